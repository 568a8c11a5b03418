"""The law where it is hardest: ways that begin near a singularity, without and with the ascent of the task.

    python benchmarks/near_singular_ways.py [--starts 3] [--out docs/figures/near_singular_ways.csv]

A minute of one core without other load. Drawers, doors and tables stand in front of the arm, their ways centred at
MIDDLE of its reach. A start is kept if the hand also finds postures at the end of the way, or of each stroke of a wipe,
in the same grip: what no posture at the end can do is no question of how the arm moves.
"""

from __future__ import annotations

import argparse
import functools
import itertools
import math
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation
from table_file import put

import manip_learn as ml
from manip_learn.control.simulation import simulate_way

SEED, DT = 87_000, 0.01  # the law was tuned on other starts; [s]
MIDDLE = 0.55  # of the reach: between too near to fold the arm and too far to reach
HEIGHTS = (0.2, 0.35, 0.5)  # [m] of handles: those of the recorded drawers (examples/data/README.md)
ASIDE = 0.2  # [m] at most, of a handle to the left or right of the arm
OPENED, RADIUS, ANGLE = 0.3, 0.35, math.radians(60.0)  # [m] of a drawer, [m] and [rad] of a door
TABLE = (0.4, 0.3)  # [m] of a table that is wiped: a stroke across, and one towards the arm
HAND, PAUSE = 0.1, 0.5  # [m/s] of the hand, and [s] at rest before the way, as a gripper takes to close
SINGULAR = 0.02  # smallest singular value of the rows held and driven, of a start near a singularity [m or 1]
MARGIN = 0.03  # [rad] of a start from the joint limits
DESCENT, STEPS, TRIES = 0.08, 60, 4  # [rad] a step towards a singularity, steps, and descents of one start
HANDS = {"may turn": False, "keeps its orientation": True}
HEADER = ("the hand", "policy", "ways done", "farthest off [mm]", "least μ over that without policy, median, quartiles")


class Arm(NamedTuple):
    """An arm: its tip, joints that are locked, how far the tip comes from the base's axis [m], and its seed."""

    tip: str
    locked: tuple[str, ...]
    reach: float
    seed: int


ARMS = {
    "panda": Arm("panda_hand_tcp", ("panda_finger_joint1", "panda_finger_joint2"), 0.95, 0),
    "sawyer": Arm("right_gripper_tip", (), 1.17, 4),
    "xarm7": Arm("link_eef", (), 0.77, 1),
}


class Stroke(NamedTuple):
    """One way: along a line, or about an axis through a point; distance and speed [m or rad, a second]."""

    distance: float
    speed: float
    direction: np.ndarray | None = None
    axis: np.ndarray | None = None
    point: np.ndarray | None = None

    def end(self, start: np.ndarray) -> np.ndarray:
        """Pose (4, 4) of the hand after the way."""
        pose = start.copy()
        if self.axis is None:
            pose[:3, 3] += self.distance * self.direction
            return pose
        turn = Rotation.from_rotvec(self.distance * self.axis).as_matrix()
        pose[:3, 3] = self.point + turn @ (start[:3, 3] - self.point)
        return pose


class Case(NamedTuple):
    """What holds the hand, along what it goes, whether it keeps its orientation, and from which posture."""

    constraint: ml.Constraint
    strokes: tuple[Stroke, ...]
    keep: bool
    start: np.ndarray

    def motion(self, number: int) -> ml.FreeDirection:
        """The task of one stroke; only the first one waits for the gripper."""
        stroke, pause = self.strokes[number], 0.0 if number else PAUSE
        wanted = {"distance" if stroke.axis is None else "angle": stroke.distance}
        wanted |= {"speed": stroke.speed, "direction": stroke.direction}
        return ml.motion(self.constraint, keep_orientation=self.keep, pause=pause, **wanted)


Draw = Callable[[ml.Robot, Arm, np.random.Generator], tuple[ml.Constraint, tuple[Stroke, ...], np.ndarray]]


