"""Moving along what a constraint leaves free: how far, how fast, and what is held meanwhile."""

from __future__ import annotations

import numpy as np
import pytest
from case import case
from test_gradients import RobotOf

from manip_learn.constraint.constraint import Constraint
from manip_learn.constraint.features import (
    CentreOfMass,
    CustomFeatures,
    FrameJacobian,
    MechanismRows,
    RelativeFrameJacobian,
)
from manip_learn.constraint.shown import shown_by
from manip_learn.control.command import Status
from manip_learn.control.controller import ResolvedRateController
from manip_learn.control.limits import Limits
from manip_learn.control.policies import ManipulabilityAscent
from manip_learn.control.rollout import Rollout
from manip_learn.control.simulation import simulate
from manip_learn.control.tasks import FreeDirection
from manip_learn.control.tasks.motion import motion
from manip_learn.control.tasks.motion_profile import MotionProfile
from manip_learn.errors import ConstraintError, FeatureError, TargetError
from manip_learn.recordings.trajectory import Trajectory
from manip_learn.robot.robot import Robot
from manip_learn.robot.rotations import rotation_matrix, rotation_vector

TIP = "panda_hand_tcp"
READY = np.array([0.0, -0.3, 0.0, -2.0, 0.0, 1.8, 0.7])
AXIS = np.array([0.1, -0.2, 0.95]) / np.linalg.norm([0.1, -0.2, 0.95])


def run(task: FreeDirection, q: np.ndarray, limits: bool | Limits = True, climb: bool = True) -> Rollout:
    learnt = task.learnt
    policy = ManipulabilityAscent(learnt, 0.3) if climb else None
    controller = ResolvedRateController(learnt, task, policy, limits=limits)
    return simulate(learnt.robot, controller, q, task.duration + 1.0, 0.01)


def tips(rollout: Rollout, robot: Robot, frame: str = TIP) -> np.ndarray:
    return np.array([robot.position(q, robot.frame(frame)) for q in rollout.q])


@pytest.mark.parametrize(("view", "distance"), [("world", 0.12), ("local", -0.12), ("relative", 0.12)])
def test_a_held_pose_along_an_oblique_line(robot_of: RobotOf, view: str, distance: float) -> None:
    """With five of six directions held, along the base, the hand or another link, the hand moves by the distance, does
    not turn, and leaves the line by less than 0.1 mm.
    """
    robot = robot_of("panda")
    f = np.concatenate([[0.6, 0.64, 0.48], np.zeros(3)])
    features = RelativeFrameJacobian(robot, TIP, "panda_link1")
    features = features if view == "relative" else FrameJacobian(robot, TIP, "pose", view)
    constraint = Constraint(np.linalg.svd(f[None])[2][1:], features)
    task = FreeDirection(constraint, distance, 0.08)
    rollout = run(task, READY, climb=False)
    start, end = features.pose(READY), features.pose(rollout.q[-1])
    turn = start[:3, :3] if view == "local" else np.eye(3)
    np.testing.assert_allclose(end[:3, 3] - start[:3, 3], turn @ f[:3] * distance, rtol=0, atol=1e-4)
    np.testing.assert_allclose(end[:3, :3], start[:3, :3], rtol=0, atol=1e-4)
    assert task.unit == "m"
    assert task.progress(rollout.q[-1]) == pytest.approx(distance, abs=1e-4)
    task = FreeDirection(Constraint(np.eye(6)[:5], features), -0.8, 0.5)
    end = features.pose(run(task, READY, climb=False).q[-1])
    Q = start[:3, :3].T @ end[:3, :3] if view == "local" else end[:3, :3] @ start[:3, :3].T
    assert task.unit == "rad"
    np.testing.assert_allclose(rotation_vector(Q), [0.0, 0.0, -0.8], rtol=0, atol=1e-4)
    np.testing.assert_allclose(end[:3, 3], start[:3, 3], rtol=0, atol=1e-4)


