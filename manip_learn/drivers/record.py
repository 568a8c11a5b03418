"""Recording of an arm that a person guides by hand: one file per motion, written while the arm moves."""

from __future__ import annotations

import math
import os
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from itertools import count
from pathlib import Path
from typing import Literal, NamedTuple, final

import numpy as np
from jaxtyping import Float

from manip_learn.atomic_write import check_folder, has_no_room
from manip_learn.control.driver import Clock, ComputerClock, Driver, Pace, Shutdown
from manip_learn.errors import ConfigurationError, OutputError, counted
from manip_learn.linalg import finite
from manip_learn.recordings.saved_motion import column_line
from manip_learn.recordings.trajectory import EFFORT_SUFFIX, VELOCITY_SUFFIX

LOOK = 0.5  # [s] recorded before a motion begins: derivatives need samples on both sides
# [rad or m] motion within `LOOK` of a guided arm: encoder noise and a waiting hand stay below a tenth of it
MOVES = 0.02
RESTS = 1.5  # [s] of rest, without motion by `MOVES`, that end a motion: a hesitating person takes less
_LATE = 1.5  # periods between two samples from which on a sample counts as lost
By = Literal["motion", "key"]
Key = Literal["", "start or stop", "end"]
Shown = Callable[[Mapping[str, float], bool], object]
Began = Callable[[Path | None], object]


@final
@dataclass(frozen=True)
class RecordedFiles:
    """Outcome of `record`.

    Attributes:
        files: Recorded files, one per motion, in order.
        samples: Total number of samples.
        lost: Number of periods without a sample during a motion.
        longest_gap: Longest time between two samples of a motion [s].
        ended: Reason why recording ended, a sentence.
        ordered: True if recording ended as intended.
        notes: Further remarks, in sentences.
        joint_names: Names of the joints in the files.
    """

    files: tuple[Path, ...]
    samples: int
    lost: int
    longest_gap: float
    ended: str
    ordered: bool
    notes: tuple[str, ...] = ()
    joint_names: tuple[str, ...] = ()

    @property
    def sentence(self) -> str:
        """Sentence with the numbers of recorded and lost samples."""
        gap = f", {1e3 * self.longest_gap:.3g} ms at most between two" if self.files else ""
        lost = counted(self.lost, "sample") if self.lost else "none"
        return (
            f"{counted(len(self.files), 'motion')}, {counted(self.samples, 'sample')}, {lost} lost{gap}; {self.ended}"
        )

    def __repr__(self) -> str:
        return f"RecordedFiles({self.sentence})"


