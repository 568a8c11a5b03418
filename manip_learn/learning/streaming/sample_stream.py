"""The trajectories of a source as samples: with the features' joints and with velocities."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import groupby, islice
from typing import final

from manip_learn.constraint.features.feature_map import FeatureMap
from manip_learn.errors import RecordingError
from manip_learn.learning.data_summary import check_joints
from manip_learn.learning.streaming.accumulator import Chunk, chunks
from manip_learn.recordings.demonstrations import Demonstrations
from manip_learn.recordings.preprocessing import evenly
from manip_learn.recordings.readers.option_uses import refuse_unmatched
from manip_learn.recordings.trajectory import Trajectory
from manip_learn.recordings.trajectory_source import TrajectorySource
from manip_learn.recordings.velocities import VelocityMethod, derive_together
from manip_learn.robot.robot import Robot

DERIVED = "velocities were derived from the positions"
TOGETHER = 16  # trajectories whose velocities are derived at a time
MOST_RECORDINGS = 64  # that stand for all: what holds in most of them holds in most of the others


@final
@dataclass(frozen=True)
class SampleStream:
    """How a source is read; picklable.

    Attributes:
        source: The trajectories.
        joint_names: Which each must have, in this order.
        robot: Derives missing velocities; None if there is none.
        velocities: How.
    """

    source: TrajectorySource
    joint_names: tuple[str, ...]
    robot: Robot | None
    velocities: VelocityMethod

    def alone(self, part: int) -> SampleStream:
        """How one part is read, without the others: what a worker is sent."""
        return dataclasses.replace(self, source=self.source.alone(part))

    def chunks(self, part: int, notes: list[str], number: int | None = None) -> Iterator[Chunk]:
        """The samples of a part.

        Args:
            part: Which part.
            notes: Sentences for the report are added here.
            number: What the chunks call the part; `part` by default.

        Raises:
            RecordingError: Joints of another robot, or velocities that can neither be found nor derived.
        """
        yield from chunks(self.trajectories(part, notes), part if number is None else number)

    def trajectories(self, part: int, notes: list[str]) -> Iterator[Trajectory]:
        """The trajectories of a part, with velocities.

        Raises:
            RecordingError: As for `chunks`.
        """
        derived = False
        for has_velocities, run in groupby(self._checked(part, notes), lambda t: t.u is not None):
            if has_velocities or self.robot is None:
                yield from run
                continue
            derived = True
            while some := list(islice(run, TOGETHER)):
                yield from derive_together(some, self.robot, self.velocities)
        if derived:
            notes.append(DERIVED)

    def _checked(self, part: int, notes: list[str]) -> Iterator[Trajectory]:
        """The trajectories of a part as they were recorded.

        Raises:
            RecordingError: As for `chunks`.
        """
        for trajectory in self.source.part(part, notes):
            _check_joints(trajectory, self.joint_names, self.robot)
            if trajectory.u is None and self.robot is None:
                raise RecordingError(
                    f"{trajectory.name} has no velocities: give features of a robot to derive them with",
                    code="no-velocities",
                )
            yield trajectory


def open_stream(source: TrajectorySource, features: Sequence[FeatureMap], velocities: VelocityMethod) -> SampleStream:
    """The samples of a source, for some features.

    Raises:
        RecordingError: The source is empty or belongs to another robot.
    """
    robot = getattr(features[0], "robot", None)
    for part in range(source.n_parts):
        for first in source.part(part):
            names = first.joint_names if robot is None else tuple(robot.joint_names)
            if len(names) != features[0].nv:
                raise RecordingError(
                    f"{first.name} has {len(names)} joint velocities, the features act on {features[0].nv}",
                    code="shape",
                )
            return SampleStream(source, names, robot, velocities)
    raise RecordingError("there are no demonstrations: give at least one trajectory", code="empty")


def representative(stream: SampleStream, most: int) -> tuple[Demonstrations, bool]:
    """Whole recordings that stand for all, evenly chosen, and whether they are all there are.

    Args:
        stream: The recordings.
        most: Number of samples that they may have together.

    Raises:
        RecordingError: As for `SampleStream.chunks`; or a setting that no part has a use for.
    """
    parts, notes = evenly(stream.source.n_parts, MOST_RECORDINGS).tolist(), list[str]()
    taken, complete = list[Trajectory](), len(parts) == stream.source.n_parts
    for part in parts:
        made = list(stream.trajectories(part, notes))
        longest = max((len(t) for t in made), default=1)
        each = max(1, min(MOST_RECORDINGS, most // longest) // len(parts))
        fits = sum(len(t) for t in [*taken, *made]) <= most and complete
        chosen = made if fits else [made[i] for i in evenly(len(made), each)]
        complete &= len(chosen) == len(made)
        taken += chosen
    kept = refuse_unmatched(notes, len(parts)) if len(parts) == stream.source.n_parts else notes
    return Demonstrations(taken, tuple(dict.fromkeys(kept))), complete


def _check_joints(trajectory: Trajectory, names: tuple[str, ...], robot: Robot | None) -> None:
    check_joints(trajectory.joint_names, robot)
    if trajectory.joint_names != names:
        raise RecordingError(
            f"{trajectory.name} has the joints {trajectory.joint_names}, others have {names}: all trajectories must "
            "name the same joints in the same order",
            code="joint-names",
        )
