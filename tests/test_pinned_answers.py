"""Answers of every room of the library, which another version may only give on purpose.

    python tests/test_pinned_answers.py        # write golden/pinned.json

All numbers that users see, also those in sentences, tables and pages, to four digits, which another processor's
rounding does not change. Long arrays are held as a few sums. A change of wording changes nothing.
"""

from __future__ import annotations

import base64
import contextlib
import io
import json
import math
import os
import re
import sys
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import is_dataclass
from functools import cache
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import pytest

HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE))

from conftest import TIPS, named_robot  # noqa: E402
from recording_corpus import CASES, FULL, HEADER, VELOCITIES, csv  # noqa: E402
from task_sets import DATA, generated, learnt  # noqa: E402

import manip_learn as ml  # noqa: E402
from manip_learn.cli import main  # noqa: E402

PINNED = HERE / "golden" / "pinned.json"
RTOL, SMALL = 1e-4, 1e-6  # of the largest number of an array; below it, numbers are rounding
# bootstraps over recordings whose contact ends at a threshold differ by 3 % between processors
LOOSE, LOOSE_RTOL = re.compile(r"uncertain|±|known to"), 0.1
LOOSE_LINE = re.compile(rf"^.*(?:{LOOSE.pattern}).*$", re.MULTILINE)
# times, sizes and places, and the largest of differences that are rounding: no results
NO_RESULT = re.compile(
    r"^date$|sha256|seconds|bytes|version|fingerprint|made_with|created|command|source|largest_difference|^link$"
)
SPACES = ("selection", "free_directions")  # whose basis is any
NUMBER = re.compile(r"(?<![\w.])[-+]?\d+(?:\.\d+)?(?:e[-+]?\d+)?")
ARMS = ("planar3", "sawyer", "panda", "ur5", "kinova", "gantry", "wrist", "tree", "mimic", "rover")


# ---- what is compared ---------------------------------------------------------------------------------------------


def flat(value: Any, name: str = "") -> Iterator[tuple[str, Any]]:
    """(key, numbers or words) of an answer of any depth."""
    last = name.rpartition(".")[2]
    if NO_RESULT.search(last) or value is None:
        return
    if last in SPACES:
        rows = np.array(value, dtype=np.float64)
        yield name, numbers(rows.T @ rows)
    elif isinstance(value, dict):
        for key, inner in value.items():
            yield from flat(inner, f"{name}.{key}" if name else str(key))
    elif isinstance(value, str) and " " in value:
        for mark, lines in (
            ("#", [x for x in value.splitlines() if not LOOSE.search(x)]),
            ("#±", LOOSE_LINE.findall(value)),
        ):
            if found := [float(n) for line in lines for n in NUMBER.findall(line)]:
                yield name + mark, found[:200]
    elif isinstance(value, str | bool):
        yield name, value
    elif hasattr(value, "to_dict"):
        yield from flat(value.to_dict(), name)
    elif is_dataclass(value):
        yield from flat(vars(value), name)
    elif isinstance(value, int | float | np.generic):
        yield name, [float(value)]
    elif isinstance(value, np.ndarray) or (isinstance(value, list | tuple) and _is_table(value)):
        yield name, numbers(value)
    elif isinstance(value, list | tuple):
        yield f"{name}.length", [len(value)]
        for i, inner in enumerate(value[:40]):
            yield from flat(inner, f"{name}[{i}]")


def _is_table(value: Any) -> bool:
    try:
        return np.asarray(value).dtype.kind in "fiu"
    except ValueError:
        return False


def numbers(value: Any) -> list[float]:
    """The numbers of an array; of a long one their number, mean, root mean square and two weighted means."""
    x = np.asarray(value, dtype=np.float64).ravel()
    if x.size <= 12:
        return x.tolist()
    finite = x[np.isfinite(x)]
    i = np.arange(finite.size)
    sums = [finite.mean(), np.sqrt(np.mean(finite**2)), np.mean(finite * np.cos(i)), np.mean(finite * np.sin(0.1 * i))]
    return [float(x.size), float(finite.size), *(float(s) for s in sums)] if finite.size else [float(x.size), 0.0]