@pytest.mark.parametrize(
    ("rows", "degrees"),
    [("radial axial", 60), ("turn-1 turn-2 slide-1 slide-2 slide", -60), ("radial axial turn-1 turn-2 turn", 60)],
)
def test_hinge(robot_of: RobotOf, rows: str, degrees: float) -> None:
    """A door turns by 60 degrees: radius and height are kept within 0.1 mm, however the hand is held."""
    robot, distance = robot_of("panda"), np.deg2rad(degrees)
    start = robot.pose(READY, robot.frame(TIP))
    point = start[:3, 3] + [0.1, 0.25, -0.3]
    features = MechanismRows(robot, TIP, rows, axis=AXIS, point=point)
    task = FreeDirection(Constraint(np.eye(features.n_rows), features), distance, 0.6)
    rollout = run(task, READY, climb=rows == "radial axial", limits=False)
    d = tips(rollout, robot) - point
    z = d @ AXIS
    rho = np.linalg.norm(d - np.outer(z, AXIS), axis=1)
    assert np.ptp(rho) < 1e-4
    assert np.ptp(z) < 1e-4
    there = point + rotation_matrix(distance * AXIS) @ (start[:3, 3] - point)
    end = robot.pose(rollout.q[-1], robot.frame(TIP))
    np.testing.assert_allclose(end[:3, 3], there, rtol=0, atol=2e-4)
    if "slide" in rows:
        np.testing.assert_allclose(end[:3, :3], rotation_matrix(distance * AXIS) @ start[:3, :3], rtol=0, atol=1e-3)
    if rows.endswith(" turn"):
        np.testing.assert_allclose(end[:3, :3], start[:3, :3], rtol=0, atol=1e-3)
    assert task.unit == "rad"
    assert task.progress(rollout.q[-1]) == pytest.approx(distance, abs=1e-3)


@pytest.mark.parametrize(("rows", "pitch"), [("radial helical", 0.03), ("turn-1 turn-2 slide-1 slide-2 screw", -0.03)])
def test_screw(robot_of: RobotOf, rows: str, pitch: float) -> None:
    """A screw moves along its axis by the pitch times the angle, in both senses of thread, also beyond half a turn."""
    robot = robot_of("panda")
    start, angle = robot.pose(READY, robot.frame(TIP)), 4.0 if "radial" in rows else 1.5
    point = start[:3, 3] + [0.05, 0.03, 0.0]
    features = MechanismRows(robot, TIP, rows, axis=(0, 0, 1), point=point, pitch=pitch)
    task = FreeDirection(Constraint(np.eye(features.n_rows), features), angle, 0.8)
    rollout = run(task, READY, climb=False, limits=False)
    d = tips(rollout, robot) - point
    assert np.ptp(np.hypot(d[:, 0], d[:, 1])) < 1e-4
    assert d[-1, 2] - d[0, 2] == pytest.approx(pitch * angle, abs=1e-4)
    phi = np.unwrap(np.arctan2(d[:, 1], d[:, 0]))
    assert phi[-1] - phi[0] == pytest.approx(angle, abs=2e-3)
    assert task.progress(rollout.q[-1]) == pytest.approx(angle, abs=2e-3)


def test_cylinder_sleeve_and_ball(robot_of: RobotOf) -> None:
    """Where several directions are free the named one is driven, and what is held stays."""
    robot = robot_of("panda")
    start = robot.position(READY, robot.frame(TIP))
    point = start + [0.1, 0.2, -0.1]

    def moved(rows: str, distance: float, direction) -> tuple[FreeDirection, np.ndarray]:
        features = MechanismRows(robot, TIP, rows, axis=AXIS, point=point)
        task = FreeDirection(Constraint(np.eye(features.n_rows), features), distance, 0.3, direction=direction)
        rollout = run(task, READY, climb=False, limits=False)
        assert task.progress(rollout.q[-1]) == pytest.approx(distance, abs=1e-3)
        return task, tips(rollout, robot) - point

    task, d = moved("radial", 0.1, "axial")
    assert task.unit == "m"
    assert d[-1] @ AXIS - d[0] @ AXIS == pytest.approx(0.1, abs=1e-3)
    assert np.ptp(np.linalg.norm(np.cross(d, AXIS), axis=1)) < 1e-4
    task, d = moved("turn-1 turn-2 slide-1 slide-2", -0.4, "turn")
    assert np.ptp(np.linalg.norm(np.cross(d, AXIS), axis=1)) < 1e-4
    task, d = moved("turn-1 turn-2 slide-1 slide-2", -0.05, "slide")
    assert task.unit == "m"
    for rows in ("spherical", "slide-1 slide-2 slide"):
        task, d = moved(rows, 0.5, (0.0, 0.0, 2.0))
        assert task.unit == "rad"
        assert np.ptp(np.linalg.norm(d, axis=1)) < 1e-4


def test_a_peg_is_slid_or_turned_or_repeated(robot_of: RobotOf) -> None:
    """A hand on the axis of what it turns goes one way at a time, or the path that was shown."""
    robot = robot_of("panda")
    features = MechanismRows(
        robot, TIP, "turn-1 turn-2 slide-1 slide-2", axis=AXIS, point=robot.position(READY, robot.frame(TIP))
    )
    slide = FreeDirection(Constraint(np.eye(4), features), -0.05, 0.1, direction="slide")
    done = run(slide, READY, climb=False)
    shown = shown_by(features, np.eye(4), slide.learnt.mechanism, [Trajectory(done.time, done.q, done.u)])
    assert shown is not None
    peg = Constraint(np.eye(4), features, {"shown": shown.to_dict()})
    again = tips(run(motion(peg), READY, climb=False), robot)
    assert np.linalg.norm(again[-1] - tips(done, robot)[-1]) < 2e-3  # a millimetre may be missing of a way
    units = [motion(peg, along=0.05, direction="slide").unit, motion(peg, turn=0.5, direction="turn").unit]
    assert units == ["m", "rad"]


