"""`manip-learn reproduce`: the paper's experiments."""

from __future__ import annotations

from manip_learn.commands.options import ReproduceOptions
from manip_learn.commands.output import Answer, Progress
from manip_learn.experiments import reproduce as run_experiments


def reproduce_paper(options: ReproduceOptions, progress: Progress) -> Answer:
    """Run one experiment, or all; numbers of each part, and its page in Markdown."""
    pages = dict[str, str]()
    numbers = run_experiments(
        options.experiment,
        options.trials,
        options.seed,
        options.out,
        progress,
        workers=options.workers,
        on_result=lambda part, result: pages.update({part: result.markdown()}),
    )
    return Answer(numbers, pages=pages, written=[f"written: {options.out}" if options.out else ""])
