"""The way of a hand as a table of stations, many postures brought onto them, and the margins that they leave.

A margin is how much of its own limits a way leaves: of the joints' ranges, of their speeds, of what the weakest
direction needs.

    margin = min over the way of  min( sigma / (sigma + 1),   sigma = sigma_min(B^-1 A U)        the weakest direction
                                       min_i 2 min(q_i - low_i, high_i - q_i) / (high_i - low_i)            the range
                                       1 - max_i |u_i| / U_i )                                              the speed

A holds the rows held and driven, U is the diagonal of the velocity limits, and B that of the speeds which the way needs
along the rows: that of the hand for translations, that of its turning for rotations, and where it does only one of the
two, the other at a lever of `LEVER`. sigma is therefore how fast the hand can go in its weakest direction, with joint
speeds of norm 1 in units of their limits, over what the way needs. Each term is 1 where nothing of a limit is used, and
0 at the limit; the first is one half where the weakest direction is just as fast as the way. The last is negative where
the way takes longer than it was asked to.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple, final

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from manip_learn.constraint.features.frame_jacobian import AXES
from manip_learn.control.limits import Limits
from manip_learn.control.rollout import Rollout
from manip_learn.control.tasks.driven_motion import Unit
from manip_learn.control.tasks.motion import FreeDirection
from manip_learn.errors import FeatureError
from manip_learn.robot.robot import Robot
from manip_learn.robot.rotations import angles_between

PERIOD = 0.1  # [s] between stations: at 0.1 m/s a centimetre, on which a joint path bends by less than a millimetre
FEWEST, MOST = 16, 64  # stations: of a short way, and of a long one, whose stations are then farther apart
# [m or rad] off its station that a posture may be: a tenth of the 0.2 mm that count as at the mechanism
ON = 2e-5
BY_EYE = 0.17  # [rad] 10 degrees by which a hand is turned that takes hold of a handle as once before, by eye
LEVER = 0.2  # [m] between a hand and what it turns: a way of 0.1 m/s counts as one of 0.5 rad/s (`tasks.motion`)
LONGEST_STEP = 0.5  # [rad or m] of one joint in one Newton step: a linearisation is good for half a radian
# [m or rad] of damping per metre or radian of error: a far target is approached, a near one met (Levenberg)
DAMPING = 0.1
LEAST_LOG = -50.0  # of mu at a singularity: e^-50 is far below what rounding leaves of it

Postures = Float[np.ndarray, "n nv"]


@final
@dataclass(frozen=True, eq=False)
class Stations:
    """Where a hand should be at each of L instants of a way, and along which rows that counts.

    Attributes:
        limits: Of the joints.
        unit: Of distances, `"m"` or `"rad"`.
        time: shape (L,), since the way began [s].
        distance: shape (L,), along the way [m or rad].
        places: shape (L, 3), where the hand's origin should be [m].
        turns: shape (L, 3, 3), how the hand should have turned since the way began, in the base frame.
        rows: shape (L, s, 6), weights of the hand's twist (v, w) in the rows held and driven.
        grasp: shape (3, 3), orientation of the hand at the start, which counts where the rows hold orientations.
        hand: The hand's place and how it turns, see `FeatureMap.twist`.
        moving: shape (nv,), joints that move the hand; others, as those of fingers, stay where they are.
        grip: shape (3, 3), orientation in which recordings took hold, and how far from it they did [rad]; None if the
            rows hold orientations, or nothing was shown: the hand may take hold as it likes.
    """

    limits: Limits
    unit: Unit
    time: Float[np.ndarray, " L"]
    distance: Float[np.ndarray, " L"]
    places: Float[np.ndarray, "L 3"]
    turns: Float[np.ndarray, "L 3 3"]
    rows: Float[np.ndarray, "L s 6"]
    grasp: Float[np.ndarray, "3 3"]
    hand: Any
    moving: Bool[np.ndarray, " nv"]
    grip: tuple[Float[np.ndarray, "3 3"], float] | None = None

    @staticmethod
    def of(motion: FreeDirection, start: ArrayLike, limits: Limits) -> Stations:
        """The stations of a motion that begins where the hand takes hold.

        Args:
            motion: The motion.
            start: Posture before that: the hand is at the mechanism, or goes to the nearest place that was shown.
            limits: Of the joints.

        Raises:
            FeatureError: The rows are not those of a frame.
        """
        features: Any = motion.constraint.features
        if (hand := features.twist) is None:
            raise FeatureError(f"a way is planned for the rows of a frame, not for {features!r}")
        time, distance, ends = motion.table(start, PERIOD, FEWEST, MOST)
        goals = np.array(ends)
        if goals.ndim == 2:  # a motion of the hand's place: what it does not say is as at the start
            here, places = hand.poses(limits.robot.positions(start)[None]), goals
            goals = np.repeat(here, len(places), axis=0)
            goals[:, [AXES.index(name) for name in features.row_names], 3] = places
        turns = goals[:, :3, :3] @ goals[0, :3, :3].T
        rows = motion.constraint.selection @ features.weights_at(goals)
        places = goals[:, :3, 3].copy()
        robot, relative = limits.robot, getattr(features, "relative_to", None)
        frames = [f for f in (features.frame, relative) if f is not None]  # type: ignore[attr-defined]  # a hand has one
        moving = np.array([any(robot.moves(name, f) for f in frames) for name in robot.joint_names])
        grip = None if np.any(np.abs(rows[:, :, 3:]) > 1e-9) else motion.grip_shown
        at, unit = (time, distance, places, turns, rows), motion.unit
        return Stations(limits, unit, *at, goals[0, :3, :3].copy(), hand, moving, grip)

    def __len__(self) -> int:
        return len(self.time)

    @property
    def tip_speed(self) -> float:
        """Largest speed of the hand's origin on the way [m/s]."""
        return float(np.max(np.linalg.norm(np.diff(self.places, axis=0), axis=1) / np.diff(self.time)))

    @cached_property
    def needs(self) -> Float[np.ndarray, "L s"]:
        """Largest speed along each row of a hand that moves, or turns, as fast as the way does [m/s or rad/s]."""
        angles = Rotation.from_matrix(self.turns[1:] @ self.turns[:-1].transpose(0, 2, 1)).magnitude()
        speed, rate = self.tip_speed, float(np.max(angles / np.diff(self.time)))
        linear, angular = max(speed, LEVER * rate), max(rate, speed / LEVER)
        return np.linalg.norm(self.rows * np.repeat([linear, angular], 3), axis=2)

    @property
    def holds_orientation(self) -> bool:
        """Whether a row weighs a rotation of the hand."""
        return bool(np.any(np.abs(self.rows[:, :, 3:]) > 1e-9))

    def with_rows(self, rows: Float[np.ndarray, "s 6"], grasp: Float[np.ndarray, "3 3"] | None = None) -> Stations:
        """Return these places for other rows of the hand's twist, and another orientation of the hand at the start."""
        table = np.repeat(rows[None], len(self), axis=0)
        return replace(self, rows=table, grip=None, grasp=self.grasp if grasp is None else grasp)

    def takes_hold_as_shown(self, q: Postures) -> Bool[np.ndarray, " n"]:
        """Which postures at the first station have the hand turned as in the recordings."""
        if self.grip is None:
            return np.ones(len(q), dtype=bool)
        orientation, turned = self.grip
        return angles_between(orientation, self.hand.poses(q)[:, :3, :3]) <= max(turned, BY_EYE)

    def matrices(self, q: Postures, station: Int[np.ndarray, " n"]) -> Float[np.ndarray, "n s nv"]:
        """A(q) of the rows held and driven."""
        return self.rows[station] @ self.hand.batch(q)

    def onto(self, q: Postures, station: Int[np.ndarray, " n"], steps: int) -> tuple[Postures, Bool[np.ndarray, " n"]]:
        """Postures brought onto their stations, within the joint limits, by Newton's method.

        A joint that stands at a limit and would go beyond it leaves the motion to the others.

        Args:
            q: Where they begin.
            station: Number of each one's station.
            steps: Of Newton's method, at most.

        Returns:
            The postures, and which of them are there.
        """
        turns = self.turns[station] @ self.grasp if self.holds_orientation else None
        return onto_poses(self.hand, self.limits.robot, q, self.places[station], turns, self.rows[station], steps)


