"""What the stated angle of a row space is made of: noise, by the bootstrap; the joints' zeros; the policy's model.

Joint offsets: a constant error of each joint's zero does something to a Lambda learnt from A(q) u = 0. Recorded
q + delta in place of q leaves a pattern in the residual e_n = Q_n^T u_n, A^T = Q R:

    e = J B + K delta + noise,    K_n,k = R_n^{-T} Lambda (dPhi/dq_k) N_n u_n,    N = I - Q Q^T

to first order, of which B takes up what it can: an error -(J^T J)^-1 J^T K delta of Lambda. What is left of the
pattern tells how large the offsets are. With delta ~ N(0, (z^2 + tau^2) I), S = K^T (I - J J^+) K = V diag(lambda) V^T
and h = V^T K^T e the likelihood of tau is

    h_i ~ N(0, lambda_i sigma^2 + lambda_i^2 (z^2 + tau^2))   (restricted maximum likelihood: B is eliminated)

z is what is thought of the arm beforehand (`ArmErrors`): a combination that shows nowhere is as large as that, and one
that shows is as large as it is seen to be. Errors of the links are further columns of K, scaled to those of the zeros,
so that delta stands for both. That the arm is as was thought, tau = 0, is NONE_TO_SOME times as likely beforehand as
tau in OFFSET_RANGE_RAD altogether; the data decide.

The regressor is made of N u and not of u. Both are N u on the constraint, but the rest of u is the residual itself:
with it K v of a combination v that no motion shows is made of the noise of e alone (errors in variables; W. A. Fuller,
Measurement Error Models, 1987, section 1.1), and K^T e grows with the data however large the offsets are. The noise of
N u is independent of that of Q^T u where that of u is alike in all joints. A turn v of the base gives Lambda dPhi[v] =
Lambda [w] Phi, so that K v lies in the span of J exactly, at any noise: no residual shows it, whatever the recordings.
Beyond z, a combination that shows nowhere is taken to be as large as the others are found to be.

How well mu = sqrt(det(A A^T)) is known follows from the same draws of dB and delta, at the postures that were shown:

    d log mu = tr(A^+ dA) - tr(Lambda^+ dLambda),      dA = dB Lambda_perp Phi + Lambda dPhi[delta]

A turn of the base changes Lambda and leaves mu as it is.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import final

import numpy as np
from jaxtyping import Float, Int

from manip_learn.constraint.features.feature_map import FeatureMap
from manip_learn.constraint.features.mechanism_rows import MechanismRows
from manip_learn.errors import NotIdentifiableError, error_in_words, listed
from manip_learn.learning.arm_errors import AS_DESCRIBED, ArmErrors, changes_by_links
from manip_learn.learning.estimate import RESIDUAL_RATIO, Estimate, PolicyPrior, split
from manip_learn.learning.samples import Samples, rows_beside, runs
from manip_learn.linalg import complement_rows, row_space_angles, whitener
from manip_learn.recordings.trajectory import evenly

# share of the cases in which the truth lies within a stated angle: one standard deviation of a normal error, rounded
STATED_SHARE = 0.68
# [deg] 68 % within this angle is no answer: of all directions in space 13 % are as close to any
MOST_UNCERTAIN_DEG = 30.0
# [rad] offsets of the joints' zeros to be thought of: from an encoder's rounding to what the eye sees
OFFSET_RANGE_RAD = (1e-6, 3e-2)
# odds beforehand of no offsets: strong evidence for them is wanted (Kass and Raftery, 1995). At even odds 11 of 180
# sets of drawers with 1e-3 rad of noise alone got stated angles three times too wide (100 Hz, seeds from 30000)
NONE_TO_SOME = 20.0

NOISE, JOINT_ZEROS, POLICY = PARTS = ("noise", "joint zeros", "policy")
Uncertainty = dict[str, float | None]

# draws of an error whose quantile is stated: uncertain by 5 %
_DRAWS = 1000
# postures at which the error of mu is looked at, and singular values of A below which it is none [share of the largest]
MU_POSTURES, MU_SINGULAR = 48, 1e-6
PLACE_STEP = 1e-6  # [m, rad] of the differences along a place
# least share of the residual that is left where a trajectory alone determines a direction, so that its influence on
# that direction is bounded
LEVERAGE_FLOOR = 1e-3
# steps of Lanczos' method after which all eigenvectors cost no more, and what is rounding in them
MOST_STEPS, _SPENT = 64, 1e-14
TAU_STEPS = 60  # of four and a half decades: 19 per cent each
_MOST_SAMPLES = 5000  # enough to see offsets
LEAST_VARIANCE = 1e-200  # of a residual: none at all is a limit, not a division by zero
UNSEEN = 1e-12  # share of |K|^2 below which the curvature of a combination of offsets shows nowhere


def uncertainty_of(
    samples: Samples, estimate: Estimate, rng: np.random.Generator, arm: ArmErrors = AS_DESCRIBED
) -> tuple[Uncertainty, float | None]:
    """Each part of what the error of a row space stays below in 68 % of cases [deg], by the names in `PARTS`; and the
    share of mu within which it is known at the postures that were shown.

    None where a part does not apply: the joints' zeros of any but the null-space estimator, the policy of any but the
    joint one with its parameters integrated out, and all of them with a single trajectory or where there is only one
    possible row space.

    Raises:
        NotIdentifiableError: A joint estimate that is known too badly for an answer.
    """
    whitened, prior = estimate.whitened_selection, estimate.prior
    power = 0.5
    if estimate.name == "null-space" and not estimate.is_held:
        # whether single trajectories differ by more than noise makes them, as of a thing that gives way
        white = (
            estimate.gradients @ whitener(estimate.hessians.sum(axis=0)).T
        )  # each of variance sigma^2 by noise alone
        sigma2 = estimate.unexplained * samples.energy / estimate.n_rows
        power = 1.0 if np.sum(white**2) > RESIDUAL_RATIO**2 * sigma2 * white.shape[1] else 0.5
    noise = bootstrap_errors(whitened, estimate.gradients, estimate.hessians, rng, prior=prior, power=power)
    if noise is None:
        return dict.fromkeys(PARTS), None
    s, r = whitened.shape
    offsets = JointOffsets.of(samples, whitened, arm) if estimate.name == "null-space" else None
    delta = None if offsets is None else offsets.draws(_DRAWS, rng)
    errors = {
        NOISE: noise,
        JOINT_ZEROS: None if offsets is None or delta is None else delta @ offsets.response.T,
        POLICY: None if prior is None else prior.errors(estimate.hessians, s * (r - s), _DRAWS, rng),
    }
    parts = {part: None if e is None else angle_within_deg(samples, whitened, e) for part, e in errors.items()}
    check_uncertainty(estimate, total_deg(parts))
    moved = np.sum([np.resize(e, (_DRAWS, e.shape[1])) for e in errors.values() if e is not None], axis=0)
    return parts, _mu_within(samples, whitened, moved, delta, arm)


def _mu_within(
    samples: Samples,
    whitened_selection: Float[np.ndarray, "s r"],
    errors: Float[np.ndarray, "k m"],
    delta: Float[np.ndarray, "k e"] | None,
    arm: ArmErrors,
) -> float:
    """|d log mu| that errors of B, and of the arm, stay below in 68 % of draws and postures."""
    q, features = samples.q[evenly(len(samples), MU_POSTURES)], samples.features
    both = np.concatenate([whitened_selection, complement_rows(whitened_selection)]) @ samples.whitening
    Lambda, beside = np.split(both, [len(whitened_selection)])
    Phi = features.batch(q)
    back = np.linalg.pinv(Lambda @ Phi, rcond=MU_SINGULAR)
    by_rows = (beside @ Phi @ back).transpose(0, 2, 1) - (beside @ np.linalg.pinv(Lambda)).T
    change = errors @ by_rows.reshape(len(q), -1).T
    if delta is not None:
        change += delta @ _mu_by_the_arm(features, q, back @ Lambda, arm.ratio)
    return float(np.quantile(np.abs(change), STATED_SHARE))


def _mu_by_the_arm(
    features: FeatureMap, q: Float[np.ndarray, "n nq"], back: Float[np.ndarray, "n nv p"], ratio: float
) -> Float[np.ndarray, "e n"]:
    """tr(A^+ Lambda dPhi) by each error of the arm, at each posture; `back` is A^+ Lambda."""
    moved = features.batch_with_derivative(q)[1]
    if ratio:
        every = np.broadcast_to(np.eye(features.nv), (len(q), features.nv, features.nv))
        moved = np.concatenate([moved, ratio * changes_by_links(features, q, every)], axis=3)
    return np.einsum("nvp,npve->en", back, moved)


def mu_within_place(
    rows: MechanismRows,
    q: Float[np.ndarray, "n nv"],
    numbers: Float[np.ndarray, "k 7"],
    radius: Float[np.ndarray, "k r"],
    delta: Float[np.ndarray, "k e"],
    arm: ArmErrors,
) -> float:
    """|d log mu| of all rows of a mechanism that errors of its place, and of the arm, stay below in 68 % of draws and
    postures. `delta` are errors of the arm that belong to those of the place, axis, point, pitch and radius.
    """
    q, place, change = q[evenly(len(q), MU_POSTURES)], rows.geometry, np.zeros((len(numbers), 1))

    def log_mu(step: Float[np.ndarray, " 7"], longer: float) -> Float[np.ndarray, " n"]:
        moved, size = place.moved(step), None if rows.radius is None else rows.radius + longer
        where = {"axis": moved.axis, "point": moved.point, "pitch": moved.pitch}
        there = MechanismRows(rows.robot, rows.frame.name, rows.row_names, **where, radius=size)
        return np.log(np.linalg.svd(there.batch(q), compute_uv=False) + np.finfo(np.float64).tiny).sum(axis=1)

    directions = np.eye(8)[: 8 if rows.radius is not None and radius.shape[1] else 7]
    for step, by in zip(directions, np.concatenate([numbers, radius], axis=1).T, strict=False):
        slope = (log_mu(PLACE_STEP * step[:7], PLACE_STEP * step[7]) - log_mu(np.zeros(7), 0.0)) / PLACE_STEP
        change = change + by[:, None] * slope
    change = change + delta @ _mu_by_the_arm(rows, q, np.linalg.pinv(rows.batch(q), rcond=MU_SINGULAR), arm.ratio)
    return float(np.quantile(np.abs(change), STATED_SHARE))


def total_deg(parts: Uncertainty) -> float | None:
    """Root of the sum of the squares of the parts there are [deg]; None if there are none."""
    known = [part for part in parts.values() if part is not None]
    return float(np.linalg.norm(known)) if known else None


def check_uncertainty(estimate: Estimate, uncertainty_deg: float | None) -> None:
    """Refuse a joint estimate that says next to nothing; one of held rows has gap and recombination to stand on.

    Raises:
        NotIdentifiableError: It is known to more than `MOST_UNCERTAIN_DEG` only.
    """
    if estimate.name == "joint" and uncertainty_deg is not None and uncertainty_deg > MOST_UNCERTAIN_DEG:
        raise NotIdentifiableError(
            f"record more trajectories, from other starts to other targets: these tell the rows to "
            f"{uncertainty_deg:.0f} degrees only, and beyond {MOST_UNCERTAIN_DEG:g} that is no answer",
            code="uncertain",
        )


def parts_in_words(parts: Uncertainty, reference: str | None) -> str:
    """What a stated angle is made of, and what no recording shows of it: `"noise 0.002 degrees; not included: ..."`.

    No part is there where a mechanism's numbers alone are stated, with the joints' zeros among them. Rows in axes of
    the tool (reference `"local"`) do not care how the base stands.
    """
    known = [f"{name} {error_in_words(part, 'degrees')}" for name, part in parts.items() if part is not None]
    missing = ["joint zeros that are off"] if known and parts[JOINT_ZEROS] is None else []
    missing += [] if reference == "local" else ["a base that stands turned, which no recording can show"]
    said = ", ".join(known) or "scatter of the samples"
    return f"{said}; not included: {listed(missing)}" if missing else said


def bootstrap_errors(
    whitened_selection: Float[np.ndarray, "s r"],
    gradients: Float[np.ndarray, "g d"],
    hessians: Float[np.ndarray, "g d d"],
    rng: np.random.Generator,
    repetitions: int = 200,
    prior: PolicyPrior | None = None,
    power: float = 0.5,
) -> Float[np.ndarray, "k m"] | None:
    """Errors B of Lambda + B Lambda_perp, one for each repetition.

    Each repetition draws trajectories with replacement, because samples of one trajectory are not independent, and
    moves Lambda by the sum of their influences. The influence of a trajectory is its share of the Gauss-Newton step,
    corrected for its leverage: its residual in the fit to all data is too small, the more so the fewer trajectories
    there are and the more freedom the policy model has.

    The gradients and Gauss-Newton Hessians are those of each trajectory, or block of them, at the optimum; their last
    s (p'-s) unknowns are those of Lambda, others before them are eliminated. The prior of the policy's parameters is
    what the Hessians leave out; for the power see `influences`. None with fewer than two trajectories or no freedom.
    """
    s, r = whitened_selection.shape
    n, m = gradients.shape[0], s * (r - s)
    if n < 2 or m == 0:
        return None
    influence = influences(gradients, hessians, prior, power)[:, -m:]
    weights = rng.multinomial(n, np.full(n, 1.0 / n), size=repetitions) - 1.0
    # where few trajectories carry most of the influence their spread is itself uncertain: Student's distribution
    energy = np.sum((influence @ whitener(influence.T @ influence).T) ** 2, axis=1)
    freedom = max(float(energy.sum() ** 2 / np.sum(energy**2)), 2.0)
    spread = np.sqrt(rng.chisquare(freedom, size=repetitions) / freedom)
    return (-weights @ influence) / spread[:, None]


def angle_within_deg(
    samples: Samples,
    whitened_selection: Float[np.ndarray, "s r"],
    steps: Float[np.ndarray, "k m"],
    quantile: float = STATED_SHARE,
) -> float:
    """Angle [deg] within which a share of the errors B of Lambda + B Lambda_perp leaves its row space."""
    s, r = whitened_selection.shape
    turns = steps.reshape(len(steps), s, r - s) @ complement_rows(whitened_selection)
    angles = row_space_angles((whitened_selection + turns) @ samples.whitening, samples.selection(whitened_selection))
    return float(np.degrees(np.quantile(angles, quantile)))


def influences(
    gradients: Float[np.ndarray, "g d"],
    hessians: Float[np.ndarray, "g d d"],
    prior: PolicyPrior | None = None,
    power: float = 0.5,
) -> Float[np.ndarray, "g d"]:
    """Contribution of each trajectory to the error, centred, its residual corrected for the leverage on the fit.

    In coordinates where the sum of the Hessians is I, the gradient of a trajectory at the optimum has the covariance
    sigma^2 H_i (I - H_i), since the fit follows its own data; (I - H_i)^(-1/2) restores sigma^2 H_i (bias-reduced
    linearisation, Bell and McCaffrey, 2002; HC2 where a trajectory has one sample). That is for noise within
    trajectories. Rows that are held softly differ between them, by more than the noise: with the power 1 the
    influence is that of leaving a trajectory out (the jackknife). A prior adds to the sum.
    """
    n, d = gradients.shape
    total = hessians.sum(axis=0) if prior is None else hessians.sum(axis=0) + np.diag(prior.precision)
    back = whitener(total).T
    steps = np.empty((n, d))
    for i in range(n):
        steps[i] = back @ _without_leverage(hessians[i], back, back.T @ gradients[i], power)
    return np.sqrt(n / (n - 1.0)) * (steps - steps.mean(axis=0))


def _without_leverage(
    hessian: Float[np.ndarray, "d d"], back: Float[np.ndarray, "d k"], gradient: Float[np.ndarray, " k"], power: float
) -> Float[np.ndarray, " k"]:
    """(I - back^T H back)^-power times a vector, by Lanczos' method where a few of its steps suffice.

    One trajectory determines few directions of many, so that its share of the Hessian has few eigenvalues that count;
    the Krylov space of the gradient holds what these do to it (Golub and Van Loan, 2013, section 10.1).
    """
    k, size = len(gradient), float(np.linalg.norm(gradient))
    most = min(MOST_STEPS, k // 4)
    if size == 0.0 or most < 2:
        return _by_eigenvectors(back.T @ hessian @ back, gradient, power)
    basis, T = np.empty((most, k)), np.zeros((most, most))
    basis[0] = gradient / size
    before = np.zeros(most)
    for j in range(most):
        next_one = back.T @ (hessian @ (back @ basis[j]))
        T[j, j] = basis[j] @ next_one
        for _ in range(2):  # once more, against the loss of orthogonality
            next_one -= (basis[: j + 1] @ next_one) @ basis[: j + 1]
        length = float(np.linalg.norm(next_one))
        if length <= _SPENT or j % 4 == 3:
            now = np.zeros(most)
            now[: j + 1] = _by_eigenvectors(T[: j + 1, : j + 1], np.eye(j + 1)[0], power)
            if length <= _SPENT or np.linalg.norm(now - before) <= _SPENT * np.linalg.norm(now):
                return size * (now[: j + 1] @ basis[: j + 1])
            before = now
        if j + 1 < most:
            basis[j + 1] = next_one / length
            T[j, j + 1] = T[j + 1, j] = length
    return _by_eigenvectors(back.T @ hessian @ back, gradient, power)


def _by_eigenvectors(
    share: Float[np.ndarray, "k k"], vector: Float[np.ndarray, " k"], power: float
) -> Float[np.ndarray, " k"]:
    """(I - S)^-power times a vector, no eigenvalue of (I - S)^(2 power) smaller than LEVERAGE_FLOOR."""
    values, axes = np.linalg.eigh(share)
    return axes @ ((axes.T @ vector) / np.sqrt(np.maximum((1.0 - values) ** (2.0 * power), LEVERAGE_FLOOR)))


@final
@dataclass(frozen=True, eq=False)
class JointOffsets:
    """What the residual says about the offsets of the joints' zeros, and of the links where these are thought of.

    Attributes:
        response: -(J^T J)^-1 J^T K, the error of B that offsets make, shape (m, e) [1/rad].
        directions: V, shape (e, e).
        curvatures: lambda, shape (e,).
        pattern: h, shape (e,).
        variance: sigma^2 by which the patterns' shares scatter, see `variance_of` [(rad/s)^2].
        expected: z, standard deviation of the offsets beforehand [rad].
    """

    response: Float[np.ndarray, "m e"]
    directions: Float[np.ndarray, "e e"]
    curvatures: Float[np.ndarray, " e"]
    pattern: Float[np.ndarray, " e"]
    variance: float
    expected: float = 0.0

    @staticmethod
    def of(
        samples: Samples, whitened_selection: Float[np.ndarray, "s r"], arm: ArmErrors = AS_DESCRIBED
    ) -> JointOffsets | None:
        """From the residual of A u = 0 at the optimum; None where Lambda has no freedom or nothing is left over."""
        s, r = whitened_selection.shape
        if s == r or samples.q.shape[1] != samples.nv:
            return None
        # e, J and K of all samples, row by row; K of the links, too, as many times that of the zeros as the ratio is
        few = samples.thinned(_MOST_SAMPLES)
        both = np.concatenate([whitened_selection, complement_rows(whitened_selection)])
        rows = np.concatenate([rows_beside(both, block.Phi) for block in few.blocks()], axis=2)
        along, null, back = split(rows[:s], np.ascontiguousarray(few.u.T))
        moved = np.einsum("npvk,vn->npk", few.features.batch_with_derivative(few.q)[1], null, optimize=True)
        if arm.ratio:
            by_links = changes_by_links(few.features, few.q, null.T[:, :, None])[:, :, 0]
            moved = np.concatenate([moved, arm.ratio * by_links], axis=2)
        dA_null, e = (whitened_selection @ few.whitening) @ moved, along.T.reshape(-1)
        J = np.einsum("sin,kn->nisk", back, np.einsum("kvn,vn->kn", rows[s:], null)).reshape(len(e), -1)
        K = np.einsum("sin,nsk->nik", back, dA_null, optimize=True).reshape(len(e), -1)
        exact = float(e @ e) <= 1e-20 * len(few) * samples.energy
        if len(e) <= J.shape[1] + K.shape[1] or (exact and not arm.zeros):
            return None
        response = -np.linalg.lstsq(J, np.concatenate([K, e[:, None]], axis=1), rcond=1e-12)[0]
        rest = K + J @ response[:, :-1]
        e = e + J @ response[:, -1]
        # neither curvature nor pattern is scaled up to all samples: chance in the pattern would look like offsets
        offsets, patterns = JointOffsets.of_residual(e, rest, response[:, :-1], float(np.sum(K * K)))
        unknowns = np.concatenate([J, patterns], axis=1)
        variance = variance_of(e - patterns @ (patterns.T @ e), unknowns, np.repeat(few.trajectory, s))
        return dataclasses.replace(offsets, variance=variance, expected=arm.zeros)

    @staticmethod
    def of_residual(
        e: Float[np.ndarray, " k"], rest: Float[np.ndarray, "k e"], response: Float[np.ndarray, "m e"], size: float
    ) -> tuple[JointOffsets, Float[np.ndarray, "k s"]]:
        """By a residual and what the unknowns leave of K, of which |K|^2 is the size; the variance is that of what the
        patterns leave, sample by sample. And the patterns, orthonormal.
        """
        curvatures, V = np.linalg.eigh(rest.T @ rest)
        seen = curvatures > UNSEEN * size
        patterns = rest @ (V[:, seen] / np.sqrt(curvatures[seen]))
        left = e - patterns @ (patterns.T @ e)
        pattern, curvatures = (np.where(seen, one, 0.0) for one in (V.T @ (rest.T @ e), curvatures))
        return JointOffsets(response, V, curvatures, pattern, float(left @ left) / len(e)), patterns

    def draws(self, n: int, rng: np.random.Generator) -> Float[np.ndarray, "n e"]:
        """Draws of the offsets, given the data; `response` times these are errors of B."""
        taus = np.concatenate([[0.0], np.geomspace(*OFFSET_RANGE_RAD, TAU_STEPS)])
        tau2 = self.expected**2 + taus[:, None] ** 2
        lam, sigma2 = self.curvatures, max(self.variance, LEAST_VARIANCE)
        seen = lam > 0.0
        spread = lam[seen] * sigma2 + lam[seen] ** 2 * tau2
        log_weight = -0.5 * np.sum(np.log(spread) + self.pattern[seen] ** 2 / spread, axis=1)
        log_weight[1:] -= np.log(NONE_TO_SOME * TAU_STEPS)
        weight = np.exp(log_weight - log_weight.max())
        drawn = tau2[rng.choice(len(taus), n, p=weight / weight.sum())]
        shrink = drawn / (sigma2 + lam * drawn)  # posterior variance over sigma^2
        # drawn along the joints, so that rounding, which chooses among directions that are alike, does not matter
        normal = rng.standard_normal((n, len(self.directions))) @ self.directions
        delta = shrink * self.pattern + np.sqrt(shrink * sigma2) * normal
        return delta @ self.directions.T


def variance_of(e: Float[np.ndarray, " k"], M: Float[np.ndarray, "k d"], trajectory: Int[np.ndarray, " k"]) -> float:
    """sigma^2 for which the unknowns of M, fitted to e, have the covariance sigma^2 (M^T M)^-1 in the mean.

    By how their shares scatter over the trajectories, as in the bootstrap: neighbours share their noise where
    velocities are derived from positions, by how much depends on the window, and a pattern over the postures is a sum
    of many of them. Of one trajectory the residual has to do.
    """
    parts, white = [part for _, part in runs(trajectory)], float(e @ e) / (len(e) - M.shape[1])
    if len(parts) < 2:
        return white
    gradients = np.array([M[part].T @ e[part] for part in parts])
    hessians = np.array([M[part].T @ M[part] for part in parts])
    moves = influences(gradients, hessians)
    return max(white, float(np.einsum("gi,ij,gj->", moves, hessians.sum(axis=0), moves)) / M.shape[1])
