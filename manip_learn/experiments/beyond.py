"""What goes beyond the paper: a point on a curve, a standing quadruped, an arm driven by torques; uncut recordings.

- Curve: a conic a x + b y + c x^2 + d x y + e y^2 = const has A(q) = Lambda Phi(q) with Phi the gradients of the
  monomials, so that A depends on the state.
- Quadruped with a floating base: Phi has the rows of the centre of mass (x, y, z) and of the four feet (x, y, z each);
  Lambda selects from them. The feet stay where they are, and the centre of mass stays above one place.
- Torques of a four-joint arm: the tip accelerates by J M^-1 tau and by gravity, springs and velocity terms; the task
  prescribes the first part along its rows, A(q) tau = b with A = Lambda Phi(q) and Phi = J M^-1. There are more
  actuators than task directions, so that a part of tau is free.

- Uncut recordings and mechanisms: the shipped physics recordings, learnt from whole. Each trial leaves one recording
  out, another one each time.

Each learnt Lambda is checked against the truth that the demonstrations were made from.
"""

from __future__ import annotations

import json
import tempfile
from collections.abc import Callable, Mapping
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
from manip_learn.experiments.experiment_result import (
    TrialsResult,
    markdown_table,
    median_and_worst,
    number,
    percent,
    share,
    summary,
)
from manip_learn.experiments.paper_setup import constrained_motion, recorded
from manip_learn.experiments.sawyer import recordings_folder
from manip_learn.experiments.trial_runner import of_trials
from manip_learn.learning.learner import ConstraintLearner
from manip_learn.linalg import null_basis, orthonormal_rows, row_space_angle
from manip_learn.recordings.demonstrations import Demonstrations
from manip_learn.recordings.load_demonstrations import load_demonstrations
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


# types of the truth files -> types of the learner
TYPES = {"slide": "line", "plane": "plane", "hinge": "hinge"}


@final
@dataclass(frozen=True)
class RecordedCase:
    """A folder of recordings.

    Attributes:
        said: What it is.
        folder: Under examples/data.
        robot: Name of the robot.
        frame: That was guided.
        locked: Joints that were not recorded.
    """

    said: str
    folder: str
    robot: str
    frame: str
    locked: tuple[str, ...] = ()


FINGERS = ("panda_finger_joint1", "panda_finger_joint2")
FOLDERS = (
    RecordedCase("a drawer, uncut", "panda_drawer_whole", "panda", "panda_hand_tcp", FINGERS),
    RecordedCase("a drawer, then a table, uncut", "xarm7_drawer_then_table", "xarm7", "link_eef"),
    RecordedCase("a door, loosely held", "ur5_loose_door", "ur5", "tool0"),
    RecordedCase("a drawer, 2 of 8 of another", "panda_drawer_mixed", "panda", "panda_hand_tcp", FINGERS),
)


def recorded_trial(case: RecordedCase, rng: np.random.Generator) -> dict[str, Any]:
    """Learn from all recordings but one.

    Returns:
        `types_right`, whether every mechanism is found with its type; `axis_deg`, the largest angle of their axes or
        normals to the truth; `stated_deg` and `inside`, the stated 68 % angle of that axis and whether it holds the
        truth; `overlap`, true and answered time of contact together over either; `odd_right`, whether the odd
        recordings are named and no others; or `refused`.
    """
    folder = recordings_folder(case.folder)
    truth = json.loads((folder / "truth.json").read_text(encoding="utf-8"))
    robot = load_robot(case.robot, locked=case.locked)
    every = load_demonstrations(sorted(folder.glob("*.csv")), robot)
    left_out = int(rng.integers(len(every)))
    kept = [i for i in range(len(every)) if i != left_out]
    demos = Demonstrations(every[i] for i in kept)
    try:
        learner = ConstraintLearner(FrameJacobian(robot, case.frame, "xyz"), seed=int(rng.integers(2**31))).fit(demos)
    except NotIdentifiableError as error:
        return {"refused": error.code}
    odd = {every[i].name for i in kept if i in truth["contaminated"]}
    report = learner.report_
    windows = {every[i].name: truth["windows"][i] for i in kept if i not in truth["contaminated"]}
    spans = {
        name: [(p.start, p.end) for p in report.phases if p.trajectory == name and p.constraint is not None]
        for name in windows
    }
    return _axes_found(learner, truth) | {
        "overlap": overlap({name: [(a, b) for a, b, _ in w] for name, w in windows.items()}, spans),
        "odd_right": {o.trajectory for o in report.odd_trajectories} == odd,
    }