def record(
    driver: Driver,
    out: str | os.PathLike[str],
    name: str = "demo",
    *,
    by: By = "motion",
    motions: int | None = None,
    duration: float | None = None,
    release: bool = True,
    key: Callable[[], Key] | None = None,
    shown: Shown | None = None,
    began: Began | None = None,
    clock: Clock | None = None,
) -> RecordedFiles:
    """Record motions of an arm that is guided by hand, one CSV file per motion: `NAME_01.csv`, `NAME_02.csv`, ...

    At the start the arm is released if the driver has `release`; at the end it is held at its position, also after an
    error. With `by="motion"` a file begins half a second before a joint moves, and ends when the arm has rested for
    1.5 s. No file is overwritten: the numbers continue after those of existing files. Samples are written immediately:
    a killed program loses 0.02 s of samples, and a full disk only the sample that did not fit. `load_demonstrations`
    reads the files. Ctrl-C, SIGTERM and SIGHUP end a recording properly; SIGTERM and SIGHUP then end the program as
    they do in `run`.

    Args:
        driver: Driver of the arm, see `Driver`, which holds its last commanded posture until `release`. A simulated
            driver needs `wait()`, which lets a period pass.
        out: Folder of the files; it is created if it does not exist.
        name: Beginning of the file names.
        by: `"motion"`: a file begins when the arm moves and ends when it rests; `"key"`: `key` begins and ends it.
        motions: Number of files after which recording ends; None for no limit.
        duration: Time after which recording ends [s]; None for no limit. Ctrl-C ends it in any case.
        release: True to call the driver's `release`; False leaves the arm as it is.
        key: Function that is called in each period, and returns `"start or stop"` to begin or end a file, `"end"` to
            end recording, or an empty text. None for no such function; with `by="key"` no file then begins.
        shown: Function that is called with each sample: joint positions by name [rad or m], and True if they are
            recorded. None for no such function.
        began: Function that is called with the path of a file when it begins, and with None when it ends. None for no
            such function.
        clock: Source of the time; None for the computer's clock (see `run`).

    Returns:
        The files, the number of lost samples, and the reason for the end.

    Raises:
        ConfigurationError: Neither the driver nor its readings name the joints; or a simulated driver has no `wait`.
        OutputError: The folder cannot be created or written to, or `name` leads to another folder.
    """
    folder = Path(out).expanduser()
    if name in ("", "..") or Path(name).name != name or "\0" in name:
        raise OutputError(f"the name must be the beginning of a file name, without a folder, got {name!r}")
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"cannot create the folder {folder}: {error.strerror or error}; choose another") from error
    check_folder(folder / name)
    if getattr(driver, "simulated", False) and getattr(driver, "wait", None) is None:
        raise ConfigurationError("a simulated driver needs wait(), in which a period passes without a command")
    clock = clock or ComputerClock()
    patience = 0.5  # [s] in a period after which a signal interrupts the driver or a callback
    ending = Shutdown(driver, lambda: None, patience, clock)
    session = _Session(driver, ending, partial(_GrowingFile, folder, name), by, motions)
    with ending:
        try:
            with ending.waiting("release"):
                session.release_arm(release)
            hooks = key or (lambda: ""), shown or (lambda _q, _recorded: None), began or (lambda _file: None)
            session.run(math.inf if duration is None else duration, Pace(driver, clock), *hooks)
        except KeyboardInterrupt:  # in the driver or in a callback
            ending.stop("Ctrl-C", True)
        finally:
            session.finish()
    return session.record()


class _Sample(NamedTuple):
    """One reading; joints in the order of the file."""

    time: float
    q: Float[np.ndarray, " n"]
    u: Float[np.ndarray, " n"] | None
    effort: Float[np.ndarray, " n"] | None

    def is_near(self, later: _Sample) -> bool:
        """Return True if an arm can move from this sample to a later one in the time between them.

        Args:
            later: The later sample.
        """
        jump, fastest = 0.1, 20.0  # [rad or m], [rad/s or m/s] of a hand that moves a joint
        far = float(np.max(np.abs(later.q - self.q), initial=0.0))
        return far <= jump + fastest * (later.time - self.time)


