"""The way that a person has shown along a handle, and how far the hand is on it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, cast, final

import numpy as np
from jaxtyping import Float

from manip_learn.constraint.constraint import Constraint
from manip_learn.constraint.features.mechanism_rows import Place
from manip_learn.constraint.mechanism import Mechanism
from manip_learn.control.tasks import FreeDirection, motion
from manip_learn.control.tasks.driven_motion import place_about
from manip_learn.linalg import null_basis
from manip_learn.robot.robot import Robot
from manip_learn.teach.scene import CLOSES, REACHES, Handle, posture_at

STEP = 0.01  # [s] of a simulation, as the arm's period
SHORTEST = {"m": 0.02, "rad": 0.05}  # [m or rad] a way that was shown and is worth doing again
SHARE = 0.85  # of the way shown that the slider begins with: the rest is the person's spread
STRIDE = 15  # samples between two postures of an approach, encoders being noisy
CALM = 1.5  # time of an approach over a person's
ARRIVES = {"m": 2e-3, "rad": 4e-3}  # [m or rad] of a way that is done


@final
@dataclass
class Shown:
    """One recording.

    Attributes:
        path: The file.
        q: shape (T, nv), its postures.
        time: shape (T,) [s].
        gripped: Number of the sample at which the gripper closed; None if it never did.
        phases: Start [s], end [s] and number of the constraint, -1 for free motion.
        odd: Why it does not agree with the others.
    """

    path: Path
    q: Float[np.ndarray, "T nv"]
    time: Float[np.ndarray, " T"]
    gripped: int | None
    phases: list[list[float]] = field(default_factory=list)
    odd: str = ""

    @property
    def held_from(self) -> int | None:
        """Number of the sample from which it holds something, by the gripper, else by the phases; or None."""
        if self.gripped is not None:
            return self.gripped
        start = next((start for start, _, k in self.phases if k == 0), None)
        return None if start is None else int(np.searchsorted(self.time, start))

    def to_dict(self) -> dict[str, Any]:
        """For the page."""
        seconds = float(self.time[-1] - self.time[0]) if len(self.time) else 0.0
        first = float(self.time[0]) if len(self.time) else 0.0
        return {
            "name": self.path.stem,
            "seconds": round(seconds, 2),
            "samples": len(self.time),
            "odd": self.odd,
            "phases": [[start - first, end - first, k] for start, end, k in self.phases],
        }


@final
@dataclass
class ShownWay:
    """As far as the task was shown, from where the hand took hold.

    Attributes:
        constraint: The learnt one.
        tip: The frame that is guided.
        recording: The one that the hand takes hold as in.
        held: shape (k, nv), its postures with the hand at the handle.
        handle: Number of the handle; None where no handle is there, as for a recording of another scene.
        start: shape (3,), the handle where it is shut, else where the hand took hold [m].
        unit: Of the way.
        high: How far it was shown.
        value: How far it is to go.
        sense: -1 where it was shown the other way round than the mechanism's turn counts.
        direction: shape (3,), unit vector of a way in m, in the base; None for one that turns.
    """

    constraint: Constraint
    tip: str
    recording: Shown
    held: Float[np.ndarray, "k nv"]
    handle: int | None
    start: Float[np.ndarray, " 3"]
    unit: Literal["m", "rad"]
    high: float
    value: float
    sense: float
    direction: Float[np.ndarray, " 3"] | None

    @property
    def robot(self) -> Robot:
        """The constraint's."""
        return cast(Robot, self.constraint.robot)  # its features are of a frame

    @staticmethod
    def of(constraint: Constraint, tip: str, recordings: Sequence[Shown], handles: Sequence[Handle]) -> ShownWay | None:
        """From the last recording that takes hold of something; None where none does, or the way is too short.

        Args:
            constraint: Learnt from them.
            tip: The frame that is guided.
            recordings: With their phases.
            handles: What a gripper can take hold of.
        """
        robot, one = constraint.robot, next((r for r in reversed(recordings) if r.held_from is not None), None)
        if one is None or robot is None:
            return None
        first = one.held_from or 0
        numbers = [k for s, e, n in one.phases if n == 0 for k in np.flatnonzero((one.time >= s) & (one.time <= e))]
        held = one.q[[k for k in numbers[::5] if k >= first]]
        if len(held) < 2:
            return None
        places = np.array([robot.position(q, tip) for q in held])
        handle = _handle_on(handles, places)
        known, start = constraint.mechanism, places[0] if handle is None else handles[handle].pose[:3, 3]
        if known is not None and known.type in ("hinge", "screw") and known.axis is not None:
            angles = np.unwrap([_turned(start, place, constraint) for place in places])
            far, unit, toward = float(angles[np.argmax(np.abs(angles))]), "rad", None
        else:
            away = places - start
            toward = away[int(np.argmax(np.linalg.norm(away, axis=1)))]
            if known is not None and known.axis is not None and known.type in ("line", "plane"):
                along = known.axis[None] if known.type == "line" else null_basis(known.axis[None]).T
                toward = along.T @ (along @ toward)
            far, unit = float(np.linalg.norm(toward)), "m"
            toward = toward / max(far, 1e-9)
        way = ShownWay(
            constraint, tip, one, held, handle, start, unit, abs(far), SHARE * abs(far), float(np.sign(far)), toward
        )
        return way if way.high > SHORTEST[way.unit] else None

    def hold(self, place: Float[np.ndarray, " 3"] | None = None) -> Float[np.ndarray, " nv"]:
        """The posture with the hand at the handle, as it was shown: where it is shut, or at another place [m]."""
        place = self.start if place is None else place
        gaps = [float(np.linalg.norm(self.robot.position(q, self.tip) - place)) for q in self.held]
        best = self.held[int(np.argmin(gaps))]
        pose = self.robot.pose(best, self.tip)
        pose[:3, 3] = place
        found = [posture_at(self.robot, self.tip, best, pose, firm=firm) for firm in (True, False)]
        return next((q for q in found if q is not None), best)

    def approach(self, place: Float[np.ndarray, " 3"]) -> tuple[Float[np.ndarray, " k"], Float[np.ndarray, "k nv"]]:
        """How the hand came to the handle in the recording, without its unsteadiness, and on to a place [m].

        Returns:
            Times [s] and postures.
        """
        last = self.recording.held_from or 0
        few = slice(0, max(last - STRIDE, 1), STRIDE)
        times, end = self.recording.time[few] - self.recording.time[0], self.recording.time[last] + CLOSES
        return CALM * np.append(times, end - self.recording.time[0]), np.vstack(
            [self.recording.q[few], self.hold(place)]
        )

    def at(self, place: Float[np.ndarray, " 3"]) -> float:
        """How far along the way a place of the hand is [m or rad]."""
        if self.direction is None:
            return self.sense * _turned(self.start, place, self.constraint)
        return float((place - self.start) @ self.direction)

    def done(self, q: Float[np.ndarray, " nv"]) -> float:
        """How far along the way the hand is [m or rad]."""
        return self.at(self.robot.position(q, self.tip))

    def set(self, value: float) -> None:
        """Ask for another way, as far as it was shown.

        Raises:
            ValueError: No finite number.
        """
        if not np.isfinite(value):
            raise ValueError("the way must be a finite number")
        self.value = float(np.clip(value, 0.0, self.high))

    def asked(self) -> dict[str, Any]:
        """As the worker takes it: the whole way from where the hand takes hold."""
        direction = None if self.direction is None else self.direction.tolist()
        return {"unit": self.unit, "value": self.sense * self.value, "direction": direction}

    def arrived(self, q: Float[np.ndarray, " nv"]) -> bool:
        """Whether the hand is where it was asked to go."""
        return abs(self.value - self.done(q)) < ARRIVES[self.unit]

    def task_from(self, q: Float[np.ndarray, " nv"]) -> FreeDirection:
        """The rest of the way from a posture."""
        return task_of(self.constraint, self.asked(), self.sense * (self.value - self.done(q)))

    def in_words(self, q: Float[np.ndarray, " nv"]) -> str:
        """How far it came."""
        size, unit, digits = (100.0, "cm", 1) if self.unit == "m" else (float(np.degrees(1.0)), "degrees", 0)
        return f"{size * self.done(q):.{digits}f} of {size * self.value:.{digits}f} {unit}"


