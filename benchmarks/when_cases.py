"""Arms, tasks and starts of `near_singular_ways.py`: the hand at a handle, anywhere or near a singularity of the rows.

Lengths are those of arms of a metre or so; for the SO-101 all of them are multiplied by `Arm.size`. Mechanisms stand in
front of the arm, their ways centred at MIDDLE of its reach. A start is kept if the hand also finds postures at the end
of the way, of each stroke of a wipe, or at the target, in the grip of the cell: what no posture at the end can do is no
question of how the arm moves.
"""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

import manip_learn as ml
from manip_learn.control.tasks.motion_profile import MotionProfile
from manip_learn.robot.loading import robot_from_text

MIDDLE = 0.55  # of the reach: between too near to fold the arm and too far to reach
HEIGHTS = (0.2, 0.35, 0.5)  # [m] of handles: those of the recorded drawers (examples/data/README.md)
ASIDE = 0.2  # [m] at most, of a handle to the left or right of the arm
DOOR, VALVE, PITCH = 0.35, 0.05, 0.02 / (2.0 * math.pi)  # [m] radius of a door and of a valve, [m/rad] 20 mm a turn
TABLE = (0.4, 0.3)  # [m] of a table that is wiped: a stroke across, and one towards the arm
HAND, TURN = 0.1, 1.0  # [m/s] of the hand, [rad/s] of the valve, whose handle so moves at 0.05 m/s
RAMP, PAUSE = 0.5, 0.5  # [s] from rest to the speed, and at rest before the way, as a gripper takes to close
REACH = 0.25  # [m] from the start of reaching to its target
SINGULAR = 0.02  # smallest singular value of the rows held and driven, of a start near a singularity [m or 1]
MARGIN = 0.03  # [rad] of a start from the joint limits
DESCENT, STEPS, TRIES = 0.08, 60, 4  # [rad] a step towards a singularity, steps, and descents of one start
KINDS = ("anywhere", "near")
GRIPS = ("free", "held")

# Simulation/SO101/so101_new_calib.urdf of github.com/TheRobotStudio/SO-ARM100 (Apache-2.0): parent, child, origin [m],
# roll pitch yaw [rad], limits [rad]; `front` is ours: the pan axis is z, and the arm points along x as the others do.
SO101 = (
    ("front", "front", "base", "-0.0230745 -0.0207909 0", "0 0 1.5708", None),
    ("shoulder_pan", "base", "shoulder", "0.0207909 -0.0230745 0.0948817", "-3.14159 0 1.5708", (-1.91986, 1.91986)),
    ("shoulder_lift", "shoulder", "upper_arm", "-0.0303992 -0.0182778 -0.0542", "-1.5708 -1.5708 0", (-1.7453, 1.7453)),
    ("elbow_flex", "upper_arm", "lower_arm", "-0.11257 -0.028 0", "0 0 1.5708", (-1.69, 1.69)),
    ("wrist_flex", "lower_arm", "wrist", "-0.1349 0.0052 0", "0 0 -1.5708", (-1.65806, 1.65806)),
    ("wrist_roll", "wrist", "gripper", "0 -0.0611 0.0181", "1.5708 0 3.14159", (-2.79253, 2.79253)),
    ("gripperframe_frame", "gripper", "gripperframe", "-0.0079 -0.000218121 -0.0981274", "1.5708 0 1.5708", None),
)
SO101_SPEED = 4.7  # [rad/s] of its servo, STS3215, without load: 45 rpm; that file says 10 rad/s


class Arm(NamedTuple):
    """An arm: its tip, joints that are locked, how far the tip comes from the base's axis [m], and the tasks' size."""

    tip: str
    locked: tuple[str, ...]
    reach: float
    size: float


ARMS = {
    "panda": Arm("panda_hand_tcp", ("panda_finger_joint1", "panda_finger_joint2"), 0.95, 1.0),
    "xarm7": Arm("link_eef", (), 0.77, 1.0),
    "ur5": Arm("tool0", (), 0.93, 1.0),
    "ur10": Arm("tool0", (), 1.32, 1.0),
    "sawyer": Arm("right_gripper_tip", (), 1.17, 1.0),
    "so101": Arm("gripperframe", (), 0.45, 0.4),
}


