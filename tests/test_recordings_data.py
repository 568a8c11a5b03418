"""The shipped recordings are what examples/data says they are, and the scripts beside them make them again."""

from __future__ import annotations

import importlib
import json
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from task_sets import DATA, EXAMPLES, arm

from manip_learn.recordings import load_demonstrations
from manip_learn.robot import Robot

SHIPPED = ("panda_drawer_whole", "xarm7_drawer_then_table", "ur5_loose_door", "panda_drawer_mixed")
HELD = "drawer_then_table door_offset table_flat hinge screw sleeve tether joystick".split()
EXACT, NOISY = 1e-9, 2e-4  # [m]; with 1e-4 rad of noise, a lever of up to 0.9 m and several joints


def files_of(folder: str) -> list[Path]:
    return sorted((DATA / folder).glob("demo_*.csv"))


def read(path: Path) -> tuple[list[str], np.ndarray]:
    return path.read_text(encoding="utf-8").split("\n", 1)[0].split(","), np.loadtxt(path, delimiter=",", skiprows=1)


@pytest.fixture
def part(monkeypatch: pytest.MonkeyPatch) -> Callable[[str], ModuleType]:
    """Imports a module of examples/ as it would be found there."""
    monkeypatch.syspath_prepend(str(EXAMPLES))
    return importlib.import_module


def worst(part, robot: Robot, trajectories: list, truth: dict[str, Any]) -> np.ndarray:
    """Return the largest violation of the truth in any window of any demonstration [m], [rad]."""
    check, violations = part("make_recordings.truth_check"), [(0.0, 0.0)]
    for number, (time, q) in enumerate(trajectories):
        windows = check.windows_of(robot, truth, number, time, q)
        violations += [check.violation(mechanism, poses) for mechanism, poses in windows]
    return np.max(violations, axis=0)


@pytest.mark.parametrize("folder", SHIPPED)
def test_shipped_recordings_obey_their_truth(part, folder: str) -> None:
    """Each shipped window obeys the shipped truth to the noise of the encoders; the reader accepts the files."""
    truth = json.loads((DATA / folder / "truth.json").read_text(encoding="utf-8"))
    rows, robot = [read(path)[1] for path in files_of(folder)], arm(truth["robot"])
    assert len(rows) == len(truth["windows"]) == len(load_demonstrations(DATA / folder, robot).trajectories)
    linear, _ = worst(part, robot, [(r[:, 0], r[:, 1:]) for r in rows], truth)
    assert 1e-5 < linear < NOISY


def test_the_script_writes_the_planar_files_again(part, tmp_path: Path) -> None:
    """Same seed, same numbers, but for the last digit."""
    part("record_planar_reaching").main([str(tmp_path)])
    for path in files_of("planar3_reach"):
        (header, rows), (shipped_header, shipped) = read(tmp_path / path.name), read(path)
        assert header == shipped_header
        np.testing.assert_allclose(rows, shipped, rtol=0.0, atol=2e-7)


@pytest.mark.parametrize("kind", HELD)
def test_the_tip_obeys_the_truth(part, kind: str) -> None:
    """Without noise the windows obey type, axis, point, radius and pitch exactly, and last a second in all."""
    name = ("panda", "xarm7", "ur5")[HELD.index(kind) % 3]
    trajectories, truth = part("make_recordings.kinematic_sets").make_set(kind, name, 5, 2, noise=0.0)
    assert max(worst(part, arm(name), trajectories, truth)) < EXACT
    assert all(sum(end - start for start, end, _ in windows) > 1.0 for windows in truth["windows"])
