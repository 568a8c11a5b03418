"""A task constraint A(q) = Lambda Phi(q): learnt or written by hand, the same type."""

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
    as_learnt,
    in_words,
    known_to,
    on_twist,
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
SCHEMA = 2  # number of the format that `save` writes; 1 is that of 0.2
SIGNATURE = "sha256"  # entry of a file: the SHA-256 of what says where an arm goes
# vector-Jacobian product of A(q): weights (s, nv) -> sum_ij weights_ij dA_ij / dq_k
Vjp = Callable[[Float[np.ndarray, "s nv"]], Float[np.ndarray, " nv"]]
# of linear and of angular rows: verb, preposition, all directions in words, and all but one
_MOVE = ("move", "along", "in every direction", "across it")
_TURN = ("turn", "about", "about every axis", "about every other axis")


@final
class Constraint:
    """A(q) = Lambda Phi(q), equation (1) of Manavalan and Howard, "Learning Singularity Avoidance".

    Only the row space of Lambda means anything, so its rows are made orthonormal; that also fixes the scale of the
    manipulability in the features' units.

    Args:
        selection: Lambda, shape (s, p); zero rows are dropped, the others must be independent.
        features: Phi.
        provenance: How it was learnt; saved with it.

    Attributes:
        selection: Lambda, its rows orthonormal.
        features: Phi.
        n_constraints: Number of rows s.
        nv: Number of velocities that A acts on.
        robot: The robot that the features belong to; None for those of a system without one.
        notes: What loading it from a file had to say, in sentences: joints that were locked, or are locked elsewhere.

    Raises:
        ConstraintError: Wrong size, not finite, no row left, dependent rows, or arguments in another order.

    Example:
        >>> import manip_learn as ml
        >>> features = ml.FrameJacobian(ml.load_robot("planar3"), "tip", axes="x y")
        >>> constraint = ml.Constraint([[0, 1]], features)  # by hand: y is held, x is free
        >>> constraint([0.3, 0.8, 0.4]).round(2)  # A(q), one row per held direction
        array([[1.48, 0.52, 0.07]])
    """

    def __init__(self, selection: ArrayLike, features: FeatureMap, provenance: Mapping[str, Any] | None = None):
        if not isinstance(features, FeatureMap):
            given = f"{an(selection)} and {an(features)}"
            raise ConstraintError(f"call Constraint(selection, features): got {given}, in this order")
        try:
            matrix = np.atleast_2d(np.array(selection, dtype=np.float64))
        except (TypeError, ValueError, OverflowError) as error:
            raise ConstraintError(f"the selection matrix must be numbers in rows of equal length: {error}") from error
        p = features.n_rows
        if matrix.ndim != 2 or matrix.shape[1] != p:
            wanted = f"{p} columns, one a feature row ({', '.join(features.row_names)})"
            raise ConstraintError(f"the selection matrix must have {wanted}; got shape {matrix.shape}")
        if not np.all(np.isfinite(matrix)):
            raise ConstraintError("the selection matrix has entries that are not finite")
        matrix = matrix[np.linalg.norm(matrix, axis=1) > 0.0]
        if len(matrix) == 0:
            raise ConstraintError("the selection matrix has no row that is not zero")
        unit = matrix / np.linalg.norm(matrix, axis=1, keepdims=True)
        smallest = np.linalg.svd(unit, compute_uv=False)[-1] if len(unit) <= p else 0.0
        if smallest < 1e-10:
            depend = f"depend on each other (smallest singular value {smallest:.1e})"
            remedy = "leave out the rows that follow from the others"
            raise ConstraintError(f"the rows of the selection matrix {depend}: {remedy}")
        # orthonormal rows are kept to the last bit: paper-mode truncation depends on it
        is_exact = np.max(np.abs(matrix @ matrix.T - np.eye(len(matrix)))) < 1e-14
        self.selection: Float[np.ndarray, "s p"] = matrix if is_exact else orthonormal_rows(matrix)
        self.selection.setflags(write=False)
        self.features, self.n_constraints, self.nv = features, len(matrix), features.nv
        self.robot: Robot | None = features.robot
        self.provenance: dict[str, Any] = dict(provenance or {})
        self.notes: tuple[str, ...] = ()

    @property
    def mechanism(self) -> Mechanism | None:
        """What holds the hand, read from Lambda; None where nothing does (b varies) or it is nothing that has a name.

        Place, radius and uncertainty are those that the learner found, if this constraint was learnt.
        """
        if self.provenance.get("kind") == "self-imposed":
            return None
        read = self.features.mechanism(self.selection, self.provenance)
        return None if read is None else as_learnt(read, self.provenance)

    @property
    def shown(self) -> Shown | None:
        """What the recordings did along the directions that are free; None if it was not learnt from any."""
        return Shown.from_dict(self.provenance.get("shown"))

    @property
    def intention(self) -> Intention | None:
        """Where the rows were moved to by a demonstrator who moved them on purpose (b unknown); None of others."""
        return Intention.from_dict(self.provenance.get("intention"))

    def task_frame(self, q: ArrayLike) -> TaskFrame:
        """Return the frame along whose axes this constraint leaves the hand free or holds it, at a posture.

        What force and impedance controllers ask for; `manip-learn export --to urscript` and others write it for them.

        Args:
            q: Posture.

        Returns:
            The frame.

        Raises:
            ConstraintError: Features that are no rows of one frame's twist.
            ConfigurationError: q has the wrong size or is not finite.
        """
        return task_frame(self, q)

    def about_its_mechanism(self) -> Constraint:
        """Return these rows, named after the mechanism: `MechanismRows`, or a frame's, in the place of `PlaceRows`.

        The constraint itself where its features are others, or hold no mechanism that has a name.
        """
        features, selection = self.features.named(self.selection, self.mechanism)
        return self if features is self.features else Constraint(selection, features, self.provenance)

    def with_orientation(self) -> Constraint:
        """Return these rows, and below them those that hold the orientation of the frame too, as far as these do not.

        Raises:
            ConstraintError: Features without a frame that could turn.
        """
        named = self.about_its_mechanism()
        features, selection = named.features.with_rotation(named.selection)
        return Constraint(selection, features, self.provenance)

    def showing(self, shown: Shown) -> Constraint:
        """Return the same rows, with something else shown along what they leave free."""
        return Constraint(self.selection, self.features, self.provenance | {"shown": shown.to_dict()})

    def moved(self, transform: Float[np.ndarray, "4 4"]) -> Constraint:
        """Return what holds the hand where it stands elsewhere, p' = R p + t in the base's frame.

        Rows in the hand's own axes move with these, and rows relative to another frame stay as they are.

        Args:
            transform: shape (4, 4), a rigid motion [m].
        """
        if self.features.relative_to is not None:
            return self
        provenance = {k: v for k, v in self.provenance.items() if not k.startswith("posture")}
        for name, known in (("mechanism", self.mechanism), ("shown", self.shown)):
            if known is not None:
                provenance[name] = known.moved(transform).to_dict()
        named = self.about_its_mechanism()
        features, selection = named.features.moved(transform, named.selection)
        return Constraint(selection, features, provenance)

    def __call__(self, q: ArrayLike) -> Float[np.ndarray, "s nv"]:
        """Return A(q).

        Raises:
            ConfigurationError: q has the wrong size or is not finite.
        """
        return self.selection.dot(self.features(q))

    def manipulability(self, q: ArrayLike) -> float:
        """Return mu(q) = sqrt(det(A A^T)), as `manip_learn.manipulability(constraint, q)`.

        Raises:
            ConfigurationError: q has the wrong size or is not finite.
        """
        return manipulability_of(self(q))

    def derivative(self, q: ArrayLike) -> Float[np.ndarray, "s nv nv"]:
        """Return dA/dq; entry [i, j, k] = d A_ij / d q_k along tangent coordinate k."""
        return self.value_and_derivative(q)[1]

    def value_and_derivative(self, q: ArrayLike) -> tuple[Float[np.ndarray, "s nv"], Float[np.ndarray, "s nv nv"]]:
        """Return A(q) and dA/dq, sharing the work."""
        Phi, dPhi = self.features.value_and_derivative(q)
        dA = self.selection @ dPhi.reshape(dPhi.shape[0], -1)
        return self.selection @ Phi, dA.reshape(-1, *dPhi.shape[1:])

    def value_and_vjp(self, q: ArrayLike) -> tuple[Float[np.ndarray, "s nv"], Vjp]:
        """Return A(q) and its vector-Jacobian product, weights (s, nv) -> sum_ij weights_ij dA_ij / dq_k."""
        A, dA = self.value_and_derivative(q)
        flat = dA.reshape(-1, self.nv)
        return A, lambda weights: weights.reshape(-1).dot(flat)

    def residual(self, demonstrations: Iterable[Trajectory]) -> float:
        """Return the fraction of the motion that breaks A(q) u = 0: sqrt(sum |A^+ A u|^2 / sum |u|^2), 0 to 1.

        Only says something for motion-constrained recordings (b = 0).

        Raises:
            ConstraintError: A trajectory has no velocities, or nothing moves.
        """
        broken = total = 0.0
        for trajectory in demonstrations:
            if trajectory.u is None or not np.all(np.isfinite(trajectory.u)):
                raise ConstraintError(f"{trajectory.name} has no velocities: derive them first (derive_velocities)")
            A, u = self.selection @ self.features.batch(trajectory.q), trajectory.u[:, :, None]
            broken += float(np.sum((np.linalg.pinv(A) @ (A @ u)) ** 2))
            total += float(np.sum(u**2))
        if total == 0.0:
            raise ConstraintError("nothing moves in these demonstrations: there is no residual")
        return float(np.sqrt(broken / total))

    # ---- files ----------------------------------------------------------------------------------------------------

    def to_dict(self) -> dict[str, Any]:
        """Return the content of a constraint file.

        Raises:
            FeatureError: The features are Python functions and cannot be written down.
        """
        described = None
        if self.robot is not None:
            described = RobotIdentity.of(self.robot).to_dict() | {"nv": self.robot.nv}
            del described["source"]  # a path of this machine
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
        return signed(content)

    def save(self, path: str | Path) -> Path:
        """Write a JSON file, whole or not at all.

        Raises:
            OutputError: It cannot be written.
            FeatureError: The features are Python functions and cannot be written down.
        """
        return write_atomically(path, json.dumps(self.to_dict(), indent=2, allow_nan=False) + "\n")

    @staticmethod
    def load(path: str | Path, robot: Robot, *, same_urdf: bool = True) -> Constraint:
        """Read a constraint file for the robot that it was made for.

        Args:
            path: JSON file written by `save`.
            robot: The robot, loaded with the same locked joints.
            same_urdf: Insist on the very same URDF, with joints locked at the same positions. False accepts another
                version of the file with the same joints, e.g. after a change of its visuals; whether its kinematics
                are the same is then yours to know, and `notes` of the constraint say which joints are locked elsewhere.

        Raises:
            ConstraintMismatchError: Another robot, a newer schema, no constraint file at all, a number that is not
                finite, rows that contradict what the file says of them (their number, names, units, or that they are
                orthonormal), or a file that was changed after it was saved.

        Warns:
            UserWarning: The file states no SHA-256, by which a change would be noticed.
        """
        return Constraint.from_dict(read_constraint_file(Path(path)), robot, source=str(path), same_urdf=same_urdf)

    @staticmethod
    def from_dict(
        content: Mapping[str, Any], robot: Robot, *, source: str = "the constraint", same_urdf: bool = True
    ) -> Constraint:
        """Return what `to_dict` wrote, for its robot; errors call it `source`, the rest is as for `load`.

        Raises:
            ConstraintMismatchError: Another robot, another schema, or no constraint at all.
        """
        if not isinstance(content, Mapping) or content.get("format") != _FORMAT:
            raise ConstraintMismatchError(f'{source} is not a constraint file: it lacks "format": "{_FORMAT}"')
        if content.get("schema") not in (1, SCHEMA):
            seen = f"{source} has schema {content.get('schema')!r:.40}, this version reads 1 and {SCHEMA}"
            raise ConstraintMismatchError(f"{seen}: load it with a newer manip_learn, or learn the constraint again")
        try:
            here = {"locked": dict(robot.locked), "objects": list(robot.objects)}  # of files that do not say
            made = RobotIdentity.from_dict(here | content["robot"])
            other, same_joints = made.mismatch(robot, "it"), made.joint_names == robot.joint_names
            if other and (same_urdf or not same_joints):
                either = spoken(", or say same_urdf=False for another description with the same joints", "")
                raise ConstraintMismatchError(other + either * same_joints)
            normal(content)
            features = described_features(content["features"], robot)
            constraint = Constraint(content["selection"], features, content.get("provenance"))
            _check_rows(content, constraint)
            digest = signed(content)[SIGNATURE]
        except DAMAGE as error:
            raise damaged(source, error) from error
        except ManipLearnError as error:
            raise ConstraintMismatchError(f"{source}: {error}") from error
        if content.get(SIGNATURE, digest) != digest:
            changed = f"{source} was changed after it was saved: its contents do not have the SHA-256 that it states"
            remedy = f'Learn it again or fetch the original; if the change is meant, delete the entry "{SIGNATURE}"'
            raise ConstraintMismatchError(f"{changed}. {remedy}")
        if SIGNATURE not in content:
            unsigned = f"{source} states no SHA-256, as a file of 0.1 or one changed by hand; saved again, it does"
            constraint.notes = (unsigned,)
            if spoken("in Python", ""):  # commands print the notes
                warnings.warn(unsigned, UserWarning, stacklevel=2)
        if made.locked != robot.locked:
            constraint.notes += (f"when the constraint was made, {'; '.join(made.differences(robot))}",)
        elif made.locked:
            constraint.notes += (f"as when the constraint was made: {locks_in_words(made.locked)}",)
        return constraint

    def __repr__(self) -> str:
        return f"Constraint({self.rows_in_words()} of {self.features!r})"

    def rows_in_words(self) -> str:
        """Return the held rows, turned towards single axes: `"(-0.42, 0.91, 0.00); z"`; their space is Lambda's."""
        return "; ".join(in_words(row, self.features.row_names) for row in along_axes(self.selection))

    def _repr_html_(self) -> str:
        rows = [[str(i + 1), *(f"{entry:.4f}" for entry in row)] for i, row in enumerate(self.selection)]
        return html_card.card(
            f"Constraint: {self.n_constraints} of {self.features.n_rows} rows",
            html_card.sentence(str(self.provenance.get("sentence", ""))),
            html_card.table(("row of Λ", *self.features.row_names), rows),
            html_card.sentence(repr(self.features)),
        )


