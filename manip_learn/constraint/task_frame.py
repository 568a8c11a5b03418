"""The frame in which a constraint's rows lie along axes: what a force or impedance controller asks for.

A held row weighs the hand's twist (v, w), and the environment answers along it with a wrench: a force f and a moment m.
The frame's origin c is where the forces have no moment but those that are held anyway (the central axis of L. Poinsot),
its axes are directions along which all is free or all is held. Both follow from Lambda alone; where the mechanism has a
place, the frame is on it. After M. T. Mason, "Compliance and Force Control for Computer Controlled Manipulators", 1981.
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
UNKNOWN = 0.5 * math.pi  # [rad] an axis of which nothing is known may be any


@final
@dataclass(frozen=True, eq=False)
class TaskFrame:
    """A frame along whose axes a constraint leaves the hand free, or holds it.

    The axes x y z are translations of one point of the hand, `point`; rx ry rz are rotations.

    Attributes:
        pose: shape (4, 4), the frame in the robot's base: origin [m] and axes. For a line, a plane, a hinge or a screw
            z is its axis; where the mechanism has an axis away from the hand, the origin is its point next to the hand
            and x points to the hand; of a ball it is the centre, and z points to the hand.
        axes: Six of `"free"`, `"held"` and `"unknown"` (the features do not show it), for x y z rx ry rz.
        uncertainty: shape (6,), angle by which each axis may be off [rad]: what the learner states and, in quadrature,
            what Lambda mixes it with other axes; pi / 2 for an unknown one. Zero stated for a constraint by hand.
        rows: shape (r, 6), the held rows of the twist of `point` along the frame's axes [m/s, rad/s], orthonormal: all
            of Lambda, also where it mixes axes (the z and rz of a screw). Fewer than s only where A has dependent rows.
        hand: shape (4, 4), the frame of the robot that the constraint is about, in the base.
        point: shape (3,), whose velocity x y z are, in the base [m]: the origin, but for a hand that may turn in a
            mechanism whose axis or centre is elsewhere the point held.
        turns: What the axes turn with when the arm moves: `"no"` for axes fixed in the base, `"hand"`, `"axis"` (x goes
            on pointing to the hand), or `"other frame"` of two.
        frame: Name of the robot's frame.
        mechanism: What holds the hand, if that has a name.
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
        """Of each axis whether it is in that state."""
        return [axis == state for axis in self.axes]

    @property
    def from_hand(self) -> Float[np.ndarray, "6 6"]:
        """X, with X (v, w) the twist of `point` along the frame's axes, (v, w) that of the hand along the base's."""
        return _from_hand(self.pose[:3, :3], self.point - self.hand[:3, 3])

    def to_dict(self) -> dict[str, Any]:
        """Return all of it as plain numbers and words, ready for JSON."""
        return plain(self) | {"axes": dict(zip(AXES, self.axes, strict=True))}

    @property
    def sentence(self) -> str:
        """The axes by their state, and the origin: `"held x y; free z; unknown rx ry rz; origin (0.5, 0.2, 0.5)"`."""
        axes = {state: [AXES[i] for i in np.flatnonzero(self.along(state))] for state in get_args(AxisState)}
        states = "; ".join(f"{state} {' '.join(names)}" for state, names in axes.items() if names)
        return f"{states}; origin ({', '.join(f'{x:.3f}' for x in self.pose[:3, 3])})"

    def __repr__(self) -> str:
        return f"TaskFrame({self.sentence}, about {self.frame!r})"


