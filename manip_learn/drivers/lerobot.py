"""A robot of LeRobot as the driver of `run`: its motors in degrees or -100 .. 100, our joints in rad."""

from __future__ import annotations

import logging
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any, Literal, final, get_args

import numpy as np
from jaxtyping import Float

from manip_learn.errors import ConfigurationError, counted, listed, named
from manip_learn.recordings.options import Units
from manip_learn.robot.robot import Robot

_ROUNDING = 1e-6  # [rad or m] by which a joint at its limit may be beyond it: what conversions there and back leave
CUT = 1e-4  # in a motor's own unit: LeRobot's own bound, from which on it says that it has cut an action
# what LeRobot's buses call the units of a motor (MotorNormMode): [rad] per unit, or lowest and highest value of a range
_RAD = {"degrees": math.pi / 180.0, "radians": 1.0}
_RANGES = {"range_m100_100": (-100.0, 100.0), "range_0_100": (0.0, 100.0)}
_LOGGER = logging.getLogger("manip_learn")


@final
@dataclass(frozen=True)
class LeRobotMotor:
    """The joint that a motor moves: joint position = zero + sign * motor position.

    Attributes:
        joint: Its name in the robot's description.
        sign: -1 where the motor turns against the joint.
        zero: Joint position where the motor reads 0, or 50 if it reads 0 .. 100 [rad or m]. None is 0, or the middle of
            the joint's limits where those are the span.
        span: How far the joint moves while the motor reads -100 .. 100, or 0 .. 100 [rad or m]. None is the range of
            the arm's calibration, or of the joint's limits where it has none. Degrees need no span.
    """

    joint: str
    sign: int = 1
    zero: float | None = None
    span: float | None = None

    def __post_init__(self) -> None:
        """Refuse numbers that are none.

        Raises:
            ConfigurationError: The sign, the zero or the span.
        """
        span_is_wrong = self.span is not None and not 0.0 < self.span < math.inf
        if self.sign not in (1, -1) or span_is_wrong or not math.isfinite(self.zero or 0.0):
            raise ConfigurationError(
                f"motor of joint {self.joint}: the sign must be 1 or -1, the zero a finite number and the "
                f"span a positive one [rad], got sign={self.sign!r}, zero={self.zero!r}, span={self.span!r}"
            )


