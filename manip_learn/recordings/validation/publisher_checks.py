"""Two publishers on one topic (a robot and a forgotten GUI): samples that jump to and fro between two motions."""

from __future__ import annotations

from dataclasses import dataclass
from typing import final

import numpy as np
from jaxtyping import Float, Int

from manip_learn.recordings.readers.recording import Recording

LAGS = 20  # samples, within which each of two publishers is heard again
PART = 20_000  # samples that are judged together: the second publisher may have been there for a while only
FEWEST_SAMPLES, FEWEST_JUMPS = 30, 10
CLEAR = 6.0  # times the motion from one sample of a publisher to its next one
SMALLEST = 0.02  # [rad or m]: a flickering encoder jumps by less
QUANTA, LARGEST_QUANTUM = 3.0, 0.02  # a coarse encoder flickers by one or two quanta [rad or m]
OPPOSITE, ALIKE = -0.9, 0.6  # cosine and ratio of the sizes of a jump and the jump back
MOSTLY = 0.9  # of the jumps
COMPARED, ROUNDING = 1000, 1e-9  # steps that are compared in pairs, and of a cosine


@final
@dataclass(frozen=True, eq=False)
class Alternation:
    """Jumps between two motions.

    Attributes:
        jumps: Samples before the jumps.
        joint: Column of the joint that jumps farthest.
        size: Its usual jump [rad or m].
        usual: The usual motion between samples that belong together [rad or m].
    """

    jumps: Int[np.ndarray, " k"]
    joint: int
    size: float
    usual: float


def refuse_two_publishers(recording: Recording, names: tuple[str, ...], q: Float[np.ndarray, "T nv"]) -> None:
    """Refuse positions that alternate, regularly or not, between two motions.

    Raises:
        RecordingError: Code `two-publishers`.
    """
    for start in range(0, q.shape[0], PART):
        found = alternation(q[start : start + PART])
        if found is not None:
            sample = start + int(found.jumps[0]) + 1
            raise recording.refusal(
                "two-publishers",
                f"the samples alternate between two motions: {found.jumps.size} steps jump to and fro, joint "
                f"{names[found.joint]!r} by about {found.size:.3g}, while samples that belong together are "
                f"{found.usual:.2g} apart. Two programs published on one topic (a robot and a GUI?): end one of them "
                "(`ros2 topic info -v`, `rostopic info` list them) and record again",
                sample=sample,
                column=names[found.joint],
            )


def alternation(q: Float[np.ndarray, "T nv"]) -> Alternation | None:
    """Jumps to and fro between two smooth motions, or None.

    A sample is close to one of the samples before it, its own publisher's last one. Where a step is clearly longer than
    that, the publisher has changed; the next such step must lead back. Noise does not do so: its steps differ in size.
    """
    n_samples = q.shape[0]
    if n_samples < FEWEST_SAMPLES:
        return None
    steps = np.diff(q, axis=0)
    size = np.linalg.norm(steps, axis=1)
    if np.count_nonzero(size > SMALLEST) < FEWEST_JUMPS:
        return None
    least = max(SMALLEST, QUANTA * _quantum(q))
    if np.count_nonzero(size > least) < FEWEST_JUMPS:
        return None
    if not _some_lead_back(steps[size > least]):
        return None
    usual = _usual_distance(q, size)
    jumps = np.flatnonzero(size > max(CLEAR * usual, least))
    if jumps.size < FEWEST_JUMPS:
        return None
    there, back = steps[jumps[:-1]], steps[jumps[1:]]
    sizes = size[jumps]
    cosine = np.sum(there * back, axis=1) / (sizes[1:] * sizes[:-1])
    alike = np.minimum(sizes[1:], sizes[:-1]) / np.maximum(sizes[1:], sizes[:-1])
    if np.mean((cosine < OPPOSITE) & (alike > ALIKE)) < MOSTLY:
        return None
    by_joint = np.median(np.abs(steps[jumps]), axis=0)
    joint = int(np.argmax(by_joint))
    return Alternation(jumps, joint, float(by_joint[joint]), usual)


def _some_lead_back(steps: Float[np.ndarray, "k nv"]) -> bool:
    """Whether any of some long steps are opposite to each other; True where they are too many to compare quickly."""
    if len(steps) > COMPARED:
        return True
    unit = steps / np.linalg.norm(steps, axis=1)[:, None]
    return bool(np.min(unit @ unit.T) < OPPOSITE + ROUNDING)


def _usual_distance(q: Float[np.ndarray, "T nv"], size: Float[np.ndarray, " n"]) -> float:
    """Distance from a sample to the closest of those before it, that nine of ten do not exceed [rad or m]."""
    columns = np.ascontiguousarray(q.T)
    nearest = size**2
    for lag in range(2, LAGS + 1):
        apart = columns[:, lag:] - columns[:, :-lag]
        np.minimum(nearest[lag - 1 :], np.einsum("vn,vn->n", apart, apart), out=nearest[lag - 1 :])
    return float(np.quantile(np.sqrt(nearest), 0.9))


def _quantum(q: Float[np.ndarray, "T nv"]) -> float:
    """Size of a step by which all joints move by the smallest difference that their encoders show [rad or m]."""
    gaps = np.diff(np.sort(q, axis=0), axis=0)
    least = np.min(np.where(gaps > 0.0, gaps, np.inf), axis=0, initial=np.inf)
    least = np.where(np.isfinite(least), np.minimum(least, LARGEST_QUANTUM), 0.0)  # a joint that stands still has none
    return float(np.sqrt(np.sum(least**2)))
