"""Rows that the demonstrator drives on purpose (b unknown): Lambda and the null-space policy together, from (q, u).

A Lambda of s rows accounts for all of u_n = Q_n c_n + Z_n w_n, Q_n and Z_n orthonormal bases of the row space and the
null space of A_n = Lambda Phi(q_n). w_n is a policy of the posture and white noise of variance sigma^2; c_n is the
motion of the task, an unknown signal in time. [Q Z] is orthonormal, so all Lambda, whatever their number of rows,
explain the same numbers, and their likelihoods can be compared. In nats

    l(Lambda) = - sum_k N_k / 2 (log S_k + 1) - d / 2 log n + log N(Z^T u; 0, sigma^2 I + K T K^T)

S_k is the mean square, per row, of Q c in octave k of the cosine transform of each recording, which has N_k entries; d
is the number of these octaves and of the entries of Lambda (Schwarz, 1978). A superfluous row turns a direction that
the policy predicts to the noise into an unknown one: it costs log(S / sigma^2) / 2 a sample. Held rows are judged by
the same l, with Z w for the signal in time and c for the noise.

The policy is pi(q) = Theta^T beta(q), Theta ~ N(0, T) with one variance for all parameters of a grade (the monomials
of one degree, the waves of one frequency), K = d (Z^T pi) / d Theta; Theta is integrated out. With C = K^T K,
P = sigma^2 T^-1 and theta the posterior mean of Theta,

    - 2 log N = n z log sigma^2 + log |C + P| - log |P| + (|Z^T (u - pi)|^2 + theta^T P theta) / sigma^2

The variances are maximum-likelihood estimates too (MacKay, 1992, Neural Computation 4(3), eq. (2.33) and following): a
degree that the data do not need has variance 0. Without noise the policy is a least-squares fit in an orthonormal basis
(variable projection: Golub and Pereyra, 1973). Lambda moves by Gauss-Newton steps on the Grassmann manifold (Kaufman,
1975).

`estimator="separate"` is the method of Towell, Howard and Vijayakumar (2010), equation (8) of Manavalan and Howard:

    min over the parameters of w~ of  sum_n ( w^_n . u_n - |w~_n| )^2,   w^ = w~ / |w~|

and then Lambda from A w~ = 0, equation (10). A low cost does not certify w~: w~ = 0 costs nothing, and where the null
space has more than one dimension so does any w~ on the sphere over w in it.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from copy import copy
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import combinations_with_replacement
from typing import Any

import numpy as np
from scipy.cluster.vq import kmeans2
from scipy.fft import dct
from scipy.linalg import LinAlgError, cholesky, eigh, solve_triangular
from scipy.spatial import cKDTree

from manip_learn.errors import NotIdentifiableError, advice, counted
from manip_learn.learning.fit import LEVEL, Errors, angles, solve, view_levels
from manip_learn.learning.table import CLEAR_GAP, LEAST_GAIN, WEAK_GAP, ZERO, Settings, Table, View
from manip_learn.linalg import invert_triangles, null_basis, orthonormal_rows, row_bases

POLYNOMIALS = ("constant", "affine", "quadratic", "cubic", "quartic", "quintic")
# grades of each policy model; "affine-offset" has a rest posture for each recording; "auto" drops grades from the end
# until the policy has few enough parameters
MODELS: dict[str, tuple[str, ...]] = {name: POLYNOMIALS[: degree + 1] for degree, name in enumerate(POLYNOMIALS)}
MODELS |= {"rbf": ("rbf32",), "affine-offset": ("affine", "offset"), "harmonic1": (*POLYNOMIALS[:2], "harmonic1")}
MODELS |= {"harmonic2": (*MODELS["harmonic1"], "harmonic2")}
MODELS |= {"auto": (*MODELS["harmonic1"], "quadratic", "cubic", "harmonic2")}
FIT_SIZE = 60_000  # velocities in the last fit: more hardly change the answer
ABOVE_NOISE = 1.5  # largest ratio of equal variances: to the noise, between joints, to motion without a policy
# shares of the energy: noise that is small enough for an answer, a thousandth of the speed, better than recorded
# velocities; and the smallest variance, a millionth of the speed, also with a rest posture of each recording. The
# square of the latter is rounding
RESOLUTION, MIN_VARIANCE = 1e-6, 1e-12
UNEXPLAINED = 0.3  # largest unexplained share of left-out motion; twice as much, on few samples, stops the search
MOST_UNCERTAIN = 30.0  # [deg] largest uncertainty of an answer
TINY = 1e-300  # keeps quotients finite
MOST_CENTRES, SAMPLES_PER_CENTRE = 96, 10  # radial functions of the policy that separates


def regressors(table: Table, grade: str, seed: int) -> np.ndarray:
    """Compute one group of regressors beta(q) of a null-space policy at all samples.

    Monomials are of the configuration shifted and scaled to about [-1, 1], call it x with m entries; they are scaled so
    that the sum of beta(x) beta(y) over the monomials of a degree is (x . y / m)^degree.

    Args:
        table: Samples, n of all recordings together.
        grade: Name of the group: one of `POLYNOMIALS` for the monomials of a degree; `"offset"` for a constant per
            recording; `"harmonic1"` or `"harmonic2"` for sines and cosines; `"rbf"` and a number of radial functions,
            e.g. `"rbf32"`.
        seed: Seed for the choice of the centres of the radial functions.

    Returns:
        Array (n, k).
    """
    low, high = table.q.min(axis=0), table.q.max(axis=0)
    angle, m = table.q - 0.5 * (low + high), table.q.shape[1]
    x = angle / np.maximum(0.5 * (high - low), 1e-9)
    if grade in POLYNOMIALS:
        degree = POLYNOMIALS.index(grade)
        terms = list(combinations_with_replacement(range(m), degree))
        repeats = [math.prod(math.factorial(t.count(i)) for i in range(m)) for t in terms]
        size = np.sqrt(math.factorial(degree) / (np.array(repeats) * m**degree))
        return np.stack([np.prod(x[:, t], axis=1) for t in terms], axis=1) * size
    if grade == "offset":  # a constant for each recording
        return np.eye(len(table.moved))[table.recording]
    if grade.startswith("harmonic"):
        wave = int(grade[-1]) * angle
        return np.concatenate([np.sin(wave), np.cos(wave)], axis=1) / math.sqrt(2.0 * m)
    rng = np.random.default_rng(seed)
    few = x if len(x) <= 4000 else x[rng.choice(len(x), 4000, replace=False)]
    centres, _ = kmeans2(few, min(int(grade[3:]), len(np.unique(few, axis=0))), minit="++", seed=rng)
    apart = max(float(cKDTree(centres).query(centres, 2)[0][:, 1].mean()), 1e-6)  # infinite for a single one
    d2 = np.sum((x[:, None] - centres) ** 2, axis=2) / (2.0 * (8.0 * apart) ** 2)  # eight times that distance
    phi = np.exp(d2.min(axis=1, keepdims=True) - d2)  # the nearest centre always counts
    return phi / phi.sum(axis=1, keepdims=True)


class Data:
    """Some samples of a view, with the regressors of a null-space policy; without regressors for held rows.

    Args:
        view: View with the whitened features.
        names: Names of the groups of regressors, see `regressors`; empty for held rows.
        seed: Seed for the choice of the centres of radial functions.
        some: Indices of the n samples to use.
        mixing: Matrix (nv, nv) by which velocities and features are multiplied to whiten the noise, see
            `noise_whitening`; None for the identity.

    Attributes:
        Phi, u: Features (n, r, nv) and joint velocities (n, nv), multiplied by `mixing`.
        beta, grades: Regressors (n, k), and the index (k,) of the group of each; variances are fitted per group.
        recording: Index (n,) of the recording of each sample.
        mixing: The matrix above.
        own: True if each recording has an offset of its own.
        mean_square: Mean square of the entries of `u`.
        floor: Smallest variance that is attributed to noise; a smaller residual only shows how well the regressors
            approximate the policy.
        enough: Largest residual variance at which nothing but noise remains.
    """

    def __init__(self, view: View, names: Sequence[str], seed: int, some: np.ndarray, mixing: np.ndarray | None = None):
        table, self.own = view.table, "offset" in names
        beta = [regressors(table, name, seed)[some] for name in names] or [np.zeros((len(some), 0))]
        self.beta = np.concatenate(beta, axis=1)
        self.grades = np.repeat(np.arange(len(beta)), [part.shape[1] for part in beta])
        self.recording = np.unique(table.recording[some], return_inverse=True)[1]
        self.mixing = np.eye(table.u.shape[1]) if mixing is None else mixing
        self.Phi, self.u = view.Phi[some] @ self.mixing.T, table.u[some] @ self.mixing.T
        self.mean_square = float(np.mean(self.u**2))
        self.floor = (MIN_VARIANCE if self.own else RESOLUTION) * self.mean_square
        self.enough = ABOVE_NOISE * max(self.floor, 0.0 if self.own else float(np.median(table.noise[some])))

    def parts(self, most: int) -> list[np.ndarray]:
        """Divide the samples into groups, e.g. for leaving out one group at a time.

        Groups consist of whole recordings, or of interleaved samples if each recording has an offset of its own.

        Args:
            most: Largest number of groups.

        Returns:
            Indices of the entries of the flattened `u` in each group.
        """
        n = self.recording[-1] + 1
        group = np.arange(len(self.u)) % most if self.own else self.recording * min(n, most) // n
        return [np.flatnonzero(np.repeat(group == g, self.u.shape[1])) for g in np.unique(group)]


def noise_whitening(table: Table) -> np.ndarray | None:
    """Return the matrix that makes the noise of the joint velocities equal and uncorrelated in all joints.

    The motion is smooth and the noise is not, so third differences e of the velocities show the noise. Its covariance S
    up to a factor is estimated from their directions, not their lengths, so that bursts have little weight (Tyler,
    1987: the mean of e e^T / (e^T S^-1 e) is S / nv).

    Args:
        table: Samples of all recordings.

    Returns:
        Inverse (nv, nv) of the Cholesky factor of S; None if the noise is similar in all joints, or if there are too
        few samples.
    """
    e, nv = np.diff(table.u, 3, axis=0)[table.recording[3:] == table.recording[:-3]], table.u.shape[1]
    e, S = e[np.any(e != 0.0, axis=1)], np.eye(nv)
    for _ in range(10 if len(e) >= 20 * nv else 0):
        S = (e / np.einsum("ni,ni->n", e, np.linalg.solve(S, e.T).T)[:, None]).T @ e
        S *= nv / np.trace(S)
    return np.linalg.inv(np.linalg.cholesky(S)) if np.linalg.cond(S) >= ABOVE_NOISE else None


class PolicyFit:
    """Fit of a null-space policy for one Lambda, with the derivatives by which Lambda is improved.

    The policy pi(q) = Theta^T beta(q) has the posterior mean of Theta with the most likely variances, or is a
    least-squares fit (`exact`). Its residual is e = N (u - pi), where N projects onto the null space of A = Lambda Phi.
    For held rows there is no policy and e = A^+ A u, equation (10) of Manavalan and Howard.

    Lambda changes to Lambda + B Lambda_perp with parameters B. D (n nv, k) is the derivative of N pi with respect to
    Theta, and J (n nv, m) the derivative of e with respect to B. With K = D back^T, the matrix K K^T projects a change
    of e onto the part that the policy can follow.

    Args:
        d: Samples with n velocities.
        rows: Lambda, whitened orthonormal rows (s, r).
        before: Fit for a similar Lambda, whose variances are the initial values; None for none.
        exact: True for a least-squares fit without noise; False for a Bayesian one.
    """

    def __init__(self, d: Data, rows: np.ndarray, before: PolicyFit | None = None, exact: bool = False):
        (n, nv), is_held = d.u.shape, not len(d.grades)
        self.d, self.rows, self.perp, self.exact = d, rows, null_basis(rows).T, exact or is_held
        Q, R = row_bases((rows @ d.Phi).transpose(2, 1, 0))
        Q = Q.transpose(2, 0, 1)
        N = np.eye(nv) - Q @ Q.transpose(0, 2, 1)
        duals = invert_triangles(R).transpose(2, 0, 1) @ Q.transpose(0, 2, 1)  # A^{+T} (n, s, nv)
        free = N @ (self.perp @ d.Phi).transpose(0, 2, 1)  # N (Lambda_perp Phi)^T (n, nv, k)
        self.N, self.n_driven = (np.eye(nv) - N, nv - len(rows)) if is_held else (N, len(rows))
        self.n_residuals, self.m = n * (nv - self.n_driven), len(rows) * len(self.perp)
        self.null = np.einsum("nij,nj->ni", self.N, d.u)
        self.energy = max(float(np.sum(self.null**2)), (1.0 if is_held else 1e-16) * float(np.sum(d.u**2)))
        self.D = np.einsum("nk,nvw->nvkw", d.beta, self.N).reshape(n * nv, -1)
        if self.exact:
            basis, T = np.linalg.qr(self.D)
            U, sigma, Vt = np.linalg.svd(T)
            regular = sigma > 1e-13 * np.max(sigma, initial=0.0)
            self.D, self.back = basis @ U[:, regular], np.eye(int(regular.sum()))
            self.precision, self.determined = np.zeros(len(self.back)), np.ones(len(d.grades))
            null = self.null.reshape(-1)
            self._with(Vt[regular].T @ (self.D.T @ null / sigma[regular]))
            self.e = null - self.D @ (self.D.T @ null)  # as small as rounding, where theta is not
            self.e -= self.D @ (self.D.T @ self.e)
            self.cost = self.residual = float(np.sum(self.e**2))
            self.noise = self.cost / self.n_residuals + TINY
        else:
            self._settle(before)
            self.cost = self.deviance(0.0)
        self.unexplained = self.residual / self.energy
        if is_held:
            J = np.einsum("nsv,nk->nvsk", duals, np.einsum("nvk,nv->nk", free, self.y))
        else:
            J = -np.einsum("nsv,nv->ns", duals, self.y)[:, None, :, None] * free[:, :, None, :]
        self.J = J.reshape(n * nv, self.m)
        self.KJ = self.back @ (self.D.T @ self.J)
        self.hessian = self.J.T @ self.J - self.KJ.T @ self.KJ  # of half the cost, the policy eliminated

    def _settle(self, before: PolicyFit | None) -> None:
        """Find the variances and Theta in turn."""
        C, pulled = self.D.T @ self.D, self.D.T @ self.null.reshape(-1)
        grade, size = np.repeat(self.d.grades, self.d.u.shape[1]), self.d.grades.max() + 1
        scale, least = self.d.mean_square, MIN_VARIANCE * self.d.mean_square
        first = (0.1 * scale, np.full(size, 4.0 * scale)) if before is None else (before.noise, before.variances[:size])
        self.noise, self.variances = first
        for i in range(5 if before is None else 3):
            if i:  # sums of squares over the numbers that the data determine
                used = np.bincount(grade, 1.0 - self.precision * np.sum(self.back**2, axis=0), size)
                self.determined = np.maximum(used, 1e-6)
                self.variances = np.maximum(np.bincount(grade, self.theta**2, size) / self.determined, least)
                self.noise = max(self.residual / max(self.n_residuals - float(self.determined.sum()), 1.0), least)
            self.precision = self.noise / self.variances[grade]
            size_of = 1.0 / np.sqrt(np.diag(C) + self.precision)
            M = size_of[:, None] * (C + np.diag(self.precision)) * size_of + 1e-11 * np.eye(len(C))
            self.back = solve_triangular(cholesky(M, lower=True), np.diag(size_of), lower=True)  # of (C + P)^-1
            self._with(self.back.T @ (self.back @ pulled))

    def _with(self, theta: np.ndarray) -> None:
        self.theta, self.y = theta, self.d.u - self.d.beta @ theta.reshape(-1, self.d.u.shape[1])
        self.e = np.einsum("nij,nj->ni", self.N, self.y).reshape(-1)
        self.residual = float(np.sum(self.e**2))

    def best(self, steps: int = 40) -> PolicyFit:
        """Improve Lambda by Levenberg-Marquardt steps, and drop groups of regressors that the data do not need.

        Args:
            steps: Largest number of steps.

        Returns:
            The fit with the smallest cost.
        """
        here, damping = self, 0.0
        for _ in range(steps):
            H = here.hessian
            B = -solve(H + damping * np.diag(np.diag(H)), here.J.T @ here.e)
            if not B @ H @ B >= RESOLUTION * here.noise or damping > 1e6:
                break
            needed = (here.determined >= min(0.1, np.max(here.determined, initial=0.0)))[here.d.grades]
            d = copy(here.d)
            d.beta, d.grades = d.beta[:, needed], d.grades[needed]
            turned = here.rows + B.reshape(len(here.rows), -1) @ here.perp
            there = PolicyFit(d, orthonormal_rows(turned), here, here.exact)
            if there.cost < here.cost:
                here, damping = there, 0.1 * damping if damping > 1e-9 else 0.0
            else:
                damping = max(1e-3, 10.0 * damping)
        return here

    def errors(self, rng: np.random.Generator) -> dict[str, np.ndarray]:
        """Draw random errors of the m parameters B of Lambda + B Lambda_perp.

        Errors by noise are a bootstrap over recordings. Residuals are corrected for being too small, because the fit
        follows them: (I - K K^T)^(-1/2) e is as large as the noise (Bell and McCaffrey, 2002). Errors by the policy
            come
        from the prior, which draws it towards zero by (C + P)^-1 P Theta (see the docstring of this module).

        Args:
            rng: Source of random numbers.

        Returns:
            Cause of the error (`"noise"`, `"policy"`) -> draws (k, m); empty if there is a single recording.
        """
        n_draws = 400  # bootstrap samples of the recordings
        parts, moves = self.d.parts(100), []
        if len(parts) < 2 or not self.m:
            return {}
        values, vectors = np.linalg.eigh(self.hessian)
        K = self.D @ self.back.T
        off = self.J - K @ (K.T @ self.J)
        both = np.concatenate([K, off @ (vectors / np.sqrt(np.maximum(values, 1e-14 * values[-1] + TINY)))], axis=1)
        for some in parts:
            e, (U, sigma, _) = self.e[some], np.linalg.svd(both[some], full_matrices=False)
            e = e + U @ ((np.maximum(1.0 - sigma**2, 1e-3) ** -0.5 - 1.0) * (U.T @ e))
            moves.append(solve(self.hessian, off[some].T @ e))
        w = rng.multinomial(len(parts), np.full(len(parts), 1.0 / len(parts)), size=n_draws) - 1.0
        out = {"noise": w @ np.array(moves) * math.sqrt(len(parts) / (len(parts) - 1.0))}
        if not self.exact:
            drawn = rng.standard_normal((n_draws, len(self.back))) * np.sqrt(self.precision * self.noise)
            out["policy"] = solve(self.hessian, (drawn @ self.back.T @ self.KJ).T).T
        return out

    def deviance(self, floor: float) -> float:
        """Return minus twice the log-likelihood of the null-space motion, -2 log N in the docstring of this module.

        Args:
            floor: Smallest allowed variance of the noise [(rad/s)^2].
        """
        noise, penalty = max(floor, self.noise), float(np.sum(self.precision * self.theta**2))
        volume = -2.0 * float(np.sum(np.log(np.diag(self.back)))) - float(np.sum(np.log(self.precision)))
        return self.n_residuals * math.log(noise) + volume + (self.residual + penalty) / noise

    def nats(self, floor: float) -> float:
        """Return the log-likelihood of Lambda [nats], l in the docstring of this module.

        Args:
            floor: Smallest allowed variance of the noise [(rad/s)^2].
        """
        d, n, squares, counts = self.d, len(self.d.u), np.zeros(64), np.zeros(64)
        for signal in np.split(d.u - self.null, np.flatnonzero(np.diff(d.recording)) + 1):
            octave = np.frexp(np.arange(len(signal)))[1]  # 0, then 1, 2-3, 4-7, ...
            squares += np.bincount(octave, np.sum(dct(signal, axis=0, norm="ortho") ** 2, axis=1), 64)
            counts += self.n_driven * np.bincount(octave, minlength=64)
        squares, counts = squares[counts > 0], counts[counts > 0]
        variance = np.maximum(squares / counts, floor)
        task = float(np.sum(counts * np.log(variance) + squares / variance))
        price = (self.m + len(counts)) * math.log(n)
        return n * float(np.linalg.slogdet(d.mixing)[1]) - 0.5 * (task + price + self.deviance(floor))

    @cached_property
    def held_out(self) -> float:
        """Cross-validated squared residual: the policy for each group of recordings is fitted to the other groups."""
        total, K_all = 0.0, self.D @ self.back.T
        for some in self.d.parts(10):
            K, e = K_all[some], self.e[some]
            rest = (1.0 + 1e-12) * np.eye(K.shape[1]) - K.T @ K
            total += float(np.sum((e + K @ np.linalg.solve(rest, K.T @ e)) ** 2))
        return total


def conditional_pca(d: Data, beta: np.ndarray) -> np.ndarray:
    """Return directions in the order of their task motion, a closed-form initial guess of Lambda.

    With G = (Phi Phi^T)^-1 Phi, the vector g = G u is G pi(q) + Lambda^T c. The residual of a regression of g on the
    configuration therefore lies in the row space of Lambda. Its covariance C is compared with the covariance of
    isotropic noise by the eigenproblem C x = e (sum G G^T) x.

    Args:
        d: Samples, n of them.
        beta: Regressors (n, k).

    Returns:
        Whitened directions as rows (r, r), the strongest task motion first.
    """
    GG = np.linalg.pinv(d.Phi @ d.Phi.transpose(0, 2, 1), rcond=1e-10, hermitian=True)
    g = np.einsum("npq,nqv,nv->np", GG, d.Phi, d.u, optimize=True)
    weight = 1.0 / np.maximum(np.einsum("npp->n", GG), TINY)  # near-singular postures count little
    root = np.sqrt(weight)[:, None]
    residual = g * root - beta * root @ np.linalg.lstsq(beta * root, g * root, rcond=1e-12)[0]
    S = np.einsum("n,nij->ij", weight, GG)
    S += 1e-14 * np.trace(S) / len(S) * np.eye(len(S))
    return (S @ eigh(residual.T @ residual, S)[1][:, ::-1]).T


def search(d: Data, rng: np.random.Generator) -> list[PolicyFit]:
    """Search for the most likely Lambda with each number of rows, without an initial guess.

    Args:
        d: A small subset of the samples.
        rng: Source of random initial guesses.

    Returns:
        Best fit for each number of rows.
    """
    # random starts if each recording has its own rest posture, which makes the cost bumpy; random starts otherwise;
    # random subspaces of the best rows
    own_starts, random_starts, subspaces = 100, 3, 10
    (_, r, nv), fits = d.Phi.shape, dict[int, PolicyFit]()

    def look(starts: Iterable[np.ndarray]) -> None:
        for start in starts:
            best = fits.get(len(start))
            if best is None or (best.noise > d.enough and best.m):
                here = PolicyFit(d, orthonormal_rows(start)).best(6)
                fits[len(start)] = here if best is None or here.cost < best.cost else best

    few = [b for b in (d.beta[:, d.grades < 2], d.beta) if 2 * b.shape[1] < len(d.u)]
    directions = [conditional_pca(d, b) for b in few] or [np.eye(r)]
    look(x[:s] for s in range(min(r, nv - 1) + 1) for x in directions)
    if select_likeliest(fits.values()).noise > d.enough:
        look(x for s in list(fits) for x in rng.standard_normal((own_starts if d.own else random_starts, s, r)))
    # try one row less, within the row space of the best: it contains the true rows if these are fewer
    s = r + 1
    while s > len(rows := select_likeliest(fits.values()).rows) > 1:
        s = len(rows)
        look(rng.standard_normal((subspaces, s - 1, s)) @ rows)
    return list(fits.values())


def select_likeliest(fits: Iterable[PolicyFit]) -> PolicyFit:
    """Return the most likely fit among those whose policy also predicts held-out recordings.

    The likelihood alone would prefer a flexible policy that overfits a few recordings.

    Args:
        fits: Fits with different numbers of rows.

    Returns:
        One of the fits.
    """
    some = [f for f in fits if f.held_out <= ABOVE_NOISE * max(f.energy, f.n_residuals * RESOLUTION * f.d.mean_square)]
    return max(some, key=lambda f: f.nats(f.d.floor)) if some else min(fits, key=lambda f: f.held_out)


@dataclass(eq=False)
class Imposed:
    """Self-imposed constraint: rows that the demonstrator drives on purpose, with their null-space policy.

    Attributes:
        view, fit: View (samples in one feature map), and the fit of rows and policy.
        gaps: Number of rows -> ratio that supports it; the larger, the clearer.
        likeliest: Number of rows with the largest likelihood.
        weak_gap: Smallest gap at which a number of rows counts as weakly supported.
        policy_model: Name of the policy model.
        policy_residuals: Policy model -> share of the motion energy that it leaves unexplained on held-out recordings.
        held_out: Share of the motion energy that is unexplained on held-out recordings.
        nats: Log-likelihood [nats].
        estimator: `"joint"` or `"separate"`, see `ConstraintLearner`.
        levels: Size of the motion along each direction, smallest first; empty for the joint estimator.
        uncertainty, errors: Parts of the uncertainty [deg], and draws of the error of the parameters.
        warnings: Warnings about the answer.
    """

    view: View
    fit: PolicyFit
    gaps: dict[int, float]
    likeliest: int
    weak_gap: float
    policy_model: str
    policy_residuals: dict[str, float]
    held_out: float
    nats: float = 0.0
    estimator: str = "joint"
    levels: np.ndarray = field(default_factory=lambda: np.zeros(0))
    uncertainty: dict[str, Any] = field(default_factory=dict)
    errors: Errors | None = None
    warnings: list[str] = field(default_factory=list)


def learn_imposed(views: list[View], settings: Settings) -> Imposed | NotIdentifiableError:
    """Learn a self-imposed constraint and its null-space policy, in the feature map with the largest likelihood.

    Args:
        views: One view (samples in one feature map) for each requested feature map.
        settings: Settings of the fit.

    Returns:
        The most likely constraint; or, if there is none, the error that states why, not raised.
    """
    table, learn = views[0].table, _separate if settings.estimator == "separate" else _joint
    best: Any = _unidentifiable(table, settings)
    for v in () if best else [v for v in views if v.r == views[0].r]:
        try:
            one = learn(v, settings)
        except LinAlgError:
            why = "the motion is too short or too uniform for a policy model: move further, and vary it"
            one = NotIdentifiableError(why, code="too-few-samples")
        if not isinstance(best, Imposed) or (isinstance(one, Imposed) and one.nats > best.nats + LEAST_GAIN):
            best = one
    if not isinstance(best, Imposed):
        return best
    if settings.estimator == "auto":
        rows = view_levels(best.view, table.wholes).directions[: len(best.fit.rows)]
        d = Data(best.view, (), 0, _subsample(table, FIT_SIZE))
        if best.held_out > UNEXPLAINED or best.nats <= PolicyFit(d, orthonormal_rows(rows)).nats(d.floor):
            return NotIdentifiableError("no policy of the posture explains this motion", code="no-task")
    return _add_warnings(best, settings)


def _unidentifiable(table: Table, settings: Settings) -> NotIdentifiableError | None:
    """Return the reason why the recordings cannot separate policy and task; None if there is none."""
    (n, nv), s, model = table.u.shape, settings.n_constraints or 1, settings.policy_model
    joint, names = settings.estimator != "separate", ", ".join(map(repr, MODELS))
    differ = "from other starts to other targets"
    one = "one trajectory does not show which part of it is driven on purpose: give several"
    same = f"the {len(table.moved)} recordings repeat one motion and show no more than one of them: give some that"
    reasons = (
        ("policy-model", model not in MODELS, f"unknown policy model {model!r}: use {names}"),
        ("no-freedom", s >= nv, f"{s} constraints leave no null space for {nv} joints"),
        ("one-trajectory", joint and len(table.moved) < 2, f"{one}, {differ}"),
        ("repeated-motion", joint and is_one_path(table), f"{same} differ, {differ}"),
        ("too-few-samples", n * (nv - s) < 2 * nv * (1 + nv), f"{n} samples are too few: record more"),
    )
    return next((NotIdentifiableError(why, code=code) for code, wrong, why in reasons if wrong), None)


def is_one_path(table: Table) -> bool:
    """Return True if all recordings repeat one motion, so that the policy is not known away from its path.

    Args:
        table: Samples of all recordings.
    """
    # largest RMS distance from a path that counts as a repetition, over the standard deviation of the motion
    same = 0.15
    paths: list[cKDTree] = []
    for t in table.moved:
        few, most = t.q[:: max(1, len(t) // 100)], same * float(np.linalg.norm(np.std(t.q, axis=0)))
        if not any(np.sqrt(np.mean(path.query(few)[0] ** 2)) < most for path in paths):
            paths.append(cKDTree(np.linspace(few[:-1], few[1:], 5).reshape(-1, t.q.shape[1])))
    return len(paths) < min(3, len(table.moved))


def _subsample(table: Table, most: int, offsets: bool = False) -> np.ndarray:
    """Return evenly spaced samples with at most `most` velocities; with offsets of recordings, of few recordings."""
    most_recordings = 16  # largest number of recordings in the search if each has an offset of its own
    few = np.flatnonzero(table.recording < (most_recordings if offsets else np.inf))
    return few[:: -(-len(few) * table.u.shape[1] // (most // (3 if offsets else 1)))]


def _joint(v: View, settings: Settings) -> Imposed | NotIdentifiableError:
    """Return the most likely Lambda on all samples, with the number of rows that is likeliest on few samples."""
    # models for motion without noise, with the fewest parameters first
    exact = ("affine", "harmonic1", "quadratic", "harmonic2", "cubic", "quartic", "quintic")
    # largest number of parameters of the policy: the time of a step grows with their cube; velocities in the search
    max_columns, n_compared = 400, 4500
    table, model, seed, nv = v.table, settings.policy_model, settings.seed, v.table.u.shape[1]
    has_offsets, auto, names = model == "affine-offset", model == "auto", list(MODELS[model])
    few, rng = _subsample(table, n_compared, has_offsets), np.random.default_rng(seed)
    while auto and nv * sum(regressors(table, g, seed).shape[1] for g in names) > max_columns:
        names.pop()

    if settings.estimator == "auto":  # if an affine policy predicts hardly anything, richer ones are not fitted
        plain = search(Data(v, MODELS["affine"], seed, few[:: -(-len(few) // 500)]), rng)
        if all(fit.held_out > 2.0 * UNEXPLAINED * fit.energy for fit in plain):
            return NotIdentifiableError("no policy of the posture explains this motion", code="no-task")

    def searched(mixing: np.ndarray | None) -> tuple[list[PolicyFit], PolicyFit]:
        fits, s = search(Data(v, names, seed, few, mixing), rng), settings.n_constraints
        return fits, (select_likeliest(fits) if s is None or s >= len(fits) else fits[s]).best()

    fits, best = searched(None)
    floor, energy = best.d.floor, len(few) * nv * best.d.mean_square
    noisy = len(few) * best.noise > 1e-2 * RESOLUTION * energy  # else by least squares, far below this resolution
    if noisy and (mixing := noise_whitening(table)) is not None:
        fits, best = max((fits, best), searched(mixing), key=lambda found: found[1].nats(floor))
    if len(best.rows) == 0:
        why = "a policy of the posture explains all motion, no direction is driven: record more, from other starts"
        return NotIdentifiableError(why, code="no-task")
    if auto and best.noise > best.d.enough:
        some = _subsample(table, n_compared, True)
        shared, apart = (PolicyFit(Data(v, g, seed, some), best.rows) for g in (names, MODELS["affine-offset"]))
        if apart.nats(apart.d.floor) > shared.nats(apart.d.floor):  # a rest posture of each recording explains more
            return _joint(v, replace(settings, policy_model="affine-offset"))
    names = [g for i, g in enumerate(names) if i in best.d.grades]
    fit, name = PolicyFit(Data(v, names, seed, _subsample(table, FIT_SIZE), best.d.mixing), best.rows), ""
    if noisy:
        fit = fit.best()
        used = [g for g, number in zip(names, fit.determined, strict=False) if number >= 1.0] or names
        name = "+".join([g for g in used if g in POLYNOMIALS][-1:] + [g for g in used if g not in POLYNOMIALS])
    nats = fit.nats(floor)
    for one in () if noisy else exact if auto else (model,):  # until the residual is rounding, or little more
        d = Data(v, MODELS[one], seed, few)
        if not fit.exact or (fit.cost > MIN_VARIANCE**2 * energy and nv * d.beta.shape[1] <= max_columns):
            there = PolicyFit(d, best.rows, exact=True).best(30)
            fit, name = (there, one) if not fit.exact or there.cost < 0.5 * fit.cost else (fit, name)
    name = name if auto else model.replace("rbf", "rbf32")
    share, weak = fit.held_out / fit.energy, math.sqrt(1.0 + 6.0 * math.sqrt(2.0 / len(few)))
    rms = [math.sqrt(max(f.held_out, MIN_VARIANCE * energy) / f.n_residuals) for f in fits]
    gaps = {k: rms[k - 1] / rms[k] for k in range(1, len(rms))}
    return Imposed(v, fit, gaps, max(len(select_likeliest(fits).rows), 1), weak, name, {name: share}, share, nats)


def _add_warnings(a: Imposed, settings: Settings) -> Imposed | NotIdentifiableError:
    """Return the answer with its uncertainty and warnings; or a refusal."""
    rows, is_given, s = a.fit.rows, settings.n_constraints is not None, counted(len(a.fit.rows), "row")
    gap, better = a.gaps.get(len(rows), 0.0), a.gaps.get(a.likeliest, 0.0)
    for part, B in a.fit.errors(np.random.default_rng(settings.seed)).items():
        a.uncertainty[part] = float(np.degrees(np.quantile(angles(rows, a.view.W, B), LEVEL)))
        total = B if a.errors is None else B + a.errors.noise
        a.errors = Errors(total, 0.0 * B, np.zeros((len(B), a.view.table.u.shape[1])))
    if a.estimator == "joint" and (deg := math.hypot(*a.uncertainty.values())) > MOST_UNCERTAIN:
        why = f"the rows are known to {deg:.0f} degrees only, at most {MOST_UNCERTAIN:g} are accepted"
        return NotIdentifiableError(f"{why}: record more, from other starts to other targets", code="uncertain")
    if not is_given and gap < a.weak_gap:
        why = f"no clear constraint: the gap is {gap:.2g} for {s}, at least {a.weak_gap:.3g} is needed"
        return NotIdentifiableError(why, code="weak-gap", gaps=a.gaps)
    if gap < CLEAR_GAP:
        why = "the constraint may be soft, or the recordings noisy"
        a.warnings.append(f"weak gap: {gap:.2g} for {s}, {CLEAR_GAP:g} is clear; {why}")
    if is_given and a.likeliest != len(rows) and better >= a.weak_gap:
        a.warnings.append(f"{s} learnt, but the gap supports {a.likeliest}: {better:.3g} against {gap:.3g}")
    if a.held_out > UNEXPLAINED and a.estimator == "joint":
        part = f"{100 * (1 - a.held_out):.0f} % of left-out trajectories"
        a.warnings.append(f"the policy predicts only {part}: the null-space motion is not a function of the posture")
    return a


# ------------------------------------------------------------------------------------------ the method of the paper


def separate_null_motion(view: View, seed: int) -> np.ndarray | NotIdentifiableError:
    """Estimate the null-space component of the motion, equation (8) of Manavalan and Howard.

    Args:
        view: View with the samples.
        seed: Seed for the choice of the radial functions.

    Returns:
        Null-space velocity (n, nv) at each sample; or, if it cannot be estimated, the error that states why, not
        raised.
    """
    # least number of radial functions; for each stage, the least singular value of the regressors, relative to the
    # largest, and the relative gain at which the stage ends
    fewest, stages = 4, ((1e-6, 1e-3), (1e-8, 1e-3), (1e-10, 1e-9))
    u, n = view.table.u, min(MOST_CENTRES, len(view.table.q) // SAMPLES_PER_CENTRE)
    if n < fewest:
        why = f"{len(u)} samples are too few to separate task and null-space part: "
        return NotIdentifiableError(f"{why}{fewest * SAMPLES_PER_CENTRE} are needed", code="too-few-samples")
    beta, few = regressors(view.table, f"rbf{n}", seed), slice(None, None, -(-len(u) // 4000))
    # orthonormal combinations of the regressors, from coarse to fine: the finest alone ends in poor minima
    basis, sigma, Vt = np.linalg.svd(beta[few], full_matrices=False)
    x = (basis[:, sigma > stages[0][0] * sigma[0]].T @ u[few]).reshape(-1)
    for share, gain in stages:
        finest = basis[:, sigma > share * sigma[0]]
        x = np.append(x, np.zeros(finest.shape[1] * u.shape[1] - x.size))
        damping, (e, J) = 1e-3, residual_and_jacobian(x, finest, u[few])
        for _ in range(200):
            H = J.T @ J  # by Levenberg and Marquardt
            there = x - np.linalg.solve(H + damping * np.diag(H).mean() * np.eye(len(H)), J.T @ e)
            after = residual_and_jacobian(there, finest, u[few])
            less = 1.0 - float(np.sum(after[0] ** 2)) / max(float(e @ e), TINY)
            damping *= 0.1 if less > 0.0 else 10.0
            x, (e, J) = (there, after) if less > 0.0 else (x, (e, J))
            if 0.0 <= less < gain or damping > 1e6:
                break
    k = x.size // u.shape[1]
    w = beta @ ((Vt[:k].T / sigma[:k]) @ x.reshape(k, -1))
    if np.sum(w**2) < ZERO * np.sum(u**2):
        use = advice("; use {}", "estimator='joint'", "--estimator joint")
        return NotIdentifiableError(f"no null-space motion remains without the task{use}", code="no-null-motion")
    return w


def residual_and_jacobian(weights: np.ndarray, basis: np.ndarray, u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    r"""Return the residual of equation (8) of Manavalan and Howard at each sample, and its derivative.

    With the estimate w of the null-space component and its direction :math:`\hat w = w / |w|`,

    .. math::

        e = \hat w^T u - |w|, \qquad \frac{\partial e}{\partial w} = \frac{u - (\hat w^T u) \, \hat w}{|w|} - \hat w

    Args:
        weights: Weights (k nv,), flattened (k, nv); w is the product of basis and weights.
        basis: Regressors (n, k).
        u: Joint velocities (n, nv) [rad/s or m/s].

    Returns:
        Residual (n,), and its derivative (n, k nv) with respect to the weights.
    """
    w = basis @ weights.reshape(basis.shape[1], -1)
    length = np.maximum(np.linalg.norm(w, axis=1, keepdims=True), TINY**0.5)
    direction = w / length
    along = np.einsum("nv,nv->n", direction, u)[:, None]
    slope = (u - along * direction) / length - direction
    return (along - length)[:, 0], (basis[:, :, None] * slope[:, None, :]).reshape(len(u), -1)


def _separate(v: View, settings: Settings) -> Imposed | NotIdentifiableError:
    """Separate u into task and null-space part, then learn Lambda from A w~ = 0."""
    w, table, u = separate_null_motion(v, settings.seed), copy(v.table), v.table.u
    if isinstance(w, NotIdentifiableError):
        return w
    table.u, name = w, f"rbf{min(MOST_CENTRES, len(w) // SAMPLES_PER_CENTRE)}"
    null, length = View(v.features, table), np.maximum(np.linalg.norm(w, axis=1), TINY**0.5)
    cost = float(np.sum((np.einsum("nv,nv->n", w, u) / length - length) ** 2) / np.sum(u**2))
    levels, directions, gaps = view_levels(null, table.wholes)
    likely = max(gaps, key=lambda s: gaps[s])
    rows = orthonormal_rows(directions[: settings.n_constraints or likely])
    fit = PolicyFit(Data(null, (), 0, np.arange(len(w))), rows).best()
    return Imposed(v, fit, gaps, likely, WEAK_GAP, name, {name: cost}, fit.unexplained, 0.0, "separate", levels)