def _axes_found(learner: ConstraintLearner, truth: dict[str, Any]) -> dict[str, Any]:
    nearest = []
    wanted = truth["mechanisms"][: 1 if truth["contaminated"] else None]
    for mechanism in wanted:
        true = np.array([mechanism["axis"]])
        nearest += sorted(
            (float(np.degrees(row_space_angle(true, one.axis[None]))), one.uncertainty.get("axis"))
            for one in (report.mechanism for report in learner.reports_)
            if one is not None and one.type == TYPES[mechanism["type"]] and one.axis is not None
        )[:1]
    angle, stated = max(nearest, default=(None, None))
    return {
        "types_right": len(nearest) == len(wanted),
        "axis_deg": angle,
        "stated_deg": stated,
        "inside": None if stated is None else angle <= stated,
    }


def overlap(true: Mapping[str, list[tuple[float, float]]], found: Mapping[str, list[tuple[float, float]]]) -> float:
    """Time in both over time in either, of all recordings together; spans of one recording do not overlap."""
    both = either = 0.0
    for name, spans in true.items():
        shared = sum(max(0.0, min(b, d) - max(a, c)) for a, b in spans for c, d in found[name])
        both += shared
        either += sum(b - a for a, b in spans) + sum(d - c for c, d in found[name]) - shared
    return both / either


@final
class RecordedResult(TrialsResult):
    """Outcome of every trial, see `recorded_trial`."""

    def to_dict(self) -> dict[str, Any]:
        """Ours; the paper has cut recordings of one known task."""
        ours = {
            said: {what: summary(t.get(what) for t in trials) for what in ("axis_deg", "stated_deg", "overlap")}
            | {
                "inside": share(t["inside"] for t in trials if t.get("inside") is not None),
                **{what: share(t.get(what, False) for t in trials) for what in ("types_right", "odd_right")},
                "refused": share("refused" in t for t in trials),
                "trials": len(trials),
            }
            for said, trials in self.outcomes.items()
        }
        return {"paper": None, "ours": ours}

    def markdown(self) -> str:
        """One line a folder."""
        lines = []
        for said, block in self.to_dict()["ours"].items():
            inside = "-" if block["inside"] is None else f"{percent(block['inside'])} of {block['trials']}"
            lines.append([said, percent(block["types_right"]), median_and_worst(block["axis_deg"])])
            lines[-1] += [number(block["stated_deg"]["median"]), inside]
            lines[-1] += [number(block["overlap"]["median"]), percent(block["odd_right"])]
        header = ["recordings", "mechanisms found", "axis or normal [deg], median (worst)", "stated 68 % [deg]"]
        header += ["truth inside", "contact, overlap in time", "odd ones named, no others"]
        return markdown_table(header, lines)

    def figures(self) -> dict[str, Figure]:
        """Angles of all trials."""
        angles = {
            said: [t["axis_deg"] for t in trials if t.get("axis_deg") is not None]
            for said, trials in self.outcomes.items()
        }
        panel = Panel(angles, "angle of axis or normal [deg],\nlearnt as shipped")
        return {"recorded": strips([[panel]], "recordings; a dot is a trial, a bar the median", 7.0, 4.2)}


RECORDED = of_trials("recorded", recorded_trial, {case.said: case for case in FOLDERS}, RecordedResult, 0.1)
