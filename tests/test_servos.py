"""What a loop makes of servos as real arms have them (delays, lags, friction, play, noise), and of forces beside."""

from __future__ import annotations

import pickle
from dataclasses import dataclass, field

import numpy as np
import pytest

import manip_learn as ml

DT, STIFFNESS, FRAME = 0.002, 2000.0, "right_gripper_tip"
START = np.array([0.3, -0.6, 0.1, 1.4, 0.2, 0.8, 0.4])
ROBOT = ml.load_robot("sawyer")


@dataclass
class Servos:
    """An arm without inertia: it is where its servos bring it, and gives way to a force on the hand.

    Attributes:
        late: Delay [s].
        lag: First-order lag [s].
        width: Friction over stiffness, or half of the play [rad].
        noise: Of the encoders [rad].
        stiffness: Of the servos [N m/rad].
    """

    late: float = 0.0
    lag: float = 0.0
    width: float = 0.0
    noise: float = 5e-5
    stiffness: float = STIFFNESS
    sent: list[np.ndarray] = field(default_factory=lambda: [START])
    q: np.ndarray = field(default_factory=START.copy)
    smooth: np.ndarray = field(default_factory=START.copy)
    rng: np.random.Generator = field(default_factory=lambda: np.random.default_rng(3))

    def read(self, force: np.ndarray | float = 0.0) -> np.ndarray:
        """Where the encoders see it, under a force on the hand [N]."""
        goal = self.sent[max(0, len(self.sent) - 1 - round(self.late / DT))]
        self.smooth = self.smooth + (goal - self.smooth) * (DT / (self.lag + DT) if self.lag else 1.0)
        goal = self.smooth
        if np.any(force):
            goal = goal + ROBOT.jacobian(self.q, FRAME)[:3].T @ force / self.stiffness
        self.q = np.clip(self.q, goal - self.width, goal + self.width)
        return self.q + self.rng.normal(0.0, self.noise, 7)


def way(**contact: object) -> ml.ServoLoop:
    """A loop that goes 0.2 m along y, and holds x and z."""
    rows = ml.Constraint([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0]], ml.FrameJacobian(ROBOT, FRAME, "xyz"))
    task = ml.motion(rows, along=0.2, speed=0.1)
    controller = ml.ResolvedRateController(rows, task, task.ascent())
    loop = ml.ServoLoop(controller, DT, contact=ml.Contact(**{"stiffness": STIFFNESS, **contact}))  # type: ignore[arg-type]
    loop.reset(START)
    return loop


def gone(loop: ml.ServoLoop, arm: Servos, seconds: float, force: object = 0.0) -> list[str]:
    """Statuses of so many seconds; a force on the hand, or one that depends on the time [s]."""
    words = []
    for _ in range(round(seconds / DT)):
        t = DT * len(arm.sent)
        words.append(str(loop.update(arm.read(force(t) if callable(force) else force), t).status))  # type: ignore[arg-type]
        assert loop.position is not None
        arm.sent.append(loop.position)
    return words


@pytest.mark.parametrize(
    ("servos", "said"),
    [
        ({}, None),
        ({"late": 0.034}, 34.0),
        ({"late": 0.004, "lag": 0.05}, 54.0),
        ({"width": 0.003, "late": 0.04}, 40.0),
        ({"noise": 2e-4}, None),
        ({"late": 0.190}, 190.0),
    ],
)
def test_what_servos_do_is_no_force(servos, said):
    """Arms that are late, that lag, with 6 N m of friction in each joint or noisy encoders go their way; how late they
    are is said to a few milliseconds.
    """
    loop = way()
    assert "following-error" not in gone(loop, Servos(**servos), 4.0), loop.stopped_by
    notes = [float(note.split()[3]) for note in loop.notes if note.startswith("the arm follows")]
    assert notes == ([] if said is None else [pytest.approx(said, abs=8.0)])


