"""Whether the recorded postures make sense beside the recorded velocities."""

from __future__ import annotations

import numpy as np

from manip_learn.errors import NotIdentifiableError, RecordingError
from manip_learn.learning.samples import Samples

# how much farther out than nearly all others a posture may lie, in their own distances from the middle
FAR_OUT = 1e4
# postures closer together than this share of their size are one and the same
SAME = 1e-9


def check_postures(samples: Samples) -> None:
    """Refuse recordings whose postures cannot belong to their velocities.

    Raises:
        NotIdentifiableError: The posture never changes, or there is a single joint.
        RecordingError: A posture is far out of line with all others.
    """
    if samples.nv < 2:
        raise NotIdentifiableError(
            "a constraint leaves a single joint no freedom: there is nothing to learn from", code="no-freedom"
        )
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
    if 0.0 < usual * FAR_OUT < distance[farthest]:
        raise RecordingError(
            f"the posture of sample {farthest} (trajectory {samples.group[farthest]}) is "
            f"{distance[farthest] / usual:.1e} times farther out than nearly all others: remove the outlier",
            code="outlier",
        )
