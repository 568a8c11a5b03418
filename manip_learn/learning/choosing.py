"""Of many samples an even choice, made while recordings are read: nothing else of them is kept in memory.

Neighbours tell the same story, so samples are left out first, then recordings, then samples again: what is kept are
whole recordings in their order, each with every k-th of its samples. Where all fit they are kept as they were recorded.
Of 16,361 evenly chosen samples of fifty drawers half turn the answer by 0.0005 degrees, less than is stated of it.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, final

from manip_learn.errors import RecordingError, counted
from manip_learn.learning.cluster import each_part
from manip_learn.learning.explanation.row_motion import SCAN_RATE
from manip_learn.recordings.load import Progress, TrajectorySource
from manip_learn.recordings.options import Velocities, refuse_unmatched
from manip_learn.recordings.trajectory import Demonstrations, Trajectory
from manip_learn.recordings.velocities import with_velocities
from manip_learn.robot.robot import Robot

MOST_SAMPLES = 16_384  # that are learnt from; Phi of these, with 6 rows and 7 joints, takes 5.5 MB
FEWEST_RECORDINGS = 5  # that are kept of more, however long they are: evidence from fewer is thin
TOGETHER = 16  # recordings whose velocities are derived at a time: those with the same times share the work


@final
class Choice:
    """Recordings to learn from; grows by `add`, and by `merge` with what was chosen of later parts.

    Args:
        robot: Derives missing velocities; None if there is none.
        velocities: How.
        most: Number of samples that may be kept.

    Attributes:
        n_recordings, n_samples: Of all that were added.
        every, step: Every so many recordings are kept, and of each of them every so many samples.
        notes: Sentences of their readers.
    """

    def __init__(self, robot: Robot | None, velocities: Velocities, most: int = MOST_SAMPLES):
        self._robot, self._most = robot, most
        self._velocities: Velocities = velocities
        self.n_recordings = self.n_samples = 0
        self.every = self.step = 1
        self.notes: list[str] = []
        self._recorded: list[Trajectory] | None = []  # as they were, while all fit
        self._waiting: list[Trajectory] = []  # their velocities are derived together
        self._kept: list[Trajectory] = []  # with velocities
        self._derived = False

    def copy(self) -> Choice:
        """The same choice, which grows on its own."""
        other = Choice(self._robot, self._velocities, self._most)
        vars(other).update({name: [*x] if isinstance(x, list) else x for name, x in vars(self).items()})
        return other

    def add(self, recording: Trajectory) -> None:
        """One more recording.

        Raises:
            RecordingError: Velocities that can neither be found nor derived.
        """
        wanted = self.n_recordings % self.every == 0
        self.n_recordings += 1
        self.n_samples += len(recording)
        if self._recorded is not None and self.n_samples <= self._most:
            self._recorded.append(recording)
            return
        self.settle()
        self._recorded = None
        if wanted:
            self._waiting.append(recording)
            if len(self._waiting) == TOGETHER or sum(map(len, self._waiting)) > self._most:
                self._take()

    def add_all(self, recordings: Iterable[Trajectory], notes: Iterable[str] = ()) -> None:
        """More recordings, one after the other, and sentences about them."""
        self.notes += notes
        for recording in recordings:
            self.add(recording)

    def settle(self) -> None:
        """Derive the velocities of what is kept as it was recorded, so that more can be chosen from it."""
        if self._recorded is not None and len(self._kept) < len(self._recorded):
            self._kept = self._with_velocities(self._recorded)

    def merge(self, later: Choice) -> Choice:
        """This choice and that from the recordings after it, which is used up."""
        self.notes += later.notes
        self.n_recordings += later.n_recordings
        self.n_samples += later.n_samples
        self._derived |= later._derived
        if self._recorded is not None and later._recorded is not None and self.n_samples <= self._most:
            self._recorded, self._kept = self._recorded + later._recorded, self._kept + later._kept
            return self
        for choice in (self, later):
            choice.settle()
            choice._take()
        self._recorded = None
        while self.every != later.every:  # what falls: the doublings from the finer to the coarser, both powers of two
            coarse = self if self.every < later.every else later
            coarse._kept, coarse.every = coarse._kept[::2], 2 * coarse.every
        for choice in (self, later):
            stride = max(self.step, later.step) // choice.step
            choice._kept = [t.part(slice(None, None, stride)) for t in choice._kept] if stride > 1 else choice._kept
        self.step = max(self.step, later.step)
        self._kept += later._kept
        self._thin()
        return self

    def demonstrations(self) -> Demonstrations:
        """As they were recorded if all fit; else those chosen, with velocities.

        Raises:
            RecordingError: There are none.
        """
        if self._recorded is not None:
            return Demonstrations(self._recorded, dict.fromkeys(self.notes))
        self._take()
        notes = [*self.notes, "velocities were derived from the positions"] if self._derived else self.notes
        kept = Demonstrations(self._kept)
        chosen = (
            f"learnt from {counted(kept.n_samples, 'sample')} of {counted(len(kept), 'recording')}, chosen evenly out "
            f"of {self.n_samples:,} of {self.n_recordings:,}"
        )
        return Demonstrations(kept, dict.fromkeys([*notes, chosen]))

    def _take(self) -> None:
        """Choose from the recordings that wait."""
        made, self._waiting = self._with_velocities(self._waiting), []
        for t in made:
            self._kept.append(t.part(slice(None, None, self.step)) if self.step > 1 else t)
        self._thin()

    def _thin(self) -> None:
        """Leave out half of what is kept until the rest is few enough."""
        # what falls: the samples, of which fewer than ten recordings have more than one each where they are too many
        while sum(map(len, self._kept)) > self._most:
            seconds = sum(t.duration for t in self._kept)
            rate = sum(len(t) - 1 for t in self._kept) / max(seconds, 1e-9)
            # neighbours first, as long as enough are left to judge by when a constraint holds
            if 0.5 * rate < SCAN_RATE * (1.0 - 1e-6) and len(self._kept) >= 2 * FEWEST_RECORDINGS:
                self._kept, self.every = self._kept[::2], 2 * self.every
            else:
                self._kept, self.step = [t.part(slice(None, None, 2)) for t in self._kept], 2 * self.step

    def _with_velocities(self, recordings: list[Trajectory]) -> list[Trajectory]:
        missing = [t.name for t in recordings if t.u is None]
        if not recordings:
            return []
        if self._robot is None and missing:
            name = missing[0]
            raise RecordingError(
                f"{name} has no velocities: give features of a robot to derive them with", code="no-velocities"
            )
        moved = with_velocities(Demonstrations(recordings), self._robot, self._velocities)
        self._derived |= any(a is not b for a, b in zip(moved, recordings, strict=True))
        return list(moved)


def few_of(demonstrations: Demonstrations, most: int) -> tuple[Demonstrations, int]:
    """Demonstrations with velocities if they are few, else the choice from them; and every how many are kept."""
    if demonstrations.n_samples <= most:
        return demonstrations, 1
    choice = Choice(None, "auto", most)
    choice.add_all(demonstrations, demonstrations.notes)
    return choice.demonstrations(), choice.every


def choose_from(
    source: TrajectorySource, empty: Choice, client: Any = None, progress: Progress | None = None
) -> Choice:
    """The choice from a source, which is read once, each part beginning with an empty one; the same for any number of
    workers of a dask client, and for none.

    Raises:
        RecordingError: Recordings that cannot be used; or a setting that no part has a use for.
        ManipLearnError: Workers of a cluster die.
    """
    waiting: list[tuple[int, Choice]] = []  # (level, choice), levels falling
    settled = client is not None
    # in pairs, pairs of pairs and so on: as many recordings are left out of each, and only a few choices are in memory
    for choice in each_part(choice_of_part, source, client, progress, "reading", empty=empty, settled=settled):
        level = 0
        while waiting and waiting[-1][0] == level:  # what falls: the choices that wait
            choice = waiting.pop()[1].merge(choice)
            level += 1
        waiting.append((level, choice))
    whole = empty if not waiting else waiting.pop()[1]
    while waiting:  # what falls: the choices that wait
        whole = waiting.pop()[1].merge(whole)
    whole.notes = refuse_unmatched(whole.notes, source.n_parts)
    return whole


def choice_of_part(number: int, source: TrajectorySource, empty: Choice, settled: bool) -> Choice:
    """What is chosen from a part; `settled`: its velocities are derived where it is read, too."""
    choice = empty.copy()
    choice.add_all(source.part(number, choice.notes))
    if settled:
        choice.settle()
    return choice
