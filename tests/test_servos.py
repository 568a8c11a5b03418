"""What a loop makes of servos as real arms have them (delays, lags, friction, play, noise), and of forces beside."""

from __future__ import annotations

import numpy as np
import pytest

import manip_learn as ml

DT, STIFFNESS, FRAME = 0.002, 2000.0, "right_gripper_tip"
START = np.array([0.3, -0.6, 0.1, 1.4, 0.2, 0.8, 0.4])
ROBOT = ml.load_robot("sawyer")
BLOCKED = "following-error"


def hand(q) -> np.ndarray:
    """Its place [m]."""
    return ROBOT.position(q, FRAME)


def rows_of(q=START) -> np.ndarray:
    """Rows of the hand's place."""
    return ROBOT.jacobian(q, FRAME)[:3]


def way(**contact) -> ml.ServoLoop:
    """A loop that goes 0.2 m along y, and holds x and z."""
    rows = ml.Constraint([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0]], ml.FrameJacobian(ROBOT, FRAME, "xyz"))
    task = ml.motion(rows, along=0.2, speed=0.1)
    controller = ml.ResolvedRateController(rows, task, task.ascent())
    loop = ml.ServoLoop(controller, DT, contact=ml.Contact(**{"stiffness": STIFFNESS, **contact}))
    loop.reset(START)
    return loop


class Servos:
    """An arm without inertia on a loop: it is where its servos bring it, and gives way to a force on the hand.

    Attributes:
        late: Delay [s].
        lag: First-order lag [s].
        width: Friction over stiffness, or half of the play [rad].
        noise: Of the encoders [rad].
        stiffness: Of the servos [N m/rad].
    """

    def __init__(self, loop=None, late=0.0, lag=0.0, width=0.0, noise=5e-5, stiffness=STIFFNESS, seed=3):
        self.loop, self.late, self.lag, self.width, self.noise = loop or way(), late, lag, width, noise
        self.stiffness, self.sent, self.q, self.smooth = stiffness, [START], START, START
        self.rng = np.random.default_rng(seed)

    def read(self, force=0.0) -> np.ndarray:
        """Where the encoders see it, under a force on the hand [N]."""
        goal = self.sent[max(0, len(self.sent) - 1 - round(self.late / DT))]
        self.smooth = goal = self.smooth + (goal - self.smooth) * (DT / (self.lag + DT) if self.lag else 1.0)
        if np.any(force):
            goal = goal + rows_of(self.q).T @ force / self.stiffness
        self.q = np.clip(self.q, goal - self.width, goal + self.width)
        return self.noisy(self.q)

    def noisy(self, q) -> np.ndarray:
        """As the encoders see a posture."""
        return q + self.rng.normal(0.0, self.noise, 7)

    def call(self, measured) -> str:
        """The status of a period in which that was measured."""
        status = self.loop.update(measured, self.loop.dt * (len(self.sent) - 1)).status
        self.sent.append(np.array(self.loop.position))
        return str(status)

    def go(self, seconds: float, force=0.0) -> list[str]:
        """Statuses of so many seconds; a force on the hand, or one that depends on the time [s]."""
        of = force if callable(force) else lambda t: force
        return [self.call(self.read(of(DT * len(self.sent)))) for _ in range(round(seconds / DT))]

    def stuck(self, periods: int, q) -> list[str]:
        """Statuses while it is held fast."""
        return [self.call(self.noisy(q)) for _ in range(periods)]

    @property
    def said(self) -> str:
        """What the loop says."""
        return " ".join([str(self.loop.stopped_by), *self.loop.notes])


@pytest.mark.parametrize(
    ("servos", "late"),
    [({}, None), ({"late": 0.034}, 34.0), ({"late": 0.004, "lag": 0.05}, 54.0), ({"width": 0.003, "late": 0.04}, 40.0),
     ({"noise": 2e-4}, None), ({"late": 0.190}, 190.0)],
)  # fmt: skip
def test_what_servos_do_is_no_force(servos, late):
    """Arms that are late, that lag, with 6 N m of friction in each joint or noisy encoders go their way; how late they
    are is said to a few milliseconds.
    """
    arm = Servos(**servos)
    assert BLOCKED not in arm.go(4.0), arm.said
    notes = [float(note.split()[3]) for note in arm.loop.notes if note.startswith("the arm follows")]
    assert notes == ([] if late is None else [pytest.approx(late, abs=8.0)])


@pytest.mark.parametrize(("told", "said"), [({}, ["max_lateral_force=15 N cannot be kept"]), ({"resolution": 0.0}, [])])
def test_friction_hides_forces_and_says_which(told, said):
    """With 6 N m of friction in each joint the loop says that it cannot keep its 15 N, unless it is told otherwise."""
    arm = Servos(way(**told), width=0.003)
    arm.go(1.5)
    assert [n[:37] for n in arm.loop.notes if "cannot be kept" in n] == said


