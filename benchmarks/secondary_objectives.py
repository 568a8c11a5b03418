"""What secondary objectives beside mu gain and cost: oblique reaching tasks of Panda and Sawyer, one table a robot.

    python benchmarks/secondary_objectives.py [number of tasks]

Ratios are to the pseudo-inverse with no policy, per task. `room` is the distance of the joint that is nearest to a
limit, as a share of half its range, in the worst step of the task's last second; `gap` the smallest distance between
two links in the whole motion, which starts without a collision. A task is lost where mean mu is below LOSES times that
with the ascent alone; `worst` is the least ratio of the two.
"""

from __future__ import annotations

import sys
import time
from typing import NamedTuple

import numpy as np
from controller_cases import ROBOTS, inside

import manip_learn as ml

DT, DURATION = 0.01, 5.0  # [s]
REACHED = 0.01  # [m]
LOSES = 0.95


class Task(NamedTuple):
    """One task: its constraint, start and target."""

    constraint: ml.Constraint
    start: np.ndarray
    target: np.ndarray


class Score(NamedTuple):
    """One motion: mu, room and gap as in the head of this file."""

    mean: float
    least: float
    room: float
    gap: float
    reached: bool


def tasks_of(collision: ml.SelfCollision, tip: str, number: int) -> list[Task]:
    """Random oblique tasks with s = 1, 2, 3 rows in turn, from and to random postures within the limits."""
    robot = collision.robot
    features, out = ml.FrameJacobian(robot, tip, "xyz"), []
    for i in range(number):
        rng = np.random.default_rng([8, i])
        rows = np.linalg.qr(rng.normal(size=(3, 3)))[0][: 1 + i % 3]
        goal = robot.position(free(collision, rng), tip)
        out.append(Task(ml.Constraint(rows, features), free(collision, rng), goal))
    return out


def free(collision: ml.SelfCollision, rng: np.random.Generator) -> np.ndarray:
    """A random posture with 3 cm between all links."""
    while True:
        q = inside(collision.robot, rng)
        if not collision.closer_than(q, 0.03):
            return q


def policies_of(constraint: ml.Constraint, collision: ml.SelfCollision) -> dict[str, ml.NullSpacePolicy | None]:
    """Name -> policy."""
    robot = collision.robot
    ascent, limits = ml.ManipulabilityAscent(constraint), ml.JointLimitAvoidance(robot)
    apart, penalised = ml.SelfCollisionAvoidance(collision), ml.PenalisedManipulabilityAscent(constraint)
    return {
        "none": None,
        "mu": ascent,
        "limits": limits,
        "mu + 1 limits": ml.WeightedPolicies([ascent, limits], [1.0, 1.0]),
        "mu + 3 limits": ml.WeightedPolicies([ascent, limits], [1.0, 3.0]),
        "mu_w": penalised,
        "mu_w + 1 limits": ml.WeightedPolicies([penalised, limits], [1.0, 1.0]),
        "mu + 3 collision": ml.WeightedPolicies([ascent, apart], [1.0, 3.0]),
        "mu + 1 limits + 3 collision": ml.WeightedPolicies([ascent, limits, apart], [1.0, 1.0, 3.0]),
    }


def measure(task: Task, policy: ml.NullSpacePolicy | None, collision: ml.SelfCollision) -> Score:
    """One motion with one policy."""
    robot = collision.robot
    controller = ml.ResolvedRateController(task.constraint, ml.PointAttractor(task.target), policy, dt=DT)
    rollout = ml.simulate(robot, controller, task.start, DURATION, DT)
    half = 0.5 * (robot.position_upper - robot.position_lower)
    room = np.minimum(robot.position_upper - rollout.q, rollout.q - robot.position_lower) / half
    gap = min(near.distance for q in rollout.q[::5] if (near := collision.nearest(q)) is not None)
    mu, last = rollout.manipulability, round(1.0 / DT)
    reached = bool(rollout.task_error[-1] < REACHED)
    return Score(float(mu.mean()), float(mu[last:].min()), float(room[-last:].min()), float(gap), reached)


def microseconds(policy: ml.NullSpacePolicy, robot: ml.Robot) -> float:
    """Median time of a call."""
    rng, times = np.random.default_rng(0), []
    for q in [inside(robot, rng) for _ in range(200)]:
        begin = time.perf_counter()
        policy(q)
        times.append(time.perf_counter() - begin)
    return 1e6 * float(np.median(times))


def table(name: str, number: int) -> None:
    """All policies on all tasks of one robot."""
    tip, locked = ROBOTS[name]
    robot = ml.load_robot(name, locked=locked)
    collision = ml.SelfCollision(robot, shapes="visual" if name == "sawyer" else "collision")
    found: dict[str, list[Score]] = {}
    times = {}
    for task in tasks_of(collision, tip, number):
        for policy_name, policy in policies_of(task.constraint, collision).items():
            found.setdefault(policy_name, []).append(measure(task, policy, collision))
            if policy is not None and policy_name not in times:
                times[policy_name] = microseconds(policy, robot)
    print(f"\n{name}, {number} tasks\n")
    print("| policy | mean mu | least mu | mean mu lost | worst | room | room < 0.05 | gap < 0 | reached | us |")
    print("|---|---|---|---|---|---|---|---|---|---|")
    for policy_name, scores in found.items():
        mean = np.array([s.mean / n.mean for s, n in zip(scores, found["none"], strict=True)])
        least = np.array([s.least / n.least for s, n in zip(scores, found["none"], strict=True)])
        to_mu = np.array([s.mean / m.mean for s, m in zip(scores, found["mu"], strict=True)])
        lost, worst = np.sum(to_mu < LOSES), to_mu.min()
        room = np.array([s.room for s in scores])
        print(
            f"| {policy_name} | {np.median(mean):.2f} | {np.median(least):.2f} | {lost} | {worst:.2f} "
            f"| {np.median(room):.2f} | {np.sum(room < 0.05)} | {sum(s.gap < 0.0 for s in scores)} "
            f"| {sum(s.reached for s in scores)} | {times.get(policy_name, 0.0):.0f} |"
        )


if __name__ == "__main__":
    for robot_name in ("panda", "sawyer"):
        table(robot_name, int(sys.argv[1]) if len(sys.argv) > 1 else 20)
