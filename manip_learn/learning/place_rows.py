"""The mechanism of some recordings, and its rows that depend on the place, in the axes that were asked for."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool

from manip_learn.constraint.features.feature_map import FeatureMap
from manip_learn.constraint.features.frame_jacobian import FrameJacobian
from manip_learn.constraint.features.mechanism_rows import MechanismRows
from manip_learn.errors import NotIdentifiableError
from manip_learn.learning.evidence.recombination import recombination_test
from manip_learn.learning.evidence.row_evidence import RowEvidence
from manip_learn.learning.mechanisms.find_mechanism import MechanismFit, find_mechanism
from manip_learn.recordings.demonstrations import Demonstrations
from manip_learn.recordings.preprocessing import evenly
from manip_learn.recordings.trajectory import Trajectory

# trajectories beyond this number add nothing to a mechanism but time
MOST_PATHS = 16
# rows of Phi below this are ones that the arm cannot move
BLIND = 1e-6
# rows of a mechanism that concern the position of the frame alone, for features without rotations
POSITION_ROWS = {
    "hinge": ("radial", "axial"),
    "screw": ("radial", "helical"),
    "ball": ("spherical",),
    "other": ("radial",),
}


def mechanism_of(
    feature_maps: Sequence[FeatureMap],
    demonstrations: Demonstrations,
    rng: np.random.Generator,
    recorded: Sequence[Trajectory] | None = None,
) -> MechanismFit | None:
    """What the path of the features' frame says, where the features belong to a frame of a robot.

    `recorded`: the demonstrations before they were smoothed, if they were.
    """
    maps = [f for f in feature_maps if isinstance(f, FrameJacobian)]
    if not maps:
        return None
    n = len(demonstrations)
    chosen = evenly(n, MOST_PATHS).tolist()
    before = None if recorded is None else [recorded[i] for i in chosen]
    robot, frame = maps[0].robot, maps[0].frame.name
    try:
        found = find_mechanism(robot, frame, [demonstrations[i] for i in chosen], rng, recorded=before)
    except NotIdentifiableError:
        return None
    return dataclasses.replace(found, odd=tuple(chosen[i] for i in found.odd))


def all_held(features: MechanismRows, evidence: RowEvidence) -> bool:
    """Whether the recombination test, too, finds every row of the mechanism held."""
    return evidence.enough and evidence.n_rows == features.n_rows


def one_mechanism_fits(
    feature_maps: Sequence[FeatureMap], demonstrations: Demonstrations, rng: np.random.Generator
) -> bool:
    """Whether rows of a mechanism that depend on the place hold throughout all recordings."""
    found = mechanism_of(feature_maps, demonstrations, rng)
    features = place_rows(found, feature_maps, demonstrations)
    if found is None or found.odd or features is None:
        return False
    return all_held(features, recombination_test(features, demonstrations, rng))


def place_rows(
    found: MechanismFit | None, feature_maps: Sequence[FeatureMap], demonstrations: Demonstrations
) -> MechanismRows | None:
    """The rows of a mechanism that depend on the place, in the axes asked for and in which the arm can move.

    Rows across the axis about which alone the hand may turn are constant, but the path of the hand tells that axis
    better than its velocity does where the hand sways: what sways to and fro has a large rate and a small angle.
    """
    if found is None or found.mechanism is None or found.features is None:
        return None
    features = found.features if isinstance(found.features, MechanismRows) else _turning(found.features, found)
    if features is None:
        return None
    units = {unit for f in feature_maps for unit in f.row_units}
    names = tuple(n for n, unit in zip(features.row_names, features.row_units, strict=True) if unit in units)
    if units == {"m/s"}:
        names = POSITION_ROWS.get(found.mechanism.type, ())
    if names:
        movable = _movable(_only(features, names), demonstrations)
        names = tuple(n for n, moves in zip(names, movable, strict=True) if moves)
    return _only(features, names) if names else None


def _turning(features: FeatureMap, found: MechanismFit) -> MechanismRows | None:
    """The rows across the axis of a held orientation; None of anything else."""
    mechanism = found.mechanism
    if mechanism is None or mechanism.type != "held-orientation" or mechanism.axis is None:
        return None
    if not isinstance(features, FrameJacobian):
        return None
    return MechanismRows(features.robot, features.frame.name, ("turn-1", "turn-2"), axis=mechanism.axis)


def _only(features: MechanismRows, names: tuple[str, ...]) -> MechanismRows:
    place = features.geometry
    return MechanismRows(
        features.robot, features.frame.name, names, axis=place.axis, point=place.point, pitch=place.pitch
    )


def _movable(features: MechanismRows, demonstrations: Demonstrations) -> Bool[np.ndarray, " p"]:
    """Whether the arm can move the frame along each row, somewhere on the recordings."""
    few = np.concatenate([t.q[:: max(1, len(t) // 10)] for t in demonstrations])
    return np.max(np.linalg.norm(features.batch(few), axis=2), axis=0) > BLIND