def test_a_latency_that_is_told_is_the_most():
    """An arm that starts fast and is less late than was told goes its way."""
    rows = ml.Constraint(np.eye(3), ml.FrameJacobian(ROBOT, FRAME, "xyz"))
    goal = ROBOT.position(START, FRAME) + [0.0, 0.2, 0.1]
    controller = ml.ResolvedRateController(rows, ml.PointAttractor(goal, gain=5.0))
    loop, arm = ml.ServoLoop(controller, DT, contact=ml.Contact(latency=0.15, stiffness=STIFFNESS)), Servos(late=0.05)
    loop.reset(START)
    assert "following-error" not in gone(loop, arm, 3.0), loop.stopped_by
    assert np.linalg.norm(ROBOT.position(arm.q, FRAME) - goal) < 1e-3


def test_friction_hides_forces_and_says_which():
    """With 6 N m of friction in each joint the loop says that it cannot keep its 15 N, and at which force it stops."""
    loop = way()
    gone(loop, Servos(width=0.003), 1.5)
    (note,) = [note for note in loop.notes if "cannot be kept" in note]
    assert note.startswith("max_lateral_force=15 N cannot be kept")
    loop = way(resolution=0.0)
    gone(loop, Servos(width=0.003), 1.5)
    assert not [note for note in loop.notes if "cannot be kept" in note]


def test_a_rail_that_sticks_is_learnt_rightly():
    """A drawer that moves at 50 N only is pulled out: its rail is pressed aside by an arm that is not equally stiff in
    all directions, and the hand is on its way for all that.
    """
    loop, arm = way(), Servos()
    rail = np.array([0.0, 1.0, 0.0])
    place, most, aside = ROBOT.position(START, FRAME), 50.0, 0.0
    for _ in range(round(3.0 / DT)):
        J = ROBOT.jacobian(arm.sent[-1], FRAME)[:3]
        yields = J @ J.T / STIFFNESS
        away = place - ROBOT.position(arm.sent[-1], FRAME)
        force = np.linalg.solve(yields, away)
        if abs(force @ rail) > most:  # it slides until less is left
            slid = np.linalg.solve(yields, rail) @ rail
            place = place + (np.sign(force @ rail) * most - force @ rail) / slid * rail
            force = np.linalg.solve(yields, place - ROBOT.position(arm.sent[-1], FRAME))
        aside = max(aside, float(np.linalg.norm(force - force @ rail * rail)))
        status = loop.update(arm.read(force), DT * len(arm.sent)).status
        assert status != "following-error", loop.stopped_by
        assert loop.position is not None
        arm.sent.append(loop.position)
    assert aside > 15.0  # more than is allowed across a way
    assert (place - ROBOT.position(START, FRAME)) @ rail > 0.18


def test_a_blocked_arm_lets_go():
    """An arm that is held fast in motion is stopped with less than 60 N, and is then not pressed on."""
    loop, arm = way(), Servos(late=0.004)
    gone(loop, arm, 1.0)
    held = arm.q.copy()
    words = []
    for _ in range(600):
        words.append(str(loop.update(held + arm.rng.normal(0.0, 5e-5, 7), DT * len(arm.sent)).status))
        assert loop.position is not None
        arm.sent.append(loop.position)
    assert "following-error" in words and words.index("following-error") < 60
    C = ROBOT.jacobian(held, FRAME)[:3] / STIFFNESS
    left = [np.linalg.lstsq(C.T, q - held)[0] for q in (np.array(arm.sent[500 + 60]), np.array(arm.sent[-1]))]
    assert np.linalg.norm(left[1]) < 3.0 and not loop.state.lets_go


@pytest.mark.parametrize("mass", [4.0, 6.0])
@pytest.mark.parametrize("stiffness", [2000.0, 200.0])
@pytest.mark.parametrize("since", [0.0, 1.0])
def test_an_arm_under_a_weight_stands(stiffness, mass, since):
    """A weight that the drives do not know of stops the arm, and the words name the payload; the arm lets go of nothing
    that it carries from the start, by millimetres of what it takes in motion, and after `reset()` it stands.
    """
    loop, arm = way(stiffness=stiffness), Servos(late=0.006, lag=0.02, stiffness=stiffness)
    weight = np.array([0.0, 0.0, -9.81 * mass])
    if since == 0.0:
        for _ in range(50):
            arm.read(weight)
    words = gone(loop, arm, 2.0, lambda t: weight * (t >= since))
    trip = words.index("following-error")
    assert abs(DT * trip - since) < 0.3 and words[-1] == "following-error" and not loop.state.lets_go
    said = loop.stopped_by or ""
    assert "payload of about" in said and f"'{FRAME}'" in said
    about = float(said.split("payload of about ")[1].split()[0])
    assert about == pytest.approx(mass, rel=0.15)
    stood = ROBOT.position(arm.sent[-1], FRAME)[2]
    assert ROBOT.position(arm.sent[trip + 1], FRAME)[2] - stood < (1e-4 if since == 0.0 else 0.01)
    loop.reset()
    gone(loop, arm, 0.3, weight)
    assert abs(ROBOT.position(arm.sent[-1], FRAME)[2] - stood) < 1e-3


