"""The page about the reproduction, filled in from results: `python -m manip_learn.experiments.documentation OUT PAGE`.

The prose is written by hand; what stands between `<!-- begin NAME -->` and `<!-- end NAME -->` is replaced, and the
pictures beside the page are renewed.
"""

from __future__ import annotations

import argparse
import json
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from manip_learn.atomic_write import write_atomically
from manip_learn.errors import ManipLearnError, OutputError
from manip_learn.experiments.experiment_result import markdown_table, mean_and_sd, number

PARTS = ("table", "variants", "rmse", "singular-start", "near-singular-start", "sawyer", "beyond")
PICTURES = "reproduction"


def write_page(results: Path, page: Path) -> list[Path]:
    """Fill in the page's tables and renew its pictures.

    Args:
        results: Output folder of `reproduce("all", ...)`.
        page: Markdown file with markers.

    Returns:
        The files that were written.

    Raises:
        OutputError: A part of the results or a marker is missing, or a file cannot be written.
    """
    blocks = {part: _text(results / f"{part}.md") for part in PARTS}
    content = {part: _content(results, part) for part in PARTS}
    blocks["settings"] = _settings(content["table"]["settings"])
    blocks["claims"] = claims({part: c["result"] for part, c in content.items()})
    written = [write_atomically(page, filled(_text(page), blocks))]
    for part in PARTS:
        picture = results / f"{part}.png"
        if picture.is_file():
            written.append(write_atomically(page.parent / PICTURES / picture.name, picture.read_bytes()))
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


def claims(results: dict[str, Any]) -> str:
    """The paper's numbers and the aims of this project one by one, with what became of them."""
    lines: list[Sequence[object]] = []
    for rows, block in results["table"].items():
        paper, ours = block["paper"]["mean"], block["ours"]
        name = rows.replace("rz", "theta")
        route = ours["separate-row-by-row"]["mean"]
        factor = route / paper
        verdict = "yes, lower" if factor <= 1.0 else f"no lower, {factor:.2g} times higher"
        lines.append(
            [f"Table, {name}: NMIE {mean_and_sd(block['paper'])}", f"the paper's route: {number(route)}", verdict]
        )
        for estimator, what, aim in (("joint-rbf", "unmatched policy model", 1e4), ("joint-affine", "matched", 1e15)):
            mean = ours[estimator]["mean"]
            reached = "yes" if mean * aim <= paper else "no"
            lines.append([f"... beaten {number(aim)} times, {what} (our aim)", f"joint: {number(mean)}", reached])
    for rows, block in results["rmse"]["ours"].items():
        seen = f"separate {number(block['separate']['mean'])}, joint {number(block['joint-rbf']['mean'])}"
        better = block["separate"]["mean"] <= results["rmse"]["paper"]["mean"]
        lines.append(
            [f"RMSE of the policy 2.1e-04 ({rows.replace('rz', 'theta')})", seen, "yes, lower" if better else "no"]
        )
    sawyer = results["sawyer"]
    worst = {what: max(b[what]["mean"] for b in sawyer["ours"].values()) for what in ("mie", "rmse")}
    for what, printed in (("mie", sawyer["paper"]["mie"]), ("rmse", sawyer["paper"]["rmse"]["mean"])):
        verdict = "lower, but not the same thing: theirs is a real arm"
        lines.append(
            [f"Drawer, {what.upper()} {number(printed)}", f"worst of our readings: {number(worst[what])}", verdict]
        )
    for part in ("singular-start", "near-singular-start"):
        for claim in results[part]["claims"]:
            if claim["source"] == "paper":
                lines.append([claim["text"], claim["seen"], "yes" if claim["holds"] else "**no**"])
    lines += _ranks(results["variants"])
    return markdown_table(["claim or aim", "here", "reproduced or reached"], lines)


def _ranks(variants: dict[str, Any]) -> list[Sequence[object]]:
    """How often the number of rows was found, where there were 20 trajectories or more."""
    cells = {
        (name, rows): cell["ours"]["auto"]["rows_right"]
        for name, block in variants.items()
        for rows, cell in block.items()
        if name not in ("1 trajectory", "5 trajectories")
    }
    plain = [v for (name, _), v in cells.items() if "own" not in name]
    own = [v for (name, _), v in cells.items() if "own" in name]
    out: list[Sequence[object]] = []
    aim = "number of rows found in 98 % of runs with 20 or more trajectories (our aim)"
    share = sum(plain) / len(plain)
    out.append([aim, f"{100 * share:.1f} %", "yes" if share >= 0.98 else "no"])
    share = sum(own) / len(own)
    verdict = "yes" if share >= 0.98 else "**no**"
    out.append(
        ["... where each demonstrator rests elsewhere, and the learner is not told", f"{100 * share:.0f} %", verdict]
    )
    return out


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


def main(arguments: list[str] | None = None) -> None:
    """Fill in a page from the command line."""
    parser = argparse.ArgumentParser(description="Fill in the page about the reproduction from results.")
    parser.add_argument("results", type=Path, help="output folder of `manip-learn reproduce all`")
    parser.add_argument("page", type=Path, help="docs/reproduction.md")
    options = parser.parse_args(arguments)
    try:
        written = write_page(options.results, options.page)
    except ManipLearnError as error:
        parser.exit(2, f"error: {error}\n")
    print(*written, sep="\n")


if __name__ == "__main__":
    main()
