"""A LeRobot robot as a driver, and the teleoperator for LeRobot (make lerobot has the real classes)."""

from __future__ import annotations

import importlib
import json
import logging
import sys
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest
from case import rows_in
from servo_cases import Constantly
from test_driver import START, loop_of
from vendor_fakes import LeRobotArm as Arm

import manip_learn as ml
from manip_learn.errors import ConfigurationError

PERIOD = 0.01  # [s]
STEPS = 4096  # of an encoder per turn


def in_units(arm: Arm, mode: str, low: int = 1024, high: int = 3072) -> Arm:
    """The arm with a bus as LeRobot's: each motor's unit and its calibrated range in encoder steps."""
    arm.bus.motors = {m: SimpleNamespace(norm_mode=SimpleNamespace(value=mode), model="m") for m in arm.motors}
    arm.bus.motors["gripper"].norm_mode = SimpleNamespace(value="range_0_100")
    arm.bus.model_resolution_table = {"m": STEPS}
    arm.calibration = {m: SimpleNamespace(range_min=low, range_max=high) for m in arm.motors}
    return arm


def driver_of(arm: Any, robot: ml.Robot, **options: Any) -> ml.LeRobotDriver:
    """The driver of an arm with a gripper."""
    return ml.LeRobotDriver(arm, robot, PERIOD, others=("gripper",), **options)


def test_a_run_in_degrees(planar3):
    """The arm moves as the loop commands, the gripper stays, each cycle reads once and sends once."""
    arm = Arm()
    driver = driver_of(arm, planar3)
    record = ml.run(loop_of(planar3, PERIOD), driver, 0.5)
    assert repr(driver) == "LeRobotDriver(fake_follower, 3 joints, 10 ms)"
    assert record.ordered and arm.observed - 1 == len(arm.sent) == record.cycles
    assert {action["gripper.pos"] for action in arm.sent} == {37.5}
    sent = np.radians([[action[f"joint{i}.pos"] for i in (1, 2, 3)] for action in arm.sent])
    np.testing.assert_allclose(record.rollout.q[0], START, atol=1e-12)
    np.testing.assert_allclose(record.rollout.q[1:], sent[:-1], atol=1e-12)
    assert np.abs(sent[-1] - START).max() > 0.01 and driver.cut == 0 and driver.notes == ()


@pytest.mark.parametrize("mode", ["degrees", "range_m100_100", "range_0_100"])
def test_units_signs_and_zeros(mode, planar3):
    """Each motor's unit is the bus's; joint = zero + sign * motor; what is read is what would be sent."""
    arm = in_units(Arm(), mode)
    arm.values |= {"joint1": 20.0, "joint2": 30.0, "joint3": 60.0}
    motors = {"joint2": ml.LeRobotMotor("joint2", sign=-1), "joint3": ml.LeRobotMotor("joint3", zero=0.2)}
    driver = driver_of(arm, planar3, motors=motors)
    half = np.pi * 2048 / (STEPS - 1)  # half of the calibrated range
    values, centre = np.array([20.0, 30.0, 60.0]), 50.0 if mode == "range_0_100" else 0.0
    unit = {"degrees": np.pi / 180, "range_m100_100": half / 100, "range_0_100": half / 50}[mode]
    q = driver.read()[0]
    np.testing.assert_allclose(q, np.array([0.0, 0.0, 0.2]) + np.array([1, -1, 1]) * unit * (values - centre))
    driver.command(q, np.zeros(3))
    np.testing.assert_allclose([arm.sent[-1][f"joint{i}.pos"] for i in (1, 2, 3)], values, atol=1e-12)


def test_a_gripper_among_the_others_shuts_and_opens(planar3):
    """0 is shut and 100 open, as LeRobot calibrates it; other motors stay where they were."""
    arm = in_units(Arm(), "degrees")
    driver = driver_of(arm, planar3)
    percent = "range_0_100"
    for word, unit, position in (("close", percent, 0.0), ("open", percent, 100.0), ("close", "degrees", 100.0)):
        arm.bus.motors["gripper"].norm_mode = SimpleNamespace(value=unit)
        driver.gripper(word)
        driver.command(START, np.zeros(3))
        assert arm.sent[-1]["gripper.pos"] == position


