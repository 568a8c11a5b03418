"""Motion that a hinge, a cylinder, a screw or a ball leaves free."""

from __future__ import annotations

import math
from typing import final

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from manip_learn.constraint.constraint import Constraint
from manip_learn.constraint.features.mechanism_rows import MechanismRows
from manip_learn.constraint.features.place_fields import Place
from manip_learn.control.tasks.driven_motion import DrivenMotion, Setpoint, Unit, nearest_turn
from manip_learn.errors import ConstraintError, TargetError, advice
from manip_learn.robot.rotations import rotation_matrix, rotation_vector, skew

# what may be driven, in words
DRIVEN = {
    "turn": "turn (about the axis, with the hand) [rad]",
    "slide": "slide (along the axis) [m]",
    "tangential": "tangential (around the axis) [rad]",
    "axial": "axial (along the axis) [m]",
    "radial": "radial (away from the axis) [m]",
}


@final
class MechanismMotion(DrivenMotion):
    """One free row of a mechanism, driven, while each held row keeps the coordinate that it is the rate of.

    Loose rows are the rates of the cylindrical coordinates (rho, phi, z) of the frame's origin about the axis: `radial`
    of rho, `axial` of z, `spherical` of the distance from the centre, `helical` of rho (z - h phi) / sqrt(rho^2 + h^2)
    on its cylinder, and `tangential` rho dphi/dt. Firm rows are those of the hand as a whole, with the rotation
    R R0^T = swing * exp([a]x theta) since the start and the hand's point that was at c, x: `turn` of theta, `turn-1`
    and `turn-2` of the swing, `slide` and `slide-1`, `slide-2` of x, `screw` of a.x - h theta.

    Args:
        constraint: The learnt constraint, of rows of a mechanism.
        direction: Name of the row that is driven; for a ball the axis of the turn in the base frame (right-handed).
        unit: `"m"` or `"rad"`: a row that slides or one that turns is meant; None for whatever is free.
        straight: The other free places of the hand's origin stand still too, so that it stays on one circle or on one
            line; False leaves them to the null-space policy.

    Raises:
        ConstraintError: Nothing is free, several are and none was named, or combinations of rows are held.
        TargetError: A direction that is not free, or no direction.
    """

    def __init__(
        self,
        constraint: Constraint,
        direction: ArrayLike | str | None,
        unit: Unit | None = None,
        straight: bool = False,
    ):
        self.along_rows = True
        rows: MechanismRows = constraint.features  # type: ignore[assignment]
        g = rows.geometry
        held = _held(constraint, rows)
        firm = any(name.startswith("slide") or name == "screw" for name in held)
        axis, driven = g.axis, ""
        if "spherical" in held or {"slide", "slide-1", "slide-2"} == set(held):
            axis, driven = _axis_of_turn(direction), "turn" if firm else "tangential"
        else:
            driven = _chosen(held, firm, direction, unit)
        beside = _beside(held, driven) if straight and not firm else ()
        self._rows = MechanismRows(
            rows.robot, rows.frame.name, (*held, *beside, driven), axis=axis, point=g.point, pitch=g.pitch
        )
        self.constraint = Constraint(np.eye(self._rows.n_rows), self._rows, constraint.provenance)
        self.unit = "rad" if driven in ("turn", "tangential") else "m"
        self._held, self._kept, self._driven = held, (*held, *beside), driven
        self._turns = any(name.startswith(("turn", "slide", "screw")) for name in (*held, driven))

    def origin(self, q: ArrayLike) -> Float[np.ndarray, "..."]:
        """Pose of the frame."""
        return self._rows.robot.pose(q, self._rows.frame)

    def progress(self, origin: Float[np.ndarray, "..."], q: ArrayLike, near: float) -> float:
        """Angle [rad] or way [m] since the start."""
        return self._coordinates(origin, q, near)[self._driven]

    def rates(
        self, origin: Float[np.ndarray, "..."], q: ArrayLike, setpoint: Setpoint, gain: float
    ) -> Float[np.ndarray, " p"]:
        """Held coordinates back to their start values, the driven one towards the setpoint."""
        now = self._coordinates(origin, q, setpoint.distance)
        rate = setpoint.approached(setpoint.distance - now[self._driven], gain)
        if self._driven == "tangential":
            rate *= now["distance from the axis"]
        rates = [-gain * now[name] for name in self._kept]
        if "tangential" in self._kept:  # of an angle: its row is a speed
            rates[self._kept.index("tangential")] *= now["distance from the axis"]
        return np.array([*rates, rate])

    def deviation(self, origin: Float[np.ndarray, "..."], q: ArrayLike, distance: float) -> Float[np.ndarray, " k"]:
        """The held coordinates, less what they were at the start."""
        now = self._coordinates(origin, q, distance)
        return np.array([now[name] for name in self._held])

    def goal(self, origin: Float[np.ndarray, "..."], distance: float) -> Float[np.ndarray, "..."]:
        """Pose of the frame after a distance of the driven row, as on a hand that turns with the mechanism."""
        g, goal = self._rows.geometry, np.eye(4)
        turn = rotation_matrix((distance if self.unit == "rad" else 0.0) * g.axis)
        shift = {"slide": distance, "axial": distance}.get(self._driven, 0.0) * g.axis
        if "screw" in self._held or "helical" in self._held:
            shift = g.pitch * distance * g.axis
        if self._driven == "radial":
            out = origin[:3, 3] - g.point
            out = out - float(g.axis @ out) * g.axis
            shift = distance * out / np.linalg.norm(out)
        goal[:3, :3] = turn @ origin[:3, :3]
        goal[:3, 3] = g.point + turn @ (origin[:3, 3] - g.point) + shift
        return goal

    def _coordinates(self, origin: np.ndarray, q: ArrayLike, near: float) -> dict[str, float]:
        """The coordinate of each row, less its value at the start; angles next to `near`."""
        pose, g = self.origin(q), self._rows.geometry
        # only what is driven goes beyond half a turn
        turned, around = (near if self._driven == name else 0.0 for name in ("turn", "tangential"))
        out = place_about(origin[:3, 3] - g.point, pose[:3, 3] - g.point, g, around)
        return out | _hand(origin, pose, g, turned) if self._turns else out


