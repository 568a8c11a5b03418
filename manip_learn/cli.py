"""Entry point of the command line; the commands are in `commands`.

Only modules of the standard library are imported before Ctrl-C has a handler, so that Ctrl-C never prints a traceback,
not even in the first moment.
"""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Callable, Sequence
from types import FrameType
from typing import Any

COMPLETION = "_MANIP_LEARN_COMPLETE"  # set by the shell that asks for completions
INTERRUPTED = 130  # exit code of a shell for Ctrl-C
_phase = "idle"  # "working" while a command may have something to clean up, "interrupted" after the first Ctrl-C


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; errors are printed as messages, not as tracebacks.

    Args:
        argv: Arguments without the name of the program. None reads `sys.argv`, handles Ctrl-C, and exits the process.

    Returns:
        Exit code: 0, 2 for bad input, 1 for an internal error, 130 for Ctrl-C.
    """
    # before NumPy is loaded: threads on matrices this small cost more than they gain
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    if argv is not None:
        return _run(list(argv))
    signal.signal(signal.SIGINT, _interrupt)
    # reopen streams that the shell has closed: otherwise the next file would get their numbers
    while os.open(os.devnull, os.O_RDWR) < 2:
        continue
    sys.stdout, sys.stderr = sys.stdout or open(1, "w"), sys.stderr or open(2, "w")
    sys.unraisablehook = _unraisable
    sys.exit(_run(sys.argv[1:]))


def _interrupt(signal_number: int = signal.SIGINT, frame: FrameType | None = None) -> None:
    """Let a running command clean up; leave at once if no command runs, or at the second Ctrl-C."""
    global _phase
    if _phase == "working":
        _phase = "interrupted"
        raise KeyboardInterrupt
    os.write(2, b"interrupted\n")
    os._exit(INTERRUPTED)


def _unraisable(unraisable: Any) -> None:
    """Handle Ctrl-C in a place where Python cannot raise, as in a destructor: it would print a traceback and go on."""
    if isinstance(unraisable.exc_value, KeyboardInterrupt):
        _interrupt()
    sys.__unraisablehook__(unraisable)


def _run(arguments: list[str]) -> int:
    """Run one command and return its exit code; refuse no command and removed ones."""
    global _phase
    from contextvars import copy_context

    from manip_learn.commands.command_line import PROGRAM_NAME, TYPED, flags_of
    from manip_learn.commands.output import refuse
    from manip_learn.commands.program import REMOVED_COMMANDS, program
    from manip_learn.errors import advice_for_command

    if not arguments and COMPLETION not in os.environ:
        return refuse(
            "no command given: try `manip-learn demo`, or `manip-learn --help` for all commands", False, "usage"
        )

    if arguments and arguments[0] in REMOVED_COMMANDS:
        sentence = f"{arguments[0]} has been removed from {PROGRAM_NAME}: {REMOVED_COMMANDS[arguments[0]]}"
        return refuse(sentence, "--json" in arguments, "usage")

    def work() -> Any:
        global _phase
        _phase = "working"
        TYPED.set((PROGRAM_NAME, *arguments))
        return program.main(arguments, prog_name=PROGRAM_NAME, standalone_mode=False)

    with advice_for_command(flags_of(program, arguments)):
        code = copy_context().run(_exit_code, work, "--json" in arguments)
    _phase = "idle"
    return code


def _exit_code(command: Callable[[], Any], as_json: bool) -> int:
    """Run a command; return its exit code, and print the reason if it failed."""
    import typer
    from typer._click.exceptions import UsageError  # typer itself exports only children of click's errors

    from manip_learn.commands.command_line import PROGRAM_NAME
    from manip_learn.commands.output import discard_output, refuse, system_refusal
    from manip_learn.errors import ManipLearnError

    try:
        outcome = command()
        sys.stdout.flush()
    except ManipLearnError as error:
        return refuse(str(error), as_json, error.code, error.facts())
    except UsageError as error:
        context = getattr(error, "ctx", None)
        where = f"{PROGRAM_NAME} {context.info_name}" if context and context.parent else PROGRAM_NAME
        return refuse(f"{error.format_message().rstrip('.')}: see `{where} --help`", as_json, "usage")
    except (typer.Abort, KeyboardInterrupt):
        print("interrupted", file=sys.stderr)
        return INTERRUPTED
    except BrokenPipeError:
        return discard_output()
    except SystemExit as end:  # of a signal; of a completion; of rich and typer, for a pipe that nobody reads
        code = end.code if isinstance(end.code, int) else 1
        return code if code > 128 or COMPLETION in os.environ else discard_output()
    except MemoryError as error:
        fix = "take fewer or shorter recordings, a shorter --duration or a larger --dt"
        return refuse(f"not enough memory ({error or 'even for small objects'}): {fix}", as_json, "system")
    except OSError as error:
        if isinstance(error.__context__, SystemExit):  # SIGHUP: the terminal to be restored has closed
            return int(error.__context__.code or 1)
        return refuse(system_refusal(error), as_json, "system")
    except Exception as error:  # last resort: a sentence, not a traceback
        if _phase == "interrupted":  # Ctrl-C during an import that reports its own failure
            return INTERRUPTED
        sentence = f"internal error ({type(error).__name__}: {error}); please report it"
        return refuse(sentence, as_json, "internal", exit_code=1)
    return outcome if isinstance(outcome, int) else 0


if __name__ == "__main__":
    main()
