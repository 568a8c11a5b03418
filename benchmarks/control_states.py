"""Postures, targets and velocities before them in every state that a control step meets, for seven robots."""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import numpy as np
import pinocchio as pin

import manip_learn as ml

ROBOTS: dict[str, tuple[str, str, tuple[str, ...]]] = {  # name in the table -> description, frame, locked joints
    "sawyer": ("sawyer", "right_l6", ()),  # placo takes no name that a link and a joint share
    "panda as loaded": ("panda", "panda_hand_tcp", ()),
    "panda locked": ("panda", "panda_hand_tcp", ("panda_finger_joint1",)),
    "ur5": ("ur5", "tool0", ()),
    "xarm7": ("xarm7", "link_eef", ()),
    "planar3": ("planar3", "tip", ()),
    "talos arm": ("talos_arm", "gripper_left_motor_single_link", ()),
}
STATES = (
    "free",
    "velocity limits",
    "one position limit",
    "two position limits",
    "outside limits",
    "near a singularity",
    "at a singularity",
    "acceleration limits",
    "unreachable target",
)
DT = 0.001  # [s]
WANTED = 48  # cases of a state
TRIES = 4000  # random cases that are looked at
BEYOND = 0.3  # [m] by which an unreachable target is out of reach


class Case(NamedTuple):
    """One call of a controller."""

    q: np.ndarray
    previous: np.ndarray | None


class Arm(NamedTuple):
    """A robot with its controller and its bare step."""

    robot: ml.Robot
    controller: ml.ResolvedRateController
    far: ml.ResolvedRateController  # the same with a target that is out of reach
    bare: Callable[[np.ndarray], np.ndarray]


def arm_of(name: str, rows: str = "xyz") -> Arm:
    """The robot with two oblique rows of its frame's position (one row for the planar arm)."""
    robot, frame, _ = robot_of(name)
    features = ml.FrameJacobian(robot, frame, "x y" if name == "planar3" else rows)
    Lambda = np.linalg.qr(np.random.default_rng(7).normal(size=(features.n_rows, features.n_rows)))[0]
    return arm_with(ml.Constraint(Lambda[: 1 if name == "planar3" else 2], features))


def arm_with(constraint: ml.Constraint) -> Arm:
    """The constraint's robot, reaching a point."""
    robot, features = constraint.robot, constraint.features
    assert robot is not None and isinstance(features, ml.FrameJacobian)
    q = inside(robot, np.random.default_rng(8))
    target = features.coordinates(q)
    reach = max(float(np.linalg.norm(features.coordinates(inside(robot, rng)))) for rng in seeds(9, 500))
    far = target * (reach + BEYOND) / float(np.linalg.norm(target))
    return Arm(robot, controller_of(constraint, target), controller_of(constraint, far), bare_step(constraint))


def robot_of(name: str) -> tuple[ml.Robot, str, tuple[str, ...]]:
    """Robot, frame and locked joints."""
    description, frame, locked = ROBOTS[name]
    return ml.load_robot(description, locked=locked), frame, locked


def engines(law: ml.ResolvedRateController) -> dict[str, ml.ResolvedRateController]:
    """The law in Python, and compiled where that is built (`make fast`)."""
    python = copy.copy(law)
    python.__dict__["native"] = None
    return {"python": python} | ({"native": law} if law.engine == "native" else {})


def controller_of(constraint: ml.Constraint, target: np.ndarray) -> ml.ResolvedRateController:
    """The default controller."""
    task = ml.PointAttractor(target)
    return ml.ResolvedRateController(constraint, task, ml.ManipulabilityAscent(constraint), dt=DT)


def bare_step(constraint: ml.Constraint) -> Callable[[np.ndarray], np.ndarray]:
    """What anyone writes first: Pinocchio's Jacobian, NumPy's pseudo-inverse and the product with the null space."""
    robot, features = constraint.robot, constraint.features
    assert robot is not None and isinstance(features, ml.FrameJacobian)
    model = robot.pinocchio_model
    data, frame, reference = model.createData(), features.frame.index, pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
    rows, b, pi = slice(0, features.n_rows), np.full(constraint.n_constraints, 0.1), np.full(model.nv, 0.1)
    selection = np.array(constraint.selection)

    def step(full: np.ndarray) -> np.ndarray:
        A = selection @ pin.computeFrameJacobian(model, data, full, frame, reference)[rows]
        inverse = np.linalg.pinv(A)
        return inverse @ b + pi - inverse @ (A @ pi)

    return step


def seeds(first: int, number: int) -> Iterator[np.random.Generator]:
    """Generators, one a case."""
    return (np.random.default_rng([first, i]) for i in range(number))


def inside(robot: ml.Robot, rng: np.random.Generator) -> np.ndarray:
    """A random posture, 5 % of the range away from the limits."""
    q = robot.positions(robot.random_configuration(rng))
    middle = 0.5 * (robot.position_lower + robot.position_upper)
    return np.where(np.isfinite(middle), middle + 0.9 * (q - middle), q)


