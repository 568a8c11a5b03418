"""Answers of every room of the library, which another version may only give on purpose.

    python tests/test_pinned_answers.py        # write golden/pinned.json

All numbers that users see, also those in sentences and tables, to four digits, which another processor's
rounding does not change. Long arrays are held as a few sums. A change of wording changes nothing. Of what the
experiments draw to the last digits.
"""

from __future__ import annotations

import contextlib
import io
import json
import os
import re
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import is_dataclass
from functools import cache, partial
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import pytest
from conftest import TIPS, named_robot
from task_sets import DATA, generated, learnt

import manip_learn as ml
from manip_learn.cli import main
from manip_learn.experiments import paper_setup, sawyer
from manip_learn.experiments.paper_setup import Setup
from manip_learn.linalg import one_thread

PINNED = Path(__file__).resolve().parent / "golden" / "pinned.json"
SMALL = 1e-6  # of the largest number of an array; below it, numbers are rounding
# (answer and key, relative, absolute tolerance). Bootstraps over recordings whose contact ends at a threshold differ by
# 3 % between processors
LOOSE = re.compile(r"uncertain|±|known to")
KNOWN = ((re.compile("experiment"), 1e-12, 1e-12), (LOOSE, 0.1, SMALL), (re.compile(""), 1e-4, SMALL))
# times, sizes and places, and the largest of differences that are rounding: no results
NO_RESULT = re.compile(
    r"^date$|sha256|seconds|bytes|version|fingerprint|made_with|created|command|source|largest_difference|^link$"
)
SPACES = ("selection", "free_directions")  # whose basis is any
NUMBER = re.compile(r"(?<![\w.])[-+]?\d+(?:\.\d+)?(?:e[-+]?\d+)?")


def flat(value: Any, name: str = "") -> Iterator[tuple[str, Any]]:
    """(key, numbers or words) of an answer of any depth; long arrays as a few sums."""
    last = name.rpartition(".")[2]
    if NO_RESULT.search(last) or value is None:
        return
    if last in SPACES:
        rows = np.array(value, dtype=np.float64)
        value = rows.T @ rows
    elif hasattr(value, "to_dict") or is_dataclass(value):
        value = value.to_dict() if hasattr(value, "to_dict") else vars(value)
    if isinstance(value, dict):
        for key, inner in value.items():
            yield from flat(inner, f"{name}.{key}" if name else str(key))
    elif isinstance(value, str) and " " in value:
        for mark, is_loose in (("#", False), ("#±", True)):
            lines = [line for line in value.splitlines() if bool(LOOSE.search(line)) == is_loose]
            if found := [float(n) for line in lines for n in NUMBER.findall(line)]:
                yield name + mark, found[:200]
    elif isinstance(value, str | bool):
        yield name, value
    elif _is_table(value):
        yield name, numbers(np.asarray(value, dtype=np.float64).ravel())
    elif isinstance(value, list | tuple):
        yield f"{name}.length", [len(value)]
        for i, inner in enumerate(value[:40]):
            yield from flat(inner, f"{name}[{i}]")


def _is_table(value: Any) -> bool:
    try:
        return np.asarray(value).dtype.kind in "fiu"
    except ValueError:
        return False


def numbers(x: np.ndarray) -> list[float]:
    """The numbers of an array; of a long one their number, mean, root mean square and two weighted means."""
    if x.size <= 12:
        return x.tolist()
    finite = x[np.isfinite(x)]
    if not finite.size:
        return [x.size, 0.0]
    i = np.arange(finite.size)
    weighted = np.mean(finite * np.cos(i)), np.mean(finite * np.sin(0.1 * i))
    return [x.size, finite.size, finite.mean(), np.sqrt(np.mean(finite**2)), *weighted]


