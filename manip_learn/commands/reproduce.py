"""`manip-learn reproduce`: the paper's experiments."""

from __future__ import annotations

from typing import Any

from manip_learn.commands.options import ReproduceOptions
from manip_learn.commands.output import Answer, Progress
from manip_learn.experiments import reproduce as run_experiments


def reproduce_paper(options: ReproduceOptions, progress: Progress) -> Answer:
    """Run one experiment, or all; return the numbers of each part, and its page in Markdown.

    Args:
        options: Options of the command.
        progress: Function that is called with the name of a stage and its completed fraction, 0 to 1.

    Returns:
        Answer with the numbers and the pages.
    """
    pages = dict[str, str]()

    def keep(part: str, result: Any) -> None:
        pages[part] = result.markdown()

    arguments = (options.experiment, options.trials, options.seed, options.out)
    numbers = run_experiments(*arguments, progress, workers=options.workers, on_result=keep)
    return Answer(numbers, pages=pages, written=[f"written: {options.out}" if options.out else ""])
