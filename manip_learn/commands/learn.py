"""`manip-learn learn`: learn a constraint file from recordings."""

from __future__ import annotations

import math
import re
import shlex
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import manip_learn as ml
from manip_learn.commands.command_line import PROGRAM_NAME, TYPED
from manip_learn.commands.loading import choose_frame, load_for_files
from manip_learn.commands.options import LearnOptions
from manip_learn.commands.output import Answer, Progress, silent
from manip_learn.constraint.mechanism import SHAPES
from manip_learn.control.tasks.driven_motion import way_in_words
from manip_learn.errors import FeatureError, RecordingError
from manip_learn.learning.report import LearningReport, RecordingOverview
from manip_learn.learning.table import dask_client
from manip_learn.recordings.trajectory import distinct_names
from manip_learn.robot import Reference

_REFERENCES: dict[str, tuple[Reference, ...]] = {"world": ("world",), "local": ("local",), "auto": ("world", "local")}


def learn_task(options: LearnOptions, progress: Progress = silent) -> Answer:
    """Learn a constraint from recordings, as `fit` does.

    Args:
        options: Options of the command.
        progress: Function that is called with the name of a stage and its completed fraction, 0 to 1.

    Returns:
        Answer with the learnt constraint and its evidence.
    """
    return fit(options, progress)[1]


def fit(options: LearnOptions, progress: Progress = silent) -> tuple[ml.ConstraintLearner, Answer]:
    """Learn a constraint from recordings; write it, and a replay of the recordings, to files if they are named.

    With `relative_to` the features are the velocity of the guided frame relative to that frame, along the axes of that
    frame, and `reference` is ignored.

    Args:
        options: Options of the command.
        progress: Function that is called with the name of a stage and its completed fraction, 0 to 1.

    Returns:
        Fitted learner, and the report as an answer.

    Raises:
        FeatureError: Unknown axes or reference.
        RecordingError: `dask` is used together with an option that needs all recordings in memory.
        ManipLearnError: Another error in the robot, the recordings, the settings or the output.
    """
    references = _REFERENCES.get(options.reference)
    if references is None:
        raise FeatureError(f"--reference must be world, local or auto, not {options.reference!r}")
    in_memory = {"--html": options.html, "--from": options.start, "--until": options.until}
    flags = [flag for flag, value in in_memory.items() if value is not None]
    if options.dask is not None and flags:
        instead = "give one of the two" if flags[0] == "--html" else "cut the files first"
        raise RecordingError(f"{flags[0]} works on recordings in memory, not with --dask: {instead}", code="option")
    progress("reading", 0.0)
    robot, demos, frame, notes = load_to_learn(options, progress)
    if isinstance(demos, ml.Demonstrations) and (options.start is not None or options.until is not None):
        demos = ml.Demonstrations([t[options.start : options.until] for t in demos], demos.notes)
    rows: list[ml.FeatureMap] = [ml.FrameJacobian(robot, frame, options.axes, r) for r in references]
    if options.relative_to is not None:
        rows = [ml.RelativeFrameJacobian(robot, frame, options.relative_to, options.axes)]
    # the learner checks these values; its arguments have the same names
    names = "n_constraints estimator phases mechanism strength keep_habits joint_offset_std link_error_std seed".split()
    settings = {name: getattr(options, name) for name in names}
    learner = ml.ConstraintLearner(rows, **{name: value for name, value in settings.items() if value is not None})
    with dask_client(options.dask) as client:
        learner.fit(demos, client=client, progress=progress)
    written = learner.skill_.save(options.out) if options.out is not None else None
    answer = learning_answer(learner.constraints_, learner.reports_)
    notes += answer.notes
    answer = replace(answer, content=answer.content | {"frame": frame, "notes": notes}, notes=notes)
    page = None
    if options.html is not None and isinstance(demos, ml.Demonstrations):
        motions = dict(zip(distinct_names(demos), demos, strict=True))
        arguments = {"constraint": learner.constraints_ or None, "report": learner.report_, "notes": answer.notes}
        page = ml.replay(robot, motions, options.html, tip=frame, open_browser=False, **arguments)
    following = _next_command(options, learner.skill_.constraints[0], learner.constraint_, written)
    return learner, replace(answer.with_files(written, page), following=following)


