"""Colours distinguishable with colour blindness (after Okabe and Ito); lines of them have 3:1 on white and on black."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from manip_learn.errors import UnknownNameError

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
