"""Motion of a hand as a table of stations, inverse kinematics for many postures onto them, and their margins.

A margin is the remaining share of the limits along a motion: of the joint ranges, of the joint speeds, and of the speed
in the weakest direction.

    margin = min over the way of  min( sigma / (sigma + 1),   sigma = sigma_min(B^-1 A U)        the weakest direction
                                       min_i 2 min(q_i - low_i, high_i - q_i) / (high_i - low_i)            the range
                                       1 - max_i |u_i| / U_i )                                              the speed

A has the held rows and the driven rows, U is the diagonal matrix of the velocity limits, and B the diagonal matrix of
the speeds that the motion needs along the rows: the speed of the hand for translations, its angular rate for rotations,
and if it has only one of the two, the other at a lever of 0.2 m. So sigma is the speed of the hand in its weakest
direction, with joint speeds of norm 1 in units of their limits, over the speed that the motion needs. Each term is 1 if
a limit is not used, and 0 at the limit; the first is one half if the weakest direction is just as fast as the motion.
The last is negative if the motion takes longer than requested.
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

Postures = Float[np.ndarray, "n nv"]


@final
@dataclass(frozen=True, eq=False)
class Stations:
    """Poses of a hand at L instants of a motion, and the rows along which they count.

    Attributes:
        limits: Joint limits.
        unit: Unit of distances, `"m"` or `"rad"`.
        time: Times (L,) since the motion began [s].
        distance: Distances (L,) along the motion [m or rad].
        places: Positions (L, 3) of the hand's origin, as `hand` gives them [m].
        turns: Rotations (L, 3, 3) of the hand since the motion began, in the base frame.
        rows: Weights (L, s, 6) of the hand's twist (v, w) in the held and driven rows.
        grasp: Orientation (3, 3) of the hand at the start; it matters if a row constrains a rotation.
        hand: Pose and twist of the hand, see `FeatureMap.twist`.
        moving: Mask (nv,) of the joints that move the hand; others, such as fingers, rest.
        grip: Orientation (3, 3) of the grasp in the recordings, and its spread [rad]; None if the rows constrain
            rotations, or nothing was demonstrated: the orientation of the grasp is free.
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
        """Return the stations of a motion that begins at the grasp.

        Args:
            motion: The motion.
            start: Configuration (nq,) before the motion: the hand is at the mechanism, or moves to the nearest
                demonstrated place.
            limits: Joint limits.

        Raises:
            FeatureError: The rows do not belong to a frame.
        """
        # time between stations [s]: at 0.1 m/s a centimetre, on which a joint path bends by less than a millimetre;
        # number of stations of a short motion, and of a long one, whose stations are further apart
        period, fewest, most = 0.1, 16, 64
        features: Any = motion.constraint.features
        if (hand := features.twist) is None:
            raise FeatureError(f"a plan needs the rows of a frame, not {features!r}")
        time, distance, ends = motion.table(start, period, fewest, most)
        goals = np.array(ends)
        if goals.ndim == 2:  # a motion of the hand's position: other coordinates stay as at the start
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
        """Largest speed of the hand's origin [m/s]."""
        return float(np.max(np.linalg.norm(np.diff(self.places, axis=0), axis=1) / np.diff(self.time)))

    @cached_property
    def needs(self) -> Float[np.ndarray, "L s"]:
        """Largest speed along each row of a hand that moves, or turns, as fast as in the motion [m/s or rad/s]."""
        # [m] distance from the hand to the object: a motion of 0.1 m/s counts as one of 0.5 rad/s (`tasks.motion`)
        lever = 0.2
        angles = Rotation.from_matrix(self.turns[1:] @ self.turns[:-1].transpose(0, 2, 1)).magnitude()
        speed, rate = self.tip_speed, float(np.max(angles / np.diff(self.time)))
        linear, angular = max(speed, lever * rate), max(rate, speed / lever)
        return np.linalg.norm(self.rows * np.repeat([linear, angular], 3), axis=2)

    @property
    def holds_orientation(self) -> bool:
        """True if a row constrains a rotation of the hand."""
        return bool(np.any(np.abs(self.rows[:, :, 3:]) > 1e-9))

    def with_rows(self, rows: Float[np.ndarray, "s 6"], grasp: Float[np.ndarray, "3 3"] | None = None) -> Stations:
        """Return the same positions for other rows of the hand's twist.

        Args:
            rows: Weights (s, 6) of the twist (v, w).
            grasp: Other orientation (3, 3) of the hand at the start; None to keep it.
        """
        table = np.repeat(rows[None], len(self), axis=0)
        return replace(self, rows=table, grip=None, grasp=self.grasp if grasp is None else grasp)

    def grasps_as_shown(self, q: Postures) -> Bool[np.ndarray, " n"]:
        """Return True for postures at the first station in which the hand has its demonstrated orientation.

        Args:
            q: Postures (n, nv) [rad or m].
        """
        tolerance = 0.17  # [rad] 10 degrees: error of a person who repeats a grasp by eye
        if self.grip is None:
            return np.ones(len(q), dtype=bool)
        orientation, turned = self.grip
        return angles_between(orientation, self.hand.poses(q)[:, :3, :3]) <= max(turned, tolerance)

    def matrices(self, q: Postures, station: Int[np.ndarray, " n"]) -> Float[np.ndarray, "n s nv"]:
        """Return A(q) of the held and driven rows.

        Args:
            q: Postures (n, nv) [rad or m].
            station: Number of the station of each posture (n,).
        """
        return self.rows[station] @ self.hand.batch(q)

    def onto(self, q: Postures, station: Int[np.ndarray, " n"], steps: int) -> tuple[Postures, Bool[np.ndarray, " n"]]:
        """Move postures onto their stations, within the joint limits, by Newton's method.

        A joint at a limit that would go beyond it stops, and the others do the rest.

        Args:
            q: Postures (n, nv) from which the iteration begins [rad or m].
            station: Number of the station of each posture (n,).
            steps: Largest number of Newton steps.

        Returns:
            The postures, and a mask (n,) of the postures that are at their station.
        """
        turns = self.turns[station] @ self.grasp if self.holds_orientation else None
        return solve_ik(self.hand, self.limits.robot, q, self.places[station], turns, self.rows[station], steps)


