"""Following error: how far the measured posture is from the commanded one, and whether that is too far."""

from __future__ import annotations

import math
from typing import final

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from manip_learn.constraint.constraint import Constraint
from manip_learn.constraint.features.feature_map import sum_in_words
from manip_learn.errors import ConfigurationError
from manip_learn.robot.robot import Robot
from manip_learn.robot.tips import default_tip

FORCE = 15.0  # [N] a tenth of what ISO/TS 15066 lets a robot press a hand with, for what rises while the arm brakes
STIFFNESS = 2000.0  # [N m/rad or N/m] of a stiff position servo of an arm that works beside people
PAYLOAD = 2.0  # [kg] weight that the hand may carry without the drives' knowing
GRAVITY = 9.81  # [m/s2]
# [rad or m] what dry friction (0.5 N m at 2,000 N m/rad) and encoders leave of a servo's error
RESOLUTION = 2.5e-4
RINGING = 0.1  # [s] for which a servo feels an acceleration: three times sqrt(2 kg m2 / 2,000 N m/rad)
ROUNDING = 1e-12  # [rad or m] of sums of steps
POSTURES = 200  # for the levers of a robot whose posture is not known


def following_error_limit(
    robot: Robot,
    force: float = FORCE,
    stiffness: ArrayLike = STIFFNESS,
    *,
    frame: str | None = None,
    q: ArrayLike | None = None,
    constraint: Constraint | None = None,
) -> Float[np.ndarray, " nv"]:
    """How far position servos give way to a force at the tip: limits for `ServoLoop`.

    A force f loads the joints with J(q)^T f, and joint j gives way by that over its stiffness. Some joint is beyond the
    limit before the force is reached, whatever its direction:

        limit_j = force / stiffness_j * min over unit f of max over j |J_j(q)^T f|

    with a lever of 1 for prismatic joints. A joint's friction shows as friction / stiffness: allow no less.

    Args:
        robot: The robot.
        force: At the tip [N].
        stiffness: shape (nv,) or a number [N m/rad or N/m], of the servos.
        frame: Name of the tip's frame; by default the robot's likeliest tip.
        q: Posture; None takes the median over postures within the limits, so that in half of them the arm yields to
            a larger force than that.
        constraint: Whose rows are the directions of force that count, e.g. those across a drawer's way; by default all
            at the tip.

    Returns:
        shape (nv,) [rad or m].

    Raises:
        ConfigurationError: A force or a stiffness that is not positive, or a posture that does not fit.
        UnknownNameError: No such frame.
    """
    if not 0.0 < force < math.inf:
        raise ConfigurationError(f"force must be a positive number of newtons, got {force!r}")
    k = _per_joint("stiffness", stiffness, robot)
    tip = robot.frame(frame or default_tip(robot))
    postures = _postures(robot) if q is None else [robot.checked_posture(q)]
    rows = (lambda x: robot.jacobian(x, tip)[:3]) if constraint is None else constraint
    levers = []
    for x in postures:  # the longest lever of a joint, for the direction in which that is shortest of those that move
        J = rows(np.asarray(x))
        U, sigma, _ = np.linalg.svd(J, full_matrices=False)
        moving = U[:, sigma > 1e-6 * sigma[0]]  # no joint yields across a plane that the arm never leaves
        levers.append(float(np.abs(_directions(moving.shape[1]) @ moving.T @ J).max(axis=1).min()))
    return force * float(np.median(levers)) / k


def _postures(robot: Robot) -> list[Float[np.ndarray, " nq"]]:
    rng = np.random.default_rng(0)
    return [robot.random_configuration(rng) for _ in range(POSTURES)]


def _directions(size: int) -> Float[np.ndarray, "n size"]:
    """Unit vectors all over a half sphere, 5 degrees apart at most in up to three dimensions."""
    if size == 1:
        return np.ones((1, 1))
    if size == 2:
        around = np.linspace(0.0, np.pi, 180, endpoint=False)
        return np.column_stack([np.cos(around), np.sin(around)])
    directions = np.random.default_rng(0).normal(size=(1000 * 4 ** (size - 3), size))
    return directions / np.linalg.norm(directions, axis=1, keepdims=True)


