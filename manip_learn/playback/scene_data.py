"""Data for the JavaScript program of a page, as one dictionary of finite numbers and text."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import product
from typing import Any, NamedTuple, cast, final

import numpy as np
import pinocchio as pin
from jaxtyping import Float

from manip_learn.constraint.constraint import Constraint
from manip_learn.constraint.features.frame_jacobian import AXES, PoseRows
from manip_learn.constraint.features.mechanism_rows import MechanismRows, WeighedVelocity
from manip_learn.constraint.mechanism import Mechanism
from manip_learn.constraint.place import across
from manip_learn.constraint.shown import Intention, Shown
from manip_learn.errors import RecordingError
from manip_learn.linalg import finite, null_basis, row_basis
from manip_learn.playback.appearance import Appearance, Shape, kinematic_tree
from manip_learn.playback.page_writer import to_base64
from manip_learn.playback.palette import PhaseKind
from manip_learn.playback.recorded_motion import MAX_CURVE_POINTS, GuidedMotion, RecordedMotion, track_data
from manip_learn.recordings.trajectory import evenly
from manip_learn.robot.joints import Frame
from manip_learn.robot.robot import Robot
from manip_learn.robot.visuals.meshes import Mesh

MAX_BOUND_POSTURES = 120  # postures of all motions that the camera frames
COUPLING_TOLERANCE = 0.1  # largest rotational part of a learnt unit row that counts as pure translation, and vice versa
CORNERS = np.array(list(product((-0.5, 0.5), repeat=3)))  # of a cube with sides of 1


def scene_data(
    robot: Robot,
    looks: Appearance,
    tip: str,
    motions: Sequence[RecordedMotion],
    notes: Sequence[str],
    kinds: Sequence[PhaseKind] = (),
    mechanisms: Sequence[MechanismDrawing | None] = (),
) -> dict[str, Any]:
    """Return the data of a page; arrays are little-endian and in base64.

    Args:
        robot: The robot.
        looks: Shapes and meshes of the robot.
        tip: Name of the frame whose path is drawn.
        motions: Motions to play.
        notes: Sentences for the page.
        kinds: Kinds of the recordings' phases; empty without phases.
        mechanisms: Drawing of each constraint's mechanism; None for a constraint without one.

    Returns:
        Dictionary of JSON values.
    """
    drawn = [line for m in mechanisms if m for line in (*m.lines, m.way)]
    cloud = np.concatenate([_drawn_points(robot, looks, motions), *drawn])
    # include the marks at the tip along its path: half the length of an arrow, as in page/constraint_marks.js
    reach = 0.085 * _extent(cloud)
    paths = [m.path[:: max(1, len(m.path) // MAX_BOUND_POSTURES)] for m in motions if m.motion.constraints]
    cloud = np.concatenate([cloud, *(path + reach * side for path in paths for side in (*np.eye(3), *-np.eye(3)))])
    # stated obstacles are drawn, and framed up to a quarter of the motion's extent beyond the motion
    low, high, near = cloud.min(axis=0), cloud.max(axis=0), 0.25 * _extent(cloud)
    rollouts, n_curves = list[dict[str, Any]](), sum(len(track["curves"]) for m in motions for track in m.measures)
    # points per curve: all curves of a page together have 100,000, of 8 bytes each
    most = int(np.clip(100_000 // max(n_curves, 1), 60, MAX_CURVE_POINTS))
    places = max(60, 12_000 // len(motions))  # ellipsoids per motion, at most 12,000 per page
    for m in motions:
        stated = getattr(m.motion.recording, "around", ())
        obstacles = [_obstacle(each, low, high) for each in stated if not each.get("assumed")]
        cloud = np.concatenate([cloud, *(np.clip(points, low - near, high + near) for _, points in obstacles)])
        each = places // max(len(m.motion.constraints), 1)
        marks = [constraint_marks(robot, m.motion, c, each) for c in m.motion.constraints]
        around = [obstacle for obstacle, _ in obstacles]
        rollouts.append({**m.content, "measures": track_data(m.measures, most), "marks": marks, "around": around})
    longest = max((mark.pop("longest") for r in rollouts for mark in r["marks"] if mark is not None), default=0.0)
    return {
        "robot": _robot(robot, looks, tip),
        "bounds": [cloud.min(axis=0).tolist(), cloud.max(axis=0).tolist()],
        "outline": _outline(cloud).round(5).tolist(),
        "azimuth": _azimuth(motions),
        "floor": float(min(cloud[:, 2].min(), 0.0)),
        "view": "top" if _is_flat(robot) else "iso",
        "rollouts": rollouts,
        # the longest semi-axis takes 8 % of the scene
        "ellipsoidScale": ellipsoid_scale(longest, 0.08 * _extent(cloud)),
        "notes": list(notes),
        "phaseKinds": [vars(k) for k in kinds],
        "mechanisms": [m.to_dict() | {"constraint": k} for k, m in enumerate(mechanisms) if m is not None],
    }


def _extent(cloud: Float[np.ndarray, "n 3"]) -> float:
    """Return the diagonal of the box around points [m]."""
    return float(np.linalg.norm(np.ptp(cloud, axis=0)))


def _outline(cloud: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "m 3"]:
    """Return the extreme points in directions all over the sphere, which the camera must frame."""
    k = np.arange(240) + 0.5  # 13 degrees apart
    height, turn = 1.0 - 2.0 * k / 240, np.pi * (1.0 + 5.0**0.5) * k
    ring = np.sqrt(1.0 - height**2)
    return cloud[np.unique(np.argmax(cloud @ np.array([ring * np.cos(turn), ring * np.sin(turn), height]), axis=0))]


def _is_flat(robot: Robot) -> bool:
    """Return True if the arm moves in the horizontal plane only, so that it is viewed from above."""
    model = robot.pinocchio_model
    J = pin.computeJointJacobians(model, model.createData(), pin.neutral(model))  # velocities at the base's origin
    # no vertical velocity, no rotation about a horizontal axis
    return model.nv > 0 and bool(np.all(np.abs(J[2:5]) < 1e-6))


def _robot(robot: Robot, looks: Appearance, tip: str) -> dict[str, Any]:
    """Return links, joints, shapes and meshes of a robot."""
    frames, tree = robot.pinocchio_model.frames, kinematic_tree(robot)
    all_frames = map(robot.frame, robot.frame_names)
    links = [f for f in all_frames if frames[f.index].type == pin.FrameType.BODY or f.name == tip]
    return {
        "tip": tip,
        "joints": [j._asdict() | {"placement": j.placement.ravel().tolist(), "axis": j.axis.tolist()} for j in tree],
        "links": [{"name": frame.name, **_place(robot, frame)} for frame in links],
        "shapes": [vars(s) | {"pose": s.pose.ravel().tolist()} for s in looks.shapes],
        "meshes": [_mesh(m) for m in looks.meshes],
    }


def _obstacle(
    stated: Mapping[str, Any], low: Float[np.ndarray, " 3"], high: Float[np.ndarray, " 3"]
) -> tuple[dict[str, Any], Float[np.ndarray, "C 3"]]:
    """Return a stated obstacle for the page, and points around it [m].

    A floor extends beyond the motion, other faces are patches.
    """
    pose, size, kind = np.array(stated["pose"], dtype=np.float64), list(stated.get("size", ())), stated["kind"]
    patch = 0.6  # [m] drawn size of an unbounded front, the width of a cupboard
    mesh, box = None, CORNERS * [patch, 0.0, patch]
    if kind == "face":
        out, size = pose[:3, 2].copy(), [patch, patch]
        # the second axis points outward, the third one as far upward as possible
        up = np.eye(3)[2 if abs(out[2]) < 0.98 else 0]  # a face within 11 degrees of horizontal has no upward direction
        up = up - (up @ out) * out
        up /= np.linalg.norm(up)
        pose[:3, :3] = np.column_stack([np.cross(out, up), out, up])
        if stated["name"] == "floor":  # to the edge of the picture: its side is three extents of the motion
            pose[:2, 3], size = 0.5 * (low + high)[:2], [3.0 * float(np.linalg.norm(high - low))] * 2
    elif kind == "mesh":
        mesh = Mesh(np.array(stated["vertices"]), np.array(stated["faces"]))
        box = mesh.vertices
    else:
        box = 2.0 * CORNERS * Shape(0, kind, tuple(size), pose).half_extent()
    drawn = {"name": stated["name"], "kind": kind, "size": size, "pose": pose.ravel().tolist()}
    return drawn | {"mesh": None if mesh is None else _mesh(mesh)}, _moved(pose, box)


def _mesh(mesh: Mesh) -> dict[str, Any]:
    """Return a mesh with its vertices as 16-bit steps within their box: 8 micrometres in half a metre."""
    origin = mesh.vertices.min(axis=0)
    step = np.maximum((mesh.vertices.max(axis=0) - origin) / 65535.0, 1e-12)
    wide = len(mesh.vertices) > 65536
    return {
        "origin": origin.tolist(),
        "step": step.tolist(),
        "positions": to_base64(np.rint((mesh.vertices - origin) / step), "<u2"),
        "triangles": to_base64(mesh.faces, "<u4" if wide else "<u2"),
        "wide": wide,
        "normals": None if mesh.normals is None else to_base64(np.rint(127.0 * mesh.normals), "i1"),
    }


def _drawn_points(robot: Robot, looks: Appearance, motions: Sequence[RecordedMotion]) -> Float[np.ndarray, "C 3"]:
    """Return points that enclose the whole arm at all times, in the base frame [m]."""
    model = robot.pinocchio_model
    data = model.createData()
    boxes = [(i, np.zeros((1, 3))) for i in range(model.njoints)]  # corners around the shapes on each joint
    for shape in looks.shapes:
        half = shape.half_extent()
        ends = np.array([-half, half]) if shape.mesh is None else looks.meshes[shape.mesh].vertices
        box = 0.5 * (ends.min(axis=0) + ends.max(axis=0)) + CORNERS * np.ptp(ends, axis=0)
        boxes.append((shape.joint, _moved(shape.pose, box)))
    points = [m.path for m in motions] + [np.zeros((1, 3))]
    for motion in motions:
        every = max(1, len(motion.postures) * len(motions) // MAX_BOUND_POSTURES)
        for q in motion.postures[::every]:
            pin.forwardKinematics(model, data, robot.pinocchio_configuration(q))
            points += [_moved(data.oMi[joint].homogeneous, box) for joint, box in boxes]
    return np.concatenate(points)


def _moved(pose: Float[np.ndarray, "4 4"], points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    """Return points transformed by a pose [m]."""
    return points @ pose[:3, :3].T + pose[:3, 3]


def _azimuth(motions: Sequence[RecordedMotion]) -> float:
    """Return the direction of the camera [rad]: to the side of the arm, 62 degrees from the middle of the path."""
    x, y, _ = np.concatenate([m.path for m in motions]).mean(axis=0)
    return float(np.arctan2(y, x) - np.deg2rad(62.0)) if np.hypot(x, y) > 1e-6 else float(np.deg2rad(-50.0))


# ---- at the tip: directions held and free, the ellipsoid of the task, the target ------------------------------------


@final
class HeldDirections(NamedTuple):
    """Projectors onto the held and the free directions of a constraint.

    Each projector has the shape (3, 3), or (T, 3, 3) along a motion if the directions depend on the position.
    Directions that the features do not contain are neither held nor free.

    Attributes:
        axes: Frame along whose axes the projectors are; None for the robot's base.
        held, free: Projectors onto translations of the frame's origin.
        held_turns, free_turns: Projectors onto rotation axes of the frame.
    """

    axes: Frame | None
    held: Float[np.ndarray, "..."]
    free: Float[np.ndarray, "..."]
    held_turns: Float[np.ndarray, "..."]
    free_turns: Float[np.ndarray, "..."]


def held_directions(constraint: Constraint, places: Float[np.ndarray, "T 3"]) -> HeldDirections | None:
    """Return the held and the free directions of a constraint.

    A translation is held if the constraint forbids it whatever the hand's rotation. It is free if the constraint
    permits a motion along it, possibly together with a rotation, as at a door's handle.

    Args:
        constraint: Constraint A(q).
        places: Positions (T, 3) of the frame's origin along the motion, in the base or in the features' reference frame
            [m].

    Returns:
        The directions; None for features that are not of one frame.
    """
    features, selection = constraint.features, constraint.selection
    if isinstance(features, PoseRows):  # the same everywhere
        W = np.eye(6)[[AXES.index(name) for name in features.row_names]]
        axes = features.frame if features.own_axes else features.relative_to
        return HeldDirections(axes, *_projectors(selection @ W, W.sum(axis=0), COUPLING_TOLERANCE))
    if not isinstance(features, WeighedVelocity):
        return None
    W = features.place_weights.values(places)
    covered = np.repeat([1.0, float(np.any(W[..., 3:]))], 3)
    # rows of a mechanism are exact, learnt combinations are not
    tolerance = 1e-6 if isinstance(features, MechanismRows) else COUPLING_TOLERANCE
    parts = [_projectors(selection @ w, covered, tolerance) for w in W]
    return HeldDirections(features.relative_to, *map(np.array, zip(*parts, strict=True)))


def _projectors(
    rows: Float[np.ndarray, "s 6"], covered: Float[np.ndarray, " 6"], tolerance: float
) -> list[Float[np.ndarray, "3 3"]]:
    """Return projectors onto held and free translations, then onto held and free rotations.

    Args:
        rows: Constrained velocities, 3 linear and 3 angular ones.
        covered: 1 for each velocity that the features contain, else 0.
        tolerance: Largest rotational part of a row that counts as pure translation, and vice versa.
    """
    basis, parts = row_basis(rows), []
    allowed, moving, turning = null_basis(basis), slice(0, 3), slice(3, 6)
    for part, other in ((moving, turning), (turning, moving)):
        # held directions come from rows that are pure translations, or pure rotations
        U, sigma, _ = np.linalg.svd(basis[:, other])
        uncoupled = U[:, np.count_nonzero(sigma >= tolerance) :]
        blocked, free = _projector((uncoupled.T @ basis[:, part]).T), _projector(allowed[part])
        parts += [blocked, _projector(free @ (np.diag(covered[part]) - blocked))]
    return parts


def _projector(columns: Float[np.ndarray, "3 k"]) -> Float[np.ndarray, "3 3"]:
    """Return the projector onto the span of columns."""
    U, sigma, _ = np.linalg.svd(columns, full_matrices=False)
    U = U[:, sigma > max(COUPLING_TOLERANCE * np.max(sigma, initial=0.0), 1e-9)]
    return U @ U.T


def constraint_marks(robot: Robot, motion: GuidedMotion, constraint: Constraint, most: int) -> dict[str, Any] | None:
    """Return the drawing of a constraint at the tip along a motion: held and free directions, and velocity ellipsoids.

    Args:
        robot: Robot of the motion.
        motion: The motion.
        constraint: One of its constraints.
        most: Largest number of times with an ellipsoid.

    Returns:
        JSON values for the page; None for a constraint that is not of a single frame.
    """
    n, base = constraint.provenance.get("n_constraints"), constraint
    if isinstance(n, int) and 0 < n < constraint.n_constraints:  # a task's own rows follow the learnt rows
        base = Constraint(constraint.selection[:n], constraint.features, constraint.provenance)
    samples, features = evenly(len(motion.samples), most), constraint.features
    if not isinstance(features, PoseRows | WeighedVelocity):
        return None
    twist, q = features.twist, motion.samples.q[samples]
    places = twist.poses(q)[:, :3, 3]
    directions, task = (cast(HeldDirections, held_directions(c, places)) for c in (base, constraint))
    # H J_v J_v^T H in the axes of the directions: the semi-axes are the tip's speeds along held directions at |u| = 1,
    # and for purely translational rows the singular values of A, because this is Lambda^T A A^T Lambda
    J = robot.frame_kinematics(twist.frame).jacobians(q, "world")[:, :3]
    if task.axes is not None:
        J = robot.frame_kinematics(task.axes).poses(q)[:, :3, :3].transpose(0, 2, 1) @ J
    driven = task.held @ J
    ellipsoid = driven @ driven.transpose(0, 2, 1)
    upper = np.triu_indices(3)  # xx xy xz yy yz zz of a symmetric matrix
    parts = zip(("held", "free", "heldTurns", "freeTurns"), directions[1:], strict=True)
    return {
        "tip": _place(robot, twist.frame),
        "axes": directions.axes and _place(robot, directions.axes),
        "times": to_base64(motion.samples.time[samples], "<f8"),
        **{key: to_base64(part[..., *upper], "<f4") for key, part in parts},
        "ellipsoid": to_base64(ellipsoid[:, *upper], "<f4"),
        "longest": float(np.sqrt(np.maximum(np.linalg.eigvalsh(ellipsoid), 0.0).max(initial=0.0))),  # semi-axis [m/s]
        "driven": constraint.n_constraints > base.n_constraints,  # also along free directions
        "target": _target_place(robot, constraint, motion),
    }


def ellipsoid_scale(longest: float, size: float) -> float:
    """Return the scale of velocity ellipsoids: the largest 1, 2 or 5 times a power of ten at which all of them fit.

    Args:
        longest: Longest semi-axis of all ellipsoids [m/s].
        size: Largest drawn length of a semi-axis [m].

    Returns:
        Drawn length of a velocity of 1 m/s [m].
    """
    steps = np.outer(10.0 ** np.arange(-30, 31), (1.0, 2.0, 5.0))
    return float(steps[steps * longest <= size * (1.0 + 1e-9)].max(initial=0.0)) if longest > 0.0 else 1.0


def _target_place(robot: Robot, constraint: Constraint, motion: GuidedMotion) -> dict[str, Any] | None:
    """Return the position of the target in the frame of a joint; missing coordinates are taken from the start."""
    target, q, selection = motion.target, motion.samples.q[0], constraint.selection
    features: Any = constraint.features
    if target is None or (target.shape != (4, 4) and isinstance(features, WeighedVelocity)):
        return None  # distances from an axis are not a position
    if target.shape == (4, 4):
        point = target[:3, 3]
    else:
        point, r = features.twist.pose(q)[:3, 3], features.coordinates(q)
        if target.shape == (len(selection),) != r.shape:  # along the rows: the target nearest to the start
            target = r + selection.T @ (target - selection @ r)
        axes = {AXES.index(name): k for k, name in enumerate(features.row_names) if name in AXES[:3]}
        if target.shape != r.shape or not axes:
            return None
        point[list(axes)] = target[list(axes.values())]
    carrier = features.relative_to
    return {"carrier": carrier and _place(robot, carrier), "point": point.tolist()}


def _place(robot: Robot, frame: Frame) -> dict[str, Any]:
    """Return the joint of a frame, and the frame's pose relative to the joint, row by row."""
    placement = robot.pinocchio_model.frames[frame.index].placement.homogeneous
    return {"joint": frame.parent_joint, "placement": placement.ravel().tolist()}


