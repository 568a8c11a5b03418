"""The command line: argv in, exit code out; all work is done in `commands`.

Nothing but the operating system is imported before Ctrl-C has a handler: whoever changes his mind in the first moment
gets no traceback either.
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
_phase = "idle"  # "working" while a command may have something to clean up, "interrupted" once it was asked to end


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; returns 0, 2 for bad input, 1 for an internal error, 130 for Ctrl-C. No traceback."""
    # before NumPy is loaded: threads on matrices this small cost more than they gain
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    if argv is not None:
        return _run(list(argv))
    signal.signal(signal.SIGINT, _interrupt)
    while os.open(os.devnull, os.O_RDWR) < 2:  # what a shell has closed, or the next file would get its number
        continue
    sys.stdout, sys.stderr = sys.stdout or open(1, "w"), sys.stderr or open(2, "w")
    sys.unraisablehook = _unraisable
    sys.exit(_run(sys.argv[1:]))


def _interrupt(signal_number: int = signal.SIGINT, frame: FrameType | None = None) -> None:
    """Let a command clean up; leave at once where there is nothing to clean up, or if asked a second time."""
    global _phase
    if _phase == "working":
        _phase = "interrupted"
        raise KeyboardInterrupt
    os.write(2, b"interrupted\n")
    os._exit(INTERRUPTED)


def _unraisable(lost: Any) -> None:
    """Where Python cannot raise, as in a destructor, it would print a traceback of Ctrl-C and go on."""
    if isinstance(lost.exc_value, KeyboardInterrupt):
        _interrupt()
    sys.__unraisablehook__(lost)


def _run(arguments: list[str]) -> int:
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
    """The exit code of a command, and the sentence that says why, where it did not work."""
    import typer
    from typer._click.exceptions import UsageError  # of click's errors typer itself exports children alone

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
        return refuse(f"there is too little memory ({error or 'for small things, too'}): {fix}", as_json, "system")
    except OSError as error:
        if isinstance(error.__context__, SystemExit):  # SIGHUP: the terminal is gone that was to be tidied up
            return int(error.__context__.code or 1)
        return refuse(system_refusal(error), as_json, "system")
    except Exception as error:  # last resort: a sentence, not a traceback
        if _phase == "interrupted":  # Ctrl-C in the middle of an import that reports its own failure
            return INTERRUPTED
        sentence = f"internal error ({type(error).__name__}: {error}); please report it"
        return refuse(sentence, as_json, "internal", exit_code=1)
    return outcome if isinstance(outcome, int) else 0


if __name__ == "__main__":
    main()
