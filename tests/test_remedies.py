"""A remedy works when it is obeyed: what a refusal says is done to the file that caused it, which is then read, or the
next sentence is another one.
"""

from __future__ import annotations

import ast
import json
import re
import shutil
from pathlib import Path

import pytest
from library_source import library
from obeying import advised
from recording_corpus import CASES as CORPUS
from refused_recordings import CASES

from manip_learn.cli import main

# what only a program in Python can do wrong
IN_PYTHON = {*("type", "span", "samples", "method", "missing", "joint-names", "duplicate-joint", "no-velocities")}
IN_PYTHON |= {"not-a-rollout"}


def codes_of_recordings() -> set[str]:
    """Codes with which recordings are refused, as the source names them."""
    calls = [n for s in library() if s.top == "recordings" for n in ast.walk(s.tree) if isinstance(n, ast.Call)]
    said = [k.value for call in calls for k in call.keywords if k.arg == "code"]
    said += [a for call in calls if ast.unparse(call.func).endswith("refusal") for a in call.args[:2]]
    return {a.value for a in said if isinstance(a, ast.Constant) and re.fullmatch("[a-z-]{2,20}", str(a.value))}


def test_every_reason_has_a_remedy() -> None:
    """A recording is refused for no reason that is missing in these tables."""
    shown = {entry.code for entry in CASES.values()} | {entry.verdict for entry in CORPUS}
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