@final
class LeRobotDriver:
    """The driver of a LeRobot robot, for `run`; LeRobot itself is not imported.

    Efforts are read from `"<motor>.torque"`, which CAN arms have in N m; currents and loads are none. Velocities are
    read from `"<motor>.vel"` of motors in degrees. Action features `.vel` and `.torque` are sent 0.

    Args:
        arm: A connected LeRobot `Robot`: of it `observation_features`, `action_features`, `is_connected`,
            `get_observation` and `send_action` are asked.
        robot: The robot whose joints it moves; locked joints need no motor.
        period: Between two commands [s].
        motors: Motor -> its joint, or a `LeRobotMotor`. A motor that is not named moves the joint of its name.
        others: Motors that move no joint, as that of a gripper: held where they were first read. One that reads 0 to
            100 shuts at 0 and opens at 100, see `gripper`.
        units: Of motor positions. LeRobot knows them of most arms (`bus.motors`, `config.use_degrees`); give them for
            the others.

    Attributes:
        period: Between two commands [s].
        joint_names: Those of the robot.
        cut: Number of actions of which LeRobot has sent less than it was given.

    Raises:
        ConfigurationError: The arm is not connected, a motor without a joint, a joint without a motor, or units that
            are not known or contradict LeRobot's.
    """

    def __init__(
        self,
        arm: Any,
        robot: Robot,
        period: float,
        motors: Mapping[str, str | LeRobotMotor] | None = None,
        others: Iterable[str] = (),
        units: Units | None = None,
    ):
        self._arm, self._name = arm, str(getattr(arm, "name", type(arm).__name__))
        if not 0.0 < period < math.inf:
            raise ConfigurationError(f"the period must be a positive number of seconds, got {period!r}")
        if not arm.is_connected:
            raise ConfigurationError(f"{self._name} is not connected: call its connect() before")
        self.period, self.joint_names = period, robot.joint_names
        self._others = (others,) if isinstance(others, str) else tuple(others)
        keys = arm.action_features
        self._motors: tuple[str, ...] = tuple(key.removesuffix(".pos") for key in keys if key.endswith(".pos"))
        self._still = {key: 0.0 for key in keys if not key.endswith(".pos")}  # goes with them: no speed and no torque
        if wrong := [key for key in self._still if not key.endswith((".vel", ".torque"))]:
            raise ConfigurationError(
                f"{self._name} takes {listed(wrong)}: only positions of motors (.pos) are known here"
            )
        if unseen := [motor for motor in self._motors if f"{motor}.pos" not in arm.observation_features]:
            raise ConfigurationError(f"{self._name} does not observe the position of {named('motor', unseen)}")
        assigned = self._assigned(robot, dict(motors or {}))
        self._scales = [_scale(arm, robot, *assigned[joint], units) for joint in self.joint_names]
        self._held: dict[str, float] = {}
        self.cut, self._largest_cut = 0, (0.0, "")  # and its motor

    def _assigned(self, robot: Robot, given: dict[str, str | LeRobotMotor]) -> dict[str, tuple[str, LeRobotMotor]]:
        """Joint -> its motor, by name and as described."""
        if unknown := [motor for motor in (*given, *self._others) if motor not in self._motors]:
            raise ConfigurationError(
                f"{self._name} has no {named('motor', unknown)}: its motors are {listed(self._motors)}"
            )
        assigned: dict[str, tuple[str, LeRobotMotor]] = {}
        for motor in (motor for motor in self._motors if motor not in self._others):
            described = given.get(motor, motor)
            described = LeRobotMotor(described) if isinstance(described, str) else described
            if described.joint not in robot.joint_names:
                locked = " (that joint is locked)" if described.joint in robot.locked else ""
                raise ConfigurationError(
                    f"motor {motor} of {self._name} moves no joint of {robot.name}{locked}: give its joint, "
                    f"motors={{{motor!r}: NAME}}, or hold it still, others=({motor!r},)"
                )
            if described.joint in assigned:
                raise ConfigurationError(
                    f"joint {described.joint} has two motors, {assigned[described.joint][0]} and "
                    f"{motor}: name one of them in others"
                )
            assigned[described.joint] = motor, described
        if missing := [joint for joint in robot.joint_names if joint not in assigned]:
            raise ConfigurationError(
                f"no motor of {self._name} moves {named('joint', missing)} of {robot.name}: give it in motors, or load "
                f"the robot with locked=({', '.join(map(repr, missing))},)"
            )
        return assigned

    def read(self) -> tuple[Float[np.ndarray, " nv"], Float[np.ndarray, " nv"] | None, Float[np.ndarray, " nv"] | None]:
        """Return the joint positions [rad or m], and velocities [rad/s] and efforts [N m] of arms that measure them.

        Raises:
            ConfigurationError: A position is missing or no finite number.
        """
        seen, values = self._observed()
        q = np.array([scale.joint(values[scale.motor]) for scale in self._scales])
        return q, self._beside(seen, "vel"), self._beside(seen, "torque")

    def _observed(self) -> tuple[Mapping[str, Any], dict[str, float]]:
        """What the arm reports, and motor -> its position, in its own unit; the others are held where they were first.

        Raises:
            ConfigurationError: A position is missing or no finite number.
        """
        seen = self._arm.get_observation()
        positions = {motor: _number(seen.get(f"{motor}.pos")) for motor in self._motors}
        if bad := [motor for motor, value in positions.items() if not math.isfinite(value)]:
            raise ConfigurationError(
                f"{self._name} reports {seen.get(f'{bad[0]}.pos')!r:.40} as position of motor {bad[0]}, which is no "
                "finite number: look at its cable and its power"
            )
        self._held = self._held or {motor: positions[motor] for motor in self._others}
        return seen, positions

    def _beside(self, seen: Mapping[str, Any], kind: Literal["vel", "torque"]) -> Float[np.ndarray, " nv"] | None:
        """Velocities or torques of the joints; None where one is missing or its unit is not known."""
        if kind == "vel" and any(scale.unit not in _RAD for scale in self._scales):
            return None
        values = [_number(seen.get(f"{scale.motor}.{kind}")) for scale in self._scales]
        factors = [scale.per_unit if kind == "vel" else math.copysign(1.0, scale.per_unit) for scale in self._scales]
        return np.multiply(factors, values) if all(map(math.isfinite, values)) else None

    def command(self, q: Float[np.ndarray, " nv"], u: Float[np.ndarray, " nv"]) -> None:
        """Go to joint positions [rad or m]; nothing is sent where one is outside the calibration or the limits.

        Raises:
            ConfigurationError: A position is outside.
        """
        goals = {scale.motor: scale.motor_position(position) for scale, position in zip(self._scales, q, strict=True)}
        if self._others and not self._held:
            self._observed()
        self._send(goals | self._held)

    def gripper(self, word: Literal["close", "open"]) -> None:
        """Send the motors of grippers among the others to 0, or to 100, from the next command on."""
        if not self._held:
            self._observed()
        for motor in self._held:
            if _stated(self._arm, "bus", "motors", motor, "norm_mode", "value") == "range_0_100":
                self._held[motor] = 0.0 if word == "close" else 100.0

    def _send(self, goals: Mapping[str, float]) -> None:
        """Send motor positions, and take note of what LeRobot makes of them."""
        sent = self._arm.send_action(self._still | {f"{motor}.pos": value for motor, value in goals.items()})
        left = sent if isinstance(sent, Mapping) else {}
        off = max((abs(_number(left.get(f"{motor}.pos", value)) - value), motor) for motor, value in goals.items())
        if off[0] > CUT:
            self.cut, self._largest_cut = self.cut + 1, max(self._largest_cut, off)
            if self.cut == 1:
                _LOGGER.warning(*self.notes)

    @property
    def notes(self) -> tuple[str, ...]:
        """What the arm was not given in full, in a sentence; empty if LeRobot has sent everything."""
        if not self.cut:
            return ()
        most, motor = self._largest_cut
        unit = next((scale.unit for scale in self._scales if scale.motor == motor), "of its own unit")
        return (
            f"{self._name} sent less than it was given in {counted(self.cut, 'action')}, motor {motor} by up to "
            f"{most:.3g} {unit}: go slower, or raise max_relative_target or joint_limits in its config",
        )

    def release(self) -> None:
        """Switch off the torque of the joints' motors, so that a person can guide the arm: hold it, it falls.

        Raises:
            ConfigurationError: LeRobot cannot do that with this arm.
        """
        self._torque("disable_torque", "guide it with its teleoperator (lerobot-teleoperate) instead")

    def hold(self) -> None:
        """Hold the arm where it is: goals first, then torque, so that it does not go to where it was sent before.

        Raises:
            ConfigurationError: LeRobot cannot do that with this arm.
        """
        _, positions = self._observed()
        self._send(positions | self._held)
        self._torque("enable_torque", "switch it on with its own software")

    def _torque(self, name: str, instead: str) -> None:
        # most arms have it on their bus, some themselves, some nowhere: LeRobot's Robot does not promise it
        if (of_motors := _stated(self._arm, "bus", name)) is not None:
            of_motors([scale.motor for scale in self._scales])
        elif (of_arm := getattr(self._arm, name, None)) is not None:
            of_arm()
        else:
            raise ConfigurationError(f"{self._name} has no {name}(), neither itself nor on its bus: {instead}")

    def __repr__(self) -> str:
        return f"LeRobotDriver({self._name}, {len(self._scales)} joints, {1e3 * self.period:g} ms)"


