"""How tests compare compiled controllers with their originals, compiled or as the plain Python that they are."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import tip_of
from random_arms import random_tree

from manip_learn.constraint.constraint import Constraint
from manip_learn.constraint.features import MechanismRows
from manip_learn.constraint.features.mechanism_rows import AT_A_DISTANCE, FIELDS, PlaceRows
from manip_learn.constraint.features.weighed_velocity import WeighedVelocity
from manip_learn.constraint.mechanism import MECHANISM_KINDS
from manip_learn.control import compiled_controller
from manip_learn.control.command import Command, Controller
from manip_learn.control.controller import ResolvedRateController
from manip_learn.control.limits import Limits
from manip_learn.robot.batch.kernel_cache import KERNEL_FILES
from manip_learn.robot.robot import Robot

needs_numba = pytest.mark.skipif(find_spec("numba") is None, reason="the extra 'fast' is not installed")
both_ways = pytest.mark.parametrize("numba", [pytest.param(True, marks=needs_numba), False])
RobotOf = Callable[[str], Robot]


@pytest.fixture
def kernels(numba: bool, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """The kernels as they are compiled, or the same function objects run by the interpreter."""
    if numba:
        yield
        return
    monkeypatch.setattr(compiled_controller, "find_spec", lambda name: "plain Python instead")
    # all of them first: one that is imported beside a replaced one would keep what it takes from it
    for module in [import_module("manip_learn." + file.removesuffix(".py").replace("/", ".")) for file in KERNEL_FILES]:
        for name, value in list(vars(module).items()):
            monkeypatch.setattr(module, name, getattr(value, "py_func", value))
    with np.errstate(all="ignore"):  # as compiled code, which overflows to infinity in silence
        yield


def mechanisms(robot: Robot, frame: str, rng: np.random.Generator) -> Iterator[Constraint]:
    """Every mechanism that has a name, at a radius and at any, its rows in another basis; and rows of every form."""
    point = robot.position(robot.random_configuration(rng), robot.frame(frame)) + rng.normal(size=3) / 5.0
    maps: list[WeighedVelocity] = [MechanismRows(robot, frame, tuple(FIELDS), axis=(0.2, -0.3, 0.9), pitch=0.05)]
    for kind in MECHANISM_KINDS:
        for radius in (None, 0.3) if set(kind.rows) & set(AT_A_DISTANCE) else (None,):
            place = {"axis": rng.normal(size=3), "point": point, "pitch": 0.03, "radius": radius}
            maps.append(MechanismRows(robot, frame, kind.rows, **place))
    maps += [PlaceRows(robot, frame, form, point) for form in ("point", "point and rotation", "twist", "surface")]
    for features in maps:
        r = features.n_rows
        s = r if isinstance(features, MechanismRows) and r <= 5 else int(rng.integers(1, 4))
        yield Constraint(np.linalg.qr(rng.normal(size=(r, s)))[0].T, features)


def tight(robot: Robot, frames: tuple[str, ...], q: np.ndarray, rng: np.random.Generator) -> Limits:
    """Limits of frames that bind at a posture: a speed, a box about the first, an oblique wall, or all of them."""
    place, kind = robot.position(q, frames[0]), int(rng.integers(4))
    limits: dict[str, Any] = {"frames": frames}
    if kind in (0, 3):
        limits["tip_speed"] = float(10.0 ** rng.uniform(-2.0, 0.0))
    if kind in (1, 3):
        limits["tip_box"] = [place - 10.0 ** rng.uniform(-4.0, 0.0, 3), place + 10.0 ** rng.uniform(-4.0, 0.0, 3)]
    if kind in (2, 3):  # in front of it, or a little behind
        n = rng.normal(size=3)
        limits["tip_walls"] = [[*n, n @ place + float(rng.choice([-1e-3, 1e-4, 1e-2, 0.1]))]]
    return Limits(robot, acceleration=np.inf if rng.random() < 0.2 else None, **limits)


def compared(law: Controller, kernel: Controller, q: np.ndarray, *arguments: Any, at_limits: float = 1e-9) -> str:
    """The status of the original's command, which the kernel must give as well, and without asking the original.

    The original is asked a second time a rounding error beside, and where that changes its answer it is no judge.
    """
    expected, beside = law(q, *arguments), law(q * (1.0 + 4e-16) + 1e-16, *arguments)
    with pytest.MonkeyPatch.context() as patch:
        if isinstance(kernel, compiled_controller.CompiledController):
            patch.setattr(ResolvedRateController, "__call__", lambda *a: pytest.fail("handed back"))
        got = kernel(q, *arguments)
    if not 1e-15 < expected.smallest_singular_value < 1e-12:  # where rounding decides whether that is singular
        agree(got, expected, beside, at_limits)
    return str(expected.status)


def state_of(rng: np.random.Generator, robot: Robot, fastest: float = 1.0) -> tuple[float, float, Any, float]:
    """Time, period, velocity before (or None) and slide of a call, at random."""
    previous = np.minimum(robot.velocity_limit, 5.0) * rng.uniform(-fastest, fastest, robot.nv)
    slide = float(rng.choice([0.0, 0.4, 1.0]))
    return 0.0, float(10.0 ** rng.uniform(-3.0, -1.0)), previous if rng.random() < 0.6 else None, slide


def robot_named(name: str, robot_of: RobotOf, rng: np.random.Generator, folder: Path) -> tuple[Robot, str]:
    """The robot and its tip; a random one for "tree"."""
    return (random_tree(rng, folder), "tip") if name == "tree" else (robot_of(name), tip_of(name))


def agree(got: Command, expected: Command, slack: Command | None = None, at_limits: float = 1e-10) -> None:
    """All fields; `slack` is the original's command a rounding error beside, which says what rounding does to it."""
    if expected.task_scale == 0.0 and not np.any(expected.null_part) and np.any(got.null_part):
        return  # the original's solver has given up
    # A is known to 1e-16: where it is small as a whole, so is what A^+ can be known to
    scale = max(1.0, float(np.max(np.abs(expected.velocity))))
    scale *= max(1.0, 0.01 / max(expected.smallest_singular_value, 1e-300))
    exact = expected.status in ("ok", "singular", "damped")
    for name in ("velocity", "task_velocity", "task_part", "null_part", "escape_part"):
        a, b = getattr(got, name), getattr(expected, name)
        assert (a is None) == (b is None), name
        if b is not None:
            rounding = 0.0 if slack is None else 20.0 * float(np.max(np.abs(getattr(slack, name) - b), initial=0.0))
            atol = scale * (1e-12 if exact and slack is None else at_limits) + rounding
            np.testing.assert_allclose(a, b, rtol=0, atol=atol, err_msg=name)
    for name in ("manipulability", "smallest_singular_value"):
        assert getattr(got, name) == pytest.approx(getattr(expected, name), rel=1e-11, abs=1e-12), name
    if slack is None or slack.status == expected.status:
        assert got.status == expected.status
    for name in ("progress", "outside", "task_scale"):
        rounding = 0.0 if slack is None else 20.0 * abs(getattr(slack, name) - getattr(expected, name))
        relative = scale * 1e-10 / max(float(np.linalg.norm(expected.task_velocity)), 1e-6)
        assert getattr(got, name) == pytest.approx(getattr(expected, name), abs=relative + 1e-7 + rounding), name
    if slack is not None and slack.limiting_joint == expected.limiting_joint:
        assert got.limiting_joint == expected.limiting_joint
    if slack is None and min(float(np.linalg.norm(expected.null_part)), expected.smallest_singular_value) > 1e-6:
        assert got.null_scale == pytest.approx(expected.null_scale, abs=1e-7)
