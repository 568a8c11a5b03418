"""The place of a mechanism by maximum likelihood for errors of the joints, and what its own error may be.

Each held quantity z_n(place) is a constant c along a trajectory. An error dq_n of the joints moves it by D_n J_n dq_n,
with J the Jacobian of the frame and D the slope of the quantity along the frame's twist. The same error sigma in all
joints gives, to first order (W. A. Fuller, Measurement Error Models, 1987, section 3.2),

    l(place, c) = - 1/2 sum_n (z_n - c)^T W_n (z_n - c) / sigma^2,     W_n = (D_n J_n J_n^T D_n^T)^-1

With M_n = W_n^(1/2) d (z_n - c) / d (place, c) and H = sum M_n^T M_n its covariance is

    C = f sigma^2 H^-1 [ sum_n,k rho_k M_n^T M_n+k ] H^-1

rho is the autocorrelation of the residuals: smoothed positions share their noise. f >= 1 is what the trajectories
scatter beyond that, by their influences corrected for leverage (Bell and McCaffrey, 2002).

A constant error delta of the joints' zeros leaves the pattern K_n delta, K_n = W_n^(1/2) D_n J_n, of which the unknowns
take up -H^-1 M^T K delta. The rest tells how large the offsets are, by the likelihood of `JointOffsets`; what a
mechanism has in common with the whole arm, such as a turn of the base, shows nowhere and is as large as the others.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import final

import numpy as np
from jaxtyping import Float

from manip_learn.learning.deciding import SCATTER_ERRORS, STANDARD_ERRORS, STATED_SHARE_OF_PLACES
from manip_learn.learning.mechanisms.fits import Fit, tangents
from manip_learn.learning.mechanisms.residuals import Place
from manip_learn.learning.mechanisms.tip_paths import TipPaths
from manip_learn.learning.mechanisms.weighted_residuals import Linearised, Weights, scaled_inverse
from manip_learn.learning.uncertainty import JointOffsets, influences

ITERATIONS = 12
SETTLED = 1e-6  # squared length of the last step in standard errors
SHORTEST = 1e-3  # share of a step
LONGEST = 100  # samples over which neighbours may share their noise
DRAWS = 1000
UNSEEN = 1e-10  # share of the largest curvature below which a combination of offsets shows nowhere


@final
@dataclass(frozen=True, eq=False)
class WeightedFit:
    """A place with what its error may be.

    Attributes:
        place: Where.
        errors: Draws of the error of axis, point and pitch, shape (k, 7).
        radius: Distance from the axis or the centre, and what its error stays below in 68 % of cases [m]; None if
            it is not held.
    """

    place: Place
    errors: Float[np.ndarray, "k 7"]
    radius: tuple[float, float] | None

    def within(self, chosen: slice) -> float:
        """What the error of some of the seven numbers stays below in 68 % of cases."""
        return float(np.quantile(np.linalg.norm(self.errors[:, chosen], axis=1), STATED_SHARE_OF_PLACES))


def fit_weighted(paths: TipPaths, J: Float[np.ndarray, "N 6 nv"], fit: Fit, rng: np.random.Generator) -> WeightedFit:
    """The place of a fit, moved to the largest likelihood.

    Args:
        paths: Of the frame.
        J: Its Jacobian along them, base axes, linear rows first.
        fit: The start: with what is held, and what is the same for all trajectories.
        rng: For the draws of the error.
    """
    weights = Weights.of(paths, J, fit.candidate, fit.place)
    here = Linearised.at(paths, fit, fit.place, weights)
    for _ in range(ITERATIONS):
        step, share, there = here.step(), 1.0, here
        if float(step @ here.H @ step) <= SETTLED * here.variance:
            break
        while share > SHORTEST and (there is here or there.cost > here.cost):
            place = here.place.moved(tangents(fit.candidate, here.place) @ (share * step[: here.m]))
            there = Linearised.at(paths, fit, place, weights)
            share *= 0.3
        if there.cost > here.cost:
            break
        here = there
    errors = _errors(here, rng)
    return WeightedFit(here.place, errors[:, : here.m] @ here.tangents.T, _radius(here, errors))


def _radius(here: Linearised, errors: Float[np.ndarray, "k w"]) -> tuple[float, float] | None:
    """That of the middle one of the trajectories, for a grip that slips is elsewhere; where each has its own, what they
    differ by belongs to its error.
    """
    if not len(here.radius):
        return None
    each = here.constants[here.radius]
    middle = here.radius[np.argsort(each)[len(each) // 2]]
    own, spread = np.abs(errors[:, middle]), np.abs(each - here.constants[middle])
    parts = [np.quantile(own, STATED_SHARE_OF_PLACES), np.quantile(spread, STATED_SHARE_OF_PLACES)]
    return float(here.constants[middle]), float(np.hypot(*parts))


def _errors(here: Linearised, rng: np.random.Generator) -> Float[np.ndarray, "k w"]:
    """Draws of the error of all unknowns: that of the noise, and that of the joints' offsets."""
    inverse, m = scaled_inverse(here.H), here.m
    noise, offsets = _without_offsets(here, inverse)
    C = offsets.variance * inverse @ (here.H + _neighbours(noise)) @ inverse
    factor, freedom = _scatter(noise, C[:m, :m])
    values, vectors = np.linalg.eigh(factor * C)
    drawn = rng.standard_normal((DRAWS, len(values))) @ (vectors * np.sqrt(values.clip(0.0))).T
    if np.isfinite(freedom):
        drawn /= np.sqrt(rng.chisquare(freedom, DRAWS) / freedom)[:, None]
    neighbours = 1.0 + 2.0 * sum(_correlation(noise))
    return drawn + dataclasses.replace(offsets, variance=neighbours * offsets.variance).errors(DRAWS, rng)


