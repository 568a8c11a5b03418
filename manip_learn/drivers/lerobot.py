"""Driver of LeRobot robots: converts motor positions in degrees or -100 .. 100 to joint positions in rad."""

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

# units of a motor by their names on LeRobot's buses (MotorNormMode): [rad] per unit, or ends of a range
_RAD = {"degrees": math.pi / 180.0, "radians": 1.0}
_RANGES = {"range_m100_100": (-100.0, 100.0), "range_0_100": (0.0, 100.0)}
_LOGGER = logging.getLogger("manip_learn")


@final
@dataclass(frozen=True)
class LeRobotMotor:
    """Relation of a motor to its joint: joint position = zero + sign * motor position, in rad or m.

    Attributes:
        joint: Name of the joint in the robot's description.
        sign: -1 if the motor turns in the negative direction of the joint, otherwise 1.
        zero: Joint position at which the motor reads 0 (50 for a motor that reads 0 .. 100) [rad or m]. None for 0, or
            for the middle of the joint's limits if the range between these is the span.
        span: Joint motion over the whole range of the motor's readings, -100 .. 100 or 0 .. 100 [rad or m]. None for
            the range of the arm's calibration, or of the joint's limits if there is no calibration. Not used for a
            motor that reads degrees.

    Raises:
        ConfigurationError: The sign is not 1 or -1, the zero is not finite, or the span is not positive and finite.
    """

    joint: str
    sign: int = 1
    zero: float | None = None
    span: float | None = None

    def __post_init__(self) -> None:
        """Refuse invalid numbers.

        Raises:
            ConfigurationError: The sign, the zero or the span is invalid.
        """
        span_is_wrong = self.span is not None and not 0.0 < self.span < math.inf
        if self.sign not in (1, -1) or span_is_wrong or not math.isfinite(self.zero or 0.0):
            raise ConfigurationError(
                f"motor of joint {self.joint}: the sign must be 1 or -1, the zero a finite number and the "
                f"span a positive number [rad], got sign={self.sign!r}, zero={self.zero!r}, span={self.span!r}"
            )


