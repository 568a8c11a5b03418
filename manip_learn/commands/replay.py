"""`manip-learn replay`: rollouts, or recordings -> one HTML file."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import chain, count
from pathlib import Path
from typing import Any, final

from manip_learn.commands.loading import load_for_files, locks_of_files, robot_of_constraint
from manip_learn.commands.options import ReplayOptions
from manip_learn.commands.output import Answer
from manip_learn.constraint.constraint import Constraint
from manip_learn.control.rollout import Rollout
from manip_learn.errors import ConstraintMismatchError, RecordingError
from manip_learn.playback import replay as write_replay
from manip_learn.playback.phase_bands import phases_from_json
from manip_learn.recordings import load_demonstrations
from manip_learn.recordings.files import recording_path
from manip_learn.recordings.load import Progress
from manip_learn.recordings.options import flag_of
from manip_learn.recordings.saved_motion import file_header
from manip_learn.recordings.trajectory import Trajectory
from manip_learn.robot.loading import DESCRIPTION_SUFFIXES
from manip_learn.robot.robot import Robot


def replay_files(options: ReplayOptions, progress: Progress | None = None) -> Answer:
    """Write a replay of rollouts (of `control`) or of recordings.

    The joints are locked that were locked when the rollouts were made. With a constraint file, the phases and the
    mechanism that were learnt with it are shown, and the joints are locked that were locked then.

    Raises:
        RecordingError: No files, files that are neither rollouts nor recordings, rollouts of another robot or with
            other joints locked, or phases of other recordings.
        ConstraintMismatchError: A constraint file of another robot, or none at all.
        ManipLearnError: Anything else that is wrong with the robot or the output.
    """
    if progress is not None:
        progress("writing the replay", 0.0)
    name, files = named_robot(options.files)
    learnt: dict[str, Any] = {}
    constraint = None
    tip = options.tip
    if options.constraint is not None:
        robot = robot_of_constraint(name, str(options.constraint), options.loading)
        constraint = Constraint.load(options.constraint, robot)
        learnt = constraint.provenance
        if not isinstance(learnt.get("mechanism") or {}, Mapping):
            raise ConstraintMismatchError(
                f"{options.constraint}: its mechanism must be an object, it is {learnt['mechanism']!r:.60}: "
                "save it again"
            )
        tip = tip or getattr(constraint.features, "frame", None)
        notes = list(constraint.notes)
    else:
        robot = load_for_files(name, files, options.loading)
        notes = locks_of_files(robot, options.loading)
    read = named_motions(files, robot, options.reading.keywords())
    page = write_replay(
        robot,
        read.motions,
        options.html,
        tip=tip,
        open_browser=options.open_browser,
        phases=phases_from_json((learnt.get("phases") if read.recordings else None) or []),
        mechanism=learnt.get("mechanism") or None,
        notes=[*notes, *read.notes],
        constraint=constraint,
        report=learnt or None,
    )
    return Answer(page.to_dict(), notes=page.notes, page=page)


def named_robot(words: list[str]) -> tuple[str, list[str]]:
    """The robot and the files, of the words of a command line: what a rollout was made with, or the first word.

    Raises:
        RecordingError: Files that do not know their robot, and none is named; or a robot alone.
    """
    first = Path(words[0])
    header = file_header(first) if first.is_file() else None
    if header is not None and header.robot is not None:
        return header.robot.source or header.robot.name, words
    if len(words) > 1:
        return words[0], words[1:]
    if first.exists() and first.suffix not in DESCRIPTION_SUFFIXES:
        raise RecordingError(
            f"{first} does not say which robot it is of: name the robot before it, `manip-learn replay ROBOT ...`"
        )
    if first.suffix and not first.exists():
        raise RecordingError(f"{first}: there is no such file: check the path", code="missing", path=first)
    raise RecordingError("name at least one rollout file; `manip-learn control ... --out run.npz` writes one")


@final
@dataclass(frozen=True)
class NamedMotions:
    """What files hold, read.

    Attributes:
        motions: Name -> rollout or recording, rollouts first.
        rollouts: Files that are rollouts.
        recordings: The others, files or folders.
        notes: What was noticed while reading.
    """

    motions: dict[str, Rollout | Trajectory]
    rollouts: list[str]
    recordings: list[str]
    notes: list[str]


def named_motions(files: list[str], robot: Robot, keywords: Mapping[str, Any]) -> NamedMotions:
    """Read rollouts and recordings, folders of recordings too.

    Args:
        files: Their paths.
        robot: Their robot.
        keywords: Of `load_demonstrations`, for recordings.

    Raises:
        RecordingError: A file that is missing, that is neither, or of another robot; options that no file can use.
    """
    rollouts = [file for file in files if _is_rollout(recording_path(file))]
    recordings = [file for file in files if file not in rollouts]
    if keywords and not recordings:
        asked = ", ".join(flag_of(name) for name in keywords)
        raise RecordingError(f"rollouts are read as they were written, so {asked} has no use: leave it out")
    named: dict[str, Rollout | Trajectory] = {}
    notes: list[str] = []

    def keep(name: str, motion: Rollout | Trajectory) -> None:
        numbered = (f"{name} ({n})" for n in count(2))
        named[next(one for one in chain((name,), numbered) if one not in named)] = motion

    for file in rollouts:
        rollout, said = Rollout.load_with_notes(file, robot)
        keep(Path(file).stem, rollout)
        notes += [f"{Path(file).name}: {note}" for note in said]
    # together, since an option may be meant for one of them
    for trajectory in load_demonstrations(recordings, robot, **keywords) if recordings else ():
        keep(trajectory.name, trajectory)
    return NamedMotions(named, rollouts, recordings, notes)


def _is_rollout(path: Path) -> bool:
    header = file_header(path) if path.is_file() else None
    return header is not None and header.kind == "rollout"
