"""What a parsing process answers, read from its pipe for no longer than it may take."""

from __future__ import annotations

import atexit
import contextlib
import json
import math
import os
import selectors
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, final

import numpy as np

from manip_learn.errors import MissingExtraError, RecordingError, command_flags
from manip_learn.recordings.readers.read_request import ParserRequest
from manip_learn.recordings.readers.recording import Recording, reason

PIECE = 1 << 20  # bytes that are asked for at a time


@final
class AnswerPipe:
    """Lines and numbers of bytes from a pipe, each with a deadline: no thread has to watch the clock.

    What is not there in time raises a TimeoutError.

    Args:
        descriptor: Of the pipe's end that is read; nobody else reads from it.
    """

    def __init__(self, descriptor: int):
        self._descriptor = descriptor
        self._held = bytearray()
        self._selector = selectors.DefaultSelector()
        self._selector.register(descriptor, selectors.EVENT_READ)

    def line(self, deadline: float) -> bytes:
        """The next line, with its end; what there was of it if the pipe was closed before.

        Args:
            deadline: On the clock of `time.monotonic` [s].
        """
        start = 0
        while (end := self._held.find(b"\n", start)) < 0:
            start = len(self._held)
            if not self._more(deadline):
                return self._taken(start)
        return self._taken(end + 1)

    def content(self, size: int, deadline: float) -> bytes:
        """So many bytes, fewer if the pipe was closed before.

        Args:
            size: How many.
            deadline: On the clock of `time.monotonic` [s].
        """
        while len(self._held) < size and self._more(deadline):
            pass
        return self._taken(min(size, len(self._held)))

    def close(self) -> None:
        """Forget the pipe, which its owner closes."""
        self._selector.close()

    def _more(self, deadline: float) -> bool:
        """Wait for bytes; False if the pipe is closed."""
        remaining = deadline - time.monotonic()
        if remaining <= 0.0 or not self._selector.select(remaining):
            raise TimeoutError
        piece = os.read(self._descriptor, PIECE)
        self._held += piece
        return bool(piece)

    def _taken(self, size: int) -> bytes:
        taken = bytes(memoryview(self._held)[:size])
        del self._held[:size]
        return taken


CHILD = Path(__file__).with_name("parser_child.py")
MEMORY, MEMORY_PER_BYTE = 2_000_000_000, 8  # [bytes], and per byte of the file
SECONDS, BYTES_PER_SECOND = 8.0, 1_000_000  # of processor time, and more for large files
SILENCE = 10.0  # times as long on the clock, for slow disks and busy machines
START_SECONDS = 60.0  # for the libraries to be loaded
FINISH_SECONDS, MOST_SKIPPED = 0.5, 20  # of a job whose further answers nobody wants
PARQUET = "manip_learn.recordings.readers.lerobot_reader"
PARTS = ("recording", "rows")

Answer = tuple[dict[str, Any], dict[str, Any]]  # words, and arrays by name


def parsed_recordings(module: str, path: Path, request: ParserRequest) -> Iterator[Recording]:
    """The recordings that a parser finds, one after the other.

    Args:
        module: Has `read(path, request)`.
        path: File or folder.
        request: Options.

    Raises:
        RecordingError: The parser's own, or codes `parser-time`, `parser-crashed`.
        MissingExtraError: The parser's library is not installed.
    """
    job = {"module": module, "path": os.path.abspath(path), "request": request.as_words()}
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
    size = _bytes(path)
    seconds = SECONDS + size / BYTES_PER_SECOND
    known = command_flags()
    flags = None if known is None else sorted(known)
    child = _idle()
    try:
        yield from child.answers(
            path, {**job, "bytes": MEMORY + MEMORY_PER_BYTE * size, "seconds": seconds, "flags": flags}
        )
    finally:
        if child.is_free:
            _IDLE.append(child)
        else:
            child.close()


def _bytes(path: Path) -> int:
    if path.is_dir():
        return sum(inner.stat().st_size for inner in path.rglob("*") if inner.is_file())
    return path.stat().st_size


