"""The command line: argv in, exit code out; all work is done in `commands`."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from importlib import import_module
from typing import Annotated, Any, final

import typer

from manip_learn.commands import options
from manip_learn.commands.command_line import (
    PROGRAM,
    GroupedCommand,
    flags_of,
    joined_vectors,
    parsed_by,
    typed,
)
from manip_learn.commands.output import answer, nobody_reads, progress, refuse, refused_by_system, waiting
from manip_learn.errors import ManipLearnError, advice_for_command

COMPLETION = "_MANIP_LEARN_COMPLETE"  # set by the shell that asks for completions


@final
@dataclass(frozen=True)
class Command:
    """One command.

    Attributes:
        name: As it is typed.
        options: Dataclass of its arguments and options; its docstring is the help.
        work: File in `commands` and function that does the work: options and progress -> an answer with `to_dict`, or
            an iterator of answers, each of which says more than the one before.
        printers: Functions in `commands.tables` that print the answers.
        waiting: What is shown meanwhile, where no progress is known.
    """

    name: str
    options: type
    work: str
    printers: tuple[str, ...]
    waiting: str = ""

    def __call__(self, given: Any) -> None:
        """Do the work, and print the answers; under --json the last one alone."""
        file, function = self.work.split(".")
        work = getattr(import_module(f"manip_learn.commands.{file}"), function)
        with waiting(given.as_json, self.waiting) if self.waiting else progress(given.as_json) as report:
            answers = work(given, report)
        explain = {"explain": given.explain} if "explain" in vars(given) else {}
        each = answers if isinstance(answers, Iterator) else [answers]
        for last, printer in zip(each, self.printers, strict=True):
            if not given.as_json:  # at once: what follows may take long
                answer(False, {}, printer, last, **explain)
        if given.as_json:
            answer(True, last.to_dict())


COMMANDS = (
    Command("robots", options.RobotsOptions, "robots.known_robots", ("print_robots",)),
    Command("demo", options.DemoOptions, "demo.demo", ("print_demo",)),
    Command("inspect", options.InspectOptions, "robots.inspect", ("print_robot", "print_cross_check")),
    Command("learn", options.LearnOptions, "learn.learn", ("print_learnt",)),
    Command("audit", options.AuditOptions, "audit.audit", ("print_audit",)),
    Command("control", options.ControlOptions, "control.control", ("print_controlled",)),
    Command("replay", options.ReplayOptions, "replay.replay", ("print_replayed",), "writing the replay"),
    Command("export", options.ExportOptions, "export.export", ("print_exported",), "writing"),
    Command("reproduce", options.ReproduceOptions, "reproduce.reproduce", ("print_reproduction",)),
    Command("warm-up", options.WarmUpOptions, "warm_up.warm_up", ("print_warm_up",)),
)
app = typer.Typer(
    name=PROGRAM,
    help="Learn which directions a demonstrated task constrains, and keep the arm away from its singularities.",
    epilog="Start with: manip-learn demo",
    add_completion=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)
for each_command in COMMANDS:
    app.command(each_command.name, cls=GroupedCommand)(parsed_by(each_command.options, each_command))


def print_version(asked: bool) -> None:
    """Print the version and leave, if it was asked for."""
    if asked:
        from importlib.metadata import version

        typer.echo(f"{PROGRAM} {version(PROGRAM)}")
        raise typer.Exit


@app.callback()
def front(
    version: Annotated[
        bool, typer.Option("--version", help="Show the version and exit.", callback=print_version, is_eager=True)
    ] = False,
) -> None:
    """Learn which directions a demonstrated task constrains, and keep the arm away from its singularities."""


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; returns 0, 2 for bad input, 1 for an internal error, 130 for Ctrl-C. No traceback."""
    from typer.main import get_command

    # before NumPy is loaded: threads on matrices this small cost more than they gain
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    arguments = joined_vectors(list(sys.argv[1:] if argv is None else argv))
    if not arguments and COMPLETION not in os.environ:
        return refuse(
            "no command given: try `manip-learn demo`, or `manip-learn --help` for all commands", False, "usage"
        )
    command = get_command(app)
    with advice_for_command(flags_of(command, arguments)), typed(arguments):
        code = _run(lambda: command.main(arguments, prog_name=PROGRAM, standalone_mode=False), "--json" in arguments)
    if argv is None:
        sys.exit(code)
    return code


def _run(command: Callable[[], Any], as_json: bool) -> int:
    # depending on its version, typer bundles click or uses the public one: either way this is click's UsageError
    usage_error: Any = typer.BadParameter.__mro__[1]
    try:
        outcome = command()
        sys.stdout.flush()
    except ManipLearnError as error:
        return refuse(str(error), as_json, error.code, error.facts())
    except usage_error as error:
        context = getattr(error, "ctx", None)
        where = f"{PROGRAM} {context.info_name}" if context and context.parent else PROGRAM
        return refuse(f"{error.format_message().rstrip('.')}: see `{where} --help`", as_json, "usage")
    except (typer.Abort, KeyboardInterrupt):
        print("interrupted", file=sys.stderr)
        return 130
    except BrokenPipeError:
        return nobody_reads()
    except SystemExit as end:  # of rich and typer, for a pipe that nobody reads; or of a completion
        return end.code if COMPLETION in os.environ and isinstance(end.code, int) else nobody_reads()
    except OSError as error:
        return refuse(refused_by_system(error), as_json, "system")
    except Exception as error:  # last resort: a sentence, not a traceback
        sentence = f"internal error ({type(error).__name__}: {error}); please report it"
        return refuse(sentence, as_json, "internal", exit_code=1)
    return outcome if isinstance(outcome, int) else 0


if __name__ == "__main__":
    main()
