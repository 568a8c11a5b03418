"""What the phase search answers: stretches of recordings, and the constraints that hold in them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import final

import numpy as np
from jaxtyping import Float


@final
@dataclass(frozen=True)
class Stretch:
    """A part of a recording.

    Attributes:
        trajectory: Number of the trajectory, counted from 0.
        start, end: On the recording's own clock [s].
    """

    trajectory: int
    start: float
    end: float

    @property
    def duration(self) -> float:
        """From start to end [s]."""
        return self.end - self.start


@final
@dataclass(frozen=True, eq=False)
class PhaseConstraint:
    """A constraint that holds in some stretches.

    Attributes:
        selection: Lambda in the features' own basis, orthonormal rows, shape (s, p).
        stretches: Where it holds, in the order of the recordings.
        features: Number of the feature map, counted from 0.
        softness: Ratio of velocities along the held rows to those along free ones, noise apart.
        support: Evidence from the trajectories beside its best supporter [nats].
        needed: Support that it must have, for the same search finds almost as much by chance [nats].
        strength: Of the confirmation: how much more recombined joints break the rows; NaN if there was none.
        p_value: Of the confirmation; NaN if there was none.
    """

    selection: Float[np.ndarray, "s p"]
    stretches: tuple[Stretch, ...]
    features: int
    softness: float
    support: float
    needed: float
    strength: float
    p_value: float

    @property
    def n_rows(self) -> int:
        """Number of rows s."""
        return int(self.selection.shape[0])

    @property
    def trajectories(self) -> tuple[int, ...]:
        """The trajectories in which it holds."""
        return tuple(sorted({s.trajectory for s in self.stretches}))


@final
@dataclass(frozen=True, eq=False)
class PhaseResult:
    """Recordings divided into stretches.

    Attributes:
        constraints: Best supported first.
        free: Stretches of free motion.
        still: Standstill beside free motion or at the ends: whether something is held cannot be known there.
        unsupported: Contacts that one recording alone shows, which are not learnt; not in `free`.
        rejected: Candidates that were refused.
        warnings: Doubts, in sentences.
    """

    constraints: tuple[PhaseConstraint, ...]
    free: tuple[Stretch, ...]
    still: tuple[Stretch, ...]
    unsupported: tuple[Stretch, ...] = ()
    rejected: tuple[PhaseConstraint, ...] = ()
    warnings: tuple[str, ...] = ()