def differences(was: dict[str, Any], now: dict[str, Any]) -> list[str]:
    """One line a key that is missing, new, or has another value."""
    said = [
        f"{key}: {was.get(key, 'nothing')} before, {now.get(key, 'nothing')} now" for key in sorted({*was} ^ {*now})
    ]
    for key in sorted({*was} & {*now}):
        a, b = (_unpacked(x) for x in (was[key], now[key]))
        if isinstance(a, list) and isinstance(b, list) and len(a) == len(b):
            rtol = LOOSE_RTOL if LOOSE.search(key) else RTOL
            x, y = _floats(a), _floats(b)
            # an array has one size, the numbers of a text have none
            scale = np.abs(x) if "#" in key else np.nanmax(np.abs(x), initial=0.0)
            if np.all((np.abs(x - y) <= np.maximum(rtol * scale, SMALL)) | (np.isnan(x) & np.isnan(y))):
                continue
        elif a == b:
            continue
        said.append(f"{key}: {a} before, {b} now")
    return said


def _unpacked(value: Any) -> Any:
    """Return the numbers that a page packs into text."""
    is_packed = isinstance(value, str) and len(value) > 80 and re.fullmatch(r"[A-Za-z0-9+/]+=*", value)
    return np.frombuffer(base64.b64decode(value), "<f4").astype(float).tolist() if is_packed else value


def _floats(values: list[float | None]) -> np.ndarray:
    return np.array([math.nan if x is None else x for x in values], dtype=np.float64)


def rounded(answer: dict[str, Any]) -> dict[str, Any]:
    """What is written: seven digits."""

    def short(x: float) -> float | None:
        return float(f"{x:.7g}") if math.isfinite(x) else None

    return {key: [short(x) for x in v] if isinstance(v, list) else v for key, v in answer.items()}


# ---- the answers --------------------------------------------------------------------------------------------------


def a_robot(name: str, folder: Path) -> dict[str, Any]:
    """Its summary, kinematics, limits and shapes."""
    robot = named_robot(name, folder)
    tip, rng = TIPS.get(name, robot.frame_names[-1]), np.random.default_rng(1)
    q = robot.random_configuration(rng)
    return {
        "summary": ml.inspect_robot(robot),
        "pose": robot.pose(q, tip),
        "jacobian": robot.jacobian(q, tip),
        "q": robot.positions(q),
        "tips": [str(t) for t in ml.likely_tips(robot)],
        "nearest": str(ml.SelfCollision(robot, shapes="visual").nearest(q))
        if name in ("sawyer", "panda", "ur5")
        else "",
    }


def some_rows(name: str, folder: Path) -> dict[str, Any]:
    """Features of all kinds, their gradients, and the manipulability with its gradients."""
    robot = named_robot(name, folder)
    tip, rng = TIPS[name], np.random.default_rng(2)
    kinds: dict[str, ml.FeatureMap] = {
        reference: ml.FrameJacobian(robot, tip, "pose", reference) for reference in ("world", "local")
    }
    kinds["centre of mass"] = ml.CentreOfMass(robot)
    about: dict[str, Any] = {"axis": (0.6, 0.0, 0.8), "point": (0.3, 0.1, 0.2)}
    kinds["mechanism"] = ml.MechanismRows(robot, tip, ("radial", "axial"), **about)
    kinds["stacked"] = ml.Stacked([ml.FrameJacobian(robot, tip, "xyz", r) for r in ("world", "local")])
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
    robot = named_robot(name, folder)
    features = ml.FrameJacobian(robot, TIPS[name], "x y" if name == "planar3" else "xyz")
    return robot, features, ml.Constraint(np.eye(2, features.n_rows), features)


def a_rollout(name: str, folder: Path) -> dict[str, Any]:
    """A reach with all limits and a sum of policies."""
    robot, features, constraint = two_rows(name, folder)
    rng = np.random.default_rng(3)
    q0 = robot.random_configuration(rng)
    target = features.coordinates(robot.random_configuration(rng))
    climb, rest = ml.ManipulabilityAscent(constraint), ml.JointAttractor(robot.positions(q0), 0.5, robot)
    avoid = ml.JointLimitAvoidance(robot)
    policy = ml.WeightedPolicies([climb, rest, avoid], [1.0, 0.3, 0.2])
    limits = ml.Limits(robot, acceleration=4.0, tip_speed=0.3, frames=TIPS[name])
    law = ml.ResolvedRateController(constraint, ml.PointAttractor(target, 2.0), policy, limits=limits)
    done = ml.simulate(robot, law, q0, 1.0, 0.02)
    said = {"q": done.q, "u": done.u, "mu": done.manipulability, "error": done.task_error}
    return {"euler": {**said, "status": [str(s) for s in done.status[::10]]}}


