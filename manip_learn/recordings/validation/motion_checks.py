"""Checks of a recorded motion: time stamps, limits, recorded velocities, and two publishers on one topic."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import final

import numpy as np
from jaxtyping import Bool, Float, Int

from manip_learn.errors import RecordingError, advice, counted, named
from manip_learn.recordings.readers.read_request import SECONDS, UNIT_WORDS, ReadRequest
from manip_learn.recordings.readers.recording import GAP_FACTOR, Recording
from manip_learn.recordings.validation.joint_matching import angular_coordinates, object_coordinates
from manip_learn.robot import Robot

# a stamp of the years 1973 to 5138 in each unit; seconds end where milliseconds begin
EPOCHS = (("ns", 1e17), ("us", 1e14), ("ms", 1e11))
NOTABLE = 1e-6  # [rad or m] beyond a limit
FAR_ANGLE, FAR_LENGTH = 0.1, 0.05  # [rad], [m]: a few degrees are calibration, more is another fault
FAST = 3.0  # times the velocity limit
MOVED = 0.02  # [rad or m] a joint must move to be judged by its velocities
SURE, UNSURE, OTHER_JOINT = 0.9, 0.5, 0.98  # correlations of displacements and integrated velocities
FEWEST = 8  # samples whose velocities are judged
# of two motions in turn: samples within which each is heard again, the fewest jumps between them, and the least size of
# a jump [rad or m], which quanta of a coarse encoder on all joints together do not reach
LAGS, FEWEST_JUMPS, SMALLEST = 20, 10, 0.1


@final
@dataclass(frozen=True, eq=False)
class Motion:
    """A recorded motion in the robot's joints and in SI units, and where it comes from.

    Attributes:
        recording: As it stands in the file, for the places in messages.
        request: How it is read.
        time: shape (T,), increasing [s].
        q: shape (T, nv) [rad or m].
        u: shape (T, nv) [rad/s or m/s], or None.
    """

    recording: Recording
    request: ReadRequest
    time: Float[np.ndarray, " T"]
    q: Float[np.ndarray, "T nv"]
    u: Float[np.ndarray, "T nv"] | None

    @property
    def robot(self) -> Robot:
        """Whose joints they are."""
        return self.request.robot

    @property
    def angular(self) -> Bool[np.ndarray, " nv"]:
        """True for angles, False for lengths."""
        return angular_coordinates(self.robot)


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
        raise _unit_refusal(recording, unit, f"the stamps reach {largest:.6g}")
    return time


def check_motion(motion: Motion) -> list[str]:
    """Notes on a motion."""
    _refuse_two_publishers(motion)
    _refuse_slow_time(motion)
    return [*_check_velocities(motion), *_check_limits(motion)]


def _refuse_slow_time(motion: Motion) -> None:
    """Refuse steps of a second and more while all joints move very slowly, where no velocities were recorded."""
    if motion.u is not None or motion.recording.in_seconds or motion.request.time_unit is not None:
        return
    step = usual_step(np.diff(motion.time))
    if step < 1.0:  # [s]
        return
    with np.errstate(over="ignore"):  # some stamps may differ by next to nothing
        speeds = np.abs(np.diff(motion.q, axis=0)) / np.diff(motion.time)[:, None]
    speed = float(np.max(np.percentile(speeds, 99, axis=0), initial=0.0))
    if 0.0 < speed < 0.02:  # [rad/s]
        unit = "ms" if step <= 1e3 else "us" if step <= 1e6 else "ns"
        evidence = f"samples are {step:.6g} apart and no joint is faster than {speed:.2g} rad/s"
        raise _unit_refusal(motion.recording, unit, evidence)


def _unit_refusal(recording: Recording, unit: str, evidence: str) -> RecordingError:
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
        text = (
            f"time goes back from {recording.time[i]:.9g} to {recording.time[i + 1]:.9g}{more}: sort the rows, or put "
            "recordings that were joined into files of their own"
        )
        raise recording.refusal("time-order", text, sample=i + 1, column="time")
    keep = np.ones(time.shape[0], dtype=bool)
    repeated = np.flatnonzero(steps == 0)
    if not repeated.size:
        return keep, []
    same = np.all(q[repeated] == q[repeated + 1], axis=1)
    if u is not None:
        same &= np.all(u[repeated] == u[repeated + 1], axis=1)
    if not np.all(same):
        i = int(repeated[np.argmin(same)])
        text = (
            f"the stamp {recording.time[i + 1]:.9g} occurs twice with different positions "
            f"({recording.place(i)} and {recording.place(i + 1)}; {np.count_nonzero(~same)} such pairs): keep one"
        )
        raise recording.refusal("duplicate-time", text, sample=i + 1, column="time")
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
    """A sentence on samples that were stamped almost at once, as by a recorder that fell behind: velocities derived
    from them would be far too large.
    """
    steps = np.diff(time)
    usual = usual_step(steps)
    share = 0.02  # of the usual step
    bunched = steps < share * usual
    if not np.any(bunched):
        return []
    return [
        f"{np.count_nonzero(bunched)} steps between stamps are under {share:.0%} of the usual {usual:.3g} s (the "
        f"smallest: {np.min(steps):.3g} s): the recorder fell behind, derived velocities will be inaccurate"
    ]


def _excess(robot: Robot, q: Float[np.ndarray, "T nv"]) -> Float[np.ndarray, " nv"]:
    """How far each joint gets beyond its limits [rad or m]; 0 within."""
    below, above = robot.position_lower - q.min(axis=0), q.max(axis=0) - robot.position_upper
    return np.maximum(np.maximum(below, above), 0.0)


def _check_limits(motion: Motion) -> list[str]:
    """Notes on positions slightly outside the limits and odd speeds; degrees, far positions and jumps are refused."""
    robot, recording, angular = motion.robot, motion.recording, motion.angular
    beyond = _excess(robot, motion.q)
    far = beyond > np.where(angular, FAR_ANGLE, FAR_LENGTH)
    notes = _fast_notes(robot, motion.time, motion.q)
    if motion.request.units is None and not recording.trusted:
        _refuse_degrees(motion, far, bool(notes))
    refuses = motion.request.outside_limits == "refuse" and not recording.trusted
    if np.any(far) and refuses:
        _refuse_far(motion, int(np.argmax(np.where(far, beyond, 0.0))))
    slight = np.flatnonzero(beyond > NOTABLE)
    if slight.size:
        worst = int(np.argmax(beyond))
        notes.append(
            f"beyond their limits: {counted(slight.size, 'joint')}, {robot.joint_names[worst]!r} the farthest: by "
            f"{beyond[worst]:.3g} {'rad' if angular[worst] else 'm'}"
        )
    if refuses:
        _refuse_jumps(motion)
    return notes


def _refuse_degrees(motion: Motion, far: Bool[np.ndarray, " nv"], fast: bool) -> None:
    robot, angular, q = motion.robot, motion.angular, motion.q
    largest = np.abs(q).max(axis=0)
    unlimited = angular & ~np.isfinite(robot.position_lower) & ~np.isfinite(robot.position_upper)
    turning = unlimited & (largest > 4 * np.pi) & fast
    beyond = far & angular & (largest > 2 * np.pi)
    if not np.any(beyond | turning):
        return
    # one faulty sample, a sign or a full turn is another fault
    mostly = np.mean((q < robot.position_lower) | (q > robot.position_upper), axis=0) > 0.3
    other = np.array([_other_guess(robot, q[:, i], i) is not None for i in range(robot.nv)])
    suspects = (beyond & mostly & ~other) | turning
    if not np.any(suspects) or np.any(_excess(robot, np.radians(q))[suspects] > FAR_ANGLE):
        return
    i = int(np.argmax(np.where(suspects, largest, 0.0)))
    sample = int(np.argmax(np.abs(q[:, i])))
    whole_file = 2 * np.count_nonzero(largest[angular] > np.pi) >= np.count_nonzero(angular)
    fix = "convert this column to radians"
    if whole_file:
        fix = advice("pass {}, or ", "degrees=True", "--degrees") + "convert the file to radians"
    text = (
        f"positions look like degrees: {q[sample, i]:.6g} where the limits are [{robot.position_lower[i]:.4g}, "
        f"{robot.position_upper[i]:.4g}] rad; {fix}"
    )
    raise motion.recording.refusal("degrees", text, sample=sample, column=robot.joint_names[i])


def _other_guess(robot: Robot, q: Float[np.ndarray, " T"], i: int) -> str | None:
    """What would bring all positions of joint i back inside its limits, other than a unit."""
    lower, upper = robot.position_lower[i], robot.position_upper[i]
    if np.all((-q >= lower) & (-q <= upper)):
        return "a wrong sign?"
    if any(np.all((q + turn >= lower) & (q + turn <= upper)) for turn in (-2 * np.pi, 2 * np.pi)):
        return "a full turn too much?"
    return None


def _refuse_far(motion: Motion, i: int) -> None:
    robot, q = motion.robot, motion.q
    lower, upper = robot.position_lower[i], robot.position_upper[i]
    outside = np.maximum(lower - q[:, i], q[:, i] - upper)
    sample = int(np.argmax(outside))
    guess = _other_guess(robot, q[:, i], i)
    if guess is None and motion.request.joint_names:
        guess = "the wrong order in joint_names?"
    guess = guess or "wrong units, columns with the wrong names, or another robot?"
    if np.all(outside > 0) and "another robot" not in guess:
        guess += " Or another robot?"
    raise motion.recording.refusal(
        "outside-limits",
        f"{q[sample, i]:.6g} is outside the limits [{lower:.4g}, {upper:.4g}] of robot {robot.name!r} at "
        f"{np.count_nonzero(outside > 0)} of {counted(q.shape[0], 'sample')}: "
        f"{guess} Correct the file"
        + advice(", or pass {} if it is right", "outside_limits='note'", "--outside-limits note"),
        sample=sample,
        column=robot.joint_names[i],
    )


def _fast_notes(robot: Robot, time: Float[np.ndarray, " T"], q: Float[np.ndarray, "T nv"]) -> list[str]:
    width = int(np.clip(time.shape[0] // 20, 1, 10))
    with np.errstate(over="ignore"):  # stamps may differ by next to nothing
        speed = np.abs(q[width:] - q[:-width]) / (time[width:] - time[:-width])[:, None]
    if np.all(speed.max(axis=0) <= FAST * robot.velocity_limit):
        return []
    typical = np.percentile(speed, 95, axis=0)
    fast = typical > FAST * robot.velocity_limit
    if not np.any(fast):
        return []
    i = int(np.argmax(np.where(fast, typical / robot.velocity_limit, 0.0)))
    return [
        f"joint {robot.joint_names[i]!r} moves at {typical[i]:.3g}, its limit is {robot.velocity_limit[i]:.3g}: "
        "check the unit of time"
    ]


def _refuse_jumps(motion: Motion) -> None:
    robot, q = motion.robot, motion.q
    change, steps = np.abs(np.diff(q, axis=0)), np.diff(motion.time)
    limit = np.where(np.isfinite(robot.velocity_limit), 10 * robot.velocity_limit, 50.0)
    # a rotation vector may jump where its rotation does not, close to a full turn
    jump = motion.angular & ~object_coordinates(robot) & (change > np.pi / 2) & (change > limit * steps[:, None])
    if np.any(jump):
        sample, i = (int(k) for k in np.argwhere(jump)[0])
        turn = abs(change[sample, i] - 2 * np.pi) < 0.5
        cause = "it wraps around a full turn, which this limited joint cannot" if turn else "a faulty sample?"
        text = (
            f"the joint jumps from {q[sample, i]:.4g} to {q[sample + 1, i]:.4g} rad within {steps[sample]:.3g} s: "
            f"{cause} "
            "Correct the file (a real break in the recording: put the parts into files of their own)"
        )
        raise motion.recording.refusal("jump", text, sample=sample + 1, column=robot.joint_names[i])


@final
@dataclass(frozen=True, eq=False)
class VelocityMatch:
    """How displacements follow from the recorded velocities.

    Attributes:
        slope: shape (nv,), displacement over integrated velocity: 1 is right, 57.3 degrees, 1e-3
            milliseconds, -1 a sign.
        correlation: shape (nv, nv), of the displacement of joint i with the integrated velocity of joint j.
        moved: shape (nv,), joints that moved enough to be judged.
    """

    slope: Float[np.ndarray, " nv"]
    correlation: Float[np.ndarray, "nv nv"]
    moved: Bool[np.ndarray, " nv"]


def compare_velocities(
    time: Float[np.ndarray, " T"], q: Float[np.ndarray, "T nv"], u: Float[np.ndarray, "T nv"]
) -> VelocityMatch:
    """Displacements over short windows against velocities integrated over the same windows.

    Windows, not single steps: jitter of the stamps and encoder noise spoil dq/dt from one sample to the next.
    """
    steps = np.diff(time)
    width = int(np.clip(time.shape[0] // 20, 1, 50))
    travel = np.vstack([np.zeros(u.shape[1]), np.cumsum(0.5 * (u[1:] + u[:-1]) * steps[:, None], axis=0)])
    gaps = np.concatenate([[0], np.cumsum(steps > GAP_FACTOR * usual_step(steps))])
    whole = gaps[width:] == gaps[:-width]
    dq = (q[width:] - q[:-width])[whole]
    du = (travel[width:] - travel[:-width])[whole]
    q_size, u_size = np.linalg.norm(dq, axis=0), np.linalg.norm(du, axis=0)
    with np.errstate(divide="ignore", invalid="ignore"):
        correlation = np.nan_to_num((dq.T @ du) / np.outer(q_size, u_size), nan=0.0, posinf=0.0, neginf=0.0)
        slope = np.sign(np.diag(correlation)) * np.where(u_size > 0, q_size / u_size, 0.0)
    return VelocityMatch(slope, correlation, np.ptp(q, axis=0) > MOVED)


def _check_velocities(motion: Motion) -> list[str]:
    """Notes on recorded velocities that do not follow the positions; a fault that can be named is refused: degrees,
    milliseconds, a sign, another joint's velocity, a scale.
    """
    if motion.u is None or len(motion.time) < FEWEST or motion.recording.trusted:
        return []
    names, notes = motion.robot.joint_names, []
    scales: dict[str, float] = {}
    match = compare_velocities(motion.time, motion.q, motion.u)
    for i, name in enumerate(names):
        if not match.moved[i]:
            continue
        own = float(match.correlation[i, i])
        if abs(own) >= SURE:
            _refuse_slope(motion.recording, name, bool(motion.angular[i]), float(match.slope[i]))
            if not _near(float(match.slope[i]), 1.0):
                scales[name] = 1.0 / float(match.slope[i])
            continue
        j = _follower(match, i)
        if j is not None:
            raise motion.recording.refusal(
                "velocity-order",
                f"the velocity does not follow this joint (correlation {own:.2f}) but that recorded for "
                f"{names[j]!r} does ({match.correlation[i, j]:.2f}): the columns are in the wrong order",
                column=name,
            )
        if abs(own) < UNSURE:
            notes.append(f"the recorded velocity of {name!r} does not follow its position (correlation {own:.2f})")
    if scales:
        farthest = max(scales.values(), key=lambda scale: abs(math.log(scale)))
        notes.append(
            f"recorded velocities are {farthest:.2g} times the rate at which the positions change "
            f"({named('joint', scales)}): check their units, or the clock; they are used as they are"
        )
    return notes


def _follower(match: VelocityMatch, i: int) -> int | None:
    """Another joint whose recorded velocity is clearly that of joint i; it must not match its own joint either."""
    size = np.abs(match.correlation)
    lost = ~(match.moved & (np.diag(size) >= SURE))
    lost[i] = False
    j = int(np.argmax(np.where(lost, size[i], 0.0)))
    return j if lost[j] and size[i, j] > OTHER_JOINT else None


def _refuse_slope(recording: Recording, name: str, angular: bool, slope: float) -> None:
    size = abs(slope)
    if 0.5 <= size <= 2.0:
        if slope < 0:
            raise recording.refusal(
                "sign",
                f"the recorded velocity has the wrong sign: slope {slope:.3g} between dq/dt and it, 1 is right; turn "
                "the sign of the velocity, or leave all velocity columns out",
                column=name,
            )
        return
    evidence = f"slope {slope:.3g} between dq/dt and the recorded velocity of {name!r}, 1 is right"
    unit = next((u for u in UNIT_WORDS if _near(size, SECONDS[u])), None)
    code = "degrees"
    if angular and _near(size, math.degrees(1.0)):
        text = f"positions look like degrees: {evidence}; radians are needed: convert the position columns"
        both = " ({} is for files whose positions and velocities are both in degrees)"
        text += advice(both, "degrees=True", "--degrees")
    elif angular and _near(size, math.radians(1.0)):
        text = (
            f"velocities look like degrees per second: {evidence}; rad/s are needed: convert the velocity columns or "
        )
        text += "leave them out"
    elif unit is not None:
        raise _unit_refusal(recording, unit, evidence)
    else:
        code, text = "velocity-scale", f"recorded velocities and positions have different scales: {evidence}; "
        text += "correct the units of one of them, or leave the velocity columns out"
    raise recording.refusal(code, text, column=name)


def _near(value: float, expected: float) -> bool:
    return 1 / 1.25 < value / expected < 1.25


def _refuse_two_publishers(motion: Motion) -> None:
    """Refuse positions that alternate, regularly or not, between two motions."""
    jumps, usual = alternation(motion.q)
    if motion.recording.trusted or not jumps.size:
        return
    by_joint = np.median(np.abs(motion.q[jumps + 1] - motion.q[jumps]), axis=0)
    joint = int(np.argmax(by_joint))
    name = motion.robot.joint_names[joint]
    raise motion.recording.refusal(
        "two-publishers",
        f"the samples alternate between two motions: {jumps.size} steps jump to and fro, joint {name!r} by about "
        f"{by_joint[joint]:.3g}, while samples that belong together are {usual:.2g} apart. Two programs published on "
        "one topic (a robot and a GUI?): end one of them (`ros2 topic info -v`, `rostopic info` list them) and record "
        "again",
        sample=int(jumps[0]) + 1,
        column=name,
    )


def alternation(q: Float[np.ndarray, "T nv"]) -> tuple[Int[np.ndarray, " k"], float]:
    """Jumps to and fro between two smooth motions.

    A sample is close to one of the samples before it, its own publisher's last one. Where a step is clearly longer than
    that, the publisher has changed; the next such step must lead back. Noise does not do so: its steps differ in size.

    Returns:
        The samples before the jumps, none of a single motion; and how far samples that belong together are apart, which
        nine of ten do not exceed [rad or m].
    """
    none = np.empty(0, dtype=int)
    steps = np.diff(q, axis=0)
    size = np.linalg.norm(steps, axis=1)
    if np.count_nonzero(size > SMALLEST) < FEWEST_JUMPS:  # most recordings
        return none, 0.0
    nearest = size**2
    for lag in range(2, LAGS + 1):
        np.minimum(nearest[lag - 1 :], np.sum((q[lag:] - q[:-lag]) ** 2, axis=1), out=nearest[lag - 1 :])
    usual = float(np.quantile(np.sqrt(nearest), 0.9))
    jumps = np.flatnonzero(size > max(6.0 * usual, SMALLEST))
    if jumps.size < FEWEST_JUMPS:
        return none, usual
    left = np.linalg.norm(steps[jumps[:-1]] + steps[jumps[1:]], axis=1)  # of a jump, once the next one has led back
    leads_back = left < 0.45 * np.maximum(size[jumps[:-1]], size[jumps[1:]])
    return (jumps if np.mean(leads_back) >= 0.9 else none), usual
