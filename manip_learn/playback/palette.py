"""Colours, and what has one: rollouts, the phases of recordings (one per constraint) and of rollouts (their own).

The colours are distinguishable with colour blindness (after Okabe and Ito); lines of them have 3:1 on white and black.
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
# trajectory, start [s], end [s], number of the constraint counted from 0, None for free motion; why nothing was learnt
Phase = tuple[str, float, float, int | None] | tuple[str, float, float, int | None, str]
WAY = "way"  # the phase of a rollout in which the hand moves along its mechanism
LEADING = {"approach": 0.18, "hold": 0.4, "retreat": 0.18}  # other phases, and how much of its colour they have
_CONSTRAINT_COLOURS = tuple(value for name, value in COLOURS.items() if name != "grey")


@final
@dataclass(frozen=True)
class PhaseKind:
    """What a colour of the bands stands for.

    Attributes:
        label: Name in the legend, e.g. `"constraint 1: line"` or `"free motion"`.
        mark: Number or word written on the bands, so that not colour alone tells them apart; empty for free motion.
        colour: Hexadecimal value.
        ink: Colour of the number, black or white, whichever has more contrast.
        strength: Share of the colour in what is drawn; the rest is the page's. Below 1 the path of the tip is thin.
        constraint: Number of the constraint to which a rollout's own phase belongs, where it has several.
    """

    label: str
    mark: str
    colour: str
    ink: str
    strength: float = 1.0
    constraint: int | None = None


class PhaseBand(NamedTuple):
    """One stretch of one recording or rollout.

    Attributes:
        start, end: On the recording's own clock, or from its first sample on [s].
        constraint: Number of the constraint, counted from 0; None for free motion.
        name: What a rollout calls a phase of its own, e.g. `"approach"` or `"line 2: approach"`; None for those of
            constraints.
    """

    start: float
    end: float
    constraint: int | None
    name: str | None = None

    @property
    def part(self) -> str:
        """What is done in a rollout's own phase, whichever thing it is done to: `"approach"`, `"hold"`, `"way"`."""
        return (self.name or "").rpartition(": ")[2]

    def covers(self, time: Float[np.ndarray, " T"]) -> Bool[np.ndarray, " T"]:
        """Return where times [s] are within the band, both ends included."""
        return (time >= self.start) & (time <= self.end)


def phase_kinds(phases: Sequence[Phase], names: Sequence[str] = ()) -> tuple[PhaseKind, ...]:
    """Return the constraints in their order, then free motion.

    Args:
        phases: Checked by `phase_bands`.
        names: What each constraint is, e.g. `"hinge"`; empty or missing where that is not known.
    """
    kinds = []
    for k in range(1 + max((p[3] for p in phases if p[3] is not None), default=-1)):
        label = f"constraint {k + 1}" + (f": {names[k]}" if k < len(names) and names[k] else "")
        kinds.append(_kind(label, str(k + 1), _CONSTRAINT_COLOURS[k % len(_CONSTRAINT_COLOURS)]))
    free = "free motion, or not learnt" if any(len(p) > 4 and p[4] for p in phases) else "free motion"
    return (*kinds, _kind(free, "", "#8a95a0"))  # grey


def phase_bands(phases: Sequence[Phase], names: Sequence[str]) -> dict[str, tuple[PhaseBand, ...]]:
    """Return the phases of each recording, in order of time; those of recordings that are not shown are left out.

    Args:
        phases: (trajectory, start [s], end [s], constraint or None), as in `LearningReport.phases`; a reason may
            follow.
        names: Names of the recordings that are shown.

    Raises:
        RecordingError: Not such a tuple, times that are not finite or in the wrong order, a constraint that is not a
            number from 0 up, or phases none of which is of a recording that is shown.
    """
    checked = [_checked(i, phase) for i, phase in enumerate(phases)]
    bands = {name: [band for whose, band, _ in checked if whose == name] for name in names}
    if phases and not any(bands.values()):
        others, shown = (", ".join(map(repr, some)) for some in (dict.fromkeys(p[0] for p in phases[:6]), names[:6]))
        whose = f"the phases are of the trajectories {others}, but the recordings shown are {shown}"
        raise _refusal(f"{whose}: show the recordings under the names that the learner knows them by")
    return {name: tuple(sorted(some, key=lambda b: b.start)) for name, some in bands.items()}


