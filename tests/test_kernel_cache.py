"""Machine code on disk must never outlive the source that it was made from."""

from __future__ import annotations

import ast
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("numba", reason="the extra 'fast' is not installed")

import manip_learn as ml  # noqa: E402
from manip_learn.constraint import compiled_rows
from manip_learn.control.compiled import step_table  # noqa: E402
from manip_learn.robot.batch import compiled_kinematics, kernel_cache  # noqa: E402
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
                    module = node.module.removeprefix("manip_learn.").replace(".", "/")
                    files = {f"{module}/{alias.name}.py" for alias in node.names}
                    assert f"{module}.py" in known or files <= known, node.module


def test_compiled_functions_live_in_that_cache() -> None:
    """The kernels' machine code is kept in the folder that is named after their content."""
    assert content_stamp() in compiled_kinematics.jacobians.stats.cache_path


def test_the_first_compilation_is_announced(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """One sentence, so that nobody thinks that it hangs, to the caller or to the log; none once it is on disk."""
    constraint = ml.Constraint(np.eye(2), ml.FrameJacobian(ml.load_robot("planar3"), "tip", "x y"))
    controller, told = ml.ResolvedRateController(constraint), []
    ml.CompiledController(controller)  # on disk from here on, whichever test comes first
    caplog.clear()
    ml.CompiledController(controller)
    ml.CompiledController(controller, told.append)
    assert not told and not caplog.text
    monkeypatch.setattr(kernel_cache, "_FOLDER", tmp_path)
    ml.CompiledController(controller, told.append)
    ml.CompiledController(controller)
    assert len(told) == 1 and "once per machine" in told[0] and caplog.messages == told
    ml.simulate(controller.robot, controller, [0.1, 0.5, 0.5], 0.02, 0.01, compiled=True)
    assert caplog.messages == 2 * told
    ml.simulate(
        controller.robot,
        controller,
        [0.1, 0.5, 0.5],
        0.02,
        0.01,
        compiled=True,
        progress=lambda title, _: told.append(title),
    )
    assert told[1] == told[0] and len(caplog.messages) == 2


def test_simulation_is_imported_without_numba() -> None:
    """Loading numba takes longer than most rollouts: nothing imports it before it is to compile something."""
    code = "import sys, manip_learn.control.simulation; print('numba' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True, timeout=60)
    assert done.stdout.strip() == "False"
    assert step_table.LEAST_WIDTH == compiled_rows.MIX_WIDTH > compiled_kinematics.GRADIENT
