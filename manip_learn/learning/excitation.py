"""Whether the demonstrations moved the arm enough to learn from, and as fast as they say."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from manip_learn.errors import NotIdentifiableError, RecordingError, advice, counted, listed, named
from manip_learn.learning.deciding import (
    FEW_JOINTS_AT_ONCE,
    OUTLIER_FACTOR,
    STILL_ENERGY,
    VELOCITY_CORRELATION,
    VELOCITY_SLOPE,
)
from manip_learn.learning.samples import DataSummary, Samples
from manip_learn.recordings.trajectory import Trajectory
from manip_learn.recordings.validation.motion_checks import FEWEST, compare_velocities

# postures closer together than this share of their size are one and the same
SAME = 1e-9


def energy_shares(energy: Float[np.ndarray, " nv"]) -> Float[np.ndarray, " nv"]:
    """Share of each joint in the sum; sums to 1."""
    return energy / max(float(energy.sum()), np.finfo(np.float64).tiny)


def check_fastest(data: DataSummary, joint_names: Sequence[str]) -> None:
    """Refuse a velocity that is far out of line with all others.

    Args:
        data: Of all samples; those to learn from say what is usual.
        joint_names: For the message.

    Raises:
        RecordingError: There is one.
    """
    speed = np.linalg.norm(data.u, axis=1)
    fastest, (sample, trajectory) = data.fastest, data.fastest_at
    if not np.any(speed > 0.0):
        return
    ratio = float(np.linalg.norm(fastest)) / float(np.median(speed[speed > 0.0]))
    if ratio > OUTLIER_FACTOR:
        joint = int(np.argmax(np.abs(fastest)))
        raise RecordingError(
            f"sample {sample} (trajectory {trajectory}) moves at {fastest[joint]:.3g} in joint {joint_names[joint]!r}, "
            f"{ratio:.1e} times the median speed: remove the outlier",
            code="outlier",
        )


def check_samples(samples: Samples, joint_names: Sequence[str], n_constraints: int | None) -> list[str]:
    """Refuse what no estimator can learn from; warnings for what is doubtful.

    Raises:
        NotIdentifiableError: Nothing moves, the posture never changes, or too few different samples.
        RecordingError: A posture is far out of line with all others.
    """
    speed = np.linalg.norm(samples.u, axis=1)
    if not np.any(speed > 0.0):
        raise NotIdentifiableError("nothing moves in these demonstrations: all velocities are zero", code="no-motion")
    check_postures(samples)
    median = float(np.median(speed[speed > 0.0]))
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
    return _warn(samples, joint_names)


def _warn(samples: Samples, joint_names: Sequence[str]) -> list[str]:
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
    if samples.n_trajectories < 5:
        count = "one trajectory" if samples.n_trajectories == 1 else f"{samples.n_trajectories} trajectories"
        warnings.append(f"only {count}: evidence from so few is thin; record 5 or more")
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
    if distance[farthest] <= SAME * (1.0 + float(np.linalg.norm(middle))):
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


def doubt_velocities(trajectories: Sequence[Trajectory], joint_names: Sequence[str]) -> list[str]:
    """A warning that names the joints whose recorded velocities have another scale than their positions.

    The displacement dq over a short window is compared with the velocity integrated over it, du, in each recording; the
    median over the recordings counts. Noise on either makes the slope of one upon the other too small, never too large,
    and so do delays and filters: for a first-order filter the slope of dq upon du is 1 at every frequency. A joint is
    named if the slope that is too large is so by more than 5 %. A factor that all joints share turns no row and is not
    named.

    Args:
        trajectories: As they were recorded; those without velocities say nothing.
        joint_names: One per velocity.
    """
    matches = [
        compare_velocities(t.time, t.q, t.u)
        for t in trajectories
        if t.u is not None and t.q.shape == t.u.shape and len(t) >= FEWEST
    ]
    if not matches:
        return []
    correlation, slope = np.array([np.diag(m.correlation) for m in matches]), np.array([m.slope for m in matches])
    moved = np.array([m.moved for m in matches])
    follows = moved & (correlation > VELOCITY_CORRELATION)
    shares: dict[int, float] = {}
    off: list[int] = []
    for j in np.flatnonzero(2 * follows.sum(axis=0) > moved.sum(axis=0)).tolist():
        r, c = slope[follows[:, j], j], correlation[follows[:, j], j]
        shares[j] = 1.0 / float(np.median(r))
        off += [j] if max(np.median(r * c), np.median(c / r)) > VELOCITY_SLOPE else []
    if not off or (len(shares) > 1 and max(shares.values()) < VELOCITY_SLOPE * min(shares.values())):
        return []
    factors = listed(f"{shares[j]:.3g}" for j in off)
    return [
        f"the recorded velocities of {named('joint', (joint_names[j] for j in off))} are {factors} times what the "
        "positions say, though they follow them closely, which turns what is learnt: correct their scale, or leave all "
        "recorded velocities out, to have them derived from the positions"
        + advice(" ({})", "dataclasses.replace(t, u=None)", "--ignore-column for each velocity column")
    ]
