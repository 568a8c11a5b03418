"""Even subsampling of large sets while recordings are read, here or by workers of dask.

Neighbours tell the same story, so they are left out first: every second sample of each recording, every fourth, and so
on. Where that would leave too few samples a second to see phases, recordings are left out. What is chosen depends on
all recordings together, and on nothing else: not on the order or the parts in which they are read, nor on who reads.
Using half of 16,361 samples of fifty drawers turns the answer by 0.0005 degrees, less than its uncertainty.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import CancelledError
from contextlib import AbstractContextManager, nullcontext
from typing import Any, NamedTuple, final
from zlib import crc32

import numpy as np

from manip_learn.errors import ManipLearnError, MissingExtraError, counted
from manip_learn.learning.table import SCAN_RATE
from manip_learn.recordings.load import Progress, Reader
from manip_learn.recordings.options import refuse_unmatched
from manip_learn.recordings.trajectory import Demonstrations, Trajectory

MOST_SAMPLES = 20_000  # that are learnt from; Phi of these, with 6 rows and 7 joints, takes 6.7 MB
FEWEST_RECORDINGS = 20  # that are kept of more, however long they are: evidence from fewer is thin
STEPS = 2 ** np.arange(40)  # every so many samples are kept
PATIENCE = "10s"  # for a scheduler that is elsewhere


class Kept(NamedTuple):
    """Recording of which every `step`-th sample is kept; at its coarsest every `coarsest`-th."""

    motion: Trajectory
    number: int
    coarsest: int
    rank: int  # recordings of the lowest are kept: a hash of the postures, as good as drawn by lot
    step: int = 1


@final
class EvenChoice:
    """Even choice of the samples of some files, which grows by `merge`; unchanged while all fit.

    Args:
        most: Number of samples that are chosen at most.
        derive: Gives recordings velocities, before samples are left out.
        part: Reader of recordings; None for an empty choice.

    Attributes:
        kept: Recordings with the samples kept of each.
        n_recordings: Number of all recordings.
        notes: Remarks of their readers.

    Raises:
        RecordingError: Recordings that cannot be used, velocities that cannot be derived.
    """

    def __init__(self, most: int, derive: Callable[[Demonstrations], Demonstrations], part: Reader | None = None):
        self._most, self._derive, self._held = most, derive, 0
        self.kept, self.notes, self.n_recordings = list[Kept](), list[str](), 0
        self._totals = np.zeros(len(STEPS), dtype=np.int64)  # samples that each step would leave of all recordings
        for t in () if part is None else part(self.notes):
            # stamps are rounded; a recording keeps enough samples for phases, but no more than its share
            rate, share = (len(t) - 1) / max(t.duration, 1e-9) * (1.0 + 1e-6), self._most / FEWEST_RECORDINGS
            coarsest = int(STEPS[(rate / STEPS >= SCAN_RATE) | (2 * len(t) / STEPS > share)].max(initial=1))
            self.kept.append(Kept(t, self.n_recordings, coarsest, crc32(t.q.data)))
            self._totals += -(-len(t) // np.minimum(STEPS, coarsest))
            self._held += len(t)
            self.n_recordings += 1
            if self._held > 2 * most:
                self._thin()
        self._thin()

    def merge(self, later: EvenChoice) -> None:
        """Add the recordings of another choice, which is not changed."""
        self._totals += later._totals
        self.kept += later.kept
        self.n_recordings += later.n_recordings
        self.notes += later.notes
        self._thin()

    def _thin(self) -> None:
        """Leave out samples, and whole recordings if necessary, until the rest is small enough."""
        steps, kept = STEPS[self._totals <= self._most], self.kept
        if not steps.size:
            order = np.argsort([k.rank for k in kept], kind="stable")
            fit = np.cumsum([-(-len(kept[i].motion) * kept[i].step // kept[i].coarsest) for i in order]) <= self._most
            kept = [kept[i] for i in np.sort(order[fit])]
        for i, k in enumerate(kept):
            step = min(k.coarsest, int(steps.min(initial=STEPS[-1])))
            if step > k.step:
                motion = k.motion if k.step > 1 else self._derive(Demonstrations([k.motion]))[0]
                kept[i] = k._replace(motion=motion.part(slice(None, None, step // k.step)), step=step)
        self.kept, self._held = kept, sum(len(k.motion) for k in kept)

    @property
    def demonstrations(self) -> Demonstrations:
        """Chosen recordings; unchanged if all fit.

        Raises:
            RecordingError: There are none.
        """
        chosen, notes = Demonstrations(k.motion for k in self.kept), dict.fromkeys(self.notes)
        if self._held < self._totals[0]:
            kept = f"{counted(self._held, 'sample')} of {counted(len(chosen), 'recording')}"
            notes[f"learnt from {kept}, chosen evenly out of {self._totals[0]:,} of {self.n_recordings:,}"] = None
        return Demonstrations(chosen, notes)


def read_evenly(choose: Callable[..., Any], parts: list[Reader], client: Any, progress: Progress | None) -> EvenChoice:
    """Return the choice from parts, each read once; it does not depend on the number of workers.

    Raises:
        RecordingError: Recordings that cannot be used; or a setting that no part has a use for.
        ManipLearnError: Workers die again and again, or their scheduler does.
    """
    whole: EvenChoice = choose()
    for choice in each_part(choose, parts, client, progress):
        whole.merge(choice)
    whole.notes = refuse_unmatched(whole.notes, len(parts))
    return whole


def each_part(work: Callable[..., Any], parts: list[Reader], client: Any, progress: Progress | None) -> Iterator[Any]:
    """Yield work(part) of each part, in order; by the workers of a client if there are several parts.

    Raises:
        ManipLearnError: Workers die again and again, or their scheduler does.
    """
    futures, died = list[Any](), tuple[type[Exception], ...]()
    if client is not None and len(parts) > 1:
        from dask.distributed import KilledWorker

        futures, died = client.map(work, parts, pure=False), (KilledWorker, CancelledError)
    for done, part in enumerate(parts, 1):
        try:
            result = futures.pop(0).result() if futures else work(part)  # what was fetched is held by no worker
        except died as error:
            raise ManipLearnError(f"dask's workers died ({error}): is there enough memory for each?") from error
        yield result
        if progress is not None:
            progress("reading", done / len(parts))


def dask_client(address: str | None, n_workers: int | None = None) -> AbstractContextManager[Any]:
    """Connect to a scheduler, or start a cluster on this machine that nobody else can reach.

    Args:
        address: `"local"`, or the address of a scheduler, e.g. `"tcp://10.0.0.1:8786"`; None for no client.
        n_workers: Number of workers of a local cluster, processes with one thread; one per processor by default.

    Returns:
        Context manager of the client, or of None.

    Raises:
        ManipLearnError: Nobody answers at the address.
        MissingExtraError: dask is not installed.
    """
    if address is None:
        return nullcontext()
    try:
        from dask.distributed import Client
    except ImportError as error:
        raise MissingExtraError("learning on a dask cluster", "dask") from error
    # by default all networks see the dashboard
    here: dict[str, Any] = {"n_workers": n_workers, "threads_per_worker": 1, "dashboard_address": "127.0.0.1:0"}
    try:
        return Client(timeout=PATIENCE, **(here if address == "local" else dict[str, Any](address=address)))
    except (OSError, ValueError, TypeError, AssertionError, ImportError, RuntimeError) as error:
        text = f"there is no dask scheduler at {address!r} ({error}): start one with `dask scheduler`, or use 'local'"
        raise ManipLearnError(text) from error