@final
class _Child:
    """One parsing process; serves many jobs until one of them kills it."""

    def __init__(self) -> None:
        self.owner = os.getpid()
        self.is_free = False
        self._is_new = True
        self._errors = tempfile.TemporaryFile()
        threads = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1")
        self._process = subprocess.Popen(
            [sys.executable, "-P", str(CHILD)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._errors,
            # Arrow's own allocators reserve far more addresses than they use
            env={**os.environ, **threads, "ARROW_DEFAULT_MEMORY_POOL": "system"},
        )
        if self._process.stdin is None or self._process.stdout is None:
            raise RecordingError("the process that parses recordings has no pipes", code="parser-crashed")
        self._stdin, self._stdout = self._process.stdin, self._process.stdout
        self._pipe = AnswerPipe(self._stdout.fileno())
        self._timed_out = False
        self._skipped = 0

    @property
    def is_alive(self) -> bool:
        """True if it runs and belongs to this process, not to one that this one was forked from."""
        return self._process.poll() is None and self.owner == os.getpid()

    def answers(self, path: Path, job: dict[str, Any]) -> Iterator[Answer]:
        """The lines and arrays that a job gives.

        Raises:
            RecordingError: What the parser refused, or codes `parser-time`, `parser-crashed`.
            MissingExtraError: The parser's library is not installed.
        """
        self.is_free = False
        self._skipped = 0
        try:
            if self._is_new:
                self._stdin.write(json.dumps([p or os.getcwd() for p in sys.path]).encode() + b"\n")
            self._stdin.write(json.dumps(job).encode() + b"\n")
            self._stdin.flush()
        except OSError as error:
            raise self._lost(path, job) from error
        patience = SILENCE * job["seconds"] + (START_SECONDS if self._is_new else 0.0)
        self._is_new = False
        while True:
            words, arrays = self._answer(path, job, patience)
            kind = words["kind"]
            if kind in PARTS:
                try:
                    yield words, arrays
                except GeneratorExit:
                    self._finish(path, job)
                    raise
                continue
            self.is_free = True
            if kind == "end":
                yield words, arrays
                return
            if kind == "missing":
                raise _rebuilt(words)
            told = Path(words["path"]) if words["path"] else None
            given = path if words["path"] == job["path"] else told
            raise RecordingError(
                words["message"], code=words["code"], path=given, line=words["line"], column=words["column"]
            )

    def _answer(self, path: Path, job: dict[str, Any], patience: float) -> Answer:
        deadline = time.monotonic() + patience
        try:
            line = self._pipe.line(deadline)
            if not line.endswith(b"\n"):
                raise self._lost(path, job)
            words = json.loads(line)
            arrays: dict[str, Any] = {}
            for name, shape in words.get("shapes", {}).items():
                content = self._pipe.content(8 * math.prod(shape), deadline)
                if len(content) < 8 * math.prod(shape):
                    raise self._lost(path, job)
                arrays[name] = np.frombuffer(content, dtype=np.float64).reshape(shape)
        except TimeoutError as error:
            self._timed_out = True
            self._process.kill()
            raise self._lost(path, job) from error
        return words, arrays

    def _finish(self, path: Path, job: dict[str, Any]) -> None:
        """Skip what the caller, who has refused a recording, does not want; a job that goes on is not waited for."""
        with contextlib.suppress(RecordingError):
            while self._answer(path, job, FINISH_SECONDS)[0]["kind"] in PARTS:
                self._skipped += 1
                if self._skipped > MOST_SKIPPED:
                    return
            self.is_free = True

    def _lost(self, path: Path, job: dict[str, Any]) -> RecordingError:
        code = self._process.wait()
        if self._timed_out or (os.name == "posix" and -code == signal.SIGXCPU):
            return RecordingError(
                f"{path.name}: reading it takes more than {job['seconds']:.0f} s of processor time, far more than a "
                "sound file of this size: it is damaged; copy or download it again",
                code="parser-time",
                path=path,
            )
        self._errors.seek(0)
        said = self._errors.read().decode(errors="replace").strip().splitlines()
        cause = reason(ValueError(said[-1] if said else f"exit code {code}"))
        return RecordingError(
            f"{path.name}: the library that reads it crashed ({cause}): the file is damaged; copy or download it again",
            code="parser-crashed",
            path=path,
        )

    def close(self) -> None:
        """End the process."""
        if self.owner == os.getpid():
            self._process.kill()
            self._process.wait()
        with contextlib.suppress(BrokenPipeError):
            self._stdin.close()
        self._pipe.close()
        self._stdout.close()
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
