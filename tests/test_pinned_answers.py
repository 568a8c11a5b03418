"""Answers of every room of the library, which another version may only give on purpose.

    python tests/test_pinned_answers.py        # write golden/pinned.json

All numbers that users see, also those in sentences, tables and pages, to four digits, which another processor's
rounding does not change. Long arrays are held as a few sums. A change of wording changes nothing. Of the experiments
only numbers that rounding does not amplify, to their last digits.
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
from dataclasses import is_dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import pytest

HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE))

from conftest import TIPS, named_robot  # noqa: E402
from recording_corpus import CASES  # noqa: E402
from rounding import rounding  # noqa: E402
from task_sets import DATA, generated, learnt  # noqa: E402

import manip_learn as ml  # noqa: E402
from manip_learn.cli import main  # noqa: E402
from manip_learn.experiments import paper_setup, rmse, sawyer, singular_starts  # noqa: E402
from manip_learn.experiments.metrics import policy_rmse  # noqa: E402
from manip_learn.experiments.paper_setup import Setup  # noqa: E402
from manip_learn.experiments.table import LearningCase, learning_trial  # noqa: E402
from manip_learn.linalg import one_thread  # noqa: E402

PINNED = HERE / "golden" / "pinned.json"
SMALL = 1e-6  # of the largest number of an array; below it, numbers are rounding
# (answer and key, relative, absolute tolerance). The separation of task and null space ends where five steps gain less
# than a millionth of the cost each: its error, of which the cost is the square, is known to 0.2 %, and the square to
# half a percent. Each of the 501 steps of a rollout adds the rounding of its factorisation, which the damping of 0.05
# raises by 20 at most, to angles of up to a turn. Bootstraps over recordings whose contact ends at a threshold differ
# by 3 % between processors
LOOSE = re.compile(r"uncertain|±|known to")
KNOWN = (
    (re.compile("experiment table.*separate"), 5e-3, 1e-12),
    (re.compile("experiment starts"), 1e-12, rounding(501 * 4 * 2 * 3, 2.0 * np.pi, 20.0)),
    (re.compile("experiment"), 1e-12, 1e-12),
    (LOOSE, 0.1, SMALL),
    (re.compile(""), 1e-4, SMALL),
)
LOOSE_LINE = re.compile(rf"^.*(?:{LOOSE.pattern}).*$", re.MULTILINE)
# times, sizes and places, and the largest of differences that are rounding: no results
NO_RESULT = re.compile(
    r"^date$|sha256|seconds|bytes|version|fingerprint|made_with|created|command|source|largest_difference|^link$"
)
SPACES = ("selection", "free_directions")  # whose basis is any
NUMBER = re.compile(r"(?<![\w.])[-+]?\d+(?:\.\d+)?(?:e[-+]?\d+)?")


# ---- what is compared ---------------------------------------------------------------------------------------------


def flat(value: Any, name: str = "", most: int = 12) -> Iterator[tuple[str, Any]]:
    """(key, numbers or words) of an answer of any depth; arrays of more numbers than `most` as a few sums."""
    last = name.rpartition(".")[2]
    if NO_RESULT.search(last) or value is None:
        return
    if last in SPACES:
        rows = np.array(value, dtype=np.float64)
        yield name, numbers(rows.T @ rows, most)
    elif isinstance(value, dict):
        for key, inner in value.items():
            yield from flat(inner, f"{name}.{key}" if name else str(key), most)
    elif isinstance(value, str) and " " in value:
        firm = [x for x in value.splitlines() if not LOOSE.search(x)]
        for mark, lines in (("#", firm), ("#±", LOOSE_LINE.findall(value))):
            if found := [float(n) for line in lines for n in NUMBER.findall(line)]:
                yield name + mark, found[:200]
    elif isinstance(value, str | bool):
        yield name, value
    elif hasattr(value, "to_dict") or is_dataclass(value):
        yield from flat(value.to_dict() if hasattr(value, "to_dict") else vars(value), name, most)
    elif _is_table(value):
        yield name, numbers(value, most)
    elif isinstance(value, list | tuple):
        yield f"{name}.length", [len(value)]
        for i, inner in enumerate(value[:40]):
            yield from flat(inner, f"{name}[{i}]", most)


def _is_table(value: Any) -> bool:
    try:
        return np.asarray(value).dtype.kind in "fiu"
    except ValueError:
        return False


def numbers(value: Any, most: int) -> list[float]:
    """The numbers of an array; of a long one their number, mean, root mean square and two weighted means."""
    x = np.asarray(value, dtype=np.float64).ravel()
    if x.size <= most:
        return x.tolist()
    finite = x[np.isfinite(x)]
    i = np.arange(finite.size)
    sums = [finite.mean(), np.sqrt(np.mean(finite**2)), np.mean(finite * np.cos(i)), np.mean(finite * np.sin(0.1 * i))]
    return [float(x.size), float(finite.size), *(float(s) for s in sums)] if finite.size else [float(x.size), 0.0]


def differences(answer: str, was: dict[str, Any], now: dict[str, Any]) -> list[str]:
    """One line a key that is missing, new, or has another value."""
    said = []
    for key in sorted({*was} | {*now}):
        a, b = (_unpacked(x.get(key, "nothing")) for x in (was, now))
        if isinstance(a, list) and isinstance(b, list) and len(a) == len(b):
            rtol, atol = next((r, a) for where, r, a in KNOWN if where.search(f"{answer} {key}"))
            x, y = (np.array([math.nan if v is None else v for v in values], dtype=np.float64) for values in (a, b))
            # an array has one size, the numbers of a text have none
            single = "#" in key or answer.startswith("experiment")
            scale = np.abs(x) if single else np.nanmax(np.abs(x), initial=0.0)
            if np.all((np.abs(x - y) <= np.maximum(rtol * scale, atol)) | (np.isnan(x) & np.isnan(y))):
                continue
        if a != b:
            said.append(f"{key}: {a} before, {b} now")
    return said


def _unpacked(value: Any) -> Any:
    """Return the numbers that a page packs into text."""
    is_packed = isinstance(value, str) and len(value) > 80 and re.fullmatch(r"[A-Za-z0-9+/]+=*", value)
    return np.frombuffer(base64.b64decode(value), "<f4").astype(float).tolist() if is_packed else value


def written(name: str, folder: Path) -> dict[str, Any]:
    """An answer as it is written: seven digits, of an experiment all."""
    exact = name.startswith("experiment")

    def short(x: float) -> float | None:
        return (x if exact else float(f"{x:.7g}")) if math.isfinite(x) else None

    answer = dict(flat(ANSWERS[name](folder), most=100 if exact else 12))
    return {key: [short(float(x)) for x in v] if isinstance(v, list) else v for key, v in answer.items()}


# ---- the answers --------------------------------------------------------------------------------------------------


def a_robot(name: str, folder: Path) -> dict[str, Any]:
    """Its summary, kinematics, limits and shapes."""
    robot = named_robot(name, folder)
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
    robot, tip, rng = named_robot(name, folder), TIPS[name], np.random.default_rng(2)
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
    robot = named_robot(name, folder)
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
    robot, tip = named_robot("panda", folder), TIPS["panda"]
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


def recordings(kind: str, folder: Path) -> dict[str, Any]:
    """What is read of the corpus of a kind of file, what is said of it, or why it is refused."""
    robot, said = named_robot("planar3", folder), {}
    for case in CASES:
        suffix = Path(case.name).suffix.strip(".")
        if kind != (suffix if suffix in ("csv", "npz") else "other"):
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
    """Velocities and fewer samples of a motion with uneven time."""
    robot, rng = named_robot("planar3", folder), np.random.default_rng(5)
    time = np.cumsum(rng.uniform(0.005, 0.02, 150))
    q = np.column_stack([np.sin(2.0 * time), np.cos(time), 0.3 * time]) + 1e-4 * rng.normal(size=(150, 3))
    q[:20] = q[20]
    moved = ml.derive_velocities(ml.Trajectory(time, q, None, robot.joint_names, "one"), robot)
    pieces = {"derived": moved, "subsampled": ml.subsample(moved, 3)}
    return {name: {"time": t.time, "q": t.q, "u": t.u} for name, t in pieces.items()}


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


def quiet(name: str, folder: str | Path) -> tuple[int, str]:
    """The code of a command and all that it prints."""
    with (
        mock.patch.dict(os.environ, COLUMNS="120"),
        contextlib.redirect_stdout(io.StringIO()) as out,
        contextlib.redirect_stderr(io.StringIO()) as err,
    ):
        code = main([w.replace("{out}", str(folder)) for w in COMMANDS[name]])
    return code, out.getvalue() + err.getvalue()


@cache
def drawer_file() -> str:
    """The drawer's constraint as `learn` writes it."""
    with tempfile.TemporaryDirectory() as out:
        assert quiet("learn", out)[0] == 0
        return (Path(out) / "drawer.json").read_text(encoding="utf-8")


