"""What all samples of the demonstrations have in common, and those that are learnt from directly."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import cast, final

import numpy as np
from jaxtyping import Float, Int

from manip_learn.constraint.features.feature_map import FeatureMap
from manip_learn.errors import RecordingError
from manip_learn.recordings.demonstrations import Demonstrations
from manip_learn.recordings.given_motions import Motion, demonstrations_of
from manip_learn.recordings.trajectory_source import TrajectorySource
from manip_learn.robot.robot import Robot

# up to this many samples are learnt from directly; of more, this many are chosen, and all of them refine the answer.
# Phi of so many samples of 6 rows and 7 joints takes 5.5 MB, four blocks of `samples.BLOCK`
IN_MEMORY_SAMPLES = 16_384


@final
@dataclass(frozen=True, eq=False)
class DataSummary:
    """Numbers of all samples, and the samples to learn from: all of them in memory, an even choice of more.

    Attributes:
        n_samples: Number of all samples.
        n_trajectories: Number of all trajectories.
        low, high: Smallest and largest posture of all samples, entry by entry, shape (m,) [rad or m].
        squares: sum u^2 of each joint over all samples, shape (nv,) [(rad/s)^2].
        fastest: The velocity with the largest norm, shape (nv,) [rad/s].
        fastest_at: Its sample and trajectory, counted from 0.
        q, u: The samples to learn from, in order, shapes (k, m) [rad or m] and (k, nv) [rad/s].
        trajectory: Trajectory of each of these, counted from 0, never decreasing, shape (k,).
        notes: What was done to the recordings.
    """

    n_samples: int
    n_trajectories: int
    low: Float[np.ndarray, " m"]
    high: Float[np.ndarray, " m"]
    squares: Float[np.ndarray, " nv"]
    fastest: Float[np.ndarray, " nv"]
    fastest_at: tuple[int, int]
    q: Float[np.ndarray, "k m"]
    u: Float[np.ndarray, "k nv"]
    trajectory: Int[np.ndarray, " k"]
    notes: tuple[str, ...] = ()

    @staticmethod
    def of(demonstrations: Demonstrations) -> DataSummary:
        """Summary of demonstrations in memory; every sample is learnt from.

        Raises:
            RecordingError: A trajectory lacks velocities, or has postures of another size.
        """
        for t in demonstrations:
            if t.u is None:
                raise RecordingError(f"{t.name} has no velocities: derive them first", code="no-velocities")
        widths = sorted({t.q.shape[1] for t in demonstrations})
        if len(widths) > 1:
            raise RecordingError(f"postures must all have the same number of values, got {widths}", code="shape")
        q = np.concatenate([t.q for t in demonstrations])
        u = np.concatenate([t.u for t in demonstrations])  # type: ignore[misc]
        trajectory = np.repeat(np.arange(len(demonstrations)), [len(t) for t in demonstrations])
        fastest = int(np.argmax(np.einsum("nv,nv->n", u, u)))
        return DataSummary(
            len(u),
            len(demonstrations),
            q.min(axis=0),
            q.max(axis=0),
            np.einsum("nv,nv->v", u, u),
            u[fastest],
            (fastest, int(trajectory[fastest])),
            q,
            u,
            trajectory,
            demonstrations.notes,
        )


def check_joints(joint_names: tuple[str, ...], robot: Robot | None) -> None:
    """Refuse demonstrations of another robot than that of the features.

    Raises:
        RecordingError: The joint names differ, or their order does.
    """
    if robot is not None and tuple(joint_names) != tuple(robot.joint_names):
        raise RecordingError(
            f"the demonstrations have the joints {', '.join(joint_names)}; robot {robot.name!r} has "
            f"{', '.join(robot.joint_names)}: load them with load_demonstrations(files, robot), which sorts by name",
            code="joint-names",
        )


def in_memory(
    demonstrations: TrajectorySource | Motion | Iterable[Motion], feature_maps: Sequence[FeatureMap]
) -> Demonstrations | TrajectorySource | Iterable[Motion]:
    """Demonstrations in memory with the joints of the features; a stream as it is.

    Raises:
        RecordingError: The joints are those of another robot.
    """
    robot = getattr(feature_maps[0], "robot", None)
    demos = None if isinstance(demonstrations, TrajectorySource) else demonstrations_of(demonstrations, robot)
    if demos is None:
        return cast("TrajectorySource | Iterable[Motion]", demonstrations)
    if not demos.joint_names:
        names = tuple(f"q{i}" for i in range(feature_maps[0].nv)) if robot is None else robot.joint_names
        demos = demos.with_joint_names(names)
    for features in feature_maps:
        check_joints(demos.joint_names, getattr(features, "robot", None))
    return demos
