"""Drivers that mix up joints, units or senses: the arm says so before it goes far, and `run` says what it does."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

import manip_learn as ml
from manip_learn.control import driver

DT, FAST = 0.002, 3.0  # [s], [rad/s] with which a position servo goes where it is sent
START = np.array([0.3, -0.6, 0.1, 1.4, 0.2, 0.8, 0.4])
Map = Callable[[np.ndarray], np.ndarray]


def turned(x: np.ndarray) -> np.ndarray:
    """Each joint in the place of the one before it."""
    return np.roll(x, 1)


def flipped(x: np.ndarray) -> np.ndarray:
    """The second joint counts the other way round."""
    return x * np.where(np.arange(len(x)) == 1, -1.0, 1.0)


class Arm:
    """A perfect arm whose driver changes what it reads or what it commands."""

    period, simulated = DT, True

    def __init__(self, read: Map | None, command: Map | None, is_velocity_servo: bool):
        self.q, self._read, self._command, self._by_velocity = START.copy(), read, command, is_velocity_servo
        self.farthest, self.held = 0.0, 0

    def read(self) -> Any:
        """As the driver says it."""
        return self.q.copy() if self._read is None else self._read(self.q), None, None

    def command(self, q: np.ndarray, u: np.ndarray) -> None:
        """As the driver understands it."""
        sent = u if self._by_velocity else q
        sent = sent if self._command is None else self._command(sent)
        self.q = self.q + (DT * sent if self._by_velocity else np.clip(sent - self.q, -FAST * DT, FAST * DT))
        self.farthest = max(self.farthest, float(np.abs(self.q - START).max()))

    def hold(self) -> None:
        """Stand."""
        self.held += 1


@pytest.fixture
def loop() -> ml.ServoLoop:
    """The hand goes 0.2 m."""
    robot = ml.load_robot("sawyer")
    place = ml.FrameJacobian(robot, "right_gripper_tip", axes="x y z")
    target = place.coordinates(START) + [0.12, -0.16, 0.06]
    return ml.ServoLoop(ml.ResolvedRateController(ml.Constraint(np.eye(3), place), ml.PointAttractor(target)), DT)


AWAY = "the driver reads other joints, units or signs than it commands"


@pytest.mark.parametrize(
    ("servo", "way", "change", "said"),
    [
        ("position", "read", np.degrees, "right_j3 reads 80.21, its limits are [-3.044, 3.044] rad: in degrees?"),
        ("velocity", "command", np.radians, "0.0175 times as far as commanded, as if in degrees"),
        ("velocity", "read", turned, "right_j2 moves as right_j1 is commanded"),
        ("position", "command", turned, AWAY),
        ("position", "read", flipped, AWAY),
        ("velocity", "command", flipped, "(right_j1 moves in the opposite sense)"),
    ],
)
def test_a_driver_that_mixes_up_its_joints(servo: str, way: str, change: Map, said: str, loop: ml.ServoLoop) -> None:
    """A position servo that leaves where it was sent is held at once; a path that another order explains is named."""
    arm = Arm(*((change, None) if way == "read" else (None, change)), servo == "velocity")
    record = ml.run(loop, arm, 5.0)
    assert not record.ordered and arm.held == 1
    assert said in record.ended and (arm.farthest < 0.07 or servo == "velocity")


@pytest.mark.parametrize("is_velocity_servo", [False, True])
def test_a_driver_in_order_is_believed(is_velocity_servo: bool, loop: ml.ServoLoop) -> None:
    """What reads as it commands is not stopped."""
    assert ml.run(loop, Arm(None, None, is_velocity_servo), 1.0).ordered


def test_a_clock_in_milliseconds(loop: ml.ServoLoop, monkeypatch: pytest.MonkeyPatch) -> None:
    """The clock of a run that counts in milliseconds ends it with both times."""
    seconds = [50.0]
    monkeypatch.setattr(driver.ComputerClock, "now", staticmethod(lambda: seconds[0]))

    class Milliseconds:
        def now(self) -> float:
            return 1e3 * seconds[0]

        def wait_until(self, moment: float) -> None:
            seconds[0] = max(seconds[0] + 1e-4, 1e-3 * moment)

    arm = Arm(None, None, False)
    arm.simulated = False
    record = ml.run(loop, arm, 1000.0, clock=Milliseconds())
    assert not record.ordered and "it must count seconds" in record.ended
