"""A remedy works when it is obeyed: what a refusal says is done to the file that caused it, which is then read, or the
next sentence is another one.
"""

from __future__ import annotations

import ast
import gzip
import json
import re
import shutil
import zipfile
from collections.abc import Callable
from pathlib import Path

import pytest
from case import case
from library_source import library
from obeying import advised, said
from recording_corpus import CHAPTERS, GOOD, archive_cases, number_cases, other_kind_cases, text_cases
from refused_recordings import CASES

from manip_learn.cli import main

# of the corpus: what no advice can save says what is needed, and these are its words
NEEDED = re.compile(
    r"needed|save (it|the|again)|copy or save|is not read|more than|at most|are not opened|given|unpack it|correct|"
    r"again|no recorded motion|keep one|is left|write all|convert|leave|remove|of no known kind|check the path|"
    r"cannot|are left",
    re.IGNORECASE,
)
# what only a program in Python can do wrong
IN_PYTHON = {*("type", "span", "samples", "method", "missing", "joint-names", "duplicate-joint", "no-velocities")}
IN_PYTHON |= {"not-a-rollout"}
# words of a sentence -> what is done to the file that it is about
DEEDS: dict[str, Callable[[Path, str], Path]] = {}


def deed(words: str) -> Callable[[Callable[[Path, str], Path]], Callable[[Path, str], Path]]:
    """Registers what is done where a sentence has these words."""

    def register(action: Callable[[Path, str], Path]) -> Callable[[Path, str], Path]:
        DEEDS[words] = action
        return action

    return register


@deed("the row or remove it")
@deed("remove them")
@deed("remove the outlier")
def without_the_line(path: Path, sentence: str) -> Path:
    """The line that the sentence names, and those of `line 9, line 12, ...`, are taken out."""
    numbers = {int(n) for n in re.findall(rf"{re.escape(path.name)}:(\d+)", sentence)}
    numbers |= {int(n) for n in re.findall(r"line (\d+)", sentence)}
    lines = path.read_text(encoding="utf-8").split("\n")
    assert numbers and max(numbers) <= len(lines), sentence
    path.write_text("\n".join(line for i, line in enumerate(lines, 1) if i not in numbers), encoding="utf-8")
    return path


@deed("sort the rows")
def sorted_rows(path: Path, sentence: str) -> Path:
    """By their time; rows of one stamp are of recordings that were joined, of which the first is kept."""
    header, *rows = path.read_text(encoding="utf-8").rstrip("\n").split("\n")
    by_time = {float(row.split(",")[0]): row for row in reversed(rows)}
    path.write_text("\n".join([header, *(by_time[t] for t in sorted(by_time)), ""]), encoding="utf-8")
    return path


@deed("save the table as plain UTF-8 text")
def in_utf8(path: Path, sentence: str) -> Path:
    """As an editor does it."""
    content = path.read_bytes()
    text = content.decode("utf-16") if content.startswith((b"\xff\xfe", b"\xfe\xff")) else content.decode("latin-1")
    path.write_text("".join(c for c in text if c.isascii()), encoding="utf-8")
    return path


@deed("compressed with gzip: unpack it first")
def unpacked(path: Path, sentence: str) -> Path:
    """By gunzip."""
    path.with_suffix("").write_bytes(gzip.decompress(path.read_bytes()))
    return path.with_suffix("")


@deed("this zip archive holds no NumPy arrays")
def unzipped(path: Path, sentence: str) -> Path:
    """The first file in it."""
    with zipfile.ZipFile(path) as archive:
        archive.extract(archive.namelist()[0], path.parent)
        return path.parent / archive.namelist()[0]


@deed("run `git lfs pull`")
@deed("copy or save it again")
@deed("save it again")
def replaced(path: Path, sentence: str) -> Path:
    """By a good file of the same name."""
    path.write_text(GOOD, encoding="utf-8")
    return path


def obey(path: Path, words: list[str], sentence: str) -> tuple[Path, list[str]] | None:
    """The file and the options after obeying a sentence; None where it leaves nothing to do."""
    ways = [way for way in advised(sentence) if way[0] not in words]
    if ways:
        return path, [*words, *ways[0]]
    action = next((DEEDS[key] for key in DEEDS if key in sentence), None)
    return None if action is None else (action(path, sentence), words)


@pytest.mark.parametrize(
    "chapter", [text_cases, number_cases, other_kind_cases, archive_cases], ids=lambda c: c.__name__
)
def test_what_a_refusal_says_helps(chapter, capsys) -> None:
    """For every refused file of the corpus: obeyed, no sentence comes twice; without advice it says what is needed."""
    read = 0
    for entry in chapter():
        if entry.verdict in ("accept", "note", "velocity-order"):  # columns that were exchanged only their owner knows
            continue
        with case(entry.name, entry.verdict) as folder:
            path, heard = folder / entry.name, list[str]()
            entry.write(path)
            words = ["--degrees"] if entry.options.get("degrees") else []
            words += ["--units", entry.options["units"]] if "units" in entry.options else []
            while refused := said(["export", "planar3", str(path), "--out", str(folder / "out.csv"), *words], capsys):
                if refused in heard and "convert" in refused:  # what is to be converted, only its owner knows
                    break
                assert refused not in heard, f"{words}: heard again: {refused}"
                heard.append(refused)
                step = obey(path, words, refused) if len(heard) < 4 else None
                if step is None:
                    assert NEEDED.search(refused), refused
                    break
                path, words = step
            else:
                read += 1
    assert read > 0


def codes_of_recordings() -> set[str]:
    """Codes with which recordings are refused, as the source names them."""
    calls = [n for s in library() if s.top == "recordings" for n in ast.walk(s.tree) if isinstance(n, ast.Call)]
    said = [k.value for call in calls for k in call.keywords if k.arg == "code"]
    said += [a for call in calls if ast.unparse(call.func).endswith("refusal") for a in call.args[:2]]
    return {a.value for a in said if isinstance(a, ast.Constant) and re.fullmatch("[a-z-]{2,20}", str(a.value))}


def test_every_reason_has_a_remedy() -> None:
    """A recording is refused for no reason that is missing in these tables."""
    shown = {entry.code for entry in CASES.values()} | {entry.verdict for chapter in CHAPTERS for entry in chapter()}
    assert codes_of_recordings() <= shown | IN_PYTHON


@pytest.mark.parametrize("name", CASES)
def test_the_remedy_of_each_reason_works(name: str, tmp_path: Path, capsys) -> None:
    """The flags in a sentence are typed, or the file is mended as it says; it is then read, or the next is another."""
    entry, words = CASES[name], list(CASES[name].words)
    path, heard = entry.bad(tmp_path), list[str]()

    def export() -> dict[str, str]:
        out = tmp_path / f"out {len(heard)}"
        code = main(["export", "planar3", str(path), "--to", "csv", "--out", str(out), *words, "--json"])
        assert code in (0, 2)
        return json.loads(capsys.readouterr().out).get("error", {})

    while error := export():
        assert error["message"] not in heard, f"{words}: heard again: {error['message']}"
        assert heard or error["code"] == entry.code, error
        heard.append(error["message"])
        assert len(heard) < 4, heard
        if entry.good is not None:
            assert entry.says in error["message"], error
            for old in tmp_path.iterdir():
                shutil.rmtree(old) if old.is_dir() else old.unlink()
            path, words = entry.good(tmp_path), [w for w in words if w not in entry.undone]
        else:
            ways = advised(error["message"])
            assert ways, error
            words += ways[0]
    assert heard
