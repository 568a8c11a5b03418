"""Task frame: the frame along whose axes a constraint's rows lie, as force and impedance controllers need it.

A held row is a combination of the hand's twist (v, w) that the environment keeps at zero, by a reaction wrench: a force
f and a moment m. The origin c of the frame is the point about which the reaction forces have no moment, except moments
that are held themselves (Poinsot's central axis). The axes are directions along which the motion is entirely free or
entirely held. Both follow from Lambda alone; if the axis or centre of the mechanism is known, the frame is placed on
it. After M. T. Mason, "Compliance and Force Control for Computer Controlled Manipulators", 1981.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal, final, get_args

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from manip_learn.constraint.mechanism import MIXED, Mechanism, plain
from manip_learn.constraint.place import AXES
from manip_learn.errors import ConstraintError
from manip_learn.linalg import row_basis
from manip_learn.robot.rotations import skew

AxisState = Literal["held", "free", "unknown"]
Turns = Literal["no", "hand", "axis", "other frame"]


@final
@dataclass(frozen=True, eq=False)
class TaskFrame:
    """Frame whose axes are each either free or held by a constraint (compliance frame, task frame of Mason).

    The six axes are translations x y z of one point of the hand (`point`) and rotations rx ry rz.

    Attributes:
        pose: Pose (4, 4) of the task frame in the robot's base [m]. For a line, a plane, a hinge or a screw, z is along
            the axis of the mechanism. If this axis does not pass through the hand, the origin is its point nearest to
            the hand, and x points to the hand. For a ball, the origin is the centre, and z points to the hand.
        axes: State of x y z rx ry rz: `"free"`, `"held"`, or `"unknown"` if the features do not contain the axis.
        uncertainty: shape (6,), angle error of each axis [rad]: root of the sum of squares of the learner's uncertainty
            (zero for a constraint written by hand) and of the angle by which Lambda mixes the axis with others; pi / 2
            for an unknown axis.
        rows: shape (r, 6), orthonormal basis of the held combinations of the twist of `point` along the frame's axes.
            It has all rows of Lambda, also those that mix axes (z and rz of a screw); r is smaller than their number s
            only if A has dependent rows.
        hand: Pose (4, 4) of the constrained frame of the robot, in the base [m].
        point: shape (3,), point of the hand whose velocity is meant by x y z, in the base [m]. It is the origin of the
            task frame, except for a hand that may turn at a distance from the mechanism's axis or centre: there it is
            the constrained point of the hand.
        turns: Motion of the axes when the arm moves: `"no"` for axes fixed in the base, `"hand"` for axes fixed in the
            hand, `"axis"` if an axis keeps pointing to the hand, `"other frame"` for axes fixed in another frame.
        frame: Name of the constrained frame of the robot.
        mechanism: Mechanism that constrains the hand; None if it is not known.
    """

    pose: Float[np.ndarray, "4 4"]
    axes: tuple[AxisState, ...]
    uncertainty: Float[np.ndarray, " 6"]
    rows: Float[np.ndarray, "r 6"]
    hand: Float[np.ndarray, "4 4"]
    point: Float[np.ndarray, " 3"]
    turns: Turns
    frame: str
    mechanism: Mechanism | None = None

    def along(self, state: AxisState) -> list[bool]:
        """Return which axes are in a state.

        Args:
            state: `"held"`, `"free"` or `"unknown"`.

        Returns:
            Six booleans, for x y z rx ry rz.
        """
        return [axis == state for axis in self.axes]

    @property
    def from_hand(self) -> Float[np.ndarray, "6 6"]:
        """Matrix (6, 6) that turns the hand's twist, base axes, into the twist of `point`, task-frame axes."""
        return _from_hand(self.pose[:3, :3], self.point - self.hand[:3, 3])

    def to_dict(self) -> dict[str, Any]:
        """Return all attributes as a dictionary of JSON values; `axes` maps each axis name to its state."""
        return plain(self) | {"axes": dict(zip(AXES, self.axes, strict=True))}

    @property
    def sentence(self) -> str:
        """Axes by state and origin [m], e.g. `"held x y; free z; unknown rx ry rz; origin (0.500, 0.200, 0.500)"`."""
        axes = {state: [AXES[i] for i in np.flatnonzero(self.along(state))] for state in get_args(AxisState)}
        states = "; ".join(f"{state} {' '.join(names)}" for state, names in axes.items() if names)
        return f"{states}; origin ({', '.join(f'{x:.3f}' for x in self.pose[:3, 3])})"

    def __repr__(self) -> str:
        return f"TaskFrame({self.sentence}, about {self.frame!r})"


