"""One recording from rest to rest: approach, contact with one mechanism after another, retreat."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import final

import numpy as np
from jaxtyping import Float

from make_recordings.arms import Arm
from make_recordings.furniture import draw_way
from make_recordings.hand_motion import RATE, minimum_jerk, reach, rest, slow_curve
from make_recordings.mechanism_motion import UnreachableError, follow, put
from make_recordings.mechanisms import Mechanism

SHORTEST_CONTACT, SHORTEST_AFTER_SLIP = 1.2, 0.5  # [s]
TRIES = 12
AWAY, BEND = 0.35, 0.2  # rest posture from the grip's, and detour on the way, standard deviations [rad]
SLIP = 0.06  # from one grip to the next, standard deviation of the joints [rad]

Window = tuple[float, float, int]
Perform = Callable[[Arm, "Tape", list[Mechanism], np.random.Generator], "Tape"]


@final
@dataclass
class Tape:
    """A recording as it grows: pieces of joint motion and the windows of contact.

    Attributes:
        pieces: Each of shape (n, nv) [rad], sampled at 100 Hz.
        windows: (start [s], end [s], index of the mechanism).
        offset: Where the hand holds things, seen from the tip's frame [m].
    """

    pieces: list[np.ndarray] = field(default_factory=list)
    windows: list[Window] = field(default_factory=list)
    offset: tuple[float, float, float] = (0.0, 0.0, 0.0)

    @property
    def motion(self) -> Float[np.ndarray, "T nv"]:
        """All of it [rad]."""
        return np.concatenate(self.pieces)

    @property
    def end(self) -> Float[np.ndarray, " nv"]:
        """The last posture [rad]."""
        return self.pieces[-1][-1]

    def add(self, piece: Float[np.ndarray, "n nv"], mechanism: int | None = None) -> None:
        """Append a piece that begins with the posture at which the last one ended."""
        length = sum(len(part) for part in self.pieces)
        first = max(length - 1, 0)
        self.pieces.append(piece[1:] if length else piece)
        if mechanism is not None:
            last = first + len(piece) - 1
            self.windows.append((round(first / RATE, 2), round(last / RATE, 2), mechanism))


@final
@dataclass(frozen=True)
class Session:
    """A person, an arm and what stands around it; the same in all demonstrations.

    Attributes:
        arm: The arm.
        mechanisms: What can be held.
        places: Postures near which each is held, shape (nv,) each [rad].
        grip: How differently the hand takes hold each time: standard deviation of the joints [rad].
        wander: How much the joints wander where nothing holds them: standard deviation [rad].
        whole: Whether approach, retreat and rests are recorded.
        settle: Least time at the grip before anything moves [s].
        perform: What becomes of a planned recording, given its mechanisms; None if the plan is what is recorded.
    """

    arm: Arm
    mechanisms: list[Mechanism]
    places: list[np.ndarray]
    grip: float
    wander: float
    whole: bool
    settle: float = 0.0
    perform: Perform | None = None

    def demonstrate(self, indices: list[int], slips: bool, key: list[int]) -> Tape:
        """One good demonstration with the mechanisms of these indices, in this order; the key seeds it.

        Raises:
            UnreachableError: 12 tries, and each hit a limit or a singularity, or was too short.
        """
        shortest = SHORTEST_AFTER_SLIP if slips else SHORTEST_CONTACT
        for attempt in range(TRIES):
            rng = np.random.default_rng([*key, attempt])
            try:
                tape = self._record(indices, slips, rng)
                if self._is_good(tape, shortest) and self.perform:
                    tape = self.perform(self.arm, tape, self.mechanisms, rng)
            except UnreachableError:
                continue
            if self._is_good(tape, shortest):
                return tape
        raise UnreachableError(f"{TRIES} tries and none was good")

    def _is_good(self, tape: Tape, shortest: float) -> bool:
        long_enough = all(end - start >= shortest for start, end, _ in tape.windows)
        return long_enough and self.arm.stays_inside(tape.motion, RATE) and self.arm.keeps_clear(tape.motion[::20])

    def _record(self, indices: list[int], slips: bool, rng: np.random.Generator) -> Tape:
        tape, n, tempo = Tape(offset=self.arm.offset), len(self.arm.ready), float(np.exp(rng.normal(0.0, 0.2)))
        for index in indices:
            mechanism = self.mechanisms[index]
            bar = rng.uniform(-1.0, 1.0, len(mechanism.bar)) @ mechanism.bar
            near = self.places[index] + rng.normal(0.0, self.grip, n)
            grip = put(self.arm, near, mechanism.handle + bar)
            contact = self._contact(mechanism, grip, tempo, slips, rng)
            if self.whole and not tape.pieces:
                tape.add(rest(grip + rng.normal(0.0, AWAY, n), rng.uniform(0.3, 1.5)))
            if tape.pieces:
                tape.add(reach(tape.end, grip, tempo * rng.uniform(1.3, 2.4), BEND, rng))
            pause = max(self.settle, rng.uniform(0.1, 0.6) * (rng.random() < 0.4))
            if tape.pieces and pause > 0.0:
                tape.add(rest(grip, pause))
            for part, held in contact:
                tape.add(part, index if held else None)
        if self.whole:
            away = tape.end + rng.normal(0.0, AWAY, n)
            tape.add(reach(tape.end, away, tempo * rng.uniform(1.3, 2.4), BEND, rng))
            tape.add(rest(away, rng.uniform(0.3, 1.5)))
        return tape

    def _contact(
        self, mechanism: Mechanism, grip: np.ndarray, tempo: float, slips: bool, rng: np.random.Generator
    ) -> list[tuple[np.ndarray, bool]]:
        """Pieces of joint motion and whether they are held; what slips lets go halfway and takes hold elsewhere."""
        way = draw_way(mechanism, tempo, rng)
        wander = slow_curve(len(way) - 1, np.full(len(grip), self.wander * rng.uniform(0.6, 1.4)), (0.1, 0.5), rng)
        half = round(len(way) * rng.uniform(0.4, 0.6)) if slips else len(way)
        held = self._held(mechanism, grip, way[:half], wander[:half])
        if not slips:
            return [(held, True)]
        again = held[-1] + rng.normal(0.0, SLIP, len(grip))
        slip = _slip(held[-1], again, (held[-1] - held[-2]) * RATE, rng)
        rest_of_it = self._held(mechanism, again, _from_rest(way[half:]), _from_rest(wander[half:]))
        return [(held, True), (slip, False), (rest_of_it, True)]

    def _held(self, mechanism: Mechanism, grip: np.ndarray, way: np.ndarray, wander: np.ndarray) -> np.ndarray:
        pose = self.arm.pose(grip)
        return follow(self.arm, grip, mechanism.carry(pose, way - way[0]), wander)


def _from_rest(curve: np.ndarray) -> np.ndarray:
    """The same curve, started gently within 0.4 s."""
    n = len(curve)
    clock = np.concatenate([[0.0], np.cumsum(minimum_jerk(np.arange(n + 20) / (0.4 * RATE)))])
    return np.column_stack([np.interp(clock, np.arange(n), column) for column in curve.T])


def _slip(last: np.ndarray, again: np.ndarray, speed: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """From one grip to the next within 0.15 to 0.35 s; begins with the arm's speed [rad/s]."""
    duration = rng.uniform(0.15, 0.35)
    motion = reach(last, again, duration, 0.0, rng)
    s = np.linspace(0.0, 1.0, len(motion))
    return motion + np.outer(duration * s * (1.0 - s) ** 3, speed)