def _handle_on(handles: Sequence[Handle], places: Float[np.ndarray, "k 3"]) -> int | None:
    """The handle along whose way the places are; None where none is near."""
    ways = [np.array([pose[:3, 3] for pose in handle.stations()]) for handle in handles]
    gaps = [float(np.median(np.min(np.linalg.norm(places[:, None] - way[None], axis=2), axis=1))) for way in ways]
    nearest = int(np.argmin(gaps)) if gaps else None
    return nearest if nearest is not None and gaps[nearest] < 2.0 * REACHES else None


def _turned(start: Float[np.ndarray, " 3"], here: Float[np.ndarray, " 3"], constraint: Constraint) -> float:
    """Angle about a mechanism's axis from one place to another [rad]."""
    known = cast(Mechanism, constraint.mechanism)
    place = Place(cast(np.ndarray, known.axis), cast(np.ndarray, known.point))
    return place_about(start - place.point, here - place.point, place, 0.0)["tangential"]


def task_of(constraint: Constraint, way: Mapping[str, Any], amount: float | None = None) -> FreeDirection:
    """The task of a way that the page asked for, as the person showed it where that says which way.

    Args:
        constraint: The learnt one.
        way: `unit` ("m" or "rad"), `value`, and `direction`, or None for the one shown.
        amount: In place of the value [m or rad].
    """
    far = float(way["value"] if amount is None else amount)
    along, turn = (far, None) if way["unit"] == "m" else (None, far)
    task = motion(constraint, along, turn, direction=way["direction"], beyond_shown=True)
    return task.with_distance(far)  # counted about the axis, whichever way was shown
