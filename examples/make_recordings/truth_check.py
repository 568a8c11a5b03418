"""How far recorded poses of the tip are from what the truth says; written from the truth alone."""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from manip_learn.robot import Robot


def windows_of(
    robot: Robot, truth: dict[str, Any], number: int, time: Float[np.ndarray, " T"], q: Float[np.ndarray, "T nv"]
) -> list[tuple[dict[str, Any], Float[np.ndarray, "n 4 4"]]]:
    """The mechanism and the poses of the held point in each window of demonstration `number`."""
    tip = robot.frame(truth["tip"])
    found = []
    for start, end, index in truth["windows"][number]:
        inside = (time > start - 1e-6) & (time < end + 1e-6)
        poses = np.array([robot.pose(row, tip) for row in q[inside]])
        poses[:, :3, 3] += poses[:, :3, :3] @ np.array(truth["offsets"][number])
        found.append((truth["mechanisms"][index], poses))
    return found


def violation(mechanism: dict[str, Any], poses: Float[np.ndarray, "n 4 4"]) -> tuple[float, float]:
    """Root mean square of what ought to be zero in one window: of the place [m] and of the rotation [rad]."""
    place, turns = poses[:, :3, 3], poses[:, :3, :3] @ poses[0, :3, :3].T
    axis = np.array(mechanism["axis"] or [0.0, 0.0, 1.0])
    firm = mechanism["held"] == "firm"
    across = np.eye(3) - np.outer(axis, axis)
    turned = Rotation.from_matrix(turns).as_rotvec()
    match mechanism["type"]:
        case "slide":
            return _rms(_centred(place) @ across), _rms(turned) if firm else 0.0
        case "plane":
            return _rms(_centred(place) @ axis), _rms(_centred(turned @ across)) if firm else 0.0
        case "upright":
            return 0.0, _rms((turns @ (poses[0, :3, :3] @ _in_hand(poses, axis)) - axis) @ across)
    arm = place - np.array(mechanism["point"])
    if mechanism["type"] == "ball":
        if firm:
            return _rms(_centred(np.einsum("nji,nj->ni", turns, arm))), 0.0
        return _rms(np.linalg.norm(arm, axis=1) - mechanism["radius"]), 0.0
    along = (arm - arm.mean(axis=0)) @ axis
    if not firm:
        radius = np.linalg.norm(arm @ across, axis=1)
        return _rms(np.column_stack([along, _centred(radius)])), 0.0
    carried = np.einsum("nji,nj->ni", turns, arm @ across) @ across
    linear = [_centred(carried)]
    if mechanism["type"] != "sleeve":
        linear.append(_centred(along - (mechanism["pitch"] or 0.0) * (turned @ axis))[:, None])
    return _rms(np.hstack(linear)), _rms(turned @ across)


def _in_hand(poses: np.ndarray, axis: np.ndarray) -> np.ndarray:
    """The hand's own axis that points up on average."""
    mean = np.mean(poses[:, :3, :3].transpose(0, 2, 1) @ axis, axis=0)
    return mean / np.linalg.norm(mean)


def _centred(rows: np.ndarray) -> np.ndarray:
    return rows - rows.mean(axis=0)


def _rms(rows: np.ndarray) -> float:
    """Root mean square length of the rows."""
    return float(np.sqrt(np.mean(np.sum(np.atleast_2d(rows.T).T ** 2, axis=-1))))