def own_bands(rollout: str, phases: Sequence[tuple[str, float, float]]) -> tuple[PhaseBand, ...]:
    """Return the phases that a rollout itself has, in order of time.

    Args:
        rollout: Its name, for errors.
        phases: As in `Rollout.phases`.

    Raises:
        RecordingError: Times that are not finite or in the wrong order.
    """
    # 40 characters of a name are as many as a band has room for
    named = [(str(name)[:40], _checked(i, (rollout, *span, None))[1]) for i, (name, *span) in enumerate(phases)]
    return tuple(sorted((band._replace(name=name) for name, band in named), key=lambda b: b.start))


def own_kinds(bands: Sequence[PhaseBand], colour: str) -> tuple[PhaseKind, ...]:
    """Return the phases that a rollout itself has, by their names; empty if it has none.

    Args:
        bands: All of its bands.
        colour: Colour of the rollout, hexadecimal.
    """
    named = {band.name: band for band in bands if band.name is not None}
    return tuple(_kind(name, name, colour, LEADING.get(b.part, 1.0), b.constraint) for name, b in named.items())


def phases_from_json(value: object) -> tuple[Phase, ...]:
    """Return phases as JSON holds them: lists of four or five, or objects with trajectory, start, end and constraint.

    Raises:
        RecordingError: Something else.
    """
    if not isinstance(value, list | tuple):
        raise _refusal(f"phases must be a list, got {type(value).__name__}")
    keys = ("trajectory", "start", "end", "constraint", "reason")
    listed = ([item.get(key) for key in keys] if isinstance(item, Mapping) else item for item in value)
    checked = (_checked(i, item) for i, item in enumerate(listed))
    phases: list[Any] = [(name, *band[:3], *map(str, reason)) for name, band, reason in checked]
    return tuple(phases)


def _checked(i: int, phase: Any) -> tuple[str, PhaseBand, list[Any]]:
    """Return the trajectory, the band and the reason of a phase, none or one."""
    if not isinstance(phase, list | tuple) or len(phase) not in (4, 5) or not isinstance(phase[0], str):
        raise _refusal(f"phase {i} must be (trajectory, start, end, constraint or None), got {phase!r:.80}")
    trajectory, start, end, constraint, *reason = phase
    span = finite([start, end], 2)
    if span is None or span[0] > span[1]:
        wanted = "must end after it starts, at finite numbers of seconds"
        raise _refusal(f"phase {i} of {trajectory!r} {wanted}, got {start!r} s to {end!r} s")
    is_number = isinstance(constraint, int) and not isinstance(constraint, bool)
    # a number of 1000 is a mistake, not a constraint
    if constraint is not None and not (is_number and 0 <= constraint < 1000):
        wanted = "the constraint must be a number from 0 up, or None for free motion"
        raise _refusal(f"phase {i} of {trajectory!r}: {wanted}, got {constraint!r:.40}")
    return trajectory, PhaseBand(float(span[0]), float(span[1]), constraint), [why for why in reason if why is not None]


def _refusal(sentence: str) -> RecordingError:
    return RecordingError(sentence, code="phases")


def _kind(label: str, mark: str, colour: str, strength: float = 1.0, constraint: int | None = None) -> PhaseKind:
    """Return a kind with the ink, black or white, that has more contrast (relative luminance as in WCAG 2.2)."""
    channels = np.array(rgb_of(colour)) / 255.0
    linear = np.where(channels <= 0.04045, channels / 12.92, ((channels + 0.055) / 1.055) ** 2.4)
    is_light = (linear @ [0.2126, 0.7152, 0.0722] + 0.05) ** 2 > 1.05 * 0.05
    return PhaseKind(label, mark, colour, "#000000" if is_light else "#ffffff", strength, constraint)


def rollout_colours(names: Sequence[str], chosen: Mapping[str, str], neutral: bool = False) -> list[tuple[str, str]]:
    """(name, hexadecimal value) of the colour of each rollout; those not chosen take the free ones in order.

    Args:
        names: Of the rollouts.
        chosen: Rollout -> colour.
        neutral: Those not chosen are all grey, because colours mean something else in this page.

    Raises:
        UnknownNameError: A colour that does not exist, or one chosen for a rollout that does not exist.
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


def rgb_of(colour: str) -> list[int]:
    """Red, green and blue of a hexadecimal colour, each 0 to 255."""
    return list(bytes.fromhex(colour[1:]))
