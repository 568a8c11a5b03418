"""Contacts that one recording alone shows: they are named, so that they can be recorded again, and not learnt."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from manip_learn.constraint.features.feature_map import FeatureMap
from manip_learn.learning.phases.chance import RATE, donors_apart, recombined
from manip_learn.learning.phases.decoding import stretches_of
from manip_learn.learning.phases.motion import PhaseMotion, directions_used
from manip_learn.learning.phases.result import Stretch
from manip_learn.learning.phases.search import FEWER, FEWER_REFINED, FEWER_REFITS, Found, candidates, evidence_of
from manip_learn.learning.phases.segmentation import held_samples
from manip_learn.recordings.trajectory import Trajectory

# in a single recording only firmness tells a contact from free motion, which also runs straight or flat, but never to
# better than a few per cent
FIRM_ALONE = 0.01
# least evidence [nats], and how many times that of the best recording without a contact
LEAST_ALONE, MARGIN_ALONE = 60.0, 1.5
# a few joints, or one after the other, move the hand on circles and in planes: only where the joints move in so many
# directions does it take a contact to keep them on one
DIRECTIONS = 5
# versions of the recordings without a contact that are searched for comparison
CHANCE_RUNS = 3
# evidence against what is explained already [nats/s]
EXPLAINED = 1e3


def contacts_of_one(
    features: FeatureMap,
    trajectories: Sequence[Trajectory],
    motion: PhaseMotion,
    taken: Sequence[Stretch],
    rng: np.random.Generator,
) -> list[tuple[float, Stretch]]:
    """Stretches beside those explained in which rows hold firmly, in one recording each, with the evidence [nats].

    The same search in one recording at a time finds straight and flat parts of free motion, too. What it finds there is
    known from recordings whose joints come from different ones: a contact must exceed the best of them.

    Args:
        features: Phi.
        trajectories: Whole recordings with velocities.
        motion: Of these trajectories in these features.
        taken: Stretches that several recordings explain.
        rng: For the comparison.
    """
    if any(t.q.shape[1] != features.nv for t in trajectories):
        return []
    largest = min(motion.rates.shape[1], features.nv) - 1
    thin = motion.thinned(RATE)
    best = [_firmest(thin.alone(i), _explained(thin.alone(i), i, taken), largest) for i in range(len(trajectories))]
    if not any(f is not None and f.support > LEAST_ALONE for f in best):
        return []
    needed = max(LEAST_ALONE, MARGIN_ALONE * _by_chance(features, trajectories, largest, rng))
    out = []
    for i, found in enumerate(best):
        if found is not None and found.support > needed:
            alone = motion.alone(i)
            values = evidence_of(alone, found) - _explained(alone, i, taken)
            held = held_samples(values[:, None], alone.first)[:, 0]
            if directions_used(np.asarray(trajectories[i].u)[held], float(alone.noise[0])) >= min(
                DIRECTIONS, features.nv
            ):
                stretches = stretches_of(alone, held.astype(np.int64), 1)
                out += [(found.support, Stretch(i, s.start, s.end)) for s in stretches]
    return out


def _firmest(thin: PhaseMotion, baseline: Float[np.ndarray, " n"], largest: int) -> Found | None:
    """The firm hypothesis of one recording with the most evidence."""
    found = candidates(thin, thin, baseline, largest, FEWER, FEWER_REFINED, FEWER_REFITS)
    return max((f for f in found if f.scale.share <= FIRM_ALONE), key=lambda f: f.support, default=None)


def _explained(alone: PhaseMotion, number: int, taken: Sequence[Stretch]) -> Float[np.ndarray, " n"]:
    inside = np.zeros(len(alone), dtype=bool)
    for s in taken:
        inside |= (s.trajectory == number) & (alone.time >= s.start) & (alone.time <= s.end)
    return np.where(inside, EXPLAINED * alone.weight, 0.0)


def _by_chance(
    features: FeatureMap, trajectories: Sequence[Trajectory], largest: int, rng: np.random.Generator
) -> float:
    """Evidence of the best single recording without a contact [nats]."""
    most = 0.0
    for _ in range(CHANCE_RUNS):
        donors = donors_apart(len(trajectories), features.nv, rng)
        made = PhaseMotion.collect(features, recombined(features, trajectories, rng, donors))
        for i in range(made.n_trajectories):
            found = _firmest(made.alone(i), np.zeros(np.count_nonzero(made.trajectory == i)), largest)
            most = max(most, 0.0 if found is None else found.support)
    return most
