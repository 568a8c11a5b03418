"""Whole recordings of people who take hold of one thing, move it, take it back, and go away; with the truth."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, final

import numpy as np
import pytest
from mechanism_motions import follow
from scipy.spatial.transform import Rotation

import manip_learn as ml

EXAMPLES = Path(__file__).resolve().parents[1] / "examples"
GRIP, WANDER, BEND = 0.12, 0.06, 0.1  # [rad] between grips, of the spare joints on the way, of a reach's detours
FINDS_AGAIN = 4e-4  # [m] to which a person finds a handle again
SPREAD = 0.06  # of how far people go, relative
Path3 = Callable[[np.ndarray], np.ndarray]


@final
@dataclass(frozen=True)
class Thing:
    """What is moved: where the hand takes hold, and where it is after so much of the way [m or rad]."""

    kind: str
    hold: np.ndarray
    place: Path3
    unit: str
    axis: np.ndarray
    size: float


def _tools() -> tuple[Any, Any, Any]:
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(EXAMPLES))
        return tuple(
            importlib.import_module(f"make_recordings.{name}") for name in ("arms", "furniture", "hand_motion")
        )


def thing(kind: str, hold: np.ndarray, rng: np.random.Generator) -> Thing:
    """A piece of furniture whose handle is at a place, turned at random but as furniture stands."""
    out = -hold * [1.0, 1.0, 0.0] / np.linalg.norm(hold[:2])  # towards the base, as chests face who opens them
    out = Rotation.from_rotvec([0.0, 0.0, rng.uniform(-0.5, 0.5)]).apply(out)
    up = np.array([0.0, 0.0, 1.0])
    side = np.cross(out, up)
    if kind == "drawer":
        return Thing(kind, hold, lambda c: hold + np.outer(c[:, 0], out), "m", out, rng.uniform(0.12, 0.2))
    if kind == "table":
        n = Rotation.from_rotvec(rng.normal(0.0, 0.15, 3)).apply(up)
        basis = np.linalg.svd(n[None])[2][1:]
        return Thing(kind, hold, lambda c: hold + c @ basis, "m", n, rng.uniform(0.05, 0.08))
    arm = out * rng.uniform(0.2, 0.3)  # of a lid

    def place(c: np.ndarray) -> np.ndarray:
        return hold - arm + Rotation.from_rotvec(np.outer(c[:, 0], side)).apply(arm)

    return Thing(kind, hold, place, "rad", side, 0.5 * rng.uniform(0.8, 1.2))


def coordinates(one: Thing, rng: np.random.Generator, tools: Any) -> np.ndarray:
    """The way that a person goes: out, a pause, and back; or about a table. Shape (T, k), from zero."""
    motion = tools[2]
    if one.kind == "table":
        t = np.linspace(0.0, 1.0, 400)
        loops = np.column_stack([np.sin(4.0 * np.pi * t) * one.size, 2.0 * one.size * t])
        ease = motion.minimum_jerk(np.linspace(0.0, 1.0, 450))
        return np.column_stack([np.interp(ease, t, c) for c in loops.T]) * rng.normal(1.0, SPREAD)
    far = one.size * rng.normal(1.0, SPREAD)
    speed = rng.uniform(1.6, 2.4)
    return motion.strokes(np.array([[far], [0.0]]), np.array([speed, speed]), np.array([0.3, 0.0]))


def recordings(
    kinds: Sequence[str], robot: str, seed: int, n: int = 6, noise: float = 1e-4
) -> tuple[ml.Robot, str, list[ml.Trajectory], list[Thing], list[list[float]]]:
    """Whole recordings of one or several things in this order: robot, tip, recordings, things, and how far each went.

    The way is that from the handle to the farthest point [m or rad].
    """
    tools = _tools()
    arm = tools[0].load_arm(robot)
    for draw in range(200):
        rng = np.random.default_rng([seed, draw, sum(map(ord, "".join(kinds) + robot))])
        middles = [tools[1].comfortable(arm, rng) for _ in kinds]
        things = [thing(kind, arm.pose(q)[:3, 3], rng) for kind, q in zip(kinds, middles, strict=True)]
        away = tools[1].comfortable(arm, rng)
        made = [_one(arm, things, middles, away, np.random.default_rng([seed, draw, i]), tools) for i in range(n)]
        if all(m is not None for m in made):
            break
    else:
        raise RuntimeError(f"{kinds}, {robot}, seed {seed}: nothing within reach was drawn")
    noises = np.random.default_rng([seed, 99])
    demos, ways = [], []
    for i, (q, far) in enumerate(m for m in made if m is not None):
        noisy = q + noises.normal(0.0, noise, q.shape)
        demos.append(ml.Trajectory(np.arange(len(q)) * 0.01, noisy, None, arm.robot.joint_names, f"demo_{i}"))
        ways.append(far)
    return arm.robot, arm.tip.name, demos, things, [list(w) for w in zip(*ways, strict=True)]


def _one(arm: Any, things: list[Thing], middles: list[np.ndarray], away: np.ndarray, rng: Any, tools: Any) -> Any:
    motion, nv = tools[2], len(away)
    q = away + rng.normal(0.0, 0.2, nv)
    parts, ways = [motion.rest(q, 0.4)], []
    for one, middle in zip(things, middles, strict=True):
        c = coordinates(one, rng, tools)
        ways.append(float(np.max(np.linalg.norm(c, axis=1))))
        places = one.place(c) + rng.normal(0.0, FINDS_AGAIN, 3)
        wander = motion.slow_curve(len(c) - 1, np.full(nv, WANDER), (0.1, 0.4), rng)
        grip = middle + rng.normal(0.0, GRIP, nv)
        try:
            contact = follow(arm.robot, arm.tip.name, grip, (places, None), wander)
        except RuntimeError:
            return None
        parts += [motion.reach(q, contact[0], rng.uniform(1.6, 2.2), BEND, rng), motion.rest(contact[0], 0.25)]
        parts += [contact, motion.rest(contact[-1], 0.25)]
        q = contact[-1]
    parts += [motion.reach(q, away + rng.normal(0.0, 0.05, nv), 1.5, BEND, rng)]
    whole = np.concatenate(parts)
    return (whole, ways) if arm.stays_inside(whole, 100.0) and arm.keeps_clear(whole[::10]) else None
