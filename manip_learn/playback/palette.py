"""Colours of rollouts, of the phases of recordings (one colour per constraint), and of the phases of rollouts.

The colours are distinguishable with colour blindness (after Okabe and Ito); lines in them have a contrast of 3:1 on
white and black.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, final

import numpy as np
from jaxtyping import Bool, Float

from manip_learn.errors import RecordingError, UnknownNameError
from manip_learn.linalg import finite

COLOURS: dict[str, str] = {
    "blue": "#0072b2",
    "vermilion": "#d55e00",
    "green": "#009e73",
    "purple": "#b2589a",
    "amber": "#c98600",
    "sky": "#3a9bd4",
    "brown": "#8c5f38",
    "grey": "#6b7580",
}
# trajectory, start [s], end [s], index of the constraint or None for free motion; optionally why nothing was learnt
Phase = tuple[str, float, float, int | None] | tuple[str, float, float, int | None, str]
WAY = "way"  # the phase of a rollout in which the hand moves along its mechanism
STRENGTHS = {"approach": 0.18, "hold": 0.4, "retreat": 0.18}  # other phase -> share of its rollout's colour
_CONSTRAINT_COLOURS = tuple(value for name, value in COLOURS.items() if name != "grey")


@final
@dataclass(frozen=True)
class PhaseKind:
    """Kind of phase, with the colour of its bands in the page.

    Attributes:
        label: Name in the legend, e.g. `"constraint 1: line"` or `"free motion"`.
        mark: Number or word on the bands, so that they differ not only in colour; empty for free motion.
        colour: Hexadecimal value.
        ink: Colour of the mark, black or white, whichever has more contrast.
        strength: Opacity of the colour, 0 to 1, over the page's background. If it is below 1, the path of the tip is
            thin.
        constraint: Index of the constraint, for a phase of a rollout with several constraints; None otherwise.
    """

    label: str
    mark: str
    colour: str
    ink: str
    strength: float = 1.0
    constraint: int | None = None


class PhaseBand(NamedTuple):
    """Time span of a phase in a recording or rollout.

    Attributes:
        start, end: Times on the recording's own time axis, or from its first sample [s].
        constraint: Index of the constraint; None for free motion.
        name: Name of a phase that a rollout contains, e.g. `"approach"` or `"line 2: approach"`; None for the phases of
            recordings.
    """

    start: float
    end: float
    constraint: int | None
    name: str | None = None

    @property
    def part(self) -> str:
        """Last part of a rollout phase's name, without the name of the mechanism: `"approach"`, `"hold"` or `"way"`."""
        return (self.name or "").rpartition(": ")[2]

    def covers(self, time: Float[np.ndarray, " T"]) -> Bool[np.ndarray, " T"]:
        """Return which times are within the band, both ends included.

        Args:
            time: Times (T,) [s].

        Returns:
            shape (T,).
        """
        return (time >= self.start) & (time <= self.end)


def phase_kinds(phases: Sequence[Phase], names: Sequence[str] = ()) -> tuple[PhaseKind, ...]:
    """Return the kinds of phase of recordings: one per constraint, then free motion.

    Args:
        phases: Phases that `phase_bands` has checked.
        names: Name of each constraint, e.g. `"hinge"`; empty or missing if unknown.

    Returns:
        One kind per constraint, and one for free motion.
    """
    kinds = []
    for k in range(1 + max((p[3] for p in phases if p[3] is not None), default=-1)):
        label = f"constraint {k + 1}" + (f": {names[k]}" if k < len(names) and names[k] else "")
        kinds.append(_kind(label, str(k + 1), _CONSTRAINT_COLOURS[k % len(_CONSTRAINT_COLOURS)]))
    free = "free motion, or not learnt" if any(len(p) > 4 and p[4] for p in phases) else "free motion"
    return (*kinds, _kind(free, "", "#8a95a0"))  # grey


def phase_bands(phases: Sequence[Phase], names: Sequence[str]) -> dict[str, tuple[PhaseBand, ...]]:
    """Check phases and sort them by recording and time; phases of recordings that are not in the page are left out.

    Args:
        phases: Tuples (name of the recording, start [s], end [s], index of the constraint or None for free motion,
            optionally a reason), as in `LearningReport.phases`.
        names: Names of the recordings in the page.

    Returns:
        Dictionary from the name of a recording to its bands.

    Raises:
        RecordingError: A phase is no such tuple, its times are not finite or in the wrong order, its constraint is not
            an index from 0 up, or no phase belongs to a recording in the page.
    """
    checked = [_checked(i, phase) for i, phase in enumerate(phases)]
    bands = {name: [band for whose, band, _ in checked if whose == name] for name in names}
    if phases and not any(bands.values()):
        others, present = (", ".join(map(repr, some)) for some in (dict.fromkeys(p[0] for p in phases[:6]), names[:6]))
        problem = f"the phases belong to the trajectories {others}, but the recordings shown are {present}"
        raise _refusal(f"{problem}: use the recording names of the learner")
    return {name: tuple(sorted(some, key=lambda b: b.start)) for name, some in bands.items()}


