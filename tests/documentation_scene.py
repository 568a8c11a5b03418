"""What the snippets of the documentation find: packages of vendors, and files in the folder in which they run.

Snippets find no names: each page imports and builds what it uses.
"""

from __future__ import annotations

import importlib
import shutil
import sys
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from types import ModuleType

import numpy as np
import pytest
from documentation_blocks import blocks
from task_sets import arm as arm_named
from task_sets import generated
from vendor_fakes import FAKES, Joints

import manip_learn as ml
from manip_learn.cli import main

ROOT = Path(__file__).resolve().parents[1]
DRAWER = ROOT / "examples" / "data" / "sawyer_drawer"
TIP = "right_gripper_tip"
# tab of a page, or page -> its arm
ARMS = {"ur": "ur5", "run_on_your_arm": "ur5e", "franka": "panda", "xarm": "xarm7", "ros2_control": "ur5"}
ARMS["lerobot"] = "so101"
OTHER_FORMATS = ("record_demonstrations", "file_formats")  # pages that show them
MY_UR5E = "my_ur5e.urdf"  # description of the arm of run_on_your_arm.md
RTDE = [f"actual_{kind}_{i}" for kind in ("q", "qd") for i in range(6)]  # columns of its recordings


def furnish(folder: Path, page: str, tab: str = "") -> None:
    """Write an arm and recordings of one's own, and link the shipped examples; more formats for pages that show them.

    Args:
        folder: Where the snippets run.
        page: Name of the page, without its ending.
        tab: Key of the tab that is run; empty for a page without tabs.
    """
    (folder / "examples").symlink_to(ROOT / "examples", target_is_directory=True)
    urdf = (ROOT / "robots" / "sawyer.urdf").read_text(encoding="utf-8")
    (folder / "my_arm.urdf").write_text(urdf.replace(TIP, "tool0"), encoding="utf-8")
    (folder / "recordings").mkdir()
    for path in sorted(DRAWER.glob("*.csv"))[:6]:
        shutil.copy(path, folder / "recordings" / path.name)
    if page in OTHER_FORMATS:
        write_other_formats(folder)
    if page == "run_on_your_arm":
        (folder / MY_UR5E).write_text(ur5e_with_tip(), encoding="utf-8")
    if (tab or page) in ARMS:
        write_recordings_of_arm(folder, tab or page)


@cache
def recorded(key: str) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return times [s] and positions of a drawer that the arm of a page or a tab has opened."""
    if key == "lerobot":
        return drawer_of_so101()
    if key == "run_on_your_arm":
        return drawer_of_ur5e()
    _, demos = generated("drawer", ARMS[key], seed=11, n=4)
    return [(demo.time, demo.q) for demo in demos]


def ur5e_with_tip() -> str:
    """Return the description of a UR5e with the frame that run_on_your_arm.md adds to it."""
    tip = next(block.text for block in blocks(ROOT / "docs" / "run_on_your_arm.md") if block.language == "xml")
    return (ROOT / "robots" / "ur5e.urdf").read_text(encoding="utf-8").replace("</robot>", f"{tip}</robot>")


def drawer_of_ur5e() -> list[tuple[np.ndarray, np.ndarray]]:
    """Return times [s] and positions of six motions of an arm that is guided by the tip of its gripper."""
    with TemporaryDirectory() as folder, pytest.MonkeyPatch.context() as patch:
        path = Path(folder) / MY_UR5E
        path.write_text(ur5e_with_tip(), encoding="utf-8")
        patch.syspath_prepend(str(ROOT / "examples"))
        arms = importlib.import_module("make_recordings.arms").ARMS
        patch.setitem(arms, str(path), ("tool_tip", arms["ur5e"][1]))
        _, demos = generated("drawer", str(path), seed=11, n=6)
    return [(demo.time, demo.q) for demo in demos]


def drawer_of_so101() -> list[tuple[np.ndarray, np.ndarray]]:
    """Return times [s] and positions of five motions of 8 cm along y, each with an approach and a retreat."""
    robot, rng = ml.load_robot("so101", locked=("gripper",)), np.random.default_rng(0)
    rows = ml.Constraint([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0]], ml.FrameJacobian(robot, "gripper_frame_link", axes="xyz"))
    middle, away = np.radians(np.full(5, 10.0)), np.array([0.2, -0.25, -0.2, 0.1, 0.0])  # [rad]
    handle = ml.PointAttractor(robot.position(middle, "gripper_frame_link"), driven="all")
    motion = ml.motion(rows, distance=0.08, speed=0.04)
    share = np.linspace(0.0, 1.0, 120)[:, None]
    smooth = 10.0 * share**3 - 15.0 * share**4 + 6.0 * share**5
    recordings = []
    for _ in range(5):
        to_handle, along = (ml.ResolvedRateController(rows, task) for task in (handle, motion))
        grasp = ml.simulate(robot, to_handle, middle + rng.uniform(-0.5, 0.5, 5), duration=5.0, dt=0.02).q[-1]
        way = ml.simulate(robot, along, grasp, duration=2.5, dt=0.01).q
        q = np.concatenate([grasp + (1.0 - smooth) * away, way, way[-1] + smooth * away])
        recordings.append((0.01 * np.arange(len(q)), q))
    return recordings


def vendors(page: str, tab: str = "") -> dict[str, ModuleType]:
    """Return the vendor's packages by their names, around an arm at the beginning of its first recording."""
    if (key := tab or page) not in ARMS:
        return {}
    names, start = arm_named(ARMS[key]).joint_names, recorded(key)[0][1][0].copy()
    start = np.append(start, np.full(len(names) - len(start), np.radians(10.0)))  # the gripper is not recorded
    fakes = FAKES["ur" if key == page else key](Joints(names, start))
    return {**fakes, "ur_arm": driver_of_tab("ur", fakes)} if key == page else fakes


