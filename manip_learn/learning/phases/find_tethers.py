"""Stretches of whole recordings in which a frame keeps its distance from a fixed point, as on a tether."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from manip_learn.constraint.features.feature_map import FeatureMap
from manip_learn.constraint.features.frame_jacobian import FrameJacobian
from manip_learn.learning.evidence.row_evidence import CLEAR_STRENGTH
from manip_learn.learning.phases.confirmation import Confirm, confirmed_by_recombination
from manip_learn.learning.phases.discovery import PhaseDiscovery
from manip_learn.learning.phases.distance_rows import DistanceRows
from manip_learn.learning.phases.hypotheses import paired_hypotheses
from manip_learn.learning.phases.merging import merged
from manip_learn.learning.phases.motion import directions_used, velocity_noise
from manip_learn.learning.phases.result import PhaseResult
from manip_learn.learning.phases.unsupported import DIRECTIONS
from manip_learn.recordings.trajectory import Trajectory
from manip_learn.robot.batch.batch_kinematics import batch_kinematics

AXES = {"x", "y", "z"}


def clearly_confirmed(
    features: FeatureMap, stretches: Sequence[Trajectory], n_rows: int, rng: np.random.Generator
) -> tuple[bool, float, float]:
    """`confirmed_by_recombination` of rows that are clearly held while the joints move in many directions.

    One joint that turns alone keeps the frame at its distance from every point of the joint's axis, in all recordings:
    the strength is 1 to 6 there and 15 to 500 on a tether.
    """
    used = [directions_used(np.asarray(t.u), velocity_noise(t)) for t in stretches]
    if not used or np.median(used) < min(DIRECTIONS, features.nv - 1):
        return False, float("nan"), float("nan")
    confirmed, strength, p_value = confirmed_by_recombination(features, stretches, n_rows, rng)
    return confirmed and strength >= CLEAR_STRENGTH, strength, p_value


def find_tethers(
    features: Sequence[FeatureMap],
    trajectories: Sequence[Trajectory],
    rng: np.random.Generator,
    confirm: Confirm = clearly_confirmed,
) -> tuple[DistanceRows, PhaseResult] | None:
    """`find_phases` in the rows of a distance: a sphere has no constant row in the frame's own velocity.

    Args:
        features: Candidates for Phi; the first with the whole velocity of a frame says which frame.
        trajectories: Whole recordings with velocities.
        rng: For the comparison with chance.
        confirm: A second opinion on (features, stretches, number of rows, rng).

    Returns:
        The rows and what was found in them; None where the features have no frame's velocity.

    Raises:
        RecordingError: A trajectory lacks velocities.
    """
    frames = [f for f in features if isinstance(f, FrameJacobian) and set(f.row_names) >= AXES]
    if not frames:
        return None
    robot, frame = frames[0].robot, frames[0].frame
    few = np.concatenate([t.q[:: max(1, len(t) // 50)] for t in trajectories])
    rows = DistanceRows(robot, frame.name, batch_kinematics(robot, frame).pose(few)[:, :3, 3].mean(axis=0))
    search = PhaseDiscovery(rows, trajectories, rng, confirm, propose=paired_hypotheses, largest=1)
    return rows, merged(search.motion, [search.run()])
