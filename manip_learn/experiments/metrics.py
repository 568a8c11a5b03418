"""Errors by which a learnt constraint is judged."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from manip_learn.constraint.constraint import Constraint
from manip_learn.constraint.manipulability import manipulability
from manip_learn.control.policies.policy import NullSpacePolicy
from manip_learn.linalg import row_space_angle


def mie(true: Constraint, learnt: Constraint, postures: Iterable[ArrayLike]) -> float:
    """Manipulability index error, mean of (mu - mu~)^2, in the constraint's units squared."""
    mu, learnt_mu = _both(true, learnt, postures)
    return float(np.mean((mu - learnt_mu) ** 2))


def nmie(true: Constraint, learnt: Constraint, postures: Iterable[ArrayLike]) -> float:
    """Normalised manipulability index error, 1/(n var(mu)) sum (mu - mu~)^2, of Manavalan and Howard."""
    mu, learnt_mu = _both(true, learnt, postures)
    return float(np.mean((mu - learnt_mu) ** 2) / np.var(mu))


def scale_free_nmie(true: Constraint, learnt: Constraint, postures: Iterable[ArrayLike]) -> float:
    """NMIE after the best single factor on mu~: grad mu's direction does not depend on that factor."""
    mu, learnt_mu = _both(true, learnt, postures)
    factor = float(mu @ learnt_mu) / float(learnt_mu @ learnt_mu)
    return float(np.mean((mu - factor * learnt_mu) ** 2) / np.var(mu))


def policy_rmse(true: NullSpacePolicy, learnt: NullSpacePolicy, postures: Iterable[ArrayLike]) -> float:
    """Root of the mean squared distance between two policies' velocities along postures."""
    squares = [float(np.sum((true(q) - learnt(q)) ** 2)) for q in postures]
    return float(np.sqrt(np.mean(squares)))


def row_space_error(true: Constraint, learnt: Constraint) -> float:
    """Largest principal angle between the row spaces of two selection matrices [rad]; pi/2 if their sizes differ."""
    return row_space_angle(true.selection, learnt.selection)


def _both(
    true: Constraint, learnt: Constraint, postures: Iterable[ArrayLike]
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    rows = list(postures)
    return (
        np.array([manipulability(true, q) for q in rows]),
        np.array([manipulability(learnt, q) for q in rows]),
    )
