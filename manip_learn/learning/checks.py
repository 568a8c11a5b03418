"""Refusal of recordings and samples from which nothing can be learnt."""

from __future__ import annotations

import numpy as np

from manip_learn.constraint.features.feature_map import FeatureMap
from manip_learn.constraint.features.frame_jacobian import FrameJacobian
from manip_learn.errors import NotIdentifiableError, RecordingError, advice, counted, named
from manip_learn.learning.table import Table
from manip_learn.recordings.clock import MOVED
from manip_learn.recordings.trajectory import Demonstrations
from manip_learn.recordings.velocities import FEWEST_JUDGED, position_noise
from manip_learn.robot.tips import likely_tips

# ratio to the usual speed, or distance from the middle, beyond which a sample is a fault of the recording. Set by hand
OUTLIER_FACTOR = 1e4
# [rad/s or m/s] of the fastest joint, below which it is at rest: encoder noise of 1e-4 rad at 100 Hz looks like 0.014
REST_SPEED = 0.02
SHOWN = 1e-3  # [rad or m] that some joint moves in any motion shown by hand: half a millimetre at the tip
# standard deviations between the least and the largest of a million numbers by chance, and some more
BEYOND_NOISE = 12.0
# postures closer together than this share of their size are one and the same, and less of it in a second is no motion
_SAME = 1e-9


def check_fastest(demonstrations: Demonstrations) -> None:
    """Refuse a velocity that is far out of line with all others.

    Raises:
        RecordingError: There is one.
    """
    u = np.concatenate([np.asarray(t.u) for t in demonstrations])
    speed = np.linalg.norm(u, axis=1)
    if not np.any(moving := speed > _SAME):  # slopes of a rest without noise are what rounding leaves
        return
    sample = int(np.argmax(speed))
    ratio = float(speed[sample]) / float(np.median(speed[moving]))
    if ratio > OUTLIER_FACTOR:
        number = np.searchsorted(np.cumsum([len(t) for t in demonstrations]), sample, side="right")
        joint = int(np.argmax(np.abs(u[sample])))
        moves = f"moves at {u[sample, joint]:.3g} in joint {demonstrations.joint_names[joint]!r}, {ratio:.1e} times"
        text = f"sample {sample} (trajectory {number}) {moves} the median speed: remove the outlier"
        raise RecordingError(text, code="outlier")


def refuse_noise(recorded: Demonstrations) -> None:
    """Refuse recordings in which no joint moves beyond the noise of its encoder, or as far as in any demonstration.

    Raises:
        NotIdentifiableError: In none of them.
    """
    found = []
    for t in recorded:
        if len(t) < FEWEST_JUDGED:
            return
        moved, noise = np.ptp(t.q, axis=0), np.sqrt(position_noise(t.time, t.q))
        j = int(np.argmax(moved / noise))
        if moved[j] >= BEYOND_NOISE * noise[j] and np.max(moved) >= SHOWN:
            return
        joint = t.joint_names[j] if len(t.joint_names) == t.q.shape[1] else f"column {j}"
        said = f"{joint} in {t.name}, by {moved[j]:.2g} where its noise is {noise[j]:.2g} (standard deviation)"
        found.append((moved[j] / noise[j], said))
    text = f"no joint moves farther than the noise of its positions does, and {SHOWN:g} rad or m: the farthest is "
    raise NotIdentifiableError(f"{text}{max(found)[1]}: record a motion", code="no-motion")


def refuse_still_hand(features: FeatureMap, demonstrations: Demonstrations) -> None:
    """Refuse motions of joints that do not move the frame.

    Raises:
        NotIdentifiableError: Code `still-hand`; says which hand moved.
    """
    if not isinstance(features, FrameJacobian) or any(t.q.shape[1] != features.nv for t in demonstrations):
        return
    robot, frame = features.robot, features.frame.name
    span = np.max([np.ptp(t.q, axis=0) for t in demonstrations], axis=0)
    moved = [joint for joint, s in zip(robot.joint_names, span, strict=True) if s > MOVED]
    own = np.array([robot.moves(joint, frame) for joint in robot.joint_names])
    if not moved or not own.any() or np.any(span[own] > MOVED):
        return
    hand = next((tip for tip in likely_tips(robot) if any(robot.moves(joint, tip) for joint in moved)), "")
    which = f", which move {hand!r}{advice(': name it with {}', f'frame={hand!r}', f'--frame {hand}')}" if hand else ""
    least = f"its joints changed by {np.max(span[own]):.2g} (rad or m) at most in a recording, {MOVED:g} is a motion"
    text = f"{frame!r} stood still: {least}; what moved is {named('joint', moved)}{which}"
    raise NotIdentifiableError(text, code="still-hand")


def unusable(table: Table, r: int, n_constraints: int | None) -> NotIdentifiableError | RecordingError | None:
    """Return why nothing can be learnt of r independent rows from these samples; None if something can.

    Args:
        table: The samples.
        r: Number of independent rows of the features.
        n_constraints: Number of rows to learn, if it was asked for.
    """
    if table.u.shape[1] < 2:
        return NotIdentifiableError("a constraint leaves no null space for a single joint", code="no-freedom")
    speed = np.linalg.norm(table.u, axis=1)
    if not np.any(moving := speed > _SAME):
        return NotIdentifiableError("nothing moves in these demonstrations: all velocities are zero", code="no-motion")
    middle = np.median(table.q, axis=0)
    distance = np.linalg.norm(table.q - middle, axis=1)
    farthest = int(np.argmax(distance))
    if distance[farthest] <= _SAME * (1.0 + float(np.linalg.norm(middle))):
        text = "the posture never changes though the velocities are not zero: give each sample its own posture"
        return NotIdentifiableError(text, code="constant-posture")
    # standing still at the median posture for long is no reason to call all motion far out
    usual = float(np.quantile(distance, 0.9)) or float(np.mean(np.delete(distance, farthest)))
    if 0.0 < usual * OUTLIER_FACTOR < distance[farthest]:
        where = f"the posture of sample {farthest} (trajectory {table.recording[farthest]})"
        ratio = f"{distance[farthest] / usual:.1e} times farther out"
        return RecordingError(f"{where} is {ratio} than nearly all others: remove the outlier", code="outlier")
    s = n_constraints or 1
    needed = max(r + 2, s * (r - s) + 2, 5)
    samples = np.concatenate([table.q, table.u], axis=1)[speed > _SAME * float(np.median(speed[moving]))]
    if (different := len(np.unique(samples, axis=0))) >= needed:
        return None
    few = f"{counted(different, 'different moving sample')} cannot determine a constraint on {counted(r, 'row')}"
    return NotIdentifiableError(f"record more: {few}, {needed} can and many more are better", code="too-few-samples")
