"""`manip-learn replay`: write rollouts or recordings as one HTML file."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import chain, count
from pathlib import Path
from typing import Any

import manip_learn as ml
from manip_learn.commands.loading import load_constraint, load_for_files, locked_joint_notes
from manip_learn.commands.options import ReplayOptions
from manip_learn.commands.output import Answer, Progress
from manip_learn.errors import ConstraintMismatchError, RecordingError
from manip_learn.playback.palette import phases_from_json
from manip_learn.recordings.files import recording_path
from manip_learn.recordings.options import flag_of
from manip_learn.recordings.saved_motion import FileHeader, file_header
from manip_learn.robot.loading import DESCRIPTION_SUFFIXES


def replay_files(options: ReplayOptions, progress: Progress) -> Answer:
    """Write a replay of rollouts from `control`, or of recordings.

    The robot gets the locked joints of the rollouts. With a constraint file, the replay shows the phases and the
    mechanism with which the constraint was learnt, and the robot gets the locked joints of the constraint.

    Args:
        options: Options of the command.
        progress: Function that is called with the name of a stage and its completed fraction, 0 to 1.

    Returns:
        Answer with the name and the size of the page.

    Raises:
        RecordingError: There are no files, a file is neither a rollout nor a recording, rollouts belong to another
            robot or have other locked joints, or the constraint was learnt from other recordings.
        ConstraintMismatchError: The constraint file belongs to another robot, or contains no constraint.
        ManipLearnError: Another error in the robot or the output.
    """
    progress("writing the replay", 0.0)
    name, files = split_robot(options.files)
    provenance, constraint, tip, keywords = dict[str, Any](), None, options.tip, options.keywords()
    if options.constraint is None:
        robot = load_for_files(name, files, options)
        notes = locked_joint_notes(robot, options)
    else:
        constraint, robot = load_constraint(name, str(options.constraint), options)
        provenance, notes = constraint.provenance, list(constraint.notes)
        tip = tip or getattr(constraint.features, "frame", None)
        if not isinstance(mechanism := provenance.get("mechanism") or {}, Mapping):
            wrong = f"its mechanism must be an object, it is {mechanism!r:.60}: save it again"
            raise ConstraintMismatchError(f"{options.constraint}: {wrong}")
    rollouts = [file for file in files if getattr(_header(recording_path(file)), "kind", "") == "rollout"]
    recordings = [file for file in files if file not in rollouts]
    if keywords and not recordings:
        flags = ", ".join(flag_of(name) for name in keywords)
        raise RecordingError(f"rollouts are read as they were written, so {flags} has no use: leave it out")
    motions, by_name = list[tuple[str, ml.Rollout | ml.Trajectory]](), dict[str, ml.Rollout | ml.Trajectory]()
    for path in map(Path, rollouts):
        rollout, remarks = ml.Rollout.load_with_notes(path, robot)
        motions.append((path.stem, rollout))
        notes += [f"{path.name}: {note}" for note in remarks]
    if recordings:  # load them together: an option may apply to one of them only
        motions += [(t.name, t) for t in ml.load_demonstrations(recordings, robot, **keywords)]
    for name, motion in motions:
        numbered = (f"{name} ({n})" for n in count(2))
        by_name[next(one for one in chain((name,), numbered) if one not in by_name)] = motion
    phases = phases_from_json((provenance.get("phases") if recordings else None) or [])
    facts: dict[str, Any] = {"phases": phases, "notes": notes, "constraint": constraint, "report": provenance or None}
    page = ml.replay(robot, by_name, options.html, tip=tip, open_browser=options.open_browser, **facts)
    return Answer(page.to_dict(), notes=page.notes, page=page)


def _header(path: Path) -> FileHeader | None:
    return file_header(path) if path.is_file() else None


def split_robot(words: list[str]) -> tuple[str, list[str]]:
    """Split the arguments of a command into the robot and the files.

    Args:
        words: Arguments of the command.

    Returns:
        Name of the robot, from the first file if that states it, otherwise the first argument; and names of the files.

    Raises:
        RecordingError: The files do not state their robot and no robot is named, or a robot is named without files.
    """
    first = Path(words[0])
    if (header := _header(first)) is not None and header.robot is not None:
        return header.robot.source or header.robot.name, words
    if len(words) > 1:
        return words[0], words[1:]
    if first.exists() and first.suffix not in DESCRIPTION_SUFFIXES:
        remedy = "name the robot before it, `manip-learn replay ROBOT ...`"
        raise RecordingError(f"{first} does not say which robot it is of: {remedy}")
    if first.suffix and not first.exists():
        raise RecordingError(f"{first}: there is no such file: check the path", code="missing", path=first)
    raise RecordingError("name at least one rollout file; `manip-learn control ... --out run.npz` writes one")
