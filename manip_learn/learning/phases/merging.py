"""One answer out of the searches with several feature maps, and what is doubtful about it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from manip_learn.learning.phases.decoding import still_stretches
from manip_learn.learning.phases.motion import PhaseMotion
from manip_learn.learning.phases.result import PhaseConstraint, PhaseResult, Stretch

# share of a constraint's time that a better supported one may explain as well
OVERLAP = 0.3
# rows of two constraints closer together than this may be one constraint, or two [rad]
NEARLY_THE_SAME = np.radians(5.0)


def merged(
    motion: PhaseMotion, results: Sequence[PhaseResult], alone: Sequence[tuple[float, Stretch]] = ()
) -> PhaseResult:
    """The constraints of all results, best supported first, without those whose time a better one explains.

    Args:
        motion: Of all recordings.
        results: One for each feature map.
        alone: Contacts that one recording shows, with the evidence for each [nats].
    """
    kept: list[PhaseConstraint] = []
    for c in sorted((c for r in results for c in r.constraints), key=lambda c: -c.support):
        rivals = [k for k in kept if k.features != c.features]
        total = sum(s.duration for s in c.stretches)
        if sum(_shared(c, k) for k in rivals) <= OVERLAP * total:
            kept.append(c)
    taken = [s for c in kept for s in c.stretches]
    unsupported: list[Stretch] = []
    for _, stretch in sorted(alone, key=lambda x: -x[0]):
        if not any(_common(stretch, other) for other in [*taken, *unsupported]):
            unsupported.append(stretch)
    taken += unsupported
    free = tuple(sorted((s for s in _free(motion, taken)), key=lambda s: (s.trajectory, s.start)))
    rejected = tuple(c for r in results for c in r.rejected)
    still = still_stretches(motion, [*taken, *free])
    lone = tuple(sorted(unsupported, key=lambda s: (s.trajectory, s.start)))
    return PhaseResult(tuple(kept), free, still, lone, rejected, tuple(_doubts(kept)))


def _shared(first: PhaseConstraint, second: PhaseConstraint) -> float:
    """Time that two constraints both claim [s]."""
    return sum(_common(a, b) for a in first.stretches for b in second.stretches)


def _common(a: Stretch, b: Stretch) -> float:
    return max(0.0, min(a.end, b.end) - max(a.start, b.start)) if a.trajectory == b.trajectory else 0.0


def _free(motion: PhaseMotion, taken: Sequence[Stretch]) -> list[Stretch]:
    """Motion that no constraint explains; from the first to the last sample that moves."""
    held = np.zeros(len(motion), dtype=bool)
    for s in taken:
        held |= (motion.trajectory == s.trajectory) & (motion.time >= s.start) & (motion.time <= s.end)
    out = []
    for i, (a, b) in enumerate(zip(motion.first[:-1], motion.first[1:], strict=True)):
        edges = np.flatnonzero(np.diff(held[a:b].astype(int), prepend=1, append=1))
        for low, high in zip(edges[::2], edges[1::2], strict=True):
            inside = np.flatnonzero(motion.moving[a + low : a + high])
            if len(inside):
                start, end = motion.time[a + low + inside[0]], motion.time[a + low + inside[-1]]
                out.append(Stretch(i, float(start), float(end)))
    return out


def _doubts(constraints: Sequence[PhaseConstraint]) -> list[str]:
    out = []
    for j, b in enumerate(constraints):
        for i, a in enumerate(constraints[:j]):
            if a.features != b.features or a.n_rows != b.n_rows:
                continue
            angle = float(np.arccos(np.clip(np.linalg.svd(a.selection @ b.selection.T)[1][-1], -1.0, 1.0)))
            if angle < NEARLY_THE_SAME:
                out.append(
                    f"constraints {i + 1} and {j + 1} differ by {np.degrees(angle):.1f} deg only: two contacts that "
                    "nearly coincide, or one that is not quite constant; they are kept apart, not averaged"
                )
    return out
