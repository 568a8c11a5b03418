"""Task constraint A(q) = Lambda Phi(q), learnt from demonstrations or written by hand."""

from __future__ import annotations

import hashlib
import json
import math
import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, final

import numpy as np
from jaxtyping import Bool, Float
from numpy.typing import ArrayLike

from manip_learn.atomic_write import write_atomically
from manip_learn.constraint.features.feature_map import FeatureMap
from manip_learn.constraint.features.other_features import described_features
from manip_learn.constraint.mechanism import (
    NEGLIGIBLE_ENTRY,
    SHAPES,
    Mechanism,
    describe_uncertainty,
    embed_rows,
    fitted_mechanism,
    format_vector,
)
from manip_learn.constraint.place import AXES
from manip_learn.constraint.shown import Intention, Shown
from manip_learn.constraint.task_frame import TaskFrame, task_frame
from manip_learn.errors import DAMAGE, ConstraintError, ConstraintMismatchError, ManipLearnError, an, listed, spoken
from manip_learn.linalg import along_axes, manipulability_of, null_basis, orthonormal_rows
from manip_learn.recordings.guards import reason_of
from manip_learn.recordings.trajectory import Trajectory
from manip_learn.robot import html_card
from manip_learn.robot.description.text import parsed_json, read_regular_file, unreadable
from manip_learn.robot.identity import RobotIdentity
from manip_learn.robot.robot import Robot

_FORMAT = "manip_learn.constraint"
SCHEMA = 2  # file format that `save` writes; version 0.2 wrote schema 1
SIGNATURE = "sha256"  # entry of a file: SHA-256 of the entries that determine the arm's motion
# vector-Jacobian product of A(q): weights (s, nv) -> sum_ij weights_ij dA_ij / dq_k
Vjp = Callable[[Float[np.ndarray, "s nv"]], Float[np.ndarray, " nv"]]
# words for linear and for angular rows: verb, preposition, all directions, all but one
_MOVE = ("move", "along", "in every direction", "across it")
_TURN = ("turn", "about", "about every axis", "about every other axis")


