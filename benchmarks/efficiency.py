"""How close the joint estimator comes to the Cramer-Rao bound, and how often its stated 68 % interval holds the truth.

    python benchmarks/efficiency.py                       # the table, 100 sets a line
    python benchmarks/efficiency.py --sets 20 --arm planar3 --policy affine --noise 0.01

Bound: the recorded u_n = A_n^+ b_n + N_n Theta^T beta(q_n) + noise of variance sigma^2, with every b_n and Theta
unknown. What b_n can imitate is the row space of A_n, so that Z_n^T u_n is what is left to learn from. With
dLambda = B Lambda_perp, y = (mean of u) - pi and K_n = d (Z_n^T pi) / d Theta

    J_n,ij = -Z_n^T (Lambda_perp,j Phi_n)^T (A_n^{+T} y_n)_i ,   J~ = J - K K^+ J ,   cov B >= sigma^2 (J~^T J~)^-1

for unbiased estimators that know the class beta of the policy. Noise of a covariance Sigma = L L^T: the same for
L^-1 u, Phi L^-T and L^-1 pi. A line gives the root of the mean (and of the median) of |B|^2 / trace of the bound over
the sets; the median of a chi-square is below its mean: an efficient estimator has 0.83 there for two unknowns.
"""

from __future__ import annotations

import argparse
import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from manip_learn.constraint.features.frame_jacobian import FrameJacobian
from manip_learn.learning import ConstraintLearner
from manip_learn.recordings.trajectory import Demonstrations, Trajectory
from manip_learn.robot import load_robot

PLANAR_ROWS = ([0, 1], [0, 2], [1, 2])
ARMS = ("planar3", "sawyer")
POLICIES = ("affine", "quadratic", "sinusoidal", "fast-sinusoidal", "mixed-sinusoidal")
NOISES = (0.001, 0.01, 0.05)
SIZES = ((20, 20), (100, 10), (50, 40))
Regressors = Callable[[np.ndarray], np.ndarray]


@dataclass(frozen=True)
class Policy:
    """pi(q) = Theta^T beta(q) with the class beta that the bound knows."""

    beta: Regressors
    theta: np.ndarray

    def __call__(self, q: np.ndarray) -> np.ndarray:
        """pi at many postures."""
        return self.beta(q) @ self.theta


@dataclass(frozen=True)
class Motion:
    """Clean motion with its truth: q, u (k, n, nv); selection (s, p)."""

    features: FrameJacobian
    selection: np.ndarray
    policy: Policy
    dt: float
    q: np.ndarray
    u: np.ndarray


def features_of(arm: str) -> FrameJacobian:
    """Planar: x, y, theta of the tip; Sawyer: x, y, z."""
    if arm == "planar3":
        return FrameJacobian(load_robot("planar3"), "tip", "planar")
    return FrameJacobian(load_robot("sawyer"), "right_gripper_tip", "xyz")


def policy_of(name: str, rest: np.ndarray, reach: np.ndarray, rng: np.random.Generator) -> Policy:
    """A policy about a rest posture; `reach` is the range that the joints use."""
    n = len(rest)

    def affine(q: np.ndarray) -> np.ndarray:
        return np.concatenate([np.ones((len(q), 1)), q - rest], axis=1)

    if name == "affine":
        return Policy(affine, np.concatenate([np.zeros((1, n)), -np.eye(n)]))
    if name == "quadratic":
        i, j = np.triu_indices(n)
        theta = np.concatenate([np.zeros((1, n)), -np.eye(n), 0.5 * rng.standard_normal((len(i), n)) / np.sqrt(n)])
        return Policy(
            lambda q: np.concatenate([affine(q), ((q - rest) / reach)[:, i] * (q - rest)[:, j]], axis=1), theta
        )
    mix = {"sinusoidal": np.eye(n), "fast-sinusoidal": 2.0 * np.eye(n)}.get(name)
    if mix is None:
        mix = np.linalg.qr(rng.standard_normal((n, n)))[0] * 1.5
    phase = rng.uniform(-0.5, 0.5, n)
    theta = np.concatenate([np.zeros((1, n)), -np.diag(np.cos(phase)), -np.diag(np.sin(phase))]) @ mix
    return Policy(
        lambda q: np.concatenate(
            [np.ones((len(q), 1)), np.sin((q - rest) @ mix.T), np.cos((q - rest) @ mix.T)], axis=1
        ),
        theta,
    )