def a_servo_loop(name: str, folder: Path) -> dict[str, Any]:
    """Irregular time, a lost reading, an offset that grows, a stop and a start."""
    robot, features, constraint = two_rows(name, folder)
    rng = np.random.default_rng(4)
    q = robot.random_configuration(rng)
    target = features.coordinates(q) + 0.1
    law = ml.ResolvedRateController(constraint, ml.PointAttractor(target), ml.ManipulabilityAscent(constraint))
    loop = ml.ServoLoop(law, 0.01)
    t, sent, words = 0.0, [], []
    for k in range(160):
        t += 0.01 * (1.0 if k % 7 else rng.uniform(0.2, 3.0))
        lost = k in (40, 41)
        measured = None if lost else (q if loop.position is None else loop.position) + 1e-3 * max(0, k - 60) * (k < 90)
        if k == 120:
            loop.stop()
        if k == 140:
            loop.start()
        command = loop.update(measured, t)
        sent.append(command.velocity)
        words.append(str(command.status))
    assert loop.position is not None
    return {"u": np.array(sent), "status": words[::8], "end": loop.position}


def a_way(kind: str, folder: Path) -> dict[str, Any]:
    """A mechanism done from a posture, and its plan."""
    robot, tip = named_robot("panda", folder), TIPS["panda"]
    ready = np.array([0.0, -0.5, 0.0, -2.0, 0.0, 1.7, 0.8])
    place = robot.position(ready, tip)
    rows = {
        "drawer": lambda: ml.Constraint(np.eye(3)[1:], ml.FrameJacobian(robot, tip)),
        "table": lambda: ml.Constraint(np.eye(3)[2:], ml.FrameJacobian(robot, tip)),
        "door": lambda: ml.Constraint(
            np.eye(2),
            ml.MechanismRows(robot, tip, ("radial", "axial"), axis=(0, 0, 1), point=place + np.array([0.0, 0.4, 0.0])),
        ),
    }
    constraint = rows[kind]()
    far = {"drawer": {"along": -0.15}, "table": {"along": 0.1, "direction": (0.6, 0.8, 0.0)}, "door": {"turn": 0.4}}[
        kind
    ]
    task = ml.motion(constraint, keep_orientation=kind == "drawer", pause=0.2, **far)
    law = ml.ResolvedRateController(constraint, task, ml.ManipulabilityAscent(constraint))
    done = ml.simulate(robot, law, ready, 3.0, 0.02)
    said: dict[str, Any] = {"q": done.q, "error": done.task_error, "words": str(task)}
    if kind == "drawer":
        found = ml.plan(constraint, task, ready, candidates=96)
        said["plan"] = {"hold": found.q_grasp, "found": found, "words": str(found), "approach": found.approach.q}
    return said


def recordings(kind: str, folder: Path) -> dict[str, Any]:
    """What is read of the corpus of a kind of file, what is said of it, or why it is refused."""
    robot, said = named_robot("planar3", folder), {}
    for case in (c for c in CASES if Path(c.name).suffix.strip(".") == kind or kind == "other"):
        if kind == "other" and Path(case.name).suffix in (".csv", ".npz"):
            continue
        path = folder / case.name
        case.write(path)
        try:
            demos = ml.load_demonstrations(path, robot, **case.options)
        except ml.ManipLearnError as error:
            words = str(error).replace(str(folder), "")
            # what another library said is cut to a length, with the paths in it
            said[case.name] = {"refused": error.code, "words": "" if error.code == "damaged" else words}
        else:
            said[case.name] = {"n": len(demos), "notes": [n.replace(str(folder), "") for n in demos.notes]}
            said[case.name] |= {"q": [t.q for t in demos], "time": [t.time for t in demos], "u": [t.u for t in demos]}
    return said


