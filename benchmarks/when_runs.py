"""Ways, reaching, plans and peers on the starts of `when_cases.py`, all judged from the joint path by one rule."""

from __future__ import annotations

import os
import subprocess
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
from controller_cases import plain_urdf
from when_cases import PAUSE, Case

import manip_learn as ml
from manip_learn.control.simulation import AT_REST, DONE, SLACK, STRAY, WayDone, simulate_way
from manip_learn.planning.clearance import links_of

GAIN, DURATION, THERE = 2.0, 5.0, 1e-3  # [1/s] and [s] of reaching, and what may be missing of it [m or rad]
SCRIPTS = Path(__file__).resolve().parent / "peers"
OWN = ("none", "learnt", "held", "limits")
SLOW = ("plan",)  # what takes seconds a start
PEERS = ("pink", "mink", "placo")
POLICIES = (*OWN, *SLOW, *PEERS)


class Score(NamedTuple):
    """What became of one start, with one policy."""

    done: bool
    seconds: float | None  # [s] from the beginning of the way until it was done
    deviation: float  # [m or rad] at most off what is held
    fastest: float  # speed of the joint nearest to its velocity limit, as a share of that limit
    least: float  # mu of the rows held and driven, on the way
    mean: float
    why: str = ""  # of what was not done


class Part(NamedTuple):
    """One stroke: its score, and mu at its samples."""

    score: Score
    mu: np.ndarray


NOTHING = Score(False, None, float("nan"), float("nan"), float("nan"), float("nan"), "no plan")


def policy_of(name: str, case: Case, task: ml.FreeDirection | None) -> ml.NullSpacePolicy | None:
    """A null-space policy by its name; reaching, which has no way, has no other ascent than that of its rows."""
    rows = case.held() if task is None else task.constraint
    made: dict[str, Callable[[], ml.NullSpacePolicy]] = {
        "learnt": lambda: ml.ManipulabilityAscent(rows),
        "ascent": lambda: ml.ManipulabilityAscent(rows) if task is None else task.ascent(),
        "held": lambda: ml.ManipulabilityAscent(case.held()),
        "limits": lambda: ml.JointLimitAvoidance(case.constraint.robot),
    }
    return None if name == "none" else made[name]()


def scored(way: WayDone, mu: np.ndarray) -> Part:
    """One stroke that `simulate_way` has made."""
    good = way.is_done and not way.strays
    why = "" if good else way.stopped_by or f"{1e3 * way.deviation:.1f} mm off"
    least, mean = float(np.min(mu)), float(np.mean(mu))
    return Part(Score(good, way.seconds, way.deviation, way.fastest[1], least, mean, why), mu)


def judged(task: ml.FreeDirection, time: np.ndarray, q: np.ndarray, u: np.ndarray, pause: float) -> Part:
    """One stroke from any joint path, by the rule of `simulate_way`: the whole way, never farther off than STRAY."""
    robot = task.constraint.robot
    task.reset()
    task.velocity(task.constraint, q[0], 0.0)  # that is where the way begins
    first = int(np.searchsorted(time, time[0] + pause - 1e-9))
    places = np.zeros(len(q) - first)
    for i, posture in enumerate(q[first:]):
        places[i] = task.progress_near(posture, places[i - 1] if i else 0.0)
    deviation = max(task.deviation(posture, s) for posture, s in zip(q[first:], places, strict=True))
    there = np.flatnonzero(np.abs(places - task.wanted) <= DONE[task.unit])
    is_done = len(there) > 0 and there[-1] == len(places) - 1
    seconds = float(time[first + there[0]] - time[first]) if is_done else None
    mu = ml.manipulability_batch(task.constraint, q[first:]).mu
    fastest = float(np.max(np.abs(u) / robot.velocity_limit))
    good = is_done and deviation <= STRAY
    why = "" if good else f"{places[-1]:.3f} of {task.wanted:.3f} {task.unit}, {1e3 * deviation:.1f} mm off"
    return Part(Score(good, seconds, deviation, fastest, float(np.min(mu)), float(np.mean(mu)), why), mu)


def reached(case: Case, time: np.ndarray, q: np.ndarray, u: np.ndarray) -> Score:
    """Reaching from any joint path: done within THERE of the target at the end, mu from PAUSE on as with the ways."""
    rows = case.held()
    target = ml.PointAttractor(case.target if case.keep else case.target[:3, 3])
    left = np.array([target.error(rows, posture, 0.0) for posture in q])
    late = np.flatnonzero(left > THERE)
    good = bool(left[-1] <= THERE)
    mu = ml.manipulability_batch(rows, q[time >= PAUSE - 1e-9]).mu
    fastest = float(np.max(np.abs(u) / rows.robot.velocity_limit))
    seconds = float(time[late[-1] + 1]) if good and len(late) else 0.0 if good else None
    why = "" if good else f"{left[-1]:.4f} left"
    return Score(good, seconds, 0.0, fastest, float(np.min(mu)), float(np.mean(mu)), why)


def together(parts: list[Part], wanted: int) -> Score:
    """The strokes of one task as one score."""
    scores, mu = [part.score for part in parts], np.concatenate([part.mu for part in parts])
    good = len(parts) == wanted and all(score.done for score in scores)
    seconds = [score.seconds for score in scores if score.seconds is not None]
    return Score(
        good,
        sum(seconds) if good else None,
        max(score.deviation for score in scores),
        max(score.fastest for score in scores),
        float(np.min(mu)),
        float(np.mean(mu)),
        scores[-1].why,
    )