@pytest.mark.parametrize(
    ("push", "kilograms"), [([30.0, 0.0, 0.0], 0.0), ([0.0, 0.0, 30.0], 0.0), ([0.0, 0.0, -50.0], 1.0)]
)
def test_a_push_is_no_payload(push, kilograms):
    """A force to the side, from below, or that comes on an arm with 1 kg: no payload is made of it."""
    loop, arm = way(), Servos(late=0.006)
    carried = np.array([0.0, 0.0, -9.81 * kilograms])
    words = gone(loop, arm, 1.0, carried)
    assert "following-error" not in words
    # held fast against the push, so that letting go makes the force less
    held = arm.q + ROBOT.jacobian(arm.q, FRAME)[:3].T @ np.array(push) / STIFFNESS
    for _ in range(300):
        status = loop.update(held + arm.rng.normal(0.0, 5e-5, 7), DT * len(arm.sent)).status
        arm.sent.append(np.array(loop.position))
    assert status == "following-error" and "payload" not in (loop.stopped_by or "")


@pytest.mark.parametrize(("dt", "noise"), [(0.0005, 1e-4), (0.001, 1e-4), (0.002, 1e-3), (0.02, 1e-4)])
def test_reset_ends_whatever_the_noise(dt, noise):
    """After a following error the arm moves again within 2 s, at every period and with every encoder."""
    rows = ml.Constraint(np.eye(3), ml.FrameJacobian(ROBOT, FRAME, "xyz"))
    law = ml.ResolvedRateController(rows, ml.PointAttractor(ROBOT.position(START, FRAME) + 0.2))
    loop = ml.ServoLoop(law, dt, contact=ml.Contact(stiffness=STIFFNESS))
    q, rng, status = START, np.random.default_rng(5), ""
    for k in range(round(3.0 / dt)):
        if k == round(1.0 / dt):
            assert status == "following-error"
            loop.reset()
        status = loop.update(q + rng.normal(0.0, noise, 7), k * dt).status
        if not 0.2 < k * dt < 0.6:  # the arm is held fast meanwhile
            q = np.array(loop.position)
        if k * dt > 1.1 and status != "following-error":
            break
    assert k * dt < 2.9


def slowed(share: float, since: float, ramp: float = 0.0) -> tuple[ml.ServoLoop, list[str]]:
    """A loop whose arm goes along the path that is sent at a share of its speed, from a time on."""
    loop, sent, rng, at = way(), [START], np.random.default_rng(1), 0.0
    words = []
    for k in range(round(2.5 / DT)):
        slow = 0.0 if k * DT < since else min(1.0, (k * DT - since) / ramp) if ramp else 1.0
        at = min(at + 1.0 - (1.0 - share) * slow, len(sent) - 1.0) if k else 0.0
        i, part = int(at), at - int(at)
        measured = sent[i] if part == 0.0 else (1.0 - part) * sent[i] + part * sent[i + 1]
        words.append(str(loop.update(measured + rng.normal(0.0, 1e-5, 7), k * DT).status))
        sent.append(np.array(loop.position))
    return loop, words