def task_frame(constraint: Any, q: ArrayLike) -> TaskFrame:
    """Return the task frame of a constraint at a posture, see `TaskFrame`.

    Args:
        constraint: A(q).
        q: Posture.

    Returns:
        The frame, its arrays read-only.

    Raises:
        ConstraintError: Features that are no rows of one frame's twist.
        ConfigurationError: q has the wrong size or is not finite.
    """
    f, told, learnt = constraint.features, constraint.mechanism, constraint.provenance
    if f.twist is None:
        raise ConstraintError(f"{f!r} are no rows of one frame's twist: a task frame needs a frame of the robot")
    mechanism, base, turns = told, np.eye(3), "no"  # the axes of the rows, and what they turn with
    if f.relative_to is not None:
        other = f.robot.pose(q, f.relative_to)
        mechanism, base, turns = None if told is None else told.moved(other), other[:3, :3], "other frame"
    own = f.twist.pose(q)
    turned, W = np.kron(np.eye(2), base.T), f.weights_at(own[None])[0]
    held, seen = constraint.selection @ W @ turned, W @ turned  # rows of the hand's twist along the base's axes
    if f.own_axes:
        base, turns = own[:3, :3], "hand"
    elif f.own_axes is None:
        # of a mechanism only the held rows are features: whoever saw one translation or rotation of it saw all
        seen = np.eye(6)[np.repeat([bool(np.any(W[:, part])) for part in (slice(0, 3), slice(3, 6))], 3)] @ turned
    hand = f.robot.pose(q, f.frame)
    p, carried = hand[:3, 3], mechanism is None or mechanism.grip == "firm"
    forces, moments, c = _central(held)
    point = origin = p + c
    wishes = [base[:, 2], base[:, 0], base[:, 1]]
    if mechanism is not None and mechanism.axis is not None and turns != "hand":
        wishes.insert(0, mechanism.axis)
    if mechanism is not None and mechanism.point is not None and mechanism.type not in ("line", "plane"):
        out = p - mechanism.point
        out = out if mechanism.axis is None else out - float(mechanism.axis @ out) * mechanism.axis
        origin = origin if carried else p - out
        wishes.insert(0 if mechanism.axis is None else 1, out)
        turns = turns if turns == "other frame" else "axis"
    pose = np.eye(4)
    # held moments weigh half as much as held forces: the sums of what an axis may hold, 0, 0.5, 1 and 1.5, all differ
    pose[:3, :3], pose[:3, 3] = _axes(forces.T @ forces + 0.5 * moments.T @ moments, wishes), origin
    back = np.linalg.inv(_from_hand(pose[:3, :3], point - p))
    rows, shown = row_basis(held @ back), row_basis(seen @ back)
    share, known = (np.einsum("si,si->i", x, x) for x in (rows, shown))
    states = np.where(known < 0.5, "unknown", np.where(share > 0.5, "held", "free"))
    P = rows.T @ rows
    mixed = np.arcsin(np.minimum(1.0, np.linalg.norm(np.where(share > 0.5, np.eye(6) - P, P), axis=0)))
    # what the learner states of directions: of Lambda, or of a fitted axis and its place as seen by the hand
    errors, angle, lever = {} if mechanism is None else mechanism.uncertainty, learnt.get("uncertainty_deg"), p - origin
    stated = np.full(6, math.radians(errors.get("axis", angle if isinstance(angle, int | float) else 0.0)))
    if np.any(lever):
        stated[:2] = np.hypot(stated[:2], math.atan(errors.get("point", 0.0) / float(np.linalg.norm(lever))))
    off = np.minimum(np.where(known < 0.5, UNKNOWN, np.hypot(stated, mixed)), UNKNOWN)
    for array in (pose, off, rows, hand, point):
        array.setflags(write=False)
    return TaskFrame(pose, tuple(states.tolist()), off, rows, hand, point, turns, f.frame.name, told)  # type: ignore[arg-type]


def _central(held: Float[np.ndarray, "s 6"]) -> tuple[np.ndarray, np.ndarray, Float[np.ndarray, " 3"]]:
    """Return directions of held forces and of held moments without a force, and where the forces have no other moment.

    Rows are f.v + m.w about the hand; about a point at c from there the moment is m - c x f. Of all points that do as
    well it is the one next to the hand.
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
    # the rank is that of clean rows: what a learnt row leaks is no lever
    return rows[:, :3], moments, np.linalg.lstsq(levers, -(rows[:, 3:] @ rest).reshape(-1), rcond=MIXED)[0]


def _from_hand(R: Float[np.ndarray, "3 3"], lever: Float[np.ndarray, " 3"]) -> Float[np.ndarray, "6 6"]:
    return np.block([[R.T, -R.T @ skew(lever)], [np.zeros((3, 3)), R.T]])


def _axes(S: Float[np.ndarray, "3 3"], wishes: Sequence[Float[np.ndarray, " 3"]]) -> Float[np.ndarray, "3 3"]:
    """Right-handed principal axes of S; where these are not determined, along the wishes.

    The first wish that can be had is z and the next one x.
    """
    values, vectors = np.linalg.eigh(S)
    space = np.cumsum(
        np.diff(values, prepend=values[0]) > 0.25
    )  # half of what sums differ by; number of each vector's eigenspace
    left = [V @ V.T for V in (vectors[:, space == k] for k in range(space[-1] + 1))]  # projections on these
    chosen: list[np.ndarray] = []
    for wish in wishes:
        parts = np.array([P @ wish for P in left])
        lengths = np.linalg.norm(parts, axis=1)
        best = int(np.argmax(lengths))
        # of three base axes one always lies in the space that is left by half or more
        if len(chosen) < 2 and lengths[best] > 0.4 * np.linalg.norm(wish):
            e = parts[best] / lengths[best]
            chosen.append(e)
            left[best] = left[best] - np.outer(e, e)
    z, x = chosen
    return np.column_stack([x, np.cross(z, x), z])
