"""Checks of a recorded motion: time stamps, limits, and two publishers on one topic."""

from __future__ import annotations

from dataclasses import dataclass
from typing import final

import numpy as np
from jaxtyping import Bool, Float, Int

from manip_learn.errors import advice, counted
from manip_learn.recordings.clock import GAP_FACTOR, usual_step
from manip_learn.recordings.readers.read_request import SECONDS_OF, UNIT_WORDS, ReadRequest
from manip_learn.recordings.readers.recording import Recording
from manip_learn.recordings.trajectory import evenly
from manip_learn.recordings.validation.joint_matching import angular_coordinates, object_coordinates
from manip_learn.robot import Robot

# a stamp of the years 1973 to 5138 in each unit; seconds end where milliseconds begin
EPOCHS = (("ns", 1e17), ("us", 1e14), ("ms", 1e11))
SLOW, LONG = 0.02, 1.0  # [rad/s], [s]: no arm is shown a motion so slowly with a sample so seldom
_NOTABLE = 1e-6  # [rad or m] beyond a limit
FAR_ANGLE, FAR_LENGTH = 0.1, 0.05  # [rad], [m]: a few degrees are calibration, more is another fault
_FAST = 3.0  # times the velocity limit
# the share by which velocities in rad/s and positions in degrees may miss the ratio of their units, and the least
# squared correlation of what they say, over all joints
UNIT_OFF, _ALIKE = 0.2, 0.8
# of two motions in turn: samples within which each is heard again, the fewest jumps between them, and the least size of
# a jump [rad or m], which quanta of a coarse encoder on all joints together do not reach
LAGS, FEWEST_JUMPS, SMALLEST = 20, 10, 0.1
_PARTS = 32  # of a motion, in which positions and the integral of velocities are compared
SELDOM = 0.05  # of the samples, at most, are failed reads; a second publisher's are more


@final
@dataclass(frozen=True, eq=False)
class MotionInFile:
    """A recorded motion in the robot's joints and in SI units, and where it comes from.

    Attributes:
        recording: As it stands in the file, for the places in messages.
        request: How it is read.
        time: shape (T,), increasing [s].
        q: shape (T, nv) [rad or m].
    """

    recording: Recording
    request: ReadRequest
    time: Float[np.ndarray, " T"]
    q: Float[np.ndarray, "T nv"]

    @property
    def robot(self) -> Robot:
        """Whose joints they are."""
        return self.request.robot

    @property
    def angular(self) -> Bool[np.ndarray, " nv"]:
        """True for angles, False for lengths."""
        return angular_coordinates(self.robot)


def time_in_seconds(
    recording: Recording, request: ReadRequest, q: Float[np.ndarray, "T nv"], u: Float[np.ndarray, "T nv"] | None
) -> tuple[Float[np.ndarray, " T"], list[str]]:
    """Times [s] of positions [rad or m], and a note if they are not the stamps of the file.

    Stamps that count from 1970 say their unit by their size, others by how slowly the arm would move.
    """
    time = recording.time
    if request.rate is not None:
        counted_time = request.counted(len(time))
        same = np.allclose(time, counted_time, rtol=1e-9, atol=0.0)  # the reader has asked for the rate itself
        note = f"the time stamps are overruled: {request.rate:g} samples per second, as asked"
        return counted_time, [] if same else [note]
    if recording.in_seconds:
        return time, []
    if request.time_unit is not None:
        request.uses.use("time_unit")
        return time * SECONDS_OF[request.time_unit], []
    largest = float(np.max(np.abs(time)))
    unit, evidence = next((u for u, start in EPOCHS if largest > start), None), f"the stamps reach {largest:.6g}"
    steps = np.abs(np.diff(time))
    step = usual_step(steps)
    if unit is None and step >= LONG:
        with np.errstate(over="ignore", divide="ignore", invalid="ignore"):  # stamps may differ by next to nothing
            speed = float(np.nanmax(np.percentile(np.abs(np.diff(q, axis=0)) / steps[:, None], 99, axis=0)))
        believed = u is not None and np.percentile(np.abs(np.nan_to_num(u)), 99) < _FAST * SLOW and np.any(u)
        if 0.0 < speed < SLOW and not believed:
            unit = "ms" if step <= 1e3 else "us" if step <= 1e6 else "ns"
            evidence = f"samples are {step:.6g} apart and no joint would be faster than {speed:.2g} rad/s"
    if unit is None:
        return time, []
    how = advice(" ({} if they are seconds)", "time_unit='s'", "--time-unit s")
    return time * SECONDS_OF[unit], [f"the time stamps were read as {UNIT_WORDS[unit]}, for {evidence}{how}"]