def driver_of_tab(tab: str, fakes: dict[str, ModuleType]) -> ModuleType:
    """Return the first Python block of a tab of arms.md, as the file that another page tells to save."""
    module = ModuleType("ur_arm")
    with pytest.MonkeyPatch.context() as patch:
        for name, fake in fakes.items():
            patch.setitem(sys.modules, name, fake)
        page = blocks(ROOT / "docs" / "arms.md")
        driver = next(b for b in page if b.tab == tab and b.language == "python")
        exec(compile(driver.text, tab, "exec"), module.__dict__)
    return module


def write_recordings_of_arm(folder: Path, key: str) -> None:
    """Write tables, with the columns of RTDE for UR and of `record` for run_on_your_arm.md, and bags for ROS 2."""
    names = arm_named(ARMS[key]).joint_names
    for number, (time, q) in enumerate(recorded(key)):
        names = names[: q.shape[1]]
        header, rows = ["time", *names], np.column_stack([time, q])
        table = folder / f"drawer_{number}.csv"
        if key in ("ur", "run_on_your_arm"):
            rows = np.column_stack([rows, np.gradient(q, time, axis=0)])
        if key == "ur":
            header = ["timestamp", *RTDE]
        elif key == "run_on_your_arm":
            header += [f"{name}_velocity" for name in names]
            table = folder / "demos" / f"drawer_{number + 1:02d}.csv"
            table.parent.mkdir(exist_ok=True)
        np.savetxt(table, rows, "%.9g", ",", header=",".join(header), comments="")
        if key == "ros2_control":
            bag = str(folder / f"drawer_{number}.mcap")
            assert main(["export", ARMS[key], str(table), "--out", bag]) == 0


def write_other_formats(folder: Path) -> None:
    """Write a bag, a LeRobot data set, and a table with headers and units of its own."""
    recordings = sorted(str(path) for path in (folder / "recordings").glob("*.csv"))
    for files, out in ((recordings[:1], "bag.mcap"), (recordings, "data_set")):
        assert main(["export", str(folder / "my_arm.urdf"), *files, "--out", str(folder / out)]) == 0
    (time, *q), names = np.loadtxt(recordings[0], delimiter=",", skiprows=1).T, arm_named("sawyer").joint_names
    header = ",".join(["stamp", "shoulder_pan", *names[1:], "battery"])
    rows = np.column_stack([1e3 * time, np.degrees(q).T, np.full(len(time), 24.1)])
    np.savetxt(folder / "foreign.csv", rows, "%.6f", ",", header=header, comments="")