@final
class Constraint:
    r"""Task constraint, a matrix that depends on the configuration q.

    Equation (1) of Manavalan and Howard, "Learning Singularity Avoidance":

    .. math::

        A(q) = \Lambda \, \Phi(q), \qquad A(q) \, u = b

    Phi (p, nv) are the features, Lambda (s, p) selects s combinations of their rows, u (nv,) is the joint velocity and
    b (s,) the velocity along the constrained directions. A physical constraint has b = 0.

    Only the row space of Lambda is significant, so the constructor makes the rows orthonormal. This also fixes the
    scale of the manipulability in the features' units.

    Args:
        selection: Matrix Lambda, shape (s, p). Zero rows are dropped; the others must be linearly independent.
        features: Feature map Phi with p rows, e.g. `FrameJacobian`.
        provenance: Record of how the constraint was learnt; saved with it. Default: none.

    Attributes:
        selection: Lambda with orthonormal rows, shape (s, p), read-only.
        features: Feature map Phi.
        n_constraints: Number of rows s.
        nv: Number of velocities that A acts on.
        provenance: Record of how the constraint was learnt, a dictionary of JSON values; empty if there is none.
        robot: The robot of the features; None for features without a robot.
        notes: Differences found by `load`, in sentences, e.g. joints that were locked at other positions. Empty for
            other constraints.

    Raises:
        ConstraintError: Wrong size, entries that are not finite, no nonzero row, dependent rows, or arguments in the
            wrong order.

    Example:
        >>> import manip_learn as ml
        >>> features = ml.FrameJacobian(ml.load_robot("planar3"), "tip", axes="x y")
        >>> constraint = ml.Constraint([[0, 1]], features)  # by hand: y is held, x is free
        >>> constraint([0.3, 0.8, 0.4]).round(2)  # A(q), one row per held direction
        array([[1.48, 0.52, 0.07]])
    """

    def __init__(self, selection: ArrayLike, features: FeatureMap, provenance: Mapping[str, Any] | None = None):
        if not isinstance(features, FeatureMap):
            arguments = f"{an(selection)} and {an(features)}"
            raise ConstraintError(f"expected Constraint(selection, features), got {arguments} in this order")
        try:
            matrix = np.atleast_2d(np.array(selection, dtype=np.float64))
        except (TypeError, ValueError, OverflowError) as error:
            raise ConstraintError(f"the selection matrix must have numeric rows of equal length: {error}") from error
        p = features.n_rows
        if matrix.ndim != 2 or matrix.shape[1] != p:
            columns = f"{p} columns, one per feature row ({', '.join(features.row_names)})"
            raise ConstraintError(f"the selection matrix must have {columns}; got shape {matrix.shape}")
        if not np.all(np.isfinite(matrix)):
            raise ConstraintError("the selection matrix has entries that are not finite")
        matrix = matrix[np.linalg.norm(matrix, axis=1) > 0.0]
        if len(matrix) == 0:
            raise ConstraintError("all rows of the selection matrix are zero")
        unit = matrix / np.linalg.norm(matrix, axis=1, keepdims=True)
        smallest = np.linalg.svd(unit, compute_uv=False)[-1] if len(unit) <= p else 0.0
        if smallest < 1e-10:
            problem = f"are linearly dependent (smallest singular value {smallest:.1e})"
            remedy = "remove the redundant rows"
            raise ConstraintError(f"the rows of the selection matrix {problem}: {remedy}")
        # leave orthonormal rows unchanged to the last bit: paper-mode truncation depends on it
        is_exact = np.max(np.abs(matrix @ matrix.T - np.eye(len(matrix)))) < 1e-14
        self.selection: Float[np.ndarray, "s p"] = matrix if is_exact else orthonormal_rows(matrix)
        self.selection.setflags(write=False)
        self.features, self.n_constraints, self.nv = features, len(matrix), features.nv
        self.robot: Robot | None = features.robot
        self.provenance: dict[str, Any] = dict(provenance or {})
        self.notes: tuple[str, ...] = ()

    @property
    def mechanism(self) -> Mechanism | None:
        """Mechanism that constrains the end effector, e.g. a hinge, identified from the rows of Lambda.

        If the constraint was learnt, axis, point, radius and uncertainty are from the fit to the recorded positions.
        None if no known mechanism has these rows, or if the demonstrator imposed the constraint (b varies).
        """
        if self.provenance.get("kind") == "self-imposed":
            return None
        mechanism = self.features.mechanism(self.selection, self.provenance)
        return None if mechanism is None else fitted_mechanism(mechanism, self.provenance)

    @property
    def shown(self) -> Shown | None:
        """Demonstrated motion along the free directions; None if the constraint was not learnt from recordings."""
        return Shown.from_dict(self.provenance.get("shown"))

    @property
    def intention(self) -> Intention | None:
        """Goals of the rows that the demonstrator drove on purpose (b unknown); None for other constraints."""
        return Intention.from_dict(self.provenance.get("intention"))

    def task_frame(self, q: ArrayLike) -> TaskFrame:
        """Return the frame whose axes are each either free or held by this constraint.

        Force and impedance controllers need their constraints in such a frame. `manip-learn export` writes it for them,
        e.g. with `--to urscript`.

        Args:
            q: Joint configuration (nq,) or positions (nv,) [rad or m].

        Returns:
            The task frame in the robot's base frame.

        Raises:
            ConstraintError: The features are not rows of one frame's twist.
            ConfigurationError: q has the wrong size or is not finite.
        """
        return task_frame(self, q)

    def about_its_mechanism(self) -> Constraint:
        """Return the same constraint with rows that are named after its mechanism, e.g. `radial` and `axial` of a
        hinge.

        Returns:
            A constraint with `MechanismRows` or `FrameJacobian` rows instead of `PlaceRows`; this constraint itself if
            it has other features or its mechanism is not known.
        """
        features, selection = self.features.named(self.selection, self.mechanism)
        return self if features is self.features else Constraint(selection, features, self.provenance)

    def with_orientation(self) -> Constraint:
        """Return this constraint with additional rows that also constrain the orientation of its frame.

        Returns:
            A constraint with the rows of this one, followed by rows for the rotations that these leave free.

        Raises:
            ConstraintError: The features have no frame with an orientation.
        """
        constraint = self.about_its_mechanism()
        features, selection = constraint.features.with_rotation(constraint.selection)
        return Constraint(selection, features, self.provenance)

    def showing(self, shown: Shown) -> Constraint:
        """Return a copy of this constraint with another demonstrated motion.

        Args:
            shown: Demonstrated motion along the free directions.

        Returns:
            A constraint with the same rows and with `shown` as its demonstrated motion.
        """
        return Constraint(self.selection, self.features, self.provenance | {"shown": shown.to_dict()})

    def moved(self, transform: Float[np.ndarray, "4 4"]) -> Constraint:
        """Return this constraint for a mechanism that was moved, e.g. a drawer at another position.

        A point p of the mechanism moves to p' = R p + t in the base frame. Rows along the axes of the hand's own frame
        do not change.

        Args:
            transform: Homogeneous matrix (4, 4) of R and t, in the base frame [m].

        Returns:
            The moved constraint, without the recorded configurations; this constraint itself if its rows are relative
            to another frame.
        """
        if self.features.relative_to is not None:
            return self
        provenance = {k: v for k, v in self.provenance.items() if not k.startswith("posture")}
        for name, record in (("mechanism", self.mechanism), ("shown", self.shown)):
            if record is not None:
                provenance[name] = record.moved(transform).to_dict()
        constraint = self.about_its_mechanism()
        features, selection = constraint.features.moved(transform, constraint.selection)
        return Constraint(selection, features, provenance)

    def __call__(self, q: ArrayLike) -> Float[np.ndarray, "s nv"]:
        """Evaluate the constraint matrix A(q) = Lambda Phi(q).

        Args:
            q: Joint configuration (nq,) or positions (nv,) [rad or m].

        Returns:
            A(q), shape (s, nv), in the units of the feature rows.

        Raises:
            ConfigurationError: q has the wrong size or is not finite.
        """
        return self.selection.dot(self.features(q))

    def manipulability(self, q: ArrayLike) -> float:
        """Return the manipulability mu(q) = sqrt(det(A A^T)), as `manip_learn.manipulability(constraint, q)` does.

        Args:
            q: Joint configuration (nq,) or positions (nv,) [rad or m].

        Returns:
            The manipulability mu, at least 0; its unit is the product of the units of the rows.

        Raises:
            ConfigurationError: q has the wrong size or is not finite.
        """
        return manipulability_of(self(q))

    def derivative(self, q: ArrayLike) -> Float[np.ndarray, "s nv nv"]:
        """Return the derivative dA/dq.

        Args:
            q: Joint configuration (nq,) or positions (nv,) [rad or m].

        Returns:
            shape (s, nv, nv): entry [i, j, k] = d A_ij / d q_k along tangent coordinate k.

        Raises:
            ConfigurationError: q has the wrong size or is not finite.
        """
        return self.value_and_derivative(q)[1]

    def value_and_derivative(self, q: ArrayLike) -> tuple[Float[np.ndarray, "s nv"], Float[np.ndarray, "s nv nv"]]:
        """Return A(q) and dA/dq, faster than by two calls.

        Args:
            q: Joint configuration (nq,) or positions (nv,) [rad or m].

        Returns:
            A (s, nv), and dA/dq (s, nv, nv) as from `derivative`.

        Raises:
            ConfigurationError: q has the wrong size or is not finite.
        """
        Phi, dPhi = self.features.value_and_derivative(q)
        dA = self.selection @ dPhi.reshape(dPhi.shape[0], -1)
        return self.selection @ Phi, dA.reshape(-1, *dPhi.shape[1:])

    def value_and_vjp(self, q: ArrayLike) -> tuple[Float[np.ndarray, "s nv"], Vjp]:
        """Return A(q) and its vector-Jacobian product.

        Args:
            q: Joint configuration (nq,) or positions (nv,) [rad or m].

        Returns:
            A (s, nv), and a function that takes weights w (s, nv) and returns the vector (nv,) whose entry k is the sum
            over i and j of `w[i, j] * dA[i, j] / dq[k]`.

        Raises:
            ConfigurationError: q has the wrong size or is not finite.
        """
        A, dA = self.value_and_derivative(q)
        flat = dA.reshape(-1, self.nv)
        return A, lambda weights: weights.reshape(-1).dot(flat)

    def residual(self, demonstrations: Iterable[Trajectory]) -> float:
        r"""Return the fraction of the demonstrated motion that violates A(q) u = 0.

        The sums are over all samples; :math:`A^+ A u` is the part of the joint velocity u that the constraint forbids:

        .. math::

            \sqrt{\frac{\sum |A^+ A u|^2}{\sum |u|^2}}

        The result is meaningful only for recordings with a physical constraint (b = 0).

        Args:
            demonstrations: Trajectories with velocities u [rad/s or m/s].

        Returns:
            The RMS fraction, from 0 (the constraint holds exactly) to 1.

        Raises:
            ConstraintError: A trajectory has no velocities, or there is no motion.
        """
        broken = total = 0.0
        for trajectory in demonstrations:
            if trajectory.u is None or not np.all(np.isfinite(trajectory.u)):
                raise ConstraintError(f"{trajectory.name} has no velocities: derive them first (derive_velocities)")
            A, u = self.selection @ self.features.batch(trajectory.q), trajectory.u[:, :, None]
            broken += float(np.sum((np.linalg.pinv(A) @ (A @ u)) ** 2))
            total += float(np.sum(u**2))
        if total == 0.0:
            raise ConstraintError("these demonstrations contain no motion, so the residual is undefined")
        return float(np.sqrt(broken / total))

    # ---- files ----------------------------------------------------------------------------------------------------

    def to_dict(self) -> dict[str, Any]:
        """Return the content of a constraint file.

        Returns:
            Dictionary of JSON values, with the SHA-256 of the entries that determine the motion.

        Raises:
            FeatureError: The features are Python functions, which cannot be saved.
        """
        described = None
        if self.robot is not None:
            described = RobotIdentity.of(self.robot).to_dict() | {"nv": self.robot.nv}
            del described["source"]  # a local path
        content = {
            "format": _FORMAT,
            "schema": SCHEMA,
            "robot": described,
            "features": self.features.describe(),
            "row_names": list(self.features.row_names),
            "row_units": list(self.features.row_units),
            "n_constraints": self.n_constraints,
            "selection": self.selection.tolist(),
            "provenance": self.provenance,
        }
        return with_checksum(content)

    def save(self, path: str | Path) -> Path:
        """Write the constraint to a JSON file; after an error, no incomplete file is left.

        Args:
            path: File to write.

        Returns:
            Path of the written file.

        Raises:
            OutputError: The file cannot be written.
            FeatureError: The features are Python functions, which cannot be saved.
        """
        return write_atomically(path, json.dumps(self.to_dict(), indent=2, allow_nan=False) + "\n")

    @staticmethod
    def load(path: str | Path, robot: Robot, *, same_urdf: bool = True) -> Constraint:
        """Read a constraint file for the robot of that constraint.

        Args:
            path: JSON file written by `save`.
            robot: The robot, loaded with the same locked joints.
            same_urdf: Require the identical URDF with joints locked at the same positions. False accepts another
                version of the URDF with the same joints, e.g. after a change of its visuals. You must then make sure
                that the kinematics are the same; `notes` of the constraint name joints that are locked at other
                positions.

        Returns:
            The constraint.

        Raises:
            ConstraintMismatchError: The file is for another robot, has a newer schema, is no constraint file, or was
                changed after it was saved; a number is not finite, or the rows contradict the file's other entries
                (number, names or units of rows, orthonormality).

        Warns:
            UserWarning: The file has no SHA-256, so that changes cannot be detected.
        """
        return Constraint.from_dict(read_constraint_file(Path(path)), robot, source=str(path), same_urdf=same_urdf)

    @staticmethod
    def from_dict(
        content: Mapping[str, Any], robot: Robot, *, source: str = "the constraint", same_urdf: bool = True
    ) -> Constraint:
        """Build a constraint from the output of `to_dict`, for the robot of that constraint.

        Args:
            content: The output of `to_dict`, or the JSON document of a file.
            robot: The robot, loaded with the same locked joints.
            source: Name of the content in error messages.
            same_urdf: Require the identical URDF with joints locked at the same positions, see `load`.

        Returns:
            The constraint.

        Raises:
            ConstraintMismatchError: The content is damaged or for another robot, see `load`.
        """
        if not isinstance(content, Mapping) or content.get("format") != _FORMAT:
            raise ConstraintMismatchError(f'{source} is not a constraint file: it lacks "format": "{_FORMAT}"')
        if content.get("schema") not in (1, SCHEMA):
            problem = f"{source} has schema {content.get('schema')!r:.40}, this version reads 1 and {SCHEMA}"
            raise ConstraintMismatchError(f"{problem}: load it with a newer manip_learn, or learn the constraint again")
        try:
            defaults = {"locked": dict(robot.locked), "objects": list(robot.objects)}  # for files without these entries
            identity = RobotIdentity.from_dict(defaults | content["robot"])
            other, same_joints = identity.mismatch(robot, "it"), identity.joint_names == robot.joint_names
            if other and (same_urdf or not same_joints):
                either = spoken(", or say same_urdf=False for another description with the same joints", "")
                raise ConstraintMismatchError(other + either * same_joints)
            normalised_json(content)
            features = described_features(content["features"], robot)
            constraint = Constraint(content["selection"], features, content.get("provenance"))
            _check_rows(content, constraint)
            digest = with_checksum(content)[SIGNATURE]
        except DAMAGE as error:
            raise damage_error(source, error) from error
        except ManipLearnError as error:
            raise ConstraintMismatchError(f"{source}: {error}") from error
        if content.get(SIGNATURE, digest) != digest:
            changed = f"{source} was changed after it was saved: its contents do not match its SHA-256"
            remedy = f'Learn it again or fetch the original; if the change is intended, delete the entry "{SIGNATURE}"'
            raise ConstraintMismatchError(f"{changed}. {remedy}")
        if SIGNATURE not in content:
            unsigned = f"{source} states no SHA-256 (a file of 0.1 or edited by hand); saving it again adds one"
            constraint.notes = (unsigned,)
            if spoken("in Python", ""):  # commands print the notes
                warnings.warn(unsigned, UserWarning, stacklevel=2)
        if identity.locked != robot.locked:
            constraint.notes += (f"when the constraint was made, {'; '.join(identity.differences(robot))}",)
        elif identity.locked:
            constraint.notes += (f"as when the constraint was made: {locks_in_words(identity.locked)}",)
        return constraint

    def __repr__(self) -> str:
        return f"Constraint({self.rows_in_words()} of {self.features!r})"

    def rows_in_words(self) -> str:
        """Return the constrained directions as text, e.g. `"(-0.42, 0.91, 0.00); z"`.

        They are a basis of the row space of Lambda in which each row involves as few features as possible.
        """
        return "; ".join(format_vector(row, self.features.row_names) for row in along_axes(self.selection))

    def _repr_html_(self) -> str:
        """Return Lambda as a table for notebooks."""
        rows = [[str(i + 1), *(f"{entry:.4f}" for entry in row)] for i, row in enumerate(self.selection)]
        return html_card.card(
            f"Constraint: {self.n_constraints} of {self.features.n_rows} rows",
            html_card.sentence(str(self.provenance.get("sentence", ""))),
            html_card.table(("row of Λ", *self.features.row_names), rows),
            html_card.sentence(repr(self.features)),
        )