def cases_of(arm: Arm, state: str, seed: int = 100) -> list[Case]:
    """Cases of a state, at most `WANTED`; none where the robot has no such state (no limits)."""
    found: list[Case] = []
    for rng in seeds(seed, TRIES):
        case = candidate(arm, state, rng)
        if case is not None:
            found.append(case)
        if len(found) == WANTED:
            break
    return found


def candidate(arm: Arm, state: str, rng: np.random.Generator) -> Case | None:
    """A random case, if it is in the state."""
    robot, q = arm.robot, inside(arm.robot, rng)
    if state == "free":
        command = arm.controller(q, 0.0)
        return Case(q, None) if command.status == "ok" and command.smallest_singular_value > 0.15 else None
    if state == "velocity limits":
        return Case(q, None) if arm.far(q, 0.0).status in ("velocity-limited", "null-scaled", "rerouted") else None
    if state in ("one position limit", "two position limits"):
        return at_limits(arm, q, 1 if state.startswith("one") else 2, rng)
    if state == "outside limits":
        j = limited_joint(robot, rng)
        if j is None:
            return None
        q[j] = robot.position_upper[j] + 0.01
        return Case(q, None)
    if state in ("near a singularity", "at a singularity"):
        return singular(arm, q, state.startswith("at"), rng)
    if state == "acceleration limits":
        command = arm.controller(q, 0.0, DT, np.zeros(robot.nv))
        return Case(q, np.zeros(robot.nv)) if command.status == "acceleration-limited" else None
    return unreachable(arm, q, rng)


def limited_joint(robot: ml.Robot, rng: np.random.Generator) -> int | None:
    """A joint with position limits that moves the frame."""
    joints = np.flatnonzero(np.isfinite(robot.position_upper))
    joints = joints[joints < 6]
    return int(rng.choice(joints)) if joints.size else None


def at_limits(arm: Arm, q: np.ndarray, number: int, rng: np.random.Generator) -> Case | None:
    """Joints at their limits, pressed into them by the law."""
    joints = np.flatnonzero(np.isfinite(arm.robot.position_upper))
    joints = joints[joints < 6]
    if joints.size < number:
        return None
    chosen = rng.permutation(joints)[:number]
    u = law(arm.controller, q)
    q[chosen] = np.where(u[chosen] > 0.0, arm.robot.position_upper[chosen], arm.robot.position_lower[chosen])
    u = law(arm.controller, q)
    pressed = np.where(
        q[chosen] > 0.5 * (arm.robot.position_upper + arm.robot.position_lower)[chosen], u[chosen], -u[chosen]
    )
    return Case(q, None) if bool(np.all(pressed > 1e-3)) and arm.controller(q).smallest_singular_value > 0.1 else None


def law(controller: ml.ResolvedRateController, q: np.ndarray) -> np.ndarray:
    """Velocity before limits."""
    free = ml.ResolvedRateController(controller.learnt, controller.task, controller.null_policy, limits=False)
    return free(q, 0.0).velocity


def singular(arm: Arm, q: np.ndarray, exactly: bool, rng: np.random.Generator) -> Case | None:
    """A posture whose smallest singular value is below 0.04 (near) or 1e-9 (at), by descending."""
    constraint = arm.controller.constraint
    wanted = 0.0 if exactly else float(rng.uniform(0.002, 0.04))
    for _ in range(40):
        A, vjp = constraint.value_and_vjp(q)
        U, sigma, Vt = np.linalg.svd(A)
        k = len(sigma) - 1
        if sigma[k] <= (1e-12 if exactly else wanted):
            break
        # u^T A is sigma v^T: all of it has to fall, not its length alone, which is a cone
        rows = [vjp(np.outer(U[:, k], v)) for v in (Vt[k:] if exactly else Vt[k : k + 1])]
        residual = np.array([sigma[k] - 0.98 * wanted] + [0.0] * (len(rows) - 1))
        step = -np.linalg.pinv(np.array(rows), rcond=1e-3) @ residual
        q = q + step * min(1.0, 0.3 / max(float(np.linalg.norm(step)), 1e-12))
    else:
        return None
    within = np.all(q > arm.robot.position_lower) and np.all(q < arm.robot.position_upper)
    return Case(q, None) if within else None


def unreachable(arm: Arm, q: np.ndarray, rng: np.random.Generator) -> Case:
    """A step of a run whose target is out of reach, with the velocity before it."""
    loop = ml.ServoLoop(arm.far, dt=0.01)
    steps = int(rng.integers(20, 300))
    for i in range(steps):
        loop.update(q, 0.01 * i)
        assert loop.position is not None
        q = loop.position
    return Case(q, loop.update(q, 0.01 * steps).velocity)


def calls(step: Callable[..., Any], cases: list[Case]) -> Callable[[], None]:
    """All cases once."""

    def run() -> None:
        for q, previous in cases:
            step(q, 0.0, DT, previous)

    return run


def bare_calls(arm: Arm, cases: list[Case]) -> Callable[[], None]:
    """The bare step at the same postures."""
    full = [arm.robot.pinocchio_configuration(case.q) for case in cases]

    def run() -> None:
        for q in full:
            arm.bare(q)

    return run
