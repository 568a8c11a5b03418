"""Foreign formats, parsed in a child process that may crash, hang or run out of memory.

The child is a script of its own, not one of `multiprocessing`, which would run the caller's main module once more and
load the robots with it. Jobs go there and answers come back over `multiprocessing` connections; of what comes back
nothing is unpickled.
"""

from __future__ import annotations

import atexit
import contextlib
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from multiprocessing.connection import Pipe
from pathlib import Path
from typing import Any, final

import numpy as np

from manip_learn.errors import MissingExtraError, RecordingError, command_flags
from manip_learn.recordings.readers.read_request import ReadRequest
from manip_learn.recordings.readers.recording import Recording, reason, refusal, size_on_disk
from manip_learn.robot.limited_child import SLACK

CHILD = Path(__file__).with_name("parser_child.py")
MEMORY, MEMORY_PER_BYTE = 2_000_000_000, 8  # [bytes], and per byte of the file
SECONDS, BYTES_PER_SECOND = 8.0, 1_000_000  # of processor time, and more for large files
START_SECONDS = 60.0  # for the libraries to be loaded
FINISH_SECONDS, MOST_SKIPPED = 0.5, 20  # of a job whose further answers nobody wants
PARQUET = "manip_learn.recordings.readers.lerobot_reader"
PARTS = ("recording", "rows")

Answer = tuple[dict[str, Any], dict[str, Any]]  # words, and arrays by name


def parsed_recordings(module: str, path: Path, request: ReadRequest) -> Iterator[Recording]:
    """The recordings that a parser finds, one after the other.

    Args:
        module: Has `read(path, request)`.
        path: File or folder.
        request: Options.

    Raises:
        RecordingError: The parser's own, or codes `parser-time`, `parser-crashed`.
        MissingExtraError: The parser's library is not installed.
    """
    job = {"module": module, "path": os.path.abspath(path), "request": request.for_parser()}
    for words, arrays in _answers(path, job):
        if words["kind"] == "end":
            request.uses.add_words(words["uses"])
            return
        fields: dict[str, Any] = {k: tuple(v) if isinstance(v, list) else v for k, v in words["fields"].items()}
        told = words["path"]
        yield Recording(path=path if told == job["path"] else Path(told), **fields, **arrays)


def parsed_rows(path: Path, columns: tuple[str, ...], *, ends_only: bool = False) -> Iterator[dict[str, Any]]:
    """Some columns of a Parquet file, row by row, as `parquet_rows` gives them.

    Raises:
        RecordingError: As `parsed_recordings`.
        MissingExtraError: The parser's library is not installed.
    """
    job = {"module": PARQUET, "path": os.path.abspath(path), "request": None, "columns": columns, "ends": ends_only}
    for words, _ in _answers(path, job):
        yield from words.get("rows", ())


def _answers(path: Path, job: dict[str, Any]) -> Iterator[Answer]:
    size = size_on_disk(path)
    seconds = SECONDS + size / BYTES_PER_SECOND
    child = _idle()
    limits = {"bytes": MEMORY + MEMORY_PER_BYTE * size, "seconds": seconds}
    try:
        yield from child.answers(path, {**job, **limits, "flags": command_flags()})
    finally:
        if child.is_free:
            _IDLE.append(child)
        else:
            child.close()


