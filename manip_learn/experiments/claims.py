"""Every claim of the paper in one row, judged as printed, and the aims of this project."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from manip_learn.experiments.experiment_result import markdown_table, mean_and_sd, number
from manip_learn.experiments.paper_setup import PAPER_ABSTRACT, PAPER_RMSE
from manip_learn.experiments.ways import SAID

Line = Sequence[object]
ENOUGH = 0.98  # share of the runs in which the number of rows is found: our aim
FEW = ("1 trajectory", "5 trajectories")


def claims(results: dict[str, Any]) -> str:
    """The claims of the paper, then the aims of this project.

    Args:
        results: Part -> its `to_dict`.
    """
    lines: list[Line] = [*_abstract(results), *_table(results["table"]), *_rmse(results["rmse"])]
    for part in ("singular-start", "near-singular-start"):
        lines += [
            [claim["text"], claim["seen"], claim["verdict"] or ("yes" if claim["holds"] else "**no**")]
            for claim in results[part]["claims"]
            if claim["source"] == "paper"
        ]
    lines += _drawer(results["sawyer"])
    aims = [*_beaten(results["table"]), *_ranks(results["variants"]), *_bounds(results["bounds"])]
    return "\n\n".join(
        [
            markdown_table(["claim of the paper", "here", "holds as printed"], lines),
            "Aims of this project, in the same way:",
            markdown_table(["aim", "here", "reached"], aims),
        ]
    )


def _said(rows: str) -> str:
    return rows.replace("rz", "theta").replace(" ", ", ")


def _abstract(results: dict[str, Any]) -> list[Line]:
    """Errors below 1e-5 in simulation and 1e-2 with a real arm."""
    route = {rows: block["ours"]["separate-row-by-row"]["mean"] for rows, block in results["table"].items()}
    worst = max(route, key=lambda rows: route[rows])
    hard = [b["mie_held"]["worst"] for key, b in results["sawyer"]["ours"].items() if key.startswith("hard")]
    simulated, real = PAPER_ABSTRACT
    return [
        [
            f"Abstract: errors below {simulated:.0e} for simulated 3-joint systems",
            f"largest mean NMIE of the paper's route: {number(route[worst])} ({_said(worst)})",
            "yes" if route[worst] < simulated else "**no**",
        ],
        [
            f"Abstract: errors below {real:.0e} with a real 7-joint arm",
            f"worst MIE on held-out recordings, hard physics: {number(max(hard))}",
            "cannot be judged: theirs is a real arm, ours a simulated one",
        ],
    ]


def _table(table: dict[str, Any]) -> list[Line]:
    lines: list[Line] = []
    for rows, block in table.items():
        paper, route = block["paper"]["mean"], block["ours"]["separate-row-by-row"]
        factor = route["mean"] / paper
        verdict = "yes, lower" if factor <= 1.0 else f"**no**, {factor:.2g} times higher"
        seen = f"the paper's route: {mean_and_sd(route)}"
        lines.append([f"Table, {_said(rows)}: NMIE {mean_and_sd(block['paper'])}", seen, verdict])
    return lines


def _rmse(rmse: dict[str, Any]) -> list[Line]:
    """Only beside the constraint that the paper tested."""
    block = rmse["ours"][rmse["paper"]["rows"]]
    route = block["separate"]["two_policies"]
    return [
        [
            f"RMSE of two trajectories' policies, {_said(rmse['paper']['rows'])}: "
            f"{PAPER_RMSE['mean']:.3e} +- {PAPER_RMSE['sd']:.3e}",
            f"{SAID['separate']}: {mean_and_sd(route)}; {SAID['joint-rbf']}: "
            f"{mean_and_sd(block['joint-rbf']['two_policies'])}",
            "yes, lower" if route["mean"] <= PAPER_RMSE["mean"] else "**no**",
        ]
    ]


def _drawer(sawyer: dict[str, Any]) -> list[Line]:
    worst = {what: max(b[what]["mean"] for b in sawyer["ours"].values()) for what in ("mie_held", "rmse")}
    printed = {"mie_held": number(sawyer["paper"]["mie"]), "rmse": mean_and_sd(sawyer["paper"]["rmse"])}
    words = {"mie_held": "MIE", "rmse": "RMSE"}
    return [
        [
            f"Drawer with a real arm: {words[what]} {printed[what]}",
            f"largest mean of our readings, simulated: {number(worst[what])}",
            "cannot be judged: theirs is a real arm, ours a simulated one",
        ]
        for what in words
    ]


def _beaten(table: dict[str, Any]) -> list[Line]:
    lines: list[Line] = []
    for rows, block in table.items():
        for estimator, what, aim in (("joint-rbf", "unmatched", 1e4), ("joint-affine", "matched", 1e15)):
            mean, paper = block["ours"][estimator]["mean"], block["paper"]["mean"]
            text = f"NMIE of the table, {_said(rows)}, beaten {number(aim)} times, policy model {what}"
            lines.append([text, f"{SAID[estimator]}: {number(mean)}", "yes" if mean * aim <= paper else "**no**"])
    return lines


def _ranks(variants: dict[str, Any]) -> list[Line]:
    """How often the number of rows was found, where there were 20 trajectories or more."""
    cells = {
        (name, rows): cell["ours"]["auto"]["rows_right"]
        for name, block in variants.items()
        for rows, cell in block.items()
        if name not in FEW
    }
    out: list[Line] = []
    for said, shares in (
        (
            "number of rows found in 98 % of the runs with 20 or more trajectories",
            [v for (n, _), v in cells.items() if "own" not in n],
        ),
        (
            "... where each demonstrator rests elsewhere, and the learner is not told",
            [v for (n, _), v in cells.items() if "own" in n],
        ),
    ):
        share = sum(shares) / len(shares)
        out.append([said, f"{100 * share:.1f} %", "yes" if share >= ENOUGH else "**no**"])
    return out


def _bounds(bounds: dict[str, Any]) -> list[Line]:
    """Median NMIE within twice what the Cramer-Rao bound implies."""
    cells = [cell for block in bounds["ours"].values() for cell in block.values()]
    known = [cell for cell in cells if not cell["why"].startswith("not determined")]
    within = [cell for cell in known if not cell["why"]]
    return [
        [
            f"median NMIE of *{SAID['auto']}* within twice what the Cramer-Rao bound implies, with noise",
            f"{len(within)} of the {len(known)} cells that determine the rows; the others say why",
            "yes" if len(within) == len(known) else "**no**",
        ]
    ]
