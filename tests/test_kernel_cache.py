"""Machine code on disk must never outlive the source that it was made from."""

from __future__ import annotations

import ast
import shutil
from pathlib import Path

import pytest

pytest.importorskip("numba", reason="the extra 'fast' is not installed")

from manip_learn.robot.batch.kernel_cache import CONSTANT_FILES, KERNEL_FILES, PACKAGE, content_stamp  # noqa: E402


def test_a_change_of_any_kernel_file_makes_a_new_cache(tmp_path: Path) -> None:
    """One byte more in one of the files gives another folder; the same content gives the same."""
    for name in (*KERNEL_FILES, *CONSTANT_FILES):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(PACKAGE / name, tmp_path / name)
    assert content_stamp(tmp_path) == content_stamp()
    seen = {content_stamp()}
    for name in (*KERNEL_FILES, *CONSTANT_FILES):
        with (tmp_path / name).open("a") as file:
            file.write(" ")
        seen.add(content_stamp(tmp_path))
    assert len(seen) == 1 + len(KERNEL_FILES) + len(CONSTANT_FILES)


def test_all_kernel_files_are_known() -> None:
    """Every file with compiled functions, and every file of the library that one of them imports from, is counted."""
    known = {
        *KERNEL_FILES,
        *CONSTANT_FILES,
        "robot/batch/chain.py",
        "robot/batch/kernel_cache.py",
    }  # the last two: Python only
    for path in PACKAGE.rglob("*.py"):
        text, name = path.read_text(encoding="utf-8"), str(path.relative_to(PACKAGE))
        if "@compiled" in text and name != "robot/batch/kernel_cache.py":
            assert name in KERNEL_FILES, name
            for node in ast.walk(ast.parse(text)):
                if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("manip_learn."):
                    assert node.module.removeprefix("manip_learn.").replace(".", "/") + ".py" in known, node.module


def test_compiled_functions_live_in_that_cache() -> None:
    """The kernels' machine code is kept in the folder that is named after their content."""
    from manip_learn.robot.batch import compiled_kinematics

    assert content_stamp() in compiled_kinematics.jacobians.stats.cache_path