@final
class LeRobotDriver:
    """Driver of a LeRobot robot, for `run` and `record`; it does not import LeRobot.

    Efforts are read from `"<motor>.torque"`, which CAN arms report in N m; currents and loads are not used. Velocities
    are read from `"<motor>.vel"` for motors that read degrees. The action features `"<motor>.vel"` and
    `"<motor>.torque"` are set to 0.

    Args:
        arm: A connected LeRobot `Robot`; the driver uses its `observation_features`, `action_features`, `is_connected`,
            `get_observation` and `send_action`.
        robot: Robot description whose joints the arm moves; locked joints need no motor.
        period: Time between two commands [s].
        motors: Mapping from motors to the names of their joints, or to a `LeRobotMotor`. A motor without an entry moves
            the joint with its own name.
        others: Motors that do not move a joint, e.g. of a gripper; they keep their first position. If such a motor
            reads 0 to 100, `gripper` moves it: 0 is closed and 100 is open.
        units: Unit of motor positions, `"radians"`, `"degrees"` or `"normalised"` (-100 .. 100). For most arms LeRobot
            states it (`bus.motors`, `config.use_degrees`): leave None; set it for all others.

    Attributes:
        period: Time between two commands [s].
        joint_names: Joints of the robot, in its order.
        cut: Number of actions that LeRobot has clipped, e.g. to its largest relative target.

    Raises:
        ConfigurationError: The arm is not connected, a motor has no joint, a joint has no motor, or the units are
            unknown or contradict LeRobot's.
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
            raise ConfigurationError(f"{self._name} is not connected: call its connect() first")
        self.period, self.joint_names = period, robot.joint_names
        self._others = (others,) if isinstance(others, str) else tuple(others)
        keys = arm.action_features
        self._motors: tuple[str, ...] = tuple(key.removesuffix(".pos") for key in keys if key.endswith(".pos"))
        self._still = {key: 0.0 for key in keys if not key.endswith(".pos")}  # zero speed and torque, sent every time
        if wrong := [key for key in self._still if not key.endswith((".vel", ".torque"))]:
            raise ConfigurationError(
                f"{self._name} expects {listed(wrong)}: this driver can only send positions of motors (.pos)"
            )
        if unseen := [motor for motor in self._motors if f"{motor}.pos" not in arm.observation_features]:
            raise ConfigurationError(f"{self._name} does not observe the position of {named('motor', unseen)}")
        assigned = self._assign(robot, dict(motors or {}))
        self._scales = [_scale(arm, robot, *assigned[joint], units) for joint in self.joint_names]
        self._held: dict[str, float] = {}
        self.cut, self._largest_cut = 0, (0.0, "")  # with its motor

    def _assign(self, robot: Robot, given: dict[str, str | LeRobotMotor]) -> dict[str, tuple[str, LeRobotMotor]]:
        """Return for each joint its motor, by name and with its `LeRobotMotor`."""
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
                    f"motor {motor} of {self._name} moves no joint of {robot.name}{locked}: name its joint, "
                    f"motors={{{motor!r}: NAME}}, or keep it still, others=({motor!r},)"
                )
            if described.joint in assigned:
                raise ConfigurationError(
                    f"joint {described.joint} has two motors, {assigned[described.joint][0]} and "
                    f"{motor}: name one of them in others"
                )
            assigned[described.joint] = motor, described
        if missing := [joint for joint in robot.joint_names if joint not in assigned]:
            raise ConfigurationError(
                f"no motor of {self._name} moves {named('joint', missing)} of {robot.name}: add it to motors, or load "
                f"the robot with locked=({', '.join(map(repr, missing))},)"
            )
        return assigned

    def read(self) -> tuple[Float[np.ndarray, " nv"], Float[np.ndarray, " nv"] | None, Float[np.ndarray, " nv"] | None]:
        """Return the joint positions (nv,) [rad or m], velocities (nv,) [rad/s] and efforts (nv,) [N m].

        Velocities and efforts are None if the arm does not measure them.

        Raises:
            ConfigurationError: A position is missing or not a finite number.
        """
        observation, values = self._observe()
        q = np.array([scale.joint(values[scale.motor]) for scale in self._scales])
        return q, self._joint_values(observation, "vel"), self._joint_values(observation, "torque")

    def _observe(self) -> tuple[Mapping[str, Any], dict[str, float]]:
        """Return the arm's observation, and motor -> position in its own unit; note the others' first positions.

        Raises:
            ConfigurationError: A position is missing or not a finite number.
        """
        observation = self._arm.get_observation()
        positions = {motor: _number(observation.get(f"{motor}.pos")) for motor in self._motors}
        if bad := [motor for motor, value in positions.items() if not math.isfinite(value)]:
            raise ConfigurationError(
                f"{self._name} reports {observation.get(f'{bad[0]}.pos')!r:.40} as position of motor {bad[0]}, which "
                "is not a finite number: check its cable and its power"
            )
        self._held = self._held or {motor: positions[motor] for motor in self._others}
        return observation, positions

    def _joint_values(self, seen: Mapping[str, Any], kind: Literal["vel", "torque"]) -> Float[np.ndarray, " nv"] | None:
        """Return velocities or torques of the joints; None if one is missing or its unit is unknown."""
        if kind == "vel" and any(scale.unit not in _RAD for scale in self._scales):
            return None
        values = [_number(seen.get(f"{scale.motor}.{kind}")) for scale in self._scales]
        factors = [scale.per_unit if kind == "vel" else math.copysign(1.0, scale.per_unit) for scale in self._scales]
        return np.multiply(factors, values) if all(map(math.isfinite, values)) else None

    def command(self, q: Float[np.ndarray, " nv"], u: Float[np.ndarray, " nv"]) -> None:
        """Send joint positions to the motors.

        Args:
            q: Joint positions (nv,) [rad or m].
            u: Joint velocities; not used.

        Raises:
            ConfigurationError: A position is outside the calibration or the limits; nothing is sent.
        """
        goals = {scale.motor: scale.motor_position(position) for scale, position in zip(self._scales, q, strict=True)}
        if self._others and not self._held:
            self._observe()
        self._send(goals | self._held)

    def gripper(self, word: Literal["close", "open"]) -> None:
        """Close or open the grippers among `others` with the next command: motors that read 0 (closed) to 100 (open).

        Args:
            word: `"close"` or `"open"`.
        """
        if not self._held:
            self._observe()
        for motor in self._held:
            if _look_up(self._arm, "bus", "motors", motor, "norm_mode", "value") == "range_0_100":
                self._held[motor] = 0.0 if word == "close" else 100.0

    def _send(self, goals: Mapping[str, float]) -> None:
        """Send motor positions, and note the reductions by LeRobot."""
        sent = self._arm.send_action(self._still | {f"{motor}.pos": value for motor, value in goals.items()})
        actual = sent if isinstance(sent, Mapping) else {}
        off = max((abs(_number(actual.get(f"{motor}.pos", value)) - value), motor) for motor, value in goals.items())
        if off[0] > 1e-4:  # in the motor's unit; LeRobot itself reports larger reductions
            self.cut, self._largest_cut = self.cut + 1, max(self._largest_cut, off)
            if self.cut == 1:
                _LOGGER.warning(*self.notes)

    @property
    def notes(self) -> tuple[str, ...]:
        """One sentence on the actions that LeRobot has clipped; empty if it has clipped none."""
        if not self.cut:
            return ()
        most, motor = self._largest_cut
        unit = next((scale.unit for scale in self._scales if scale.motor == motor), "in its own unit")
        return (
            f"{self._name} reduced {counted(self.cut, 'action')}, motor {motor} by up to {most:.3g} {unit}: "
            f"go slower, or raise max_relative_target or joint_limits in its config",
        )

    def release(self) -> None:
        """Switch off the torque of the joints' motors, so that a person can guide the arm. Support the arm: it falls.

        Raises:
            ConfigurationError: LeRobot cannot switch off the torque of this arm.
        """
        self._torque("disable_torque", "guide it with its teleoperator (lerobot-teleoperate) instead")

    def hold(self) -> None:
        """Hold the arm at its present position. The goals are set before the torque, so that it does not move.

        Raises:
            ConfigurationError: LeRobot cannot switch on the torque of this arm.
        """
        _, positions = self._observe()
        self._send(positions | self._held)
        self._torque("enable_torque", "switch it on with its own software")

    def _torque(self, name: str, instead: str) -> None:
        """Call a method for the torque of the joints' motors, of the bus or of the arm."""
        # the method is on the bus for most arms, on the arm for some, missing for others: LeRobot's Robot does not
        # promise it
        if (bus_method := _look_up(self._arm, "bus", name)) is not None:
            bus_method([scale.motor for scale in self._scales])
        elif (arm_method := getattr(self._arm, name, None)) is not None:
            arm_method()
        else:
            raise ConfigurationError(f"{self._name} has no {name}(), neither on the arm nor on its bus: {instead}")

    def __repr__(self) -> str:
        return f"LeRobotDriver({self._name}, {len(self._scales)} joints, {1e3 * self.period:g} ms)"