def differences(answer: str, was: dict[str, Any], now: dict[str, Any]) -> list[str]:
    """One line a key that is missing, new, or has another value."""
    said = []
    for key in sorted({*was} | {*now}):
        a, b = (x.get(key, "nothing") for x in (was, now))
        if isinstance(a, list) and isinstance(b, list) and len(a) == len(b):
            rtol, atol = next((r, t) for where, r, t in KNOWN if where.search(f"{answer} {key}"))
            x, y = np.array(a, dtype=np.float64), np.array(b, dtype=np.float64)
            # an array has one size, the numbers of a text have none
            is_single = "#" in key or answer.startswith("experiment")
            scale = np.abs(x) if is_single else np.abs(x[np.isfinite(x)]).max(initial=0.0)
            if np.isclose(x, y, rtol=0, atol=np.maximum(rtol * scale, atol), equal_nan=True).all():
                continue
        if a != b:
            said.append(f"{key}: {a} before, {b} now")
    return said


def written(name: str, folder: Path) -> dict[str, Any]:
    """An answer as it is written: seven digits, of an experiment all."""
    digits = ".17g" if name.startswith("experiment") else ".7g"
    answer = dict(flat(ANSWERS[name](folder)))
    return {k: [float(format(float(x), digits)) for x in v] if isinstance(v, list) else v for k, v in answer.items()}


# ---- the answers --------------------------------------------------------------------------------------------------


def a_robot(name: str, folder: Path) -> dict[str, Any]:
    """Its summary, kinematics, limits and shapes."""
    robot = named_robot(name)
    tip, q = TIPS.get(name, robot.frame_names[-1]), robot.random_configuration(np.random.default_rng(1))
    is_drawn = name in ("sawyer", "panda", "ur5")
    return {
        "summary": ml.inspect_robot(robot),
        "pose": robot.pose(q, tip),
        "jacobian": robot.jacobian(q, tip),
        "q": robot.positions(q),
        "tips": [str(t) for t in ml.likely_tips(robot)],
        "nearest": str(ml.SelfCollision(robot, shapes="visual").nearest(q)) if is_drawn else "",
    }


def some_rows(name: str, folder: Path) -> dict[str, Any]:
    """Features of all kinds, their gradients, and the manipulability with its gradients."""
    robot, tip, rng = named_robot(name), TIPS[name], np.random.default_rng(2)
    about: dict[str, Any] = {"axis": (0.6, 0.0, 0.8), "point": (0.3, 0.1, 0.2)}
    kinds: dict[str, ml.FeatureMap] = {
        **{reference: ml.FrameJacobian(robot, tip, "pose", reference) for reference in ("world", "local")},
        "centre of mass": ml.CentreOfMass(robot),
        "mechanism": ml.MechanismRows(robot, tip, ("radial", "axial"), **about),
        "stacked": ml.Stacked([ml.FrameJacobian(robot, tip, "xyz", r) for r in ("world", "local")]),
    }
    said: dict[str, Any] = {}
    for kind, rows in kinds.items():
        q, p = robot.random_configuration(rng), rows(robot.neutral()).shape[0]
        several = np.array([robot.random_configuration(rng) for _ in range(5)])
        constraint = ml.Constraint(np.linalg.qr(rng.normal(size=(p, min(2, p))))[0].T, rows)
        said[kind] = {
            "rows": rows(q),
            "mu": ml.manipulability(constraint, q),
            "gradient": ml.manipulability_gradient(constraint, q),
            "log gradient": ml.log_manipulability_gradient(constraint, q),
            "many": ml.manipulability_batch(constraint, several).mu,
            "words": str(constraint),
            "file": {key: v for key, v in constraint.to_dict().items() if key != "selection"},
        }
    return said


def two_rows(name: str, folder: Path) -> tuple[ml.Robot, ml.FrameJacobian, ml.Constraint]:
    """A robot, the position of its tip, and a constraint of two rows of it."""
    robot = named_robot(name)
    features = ml.FrameJacobian(robot, TIPS[name], "x y" if name == "planar3" else "xyz")
    return robot, features, ml.Constraint(np.eye(2, features.n_rows), features)


