"""Everything the page's program reads, as one dictionary of finite numbers and text."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import product
from typing import Any

import numpy as np
import pinocchio as pin
from jaxtyping import Float

from manip_learn.playback.appearance import Appearance, Shape, kinematic_tree
from manip_learn.playback.constraint_marks import MechanismDrawing, constraint_marks, ellipsoid_scale
from manip_learn.playback.page_writer import packed
from manip_learn.playback.palette import PhaseKind
from manip_learn.playback.recorded_motion import MOST_OF_A_CURVE, RecordedMotion, track_data
from manip_learn.robot.robot import Robot
from manip_learn.robot.visuals.meshes import Mesh

MAX_POSTURES_FOR_BOUNDS = 120  # of all motions, around which the camera stands
PATCH = 0.6  # [m] of a front that has no end: as wide as a cupboard
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
    guided = [m for m in motions if m.motion.constraints]
    paths = [m.path[:: max(1, len(m.path) // MAX_POSTURES_FOR_BOUNDS)] for m in guided]
    cloud = np.concatenate([cloud, *(path + reach * side for path in paths for side in (*np.eye(3), *-np.eye(3)))])
    # what was stated is drawn; of it as much is framed as is within a quarter of the motion's extent
    low, high, near = cloud.min(axis=0), cloud.max(axis=0), 0.25 * _extent(cloud)
    rollouts, n_curves = list[dict[str, Any]](), sum(len(track["curves"]) for m in motions for track in m.measures)
    # points of a curve: all curves of a page have 100,000 of 8 bytes
    most = int(np.clip(100_000 // max(n_curves, 1), 60, MOST_OF_A_CURVE))
    places = max(60, 12_000 // len(motions))  # of the ellipsoids of one motion; all of a page are 12,000
    for m in motions:
        stated = getattr(m.motion.recording, "around", ())
        things = [_thing(thing, low, high) for thing in stated if not thing.get("assumed")]
        cloud = np.concatenate([cloud, *(np.clip(points, low - near, high + near) for _, points in things)])
        constraints, measures = m.motion.constraints, track_data(m.measures, most)
        each = places // max(len(constraints), 1)
        marks = [constraint_marks(robot, m.motion, c, each) for c in constraints]
        rollouts.append({**m.content, "measures": measures, "marks": marks, "around": [thing for thing, _ in things]})
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
        "panes": [],
        "zero": 0.0,
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
    rotation, tree = [np.eye(3)], kinematic_tree(robot)
    for joint in tree[1:]:
        rotation.append(rotation[joint.parent] @ joint.placement[:3, :3])
        upright = abs(float((rotation[-1] @ joint.axis)[2]))
        if joint.motion == "free" or abs(upright - (joint.motion == "revolute")) > 1e-6:
            return False
    return len(tree) > 1


def _robot(robot: Robot, looks: Appearance, tip: str) -> dict[str, Any]:
    frames, tree = robot.pinocchio_model.frames, kinematic_tree(robot)
    links = {name: frames[robot.frame(name).index] for name in robot.frame_names}
    return {
        "tip": tip,
        "joints": [vars(j) | {"placement": j.placement.ravel().tolist(), "axis": j.axis.tolist()} for j in tree],
        "links": [
            {"name": name, "joint": frame.parentJoint, "placement": frame.placement.homogeneous.ravel().tolist()}
            for name, frame in links.items()
            if frame.type == pin.FrameType.BODY or name == tip
        ],
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
    corners = [_corners(looks, i) for i in range(model.njoints)]
    points = [m.path for m in motions] + [np.zeros((1, 3))]
    for motion in motions:
        every = max(1, len(motion.postures) * len(motions) // MAX_POSTURES_FOR_BOUNDS)
        for q in motion.postures[::every]:
            pin.forwardKinematics(model, data, robot.pinocchio_configuration(q))
            points += [_moved(pose.homogeneous, local) for pose, local in zip(data.oMi, corners, strict=True)]
    return np.concatenate(points)


def _corners(looks: Appearance, joint: int) -> Float[np.ndarray, "C 3"]:
    """Return the corners of the boxes around a joint's shapes, and its origin, in the joint's frame [m]."""
    points = [np.zeros((1, 3))]
    for shape in (s for s in looks.shapes if s.joint == joint):
        half = shape.half_extent()
        ends = np.array([-half, half]) if shape.mesh is None else looks.meshes[shape.mesh].vertices
        points.append(_moved(shape.pose, 0.5 * (ends.min(axis=0) + ends.max(axis=0)) + CORNERS * np.ptp(ends, axis=0)))
    return np.concatenate(points)


def _moved(pose: Float[np.ndarray, "4 4"], points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    return points @ pose[:3, :3].T + pose[:3, 3]


def _azimuth(motions: Sequence[RecordedMotion]) -> float:
    """Return the direction of the camera [rad]: beside the arm, 62 degrees from the middle of the path."""
    x, y, _ = np.concatenate([m.path for m in motions]).mean(axis=0)
    return float(np.arctan2(y, x) - np.deg2rad(62.0)) if np.hypot(x, y) > 1e-6 else float(np.deg2rad(-50.0))