def solve_ik(
    hand: Any,
    robot: Robot,
    q: Postures,
    places: Float[np.ndarray, "n 3"],
    turns: Float[np.ndarray, "n 3 3"] | None,
    rows: Float[np.ndarray, "n s 6"],
    steps: int,
) -> tuple[Postures, Bool[np.ndarray, " n"]]:
    """Move the hand in many postures to poses, as far as rows of its twist constrain them; `Stations.onto` has the
    method.

    Args:
        hand: Pose and twist of the hand, see `FeatureMap.twist`.
        robot: The robot.
        q: Postures (n, nv) from which the iteration begins [rad or m].
        places: Positions (n, 3) of the hand, as `hand` gives them [m].
        turns: Orientations (n, 3, 3) of the hand; None if no row constrains a rotation.
        rows: Weights (n, s, 6) of the twist (v, w).
        steps: Largest number of Newton steps.

    Returns:
        The postures, and a mask (n,) of the postures that are at their pose.
    """
    tolerance = 2e-5  # [m or rad] a tenth of the 0.2 mm that count as at the mechanism
    low, high = robot.position_lower, robot.position_upper
    q, there, todo = np.clip(q, low, high), np.zeros(len(q), dtype=bool), np.arange(len(q))
    for step in range(steps + 1):
        pose, twist = hand.poses(q[todo]), np.zeros((len(todo), 6))
        twist[:, :3] = places[todo] - pose[:, :3, 3]
        if turns is not None:
            twist[:, 3:] = Rotation.from_matrix(turns[todo] @ pose[:, :3, :3].transpose(0, 2, 1)).as_rotvec()
        error = np.einsum("nsk,nk->ns", rows[todo], twist)
        size = np.sqrt(np.sum(error * error, axis=1))
        there[todo], late = size < tolerance, size >= tolerance
        if step == steps or not late.any():
            break
        todo, error, size = todo[late], error[late], size[late]
        A, x = rows[todo] @ hand.batch(q[todo]), q[todo]
        out = x + _least_step(A, error, size)
        blocked = (out < low) | (out > high)  # these joints move to their limits, the others do the rest
        edge = np.where(blocked, np.clip(out, low, high) - x, 0.0)
        rest = _least_step(A * ~blocked[:, None], error - np.einsum("nsj,nj->ns", A, edge), size)
        q[todo] = np.clip(x + edge + rest, low, high)
    return q, there


