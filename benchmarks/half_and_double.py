"""What changes in the answers if a number that decides has half or twice its value: one at a time, on a panel of sets.

    python benchmarks/half_and_double.py --jobs 2 --out table.md
    python benchmarks/half_and_double.py --names LEAST_GAIN_NATS BELIEVED_STRENGTH

Each value is put in place before the library is imported, in a process of its own, so that what follows from it follows
here, too; all parts of a group of numbers are changed together. The panel is small, for there are 200 values: a number
without a change on it may well decide elsewhere, and one with a change need not be wrong. A set is not learnt again for
a number that no function read when it was learnt first.
"""

from __future__ import annotations

import argparse
import ast
import importlib.util
import multiprocessing
import re
import sys
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "examples"))

from recording_cases import Case

from manip_learn.recordings.trajectory import Trajectory

TREE = Path(__file__).resolve().parents[1]
NAME = "manip_learn.learning.deciding"
FILE = TREE / "manip_learn" / "learning" / "deciding.py"
FACTORS = {"half": 0.5, "twice": 2.0}
ANGLES = 1.5  # ratio from which a stated angle counts as another
RATE = 2  # every so many samples of the generated 100 Hz
Outcome = dict[str, str | int | float | None]
Recordings = tuple[str, str, str, list[Trajectory]]  # robot, tip, axes


def generated(case: Case, seconds: float = np.inf) -> Recordings:
    """The recordings of a case, thinned, their first seconds."""
    _, demos, truth = case.make()
    demos = [t.part(slice(int(np.searchsorted(t.time, t.time[0] + seconds)))) for t in demos]
    thin = [Trajectory(t.time[::RATE], t.q[::RATE], None, t.joint_names, t.name) for t in demos]
    return case.robot, truth["tip"], case.axes, thin


def copied(case: Case) -> Recordings:
    """The first recording twice, the second time in three pieces."""
    robot, tip, axes, demos = generated(case)
    cuts = np.linspace(0, len(demos[0]), 4).astype(int)
    parts = [demos[0].part(slice(a, b)) for a, b in zip(cuts, cuts[1:], strict=False)]
    more = [Trajectory(p.time, p.q, None, p.joint_names, f"piece_{i}") for i, p in enumerate(parts)]
    return robot, tip, axes, [*demos, *more]


def sloped(case: Case) -> Recordings:
    """Velocities are recorded, those of one joint 1.07 times too large."""
    robot, tip, axes, demos = generated(case)
    factor = np.where(np.arange(demos[0].q.shape[1]) == 1, 1.07, 1.0)
    made = [(t, np.gradient(t.q, t.time, axis=0) * factor) for t in demos]
    return robot, tip, axes, [Trajectory(t.time, t.q, u, t.joint_names, t.name) for t, u in made]


def panel() -> dict[str, Recordings]:
    """Name -> recordings that the learner gets."""
    few, cut = {"n": 3}, {"n": 4, "whole": False}
    return {
        "drawer, whole": generated(Case("drawer", "panda", 26000, **few)),
        "table, whole": generated(Case("table", "ur5", 26000, **few)),
        "drawer then table, whole": generated(Case("drawer_then_table", "panda", 26002, **few)),
        "drawer with a slip, whole": generated(Case("drawer_slip", "panda", 26006, **few)),
        "door": generated(Case("door", "panda", 26001, **cut)),
        "tether": generated(Case("tether", "panda", 26003, **cut)),
        "hinge by pose": generated(Case("hinge", "panda", 26004, axes="pose", **cut)),
        "drawer, noise 3e-3 rad": generated(Case("drawer", "panda", 26005, noise=3e-3, **cut)),
        "door, 5 degrees of turn": generated(Case("door", "panda", 26011, n=5, whole=False, turn=5.0)),
        "drawer, 1 of 6 odd": generated(Case("drawer", "panda", 26006, n=6, whole=False, mixed=1)),
        "tables 2 degrees apart": generated(Case("table", "panda", 26007, n=6, whole=False, apart=2.0)),
        "drawer, copied": copied(Case("drawer", "panda", 26012, **cut)),
        "drawer, velocities off": sloped(Case("drawer", "panda", 26013, **cut)),
        "free": generated(Case("free", "panda", 26008, n=3), 2.0),
        "free, slow": generated(Case("free_slow", "panda", 26009, n=3), 2.0),
        "reaching": reaching(),
        "reaching, separate": reaching(),
    }