def with_checksum(content: Mapping[str, Any]) -> dict[str, Any]:
    """Return the content of a constraint or skill file with its checksum.

    The checksum is the SHA-256 of features, selection, demonstrated motion and steps of the skill, and detects later
    changes of these. It does not cover entries that are only reported, such as the phases.

    Args:
        content: Content of the file, with or without a checksum.

    Returns:
        A copy with the checksum in the entry `SIGNATURE` (`"sha256"`).
    """
    motion = (content.get("provenance") or {}).get("shown")
    entries = (content.get("features"), content.get("selection"), motion, content.get("skill"))
    text = _text_of_02(entries) if content["schema"] == 1 else json.dumps(normalised_json(entries), sort_keys=True)
    return {**content, SIGNATURE: hashlib.sha256(text.encode()).hexdigest()}


def normalised_json(value: Any) -> Any:
    """Return a JSON value with every number as a float that is rounded to twelve digits.

    A checksum of the result is then the same after another program has rewritten the file.

    Args:
        value: JSON value: number, text, list or mapping, possibly nested.

    Returns:
        A copy of the value; mappings become dictionaries, lists and tuples become lists.

    Raises:
        ValueError: A number is not finite.
    """
    match value:
        case Mapping():
            return {key: normalised_json(inner) for key, inner in value.items()}
        case list() | tuple():
            return [normalised_json(inner) for inner in value]
        case int() | float() if not isinstance(value, bool):
            if not math.isfinite(value):
                raise ValueError(f"expected a finite number, got {value}")
            return float(f"{value:.12g}") + 0.0  # -0 is 0
    return value


