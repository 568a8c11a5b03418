"""How much evidence the phase search finds where nothing is held: the same search on motions without a contact."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Int

from manip_learn.constraint.features.feature_map import FeatureMap
from manip_learn.learning.phases.hypotheses import Propose, window_hypotheses
from manip_learn.learning.phases.motion import PhaseMotion
from manip_learn.learning.phases.search import best_supports
from manip_learn.recordings.trajectory import Trajectory

# samples a second of the motions that are made [1/s]
RATE = 12.5


def turned(motion: PhaseMotion, rng: np.random.Generator) -> PhaseMotion:
    """Each recording's rows turned by a random rotation of its own.

    Each stays as straight, as flat and as smooth as it was; that their directions agree is taken away.
    """
    r = motion.rates.shape[1]
    Q = np.linalg.qr(rng.normal(size=(motion.n_trajectories, r, r)))[0][motion.trajectory]
    rates = np.einsum("nij,nj->ni", Q, motion.rates)
    return motion.replaced(rates, Q @ motion.gram @ Q.transpose(0, 2, 1))


def donors_apart(g: int, nv: int, rng: np.random.Generator) -> Int[np.ndarray, "g nv"]:
    """For each of g recordings and each joint, the recording that lends it, as few as possible from the same lender.

    Where donors are drawn for each joint by itself, one recording in thirty has three joints of one donor, and with
    them nearly its contact.
    """
    shifts = np.concatenate([rng.permutation(g) for _ in range(-(-nv // g))])[:nv]
    return rng.permutation(g)[(np.arange(g)[:, None] + shifts) % g]


def recombined(
    features: FeatureMap,
    trajectories: Sequence[Trajectory],
    rng: np.random.Generator,
    donors: Int[np.ndarray, "g nv"] | None = None,
) -> list[Trajectory]:
    """Recordings whose joints come from different recordings, at the same share of the time.

    Each joint keeps its own motion, and what all recordings have in common; the coordination of the joints that a
    contact enforces is taken away.

    Args:
        features: Phi.
        trajectories: With velocities.
        rng: Draws the donors.
        donors: Which recording each joint comes from; drawn for each joint by itself if not given.
    """
    g, nv = len(trajectories), features.nv
    if donors is None:
        donors = np.stack([rng.permutation(g) for _ in range(nv)], axis=1)
    out = []
    for i, t in enumerate(trajectories):
        phase = np.linspace(0.0, 1.0, max(8, int(RATE * t.duration)))
        q, u = np.empty((len(phase), nv)), np.empty((len(phase), nv))
        for j in range(nv):
            donor = trajectories[donors[i, j]]
            time = donor.time[0] + phase * donor.duration
            q[:, j] = np.interp(time, donor.time, donor.q[:, j])
            u[:, j] = np.interp(time, donor.time, np.asarray(donor.u)[:, j]) * donor.duration / max(t.duration, 1e-9)
        out.append(Trajectory(t.time[0] + phase * t.duration, q, u, t.joint_names, t.name))
    return out


def chance_support(
    features: FeatureMap,
    trajectories: Sequence[Trajectory],
    thin: PhaseMotion,
    largest: int,
    n: int,
    rng: np.random.Generator,
    propose: Propose = window_hypotheses,
) -> Float[np.ndarray, "s 2"]:
    """Support [nats] that is hardly exceeded by chance, for each number of rows: of any hypothesis and of firm ones.

    Mean and three standard deviations of the best support in n turned, and in n recombined versions of the recordings;
    the larger of the two.
    """
    thin = thin.thinned(RATE)
    kinds = [[best_supports(turned(thin, rng), largest, propose) for _ in range(n)]]
    if trajectories and all(t.q.shape[1] == features.nv for t in trajectories):
        made = (PhaseMotion.collect(features, recombined(features, trajectories, rng)) for _ in range(n))
        kinds.append([best_supports(motion, largest, propose) for motion in made])
    table = np.array(kinds)
    return (table.mean(axis=1) + 3.0 * table.std(axis=1)).max(axis=0)