@pytest.mark.parametrize(
    ("share", "since", "ramp"),
    [(0.3, 0.0, 0.0), (0.5, 0.0, 0.0), (0.7, 0.0, 0.0), (0.9, 0.0, 0.0), (0.3, 0.8, 0.0), (0.5, 0.8, 0.0),
     (0.7, 1.2, 0.0), (0.9, 0.6, 0.0), (0.3, 0.6, 0.8)],
)  # fmt: skip
def test_a_path_that_is_followed_slowly_is_said(share, since, ramp):
    """The words name the share of the speed; no force, no friction and no lock is said of it."""
    loop, words = slowed(share, since, ramp)
    assert "following-error" in words
    said = " ".join([str(loop.stopped_by), *loop.notes])
    assert "% of its speed" in said
    assert not any(word in said for word in (" N along", " N across", "locked", "friction"))
    told = float(str(loop.stopped_by).split("at about ")[1].split("%")[0]) / 100.0
    assert told == pytest.approx(share, abs=0.08) or ramp


@pytest.mark.parametrize("since", [0.4, 0.8, 1.2])
def test_an_arm_that_stands_altogether_is_said(since):
    """Brakes that close stop every joint; a drawer that jams leaves spare joints moving, and is called a block."""
    loop, arm = way(), Servos(noise=1e-5)
    gone(loop, arm, since)
    jammed, place, q = way(), ROBOT.position(arm.q, FRAME), arm.q.copy()
    gone(jammed, other := Servos(noise=1e-5), since)
    for _ in range(300):
        loop.update(arm.q + arm.rng.normal(0.0, 1e-5, 7), DT * len(arm.sent))
        arm.sent.append(np.array(loop.position))
        q = np.array(other.sent[-1])
        for _ in range(3):  # the hand stays, the joints go as near to where they are sent as that lets them
            J = ROBOT.jacobian(q, FRAME)[:3]
            q = q + J.T @ np.linalg.solve(J @ J.T, place - ROBOT.position(q, FRAME))
        jammed.update(q + other.rng.normal(0.0, 1e-5, 7), DT * len(other.sent))
        other.sent.append(np.array(jammed.position))
    assert "no joint moves any more" in (loop.stopped_by or "") and "brakes" in (loop.stopped_by or "")
    said = jammed.stopped_by or ""
    assert " N along what is driven" in said and "no joint" not in said and "% of its speed" not in said


@pytest.mark.parametrize("every", [0.02, 0.04])
def test_readings_that_are_slower_than_the_loop_are_said(every):
    """The note has both periods, and nothing is said of friction, nor is the arm stopped."""
    loop, arm, rng = way(), START, np.random.default_rng(2)
    for k in range(round(1.5 / DT)):
        if k % round(every / DT) == 0:
            arm = START if k == 0 else np.array(loop.position)
        assert loop.update(arm + rng.normal(0.0, 1e-5, 7), k * DT).status != "following-error", loop.stopped_by
    said = " ".join(loop.notes)
    assert f"readings change every {1e3 * every:.0f} ms, the loop runs at 2 ms" in said and "friction" not in said


def test_an_arm_that_stands_remembers_no_more_and_more():
    """After a start of 40 ms, too short to tell what its servos do, it stands for 2 s or 4 s and remembers as much."""
    loop, arm, sizes = way(), Servos(), []
    gone(loop, arm, 0.04)
    loop.stop()
    for _ in range(2):
        gone(loop, arm, 2.0)
        sizes.append(len(pickle.dumps(loop.state.following.servos)))
    assert loop.state.following.servos.late is None and sizes[0] == sizes[1]


def test_a_stiffness_that_is_not_told_is_said():
    """The limits are then distances, and a note says what they mean."""
    rows = ml.Constraint(np.eye(3), ml.FrameJacobian(ROBOT, FRAME, "xyz"))
    loop = ml.ServoLoop(ml.ResolvedRateController(rows), DT)
    assert "the stiffness of the servos is not told" in loop.notes[0] and "mrad off" in loop.notes[0]
    assert way().notes == ()


@pytest.mark.parametrize("name", ["latency", "stiffness"])
def test_arguments_that_are_given_elsewhere_now_say_where(name):
    """One line of advice, with the value that was given."""
    rows = ml.Constraint(np.eye(3), ml.FrameJacobian(ROBOT, FRAME, "xyz"))
    with pytest.raises(TypeError, match=rf"'{name}': give contact=Contact\({name}=0.5\)"):
        ml.ServoLoop(ml.ResolvedRateController(rows), DT, **{name: 0.5})