@final
class _Session:
    """The state of a recording: waiting for a motion, or writing one down."""

    def __init__(
        self, driver: Driver, ending: Shutdown, opened: Callable[[str], _GrowingFile], by: By, motions: int | None
    ):
        self._driver, self._ending, self._opened, self._by, self._motions = driver, ending, opened, by, motions
        self._names: tuple[str, ...] = tuple(getattr(driver, "joint_names", None) or ())
        self._parts: list[str] = []  # parts of a sample that are columns of the file
        self._before: list[_Sample] = []  # the last seconds, recorded or not
        self._file: _GrowingFile | None = None
        self._files: list[Path] = []
        # the newest sample, and a later one that is out of reach unless the next sample confirms it
        self._good: _Sample | None = None
        self._doubted: _Sample | None = None
        self._written = self._gap = 0.0  # [s] time of the last sample that was written, and the longest gap
        self._samples = self._lost = 0
        self._notes: list[str] = []

    def release_arm(self, wanted: bool) -> None:
        """Call the driver's `release`, if it has one, so that a person can guide the arm.

        Args:
            wanted: False to leave the arm as it is.
        """
        try:
            if wanted and (release := getattr(self._driver, "release", None)) is not None:
                release()
        except ConfigurationError as error:
            self._notes.append(str(error))

    def run(self, duration: float, pace: Pace, key: Callable[[], Key], shown: Shown, began: Began) -> None:
        """Run until there is a reason to end.

        Args:
            duration: Time after which recording ends [s].
            pace: Timing of the periods.
            key: See `record`.
            shown: See `record`.
            began: See `record`.
        """
        self._shown, self._began, ending, heard = shown, began, self._ending, 0.0
        silent = 1.0  # [s] without a posture after which recording ends
        while not ending.reason:
            t = pace.wait()
            with ending.waiting("read"):
                sample = self._read(t)
                heard = heard if sample is None else pace.time  # reading may have taken long
                if pace.time - heard > silent:
                    ending.stop(f"the driver has returned no posture for {silent:g} s")
                pressed = key()
                if pressed == "end":
                    ending.stop("ended by key", True)
                if t >= duration:
                    ending.stop(f"the {duration:g} s were over", True)
                for one in self._plausible(sample):
                    self._take(one, pressed == "start or stop")
                    pressed = ""
                if pace.simulated and not ending.reason:
                    self._driver.wait()  # type: ignore[attr-defined]
            pace.cycles += 1

    def _read(self, t: float) -> _Sample | None:
        """Read a sample at a time [s]; None without a posture."""
        try:
            q, u, effort = self._driver.read()
        except Exception as error:  # after any error of a driver, the files are kept and the arm is held
            self._ending.stop(f"the driver's read() failed: {type(error).__name__}: {error}")
            return None
        if q is None:
            return None
        names = self._names = self._names or (tuple(q) if isinstance(q, Mapping) else ())
        if not names:
            raise ConfigurationError("the driver names no joints: set its joint_names, or let read() return mappings")
        parts = ([x.get(name, np.nan) for name in names] if isinstance(x, Mapping) else x for x in (q, u, effort))
        x, *others = (finite(part, len(names)) for part in parts)  # None if missing or not finite
        return None if x is None else _Sample(t, x, *others)

    def _plausible(self, sample: _Sample | None) -> list[_Sample]:
        """Return a plausible sample, with a doubtful one before it that it confirms; none for a doubtful sample."""
        if sample is None:
            return []
        before = [self._doubted] if self._doubted is not None and self._doubted.is_near(sample) else []
        is_plausible = bool(before) or self._good is None or self._good.is_near(sample)
        self._good, self._doubted = (sample, None) if is_plausible else (self._good, sample)
        return [*before, sample] if is_plausible else []

    def _take(self, sample: _Sample, pressed: bool) -> None:
        """Begin, continue or complete a file: it is complete by key, after a rest, or when the disk is full."""
        self._before = before = [s for s in (*self._before, sample) if sample.time - s.time <= RESTS]
        file = self._file
        if file is not None:
            self._write(sample)
            rested = sample.time - before[0].time > RESTS - _LATE * self._driver.period and not self._moved(RESTS)
            if file.error is not None or (pressed if self._by == "key" else rested):
                self.finish()
        elif pressed if self._by == "key" else self._moved(LOOK):
            self._begin([s for s in before if sample.time - s.time <= LOOK])
        self._shown(dict(zip(self._names, sample.q.tolist(), strict=True)), file is not None)

    def _moved(self, within: float) -> bool:
        """Return True if a joint has moved within the last seconds [s]."""
        now = self._before[-1]
        recent = np.array([s.q for s in self._before if now.time - s.time <= within])
        return bool(np.any(np.abs(recent - now.q) > MOVES))

    def _begin(self, first: list[_Sample]) -> None:
        """Open a file, and write the samples before."""
        suffixes = {"q": "", "u": VELOCITY_SUFFIX, "effort": EFFORT_SUFFIX}
        self._parts = [part for part in suffixes if getattr(first[-1], part) is not None]
        columns = {part: [name + suffixes[part] for name in self._names] for part in self._parts}
        try:
            self._file = self._opened(column_line({"time": ["time"]} | columns) + "\n")
        except OSError as error:
            self._ending.stop(f"cannot write to {error.filename}: {error.strerror or error}")
            return
        self._files.append(self._file.path)
        self._began(self._file.path)
        self._written = first[0].time
        for one in first:
            self._write(one)

    def _write(self, sample: _Sample) -> None:
        """Write a sample, or count it as lost."""
        values = [getattr(sample, part) for part in self._parts]
        if self._file is None or any(part is None for part in values):
            self._lost += 1
            return
        gap, period = sample.time - self._written, self._driver.period
        self._gap = max(self._gap, gap)
        self._lost += round(gap / period) - 1 if gap > _LATE * period else 0
        self._file.add(",".join(map(repr, np.concatenate([[sample.time], *values]).tolist())) + "\n")
        self._samples, self._written = self._samples + 1, sample.time

    def finish(self) -> None:
        """Complete the present file, if there is one."""
        if (file := self._file) is None:
            return
        file.close()
        if file.error is not None:
            self._ending.stop(f"{file.error}; the samples before are kept in {file.path}")
        self._file, self._before = None, []  # the next motion begins with new samples
        self._began(None)
        if self._motions is not None and len(self._files) >= self._motions:
            self._ending.stop(f"{counted(self._motions, 'motion')} recorded", True)

    def record(self) -> RecordedFiles:
        """Return the outcome, with a note if the arm could not be held."""
        ending, numbers = self._ending, (self._samples, self._lost, self._gap)
        notes = (*self._notes, *(words for call, words in ending.failed.items() if call == "hold"))
        return RecordedFiles(tuple(self._files), *numbers, ending.reason, ending.ordered, notes, self._names)


