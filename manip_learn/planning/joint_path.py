"""A joint path round what is in the way: the RRT-Connect and the shortcuts of RoboPlan, in a copy of our own scene.

RoboPlan (https://github.com/open-planning/roboplan) plans on Pinocchio and Coal in C++. A URDF with plain names is
written for it, of our joints, limits and shapes, whatever file the robot came from. It knows no clearance: of each pair
of shapes the link's is larger in its copy. Our own distances alone decide whether a path is clear.
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

NODES = 300  # of both trees: a path round a box takes 150 at most
REACH = 1.0  # [rad or m] by which a tree grows at once, all joints together
COARSE = 0.05  # [rad or m] between RoboPlan's checks, all joints together; those of the result are closer
SECONDS = 2.0  # of a search that adds no nodes, as from a start that is shut in: no number of nodes ends it
SEEDS = 3  # searches in each copy
GROWN = (1.0, 0.4, 2.0)  # times the clearance: less where start or goal has no more, more where paths come too near
_ROUNDING = 1e-9  # [rad or m] beyond limits: start and goal may stand at them
COPIES = 8  # that are kept, of a few megabytes each
_TURN = 2.0 * np.pi  # [rad] one turn, and the room to both sides of a joint that turns without end
Joints = Bool[np.ndarray, " nv"]
_LOCK, _LOG = threading.Lock(), logging.getLogger(__name__)  # a copy is for one thread at a time


def joint_path(
    robot: Robot, start: Posture, goal: Posture, limits: Limits, clear: Clearance, seed: int
) -> list[Posture] | None:
    """Knots from the start to the goal, straight joint motions between which are clear; None where none was found.

    RoboPlan is imported where the straight motion is not clear. It plans for joints that turn or slide, and for joints
    that follow one of these which comes before them. Why there is no path is written to the log, at level INFO.

    Args:
        robot: The robot.
        start: Joint positions within the limits [rad or m].
        goal: Likewise; of a joint without limits at most a turn away.
        limits: Of the joints; the positions count.
        clear: What is clear.
        seed: Of the search: the same seed gives the same path.

    Raises:
        MissingExtraError: The straight motion is not clear, and RoboPlan is not installed.
    """
    if not (clear(start) and clear(goal)):
        return None
    if clear.of_line(start, goal):
        return [start, goal]
    why = "every path that was found comes too near to something on the way"
    endless = (np.array(robot.joint_units) == "rad") & ~np.isfinite(limits.lower) & ~np.isfinite(limits.upper)
    turns = np.where(endless, _TURN * np.round(0.5 * (start + goal) / _TURN), 0.0)
    differ, supports = start != goal, robot.pinocchio_model.supports
    below = {j for block in robot.blocks if np.any(differ[block.v]) for j in supports[block.index]}
    carry = differ | np.array([block.index in below for block in robot.blocks for _ in block.units])
    for free in (carry,) if np.all(carry) else (carry, np.ones_like(carry)):  # fingers, too, only where that is needed
        for grown, number in product(GROWN, np.random.SeedSequence(seed).generate_state(SEEDS)):
            try:
                with _LOCK:
                    knots = _searched(limits, clear, grown, free, (start - turns, goal - turns), int(number) >> 1)
            except (RuntimeError, ValueError) as error:  # all that RoboPlan raises
                why = str(error)
                break
            path = [start, *(knots[1:-1] + turns), goal]
            if len(knots) and clear.of_way(path):
                return path
    _LOG.info("no path round what is in the way: %s", why)
    return None


def _searched(
    limits: Limits, clear: Clearance, grown: float, free: Joints, ends: tuple[Posture, Posture], seed: int
) -> Float[np.ndarray, "k nv"]:
    """RoboPlan's path in a copy whose links are larger; empty where start or goal touch something in it."""
    try:
        with warnings.catch_warnings():  # of the viewer that it imports
            warnings.simplefilter("ignore", DeprecationWarning)
            core, rrt = import_module("roboplan.core"), import_module("roboplan.rrt")
    except ImportError as error:
        raise MissingExtraError("a path round what is in the way", "plan") from error
    scene = _copied(clear.links, clear.pairs, limits, grown * clear.least)
    names = np.array([joint_name(block.index) for block in limits.robot.blocks])
    place, start = np.argsort(scene.getJointPositionIndices(names.tolist())), ends[0]
    if any(scene.hasCollisions(q[place]) for q in ends):
        return np.empty((0, len(start)))
    scene.setJointPositions(start[place])  # of the joints that stand still
    scene.addGroup("free", names[free].tolist())
    options = rrt.RRTOptions("free", NODES, REACH, COARSE, max_planning_time=SECONDS, rrt_connect=True)
    planner = rrt.RRT(scene, options)
    planner.setRngSeed(seed)
    found = planner.plan(*(core.JointConfiguration(names[free].tolist(), q[free]) for q in ends))
    found = core.PathShortcutter(scene, core.PathShortcuttingOptions("free", COARSE, seed=seed)).shortcut(found)
    knots = np.tile(start, (len(found.positions), 1))
    knots[:, free] = found.positions
    return knots[np.append(True, np.any(np.diff(knots, axis=0), axis=1))]  # which repeat where the trees met


@lru_cache(maxsize=COPIES)
def _copied(links: SelfCollision, pairs: tuple[tuple[int, int], ...], limits: Limits, larger: float) -> Any:
    """RoboPlan's scene of ours, the links larger by so much [m]."""
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
        text = plain_urdf(limits.robot, low - _ROUNDING, high + _ROUNDING, sizes, Path(folder))
        scene = core.Scene("copy", core.loadUrdfSceneDescriptionFromXml(text))
    scene.setCollisions([(a, b) for a, b in product(sizes, sizes) if a < b], False)
    scene.setCollisions(together, True)
    return scene
