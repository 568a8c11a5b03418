"""Contacts that one recording alone shows: they are named, so that they can be recorded again, and not learnt."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np
from jaxtyping import Float

from manip_learn.learning.deciding import FEWEST_TRAJECTORIES, FIRM_ALONE_SHARE, LEAST_GAIN_NATS
from manip_learn.learning.explanation.explain import Explanation, Hypothesis, candidates
from manip_learn.learning.explanation.row_motion import View
from manip_learn.learning.explanation.stretch import Stretch, covered, stretches_of


def lone_contacts(explanation: Explanation, believed: Callable[[View, Hypothesis, Stretch], bool]) -> list[Stretch]:
    """Stretches beside those explained in which rows hold firmly, in one recording each.

    Args:
        explanation: What several recordings show.
        believed: The test of a hypothesis against chance, by a single stretch.
    """
    found = [h for h in candidates(explanation, alone=True) if h.scale.share <= FIRM_ALONE_SHARE]
    out, motion = list[Stretch](), explanation.views[0].motion
    for i in range(explanation.thin.n_trajectories if found else 0):
        h = max(found, key=lambda h: h.gains[i])
        if h.gains[i] <= LEAST_GAIN_NATS:
            continue
        alone = Explanation(explanation.views, (*explanation.hypotheses, h), explanation.switch)
        states = alone.fine_states() * (motion.trajectory == i)
        stretches = stretches_of(motion, states, len(alone.hypotheses))
        worthy = [s for s in stretches if _worth(alone, s) > LEAST_GAIN_NATS]
        out += [s for s in worthy if believed(explanation.views[h.view], h, s)]
    return out


def parts_of(start: float, end: float) -> Float[np.ndarray, " k"]:
    """Edges of the parts of a stretch that stand for recordings: one more than the fewest can be spared [s]."""
    return np.linspace(start, end, FEWEST_TRAJECTORIES + 2)


def _worth(alone: Explanation, stretch: Stretch) -> float:
    """Gain of the last hypothesis in a stretch, without the part of it that gains most, less its price and that of the
    change into it and out of it [nats].
    """
    thin, k = alone.thin, len(alone.hypotheses) - 1
    inside = covered(thin, [stretch])
    part = np.searchsorted(parts_of(stretch.start, stretch.end)[1:-1], thin.time[inside])
    gains = np.bincount(part, (alone.values[:, k] - alone.others(k))[inside])
    return dataclasses.replace(alone.hypotheses[k], gains=gains).worth(stretch.duration) - alone.switch
