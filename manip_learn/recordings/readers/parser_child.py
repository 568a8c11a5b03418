"""The child process that parses foreign formats; run as a script, never imported.

Standard input is a connection that brings the search path of modules, then jobs. For a job the process limits its own
memory and processor time, and answers with frames of JSON, some followed by frames with the bytes of arrays; the last
one says how it ended.
"""

from __future__ import annotations

import contextlib
import importlib
import itertools
import json
import os
import signal
import sys
import types
from multiprocessing.connection import Connection
from typing import Any

ROWS = 10_000  # in one answer
ARRAYS = ("time", "positions", "velocities", "efforts", "wrench")


def main() -> None:
    """Serve jobs until stdin closes."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent decides
    # what a library prints must not get between the answers
    answers = Connection(os.dup(sys.stdout.fileno()), readable=False)
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    jobs = Connection(os.dup(sys.stdin.fileno()), writable=False)
    sys.path[:] = jobs.recv()
    # the package without its __init__, which would load robots, too
    package = types.ModuleType("manip_learn.recordings")
    package.__path__ = [os.path.dirname(os.path.dirname(os.path.abspath(__file__)))]
    sys.modules[package.__name__] = package
    with contextlib.suppress(EOFError):
        while True:
            job = jobs.recv()
            limit_self(job["bytes"], job["seconds"])
            serve(job, answers)


def serve(job: dict[str, Any], answers: Connection) -> None:
    """Answer one job."""
    from pathlib import Path

    from manip_learn.errors import MissingExtraError, RecordingError, advice_for_command

    request = job["request"]
    advice = contextlib.nullcontext() if job["flags"] is None else advice_for_command(job["flags"])
    try:
        with advice:
            module = importlib.import_module(job["module"])
            if request is None:
                rows = module.parquet_rows(Path(job["path"]), tuple(job["columns"]), ends_only=job["ends"])
                while batch := list(itertools.islice(rows, ROWS)):
                    say(answers, {"kind": "rows", "rows": batch})
            else:
                for recording in module.read(Path(job["path"]), request):
                    say_recording(answers, recording)
        say(answers, {"kind": "end", "uses": None if request is None else request.uses.as_words()})
    except RecordingError as error:
        path = None if error.path is None else str(error.path)
        where = {"path": path, "line": error.line, "column": error.column}
        say(answers, {"kind": "refusal", "message": str(error), "code": error.code, **where})
    except MissingExtraError as error:
        say(answers, {"kind": "missing", "message": str(error), "extra": error.extra})


def say(answers: Connection, words: dict[str, Any]) -> None:
    """One frame of words."""
    answers.send_bytes(json.dumps(words).encode())


def say_recording(answers: Connection, recording: Any) -> None:
    """A recording: what has no numbers, then the arrays."""
    import numpy as np

    arrays = {name: getattr(recording, name) for name in ARRAYS}
    given = {k: np.ascontiguousarray(a, dtype=np.float64) for k, a in arrays.items() if a is not None}
    names = ("name", "position_names", "velocity_names", "effort_names", "strict_columns", "in_seconds", "notes")
    words = {name: getattr(recording, name) for name in names}
    shapes = {k: a.shape for k, a in given.items()}
    say(answers, {"kind": "recording", "path": str(recording.path), "fields": words, "shapes": shapes})
    for array in given.values():
        answers.send_bytes(array.tobytes())


def limit_self(memory: int, seconds: float) -> None:
    """Memory and further processor time, no core dump; nothing on systems without such limits."""
    try:
        import resource
    except ImportError:
        return
    used = resource.getrusage(resource.RUSAGE_SELF)
    limits = (
        (resource.RLIMIT_AS, memory),
        (resource.RLIMIT_CPU, int(used.ru_utime + used.ru_stime + seconds) + 1),
        (resource.RLIMIT_CORE, 0),
    )
    for kind, value in limits:
        _, hard = resource.getrlimit(kind)
        try:
            resource.setrlimit(kind, (value if hard == resource.RLIM_INFINITY else min(value, hard), hard))
        except (ValueError, OSError):
            continue


if __name__ == "__main__":
    main()
