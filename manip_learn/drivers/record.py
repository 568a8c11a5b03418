"""Record an arm that a person guides: samples go to the disk as they come, from motion to rest, file after file."""

from __future__ import annotations

import os
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from itertools import count
from pathlib import Path
from typing import Literal, NamedTuple, final

import numpy as np
from jaxtyping import Float

from manip_learn.atomic_write import has_no_room
from manip_learn.control.cycle import Clock, ComputerClock, OrderlyEnd, quiet_collector
from manip_learn.control.driver import Driver
from manip_learn.errors import ConfigurationError, OutputError, counted
from manip_learn.linalg import finite
from manip_learn.recordings.saved_motion import column_line
from manip_learn.recordings.trajectory import EFFORT_SUFFIX, VELOCITY_SUFFIX

LOOK = 0.5  # [s] before a motion begins that are recorded too: derivatives need samples on both sides
# [rad or m] within `LOOK` by which an arm moves that is guided: encoders and a hand that waits stay below a tenth of it
MOVES = 0.02
RESTS = 1.5  # [s] in which an arm whose motion is over does not move by that much: a person who thinks takes less
FLUSHED = 0.02  # [s] between two writes: what a killed program loses
SYNCED = 1.0  # [s] between two waits for the disk itself: what a power cut loses
SILENT = 1.0  # [s] without a posture after which recording ends
_PATIENCE = 0.5  # [s] in a period after which a signal gives up what the driver, or who is told of the sample, does
_JUMP, _FASTEST = 0.1, 20.0  # [rad or m], [rad/s or m/s] by which a joint is elsewhere that no hand has moved there
_LATE = 1.5  # periods from one sample to the next from which on one was lost
By = Literal["motion", "key"]
Key = Literal["", "start or stop", "end"]