def onto_poses(
    hand: Any,
    robot: Robot,
    q: Postures,
    places: Float[np.ndarray, "n 3"],
    turns: Float[np.ndarray, "n 3 3"] | None,
    rows: Float[np.ndarray, "n s 6"],
    steps: int,
) -> tuple[Postures, Bool[np.ndarray, " n"]]:
    """Bring each posture's hand to a place [m] and an orientation, as far as rows of its twist say; return also which
    of them are there. `Stations.onto` has the method.
    """
    low, high = robot.position_lower, robot.position_upper
    q, there, todo = np.clip(q, low, high), np.zeros(len(q), dtype=bool), np.arange(len(q))
    for step in range(steps + 1):
        pose, twist = hand.poses(q[todo]), np.zeros((len(todo), 6))
        twist[:, :3] = places[todo] - pose[:, :3, 3]
        if turns is not None:
            twist[:, 3:] = Rotation.from_matrix(turns[todo] @ pose[:, :3, :3].transpose(0, 2, 1)).as_rotvec()
        error = np.einsum("nsk,nk->ns", rows[todo], twist)
        far = np.sqrt(np.sum(error * error, axis=1))
        there[todo], late = far < ON, far >= ON
        if step == steps or not late.any():
            break
        todo, error, far = todo[late], error[late], far[late]
        A, x = rows[todo] @ hand.batch(q[todo]), q[todo]
        out = x + _least_step(A, error, far)
        blocked = (out < low) | (out > high)  # these go to their limits, the others do the rest
        edge = np.where(blocked, np.clip(out, low, high) - x, 0.0)
        rest = _least_step(A * ~blocked[:, None], error - np.einsum("nsj,nj->ns", A, edge), far)
        q[todo] = np.clip(x + edge + rest, low, high)
    return q, there


