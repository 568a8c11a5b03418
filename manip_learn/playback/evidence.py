"""Why a learnt constraint should be believed, as the sentences and the table of a page."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, Protocol

from manip_learn.errors import counted, error_in_words

MAX_TEXT = 2000
MOST_ROWS = 60
STATES = {
    "held": "held",
    "unclear": "unclear",
    "free": "free",
    "untried": "not tried: nothing moved along it",
}


class DescribedReport(Protocol):
    """A report that can describe itself, as `LearningReport` of the learner does."""

    def to_dict(self) -> Mapping[str, Any]:
        """Plain numbers, strings and lists."""
        ...


def evidence_of(report: DescribedReport | Mapping[str, Any]) -> dict[str, Any]:
    """Headline, facts with what they mean, the evidence of each row, warnings, odd recordings.

    What the report lacks is left out: constraint files of earlier versions hold less.

    Args:
        report: `learner.report_`, or the dictionary of it that a constraint file keeps as its provenance.
    """
    content = report if isinstance(report, Mapping) else report.to_dict()
    facts = [fact for fact in (_gap(content), _held_out(content), _uncertainty(content), _samples(content)) if fact]
    imposed = content.get("kind") == "self-imposed"
    return {
        "headline": _text(content.get("sentence")),
        "kind": "the demonstrator moves the constrained directions (b is not 0)" if imposed else "",
        "facts": facts,
        "words": _text(content.get("evidence")),
        "rows": _rows(content.get("row_evidence")),
        "warnings": _texts(content.get("warnings")),
        "odd": _odd(content.get("odd_trajectories")),
        "notes": _texts(content.get("notes")),
    }


def _gap(content: Mapping[str, Any]) -> list[str] | None:
    gap, n = _number(content.get("gap")), content.get("n_constraints")
    if gap is None:
        return None
    joint = content.get("estimator") == "joint"
    scale = "1.5 and above is clear" if joint else "10 and above is clear, below 3 says little"
    rows = counted(n, "row") if isinstance(n, int) else "this number of rows"
    return ["Gap", f"{gap:,.3g}" if gap < 1000 else f"{gap:,.0f}", f"how clearly the data ask for {rows}: {scale}"]


def _held_out(content: Mapping[str, Any]) -> list[str] | None:
    residual = _number(content.get("held_out_residual"))
    if residual is None:
        return None
    return [
        "Residual",
        f"{100.0 * residual:.2g} %",
        "share of the motion left unexplained in recordings not learnt from",
    ]


def _uncertainty(content: Mapping[str, Any]) -> list[str] | None:
    angle = _number(content.get("uncertainty_deg"))
    if angle is None:
        return None
    return ["Direction", error_in_words(angle, "degrees"), "68 % of repetitions with other recordings stay within it"]


def _samples(content: Mapping[str, Any]) -> list[str] | None:
    n, recordings = content.get("n_samples"), content.get("n_trajectories")
    if not isinstance(n, int) or not isinstance(recordings, int):
        return None
    estimator = _text(content.get("estimator"))
    said = f"estimator: {estimator}" if estimator else ""
    return [
        "Learnt from",
        counted(n, "sample"),
        f"of {counted(recordings, 'recording')}" + f"; {said}" * bool(said),
    ]


def _rows(value: object) -> list[list[str]]:
    """Strength, chance and verdict of each row, most firmly held first."""
    rows = []
    for k, entry in enumerate(_list(value)):
        if not isinstance(entry, Mapping):
            continue
        strength, chance = _number(entry.get("strength")), _number(entry.get("p_value"))
        state = str(entry.get("state"))
        rows.append(
            [
                f"row {k + 1}",
                STATES.get(state, state[:40]),
                "" if strength is None else f"{strength:,.3g} times" if strength < 1e6 else "over a million times",
                "" if chance is None else f"p = {chance:.2g}",
            ]
        )
    return rows


def _odd(value: object) -> list[list[str]]:
    odd = []
    for entry in _list(value):
        if isinstance(entry, Mapping):
            odd.append([_text(entry.get("trajectory")), _text(entry.get("reason"))])
        elif isinstance(entry, Sequence) and not isinstance(entry, str) and len(entry) == 2:
            odd.append([_text(entry[0]), _text(entry[1])])
    return odd


def _list(value: object) -> list[Any]:
    return list(value)[:MOST_ROWS] if isinstance(value, list | tuple) else []


def _texts(value: object) -> list[str]:
    return [_text(text) for text in _list(value)]


def _text(value: object) -> str:
    return "" if value is None else str(value)[:MAX_TEXT]


def _number(value: object) -> float | None:
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        return None
    return float(value)