def motion_of(
    arm: str,
    policy_name: str,
    n_trajectories: int,
    n_points: int,
    rng: np.random.Generator,
    selection: np.ndarray | None = None,
) -> Motion:
    """Reaches along two rows, or those given: A u = d exp(-t) with d of each trajectory, Euler steps."""
    features = features_of(arm)
    nv = features.nv
    if arm == "planar3":
        selection, dt = np.eye(3)[PLANAR_ROWS[rng.integers(3)]] if selection is None else selection, 0.02
        q = np.radians(rng.uniform([0, 90, 0], [10, 100, 10], (n_trajectories, 3)))
        rest, reach = np.radians([10.0, -10.0, 10.0]), np.full(3, 1.0)
        turn = np.cumsum(q, axis=1)
        r = np.stack([np.cos(turn).sum(1), np.sin(turn).sum(1), turn[:, 2]], axis=1)
        d = (rng.uniform([-1, 0, 0], [1, 2, np.pi], (n_trajectories, 3)) - r) @ selection.T
    else:
        selection, dt = np.linalg.qr(rng.standard_normal((3, 2)))[0].T if selection is None else selection, 0.04
        middle = 0.5 * (features.robot.position_lower + features.robot.position_upper)
        rest, reach = middle + rng.uniform(-0.3, 0.3, nv), np.full(nv, 0.8)
        q = middle + reach * rng.uniform(-1, 1, (n_trajectories, nv))
        d = rng.uniform(-0.5, 0.5, (n_trajectories, len(selection)))
    policy = policy_of(policy_name, rest, reach, rng)
    Q, U = np.empty((n_points, n_trajectories, nv)), np.empty((n_points, n_trajectories, nv))
    for i in range(n_points):
        A = selection @ features.batch(q)
        inverse = np.linalg.pinv(A)
        pi = policy(q)
        Q[i], U[i] = q, np.einsum("nvs,ns->nv", inverse, d * np.exp(-dt * i) - np.einsum("nsv,nv->ns", A, pi)) + pi
        q = q + dt * U[i]
    return Motion(features, selection, policy, dt, Q.transpose(1, 0, 2), U.transpose(1, 0, 2))


def bound(motion: Motion, covariance: np.ndarray) -> np.ndarray:
    """Cramer-Rao bound on the covariance of B, for noise on u of a covariance (nv, nv): whitened by its factor."""
    q, u = motion.q.reshape(-1, motion.q.shape[2]), motion.u.reshape(-1, motion.u.shape[2])
    back = np.linalg.inv(np.linalg.cholesky(covariance))
    Phi = motion.features.batch(q) @ back.T
    perp = np.linalg.svd(motion.selection)[2][len(motion.selection) :]
    A = motion.selection @ Phi
    Z = np.linalg.svd(A)[2][:, len(motion.selection) :].transpose(0, 2, 1)
    beta = motion.policy.beta(q)
    y = (u - motion.policy(q)) @ back.T
    a = np.einsum("nvs,nv->ns", np.linalg.pinv(A), y)
    F = np.einsum("nvz,kr,nrv->nzk", Z, perp, Phi)
    J = -np.einsum("ns,nzk->nzsk", a, F).reshape(-1, a.shape[1] * F.shape[2])
    K = np.einsum("nk,nvz,vw->nzkw", beta, Z, back).reshape(len(J), -1)
    scale = 1.0 / np.linalg.norm(K, axis=0)
    eigenvalues, vectors = np.linalg.eigh(scale[:, None] * (K.T @ K) * scale)
    basis = scale[:, None] * vectors[:, eigenvalues > 1e-11 * eigenvalues[-1]]
    for _ in range(2):
        J = J - K @ (basis @ ((basis.T @ (K.T @ J)) / eigenvalues[eigenvalues > 1e-11 * eigenvalues[-1], None]))
    return np.linalg.inv(J.T @ J)