def _text_of_02(value: Any) -> str:
    """Return the text whose SHA-256 is in files of schema 1; until 0.4."""
    match value:
        case Mapping():
            return "{" + ",".join(f"{key}:{_text_of_02(value[key])}" for key in sorted(value)) + "}"
        case list() | tuple():
            return "[" + ",".join(map(_text_of_02, value)) + "]"
        case int() | float() if not isinstance(value, bool):
            return format(float(value) + 0.0, ".12g")  # 12 of 16 digits; + 0.0 turns -0 into 0
    return repr(value)


def damage_error(source: str, error: BaseException) -> ConstraintMismatchError:
    """Return the error for a damaged file.

    Args:
        source: Name of the file.
        error: Exception raised while reading it.

    Returns:
        The error for the caller to raise; its message states the reason.
    """
    reason = f"it lacks {error}" if isinstance(error, KeyError) else reason_of(error)
    return ConstraintMismatchError(f"{source} is damaged: {reason}. Fetch the original, or learn it again")


def read_constraint_file(path: Path) -> dict[str, Any]:
    """Return the JSON document in a constraint file.

    Args:
        path: File, at most 100 MB.

    Returns:
        The document.

    Raises:
        ConstraintMismatchError: The file does not exist, cannot be read, or is not JSON.
    """
    try:
        # largest size [bytes], ten times the size of a constraint from a hundred thousand recordings
        return parsed_json(read_regular_file(path, 100_000_000))
    except OSError as error:
        reason = unreadable(error)[1]
    except ValueError as error:
        reason = f"not a constraint file, because it is not JSON ({reason_of(error)})"
    raise ConstraintMismatchError(f"{path}: {reason}; `manip-learn learn ... --out FILE` or save() writes a constraint")