def command(name: str, folder: Path) -> dict[str, Any]:
    """What a command prints for people; of `replay` also the page's data."""
    if any("drawer.json" in w for w in COMMANDS[name]) and name != "learn":
        (folder / "drawer.json").write_text(drawer_file(), encoding="utf-8")
    code, printed = quiet(name, folder)
    words = re.sub(r"[0-9.]+ (?:s|seconds|kB|MB)\b", "", printed.replace(str(folder), "").replace(str(DATA), ""))
    said: dict[str, Any] = {"code": code, "printed": words}
    if name == "replay":
        page = (folder / "page.html").read_text(encoding="utf-8")
        found = re.search(r'id="data">(.*?)</script>', page, re.DOTALL)
        assert found is not None
        said["page"] = json.loads(found[1])
    return said


# ---- the experiments ----------------------------------------------------------------------------------------------

BESIDE = (0.1, -0.2, 0.15)  # [rad]
SHOWN = [0, 1, 2, 3, 20, 37, 72, 150, -1]  # samples of a rollout


def generator() -> dict[str, Any]:
    """First and last samples of each constraint's demonstrations, and of the variants that draw more."""
    setups = {rows: Setup(rows) for rows in paper_setup.SELECTIONS}
    setups |= {"noise": Setup(noise=0.05), "own": Setup(policy="own"), "sinusoidal": Setup(policy="sinusoidal")}
    made = {k: paper_setup.demonstrate(x, x.selection, np.random.default_rng(0)) for k, x in setups.items()}
    drawer = sawyer.CASES["model, 10 points each | constrained row | x"]
    made["drawer"] = sawyer.drawn(drawer, np.random.default_rng(0))[0]
    return {k: [{"q": t.q[[0, 9]], "u": t.u[[0, 9]]} for t in (demos[0], demos[-1])] for k, demos in made.items()}


