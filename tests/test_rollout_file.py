"""Rollout files: what is saved is what is loaded, and a damaged file is refused in a sentence."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from manip_learn.control.rollout import Rollout
from manip_learn.errors import RecordingError

T = 4
ROLLOUT = Rollout(
    np.arange(T) * 0.1,
    np.arange(2.0 * T).reshape(T, 2),
    np.ones((T, 2)),
    np.full(T, 0.5),
    ("ok", "ok", "damped", "ok"),
    ("a", "b"),
    np.zeros(T),
)


KINDS = {
    "missing": lambda path: None,
    "folder": lambda path: path.mkdir(),
    "empty": lambda path: path.write_bytes(b""),
    "text": lambda path: path.write_text("time,q\n0,1\n", encoding="utf-8"),
    "other npz": lambda path: np.savez(path, q=np.zeros(3)),
    "pickle": lambda path: np.savez(path, format=np.array([{}], dtype=object)),
}


@pytest.mark.parametrize("kind", KINDS)
def test_other_files_are_refused(kind, tmp_path):
    """No file, a folder, or a file of another kind is a RecordingError that names it."""
    KINDS[kind](tmp_path / "r.npz")
    with pytest.raises(RecordingError, match=r"r\.npz"):
        Rollout.load(tmp_path / "r.npz")


def test_a_table_that_was_cut_or_changed_is_refused(tmp_path):
    """The file says how many samples it has, and each status is one of the words."""
    lines = ROLLOUT.save(tmp_path / "whole.csv").read_text(encoding="utf-8").splitlines(keepends=True)
    for content, said in ((lines[:-1], "samples"), ([line.replace("damped", "fine") for line in lines], "'fine'")):
        (tmp_path / "r.csv").write_text("".join(content), encoding="utf-8")
        with pytest.raises(RecordingError, match=said):
            Rollout.load(tmp_path / "r.csv")


def whole_file() -> bytes:
    """The bytes of a good file, uncompressed so that damage reaches the arrays' headers too."""
    stream = io.BytesIO()
    arrays = {
        n: getattr(ROLLOUT, n) for n in ("time", "q", "u", "manipulability", "task_error", "status", "joint_names")
    }
    np.savez(stream, format=np.array("manip_learn.rollout"), **arrays)
    return stream.getvalue()


@given(cut=st.floats(0.0, 1.0), changes=st.lists(st.tuples(st.floats(0.0, 0.999999), st.integers(0, 255)), max_size=6))
@pytest.mark.fuzz
def test_damaged_files_are_refused_or_harmless(tmp_path_factory, cut, changes):
    """Whatever bytes are changed or missing, loading gives a rollout or a RecordingError, never anything else."""
    content = bytearray(whole_file())
    for place, value in changes:
        content[int(place * len(content))] = value
    path = Path(tmp_path_factory.getbasetemp()) / "damaged.npz"
    path.write_bytes(content[: max(1, int(np.ceil(cut * len(content))))])
    try:
        Rollout.load(path)
    except RecordingError as error:
        assert "damaged.npz" in str(error)