def learning_answer(constraints: Sequence[ml.Constraint], reports: Sequence[LearningReport]) -> Answer:
    """Return learnt constraints with their evidence as an answer.

    Args:
        constraints: Learnt constraints, the best supported one first.
        reports: Report of each constraint.
    """
    constraint, report = constraints[0], reports[0]
    mechanism, demo, title, sentences = report.mechanism, constraint.shown, report.sentence, list[str]()
    if mechanism is not None and demo is not None:
        words = SHAPES[mechanism.kind][0]
        title = f"{words[0].upper()}{words[1:]}, demonstrated travel {way_in_words(demo.extent, demo.unit)}."
        parts = re.split(rf" It looks like {re.escape(words)}[.;] ", report.sentence)  # the title says it
        sentences = [part[0].upper() + part[1:] for part in parts]
    contents = []
    for c, r in zip(constraints, reports, strict=True):
        rows = {"selection": c.selection.tolist(), "axes": r.row_names, "shown": c.provenance.get("shown")}
        contents.append(r.to_dict() | rows)
    heading = "held rows" if report.kind == "motion-constrained" else "steered rows"
    remarks = [f"constraint {n}: {other.sentence}" for n, other in enumerate(reports[1:], start=2)]
    remarks += RecordingOverview(report.phases).sentences()
    for n, motion in enumerate((c.shown or c.intention for c in constraints), start=1):
        if motion is not None:
            remarks.append((f"constraint {n}: " if len(constraints) > 1 else "") + motion.sentence)
    return Answer(
        contents[0] | {"constraints": contents},
        title=title,
        sentences=sentences,
        facts={heading: constraint.rows_in_words(), **report.facts()},
        remarks=remarks,
        warnings=[f"warning: {warning}" for warning in report.warnings],
        notes=report.notes,
    )


def _next_command(options: LearnOptions, whole: ml.Constraint, constraint: ml.Constraint, out: Path | None) -> str:
    """Return the next command: it reproduces the task, or writes the constraint; empty if no direction is free.

    Args:
        options: Options of `learn`.
        whole: Constraint with all rows of the hand.
        constraint: Best supported constraint.
        out: File of the constraint; None if it was not written.
    """
    aim, replay = constraint.intention, ["--html", "run.html"]
    if out is None:
        return shlex.join([*TYPED.get(), "--out", "task.json"]) if TYPED.get() else ""
    words = [options.robot, str(out), *options.words]
    if aim is not None:
        flags = [] if aim.common else ["--rows", "held", "--target", ",".join(f"{x:.3g}" for x in aim.targets[0])]
        return shlex.join([PROGRAM_NAME, "control", *words, *(flags or replay)])
    flags = {"": dict[str, Any](), "--along 0.1": {"distance": 0.1}, "--turn 10": {"angle": math.radians(10.0)}}
    for typed, way in flags.items():
        with suppress(ml.ManipLearnError):
            if typed or constraint.shown:
                ml.motion(whole, **way)
                command = "control" if typed else "repeat"
                return shlex.join([PROGRAM_NAME, command, *words, *typed.split(), *replay])
    return ""


def load_to_learn(
    options: LearnOptions, progress: Progress = silent
) -> tuple[ml.Robot, ml.Demonstrations | ml.RecordingSource, str, list[str]]:
    """Load robot and recordings, and choose the frame; lock joints that are not recorded and do not move the frame.

    Such a joint (a finger of a gripper, a joint of the other arm) cannot affect the constraint. With `dask` the
    recordings are not loaded: only the first file is read here.

    Args:
        options: Options of `learn`.
        progress: Function that is called with the name of a stage and its completed fraction, 0 to 1.

    Returns:
        Robot, recordings, name of the frame, and notes on locked joints.

    Raises:
        ManipLearnError: Any error of loading robots and recordings.
    """
    robot = load_for_files(options.robot, options.recordings, options)
    tip = choose_frame(robot, options.frame)
    frames = [tip] if options.relative_to is None else [tip, robot.frame(options.relative_to).name]
    notes = [] if options.frame else [f"the guided frame is {tip}, the only likely tip; name another with --frame"]
    while True:
        try:
            loader = ml.load_demonstrations if options.dask is None else ml.RecordingSource
            demos = loader(options.recordings, robot, progress=progress, **options.keywords())
            if isinstance(demos, ml.RecordingSource):
                next(demos.part(0))
            return robot, demos, tip, notes
        except RecordingError as error:
            joint = error.column if error.code == "missing-joint" else None
            if joint not in robot.joint_names or any(robot.moves(joint, f) for f in frames):
                raise
            robot = options.load(options.robot, {**robot.locked, joint: None}, robot.objects)
            where = " or ".join(map(repr, frames))
            notes.append(f"joint {joint!r} is not recorded and does not move {where}: it was locked")
