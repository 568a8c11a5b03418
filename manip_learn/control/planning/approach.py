"""A joint path from one posture to another, clear of self-collision: straight, or by two trees that grow together.

The trees are those of Kuffner and LaValle, "RRT-Connect", ICRA 2000, in our own code since the planners of OMPL draw
from one random source a process, whose seed counts before its first use only: a plan could not be repeated by its seed.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import final

import numpy as np
from jaxtyping import Float

from manip_learn.control.limits import Limits
from manip_learn.errors import RobotError
from manip_learn.robot.collision import SelfCollision
from manip_learn.robot.robot import Robot

CLEARANCE = 0.005  # [m] between links: what a servo's lag makes of a path; links that are neighbours come within 2 cm
STEP = 0.02  # [rad or m] between checks: a hand at 0.25 m moves by the clearance
REACH = 0.4  # [rad or m] by which a tree grows at once
TRIES = 600  # of the trees: a quarter of a second of checks, for each posture of hold that is tried
SHORTCUTS = 60  # pairs of a path's postures that are tried: of ten postures there are 36

Posture = Float[np.ndarray, " nv"]


@lru_cache(maxsize=8)
def self_collision(robot: Robot) -> SelfCollision | None:
    """The links that can touch each other, of the collision shapes or else the drawn ones; None if there are none."""
    for shapes in ("collision", "visual"):
        try:
            return SelfCollision(robot, shapes=shapes)  # type: ignore[arg-type]  # the two words that it knows
        except RobotError:
            continue
    return None


@final
class Clearance:
    """Whether postures are clear of self-collision.

    Args:
        collision: The pairs of links; None where there are no shapes: everything is clear.
        robot: The robot.
        known: Postures that count as clear as they are: where they are nearer than the clearance, that is taken.
    """

    def __init__(self, collision: SelfCollision | None, robot: Robot, known: list[Posture]):
        self._collision, self._robot = collision, robot
        nearest = [] if collision is None else [collision.nearest(robot.configuration(q)) for q in known]
        self.least = max(0.0, min([CLEARANCE, *(0.5 * pair.distance for pair in nearest if pair is not None)]))

    def near(self, q: Posture, distance: float | None = None) -> tuple[str, str] | None:
        """Two links that are nearer to each other than a distance [m], by default that asked for; None if none are."""
        if self._collision is None:
            return None
        far = self.least if distance is None else distance
        found = self._collision.closer_than(self._robot.configuration(q), far)
        return found[0].links if found else None

    def __call__(self, q: Posture) -> bool:
        """Whether a posture is clear."""
        return self.near(q) is None

    def of_line(self, a: Posture, b: Posture) -> bool:
        """Whether the straight joint motion between two postures is clear, the middle looked at first."""
        n = max(1, int(np.ceil(np.max(np.abs(b - a)) / STEP)))
        return all(self(a + i / n * (b - a)) for i in sorted(range(1, n), key=lambda i: abs(i - n // 2)))


def clear_path(
    start: Posture, goal: Posture, limits: Limits, clear: Clearance, rng: np.random.Generator
) -> list[Posture] | None:
    """Postures from the start to the goal, straight motions between which are clear; None where none was found.

    Args:
        start: Joint positions, within the limits.
        goal: Joint positions.
        limits: Of the joints.
        clear: What is clear; both ends are.
        rng: Random numbers of the trees.
    """
    if clear.of_line(start, goal):
        return [start, goal]
    low = np.where(np.isfinite(limits.robot.position_lower), limits.robot.position_lower, start - np.pi)
    high = np.where(np.isfinite(limits.robot.position_upper), limits.robot.position_upper, start + np.pi)
    path = _grown(start, goal, lambda: rng.uniform(low, high), clear)
    return None if path is None else _shortened(path, clear, rng)


def _grown(start: Posture, goal: Posture, draw: Callable[[], Posture], clear: Clearance) -> list[Posture] | None:
    trees: list[tuple[list[Posture], list[int]]] = [([start], [-1]), ([goal], [-1])]
    for turn in range(TRIES):
        here, there = trees[turn % 2], trees[1 - turn % 2]
        new = _toward(here, draw(), clear)
        if new is None:
            continue
        met = _toward(there, here[0][new], clear)
        while met is not None and not np.array_equal(there[0][met], here[0][new]):
            met = _toward(there, here[0][new], clear)
        if met is not None:
            ours, theirs = _back(here, new), _back(there, met)
            return [*ours[::-1], *theirs[1:]] if turn % 2 == 0 else [*theirs[::-1], *ours[1:]]
    return None


def _toward(tree: tuple[list[Posture], list[int]], goal: Posture, clear: Clearance) -> int | None:
    """Grow a tree by one step towards a posture; the number of the new posture, None where something is in the way."""
    postures, parents = tree
    nearest = int(np.argmin(np.max(np.abs(np.array(postures) - goal), axis=1)))
    step = goal - postures[nearest]
    size = float(np.max(np.abs(step)))
    new = goal if size <= REACH else postures[nearest] + REACH / size * step
    if size == 0.0:
        return nearest
    if not (clear(new) and clear.of_line(postures[nearest], new)):
        return None
    postures.append(new)
    parents.append(nearest)
    return len(postures) - 1


def _back(tree: tuple[list[Posture], list[int]], node: int) -> list[Posture]:
    """From a node to the root."""
    out = []
    while node >= 0:
        out.append(tree[0][node])
        node = tree[1][node]
    return out


def _shortened(path: list[Posture], clear: Clearance, rng: np.random.Generator) -> list[Posture]:
    """Without the postures that a straight motion can leave out."""
    for _ in range(SHORTCUTS):
        if len(path) < 3:
            break
        i, j = sorted(rng.choice(len(path), 2, replace=False).tolist())
        if j - i > 1 and clear.of_line(path[i], path[j]):
            path = [*path[: i + 1], *path[j:]]
    return path
