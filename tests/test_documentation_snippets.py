"""Every snippet of the documentation runs, and what is shown as its output is what came out."""

from __future__ import annotations

import glob
import re
import shlex
import sys
from pathlib import Path

import pytest
from documentation_blocks import Block, blocks, differences, tabs
from documentation_scene import furnish, vendors
from vendor_fakes import Clock

from manip_learn.cli import main

ROOT = Path(__file__).resolve().parents[1]
PAGES = [p for p in [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))] if "_build" not in p.parts]
# what a shell block may hold beside commands of this program
OTHER_PROGRAMS = re.compile(r"(\$ )?(pip|python|make|cd|dask|export|ssh|source|ros2|jupyter)\b|#")


def is_runnable(block: Block) -> bool:
    """Python, or command lines of this program."""
    return block.language == "python" or bool(block.commands)


WITH_SNIPPETS = [page for page in PAGES if any(map(is_runnable, blocks(page)))]


# pages that learn many times, and a tab whose arm has large meshes
LONG = ("learning_options", "record_demonstrations", "interpret_the_result", "arms-lerobot")


@pytest.mark.parametrize(
    ("page", "tab"),
    [
        pytest.param(page, tab, marks=[pytest.mark.slow] * (name in LONG), id=name)
        for page in WITH_SNIPPETS
        for tab in tabs(page)
        for name in [f"{page.stem}-{tab}".rstrip("-")]
    ],
)
@pytest.mark.timeout(300)
def test_snippets_run(page, tab, tmp_path, monkeypatch, capsys):
    """The blocks of a page run in their order, share their names and files, and print what the page shows.

    They find no other names. Of a page with tabs each tab runs by itself, with the blocks outside of tabs.
    """
    furnish(tmp_path, page.stem, tab)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "160")
    if fakes := vendors(page.stem, tab):
        monkeypatch.setattr("manip_learn.control.driver.time", Clock())  # 500 Hz is too much for a busy machine
        for name, module in fakes.items():
            monkeypatch.setitem(sys.modules, name, module)
    names: dict[str, object] = {"__name__": "page"}
    printed = ""
    for block in (b for b in blocks(page) if b.tab in ("", tab)):
        if block.skipped:
            printed = ""
        elif is_runnable(block):
            capsys.readouterr()
            run(block, names)
            printed = capsys.readouterr().out
        elif block.language == "text" and printed:
            missing = differences(block.text, printed)
            assert not missing, f"{page.name}:{block.line} shows what is not printed:\n{missing}\nprinted:\n{printed}"


def run(block: Block, names: dict[str, object]) -> None:
    """Run Python in the page's names; command lines in this process, with file patterns replaced by the files."""
    where = f"{block.page.name}:{block.line}"
    if block.language == "python":
        exec(compile(block.text, where, "exec"), names)
        return
    for line in block.commands:
        words = shlex.split(line, comments=True)[1:]
        typed = [f for word in words for f in (sorted(glob.glob(word)) if "*" in word else [word])]
        assert main(typed) == 0, f"{where}: {line}"


def test_each_block_says_what_it_is():
    """A block that is not run says why; Python and shell blocks are fenced as such, and no reason stands elsewhere."""
    faults = []
    for page in PAGES:
        all_blocks = list(blocks(page))
        if page.read_text(encoding="utf-8").count("<!-- not run: ") != sum(bool(b.skipped) for b in all_blocks):
            faults.append(f"{page.name}: a reason before no block")
        for block in all_blocks:
            lines = re.sub(r"\\\n\s*", " ", block.text).splitlines() if block.language == "bash" else []
            faults += [
                f"{page.name}:{block.line}: {line}"
                for line in lines
                if line.strip() and line not in block.commands and not OTHER_PROGRAMS.match(line.strip())
            ]
    assert not faults, faults


def test_an_output_is_compared_in_words_and_numbers():
    """Line breaks, times and last digits do not count; words, numbers and their order do."""
    printed = "constraints 2 of 3 rows, gap 308 (clear)\n ─────── \nlearnt from 16361 samples in 3.1 s\n"
    for shown, same in (
        ("gap 308 (clear)\nlearnt from 16361 samples in 2.6 s", True),
        ("gap 300 (clear) learnt from\n16361 samples in 90 s", True),
        ("...\nlearnt from 16361 samples\n...", True),
        ("gap 30 (clear)", False),
        ("gap 308 (weak)", False),
        ("learnt from 16361 samples\n...\ngap 308", False),
    ):
        assert (not differences(shown, printed)) is same, shown
