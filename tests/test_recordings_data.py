"""The shipped recordings are what examples/data/README.md says they are."""

from __future__ import annotations

import importlib
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from case import case
from jaxtyping import Float

from manip_learn.robot import Robot, load_robot

EXAMPLES = Path(__file__).resolve().parents[1] / "examples"
DATA = EXAMPLES / "data"
MADE_WITH = "4.0.0"  # MuJoCo; other versions give other last digits
DRAWER_AXIS = np.array([np.cos(np.deg2rad(25.0)), np.sin(np.deg2rad(25.0)), 0.0])
FOLDERS = {"sawyer_drawer": ("sawyer", 50), "sawyer_door": ("sawyer", 8), "planar3_reach": ("planar3", 20)}


def files_of(folder: str) -> list[Path]:
    return sorted((DATA / folder).glob("demo_*.csv"))


def read(path: Path) -> tuple[list[str], Float[np.ndarray, "T columns"]]:
    header = path.read_text(encoding="utf-8").split("\n", 1)[0].split(",")
    return header, np.loadtxt(path, delimiter=",", skiprows=1)


@pytest.fixture(scope="module")
def sawyer() -> Robot:
    return load_robot("sawyer")


@pytest.fixture
def example(monkeypatch: pytest.MonkeyPatch):
    """Imports a script of examples/ as it would run there."""
    monkeypatch.syspath_prepend(str(EXAMPLES))

    def load(name: str) -> ModuleType:
        return importlib.import_module(name)

    return load


def test_files_are_complete_and_name_the_robots_joints() -> None:
    """The promised number of files; columns named like the robot's joints; finite; even time from 0; inside limits."""
    for folder in FOLDERS:
        with case(folder):
            name, count = FOLDERS[folder]
            robot, paths = load_robot(name), files_of(folder)
            assert [p.name for p in paths] == [f"demo_{i:02d}.csv" for i in range(1, count + 1)]
            for path in paths:
                header, rows = read(path)
                assert header[: robot.nv + 1] == ["time", *robot.joint_names]
                assert np.all(np.isfinite(rows)) and rows[0, 0] == 0.0
                np.testing.assert_allclose(np.diff(rows[:, 0]), rows[1, 0], atol=1e-12)
                q = rows[:, 1 : robot.nv + 1]
                assert np.all(q > robot.position_lower) and np.all(q < robot.position_upper)


def test_the_script_writes_the_planar_files_again(example, tmp_path: Path) -> None:
    """Same seed, same numbers, but for the last digit."""
    example("record_planar_reaching").main([str(tmp_path)])
    for path in files_of("planar3_reach"):
        header, rows = read(tmp_path / path.name)
        assert header == read(path)[0]
        np.testing.assert_allclose(rows, read(path)[1], rtol=0.0, atol=2e-7)


@pytest.mark.slow
@pytest.mark.parametrize(("script", "folder", "number"), [("drawer", "sawyer_drawer", 7), ("door", "sawyer_door", 3)])
def test_the_scripts_record_a_physics_file_again(
    example, tmp_path: Path, sawyer: Robot, script: str, folder: str, number: int
) -> None:
    """With the MuJoCo that made the files: the same demonstration within rounding."""
    mujoco = pytest.importorskip("mujoco")
    if mujoco.__version__ != MADE_WITH:
        pytest.skip(f"the files were made with MuJoCo {MADE_WITH}, this is {mujoco.__version__}")
    example(f"record_{script}_physics").main([str(tmp_path), "--only", str(number)])
    (written,) = tmp_path.iterdir()
    np.testing.assert_allclose(read(written)[1], read(DATA / folder / written.name)[1], rtol=0.0, atol=2e-5)


@pytest.mark.slow
def test_the_grip_keeps_to_the_rail(example, sawyer: Robot) -> None:
    """In the simulation the grip point stays within 0.1 mm of a straight line along the drawer's axis."""
    pytest.importorskip("mujoco")
    recording = example("record_drawer_physics").record_one(1, sawyer)
    way = np.array([sawyer.pose(q, sawyer.frame("right_gripper_tip"))[:3, 3] for q in recording.exact])
    way -= way[0]
    assert np.max(np.linalg.norm(way - np.outer(way @ DRAWER_AXIS, DRAWER_AXIS), axis=1)) < 1e-4
    np.testing.assert_allclose(-way @ DRAWER_AXIS, recording.way, atol=1e-4)
