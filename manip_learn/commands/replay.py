"""`manip-learn replay`: rollout files -> one HTML file."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from manip_learn.commands.named_motions import NamedMotions, named_motions
from manip_learn.commands.robot_loading import load_for_files, robot_of_constraint
from manip_learn.commands.robot_options import RobotOptions
from manip_learn.commands.typed_command import learning_command
from manip_learn.constraint.constraint import Constraint
from manip_learn.constraint.features import FrameJacobian
from manip_learn.errors import ConstraintMismatchError, RecordingError
from manip_learn.playback import RecordingChoice, ReplayResult
from manip_learn.playback import replay as write_replay
from manip_learn.playback.phase_bands import phases_from_json
from manip_learn.recordings.load_demonstrations import ReadOptions, numbers_read
from manip_learn.robot.robot import Robot


def replay(
    robot_name: str,
    files: list[str],
    *,
    html: Path | None = None,
    open_browser: bool = False,
    tip: str | None = None,
    robot_options: RobotOptions | None = None,
    options: ReadOptions | None = None,
    constraint_file: Path | None = None,
) -> ReplayResult:
    """Write a replay of rollouts (of `control`) or of recordings.

    The joints are locked that were locked when the rollouts were made. With a constraint file, the phases and the
    mechanism that were learnt with it are shown, and the joints are locked that were locked then.

    Raises:
        RecordingError: No files, files that are neither rollouts nor recordings, rollouts of another robot or with
            other joints locked, or phases of other recordings.
        ConstraintMismatchError: A constraint file of another robot, or none at all.
        ManipLearnError: Anything else that is wrong with the robot or the output.
    """
    loading = robot_options or RobotOptions()
    if not files:
        raise RecordingError("name at least one rollout file; `manip-learn control ... --out rollout.npz` writes one")
    learnt: dict[str, Any] = {}
    constraint = None
    if constraint_file is not None:
        robot = robot_of_constraint(robot_name, str(constraint_file), loading)
        constraint = Constraint.load(constraint_file, robot)
        learnt = constraint.provenance
        if not isinstance(learnt.get("mechanism") or {}, Mapping):
            raise ConstraintMismatchError(
                f"{constraint_file}: its mechanism must be an object, it is {learnt['mechanism']!r:.60}: save it again"
            )
        tip = tip or getattr(constraint.features, "frame", None)
    else:
        robot = load_for_files(robot_name, files, loading)
    read = named_motions(files, robot, options)
    return write_replay(
        robot,
        read.motions,
        html or Path("replay.html"),
        tip=tip,
        open_browser=open_browser,
        phases=phases_from_json(learnt.get("phases") or []),
        mechanism=learnt.get("mechanism") or None,
        notes=read.notes,
        constraint=constraint,
        report=learnt or None,
        choice=_choice(robot, constraint, read, options or {}) if read.recordings and not read.rollouts else None,
    )


def _choice(
    robot: Robot, constraint: Constraint | None, read: NamedMotions, options: ReadOptions
) -> RecordingChoice | None:
    """The command line that learns from these recordings again; None without a constraint that says how."""
    features = None if constraint is None else constraint.features
    if not isinstance(features, FrameJacobian):
        return None
    command = learning_command(features.frame.name, features.row_names, features.reference)
    return RecordingChoice.of(command, tuple(read.motions), numbers_read(read.recordings, robot, **options))
