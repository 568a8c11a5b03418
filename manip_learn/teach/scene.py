"""Teaching scenes in MuJoCo: a drawer, a door or a table at a random position within the arm's reach.

The true mechanism consists of MuJoCo joints with friction and play, independent of the learner's models. The fixed
furniture collides with the arm's links except the hand; the moving furniture does not.
"""

# pyright: reportAttributeAccessIssue=false
# (the compiled parts of MuJoCo have no complete stubs)
from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from types import ModuleType
from typing import Any, Literal, final

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from manip_learn.constraint.place import across
from manip_learn.errors import ConfigurationError, MissingExtraError, counted, few
from manip_learn.planning.clearance import hand_of, links_of
from manip_learn.planning.scene import Box, Scene
from manip_learn.playback.appearance import kinematic_tree
from manip_learn.robot.collision import collision_shapes, known_shapes
from manip_learn.robot.robot import Robot
from manip_learn.robot.rotations import pose_error, rotation_matrix
from manip_learn.robot.visuals.visual_shapes import Solid
from manip_learn.teach.furniture import BODY, HANDLE, Board, door_boards, drawer_boards, facing, hinged

Kind = Literal["drawer", "door", "loose-door", "table"]
TITLES: dict[Kind, str] = {
    "drawer": "A drawer",
    "door": "A door, its handle held firmly",
    "loose-door": "A door, held by a finger",
    "table": "A table to wipe",
}
# type of a handle -> instructions for the handle, and for the whole scene
MOVES = {
    "line": ("Pull it open", "Take the hand to the handle, pull the drawer open and push it shut."),
    "hinge": ("Swing it open", "Take the hand to the handle, swing the door open and shut it."),
    "plane": ("Wipe to and fro", "Take the hand to the sponge and wipe the table to and fro, in both directions."),
}

FIRST_SEED = 3  # seed of the first scenes: the furniture is at the arm's side, so that neither hides the other
# robot and scene -> posture with the hand at the handle of the first scene [rad], from which the control law without a
# null-space policy stops within a third of the motion, and a plan completes it. Candidates were random postures at the
# handle, clear of the furniture and of the arm's own links, by increasing manipulability: each was simulated for the
# recordings of two scripted persons, and the first one whose plan follows a recording was chosen.
HARD_STARTS: dict[tuple[str, Kind], tuple[float, ...]] = {
    ("sawyer", "door"): (-2.021, -1.637, 2.097, 2.281, 2.91, -0.662, -3.783),
    ("sawyer", "drawer"): (-0.845, 0.408, -0.439, -1.315, -1.141, 2.838, -4.571),
}

TIMESTEP = 0.002  # [s], 500 steps a second
STIFF = 2.0 * TIMESTEP  # [s] settling time of stops and grips: the shortest that the time step allows
# MuJoCo's solimp of stops and grips: impedance from least to most over 1 mm. MuJoCo needs it below 1; it is so close
# to 1 that a person's 60 N moves them by less than the encoders resolve
STIFF_SOLIMP = (0.9999, 0.99999, 0.001, 0.5, 2.0)
LEAST_MASS = 0.05  # [kg] smallest mass of a link: lighter links need a shorter time step
REACHES = 0.03  # [m] largest distance from the handle at which the gripper can close: a common gripper's opening