def run(case: Case, name: str, dt: float) -> Score:
    """One start with one policy or a plan."""
    if not case.strokes:
        return _reaching(case, name, dt)
    make = _plan if name == "plan" else _stroke
    q, parts = case.start, []
    for number in range(len(case.strokes)):
        answer = make(case, number, q, name, dt)
        if answer is None:
            return together(parts, len(case.strokes))._replace(why="no plan") if parts else NOTHING
        q, part = answer
        parts.append(part)
        if not part.score.done:
            break
    return together(parts, len(case.strokes))


def _stroke(case: Case, number: int, q: np.ndarray, name: str, dt: float) -> tuple[np.ndarray, Part]:
    task = case.motion(number)
    law = ml.ResolvedRateController(case.constraint, task, policy_of(name, case, task), dt=dt)
    rollout, way = simulate_way(case.constraint.robot, law, q, dt)
    begins = rollout.time[-1] if way.begins is None else way.begins
    return rollout.q[-1], scored(way, rollout.manipulability[rollout.time >= begins - 1e-9])


def _plan(case: Case, number: int, q: np.ndarray, name: str, dt: float) -> tuple[np.ndarray, Part] | None:
    task, links = case.motion(number), links_of(case.constraint.robot)[0]
    touching = links is not None and bool(links.closer_than(q, 0.0))  # starts are drawn without regard to links
    try:
        way = ml.plan(case.constraint, task, q, seed=0, collision=not touching).way
    except ml.NoPlanError:
        return None
    return way.q[-1], judged(task, way.time, way.q, way.u, 0.0)


def _reaching(case: Case, name: str, dt: float) -> Score:
    if name == "plan":
        raise LookupError("reaching has no way that could be planned")
    rows, robot = case.held(), case.constraint.robot
    task = ml.PointAttractor(case.target if case.keep else case.target[:3, 3], GAIN)
    law = ml.ResolvedRateController(rows, task, policy_of(name, case, None), dt=dt)
    rollout = ml.simulate(robot, law, case.start, DURATION, dt)
    return reached(case, rollout.time, rollout.q, rollout.u)


def poses_of(case: Case, dt: float) -> tuple[np.ndarray, list[slice]]:
    """What peers are to follow, a pose a step, (T, 4, 4), and the samples of each stroke, with the rest after it."""
    pose = case.constraint.robot.pose(case.start, case.constraint.features.frame)
    if not case.strokes:
        return np.repeat(case.target[None], round(DURATION / dt) + 1, axis=0), []
    poses, slices = [], []
    for number, stroke in enumerate(case.strokes):
        pause, rest = (0.0 if number else PAUSE), AT_REST if number + 1 < len(case.strokes) else SLACK
        steps, profile = round((pause + stroke.profile().duration + rest) / dt), stroke.profile()
        slices.append(slice(len(poses), len(poses) + steps + 1))
        poses += [stroke.place(pose, profile.at(i * dt - pause)[0]) for i in range(steps)]
        pose = stroke.place(pose, stroke.distance)
    return np.array([*poses, pose]), slices


def peer_rows(case: Case) -> np.ndarray:
    """Rows (s, 6) of the hand's pose that a peer is asked for: all of the place on a way, Lambda where it reaches."""
    linear = np.eye(3) if case.strokes else case.constraint.selection
    rows = np.hstack([linear, np.zeros_like(linear)])
    return np.vstack([rows, np.eye(6)[3:]]) if case.keep else rows


def run_peer(peer: str, python: str, cases: list[Case], dt: float) -> list[Score]:
    """All starts of a cell by a peer, in an environment of its own; where it ends in an error none counts as done."""
    with tempfile.TemporaryDirectory() as folder:
        asked, answer = Path(folder) / "asked.npz", Path(folder) / "answer.npz"
        _write(cases, asked, dt)
        command = [python, str(SCRIPTS / f"{peer}_peer.py"), "way", str(asked), str(answer)]
        environment = {**os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
        environment.pop("PYTHONPATH", None)
        quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.PIPE, "text": True}
        ended = subprocess.run(command, check=False, env=environment, **quiet)
        if ended.returncode:
            why = (ended.stderr.strip().splitlines() or ["no words"])[-1]
            return [NOTHING._replace(why=f"error: {why:.80}")] * len(cases)
        with np.load(answer) as content:
            paths = list(zip(content[f"{peer}|q"], content[f"{peer}|u"], strict=True))
    return [_judged_peer(case, q, u, dt) for case, (q, u) in zip(cases, paths, strict=True)]


def _write(cases: list[Case], path: Path, dt: float) -> None:
    """What the child reads."""
    case, robot = cases[0], cases[0].constraint.robot
    out = {"urdf": str(plain_urdf(robot, path.parent)), "tip": case.constraint.features.frame.name, "dt": dt}
    out |= {"names": list(robot.joint_names), "lower": robot.position_lower, "upper": robot.position_upper}
    out |= {"velocity": robot.velocity_limit, "number": len(cases), "whole": case.keep and robot.nv >= 6}
    out |= {"gain": 1.0 if case.strokes else GAIN * dt}
    for i, one in enumerate(cases):
        out |= {f"rows{i}": peer_rows(one), f"start{i}": one.start, f"poses{i}": poses_of(one, dt)[0]}
    np.savez(path, **out)


def _judged_peer(case: Case, q: np.ndarray, u: np.ndarray, dt: float) -> Score:
    time = dt * np.arange(len(q))
    if not case.strokes:
        return reached(case, time, q, u)
    parts = []
    for number, part in enumerate(poses_of(case, dt)[1]):
        task = case.motion(number)
        parts.append(judged(task, time[part], q[part], u[part], task.pause))
    return together(parts, len(case.strokes))