def _per_joint(what: str, values: ArrayLike, robot: Robot) -> Float[np.ndarray, " nv"]:
    array = np.asarray(values, dtype=np.float64)
    if array.shape not in ((), (robot.nv,)) or not np.all(array > 0.0):
        raise ConfigurationError(f"{what} must be one positive number or {robot.nv}, got {array.tolist()}")
    return np.array(np.broadcast_to(array, (robot.nv,)))


@final
class FollowingError:
    """Distance between the commanded and the measured posture, beyond what a late measurement explains.

    Without a limit of the user's own, the force on the hand is what counts: the one that explains the distance best,

        f = (C C^T + (RESOLUTION / force)^2)^-1 C e,    C = J(q) / stiffness

    without the weight of up to `PAYLOAD`. What touches the arm elsewhere trips where it loads a joint as `FORCE` would
    at the arm's longest lever.

    Args:
        robot: The robot.
        limit: shape (nv,) or a number [rad or m]; None for the force.
        latency: Time by which a measurement may lag behind the command that it is compared with [s].
        dt: Period [s].
        stiffness: shape (nv,) or a number [N m/rad or N/m], of the servos.
        frame: Name of the tip's frame.

    Attributes:
        limit: shape (nv,) [rad or m].
        largest: Largest distance of a joint in the newest comparison [rad or m].
        distance: shape (nv,), measured less commanded.
        excess: shape (nv,), what the latency does not explain of it.
        force: Force on the hand that explains them [N], 0 where the user has given limits.
        tripped: Whether a joint has ever been farther away than its limit, or the force larger than `FORCE`.

    Raises:
        ConfigurationError: A limit or a stiffness that is not positive or has the wrong size.
    """

    def __init__(
        self,
        robot: Robot,
        limit: ArrayLike | None,
        latency: float,
        dt: float,
        stiffness: ArrayLike = STIFFNESS,
        frame: str | None = None,
    ):
        self._stiffness = _per_joint("stiffness", stiffness, robot)
        self._frame = None
        if limit is None:
            self._frame = tip = robot.frame(frame or default_tip(robot))
            # the longest lever of the tip on any joint [m]; at least 1 where a joint is prismatic
            reach = max(float(np.linalg.norm(robot.jacobian(q, tip)[:3], axis=0).max()) for q in _postures(robot))
            limit = FORCE * reach / self._stiffness
        self.limit = _per_joint("following_error_limit", limit, robot)
        self._dt, self._rows = dt, math.ceil(latency / dt - 1e-9) + 2
        self._robot = robot
        self._damping = (RESOLUTION / FORCE) ** 2 * np.eye(3)
        self.forget()

    def forget(self) -> None:
        """Begin anew."""
        nv = self._robot.nv
        self.largest, self.force, self.tripped = 0.0, 0.0, False
        self.distance = self.excess = np.zeros(nv)
        # one row per period within the latency: ways of the commanded posture since the beginning, and what was found
        self._ways, self._found, self._row = np.zeros((self._rows, nv)), np.full((self._rows, nv), np.nan), 0
        self._way, self._since = np.zeros(nv), 0.0  # the newest, and the time since the row began [s]
        self._velocity = np.zeros(nv)
        self._least, self._most = np.zeros(nv), np.zeros(nv)  # by which servos lately gave way to inertia

    def moved(self, q: Float[np.ndarray, " n"], time: float, velocity: Float[np.ndarray, " nv"]) -> None:
        """Take note of a step of the commanded posture: the posture before it, how long it took [s], its velocity."""
        self._way = self._way + time * velocity
        self._since += time
        # a call that came early takes a part of the step before back, which the arm may have made
        if self._since > 0.99 * self._dt or time < 0.0:
            self._since, self._row = 0.0, (self._row + 1) % self._rows
            self._found[self._row] = self.excess
        self._ways[self._row] = self._way
        if self._frame is None or time <= 0.0:
            return
        # a servo gives way to M a as a spring and a damper do: by no more than lately, and for a while after
        now = self._robot.inertial_effort(q, (velocity - self._velocity) / time) / self._stiffness
        lately = math.exp(-time / RINGING)
        self._least, self._most = np.minimum(lately * self._least, now), np.maximum(lately * self._most, now)
        self._velocity = velocity.copy()

    def relief(self) -> Float[np.ndarray, " nv"]:
        """Way to a commanded posture at which the servos no longer press, shape (nv,) [rad or m].

        To where the arm was measured, and by what dry friction would go on holding; by no more than the limits and
        what was commanded within the latency, in case the measurement was wrong.
        """
        most = self.limit + np.abs(self._ways - self._way).max(axis=0)
        way = np.clip(self.distance, -most, most)
        return way * (1.0 + RESOLUTION / (np.abs(way) + RESOLUTION))

    def sentence(self, constraint: Constraint | None, q: Float[np.ndarray, " n"]) -> str:
        """What was blocked and by how much: the row of the constraint, if it is known, and the joint."""
        j = int(np.abs(self.distance).argmax())
        kind = next(block.kind for block in self._robot.blocks if block.v.start <= j < block.v.stop)
        unit = "mm" if kind == "prismatic" else "mrad"
        words = f"joint {self._robot.joint_names[j]} is {1e3 * self.distance[j]:+.2g} {unit} from where it was sent"
        if constraint is not None:
            off = constraint(q) @ self.distance
            i = int(np.abs(off).argmax())
            row = constraint.selection[i]
            unit = "mrad" if constraint.features.row_units[int(np.abs(row).argmax())].startswith("rad") else "mm"
            parts = sum_in_words(row, constraint.features.row_names, "+.2g", 0.05)
            words = f"row {i + 1} of the constraint ({parts}) is {1e3 * off[i]:+.2g} {unit} off, {words}"
        return words if self._frame is None else f"{words}, as under {self.force:.0f} N on the hand"

    def compare(
        self,
        commanded: Float[np.ndarray, " n"],
        measured: Float[np.ndarray, " n"],
        correction: Float[np.ndarray, " nv"] | float = 0.0,
    ) -> None:
        """Compare two postures, the newest commanded and the newest measured one.

        A correction [rad or m] that the servos were sent beside the commanded posture loads them as well.
        """
        self.distance = self._robot.difference(commanded, measured)
        excess = self.distance - correction
        # the measurement may belong to any of the postures within the latency
        back = self._ways - self._way
        low, high = back.min(axis=0) - self._most - ROUNDING, back.max(axis=0) - self._least + ROUNDING
        self.excess = excess = excess - np.minimum(np.maximum(excess, low), high)
        self.largest = float(np.abs(excess).max(initial=0.0))
        self._found[self._row] = excess
        if self._frame is None:
            self.tripped = self.tripped or bool(np.any(np.abs(excess) > self.limit))
            return
        before = self._found[(self._row + 1) % self._rows]
        if before[0] == before[0]:  # what it will be when a brake, ordered now, takes effect
            excess = 2.0 * excess - before
        self.force = 0.0
        if excess.dot(excess) <= 4.0 * RESOLUTION * RESOLUTION:  # no force can be larger than `FORCE` then
            return
        C = self._robot.jacobian(measured, self._frame)[:3] / self._stiffness
        f = np.linalg.solve(C.dot(C.T) + self._damping, C.dot(excess))
        weight = min(max(0.0, -f[2]), GRAVITY * PAYLOAD)
        f[2] += weight
        self.force = math.sqrt(f.dot(f))
        if self.force > FORCE or np.any(np.abs(excess + weight * C[2]) > self.limit):
            self.tripped = True