def reaching() -> Recordings:
    """Shipped recordings of a planar arm that moves what it keeps to: the joint estimator's case."""
    from manip_learn.recordings import load_demonstrations
    from manip_learn.robot.loading import load_robot

    files = sorted((TREE / "examples" / "data" / "planar3_reach").glob("*.csv"))[:12]
    demos = load_demonstrations([str(f) for f in files], load_robot("planar3"))
    return "planar3", "tip", "planar", list(demos)


def learnt(name: str, recordings: Recordings) -> Outcome:
    """What is answered to a set of the panel."""
    from make_recordings.arms import LOCKED

    import manip_learn as ml
    from manip_learn.errors import NotIdentifiableError

    robot_name, tip, axes, demos = recordings
    robot = ml.load_robot(robot_name, locked=LOCKED.get(robot_name, ()))
    references = ("world",) if axes == "planar" else ("world", "local")
    maps = [ml.FrameJacobian(robot, tip, axes, reference) for reference in references]
    estimator = "separate" if name.endswith("separate") else "joint" if axes == "planar" else "auto"
    learner = ml.ConstraintLearner(maps, estimator=estimator)
    try:
        learner.fit(demos)
    except NotIdentifiableError as refusal:
        return {"refused": refusal.code}
    report = learner.report_
    audit = ml.audit_episodes(learner.constraint_, demos) if "odd" in name else None
    return {
        "rows": report.n_constraints,
        "type": report.mechanism.type if report.mechanism else "none",
        "constraints": len(learner.constraints_),
        "odd": ", ".join(sorted(odd.trajectory for odd in report.odd_trajectories)),
        "estimator": report.estimator,
        "model": report.policy_model,
        "warned": " | ".join(re.sub(r"[^a-z ]+", "", w.lower())[:40] for w in report.warnings),
        "angle": report.uncertainty_deg,
        "left out": ", ".join(sorted(e.episode for e in audit.leave_out)) if audit else "",
    }


def changed(name: str, before: Outcome, after: Outcome) -> str:
    """In words, what differs; nothing if nothing does."""
    if before.get("refused") != after.get("refused"):
        how = f"refused ({after['refused']})" if "refused" in after else "answered"
        return f"{name}: {how}"
    words = []
    for key in before:
        one, other = before[key], after.get(key)
        if key == "angle" and isinstance(one, float) and isinstance(other, float):
            ratio = other / one if one > 0.0 else np.inf
            words += [f"angle x {ratio:.2g}"] if max(ratio, 1.0 / max(ratio, 1e-9)) > ANGLES else []
        elif key == "warned" and one != other:
            counts = f"warnings {_count(other)}, not {_count(one)}"
            words.append(counts if _count(one) != _count(other) else "other warnings")
        elif one != other:
            words.append(f"{key} {other or 'none'}, not {one or 'none'}")
    return f"{name}: {', '.join(words)}" if words else ""


def _count(warned: Any) -> int:
    return len(warned.split(" | ")) if warned else 0


def scaled(value: Any, factor: float) -> Any:
    """A value, or each of a group, times the factor; a count stays one and at least one."""
    if isinstance(value, dict):
        return {key: scaled(one, factor) for key, one in value.items()}
    if isinstance(value, tuple):
        return tuple(scaled(one, factor) for one in value)
    return max(1, round(value * factor)) if isinstance(value, int) else value * factor