@functools.cache
def robot_of(name: str) -> ml.Robot:
    """The arm by its name."""
    return ml.load_robot(name, locked=ARMS[name].locked)


def handle(arm: Arm, rng: np.random.Generator) -> np.ndarray:
    """The middle of a way, in front of an arm."""
    return np.array([MIDDLE * arm.reach, rng.uniform(-ASIDE, ASIDE), rng.choice(HEIGHTS)])


def drawer(robot: ml.Robot, arm: Arm, rng: np.random.Generator):
    """A drawer that opens towards the base."""
    out = np.array([-1.0, 0.0, 0.0])
    constraint = ml.Constraint(np.eye(3)[1:], ml.FrameJacobian(robot, arm.tip))
    return constraint, (Stroke(OPENED, HAND, out),), handle(arm, rng) - 0.5 * OPENED * out


def door(robot: ml.Robot, arm: Arm, rng: np.random.Generator):
    """A door that opens towards the base, its hinge on either side; the hand on its handle."""
    side, axis = rng.choice([-1.0, 1.0]), np.array([0.0, 0.0, 1.0])
    place = handle(arm, rng) + [0.5 * RADIUS * math.sin(ANGLE), 0.0, 0.0]
    hinge = place + [0.0, side * RADIUS, 0.0]
    rows = ml.MechanismRows(robot, arm.tip, "radial axial", axis=axis, point=hinge, radius=RADIUS)
    return ml.Constraint(np.eye(2), rows), (Stroke(-side * ANGLE, HAND / RADIUS, axis=axis, point=hinge),), place


def wipe(robot: ml.Robot, arm: Arm, rng: np.random.Generator):
    """A level table: one stroke across, one towards the arm, the height held."""
    (across, towards), side = TABLE, rng.choice([-1.0, 1.0])
    constraint = ml.Constraint(np.eye(3)[2:], ml.FrameJacobian(robot, arm.tip))
    strokes = (
        Stroke(across, HAND, np.array([0.0, side, 0.0])),
        Stroke(towards, HAND, np.array([-1.0, 0.0, 0.0])),
    )
    return constraint, strokes, handle(arm, rng) + 0.5 * np.array([towards, -side * across, 0.0])


TASKS: tuple[tuple[Draw, int], ...] = ((drawer, 0), (door, 2), (wipe, 5))  # with their seeds


def posture(robot: ml.Robot, rng: np.random.Generator) -> np.ndarray:
    """A random posture within MARGIN of the limits."""
    return rng.uniform(robot.position_lower + MARGIN, robot.position_upper - MARGIN)


def brought_to(features: ml.FrameJacobian, target: np.ndarray, q: np.ndarray, most: int = 50) -> np.ndarray | None:
    """The posture with a frame at a target that damped steps find from q; None if they find none."""
    robot, q = features.robot, q.copy()
    low, high = robot.position_lower + MARGIN, robot.position_upper - MARGIN
    for _ in range(most):
        error, E = features.error_and_jacobian(target, q)
        size = math.sqrt(error @ error)
        if size < 1e-7:  # [m or rad]: a hundredth of the encoders' noise
            return q
        E = features(q) if E is None else E
        damped = E @ E.T + 1e-3 * min(size, 1.0) * np.eye(len(E))  # full steps near the target
        step = E.T @ np.linalg.solve(damped, error)
        longest = float(np.max(np.abs(step)))
        q = np.clip(q + step * min(1.0, 0.5 / max(longest, 1e-12)), low, high)
    return None


def nearly_singular(rows: ml.Constraint, place: np.ndarray, q: np.ndarray) -> tuple[np.ndarray, float]:
    """Along the self-motion down the slope of mu: the posture nearest to a singularity, and its singular value."""
    at = ml.FrameJacobian(rows.robot, rows.features.frame.name)
    best, least = q, math.inf
    for _ in range(STEPS):
        sigma = smallest(rows, q)
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


