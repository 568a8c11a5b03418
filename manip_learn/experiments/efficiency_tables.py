"""What the noisy experiments say beyond the paper: what can be known, what is reached, and how well it is stated."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from manip_learn.experiments.bounds_report import UNKNOWABLE
from manip_learn.experiments.experiment_result import markdown_table, number
from manip_learn.experiments.ways import SAID

EFFICIENT = ("auto", "joint-told", "joint-affine")


def identifiability(bounds: dict[str, Any]) -> str:
    """The least angle that any unbiased learner can have, over the number of trajectories."""
    cells = [one for _, _, one in _cells(bounds)]
    noise = _common([one["noise"] for one in cells])
    rows = list(dict.fromkeys(rows for _, rows, _ in _cells(bounds)))
    counts = sorted({one["trajectories"] for one in cells if one["noise"] == noise})
    lines = []
    for count in counts:
        found = {r: one for _, r, one in _cells(bounds) if one["noise"] == noise and one["trajectories"] == count}
        angles = (found[r]["bound"]["angle_deg"] for r in rows)
        said = [number(a) if a <= UNKNOWABLE else f"{number(a)}: not determined" for a in angles]
        lines.append([str(count), *said, _percent(max(found[r]["auto"]["refused"] for r in rows))])
        lines[-1].append(_percent(min(found[r]["auto"]["warned"] + found[r]["auto"]["refused"] for r in rows)))
    header = [f"trajectories, noise {100 * noise:g} %", *(f"bound, rows {_said(r)} [deg]" for r in rows)]
    return markdown_table([*header, "refused, most", "refused or warned, least"], lines)


def efficiency(bounds: dict[str, Any]) -> str:
    """Root mean square error over the bound, and the share of stated intervals that hold the truth."""
    lines = []
    for key, rows, one in _cells(bounds):
        if one["bound"]["angle_deg"] > UNKNOWABLE:
            continue
        ratios = [number(one[name]["efficiency"]) for name in EFFICIENT]
        lines.append([key.removeprefix("noise "), _said(rows), number(one["bound"]["angle_deg"]), *ratios])
        lines[-1].append("-" if one["inside"] is None else f"{_percent(one['inside'])} of {one['stated']}")
    header = [
        "noise, trajectories",
        "rows",
        "bound [deg]",
        *(f"{SAID[name]}: error over the bound" for name in EFFICIENT),
    ]
    return markdown_table([*header, f"truth inside the stated 68 % of *{SAID['auto']}*"], lines)


def calibration(bounds: dict[str, Any], sawyer: dict[str, Any]) -> str:
    """Share of the stated 68 % angles that hold the truth, all cells of a kind together."""
    lines = []
    noises = sorted({one["noise"] for _, _, one in _cells(bounds)})
    for noise in noises:
        told = [
            one for _, _, one in _cells(bounds) if one["noise"] == noise and one["bound"]["angle_deg"] <= UNKNOWABLE
        ]
        total = sum(one["stated"] for one in told)
        inside = sum(one["inside"] * one["stated"] for one in told if one["inside"] is not None)
        lines.append([f"reaches, noise {100 * noise:g} %", str(total), _percent(inside / total) if total else "-"])
    for source in ("kind physics", "hard physics"):
        found = [b for key, b in sawyer["ours"].items() if key.startswith(source) and b["inside"] is not None]
        total = sum(b["angle_deg"]["n"] for b in found)
        inside = sum(b["inside"] * b["angle_deg"]["n"] for b in found)
        lines.append([f"drawer, {source}, resamples of 50", str(total), _percent(inside / total) if total else "-"])
    return markdown_table(["recordings", "answers", "truth inside the stated 68 %"], lines)


def _cells(bounds: dict[str, Any]) -> Iterator[tuple[str, str, dict[str, Any]]]:
    for key, block in bounds["ours"].items():
        for rows, one in block.items():
            yield key, rows, one


def _common(noises: list[float]) -> float:
    return max(set(noises), key=noises.count)


def _said(rows: str) -> str:
    return rows.replace("rz", "theta").replace(" ", ", ")


def _percent(share: float) -> str:
    return f"{100.0 * share:.0f} %"
