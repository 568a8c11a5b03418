"""`manip-learn reproduce`: the paper's experiments."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, final

from manip_learn.commands.options import ReproduceOptions
from manip_learn.experiments import reproduce as run_experiments
from manip_learn.recordings.load import Progress


@final
@dataclass(frozen=True)
class Reproduction:
    """Numbers of each part, and its page in Markdown."""

    numbers: dict[str, Any]
    pages: dict[str, str]
    out: Path | None

    def to_dict(self) -> dict[str, Any]:
        """The JSON answer."""
        return self.numbers


def reproduce_paper(options: ReproduceOptions, progress: Progress | None = None) -> Reproduction:
    """Run one experiment, or all."""
    pages: dict[str, str] = {}
    numbers = run_experiments(
        options.experiment,
        options.trials,
        options.seed,
        options.out,
        progress,
        workers=options.workers,
        on_result=lambda part, result: pages.update({part: result.markdown()}),
    )
    return Reproduction(numbers, pages, options.out)
