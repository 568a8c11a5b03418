"""Loops and bad input that the tests of the servo loop share."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from conftest import tip_of

import manip_learn as ml
from manip_learn.control.command import Command
from manip_learn.robot.robot import Robot

DT = 0.001
RobotOf = Callable[[str], Robot]


def law_of(robot: Robot, name: str, reach: float = 0.3, seed: int = 4, **settings: Any) -> ml.ResolvedRateController:
    """Two oblique rows, a target `reach` m away, and manipulability ascent."""
    rng = np.random.default_rng(seed)
    axes = "planar" if name == "planar3" else "xyz"
    features = ml.FrameJacobian(robot, tip_of(name), axes)
    constraint = ml.Constraint(np.linalg.qr(rng.normal(size=(3, 3)))[0][:2], features)
    target = features.coordinates(start_of(robot)) + reach * rng.uniform(-1.0, 1.0, 3)
    task = ml.PointAttractor(target, gain=2.0)
    return ml.ResolvedRateController(constraint, task, ml.ManipulabilityAscent(constraint), **settings)


def start_of(robot: Robot, seed: int = 2) -> np.ndarray:
    """A posture inside the limits."""
    rng = np.random.default_rng(seed)
    low, high = np.maximum(robot.position_lower, -2.0), np.minimum(robot.position_upper, 2.0)
    return rng.uniform(low + 0.2 * (high - low), high - 0.2 * (high - low))


def command_of(velocity: Any, words: str = "ok") -> Command:
    """A command of a user's own controller."""
    zero = np.zeros(np.size(velocity))
    return Command(velocity, ml.Status(words), 1.0, zero[:1], zero, zero, 1.0, 1.0, 1.0)


class Constantly:
    """A user's own controller that always wants the same velocity, in one array that it uses again and again."""

    def __init__(self, robot: Robot, velocity: Any):
        self.robot, self.velocity = robot, np.array(velocity, dtype=np.float64)
        self.buffer = np.zeros(robot.nv)

    def __call__(self, q: np.ndarray, t: float = 0.0, dt: float | None = None) -> Command:
        """The velocity, whatever the posture, which is written over."""
        q[:] = 99.0
        self.buffer[:] = self.velocity
        return command_of(self.buffer)


def run(loop: ml.ServoLoop, q: np.ndarray, periods: int, t: float = 0.0) -> Iterator[tuple[np.ndarray, Command]]:
    """A perfect servo: (posture, command) of each period; the posture is the one that the command begins at."""
    for k in range(periods):
        command = loop.update(q, t + k * DT)
        yield q, command
        q = loop.robot.integrate(q, DT * command.velocity)


def bad_postures(robot: Robot) -> list[Any]:
    """What is no posture of a robot."""
    n = robot.nv
    return [
        *(
            None,
            "text",
            b"bytes",
            3.0,
            True,
            [],
            {},
            object(),
            np.zeros(n + 5),
            np.zeros((1, n)),
            [[0.0] * n],
            [1j] * n,
        ),
        *([np.nan] * n, np.full(n, np.inf), np.full(n, -np.inf), ["1"] * n, [None] * n, [10**400] * n, [True] * n),
        *(
            np.array([0.0] * n, dtype=object),
            np.full(n, "0"),
            np.zeros(n, dtype="M8[s]"),
            [[1.0], [2.0, 3.0]],
            Refuses(),
        ),
        *(np.append(np.zeros(n - 1), np.nan), np.zeros(n, dtype=complex), np.zeros(0), np.array(1.0), range, lambda: 0),
    ]


BAD_TIMES = (
    *(None, "0.1", np.nan, np.inf, -np.inf, True, 10**400, [0.1], np.array([0.1]), 1j, np.complex128(1.0), object()),
    *(-1.0, -(10**9), np.timedelta64(1, "s"), np.float32("nan"), b"1", {}),
)


class Refuses:
    """An object that cannot be made an array."""

    def __array__(self, *_: Any, **__: Any) -> np.ndarray:
        """Fails with an error that no number ever raises."""
        raise ZeroDivisionError("no array")

    def __float__(self) -> float:
        """Likewise."""
        raise ZeroDivisionError("no number")
