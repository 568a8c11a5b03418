"""What the paper only mentions: a point on a curve, a standing quadruped, an arm driven by torques.

- Curve: a conic a x + b y + c x^2 + d x y + e y^2 = const has A(q) = Lambda Phi(q) with Phi the gradients of the
  monomials, so that A depends on the state.
- Quadruped with a floating base: Phi has the rows of the centre of mass (x, y, z) and of the four feet (x, y, z each);
  Lambda selects from them. The feet stay where they are, and the centre of mass stays above one place.
- Torques of a four-joint arm: the tip accelerates by J M^-1 tau and by gravity, springs and velocity terms; the task
  prescribes the first part along its rows, A(q) tau = b with A = Lambda Phi(q) and Phi = J M^-1. There are more
  actuators than task directions, so that a part of tau is free.

Each learnt Lambda is checked against the truth that the demonstrations were made from.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, final

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike
from scipy.linalg import block_diag

from manip_learn.constraint.features.frame_jacobian import FrameJacobian
from manip_learn.constraint.features.other_features import CentreOfMass, CustomFeatures, Stacked
from manip_learn.errors import NotIdentifiableError
from manip_learn.experiments.charts import Panel, strips
from manip_learn.experiments.experiment_result import TrialsResult, markdown_table, number, percent, share, summary
from manip_learn.experiments.paper_setup import constrained_motion, recorded
from manip_learn.experiments.trial_runner import of_trials
from manip_learn.learning.learner import ConstraintLearner
from manip_learn.linalg import null_basis, orthonormal_rows, row_space_angle
from manip_learn.recordings.demonstrations import Demonstrations
from manip_learn.recordings.trajectory import Trajectory
from manip_learn.robot.loading import load_robot
from manip_learn.robot.robot import Robot

if TYPE_CHECKING:
    from matplotlib.figure import Figure

MONOMIALS = ("x", "y", "x^2", "x y", "y^2")
# name -> coefficients of the monomials
CURVES = {
    "circle": np.array([[-0.6, 0.4, 1.0, 0.0, 1.0]]),
    "ellipse": np.array([[-0.3, -0.2, 1.0, 0.6, 2.5]]),
}
CURVE_DEMONSTRATIONS, CURVE_SAMPLES, CURVE_STEP = 20, 40, 0.02  # [s]
LEGS = {"fl": (0.25, 0.15), "fr": (0.25, -0.15), "hl": (-0.25, 0.15), "hr": (-0.25, -0.15)}  # hips [m]
THIGH, SHANK = 0.25, 0.25  # [m]
STANCE = (0.1, 0.7, -1.4)  # abduction, hip, knee [rad]
# name -> rows of the centre of mass that are held besides the feet, as a matrix over x, y, z
BALANCE = {
    "stand, mass over one place": np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]),
    "stand, mass in a slanted plane": np.array([[0.6, 0.0, 0.8]]),
}
LEGGED_DEMONSTRATIONS, LEGGED_SAMPLES, LEGGED_STEP = 10, 40, 0.02  # [s]
LENGTHS = np.array([0.5, 0.5, 0.4, 0.3])  # [m]
MASSES = np.array([3.0, 2.0, 1.5, 1.0])  # at the end of each link [kg]
ROTORS = 0.05  # inertia of each drive [kg m^2]
REST = np.array([0.4, 0.6, 0.5, 0.4])  # [rad]
STIFFNESS, DAMPING = 6.0, 2.0  # of the free part [N m/rad], of the joints [N m s/rad]
NAMES = ("torque1", "torque2", "torque3", "torque4")
# name -> rows of the acceleration of the tip and its heading
TORQUE_TASKS = {
    "tip accelerates along x and y": np.eye(3)[:2],
    "tip accelerates along 30 degrees": np.array([[np.cos(np.pi / 6), np.sin(np.pi / 6), 0.0]]),
}
TORQUE_DEMONSTRATIONS, TORQUE_SAMPLES, TORQUE_STEP, TORQUE_EVERY = 40, 25, 0.002, 10  # recorded every 20 ms


# gradients of the monomials, LINEAR + BENT q
LINEAR = np.eye(5, 2)
BENT = np.zeros((5, 2, 2))  # second derivatives
BENT[2, 0, 0] = BENT[4, 1, 1] = 2.0
BENT[3, 0, 1] = BENT[3, 1, 0] = 1.0


@cache
def curve_features() -> CustomFeatures:
    """Gradients of the monomials of degree 1 and 2."""
    return CustomFeatures(gradients, MONOMIALS, nv=2, derivative=lambda q: BENT, coordinates=monomials)


def monomials(q: Float[np.ndarray, " 2"]) -> Float[np.ndarray, " 5"]:
    """The monomials themselves: task coordinates whose rate is Phi u."""
    return LINEAR @ q + 0.5 * BENT @ q @ q


def gradients(q: Float[np.ndarray, " 2"]) -> Float[np.ndarray, "5 2"]:
    """Phi."""
    return LINEAR + BENT @ q


def curve_demonstrations(
    task: str, noise: float, rng: np.random.Generator
) -> tuple[Demonstrations, Float[np.ndarray, "1 5"]]:
    """Points that are pushed about at random while a curve of the family holds them (b = 0); and the true Lambda."""
    Lambda = orthonormal_rows(CURVES[task])
    trajectories = []
    for i in range(CURVE_DEMONSTRATIONS):
        q, push = rng.uniform(-1.0, 1.0, size=2) + [0.3, -0.2], 2.0 * rng.standard_normal(2)
        q, u = held_motion(lambda q: Lambda @ gradients(q), q, push, CURVE_SAMPLES, CURVE_STEP, rng, kick=0.5, pull=0.5)
        time = CURVE_STEP * np.arange(CURVE_SAMPLES)
        trajectories.append(Trajectory(time, q, with_noise(u, noise, rng), ("x", "y"), f"point {i}"))
    return Demonstrations(trajectories), Lambda


def held_motion(
    A: Callable[[np.ndarray], np.ndarray], q: np.ndarray, push: np.ndarray, samples: int, step: float,
    rng: np.random.Generator, *, kick: float, keep: float = 1.0, pull: float = 0.0,
    integrate: Callable[[np.ndarray, np.ndarray], np.ndarray] = np.add,
) -> tuple[Float[np.ndarray, "T nq"], Float[np.ndarray, "T nv"]]:  # fmt: skip
    """Postures and velocities u = N (push - pull q), b = 0; after each step a share of the push and a kick are left."""
    postures, actions = [], []
    for _ in range(samples):
        Z = null_basis(A(q))
        postures.append(q)
        actions.append(Z @ (Z.T @ (push - pull * q if pull else push)))
        q = integrate(q, step * actions[-1])
        push = keep * push + kick * rng.standard_normal(len(push))
    return np.array(postures), np.array(actions)


def with_noise(u: Float[np.ndarray, "T nv"], noise: float, rng: np.random.Generator) -> Float[np.ndarray, "T nv"]:
    """Actions with Gaussian noise relative to each column's root mean square."""
    return u + noise * np.sqrt(np.mean(u**2, axis=0)) * rng.standard_normal(u.shape) if noise > 0.0 else u


