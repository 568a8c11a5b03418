"""Whether recorded positions of the tool agree with joints whose order the caller stated; another order that does."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations

import numpy as np
from jaxtyping import Float

from manip_learn.errors import advice
from manip_learn.recordings.options import rename_words
from manip_learn.recordings.table import Note, note
from manip_learn.recordings.trajectory import evenly
from manip_learn.robot.robot import Robot

SAMPLES = 40  # that are compared: more change nothing
ROUNDS = 60  # of the two fits in turn; each is exact, and the error falls slowly in the end
CLEAR = 5.0  # times the error of another order: noise and an arm that is not quite the description do not do so
BAD = 5e-3  # [m] rms, below which the stated order is not doubted


def order_notes(
    robot: Robot,
    q: Float[np.ndarray, "T nv"],
    tool: Float[np.ndarray, "T 3"],
    order: Sequence[str],
    columns: Sequence[str] = (),
) -> list[Note]:
    """Return a remark if the tool was recorded where another order of the joints puts it.

    Of other orders those are tried that people meet: sorted by name, as ROS drivers publish them, and two exchanged.

    Args:
        robot: The robot.
        q: Positions of its joints, by the stated order [rad or m].
        tool: Positions of the tool, in any unit and axes.
        order: Names of the joints as stated, without what is not read.
        columns: Names of their columns in the file, where they have some.
    """
    frame = next((f for f in robot.frame_names[::-1] if all(robot.moves(j, f) for j in robot.joint_names)), None)
    finite = np.flatnonzero(np.all(np.isfinite(tool), axis=1))
    if frame is None or len(finite) < SAMPLES or len(order) != robot.nv:
        return []
    some, n = finite[evenly(len(finite), SAMPLES)], robot.nv
    swaps = [[b if k == a else a if k == b else k for k in range(n)] for a, b in combinations(range(n), 2)]
    stated = [robot.joint_names.index(name) for name in order]  # column of the file -> joint
    as_read = q[some][:, stated]

    def error(names: list[str]) -> float:
        postures = as_read[:, [names.index(j) for j in robot.joint_names]]
        return _error(np.array([robot.pose(x, frame) for x in postures]), tool[some])

    if (own := error(list(order))) < BAD:
        return []
    orders = [sorted(order), *([order[k] for k in swap] for swap in swaps)]
    errors = list(map(error, orders))
    names, other = orders[int(np.argmin(errors))], min(errors)
    if own < CLEAR * other:
        return []
    words = (f"joint_names={names}", f"--joint-names {','.join(names)}")
    how = advice(": pass {}", *(rename_words(dict(zip(columns, names, strict=True))) if columns else words))
    return [note("joint-order", stated=1e3 * own, other=1e3 * other, how=how)]


def _error(poses: Float[np.ndarray, "n 4 4"], tool: Float[np.ndarray, "n 3"]) -> float:
    """Return the rms distance [m] of a point of a frame from the positions, after the axes, the unit and the place of
    the point were fitted in turn (Umeyama 1991; least squares).
    """
    turns, origins, point = poses[:, :3, :3], poses[:, :3, 3], np.zeros(3)
    measured = tool - tool.mean(axis=0)
    for _ in range(ROUNDS):
        at = origins + turns @ point
        u, s, vt = np.linalg.svd((at - at.mean(axis=0)).T @ measured)
        flip = np.diag([1.0, 1.0, np.linalg.det(u @ vt)])
        scale = np.sum(s * np.diag(flip)) / max(float(np.sum(measured**2)), 1e-300)
        fitted = at.mean(axis=0) + scale * measured @ (u @ flip @ vt).T
        # the point and the shift between the two together: one alone creeps
        left = np.concatenate([np.hstack([turn, -np.eye(3)]) for turn in turns])
        wanted = (fitted - origins).ravel()
        found = np.linalg.lstsq(left, wanted, rcond=1e-9)[0]
        point = found[:3]
    return float(np.sqrt(np.sum((left @ found - wanted) ** 2) / len(poses)))