@final
@dataclass(frozen=True, eq=False)
class Handle:
    """Handle to grasp, and the motion of its furniture; poses and vectors are in the robot's base frame.

    Attributes:
        name: Name of the object, e.g. `"drawer"`.
        type: Type of the mechanism, as the learner calls it: `"line"`, `"plane"` or `"hinge"`.
        pose: shape (4, 4), pose of the handle at rest [m].
        axis: shape (3,), unit vector: direction of the line, axis of the hinge, or normal of the plane.
        point: shape (3,), a point on the axis or in the plane [m].
        firm: True if the hand turns with the handle.
        travel: Range of the motion [m or rad]; in a plane in each direction.
        play: Sideways play of rails or bearings [m].
        friction: Dry friction of the mechanism [N or N m].
        fixed: Boxes of the fixed furniture, in the frame of the handle at rest.
        moving: Boxes of the moving furniture, in the frame of the handle at rest.
    """

    name: str
    type: Literal["line", "plane", "hinge"]
    pose: Float[np.ndarray, "4 4"]
    axis: Float[np.ndarray, " 3"]
    point: Float[np.ndarray, " 3"]
    firm: bool
    travel: float
    play: float
    friction: float
    fixed: tuple[Board, ...]
    moving: tuple[Board, ...]

    @property
    def turns(self) -> bool:
        """True for a hinge, False for a line or a plane."""
        return self.type == "hinge"

    def moved(self, by: float, beside: float = 0.0) -> Float[np.ndarray, "4 4"]:
        """Return the handle's pose (4, 4) after a displacement, in the base frame [m].

        Args:
            by: Displacement [m or rad]; in a plane along its first direction.
            beside: Displacement along the second direction of a plane [m]; not used for other mechanisms.
        """
        pose = self.pose.copy()
        if self.turns:
            turn = rotation_matrix(by * self.axis)
            pose[:3, 3] = self.point + turn @ (pose[:3, 3] - self.point)
            pose[:3, :3] = turn @ pose[:3, :3]
        elif self.type == "plane":
            pose[:3, 3] += by * pose[:3, 0] + beside * pose[:3, 1]
        else:
            pose[:3, 3] += by * self.axis
        return pose

    @property
    def surroundings(self) -> Scene:
        """Scene with the fixed furniture as obstacles for the arm; the hand may touch them."""
        boxes = []
        for *at, wide, deep, high, part in self.fixed:
            if part != HANDLE:
                pose = self.pose.copy()
                pose[:3, 3] += pose[:3, :3] @ at
                boxes.append(Box((wide, deep, high), pose, f"{self.name} {len(boxes) + 1}"))
        return Scene(boxes=boxes, handled=[box.name for box in boxes])

    def stations(self) -> list[Float[np.ndarray, "4 4"]]:
        """Return poses (4, 4) along the whole motion in the base frame [m], each near the previous one."""
        if self.type == "plane":
            angles = np.linspace(0.0, 2.0 * np.pi, 25)
            return [self.moved(self.travel * np.sin(x), self.travel * np.sin(2.0 * x)) for x in angles]
        return [self.moved(by) for by in np.linspace(0.0, self.travel, 25)]


@final
@dataclass(frozen=True, eq=False)
class TeachingScene:
    """Teaching scene: an arm and the furniture around it.

    Attributes:
        kind: Kind of the scene.
        robot: The arm.
        tip: Name of the frame that grasps.
        handle: The handle to grasp.
        start: shape (nv,), initial joint positions [rad or m].
        notes: Assumptions about the robot, in sentences.
    """

    kind: Kind
    robot: Robot
    tip: str
    handle: Handle
    start: Float[np.ndarray, " nv"]
    notes: tuple[str, ...]

    @property
    def hard_start(self) -> tuple[float, ...] | None:
        """Posture at the handle from which the task needs a planned motion [rad]; None if no such posture is known."""
        if (start := HARD_STARTS.get((self.robot.name, self.kind))) is None:
            return None
        gap = self.robot.position(start, self.tip) - self.handle.pose[:3, 3]
        return start if np.linalg.norm(gap) <= 0.01 else None  # [m]


def place_scene(kind: Kind, robot: Robot, tip: str, rng: np.random.Generator) -> TeachingScene:
    """Return a scene at a random position where the whole task is feasible, away from limits and singularities.

    Args:
        kind: Kind of the scene.
        robot: The arm, with revolute or prismatic joints on a fixed base.
        tip: Name of the frame that grasps.
        rng: Random generator of positions, sizes, friction and backlash.

    Raises:
        ConfigurationError: The kind is unknown, the robot has other joints, or no feasible position was found.
    """
    if kind not in TITLES:
        raise ConfigurationError(f"there is no scene {kind!r}: use one of {', '.join(TITLES)}")
    odd = [joint.name for joint in kinematic_tree(robot)[1:] if joint.motion == "free"]
    if odd:
        raise ConfigurationError(
            f"only arms on a fixed base with revolute or prismatic joints can be taught here: {odd[0]!r} is neither; "
            "lock it, or load the robot without it"
        )
    reach = _Reach(robot, tip, rng)
    for _ in range(400):  # random places: one in three to one in thirty are within reach
        if (placed := reach.place(kind)) is not None:
            return TeachingScene(kind, robot, tip, *placed, tuple(_assumptions(robot)))
    raise ConfigurationError(
        f"no place was found where {robot.name!r} can do this with {tip!r}: {TITLES[kind].lower()}; try another scene, "
        "or another frame with --frame"
    )