class Stroke(NamedTuple):
    """One way: along a line, or about an axis through a point with a pitch; distance and speed [m or rad, a second]."""

    distance: float
    speed: float
    direction: np.ndarray | None = None
    axis: np.ndarray | None = None
    point: np.ndarray | None = None
    pitch: float = 0.0

    def place(self, start: np.ndarray, s: float) -> np.ndarray:
        """Pose (4, 4) of a hand that keeps its orientation, after so much of the way [m or rad]."""
        pose = start.copy()
        if self.axis is None:
            pose[:3, 3] += s * self.direction
            return pose
        turn = Rotation.from_rotvec(s * self.axis).as_matrix()
        pose[:3, 3] = self.point + turn @ (start[:3, 3] - self.point) + self.pitch * s * self.axis
        return pose

    def profile(self) -> MotionProfile:
        """Where the hand is in time."""
        return MotionProfile(self.distance, self.speed, RAMP)


class Case(NamedTuple):
    """What holds the hand, along what it goes (nothing: to the target), from which posture, and how it is gripped."""

    constraint: ml.Constraint
    strokes: tuple[Stroke, ...]
    target: np.ndarray | None
    keep: bool
    start: np.ndarray

    def motion(self, number: int) -> ml.FreeDirection:
        """The task of one stroke; only the first one waits for the gripper."""
        stroke, pause = self.strokes[number], 0.0 if number else PAUSE
        wanted: dict[str, Any] = {"along": stroke.distance} if stroke.axis is None else {"turn": stroke.distance}
        wanted |= {"speed": stroke.speed, "direction": stroke.direction}
        return ml.motion(self.constraint, keep_orientation=self.keep, pause=pause, **wanted)

    def rows(self) -> ml.Constraint:
        """Rows held and driven at the start."""
        return self.motion(0).constraint if self.strokes else self.held()

    def held(self) -> ml.Constraint:
        """Rows held only, the orientation among them if the grip keeps it."""
        return self.constraint.with_orientation() if self.keep else self.constraint


Draw = Callable[[ml.Robot, Arm, np.random.Generator], tuple[ml.Constraint, tuple[Stroke, ...], np.ndarray]]


def so101_urdf() -> str:
    """The SO-101 without shapes and masses, the jaw closed."""
    out = ['<robot name="so101"><link name="front"/>']
    for name, parent, child, xyz, rpy, limits in SO101:
        kind, more = ("fixed", "") if limits is None else ("revolute", '<axis xyz="0 0 1"/>')
        if limits is not None:
            more += f'<limit effort="10" velocity="{SO101_SPEED}" lower="{limits[0]}" upper="{limits[1]}"/>'
        out.append(f'<link name="{child}"/><joint name="{name}" type="{kind}"><parent link="{parent}"/>')
        out.append(f'<child link="{child}"/><origin xyz="{xyz}" rpy="{rpy}"/>{more}</joint>')
    return "".join([*out, "</robot>"])


@functools.cache
def robot_of(name: str) -> ml.Robot:
    """The arm by its name."""
    if name == "so101":
        return robot_from_text(so101_urdf().encode(), Path("so101.urdf"))
    return ml.load_robot(name, locked=ARMS[name].locked)


def handle(arm: Arm, rng: np.random.Generator) -> np.ndarray:
    """The middle of a way, in front of an arm."""
    return np.array([MIDDLE * arm.reach, arm.size * rng.uniform(-ASIDE, ASIDE), arm.size * rng.choice(HEIGHTS)])


def drawer(length: float) -> Draw:
    """A drawer that opens towards the base by a length [m]."""

    def draw(robot: ml.Robot, arm: Arm, rng: np.random.Generator):
        way, out = arm.size * length, np.array([-1.0, 0.0, 0.0])
        constraint = ml.Constraint(np.eye(3)[1:], ml.FrameJacobian(robot, arm.tip))
        stroke = Stroke(way, HAND * arm.size, out)
        return constraint, (stroke,), handle(arm, rng) - 0.5 * way * out

    return draw