def signed(content: Mapping[str, Any]) -> dict[str, Any]:
    """Return the content of a constraint file with the SHA-256 of its rows, of what was shown, and of a skill's steps.

    A later change of these is noticed; one of what is only reported, such as the phases, does not count.
    """
    shown = (content.get("provenance") or {}).get("shown")
    moving = (content.get("features"), content.get("selection"), shown, content.get("skill"))
    text = _text_of_02(moving) if content["schema"] == 1 else json.dumps(normal(moving), sort_keys=True)
    return {**content, SIGNATURE: hashlib.sha256(text.encode()).hexdigest()}


def normal(value: Any) -> Any:
    """Return JSON with every number as a float of twelve digits: as good when another program has written it again.

    Raises:
        ValueError: A number that is not finite.
    """
    match value:
        case Mapping():
            return {key: normal(inner) for key, inner in value.items()}
        case list() | tuple():
            return [normal(inner) for inner in value]
        case int() | float() if not isinstance(value, bool):
            if not math.isfinite(value):
                raise ValueError(f"{value} stands in the place of a finite number")
            return float(f"{value:.12g}") + 0.0  # -0 is 0
    return value


def _text_of_02(value: Any) -> str:
    """Return the text of which files of schema 1 state the SHA-256; until 0.4."""
    match value:
        case Mapping():
            return "{" + ",".join(f"{key}:{_text_of_02(value[key])}" for key in sorted(value)) + "}"
        case list() | tuple():
            return "[" + ",".join(map(_text_of_02, value)) + "]"
        case int() | float() if not isinstance(value, bool):
            return format(float(value) + 0.0, ".12g")  # of 16 digits; + 0.0, for -0 is 0
    return repr(value)


