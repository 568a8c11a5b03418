"""Recorded velocities against the motion of the positions: units, signs, order and time base."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import final

import numpy as np
from jaxtyping import Bool, Float

from manip_learn.errors import advice
from manip_learn.recordings.readers.recording import GAP_FACTOR, Recording
from manip_learn.recordings.validation.time_checks import unit_refusal, usual_step

DEGREE = math.degrees(1.0)
MOVED = 0.02  # [rad or m] a joint must move to be judged
SURE, UNSURE, OTHER_JOINT = 0.9, 0.5, 0.98  # correlations
FEWEST, LONGEST_WINDOW = 8, 50  # samples
TIME_SLOPES = (("ms", 1e-3), ("us", 1e-6), ("ns", 1e-9))


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
    width = int(np.clip(time.shape[0] // 20, 1, LONGEST_WINDOW))
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


def check_velocities(
    recording: Recording,
    names: tuple[str, ...],
    angular: Bool[np.ndarray, " nv"],
    match: VelocityMatch,
) -> list[str]:
    """Notes on recorded velocities that do not follow the positions.

    Raises:
        RecordingError: A fault that can be named: degrees, milliseconds, a sign, another joint's velocity, a scale.
    """
    notes = []
    for i, name in enumerate(names):
        if not match.moved[i]:
            continue
        own = float(match.correlation[i, i])
        if abs(own) >= SURE:
            _refuse_slope(recording, name, bool(angular[i]), float(match.slope[i]))
            continue
        j = _follower(match, i)
        if j is not None:
            raise recording.refusal(
                "velocity-order",
                f"the velocity does not follow this joint (correlation {own:.2f}) but that recorded for "
                f"{names[j]!r} does ({match.correlation[i, j]:.2f}): the columns are in the wrong order",
                column=name,
            )
        if abs(own) < UNSURE:
            notes.append(f"the recorded velocity of {name!r} does not follow its position (correlation {own:.2f})")
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
    if angular and _near(size, DEGREE):
        raise recording.refusal(
            "degrees",
            f"positions look like degrees: {evidence}; radians are needed: convert the position columns"
            + advice(
                " ({} is for files whose positions and velocities are both in degrees)", "degrees=True", "--degrees"
            ),
            column=name,
        )
    if angular and _near(size, 1 / DEGREE):
        raise recording.refusal(
            "degrees",
            f"velocities look like degrees per second: {evidence}; rad/s are needed: convert the velocity columns or "
            "leave them out",
            column=name,
        )
    unit = next((u for u, s in TIME_SLOPES if _near(size, s)), None)
    if unit is not None:
        raise unit_refusal(recording, unit, evidence)
    raise recording.refusal(
        "velocity-scale",
        f"recorded velocities and positions have different scales: {evidence}; correct the units of one of them, "
        "or leave the velocity columns out",
        column=name,
    )


def _near(value: float, expected: float) -> bool:
    return 1 / 1.25 < value / expected < 1.25