def place_about(d0: np.ndarray, d: np.ndarray, g: Place, near: float) -> dict[str, float]:
    """Of the frame's origin, from its places about the point of the axis at the start and now."""
    a = g.axis
    z0, z = float(a @ d0), float(a @ d)
    x0, x = d0 - z0 * a, d - z * a
    rho0, rho = math.sqrt(x0 @ x0), math.sqrt(x @ x)
    phi = nearest_turn(math.atan2(float(x @ (skew(a) @ x0)), float(x0 @ x)), near)
    size = math.hypot(rho, g.pitch)
    return {
        "tangential": phi,
        "radial": rho - rho0,
        "axial": z - z0,
        "spherical": math.sqrt(d @ d) - math.sqrt(d0 @ d0),
        "helical": rho / size * (z - z0 - g.pitch * phi) if size > 0.0 else 0.0,
        "distance from the axis": rho,
    }


def _hand(start: np.ndarray, pose: np.ndarray, g: Place, near: float) -> dict[str, float]:
    """Of the hand as a whole, from its poses at the start and now."""
    Q, a = pose[:3, :3] @ start[:3, :3].T, g.axis
    r = rotation_vector(Q)
    angle = math.sqrt(r @ r)
    along = math.sin(0.5 * angle) * float(a @ r) / angle if angle > 0.0 else 0.0
    theta = 2.0 * math.atan2(along, math.cos(0.5 * angle))
    swing = rotation_vector(Q @ rotation_matrix(-theta * a))
    theta = nearest_turn(theta, near)
    x = pose[:3, 3] + Q @ (g.point - start[:3, 3]) - g.point
    return {
        "turn": theta,
        "turn-1": float(g.across[0] @ swing),
        "turn-2": float(g.across[1] @ swing),
        "slide": float(a @ x),
        "slide-1": float(g.across[0] @ x),
        "slide-2": float(g.across[1] @ x),
        "screw": float(a @ x) - g.pitch * theta,
    }


def _held(constraint: Constraint, rows: MechanismRows) -> tuple[str, ...]:
    """Names of the rows that are held."""
    projector = constraint.selection.T @ constraint.selection
    if np.max(np.abs(projector - np.round(projector))) > 1e-9:
        raise ConstraintError(
            f"the constraint holds combinations of the rows {' '.join(rows.row_names)}: FreeDirection needs each of "
            "them to be held as it is, or not at all"
        )
    return tuple(name for name, weight in zip(rows.row_names, np.diag(projector), strict=True) if weight > 0.5)


def _beside(held: tuple[str, ...], driven: str) -> tuple[str, ...]:
    """The cylindrical coordinates of the hand's origin that a way along one of them leaves out, beside what is held.

    A ball and a screw hold a combination of two: with it and the driven one, one of the two is left.
    """
    combined = {"spherical": "radial", "helical": "axial"}
    taken = {driven, *held, *(combined[name] for name in held if name in combined)}
    return tuple(name for name in ("radial", "axial", "tangential") if name not in taken)


def _chosen(held: tuple[str, ...], firm: bool, direction: ArrayLike | str | None, unit: Unit | None) -> str:
    taken = {*held, "slide" if "screw" in held else "", "axial" if "helical" in held else ""}
    names = ("turn", "slide") if firm else ("tangential", "axial", "radial")
    free = [name for name in names if name not in taken and (unit is None or f"[{unit}]" in DRIVEN[name])]
    words = "; ".join(DRIVEN[name] for name in free)
    if not free:
        how = {"m": "move along", "rad": "turn about", None: "move along"}[unit]
        raise ConstraintError(f"the mechanism's rows {' '.join(held)} leave nothing free to {how}")
    if direction is None:
        if len(free) > 1:
            raise ConstraintError(
                f"the mechanism leaves {len(free)} directions free ({words}): say along which one to move"
                + advice(" with {}", f"direction={free[0]!r}", f"--direction {free[0]}")
            )
        return free[0]
    if not (isinstance(direction, str) and direction in free):
        raise TargetError(f"the direction of a mechanism is the name of a row that is free: {words}; got {direction!r}")
    return direction


def _axis_of_turn(direction: ArrayLike | str | None) -> Float[np.ndarray, " 3"]:
    if direction is None:
        raise ConstraintError(
            "a ball leaves turns about every axis free: give the axis in the base frame"
            + advice(", e.g. {}", "direction=(0, 0, 1)", "--direction 0,0,1")
        )
    refusal = f"the direction of a ball is the axis of the turn, three finite numbers not all zero; got {direction!r}"
    try:
        axis = np.array(direction, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise TargetError(refusal) from error
    if axis.shape != (3,) or not np.all(np.isfinite(axis)) or not np.linalg.norm(axis) > 0.0:
        raise TargetError(refusal)
    return axis