def names_read(name: str, recordings: Recordings) -> set[str]:
    """Every name in the functions of the room that are called when a set is learnt."""
    codes = set()

    def note(frame: Any, event: str, _: Any) -> None:
        if event == "call":
            codes.add(frame.f_code)

    sys.setprofile(note)
    learnt(name, recordings)
    sys.setprofile(None)
    return {read for code in codes if code.co_filename.startswith(str(FILE.parent)) for read in code.co_names}


def names_at_import() -> set[str]:
    """Every name that modules of the room read when they are imported: in other values, and as defaults."""
    out = set()
    for file in FILE.parent.rglob("*.py"):
        nodes: list[ast.AST] = [ast.parse(file.read_text())] if file != FILE else []
        while nodes:
            node = nodes.pop()
            if isinstance(node, ast.FunctionDef):
                nodes += [*node.args.defaults, *filter(None, node.args.kw_defaults)]
            elif isinstance(node, ast.Name) and isinstance(node.ctx, ast.Load):
                out.add(node.id)
            else:
                nodes += list(ast.iter_child_nodes(node))
    return out


def sets_that_read(names: Iterable[str]) -> dict[str, list[str]]:
    """Name -> the sets of the panel that may depend on it."""
    always, read = names_at_import(), {name: names_read(name, recordings) for name, recordings in SETS.items()}
    return {name: [s for s in SETS if name in always or name in read[s]] for name in names}


def outcomes(name: str, word: str, sets: Iterable[str]) -> dict[str, Outcome]:
    """Of some sets of the panel, in a process that has not imported the learner yet."""
    spec = importlib.util.spec_from_file_location(NAME, FILE)
    if spec is None or spec.loader is None:
        raise ImportError(str(FILE))
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    if name:
        setattr(module, name, scaled(getattr(module, name), FACTORS[word]))
    sys.modules[NAME] = module
    out: dict[str, Outcome] = {}
    for one in sets:
        try:
            out[one] = learnt(one, SETS[one])
        except (ValueError, ArithmeticError, IndexError, np.linalg.LinAlgError) as fault:
            out[one] = {"refused": f"fails: {type(fault).__name__}"}  # a value that makes no sense there
    return out


SETS: dict[str, Recordings] = {}


def names_of() -> list[str]:
    """The numbers, in the order of their file."""
    out = []
    for line in ast.parse(FILE.read_text()).body:
        if isinstance(line, ast.Assign):
            out += [n.id for target in line.targets for n in ast.walk(target) if isinstance(n, ast.Name)]
    return out


def main(arguments: list[str] | None = None, write: Callable[[str], None] = print) -> None:
    """Measure, and write one table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--names", nargs="+", choices=names_of(), default=names_of())
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--out", type=Path, help="file for the table")
    given = parser.parse_args(arguments)
    SETS.update(panel())
    if NAME in sys.modules:
        raise RuntimeError("the learner is imported already: its numbers cannot be changed any more")
    lines = ["| number | half | twice |", "|---|---|---|"]
    write("\n".join(lines))
    # a process for each value: what it imports is its own
    with multiprocessing.get_context("fork").Pool(given.jobs, maxtasksperchild=1) as pool:
        read = pool.apply(sets_that_read, (given.names,))
        before = pool.apply(outcomes, ("", "", list(SETS)))
        for name, outcome in before.items():
            write(f"    {name}: {outcome}")
        after = {(n, word): pool.apply_async(outcomes, (n, word, read[n])) for n in given.names for word in FACTORS}
        for name in given.names:
            cells = []
            for word in FACTORS:
                there = after[name, word].get()
                words = [changed(one, before[one], outcome) for one, outcome in there.items()]
                cells.append("; ".join(filter(None, words)) or "-")
            lines.append(f"| `{name}` | {cells[0]} | {cells[1]} |")
            write(lines[-1])
            if given.out:
                given.out.write_text("\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