def _without_offsets(here: Linearised, inverse: Float[np.ndarray, "w w"]) -> tuple[Linearised, JointOffsets]:
    """The residuals without the pattern that offsets of the joints explain, and what it says of them."""
    K = here.weights.noise
    cross = np.zeros((len(inverse), K.shape[2]))
    for _, part, own in here.unknowns.clusters():
        cross[own] += np.einsum("nij,nik->jk", here.slopes[part], K[part], optimize=True)
    response, flat = -inverse @ cross, K.reshape(-1, K.shape[2])
    total = flat.T @ flat
    curvatures, V = np.linalg.eigh(total + cross.T @ response)
    seen = curvatures > UNSEEN * float(np.trace(total))
    pattern = np.where(seen, V.T @ (flat.T @ here.residuals.reshape(-1)), 0.0)
    delta = V @ np.divide(pattern, curvatures, out=np.zeros_like(pattern), where=seen)
    residuals, gradients = here.residuals - K @ delta, np.zeros_like(here.gradients)
    for i, part, own in here.unknowns.clusters():
        residuals[part] -= here.slopes[part] @ (response @ delta)[own]
        gradients[i, own] = np.einsum("nij,ni->j", here.slopes[part], residuals[part])
    noise = dataclasses.replace(here, residuals=residuals, gradients=gradients)
    return noise, JointOffsets(response, V, np.where(seen, curvatures, 0.0), pattern, noise.variance)


def _neighbours(here: Linearised) -> Float[np.ndarray, "w w"]:
    """sum_n,k rho_k M_n^T M_n+k, k > 0 and k < 0."""
    out, shares = np.zeros_like(here.H), _correlation(here)
    for _, part, own in here.unknowns.clusters():
        M = here.slopes[part]
        for k, share in enumerate(shares[: max(len(M) - 1, 0)], start=1):
            products = share * (M[:-k].reshape(-1, len(own)).T @ M[k:].reshape(-1, len(own)))
            out[np.ix_(own, own)] += products + products.T
    return out


def _correlation(here: Linearised) -> list[float]:
    """rho_1, rho_2, ... as far as they exceed chance."""
    shares: list[float] = []
    for k in range(1, LONGEST + 1):
        pairs = [(here.residuals[p][k:], here.residuals[p][:-k]) for p in here.unknowns.parts]
        n = sum(len(a) for a, _ in pairs)
        if n < 2 * k or here.cost <= 0.0:
            break
        share = sum(float(np.sum(a * b)) for a, b in pairs) / n * len(here.residuals) / here.cost
        if share < STANDARD_ERRORS / np.sqrt(n):
            break
        shares.append(share)
    return shares


def _scatter(here: Linearised, C: Float[np.ndarray, "m m"]) -> tuple[float, float]:
    """Variance of the place by the scatter over clusters over what is expected, and its degrees of freedom."""
    n = len(here.gradients)
    freedom = here.m * (n - 1.0)
    if freedom <= 0.0:
        return 1.0, np.inf
    moves = influences(here.gradients, here.hessians)[:, : here.m] * np.sqrt((n - 1.0) / n)
    ratio = float(np.trace(scaled_inverse(C) @ moves.T @ moves)) / here.m
    factor = ratio / (1.0 + SCATTER_ERRORS * np.sqrt(2.0 / freedom))
    return (factor, freedom) if factor > 1.0 else (1.0, np.inf)
