"""Time stamps: unit, order, repetitions and gaps."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Int

from manip_learn.errors import RecordingError, advice
from manip_learn.recordings.readers.read_request import SECONDS, ReadRequest
from manip_learn.recordings.readers.recording import GAP_FACTOR, Recording

BUNCHED = 0.02  # of the usual step
UNIT_WORDS = {"ms": "milliseconds", "us": "microseconds", "ns": "nanoseconds"}
# a stamp of the years 1973 to 5138 in each unit; seconds end where milliseconds begin
EPOCHS = (("ns", 1e17), ("us", 1e14), ("ms", 1e11))
# without recorded velocities: a step this long [s] with all joints this slow [rad/s] is no recording in seconds
LONG_STEP, SLOW = 1.0, 0.02


def time_in_seconds(recording: Recording, request: ReadRequest) -> Float[np.ndarray, " T"]:
    """Stamps in seconds.

    Raises:
        RecordingError: Fewer than two samples, or stamps that look like another unit.
    """
    time = recording.time
    if time.shape[0] < 2:
        rows = "1 row" if time.shape[0] == 1 else "no row"
        raise recording.refusal("too-short", f"there is {rows} of numbers, at least 2 are needed")
    if recording.in_seconds:
        return time
    if request.time_unit is not None:
        request.uses.use("time_unit")
        return time * SECONDS[request.time_unit]
    largest = float(np.max(np.abs(time)))
    unit = next((u for u, start in EPOCHS if largest > start), None)
    if unit is not None:
        raise unit_refusal(recording, unit, f"the stamps reach {largest:.6g}")
    return time


def doubt_slow_time(
    recording: Recording, request: ReadRequest, time: Float[np.ndarray, " T"], q: Float[np.ndarray, "T nv"]
) -> None:
    """Refuse stamps that look like milliseconds or less; for recordings without velocities.

    Raises:
        RecordingError: Steps of a second and more while all joints move very slowly.
    """
    if recording.in_seconds or request.time_unit is not None:
        return
    step = usual_step(np.diff(time))
    if step < LONG_STEP:
        return
    with np.errstate(over="ignore"):  # some stamps may differ by next to nothing
        speeds = np.abs(np.diff(q, axis=0)) / np.diff(time)[:, None]
    speed = float(np.max(np.percentile(speeds, 99, axis=0), initial=0.0))
    if 0.0 < speed < SLOW:
        unit = "ms" if step <= 1e3 else "us" if step <= 1e6 else "ns"
        raise unit_refusal(
            recording, unit, f"samples are {step:.6g} apart and no joint is faster than {speed:.2g} rad/s"
        )


def unit_refusal(recording: Recording, unit: str, evidence: str) -> RecordingError:
    """The refusal of stamps that are not in seconds."""
    return recording.refusal(
        "time-unit",
        f"time looks like {UNIT_WORDS[unit]}: {evidence}; seconds are needed: convert the column"
        + advice(", or pass {}", f"time_unit={unit!r}", f"--time-unit {unit}")
        + advice(" ({} if they are seconds)", "time_unit='s'", "--time-unit s"),
        column="time",
    )


def increasing(
    recording: Recording,
    time: Float[np.ndarray, " T"],
    q: Float[np.ndarray, "T nv"],
    u: Float[np.ndarray, "T nv"] | None,
) -> tuple[Bool[np.ndarray, " T"], list[str]]:
    """Samples to keep, so that time increases, and notes.

    Raises:
        RecordingError: Time goes back, or two different samples have one stamp.
    """
    steps = np.diff(time)
    back = np.flatnonzero(steps < 0)
    if back.size:
        i = int(back[0])
        more = f" (and {back.size - 1} more times)" if back.size > 1 else ""
        raise recording.refusal(
            "time-order",
            f"time goes back from {recording.time[i]:.9g} to {recording.time[i + 1]:.9g}{more}: sort the rows, or put "
            "recordings that were joined into files of their own",
            sample=i + 1,
            column="time",
        )
    keep = np.ones(time.shape[0], dtype=bool)
    repeated = np.flatnonzero(steps == 0)
    if not repeated.size:
        return keep, []
    same = np.all(q[repeated] == q[repeated + 1], axis=1)
    if u is not None:
        same &= np.all(u[repeated] == u[repeated + 1], axis=1)
    if not np.all(same):
        i = int(repeated[np.argmin(same)])
        raise recording.refusal(
            "duplicate-time",
            f"the stamp {recording.time[i + 1]:.9g} occurs twice with different positions "
            f"({recording.place(i)} and {recording.place(i + 1)}; {np.count_nonzero(~same)} such pairs): keep one",
            sample=i + 1,
            column="time",
        )
    keep[repeated + 1] = False
    return keep, [f"{repeated.size} repeated samples left out (first: {recording.place(int(repeated[0]) + 1)})"]


def pieces(time: Float[np.ndarray, " T"]) -> tuple[list[slice], Int[np.ndarray, " gaps"]]:
    """Runs of samples without a gap longer than ten times the median step, and the samples before each gap."""
    steps = np.diff(time)
    gaps = np.flatnonzero(steps > GAP_FACTOR * usual_step(steps))
    bounds = [0, *(int(g) + 1 for g in gaps), time.shape[0]]
    return [slice(a, b) for a, b in zip(bounds, bounds[1:], strict=False)], gaps


def usual_step(steps: Float[np.ndarray, " n"]) -> float:
    """Median of the steps between stamps [s]; for so short a question NumPy's own takes longer to start than to do."""
    ordered, half = np.sort(steps), len(steps) // 2
    return float(ordered[half] if len(steps) % 2 else 0.5 * (ordered[half - 1] + ordered[half]))


def bunched_note(time: Float[np.ndarray, " T"]) -> list[str]:
    """A sentence on samples that were stamped almost at once, as by a recorder that fell behind; velocities derived
    from them would be far too large.
    """
    steps = np.diff(time)
    usual = usual_step(steps)
    bunched = steps < BUNCHED * usual
    if not np.any(bunched):
        return []
    return [
        f"{np.count_nonzero(bunched)} steps between stamps are under {BUNCHED:.0%} of the usual {usual:.3g} s (the "
        f"smallest: {np.min(steps):.3g} s): the recorder fell behind, derived velocities will be inaccurate"
    ]