def _assumptions(robot: Robot) -> Iterator[str]:
    """Yield the assumptions about a robot, a sentence each."""
    model = robot.pinocchio_model
    light = [model.names[i] for i in range(1, model.njoints) if model.inertias[i].mass < LEAST_MASS]
    if known_shapes(robot) == "links":
        yield "no shapes: the furniture stops capsules along the links instead"
    if light:
        yield f"{counted(len(light), 'link')} without mass ({few(light)}): {LEAST_MASS:g} kg assumed"
    unlimited = [n for n, v in zip(robot.joint_names, robot.velocity_limit, strict=True) if not np.isfinite(v)]
    if unlimited:
        yield f"{counted(len(unlimited), 'joint')} without a velocity limit ({few(unlimited)}): 1.5 rad/s assumed"


@final
class _Reach:
    """The reach of an arm, and the search for a scene within it."""

    def __init__(self, robot: Robot, tip: str, rng: np.random.Generator):
        self._robot, self._tip, self._rng = robot, tip, rng
        self._links, self._hand = links_of(robot)[0], hand_of(robot, robot.frame(tip))
        places = np.array([robot.position(self._sample_posture(), tip) for _ in range(200)])
        self._far = float(np.quantile(np.linalg.norm(places, axis=1), 0.95))
        self._flat = bool(np.ptp(places[:, 2]) < 1e-6)
        frames = robot.pinocchio_model.frames  # all moving links except the first must be above the floor
        self._links_above = [f.name for f in frames if f.parentJoint > 1 and f.name in robot.frame_names]
        hand = robot.pinocchio_model.frames[robot.frame(tip).index].placement
        far = float(np.linalg.norm(hand.translation))
        # pointing direction of the hand: from its last joint to the tip, or along z if the tip is on the joint
        self._points = hand.rotation.T @ (hand.translation / far if far > 0.01 else np.array([0.0, 0.0, 1.0]))
        low, high = robot.position_lower, robot.position_upper
        # margin of each joint to its limits along the whole motion
        self._margin = np.where(np.isfinite(high - low), 0.06 * (high - low), 0.0)

    def _sample_posture(self) -> Float[np.ndarray, " nv"]:
        """Sample a random posture."""
        return self._robot.positions(self._robot.random_configuration(self._rng))

    def _posture(self, down: bool) -> Float[np.ndarray, " nv"]:
        """Return a random posture at a comfortable distance, above the floor, with the hand pointing down or ahead."""
        while True:
            q = self._sample_posture()
            pose = self._robot.pose(q, self._tip)
            x, points = pose[:3, 3], pose[:3, :3] @ self._points
            if not 0.4 * self._far < np.linalg.norm(x) < 0.85 * self._far or self._margin_of(q) < 0.0:
                continue
            if not self._flat and (
                x[2] < 0.15 * self._far or min(self._robot.position(q, name)[2] for name in self._links_above) < 0.0
            ):
                continue
            flat = np.linalg.norm(x[:2])
            outward = float(points[:2] @ x[:2]) / flat if flat > 1e-6 else 0.0
            if self._flat or (points[2] < -0.7 if down else outward > 0.6):
                return q

    def _margin_of(self, q: np.ndarray) -> float:
        """Return the smallest margin of a joint to its limits, less the required one [rad or m]."""
        robot = self._robot
        return float(np.min(np.minimum(q - robot.position_lower, robot.position_upper - q) - self._margin))

    def place(self, kind: Kind) -> tuple[Handle, Float[np.ndarray, " nv"]] | None:
        """Place a handle at the tip of a random posture.

        Args:
            kind: Kind of the scene.

        Returns:
            The handle and the start posture (nv,); None if the task is not feasible there.
        """
        q = self._posture(down=kind == "table")
        pose = self._robot.pose(q, self._tip)
        handle, away = self._handle(kind, pose[:3, 3], pose[:3, :3] @ self._points)
        way, grip = [q], np.linalg.inv(handle.pose) @ pose
        for station in handle.stations():
            if (posture := self._posture_at(way[-1], station @ grip, handle.firm)) is None:
                return None
            way.append(posture)
        start_pose = pose.copy()
        start_pose[:3, 3] += 0.16 * away  # [m] distance to the handle, so that a recording contains an approach
        if (start := self._posture_at(q, start_pose, False)) is None:
            return None
        solids = handle.surroundings.obstacles(self._robot)
        clear = self._links.with_obstacles([replace(one, may_touch=self._hand) for one in solids], False)
        # keep 0.01 m of clearance along the motion
        return (handle, start) if all(clear.is_clear(x, 0.01) for x in (*way, start)) else None

    def _handle(self, kind: Kind, at: np.ndarray, points: np.ndarray) -> tuple[Handle, Float[np.ndarray, " 3"]]:
        """Return a mechanism of random size with its handle in front of a hand, and the direction away from it."""
        rng, size = self._rng, min(self._far, 1.0)
        play, up = float(rng.uniform(1e-4, 3e-4)), np.array([0.0, 0.0, 1.0])
        level = points - (points @ up) * up
        out = -level / np.linalg.norm(level) if np.linalg.norm(level) > 0.3 else -points
        if kind == "drawer":
            travel = float(rng.uniform(0.2, 0.32)) * size
            pose, friction = facing(out, at), float(rng.uniform(1.0, 4.0))
            boards = drawer_boards(travel, pose)
            return Handle("drawer", "line", pose, out, at, False, travel, play, friction, *boards), out
        if kind in ("door", "loose-door"):
            axis = float(rng.choice([-1.0, 1.0])) * up
            pose, pivot = hinged(out, axis, at, float(rng.uniform(0.25, 0.4)) * size)
            travel, friction = float(rng.uniform(0.6, 1.1)), float(rng.uniform(0.1, 0.5))
            point, boards = pose[:3, :3] @ pivot + at, door_boards(pivot)
            return Handle("door", "hinge", pose, axis, point, kind == "door", travel, play, friction, *boards), out
        normal = -points if self._flat else rotation_matrix(rng.normal(0.0, 0.12, 3)) @ up
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = np.vstack([across(normal), normal]).T, at
        travel = float(rng.uniform(0.09, 0.14)) * size
        fixed = ((0.0, 0.0, -0.045, 4.0 * travel, 4.0 * travel, 0.03, BODY),)
        sponge = ((0.0, 0.0, -0.015, 0.09, 0.06, 0.03, HANDLE),)
        return Handle("sponge", "plane", pose, normal, at, False, travel, play, 2.0, fixed, sponge), normal

    def _posture_at(
        self, q: Float[np.ndarray, " nv"], wanted: Float[np.ndarray, "4 4"], firm: bool
    ) -> Float[np.ndarray, " nv"] | None:
        """Return a posture with the tip at a pose, by Newton steps; None near limits, singularities, or out of reach.

        Args:
            q: First guess.
            wanted: Pose of the tip in the base frame [m].
            firm: True if the orientation counts too; otherwise only the position counts.
        """
        for _ in range(12):
            error = pose_error(self._robot.pose(q, self._tip), wanted, own_axes=False)[: 6 if firm else 3]
            rows = self._robot.jacobian(q, self._tip)[: len(error)]
            step, _, _, sizes = np.linalg.lstsq(rows, error, rcond=1e-3)
            if np.linalg.norm(error) < 1e-4:  # [m or rad]: below the resolution of encoders
                least = sizes[min(len(sizes), 2 if self._flat else 6) - 1]  # a planar arm moves in two directions only
                return q if least >= 0.075 and self._margin_of(q) >= 0.0 else None  # [m/rad]
            q = q + step * min(1.0, 0.3 / max(float(np.linalg.norm(step)), 1e-12))  # [rad] largest accurate step
        return None