def door(angle: float) -> Draw:
    """A door that opens towards the base by an angle [rad], its hinge on either side; the hand on its handle."""

    def draw(robot: ml.Robot, arm: Arm, rng: np.random.Generator):
        radius, side, axis = arm.size * DOOR, rng.choice([-1.0, 1.0]), np.array([0.0, 0.0, 1.0])
        place = handle(arm, rng) + [0.5 * radius * math.sin(angle), 0.0, 0.0]
        hinge = place + [0.0, side * radius, 0.0]
        rows = ml.MechanismRows(robot, arm.tip, "radial axial", axis=axis, point=hinge, radius=radius)
        stroke = Stroke(-side * angle, HAND / DOOR, axis=axis, point=hinge)
        return ml.Constraint(np.eye(2), rows), (stroke,), place

    return draw


def screw(robot: ml.Robot, arm: Arm, rng: np.random.Generator):
    """A valve with an upright axis, turned by half a turn; the hand on its rim."""
    radius, axis, point = arm.size * VALVE, np.array([0.0, 0.0, 1.0]), handle(arm, rng)
    phi, pitch = rng.uniform(-np.pi, np.pi), arm.size * PITCH
    place = point + radius * np.array([math.cos(phi), math.sin(phi), 0.0])
    rows = ml.MechanismRows(robot, arm.tip, "radial helical", axis=axis, point=point, pitch=pitch)
    stroke = Stroke(np.pi, TURN, axis=axis, point=point, pitch=pitch)
    return ml.Constraint(np.eye(2), rows), (stroke,), place


def wipe(robot: ml.Robot, arm: Arm, rng: np.random.Generator):
    """A level table: one stroke across, one towards the arm, the height held."""
    across, towards = (arm.size * side for side in TABLE)
    side, speed = rng.choice([-1.0, 1.0]), HAND * arm.size
    constraint = ml.Constraint(np.eye(3)[2:], ml.FrameJacobian(robot, arm.tip))
    strokes = (
        Stroke(across, speed, np.array([0.0, side, 0.0])),
        Stroke(towards, speed, np.array([-1.0, 0.0, 0.0])),
    )
    return constraint, strokes, handle(arm, rng) + 0.5 * np.array([towards, -side * across, 0.0])


def reaching(robot: ml.Robot, arm: Arm, rng: np.random.Generator):
    """One or two oblique rows of the hand's place, from anywhere the arm comes."""
    rows = np.linalg.qr(rng.normal(size=(3, 3)))[0][: rng.integers(1, 3)]
    return ml.Constraint(rows, ml.FrameJacobian(robot, arm.tip)), (), robot.position(posture(robot, rng), arm.tip)


TASKS: dict[str, Draw] = {
    "drawer 0.3 m": drawer(0.3),
    "drawer 0.5 m": drawer(0.5),
    "door 60 deg": door(math.radians(60.0)),
    "door 90 deg": door(math.radians(90.0)),
    "screw 180 deg": screw,
    "wipe 0.4 x 0.3 m": wipe,
    "reach": reaching,
}


def exists(arm: str, task: str, grip: str) -> bool:
    """Whether the arm has a joint for each row: a way in a kept orientation has six."""
    return task == "reach" or grip == "free" or robot_of(arm).nv >= 6


def posture(robot: ml.Robot, rng: np.random.Generator) -> np.ndarray:
    """A random posture within MARGIN of the limits."""
    return rng.uniform(robot.position_lower + MARGIN, robot.position_upper - MARGIN)


def brought_to(rows: ml.Constraint, target: np.ndarray, q: np.ndarray, most: int = 50) -> np.ndarray | None:
    """The posture with a frame's rows at a target that damped steps find from q; None if they find none."""
    robot, selection, q = rows.robot, rows.selection, q.copy()
    low, high = robot.position_lower + MARGIN, robot.position_upper - MARGIN
    for _ in range(most):
        error, E = rows.features.error_and_jacobian(target, q)
        error = selection @ error
        size = math.sqrt(error @ error)
        if size < 1e-7:  # [m or rad]: a hundredth of the encoders' noise
            return q
        E = selection @ (rows.features(q) if E is None else E)
        damped = E @ E.T + 1e-3 * min(size, 1.0) * np.eye(len(E))  # full steps near the target
        step = E.T @ np.linalg.solve(damped, error)
        longest = float(np.max(np.abs(step)))
        q = np.clip(q + step * min(1.0, 0.5 / max(longest, 1e-12)), low, high)
    return None


