"""Furniture at a random place within the arm's reach, and how a person moves it."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from make_recordings.arms import Arm
from make_recordings.hand_motion import samples, slow_curve, strokes
from make_recordings.mechanisms import Axle, Ball, Mechanism, Plane, Slide, Upright, across

UP = np.array([0.0, 0.0, 1.0])
NO_BAR = np.zeros((0, 3))

Maker = Callable[[Float[np.ndarray, " 3"], np.random.Generator], Mechanism]


def drawer(handle: Float[np.ndarray, " 3"], rng: np.random.Generator, firm: bool = False) -> Slide:
    """A drawer or a lid on rails that runs in any direction up to 30 degrees from level; it has a bar to hold."""
    heading, slope = rng.uniform(-np.pi, np.pi), rng.uniform(-np.pi / 6, np.pi / 6)
    axis = np.array([np.cos(heading) * np.cos(slope), np.sin(heading) * np.cos(slope), np.sin(slope)])
    level = across(axis) * np.array([[0.05], [0.04]])
    return Slide(handle, level, np.array([rng.uniform(0.15, 0.28)]), axis, firm)


def table(handle: Float[np.ndarray, " 3"], rng: np.random.Generator, flat: bool = False) -> Plane:
    """A table top that leans by up to 15 degrees, one time in four a wall."""
    normal = Rotation.from_rotvec(np.append(rng.uniform(-0.26, 0.26, 2), 0.0)).apply(UP)
    if rng.random() < 0.25:
        normal = Rotation.from_rotvec([0.0, np.pi / 2, 0.0]).apply(normal)
        normal = Rotation.from_rotvec(rng.uniform(-1.0, 1.0) * UP).apply(normal)
    return Plane(handle, across(normal) * 0.05, rng.uniform(0.03, 0.06, 2), normal, flat)


def door(handle: Float[np.ndarray, " 3"], rng: np.random.Generator, firm: bool = False) -> Axle:
    """A door with an upright hinge, or a flap with a level one; handle 0.25 to 0.45 m from the hinge."""
    axis = UP if rng.random() < 0.6 else Rotation.from_rotvec(rng.uniform(-np.pi, np.pi) * UP).apply([1.0, 0.0, 0.0])
    axis = Rotation.from_rotvec(rng.uniform(-0.12, 0.12, 3)).apply(axis) * rng.choice([-1.0, 1.0])
    radius = rng.uniform(0.25, 0.45)
    angle = rng.uniform(-np.pi, np.pi)
    point = handle + radius * np.array([np.cos(angle), np.sin(angle)]) @ across(axis)
    return Axle(handle, axis[None] * 0.05, np.array([rng.uniform(0.5, 0.9)]), axis, point, firm=firm)


def _knob(handle: np.ndarray, rng: np.random.Generator, pitch: float = 0.0, sleeve: bool = False) -> Axle:
    axis = rng.normal(size=3)
    axis /= np.linalg.norm(axis)
    point = handle + rng.uniform(-0.06, 0.06, 2) @ across(axis)
    size = np.array([rng.uniform(0.7, 1.3)] + [rng.uniform(0.08, 0.16)] * sleeve)
    return Axle(handle, NO_BAR, size, axis, point, pitch, sleeve)


def hinge(handle: Float[np.ndarray, " 3"], rng: np.random.Generator) -> Axle:
    """A knob or lever close to its axis, which points anywhere."""
    return _knob(handle, rng)


def screw(handle: Float[np.ndarray, " 3"], rng: np.random.Generator) -> Axle:
    """A coarse thread: 0.02 to 0.06 m/rad, either hand."""
    return _knob(handle, rng, pitch=rng.uniform(0.02, 0.06) * rng.choice([-1.0, 1.0]))


def sleeve(handle: Float[np.ndarray, " 3"], rng: np.random.Generator) -> Axle:
    """A ring on a rod: turns and slides."""
    return _knob(handle, rng, sleeve=True)


def tether(handle: Float[np.ndarray, " 3"], rng: np.random.Generator, firm: bool = False) -> Ball:
    """A taut cord of 0.2 to 0.4 m; the hand turns as it likes."""
    direction = rng.normal(size=3)
    length = rng.uniform(0.2, 0.4)
    point = handle + length * direction / np.linalg.norm(direction)
    return Ball(handle, NO_BAR, np.full(3, rng.uniform(0.2, 0.35)), point, firm)


def glass(handle: Float[np.ndarray, " 3"], rng: np.random.Generator) -> Upright:
    """A full glass; it sways by 0.5 to 1.5 degrees."""
    sway = np.deg2rad(rng.uniform(0.5, 1.5))
    return Upright(handle, 0.05 * np.eye(3), np.array([0.15, 0.15, 0.1, sway, sway]), float(sway))


def draw_way(mechanism: Mechanism, tempo: float, rng: np.random.Generator) -> Float[np.ndarray, "T k"]:
    """Coordinates of a mechanism as a person moves it, from zero; everything takes `tempo` times as long."""
    size = mechanism.size
    match mechanism:
        case Plane():
            return slow_curve(samples(tempo * rng.uniform(3.0, 5.0)), size, (0.15, 0.6), rng)
        case Ball():
            return slow_curve(samples(tempo * rng.uniform(3.0, 5.0)), size, (0.1, 0.4), rng)
        case Upright():
            m = int(rng.integers(3, 5))
            way = _strokes(rng.uniform(-1.0, 1.0, (m, 3)) * size[:3], tempo, rng)
            return np.column_stack([way, slow_curve(len(way) - 1, size[3:], (0.2, 0.8), rng)])
        case Axle(sleeve=True):
            m = int(rng.integers(3, 5))
            return _strokes(rng.uniform(-0.9, 0.9, (m, 2)) * size, tempo, rng)
    far = rng.uniform(0.7, 1.0)
    shares = [far, far * rng.uniform(0.0, 0.3), far * rng.uniform(0.6, 1.0)][: int(rng.choice([1, 2, 2, 2, 3]))]
    return _strokes(np.outer(shares, size), tempo * (1.5 if len(shares) == 1 else 1.0), rng)


def _strokes(points: np.ndarray, tempo: float, rng: np.random.Generator) -> np.ndarray:
    m = len(points)
    pauses = np.where(rng.random(m) < 0.3, rng.uniform(0.1, 0.8, m), 0.0)
    return strokes(points, tempo * rng.uniform(1.0, 1.9, m), pauses)


def comfortable(arm: Arm, rng: np.random.Generator) -> Float[np.ndarray, " nv"]:
    """A posture [rad] anywhere around the base, the elbow about up."""
    q = arm.ready + rng.normal(0.0, 0.25, len(arm.ready))
    q[0] = arm.ready[0] + rng.uniform(-1.2, 1.2)
    return q
