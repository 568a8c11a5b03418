"""Everything the page's program reads, as one dictionary of finite numbers and text: robot, marks and mechanisms."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import product
from typing import Any, NamedTuple, cast, final

import numpy as np
import pinocchio as pin
from jaxtyping import Float

from manip_learn.constraint.constraint import Constraint
from manip_learn.constraint.features import MechanismRows
from manip_learn.constraint.features.frame_jacobian import AXES, PoseRows
from manip_learn.constraint.features.mechanism_rows import WeighedVelocity
from manip_learn.constraint.mechanism import Mechanism
from manip_learn.constraint.place import across
from manip_learn.constraint.shown import Intention, Shown
from manip_learn.errors import RecordingError
from manip_learn.linalg import finite, null_basis, row_basis
from manip_learn.playback.appearance import Appearance, Shape, kinematic_tree
from manip_learn.playback.page_writer import packed
from manip_learn.playback.palette import PhaseKind
from manip_learn.playback.recorded_motion import MAX_CURVE_POINTS, GuidedMotion, RecordedMotion, track_data
from manip_learn.recordings.trajectory import evenly
from manip_learn.robot.joints import Frame
from manip_learn.robot.robot import Robot
from manip_learn.robot.visuals.meshes import Mesh

MAX_POSTURES_FOR_BOUNDS = 120  # of all motions, around which the camera stands
PATCH = 0.6  # [m] of a front that has no end: as wide as a cupboard
COUPLED = 0.1  # part of a learnt unit row that turns, up to which it counts as one that only moves, and the other way
SIX = np.triu_indices(3)  # xx xy xz yy yz zz of a symmetric matrix
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
        looks: How it is drawn.
        tip: Name of the frame whose path is drawn.
        motions: What is played.
        notes: Sentences.
        kinds: Phases of recordings; empty without.
        mechanisms: What is drawn of each constraint's mechanism, None for nothing.
    """
    drawn = [line for m in mechanisms if m for line in (*m.lines, m.way)]
    cloud = np.concatenate([_drawn_points(robot, looks, motions), *drawn])
    # and where the marks at the tip reach to, along its path: half length of an arrow, as in page/constraint_marks.js
    reach = 0.085 * _extent(cloud)
    paths = [m.path[:: max(1, len(m.path) // MAX_POSTURES_FOR_BOUNDS)] for m in motions if m.motion.constraints]
    cloud = np.concatenate([cloud, *(path + reach * side for path in paths for side in (*np.eye(3), *-np.eye(3)))])
    # what was stated is drawn; of it as much is framed as is within a quarter of the motion's extent
    low, high, near = cloud.min(axis=0), cloud.max(axis=0), 0.25 * _extent(cloud)
    rollouts, n_curves = list[dict[str, Any]](), sum(len(track["curves"]) for m in motions for track in m.measures)
    # points of a curve: all curves of a page have 100,000 of 8 bytes
    most = int(np.clip(100_000 // max(n_curves, 1), 60, MAX_CURVE_POINTS))
    places = max(60, 12_000 // len(motions))  # of the ellipsoids of one motion; all of a page are 12,000
    for m in motions:
        stated = getattr(m.motion.recording, "around", ())
        things = [_thing(thing, low, high) for thing in stated if not thing.get("assumed")]
        cloud = np.concatenate([cloud, *(np.clip(points, low - near, high + near) for _, points in things)])
        each = places // max(len(m.motion.constraints), 1)
        marks = [constraint_marks(robot, m.motion, c, each) for c in m.motion.constraints]
        shown = {"measures": track_data(m.measures, most), "marks": marks, "around": [thing for thing, _ in things]}
        rollouts.append({**m.content, **shown})
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
    """Return the points that stick out farthest in directions all over the sphere: what the camera must frame."""
    k = np.arange(240) + 0.5  # 13 degrees apart
    height, turn = 1.0 - 2.0 * k / 240, np.pi * (1.0 + 5.0**0.5) * k
    ring = np.sqrt(1.0 - height**2)
    return cloud[np.unique(np.argmax(cloud @ np.array([ring * np.cos(turn), ring * np.sin(turn), height]), axis=0))]


def _is_flat(robot: Robot) -> bool:
    """Return True if all motion of the arm is in the horizontal plane: it is seen from above."""
    model = robot.pinocchio_model
    J = pin.computeJointJacobians(model, model.createData(), pin.neutral(model))  # velocities at the base's origin
    return model.nv > 0 and bool(np.all(np.abs(J[2:5]) < 1e-6))  # none upward, no turn about a level axis


def _robot(robot: Robot, looks: Appearance, tip: str) -> dict[str, Any]:
    frames, tree = robot.pinocchio_model.frames, kinematic_tree(robot)
    named = map(robot.frame, robot.frame_names)
    links = [f for f in named if frames[f.index].type == pin.FrameType.BODY or f.name == tip]
    return {
        "tip": tip,
        "joints": [j._asdict() | {"placement": j.placement.ravel().tolist(), "axis": j.axis.tolist()} for j in tree],
        "links": [{"name": frame.name, **_place(robot, frame)} for frame in links],
        "shapes": [vars(s) | {"pose": s.pose.ravel().tolist()} for s in looks.shapes],
        "meshes": [_mesh(m) for m in looks.meshes],
    }


def _thing(
    thing: Mapping[str, Any], low: Float[np.ndarray, " 3"], high: Float[np.ndarray, " 3"]
) -> tuple[dict[str, Any], Float[np.ndarray, "C 3"]]:
    """Return a thing that was stated as the page draws it, and points around it [m].

    A floor reaches below the motion, other faces are patches.
    """
    pose, size, kind = np.array(thing["pose"], dtype=np.float64), list(thing.get("size", ())), thing["kind"]
    mesh, box = None, CORNERS * [PATCH, 0.0, PATCH]
    if kind == "face":
        out, size = pose[:3, 2].copy(), [PATCH, PATCH]
        # its second axis looks out, its third one is as upright as that allows
        up = np.eye(3)[2 if abs(out[2]) < 0.98 else 0]  # within 11 degrees of level there is no upright
        up = up - (up @ out) * out
        up /= np.linalg.norm(up)
        pose[:3, :3] = np.column_stack([np.cross(out, up), out, up])
        if thing["name"] == "floor":  # to the rim of the picture: its edge is three extents of the motion
            pose[:2, 3], size = 0.5 * (low + high)[:2], [3.0 * float(np.linalg.norm(high - low))] * 2
    elif kind == "mesh":
        mesh = Mesh(np.array(thing["vertices"]), np.array(thing["faces"]))
        box = mesh.vertices
    else:
        box = 2.0 * CORNERS * Shape(0, kind, tuple(size), pose).half_extent()
    known = {"name": thing["name"], "kind": kind, "size": size, "pose": pose.ravel().tolist()}
    return known | {"mesh": None if mesh is None else _mesh(mesh)}, _moved(pose, box)


def _mesh(mesh: Mesh) -> dict[str, Any]:
    """Vertices as 16-bit steps within their box: 8 micrometres in half a metre."""
    origin = mesh.vertices.min(axis=0)
    step = np.maximum((mesh.vertices.max(axis=0) - origin) / 65535.0, 1e-12)
    wide = len(mesh.vertices) > 65536
    return {
        "origin": origin.tolist(),
        "step": step.tolist(),
        "positions": packed(np.rint((mesh.vertices - origin) / step), "<u2"),
        "triangles": packed(mesh.faces, "<u4" if wide else "<u2"),
        "wide": wide,
        "normals": None if mesh.normals is None else packed(np.rint(127.0 * mesh.normals), "i1"),
    }


def _drawn_points(robot: Robot, looks: Appearance, motions: Sequence[RecordedMotion]) -> Float[np.ndarray, "C 3"]:
    """Return points that enclose all of the arm at any time, in the base frame [m]."""
    model = robot.pinocchio_model
    data = model.createData()
    boxes = [(i, np.zeros((1, 3))) for i in range(model.njoints)]  # corners around what rides on each joint
    for shape in looks.shapes:
        half = shape.half_extent()
        ends = np.array([-half, half]) if shape.mesh is None else looks.meshes[shape.mesh].vertices
        box = 0.5 * (ends.min(axis=0) + ends.max(axis=0)) + CORNERS * np.ptp(ends, axis=0)
        boxes.append((shape.joint, _moved(shape.pose, box)))
    points = [m.path for m in motions] + [np.zeros((1, 3))]
    for motion in motions:
        every = max(1, len(motion.postures) * len(motions) // MAX_POSTURES_FOR_BOUNDS)
        for q in motion.postures[::every]:
            pin.forwardKinematics(model, data, robot.pinocchio_configuration(q))
            points += [_moved(data.oMi[joint].homogeneous, box) for joint, box in boxes]
    return np.concatenate(points)


def _moved(pose: Float[np.ndarray, "4 4"], points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    return points @ pose[:3, :3].T + pose[:3, 3]


def _azimuth(motions: Sequence[RecordedMotion]) -> float:
    """Return the direction of the camera [rad]: beside the arm, 62 degrees from the middle of the path."""
    x, y, _ = np.concatenate([m.path for m in motions]).mean(axis=0)
    return float(np.arctan2(y, x) - np.deg2rad(62.0)) if np.hypot(x, y) > 1e-6 else float(np.deg2rad(-50.0))


# ---- at the tip: directions held and free, the ellipsoid of the task, the target ------------------------------------


@final
class HeldDirections(NamedTuple):
    """Projectors onto directions, in the axes of `axes` (the base, if that is None).

    Each field is shape (3, 3), or (T, 3, 3) along a motion if the directions depend on the place. Directions that the
    features do not look at are neither held nor free.

    Attributes:
        axes: Frame whose axes are meant; None for the base.
        held, free: Of the frame's origin.
        held_turns, free_turns: Of its orientation.
    """

    axes: Frame | None
    held: Float[np.ndarray, "..."]
    free: Float[np.ndarray, "..."]
    held_turns: Float[np.ndarray, "..."]
    free_turns: Float[np.ndarray, "..."]


def held_directions(constraint: Constraint, places: Float[np.ndarray, "T 3"]) -> HeldDirections | None:
    """Return the directions of a constraint; None for features that are not of one frame.

    A direction is held if moving along it alone breaks the constraint, whatever the turning: the row space has the row
    (a, 0). It is free if the constraint allows to move along it, perhaps with a turn, as at a door's handle.

    Args:
        constraint: A(q).
        places: Origin of the frame along the motion, where the features see it: in the base, or in the other frame [m].
    """
    features, selection = constraint.features, constraint.selection
    if isinstance(features, PoseRows):  # the same everywhere
        W = np.eye(6)[[AXES.index(name) for name in features.row_names]]
        axes = features.frame if features.own_axes else features.relative_to
        return HeldDirections(axes, *_parts(selection @ W, W.sum(axis=0), COUPLED))
    if not isinstance(features, WeighedVelocity):
        return None
    W = features.place_weights.values(places)
    seen = np.repeat([1.0, float(np.any(W[..., 3:]))], 3)
    # a mixture was learnt, where a mechanism's rows are what they are
    tolerance = 1e-6 if isinstance(features, MechanismRows) else COUPLED
    parts = [_parts(selection @ w, seen, tolerance) for w in W]
    return HeldDirections(features.relative_to, *map(np.array, zip(*parts, strict=True)))


def _parts(
    rows: Float[np.ndarray, "s 6"], seen: Float[np.ndarray, " 6"], tolerance: float
) -> list[Float[np.ndarray, "3 3"]]:
    """Return projectors onto held and free directions, moving, then turning.

    Args:
        rows: Constrained velocities, 3 linear and 3 angular ones.
        seen: 1 for each velocity that the features look at, else 0.
        tolerance: Part of a row that turns, up to which it counts as one that only moves, and the other way.
    """
    basis, parts = row_basis(rows), []
    allowed, moving, turning = null_basis(basis), slice(0, 3), slice(3, 6)
    for part, other in ((moving, turning), (turning, moving)):
        # held are the directions of those rows that only move, or only turn
        U, sigma, _ = np.linalg.svd(basis[:, other])
        uncoupled = U[:, np.count_nonzero(sigma >= tolerance) :]
        held, free = _projector((uncoupled.T @ basis[:, part]).T), _projector(allowed[part])
        parts += [held, _projector(free @ (np.diag(seen[part]) - held))]
    return parts


def _projector(columns: Float[np.ndarray, "3 k"]) -> Float[np.ndarray, "3 3"]:
    U, sigma, _ = np.linalg.svd(columns, full_matrices=False)
    U = U[:, sigma > max(COUPLED * np.max(sigma, initial=0.0), 1e-9)]
    return U @ U.T


def constraint_marks(robot: Robot, motion: GuidedMotion, constraint: Constraint, most: int) -> dict[str, Any] | None:
    """Return the marks of a constraint along a motion; None for a constraint that is not of a single frame.

    Args:
        robot: Whose tip it is.
        motion: The motion.
        constraint: One that guides it.
        most: Largest number of times at which the ellipsoid is known.
    """
    n, learnt = constraint.provenance.get("n_constraints"), constraint
    if isinstance(n, int) and 0 < n < constraint.n_constraints:  # a task's rows follow those that were learnt
        learnt = Constraint(constraint.selection[:n], constraint.features, constraint.provenance)
    kept, features = evenly(len(motion.samples), most), constraint.features
    if not isinstance(features, PoseRows | WeighedVelocity):
        return None
    twist, q = features.twist, motion.samples.q[kept]
    places = twist.poses(q)[:, :3, 3]
    directions, ruled = (cast(HeldDirections, held_directions(c, places)) for c in (learnt, constraint))
    # H J_v J_v^T H in the axes of the directions: semi-axes are the tip's speeds along what is held, at |u| = 1, and of
    # rows that only move the singular values of A, since this is Lambda^T A A^T Lambda
    J = robot.frame_kinematics(twist.frame).jacobians(q, "world")[:, :3]
    if ruled.axes is not None:
        J = robot.frame_kinematics(ruled.axes).poses(q)[:, :3, :3].transpose(0, 2, 1) @ J
    driven = ruled.held @ J
    ellipsoid = driven @ driven.transpose(0, 2, 1)
    parts = zip(("held", "free", "heldTurns", "freeTurns"), directions[1:], strict=True)
    return {
        "tip": _place(robot, twist.frame),
        "axes": directions.axes and _place(robot, directions.axes),
        "times": packed(motion.samples.time[kept], "<f8"),
        **{key: packed(part[..., *SIX], "<f4") for key, part in parts},
        "ellipsoid": packed(ellipsoid[:, *SIX], "<f4"),
        "longest": float(np.sqrt(np.maximum(np.linalg.eigvalsh(ellipsoid), 0.0).max(initial=0.0))),  # semi-axis [m/s]
        "driven": constraint.n_constraints > learnt.n_constraints,  # along what is free, too
        "target": _target_place(robot, constraint, motion),
    }


def ellipsoid_scale(longest: float, size: float) -> float:
    """Return the length drawn for 1 m/s: 1, 2 or 5 times a power of ten, the largest ellipsoid fits into the scene.

    Args:
        longest: Semi-axis of all ellipsoids [m/s].
        size: Room for it [m].
    """
    steps = np.outer(10.0 ** np.arange(-30, 31), (1.0, 2.0, 5.0))
    return float(steps[steps * longest <= size * (1.0 + 1e-9)].max(initial=0.0)) if longest > 0.0 else 1.0


def _target_place(robot: Robot, constraint: Constraint, motion: GuidedMotion) -> dict[str, Any] | None:
    """Return the place of the target in the frame of a joint; coordinates that it lacks are those of the start."""
    target, q, selection = motion.target, motion.samples.q[0], constraint.selection
    features: Any = constraint.features
    if target is None or (target.shape != (4, 4) and isinstance(features, WeighedVelocity)):
        return None  # distances from an axis are no place
    if target.shape == (4, 4):
        point = target[:3, 3]
    else:
        point, r = features.twist.pose(q)[:3, 3], features.coordinates(q)
        if target.shape == (len(selection),) != r.shape:  # along the rows: the nearest place from the start
            target = r + selection.T @ (target - selection @ r)
        known = {AXES.index(name): k for k, name in enumerate(features.row_names) if name in AXES[:3]}
        if target.shape != r.shape or not known:
            return None
        point[list(known)] = target[list(known.values())]
    carrier = features.relative_to
    return {"carrier": carrier and _place(robot, carrier), "point": point.tolist()}


def _place(robot: Robot, frame: Frame) -> dict[str, Any]:
    """Return the joint that carries a frame, and the frame's pose in the joint's, row by row."""
    placement = robot.pinocchio_model.frames[frame.index].placement.homogeneous
    return {"joint": frame.parent_joint, "placement": placement.ravel().tolist()}


# ---- the mechanism, as lines and surfaces in the robot's base frame ------------------------------------------------


@final
class MechanismDrawing(NamedTuple):
    """What is drawn of a mechanism, in the robot's base frame [m].

    Attributes:
        type: E.g. `"hinge"`.
        sentence: The mechanism in words.
        lines: Polylines, each of shape (n, 3).
        patches: Corners of flat surfaces in order around them, each of shape (4, 3).
        shown: What the recordings did along it, in words; empty if that is not known.
        way: shape (n, 3), from where they began to the farthest point, or along the path on a surface.
        hold: Whether all of them began at one place.
    """

    type: str
    sentence: str
    lines: tuple[Float[np.ndarray, "_n 3"], ...]
    patches: tuple[Float[np.ndarray, "4 3"], ...]
    shown: str
    way: Float[np.ndarray, "_n 3"]
    hold: bool

    def to_dict(self) -> dict[str, Any]:
        """For the page."""
        packed_up = {name: [packed(x, "<f4") for x in getattr(self, name)] for name in ("lines", "patches")}
        return self._asdict() | packed_up | {"way": packed(self.way, "<f4")}


def mechanism_drawing(
    mechanism: Mechanism | Mapping[str, Any] | None,
    held: Float[np.ndarray, "n 3"],
    shown: Shown | Intention | None = None,
) -> MechanismDrawing:
    """Lines and patches of a mechanism, as large as the motion that it held, and what was shown along it.

    What a mechanism lacks, e.g. the axis of an orientation that is held, is not drawn; its sentence is always shown.

    Args:
        mechanism: Or its dictionary, as a constraint file holds it; None where it has no name.
        held: The tip where the mechanism held it, in the base frame [m]; at least one point.
        shown: What the recordings did along it, or where they went, if that is known.

    Raises:
        RecordingError: Numbers of a wrong size or not finite.
    """
    described = mechanism.to_dict() if isinstance(mechanism, Mechanism) else dict(mechanism or {})
    # 400 characters are as many as there is room for
    kind = str(described.get("type") or "mechanism")[:400] if described or shown is None else ""
    way, hold, told = np.zeros((0, 3)), False, "" if shown is None else shown.sentence
    if isinstance(shown, Shown) and not described.get("relative_to"):
        way, hold = shown.points, shown.hold is not None
    sentence = str(described.get("sentence") or kind)[:400]
    return MechanismDrawing(kind, sentence, *_form(kind, described, held), told, way, hold)


def _form(
    kind: str, described: Mapping[str, Any], held: Float[np.ndarray, "n 3"]
) -> tuple[tuple[np.ndarray, ...], tuple[np.ndarray, ...]]:
    """Return the lines and the patches of a mechanism; none where it lacks an axis or a place."""
    known = dict[str, Any]()
    for name, shape in {"axis": (3,), "point": (3,), "radius": (), "pitch": ()}.items():
        given = described.get(name)
        known[name] = None if given is None else finite(given, *shape)
        # [m] what is farther away than 1e9 cannot be drawn
        if given is not None and (known[name] is None or not np.all(np.abs(known[name]) < 1e9)):
            wanted = f"{'three finite numbers' if shape else 'a finite number'} below 1e+09"
            raise RecordingError(f"the mechanism's {name} must be {wanted}, got {given!r:.80}", code="mechanism")
    axis, point, radius, pitch = known["axis"], known["point"], float(known["radius"] or 0), float(known["pitch"] or 0)
    if kind == "ball" and point is not None and radius:
        return tuple(_helix(a, point, radius) for a in np.eye(3)), ()
    if kind == "ball" or axis is None or point is None or not np.any(axis):
        return (), ()
    axis = axis / np.linalg.norm(axis)
    beside, along = (held - point) @ across(axis).T, (held - point) @ axis
    if kind == "plane":  # a rectangle, its sides along the widest and the narrowest spread of the motion
        turn = np.linalg.svd(beside - beside.mean(axis=0), full_matrices=False)[2] if len(held) > 2 else np.eye(2)
        within = beside @ turn.T
        margin = _margin(float(np.ptp(within, axis=0).max()))
        (x, y), (right, top) = within.min(axis=0) - margin, within.max(axis=0) + margin
        patch = point + np.array([[x, y], [right, y], [right, top], [x, top]]) @ turn @ across(axis)
        return (np.vstack([patch, patch[:1]]),), (patch,)
    low, high = float(along.min()), float(along.max())
    reach = _margin(high - low) + 0.3 * radius
    lines = [np.array([point + (low - reach) * axis, point + (high + reach) * axis])]
    if kind == "screw" and pitch and radius:
        phase = np.arctan2(beside[0, 1], beside[0, 0]) + (low - along[0]) / pitch  # at the lowest place held
        turn = np.sign(pitch) * min((high - low) / abs(pitch), 2.0 * np.pi * 12.0)  # more turns are not told apart
        lines.append(_helix(axis, point + low * axis, radius, turn, pitch, phase))
    elif kind != "line" and radius:  # the circle of a hinge, the two rims of a cylinder
        heights = (low, high) if kind == "other" else (0.5 * (low + high),)
        lines += [_helix(axis, point + h * axis, radius) for h in heights]
    return tuple(lines), ()


def _helix(
    axis: np.ndarray, point: np.ndarray, radius: float, turn: float = 2.0 * np.pi, pitch: float = 0.0, phase: float = 0
) -> Float[np.ndarray, "n 3"]:
    """Return the circle, or the helix, of a hand that turns about an axis; it begins beside the point at a phase [rad].

    Lines of 3.75 degrees look round when they fill a screen.
    """
    angles = np.linspace(0.0, turn, max(2, round(96 * abs(turn) / (2.0 * np.pi)) + 1))[:, None]
    turned = np.hstack([np.cos(phase + angles), np.sin(phase + angles)]) @ across(axis)
    return point + radius * turned + pitch * angles * axis


def _margin(extent: float) -> float:
    return max(0.25 * extent, 0.06)  # [m] beyond a motion of that extent
