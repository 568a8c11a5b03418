"""Loops, arms and bad input that the tests of the servo loop share."""

from __future__ import annotations

from typing import Any

import numpy as np
from conftest import tip_of

import manip_learn as ml
from manip_learn.control.servo_loop import STANDING

DT = 0.001
ROUNDING = 1.0 + 1e-9  # of the change that the acceleration limits allow in a period
SAME = object()  # where the arm is, and the time of its clock
OLD = object()  # the time of the last state that was given with the time of the clock


def law_of(robot: ml.Robot, name: str, reach: float = 0.3, seed: int = 4, **settings: Any) -> ml.ResolvedRateController:
    """Two oblique rows, a target `reach` m away, and manipulability ascent."""
    rng = np.random.default_rng(seed)
    features = ml.FrameJacobian(robot, tip_of(name), "planar" if name == "planar3" else "xyz")
    constraint = ml.Constraint(np.linalg.qr(rng.normal(size=(3, 3)))[0][:2], features)
    target = features.coordinates(start_of(robot)) + reach * rng.uniform(-1.0, 1.0, 3)
    task = ml.PointAttractor(target, gain=2.0)
    return ml.ResolvedRateController(constraint, task, ml.ManipulabilityAscent(constraint), **settings)


def start_of(robot: ml.Robot, seed: int = 2) -> np.ndarray:
    """A posture inside the limits."""
    rng = np.random.default_rng(seed)
    low, high = np.maximum(robot.position_lower, -2.0), np.minimum(robot.position_upper, 2.0)
    return rng.uniform(low + 0.2 * (high - low), high - 0.2 * (high - low))


def command_of(velocity: Any) -> ml.Command:
    """A command of a user's own controller."""
    zero = np.zeros(np.size(velocity))
    return ml.Command(velocity, ml.Status.OK, 1.0, zero[:1], zero, zero, 1.0, 1.0, 1.0)


class Constantly:
    """A user's own controller that always wants the same velocity, in one array that it uses again and again."""

    def __init__(self, robot: ml.Robot, velocity: Any):
        self.robot, self.velocity = robot, np.array(velocity, dtype=np.float64)
        self.buffer = np.zeros(robot.nv)

    def __call__(self, q: np.ndarray, t: float = 0.0, dt: float | None = None) -> ml.Command:
        """The velocity, whatever the posture, which is written over."""
        q[:] = 99.0
        self.buffer[:] = self.velocity
        return command_of(self.buffer)


class Arm:
    """A perfect servo on a loop, every command of which must keep the limits of position, velocity and its rates."""

    def __init__(self, loop: ml.ServoLoop, q: np.ndarray):
        self.loop, self.q, self.t, self.newest, self.dt = loop, q, 0.0, 0.0, loop.dt
        self.last, self.rate = np.zeros((2, loop.robot.nv))

    def call(self, measured: Any = SAME, t: Any = SAME) -> ml.Command:
        """One period: what was measured, where that is not where the arm is, and its time, where that is another."""
        loop, robot, dt, t = self.loop, self.loop.robot, self.dt, self.newest if t is OLD else t
        command = loop.update(self.q if measured is SAME else measured, self.t if t is SAME else t)
        self.newest = self.t if t is SAME else self.newest
        u, change = command.velocity, command.velocity - self.last
        blocked = command.status is ml.Status.FOLLOWING_ERROR  # it then brakes as hard as the arm can
        most = np.maximum(loop.acceleration_limit, ml.Limits(robot).acceleration if blocked else 0.0)
        assert np.all(np.abs(change) <= most * dt * ROUNDING), (self.t, u, self.last)
        if loop.jerk_limit is not None and not blocked:
            assert np.all(np.abs(change - self.rate) <= loop.jerk_limit * dt * dt * (1.0 + 1e-6)), self.t
        assert np.all(np.abs(u) <= loop.limits.velocity * ROUNDING)
        self.q, self.last, self.rate, self.t = robot.integrate(self.q, dt * u), u, change, self.t + dt
        x = robot.positions(self.q)
        kept = (x <= robot.position_upper + 1e-9) & (x >= robot.position_lower - 1e-9)
        assert np.all(kept | (command.outside > 0.0) | (command.status in STANDING))
        return command

    def calls(self, periods: int, measured: Any = SAME, t: Any = SAME) -> list[ml.Command]:
        """As many of them."""
        return [self.call(measured, t) for _ in range(periods)]


def bad_postures(robot: ml.Robot) -> list[Any]:
    """What is no posture of a robot."""
    n = robot.nv
    return [
        None, "text", b"bytes", 3.0, True, [], {}, object(), range, lambda: 0, Refuses(), [[1.0], [2.0, 3.0]],
        [[0.0] * n], [1j] * n, [np.nan] * n, ["1"] * n, [None] * n, [10**400] * n, [True] * n,
        np.zeros(n + 5), np.zeros((1, n)), np.full(n, np.inf), np.full(n, -np.inf), np.array([0.0] * n, dtype=object),
        np.full(n, "0"), np.zeros(n, dtype="M8[s]"), np.append(np.zeros(n - 1), np.nan), np.zeros(n, dtype=complex),
        np.zeros(0), np.array(1.0),
    ]  # fmt: skip


BAD_TIMES = (
    None, "0.1", np.nan, np.inf, -np.inf, True, 10**400, [0.1], np.array([0.1]), 1j, np.complex128(1.0), object(),
    -1.0, -(10**9), np.timedelta64(1, "s"), np.float32("nan"), b"1", {},
)  # fmt: skip


class Refuses:
    """An object that cannot be made an array or a number: it fails with an error that no number ever raises."""

    def __array__(self, *_: Any, **__: Any) -> np.ndarray:
        raise ZeroDivisionError("no array")

    def __float__(self) -> float:
        raise ZeroDivisionError("no number")