def found(rows: ml.Constraint, target: np.ndarray, q: np.ndarray, rng: np.random.Generator, most: int) -> bool:
    """Whether a posture with the rows at the target is found, from q or one of so many random ones."""
    starts = itertools.chain([q], (posture(rows.robot, rng) for _ in range(most)))
    return any(brought_to(rows, target, start) is not None for start in starts)


def place_rows(robot: ml.Robot, tip: str) -> ml.Constraint:
    """All of the hand's place."""
    return ml.Constraint(np.eye(3), ml.FrameJacobian(robot, tip))


def nearly_singular(rows: ml.Constraint, place: np.ndarray, q: np.ndarray) -> tuple[np.ndarray, float]:
    """Along the self-motion down the slope of mu: the posture nearest to a singularity, and its singular value."""
    at = place_rows(rows.robot, rows.features.frame.name)
    best, least = q, math.inf
    for _ in range(STEPS):
        sigma = float(np.linalg.svd(rows(q), compute_uv=False)[-1])
        if sigma < least:
            best, least = q, sigma
        if sigma < SINGULAR:
            break
        A = at(q)
        slope = ml.log_manipulability_gradient(rows, q)
        slope -= np.linalg.pinv(A) @ (A @ slope)
        there = brought_to(at, place, q - DESCENT * slope / max(float(np.linalg.norm(slope)), 1e-12), 10)
        if there is None:
            break
        q = there
    return best, least


def start_of(name: str, draw: Draw, keep: bool, near: bool, rng: np.random.Generator) -> Case | None:
    """One attempt at a start; None if no posture is found at the handle, or at the end of the way."""
    robot, arm = robot_of(name), ARMS[name]
    constraint, strokes, place = draw(robot, arm, rng)
    q = brought_to(place_rows(robot, arm.tip), place, posture(robot, rng))
    if q is None:
        return None
    case = Case(constraint, strokes, None, keep, q)
    if near:
        for number in range(TRIES):
            other = brought_to(place_rows(robot, arm.tip), place, posture(robot, rng)) if number else q
            if other is not None:
                there, sigma = nearly_singular(case.rows(), place, other)
                case = min(case, case._replace(start=there), key=lambda c: smallest(c))
                if sigma < SINGULAR:
                    break
    return ended(case, arm, rng)


def smallest(case: Case) -> float:
    """Smallest singular value of the rows at the start [m or 1]."""
    return float(np.linalg.svd(case.rows()(case.start), compute_uv=False)[-1])


def ended(case: Case, arm: Arm, rng: np.random.Generator) -> Case | None:
    """The case with its target, if postures are found at all ends of its ways; else None."""
    robot, q = case.constraint.robot, case.start
    pose = robot.pose(q, arm.tip)
    if not case.strokes:
        out = rng.normal(size=3)
        target = pose.copy()
        target[:3, 3] += arm.size * REACH * out / np.linalg.norm(out)
        return case._replace(target=target) if found(case.held(), target, q, rng, 6) else None
    features = ml.FrameJacobian(robot, arm.tip, "pose" if case.keep else "xyz")
    rows = ml.Constraint(np.eye(features.n_rows), features)
    for stroke in case.strokes:
        pose = stroke.place(pose, stroke.distance)
        if not found(rows, pose if case.keep else pose[:3, 3], q, rng, 6):
            return None
    return case


def cases_of(arm: str, task: str, grip: str, kind: str, number: int, seed: int) -> list[Case]:
    """The starts of a cell; the first ones are the same whatever their number."""
    cell = [list(ARMS).index(arm), list(TASKS).index(task), GRIPS.index(grip), KINDS.index(kind)]
    out = []
    for i in range(number):
        rng = np.random.default_rng([seed, *cell, i])
        attempts = (start_of(arm, TASKS[task], grip == "held", kind == "near", rng) for _ in itertools.count())
        out.append(next(case for case in attempts if case is not None))
    return out