def test_spans_without_calibration():
    """-100 .. 100 is the span that is given, or the joint's limits; radians are radians; a wide range needs a span."""
    planar3 = ml.load_robot("planar3")  # whose limits are changed below
    arm = Arm()
    arm.config = None
    arm.values |= {"joint1": 50.0, "joint2": 50.0, "joint3": 50.0}
    given = {"joint1": ml.LeRobotMotor("joint1", span=2.0)}
    q = driver_of(arm, planar3, units="normalised", motors=given).read()[0]
    lower, upper = planar3.position_lower[1], planar3.position_upper[1]
    np.testing.assert_allclose(q[:2], [0.5, lower + 0.75 * (upper - lower)])
    np.testing.assert_array_equal(driver_of(arm, planar3, units="radians").read()[0], [50.0] * 3)
    planar3.position_upper = np.full(3, np.inf)
    for q in (np.inf, np.nan):
        with pytest.raises(ConfigurationError, match="motor joint1 is not sent to"):
            driver_of(arm, planar3, units="radians").command(np.full(3, q), np.zeros(3))
    with pytest.raises(ConfigurationError, match=r"joint1 reads -100 .. 100 and neither.*span=\.\.\."):
        driver_of(arm, planar3, units="normalised")


SO101 = ml.load_robot("so101", locked=("gripper",))


@pytest.mark.parametrize(("words", "changes", "options"), rows_in("lerobot_refused.txt"))
def test_what_does_not_fit_is_refused_in_a_sentence(words, changes, options, planar3):
    """Motors, joints, units and numbers that do not fit: what, where, and what to do."""
    vars(arm := Arm()).update(json.loads(changes))
    with pytest.raises(ConfigurationError, match=words):
        ml.LeRobotDriver(arm, planar3, **{"period": PERIOD, "others": ("gripper",), **json.loads(options)})


def test_motors_and_joints_that_do_not_fit(planar3):
    """A joint that is locked or has no motor; numbers of a motor that are none."""
    with pytest.raises(ConfigurationError, match=r"gripper .* moves no joint of .* \(that joint is locked\)"):
        ml.LeRobotDriver(Arm(np.zeros(5), (*SO101.joint_names, "gripper")), SO101, PERIOD)
    with pytest.raises(ConfigurationError, match="no motor of fake_follower moves joint joint3 of planar3: .*locked="):
        driver_of(Arm(motors=("joint1", "joint2", "gripper")), planar3)
    words = {"sign": "sign must be 1 or -1", "span": "span a positive number", "zero": "zero a finite number"}
    for name, value in (("sign", 2), ("span", 0.0), ("zero", np.nan)):
        with pytest.raises(ConfigurationError, match=words[name]):
            ml.LeRobotMotor("joint1", **{name: value})


def test_joints_in_m_are_not_in_degrees():
    """A gripper's linear joint takes a range of 100 and no degrees."""
    panda = ml.load_robot("panda")
    arm = Arm(np.zeros(8), (*panda.joint_names, "gripper"))
    finger = panda.joint_names[-1]
    with pytest.raises(ConfigurationError, match=f"joint {finger} moves in m and motor {finger} in degrees"):
        driver_of(arm, panda)
    in_units(arm, "degrees")
    arm.bus.motors[finger] = arm.bus.motors["gripper"]
    arm.calibration, arm.values[finger] = {}, 75.0
    np.testing.assert_allclose(driver_of(arm, panda).read()[0][-1], 0.75 * panda.position_upper[-1])


@pytest.mark.parametrize("calibrated", [False, True])
def test_nothing_outside_the_ranges_is_sent(calibrated, planar3):
    """A motion that leaves the limits, or the calibrated range, ends with a sentence; the arm stands where it was."""
    arm = in_units(Arm(), "degrees", 2048 - 180, 2048 + 540) if calibrated else Arm()
    arm.values |= {"joint1": 10.0, "joint2": 10.0, "joint3": 10.0}
    driver = driver_of(arm, planar3)
    low = np.degrees(planar3.position_upper[0]) if not calibrated else 0.5 * 720 * 360 / (STEPS - 1)

    with pytest.raises(ConfigurationError, match=r"motor joint1 is not sent to .* degrees, outside"):
        driver.command(np.array([np.radians(low + 1.0), 0.1, 0.1]), np.zeros(3))
    driver.command(np.array([np.radians(low) + 1e-9, 0.1, 0.1]), np.zeros(3))
    assert arm.sent.pop()["joint1.pos"] <= low + 1e-9
    arm.values |= {"joint1": low - 20.0}
    if calibrated:
        record = ml.run(ml.ServoLoop(Constantly(planar3, [1.0, 0.0, 0.0]), PERIOD), driver, 5.0)
        assert "ConfigurationError: motor joint1 is not sent to" in record.ended and "calibrated range" in record.ended
        assert not record.ordered and not record.rollout.u[-1].any()
        assert max(action["joint1.pos"] for action in arm.sent) <= low