def smallest(rows: ml.Constraint, q: np.ndarray) -> float:
    """Smallest singular value of the rows [m or 1]."""
    return float(np.linalg.svd(rows(q), compute_uv=False)[-1])


def start_of(name: str, draw: Draw, keep: bool, rng: np.random.Generator) -> Case | None:
    """One attempt at a start; None if no posture is found at the handle, or at the end of the way."""
    robot, arm = robot_of(name), ARMS[name]
    constraint, strokes, place = draw(robot, arm, rng)
    at = ml.FrameJacobian(robot, arm.tip)
    q = brought_to(at, place, posture(robot, rng))
    if q is None:
        return None
    case = Case(constraint, strokes, keep, q)
    rows = case.motion(0).constraint  # held and driven at the start
    for number in range(TRIES):
        other = brought_to(at, place, posture(robot, rng)) if number else q
        if other is not None:
            there, sigma = nearly_singular(rows, place, other)
            case = min(case, case._replace(start=there), key=lambda c: smallest(rows, c.start))
            if sigma < SINGULAR:
                break
    return case if ends(case, arm, rng) else None


def ends(case: Case, arm: Arm, rng: np.random.Generator) -> bool:
    """Whether postures are found at all ends of its ways, from the start or one of six random postures."""
    robot, pose = case.constraint.robot, case.constraint.robot.pose(case.start, arm.tip)
    features = ml.FrameJacobian(robot, arm.tip, "pose" if case.keep else "xyz")
    for stroke in case.strokes:
        pose = stroke.end(pose)
        starts = itertools.chain([case.start], (posture(robot, rng) for _ in range(6)))
        if all(brought_to(features, pose if case.keep else pose[:3, 3], q) is None for q in starts):
            return False
    return True


def cases_of(arm: str, task: tuple[Draw, int], keep: bool, number: int) -> list[Case]:
    """Starts; the first ones are the same whatever their number."""
    out, (draw, seed) = [], task
    for i in range(number):
        rng = np.random.default_rng([SEED, ARMS[arm].seed, seed, int(keep), 1, i])
        attempts = (start_of(arm, draw, keep, rng) for _ in itertools.count())
        out.append(next(case for case in attempts if case is not None))
    return out


def run(case: Case, climbs: bool) -> tuple[bool, float, float]:
    """Whether all of the ways are done, how far the hand was off at most [m or rad], and the least mu."""
    q, off, least = case.start, 0.0, math.inf
    for number in range(len(case.strokes)):
        task = case.motion(number)
        law = ml.ResolvedRateController(case.constraint, task, task.ascent() if climbs else None, dt=DT)
        rollout, way = simulate_way(case.constraint.robot, law, q, DT)
        begins = rollout.time[-1] if way.begins is None else way.begins
        off = max(off, way.deviation)
        least = min(least, float(np.min(rollout.manipulability[rollout.time >= begins - 1e-9])))
        if not way.is_done or way.strays:
            return False, off, least
        q = rollout.q[-1]
    return True, off, least


def main() -> None:
    """Measure, and write the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--starts", type=int, default=3, help="of each arm and task, with either hand")
    parser.add_argument("--out", type=Path)
    given, lines = parser.parse_args(), []
    for hand, keep in HANDS.items():
        cases = [case for arm in ARMS for task in TASKS for case in cases_of(arm, task, keep, given.starts)]
        scores = {climbs: np.array([run(case, climbs) for case in cases]) for climbs in (False, True)}
        for climbs, (done, off, least) in ((climbs, found.T) for climbs, found in scores.items()):
            ratios = np.quantile(least / scores[False][:, 2], [0.5, 0.25, 0.75])
            cells = (
                f"{done.sum():.0f} of {len(cases)}",
                round(1e3 * off.max(), 2),
                ", ".join(f"{x:.2f}" for x in ratios),
            )
            lines.append((hand, "ascent" if climbs else "none", *cells))
    put(HEADER, lines, given.out)


if __name__ == "__main__":
    main()