# ---- MuJoCo model -------------------------------------------------------------------------------------------------


def physics() -> ModuleType:
    """Import the module `mujoco`, and return it.

    Raises:
        MissingExtraError: MuJoCo is not installed.
    """
    try:
        import mujoco
        from mujoco import MjSpec  # noqa: F401  # missing in old versions, and in folders left by an uninstalled one
    except ImportError as error:
        raise MissingExtraError("teaching in the browser", "physics") from error
    return mujoco


def scene_model(scene: TeachingScene) -> object:
    """Return the scene as a `mujoco.MjModel`.

    The model has the arm's joints under their own names, and the body `handle`; the equality constraint `grip` can
    attach that body to the site `tip`.

    Args:
        scene: The scene.

    Raises:
        MissingExtraError: MuJoCo is not installed.
    """
    mujoco: Any = physics()
    spec = mujoco.MjSpec()
    spec.compiler.degree, spec.option.timestep = False, TIMESTEP
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    spec.option.tolerance = 1e-10
    _add_arm(mujoco, spec, scene)
    _add_handle(mujoco, spec, scene.handle)
    for box in scene.handle.surroundings.boxes:
        geom = _add_geom(mujoco, spec, spec.worldbody, np.asarray(box.pose), box.shape, box.name)
        geom.contype, geom.conaffinity = 0, 1
    return spec.compile()


