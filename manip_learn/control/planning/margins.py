"""How much of its own limits a way leaves: of the joints' ranges, of their speeds, of what the weakest direction needs.

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

from typing import NamedTuple, final

import numpy as np
from jaxtyping import Float

from manip_learn.control.limits import Limits
from manip_learn.control.planning.stations import Postures, Stations
from manip_learn.control.tasks.driven_motion import Unit

LEAST_LOG = -50.0  # of mu at a singularity: e^-50 is far below what rounding leaves of it


@final
class NodeMargins(NamedTuple):
    """Of postures at stations.

    Attributes:
        weakest: shape (n,), sigma / (sigma + 1): 0 at a singularity.
        room: shape (n,), left of the range of the joint that is nearest to a limit, as a share of half of it.
        log_mu: shape (n,), log of the manipulability of the rows held and driven.
    """

    weakest: Float[np.ndarray, " n"]
    room: Float[np.ndarray, " n"]
    log_mu: Float[np.ndarray, " n"]

    @property
    def least(self) -> Float[np.ndarray, " n"]:
        """The smaller of the two margins."""
        return np.minimum(self.weakest, self.room)


@final
class Margins(NamedTuple):
    """What is least along a way, and where.

    Attributes:
        margin: The least of the three.
        singular_value: Least singular value of the rows held and driven [m or 1].
        weakest: sigma / (sigma + 1), the least.
        weakest_at: Where on the way [m or rad].
        room: Least share of half a joint's range that is left.
        room_joint: Name of that joint.
        room_at: Where on the way [m or rad].
        speed: Least share of a joint's velocity limit that is left.
        speed_joint: Name of that joint.
        mean_manipulability: Of the rows held and driven.
    """

    margin: float
    singular_value: float
    weakest: float
    weakest_at: float
    room: float
    room_joint: str
    room_at: float
    speed: float
    speed_joint: str
    mean_manipulability: float

    def limited_by(self, unit: Unit) -> str:
        """What is least, in words."""

        def where(place: float) -> str:
            return f"{abs(place):.2f} m" if unit == "m" else f"{np.degrees(abs(place)):.0f} degrees"

        if self.margin == self.room:
            return f"joint {self.room_joint!r} has {self.room:.0%} of half its range left, {where(self.room_at)} along"
        if self.margin == self.speed:
            return f"joint {self.speed_joint!r} has {self.speed:.0%} of its speed left"
        sigma = self.weakest / max(1.0 - self.weakest, np.finfo(np.float64).tiny)
        return (
            f"the weakest direction has {sigma:.2g} times the speed that the way needs, {where(self.weakest_at)} "
            f"along (least singular value {self.singular_value:.2g})"
        )


def node_margins(stations: Stations, q: Postures, station: np.ndarray) -> NodeMargins:
    """Margins of postures, each at its station."""
    A = stations.matrices(q, station)
    weighted = A * stations.limits.velocity / stations.needs[station][:, :, None]
    squares = np.linalg.eigvalsh(weighted @ weighted.transpose(0, 2, 1))[:, 0]
    sigma = np.sqrt(np.maximum(squares, 0.0))
    log_mu = 0.5 * np.linalg.slogdet(A @ A.transpose(0, 2, 1))[1]
    room = np.min(rooms(stations.limits, q), axis=1)
    return NodeMargins(sigma / (sigma + 1.0), room, np.maximum(log_mu, LEAST_LOG))


def rooms(limits: Limits, q: Postures) -> Postures:
    """Left of each joint's range, as a share of half of it; 1 where there is no limit."""
    low, high = limits.robot.position_lower, limits.robot.position_upper
    with np.errstate(invalid="ignore"):
        left = 2.0 * np.minimum(q - low, high - q) / (high - low)
    return np.where(np.isfinite(high - low), left, 1.0)


def margins_of(stations: Stations, q: Postures) -> Margins:
    """Of a whole way: one posture a station."""
    k, names = np.arange(len(q)), stations.limits.robot.joint_names
    nodes, left = node_margins(stations, q, k), rooms(stations.limits, q)
    shares = np.abs(np.diff(q, axis=0)) / np.diff(stations.time[: len(q)])[:, None] / stations.limits.velocity
    fastest = shares.max(axis=0, initial=0.0)
    weak, (tight, joint) = int(np.argmin(nodes.weakest)), np.unravel_index(np.argmin(left), left.shape)
    values = float(nodes.weakest[weak]), float(left[tight, joint]), float(1.0 - fastest.max())
    A = stations.matrices(q, k)
    return Margins(
        margin=min(values),
        singular_value=float(np.min(np.linalg.svd(A, compute_uv=False)[:, -1])),
        weakest=values[0],
        weakest_at=float(stations.distance[weak]),
        room=values[1],
        room_joint=names[int(joint)],
        room_at=float(stations.distance[int(tight)]),
        speed=values[2],
        speed_joint=names[int(np.argmax(fastest))],
        mean_manipulability=float(np.mean(np.exp(nodes.log_mu))),
    )
