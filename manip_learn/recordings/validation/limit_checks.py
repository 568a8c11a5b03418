"""Positions against the joint limits: units, turns, signs and jumps."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float

from manip_learn.errors import advice, counted
from manip_learn.recordings.readers.read_request import ReadRequest
from manip_learn.recordings.readers.recording import Recording
from manip_learn.recordings.validation.object_poses import object_coordinates
from manip_learn.robot import Robot

NOTABLE = 1e-6  # [rad or m] beyond a limit
FAR_ANGLE, FAR_LENGTH = 0.1, 0.05  # [rad], [m]: a few degrees are calibration, more is another fault
MANY_TURNS = 4 * np.pi  # [rad] for joints without limits
FAST = 3.0  # times the velocity limit
JUMP = np.pi / 2  # [rad] in one step
MOSTLY = 0.3  # of the samples


def excess(robot: Robot, q: Float[np.ndarray, "T nv"]) -> Float[np.ndarray, " nv"]:
    """How far each joint gets beyond its limits [rad or m]; 0 within."""
    below, above = robot.position_lower - q.min(axis=0), q.max(axis=0) - robot.position_upper
    return np.maximum(np.maximum(below, above), 0.0)


def check_limits(
    recording: Recording,
    request: ReadRequest,
    angular: Bool[np.ndarray, " nv"],
    time: Float[np.ndarray, " T"],
    q: Float[np.ndarray, "T nv"],
) -> list[str]:
    """Notes on positions a little outside the limits and on odd speeds.

    Raises:
        RecordingError: Positions that look like degrees, are far outside, or jump.
    """
    robot = request.robot
    beyond = excess(robot, q)
    far = beyond > np.where(angular, FAR_ANGLE, FAR_LENGTH)
    notes = _fast_notes(robot, time, q)
    if request.units is None and not recording.trusted:
        _refuse_degrees(recording, robot, angular, q, far, bool(notes))
    if np.any(far) and request.outside_limits == "refuse" and not recording.trusted:
        _refuse_far(recording, request, q, int(np.argmax(np.where(far, beyond, 0.0))))
    slight = np.flatnonzero(beyond > NOTABLE)
    if slight.size:
        worst = int(np.argmax(beyond))
        notes.append(
            f"beyond their limits: {counted(slight.size, 'joint')}, {robot.joint_names[worst]!r} the farthest: by "
            f"{beyond[worst]:.3g} {'rad' if angular[worst] else 'm'}"
        )
    if not recording.trusted and request.outside_limits == "refuse":
        _refuse_jumps(recording, robot, angular, time, q)
    return notes


def _refuse_degrees(
    recording: Recording,
    robot: Robot,
    angular: Bool[np.ndarray, " nv"],
    q: Float[np.ndarray, "T nv"],
    far: Bool[np.ndarray, " nv"],
    fast: bool,
) -> None:
    largest = np.abs(q).max(axis=0)
    unlimited = angular & ~np.isfinite(robot.position_lower) & ~np.isfinite(robot.position_upper)
    turning = unlimited & (largest > MANY_TURNS) & fast
    if not np.any((far & angular & (largest > 2 * np.pi)) | turning):
        return
    # one faulty sample, a sign or a full turn is another fault
    mostly = np.mean((q < robot.position_lower) | (q > robot.position_upper), axis=0) > MOSTLY
    other = np.array([_other_guess(robot, q[:, i], i) is not None for i in range(robot.nv)])
    suspects = (far & angular & mostly & ~other & (largest > 2 * np.pi)) | turning
    if not np.any(suspects) or np.any(excess(robot, np.radians(q))[suspects] > FAR_ANGLE):
        return
    i = int(np.argmax(np.where(suspects, largest, 0.0)))
    sample = int(np.argmax(np.abs(q[:, i])))
    whole_file = 2 * np.count_nonzero(largest[angular] > np.pi) >= np.count_nonzero(angular)
    fix = "convert this column to radians"
    if whole_file:
        fix = advice("pass {}, or ", "degrees=True", "--degrees") + "convert the file to radians"
    raise recording.refusal(
        "degrees",
        f"positions look like degrees: {q[sample, i]:.6g} where the limits are [{robot.position_lower[i]:.4g}, "
        f"{robot.position_upper[i]:.4g}] rad; {fix}",
        sample=sample,
        column=robot.joint_names[i],
    )


def _other_guess(robot: Robot, q: Float[np.ndarray, " T"], i: int) -> str | None:
    """What would bring all positions of joint i back inside its limits, other than a unit."""
    lower, upper = robot.position_lower[i], robot.position_upper[i]
    if np.all((-q >= lower) & (-q <= upper)):
        return "a wrong sign?"
    if any(np.all((q + turn >= lower) & (q + turn <= upper)) for turn in (-2 * np.pi, 2 * np.pi)):
        return "a full turn too much?"
    return None


def _refuse_far(recording: Recording, request: ReadRequest, q: Float[np.ndarray, "T nv"], i: int) -> None:
    robot = request.robot
    lower, upper = robot.position_lower[i], robot.position_upper[i]
    outside = np.maximum(lower - q[:, i], q[:, i] - upper)
    sample = int(np.argmax(outside))
    guess = _other_guess(robot, q[:, i], i)
    if guess is None and request.joint_names:
        guess = "the wrong order in joint_names?"
    guess = guess or "wrong units, columns with the wrong names, or another robot?"
    if np.all(outside > 0) and "another robot" not in guess:
        guess += " Or another robot?"
    raise recording.refusal(
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


def _refuse_jumps(
    recording: Recording,
    robot: Robot,
    angular: Bool[np.ndarray, " nv"],
    time: Float[np.ndarray, " T"],
    q: Float[np.ndarray, "T nv"],
) -> None:
    change, steps = np.abs(np.diff(q, axis=0)), np.diff(time)
    limit = np.where(np.isfinite(robot.velocity_limit), 10 * robot.velocity_limit, 50.0)
    # a rotation vector may jump where its rotation does not, close to a full turn
    jump = angular & ~object_coordinates(robot) & (change > JUMP) & (change > limit * steps[:, None])
    if np.any(jump):
        sample, i = (int(k) for k in np.argwhere(jump)[0])
        turn = abs(change[sample, i] - 2 * np.pi) < 0.5
        cause = "it wraps around a full turn, which this limited joint cannot" if turn else "a faulty sample?"
        raise recording.refusal(
            "jump",
            f"the joint jumps from {q[sample, i]:.4g} to {q[sample + 1, i]:.4g} rad within {steps[sample]:.3g} s: "
            f"{cause} "
            "Correct the file (a real break in the recording: put the parts into files of their own)",
            sample=sample + 1,
            column=robot.joint_names[i],
        )