@final
class _GrowingFile:
    """A new file to which a thread appends lines, whole lines only.

    Attributes:
        path: The file.
        error: Error of writing, in words; None without one.

    Raises:
        OSError: It cannot be created.
    """

    def __init__(self, folder: Path, name: str, header: str):
        for number in count(1):
            self.path = folder / f"{name}_{number:02d}.csv"
            with suppress(FileExistsError):
                self._file = self.path.open("xb", buffering=0)
                break
        self.error: str | None = None
        self._waiting, self._closing = deque([header]), threading.Event()
        self._thread = threading.Thread(target=self._feed, name="recording", daemon=True)
        self._thread.start()

    def add(self, line: str) -> None:
        """Add a line without waiting for the disk.

        Args:
            line: The line with its end.
        """
        self._waiting.append(line)

    def close(self) -> None:
        """Write the pending lines and end the thread."""
        self._closing.set()
        self._thread.join()

    def _feed(self) -> None:
        """Write pending lines until the file is closed; after an error, cut the file to whole lines."""
        # [s] between two writes, lost by a killed program; [s] between two syncs of the disk, lost by a power cut
        write_period, sync_period = 0.02, 1.0
        synced, whole, is_last = time.monotonic(), 0, False  # whole: bytes of whole lines
        with self._file as file:
            try:
                while not is_last:
                    is_last = self._closing.wait(write_period)
                    lines = [self._waiting.popleft() for _ in range(len(self._waiting))]
                    content, n_written, begun = "".join(lines).encode(), 0, whole
                    while n_written < len(content):
                        n_written += file.write(content[n_written:])
                        whole = begun + content.rfind(b"\n", 0, n_written) + 1
                    if is_last or time.monotonic() - synced > sync_period:
                        os.fsync(file)
                        synced = time.monotonic()
            except OSError as error:
                why = f"cannot write: {error.strerror or error}"
                self.error = "the disk is full, make room" if has_no_room(error) else why
                file.truncate(whole)
