"""Stand-ins for the vendors' packages that the pages of the arms import.

Names, units, orders and ranges are those of the versions that each page states; a call that the real package would
refuse fails here. They go at once where they are sent: no dynamics, no delays.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
from jaxtyping import Float


class Joints:
    """What all stand-ins of one arm share: its posture [rad], and whether a person guides it."""

    def __init__(self, names: tuple[str, ...], q: Float[np.ndarray, " n"]) -> None:
        self.names, self.q, self.u, self.guided = names, q, np.zeros(len(names)), False

    def go(self, q: Any, u: Any = None) -> None:
        """Be there, unless a person guides the arm."""
        assert not self.guided, "the arm is released: it cannot follow"
        assert len(q) == len(self.q) and np.all(np.isfinite(q))
        self.q, self.u = np.array(q, dtype=float), self.u if u is None else np.array(u, dtype=float)

    def guide(self, guided: bool) -> bool:
        """Whether a person guides the arm from now on."""
        self.guided = guided
        return True


class Clock:
    """Stands in for `time` in a run: as fast as the machine is, and never late."""

    def __init__(self) -> None:
        self._now = 0.0

    def perf_counter(self) -> float:
        """[s]; looking takes 10 us, so that whoever waits awake gets on."""
        self._now += 1e-5
        return self._now

    def sleep(self, seconds: float) -> None:
        """It is that much later."""
        self._now += seconds


def _module(name: str, **content: Any) -> dict[str, ModuleType]:
    module = ModuleType(name)
    module.__dict__.update(content)
    return {name: module}


def _ur(arm: Joints) -> dict[str, ModuleType]:
    def servo(q: list, _speed: float, _acceleration: float, time: float, lookahead: float, gain: float) -> bool:
        assert isinstance(q, list) and time > 0.0 and 0.03 <= lookahead <= 0.2 and 100.0 <= gain <= 2000.0
        arm.go(q)
        return True

    def control(hostname: str, frequency: float) -> SimpleNamespace:
        assert frequency in (125.0, 500.0)
        modes = {"teachMode": lambda: arm.guide(True), "endTeachMode": lambda: arm.guide(False)}
        return SimpleNamespace(servoJ=servo, servoStop=lambda: True, stopScript=lambda: None, **modes)

    def receive(hostname: str, frequency: float) -> SimpleNamespace:
        return SimpleNamespace(getActualQ=lambda: arm.q.tolist(), getActualQd=lambda: arm.u.tolist())

    return _module("rtde_control", RTDEControlInterface=control) | _module("rtde_receive", RTDEReceiveInterface=receive)


def _franka(arm: Joints) -> dict[str, ModuleType]:
    class Robot:
        def __init__(self, host: str) -> None:
            pass

        @property
        def state(self) -> SimpleNamespace:
            return SimpleNamespace(q=arm.q, dq=arm.u, tau_ext_hat_filtered=np.zeros(7))

        def join_motion(self) -> None:
            raise RuntimeError("the motion has ended")

    class Tracker:
        def __init__(self, robot: Robot, *, stiffness: Any) -> None:
            self.is_running = True
            self.set_gains(stiffness=stiffness)

        def set_target(self, q: Any, dq: Any = None) -> None:
            arm.go(q, dq) if not arm.guided else None

        def set_gains(self, *, stiffness: Any, damping: Any = None) -> None:
            assert np.shape(stiffness) == (7,) and (damping is None or np.shape(damping) == (7,))
            arm.guide(not np.any(stiffness))

        def stop(self) -> None:
            self.is_running = False

    return _module("franky", Robot=Robot, JointImpedanceTracker=Tracker)


def _xarm(arm: Joints) -> dict[str, ModuleType]:
    class XArmAPI:
        def __init__(self, ip: str) -> None:
            self.mode, self.ready, self.enabled = 0, False, False

        def motion_enable(self, enable: bool) -> int:
            self.enabled = enable
            return 0

        def set_mode(self, mode: int) -> int:
            self.mode, self.ready = mode, False  # set_state(0) comes after every change
            return 0

        def set_state(self, state: int) -> int:
            self.ready, arm.guided = state == 0, self.mode == 2
            return 0

        def get_joint_states(self, is_radian: bool) -> tuple[int, list[list[float]]]:
            assert is_radian
            return 0, [arm.q.tolist(), arm.u.tolist(), [0.0] * len(arm.q)]

        def set_servo_angle_j(self, angles: list, is_radian: bool) -> int:
            assert isinstance(angles, list) and is_radian
            if not (self.enabled and self.ready and self.mode == 1):
                return 9
            arm.go(angles)
            return 0

        def disconnect(self) -> None:
            pass

    return _module("xarm") | _module("xarm.wrapper", XArmAPI=XArmAPI)


def _ros(arm: Joints) -> dict[str, ModuleType]:
    order = sorted(range(len(arm.names)), key=lambda i: arm.names[i])  # as joint_state_broadcaster is often set up
    listeners: list[Callable[[Any], None]] = []

    class Node:
        def __init__(self, name: str) -> None:
            self.destroy_node = lambda: None

        def create_subscription(self, kind: type, topic: str, listener: Callable[[Any], None], depth: int) -> None:
            assert kind is JointState and topic == "/joint_states"
            listeners.append(listener)

        def create_publisher(self, kind: type, topic: str, depth: int) -> SimpleNamespace:
            assert kind is Float64MultiArray and topic.endswith("/commands")
            return SimpleNamespace(publish=lambda message: arm.go(message.data))

    JointState, Float64MultiArray = (type(name, (SimpleNamespace,), {}) for name in ("JointState", "Float64MultiArray"))

    def spin_once(_node: Node, timeout_sec: float) -> None:
        message = JointState(name=[arm.names[i] for i in order], position=arm.q[order].tolist(), velocity=[], effort=[])
        for listener in listeners:
            listener(message)

    known = {"init": lambda: None, "ok": lambda: True, "create_node": Node, "spin_once": spin_once}
    states = _module("sensor_msgs") | _module("sensor_msgs.msg", JointState=JointState)
    commands = _module("std_msgs") | _module("std_msgs.msg", Float64MultiArray=Float64MultiArray)
    return _module("rclpy", **known) | states | commands


class LeRobotArm:
    """A perfect arm as LeRobot shows it: by default with a gripper, in degrees; counts what it is asked."""

    name, is_connected, simulated = "fake_follower", True, False

    def __init__(self, q: Any = (0.3, 0.8, 0.4), motors: Any = ("joint1", "joint2", "joint3", "gripper")) -> None:
        self.motors, self.observed, self.sent = motors, 0, list[dict[str, Any]]()
        self.values = dict(zip(motors, [*np.degrees(q), 37.5], strict=False))
        self.action_features = {f"{motor}.pos": float for motor in motors}
        self.observation_features: dict[str, Any] = {**self.action_features, "front": (480, 640, 3)}
        self.config: Any = SimpleNamespace(use_degrees=True)
        self.calibration: dict[str, Any] = {}
        self.order: list[Any] = []  # of what changes the motors
        self.bus: Any = SimpleNamespace(
            enable_torque=lambda motors: self.order.append(("on", motors)),
            disable_torque=lambda motors: self.order.append(("off", motors)),
        )

    def get_observation(self) -> dict[str, Any]:
        """Positions, and a picture that nobody needs."""
        self.observed += 1
        return {f"{motor}.pos": value for motor, value in self.values.items()} | {"front": None}

    def send_action(self, action: dict[str, Any]) -> dict[str, Any]:
        """Goes there at once."""
        assert self.is_connected and {f"{motor}.pos" for motor in self.motors} <= action.keys()
        assert np.all(np.isfinite([*action.values()]))
        self.sent.append(dict(action))
        self.order.append("goals")
        self.values |= {key.removesuffix(".pos"): value for key, value in action.items() if key.endswith(".pos")}
        return action


def _lerobot(arm: Joints) -> dict[str, ModuleType]:
    def follower(config: SimpleNamespace) -> LeRobotArm:
        made: Any = LeRobotArm(arm.q, arm.names)  # of the so101 description by the same names
        made.config, made.is_connected = config, False
        made.connect, made.disconnect = (partial(setattr, made, "is_connected", on) for on in (True, False))
        return made

    def config(port: str, id: str) -> SimpleNamespace:
        return SimpleNamespace(port=port, id=id, use_degrees=True)

    packages = _module("lerobot") | _module("lerobot.robots")
    return packages | _module("lerobot.robots.so_follower", SO101Follower=follower, SO101FollowerConfig=config)


# tab of the page of the arms -> the packages that it imports, by their names, around an arm
FAKES = {"ur": _ur, "franka": _franka, "xarm": _xarm, "ros2_control": _ros, "lerobot": _lerobot}