def damaged(source: str, error: BaseException) -> ConstraintMismatchError:
    """Return the refusal of a file whose reading raised an error."""
    said = f"it lacks {error}" if isinstance(error, KeyError) else reason_of(error)
    return ConstraintMismatchError(f"{source} is damaged: {said}. Fetch the original, or learn it again")


def read_constraint_file(path: Path) -> dict[str, Any]:
    """Return the JSON document in a constraint file.

    Raises:
        ConstraintMismatchError: There is no such file, it is none that may be read, or it is no JSON.
    """
    try:
        # [bytes]: a constraint of a hundred thousand recordings has a tenth of it
        return parsed_json(read_regular_file(path, 100_000_000))
    except OSError as error:
        said = unreadable(error)[1]
    except ValueError as error:
        said = f"it is not a constraint file, it is not JSON ({reason_of(error)})"
    raise ConstraintMismatchError(f"{path}: {said}; `manip-learn learn ... --out FILE` or save() writes a constraint")


def locks_in_words(locked: Mapping[str, float]) -> str:
    """Return joints with the positions that they are locked at."""
    return ", ".join(f"{name} = {value:.4g}" for name, value in locked.items()) + " locked" if locked else "none locked"


def _check_rows(content: Mapping[str, Any], constraint: Constraint) -> None:
    """Refuse rows that contradict what the file says of them.

    Raises:
        ConstraintError: They do.
    """
    rows, own, saved = content["selection"], constraint.to_dict(), constraint.provenance.get("postures", [])
    if not all(type(x) in (int, float) for row in (*rows, *saved) for x in row):
        raise ConstraintError("something stands in the place of a number (true, false or text): it is damaged")
    # rows written with ten digits are taken
    if np.shape(rows) != constraint.selection.shape or np.max(np.abs(constraint.selection - rows)) > 1e-9:
        raise ConstraintError("the rows of Lambda are not orthonormal, as those of every saved constraint are")
    for what in ("row_names", "row_units", "n_constraints"):
        if (given := content.get(what, own[what])) != own[what]:
            raise ConstraintError(f"it states {what} {given}, its rows and features {own[what]}: it is damaged")
    robot = constraint.robot
    if robot is not None and any(len(row) not in (robot.nq, robot.nv) for row in saved):
        raise ConstraintError(f"the postures in which it was shown are not rows of {robot.nv} numbers: it is damaged")


