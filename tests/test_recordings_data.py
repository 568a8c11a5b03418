"""The shipped recordings are what examples/data/README.md says they are."""

from __future__ import annotations

import importlib
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from case import case
from jaxtyping import Float
from scipy.signal import savgol_filter

from manip_learn.robot import Robot, load_robot

EXAMPLES = Path(__file__).resolve().parents[1] / "examples"
DATA = EXAMPLES / "data"
MADE_WITH = "4.0.0"  # MuJoCo; other versions give other last digits
DRAWER_AXIS = np.array([np.cos(np.deg2rad(25.0)), np.sin(np.deg2rad(25.0)), 0.0])
DOOR_TWIST = np.array([0.0855, 0.0554, 0.3142, 0.5860, 0.6848, -0.2802])
FOLDERS = {"sawyer_drawer": ("sawyer", 50), "sawyer_door": ("sawyer", 8), "planar3_reach": ("planar3", 20)}


def files_of(folder: str) -> list[Path]:
    return sorted((DATA / folder).glob("demo_*.csv"))


def read(path: Path) -> tuple[list[str], Float[np.ndarray, "T columns"]]:
    header = path.read_text(encoding="utf-8").split("\n", 1)[0].split(",")
    return header, np.loadtxt(path, delimiter=",", skiprows=1)


def spread_of_motion(robot: Robot, frame: str, paths: list[Path], reference: str, rows: int) -> tuple:
    """Singular values of the frame's motion, largest first, and its directions as columns."""
    tip, window = robot.frame(frame), 21
    M = np.zeros((rows, rows))
    for path in paths:
        q = read(path)[1][:, 1:]
        u = savgol_filter(q, window, 3, deriv=1, delta=0.01, axis=0)
        smooth = savgol_filter(q, window, 3, axis=0)
        for k in range(window // 2, len(q) - window // 2):
            motion = robot.jacobian(smooth[k], tip, reference)[:rows] @ u[k]
            M += np.outer(motion, motion)
    values, directions = np.linalg.eigh(M)
    return np.sqrt(np.maximum(values, 0.0))[::-1], directions[:, ::-1]


def angle_between(a: np.ndarray, b: np.ndarray) -> float:
    """Angle of two lines [deg]."""
    cosine = abs(float(a @ b)) / (np.linalg.norm(a) * np.linalg.norm(b))
    return float(np.rad2deg(np.arccos(min(cosine, 1.0))))


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


def test_the_recordings_stay_small() -> None:
    """All files together stay below 2.7 MB, since they are shipped in the wheel; 0.5 of it are the hard drawers."""
    assert sum(p.stat().st_size for p in DATA.rglob("*.csv")) < 2.7e6


def test_physics_recordings_last_three_to_four_seconds_at_100_hz_without_velocities() -> None:
    """Positions only, 100 Hz, 3 to 4 s, and noise of an encoder's size in every joint."""
    for folder in ["sawyer_drawer", "sawyer_door"]:
        with case(folder):
            for path in files_of(folder):
                header, rows = read(path)
                assert len(header) == 8
                assert rows[1, 0] == 0.01 and 3.0 <= rows[-1, 0] <= 4.0
                noise = np.std(rows[:, 1:] - savgol_filter(rows[:, 1:], 11, 3, axis=0), axis=0)
                assert np.all((noise > 6e-5) & (noise < 1.6e-4))


def test_the_drawer_leaves_one_direction_and_it_is_the_truth(sawyer: Robot) -> None:
    """Two translational rows hold at right_gripper_tip in the base frame; the free direction is within 0.1 degrees."""
    values, directions = spread_of_motion(sawyer, "right_gripper_tip", files_of("sawyer_drawer"), "world", 3)
    assert values[0] / values[1] > 100.0 and values[1] / values[2] < 2.0
    assert angle_between(directions[:, 0], DRAWER_AXIS) < 0.01


def test_the_door_is_constant_in_the_tools_frame_only(sawyer: Robot) -> None:
    """One free direction in the local reference, with and without rotations; no clear gap in the world reference."""
    for rows, truth in [(3, DOOR_TWIST[:3]), (6, DOOR_TWIST)]:
        with case(rows, truth):
            paths = files_of("sawyer_door")
            local, directions = spread_of_motion(sawyer, "right_gripper_tip", paths, "local", rows)
            world, _ = spread_of_motion(sawyer, "right_gripper_tip", paths, "world", rows)
            assert local[0] / local[1] > 100.0
            assert angle_between(directions[:, 0], truth) < 0.1
            assert np.all(world[:-1] / world[1:] < 10.0)


def test_planar_reaching_obeys_its_law() -> None:
    """Along each file tip + tip velocity is one point, the target, and the files' targets differ."""
    robot = load_robot("planar3")
    tip, targets = robot.frame("tip"), []
    for path in files_of("planar3_reach"):
        header, rows = read(path)
        assert header[4:] == [f"{name}_velocity" for name in robot.joint_names] and len(rows) == 40
        q, u = rows[:, 1:4], rows[:, 4:]
        points = np.array(
            [robot.pose(a, tip)[:2, 3] + (robot.jacobian(a, tip) @ b)[:2] for a, b in zip(q, u, strict=True)]
        )
        np.testing.assert_allclose(points, np.broadcast_to(points[0], points.shape), atol=1e-6)
        targets.append(points[0])
    assert np.all(np.std(targets, axis=0) > 0.3)


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
