"""The law where it is hardest: ways that begin near a singularity, firm grips, targets and ways out of reach.

    python benchmarks/near_singular_ways.py --short docs/figures/near_singular_ways.csv
    python benchmarks/near_singular_ways.py [--runs FILE.csv] [--workers 1]

The first, a minute of one core without other load, is what the ascent of a way brings to three arms. Of the second one
line is one start with one policy; a quarter of an hour.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Callable, Iterable
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple

import controller_cases
import numpy as np
from closed_loops import PERIODS, singular_starts
from controller_scores import scores
from table_file import put
from when_cases import ARMS, PAUSE, TASKS, Case, cases_of, exists, posture, robot_of
from when_runs import run

import manip_learn as ml
from manip_learn.control.simulation import simulate_way

SHORT_ARMS, SHORT_TASKS = ("panda", "sawyer", "xarm7"), ("drawer 0.3 m", "door 60 deg", "wipe 0.4 x 0.3 m")
SHORT_STARTS = 3  # of each arm and task, with either hand
SHORT = ("the hand", "policy", "ways done", "farthest off [mm]", "least μ over that without policy, median, quartiles")
SEEDS = (41_000, 87_000)  # the law was tuned on the starts of the first one
STARTS = 2  # of each arm and task
DT = 0.01  # [s]
POLICIES = ("none", "learnt", "ascent")
XARM = (3.302, -1.7578, 0.2082, 3.0665, 5.0783, 1.7292, 0.1807)  # [rad] of the smallest case
POINTS, SECONDS = 12, 8.0  # targets out of reach of each arm, and how long each is driven to [s]
SPEED, BEYOND, TAIL = 0.25, 2.2, 1.0  # [m/s] of ways out of reach, their length in reaches, last seconds looked at [s]
STILL = 1e-3  # [rad/s] below which a joint does not count as turning to and fro


class Run(NamedTuple):
    """The outcome of one start with one policy.

    `good` is a way that was done, a target out of reach without chatter, or a singularity that was left; `off` is how
    far the hand was off its mechanism [mm], and `why` says what stopped it.
    """

    part: str
    seed: int
    arm: str
    task: str
    number: int
    policy: str
    good: bool
    off: float
    why: str


def way(part: str, seed: int, arm: str, task: str, number: int, policy: str) -> Run:
    """One start of `when_cases.py`, the hand held in its orientation, or turning with its mechanism ("firm grip")."""
    case = cases_of(arm, task, "held", "near", number + 1, seed)[number]
    if part == "firm grip":
        done, off, why = firm(case, policy)
    else:
        score = run(case, policy, DT)
        done, off, why = score.done, score.deviation, score.why
    return Run(part, seed, arm, task, number, policy, done, round(1e3 * off, 3), why)


def firm(case: Case, policy: str) -> tuple[bool, float, str]:
    """A door or screw whose handle is gripped firmly: five constant rows of the pose in the hand's own frame."""
    (stroke,), robot, frame = case.strokes, case.constraint.robot, case.constraint.features.frame
    pose = robot.pose(case.start, frame)
    moves = np.cross(stroke.axis, pose[:3, 3] - stroke.point) + stroke.pitch * stroke.axis
    twist = np.concatenate([pose[:3, :3].T @ moves, pose[:3, :3].T @ stroke.axis])
    rows = np.linalg.svd(twist[None])[2][1:]
    constraint = ml.Constraint(rows, ml.FrameJacobian(robot, frame.name, "pose", reference="local"))
    there = stroke.place(pose, stroke.distance)[:3, 3]

    def beside(task: ml.FreeDirection) -> float:
        task.velocity(constraint, case.start, 0.0)  # that is where the way begins
        return float(np.linalg.norm(task.goal()[:3, 3] - there))

    # which sense counts as positive is up to the rows
    senses = (stroke.distance, -stroke.distance)
    task = min((ml.FreeDirection(constraint, s, stroke.speed, unit="rad", pause=PAUSE) for s in senses), key=beside)
    task.reset()
    law = ml.ResolvedRateController(constraint, task, climbing(policy, task), dt=DT)
    done = simulate_way(robot, law, case.start, DT)[1]
    why = done.stopped_by or (f"{1e3 * done.deviation:.1f} mm off" if done.strays else "")
    return not why, done.deviation, why