def a_rollout(name: str, folder: Path) -> dict[str, Any]:
    """A reach with all limits and a sum of policies."""
    robot, features, constraint = two_rows(name, folder)
    rng = np.random.default_rng(3)
    q0, goal = (robot.random_configuration(rng) for _ in range(2))
    climb, rest = ml.ManipulabilityAscent(constraint), ml.JointAttractor(robot.positions(q0), 0.5, robot)
    policy = ml.WeightedPolicies([climb, rest, ml.JointLimitAvoidance(robot)], [1.0, 0.3, 0.2])
    limits = ml.Limits(robot, acceleration=4.0, tip_speed=0.3, frames=TIPS[name])
    reach = ml.PointAttractor(features.coordinates(goal), 2.0)
    done = ml.simulate(robot, ml.ResolvedRateController(constraint, reach, policy, limits=limits), q0, 1.0, 0.02)
    status = [str(s) for s in done.status[::10]]
    return {"euler": {"q": done.q, "u": done.u, "mu": done.manipulability, "error": done.task_error, "status": status}}


def a_servo_loop(name: str, folder: Path) -> dict[str, Any]:
    """Irregular time, a lost reading, an offset that grows, a stop and a start."""
    robot, features, constraint = two_rows(name, folder)
    rng = np.random.default_rng(4)
    q = robot.random_configuration(rng)
    reach = ml.PointAttractor(features.coordinates(q) + 0.1)
    loop = ml.ServoLoop(ml.ResolvedRateController(constraint, reach, ml.ManipulabilityAscent(constraint)), 0.01)
    t, sent = 0.0, []
    for k in range(160):
        t += 0.01 * (1.0 if k % 7 else rng.uniform(0.2, 3.0))
        at = (q if loop.position is None else loop.position) + 1e-3 * max(0, k - 60) * (k < 90)
        if k in (120, 140):
            (loop.stop if k == 120 else loop.start)()
        sent.append(loop.update(None if k in (40, 41) else at, t))
    return {
        "u": np.array([x.velocity for x in sent]),
        "status": [str(x.status) for x in sent[::8]],
        "end": loop.position,
    }


def a_way(kind: str, folder: Path) -> dict[str, Any]:
    """A mechanism done from a posture, and its plan."""
    robot, tip = named_robot("panda"), TIPS["panda"]
    ready, hand = np.array([0.0, -0.5, 0.0, -2.0, 0.0, 1.7, 0.8]), ml.FrameJacobian(robot, tip)
    beside = robot.position(ready, tip) + np.array([0.0, 0.4, 0.0])
    rows, features, far = {
        "drawer": (np.eye(3)[1:], hand, {"along": -0.15}),
        "table": (np.eye(3)[2:], hand, {"along": 0.1, "direction": (0.6, 0.8, 0.0)}),
        "door": (np.eye(2), ml.MechanismRows(robot, tip, "radial axial", axis=(0, 0, 1), point=beside), {"turn": 0.4}),
    }[kind]
    constraint = ml.Constraint(rows, features)
    task = ml.motion(constraint, keep_orientation=kind == "drawer", pause=0.2, **far)
    law = ml.ResolvedRateController(constraint, task, ml.ManipulabilityAscent(constraint))
    done = ml.simulate(robot, law, ready, 3.0, 0.02)
    said: dict[str, Any] = {"q": done.q, "error": done.task_error, "words": str(task)}
    if kind == "drawer":
        found = ml.plan(constraint, task, ready, candidates=96)
        said["plan"] = {"hold": found.q_grasp, "found": found, "words": str(found), "approach": found.approach.q}
    return said


SETS = {
    "drawer": ("panda", 4004, 5, True),
    "door": ("sawyer", 5004, 5, True),
    "table": ("xarm7", 6004, 4, False),
    "screw": ("panda", 8004, 4, True),
    "drawer_slip": ("ur5", 7004, 5, False),
}


def learning(kind: str, folder: Path) -> dict[str, Any]:
    """All that a report says, in numbers and in words, of recordings with their ways there and back."""
    truth, demos = generated(kind, *SETS[kind])
    try:
        learner = learnt(SETS[kind][0], truth["tip"], demos)
    except ml.ManipLearnError as error:
        return {"refused": error.code, "words": str(error), "facts": error.facts()}
    words = {"words": str(learner.report_), "constraint": str(learner.constraint_)}
    return {"report": learner.report_.to_dict()} | words