def locks_in_words(locked: Mapping[str, float]) -> str:
    """Return locked joints as text.

    Args:
        locked: Joint name -> locked position [rad or m].

    Returns:
        For example `"right_j3 = 1.2 locked"`, or `"none locked"`.
    """
    return ", ".join(f"{name} = {value:.4g}" for name, value in locked.items()) + " locked" if locked else "none locked"


def _check_rows(content: Mapping[str, Any], constraint: Constraint) -> None:
    """Refuse rows that contradict the other entries of the file.

    Raises:
        ConstraintError: Rows, names, units, number or postures do not match.
    """
    rows, expected, postures = content["selection"], constraint.to_dict(), constraint.provenance.get("postures", [])
    if not all(type(x) in (int, float) for row in (*rows, *postures) for x in row):
        raise ConstraintError("an entry is not a number (true, false or text): the file is damaged")
    # the tolerance accepts rows written with ten digits
    if np.shape(rows) != constraint.selection.shape or np.max(np.abs(constraint.selection - rows)) > 1e-9:
        raise ConstraintError("the rows of Lambda are not orthonormal, as in every saved constraint")
    for what in ("row_names", "row_units", "n_constraints"):
        if (value := content.get(what, expected[what])) != expected[what]:
            problem = f"it states {what} {value}, but its rows and features give {expected[what]}"
            raise ConstraintError(f"{problem}: it is damaged")
    robot = constraint.robot
    if robot is not None and any(len(row) not in (robot.nq, robot.nv) for row in postures):
        raise ConstraintError(f"its recorded postures are not rows of {robot.nv} numbers: it is damaged")