@pytest.mark.parametrize("value", [None, float("nan"), "off"])
def test_readings_that_are_no_numbers(value, planar3):
    """A motor that is not reported, or not as a number, brakes the arm with its name."""
    arm = Arm()
    driver, get = driver_of(arm, planar3), arm.get_observation
    arm.get_observation = lambda: get() | ({"joint2.pos": value} if arm.observed > 20 else {})  # type: ignore[method-assign]
    record = ml.run(loop_of(planar3, PERIOD), driver, 2.0)
    assert "position of motor joint2, which is not a finite number" in record.ended and not record.rollout.u[-1].any()
    arm.observed = 0
    del arm.values["gripper"]
    with pytest.raises(ConfigurationError, match="None as position of motor gripper"):
        driver.read()


def test_velocities_and_torques_of_arms_that_have_them(planar3):
    """Velocities come from degrees, torques in N m with the motor's sign; currents are no torques."""
    arm = Arm()
    for kind in ("vel", "torque"):
        arm.action_features |= {f"{motor}.{kind}": float for motor in arm.motors}
    arm.observation_features = dict(arm.action_features)
    driver = driver_of(arm, planar3, motors={"joint2": ml.LeRobotMotor("joint2", sign=-1)})
    assert driver.read()[1:] == (None, None)
    seen = arm.get_observation() | {f"joint{i}.current": 7.0 for i in (1, 2, 3)}
    arm.get_observation = lambda: seen  # type: ignore[method-assign]
    assert driver.read()[1:] == (None, None)
    seen |= {f"joint{i}.{kind}": x for i, x in ((1, 9.0), (2, 18.0), (3, 0.0)) for kind in ("vel", "torque")}
    _, u, effort = driver.read()
    np.testing.assert_allclose(u, np.radians([9.0, -18.0, 0.0]))
    np.testing.assert_array_equal(effort, [9.0, -18.0, 0.0])
    driver.command(np.array([0.3, -0.8, 0.4]), np.zeros(3))
    assert arm.sent[-1]["joint1.vel"] == arm.sent[-1]["gripper.torque"] == 0.0
    assert in_units(arm, "range_m100_100").config.use_degrees
    assert driver_of(arm, planar3).read()[1] is None  # of a unit per second that nobody knows


def test_actions_that_lerobot_cuts_are_told(planar3, caplog):
    """With max_relative_target LeRobot sends less: counted, said once, with the motor and by how much."""
    arm = Arm()
    send = arm.send_action

    def cut(action: dict[str, Any]) -> dict[str, Any]:
        return send(action | {"joint2.pos": action["joint2.pos"] - 0.01 * len(arm.sent)})

    driver = driver_of(arm, planar3)
    arm.send_action = cut  # type: ignore[method-assign]
    with caplog.at_level(logging.WARNING, "manip_learn"):
        for _ in range(3):
            driver.command(START, np.zeros(3))
    assert driver.cut == 2 and len(caplog.records) == 1
    assert driver.notes[0].startswith("fake_follower reduced 2 actions, motor joint2 by up to 0.02 degrees")
    arm.send_action = lambda action: None  # type: ignore[method-assign,assignment,return-value]
    driver.command(START, np.zeros(3))
    assert driver.cut == 2