def free_directions(selection: Float[np.ndarray, "s p"], used: Bool[np.ndarray, " p"]) -> Float[np.ndarray, "k p"]:
    """Orthonormal rows that the constraint leaves free, among the feature rows that can move at all.

    Each points so that its largest entry is positive; several are turned so that they share as few rows as possible.
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
    """Return what can move and what is blocked; what it looks like; how sure it is: up to three sentences."""
    names = [n for n, u in zip(features.row_names, used, strict=True) if u]
    held, ways = "blocked" if kind == "motion-constrained" else "steered on purpose", free[:, used]
    if features.twist is None:
        subject = "The motion" if features.own_axes is None else "The centre of mass"
    elif features.relative_to is not None:
        subject = f"Seen from {features.relative_to.name!r}, the tip"
    else:
        subject = "In its own axes, the tip" if features.own_axes else "The tip"
    if features.curve is not None:
        ends = " to ".join(in_words(end) for end in features.curve.points[[0, -1]])
        freedom = f"can move along a curve of {features.curve.length:.2f} m from {ends} and cannot leave it"
    elif features.geometry is not None and mechanism is not None:
        axis, point = in_words(mechanism.axis), in_words(mechanism.point)
        radius = "" if mechanism.radius is None else f" of radius {mechanism.radius:.3f} m"
        place = {"axis": axis, "point": point, "axle": f"the axis {axis} through {point}", "radius": radius}
        freedom = f"can {SHAPES[mechanism.kind][1].format(**place)}"
    elif features.own_axes is None:
        said = "" if not len(ways) else f"free along {listed(in_words(row, names) for row in ways)} in "
        freedom = f"is {said}({', '.join(names)}) and {held} in every other way" if said else f"is {held}"
    else:
        twists = on_twist(names, np.where(np.abs(ways) < NEGLIGIBLE_ENTRY, 0.0, ways))
        moves, turns = np.split(twists, 2, axis=1)
        if np.any(np.any(moves, axis=1) & np.any(turns, axis=1)):
            freedom = f"can {listed(map(_way, moves, turns))}, and is {held} in every other way"
        else:
            known = np.split(np.isin(AXES, names), 2)
            freedom = "; it ".join(filter(None, map(_clause, (_MOVE, _TURN), (moves, turns), known, (held, held))))
    sentences, reference = [f"{subject} {freedom}."], getattr(features, "reference", None)
    told = said_by_rows(mechanism, features.row_names, reference, free)
    if mechanism is not None:
        place = f", {mechanism.place}" if mechanism.place and not told else ""
        turn = mechanism.grip == "kept" or (mechanism.orientation != "free" and not set(AXES[3:]) & set(names))
        other = not told and mechanism.type in ("line", "plane") and reference == "world"
        it = "The path alone looks" if other and set(AXES[:3]) <= set(names) else "It looks"
        looks = SHAPES[mechanism.kind][0]
        sentences.append(f"{it} like {looks}{place}{f'; {mechanism.turns}' if turn else ''}.")
    if known_words := known_to(uncertainty_deg, mechanism, told):
        sentences.append(f"{known_words[0].upper()}{known_words[1:]}.")
    return " ".join(sentences)


def _way(move: Float[np.ndarray, " 3"], turn: Float[np.ndarray, " 3"]) -> str:
    """Return a free direction in words, with the proportion where it is both."""
    if np.any(move) and np.any(turn):
        return f"move along {in_words(move)} while turning about {in_words(turn)}"
    return f"move along {in_words(move, AXES[:3])}" if np.any(move) else f"turn about {in_words(turn, AXES[:3])}"


def said_by_rows(
    mechanism: Mechanism | None, names: Sequence[str], reference: str | None, free: Float[np.ndarray, "k p"]
) -> bool:
    """Return whether what the rows leave free says already where the mechanism is.

    Args:
        mechanism: What holds the hand.
        names: Names of the feature rows.
        reference: Their frame, `"world"` or `"local"`; None for rows of the mechanism itself.
        free: What they leave free.
    """
    if mechanism is None or reference is None:
        return mechanism is not None
    moves = np.count_nonzero(np.any(on_twist(names, free)[:, :3], axis=1))
    return reference == "world" and set(AXES[:3]) <= set(names) and moves == {"line": 1, "plane": 2}.get(mechanism.type)


def _clause(words: tuple[str, ...], rows: Float[np.ndarray, "k 3"], known: Bool[np.ndarray, " 3"], held: str) -> str:
    """Return what can move or turn, and what of the rows that are `known` is held; empty if none is."""
    verb, preposition, everywhere, elsewhere = words
    free, n = [row for row in rows if np.any(row)], int(np.count_nonzero(known))
    ways = f"can {verb} {preposition} {listed(in_words(v, AXES[:3]) for v in free)}" if free else ""
    if len(free) == n:
        return f"can {verb} freely" if n == 3 else ways
    where = {0: everywhere, 1: elsewhere}.get(len(free)) if n == 3 else None
    if where is None:
        rest = along_axes(null_basis(np.array([*free, *np.eye(3)[~known]])).T)
        where = f"{preposition} {listed(in_words(v, AXES[:3]) for v in rest)}"
    if free:
        return f"{ways} and is {held} {where}"
    cannot = f"cannot {verb}" if n == 3 else f"cannot {verb} {where}"
    return cannot if held == "blocked" else f"is {held} {where}"
