"""A joint path round what is in the way: the RRT-Connect and the shortcuts of RoboPlan, in a copy of our own scene.

RoboPlan (https://github.com/open-planning/roboplan) plans on Pinocchio and Coal in C++. A URDF with plain names is
written for it, of our joints, limits and shapes, whatever file the robot came from. It knows no clearance: of each pair
of shapes one is larger in its copy. Our own distances alone decide whether a path is clear.
"""

from __future__ import annotations

import tempfile
import warnings
from importlib import import_module
from itertools import product
from pathlib import Path
from typing import Any, final

import coal
import numpy as np
import pinocchio as pin
from jaxtyping import Bool, Float
from scipy.spatial import ConvexHull

from manip_learn.control.limits import Limits
from manip_learn.errors import MissingExtraError
from manip_learn.planning.clearance import Clearance, Posture
from manip_learn.robot.joints import motion_along

NODES = 800  # of both trees; a path round a box takes 150 at most, 800 in vain half a second
REACH = 1.0  # [rad or m] by which a tree grows at once, all joints together
COARSE = 0.05  # [rad or m] between RoboPlan's checks, all joints together; those of the result are closer
SECONDS = 4.0  # of a search that adds no nodes, as from a start that is shut in: no number of nodes ends it
SEEDS = 3  # searches in each copy
GROWN = (1.0, 0.4, 2.0)  # times the clearance: less where start or goal has no more, more where paths come too near
TURN = 2.0 * np.pi  # [rad] one turn, and the room to both sides of a joint that turns without end
# corners of a solid about the ball of radius 1: its faces are 0.8866 away where its corners are at 1
CORNERS = np.array([np.divide(d, 0.8866 * np.linalg.norm(d)) for d in product((-1, 0, 1), repeat=3) if any(d)])


@final
class JointPlanner:
    """Joint paths of one robot among what stands around it; made once, used for many goals.

    RoboPlan is imported, and the copy made, at the first straight motion that is not clear.

    Args:
        clear: Whether a posture or a straight motion is clear.
        limits: Of the joints; the positions count.
        moving: shape (nv,), joints that may move, the others only where start and goal differ in them; None for all.

    Attributes:
        clear: As given.
        why: Why the last call of `path` found none, in words; empty where it found one.
    """

    def __init__(self, clear: Clearance, limits: Limits, moving: Bool[np.ndarray, " nv"] | None = None):
        self._robot, self.clear, self.why = limits.robot, clear, ""
        robot, self._geometry = limits.robot, clear.geometry
        low, high = limits.lower, limits.upper
        self._endless = (np.array(robot.joint_units) == "rad") & ~np.isfinite(low) & ~np.isfinite(high)
        self._lower = np.where(np.isfinite(low), low, np.minimum(high - 2.0 * TURN, -TURN)) - 1e-9
        self._upper = np.where(np.isfinite(high), high, np.maximum(low + 2.0 * TURN, TURN)) + 1e-9  # rounding
        self._moving = np.ones(robot.nv, dtype=bool) if moving is None else moving
        self._names = np.array([f"j{block.index:03}" for block in robot.blocks])
        self._copies: dict[float, Any] = {}

    def path(self, start: Posture, goal: Posture, seed: int) -> list[Posture] | None:
        """Knots from the start to the goal, straight joint motions between which are clear; None where none was found.

        Args:
            start: Joint positions within the limits [rad or m].
            goal: Likewise.
            seed: Of the search: the same seed gives the same path.

        Raises:
            MissingExtraError: The straight motion is not clear, and RoboPlan is not installed.
        """
        pair, self.why = self.clear.touching(start) or self.clear.touching(goal), ""
        if pair is not None:
            self.why = f"at one end {' and '.join(pair.links)} are nearer than {1e3 * self.clear.least:.3g} mm"
            return None
        if self.clear.of_line(start, goal):
            return [start, goal]
        turns = np.where(self._endless, TURN * np.round(0.5 * (start + goal) / TURN), 0.0)
        for grown, number in product(GROWN, np.random.SeedSequence(seed).generate_state(SEEDS)):
            try:
                knots = self._searched(grown, start - turns, goal - turns, int(number) >> 1)  # a seed with a sign
            except (RuntimeError, ValueError) as error:  # all that RoboPlan raises
                self.why = f"no path was found: {error}"
                return None
            path = [start, *(knots[1:-1] + turns), goal]
            if len(knots) and all(map(self.clear, path)) and all(map(self.clear.of_line, path[:-1], path[1:])):
                return path
        self.why = "every path that was found comes too near to something on the way"
        return None

    def _searched(self, grown: float, start: Posture, goal: Posture, seed: int) -> Float[np.ndarray, "k nv"]:
        """RoboPlan's path in a copy whose shapes are larger; empty where start or goal touch something in it."""
        try:
            with warnings.catch_warnings():  # of the viewer that it imports
                warnings.simplefilter("ignore", DeprecationWarning)
                core, rrt = import_module("roboplan.core"), import_module("roboplan.rrt")
        except ImportError as error:
            raise MissingExtraError("a path round what is in the way", "plan") from error
        if grown not in self._copies:
            self._copies[grown] = self._copied(core, grown * self.clear.least)
        scene, free = self._copies[grown], self._moving | bool(np.any((start != goal) & ~self._moving))
        place = np.argsort(scene.getJointPositionIndices(self._names.tolist()))
        if scene.hasCollisions(start[place]) or scene.hasCollisions(goal[place]):
            return np.empty((0, len(start)))
        scene.setJointPositions(start[place])  # of the joints that stand still
        names = self._names[free].tolist()
        scene.addGroup("free", names)
        planner = rrt.RRT(
            scene, rrt.RRTOptions("free", NODES, REACH, COARSE, max_planning_time=SECONDS, rrt_connect=True)
        )
        planner.setRngSeed(seed)
        found = planner.plan(*(core.JointConfiguration(names, q[free]) for q in (start, goal)))
        found = core.PathShortcutter(scene, core.PathShortcuttingOptions("free", COARSE, seed=seed)).shortcut(found)
        knots = np.tile(start, (len(found.positions), 1))
        knots[:, free] = found.positions
        return knots[np.append(True, np.any(np.diff(knots, axis=0), axis=1))]  # which repeat where the trees met

    def _copied(self, core: Any, larger: float) -> Any:
        """RoboPlan's scene of ours, of each pair one shape larger by so much [m]."""
        things = list(self._geometry.geometryObjects)  # obstacles last: of each pair it is a link that is larger
        pairs = [(p.first, p.second) for p in self._geometry.collisionPairs]
        sizes = {f"s{k:03}": (k, 0.0) for _, k in pairs} | {f"g{k:03}": (k, larger) for k, _ in pairs}
        with tempfile.TemporaryDirectory(prefix="manip_learn_") as folder:
            links = [_link(name, things[k], by, Path(folder)) for name, (k, by) in sizes.items()]
            text = "".join(["<robot name='copy'><link name='l000'/>", *self._joints(), *links, "</robot>"])
            scene = core.Scene("copy", core.loadUrdfSceneDescriptionFromXml(text))
        scene.setCollisions([(a, b) for a, b in product(sizes, sizes) if a < b], False)
        scene.setCollisions([(f"g{k:03}", f"s{other:03}") for k, other in pairs], True)
        return scene

    def _joints(self) -> list[str]:
        robot, model, out = self._robot, self._robot.pinocchio_model, list[str]()
        data, mimics = model.createData(), {m.joint: m for m in robot.mimics}
        pin.forwardKinematics(model, data, pin.neutral(model), np.zeros(model.nv))
        limits = {b.name: (self._lower[b.v][0], self._upper[b.v][0]) for b in robot.blocks}
        for j, name in list(enumerate(model.names))[1:]:
            if (along := motion_along(data.joints[j].S)) is None:
                raise ValueError(f"joint {name!r} does more than turn or slide")
            low, high = limits.get(name, (-1e3, 1e3))  # a joint that follows another has its limits
            inside = f"<axis xyz='{_words(along[1])}'/><limit lower='{low}' upper='{high}' velocity='1' effort='1'/>"
            if (m := mimics.get(name)) is not None:
                leader = f"j{model.getJointId(m.leader):03}"
                inside += f"<mimic joint='{leader}' multiplier='{m.multiplier}' offset='{m.offset}'/>"
            head = f"j{j:03}", "revolute" if along[0] == "R" else "prismatic", model.parents[j], f"l{j:03}"
            out.append(f"<link name='l{j:03}'/>{_joint(*head, model.jointPlacements[j], inside)}")
        return out