def free_directions(selection: Float[np.ndarray, "s p"], used: Bool[np.ndarray, " p"]) -> Float[np.ndarray, "k p"]:
    """Return orthonormal combinations of feature rows that the constraint leaves free.

    Args:
        selection: Lambda (s, p) with orthonormal rows.
        used: shape (p,), True for the feature rows that the arm can move. The others get the coefficient 0.

    Returns:
        shape (k, p), one free direction per row. The basis is chosen so that each direction involves as few feature
        rows as possible; its largest entry is positive.
    """
    inner = null_basis(selection[:, used]).T
    out = np.zeros((len(inner), selection.shape[1]))
    if len(inner):
        out[:, used] = along_axes(inner)
    return out


def describe(
    kind: str,
    free: Float[np.ndarray, "k p"],
    features: FeatureMap,
    used: Bool[np.ndarray, " p"],
    uncertainty_deg: float | None,
    mechanism: Mechanism | None = None,
) -> str:
    """Describe a constraint in words: free and blocked motions, the mechanism, and the uncertainty.

    Args:
        kind: `"motion-constrained"` for a physical constraint, whose other directions are called blocked; with another
            kind they are called steered on purpose.
        free: Orthonormal free directions (k, p), see `free_directions`.
        features: Feature map Phi with p rows.
        used: shape (p,), True for the feature rows that the arm can move.
        uncertainty_deg: Uncertainty of the rows [deg]; None if unknown.
        mechanism: Mechanism that constrains the end effector; None if there is none.

    Returns:
        Text of one to three sentences.
    """
    names = [n for n, u in zip(features.row_names, used, strict=True) if u]
    blocked, ways = "blocked" if kind == "motion-constrained" else "steered on purpose", free[:, used]
    if features.twist is None:
        subject = "The motion" if features.own_axes is None else "The centre of mass"
    elif features.relative_to is not None:
        subject = f"Seen from {features.relative_to.name!r}, the tip"
    else:
        subject = "In its own axes, the tip" if features.own_axes else "The tip"
    if features.curve is not None:
        ends = " to ".join(format_vector(end) for end in features.curve.points[[0, -1]])
        freedom = f"can move along a curve of {features.curve.length:.2f} m from {ends} and cannot leave it"
    elif features.geometry is not None and mechanism is not None:
        axis, point = format_vector(mechanism.axis), format_vector(mechanism.point)
        radius = "" if mechanism.radius is None else f" of radius {mechanism.radius:.3f} m"
        place = {"axis": axis, "point": point, "axle": f"the axis {axis} through {point}", "radius": radius}
        freedom = f"can {SHAPES[mechanism.kind][1].format(**place)}"
    elif features.own_axes is None:
        lead = "" if not len(ways) else f"free along {listed(format_vector(row, names) for row in ways)} in "
        freedom = f"is {lead}({', '.join(names)}) and {blocked} in every other way" if lead else f"is {blocked}"
    else:
        twists = embed_rows(names, np.where(np.abs(ways) < NEGLIGIBLE_ENTRY, 0.0, ways))
        moves, turns = np.split(twists, 2, axis=1)
        if np.any(np.any(moves, axis=1) & np.any(turns, axis=1)):
            freedom = f"can {listed(map(_way, moves, turns))}, and is {blocked} in every other way"
        else:
            present = np.split(np.isin(AXES, names), 2)
            clauses = map(_clause, (_MOVE, _TURN), (moves, turns), present, (blocked, blocked))
            freedom = "; it ".join(filter(None, clauses))
    sentences, reference = [f"{subject} {freedom}."], getattr(features, "reference", None)
    is_stated = rows_state_place(mechanism, features.row_names, reference, free)
    if mechanism is not None:
        place = f", {mechanism.place}" if mechanism.place and not is_stated else ""
        turn = mechanism.grip == "kept" or (mechanism.orientation != "free" and not set(AXES[3:]) & set(names))
        other = not is_stated and mechanism.type in ("line", "plane") and reference == "world"
        it = "The path alone looks" if other and set(AXES[:3]) <= set(names) else "It looks"
        looks = SHAPES[mechanism.kind][0]
        sentences.append(f"{it} like {looks}{place}{f'; {mechanism.turns}' if turn else ''}.")
    if known_words := describe_uncertainty(uncertainty_deg, mechanism, is_stated):
        sentences.append(f"{known_words[0].upper()}{known_words[1:]}.")
    return " ".join(sentences)


