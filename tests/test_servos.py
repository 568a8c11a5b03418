"""What a loop makes of servos as real arms have them (delays, lags, friction, play, noise), and of forces beside."""

from __future__ import annotations

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
    """

    late: float = 0.0
    lag: float = 0.0
    width: float = 0.0
    noise: float = 5e-5
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
            goal = goal + ROBOT.jacobian(self.q, FRAME)[:3].T @ force / STIFFNESS
        self.q = np.clip(self.q, goal - self.width, goal + self.width)
        return self.q + self.rng.normal(0.0, self.noise, 7)


def way(**contact: object) -> ml.ServoLoop:
    """A loop that goes 0.2 m along y, and holds x and z."""
    rows = ml.Constraint([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0]], ml.FrameJacobian(ROBOT, FRAME, "xyz"))
    task = ml.motion(rows, along=0.2, speed=0.1)
    controller = ml.ResolvedRateController(rows, task, task.ascent())
    loop = ml.ServoLoop(controller, DT, contact=ml.Contact(stiffness=STIFFNESS, **contact))  # type: ignore[arg-type]
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
def test_what_servos_do_is_no_force(servos: dict[str, float], said: float | None) -> None:
    """Arms that are late, that lag, with 6 N m of friction in each joint or noisy encoders go their way; how late they
    are is said to a few milliseconds.
    """
    loop = way()
    assert "following-error" not in gone(loop, Servos(**servos), 4.0), loop.stopped_by
    notes = [float(note.split()[3]) for note in loop.notes if note.startswith("the arm follows")]
    assert notes == ([] if said is None else [pytest.approx(said, abs=8.0)])


def test_a_latency_that_is_told_is_the_most() -> None:
    """An arm that starts fast and is less late than was told goes its way."""
    rows = ml.Constraint(np.eye(3), ml.FrameJacobian(ROBOT, FRAME, "xyz"))
    goal = ROBOT.position(START, FRAME) + [0.0, 0.2, 0.1]
    controller = ml.ResolvedRateController(rows, ml.PointAttractor(goal, gain=5.0))
    loop, arm = ml.ServoLoop(controller, DT, contact=ml.Contact(latency=0.15, stiffness=STIFFNESS)), Servos(late=0.05)
    loop.reset(START)
    assert "following-error" not in gone(loop, arm, 3.0), loop.stopped_by
    assert np.linalg.norm(ROBOT.position(arm.q, FRAME) - goal) < 1e-3


def test_friction_hides_forces_and_says_which() -> None:
    """With 6 N m of friction in each joint the loop says that it cannot keep its 15 N, and at which force it stops."""
    loop = way()
    gone(loop, Servos(width=0.003), 1.5)
    (note,) = [note for note in loop.notes if "cannot be kept" in note]
    assert note.startswith("held=15 N cannot be kept")
    loop = way(resolution=0.0)
    gone(loop, Servos(width=0.003), 1.5)
    assert not [note for note in loop.notes if "cannot be kept" in note]


def test_a_rail_that_sticks_is_learnt_rightly() -> None:
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


def test_a_blocked_arm_lets_go() -> None:
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
    assert np.linalg.norm(left[1]) < 3.0 and not loop.lets_go


def test_a_stiffness_that_is_not_told_is_said() -> None:
    """The limits are then distances, and a note says what they mean."""
    rows = ml.Constraint(np.eye(3), ml.FrameJacobian(ROBOT, FRAME, "xyz"))
    loop = ml.ServoLoop(ml.ResolvedRateController(rows), DT)
    assert "the stiffness of the servos is not told" in loop.notes[0] and "mrad off" in loop.notes[0]
    assert way().notes == ()


@pytest.mark.parametrize("name", ["latency", "stiffness"])
def test_arguments_that_are_given_elsewhere_now_say_where(name: str) -> None:
    """One line of advice, with the value that was given."""
    rows = ml.Constraint(np.eye(3), ml.FrameJacobian(ROBOT, FRAME, "xyz"))
    with pytest.raises(TypeError, match=rf"'{name}': give contact=Contact\({name}=0.5\)"):
        ml.ServoLoop(ml.ResolvedRateController(rows), DT, **{name: 0.5})
