"""Recordings in which nothing is held: the joints of each come from different ones."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Int

from manip_learn.recordings.trajectory import Trajectory

# samples a second of the recordings that are made [1/s]
RATE = 25.0


def exchanged(trajectories: Sequence[Trajectory], rng: np.random.Generator) -> list[Trajectory]:
    """Recordings whose joints come from different recordings, at the same share of the time.

    Each joint keeps its own motion, and what all recordings have in common; the coordination of the joints that a
    contact enforces is taken away.

    Args:
        trajectories: With velocities, and as many positions.
        rng: Draws the lenders.
    """
    g, nv = len(trajectories), np.asarray(trajectories[0].u).shape[1]
    borrowed, out = lenders(g, nv, rng), []
    for i, t in enumerate(trajectories):
        phase = np.linspace(0.0, 1.0, max(8, int(RATE * t.duration)))
        q, u = np.empty((len(phase), nv)), np.empty((len(phase), nv))
        for j in range(nv):
            lender = trajectories[borrowed[i, j]]
            time = lender.time[0] + phase * lender.duration
            q[:, j] = np.interp(time, lender.time, lender.q[:, j])
            u[:, j] = np.interp(time, lender.time, np.asarray(lender.u)[:, j])
            u[:, j] *= lender.duration / max(t.duration, 1e-9)
        out.append(Trajectory(t.time[0] + phase * t.duration, q, u, t.joint_names, t.name))
    return out


def lenders(g: int, nv: int, rng: np.random.Generator) -> Int[np.ndarray, "g nv"]:
    """For each of g recordings and each joint, the recording that lends it, as few as possible from the same lender.

    Where lenders are drawn for each joint by itself, one recording in thirty has three joints of one lender, and with
    them nearly its contact.
    """
    shifts = np.concatenate([rng.permutation(g) for _ in range(-(-nv // g))])[:nv]
    return rng.permutation(g)[(np.arange(g)[:, None] + shifts) % g]
