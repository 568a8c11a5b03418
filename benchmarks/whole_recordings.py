"""How well whole, mixed and loosely held recordings are learnt, on generated sets that nothing was tuned on.

    python benchmarks/whole_recordings.py --studies phases free --sets 12 --out table.md

Each set is learnt by `ConstraintLearner([world, local])`, as the command line does, and compared with the mechanism
that it was made with. Set i of a kind has the seed 1000 + i and the robots take turns. No learnt quantity takes part in
the truth.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import final

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "examples"))

from make_recordings.kinds import FREE
from recording_cases import STUDIES, Case, cases_of
from recording_scores import mechanisms_figures, odd_figures, phases_figures, rows_figures

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
    "odd missed",
    "false alarms",
    "cpu s",
)
COUNTED = {"refused", "warned", "rows right", "wrong, no warning", "type right", "odd missed", "false alarms"}
LARGE_IS_GOOD = {"found %"}


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
        if truth["contaminated"]:
            figures |= {"odd missed": float(len(truth["contaminated"]))}
        return Outcome(case, figures, f"refused ({refusal.code}): {refusal}")
    report = learner.report_
    figures = {"refused": 0.0, "warned": float(bool(report.warnings)), "cpu s": time.process_time() - started}
    if truth["mechanisms"]:
        figures |= rows_figures(learner, arm, demos, truth, case.axes) | mechanisms_figures(learner, demos, truth)
        figures["wrong, no warning"] = float(not figures["rows right"] and not report.warnings)
        if case.whole and not truth["contaminated"]:
            figures |= phases_figures(report, arm, demos, truth)
        figures |= odd_figures(report, len(demos), truth["contaminated"], bool(case.mixed))
    return Outcome(case, figures, str(report))


def line_of(study: str, name: str, outcomes: list[Outcome]) -> str:
    """One line of the table: counts, and medians with the worst."""
    cells = [study, name, str(len(outcomes))]
    for column in COLUMNS:
        values = np.array([o.figures[column] for o in outcomes if column in o.figures])
        if not len(values):
            cells.append("")
        elif column in COUNTED:
            cells.append(f"{values.sum():.0f}")
        else:
            worst = values.min() if column in LARGE_IS_GOOD else values.max()
            cells.append(f"{np.median(values):.3g} ({worst:.3g})")
    return "| " + " | ".join(cells) + " |"


def losing(o: Outcome) -> bool:
    """Whether something about it is not as it should be."""
    f = o.figures
    wrong = f.get("rows right") == 0.0 or f.get("type right") == 0.0 or f.get("found %", 100.0) < 95.0
    wrong |= f.get("outside %", 0.0) > 3.0 or f.get("odd missed", 0.0) > 0.0 or f.get("false alarms", 0.0) > 0.0
    return wrong or (o.case.kind in FREE and f["refused"] == 0.0) or f.get("direction deg", 0.0) > 0.1


def main(arguments: list[str] | None = None, write: Callable[[str], None] = print) -> None:
    """Measure, and write one table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--studies", nargs="+", choices=STUDIES, default=list(STUDIES))
    parser.add_argument("--kinds", nargs="+", help="only these kinds of recordings")
    parser.add_argument("--sets", type=int, default=12, help="sets of each kind")
    parser.add_argument("--out", type=Path, help="file for the table")
    parser.add_argument("--losing", action="store_true", help="say what was answered where it is wrong")
    given = parser.parse_args(arguments)
    lines = ["| study | kind | sets | " + " | ".join(COLUMNS) + " |", "|---" * (3 + len(COLUMNS)) + "|"]
    write("\n".join(lines))
    for study in given.studies:
        for name, cases in cases_of(study, given.sets, given.kinds):
            outcomes = [judge(case) for case in cases]
            lines.append(line_of(study, name, outcomes))
            write(lines[-1])
            for o in outcomes:
                if given.losing and losing(o):
                    numbers = {k: round(v, 3) for k, v in o.figures.items()}
                    write(f"    {o.case.robot} {o.case.seed} {numbers}: {o.words[:600]}")
            if given.out:
                given.out.write_text("\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
