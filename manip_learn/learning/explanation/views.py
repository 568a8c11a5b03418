"""The recordings seen in several feature maps: those asked for, and those in which every mechanism is constant."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import final

import numpy as np
from jaxtyping import Float

from manip_learn.constraint.features.feature_map import FeatureMap
from manip_learn.constraint.features.frame_jacobian import AXES, FrameJacobian
from manip_learn.constraint.features.place_rows import PlaceForm, PlaceRows
from manip_learn.learning.explanation.row_motion import RowMotion, velocity_noise
from manip_learn.linalg import null_basis
from manip_learn.recordings.trajectory import Trajectory
from manip_learn.robot.batch.batch_kinematics import batch_kinematics

# postures of each recording whose mean place becomes the middle of the rows: it conditions the numbers only
FEW = 50


@final
@dataclass(frozen=True, eq=False)
class View:
    """The recordings in one feature map.

    Attributes:
        features: Phi.
        motion: All samples.
        thin: Evenly chosen ones, on which hypotheses are scored.
        largest: Largest number of rows that leave the features something free.
    """

    features: FeatureMap
    motion: RowMotion
    thin: RowMotion
    largest: int

    @property
    def immovable(self) -> Float[np.ndarray, "k p"]:
        """Rows of the features that the arm cannot move, orthonormal."""
        return null_basis(np.linalg.svd(self.motion.whitening, full_matrices=False)[2]).T


def views_of(feature_maps: Sequence[FeatureMap], trajectories: Sequence[Trajectory]) -> list[View]:
    """The recordings in each feature map.

    Raises:
        RecordingError: A trajectory lacks velocities.
        NotIdentifiableError: Every row of a map is zero throughout.
    """
    noise = [velocity_noise(t) for t in trajectories]
    motions = [(f, RowMotion.collect(f, trajectories, noise)) for f in feature_maps]
    views = [View(f, motion, motion.thinned(), min(motion.rank, f.nv) - 1) for f, motion in motions]
    return [v for v in views if v.largest > 0]


def mechanism_features(feature_maps: Sequence[FeatureMap], trajectories: Sequence[Trajectory]) -> list[PlaceRows]:
    """The rows in which mechanisms that hold the frame asked for are constant; none where its velocity is not whole."""
    frames = [f for f in feature_maps if isinstance(f, FrameJacobian) and set(f.row_names) >= set(AXES[:3])]
    if not frames:
        return []
    robot, frame = frames[0].robot, frames[0].frame
    few = np.concatenate([t.q[:: max(1, len(t) // FEW)] for t in trajectories])
    middle = batch_kinematics(robot, frame).pose(few)[:, :3, 3].mean(axis=0)
    whole = set(frames[0].row_names) == set(AXES)
    forms: tuple[PlaceForm, ...] = ("point and rotation", "twist") if whole else ("point",)
    return [PlaceRows(robot, frame.name, form, middle) for form in forms]