def quadruped_urdf() -> str:
    """URDF of a trunk with four legs of three joints each, with inertias."""
    parts = [_link("trunk", 6.0, "0 0 0", 0.08)]
    for name, (x, y) in LEGS.items():
        parts += [_link(f"{name}_hip", 0.6, "0 0 0", 0.001), _link(f"{name}_thigh", 0.8, f"0 0 {-THIGH / 2}", 0.005)]
        parts += [_link(f"{name}_shank", 0.3, f"0 0 {-SHANK / 2}", 0.002), f'<link name="{name}_foot"/>']
        parts.append(_joint(f"{name}_abduction", "trunk", f"{name}_hip", f"{x} {y} 0", "1 0 0"))
        parts.append(_joint(f"{name}_swing", f"{name}_hip", f"{name}_thigh", "0 0 0", "0 1 0"))
        parts.append(_joint(f"{name}_knee", f"{name}_thigh", f"{name}_shank", f"0 0 {-THIGH}", "0 1 0"))
        parts.append(
            f'<joint name="{name}_sole" type="fixed"><parent link="{name}_shank"/><child link="{name}_foot"/>'
            f'<origin xyz="0 0 {-SHANK}"/></joint>'
        )
    return f'<robot name="quadruped">{"".join(parts)}</robot>'