LEARN = ("learn", "sawyer", *(str(f) for f in sorted((DATA / "sawyer_drawer").glob("*.csv"))[:8]))
COMMANDS: dict[str, tuple[str, ...]] = {
    "inspect": ("inspect", "sawyer"),
    "learn": (*LEARN, "--frame", "right_gripper_tip", "--out", "{out}/drawer.json"),
    "learn a door": ("learn", "ur5", str(DATA / "ur5_loose_door"), "--frame", "tool0"),
    "learn two things": ("learn", "xarm7", str(DATA / "xarm7_drawer_then_table"), "--frame", "link_eef"),
    "audit": ("audit", "sawyer", "{out}/drawer.json", str(DATA / "sawyer_drawer"), "--episodes", "8:14"),
    "control": ("control", "sawyer", "{out}/drawer.json", "--along", "0.1"),
    "replay": ("replay", "sawyer", *LEARN[2:4], "--constraint", "{out}/drawer.json", "--html", "{out}/page.html"),
    "export": ("export", "sawyer", *LEARN[2:4], "--to", "csv", "--out", "{out}/copies"),
}


def command(_: str, folder: Path) -> dict[str, Any]:
    """What each command prints for people, one after another in one folder."""
    said: dict[str, Any] = {}
    for name, words in COMMANDS.items():
        with (
            mock.patch.dict(os.environ, COLUMNS="120"),
            contextlib.redirect_stdout(io.StringIO()) as out,
            contextlib.redirect_stderr(out),
        ):
            code = main([w.replace("{out}", str(folder)) for w in words])
        printed = out.getvalue().replace(str(folder), "").replace(str(DATA), "")
        said[name] = {"code": code, "printed": re.sub(r"[0-9.]+ (?:s|seconds|kB|MB)\b", "", printed)}
    return said


def experiment(_: str, folder: Path) -> dict[str, Any]:
    """First and last samples of each constraint's demonstrations, and of the variants that draw more."""
    setups = {rows: Setup(rows) for rows in paper_setup.SELECTIONS}
    setups |= {"noise": Setup(noise=0.05), "own": Setup(policy="own"), "sinusoidal": Setup(policy="sinusoidal")}
    with one_thread():  # sums that are split among threads differ in their last digits
        made = {k: paper_setup.demonstrate(x, x.selection, np.random.default_rng(0)) for k, x in setups.items()}
        drawer = sawyer.CASES["model, 10 points each | constrained row | x"]
        made["drawer"] = sawyer.drawn(drawer, np.random.default_rng(0))[0]
    return {k: [{"q": t.q[[0, 9]], "u": t.u[[0, 9]]} for t in (demos[0], demos[-1])] for k, demos in made.items()}


ANSWERS: dict[str, Callable[[Path], dict[str, Any]]] = {
    f"{make.__name__} {name}": partial(make, name)
    for make, names in {
        a_robot: ("planar3", "sawyer", "panda", "ur5", "kinova", "gantry", "wrist", "tree", "mimic", "rover"),
        some_rows: ("planar3", "sawyer", "kinova"),
        a_rollout: ("planar3", "sawyer", "kinova"),
        a_servo_loop: ("planar3", "sawyer"),
        a_way: ("drawer", "table", "door"),
        learning: tuple(SETS),
        command: ("lines",),
        experiment: ("demonstrations",),
    }.items()
    for name in names
}


@cache
def pinned() -> dict[str, dict[str, Any]]:
    """What was written."""
    return json.loads(PINNED.read_text(encoding="utf-8"))


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("name", ANSWERS)
def test_an_answer_is_as_it_was(name: str, tmp_path: Path) -> None:
    """Its numbers to four digits, its words but for sentences. Where a change is meant, run this file."""
    assert not (said := differences(name, pinned()[name], written(name, tmp_path))), "\n".join(said[:20])


if __name__ == "__main__":
    lines = []
    for each in ANSWERS:
        with tempfile.TemporaryDirectory() as out:
            lines.append(f"{json.dumps(each)}: {json.dumps(written(each, Path(out)), ensure_ascii=False)}")
        print(each)
    PINNED.write_text("{\n" + ",\n".join(lines) + "\n}\n", encoding="utf-8")
