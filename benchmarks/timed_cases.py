"""What is timed in this tree and in the last release, in alternation: a few calls of every benchmark.

    PYTHONPATH=TREE python benchmarks/timed_cases.py     # a case and a number of calls per line of JSON in, seconds out

`bench_release.py` starts one such process per tree. A case is made from the package's public names only, so that a
release of some time ago can run it; one that it cannot run yet is answered with the reason.
"""

from __future__ import annotations

import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))

Call = Callable[[], object]
CENTRE = np.array([0.1, -0.6, 0.2, 1.3, -0.2, 0.7, 0.4])  # of the Sawyer, far from limits and singularities [rad]
STRAIGHT = np.array([0.1, -0.6, 0.0, 0.0, -0.2, 0.7, 0.4])  # elbow straight: the end of its reach [rad]
TARGETS = {"": (0.75, 0.2, 0.35), ", unreachable target": (3.0, 0.8, 1.4)}  # [m]
FOLDER = Path(tempfile.gettempdir()) / f"manip_learn_bench_{os.getuid()}"  # files that the cases read


def held_rows(axes: str = "xyz") -> Any:
    """Two oblique rows of the Sawyer's last link."""
    import manip_learn as ml

    features = ml.FrameJacobian(ml.load_robot("sawyer"), "right_l6", axes)
    return ml.Constraint(np.linalg.qr(np.random.default_rng(7).normal(size=(3, 3)))[0][:2], features)


def law(target: tuple[float, ...] = TARGETS[""]) -> Any:
    """The default controller towards a point, which climbs the manipulability."""
    import manip_learn as ml

    constraint = held_rows()
    task = ml.PointAttractor(list(target))
    return ml.ResolvedRateController(constraint, task, ml.ManipulabilityAscent(constraint), dt=0.001)


def step(centre: np.ndarray, target: tuple[float, ...] = TARGETS[""], from_rest: bool = False) -> Call:
    """64 steps at postures around one."""
    postures = centre + np.random.default_rng(0).uniform(-0.02, 0.02, (64, 7))
    controller, previous = law(target), np.zeros(7) if from_rest else None

    def run() -> None:
        for q in postures:
            controller(q, 0.0, 0.001, previous)

    return run


def five_seconds() -> Call:
    """A rollout in steps of 0.01 s."""
    import manip_learn as ml

    robot, controller = ml.load_robot("sawyer"), law()
    return lambda: ml.simulate(robot, controller, CENTRE, 5.0, 0.01)


def batch(what: str) -> Call:
    """8,192 Jacobians, or mu and its gradient at as many postures."""
    import manip_learn as ml

    q, constraint = np.random.default_rng(0).uniform(-1.5, 1.5, (8192, 7)), held_rows()
    features = ml.FrameJacobian(constraint.robot, "right_l6", "pose")
    if what == "Jacobians":
        return lambda: features.batch(q)
    return lambda: ml.manipulability_batch(constraint, q)


def learning(held: bool, **settings: Any) -> Call:
    """A thousand samples of a 7-joint arm with 2 % noise."""
    from scale_motions import motions

    import manip_learn as ml

    features = ml.FrameJacobian(ml.load_robot("sawyer"), "right_gripper_tip", "xyz")
    rng = np.random.default_rng(1)
    demos = motions(features, np.linalg.qr(rng.standard_normal((3, 2)))[0].T, rng, 10, noise=0.02, held=held)
    return lambda: ml.ConstraintLearner(features, **settings).fit(demos)


def fleet(stream: bool) -> Call:
    """100 episodes as NPZ files, read, or streamed to Lambda."""
    from scale_motions import motions

    import manip_learn as ml

    features = ml.FrameJacobian(ml.load_robot("sawyer"), "right_gripper_tip", "xyz")
    folder, rng = FOLDER / "fleet", np.random.default_rng(1)
    if not folder.is_dir():
        folder.mkdir(parents=True)
        for i, t in enumerate(motions(features, np.eye(3)[:2], rng, 100, 100, 0.02, held=True)):
            np.savez(folder / f"episode_{i:03d}.npz", time=t.time, q=t.q, u=t.u, joint_names=np.array(t.joint_names))
    if not stream:
        return lambda: ml.load_demonstrations(folder, features.robot)
    return lambda: ml.ConstraintLearner(features, 2, "null-space").fit(ml.RecordingSource(folder, features.robot))