@final
@dataclass(frozen=True)
class _Scale:
    """The conversion between a motor's position and its joint's.

    Attributes:
        motor: Name of the motor.
        unit: A key of `_RAD`, or % of a range.
        centre: Motor position at the joint position `zero`.
        zero: That joint position [rad or m].
        per_unit: Joint motion per unit of the motor, negative if the motor turns against the joint [rad or m].
        bounds: (lowest, highest, source) of motor positions.
    """

    motor: str
    unit: str
    centre: float
    zero: float
    per_unit: float
    bounds: tuple[tuple[float, float, str], ...]

    def joint(self, value: float) -> float:
        """Return the joint position of a motor position [rad or m].

        Args:
            value: Motor position in its unit.
        """
        return self.zero + self.per_unit * (value - self.centre)

    def motor_position(self, position: float) -> float:
        """Return the motor position, in the motor's unit, that belongs to a joint position.

        Args:
            position: Joint position [rad or m].

        Raises:
            ConfigurationError: The motor position is outside its bounds.
        """
        rounding = 1e-6 / abs(self.per_unit)  # [rad or m] / unit: tolerance at the limits, for round-trip conversion
        value = self.centre + (float(position) - self.zero) / self.per_unit
        for low, high, what in self.bounds:
            if not low - rounding <= value <= high + rounding or not math.isfinite(value):
                raise ConfigurationError(
                    f"motor {self.motor} is not sent to {value:.4g} {self.unit}, outside {low:.4g} .. {high:.4g}, "
                    f"{what}: start where the motion stays inside"
                )
            value = min(max(value, low), high)
        return value