def _add_arm(mujoco: Any, spec: Any, scene: TeachingScene) -> None:
    """Add the arm's links, joints, collision shapes and mimic joints, and the site `tip`."""
    robot, model = scene.robot, scene.robot.pinocchio_model
    bodies = [spec.worldbody]
    limits = dict(zip(robot.joint_names, zip(robot.position_lower, robot.position_upper, strict=True), strict=True))
    frame = model.frames[robot.frame(scene.tip).index]
    chain = [i for i in model.supports[frame.parentJoint] if i]
    for i, joint in enumerate(kinematic_tree(robot)[1:], start=1):
        body = bodies[joint.parent].add_body(name=joint.name, pos=joint.placement[:3, 3])
        body.quat = _quaternion(joint.placement[:3, :3])
        inertia = model.inertias[i]
        body.mass, body.ipos, body.explicitinertial = max(inertia.mass, LEAST_MASS), inertia.lever, True
        moments, axes = np.linalg.eigh(inertia.inertia)  # smallest first
        moments = np.maximum(moments, 1e-4)  # [kg m2]
        body.inertia = np.minimum(moments, moments[0] + moments[1])  # no moment of a body exceeds the sum of the others
        body.iquat = _quaternion(axes * np.linalg.det(axes))
        kind = mujoco.mjtJoint.mjJNT_HINGE if joint.motion == "revolute" else mujoco.mjtJoint.mjJNT_SLIDE
        new = body.add_joint(name=joint.name, type=kind, axis=joint.axis)
        n_to_tip = len(chain) - chain.index(i) if i in chain else 1  # number of joints from here to the tip
        # damping [N m s/rad], dry friction [N m] and rotor inertia [kg m^2] of guided arms; then of a prismatic joint
        revolute = (1.0, 0.1, 0.02) if n_to_tip <= 3 else (3.0, 0.3, 0.10) if n_to_tip <= 5 else (4.0, 0.5, 0.10)
        damping, new.frictionloss, new.armature = (40.0, 4.0, 2.0) if joint.motion == "prismatic" else revolute
        _set_damping(new, damping)
        low, high = limits.get(joint.name, (-np.inf, np.inf))
        if np.isfinite(low) and np.isfinite(high):
            new.limited, new.range = mujoco.mjtLimited.mjLIMITED_TRUE, [low, high]
        bodies.append(body)
    hand = hand_of(robot, robot.frame(scene.tip))
    shapes = collision_shapes(robot, known_shapes(robot))
    for k, shape in enumerate(one for one in shapes if one.joint and one.link not in hand):
        geom = _add_geom(mujoco, spec, bodies[shape.joint], shape.placement, shape.shape, f"link_{k}")
        geom.contype, geom.conaffinity = 1, 0
    for mimic in robot.mimics:
        led = spec.add_equality(name=f"{mimic.joint}_follows", type=mujoco.mjtEq.mjEQ_JOINT)
        led.objtype, led.name1, led.name2 = mujoco.mjtObj.mjOBJ_JOINT, mimic.joint, mimic.leader
        led.data[:5] = [mimic.offset, mimic.multiplier, 0.0, 0.0, 0.0]
    at = frame.placement
    bodies[frame.parentJoint].add_site(name="tip", pos=at.translation, quat=_quaternion(at.rotation))