def climbing(policy: str, task: ml.FreeDirection) -> ml.NullSpacePolicy | None:
    """A null-space policy for a way by its name."""
    return {"none": None, "learnt": ml.ManipulabilityAscent(task.constraint), "ascent": task.ascent()}[policy]


def short() -> list[tuple[str, str, str, float, str]]:
    """54 starts of three arms: ways done, how far the hand was off [mm], and the least μ over that without policy."""
    lines = []
    for grip, hand in (("free", "may turn"), ("held", "keeps its orientation")):
        cells = [(arm, task) for arm in SHORT_ARMS for task in SHORT_TASKS]
        cases = [case for cell in cells for case in cases_of(*cell, grip, "near", SHORT_STARTS, SEEDS[1])]
        scores = {policy: [run(case, policy, DT) for case in cases] for policy in ("none", "ascent")}
        for policy, found in scores.items():
            ratios = [now.least / rest.least for now, rest in zip(found, scores["none"], strict=True)]
            least = ", ".join(f"{x:.2f}" for x in np.quantile(ratios, [0.5, 0.25, 0.75]))
            off = round(1e3 * max(score.deviation for score in found), 2)
            lines.append((hand, policy, f"{sum(score.done for score in found)} of {len(cases)}", off, least))
    return lines


def smallest_case(policy: str) -> Run:
    """Half a metre along x, y and z held, from a posture with a spare joint near its limit."""
    robot = ml.load_robot("xarm7")
    constraint = ml.Constraint([[0, 1, 0], [0, 0, 1]], ml.FrameJacobian(robot, "link_eef"))
    task = ml.FreeDirection(constraint, -0.5, 0.1)
    law = ml.ResolvedRateController(constraint, task, climbing(policy, task), dt=DT)
    done = simulate_way(robot, law, XARM, DT)[1]
    off = round(1e3 * done.deviation, 3)
    return Run("smallest case", 0, "xarm7", "line", 0, policy, done.is_done, off, done.stopped_by or "")


def points(arm: str, dt: float, gain: float) -> list[Run]:
    """Points out of reach, climbing the manipulability: whether a joint turns to and fro in the last second."""
    out = []
    with tempfile.TemporaryDirectory() as folder:
        tasks = controller_cases.tasks_of(arm, Path(folder), POINTS, reachable=False)
        for i in range(POINTS):
            rows = tasks.constraint(i)
            task = ml.PointAttractor(tasks.targets[i], gain)
            law = ml.ResolvedRateController(rows, task, ml.ManipulabilityAscent(rows), dt=dt)
            rollout = ml.simulate(tasks.robot, law, tasks.starts[i], SECONDS, dt)
            flips = scores(tasks, i, rollout.q, rollout.u, dt, 0.0, 0).flips
            why = f"{flips:.0f} changes of sign, {rollout.status[-1]}" if flips else ""
            part = f"point out of reach, {1e3 * dt:.0f} ms, gain {gain:g}"
            out.append(Run(part, 0, arm, f"{len(rows.selection)} rows", i, "learnt", not flips, 0.0, why))
    return out