def check_motion(motion: MotionInFile, u: Float[np.ndarray, "T nv"] | None) -> list[str]:
    """Return notes on a motion; one that no arm can have made is refused, be it in a file of the library's own.

    Args:
        motion: The motion.
        u: Its recorded velocities [rad/s or m/s]; None where there are none, or none are used.
    """
    _refuse_two_publishers(motion)
    robot, recording, angular, q = motion.robot, motion.recording, motion.angular, motion.q
    beyond = _excess(robot, q)
    far = beyond > np.where(angular, FAR_ANGLE, FAR_LENGTH)
    notes = _fast_notes(robot, motion.time, q)
    if motion.request.units is None and not recording.trusted:
        _refuse_degrees(motion, far, bool(notes))
    if motion.request.outside_limits == "refuse":
        if recording.trusted:  # what was simulated from outside the limits only comes back
            far &= (beyond > _excess(robot, q[:1]) + _NOTABLE) | (_excess(robot, q[-1:]) >= beyond)
        if np.any(far):
            _refuse_far(motion, int(np.argmax(np.where(far, beyond, 0.0))))
        _refuse_jump(motion)
    if recording.trusted and u is not None:
        _refuse_contradiction(motion, u)
    slight = np.flatnonzero(beyond > _NOTABLE)
    if slight.size:
        worst = int(np.argmax(beyond))
        notes.append(
            f"beyond their limits: {counted(slight.size, 'joint')}, {robot.joint_names[worst]!r} the farthest: by "
            f"{beyond[worst]:.3g} {'rad' if angular[worst] else 'm'}"
        )
    return notes


def _refuse_jump(motion: MotionInFile) -> None:
    """Refuse a joint that goes faster from one sample to the next than ten times its limit, and far."""
    robot, q, trusted = motion.robot, motion.q, motion.recording.trusted
    change, steps = np.abs(np.diff(q, axis=0)), np.diff(motion.time)
    limit = np.where(np.isfinite(robot.velocity_limit), 10 * robot.velocity_limit, 50.0)
    # other recordings have gaps, and lengths in other units
    least = np.where(motion.angular, FAR_ANGLE if trusted else np.pi / 2, FAR_LENGTH if trusted else np.inf)
    # a rotation vector may jump where its rotation does not, close to a full turn
    jump = ~object_coordinates(robot) & (change > least) & (change > limit * steps[:, None])
    if np.any(jump):
        sample, i = (int(k) for k in np.argwhere(jump)[0])
        turn = abs(change[sample, i] - 2 * np.pi) < 0.5
        cause = "it wraps around a full turn, which this limited joint cannot" if turn else "a faulty sample?"
        text = (
            f"the joint jumps from {q[sample, i]:.4g} to {q[sample + 1, i]:.4g} {robot.joint_units[i]} within "
            f"{steps[sample]:.3g} s, its limit is {robot.velocity_limit[i]:.3g} {robot.joint_units[i]}/s: {cause} "
            "Correct the file (a real break in the recording: put the parts into files of their own)"
        )
        raise motion.recording.refusal("jump", text, sample=sample + 1, column=robot.joint_names[i])


def _refuse_contradiction(motion: MotionInFile, u: Float[np.ndarray, "T nv"]) -> None:
    """Refuse velocities that say another motion than the positions: what they say is farther off than half of it.

    A measured arm lags behind the velocities that are commanded, which is allowed for, and goes by itself where none
    are, which is left out.
    """
    robot, steps = motion.robot, np.diff(motion.time)[:, None]
    went, said = np.diff(motion.q, axis=0), 0.5 * (u[1:] + u[:-1]) * steps
    told = (steps <= GAP_FACTOR * usual_step(steps[:, 0])) & np.any(said != 0.0, axis=1, keepdims=True)
    ways = np.cumsum(np.where(told, [went, said], 0.0), axis=1)
    apart = np.abs(ways[0] - ways[1])
    parts = np.diff(ways[:, evenly(len(said), _PARTS)], axis=1, prepend=0.0)
    off, most = np.sum((parts[0] - parts[1]) ** 2, axis=0), np.max(np.sum(parts**2, axis=1), axis=0)
    # of what has several coordinates a velocity is no derivative of them
    single = np.array([len(b.coordinate_names) == 1 for b in robot.blocks for _ in b.coordinate_names])
    wrong = single & (off > 0.5 * most) & (apart.max(axis=0) > 2.0 * motion.recording.lag)
    if np.any(wrong):
        i = int(np.argmax(np.where(wrong, apart.max(axis=0), 0.0)))
        k, unit = int(np.argmax(apart[:, i])), robot.joint_units[i]
        text = f"after {motion.time[k + 1] - motion.time[0]:.3g} s the joint has moved by {ways[0, k, i]:.3g} {unit}, "
        text += f"its velocities say {ways[1, k, i]:.3g} {unit}: the file was damaged or changed; make it again"
        text += advice(", or pass {} if the positions are right", "velocities='derive'", "--velocities derive")
        raise motion.recording.refusal("contradiction", text, sample=k + 1, column=robot.joint_names[i])


