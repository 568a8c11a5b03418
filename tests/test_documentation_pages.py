"""The check that `make docs` runs on the built pages finds what it is there for."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import pytest

CHECK = Path(__file__).resolve().parents[1] / "docs" / "check_pages.py"
GOOD = '<h1 id="top">A</h1><a href="b.html#there">b</a><a href="#top">up</a><a href="https://example.org">site</a>'
OTHER = '<p id="there"><img src="picture.png"></p><link rel="canonical" href="https://example.org/b.html">'


@pytest.fixture(scope="module")
def check():
    """The script as a module."""
    spec = importlib.util.spec_from_file_location("check_pages", CHECK)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture
def site(tmp_path):
    """Two pages and a picture, without a fault."""
    (tmp_path / "a.html").write_text(GOOD, encoding="utf-8")
    (tmp_path / "b.html").write_text(OTHER, encoding="utf-8")
    (tmp_path / "picture.png").write_bytes(b"")
    return tmp_path


def test_sound_pages_have_no_fault(check, site):
    """Links to files, anchors and other sites are fine, and so is a name in the head of a page."""
    assert list(check.faults_of_pages(site)) == []


def test_each_fault_is_found(check, site):
    """What is loaded from the network, and what links to nothing, is named with its page."""
    for fault, words in (
        ('<script src="https://cdn.example.org/mathjax.js"></script>', "loads https://cdn.example.org/mathjax.js"),
        ('<link rel="stylesheet" href="//fonts.example.org/css">', "loads //fonts.example.org/css"),
        ('<img src="http://example.org/badge.svg">', "loads http://example.org/badge.svg"),
        ("<style>@font-face { src: url('https://x.org/f.woff2') }</style>", "loads https://x.org/f.woff2"),
        ('<a href="c.html">c</a>', "c.html: no such file"),
        ('<a href="b.html#here">b</a>', "b.html#here: no such anchor"),
        ('<a href="#bottom">down</a>', "#bottom: no such anchor"),
        ('<img src="other.png">', "other.png: no such file"),
    ):
        (site / "a.html").write_text(GOOD + fault, encoding="utf-8")
        assert list(check.faults_of_pages(site)) == [f"a.html: {words}"]


def test_style_sheets_load_nothing_from_the_network(check, site):
    """Fonts and further sheets are looked for in the sheets too."""
    (site / "style.css").write_text('@import "https://example.org/more.css";', encoding="utf-8")
    assert list(check.faults_of_pages(site)) == ["style.css: loads https://example.org/more.css"]


def test_links_of_markdown_files_have_targets(check, tmp_path):
    """README and its like: a file or a heading that does not exist is named."""
    text = "# A title, here\n[a](b.md) [b](#a-title-here) [c](c.md) [d](b.md#none) [e](https://example.org/x.md)\n"
    (tmp_path / "README.md").write_text(text, encoding="utf-8")
    (tmp_path / "b.md").write_text("# B\n", encoding="utf-8")
    assert list(check.faults_of_markdown(tmp_path)) == [
        "README.md: c.md: no such file",
        "README.md: b.md#none: no such heading",
    ]


def test_links_of_the_markdown_files_here(check):
    """README, CONTRIBUTING and the pages beside recordings and robots link to what exists."""
    assert list(check.faults_of_markdown(check.ROOT)) == []