@final
@dataclass(frozen=True)
class _Scale:
    """From a motor's position to its joint's and back.

    Attributes:
        motor: Its name.
        unit: A key of `_RAD`, or % of a range.
        centre: Motor position that is the joint's zero.
        zero: That joint position [rad or m].
        per_unit: Of the joint, negative where the motor turns against it [rad or m].
        bounds: (lowest, highest, what says so) of motor positions.
    """

    motor: str
    unit: str
    centre: float
    zero: float
    per_unit: float
    bounds: tuple[tuple[float, float, str], ...]

    def joint(self, value: float) -> float:
        """Return the joint position of a motor position."""
        return self.zero + self.per_unit * (value - self.centre)

    def motor_position(self, position: float) -> float:
        """Return the motor position of a joint position.

        Raises:
            ConfigurationError: It is outside the bounds.
        """
        value, rounding = self.centre + (float(position) - self.zero) / self.per_unit, _ROUNDING / abs(self.per_unit)
        for low, high, what in self.bounds:
            if not low - rounding <= value <= high + rounding or not math.isfinite(value):
                raise ConfigurationError(
                    f"motor {self.motor} is not sent to {value:.4g} {self.unit}, outside {low:.4g} .. {high:.4g}, "
                    f"{what}: start where the motion stays inside"
                )
            value = min(max(value, low), high)
        return value


