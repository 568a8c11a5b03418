"""The teleoperator for LeRobot, on stand-ins for LeRobot's base classes (make lerobot has the real ones)."""

from __future__ import annotations

import importlib
import logging
import sys
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest

import manip_learn as ml

FOLDER = Path(__file__).resolve().parents[1] / "examples" / "lerobot_teleoperator_manip_learn"
PACKAGE = "lerobot_teleoperator_manip_learn"


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