def refuse_degrees_beside(motion: MotionInFile, u: Float[np.ndarray, "T nv"]) -> None:
    """Refuse positions that move by as many degrees as their recorded velocities say in radians."""
    if motion.request.units is not None or motion.request.velocities != "auto":
        return
    steps = np.diff(motion.q, axis=0)[:, motion.angular]
    said = (0.5 * (u[1:] + u[:-1]) * np.diff(motion.time)[:, None])[:, motion.angular]
    with np.errstate(all="ignore"):  # velocities that are not numbers, or have none, say nothing
        both, own, other = np.sum(steps * said), np.sum(steps**2), np.sum(said**2)
        alike = abs(np.degrees(both / own) - 1.0) < UNIT_OFF and both**2 > _ALIKE * own * other
    if alike:
        python, flag = "velocities='derive'", "--velocities derive"
        text = f"positions look like degrees: the recorded velocities are {both / own:.3g} of their speed, in radians "
        text += f"1; {advice('pass {}, or ', 'degrees=True', '--degrees')}convert the position columns to radians"
        raise motion.recording.refusal("degrees", text + advice("; {} if they are", python, flag))


def _excess(robot: Robot, q: Float[np.ndarray, "T nv"]) -> Float[np.ndarray, " nv"]:
    """How far each joint gets beyond its limits [rad or m]; 0 within."""
    below, above = robot.position_lower - q.min(axis=0), q.max(axis=0) - robot.position_upper
    return np.maximum(np.maximum(below, above), 0.0)


def _refuse_degrees(motion: MotionInFile, far: Bool[np.ndarray, " nv"], fast: bool) -> None:
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


def far_outside(robot: Robot, q: Float[np.ndarray, " nv"]) -> str:
    """How far a posture is outside the limits, in words, and what it may be; nothing where no joint is far outside."""
    beyond, angular = _excess(robot, q[None]), angular_coordinates(robot)
    far = beyond > np.where(angular, FAR_ANGLE, FAR_LENGTH)
    if not np.any(far):
        return ""
    i = int(np.argmax(beyond))
    limits = f"[{robot.position_lower[i]:.4g}, {robot.position_upper[i]:.4g}] {robot.joint_units[i]}"
    guess = _other_guess(robot, q[None, i], i) or "another unit or order of the joints, or another robot?"
    if np.any(far & angular) and not np.any(_excess(robot, np.where(angular, np.radians(q), q)[None]) > FAR_LENGTH):
        guess = "in degrees? It is to be in radians"
    return f"joint {robot.joint_names[i]} was read at {q[i]:.4g}, its limits are {limits}: {guess}"


def _refuse_far(motion: MotionInFile, i: int) -> None:
    robot, q = motion.robot, motion.q
    lower, upper = robot.position_lower[i], robot.position_upper[i]
    outside = np.maximum(lower - q[:, i], q[:, i] - upper)
    sample = int(np.argmax(outside))
    ordered = "the wrong order in joint_names?" if motion.request.joint_names else None
    otherwise = ordered or "wrong units, columns with the wrong names, or another robot?"
    guess = _other_guess(robot, q[:, i], i) or otherwise
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
    typical = np.percentile(speed, 95, axis=0)
    fast = typical > _FAST * robot.velocity_limit
    if not np.any(fast):
        return []
    i = int(np.argmax(np.where(fast, typical / robot.velocity_limit, 0.0)))
    return [
        f"joint {robot.joint_names[i]!r} moves at {typical[i]:.3g}, its limit is {robot.velocity_limit[i]:.3g}: "
        "check the unit of time"
    ]


def _refuse_two_publishers(motion: MotionInFile) -> None:
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


def failed_reads(q: Float[np.ndarray, "T nv"]) -> Int[np.ndarray, " k"]:
    """Samples that repeat one posture to the last bit, each far from those before and after: what a driver publishes
    when it could not read its motors, e.g. -pi of every joint.
    """
    size = np.linalg.norm(np.diff(q, axis=0), axis=1)
    if np.count_nonzero(size > SMALLEST) < 4:  # of two such samples; most recordings
        return np.empty(0, dtype=int)
    far = size > max(6.0 * float(np.quantile(size, 0.9)), SMALLEST)
    postures, often = np.unique(q[1:][far], axis=0, return_counts=True)
    same = np.all(q == postures[np.argmax(often)], axis=1) if len(postures) else np.zeros(len(q), dtype=bool)
    is_seldom = 1 < np.count_nonzero(same) < SELDOM * len(q)
    return np.flatnonzero(same & is_seldom & np.all(far[np.flatnonzero(np.diff(same))]))


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