def noisy(
    motion: Motion, share: float, anisotropy: float, rng: np.random.Generator
) -> tuple[Demonstrations, np.ndarray]:
    """Demonstrations with noise, and its covariance; `anisotropy` is the ratio of its largest to its least s.d."""
    nv = motion.u.shape[2]
    spread = np.geomspace(1.0, anisotropy, nv)
    turn = np.linalg.qr(rng.standard_normal((nv, nv)))[0] if anisotropy > 1.0 else np.eye(nv)
    L = turn * (spread / np.sqrt(np.mean(spread**2)) * share * np.sqrt(np.mean(motion.u**2)))
    u = motion.u + rng.standard_normal(motion.u.shape) @ L.T
    t = motion.dt * np.arange(motion.q.shape[1])
    names = motion.features.robot.joint_names
    return Demonstrations(
        [Trajectory(t, a, b, names, f"reach {k}", exact=True) for k, (a, b) in enumerate(zip(motion.q, u, strict=True))]
    ), L @ L.T


@dataclass(frozen=True)
class Line:
    """One line of the table."""

    ratio: float
    median: float
    coverage: float
    largest_share: float
    seconds: float
    models: dict[str, int]


def measure(
    arm: str,
    policy: str,
    noise: float,
    size: tuple[int, int],
    sets: int,
    seed: int = 0,
    anisotropy: float = 1.0,
    model: str = "auto",
) -> Line:
    """Ratio to the bound and coverage over some sets."""
    errors, traces, inside, seconds, models = [], [], 0, [], {}
    for k in range(sets):
        rng = np.random.default_rng([seed, k, ARMS.index(arm), POLICIES.index(policy), size[0], size[1]])
        motion = motion_of(arm, policy, *size, rng)
        demos, covariance = noisy(motion, noise, anisotropy, rng)
        settings = {"policy_model": model, "velocities": "recorded"}  # with noise that positions do not have
        learner = ConstraintLearner(motion.features, len(motion.selection), "joint", **settings)
        started = time.process_time()
        learner.fit(demos)
        seconds.append(time.process_time() - started)
        learnt = learner.constraint_.selection
        perp = np.linalg.svd(motion.selection)[2][len(motion.selection) :]
        # B with learnt ~ (1, B): the graph of the learnt row space over the true one
        B = np.linalg.solve(learnt @ motion.selection.T, learnt @ perp.T)
        errors.append(float(np.sum(B**2)))
        traces.append(float(np.trace(bound(motion, covariance))))
        angle = np.degrees(np.arctan(np.linalg.norm(B, 2)))
        inside += bool(angle <= (learner.report_.uncertainty_deg or 0.0))
        name = learner.report_.policy_model or ""
        models[name] = models.get(name, 0) + 1
    ratios = np.array(errors) / np.array(traces)
    return Line(
        float(np.sqrt(np.mean(ratios))),
        float(np.sqrt(np.median(ratios))),
        inside / sets,
        float(ratios.max() / ratios.sum()),
        float(np.median(seconds)),
        models,
    )


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--sets", type=int, default=100)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--anisotropy", type=float, default=1.0)
    parser.add_argument("--model", default="auto")
    parser.add_argument("--arm", choices=ARMS, nargs="*", default=ARMS)
    parser.add_argument("--policy", choices=POLICIES, nargs="*", default=POLICIES)
    parser.add_argument("--noise", type=float, nargs="*", default=NOISES)
    parser.add_argument("--size", nargs="*", default=[f"{k}x{n}" for k, n in SIZES])
    options = parser.parse_args()
    warnings.simplefilter("ignore")
    print("| arm | policy | noise | trajectories x points | ratio to the bound | median | inside | s a fit | models |")
    print("|---|---|---|---|---|---|---|---|---|")
    for arm in options.arm:
        for policy in options.policy:
            for noise in options.noise:
                for size in options.size:
                    k, n = map(int, size.split("x"))
                    line = measure(
                        arm, policy, noise, (k, n), options.sets, options.seed, options.anisotropy, options.model
                    )
                    print(
                        f"| {arm} | {policy} | {100 * noise:g} % | {size} | {line.ratio:.2f} | {line.median:.2f} | "
                        f"{100 * line.coverage:.0f} % | {line.seconds:.2f} | {line.models} |",
                        flush=True,
                    )


if __name__ == "__main__":
    main()