@cache
def quadruped() -> Robot:
    """The generated robot with a floating base, nv = 18."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "quadruped.urdf"
        path.write_text(quadruped_urdf(), encoding="utf-8")
        return load_robot(path, base="floating")


@cache
def standing_features() -> Stacked:
    """Rows of the centre of mass and of the four feet, p = 15."""
    robot = quadruped()
    return Stacked([CentreOfMass(robot), *(FrameJacobian(robot, f"{leg}_foot", "xyz") for leg in LEGS)])


def standing_demonstrations(
    task: str, noise: float, rng: np.random.Generator
) -> tuple[Demonstrations, Float[np.ndarray, "s 15"]]:
    """The trunk is pushed about while feet and balance hold (b = 0); and the true Lambda."""
    robot, features = quadruped(), standing_features()
    held = BALANCE[task]
    Lambda = block_diag(held, np.eye(12))
    trajectories = []
    for i in range(LEGGED_DEMONSTRATIONS):
        start = np.concatenate([np.zeros(6), np.tile(STANCE, 4)]) + 0.1 * rng.standard_normal(robot.nv)
        q, push = robot.integrate(robot.neutral(), start), rng.standard_normal(robot.nv)
        how: Any = {"kick": 0.4, "keep": 0.95, "integrate": robot.integrate}
        q, u = held_motion(lambda q: Lambda @ features(q), q, push, LEGGED_SAMPLES, LEGGED_STEP, rng, **how)
        time = LEGGED_STEP * np.arange(LEGGED_SAMPLES)
        trajectories.append(Trajectory(time, q, with_noise(u, noise, rng), robot.joint_names, f"stand {i}"))
    return Demonstrations(trajectories), Lambda


def _link(name: str, mass: float, centre: str, inertia: float) -> str:
    return (
        f'<link name="{name}"><inertial><origin xyz="{centre}"/><mass value="{mass}"/><inertia ixx="{inertia}" ixy="0" '
        f'ixz="0" iyy="{inertia}" iyz="0" izz="{inertia}"/></inertial></link>'
    )


def _joint(name: str, parent: str, child: str, xyz: str, axis: str) -> str:
    return (
        f'<joint name="{name}" type="revolute"><parent link="{parent}"/><child link="{child}"/><origin xyz="{xyz}"/>'
        f'<axis xyz="{axis}"/><limit lower="-2.6" upper="2.6" velocity="10" effort="30"/></joint>'
    )


@cache
def torque_features() -> CustomFeatures:
    """Phi = J M^-1: tip acceleration along x, y and of the heading per unit torque [m/s^2 or rad/s^2 per N m]."""
    return CustomFeatures(lambda q: tip_jacobian(q) @ np.linalg.inv(inertia(q)), ("x", "y", "heading"), nv=4)


def jacobians(q: ArrayLike) -> Float[np.ndarray, "*n 4 2 4"]:
    """Of the end of each link, at one posture or at many."""
    angles = np.cumsum(np.asarray(q, dtype=np.float64), axis=-1)
    columns = LENGTHS * np.stack([-np.sin(angles), np.cos(angles)], axis=-2)  # what link i adds, (..., 2, 4)
    links = np.tril(np.ones((4, 4)))  # link l moves the end of link k, and joint j moves link l
    return np.einsum("...al,kl,lj->...kaj", columns, links, links)


def tip_jacobian(q: ArrayLike) -> Float[np.ndarray, "*n 3 4"]:
    """Of the tip, with the row of its heading."""
    J = jacobians(q)[..., -1, :, :]
    return np.concatenate([J, np.ones((*J.shape[:-2], 1, 4))], axis=-2)


def inertia(q: ArrayLike) -> Float[np.ndarray, "*n 4 4"]:
    """M(q) [kg m^2]."""
    J = jacobians(q)
    return np.einsum("k,...kai,...kaj->...ij", MASSES, J, J) + ROTORS * np.eye(4)


def speed_torques(q: Float[np.ndarray, "*n 4"], dq: Float[np.ndarray, "*n 4"]) -> Float[np.ndarray, "*n 4"]:
    """Coriolis and centrifugal torques, sum_k m_k J_k^T (dJ_k/dt dq) [N m]."""
    angles, rates = np.cumsum(q, axis=-1), np.cumsum(dq, axis=-1)[..., None, :]
    pulls = -LENGTHS * rates**2 * np.stack([np.cos(angles), np.sin(angles)], axis=-2)
    return np.einsum("k,...kai,...ak->...i", MASSES, jacobians(q), np.cumsum(pulls, axis=-1))


def torque_demonstrations(
    task: str, noise: float, rng: np.random.Generator
) -> tuple[Demonstrations, Float[np.ndarray, "s 3"]]:
    """Reaching by torques, tau = A^+ b + N pi with pi = -K (q - rest); b pulls to a target and damps; and Lambda."""
    Lambda, n = TORQUE_TASKS[task], TORQUE_DEMONSTRATIONS
    q, dq = REST + 0.5 * rng.standard_normal((n, 4)), np.zeros((n, 4))
    target = rng.uniform([0.2, -0.2, 0.5], [1.2, 1.2, 2.5], size=(n, 3))
    postures, torques = [], []
    for step in range(TORQUE_SAMPLES * TORQUE_EVERY):
        J, M = tip_jacobian(q), inertia(q)
        A = Lambda @ np.linalg.solve(M, J.transpose(0, 2, 1)).transpose(0, 2, 1)
        angles = np.cumsum(q, axis=1)
        r = np.column_stack([np.cos(angles) @ LENGTHS, np.sin(angles) @ LENGTHS, angles[:, -1]])
        b = (8.0 * (target - r) - 4.0 * np.einsum("nrj,nj->nr", J, dq)) @ Lambda.T
        tau = constrained_motion(A, b, -STIFFNESS * (q - REST))
        if step % TORQUE_EVERY == 0:
            postures.append(q)
            torques.append(tau)
        pull = tau - speed_torques(q, dq) - DAMPING * dq
        dq = dq + TORQUE_STEP * np.linalg.solve(M, pull[:, :, None])[:, :, 0]
        q = q + TORQUE_STEP * dq
    q, tau = np.stack(postures, axis=1), np.stack(torques, axis=1)
    noisy = np.array([with_noise(one, noise, rng) for one in tau])
    return recorded(TORQUE_STEP * TORQUE_EVERY, q, noisy, NAMES, "reach"), Lambda


NOISES = (0.0, 0.01)  # shares of each column's root mean square


@final
@dataclass(frozen=True)
class BeyondCase:
    """One system.

    Attributes:
        system: `"curve"`, `"legged"` or `"torque"`.
        task: Which constraint; a key of the system's table.
        noise: Standard deviation of the noise on the action, relative to each column's root mean square.
    """

    system: str
    task: str
    noise: float


# name -> (features, demonstrations and true Lambda from a task and rng)
SYSTEMS: dict[str, tuple[Callable[[], Any], Callable[..., Any]]] = {
    "curve": (curve_features, curve_demonstrations),
    "legged": (standing_features, standing_demonstrations),
    "torque": (torque_features, torque_demonstrations),
}
CASES = {
    f"{system} | {task} | noise {100 * noise:g} %": BeyondCase(system, task, noise)
    for system, tasks in (("curve", CURVES), ("legged", BALANCE), ("torque", TORQUE_TASKS))
    for task in tasks
    for noise in NOISES
}


def beyond_trial(case: BeyondCase, rng: np.random.Generator) -> dict[str, Any]:
    """Learn with the shipped defaults; `angle_deg` to the true row space, `rows`, `estimator`; or `refused`."""
    make_features, demonstrate = SYSTEMS[case.system]
    features = make_features()
    demos, Lambda = demonstrate(case.task, case.noise, rng)
    try:
        learner = ConstraintLearner(features, seed=int(rng.integers(2**31))).fit(demos)
    except NotIdentifiableError as error:
        return {"refused": error.code}
    learnt, report = learner.constraint_, learner.report_
    return {
        "rows": learnt.n_constraints,
        "rows_true": len(Lambda),
        "estimator": report.estimator,
        "gap": report.gap,
        "angle_deg": float(np.degrees(row_space_angle(Lambda, learnt.selection))),
        "seconds": report.seconds,
    }


@final
class BeyondResult(TrialsResult):
    """Outcome of every trial, see `beyond_trial`."""

    def to_dict(self) -> dict[str, Any]:
        """Ours; the paper gives no numbers for these."""
        ours = {
            case: {
                "angle_deg": summary(t.get("angle_deg") for t in trials),
                "rows_right": share("rows" in t and t["rows"] == t["rows_true"] for t in trials),
                "refused": share("refused" in t for t in trials),
                **{what: next((t[what] for t in trials if what in t), None) for what in ("rows_true", "estimator")},
                "seconds_per_fit": summary(t.get("seconds") for t in trials)["median"],
            }
            for case, trials in self.outcomes.items()
        }
        return {"paper": None, "ours": ours}

    def markdown(self) -> str:
        """All systems."""
        lines = []
        for key, block in self.to_dict()["ours"].items():
            lines.append([*key.split(" | "), str(block["rows_true"]), block["estimator"] or "refused"])
            angles = block["angle_deg"]
            lines[-1] += [percent(block["rows_right"]), number(angles["median"]), number(angles["worst"])]
        header = ["system", "constraint", "noise", "rows", "estimator", "rows found", "angle [deg], median", "worst"]
        return markdown_table(header, lines)

    def figures(self) -> dict[str, Figure]:
        """Angles of all systems."""
        angles = {
            case.replace(" | ", ", "): [t["angle_deg"] for t in trials if "angle_deg" in t]
            for case, trials in self.outcomes.items()
        }
        panel = Panel(angles, "angle to the true row space [deg],\nlearnt as shipped")
        return {"beyond": strips([[panel]], "system, constraint, noise; a dot is a trial, a bar the median", 8.0, 5.5)}


BEYOND = of_trials("beyond", beyond_trial, CASES, BeyondResult, 0.1)
