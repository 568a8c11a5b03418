"""`manip-learn export`: write recordings and rollouts in other formats, and a learnt task for other controllers."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from pathlib import Path

from numpy.typing import ArrayLike

import manip_learn as ml
from manip_learn.atomic_write import write_atomically
from manip_learn.commands.command_line import refuse_to_replace
from manip_learn.commands.loading import load_constraint, load_for_files, locked_joint_notes
from manip_learn.commands.options import ExportOptions, vector
from manip_learn.commands.output import Answer, Progress
from manip_learn.constraint.constraint import read_constraint_file
from manip_learn.control.interop.force_control import WRITERS, as_json
from manip_learn.errors import OutputError, counted
from manip_learn.recordings.saved_motion import SavedMotion, motion_of_trajectory
from manip_learn.recordings.writers.write_motion import csv_bytes, joint_trajectory_bytes, mcap_bytes

# name on the command line -> endings, and the writer of one motion
_FORMATS: dict[str, tuple[tuple[str, ...], Callable[[SavedMotion], bytes]]] = {
    "mcap": ((".mcap",), mcap_bytes),
    "csv": ((".csv",), csv_bytes),
    "trajectory": ((".yaml", ".yml", ".json"), joint_trajectory_bytes),
}


def export(options: ExportOptions, progress: Progress) -> Answer:
    """Read recordings or rollouts, and write them in another format.

    Args:
        options: Options of the command.
        progress: Function that is called with the name of a stage and its completed fraction, 0 to 1.

    Returns:
        Answer with the names of the files.

    Raises:
        OutputError: The format is unknown, there are several trajectories for one file, or a file cannot be written.
        ManipLearnError: An error in the robot or the recordings.
    """
    progress("writing", 0.0)
    if options.to is not None and options.to in WRITERS:
        return _export_task(options, WRITERS[options.to])
    out = options.out
    by_ending = next((name for name, (endings, _) in _FORMATS.items() if out.suffix.lower() in endings), None)
    kind = options.to or by_ending or "lerobot"
    if kind not in (*_FORMATS, "lerobot"):
        formats = ", ".join([*_FORMATS, "lerobot", *WRITERS])
        raise OutputError(f"--to must be one of {formats}, not {options.to!r}")
    if (options.to is None and by_ending is None and out.suffix) or by_ending not in (None, kind):
        raise OutputError(
            f"cannot write {str(out)!r} as {kind}: the ending says the format, .mcap, .csv, .yaml or .json; "
            "LeRobot data and several files are written to a folder (a name without ending)"
        )
    robot = load_for_files(options.robot, options.files, options)
    demonstrations = ml.load_demonstrations(options.files, robot, **options.keywords())
    motions = [motion_of_trajectory(t, robot) for t in demonstrations]
    if kind == "lerobot":
        from manip_learn.recordings.writers.lerobot_writer import write_lerobot

        files = [write_lerobot(out, motions)]
    else:
        endings, content_of = _FORMATS[kind]
        if by_ending and len(motions) > 1:
            several = counted(len(motions), "trajectory")
            raise OutputError(f"cannot write {several} to one file, {out}: name a folder, and --to {kind}")
        stems = [Path(m.name).stem if Path(m.name).suffix else m.name for m in motions]
        safe = [re.sub(r"[^A-Za-z0-9_.-]+", "_", stem)[:80] for stem in stems]
        if len(motions) > 1:  # `demo_01.csv` -> `0_demo_01`
            safe = [f"{i:0{len(str(len(motions) - 1))}d}_{name}" for i, name in enumerate(safe)]
        names = [out if by_ending else out / (name + endings[0]) for name in safe]
        refuse_to_replace([("--out", name) for name in names], options.files)
        written = [content_of(m) for m in motions]  # convert all before the first file is written
        files = list(map(write_atomically, names, written))
    notes = [*locked_joint_notes(robot, options), *demonstrations.notes]
    return _written(kind, files, notes, len(motions), sum(map(len, motions)))


def _written(kind: str, files: Sequence[Path], notes: list[str], trajectories: int = 0, samples: int = 0) -> Answer:
    """Return the files, or the folder of a LeRobot data set, as an answer; without numbers for a task."""
    content = {"format": kind, "files": files, "trajectories": trajectories, "samples": samples, "notes": notes}
    text = f"{counted(trajectories, 'trajectory')}, {counted(samples, 'sample')}" if trajectories else ""
    return Answer(content, remarks=[text], notes=notes, written=[f"{kind}: {file}" for file in files])


def _export_task(options: ExportOptions, text_of: Callable[[ml.Constraint, ArrayLike], str]) -> Answer:
    """Write a constraint for another controller, with its task frame in words."""
    if len(options.files) != 1:
        raise OutputError(f"--to {options.to} writes one constraint file, got {', '.join(options.files)}")
    constraint, robot = load_constraint(options.robot, options.files[0], options)
    postures, at = constraint.provenance.get("postures"), vector("--at", options.at)
    if at is not None:
        q, where = robot.checked_posture(at), ""
    else:
        q = robot.checked_posture(postures[len(postures) // 2]) if postures else robot.neutral()
        where = "in the middle of the postures shown" if postures else "at the robot's neutral posture"
    frame = constraint.task_frame(q)
    text = text_of(constraint, q)
    if options.to == "json":  # the whole file, with the steps of a skill
        text = as_json(read_constraint_file(Path(options.files[0])) | frame.to_dict())
    file = write_atomically(options.out, text)
    notes = [*constraint.notes, f"task frame: {frame.sentence}{where and f', {where} (--at takes another)'}"]
    return _written(str(options.to), [file], notes)
