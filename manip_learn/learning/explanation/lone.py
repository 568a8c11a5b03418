"""Contacts that one recording alone shows: they are named, so that they can be recorded again, and not learnt."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from manip_learn.learning.explanation.explain import Explanation, Hypothesis, candidates
from manip_learn.learning.explanation.row_motion import directions_used
from manip_learn.learning.explanation.stretch import Stretch, stretches_of
from manip_learn.learning.explanation.surrogates import exchanged
from manip_learn.learning.explanation.views import View
from manip_learn.recordings.trajectory import Trajectory

# in a single recording only firmness tells a contact from free motion, which also runs straight or flat, but never to
# better than a few per cent
FIRM_ALONE = 0.01
# least evidence [nats], and how many times that of the best recording without a contact
LEAST_ALONE, MARGIN_ALONE = 60.0, 1.5
# recordings without a contact that are searched for comparison
CHANCE_RUNS = 3


def lone_contacts(
    explanation: Explanation,
    trajectories: Sequence[Trajectory],
    views_of: Callable[[Sequence[Trajectory]], list[View]],
    rng: np.random.Generator,
    excited: int,
) -> list[Stretch]:
    """Stretches beside those explained in which rows hold firmly, in one recording each.

    The same search finds straight and flat parts of free motion, too. What it finds there is known from recordings
    whose joints come from different ones: a contact must exceed the best of them.

    Args:
        explanation: What several recordings show.
        trajectories: Whole recordings with velocities.
        views_of: Shows recordings in the feature maps.
        rng: For the comparison.
        excited: Directions in which the joints must move for rows to be held rather than not used.
    """
    best = _firmest(explanation)
    if not best:
        return []
    needed = LEAST_ALONE
    for _ in range(CHANCE_RUNS):
        chance = Explanation(views_of(exchanged(trajectories, rng)))
        needed = max(needed, *(MARGIN_ALONE * h.gains[i] for i, h in _firmest(chance).items()), needed)
    out, motion = list[Stretch](), explanation.views[0].motion
    for i, h in best.items():
        if h.gains[i] <= needed:
            continue
        alone = Explanation(explanation.views, (*explanation.hypotheses, h), explanation.switch)
        states = alone.fine_states() * (motion.trajectory == i)
        for s in stretches_of(motion, states, len(alone.hypotheses)):
            t = trajectories[i][s.start : s.end]
            if s.trajectory == i and directions_used(np.asarray(t.u), float(motion.noise[motion.first[i]])) >= excited:
                out.append(s)
    return out


def _firmest(explanation: Explanation) -> dict[int, Hypothesis]:
    """The firm hypothesis with the most evidence in each recording where it has enough."""
    found = [h for h in candidates(explanation, alone=True) if h.scale.share <= FIRM_ALONE]
    out = {}
    for i in range(explanation.thin.n_trajectories):
        best = max(found, key=lambda h: h.gains[i], default=None)
        if best is not None and best.gains[i] > LEAST_ALONE:
            out[i] = best
    return out
