"""Fills in the pages about the reproduction, and about what goes beyond it, from results.

    python docs/fill_pages.py OUT docs/reproduction.md docs/beyond.md

The prose is written by hand; what stands between `<!-- begin NAME -->` and `<!-- end NAME -->` is replaced, and the
pictures beside the page are renewed. The tables that an experiment writes itself are taken as they are. Made here:
every claim of the paper in one row, judged as printed, with the aims of this project; and what the noisy experiments
say beyond the paper: what can be known, what is reached, and how well it is stated.
"""

from __future__ import annotations

import argparse
import json
import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import draw_results
from draw_results import most_frequent

from manip_learn.atomic_write import write_atomically
from manip_learn.errors import ManipLearnError, OutputError
from manip_learn.experiments import EXPERIMENTS
from manip_learn.experiments.bounds import UNKNOWABLE
from manip_learn.experiments.charts import save_figure
from manip_learn.experiments.experiment_result import markdown_table, mean_and_sd, number, percent, said_rows
from manip_learn.experiments.paper_setup import PAPER_ABSTRACT, PAPER_RMSE
from manip_learn.experiments.ways import SAID

PARTS = EXPERIMENTS["all"]
# page -> the blocks that it must have
PAGES: dict[str, tuple[str, ...]] = {
    "reproduction.md": ("settings", "claims", *PARTS[:7]),
    "beyond.md": ("settings", "identifiability", "efficiency", "calibration", "recorded", "beyond"),
}
PICTURES = "reproduction"


def write_page(results: Path, page: Path) -> list[Path]:
    """Fill in a page's tables and renew its pictures.

    Args:
        results: Output folder of `reproduce("all", ...)`.
        page: Markdown file with markers, named as one of `PAGES`.

    Returns:
        The files that were written.

    Raises:
        OutputError: A part of the results or a marker is missing, or a file cannot be written.
    """
    if page.name not in PAGES:
        raise OutputError(f"{page} is none of the pages that are filled in: {', '.join(PAGES)}")
    content = {part: _content(results, part) for part in PARTS}
    found = {part: c["result"] for part, c in content.items()}
    blocks = {part: _text(results / f"{part}.md") for part in PARTS}
    blocks["settings"] = _settings(content["table"]["settings"])
    blocks["claims"] = claims(found)
    blocks["identifiability"] = identifiability(found["bounds"])
    blocks["efficiency"] = efficiency(found["bounds"])
    blocks["calibration"] = calibration(found["bounds"], found["sawyer"])
    wanted = {name: blocks[name] for name in PAGES[page.name]}
    written = [write_atomically(page, filled(_text(page), wanted))]
    for part in PARTS:
        picture = results / f"{part}.png"
        if part in wanted and picture.is_file():
            written.append(write_atomically(page.parent / PICTURES / picture.name, picture.read_bytes()))
    # in place of the dots of all trials, and beside them
    if "bounds" in wanted:
        written += save_figure(draw_results.bounds(found["bounds"]), page.parent / PICTURES, "bounds", ("png",))
    if "beyond" in wanted:
        written += save_figure(draw_results.curves(), page.parent / PICTURES, "curves", ("png",))
    return written


def filled(text: str, blocks: dict[str, str]) -> str:
    """A text with something new between its markers.

    Raises:
        OutputError: A marker is missing.
    """
    for name, block in blocks.items():
        pattern = re.compile(rf"(<!-- begin {re.escape(name)} -->\n).*?(<!-- end {re.escape(name)} -->)", re.DOTALL)
        if not pattern.search(text):
            raise OutputError(f"the page has no markers '<!-- begin {name} -->' and '<!-- end {name} -->': add them")
        text = pattern.sub(lambda found, new=block: f"{found[1]}\n{new.strip()}\n\n{found[2]}", text)
    return text


def _settings(settings: dict[str, Any]) -> str:
    return f"The numbers on this page: `--trials {settings['trials']} --seed {settings['seed']}`."


def _content(results: Path, part: str) -> dict[str, Any]:
    path = results / f"{part}.json"
    try:
        content = json.loads(_text(path))
    except ValueError as error:
        raise OutputError(f"{path} is no JSON: {error}; run `manip-learn reproduce all` again") from error
    if not isinstance(content, dict) or content.get("experiment") != part:
        raise OutputError(f"{path} does not hold the results of {part!r}: run `manip-learn reproduce all` again")
    return content