@pytest.mark.parametrize("mass", [4.0, 6.0])
@pytest.mark.parametrize("stiffness", [2000.0, 200.0])
@pytest.mark.parametrize("since", [0.0, 1.0])
def test_an_arm_under_a_weight_stands(stiffness, mass, since):
    """A weight that the drives do not know of stops the arm, and the words name the payload; the arm lets go of nothing
    that it carries from the start, by millimetres of what it takes in motion, and after `reset()` it stands.
    """
    arm = Servos(way(stiffness=stiffness), late=0.006, lag=0.02, stiffness=stiffness)
    weight = np.array([0.0, 0.0, -9.81 * mass])
    for _ in range(0 if since else 50):
        arm.read(weight)
    words = arm.go(2.0, lambda t: weight * (t >= since))
    trip = words.index(BLOCKED)
    assert abs(DT * trip - since) < 0.3 and words[-1] == BLOCKED and not arm.loop.state.lets_go
    assert f"'{FRAME}'" in arm.loop.stopped_by
    about = float(arm.loop.stopped_by.split("payload of about ")[1].split()[0])
    assert about == pytest.approx(mass, rel=0.15)
    stood = hand(arm.sent[-1])[2]
    assert hand(arm.sent[trip + 1])[2] - stood < (1e-4 if since == 0.0 else 0.01)
    arm.loop.reset()
    arm.go(0.3, weight)
    assert abs(hand(arm.sent[-1])[2] - stood) < 1e-3


@pytest.mark.parametrize(("push", "kilograms"), [([30.0, 0, 0], 0.0), ([0, 0, 30.0], 0.0), ([0, 0, -50.0], 1.0)])
def test_a_push_is_no_payload(push, kilograms):
    """A force to the side, from below, or that comes on an arm with 1 kg: no payload is made of it."""
    arm = Servos(late=0.006)
    assert BLOCKED not in arm.go(1.0, np.array([0.0, 0.0, -9.81 * kilograms]))
    # held fast against the push, so that letting go makes the force less
    words = arm.stuck(300, arm.q + rows_of(arm.q).T @ np.array(push) / STIFFNESS)
    assert words[-1] == BLOCKED and "payload" not in arm.loop.stopped_by


@pytest.mark.parametrize(
    ("share", "since", "ramp"),
    [(0.3, 0.0, 0.0), (0.5, 0.0, 0.0), (0.7, 0.0, 0.0), (0.9, 0.0, 0.0), (0.3, 0.8, 0.0), (0.5, 0.8, 0.0),
     (0.7, 1.2, 0.0), (0.9, 0.6, 0.0), (0.3, 0.6, 0.8)],
)  # fmt: skip
def test_a_path_that_is_followed_slowly_is_said(share, since, ramp):
    """The words name the share of the speed; no force, no friction and no lock is said of it."""
    arm, at, words = Servos(noise=1e-5, seed=1), 0.0, []
    for k in range(round(2.5 / DT)):
        slow = 0.0 if k * DT < since else min(1.0, (k * DT - since) / ramp) if ramp else 1.0
        at = min(at + 1.0 - (1.0 - share) * slow, len(arm.sent) - 1.0) if k else 0.0
        i, part = int(at), at % 1.0
        words.append(arm.call(arm.noisy((1.0 - part) * arm.sent[i] + part * arm.sent[min(i + 1, len(arm.sent) - 1)])))
    assert BLOCKED in words and "% of its speed" in arm.said
    assert not any(word in arm.said for word in (" N along", " N across", "locked", "friction"))
    told = float(arm.loop.stopped_by.split("at about ")[1].split("%")[0]) / 100.0
    assert told == pytest.approx(share, abs=0.08) or ramp


@pytest.mark.parametrize("since", [0.4, 0.8, 1.2])
def test_an_arm_that_stands_altogether_is_said(since):
    """Brakes that close stop every joint; a drawer that jams leaves spare joints moving, and is called a block."""
    arm, jammed = Servos(noise=1e-5), Servos(noise=1e-5)
    arm.go(since)
    jammed.go(since)
    place = hand(arm.q)
    arm.stuck(300, arm.q)
    for _ in range(300):
        q = jammed.sent[-1]
        for _ in range(3):  # the hand stays, the joints go as near to where they are sent as that lets them
            q = q + rows_of(q).T @ np.linalg.solve(rows_of(q) @ rows_of(q).T, place - hand(q))
        jammed.call(jammed.noisy(q))
    assert "no joint moves any more" in arm.loop.stopped_by and "brakes" in arm.loop.stopped_by
    said = jammed.loop.stopped_by
    assert " N along the driven direction" in said and "no joint" not in said and "% of its speed" not in said


@pytest.mark.parametrize("every", [0.02, 0.04])
def test_readings_that_are_slower_than_the_loop_are_said(every):
    """The note has both periods, and nothing is said of friction, nor is the arm stopped."""
    arm, q = Servos(noise=1e-5, seed=2), START
    for k in range(round(1.5 / DT)):
        q = arm.sent[-1] if k % round(every / DT) == 0 else q
        assert arm.call(arm.noisy(q)) != BLOCKED, arm.said
    assert f"readings change every {1e3 * every:.0f} ms, the loop runs at 2 ms" in arm.said
    assert "friction" not in arm.said


def test_a_stiffness_that_is_not_told_is_said():
    """The limits are then distances, and a note says what they mean."""
    loop = ml.ServoLoop(way().controller, DT)
    assert "the stiffness of the servos is unknown" in loop.notes[0] and "mrad off" in loop.notes[0]
    rng = np.random.default_rng(1)
    levers = [np.linalg.norm(rows_of(ROBOT.random_configuration(rng)), axis=0).max() for _ in range(999)]
    told = float(loop.notes[0].split(" mrad off")[0].split()[-1])
    assert told == pytest.approx(1e3 * 15.0 * max(levers) / STIFFNESS, rel=0.06)
    assert way().notes == ()