# ---- the mechanism, as lines and surfaces in the robot's base frame ------------------------------------------------


@final
class MechanismDrawing(NamedTuple):
    """Drawing of a mechanism, in the robot's base frame [m].

    Attributes:
        type: Type of the mechanism, e.g. `"hinge"`.
        sentence: The mechanism in words.
        lines: Polylines, each of shape (n, 3).
        patches: Corners of flat surfaces in order around them, each of shape (4, 3).
        shown: Demonstrated motion along it, in words; empty if it is not known.
        way: shape (n, 3), demonstrated path: from the start to the farthest point, or the whole path on a surface.
        hold: True if all recordings began at one position.
    """

    type: str
    sentence: str
    lines: tuple[Float[np.ndarray, "_n 3"], ...]
    patches: tuple[Float[np.ndarray, "4 3"], ...]
    shown: str
    way: Float[np.ndarray, "_n 3"]
    hold: bool

    def to_dict(self) -> dict[str, Any]:
        """Return the attributes as a dictionary of JSON values, with arrays in base64."""
        arrays = {name: [to_base64(x, "<f4") for x in getattr(self, name)] for name in ("lines", "patches")}
        return self._asdict() | arrays | {"way": to_base64(self.way, "<f4")}


def mechanism_drawing(
    mechanism: Mechanism | Mapping[str, Any] | None,
    held: Float[np.ndarray, "n 3"],
    shown: Shown | Intention | None = None,
) -> MechanismDrawing:
    """Draw a mechanism with lines and surfaces that are as large as the motion along it, and the demonstrated path.

    Missing parts of a mechanism, e.g. the axis of a held orientation, are not drawn; its sentence is always shown.

    Args:
        mechanism: The mechanism, or its dictionary from a constraint file; None if it is not known.
        held: Positions (n, 3) of the tip while it is on the mechanism, in the base frame [m]; at least one.
        shown: Demonstrated motion, or target of a self-imposed constraint; None if it is not known.

    Returns:
        The drawing.

    Raises:
        RecordingError: Numbers of the mechanism have the wrong size or are not finite.
    """
    described = mechanism.to_dict() if isinstance(mechanism, Mechanism) else dict(mechanism or {})
    # the page has room for 400 characters
    kind = str(described.get("type") or "mechanism")[:400] if described or shown is None else ""
    way, hold, text = np.zeros((0, 3)), False, "" if shown is None else shown.sentence
    if isinstance(shown, Shown) and not described.get("relative_to"):
        way, hold = shown.points, shown.hold is not None
    sentence = str(described.get("sentence") or kind)[:400]
    return MechanismDrawing(kind, sentence, *_geometry(kind, described, held), text, way, hold)