def _text(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8")
    except OSError as error:
        raise OutputError(f"cannot read {path}: {error.strerror}; run `manip-learn reproduce all` first") from error


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


def _abstract(results: dict[str, Any]) -> list[Line]:
    """Errors below 1e-5 in simulation and 1e-2 with a real arm."""
    route = {rows: block["ours"]["separate-row-by-row"]["mean"] for rows, block in results["table"].items()}
    worst = max(route, key=lambda rows: route[rows])
    hard = [b["mie_held"]["worst"] for key, b in results["sawyer"]["ours"].items() if key.startswith("hard")]
    simulated, real = PAPER_ABSTRACT
    return [
        [
            f"Abstract: errors below {simulated:.0e} for simulated 3-joint systems",
            f"largest mean NMIE of the paper's route: {number(route[worst])} ({said_rows(worst)})",
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
        lines.append([f"Table, {said_rows(rows)}: NMIE {mean_and_sd(block['paper'])}", seen, verdict])
    return lines


def _rmse(rmse: dict[str, Any]) -> list[Line]:
    """Only beside the constraint that the paper tested."""
    block = rmse["ours"][rmse["paper"]["rows"]]
    route = block["separate"]["two_policies"]
    return [
        [
            f"RMSE of two trajectories' policies, {said_rows(rmse['paper']['rows'])}: "
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
            text = f"NMIE of the table, {said_rows(rows)}, beaten {number(aim)} times, policy model {what}"
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


EFFICIENT = ("auto", "joint-told", "joint-affine")


def identifiability(bounds: dict[str, Any]) -> str:
    """The least angle that any unbiased learner can have, over the number of trajectories."""
    cells = [one for _, _, one in _cells(bounds)]
    noise = most_frequent([one["noise"] for one in cells])
    rows = list(dict.fromkeys(rows for _, rows, _ in _cells(bounds)))
    counts = sorted({one["trajectories"] for one in cells if one["noise"] == noise})
    lines = []
    for count in counts:
        found = {r: one for _, r, one in _cells(bounds) if one["noise"] == noise and one["trajectories"] == count}
        angles = (found[r]["bound"]["angle_deg"] for r in rows)
        said = [number(a) if a <= UNKNOWABLE else f"{number(a)}: not determined" for a in angles]
        lines.append([str(count), *said, percent(max(found[r]["auto"]["refused"] for r in rows))])
        lines[-1].append(percent(min(found[r]["auto"]["warned"] + found[r]["auto"]["refused"] for r in rows)))
    header = [f"trajectories, noise {100 * noise:g} %", *(f"bound, rows {said_rows(r)} [deg]" for r in rows)]
    return markdown_table([*header, "refused, most", "refused or warned, least"], lines)


def efficiency(bounds: dict[str, Any]) -> str:
    """Root mean square error over the bound, and the share of stated intervals that hold the truth."""
    lines = []
    for key, rows, one in _cells(bounds):
        if one["bound"]["angle_deg"] > UNKNOWABLE:
            continue
        ratios = [number(one[name]["efficiency"]) for name in EFFICIENT]
        lines.append([key.removeprefix("noise "), said_rows(rows), number(one["bound"]["angle_deg"]), *ratios])
        lines[-1].append("-" if one["inside"] is None else f"{percent(one['inside'])} of {one['stated']}")
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
        lines.append([f"reaches, noise {100 * noise:g} %", str(total), percent(inside / total) if total else "-"])
    for source in ("kind physics", "hard physics"):
        found = [b for key, b in sawyer["ours"].items() if key.startswith(source) and b["inside"] is not None]
        total = sum(b["angle_deg"]["n"] for b in found)
        inside = sum(b["inside"] * b["angle_deg"]["n"] for b in found)
        lines.append([f"drawer, {source}, resamples of 50", str(total), percent(inside / total) if total else "-"])
    return markdown_table(["recordings", "answers", "truth inside the stated 68 %"], lines)


def _cells(bounds: dict[str, Any]) -> Iterator[tuple[str, str, dict[str, Any]]]:
    for key, block in bounds["ours"].items():
        for rows, one in block.items():
            yield key, rows, one


def main(arguments: list[str] | None = None) -> None:
    """Fill in pages from the command line."""
    parser = argparse.ArgumentParser(description="Fill in the pages about the reproduction from results.")
    parser.add_argument("results", type=Path, help="output folder of `manip-learn reproduce all`")
    parser.add_argument("pages", type=Path, nargs="+", help="docs/reproduction.md docs/beyond.md")
    options = parser.parse_args(arguments)
    try:
        written = [path for page in options.pages for path in write_page(options.results, page)]
    except ManipLearnError as error:
        parser.exit(2, f"error: {error}\n")
    print(*written, sep="\n")


if __name__ == "__main__":
    main()
