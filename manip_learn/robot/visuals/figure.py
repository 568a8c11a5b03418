"""The figure that stands in for a robot without shapes: how thick its tubes are, and where the last ones end."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
from jaxtyping import Float

TUBE_RADIUS = 0.032  # share of the reach
TAPER = 0.55  # radius at the last joint, share of that at the base
TUBE = 0.8  # thickness of the tubes, share of those radii
SHORTEST = 0.2  # length from which there is a tube, share of those radii


def link_ends(model: pin.Model) -> dict[int, Float[np.ndarray, "E 3"]]:
    """For joints that carry no other joint: the farthest fixed link on each [m], in the joint's frame."""
    inner = set(model.parents[1:])
    ends: dict[int, np.ndarray] = {}
    for i in range(1, model.njoints):
        points = [f.placement.translation for f in model.frames if f.parentJoint == i and f.type == pin.FrameType.BODY]
        if i not in inner and points:
            ends[i] = np.array([max(points, key=lambda p: float(np.linalg.norm(p)))])
    return ends


def link_radii(model: pin.Model) -> Float[np.ndarray, " J"]:
    """Radius of the figure at each joint [m]: in proportion to the robot, slimmer towards the tip."""
    depth, reach = np.zeros(model.njoints), np.zeros(model.njoints)  # joints, and length of the path, from the base
    for i in range(1, model.njoints):
        depth[i] = depth[model.parents[i]] + 1
        reach[i] = reach[model.parents[i]] + float(np.linalg.norm(model.jointPlacements[i].translation))
    tips = [reach[i] + float(np.linalg.norm(p, axis=1).max()) for i, p in link_ends(model).items()]
    scale = max([float(reach.max()), *tips, 1e-3])
    return TUBE_RADIUS * scale * (1.0 - (1.0 - TAPER) * depth / max(int(depth.max()), 1))