def _words(values: Any) -> str:
    return " ".join(map(repr, np.asarray(values, dtype=np.float64).tolist()))


def _joint(name: str, kind: str, parent: int, child: str, place: pin.SE3, inside: str = "") -> str:
    inside += f"<origin xyz='{_words(place.translation)}' rpy='{_words(pin.rpy.matrixToRpy(place.rotation))}'/>"
    return f"<joint name='{name}' type='{kind}'><parent link='l{parent:03}'/><child link='{child}'/>{inside}</joint>"


def _link(name: str, thing: Any, larger: float, folder: Path) -> str:
    """One shape, larger all round by a length [m], on a link of its own."""
    shape, mark = thing.geometry, ""
    match shape:
        case coal.Box():
            form = f"<box size='{_words(2.0 * (np.asarray(shape.halfSide) + larger))}'/>"
        case coal.Cylinder():
            form = f"<cylinder radius='{shape.radius + larger}' length='{2.0 * (shape.halfLength + larger)}'/>"
        case coal.Sphere() | coal.Capsule():  # a capsule is no element of URDF: Pinocchio has a mark for it
            length = 2.0 * getattr(shape, "halfLength", 0.0)
            form, mark = f"<cylinder radius='{shape.radius + larger}' length='{length}'/>", "capsule"
        case _:
            form, mark = _mesh(shape, larger, folder / f"{name}.obj")
    marked = f"<collision_checking><{mark} name='{name}'/></collision_checking>" if mark else ""
    link = f"<link name='{name}'><collision name='{name}'><geometry>{form}</geometry></collision>{marked}</link>"
    return link + _joint(f"{name}_fixed", "fixed", thing.parentJoint, name, thing.placement)


def _mesh(shape: Any, larger: float, file: Path) -> tuple[str, str]:
    if convex := isinstance(shape, coal.ConvexBase):
        hull = ConvexHull((np.array(shape.points())[:, None] + larger * CORNERS[: 26 if larger else 1]).reshape(-1, 3))
        points, faces = hull.points[hull.vertices], np.searchsorted(hull.vertices, hull.simplices)
    else:
        corners = [shape.tri_indices(k) for k in range(shape.num_tris)]
        points, faces = np.array(shape.vertices()), np.array([(t[0], t[1], t[2]) for t in corners])
        a, b, c = np.moveaxis(points[faces], 1, 0)
        normals = np.zeros_like(points)
        np.add.at(normals, faces, np.cross(b - a, c - a)[:, None])
        points = points + larger * normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    lines = [f"v {_words(p)}\n" for p in points] + [f"f {a} {b} {c}\n" for a, b, c in (faces + 1).tolist()]
    file.write_text("".join(lines))
    return f"<mesh filename='{file}'/>", "convex" if convex else ""