def task_frame(constraint: Any, q: ArrayLike) -> TaskFrame:
    """Return the task frame of a constraint at a configuration, see `TaskFrame`.

    Args:
        constraint: Constraint A(q).
        q: Joint configuration (nq,) or positions (nv,) [rad or m].

    Returns:
        The task frame in the robot's base frame; its arrays are read-only.

    Raises:
        ConstraintError: The features are not rows of one frame's twist.
        ConfigurationError: q has the wrong size or is not finite.
    """
    f, fitted, record = constraint.features, constraint.mechanism, constraint.provenance
    if f.twist is None:
        raise ConstraintError(f"{f!r} are not rows of one frame's twist: a task frame needs a frame of the robot")
    mechanism, base, turns = fitted, np.eye(3), "no"  # the axes of the rows, and their motion
    if f.relative_to is not None:
        other = f.robot.pose(q, f.relative_to)
        mechanism, base, turns = None if fitted is None else fitted.moved(other), other[:3, :3], "other frame"
    pose_of_rows = f.twist.pose(q)
    to_base, W = np.kron(np.eye(2), base.T), f.weights_at(pose_of_rows[None])[0]
    blocked, features = constraint.selection @ W @ to_base, W @ to_base  # rows of the hand's twist, base axes
    if f.own_axes:
        base, turns = pose_of_rows[:3, :3], "hand"
    elif f.own_axes is None:
        # features of a mechanism contain its held rows only: one translation or rotation stands for all three
        features = np.eye(6)[np.repeat([bool(np.any(W[:, part])) for part in (slice(0, 3), slice(3, 6))], 3)] @ to_base
    hand = f.robot.pose(q, f.frame)
    p, carried = hand[:3, 3], mechanism is None or mechanism.grip == "firm"
    forces, moments, c = _central(blocked)
    point = origin = p + c
    preferred = [base[:, 2], base[:, 0], base[:, 1]]
    if mechanism is not None and mechanism.axis is not None and turns != "hand":
        preferred.insert(0, mechanism.axis)
    if mechanism is not None and mechanism.point is not None and mechanism.type not in ("line", "plane"):
        out = p - mechanism.point
        out = out if mechanism.axis is None else out - float(mechanism.axis @ out) * mechanism.axis
        origin = origin if carried else p - out
        preferred.insert(0 if mechanism.axis is None else 1, out)
        turns = turns if turns == "other frame" else "axis"
    pose = np.eye(4)
    # held moments get half the weight of held forces, so that the possible sums per axis, 0, 0.5, 1 and 1.5, all differ
    pose[:3, :3], pose[:3, 3] = _axes(forces.T @ forces + 0.5 * moments.T @ moments, preferred), origin
    back = np.linalg.inv(_from_hand(pose[:3, :3], point - p))
    rows, visible = row_basis(blocked @ back), row_basis(features @ back)
    share, coverage = (np.einsum("si,si->i", x, x) for x in (rows, visible))
    states = np.where(coverage < 0.5, "unknown", np.where(share > 0.5, "held", "free"))
    P = rows.T @ rows
    mixed = np.arcsin(np.minimum(1.0, np.linalg.norm(np.where(share > 0.5, np.eye(6) - P, P), axis=0)))
    # the learner's angle errors: from Lambda, or from a fitted axis and its place relative to the hand
    errors, angle, lever = {} if mechanism is None else mechanism.uncertainty, record.get("uncertainty_deg"), p - origin
    stated = np.full(6, math.radians(errors.get("axis", angle if isinstance(angle, int | float) else 0.0)))
    if np.any(lever):
        stated[:2] = np.hypot(stated[:2], math.atan(errors.get("point", 0.0) / float(np.linalg.norm(lever))))
    right_angle = 0.5 * math.pi  # [rad] error of an unknown axis
    uncertainty = np.minimum(np.where(coverage < 0.5, right_angle, np.hypot(stated, mixed)), right_angle)
    for array in (pose, uncertainty, rows, hand, point):
        array.setflags(write=False)
    return TaskFrame(pose, tuple(states.tolist()), uncertainty, rows, hand, point, turns, f.frame.name, fitted)  # type: ignore[arg-type]


def _central(held: Float[np.ndarray, "s 6"]) -> tuple[np.ndarray, np.ndarray, Float[np.ndarray, " 3"]]:
    """Return directions of held forces and of held pure moments, and the point about which the forces have no other
    moment.

    Rows are f.v + m.w about the hand; about a point at c from there the moment is m - c x f. Among all equivalent
    points it is the one nearest to the hand.
    """
    held = row_basis(held)
    U, sizes, _ = np.linalg.svd(held[:, :3])
    n = int(np.count_nonzero(sizes > MIXED))
    moments = (U[:, n:].T @ held)[:, 3:]
    _, turning, Vt = np.linalg.svd(moments)
    moments = Vt[: int(np.count_nonzero(turning > MIXED))]
    rows = (U[:, :n].T @ held) / sizes[:n, None]
    rest = np.eye(3) - moments.T @ moments
    levers = np.reshape([rest @ skew(force) for force in rows[:, :3]], (-1, 3))
    # use the rank of exact rows: the leakage of a learnt row is not a lever
    return rows[:, :3], moments, np.linalg.lstsq(levers, -(rows[:, 3:] @ rest).reshape(-1), rcond=MIXED)[0]


def _from_hand(R: Float[np.ndarray, "3 3"], lever: Float[np.ndarray, " 3"]) -> Float[np.ndarray, "6 6"]:
    """Return the matrix from a twist at the hand to the twist at a point, along the axes R."""
    return np.block([[R.T, -R.T @ skew(lever)], [np.zeros((3, 3)), R.T]])


def _axes(S: Float[np.ndarray, "3 3"], preferred: Sequence[Float[np.ndarray, " 3"]]) -> Float[np.ndarray, "3 3"]:
    """Return right-handed principal axes of S; where these are not determined, along the preferred directions.

    The first preferred direction that is possible becomes z, the next one x.
    """
    values, vectors = np.linalg.eigh(S)
    # index of each vector's eigenspace; 0.25 is half the smallest difference of the sums
    space = np.cumsum(np.diff(values, prepend=values[0]) > 0.25)
    projections = [V @ V.T for V in (vectors[:, space == k] for k in range(space[-1] + 1))]
    directions: list[np.ndarray] = []
    for wish in preferred:
        parts = np.array([P @ wish for P in projections])
        lengths = np.linalg.norm(parts, axis=1)
        best = int(np.argmax(lengths))
        # one of the three base axes always lies by half or more in the remaining space
        if len(directions) < 2 and lengths[best] > 0.4 * np.linalg.norm(wish):
            e = parts[best] / lengths[best]
            directions.append(e)
            projections[best] = projections[best] - np.outer(e, e)
    z, x = directions
    return np.column_stack([x, np.cross(z, x), z])