def motions(kind: str, folder: Path) -> dict[str, Any]:
    """Velocities, fewer samples, and the way through every format of a motion with uneven time."""
    robot, rng = named_robot("planar3", folder), np.random.default_rng(5)
    time = np.cumsum(rng.uniform(0.005, 0.02, 150))
    q = np.column_stack([np.sin(2.0 * time), np.cos(time), 0.3 * time]) + 1e-4 * rng.normal(size=(150, 3))
    q[:20] = q[20]
    raw = ml.Trajectory(time, q, None, robot.joint_names, "one")
    moved = ml.derive_velocities(raw, robot)
    if kind == "velocities":
        assert moved.u is not None
        pieces = {"derived": moved, "subsampled": ml.subsample(moved, 3)}
        return {name: {"time": t.time, "q": t.q, "u": t.u} for name, t in pieces.items()}
    file = folder / "one.csv"
    file.write_text(csv(FULL, HEADER + VELOCITIES), encoding="utf-8")
    assert quiet("export", "planar3", str(file), "--to", kind, "--out", str(folder / f"out.{kind}"))[0] == 0
    saved = next(p for p in sorted(folder.glob("out*")))
    back = ml.load_demonstrations(saved, robot)
    return {"notes": list(back.notes), "time": back[0].time, "q": back[0].q, "u": back[0].u}


SETS = {
    "drawer": ("panda", 4004, 5, True),
    "door": ("sawyer", 5004, 5, True),
    "table": ("xarm7", 6004, 4, False),
    "screw": ("panda", 8004, 4, True),
    "drawer_slip": ("ur5", 7004, 5, False),
}


def learning(kind: str, folder: Path) -> dict[str, Any]:
    """All that a report says, in numbers and in words, of recordings with their ways there and back."""
    arm, seed, n, whole = SETS[kind]
    truth, demos = generated(kind, arm, seed, n, whole)
    try:
        learner = learnt(arm, truth["tip"], demos)
    except ml.ManipLearnError as error:
        return {"refused": error.code, "words": str(error), "facts": error.facts()}
    report = learner.report_.to_dict()
    return {"report": report, "words": str(learner.report_), "constraint": str(learner.constraint_)}


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


def quiet(*words: str) -> tuple[int, str]:
    """The code of a command and all that it prints."""
    with (
        mock.patch.dict(os.environ, COLUMNS="120"),
        contextlib.redirect_stdout(io.StringIO()) as out,
        contextlib.redirect_stderr(io.StringIO()) as err,
    ):
        code = main(list(words))
    return code, out.getvalue() + err.getvalue()


@cache
def drawer_file() -> str:
    """The drawer's constraint as `learn` writes it."""
    with tempfile.TemporaryDirectory() as out:
        assert quiet(*(w.replace("{out}", out) for w in COMMANDS["learn"]))[0] == 0
        return (Path(out) / "drawer.json").read_text(encoding="utf-8")


def command(name: str, folder: Path) -> dict[str, Any]:
    """What a command prints for people; of `replay` also the page's data."""
    if any("drawer.json" in w for w in COMMANDS[name]) and name != "learn":
        (folder / "drawer.json").write_text(drawer_file(), encoding="utf-8")
    code, printed = quiet(*(w.replace("{out}", str(folder)) for w in COMMANDS[name]))
    words = re.sub(r"[0-9.]+ (?:s|seconds|kB|MB)\b", "", printed.replace(str(folder), "").replace(str(DATA), ""))
    said: dict[str, Any] = {"code": code, "printed": words}
    if name == "replay":
        page = (folder / "page.html").read_text(encoding="utf-8")
        found = re.search(r'id="data">(.*?)</script>', page, re.DOTALL)
        assert found is not None
        said["page"] = json.loads(found[1])
    return said


ANSWERS: dict[str, Callable[[Path], dict[str, Any]]] = {
    f"{make.__name__} {name}": lambda folder, make=make, name=name: make(name, folder)
    for make, names in {
        a_robot: ARMS,
        some_rows: ("planar3", "sawyer", "kinova"),
        a_rollout: ("planar3", "sawyer", "kinova"),
        a_servo_loop: ("planar3", "sawyer"),
        a_way: ("drawer", "table", "door"),
        recordings: ("csv", "npz", "other"),
        motions: ("velocities", "csv", "mcap"),
        learning: tuple(SETS),
        command: tuple(COMMANDS),
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
    now = rounded(dict(flat(ANSWERS[name](tmp_path))))
    assert not (said := differences(pinned()[name], now)), "\n".join(said[:20])


if __name__ == "__main__":
    written = {}
    for each, answer in ANSWERS.items():
        with tempfile.TemporaryDirectory() as place:
            written[each] = rounded(dict(flat(answer(Path(place)))))
        print(f"{each}: {len(written[each])} keys")
    lines = [f"{json.dumps(name)}: {json.dumps(content, ensure_ascii=False)}" for name, content in written.items()]
    PINNED.write_text("{\n" + ",\n".join(lines) + "\n}\n", encoding="utf-8")