def test_direction_in_a_plane_is_projected(robot_of: RobotOf) -> None:
    """A direction out of a plane counts as far as it lies in the plane; other features with coordinates work too."""
    robot = robot_of("panda")
    constraint = Constraint([[0.0, 0.0, 1.0]], FrameJacobian(robot, TIP))
    rollout = run(FreeDirection(constraint, 0.1, 0.1, direction=(3.0, 4.0, 2.0)), READY, climb=False)
    moved = tips(rollout, robot)[-1] - tips(rollout, robot)[0]
    assert moved @ [0.6, 0.8, 0.0] == pytest.approx(0.1, abs=1e-4)
    assert abs(moved[2]) < 1e-4
    masses = Constraint(np.eye(3)[:2], CentreOfMass(robot))
    rollout = run(FreeDirection(masses, -0.04, 0.05), READY, climb=False)
    moved = robot.centre_of_mass(rollout.q[-1]) - robot.centre_of_mass(READY)
    np.testing.assert_allclose(moved, [0.0, 0.0, -0.04], rtol=0, atol=1e-4)
    with pytest.raises(ConstraintError, match=r"3 directions free \(\+1 x; \+1 y; \+1 rz\)"):
        FreeDirection(Constraint([[0, 0, 1.0, 0]], FrameJacobian(robot, TIP, "x y z rz")), 0.1, 0.1)
    four = Constraint([[0, 0, 1.0, 0]], FrameJacobian(robot, TIP, "x y z rz"))
    assert FreeDirection(four, 0.1, 0.1, direction=(1.0, 0.0, 0.0)).unit == "m"  # three numbers: x, y, z


def test_limits_delay_but_do_not_bend(robot_of: RobotOf) -> None:
    """Asked for more speed than the joints have, the arm arrives late, on the line, and never faster than asked; where
    a joint limit ends the way it stays on the line and the status says so.
    """
    robot = robot_of("panda")
    constraint = Constraint(np.eye(3)[1:], FrameJacobian(robot, TIP))
    fast = FreeDirection(constraint, -0.25, 3.0, ramp=0.05)
    strong = Limits(robot, acceleration=100.0 * robot.velocity_limit)  # whose joints brake at once
    for limits, status in ((strong, Status.VELOCITY_LIMITED), (True, Status.ACCELERATION_LIMITED)):
        fast.reset()
        rollout = run(fast, READY, limits=limits, climb=False)
        p = tips(rollout, robot)
        assert status in rollout.status
        assert np.max(np.abs(p[:, 1:] - p[0, 1:])) < 1e-3
        assert p[-1, 0] - p[0, 0] == pytest.approx(-0.25, abs=1e-3)
        assert np.max(np.abs(np.diff(p[:, 0]))) / 0.01 < 3.0 * 1.001
        assert np.all(np.abs(rollout.u) <= robot.velocity_limit + 1e-9)
    far = FreeDirection(constraint, 2.0, 0.5)
    rollout = run(far, READY, climb=False)
    p = tips(rollout, robot)
    assert np.all(rollout.q <= robot.position_upper + 1e-9)
    assert np.all(rollout.q >= robot.position_lower - 1e-9)
    assert 0.05 < far.progress(rollout.q[-1]) < 1.0
    assert rollout.task_error[-1] > 1.0
    assert set(rollout.status) - {Status.OK, Status.NULL_SCALED, Status.REROUTED}


def test_profile() -> None:
    """Position and rate agree, rise from and end at rest, reach the speed, also where the way is short or backwards."""
    for distance, speed, ramp in ((0.18, 0.1, 0.5), (-2.0, 0.7, 0.2), (0.01, 0.1, 0.5), (0.05, 0.1, 0.5)):
        profile, h = MotionProfile(distance, speed, ramp), 1e-6
        assert profile.at(-1.0) == (0.0, 0.0)
        assert profile.at(profile.duration + 1.0) == pytest.approx((distance, 0.0))
        assert profile.at(profile.duration / 2)[0] == pytest.approx(distance / 2)
        times = np.linspace(0.0, profile.duration, 200)
        for t in times[1:-1]:
            slope = (profile.at(t + h)[0] - profile.at(t - h)[0]) / (2 * h)
            assert profile.at(t)[1] == pytest.approx(slope, abs=1e-7)
        rates = np.array([profile.at(t)[1] for t in times])
        assert np.max(np.abs(rates)) == pytest.approx(profile.peak, rel=1e-3)
        assert profile.peak <= speed
        assert np.max(np.abs(np.diff(rates))) / (times[1] - times[0]) < 1.5 * profile.peak / ramp * 1.001