def _scale(arm: Any, robot: Robot, motor: str, described: LeRobotMotor, units: Units | None) -> _Scale:
    """Return the scale of a motor, from LeRobot, the robot's description and the user's settings."""
    unit = _unit(arm, motor, units)
    joint = robot.joint_index(described.joint)
    lower, upper = float(robot.position_lower[joint]), float(robot.position_upper[joint])
    low, high = _RANGES.get(unit, (-math.inf, math.inf))
    zero, centre = described.zero, 0.0
    calibration = _look_up(arm, "calibration", motor)
    steps = _look_up(arm, "bus", "model_resolution_table", str(_look_up(arm, "bus", "motors", motor, "model")))
    span = None  # [rad] calibrated range; LeRobot counts a turn as steps - 1
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
                f"motor {motor} reads {low:g} .. {high:g} and neither a calibration nor joint limits give "
                f"its span: set LeRobotMotor({described.joint!r}, span=...) [rad]"
            )
        size, centre = span / (high - low), 0.5 * (low + high)
    per_unit, zero = described.sign * size, zero or 0.0
    ends = sorted(centre + (end - zero) / per_unit for end in (lower, upper))
    bounds = (low, high, "its calibrated range"), (ends[0], ends[1], f"the limits of joint {described.joint}")
    return _Scale(motor, unit if unit in _RAD else "%", centre, zero, per_unit, bounds)


def _unit(arm: Any, motor: str, given: Units | None) -> str:
    """Return a motor's unit, from LeRobot or the user's setting."""
    if given not in (None, *get_args(Units)):
        raise ConfigurationError(f"units must be 'degrees', 'normalised' or 'radians', got {given!r}")
    setting = "range_m100_100" if given == "normalised" else given
    # the bus knows each motor's unit; arms without LeRobot's bus may have it in their config
    stated = _look_up(arm, "bus", "motors", motor, "norm_mode", "value")
    if stated not in (*_RAD, *_RANGES):
        in_degrees = _look_up(arm, "config", "use_degrees")
        stated = None if in_degrees is None else "degrees" if in_degrees else "range_m100_100"
    if stated is None and setting is None:
        raise ConfigurationError(
            f"LeRobot does not know the unit of motor {motor}: set units='degrees', 'normalised' (-100 .. "
            "100) or 'radians'; print the arm's get_observation() while you move it to see which"
        )
    if stated in ("degrees", "range_m100_100") and setting not in (None, stated):
        raise ConfigurationError(
            f"motor {motor} is in {'degrees' if stated == 'degrees' else '-100 .. 100'} by LeRobot's own config, "
            f"but units={given!r}: leave units out"
        )
    return stated or setting or ""


def _look_up(thing: Any, *names: Any) -> Any:
    """Return an attribute of an attribute, or an entry of a mapping; None if LeRobot's robot does not have it."""
    for name in names:
        thing = thing.get(name) if isinstance(thing, Mapping) else getattr(thing, name, None)
    return thing


def _number(value: Any) -> float:
    """Return any kind of scalar as a float, NaN for other values."""
    try:
        return float(value)
    except (TypeError, ValueError):
        return math.nan
