"""How long a fit takes at most, beside the median of sets of its size: every fit is to end within ten times that.

    python benchmarks/fits_end.py --sets 500 --out table.csv

A set is drawn from its number: motions that a mechanism carries (lines, planes, arcs and cylinders of 0.1 to 3 m
radius, hinges, screws, balls; at one place, at two, moved each time, or with the joints' zeros off), the recordings of
tasks of examples/make_recordings (whole and cut, mixed, slipped, moved, free motion), those of people's hands, and
motions that somebody imposes. The time is that of the processor. Sets of a class have as many samples, to a power of
four, and are alike in whether rows that somebody moves on purpose were looked for: a policy model is fitted from many
starts then, which takes 10 to 25 s however few the samples are.
"""

from __future__ import annotations

import argparse
import math
import signal
import statistics
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "examples"))
sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))

from generated_motions import PLANAR_ROWS, arm_features, guided_motions, oblique, paper_motions, planar_features
from guided_hands import HandSet
from make_recordings.arms import ROBOTS
from make_recordings.kinds import KINDS
from mechanism_motions import about, along, ball, demonstrate, wave
from recording_cases import FIRM, Case
from scale_motions import motions
from scipy.spatial.transform import Rotation
from table_file import put
from task_sets import arm

import manip_learn as ml
from manip_learn.learning import answer as answer_file

ESTIMATE = answer_file.learn_imposed
LIMIT = 10.0  # times the median
GIVEN_UP_SECONDS = 900  # [s] a fit that takes longer is one that does not end
MIDDLE = {
    "panda": ("panda_hand_tcp", (0.0, -0.3, 0.0, -1.9, 0.0, 1.7, 0.6)),
    "xarm7": ("link_eef", (0.0, -0.2, 0.0, 1.2, 0.0, 1.4, 0.0)),
}
SHAPES = ("cylinder", "cylinder", "arc", "line", "plane", "hinge", "screw", "ball")
Drawn = tuple[str, Sequence[ml.FrameJacobian], Any]


def side(radius: float, turn: Rotation, width: float = 0.14) -> Callable[..., Any]:
    """Path of a hand on a cylinder; of no width, along an arc."""

    def path(pose: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, None]:
        # at most a quarter of a turn each way, and 0.14 m
        way = wave(rng, np.array([min(0.14, radius), width]))
        phi = way[:, 0] / radius
        return pose[:3, 3] + turn.apply(
            np.column_stack([radius * np.sin(phi), way[:, 1], radius * np.cos(phi) - radius])
        ), None

    return path


def shape(kind: str, turn: Rotation, radius: float, handle: np.ndarray) -> Callable[..., Any]:
    """Path of a hand on one thing, turned."""
    axis = turn.apply([0.0, 0.0, 1.0])
    match kind:
        case "cylinder":
            return side(radius, turn)
        case "arc":
            return side(radius, turn, 0.0)
        case "line":
            return along(turn.apply([[0.8, 0.6, 0.0]]), 0.2, firm=False)
        case "plane":
            return along(turn.apply([[1.0, 0.0, 0.1], [0.0, 1.0, 0.0]]), 0.2, firm=False)
        case "ball":
            return ball(handle + turn.apply([0.0, 0.0, -min(radius, 0.6)]), 0.15 / min(radius, 0.6), firm=False)
    point = handle + turn.apply([min(radius, 1.0), 0.0, 0.0])
    pitch = 0.03 if kind == "screw" else 0.0
    return about(axis, point, min(0.2 / radius, 0.6), pitch=pitch, firm=kind == "hinge")


def on_mechanisms(seed: int) -> Drawn:
    """Six to eight recordings of a hand on something; at one place, at two, moved each time, or by an arm that is off.

    Raises:
        RuntimeError: The arm does not get along the path.
    """
    rng = np.random.default_rng([seed, 1])
    name, kind = str(rng.choice(list(MIDDLE))), str(rng.choice(SHAPES))
    radius, where = float(rng.choice([0.1, 0.3, 1.0, 3.0])), str(rng.choice(["one", "two", "moved", "off"]))
    robot, (frame, middle) = arm(name), MIDDLE[name]
    handle = robot.position(np.array(middle), robot.frame(frame))
    first = Rotation.from_rotvec(rng.normal(0.0, 0.3, 3))
    steps = {"one": 0.0, "off": 0.0, "two": math.radians(float(rng.choice([0.5, 1.0, 5.0]))), "moved": 0.08}
    demos, n = [], int(rng.choice([6, 8, 12]))
    for i in range(n):
        angle = steps[where] * (i % 2 if where == "two" else rng.normal())
        path = shape(kind, Rotation.from_rotvec([0.0, 0.6 * angle, 0.8 * angle]) * first, radius, handle)
        demos += demonstrate(
            robot, frame, np.array(middle), path, rng, n=1, noise=float(rng.choice([2e-5, 1e-4, 5e-4]))
        )
    zeros = np.radians(rng.normal(0.0, 1.0, robot.nv)) if where == "off" else 0.0
    demos = [ml.Trajectory(t.time, t.q + zeros, None, t.joint_names, f"demo_{i}") for i, t in enumerate(demos)]
    axes = "pose" if kind == "hinge" else "xyz"
    return f"{kind} {radius:g} m {where} {name}", both(robot, frame, axes), demos


def both(robot: ml.Robot, frame: str, axes: str) -> list[ml.FrameJacobian]:
    """Rows in the world's and in the tool's axes, as the command line asks for them."""
    return [ml.FrameJacobian(robot, frame, axes, reference) for reference in ("world", "local")]