def long_way(arm: str, number: int, dt: float, policy: str) -> Run:
    """A straight way of two reaches and more: whether a joint turns to and fro in the last second, and how far off."""
    rng, robot = np.random.default_rng([9, list(ARMS).index(arm), number]), robot_of(arm)
    q, features = posture(robot, rng), ml.FrameJacobian(robot, ARMS[arm].tip)
    constraint = ml.Constraint(np.linalg.qr(rng.normal(size=(3, 3)))[0][:2], features)
    distance = BEYOND * ARMS[arm].reach * (1 if rng.random() < 0.5 else -1)
    keep = robot.nv >= 6 and number % 2 == 0
    task = ml.FreeDirection(constraint, distance, SPEED, straight=True, keep_orientation=keep)
    law = ml.ResolvedRateController(constraint, task, climbing(policy, task), dt=dt)
    rollout = ml.simulate(robot, law, q, abs(distance) / SPEED + 3.0, dt)
    tail = rollout.u[-round(TAIL / dt) :]
    moving = (np.abs(tail[1:]) > STILL) & (np.abs(tail[:-1]) > STILL)
    flips = int(np.sum(moving & (np.sign(tail[1:]) != np.sign(tail[:-1])), axis=0).max())
    off = max(task.deviation(posture, task.progress_near(posture, 0.0)) for posture in rollout.q[::5])
    why = f"{flips} changes of sign, {rollout.status[-1]}" if flips else ""
    kind = "orientation kept" if keep else "hand may turn"
    part = f"way out of reach, {1e3 * dt:.0f} ms"
    return Run(part, 9, arm, kind, number, policy, not flips, round(1e3 * off, 3), why)


def singular() -> list[Run]:
    """Exactly singular starts of ten arms (`closed_loops.py`): how many are left within a second."""
    out = []
    for arm, *cells in singular_starts(6):
        for kind, cell in zip(("holding", "reaching", "along the lost direction"), cells, strict=True):
            counts, _, of = cell.partition(" of ")
            for dt, left in zip(PERIODS, counts.split(", "), strict=True):
                part = f"singular start, {1e3 * dt:.0f} ms"
                out += [Run(part, 17, arm, kind, i, "learnt", i < int(left), 0.0, "") for i in range(int(of))]
    return out


def policies() -> tuple[str, ...]:
    """Without the ascent of the task, where that is the ascent of the manipulability."""
    task = cases_of("panda", "drawer 0.3 m", "held", "near", 1, SEEDS[0])[0].motion(0)
    return POLICIES[:2] if type(task.ascent()) is ml.ManipulabilityAscent else POLICIES


def jobs() -> Iterable[tuple[Callable[..., Any], tuple[Any, ...]]]:
    """All of the work, in pieces."""
    names = policies()
    cells = [(arm, task) for arm in ARMS for task in TASKS if exists(arm, task, "held")]
    firmly = [cell for cell in cells if cell[1].startswith(("door", "screw"))]
    for seed in SEEDS:
        for part, some in (("way", cells), ("firm grip", firmly)):
            yield from ((way, (part, seed, *c, i, p)) for c in some for i in range(STARTS) for p in names)
    yield from ((smallest_case, (p,)) for p in names)
    yield from ((points, (a, *g)) for g in ((0.01, 1.0), (0.02, 1.0), (0.02, 3.0)) for a in controller_cases.ROBOTS)
    yield from ((long_way, (a, i, t, p)) for t in (0.01, 0.02) for a in ARMS for i in range(6) for p in POLICIES[:2])
    yield singular, ()


def done_job(job: tuple[Callable[..., Any], tuple[Any, ...]]) -> list[Run]:
    """One piece of the work."""
    found = job[0](*job[1])
    return found if isinstance(found, list) else [found]


def main() -> None:
    """Measure, and write the runs."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--runs", type=Path, default=Path("near_singular_ways.csv"))
    parser.add_argument("--short", type=Path, help="write the short table here, and nothing else")
    parser.add_argument("--workers", type=int, default=1)
    given = parser.parse_args()
    if given.short is not None:
        put(SHORT, short(), given.short)
        return
    runs: list[Run] = []
    with ProcessPoolExecutor(given.workers) as pool:
        for some in pool.map(done_job, jobs()):
            runs += some
            put(Run._fields, runs, given.runs)  # what is done so far stays if the rest is interrupted


if __name__ == "__main__":
    main()