def _geometry(
    kind: str, described: Mapping[str, Any], held: Float[np.ndarray, "n 3"]
) -> tuple[tuple[np.ndarray, ...], tuple[np.ndarray, ...]]:
    """Return the lines and the patches of a mechanism; none if it lacks an axis or a point."""
    parts = dict[str, Any]()
    for name, shape in {"axis": (3,), "point": (3,), "radius": (), "pitch": ()}.items():
        entry = described.get(name)
        parts[name] = None if entry is None else finite(entry, *shape)
        # [m] distances above 1e9 cannot be drawn
        if entry is not None and (parts[name] is None or not np.all(np.abs(parts[name]) < 1e9)):
            rule = f"{'three finite numbers' if shape else 'a finite number'} below 1e+09"
            raise RecordingError(f"the mechanism's {name} must be {rule}, got {entry!r:.80}", code="mechanism")
    axis, point, radius, pitch = parts["axis"], parts["point"], float(parts["radius"] or 0), float(parts["pitch"] or 0)
    if kind == "ball" and point is not None and radius:
        return tuple(_helix(a, point, radius) for a in np.eye(3)), ()
    if kind == "ball" or axis is None or point is None or not np.any(axis):
        return (), ()
    axis = axis / np.linalg.norm(axis)
    lateral, along = (held - point) @ across(axis).T, (held - point) @ axis
    if kind == "plane":  # a rectangle, its sides along the widest and the narrowest spread of the motion
        turn = np.linalg.svd(lateral - lateral.mean(axis=0), full_matrices=False)[2] if len(held) > 2 else np.eye(2)
        spread = lateral @ turn.T
        margin = _margin(float(np.ptp(spread, axis=0).max()))
        (x, y), (right, top) = spread.min(axis=0) - margin, spread.max(axis=0) + margin
        patch = point + np.array([[x, y], [right, y], [right, top], [x, top]]) @ turn @ across(axis)
        return (np.vstack([patch, patch[:1]]),), (patch,)
    low, high = float(along.min()), float(along.max())
    reach = _margin(high - low) + 0.3 * radius
    lines = [np.array([point + (low - reach) * axis, point + (high + reach) * axis])]
    if kind == "screw" and pitch and radius:
        phase = np.arctan2(lateral[0, 1], lateral[0, 0]) + (low - along[0]) / pitch  # at the lowest position
        turn = np.sign(pitch) * min((high - low) / abs(pitch), 2.0 * np.pi * 12.0)  # more turns cannot be distinguished
        lines.append(_helix(axis, point + low * axis, radius, turn, pitch, phase))
    elif kind != "line" and radius:  # the circle of a hinge, the two rims of a cylinder
        heights = (low, high) if kind == "other" else (0.5 * (low + high),)
        lines += [_helix(axis, point + h * axis, radius) for h in heights]
    return tuple(lines), ()


def _helix(
    axis: np.ndarray, point: np.ndarray, radius: float, turn: float = 2.0 * np.pi, pitch: float = 0.0, phase: float = 0
) -> Float[np.ndarray, "n 3"]:
    """Return the circle, or the helix, of a hand that turns about an axis, from a phase angle [rad].

    Its segments of 3.75 degrees look round even if it fills a screen.
    """
    angles = np.linspace(0.0, turn, max(2, round(96 * abs(turn) / (2.0 * np.pi)) + 1))[:, None]
    radial = np.hstack([np.cos(phase + angles), np.sin(phase + angles)]) @ across(axis)
    return point + radius * radial + pitch * angles * axis


def _margin(extent: float) -> float:
    """Return the drawn length beyond a motion of an extent [m]."""
    return max(0.25 * extent, 0.06)  # [m]
