"""Our law, in Python and compiled, beside its peers in one run: time of a step in five states, and what it achieves.

    python benchmarks/beside_peers.py [--robots sawyer ur5] [--tasks 30] [--rounds 30] [--out docs/figures]

Times are ratios to the bare step (Pinocchio's Jacobian, NumPy's pseudo-inverse, the product with the null space) at the
same postures: processor time, best over best of rounds in which all peers take turns, the median over the arms.
Rollouts begin at the same starts, go to the same points and have the same limits. Both are measured for x, y, z of the
tip and, where a peer takes rows of one's own, for two oblique rows. Environments are those of `bench_control_step.py`.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
from datetime import date
from pathlib import Path
from typing import Any, NamedTuple

import control_states as states
import numpy as np
from bench_control_step import ENVIRONMENT, SCRIPTS, interpreter
from controller_cases import ARMS, Tasks, plain_robot, tasks_of, write
from table_file import put

import manip_learn as ml

STATES = ("free", "velocity limits", "one position limit", "near a singularity", "unreachable target")
FAR = ("velocity limits", "unreachable target")
KINDS = {3: "x y z of the tip", 2: "two oblique rows of x y z"}
PEERS = ("pinocchio", "manip_learn", "placo", "oink", "mink", "pink", "drake", "roboticstoolbox")
BARE = "bare"
POSTURES = 24  # of a state
GAIN, TASK_GAIN = 3.0, 2.0
DURATION, DT = 5.0, 0.01  # [s] of a rollout and its step
ARRIVED = 0.001  # [m]
TIMES = ("rows", "arm", "method", "state", "of a bare step", "lowest arm", "highest arm", "postures without an answer")
ENDS = ("rows", "method", "arrived within 1 mm", "end error, median [mm]", "three quarters below [mm]", "worst [mm]")
EXCESS = ("largest excess of velocity [% of the limit]", "of position [mrad]", "steps without an answer")
Row = tuple[object, ...]


class Scores(NamedTuple):
    """One motion.

    Attributes:
        miss: Distance to the target along the rows, in the end [m].
        failed: Steps without an answer.
        over_velocity: Largest velocity that was commanded, less its limit, as a share of it; 0 if within.
        over_position: How far a command led beyond a position limit within its step [rad]; 0 if within.
    """

    miss: float
    failed: int
    over_velocity: float
    over_position: float


def run(peer: str, python: str, cases: Path, tasks: Tasks) -> dict[str, list[Scores]]:
    """Scores of each of a peer's methods.

    Raises:
        subprocess.CalledProcessError: It failed.
    """
    answer = cases.with_name(f"{peer}-{cases.stem}.npz")
    command = [python, str(SCRIPTS / f"{peer}_peer.py"), "control", str(cases), str(answer)]
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True, env=ENVIRONMENT)
    out: dict[str, list[Scores]] = {}
    with np.load(answer) as content:
        for name in dict.fromkeys(key.split("|")[0] for key in content if "|" in key):
            ends, failed, excess = (content[f"{name}|{key}"] for key in ("q", "failed", "excess"))
            places = [tasks.robot.position(q, tasks.tip) for q in ends]
            away = zip(tasks.rows, tasks.targets, places, strict=True)
            misses = [float(np.linalg.norm(rows @ (place - target))) for rows, target, place in away]
            out[name] = [Scores(*x) for x in zip(misses, failed.tolist(), *excess.T.tolist(), strict=True)]
    answer.unlink()
    return out


class Peer:
    """A child that times its methods when it is asked to.

    Attributes:
        version: Package and version.
        methods: Names.

    Raises:
        RuntimeError: The child ended.
    """

    def __init__(self, name: str, python: str):
        command, pipe = [python, str(SCRIPTS / f"{name}_peer.py"), "timings"], subprocess.PIPE
        self._child = subprocess.Popen(
            command, stdin=pipe, stdout=pipe, stderr=subprocess.DEVNULL, text=True, env=ENVIRONMENT
        )
        self.version, self.methods = self._reply()

    def seconds(self, method: str, path: Path) -> tuple[float | None, Any]:
        """Seconds a step and the number of postures without an answer; None and why it cannot."""
        assert self._child.stdin is not None
        self._child.stdin.write(json.dumps([method, str(path)]) + "\n")
        self._child.stdin.flush()
        return self._reply()

    def _reply(self) -> Any:
        assert self._child.stdout is not None
        line = self._child.stdout.readline()
        if not line:
            raise RuntimeError("it ended without an answer")
        return json.loads(line)

    def close(self) -> None:
        """End the child."""
        self._child.communicate()


Found = dict[tuple[int, str, str, str], tuple[float, int]]  # rows, arm, state, method -> ratio, postures without answer


def state_files(folder: Path, arms: list[str]) -> dict[tuple[int, str, str], Path]:
    """Postures of each number of rows, arm and state; those that an arm has."""
    files = {}
    for name in arms:
        robot = plain_robot(name, folder)
        features = ml.FrameJacobian(robot, ARMS[name][0], "xyz")
        for s in KINDS:
            rows = np.linalg.qr(np.random.default_rng(7).normal(size=(3, 3)))[0][:s] if s < 3 else np.eye(3)
            arm = states.arm_with(ml.Constraint(rows, features))
            for state in STATES:
                law = arm.far if state in FAR else arm.controller
                starts = [case.q for case in states.cases_of(arm, state)[:POSTURES]]
                if not starts:
                    continue
                assert isinstance(law.task, ml.PointAttractor)
                n, goal = len(starts), law.task.target
                tasks = Tasks(robot, ARMS[name][0], [rows] * n, starts, [goal] * n)
                files[s, name, state] = folder / f"{name}-{s}-{state}.json"
                write(tasks, files[s, name, state], GAIN, states.DT, 0.0, law.task.gain)
    return files


def times(peers: dict[str, Peer], files: dict[tuple[int, str, str], Path], rounds: int) -> Found:
    """Every method at every file; in a round all files and methods have their turn: what a neighbour does passes by."""
    seconds: dict[tuple[int, str, str, str], float] = {}
    failed: dict[tuple[int, str, str, str], int] = {}
    for i in range(rounds):
        for place, path in files.items():
            for peer in peers.values():
                for method in peer.methods:
                    value, answer = peer.seconds(method, path)
                    if value is not None:
                        seconds[*place, method] = min(value, seconds.get((*place, method), value))
                        failed[*place, method] = answer
        print(f"round {i + 1} of {rounds}, load {os.getloadavg()[0]:.1f}", file=sys.stderr, flush=True)
    bare = {place: seconds.pop((*place, BARE)) for place in files}
    print(f"bare step: {1e6 * min(bare.values()):.0f} to {1e6 * max(bare.values()):.0f} us", file=sys.stderr)
    return {key: (value / bare[key[:3]], failed[key]) for key, value in seconds.items()}


def time_rows(found: Found, s: int, name: str, arms: list[str]) -> list[Row]:
    """A line for each method and state: the median over the arms, and their range."""
    rows: list[Row] = []
    for method in dict.fromkeys(method for number, _, _, method in found if number == s):
        for state in STATES:
            own = [found[key] for arm in arms if (key := (s, arm, state, method)) in found]
            if own:
                ratios = [ratio for ratio, _ in own]
                spread = (f"{x:.2g}" for x in (np.median(ratios), min(ratios), max(ratios)))
                rows.append((KINDS[s], name, method, state, *spread, sum(number for _, number in own)))
    return rows


def rollout_rows(results: dict[str, list[Scores]], s: int) -> list[Row]:
    """What each method achieved, all arms together."""
    rows: list[Row] = []
    for method, own in results.items():
        miss = 1e3 * np.array([x.miss for x in own])
        ends = f"{np.median(miss):.2g}", f"{np.quantile(miss, 0.75):.2g}", f"{miss.max():.0f}"
        speed, place = max(x.over_velocity for x in own), max(x.over_position for x in own)
        arrived = f"{np.sum(miss < 1e3 * ARRIVED)} of {len(own)}"
        excess = f"{100 * speed:.2g}", f"{1e3 * place:.2g}"
        rows.append((KINDS[s], method, arrived, *ends, *excess, sum(x.failed for x in own)))
    return rows


def rollouts(
    pythons: dict[str, str], folder: Path, arms: list[str], number: int, skipped: dict[str, str]
) -> dict[int, dict[str, list[Scores]]]:
    """Scores of every method on the reachable tasks of every arm, by the number of rows."""
    results: dict[int, dict[str, list[Scores]]] = {s: {} for s in KINDS}
    for s in KINDS:
        for name in arms:
            tasks, path = tasks_of(name, folder, number, s), folder / f"{name}-{s}.json"
            write(tasks, path, GAIN, DT, DURATION, TASK_GAIN)
            for peer, python in pythons.items():
                try:
                    for method, own in run(peer, python, path, tasks).items():
                        results[s].setdefault(method, []).extend(own)
                except subprocess.CalledProcessError as error:
                    words = (error.stderr.strip() or "no output").splitlines()[-1]
                    skipped[f"{peer}, {KINDS[s]}, {name}"] = words[:200]
            print(f"{name}, {s} rows: rollouts done", file=sys.stderr, flush=True)
    return results


def main() -> None:
    """Measure and print the tables."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--robots", nargs="+", default=list(ARMS), choices=list(ARMS))
    parser.add_argument("--peers", nargs="+", default=list(PEERS), choices=list(PEERS))
    parser.add_argument("--tasks", type=int, default=30, help="rollouts per robot and kind of rows; 0: none")
    parser.add_argument("--rounds", type=int, default=30)
    parser.add_argument("--out", type=Path, help="folder of the tables; they are printed where none is given")
    options = parser.parse_args()
    pythons: dict[str, str] = {}
    peers: dict[str, Peer] = {}
    skipped: dict[str, str] = {}
    for name in dict.fromkeys(["pinocchio", *options.peers]):
        try:
            pythons[name] = interpreter(name)
            peers[name] = Peer(name, pythons[name])
        except (subprocess.CalledProcessError, RuntimeError) as error:
            words = getattr(error, "stderr", None) or str(error)
            skipped[name] = words.strip().splitlines()[-1][:200]
    parts = [f"{date.today()}, load {os.getloadavg()[0]:.1f} at first; " + ", ".join(x.version for x in peers.values())]
    with tempfile.TemporaryDirectory() as folder:
        found = times(peers, state_files(Path(folder), options.robots), options.rounds)
        for peer in peers.values():
            peer.close()
        groups = {"all": options.robots} | {arm: [arm] for arm in options.robots}
        rows = [row for name, arms in groups.items() for s in KINDS for row in time_rows(found, s, name, arms)]
        put(TIMES, rows, options.out and options.out / "speed_peers.csv")
        if options.tasks:
            able = {name: python for name, python in pythons.items() if name in peers}
            reached = rollouts(able, Path(folder), options.robots, options.tasks, skipped)
            rows = [row for s in KINDS for row in rollout_rows(reached[s], s)]
            put((*ENDS, *EXCESS), rows, options.out and options.out / "speed_rollouts.csv")
    parts += [f"SKIPPED {peer}: {reason}" for peer, reason in skipped.items()]
    parts.append(f"load {os.getloadavg()[0]:.1f} at last")
    print("\n".join(parts), file=sys.stderr)


if __name__ == "__main__":
    main()