def _way(move: Float[np.ndarray, " 3"], turn: Float[np.ndarray, " 3"]) -> str:
    """Return a free direction as text, with the proportion if it both moves and turns."""
    if np.any(move) and np.any(turn):
        return f"move along {format_vector(move)} while turning about {format_vector(turn)}"
    verb, axis = ("move along", move) if np.any(move) else ("turn about", turn)
    return f"{verb} {format_vector(axis, AXES[:3])}"


def rows_state_place(
    mechanism: Mechanism | None, names: Sequence[str], reference: str | None, free: Float[np.ndarray, "k p"]
) -> bool:
    """Return whether a sentence with the free directions already describes the mechanism's axis and position.

    Args:
        mechanism: Mechanism that constrains the end effector; None if there is none.
        names: Names of the p feature rows.
        reference: Axes of the feature rows, `"world"` or `"local"`; None for rows of the mechanism itself.
        free: Orthonormal free directions (k, p).

    Returns:
        True if the axis and position of the mechanism need not be repeated.
    """
    if mechanism is None or reference is None:
        return mechanism is not None
    moves = np.count_nonzero(np.any(embed_rows(names, free)[:, :3], axis=1))
    return reference == "world" and set(AXES[:3]) <= set(names) and moves == {"line": 1, "plane": 2}.get(mechanism.type)


def _clause(words: tuple[str, ...], rows: Float[np.ndarray, "k 3"], known: Bool[np.ndarray, " 3"], held: str) -> str:
    """Return the free and the held motions among the `known` rows as text; empty if none is known."""
    verb, preposition, everywhere, elsewhere = words
    free, n = [row for row in rows if np.any(row)], int(np.count_nonzero(known))
    ways = f"can {verb} {preposition} {listed(format_vector(v, AXES[:3]) for v in free)}" if free else ""
    if len(free) == n:
        return f"can {verb} freely" if n == 3 else ways
    where = {0: everywhere, 1: elsewhere}.get(len(free)) if n == 3 else None
    if where is None:
        rest = along_axes(null_basis(np.array([*free, *np.eye(3)[~known]])).T)
        where = f"{preposition} {listed(format_vector(v, AXES[:3]) for v in rest)}"
    if free:
        return f"{ways} and is {held} {where}"
    cannot = f"cannot {verb}" if n == 3 else f"cannot {verb} {where}"
    return cannot if held == "blocked" else f"is {held} {where}"
