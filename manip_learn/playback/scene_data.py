"""Everything the page's program reads, as one dictionary of finite numbers and text."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pinocchio as pin
from jaxtyping import Float

from manip_learn.playback.appearance import Appearance
from manip_learn.playback.constraint_marks import constraint_marks, ellipsoid_scale
from manip_learn.playback.kinematic_tree import TreeJoint
from manip_learn.playback.mechanism_drawing import CORNERS, MechanismDrawing, facing
from manip_learn.playback.page_writer import packed
from manip_learn.playback.phase_bands import PhaseKind, own_kinds
from manip_learn.playback.recorded_motion import RecordedMotion, points_per_curve, track_data
from manip_learn.robot.robot import Robot
from manip_learn.robot.visuals.meshes import Mesh

MAX_POSTURES_FOR_BOUNDS = 120  # of all motions, around which the camera stands
OUTLINE_DIRECTIONS = 240  # over the sphere, 13 degrees apart
MOST_PLACES, LEAST_PLACES = 12_000, 60  # of all ellipsoids of a page, and of one motion
ELLIPSOID = 0.08  # longest semi-axis relative to the scene
ASIDE = np.deg2rad(62.0)  # the camera from what it looks at
_NEAR = 0.25  # of the motion's extent: how far around it the picture reaches for what stands there
FLOOR_REACH = 3.0  # edge of a floor in extents of the motion: to the rim of the picture
PATCH = 0.6  # [m] of a front that has no end: as wide as a cupboard
_MARKS = 0.085  # half length of an arrow relative to the scene, as in page/constraint_marks.js


def scene_data(
    robot: Robot,
    tree: tuple[TreeJoint, ...],
    looks: Appearance,
    tip: str,
    motions: Sequence[RecordedMotion],
    colours: Sequence[tuple[str, str]],
    notes: Sequence[str],
    kinds: Sequence[PhaseKind] = (),
    mechanisms: Sequence[MechanismDrawing | None] = (),
) -> dict[str, Any]:
    """The data of a page; arrays are little-endian and in base64."""
    drawn = [line for m in mechanisms if m for line in (*m.lines, m.way)]
    cloud = np.concatenate([_drawn_points(robot, looks, motions), *drawn])
    # and where the marks at the tip reach to, along its path
    reach = _MARKS * float(np.linalg.norm(np.ptp(cloud, axis=0)))
    paths = [m.path[:: max(1, len(m.path) // MAX_POSTURES_FOR_BOUNDS)] for m in motions if m.guidance.constraints]
    marked = [path + reach * side for path in paths for side in (*np.eye(3), *-np.eye(3))]
    cloud = np.concatenate([cloud, *marked])
    low, high = cloud.min(axis=0), cloud.max(axis=0)
    size = float(np.linalg.norm(high - low))
    around = [[_thing(thing, low, high) for thing in m.around] for m in motions]
    # of what stands around as much is framed as is near the motion
    near = [corner for some in around for thing in some for corner in thing.pop("corners")]
    cloud = np.concatenate([cloud, np.clip(np.reshape(near, (-1, 3)), low - _NEAR * size, high + _NEAR * size)])
    low, high = cloud.min(axis=0), cloud.max(axis=0)
    most, marks = points_per_curve([m.measures for m in motions]), list[list[dict[str, Any] | None]]()
    for m in motions:
        each, target = m.guidance.constraints, m.guidance.target
        places = max(LEAST_PLACES, MOST_PLACES // len(motions)) // max(len(each), 1)
        marks.append([constraint_marks(robot, m.samples, c, target, places) for c in each if m.samples is not None])
    size = float(np.linalg.norm(high - low))
    # the points that stick out farthest in directions all over the sphere: what the camera must frame
    k = np.arange(OUTLINE_DIRECTIONS) + 0.5
    height, turn = 1.0 - 2.0 * k / OUTLINE_DIRECTIONS, np.pi * (1.0 + 5.0**0.5) * k
    ring = np.sqrt(1.0 - height**2)
    outermost = np.unique(np.argmax(cloud @ np.array([ring * np.cos(turn), ring * np.sin(turn), height]), axis=0))
    # an arm all of whose motion is in the horizontal plane is seen from above
    rotation, is_flat, frames = [np.eye(3)], True, robot.pinocchio_model.frames
    for joint in tree[1:]:
        rotation.append(rotation[joint.parent] @ joint.placement[:3, :3])
        upright = abs(float((rotation[-1] @ joint.axis)[2]))
        is_flat &= joint.motion != "free" and abs(upright - (joint.motion == "revolute")) <= 1e-6
    return {
        "robot": {
            "tip": tip,
            "joints": [vars(j) | {"placement": _rows(j.placement), "axis": j.axis.tolist()} for j in tree],
            "links": [
                {"name": name, "joint": f.parent_joint, "placement": _rows(frames[f.index].placement.homogeneous)}
                for name, f in ((name, robot.frame(name)) for name in robot.frame_names)
                if frames[f.index].type == pin.FrameType.BODY or name == tip
            ],
            "shapes": [vars(s) | {"pose": _rows(s.pose)} for s in looks.shapes],
            "meshes": [_mesh(m) for m in looks.meshes],
        },
        "bounds": [low.tolist(), high.tolist()],
        "outline": cloud[outermost].round(5).tolist(),
        "azimuth": _azimuth(motions),
        "floor": float(min(low[2], 0.0)),
        "view": "top" if is_flat and len(tree) > 1 else "iso",
        "rollouts": [
            _rollout(m, c) | {"measures": track_data(m.measures, most), "marks": mark, "around": things}
            for m, c, mark, things in zip(motions, colours, marks, around, strict=True)
        ],
        "ellipsoidScale": ellipsoid_scale([one for some in marks for one in some], ELLIPSOID * size),
        "notes": list(notes),
        "panes": [],
        "zero": 0.0,
        "phaseKinds": [vars(k) for k in kinds],
        "mechanisms": [m.to_dict() | {"constraint": k} for k, m in enumerate(mechanisms) if m is not None],
    }


def _thing(thing: Mapping[str, Any], low: Float[np.ndarray, " 3"], high: Float[np.ndarray, " 3"]) -> dict[str, Any]:
    """What stands around, with corners of a box about it; a floor reaches below the motion, other faces are patches."""
    pose, size, kind = np.array(thing["pose"], dtype=np.float64), thing.get("size", ()), thing["kind"]
    mesh = Mesh(np.array(thing["vertices"]), np.array(thing["faces"])) if kind == "mesh" else None
    if kind == "face":
        size = (FLOOR_REACH * float(np.linalg.norm(high - low)),) * 2 if thing["name"] == "floor" else (PATCH,) * 2
        pose = facing(pose[:3, 2], pose[:3, 3])
        pose[:2, 3] = 0.5 * (low + high)[:2] if thing["name"] == "floor" else pose[:2, 3]
    extents = {"face": [PATCH, 0.0, PATCH], "sphere": [2.0 * x for x in (*size,) * 3], "box": size}.get(kind)
    if kind == "cylinder":
        extents = [2.0 * size[0], 2.0 * size[0], size[1]]
    corners = CORNERS * extents if mesh is None else mesh.vertices
    known = {"name": thing["name"], "kind": kind, "size": list(size), "pose": _rows(pose)}
    known |= {"assumed": bool(thing.get("assumed")), "nearest": thing.get("nearest"), "link": thing.get("link")}
    known |= {"mesh": None if mesh is None else _mesh(mesh)}
    return known | {"corners": (corners @ pose[:3, :3].T + pose[:3, 3]).tolist()}


def _rows(pose: Float[np.ndarray, "4 4"]) -> list[float]:
    return [float(x) for x in pose.ravel()]


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


def _rollout(motion: RecordedMotion, colour: tuple[str, str]) -> dict[str, Any]:
    own = own_kinds(motion.phases, colour[1])
    numbers = {kind.label: k for k, kind in enumerate(own)}
    described: dict[str, Any] = {
        "name": motion.name,
        "colour": colour[1],
        "duration": motion.duration,
        # float64: an angle of many turns must still be right to a nanoradian
        "keyTimes": packed(motion.key_times, "<f8"),
        "tracks": packed(motion.tracks, "<f8"),
        "pathTimes": packed(motion.path_times, "<f4"),
        "path": packed(motion.path, "<f4"),
        "curveTimes": packed(motion.curve_times, "<f8"),
        "curve": packed(motion.curve, "<f8"),
        "status": [list(change) for change in motion.status],
        "fitShare": motion.fit_share,
        "handles": motion.handles,
        # start, end, number of the kind; -1 for free motion
        "phases": [
            [b.start, b.end, numbers.get(b.name or "", -1 if b.constraint is None else b.constraint)]
            for b in motion.phases
        ],
    }
    return described | ({"phaseKinds": [vars(k) for k in own]} if own else {})


def _drawn_points(robot: Robot, looks: Appearance, motions: Sequence[RecordedMotion]) -> Float[np.ndarray, "C 3"]:
    """Points that enclose everything that is ever drawn, in the base frame [m]."""
    model = robot.pinocchio_model
    data = model.createData()
    corners = [_corners(looks, i) for i in range(model.njoints)]
    points = [m.path for m in motions] + [np.zeros((1, 3))]
    for motion in motions:
        every = max(1, len(motion.postures) * len(motions) // MAX_POSTURES_FOR_BOUNDS)
        for q in motion.postures[::every]:
            pin.forwardKinematics(model, data, robot.pinocchio_configuration(q))
            for i, local in enumerate(corners):
                pose = data.oMi[i].homogeneous
                points.append(local @ pose[:3, :3].T + pose[:3, 3])
    return np.concatenate([p for p in points if len(p)])


def _azimuth(motions: Sequence[RecordedMotion]) -> float:
    """Where the camera stands [rad]: beside the arm and a little before it."""
    x, y, _ = np.concatenate([m.path for m in motions]).mean(axis=0)
    return float(np.arctan2(y, x) - ASIDE) if np.hypot(x, y) > 1e-6 else float(np.deg2rad(-50.0))


def _corners(looks: Appearance, joint: int) -> Float[np.ndarray, "C 3"]:
    """Corners of the boxes around a joint's shapes, and the joint's origin, in the joint's frame [m]."""
    points = [np.zeros((1, 3))]
    for shape in (s for s in looks.shapes if s.joint == joint):
        half = shape.half_extent()
        ends = np.array([-half, half]) if shape.mesh is None else looks.meshes[shape.mesh].vertices
        low, high = ends.min(axis=0), ends.max(axis=0)
        box = (low + high) / 2.0 + CORNERS * (high - low)
        points.append(box @ shape.pose[:3, :3].T + shape.pose[:3, 3])
    return np.concatenate(points)