def _add_handle(mujoco: Any, spec: Any, handle: Handle) -> None:
    """Add the body `handle` with its joints, its play, and the equality `grip`."""
    name, axes = "handle", handle.pose[:3, :3]
    body = spec.worldbody.add_body(name=name, pos=handle.pose[:3, 3], quat=_quaternion(axes))
    body.mass, body.inertia, body.explicitinertial, body.gravcomp = 1.5, np.full(3, 0.01), True, 1.0
    slide, hinge = mujoco.mjtJoint.mjJNT_SLIDE, mujoco.mjtJoint.mjJNT_HINGE
    axis, point = axes.T @ handle.axis, axes.T @ (handle.point - handle.pose[:3, 3])

    def joint(kind: Any, along: np.ndarray, label: str, friction: float, reach: tuple[float, float] | None) -> None:
        new = body.add_joint(name=f"{name}_{label}", type=kind, axis=along, pos=point)
        _set_damping(new, 4.0 if kind == slide else 0.2)
        new.frictionloss = friction
        if reach is not None:
            new.limited, new.range = mujoco.mjtLimited.mjLIMITED_TRUE, reach
            new.solref_limit, new.solimp_limit = (STIFF, 1.0), STIFF_SOLIMP

    for k, side in enumerate([axis] if handle.type == "plane" else across(axis)):
        joint(slide, side, f"play_{k}", 0.0, (-handle.play, handle.play))
    if handle.type == "plane":
        joint(slide, np.array([1.0, 0.0, 0.0]), "x", handle.friction, None)
        joint(slide, np.array([0.0, 1.0, 0.0]), "y", handle.friction, None)
    else:  # stops at the shut position, and a little beyond the open one
        joint(hinge if handle.turns else slide, axis, "x", handle.friction, (0.0, 1.1 * handle.travel))
    body.add_site(name=name)
    grip = spec.add_equality(name="grip", type=mujoco.mjtEq.mjEQ_WELD if handle.firm else mujoco.mjtEq.mjEQ_CONNECT)
    grip.objtype, grip.name1, grip.name2, grip.active = mujoco.mjtObj.mjOBJ_SITE, "tip", name, False
    grip.solref, grip.solimp = (STIFF, 1.0), STIFF_SOLIMP


def _add_geom(mujoco: Any, spec: Any, body: Any, at: Float[np.ndarray, "4 4"], shape: Any, name: str) -> Any:
    """Add a solid, or the convex hull of a mesh, to a body and return it.

    Args:
        mujoco: The module.
        spec: The model under construction.
        body: Body of that model.
        at: Pose of the shape in the body's frame [m].
        shape: As `CollisionShape.shape` and `Thing.shape`.
        name: Name of its mesh.
    """
    geom = body.add_geom(pos=at[:3, 3], quat=_quaternion(at[:3, :3]))
    if not isinstance(shape, Solid):
        spec.add_mesh(name=name, uservert=np.array(shape.vertices).ravel())
        geom.type, geom.meshname = mujoco.mjtGeom.mjGEOM_MESH, name
        return geom
    geom.type = getattr(mujoco.mjtGeom, f"mjGEOM_{shape.kind.upper()}")
    halves = np.array(shape.size)  # MuJoCo takes half lengths, but the radius itself
    halves[slice(None) if shape.kind == "box" else slice(1, None)] *= 0.5
    geom.size[: len(halves)] = halves
    return geom


def _quaternion(rotation: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, " 4"]:
    """Return the quaternion of a rotation as MuJoCo writes it, the real part first."""
    return Rotation.from_matrix(rotation).as_quat()[[3, 0, 1, 2]]


def _set_damping(joint: Any, damping: float) -> None:
    """Set linear damping [N m s/rad or N s/m]; MuJoCo 4 has three coefficients per joint, MuJoCo 3 one."""
    joint.damping = damping if isinstance(joint.damping, float) else [damping] + [0.0] * (len(joint.damping) - 1)