def recording(kind: str) -> Call:
    """A bag of 10,000 joint states, or a table of as many rows."""
    from bench_recordings import NAMES, write_bag, write_table

    import manip_learn as ml

    path, robot = FOLDER / NAMES[kind], ml.load_robot("planar3")
    if not path.exists():
        path.parent.mkdir(parents=True, exist_ok=True)
        (write_table if kind == "table" else write_bag)(path, kind, 10_000)
    return lambda: ml.load_demonstrations(path, robot)


def command(name: str) -> Call:
    """A whole command."""
    from bench_startup import COMMANDS

    return lambda: subprocess.run(
        [sys.executable, "-m", "manip_learn", *COMMANDS[name]], stdout=subprocess.DEVNULL, check=True, timeout=120
    )


def loading() -> Call:
    """A robot with all checks."""
    import manip_learn as ml

    return lambda: ml.load_robot("sawyer")


# benchmark -> what is timed -> makes the call
CASES: dict[str, dict[str, Callable[[], Call]]] = {
    "control_step": {"python, free": lambda: step(CENTRE), "a rollout of 5 s": five_seconds},
    "states": {
        "python, unreachable target": lambda: step(CENTRE, TARGETS[", unreachable target"]),
        "python, acceleration limits": lambda: step(CENTRE, from_rest=True),
        "python, at the end of its reach": lambda: step(STRAIGHT),
        "python, outside limits": lambda: step(CENTRE + np.array([3.0, 0, 0, 0, 0, 0, 0])),
    },
    "batch_kinematics": {
        "Jacobians, python": lambda: batch("Jacobians"),
        "mu and gradient, python": lambda: batch("mu and gradient"),
    },
    "learning": {
        "auto, b = 0": lambda: learning(True),
        "auto, b varies": lambda: learning(False),
        "joint, affine, 2 rows": lambda: learning(False, estimator="joint", n_constraints=2, policy_model="affine"),
        "null-space, b = 0, 2 rows": lambda: learning(True, estimator="null-space", n_constraints=2),
    },
    "fleet": {"100 NPZ episodes read": lambda: fleet(False), "100 NPZ episodes streamed": lambda: fleet(True)},
    "startup": {name: lambda n=name: command(n) for name in ("--help", "inspect sawyer", "learn, 50 CSV files")},
    "loading": {"sawyer": loading},
    "recordings": {
        kind: lambda k=kind: recording(k) for kind in ("table", *(("mcap",) if find_spec("rosbags") else ()))
    },
}
# files may be parsed in processes that go on living: their time shows on the wall only
ON_THE_WALL = ("fleet", "recordings")


def processor_time() -> float:
    """Of this process and of those that it has ended [s]."""
    both = (resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    return sum(used.ru_utime + used.ru_stime for used in both)


def main() -> None:
    """Answer until the input ends; one case is kept at a time."""
    asked, call = None, None
    for line in sys.stdin:
        task = json.loads(line)
        clock = time.perf_counter if task["benchmark"] in ON_THE_WALL else processor_time
        try:
            if call is None or (task["benchmark"], task["case"]) != asked:
                asked, call = (task["benchmark"], task["case"]), CASES[task["benchmark"]][task["case"]]()
                call()  # loads what it needs
            begin = clock()
            for _ in range(task["calls"]):
                call()
            answer = {"seconds": (clock() - begin) / task["calls"]}
        except (ImportError, AttributeError, TypeError, ValueError) as error:  # a release without this ability
            asked, call, answer = None, None, {"cannot": f"{type(error).__name__}: {error}"}
        print(json.dumps(answer), flush=True)


if __name__ == "__main__":
    main()
