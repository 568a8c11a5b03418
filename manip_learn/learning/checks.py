"""Recordings and samples that nothing can be learnt from are refused; what is doubtful is said."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from manip_learn.constraint.features.feature_map import FeatureMap
from manip_learn.constraint.features.frame_jacobian import FrameJacobian
from manip_learn.errors import NotIdentifiableError, RecordingError, advice, counted, named
from manip_learn.learning.samples import STILL_ENERGY, Samples
from manip_learn.recordings.clock import MOVED
from manip_learn.recordings.trajectory import Demonstrations
from manip_learn.recordings.velocities import FEWEST_JUDGED, position_noise
from manip_learn.robot.tips import likely_tips

# ratio to the usual speed, or distance from the middle, beyond which a sample is a fault of the recording. Set by hand
OUTLIER_FACTOR = 1e4
# [joints] fewer than this that move at a time, in the mean, is how a hand-guided arm with stiction moves. Set by hand
FEW_JOINTS_AT_ONCE = 1.6
# [rad/s or m/s] of the fastest joint, below which it is at rest: encoder noise of 1e-4 rad at 100 Hz looks like 0.014
REST_SPEED = 0.02
# standard deviations between the least and the largest of a million numbers by chance, and some more
SHOWN = 1e-3  # [rad or m] that some joint moves in any motion shown by hand: half a millimetre at the tip
BEYOND_NOISE = 12.0
# postures closer together than this share of their size are one and the same, and less of it in a second is no motion
_SAME = 1e-9


def energy_shares(energy: Float[np.ndarray, " nv"]) -> Float[np.ndarray, " nv"]:
    """Share of each joint in the sum; sums to 1."""
    return energy / max(float(energy.sum()), np.finfo(np.float64).tiny)


def check_fastest(demonstrations: Demonstrations) -> None:
    """Refuse a velocity that is far out of line with all others.

    Raises:
        RecordingError: There is one.
    """
    u = np.concatenate([np.asarray(t.u) for t in demonstrations])
    speed = np.linalg.norm(u, axis=1)
    if not np.any(moving := speed > _SAME):  # slopes of a rest without noise are what rounding leaves
        return
    sample = int(np.argmax(np.einsum("nv,nv->n", u, u)))
    ratio = float(speed[sample]) / float(np.median(speed[moving]))
    if ratio > OUTLIER_FACTOR:
        joint, last = int(np.argmax(np.abs(u[sample]))), np.cumsum([len(t) for t in demonstrations])
        raise RecordingError(
            f"sample {sample} (trajectory {np.searchsorted(last, sample, side='right')}) moves at "
            f"{u[sample, joint]:.3g} in joint "
            f"{demonstrations.joint_names[joint]!r}, {ratio:.1e} times the median speed: remove the outlier",
            code="outlier",
        )


def refuse_noise(recorded: Demonstrations) -> None:
    """Refuse recordings in which no joint moves farther than its encoder's noise does, and than anyone shows by hand.

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
        joint = t.joint_names[j] if t.joint_names else str(j)
        found.append((moved[j] / noise[j], joint, t.name, moved[j], noise[j]))
    _, joint, name, moved, noise = max(found)
    raise NotIdentifiableError(
        f"no joint moves farther than the noise of its positions does, and {SHOWN:g} rad or m: the farthest is "
        f"{joint} in {name}, by {moved:.2g} where its noise is {noise:.2g} (standard deviation): record a motion",
        code="no-motion",
    )


def check_samples(samples: Samples, joint_names: Sequence[str], n_constraints: int | None) -> list[str]:
    """Refuse what no estimator can learn from; warnings for what is doubtful.

    Raises:
        NotIdentifiableError: Nothing moves, the posture never changes, or too few different samples.
        RecordingError: A posture is far out of line with all others.
    """
    speed = np.linalg.norm(samples.u, axis=1)
    if not np.any(moving := speed > _SAME):
        raise NotIdentifiableError("nothing moves in these demonstrations: all velocities are zero", code="no-motion")
    check_postures(samples)
    median = float(np.median(speed[moving]))
    r = samples.n_rows
    s = n_constraints or 1
    needed = max(r + 2, s * (r - s) + 2, 5)
    moving = np.concatenate([samples.q, samples.u], axis=1)[speed > 1e-9 * median]
    # an even choice is soon counted
    few = moving[:: max(1, len(moving) // (10 * needed))]
    if len(np.unique(few, axis=0)) < needed and (different := len(np.unique(moving, axis=0))) < needed:
        raise NotIdentifiableError(
            f"record more: {counted(different, 'different moving sample')} cannot determine a constraint on "
            f"{counted(r, 'row')}, {needed} can and many more are better",
            code="too-few-samples",
        )
    warnings = []
    squares = samples.u**2
    shares = energy_shares(squares.mean(axis=0))
    still = [name for name, part in zip(joint_names, shares, strict=True) if part < STILL_ENERGY]
    if still and len(still) < samples.nv:
        warnings.append(
            f"{named('joint', still)} hardly moved: what the arm did not try cannot be told from what it could not do"
        )
    norm = squares.sum(axis=1)
    moving = norm > 1e-4 * np.mean(norm)
    # participation number: 1 if a single joint moves, nv if all move equally
    together = float(np.mean(norm[moving] ** 2 / np.sum(squares[moving] ** 2, axis=1)))
    if samples.nv > 3 and together < FEW_JOINTS_AT_ONCE:
        warnings.append(
            f"only {together:.1f} joints move at a time on average: friction of a hand-guided arm looks like a "
            "constraint; move all joints together"
        )
    return warnings


def check_postures(samples: Samples) -> None:
    """Refuse recordings whose postures cannot belong to their velocities.

    Raises:
        NotIdentifiableError: The posture never changes, or there is a single joint.
        RecordingError: A posture is far out of line with all others.
    """
    if samples.nv < 2:
        raise NotIdentifiableError("a constraint leaves no null space for a single joint", code="no-freedom")
    middle = np.median(samples.q, axis=0)
    distance = np.linalg.norm(samples.q - middle, axis=1)
    farthest = int(np.argmax(distance))
    if distance[farthest] <= _SAME * (1.0 + float(np.linalg.norm(middle))):
        raise NotIdentifiableError(
            "the posture never changes although the velocities are not zero: give each sample the posture that it was "
            "recorded at",
            code="constant-posture",
        )
    # standing still at the median posture for long is no reason to call all motion far out
    usual = float(np.quantile(distance, 0.9)) or float(np.mean(np.delete(distance, farthest)))
    if 0.0 < usual * OUTLIER_FACTOR < distance[farthest]:
        raise RecordingError(
            f"the posture of sample {farthest} (trajectory {samples.trajectory[farthest]}) is "
            f"{distance[farthest] / usual:.1e} times farther out than nearly all others: remove the outlier",
            code="outlier",
        )


def refuse_still_hand(features: FeatureMap, demonstrations: Demonstrations) -> None:
    """Refuse motions of joints none of which moves the frame.

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
    hands = [tip for tip in likely_tips(robot) if any(robot.moves(joint, tip) for joint in moved)]
    which = f", which move {hands[0]!r}{advice(': name it with {}', f'frame={hands[0]!r}', f'--frame {hands[0]}')}"
    raise NotIdentifiableError(
        f"{frame!r} stood still: its joints changed by {np.max(span[own]):.2g} (rad or m) at most in a recording, "
        f"{MOVED:g} is a motion; what moved is {named('joint', moved)}{which if hands else ''}",
        code="still-hand",
    )
