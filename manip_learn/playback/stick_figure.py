"""A plain figure for robots without usable shapes: tubes from joint to joint, discs at the joints."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from manip_learn.playback.kinematic_tree import TreeJoint
from manip_learn.playback.shapes import PLAIN, Colour, Shape

DARK: Colour = (0.27, 0.31, 0.36, 1.0)
TUBE_RADIUS = 0.032  # share of the reach
ROD = 0.8  # share of the slimmest shape's half width
TAPER = 0.55  # radius at the last joint, share of that at the base


def stick_figure(
    tree: tuple[TreeJoint, ...], ends: dict[int, Float[np.ndarray, "E 3"]], only: set[int] | None = None
) -> tuple[Shape, ...]:
    """Shapes made from the kinematics alone.

    Args:
        tree: The joints.
        ends: Points that the last links reach to, in the frame of the joint that carries them [m].
        only: Joints whose shapes are made; None for all.
    """
    radius = _radii(tree, ends)
    shapes: list[Shape] = []
    for i, joint in enumerate(tree):
        if only is not None and i not in only:
            continue
        shapes.append(_pedestal(float(radius[0])) if i == 0 else _hub(i, joint, float(radius[i])))
        for child in (c for c in range(1, len(tree)) if tree[c].parent == i):
            shapes += _tube(i, tree[child].placement[:3, 3], float(radius[i]), float(radius[child]))
        for point in ends.get(i, np.zeros((0, 3))):
            shapes += _tube(i, point, float(radius[i]), 0.7 * float(radius[i]))
            shapes.append(Shape(i, "sphere", (0.95 * float(radius[i]),), _at(point), DARK))
    return tuple(shapes)


def rods(
    tree: tuple[TreeJoint, ...], ends: dict[int, Float[np.ndarray, "E 3"]], shapes: Sequence[Shape]
) -> tuple[Shape, ...]:
    """Slim rods from joint to joint and to the ends, hidden where the shapes of a joint enclose them.

    Args:
        tree: The joints.
        ends: As for `stick_figure`.
        shapes: What the rods connect; a rod is slimmer than the slimmest shape on its joint.
    """
    radius = _radii(tree, ends)
    made: list[Shape] = []
    for i in range(len(tree)):
        slim = min([float(radius[i]), *(ROD * float(s.half_extent().min()) for s in shapes if s.joint == i)])
        targets = [tree[c].placement[:3, 3] for c in range(1, len(tree)) if tree[c].parent == i]
        for point in [*targets, *ends.get(i, np.zeros((0, 3)))]:
            made += _tube(i, point, slim, slim, DARK)
    return tuple(made)


def _radii(tree: tuple[TreeJoint, ...], ends: dict[int, Float[np.ndarray, "E 3"]]) -> Float[np.ndarray, " J"]:
    """Radius of the tube that starts at each joint [m]: in proportion to the robot, slimmer towards the tip."""
    depth = _depths(tree)
    reach = np.array([_distance(tree, i) for i in range(len(tree))])
    tips = [reach[i] + float(np.linalg.norm(p, axis=1).max()) for i, p in ends.items() if len(p)]
    scale = max([float(reach.max()), *tips, 1e-3])
    return TUBE_RADIUS * scale * (1.0 - (1.0 - TAPER) * depth / max(int(depth.max()), 1))


def _depths(tree: tuple[TreeJoint, ...]) -> np.ndarray:
    depth = np.zeros(len(tree))
    for i in range(1, len(tree)):
        depth[i] = depth[tree[i].parent] + 1
    return depth


def _distance(tree: tuple[TreeJoint, ...], i: int) -> float:
    """Length of the path from the base to a joint [m]."""
    length = 0.0
    while i > 0:
        length += float(np.linalg.norm(tree[i].placement[:3, 3]))
        i = tree[i].parent
    return length


def _at(point: np.ndarray, rotation: np.ndarray | None = None) -> np.ndarray:
    pose = np.eye(4)
    pose[:3, 3] = point
    if rotation is not None:
        pose[:3, :3] = rotation
    return pose


def z_to(direction: Float[np.ndarray, " 3"]) -> Float[np.ndarray, "3 3"]:
    """A rotation that takes the z axis to a unit vector."""
    helper = np.eye(3)[int(np.argmin(np.abs(direction)))]
    x = np.cross(helper, direction)
    x /= np.linalg.norm(x)
    return np.column_stack([x, np.cross(direction, x), direction])


def _pedestal(radius: float) -> Shape:
    return Shape(0, "disc", (2.1 * radius, 0.9 * radius), np.eye(4), DARK)


def _hub(i: int, joint: TreeJoint, radius: float) -> Shape:
    if joint.motion == "revolute":
        return Shape(i, "disc", (1.3 * radius, 2.5 * radius), _at(np.zeros(3), z_to(joint.axis)), DARK, accent=True)
    if joint.motion == "prismatic":
        size = (2.1 * radius, 2.1 * radius, 2.6 * radius)
        return Shape(i, "box", size, _at(np.zeros(3), z_to(joint.axis)), DARK, accent=True)
    return Shape(i, "sphere", (1.3 * radius,), np.eye(4), DARK, accent=True)


def _tube(i: int, end: np.ndarray, bottom: float, top: float, colour: Colour = PLAIN) -> list[Shape]:
    length = float(np.linalg.norm(end))
    if length < 0.2 * bottom:
        return []
    pose = _at(end / 2.0, z_to(end / length))
    return [Shape(i, "cone", (0.8 * bottom, 0.8 * top, length), pose, colour)]