@final
class _Child:
    """One parsing process; serves many jobs until one of them kills it."""

    def __init__(self) -> None:
        self.owner = os.getpid()
        self.is_free = False
        self._is_new = True
        self._errors = tempfile.TemporaryFile()
        self._pipe, answers = Pipe(duplex=False)
        jobs, self._jobs = Pipe(duplex=False)
        threads = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1")
        self._process = subprocess.Popen(
            [sys.executable, "-P", str(CHILD)],
            stdin=jobs.fileno(),
            stdout=answers.fileno(),
            stderr=self._errors,
            # Arrow's own allocators reserve far more addresses than they use
            env={**os.environ, **threads, "ARROW_DEFAULT_MEMORY_POOL": "system"},
        )
        for end in (answers, jobs):  # those of the child: where they are closed, the child has ended
            end.close()
        self._timed_out = False

    @property
    def is_alive(self) -> bool:
        """True if it runs and belongs to this process, not to one that this one was forked from."""
        return self._process.poll() is None and self.owner == os.getpid()

    def answers(self, path: Path, job: dict[str, Any]) -> Iterator[Answer]:
        """The words and arrays that a job gives.

        Raises:
            RecordingError: What the parser refused, or codes `parser-time`, `parser-crashed`.
            MissingExtraError: The parser's library is not installed.
        """
        self.is_free = False
        try:
            if self._is_new:
                self._jobs.send([p or os.getcwd() for p in sys.path])
            self._jobs.send(job)
        except OSError as error:
            raise self._lost(path, job) from error
        patience = SLACK * job["seconds"] + (START_SECONDS if self._is_new else 0.0)
        self._is_new = False
        while (answer := self._answer(path, job, patience))[0]["kind"] in PARTS:
            try:
                yield answer
            except GeneratorExit:
                self._finish(path, job)
                raise
        self.is_free = True
        words, _ = answer
        if words["kind"] == "missing":
            raise _rebuilt(words)
        if words["kind"] == "refusal":
            told = Path(words["path"]) if words["path"] else None
            given = path if words["path"] == job["path"] else told
            raise RecordingError(
                words["message"], code=words["code"], path=given, line=words["line"], column=words["column"]
            )
        yield answer

    def _answer(self, path: Path, job: dict[str, Any], patience: float) -> Answer:
        deadline = time.monotonic() + patience
        try:
            words = json.loads(self._frame(deadline))
            shapes = words.get("shapes", {}).items()
            return words, {name: np.frombuffer(self._frame(deadline)).reshape(shape) for name, shape in shapes}
        except TimeoutError as error:
            self._timed_out = True
            self._process.kill()
            raise self._lost(path, job) from error
        except (EOFError, OSError) as error:
            raise self._lost(path, job) from error

    def _frame(self, deadline: float) -> bytes:
        """The next frame; one that has begun comes whole, or breaks off where the child's limits end it."""
        if not self._pipe.poll(max(deadline - time.monotonic(), 0.0)):
            raise TimeoutError
        return self._pipe.recv_bytes()

    def _finish(self, path: Path, job: dict[str, Any]) -> None:
        """Skip what the caller, who has refused a recording, does not want; a job that goes on is not waited for."""
        with contextlib.suppress(RecordingError):
            for _ in range(MOST_SKIPPED):
                if self._answer(path, job, FINISH_SECONDS)[0]["kind"] not in PARTS:
                    self.is_free = True
                    return

    def _lost(self, path: Path, job: dict[str, Any]) -> RecordingError:
        code = self._process.wait()
        if self._timed_out or (os.name == "posix" and -code == signal.SIGXCPU):
            return refusal(
                path,
                "parser-time",
                f"reading it takes more than {job['seconds']:.0f} s of processor time, far more than a "
                "sound file of this size: it is damaged; copy or download it again",
            )
        self._errors.seek(0)
        said = self._errors.read().decode(errors="replace").strip().splitlines()
        cause = reason(ValueError(said[-1] if said else f"exit code {code}"))
        return refusal(
            path,
            "parser-crashed",
            f"the library that reads it crashed ({cause}): the file is damaged; copy or download it again",
        )

    def close(self) -> None:
        """End the process."""
        if self.owner == os.getpid():
            self._process.kill()
            self._process.wait()
        self._jobs.close()
        self._pipe.close()
        self._errors.close()


# a process costs as much as many small files, so one that is done waits for the next file; it ends with this process
_IDLE: list[_Child] = []


@atexit.register
def _end_idle() -> None:
    while _IDLE:
        _IDLE.pop().close()


def _idle() -> _Child:
    while _IDLE:
        child = _IDLE.pop()
        if child.is_alive:
            return child
        child.close()
    return _Child()


def _rebuilt(words: dict[str, Any]) -> MissingExtraError:
    error = MissingExtraError("", words["extra"])
    error.args = (words["message"],)
    return error
