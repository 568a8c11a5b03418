"""Fits of the same recordings by this tree and by another one, in turns, in a process of their own each.

    PYTHONPATH=TREE python benchmarks/reference_fits.py     # a task per line of JSON in, an answer out

Run as a script with PYTHONPATH set to the tree that is to be measured; `Rival` starts it.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any, final

import numpy as np


@final
class Rival:
    """A process that learns with the library of one tree.

    Args:
        tree: Its path; the folder that holds `manip_learn`.
    """

    def __init__(self, tree: Path):
        path = {**os.environ, "PYTHONPATH": str(tree)}
        self._process = subprocess.Popen(
            [sys.executable, __file__], env=path, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )

    def fit(self, task: dict[str, Any]) -> dict[str, Any]:
        """CPU time [s], and A at the postures asked for; or the refusal."""
        source, sink = self._process.stdout, self._process.stdin
        if source is None or sink is None:
            raise RuntimeError("the worker has no pipes")
        sink.write(json.dumps(task) + "\n")
        sink.flush()
        return json.loads(source.readline())

    def close(self) -> None:
        """End the process."""
        self._process.communicate()


def in_turns(
    rivals: dict[str, Rival], robot: dict[str, Any], demos: list[Any], postures: np.ndarray, rounds: int
) -> dict[str, dict[str, Any]]:
    """The least CPU time of each rival over some rounds, and its answer; in a round every rival has its turn."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "set.npz"
        arrays = {f"t{i}": d.time for i, d in enumerate(demos)} | {f"q{i}": d.q for i, d in enumerate(demos)}
        np.savez(file, allow_pickle=False, postures=postures, **arrays)
        task = robot | {"file": str(file), "n": len(demos)}
        answers: dict[str, dict[str, Any]] = {}
        for turn in range(rounds):
            for name in sorted(rivals, reverse=bool(turn % 2)):
                answer = rivals[name].fit(task)
                best = answers.setdefault(name, answer)
                best["cpu s"] = min(best["cpu s"], answer["cpu s"])
    return answers


def _answer(task: dict[str, Any]) -> dict[str, Any]:
    import manip_learn as ml
    from manip_learn.errors import NotIdentifiableError

    robot = ml.load_robot(task["robot"], locked=task["locked"])
    maps = [ml.FrameJacobian(robot, task["tip"], task["axes"], reference) for reference in ("world", "local")]
    with np.load(task["file"]) as data:
        names, postures = robot.joint_names, data["postures"]
        demos = [ml.Trajectory(data[f"t{i}"], data[f"q{i}"], None, names, f"demo_{i}") for i in range(task["n"])]
    learner, started = ml.ConstraintLearner(maps), time.process_time()
    try:
        learner.fit(demos)
    except NotIdentifiableError as refusal:
        return {"cpu s": time.process_time() - started, "refused": str(refusal)}
    seconds = time.process_time() - started
    return {"cpu s": seconds, "A": [np.asarray(learner.constraint_(q)).tolist() for q in postures]}


def main() -> None:
    """Answer until the input ends."""
    for line in sys.stdin:
        sys.stdout.write(json.dumps(_answer(json.loads(line))) + "\n")
        sys.stdout.flush()


if __name__ == "__main__":
    main()
