"""The check that `make docs` runs on built pages finds what it is for; figures are drawn from their tables."""

from __future__ import annotations

import csv
import importlib.util
import re
from pathlib import Path
from types import ModuleType

import pytest

DOCS = Path(__file__).resolve().parents[1] / "docs"
GOOD = '<h1 id="top">A</h1><a href="b.html#there">b</a><a href="#top">up</a><a href="https://example.org">site</a>'
OTHER = '<p id="there"><img src="picture.png"></p><link rel="canonical" href="https://example.org/b.html">'


def script(path: Path) -> ModuleType:
    """A script as a module."""
    spec = importlib.util.spec_from_file_location(path.stem, path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def check():
    """The check of the pages."""
    return script(DOCS / "check_pages.py")


FAULTS = {
    "": (),
    '<script src="https://cdn.example.org/mathjax.js"></script>': "loads https://cdn.example.org/mathjax.js",
    "<style>@font-face { src: url('https://x.org/f.woff2') }</style>": "loads https://x.org/f.woff2",
    '<a href="c.html">c</a>': "c.html: no such file",
    '<a href="b.html#here">b</a>': "b.html#here: no such anchor",
}


def test_each_fault_of_a_page_is_found(check, tmp_path):
    """What is loaded from the network, also by style sheets, and what links to nothing, is named with its page; links
    to files, anchors and other sites are fine, and so is a name in the head of a page.
    """
    (tmp_path / "b.html").write_text(OTHER, encoding="utf-8")
    (tmp_path / "picture.png").write_bytes(b"")
    for fault, words in FAULTS.items():
        (tmp_path / "a.html").write_text(GOOD + fault, encoding="utf-8")
        assert list(check.faults_of_pages(tmp_path)) == ([f"a.html: {words}"] if words else []), fault
    (tmp_path / "a.html").write_text(GOOD, encoding="utf-8")
    (tmp_path / "style.css").write_text('@import "https://example.org/more.css";', encoding="utf-8")
    assert list(check.faults_of_pages(tmp_path)) == ["style.css: loads https://example.org/more.css"]


def test_links_of_markdown_files_have_targets(check, tmp_path):
    """README and its like: a file or a heading that does not exist is named, and those here have none."""
    text = "# A title, here\n[a](b.md) [b](#a-title-here) [c](c.md) [d](b.md#none) [e](https://example.org/x.md)\n"
    (tmp_path / "README.md").write_text(text, encoding="utf-8")
    (tmp_path / "b.md").write_text("# B\n", encoding="utf-8")
    assert list(check.faults_of_markdown(tmp_path)) == [
        "README.md: c.md: no such file",
        "README.md: b.md#none: no such heading",
    ]
    assert list(check.faults_of_markdown(check.ROOT)) == []


def test_each_figure_is_drawn_from_its_table(tmp_path):
    """The script that draws the pictures of the pages of figures makes each picture that is there."""
    pytest.importorskip("matplotlib", reason="the extra 'experiments' is not installed")
    plot = script(DOCS / "figures" / "plot.py")
    tables, plot.HERE = plot.HERE, tmp_path
    for table in tables.glob("*.csv"):
        (tmp_path / table.name).symlink_to(table)
    plot.main()
    assert {p.name for p in tmp_path.glob("*.svg")} == {p.name for p in tables.glob("*.svg")}


def test_each_figure_says_where_it_comes_from():
    """A table or picture without commit, day and command, or on no page, would be named."""
    assert list(script(DOCS / "list_figures.py").faults_of_figures()) == []


ARM_PAGES = [DOCS / f"{name}.md" for name in ("arms", "run_on_your_arm", "control")]


@pytest.mark.parametrize("page", [*ARM_PAGES, DOCS.parent / "SECURITY.md"], ids=lambda page: page.stem)
def test_a_detected_force_is_told_from_what_is_measured(page):
    """15 N across is what a loop detects; the larger forces that are measured stand in a sentence of their own."""
    with (DOCS / "figures" / "servos_jams.csv").open(encoding="utf-8") as file:
        rows = {row["speed [m/s]"]: row for row in csv.DictReader(file) if row["driven [N]"] == "60"}
    text = " ".join(page.read_text(encoding="utf-8").split())
    detects = [sentence for sentence in re.split(r"(?<=[a-z])[.:] ", text) if "15 N across" in sentence]
    assert detects and all("detects" in sentence and "88 N" not in sentence for sentence in detects)
    for speed in ("0.06", "0.25"):
        median, worst = rows[speed]["largest, median and worst [N]"].split(", ")
        assert re.search(rf"{median} N \({worst}( at worst)?\) at {speed} m/s", text), (page, speed)


@pytest.mark.parametrize("page", ["arms", "run_on_your_arm"])
def test_a_stand_in_is_not_called_a_simulation(page):
    """What goes at once where it is sent has no dynamics: the page says so at its head, and each tab of such an arm."""
    text = (DOCS / f"{page}.md").read_text(encoding="utf-8")
    head = " ".join(text.partition("\n## ")[0].split())
    assert "without dynamics" in head and "ried only in simulation" not in head and "in simulation only" not in head
    if page == "arms":
        for arm in ("ur", "xarm", "lerobot", "ros2_control"):
            first_words = text.partition(f"\n:sync: {arm}\n")[2].partition("```")[0]
            assert "without dynamics" in first_words, arm