@final
@dataclass(frozen=True)
class RecordedFiles:
    """What `record` did.

    Attributes:
        files: One per motion, in order.
        samples: Number of samples of all of them.
        lost: Number of periods in which no sample came while a motion was recorded.
        longest_gap: Between two samples of a motion [s].
        ended: Why it ended, a sentence.
        ordered: Whether it ended as it was meant to.
        notes: What else there is to know, in sentences.
        joint_names: Joints of the files' columns.
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
        """How much was recorded, and how much was lost."""
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
    shown: Callable[[Mapping[str, float], bool], object] | None = None,
    began: Callable[[Path | None], object] | None = None,
    clock: Clock | None = None,
) -> RecordedFiles:
    """Record motions of an arm that is guided by hand, a CSV file each: `NAME_01.csv`, `NAME_02.csv`, ...

    The arm is released first, where the driver can do that, and held where it is at the end, however recording ends. By
    motion, a file begins half a second before a joint moves, and ends when the arm has rested for 1.5 s. Nothing is
    overwritten: numbers go on where a folder has some. Each file is written as its samples come, so that a killed
    program loses 0.02 s of them, and a full disk the sample that it had no room for. `load_demonstrations` reads
    them. Ctrl-C, SIGTERM and SIGHUP end a recording in order; the last two then end the program as they end `run`.

    Args:
        driver: The arm; the last posture that it was sent to is where it is held until `release`. A simulated one needs
            `wait()`, in which a period passes.
        out: Folder; made if it is missing.
        name: What the files are called.
        by: What begins and ends a file: motion and rest, or the key.
        motions: Number of files after which recording ends; None for no such end.
        duration: Time after which it ends [s]; None for no such end. Ctrl-C ends it in any case.
        release: Whether the driver's `release` is called.
        key: Asked in each period: `"start or stop"`, `"end"` or nothing.
        shown: Told of each sample: joint positions by name [rad or m], and whether they are recorded.
        began: Told of the file that begins, and of None when it ends.
        clock: As for `run`.

    Returns:
        The files, and how many samples were lost.

    Raises:
        ConfigurationError: Neither the driver nor its readings name the joints; or a simulated driver without `wait`.
        OutputError: The folder cannot be made or written to, or the name leads out of it.
    """
    folder = Path(out).expanduser()
    if name in ("", "..") or Path(name).name != name or "\0" in name:
        raise OutputError(f"the name must be the beginning of a file name, without a folder, got {name!r}")
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"cannot make the folder {folder}: {error.strerror or error}; name another") from error
    if not os.access(folder, os.W_OK):
        raise OutputError(f"cannot write to the folder {folder}: name one that you may write to")
    if getattr(driver, "simulated", False) and getattr(driver, "wait", None) is None:
        raise ConfigurationError("a simulated driver needs wait(), in which a period passes without a command")
    clock = clock or ComputerClock()
    session = _Session(driver, folder, name, by, motions, shown, began)
    with OrderlyEnd(driver, session.end, _PATIENCE, clock) as ending:
        try:
            with ending.waiting():
                session.released(release)
            with quiet_collector():
                session.run(np.inf if duration is None else duration, key or (lambda: ""), ending, clock)
        except KeyboardInterrupt:  # in the driver or in who is told of samples
            session.end("Ctrl-C")
        finally:
            session.finish()
    return session.record(ending.failed)


class _Sample(NamedTuple):
    """One reading; joints in the order of the file."""

    time: float
    q: Float[np.ndarray, " n"]
    u: Float[np.ndarray, " n"] | None
    effort: Float[np.ndarray, " n"] | None


@final
class _Session:
    """The state of a recording: waiting for a motion, or writing one down."""

    def __init__(
        self,
        driver: Driver,
        folder: Path,
        name: str,
        by: str,
        motions: int | None,
        shown: Callable[[Mapping[str, float], bool], object] | None,
        began: Callable[[Path | None], object] | None,
    ):
        self._driver, self._folder, self._name, self._by, self._motions = driver, folder, name, by, motions
        self._shown, self._began = shown or (lambda _q, _recorded: None), began or (lambda _file: None)
        given = getattr(driver, "joint_names", None)
        self._names: tuple[str, ...] | None = None if given is None else tuple(given)
        self._before: deque[_Sample] = deque()  # the last seconds, whether they are recorded or not
        self._file: _GrowingFile | None = None
        self._files: list[Path] = []
        # the newest and when it came [s], and one since then that no arm can have gone to unless the next is there too
        self._good: tuple[_Sample, float] | None = None
        self._doubted: tuple[_Sample, float] | None = None
        self._written = 0.0  # when a sample was last written down [s]
        self._samples = self._lost = 0
        self._gap = 0.0
        self._notes: list[str] = []
        self._ended, self._ordered = "", True

    def released(self, wanted: bool) -> None:
        """Let a person guide the arm, where the driver can do that."""
        let_go = getattr(self._driver, "release", None)
        if not wanted or let_go is None:
            return
        try:
            let_go()
        except ConfigurationError as error:
            self._notes.append(str(error))

    def end(self, reason: str, ordered: bool = True) -> None:
        """No more samples; the first reason counts."""
        if not self._ended:
            self._ended, self._ordered = reason, ordered

    def run(self, duration: float, key: Callable[[], Key], ending: OrderlyEnd, clock: Clock) -> None:
        """Until there is a reason to end."""
        driver, period = self._driver, self._driver.period
        simulated = bool(getattr(driver, "simulated", False))
        start = due = clock.now()
        heard = 0.0
        for k in count():
            t = k * period if simulated else clock.now() - start
            with ending.waiting():
                sample = self._read(t)
                now = t if simulated else clock.now() - start  # reading may have taken long
                heard = heard if sample is None else now
                if now - heard > SILENT:
                    self.end(f"the driver has given no posture for {SILENT:g} s", False)
                pressed = key()
                if pressed == "end":
                    self.end("ended by key")
                if t >= duration:
                    self.end(f"the {duration:g} s were over")
                for one in self._believed(sample, now):
                    self._take(one, pressed == "start or stop")
                    pressed = ""
                if simulated and not self._ended:
                    driver.wait()  # type: ignore[attr-defined]
            if self._ended:
                return
            if not simulated:
                due = max(due + period, clock.now())  # a period that was missed is not made up for
                clock.wait_until(due)

    def _read(self, t: float) -> _Sample | None:
        """A reading at a time [s]; None where it is no posture."""
        try:
            q, u, effort = self._driver.read()
        except Exception as error:  # whatever a driver raises, the files are kept and the arm is held
            self.end(f"the driver's read() failed: {type(error).__name__}: {error}", False)
            return None
        if q is None:
            return None
        if isinstance(q, Mapping) and self._names is None:
            self._names = tuple(q)
        if self._names is None:
            raise ConfigurationError("the driver names no joints: give it joint_names, or read() a mapping from names")
        columns, names = [], self._names
        for values in (q, u, effort):  # None where there are none, or some are not finite
            values = [values.get(name, np.nan) for name in names] if isinstance(values, Mapping) else values  # noqa: PLW2901
            columns.append(finite(values, len(names)))
        return None if columns[0] is None else _Sample(t, *columns)

    def _believed(self, sample: _Sample | None, now: float) -> list[_Sample]:
        """A sample that came at a time [s]: at once, or with the next one where no arm can have gone there so fast."""
        if sample is None:
            return []
        doubted, self._doubted = self._doubted, None
        follows = doubted is not None and _reachable(doubted, sample, now)
        if self._good is None or follows or _reachable(self._good, sample, now):
            self._good = sample, now
            return [doubted[0], sample] if doubted is not None and follows else [sample]
        self._doubted = sample, now
        return []

    def _take(self, sample: _Sample, pressed: bool) -> None:
        """Begin, go on with or end a file: it is complete by key, after a rest, or where it has no room."""
        before, file = self._before, self._file
        before.append(sample)
        while before[-1].time - before[0].time > RESTS:
            before.popleft()
        if file is not None:
            self._write(sample)
            rested = sample.time - before[0].time > RESTS - _LATE * self._driver.period and not self._moved(RESTS)
            if file.error is not None or (pressed if self._by == "key" else rested):
                self.finish()
        elif pressed if self._by == "key" else self._moved(LOOK):
            self._begin([s for s in before if sample.time - s.time <= LOOK])
        self._shown(dict(zip(self._names or (), sample.q.tolist(), strict=True)), file is not None)

    def _moved(self, within: float) -> bool:
        """Whether a joint has moved in a time before now [s]."""
        now = self._before[-1]
        return any(
            float(np.max(np.abs(s.q - now.q), initial=0.0)) > MOVES for s in self._before if now.time - s.time <= within
        )

    def _begin(self, first: list[_Sample]) -> None:
        names, sample = self._names or (), first[-1]
        groups = {"time": ["time"], "q": list(names)}
        for what, values, suffix in (("u", sample.u, VELOCITY_SUFFIX), ("effort", sample.effort, EFFORT_SUFFIX)):
            if values is not None:
                groups[what] = [name + suffix for name in names]
        try:
            self._file = _GrowingFile(self._folder, self._name, column_line(groups) + "\n")
        except OSError as error:
            self.end(f"cannot write to {self._folder}: {error.strerror or error}", False)
            return
        self._with_velocities, self._with_efforts = sample.u is not None, sample.effort is not None
        self._files.append(self._file.path)
        self._began(self._file.path)
        self._written = first[0].time
        for one in first:
            self._write(one)

    def _write(self, sample: _Sample) -> None:
        wanted = [sample.q, *([sample.u] * self._with_velocities), *([sample.effort] * self._with_efforts)]
        if self._file is None or any(values is None for values in wanted):
            self._lost += 1
            return
        gap, period = sample.time - self._written, self._driver.period
        self._gap = max(self._gap, gap)
        self._lost += round(gap / period) - 1 if gap > _LATE * period else 0
        numbers = np.concatenate([[sample.time], *(values for values in wanted if values is not None)])
        self._file.add(",".join(map(repr, numbers.tolist())) + "\n")
        self._samples, self._written = self._samples + 1, sample.time

    def finish(self) -> None:
        """The file is complete."""
        if self._file is None:
            return
        self._file.close()
        if self._file.error is not None:
            self.end(f"{self._file.error}; the samples before are kept in {self._file.path}", False)
        self._file = None
        self._before.clear()  # a motion begins anew
        self._began(None)
        if self._motions is not None and len(self._files) >= self._motions:
            self.end(f"{counted(self._motions, 'motion')} recorded")

    def record(self, failed: str) -> RecordedFiles:
        """The files and numbers so far, and what went wrong when the arm was to hold itself."""
        self._notes += [failed] if failed else []
        numbers = self._samples, self._lost, self._gap
        return RecordedFiles(
            tuple(self._files), *numbers, self._ended, self._ordered, tuple(self._notes), self._names or ()
        )


def _reachable(earlier: tuple[_Sample, float], sample: _Sample, now: float) -> bool:
    """Whether an arm can have gone from an earlier sample, which came at a time [s], to one that comes now."""
    far = float(np.max(np.abs(sample.q - earlier[0].q), initial=0.0))
    return far <= _JUMP + _FASTEST * (now - earlier[1])


@final
class _GrowingFile:
    """Lines that a thread of its own appends to a new file, whole lines only.

    Attributes:
        path: The file.
        error: What went wrong, in words; None so far.

    Raises:
        OSError: It cannot be made.
    """

    def __init__(self, folder: Path, name: str, header: str):
        for number in count(1):
            self.path = folder / f"{name}_{number:02d}.csv"
            try:
                self._file = os.open(self.path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o666)
            except FileExistsError:
                continue
            break
        self.error: str | None = None
        self._waiting: deque[str] = deque([header])
        self._whole, self._closing = 0, threading.Event()  # bytes of whole lines
        self._thread = threading.Thread(target=self._feed, name="recording", daemon=True)
        self._thread.start()

    def add(self, line: str) -> None:
        """A line with its end; returns at once."""
        self._waiting.append(line)

    def close(self) -> None:
        """Write the lines that wait."""
        self._closing.set()
        self._thread.join()

    def _feed(self) -> None:
        synced = time.monotonic()
        try:
            while True:
                last = self._closing.wait(FLUSHED)
                lines = [self._waiting.popleft() for _ in range(len(self._waiting))]
                content, done, begun = "".join(lines).encode(), 0, self._whole
                while done < len(content):
                    done += os.write(self._file, content[done:])
                    self._whole = begun + content.rfind(b"\n", 0, done) + 1
                if last or time.monotonic() - synced > SYNCED:
                    os.fsync(self._file)
                    synced = time.monotonic()
                if last:
                    return
        except OSError as error:
            why = f"cannot write: {error.strerror or error}"
            self.error = "the disk is full, make room" if has_no_room(error) else why
            os.ftruncate(self._file, self._whole)
        finally:
            os.close(self._file)
