"""Whether the demonstrations moved the arm enough to learn from."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from manip_learn.errors import NotIdentifiableError, RecordingError
from manip_learn.learning.samples import Samples

OUTLIER_FACTOR = 1e4
STILL_SHARE = 1e-6
# fewer joints than this moving at a time, in the mean, is how a hand-guided arm with stiction moves
FEW_JOINTS = 1.6


def excitation(samples: Samples) -> Float[np.ndarray, " nv"]:
    """Share of the motion's energy in each joint; sums to 1."""
    energy = np.mean(samples.u**2, axis=0)
    return energy / max(float(energy.sum()), np.finfo(np.float64).tiny)


def check_samples(samples: Samples, joint_names: Sequence[str], n_constraints: int | None) -> list[str]:
    """Refuse what no estimator can learn from; warnings for what is doubtful.

    Raises:
        NotIdentifiableError: Nothing moves, or too few different samples.
        RecordingError: A velocity is far out of line with all others.
    """
    speed = np.linalg.norm(samples.u, axis=1)
    if not np.any(speed > 0.0):
        raise NotIdentifiableError("nothing moves in these demonstrations: all velocities are zero", code="no-motion")
    median = float(np.median(speed[speed > 0.0]))
    if float(speed.max()) > OUTLIER_FACTOR * median:
        i = int(np.argmax(speed))
        joint = int(np.argmax(np.abs(samples.u[i])))
        raise RecordingError(
            f"sample {i} (trajectory {samples.group[i]}) moves at {samples.u[i, joint]:.3g} in joint "
            f"{joint_names[joint]!r}, {speed[i] / median:.1e} times the median speed: remove the outlier",
            code="outlier",
        )
    r = samples.n_rows
    s = n_constraints or 1
    needed = max(r + 2, s * (r - s) + 2, 5)
    different = len(np.unique(np.concatenate([samples.q, samples.u], axis=1)[speed > 1e-9 * median], axis=0))
    if different < needed:
        raise NotIdentifiableError(
            f"{different} different moving sample(s) cannot determine a constraint on {r} rows: at least {needed} are "
            "needed, and many more are better",
            code="too-few-samples",
        )
    return _doubts(samples, joint_names)


def _doubts(samples: Samples, joint_names: Sequence[str]) -> list[str]:
    warnings = []
    share = excitation(samples)
    still = [name for name, part in zip(joint_names, share, strict=True) if part < STILL_SHARE]
    if still and len(still) < samples.nv:
        warnings.append(
            f"joint(s) {', '.join(still)} hardly moved: what the arm did not try cannot be told from what it could "
            "not do"
        )
    squares = samples.u**2
    norm = squares.sum(axis=1)
    moving = norm > 1e-4 * np.mean(norm)
    # participation number: 1 if a single joint moves, nv if all move equally
    together = float(np.mean(norm[moving] ** 2 / np.sum(squares[moving] ** 2, axis=1)))
    if samples.nv > 3 and together < FEW_JOINTS:
        warnings.append(
            f"only {together:.1f} joints move at a time on average: friction of a hand-guided arm looks like a "
            "constraint; move all joints together"
        )
    if samples.n_groups < 5:
        count = "one trajectory" if samples.n_groups == 1 else f"{samples.n_groups} trajectories"
        warnings.append(f"only {count}: evidence from so few is thin; record 5 or more")
    return warnings
