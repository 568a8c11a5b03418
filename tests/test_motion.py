"""A way along what was learnt, in one call: the hand goes to the mechanism, along it, and says what stopped it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from task_sets import arm, learnt_from, shipped

import manip_learn as ml
from manip_learn.control.simulation import DONE, WayDone, joint_at_limit, leads_away, simulate_way
from manip_learn.control.tasks.motion import motion_to
from manip_learn.errors import ConfigurationError, ConstraintError, TargetError

READY = np.array([0.0, -0.3, 0.0, -2.0, 0.0, 1.8, 0.7])
# folder, robot, frame, number of the constraint
LEARNT = {
    "drawer": ("panda_drawer_whole", "panda", "panda_hand_tcp", 0),
    "door": ("ur5_loose_door", "ur5", "tool0", 0),
    "table": ("xarm7_drawer_then_table", "xarm7", "link_eef", 1),
}


def learnt(name: str) -> tuple[ml.Constraint, ml.Demonstrations]:
    """A constraint from the shipped recordings, and these."""
    folder, _robot, _frame, number = LEARNT[name]
    return learnt_from(folder).constraints_[number], shipped(folder)[1]


def screw() -> ml.Constraint:
    """A valve in front of a Panda: 20 mm a turn, its handle 0.12 m from the axis, in a hand that may turn."""
    robot = arm("panda")
    place = {"axis": [0.1, -0.2, 0.95], "point": [0.45, 0.1, 0.4], "pitch": 0.02 / (2 * np.pi)}
    rows = ml.MechanismRows(robot, "panda_hand_tcp", "radial helical", **place)
    return ml.Constraint(np.eye(2), rows)


def done(constraint: ml.Constraint, task: ml.FreeDirection, q0: np.ndarray) -> tuple[ml.Rollout, WayDone]:
    climb = ml.ManipulabilityAscent(task.constraint)
    return simulate_way(constraint.robot, ml.ResolvedRateController(constraint, task, climb), q0)


def tips(constraint: ml.Constraint, postures: np.ndarray) -> np.ndarray:
    """Where the hand is."""
    return np.array([constraint.robot.position(q, constraint.features.frame) for q in postures])


def inside(robot: ml.Robot, postures: np.ndarray, by: float = 1e-9) -> bool:
    return bool(np.all((postures >= robot.position_lower - by) & (postures <= robot.position_upper + by)))


@pytest.mark.parametrize(("name", "direction", "near"), [("drawer", None, 0.05), ("table", [1.0, 0.3, 0.0], 0.1)])
def test_the_hand_first_goes_to_the_mechanism(name: str, direction: list[float] | None, near: float) -> None:
    """A hand more than 0.1 m from every demonstrated position first goes to where the task was demonstrated, then moves
    the whole way to a millimetre, less than 2 mm off, within the limits. A table was not wiped everywhere.
    """
    constraint, _ = learnt(name)
    robot, task = constraint.robot, ml.motion(constraint, direction=direction, along=0.15)
    shown = np.array(constraint.provenance["postures"])
    ready = (robot.neutral(), READY, np.full(robot.nv, 0.4))
    q0 = next(q for q in ready if len(q) == robot.nv and inside(robot, q, 0.0))
    assert task.hold(shown[0]) == 0.0 and task.hold(q0) > 0.1
    rollout, way = done(constraint, task, q0)
    assert way.is_done and way.stopped_by is None and rollout.task_error[-1] < 5e-3 and way.begins > 0.0
    assert way.done == pytest.approx(way.wanted, abs=DONE[way.unit])
    assert way.deviation < 2e-3
    assert way.fastest[1] <= 1.0 + 1e-9 and inside(robot, rollout.q)
    for end in tips(constraint, rollout.q[[np.searchsorted(rollout.time, way.begins - 1e-9), -1]]):
        assert np.min(np.linalg.norm(tips(constraint, shown) - end, axis=1)) < near


def test_the_hand_keeps_its_orientation_if_asked() -> None:
    """A gripper that has closed on a handle does not turn on the way; otherwise it may."""
    constraint, _ = learnt("drawer")
    q0 = np.array(constraint.provenance["postures"][0])
    turned = []
    for keep in (True, False):
        task = ml.motion(constraint, along=0.1, keep_orientation=keep)
        rollout, way = done(constraint, task, q0)
        first, last = (constraint.robot.pose(q, constraint.features.frame)[:3, :3] for q in rollout.q[[0, -1]])
        turned.append(np.degrees(np.arccos(np.clip((np.trace(first.T @ last) - 1.0) / 2.0, -1.0, 1.0))))
        assert way.is_done and way.deviation < 1e-3
    assert turned[0] < 0.1 < turned[1]
    door = learnt("door")[0].with_orientation()
    assert door.n_constraints == 5 and door.mechanism is not None and door.mechanism.type == "hinge"


def test_a_run_may_begin_at_any_time_and_last_as_long_as_is_said() -> None:
    """The clock of the first call is the start; a given duration is kept; the fastest joint is that of the rollout."""
    constraint, _ = learnt("drawer")
    robot, q0 = constraint.robot, READY
    task = ml.motion(constraint, along=0.1)
    assert task.duration == pytest.approx(0.1 / 0.1 + 0.5)  # 0.1 m/s, and half a second from rest to it
    controller = ml.ResolvedRateController(constraint, task)
    q, dt = q0, 0.01
    for k in range(round((task.duration_from(q0) + 1.0) / dt)):
        q = q + dt * controller(q, 100.0 + k * dt, dt).velocity
    later = task.way_begins
    rollout, way = simulate_way(robot, controller, q0)
    assert later is not None and later - 100.0 == pytest.approx(way.begins, abs=0.02) and way.begins > 1.0
    assert way.fastest[1] == np.max(np.abs(rollout.u) / robot.velocity_limit)
    short, unfinished = simulate_way(robot, controller, q0, duration=1.0)
    assert short.time[-1] == 1.0 and unfinished.begins is None and not unfinished.is_done
    assert unfinished.stopped_by is not None and "on its way to the mechanism: the time" in unfinished.stopped_by


def test_a_way_that_is_too_long_says_what_stops_it() -> None:
    """How far it comes, and the joint whose limit or the singularity that ends it; nothing is beyond a limit."""
    robot = arm("panda")
    knob = ml.Constraint(np.eye(6)[:5], ml.FrameJacobian(robot, "panda_hand_tcp", "pose", "local"))
    rollout, way = done(knob, ml.motion(knob, turn=6.0), READY)
    assert not way.is_done and 1.0 < way.done < 6.0 and way.seconds is None
    assert way.stopped_by is not None and way.stopped_by.startswith("joint 'panda_joint7' at its ")
    assert inside(robot, rollout.q)
    assert way.to_dict()["stopped_by"] == way.stopped_by
    with pytest.raises(ConfigurationError, match="returned by motion"):
        simulate_way(robot, ml.ResolvedRateController(knob), READY)


def test_what_became_of_a_way_in_numbers_and_words(robot_of) -> None:
    """Degrees in JSON; 2 mm astray; within 2 mrad of a limit a joint stands at it; a push leads away from the base."""
    way = WayDone(np.pi, 0.5 * np.pi, "rad", 0.5, None, 2.1e-3, 0.4, ("a", 0.9), "the time")
    told = way.to_dict()
    assert (told["wanted"], told["done"], told["unit"], told["deviation"]) == (180.0, 90.0, "deg", 2.1e-3)
    assert way.strays and not way.is_done
    metres = replace(way, wanted=0.3, done=0.3, unit="m", deviation=1.9e-3, stopped_by=None)
    assert (metres.to_dict()["wanted"], metres.to_dict()["unit"]) == (0.3, "m") and metres.is_done and not metres.strays
    robot = robot_of("sawyer")
    for side, limit, inward in (("lower", robot.position_lower[2], 1.0), ("upper", robot.position_upper[2], -1.0)):
        said = f"joint 'right_j2' at its {side} limit of {limit:.4g} rad"
        for apart, found in ((1.9e-3, said), (2.1e-3, None)):
            assert joint_at_limit(robot, np.array([0, 0, limit + inward * apart, 0, 0, 0, 0])) == found
    for way, away in {(1.0, 0.0, 0.0): True, (0.51, 0.86, 0.0): True, (0.49, 0.87, 0.0): False}.items():
        assert leads_away(np.array([0.6, 0.0, 0.9]), np.array(way)) is away


def test_of_rows_of_a_pose_the_translations_are_meant() -> None:
    """A drawer learnt from poses leaves a translation and three rotations free: `along` needs no direction there."""
    robot = arm("panda")
    f = np.array([0.6, 0.64, 0.48])
    across = np.linalg.svd(f[None])[2][1:]
    leak = 0.004 * np.random.default_rng(0).normal(size=(2, 3))  # what a learnt Lambda has of rotations
    constraint = ml.Constraint(np.hstack([across, leak]), ml.FrameJacobian(robot, "panda_hand_tcp", "pose"))
    task = ml.motion(constraint, along=0.1)
    assert task.unit == "m" and abs(task.constraint.selection[-1][:3] @ f) > 0.999
    assert constraint.mechanism is not None and constraint.mechanism.type == "line"
    _rollout, way = done(constraint, task, READY)
    assert way.is_done
    held = ml.Constraint(np.eye(6)[3:5], ml.FrameJacobian(robot, "panda_hand_tcp", "pose"))  # an upright cup
    with pytest.raises(ConstraintError, match="3 directions free"):
        ml.motion(held, along=0.1)
    assert ml.motion(held, along=0.1, direction=[0, 0, 1]).unit == "m"


def test_a_door_is_not_turned_towards_a_point_from_elsewhere() -> None:
    """A hand that is not on the mechanism is refused, so is what turns about no axis, and a distance with an angle."""
    point = np.array([0.4, 0.2, 0.5])
    with pytest.raises(TargetError, match="away from the hinge"):
        motion_to(learnt("door")[0], point, np.array([0.5, -1.5, 1.0, -1.0, -1.5, 0.0]))
    with pytest.raises(ConstraintError, match="has no single rotation axis"):
        motion_to(learnt("drawer")[0], point, READY)
    with pytest.raises(TargetError, match="one distance or angle"):
        ml.motion(learnt("drawer")[0], along=0.1, turn=0.2)