def table() -> dict[str, Any]:
    """NMIE on both sets of one seed."""
    case = LearningCase(Setup("x y"), ("joint-affine", "separate", "true-w"))
    outcome = learning_trial(case, np.random.default_rng(0))
    return {name: [t["train"], t["test"], t["angle_deg"]] for name, t in outcome.items()}


def starts() -> dict[str, Any]:
    """The rollouts that rounding leaves alone; of the leap, the order of magnitude."""
    singular, near, rows = singular_starts.SINGULAR, singular_starts.NEAR_SINGULAR, paper_setup.true_constraint("x y")
    chosen = [(singular, policy, dt, False) for policy in ("zero", "attractor") for dt in singular_starts.STEPS]
    for setting in (singular, near):  # from the exact starts these are chaotic, or go either way by rounding
        beside = replace(setting, start=tuple(np.array(setting.start) + BESIDE))
        chosen += [(beside, "manipulability", 0.02, False), (beside, "attractor", 0.02, True)]
    out: dict[str, Any] = {"near, start": near.start}
    for number, (setting, policy, dt, product) in enumerate(chosen):
        law = setting.law(policy, rows, product=product)
        r = ml.simulate(paper_setup.planar_arm(), law, setting.start, singular_starts.DURATION, dt)
        out[f"{number}, {policy}, dt {dt:g}"] = {"n": len(r), "q": r.q[SHOWN], "mu": r.manipulability[SHOWN]}
    leap = near.law("zero", rows)(near.start).velocity
    return out | {"near, leap": int(np.floor(np.log10(np.max(np.abs(leap)))))}


def turned_rmse() -> dict[str, Any]:
    """RMSE of both kinds for rows that are turned by 1e-3 rad."""
    rng, (c, s) = np.random.default_rng(0), (np.cos(1e-3), np.sin(1e-3))
    turned = ml.Constraint([[c, 0.0, s], [0.0, 1.0, 0.0]], paper_setup.planar_features())
    where = paper_setup.draw_starts(3, rng), paper_setup.draw_targets(3, rng)
    true = paper_setup.true_constraint("x y")
    (q, pi), (own_q, own_pi) = (rmse.climbing(true, *where, climbed) for climbed in (None, turned))
    return {"policies": policy_rmse(pi, own_pi), "postures": policy_rmse(q, own_q)}


def experiment(name: str, folder: Path) -> dict[str, Any]:
    """On one thread: sums that are split among threads differ in their last digits."""
    with one_thread():
        return EXPERIMENTS[name]()


EXPERIMENTS = {"generator": generator, "table": table, "starts": starts, "rmse": turned_rmse}
ANSWERS: dict[str, Callable[[Path], dict[str, Any]]] = {
    f"{make.__name__} {name}": lambda folder, make=make, name=name: make(name, folder)
    for make, names in {
        a_robot: ("planar3", "sawyer", "panda", "ur5", "kinova", "gantry", "wrist", "tree", "mimic", "rover"),
        some_rows: ("planar3", "sawyer", "kinova"),
        a_rollout: ("planar3", "sawyer", "kinova"),
        a_servo_loop: ("planar3", "sawyer"),
        a_way: ("drawer", "table", "door"),
        recordings: ("csv", "npz", "other"),
        motions: ("velocities",),
        learning: tuple(SETS),
        command: tuple(COMMANDS),
        experiment: tuple(EXPERIMENTS),
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