def of_tasks(seed: int) -> Drawn:
    """Recordings of a task, whole or cut, of one piece of furniture or of two, some of them mixed."""
    rng = np.random.default_rng([seed, 2])
    kind, robot, whole, n = (
        str(rng.choice(KINDS)),
        str(rng.choice(ROBOTS)),
        bool(rng.integers(2)),
        int(rng.integers(3, 11)),
    )
    more: dict[str, Any] = {}
    if kind in ("drawer", "door", "table") and rng.random() < 0.7:
        more = [{"apart": 1.0}, {"apart": 5.0}, {"mixed": n // 3}, {"noise": 1e-3}, {"duration": 12.0}][rng.integers(5)]
        whole = whole and "apart" not in more
    case = Case(kind, robot, seed, n, whole=whole, axes="pose" if kind in FIRM else "xyz", **more)
    made, demos, _ = case.make()
    what = f"{kind} {'whole' if whole else 'cut'} {' '.join(more)} {robot}"
    return what, both(made.robot, made.tip.name, case.axes), demos


def of_hands(seed: int) -> Drawn:
    """Recordings of a person's hand."""
    given = HandSet.of(90000 + seed)
    what = f"hand {given.kind} {'whole' if given.whole else 'cut'} {given.arm.robot.name}"
    return what, both(given.arm.robot, given.arm.tip.name, "xyz"), given.demos


def imposed(seed: int) -> Drawn:
    """Velocities with rows that the world holds, or that somebody moves."""
    rng, features = np.random.default_rng([seed, 3]), arm_features()
    kind = str(rng.choice(["paper", "guided", "scale"]))
    if kind == "paper":
        return kind, [planar_features()], paper_motions(PLANAR_ROWS["xy"], rng, 40)[0]
    if kind == "guided":
        speed = float(rng.choice([0.0, 0.1]))
        return kind, [features], guided_motions(features, oblique(2, 3, rng), rng, noise=1e-3, task_speed=speed)[0]
    held = bool(rng.integers(2))
    return kind, [features], motions(features, oblique(2, 3, rng), rng, 40, noise=1e-3, held=held)


def drawn(number: int) -> Drawn | None:
    """A set by its number; None where the arm cannot do what was drawn."""
    # half of them are carried by a mechanism: these are divided by their places, and joined
    kinds = (on_mechanisms, of_tasks, on_mechanisms, of_hands, on_mechanisms, of_tasks, on_mechanisms, imposed)
    try:
        return kinds[number % len(kinds)](number)
    except RuntimeError:
        return None


def fitted(maps: Sequence[ml.FrameJacobian], demos: Any) -> str:
    """What a fit says, in few words."""
    try:
        learner = ml.ConstraintLearner(list(maps)).fit(demos)
    except ml.ManipLearnError as error:
        return f"refused ({error.code})"
    return " + ".join(str(r.mechanism.name if r.mechanism else r.n_constraints) for r in learner.reports_)


def judged(number: int) -> list[Any] | None:
    """A line of the table."""
    given = drawn(number)
    if given is None:
        return None
    what, maps, demos = given

    def give_up(*_: Any) -> None:
        raise TimeoutError

    imposed_too = list[int]()

    def estimated(*arguments: Any, **more: Any) -> Any:
        imposed_too.append(number)
        return ESTIMATE(*arguments, **more)

    answer_file.learn_imposed = estimated
    signal.signal(signal.SIGALRM, give_up)
    signal.alarm(GIVEN_UP_SECONDS)
    started = time.process_time()
    try:
        answer = fitted(maps, demos)
    except TimeoutError:
        answer = "NO END"
    finally:
        signal.alarm(0)
    samples = sum(len(t) for t in demos)
    return [number, what, len(demos), samples, bool(imposed_too), answer, round(time.process_time() - started, 2)]


def main() -> int:
    """Fit every set, and print the largest ratio to the median of its size."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sets", type=int, default=500)
    parser.add_argument("--first", type=int, default=0, help="number of the first set")
    parser.add_argument("--out", type=Path)
    given = parser.parse_args()
    lines, number = list[list[Any]](), given.first
    while len(lines) < given.sets:
        line, number = judged(number), number + 1
        if line is not None:
            lines.append(line)
            print(*line, file=sys.stderr, flush=True)
    classes = [(round(math.log(line[3], 4)), line[4]) for line in lines]
    medians = {
        k: statistics.median(line[-1] for line, c in zip(lines, classes, strict=True) if c == k) for k in set(classes)
    }
    lines = [[*line, round(line[-1] / medians[c], 2)] for line, c in zip(lines, classes, strict=True)]
    header = ["set", "what", "recordings", "samples", "imposed too", "answer", "cpu s", "times the median"]
    put(header, lines, given.out)
    for k in sorted(medians):
        of_class = [line for line, c in zip(lines, classes, strict=True) if c == k]
        worst = max(of_class, key=lambda line: line[-1])
        said = (
            f"{len(of_class)} sets, median {medians[k]:.2f} s, largest ratio {worst[-1]} (set {worst[0]}: {worst[1]})"
        )
        print(f"about {4 ** k[0]} samples{', imposed too' if k[1] else ''}: {said}")
    return int(any(line[-1] > LIMIT or line[5] == "NO END" for line in lines))


if __name__ == "__main__":
    sys.exit(main())