def rollout_bands(rollout: str, phases: Sequence[tuple[str, float, float]]) -> tuple[PhaseBand, ...]:
    """Check the phases that a rollout contains and sort them by time.

    Args:
        rollout: Name of the rollout, for error messages.
        phases: Tuples (name, start [s], end [s]), as in `Rollout.phases`.

    Returns:
        The bands, on the rollout's own time axis.

    Raises:
        RecordingError: Times are not finite or in the wrong order.
    """
    # a band has room for 40 characters
    bands = [(str(name)[:40], _checked(i, (rollout, *span, None))[1]) for i, (name, *span) in enumerate(phases)]
    return tuple(sorted((band._replace(name=name) for name, band in bands), key=lambda b: b.start))


def rollout_kinds(bands: Sequence[PhaseBand], colour: str) -> tuple[PhaseKind, ...]:
    """Return the kinds of the phases that a rollout contains, one per name.

    Args:
        bands: All bands of the rollout.
        colour: Colour of the rollout, hexadecimal.

    Returns:
        The kinds; empty if the rollout contains no phases.
    """
    by_name = {band.name: band for band in bands if band.name is not None}
    return tuple(_kind(name, name, colour, STRENGTHS.get(b.part, 1.0), b.constraint) for name, b in by_name.items())


def phases_from_json(value: object) -> tuple[Phase, ...]:
    """Parse phases of recordings from JSON.

    Args:
        value: List of phases. Each is a list `[trajectory, start [s], end [s], index of the constraint or null for free
            motion, reason (optional)]`, or an object with the keys `trajectory`, `start`, `end`, `constraint` and,
            optionally, `reason`.

    Returns:
        The phases as tuples in the same order.

    Raises:
        RecordingError: The value is no such list, or a phase has invalid times or an invalid constraint.
    """
    if not isinstance(value, list | tuple):
        raise _refusal(f"phases must be a list, got {type(value).__name__}")
    keys = ("trajectory", "start", "end", "constraint", "reason")
    listed = ([item.get(key) for key in keys] if isinstance(item, Mapping) else item for item in value)
    checked = (_checked(i, item) for i, item in enumerate(listed))
    phases: list[Any] = [(name, *band[:3], *map(str, reason)) for name, band, reason in checked]
    return tuple(phases)


def _checked(i: int, phase: Any) -> tuple[str, PhaseBand, list[Any]]:
    """Return the trajectory, the band and the reasons (none or one) of a phase."""
    if not isinstance(phase, list | tuple) or len(phase) not in (4, 5) or not isinstance(phase[0], str):
        raise _refusal(f"phase {i} must be (trajectory, start, end, constraint or None), got {phase!r:.80}")
    trajectory, start, end, constraint, *reason = phase
    span = finite([start, end], 2)
    if span is None or span[0] > span[1]:
        rule = "must have finite times and end after it starts"
        raise _refusal(f"phase {i} of {trajectory!r} {rule}, got {start!r} s to {end!r} s")
    is_number = isinstance(constraint, int) and not isinstance(constraint, bool)
    # an index of 1000 is a mistake, not a constraint
    if constraint is not None and not (is_number and 0 <= constraint < 1000):
        rule = "the constraint must be a number from 0 up, or None for free motion"
        raise _refusal(f"phase {i} of {trajectory!r}: {rule}, got {constraint!r:.40}")
    return trajectory, PhaseBand(float(span[0]), float(span[1]), constraint), [why for why in reason if why is not None]


def _refusal(sentence: str) -> RecordingError:
    """Return the error for invalid phases."""
    return RecordingError(sentence, code="phases")


def _kind(label: str, mark: str, colour: str, strength: float = 1.0, constraint: int | None = None) -> PhaseKind:
    """Return a kind whose ink, black or white, has more contrast (relative luminance as in WCAG 2.2)."""
    channels = np.array(hex_to_rgb(colour)) / 255.0
    linear = np.where(channels <= 0.04045, channels / 12.92, ((channels + 0.055) / 1.055) ** 2.4)
    is_light = (linear @ [0.2126, 0.7152, 0.0722] + 0.05) ** 2 > 1.05 * 0.05
    return PhaseKind(label, mark, colour, "#000000" if is_light else "#ffffff", strength, constraint)


def rollout_colours(names: Sequence[str], chosen: Mapping[str, str], neutral: bool = False) -> list[tuple[str, str]]:
    """Return the colour of each rollout; rollouts without a chosen colour get the unused colours in order.

    Args:
        names: Names of the rollouts.
        chosen: Mapping from names of rollouts to names of colours.
        neutral: True to draw all rollouts without a chosen colour in grey, because colours have another meaning in this
            page.

    Returns:
        (name of the colour, hexadecimal value) per rollout.

    Raises:
        UnknownNameError: A chosen colour does not exist, or it is for a rollout that does not exist.
    """
    for rollout, colour in chosen.items():
        if rollout not in names:
            raise UnknownNameError("rollout", rollout, names, "colours")
        if colour not in COLOURS:
            raise UnknownNameError("colour", colour, COLOURS)
    free = ["grey"] if neutral else [c for c in COLOURS if c not in chosen.values()] or list(COLOURS)
    others = [n for n in names if n not in chosen]
    picked = dict(chosen) | {n: free[i % len(free)] for i, n in enumerate(others)}
    return [(picked[n], COLOURS[picked[n]]) for n in names]


def hex_to_rgb(colour: str) -> list[int]:
    """Return red, green and blue of a hexadecimal colour.

    Args:
        colour: For example `"#0072b2"`.

    Returns:
        Three values, 0 to 255.
    """
    return list(bytes.fromhex(colour[1:]))