def _least_step(
    A: Float[np.ndarray, "n s nv"], error: Float[np.ndarray, "n s"], far: Float[np.ndarray, " n"]
) -> Postures:
    """A^T (A A^T + d^2)^-1 e, with d in proportion to the error, no joint farther than `LONGEST_STEP`."""
    gram = A @ A.transpose(0, 2, 1)
    gram += ((DAMPING * np.minimum(far, 1.0)) ** 2 + 1e-12)[:, None, None] * np.eye(A.shape[1])
    step = np.einsum("nsj,ns->nj", A, np.linalg.solve(gram, error[:, :, None])[:, :, 0])
    size = np.max(np.abs(step), axis=1, keepdims=True)
    return step * np.minimum(1.0, LONGEST_STEP / np.maximum(size, LONGEST_STEP))


@final
class Margins(NamedTuple):
    """What is least along a way.

    Attributes:
        margin: The least of the three.
        singular_value: Least singular value of the rows held and driven [m or 1].
        weakest: sigma / (sigma + 1), the least.
        room: Least share of half a joint's range that is left.
        speed: Least share of a joint's velocity limit that is left.
        limited_by: Which of them is least, of what joint and where, in words.
    """

    margin: float
    singular_value: float
    weakest: float
    room: float
    speed: float
    limited_by: str


def node_margins(
    stations: Stations, q: Postures, station: np.ndarray
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """Return of postures at stations the margin of the weakest direction, that of the joint nearest to a limit, and the
    log of the manipulability of the rows held and driven.
    """
    A = stations.matrices(q, station)
    weighted = A * stations.limits.velocity / stations.needs[station][:, :, None]
    squares = np.linalg.eigvalsh(weighted @ weighted.transpose(0, 2, 1))[:, 0]
    sigma = np.sqrt(np.maximum(squares, 0.0))
    log_mu = 0.5 * np.linalg.slogdet(A @ A.transpose(0, 2, 1))[1]
    return sigma / (sigma + 1.0), np.min(rooms(stations, q), axis=1), np.maximum(log_mu, LEAST_LOG)


def rooms(stations: Stations, q: Postures) -> Postures:
    """Left of each joint's range, as a share of half of it; 1 where there is no limit, or the hand is not moved."""
    low, high = stations.limits.robot.position_lower, stations.limits.robot.position_upper
    with np.errstate(invalid="ignore"):
        left = 2.0 * np.minimum(q - low, high - q) / (high - low)
    return np.where(np.isfinite(high - low) & stations.moving, left, 1.0)


def margin_of(motion: FreeDirection, rollout: Rollout, begins: float | None, robot: Robot) -> float | None:
    """The margin that a way left as it was simulated; None if the hand did not come to it, or the rows have no frame.

    Args:
        motion: The way.
        rollout: Its rollout.
        begins: When the hand was at the mechanism [s].
        robot: Whose limits count.
    """
    if begins is None:
        return None
    try:
        stations = Stations.of(motion, rollout.q[0], Limits(robot))
    except FeatureError:
        return None
    inside = begins + stations.time <= rollout.time[-1] + 1e-9
    positions = np.array([robot.positions(q) for q in rollout.q])
    q = np.column_stack([np.interp(begins + stations.time[inside], rollout.time, column) for column in positions.T])
    return margins_of(stations, q).margin if len(q) > 1 else None


def margins_of(stations: Stations, q: Postures) -> Margins:
    """Of a whole way: one posture a station."""
    k, names = np.arange(len(q)), stations.limits.robot.joint_names
    weakest, left = node_margins(stations, q, k)[0], rooms(stations, q)
    shares = np.abs(np.diff(q, axis=0)) / np.diff(stations.time[: len(q)])[:, None] / stations.limits.velocity
    fastest = shares.max(axis=0, initial=0.0)
    weak, (tight, joint) = int(np.argmin(weakest)), np.unravel_index(np.argmin(left), left.shape)
    values = float(weakest[weak]), float(left[tight, joint]), float(1.0 - fastest.max())
    least = float(np.min(np.linalg.svd(stations.matrices(q, k), compute_uv=False)[:, -1]))
    ways = (abs(float(stations.distance[x])) for x in (weak, tight))
    at_weakest, at_tight = (f"{x:.2f} m" if stations.unit == "m" else f"{np.degrees(x):.0f} degrees" for x in ways)
    words = (
        f"the weakest direction has {values[0] / max(1.0 - values[0], 1e-300):.2g} times the speed that the way needs, "
        f"{at_weakest} along (least singular value {least:.2g})",
        f"joint {names[int(joint)]!r} has {values[1]:.0%} of half its range left, {at_tight} along",
        f"joint {names[int(np.argmax(fastest))]!r} has {values[2]:.0%} of its speed left",
    )
    return Margins(min(values), least, *values, words[int(np.argmin(values))])
