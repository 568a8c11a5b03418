"""What the snippets of the documentation find: names in Python, and files in the folder in which they run."""

from __future__ import annotations

import shutil
import sys
from functools import cache
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest
from documentation_blocks import blocks
from task_sets import arm as arm_named
from task_sets import generated, sawyer_drawer
from vendor_fakes import FAKES, Joints

import manip_learn as ml
from manip_learn.cli import main

ROOT = Path(__file__).resolve().parents[1]
DRAWER = ROOT / "examples" / "data" / "sawyer_drawer"
TIP = "right_gripper_tip"
# that a page is about
ARMS = {"ur": "ur5", "ur5e_in_ten_minutes": "ur5e", "franka": "panda", "xarm": "xarm7", "ros2_control": "ur5"}
RTDE = [f"actual_{kind}_{i}" for kind in ("q", "qd") for i in range(6)]  # columns of its recordings


class Countdown:
    """True a few times: a loop's condition."""

    def __init__(self, cycles: int = 5) -> None:
        self._left = cycles

    def __bool__(self) -> bool:
        self._left -= 1
        return self._left >= 0


def names() -> dict[str, Any]:
    """What the pages take for granted: the library, the drawer that was learnt, an arm's driver."""
    robot, demos, learner = sawyer_drawer()
    constraint = learner.constraint_
    q0, target = np.array([1.2, -1.2, 0.0, 0.4, 0.0, 0.8, 0.0]), [0.6, 0.27, 0.35]
    task = ml.PointAttractor(target)
    policy = ml.ManipulabilityAscent(constraint)
    controller = ml.ResolvedRateController(constraint, task, policy)
    loop = ml.ServoLoop(controller, 0.01)
    rollout = ml.simulate(robot, controller, q0, duration=0.2, dt=0.01)
    sent: list[Any] = []
    arm = SimpleNamespace(
        period=loop.dt, simulated=True, read=lambda: (q0, None, None), command=lambda q, u: None,
        send=sent.append, measured=lambda: (q0, 0.01 * len(sent)),
    )  # fmt: skip
    motors = ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll", "gripper")
    features = {f"{motor}.pos": float for motor in motors}
    follower = SimpleNamespace(
        name="so_follower", is_connected=True, config=SimpleNamespace(use_degrees=True), action_features=features,
        observation_features=features, get_observation=lambda: dict.fromkeys(features, 10.0),
        send_action=lambda action: action, bus=SimpleNamespace(enable_torque=list, disable_torque=list),
    )  # fmt: skip
    return {
        "ml": ml, "np": np, "Path": Path, "RECORDINGS": DRAWER.parent, "robot": robot, "demos": demos,
        "recordings": demos, "features": learner.features, "follower": follower,
        "learner": learner, "report": learner.report_, "constraint": constraint, "task": task, "policy": policy,
        "controller": controller, "loop": loop, "rollout": rollout, "other": rollout, "grasp": demos[0].q[0],
        "q0": q0, "q": q0, "t": 0.0, "target": target, "arm": arm, "running": Countdown(), "physics": arm,
    }  # fmt: skip


def furnish(folder: Path, page: str) -> None:
    """An arm and recordings of one's own, and the shipped examples; more formats for the page that shows them."""
    (folder / "examples").symlink_to(ROOT / "examples", target_is_directory=True)
    urdf = (ROOT / "robots" / "sawyer.urdf").read_text(encoding="utf-8")
    (folder / "my_arm.urdf").write_text(urdf.replace(TIP, "tool0"), encoding="utf-8")
    (folder / "recordings").mkdir()
    for path in sorted(DRAWER.glob("*.csv"))[:6]:
        shutil.copy(path, folder / "recordings" / path.name)
    if page == "your_own_arm":
        write_other_formats(folder)
    if page in ARMS:
        write_recordings_of_arm(folder, page)


@cache
def recorded(page: str) -> list[tuple[np.ndarray, np.ndarray]]:
    """Times and postures of a drawer that the page's arm has opened."""
    _, demos = generated("drawer", ARMS[page], seed=11, n=4)
    return [(demo.time, demo.q) for demo in demos]


def vendors(page: str) -> dict[str, ModuleType]:
    """The vendor's packages, around an arm at the beginning of the page's first recording."""
    if page not in ARMS:
        return {}
    vendor = page.partition("5e_")[0]
    fakes = FAKES[vendor](Joints(arm_named(ARMS[page]).joint_names, recorded(page)[0][1][0].copy()))
    return fakes if vendor == page else {**fakes, "ur_arm": driver_of_the_page("ur", fakes)}


def driver_of_the_page(page: str, fakes: dict[str, ModuleType]) -> ModuleType:
    """The driver that a page shows, as the file that another page tells to save."""
    module = ModuleType("ur_arm")
    module.__dict__["np"] = np
    with pytest.MonkeyPatch.context() as patch:
        for name, fake in fakes.items():
            patch.setitem(sys.modules, name, fake)
        driver = next(b for b in blocks(ROOT / "docs" / f"{page}.md") if b.language == "python")
        exec(compile(driver.text, page, "exec"), module.__dict__)
    module.__dict__["my_arm"] = lambda: module.__dict__["URArm"]("192.168.56.101")
    return module


def write_recordings_of_arm(folder: Path, page: str) -> None:
    """As a table, with the columns of RTDE for UR, and for ROS 2 as bags."""
    names = arm_named(ARMS[page]).joint_names
    for number, (time, q) in enumerate(recorded(page)):
        header, rows = ["time", *names], np.column_stack([time, q])
        if page.startswith("ur"):
            header, rows = ["timestamp", *RTDE], np.column_stack([rows, np.gradient(q, time, axis=0)])
        table = folder / f"drawer_{number}.csv"
        np.savetxt(table, rows, "%.9g", ",", header=",".join(header), comments="")
        if page == "ros2_control":
            bag = str(folder / f"drawer_{number}.mcap")
            assert main(["export", ARMS[page], str(table), "--out", bag]) == 0


def write_other_formats(folder: Path) -> None:
    """A bag, a LeRobot data set, and a table with headers and units of its own."""
    recordings = sorted(str(path) for path in (folder / "recordings").glob("*.csv"))
    for files, out in ((recordings[:1], "bag.mcap"), (recordings, "data_set")):
        assert main(["export", str(folder / "my_arm.urdf"), *files, "--out", str(folder / out)]) == 0
    header, *rows = Path(recordings[0]).read_text(encoding="utf-8").splitlines()
    names = header.replace("time", "stamp").replace("right_j0", "shoulder_pan")
    lines = [f"{names},battery"]
    for line in rows:
        time, *q = map(float, line.split(","))
        lines.append(",".join([f"{1e3 * time:.3f}", *(f"{np.degrees(x):.6f}" for x in q), "24.1"]))
    (folder / "foreign.csv").write_text("\n".join(lines) + "\n", encoding="utf-8")