def _scale(arm: Any, robot: Robot, motor: str, described: LeRobotMotor, units: Units | None) -> _Scale:
    """The scale of a motor, by LeRobot, by the robot's description and as given."""
    unit = _unit(arm, motor, units)
    joint = robot.joint_index(described.joint)
    lower, upper = float(robot.position_lower[joint]), float(robot.position_upper[joint])
    low, high = _RANGES.get(unit, (-math.inf, math.inf))
    zero, centre = described.zero, 0.0
    calibration = _stated(arm, "calibration", motor)
    steps = _stated(arm, "bus", "model_resolution_table", str(_stated(arm, "bus", "motors", motor, "model")))
    span = None  # [rad] calibrated; one turn is the last step less the first, as LeRobot counts it
    if calibration is not None and steps is not None:
        span = 2.0 * math.pi * (calibration.range_max - calibration.range_min) / (steps - 1)
    if unit in _RAD:
        if robot.joint_units[joint] != "rad":
            raise ConfigurationError(
                f"joint {described.joint} moves in m and motor {motor} in {unit}: "
                f"name the motor in others and lock the joint"
            )
        size = _RAD[unit]
        if span is not None:
            low, high = -0.5 * span / size, 0.5 * span / size
    else:
        span = described.span or span
        if span is None:
            span, zero = upper - lower, 0.5 * (lower + upper) if zero is None else zero
        if not math.isfinite(span):
            raise ConfigurationError(
                f"motor {motor} reads {low:g} .. {high:g} and neither a calibration nor joint limits say how far "
                f"that is: give LeRobotMotor({described.joint!r}, span=...) [rad]"
            )
        size, centre = span / (high - low), 0.5 * (low + high)
    per_unit, zero = described.sign * size, zero or 0.0
    ends = sorted(centre + (end - zero) / per_unit for end in (lower, upper))
    bounds = (low, high, "its calibrated range"), (ends[0], ends[1], f"the limits of joint {described.joint}")
    return _Scale(motor, unit if unit in _RAD else "%", centre, zero, per_unit, bounds)


def _unit(arm: Any, motor: str, given: Units | None) -> str:
    """A motor's unit by LeRobot, or as given."""
    if given not in (None, *get_args(Units)):
        raise ConfigurationError(f"units must be 'degrees', 'normalised' or 'radians', got {given!r}")
    asked = "range_m100_100" if given == "normalised" else given
    # the bus knows each motor's unit; arms without LeRobot's bus may still say it in their config
    known = _stated(arm, "bus", "motors", motor, "norm_mode", "value")
    if known not in (*_RAD, *_RANGES):
        in_degrees = _stated(arm, "config", "use_degrees")
        known = None if in_degrees is None else "degrees" if in_degrees else "range_m100_100"
    if known is None and asked is None:
        raise ConfigurationError(
            f"LeRobot does not say in which unit motor {motor} is: give units='degrees', 'normalised' (-100 .. "
            "100) or 'radians'; print the arm's get_observation() and move it to see which"
        )
    if known in ("degrees", "range_m100_100") and asked not in (None, known):
        raise ConfigurationError(
            f"motor {motor} is in {'degrees' if known == 'degrees' else '-100 .. 100'} by LeRobot's own config, "
            f"units={given!r} were given: leave units out"
        )
    return known or asked or ""


def _stated(thing: Any, *names: Any) -> Any:
    """An attribute of an attribute, or an entry of a mapping; None where LeRobot's robot does not have it."""
    for name in names:
        thing = thing.get(name) if isinstance(thing, Mapping) else getattr(thing, name, None)
    return thing


def _number(value: Any) -> float:
    """A scalar of whichever kind, NaN if it is none."""
    try:
        return float(value)
    except (TypeError, ValueError):
        return math.nan