def test_release_and_hold(planar3):
    """Torque off for guiding by hand, without the gripper's; the goals are where the arm is before torque is on."""
    arm = Arm()
    driver = driver_of(arm, planar3)
    driver.release()
    arm.values |= {"joint1": 12.0}
    driver.hold()
    joints = ["joint1", "joint2", "joint3"]
    # torque before goals would throw the arm to where it was sent before
    assert arm.order == [("off", joints), "goals", ("on", joints)]
    assert arm.sent[-1]["joint1.pos"] == 12.0 and arm.sent[-1]["gripper.pos"] == 37.5
    arm.bus, done = None, []
    with pytest.raises(ConfigurationError, match=r"no disable_torque\(\).*lerobot-teleoperate"):
        driver.release()
    arm.disable_torque = lambda: done.append("off")  # type: ignore[attr-defined]
    driver.release()
    assert done == ["off"]


# ---- the teleoperator, on stand-ins for LeRobot's base classes ----

PACKAGE = "lerobot_teleoperator_manip_learn"
FOLDER = Path(__file__).resolve().parents[1] / "examples" / PACKAGE


@dataclass
class Config:
    """Stands for `TeleoperatorConfig`."""

    @classmethod
    def register_subclass(cls, name: str) -> Any:
        return lambda kind: kind


class Base:
    """Stands for `Teleoperator`."""

    def __init__(self, config: Any):
        self.id = "fake"


@pytest.fixture
def package(monkeypatch):
    """The plugin, imported on the stand-ins."""
    stands_for = {
        "lerobot": {}, "lerobot.teleoperators": {}, "lerobot.utils": {},
        "lerobot.teleoperators.config": {"TeleoperatorConfig": Config},
        "lerobot.teleoperators.teleoperator": {"Teleoperator": Base},
        "lerobot.utils.decorators": {"check_if_not_connected": lambda method: method},
    }  # fmt: skip
    for name, members in stands_for.items():
        monkeypatch.setitem(sys.modules, name, module := ModuleType(name))
        vars(module).update(members)
    monkeypatch.syspath_prepend(str(FOLDER))
    return importlib.import_module(PACKAGE)


@pytest.fixture
def drawer(tmp_path):
    """The settings of a motion: 0.1 m along y, x held."""
    robot = ml.load_robot("planar3")
    file = ml.Constraint([[1, 0]], ml.FrameJacobian(robot, "tip", axes="x y")).save(tmp_path / "drawer.json")
    start = {"joint1": 17.0, "joint2": 46.0, "joint3": 23.0, "gripper": 12.0}
    motion = {"robot": "planar3", "constraint": str(file), "start": start, "along": 0.1}
    return {**motion, "others": ["gripper"], "fps": 30.0}


def test_actions_keep_the_constraint(package, drawer, monkeypatch):
    """At 30 Hz: from the start 0.1 m along what is free, the held row held, the gripper where it was."""
    clock = [0.0]
    teleop = package.ManipLearn(package.ManipLearnConfig(**drawer))
    monkeypatch.setattr(f"{PACKAGE}.manip_learn.time", SimpleNamespace(perf_counter=lambda: clock[0]))
    assert teleop.is_calibrated and not teleop.is_connected
    teleop.connect()
    actions = []
    for _ in range(150):
        actions.append(teleop.get_action())
        clock[0] += 1.0 / 30.0
    robot = ml.load_robot("planar3")
    q = np.radians([[action[f"joint{i}.pos"] for i in (1, 2, 3)] for action in actions])
    way = np.array([robot.position(row, "tip") for row in q])
    first = robot.position(np.radians([17.0, 46.0, 23.0]), "tip")
    assert abs(way[-1, 1] - first[1]) == pytest.approx(0.1, abs=1e-3)
    assert np.abs(way[:, 0] - first[0]).max() < 1e-4
    assert {action["gripper.pos"] for action in actions} == {12.0}
    assert teleop.action_features == dict.fromkeys(actions[0], float) == teleop.feedback_features
    teleop.disconnect()
    assert not teleop.is_connected


def test_the_arm_stands_where_an_action_would_leave_the_limits(package, drawer, caplog):
    """A start outside the limits is never left by an action: one warning with the motor, the start again and again."""
    drawer["start"]["joint1"] = 800.0
    teleop = package.ManipLearn(package.ManipLearnConfig(**drawer))
    teleop.connect()
    with caplog.at_level(logging.WARNING):
        actions = [teleop.get_action() for _ in range(5)]
    assert {action["joint1.pos"] for action in actions} == {800.0}
    (warning,) = caplog.records
    assert "motor joint1 is not sent to" in warning.getMessage()