def _least_step(
    A: Float[np.ndarray, "n s nv"], error: Float[np.ndarray, "n s"], error_size: Float[np.ndarray, " n"]
) -> Postures:
    """Return A^T (A A^T + d^2)^-1 e, with d in proportion to the error, shortened to 0.5 rad or m of any joint."""
    # [rad or m] largest step of a joint, for which a linearisation is valid; damping per unit of error: a far target is
    # approached, a near one reached (Levenberg)
    largest, damping = 0.5, 0.1
    gram = A @ A.transpose(0, 2, 1)
    gram += ((damping * np.minimum(error_size, 1.0)) ** 2 + 1e-12)[:, None, None] * np.eye(A.shape[1])
    step = np.einsum("nsj,ns->nj", A, np.linalg.solve(gram, error[:, :, None])[:, :, 0])
    size = np.max(np.abs(step), axis=1, keepdims=True)
    return step * np.minimum(1.0, largest / np.maximum(size, largest))


@final
class Margins(NamedTuple):
    """Smallest margins along a motion.

    Attributes:
        margin: The smallest of the three.
        singular_value: Smallest singular value of the held and driven rows [m or 1].
        weakest: Smallest sigma / (sigma + 1).
        room: Smallest remaining share of half a joint's range.
        speed: Smallest remaining share of a joint's velocity limit.
        limited_by: The smallest of the three, with the joint and the place, in words.
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
    """Return margins of postures at stations.

    Args:
        stations: The motion.
        q: Postures (n, nv) [rad or m].
        station: Number of the station of each posture (n,).

    Returns:
        Margin of the weakest direction, margin of the joint nearest to a limit, and log of the manipulability of the
        held and driven rows, each (n,).
    """
    least_log = -50.0  # smallest log of mu, at a singularity: e^-50 is far below rounding errors
    A = stations.matrices(q, station)
    weighted = A * stations.limits.velocity / stations.needs[station][:, :, None]
    squares = np.linalg.eigvalsh(weighted @ weighted.transpose(0, 2, 1))[:, 0]
    sigma = np.sqrt(np.maximum(squares, 0.0))
    log_mu = 0.5 * np.linalg.slogdet(A @ A.transpose(0, 2, 1))[1]
    return sigma / (sigma + 1.0), np.min(slack(stations, q), axis=1), np.maximum(log_mu, least_log)


def slack(stations: Stations, q: Postures) -> Postures:
    """Return the remaining share of half of each joint's range.

    Args:
        stations: The motion.
        q: Postures (n, nv) [rad or m].

    Returns:
        Array (n, nv); 1 for joints without limits, or that do not move the hand.
    """
    low, high = stations.limits.robot.position_lower, stations.limits.robot.position_upper
    with np.errstate(invalid="ignore"):
        share = 2.0 * np.minimum(q - low, high - q) / (high - low)
    return np.where(np.isfinite(high - low) & stations.moving, share, 1.0)


def margin_of(motion: FreeDirection, rollout: Rollout, begins: float | None, robot: Robot) -> float | None:
    """Return the margin of a motion as it was simulated.

    Args:
        motion: The motion.
        rollout: Its rollout.
        begins: Time at which the hand was at the mechanism [s]; None if it never was.
        robot: Robot whose limits apply.

    Returns:
        Margin; None if the hand did not reach the mechanism, or the rows have no frame.
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
    return path_margins(stations, q).margin if len(q) > 1 else None


def path_margins(stations: Stations, q: Postures) -> Margins:
    """Return the margins of a whole motion.

    Args:
        stations: The motion.
        q: Postures (k, nv) at the first k stations [rad or m].
    """
    k, names = np.arange(len(q)), stations.limits.robot.joint_names
    weakest, ranges = node_margins(stations, q, k)[0], slack(stations, q)
    shares = np.abs(np.diff(q, axis=0)) / np.diff(stations.time[: len(q)])[:, None] / stations.limits.velocity
    fastest = shares.max(axis=0, initial=0.0)
    weak, (tight, joint) = int(np.argmin(weakest)), np.unravel_index(np.argmin(ranges), ranges.shape)
    values = float(weakest[weak]), float(ranges[tight, joint]), float(1.0 - fastest.max())
    least = float(np.min(np.linalg.svd(stations.matrices(q, k), compute_uv=False)[:, -1]))
    ways = (abs(float(stations.distance[x])) for x in (weak, tight))
    at_weakest, at_tight = (f"{x:.2f} m" if stations.unit == "m" else f"{np.degrees(x):.0f} degrees" for x in ways)
    words = (
        f"the weakest direction has {values[0] / max(1.0 - values[0], 1e-300):.2g} times the required speed, "
        f"{at_weakest} along (least singular value {least:.2g})",
        f"joint {names[int(joint)]!r} has {values[1]:.0%} of half its range left, {at_tight} along",
        f"joint {names[int(np.argmax(fastest))]!r} has {values[2]:.0%} of its speed left",
    )
    return Margins(min(values), least, *values, words[int(np.argmin(values))])
