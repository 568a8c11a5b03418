"""Discretised motion of a hand (stations), inverse kinematics onto the stations, and margins of joint paths.

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
    """Discretised motion of a hand: its poses at L times (stations), and the rows along which it must follow them.

    Attributes:
        limits: Joint limits.
        unit: Unit of distances, `"m"` or `"rad"`.
        time: Times (L,) since the motion began [s].
        distance: Distances (L,) along the motion [m or rad].
        places: Positions (L, 3) of the hand's origin, in the reference frame of `hand` [m].
        turns: Rotations (L, 3, 3) of the hand since the motion began, in the base frame.
        rows: Matrices (L, s, 6) that turn the hand's twist (v, w) into the s held and driven rows.
        grasp: Orientation (3, 3) of the hand at the start; only used if a row constrains a rotation.
        hand: Features of the hand's twist, which also give its pose, see `FeatureMap.twist`.
        moving: Mask (nv,) of the joints that move the hand; other joints, such as fingers, rest.
        grip: Orientation (3, 3) of the demonstrated grasp, and its spread [rad]. None if the rows constrain rotations,
            or if nothing was demonstrated, so that any orientation of the grasp is allowed.
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
        """Discretise a motion that begins at the grasp.

        Args:
            motion: The motion.
            start: Configuration (nq,) before the motion. If the hand is not at the mechanism, the motion begins at the
                nearest demonstrated grasp.
            limits: Joint limits.

        Returns:
            The stations, 0.1 s apart unless the motion is short or long.

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
        """Speed (L, s) that the motion needs along each row, matrix B in the module's docstring [m/s or rad/s]."""
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
        """Return a copy with other rows, the same at all stations, and without a demonstrated grip.

        `grip` becomes None, so any grasp orientation counts as demonstrated.

        Args:
            rows: Matrix (s, 6) that turns the hand's twist (v, w) into the rows, the same at all stations.
            grasp: Orientation (3, 3) of the hand at the start, used if a row constrains a rotation; None keeps
                `self.grasp`.
        """
        table = np.repeat(rows[None], len(self), axis=0)
        return replace(self, rows=table, grip=None, grasp=self.grasp if grasp is None else grasp)

    def grasps_as_shown(self, q: Postures) -> Bool[np.ndarray, " n"]:
        """Return whether the hand has its demonstrated grasp orientation, within 10 degrees or the spread of grasps.

        Args:
            q: Joint positions (n, nv) at the first station [rad or m].

        Returns:
            Mask (n,); True for all if any orientation is allowed.
        """
        tolerance = 0.17  # [rad] 10 degrees: error of a person who repeats a grasp by eye
        if self.grip is None:
            return np.ones(len(q), dtype=bool)
        orientation, turned = self.grip
        return angles_between(orientation, self.hand.poses(q)[:, :3, :3]) <= max(turned, tolerance)

    def matrices(self, q: Postures, station: Int[np.ndarray, " n"]) -> Float[np.ndarray, "n s nv"]:
        """Return the matrix A(q) of the held and driven rows at configurations.

        Args:
            q: Joint positions (n, nv) [rad or m].
            station: Index (n,) of the station of each configuration.
        """
        return self.rows[station] @ self.hand.batch(q)

    def onto(self, q: Postures, station: Int[np.ndarray, " n"], steps: int) -> tuple[Postures, Bool[np.ndarray, " n"]]:
        """Solve inverse kinematics: move configurations to their stations, within the joint limits.

        The method is Newton's. A joint that would exceed its limit stops there, and the other joints compensate.

        Args:
            q: Initial joint positions (n, nv) [rad or m].
            station: Index (n,) of the station of each configuration.
            steps: Largest number of Newton steps.

        Returns:
            Joint positions (n, nv), and a mask (n,) of those that reached their station.
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
    """Solve inverse kinematics for n poses of the hand at once, by Newton's method within the joint limits.

    Only the deviation along given rows of the hand's twist is removed. A joint that would exceed its limit stops there,
    and the other joints compensate.

    Args:
        hand: Features of the hand's twist, which also give its pose, see `FeatureMap.twist`.
        robot: The robot.
        q: Initial joint positions (n, nv) [rad or m].
        places: Goal positions (n, 3) of the hand, in the reference frame of `hand` [m].
        turns: Goal orientations (n, 3, 3) of the hand; None if no row constrains a rotation.
        rows: Matrices (n, s, 6) that turn the twist (v, w) into the rows.
        steps: Largest number of Newton steps.

    Returns:
        Joint positions (n, nv), and a mask (n,) of those that reached their pose.
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
    """Smallest margins along a motion, see the docstring of this module for the formula.

    Attributes:
        margin: Smallest of `weakest`, `room` and `speed`.
        singular_value: Smallest singular value of the held and driven rows, for translations in m.
        weakest: Margin of the weakest direction, the smallest sigma / (sigma + 1).
        room: Margin of the joint ranges: smallest distance to a position limit as a share of half the joint's range.
        speed: Margin of the joint speeds: smallest remaining share of a joint's velocity limit.
        limited_by: The margin that is smallest, in words, with the joint and the position along the motion.
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
    """Compute margins of single configurations, without joint speeds.

    Args:
        stations: The motion.
        q: Joint positions (n, nv) [rad or m].
        station: Index (n,) of the station of each configuration.

    Returns:
        Margin of the weakest direction, margin of the joint nearest to a position limit, and log of the manipulability
        of the held and driven rows, shape (n,) each.
    """
    least_log = -50.0  # smallest log of mu, at a singularity: e^-50 is far below rounding errors
    A = stations.matrices(q, station)
    weighted = A * stations.limits.velocity / stations.needs[station][:, :, None]
    squares = np.linalg.eigvalsh(weighted @ weighted.transpose(0, 2, 1))[:, 0]
    sigma = np.sqrt(np.maximum(squares, 0.0))
    log_mu = 0.5 * np.linalg.slogdet(A @ A.transpose(0, 2, 1))[1]
    return sigma / (sigma + 1.0), np.min(slack(stations, q), axis=1), np.maximum(log_mu, least_log)


def slack(stations: Stations, q: Postures) -> Postures:
    """Return the distance of each joint to its nearest position limit, as a share of half of its range.

    Args:
        stations: The motion, with the limits.
        q: Joint positions (n, nv) [rad or m].

    Returns:
        Shares (n, nv): 1 in the middle of the range, 0 at a limit; 1 for joints without limits or that do not move the
        hand.
    """
    low, high = stations.limits.robot.position_lower, stations.limits.robot.position_upper
    with np.errstate(invalid="ignore"):
        share = 2.0 * np.minimum(q - low, high - q) / (high - low)
    return np.where(np.isfinite(high - low) & stations.moving, share, 1.0)


def margin_of(motion: FreeDirection, rollout: Rollout, begins: float | None, robot: Robot) -> float | None:
    """Return the margin of a simulated motion.

    Args:
        motion: The motion.
        rollout: Simulated rollout of the motion.
        begins: Time in the rollout at which the hand reached the mechanism [s]; None if it did not.
        robot: Robot whose limits apply.

    Returns:
        Smallest share of the limits that remains, at most 1, see `Margins`; None if the hand did not reach the
        mechanism, or the rows have no frame.
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
    """Compute the margins of a joint path.

    Args:
        stations: The motion.
        q: Joint positions (k, nv) at the first k stations [rad or m].
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
