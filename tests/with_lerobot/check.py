"""The driver and the teleoperator against the real `lerobot`, with arms that are not there (make lerobot).

    python tests/with_lerobot/check.py        (in an environment with lerobot, manip_learn and the teleoperator)

Prints a line for each thing that holds, and fails at the first that does not.
"""

from __future__ import annotations

import os
import sys
import tempfile
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import lerobot
import numpy as np
from lerobot.motors import MotorCalibration
from lerobot.robots import Robot, RobotConfig
from lerobot.robots.so_follower import SO101Follower, SO101FollowerConfig
from lerobot.scripts import lerobot_record
from lerobot.utils.import_utils import register_third_party_plugins

import manip_learn as ml

URDF = Path(__file__).resolve().parents[1] / "arms" / "five_joints.urdf"
JOINTS = ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll")
MOTORS = (*JOINTS, "gripper")
START = {"shoulder_pan": 10.0, "shoulder_lift": -40.0, "elbow_flex": 60.0, "wrist_flex": 30.0, "wrist_roll": 0.0}
GRIPPER, ALONG, SECONDS, FPS = 25.0, 0.06, 6, 30  # [%], [m], [s], [Hz]


@RobotConfig.register_subclass("arm_that_is_not_there")
@dataclass
class NotThereConfig(RobotConfig):
    """LeRobot's command line makes a `NotThere` of it."""

    use_degrees: bool = True
    cameras: dict = field(default_factory=dict)


class NotThere(Robot):
    """A perfect arm in degrees."""

    config_class, name = NotThereConfig, "arm_that_is_not_there"

    def __init__(self, config: NotThereConfig):
        super().__init__(config)
        self.config, self.cameras, self.connected = config, {}, False
        self.values = {f"{motor}.pos": value for motor, value in {**START, "gripper": GRIPPER}.items()}

    action_features = observation_features = property(lambda self: dict.fromkeys(self.values, float))
    is_connected = property(lambda self: self.connected)
    is_calibrated = property(lambda self: True)

    def connect(self, calibrate: bool = True) -> None:
        self.connected = True

    def disconnect(self) -> None:
        self.connected = False

    def calibrate(self) -> None: ...

    def configure(self) -> None: ...

    def get_observation(self) -> dict[str, Any]:
        return dict(self.values)

    def send_action(self, action: dict[str, Any]) -> dict[str, Any]:
        self.values |= action
        return action


def said(what: str) -> None:
    """What holds."""
    print(f"ok: {what}", flush=True)


def follower(use_degrees: bool) -> SO101Follower:
    """LeRobot's own SO-101 follower, whose servos are numbers of encoder steps here."""
    arm = SO101Follower(SO101FollowerConfig(port="none", id="check", use_degrees=use_degrees))
    ranges = zip(MOTORS, (1000, 900, 800, 1100, 0, 2000), (3000, 3200, 3100, 3001, 4095, 3500), strict=True)
    arm.calibration |= {m: MotorCalibration(i + 1, 0, 0, low, high) for i, (m, low, high) in enumerate(ranges)}
    bus = arm.bus
    bus.calibration = arm.calibration
    steps = {motor: 2048 + 10 * bus.motors[motor].id for motor in MOTORS}
    names = {motor.id: name for name, motor in bus.motors.items()}

    def read(data_name: str, **_: Any) -> dict[str, float]:
        return {names[i]: x for i, x in bus._normalize({bus.motors[m].id: s for m, s in steps.items()}).items()}

    def write(data_name: str, values: dict[str, float], **_: Any) -> None:
        raw = bus._unnormalize({bus.motors[m].id: float(x) for m, x in values.items()})
        steps.update({names[i]: s for i, s in raw.items()})

    bus.sync_read, bus.sync_write, arm.steps = read, write, steps
    type(bus).is_connected = property(lambda self: True)
    bus.disable_torque = lambda motors: steps.update(dict.fromkeys(motors, 0))
    bus.enable_torque = lambda motors: None
    return arm


def check_units(robot: ml.Robot) -> None:
    """The conversions of LeRobot's own bus, from encoder steps, against ours."""
    for use_degrees in (True, False):
        arm = follower(use_degrees)
        driver = ml.LeRobotDriver(arm, robot, 0.01, others=("gripper",))
        middle = [0.5 * (arm.calibration[m].range_min + arm.calibration[m].range_max) for m in JOINTS]
        expected = 2.0 * np.pi * (np.array([arm.steps[m] for m in JOINTS]) - middle) / 4095
        q, u, effort = driver.read()
        assert u is None and effort is None
        np.testing.assert_allclose(q, expected, atol=1e-9)
        driver.command(q + 0.1, np.zeros(5))
        np.testing.assert_allclose(driver.read()[0], q + 0.1, atol=2.0 * np.pi / 4095)  # a step of the encoder
        try:
            driver.command(np.array([1.6, 0.0, 0.0, 0.0, 0.0]), np.zeros(5))
        except ml.ManipLearnError as error:
            said(f"outside the calibration: {error}")
        else:
            raise AssertionError("sent to a place outside the calibration")
        said(f"SO101Follower with use_degrees={use_degrees}: joints agree with encoder steps to 1e-9 rad")
        driver.release()


def check_record(robot: ml.Robot, folder: Path) -> None:
    """`lerobot-record` with our teleoperator, and our reader on what it wrote."""
    names = ", ".join(f"{motor}: {value}" for motor, value in {**START, "gripper": GRIPPER}.items())
    sys.argv = [
        "lerobot-record", "--robot.type=arm_that_is_not_there", "--robot.id=check",
        "--teleop.type=manip_learn", "--teleop.id=check", f"--teleop.robot={URDF}",
        f"--teleop.constraint={folder / 'drawer.json'}", f"--teleop.along={ALONG}", f"--teleop.fps={FPS}",
        f"--teleop.start={{{names}}}", "--teleop.others=[gripper]",
        "--teleop.motors={wrist_roll: {joint: wrist_roll, sign: -1}}",
        "--dataset.repo_id=local/drawer", f"--dataset.root={folder / 'recorded'}", "--dataset.num_episodes=1",
        f"--dataset.episode_time_s={SECONDS}", f"--dataset.fps={FPS}", "--dataset.single_task=open the drawer",
        "--dataset.video=false", "--dataset.push_to_hub=false", "--play_sounds=false",
    ]  # fmt: skip
    register_third_party_plugins()
    start = time.perf_counter()
    lerobot_record.main()
    (demo,) = ml.load_demonstrations(folder / "recorded", robot, units="degrees")
    way = np.array([robot.position(q, "hand") for q in demo.q])
    moved, off = abs(way[-1, 1] - way[0, 1]), np.ptp(way[:, [0, 2]], axis=0).max()
    said(
        f"lerobot-record: {len(demo.q)} frames in {time.perf_counter() - start:.1f} s, hand {1e3 * moved:.1f} mm "
        f"along, {1e3 * off:.2g} mm off the held rows"
    )
    assert abs(len(demo.q) - SECONDS * FPS) <= FPS and abs(moved - ALONG) < 2e-3 and off < 1e-3


def main() -> None:
    """All checks, in a folder that is removed."""
    print(f"lerobot {lerobot.__version__}, numpy {np.__version__}, Python {sys.version.split()[0]}")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        robot = ml.load_robot(URDF)
        features = ml.FrameJacobian(robot, frame="hand", axes="xyz")
        constraint = ml.Constraint([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0]], features)
        constraint.save(folder / "drawer.json")
        check_units(robot)
        check_record(robot, folder)


if __name__ == "__main__":
    os.environ.setdefault("HF_HUB_OFFLINE", "1")
    main()
