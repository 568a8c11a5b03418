"""Code of others (parsers of meshes, expressions of macro files) in a process of limited memory and time.

This file is both ends: the parent makes a `LimitedChild`, whose process runs this file as a script. The script limits
itself, loads a file of Python, the task, and answers each job with what the task's function makes of it. Jobs and
answers are JSON objects, one a line.
"""

from __future__ import annotations

import contextlib
import importlib.util
import json
import math
import os
import selectors
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any, final

START_SECONDS = 30  # for the task's libraries to be loaded, from a cold disk on a busy machine
SLACK = 10.0  # seconds on the clock for one of processor time, on slow disks and busy machines
LARGEST_FILE = 500_000_000  # [bytes] that the process can write
# what a task may raise about a job, which the answer then says in place of a result
FAULTS = (ArithmeticError, AttributeError, LookupError, NameError, OSError, RuntimeError, SyntaxError)


@final
class LimitedChild:
    """One process; serves many jobs until one of them ends it.

    Args:
        task: File of Python with `prepared()`, which loads what it needs and returns the function from a job to its
            answer, both of them dicts.
        memory: Largest address space [bytes].
        seconds: Processor time of all jobs together, beside that of the start [s].
        folder: Where the process runs.

    Attributes:
        is_lost: True if the process has ended or is of no more use: make a new one for the next job.
    """

    def __init__(self, task: Path, *, memory: int, seconds: int, folder: Path):
        search_path = json.dumps([p or os.getcwd() for p in sys.path])
        self.is_lost, self._is_new = False, True
        self._process = subprocess.Popen(
            [sys.executable, "-I", __file__, str(task), str(memory), str(seconds + START_SECONDS), search_path],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            cwd=folder,
            env={**os.environ, "OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"},
        )
        if self._process.stdin is None or self._process.stdout is None:
            raise ChildProcessError("the process has no pipes")
        self._stdin, self._stdout = self._process.stdin, self._process.stdout

    def ask(self, job: dict[str, Any], seconds: float) -> dict[str, Any]:
        """The answer to a job; `{"fault": reason}` where the task refuses it, after which the process is lost, too.

        Args:
            job: What JSON can hold.
            seconds: Longest processor time, and SLACK of it on the clock [s]; the start of the process does not count.

        Raises:
            TimeoutError: It took longer.
            OSError: The process crashed or ran out of memory (a `ChildProcessError`).
        """
        try:
            if self._is_new:
                self._answer(START_SECONDS, START_SECONDS)
                self._is_new = False
            self._stdin.write(json.dumps([seconds, job]).encode() + b"\n")
            self._stdin.flush()
            answer = self._answer(seconds, SLACK * seconds)
        except OSError as error:
            self.is_lost = True
            if isinstance(error, TimeoutError | ChildProcessError):
                raise
            raise ChildProcessError("the process is gone") from error
        self.is_lost = "fault" in answer  # its memory is not used again
        return answer

    def _answer(self, seconds: float, on_the_clock: float) -> dict[str, Any]:
        late = TimeoutError(f"it took more than {max(seconds, 0.0):.3g} s")
        with selectors.DefaultSelector() as selector:
            selector.register(self._stdout, selectors.EVENT_READ)
            if on_the_clock <= 0.0 or not selector.select(on_the_clock):
                raise late
        line = self._stdout.readline()
        if not line.endswith(b"\n"):
            if os.name == "posix" and self._process.wait() == -signal.SIGXCPU:
                raise late
            raise ChildProcessError("it crashed or ran out of memory")
        return json.loads(line)

    def close(self) -> None:
        """End the process."""
        self._process.kill()
        self._process.communicate()


def limit_self(memory: int, seconds: int) -> None:
    """Limit this process's address space [bytes], processor time [s] and files; nothing where there are no limits."""
    try:
        import resource
    except ImportError:
        return
    for kind, value in (
        (resource.RLIMIT_AS, memory),
        (resource.RLIMIT_CPU, seconds),
        (resource.RLIMIT_CORE, 0),
        (resource.RLIMIT_FSIZE, LARGEST_FILE),
    ):
        _, hard = resource.getrlimit(kind)
        with contextlib.suppress(ValueError, OSError):
            resource.setrlimit(kind, (value if hard == resource.RLIM_INFINITY else min(value, hard), hard))


def limit_job(seconds: float, most: int) -> None:
    """Limit the processor time of this process to what it has used and this [s], never beyond the most of all jobs."""
    try:
        import resource
    except ImportError:
        return
    with contextlib.suppress(ValueError, OSError):
        _, hard = resource.getrlimit(resource.RLIMIT_CPU)
        resource.setrlimit(resource.RLIMIT_CPU, (min(math.ceil(time.process_time() + seconds), most), hard))


def serve(task: str, memory: str, seconds: str, search_path: str) -> None:
    """Answer jobs until stdin closes."""
    limit_self(int(memory), int(seconds))
    sys.path[:] = json.loads(search_path)
    # what libraries print must not get between the answers
    answers = os.fdopen(os.dup(sys.stdout.fileno()), "w")
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    spec = importlib.util.spec_from_file_location("task", task)
    if spec is None or spec.loader is None:
        raise ImportError(task)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    answer_to = module.prepared()
    print(json.dumps({}), file=answers, flush=True)
    for line in sys.stdin:
        try:
            for_this, job = json.loads(line)
            limit_job(for_this, int(seconds))
            answer = answer_to(job)
        except (*FAULTS, MemoryError, TypeError, ValueError) as error:
            answer = {"fault": f"{type(error).__name__}: {error}"[:300]}
        print(json.dumps(answer), file=answers, flush=True)


if __name__ == "__main__":
    serve(*sys.argv[1:])
