"""How well whole, mixed and loosely held recordings are learnt, on generated sets that nothing was tuned on.

    python benchmarks/whole_recordings.py --first-seed 27000 --sets 4 --losing --out table.csv
    python benchmarks/whole_recordings.py --studies phases free --sets 5 --losing

Each set is learnt by `ConstraintLearner([world, local])`, as the command line does, and compared with the mechanism
that it was made with. Set i of a kind has the seed first + i and the robots take turns. No learnt quantity takes part
in the truth. Figures are medians with the worst beside them; `COUNTED` ones are numbers of sets.
"""

from __future__ import annotations

import argparse
import sys
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import final

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "examples"))

from make_recordings.kinds import FREE
from recording_cases import STUDIES, Case, cases_of
from recording_scores import (
    INSIDE,
    lone_figures,
    mechanisms_figures,
    odd_figures,
    phases_figures,
    rows_figures,
)
from table_file import put

import manip_learn as ml
from manip_learn.errors import NotIdentifiableError

COLUMNS = (
    "refused",
    "warned",
    "rows right",
    "wrong, no warning",
    "found %",
    "outside %",
    "boundary s",
    "direction deg",
    "type right",
    "axis deg",
    "place mm",
    "radius mm",
    "pitch %",
    *INSIDE.values(),
    "odd missed",
    "false alarms",
    "lone named",
    "lone wrong",
    "cpu s",
)
COUNTED = {"refused", "warned", "rows right", "wrong, no warning", "type right", "odd missed", "false alarms"}
COUNTED |= {"lone named", "lone wrong"}
LARGE_IS_GOOD = {"found %"}
HEADER = ["table", "study", "kind", "sets"]
for column in COLUMNS:
    HEADER += [column] if column in COUNTED or column in INSIDE.values() else [column, f"{column}, worst"]


@final
@dataclass(frozen=True)
class Outcome:
    """What was learnt from one set: figures by the names of the columns, and words about what went wrong."""

    case: Case
    figures: dict[str, float]
    words: str = ""


def judge(case: Case) -> Outcome:
    """Learn one set and compare it with the truth."""
    arm, demos, truth = case.make()
    maps = [ml.FrameJacobian(arm.robot, truth["tip"], case.axes, reference) for reference in ("world", "local")]
    learner, started = ml.ConstraintLearner(maps), time.process_time()
    try:
        learner.fit(demos)
    except NotIdentifiableError as refusal:
        figures = {"refused": 1.0, "cpu s": time.process_time() - started}
        if truth["mechanisms"]:
            figures |= {"rows right": 0.0, "type right": 0.0}
        if not case.mixed:
            figures |= {"lone wrong": float(any("one recording alone" in advice for advice in refusal.advice))}
        if truth["contaminated"]:
            figures |= {"odd missed": float(len(truth["contaminated"]))}
        return Outcome(case, figures, f"refused ({refusal.code}): {refusal}")
    report = learner.report_
    figures = {"refused": 0.0, "warned": float(bool(report.warnings)), "cpu s": time.process_time() - started}
    if truth["mechanisms"]:
        figures |= rows_figures(learner, arm, demos, truth, case.axes) | mechanisms_figures(learner, demos, truth)
        figures["wrong, no warning"] = float(not figures["rows right"] and not report.warnings)
        if not truth["contaminated"]:
            figures |= lone_figures(report, truth)
        if case.whole and not truth["contaminated"] and not case.lone:
            figures |= phases_figures(report, arm, demos, truth)
        figures |= odd_figures(report, len(demos), truth["contaminated"], bool(case.mixed))
    stated = "" if report.mechanism is None else f" {dict(report.mechanism.uncertainty)}"
    return Outcome(case, figures, f"{report}{stated}")


def line_of(study: str, name: str, outcomes: list[Outcome], first_seed: int) -> list[str]:
    """One line of the table: counts, and medians with the worst."""
    cells = [f"whole recordings, seeds from {first_seed}", study, name, str(len(outcomes))]
    for column in COLUMNS:
        values = np.array([o.figures[column] for o in outcomes if column in o.figures])
        if column in INSIDE.values():
            cells.append(f"{100.0 * values.mean():.0f} %" if len(values) else "")
        elif column in COUNTED:
            cells.append(f"{values.sum():.0f}" if len(values) else "")
        elif not len(values):
            cells += ["", ""]
        else:
            worst = values.min() if column in LARGE_IS_GOOD else values.max()
            cells += [f"{np.median(values):.3g}", f"{worst:.3g}"]
    return cells


def losing(o: Outcome) -> bool:
    """Whether something about it is not as it should be."""
    f = o.figures
    wrong = f.get("rows right") == 0.0 or f.get("type right") == 0.0 or f.get("found %", 100.0) < 95.0
    wrong |= f.get("outside %", 0.0) > 3.0 or f.get("odd missed", 0.0) > 0.0 or f.get("false alarms", 0.0) > 0.0
    wrong |= f.get("radius mm", 0.0) > 1.0 or f.get("place mm", 0.0) > 1.0 or f.get("axis deg", 0.0) > 0.1
    wrong |= f.get("lone wrong", 0.0) > 0.0 or f.get("lone named") == 0.0
    return wrong or (o.case.kind in FREE and f["refused"] == 0.0) or f.get("direction deg", 0.0) > 0.1


def described(o: Outcome) -> str:
    """A losing set in numbers and words."""
    numbers = {k: round(v, 3) for k, v in o.figures.items()}
    return f"    {o.case.kind} {o.case.robot} {o.case.seed} {numbers}: {o.words[:900]}"


def options() -> argparse.ArgumentParser:
    """What can be asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--studies", nargs="+", choices=STUDIES, default=list(STUDIES))
    parser.add_argument("--kinds", nargs="+", help="only these kinds of recordings")
    parser.add_argument("--sets", type=int, help="sets of each line; by default as many as in the full table")
    parser.add_argument("--first-seed", type=int, default=1100, help="seed of the first set of each kind")
    parser.add_argument("--jobs", type=int, default=1, help="processes that learn sets at the same time")
    parser.add_argument("--out", type=Path, help="file for the table")
    parser.add_argument("--losing", action="store_true", help="say what was answered where it is wrong")
    return parser


def outcomes_of(study: str, name: str, cases: list[Case], pool: ProcessPoolExecutor) -> list[Outcome]:
    """Every set of a line, learnt; progress goes to the standard error."""
    out = []
    for outcome in pool.map(judge, cases):
        out.append(outcome)
        print(f"\r{study}: {name}, {len(out)} of {len(cases)}   ", end="", file=sys.stderr, flush=True)
    print("\r" + 60 * " " + "\r", end="", file=sys.stderr, flush=True)
    return out


def main() -> None:
    """Measure, and print or write one table."""
    given = options().parse_args()
    lines: list[list[str]] = []
    with ProcessPoolExecutor(given.jobs) as pool:
        for study in given.studies:
            for name, cases in cases_of(study, given.sets or STUDIES[study], given.first_seed, given.kinds):
                outcomes = outcomes_of(study, name, cases, pool)
                lines.append(line_of(study, name, outcomes, given.first_seed))
                lost = [described(o) for o in outcomes if losing(o)] if given.losing else []
                if lost:
                    print("\n".join(lost), file=sys.stderr)
                if given.out:
                    put(HEADER, lines, given.out)
    if not given.out:
        put(HEADER, lines, None)


if __name__ == "__main__":
    main()
