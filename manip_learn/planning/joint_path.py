"""Joint paths around obstacles: RRT-Connect and path shortcuts of RoboPlan, in a copy of our own scene.

RoboPlan (https://github.com/open-planning/roboplan) plans on Pinocchio and Coal in C++. A URDF with plain names is
written for it, with our joints, limits and shapes, whatever file the robot came from. RoboPlan has no clearance: the
shapes of the links are inflated in its copy instead. Our own distances alone decide if a path is clear.
"""

from __future__ import annotations

import logging
import tempfile
import threading
import warnings
from functools import lru_cache
from importlib import import_module
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from manip_learn.control.limits import Limits
from manip_learn.errors import MissingExtraError
from manip_learn.planning.clearance import Clearance, Posture
from manip_learn.robot.collision import CollisionShape, SelfCollision
from manip_learn.robot.plain_urdf import joint_name, plain_urdf
from manip_learn.robot.robot import Robot

_TURN = 2.0 * np.pi  # [rad] one turn; the range of a continuous joint is one turn to both sides
Joints = Bool[np.ndarray, " nv"]
_LOCK, _LOG = threading.Lock(), logging.getLogger(__name__)  # a copy is for one thread at a time


def joint_path(
    robot: Robot, start: Posture, goal: Posture, limits: Limits, clear: Clearance, seed: int
) -> list[Posture] | None:
    """Plan a joint path from a start to a goal that is free of collisions.

    RoboPlan is imported only if the straight motion is not free. It plans for revolute and prismatic joints, and for
    joints that mimic an earlier one of these. The reason for a failure is logged at level INFO.

    Args:
        robot: The robot.
        start: Joint positions (nv,) within the limits [rad or m].
        goal: Joint positions (nv,) within the limits [rad or m]; for a joint without limits, at most a turn from the
            start.
        limits: Joint limits; only the position limits are used.
        clear: Collision check.
        seed: Seed of the search: the same seed gives the same path.

    Returns:
        Waypoints, joint positions (nv,) each, including start and goal, with straight joint motions between them; None
        if no path was found.

    Raises:
        MissingExtraError: The straight motion is not clear, and RoboPlan is not installed.
    """
    # searches in each copy; inflation of the links in each copy, in clearances: less if the start or the goal has no
    # more, more if paths come too near
    n_searches, inflations = 3, (1.0, 0.4, 2.0)
    if not (clear(start) and clear(goal)):
        return None
    if clear.is_line_clear(start, goal):
        return [start, goal]
    why = "every path that was found comes too near to something on the way"
    endless = (np.array(robot.joint_units) == "rad") & ~np.isfinite(limits.lower) & ~np.isfinite(limits.upper)
    turns = np.where(endless, _TURN * np.round(0.5 * (start + goal) / _TURN), 0.0)
    differ, supports = start != goal, robot.pinocchio_model.supports
    below = {j for block in robot.blocks if np.any(differ[block.v]) for j in supports[block.index]}
    carry = differ | np.array([block.index in below for block in robot.blocks for _ in block.units])
    for free in (carry,) if np.all(carry) else (carry, np.ones_like(carry)):  # move the fingers only if necessary
        for grown, number in product(inflations, np.random.SeedSequence(seed).generate_state(n_searches)):
            try:
                with _LOCK:
                    knots = _plan_in_copy(limits, clear, grown, free, (start - turns, goal - turns), int(number) >> 1)
            except (RuntimeError, ValueError) as error:  # the exceptions of RoboPlan
                why = str(error)
                break
            path = [start, *(knots[1:-1] + turns), goal]
            if len(knots) and clear.is_path_clear(path):
                return path
    _LOG.info("no path round what is in the way: %s", why)
    return None


def _plan_in_copy(
    limits: Limits, clear: Clearance, grown: float, free: Joints, ends: tuple[Posture, Posture], seed: int
) -> Float[np.ndarray, "k nv"]:
    """Return RoboPlan's path in a copy with inflated links; empty if start or goal are in contact in it."""
    # [rad or m] growth of a tree in one step, and distance between RoboPlan's checks, all joints together; our own
    # checks of the result are denser
    reach, resolution = 1.0, 0.05
    # nodes of both trees: a path around a box takes 150 at most; duration of a search that adds no nodes, e.g. if the
    # start is shut in [s]
    max_nodes, max_seconds = 300, 2.0
    try:
        with warnings.catch_warnings():  # its viewer raises a deprecation warning
            warnings.simplefilter("ignore", DeprecationWarning)
            core, rrt = import_module("roboplan.core"), import_module("roboplan.rrt")
    except ImportError as error:
        raise MissingExtraError("a path round what is in the way", "plan") from error
    scene = _copy_scene(clear.links, clear.pairs, limits, grown * clear.least)
    names = np.array([joint_name(block.index) for block in limits.robot.blocks])
    place, start = np.argsort(scene.getJointPositionIndices(names.tolist())), ends[0]
    if any(scene.hasCollisions(q[place]) for q in ends):
        return np.empty((0, len(start)))
    scene.setJointPositions(start[place])  # for the joints at rest
    scene.addGroup("free", names[free].tolist())
    options = rrt.RRTOptions("free", max_nodes, reach, resolution, max_planning_time=max_seconds, rrt_connect=True)
    planner = rrt.RRT(scene, options)
    planner.setRngSeed(seed)
    path = planner.plan(*(core.JointConfiguration(names[free].tolist(), q[free]) for q in ends))
    path = core.PathShortcutter(scene, core.PathShortcuttingOptions("free", resolution, seed=seed)).shortcut(path)
    knots = np.tile(start, (len(path.positions), 1))
    knots[:, free] = path.positions
    return knots[np.append(True, np.any(np.diff(knots, axis=0), axis=1))]  # the knot where the trees meet is repeated


@lru_cache(maxsize=8)  # of a few megabytes each
def _copy_scene(links: SelfCollision, pairs: tuple[tuple[int, int], ...], limits: Limits, larger: float) -> Any:
    """Return a copy of our scene for RoboPlan, with links inflated by a distance [m]."""
    tolerance = 1e-9  # [rad or m] margin of the limits in the copy: the start and the goal may be at a limit
    core = import_module("roboplan.core")
    sizes, together = dict[str, tuple[CollisionShape, float]](), list[tuple[str, str]]()
    for k, other in pairs:
        hull = other in links.faces
        one, two = f"{'h' if hull else 'g'}{k:03}", f"s{other:03}"
        sizes |= {one: (links.solid(k, hull), larger), two: (links.solid(other), 0.0)}
        together.append((one, two))
    low = np.where(np.isfinite(limits.lower), limits.lower, np.minimum(limits.upper - 2.0 * _TURN, -_TURN))
    high = np.where(np.isfinite(limits.upper), limits.upper, np.maximum(limits.lower + 2.0 * _TURN, _TURN))
    with tempfile.TemporaryDirectory(prefix="manip_learn_") as folder:
        text = plain_urdf(limits.robot, low - tolerance, high + tolerance, sizes, Path(folder))
        scene = core.Scene("copy", core.loadUrdfSceneDescriptionFromXml(text))
    scene.setCollisions([(a, b) for a, b in product(sizes, sizes) if a < b], False)
    scene.setCollisions(together, True)
    return scene
