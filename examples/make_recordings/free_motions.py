"""Nothing is held: reaches, the same reach again and again, sticking joints, slow motion."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from jaxtyping import Float

from make_recordings.arms import Arm
from make_recordings.furniture import comfortable
from make_recordings.hand_motion import RATE, reach, rest

Free = Callable[[Arm, np.random.Generator, np.random.Generator], Float[np.ndarray, "T nv"]]


def reaches(arm: Arm, shared: np.random.Generator, rng: np.random.Generator, slower: float = 1.0) -> np.ndarray:
    """Three to five curved reaches [rad], other ones in each demonstration, with pauses."""
    home = comfortable(arm, shared)
    here, parts = home + rng.normal(0.0, 0.2, len(home)), []
    for _ in range(rng.integers(3, 6)):
        there = home + rng.normal(0.0, 0.3, len(home))
        parts.append(reach(here, there, slower * rng.uniform(1.0, 2.2), 0.15, rng)[:-1])
        here = there
        if rng.random() < 0.4:
            parts.append(rest(here, rng.uniform(0.1, 0.8))[:-1])
    return np.concatenate([*parts, here[None]])


def slow_reaches(arm: Arm, shared: np.random.Generator, rng: np.random.Generator) -> np.ndarray:
    """Reaches at a fifth of the speed, cut after 12 s: the noise shows."""
    return reaches(arm, shared, rng, slower=5.0)[: round(12.0 * RATE)]


def repeated_reach(arm: Arm, shared: np.random.Generator, rng: np.random.Generator) -> np.ndarray:
    """The same reach to and fro in all demonstrations, with small variations of ends, bend and time."""
    n = len(arm.ready)
    start, end = comfortable(arm, shared), None
    end = start + shared.normal(0.0, 0.4, n)
    bends = shared.integers(2**31, size=2)
    a, b = start + rng.normal(0.0, 0.03, n), end + rng.normal(0.0, 0.03, n)
    out = reach(a, b, rng.uniform(1.6, 2.2), 0.15, np.random.default_rng(bends[0]))
    back = reach(b, a + rng.normal(0.0, 0.02, n), rng.uniform(1.6, 2.2), 0.15, np.random.default_rng(bends[1]))
    extra = reach(np.zeros(n), np.zeros(n), len(out) / RATE, 0.02, rng)[: len(out)]
    return np.concatenate([out + extra[: len(out)], back[1:]])


def one_joint_at_a_time(arm: Arm, shared: np.random.Generator, rng: np.random.Generator) -> np.ndarray:
    """Each joint is moved by itself, in any order, some twice; the others do not move at all."""
    here = comfortable(arm, shared) + rng.normal(0.0, 0.15, len(arm.ready))
    parts = []
    for joint in rng.permutation(np.concatenate([np.arange(len(here)), rng.integers(len(here), size=2)])):
        there = np.array(here)
        there[joint] += rng.uniform(0.15, 0.5) * rng.choice([-1.0, 1.0])
        parts.append(reach(here, there, rng.uniform(0.7, 1.4), 0.0, rng)[:-1])
        here = there
    return np.concatenate([*parts, here[None]])


def sticking_joints(arm: Arm, shared: np.random.Generator, rng: np.random.Generator) -> np.ndarray:
    """Reaches in which a joint gives only after the hand has moved it by up to 0.08 rad: dry friction.

    The play operator q <- clip(q, wanted - r, wanted + r), with one r a joint and a light low pass of 0.1 s.
    """
    wanted = reaches(arm, shared, rng)
    width = shared.uniform(0.01, 0.08, wanted.shape[1])
    stuck, q = np.empty_like(wanted), np.array(wanted[0])
    for k, row in enumerate(wanted):
        q = np.clip(q, row - width, row + width)
        stuck[k] = q
    kernel = np.hanning(13)[1:-1] / np.sum(np.hanning(13))
    padded = np.pad(stuck, ((5, 5), (0, 0)), mode="edge")
    return np.column_stack([np.convolve(column, kernel, mode="valid") for column in padded.T])


def few_joints(arm: Arm, shared: np.random.Generator, rng: np.random.Generator) -> np.ndarray:
    """Reaches with three joints only, the same three in all demonstrations; the others rest where they are."""
    home = comfortable(arm, shared)
    moving = np.zeros(len(home))
    moving[shared.choice(len(home), 3, replace=False)] = 1.0
    motion = reaches(arm, np.random.default_rng(shared.integers(2**31)), rng)
    start = home + rng.normal(0.0, 0.05, len(home))
    return start + moving * (motion - motion[0])