def test_start_reset_and_a_second_run(robot_of: RobotOf) -> None:
    """The start is the first call's, or the one that was given; a run that begins again at its first time, and reset,
    start anew.
    """
    robot = robot_of("panda")
    constraint = Constraint(np.eye(3)[1:], FrameJacobian(robot, TIP))
    task = FreeDirection(constraint, 0.05, 0.1)
    assert task.progress(READY) == 0.0
    for start in (READY, READY + 0.1):
        rollout = run(task, start, climb=False)
        p = tips(rollout, robot)
        assert p[-1, 0] - p[0, 0] == pytest.approx(0.05, abs=1e-4)
    task.reset()
    controller = ResolvedRateController(constraint, task)
    for t in (7.0, 7.01):  # clocks need not begin at 0
        assert np.linalg.norm(controller(READY, t).velocity) < 0.02
    given = FreeDirection(constraint, 0.05, 0.1, start=READY)
    here = READY + 0.02 * np.linalg.pinv(constraint.features(READY))[:, 0]
    assert given.progress(here) == pytest.approx(0.02, abs=1e-3)
    end = tips(run(given, here, climb=False), robot)[-1]
    np.testing.assert_allclose(end, robot.position(READY, robot.frame(TIP)) + [0.05, 0.0, 0.0], rtol=0, atol=1e-4)


WRONG = [
    ({"distance": 0.0}, "distance must be a finite number other than 0"),
    ({"distance": np.nan}, "distance"),
    ({"distance": "far"}, "distance must be a number"),
    ({"speed": 0.0}, "speed must be a positive number"),
    ({"speed": -0.1}, "speed must be a positive number"),
    ({"speed": np.inf}, "speed"),
    ({"gain": 0.0}, "gain"),
    ({"ramp": -1.0}, "ramp"),
    ({"direction": (0.0, 1.0, 0.0)}, r"holds the direction .* free is \+1 x"),
    ({"direction": (1.0, 0.0)}, "3 finite numbers"),
    ({"direction": (0.0, 0.0, 0.0)}, "not all zero"),
    ({"direction": "ahead"}, "3 finite numbers .* got 'ahead'"),
]


def test_wrong_arguments(robot_of: RobotOf) -> None:
    """Each is refused with a sentence that names it."""
    constraint = Constraint(np.eye(3)[1:], FrameJacobian(robot_of("panda"), TIP))
    for arguments, words in WRONG:
        with case(arguments), pytest.raises(TargetError, match=words):
            FreeDirection(constraint, **({"distance": 0.1, "speed": 0.1} | arguments))


def test_what_cannot_be_driven(robot_of: RobotOf) -> None:
    """Nothing free, several directions free, a held or unknown row, combinations, and features without coordinates."""
    robot = robot_of("panda")

    def mechanism(rows: str, selection=None, direction=None) -> None:
        features = MechanismRows(robot, TIP, rows)
        FreeDirection(
            Constraint(np.eye(features.n_rows) if selection is None else selection, features), 1, 1, direction=direction
        )

    with pytest.raises(ConstraintError, match="none of x y free"):
        FreeDirection(Constraint(np.eye(2), FrameJacobian(robot, TIP, "x y")), 0.1, 0.1)
    with pytest.raises(ConstraintError, match=r"2 directions free .*tangential \(around the axis\).*direction='tang"):
        mechanism("radial")
    with pytest.raises(ConstraintError, match="turns about every axis"):
        mechanism("spherical")
    with pytest.raises(ConstraintError, match="nothing free"):
        mechanism("radial axial tangential")
    with pytest.raises(ConstraintError, match="combinations"):
        mechanism("radial axial", [[1.0, 0.5]])
    for rows, direction in (("radial", "turn"), ("radial", (0, 0, 1)), ("spherical", "x"), ("spherical", (0, 0, 0))):
        with pytest.raises(TargetError):
            mechanism(rows, None, direction)
    mechanism("radial axial", [[1.0, 0.0]], "axial")  # what is not selected is free
    silent = CustomFeatures(lambda q: np.eye(2), ("a", "b"), 2)
    task = FreeDirection(Constraint([[1.0, 0.0]], silent), 0.1, 0.1)
    with pytest.raises(FeatureError, match="no task coordinates"):
        task.velocity(task.constraint, np.zeros(2), 0.0)
