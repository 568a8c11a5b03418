"""Taking hold: orientations in which a hand may, and a joint path to the posture, clear of self-collision.

The path is straight, or found by two trees that grow together, those of Kuffner and LaValle, "RRT-Connect", ICRA 2000,
in our own code since the planners of OMPL draw from one random source a process, whose seed counts before its first use
only: a plan could not be repeated by its seed.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import final

import numpy as np
from jaxtyping import Bool, Float
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from manip_learn.control.limits import Limits
from manip_learn.errors import RobotError, TargetError
from manip_learn.linalg import finite
from manip_learn.robot.collision import SelfCollision
from manip_learn.robot.robot import Robot
from manip_learn.robot.rotations import rotation_matrix

SPINS = 24  # of a hand that may turn about its axis by any angle: every 15 degrees
ROUNDING = 1e-6  # of a cosine: a hand whose axis stands still counts as inside a cone of no width
TILTS = 48  # of a hand whose axis may tilt
CLEARANCE = 0.005  # [m] between links: what a servo's lag makes of a path; links that are neighbours come within 2 cm
STEP = 0.02  # [rad or m] between checks: a hand at 0.25 m moves by the clearance
REACH = 0.4  # [rad or m] by which a tree grows at once
TRIES = 600  # of the trees: a quarter of a second of checks, for each posture of hold that is tried
SHORTCUTS = 60  # pairs of a path's postures that are tried: of ten postures there are 36
Posture = Float[np.ndarray, " nv"]


@final
@dataclass(frozen=True, eq=False)
class GraspCone:
    """The hand may take hold with an axis of its own inside a cone.

    A parallel gripper that is the same after half a turn: `GraspCone(turns=2)`. A round knob: `GraspCone(turns=None)`.
    A hand that comes from above, within 30 degrees: `GraspCone(angle=0.52, turns=None, direction=(0, 0, -1))`.

    Args:
        axis: shape (3,), of the hand: the way its fingers point, in its frame.
        angle: Largest angle between that axis and the direction [rad].
        turns: In how many orientations about the axis, evenly apart, the hand takes hold alike; None for all of them.
        direction: shape (3,), where the axis should point when the hand takes hold, in the base frame; None for where
            it points at the start.

    Raises:
        TargetError: Axes that are not three finite numbers, a negative angle, no orientation at all.
    """

    axis: ArrayLike = (0.0, 0.0, 1.0)
    angle: float = 0.0
    turns: int | None = 1
    direction: ArrayLike | None = None

    def __post_init__(self) -> None:
        for name in ("axis", "direction"):
            given = getattr(self, name)
            if given is None:
                continue
            vector = finite(given, 3)
            if vector is None or not vector.any():
                raise TargetError(f"the {name} of a grasp must be three finite numbers not all zero, got {given!r}")
            object.__setattr__(self, name, vector / np.linalg.norm(vector))
        if not 0.0 <= self.angle <= np.pi:
            raise TargetError(f"the angle of a grasp cone must be from 0 to pi [rad], got {self.angle!r}")
        if self.turns is not None and self.turns < 1:
            raise TargetError(f"a hand takes hold in one orientation at least, got turns={self.turns!r}")

    def toward(self, shown: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, " 3"]:
        """Where the axis should point, in the base frame.

        Args:
            shown: Orientation of the hand at the start.
        """
        return shown @ np.asarray(self.axis) if self.direction is None else np.asarray(self.direction)

    def orientations(self, shown: Float[np.ndarray, "3 3"], rng: np.random.Generator) -> Float[np.ndarray, "g 3 3"]:
        """Orientations of the hand inside the cone, that next to the one shown first.

        Args:
            shown: Orientation of the hand at the start.
            rng: Random numbers of the tilts.
        """
        wanted, axis = self.toward(shown), np.asarray(self.axis)
        upright = _least_turn(shown @ axis, wanted) @ shown
        spins = np.arange(self.turns or SPINS) * 2.0 * np.pi / (self.turns or SPINS)
        spun = upright @ Rotation.from_rotvec(spins[:, None] * axis).as_matrix()
        if self.angle == 0.0:
            return spun
        across = np.linalg.svd(wanted[None])[2][1:]
        # even over the cap of the sphere that the cone cuts out
        tilt = np.arccos(1.0 - rng.uniform(0.0, 1.0, TILTS) * (1.0 - np.cos(self.angle)))
        turn = rng.uniform(0.0, 2.0 * np.pi, TILTS)
        about = np.cos(turn)[:, None] * across[0] + np.sin(turn)[:, None] * across[1]
        tilted = Rotation.from_rotvec(tilt[:, None] * about).as_matrix()
        chosen = spun[rng.integers(len(spun), size=TILTS)]
        if self.turns is None:
            chosen = upright @ Rotation.from_rotvec(rng.uniform(0.0, 2.0 * np.pi, (TILTS, 1)) * axis).as_matrix()
        return np.concatenate([upright[None], tilted @ chosen])

    def holds(
        self, orientations: Float[np.ndarray, "n 3 3"], toward: Float[np.ndarray, "n 3"]
    ) -> Bool[np.ndarray, " n"]:
        """Which hands have their axis in the cone about a direction each."""
        cosine = np.sum((orientations @ np.asarray(self.axis)) * toward, axis=1)
        return cosine >= np.cos(self.angle) - ROUNDING


def _least_turn(a: Float[np.ndarray, " 3"], b: Float[np.ndarray, " 3"]) -> Float[np.ndarray, "3 3"]:
    """The rotation by the least angle from one unit vector to another; one of them where they are opposite."""
    axis, cosine = np.cross(a, b), float(a @ b)
    sine = float(np.linalg.norm(axis))
    if sine < ROUNDING:
        axis, sine = np.linalg.svd(a[None])[2][1], 1.0
        return rotation_matrix((0.0 if cosine > 0.0 else np.pi) * axis)
    return rotation_matrix(np.arctan2(sine, cosine) / sine * axis)


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
    for _ in range(SHORTCUTS if path is not None else 0):  # postures that a straight motion can leave out
        if path is None or len(path) < 3:
            break
        i, j = sorted(rng.choice(len(path), 2, replace=False).tolist())
        if j - i > 1 and clear.of_line(path[i], path[j]):
            path = [*path[: i + 1], *path[j:]]
    return path


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
