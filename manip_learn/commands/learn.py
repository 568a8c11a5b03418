"""`manip-learn learn`: recordings -> constraint file."""

from __future__ import annotations

import math
import shlex
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, final

from manip_learn.commands.command_line import PROGRAM_NAME, typed_command
from manip_learn.commands.guided_frame import choose_frame
from manip_learn.commands.loading import load_for_files
from manip_learn.commands.options import LearnOptions
from manip_learn.constraint.constraint import Constraint
from manip_learn.constraint.features import FeatureMap, FrameJacobian, RelativeFrameJacobian
from manip_learn.constraint.mechanism import SHAPES
from manip_learn.control.tasks import motion
from manip_learn.control.tasks.driven_motion import way_in_words
from manip_learn.errors import FeatureError, ManipLearnError, RecordingError
from manip_learn.learning import ConstraintLearner, LearningReport
from manip_learn.learning.table import BELIEVED, dask_client
from manip_learn.recordings import load_demonstrations
from manip_learn.recordings.load import Progress, RecordingSource
from manip_learn.recordings.trajectory import Demonstrations, distinct_names
from manip_learn.robot.robot import Reference, Robot

if TYPE_CHECKING:
    from manip_learn.playback import ReplayResult

_REFERENCES: dict[str, tuple[Reference, ...]] = {"world": ("world",), "local": ("local",), "auto": ("world", "local")}


@final
@dataclass(frozen=True)
class LearntTask:
    """What was learnt, and where it was written."""

    constraints: tuple[Constraint, ...]
    reports: tuple[LearningReport, ...]
    frame: str
    out: Path | None
    notes: tuple[str, ...]
    page: ReplayResult | None
    options: LearnOptions
    whole: Constraint  # all rows of the hand

    @property
    def constraint(self) -> Constraint:
        """The best supported one."""
        return self.constraints[0]

    @property
    def report(self) -> LearningReport:
        """The evidence for it."""
        return self.reports[0]

    @property
    def headline(self) -> str:
        """What it is and how far it moved, in words; empty where nothing has a name, or nothing moved along it."""
        found, shown = self.report.mechanism, self.constraint.shown
        if found is None or shown is None:
            return ""
        words = SHAPES[found.kind][0]
        return f"{words[0].upper()}{words[1:]}, moved {way_in_words(shown.extent, shown.unit)} when it was shown."

    @property
    def sentences(self) -> list[str]:
        """What can move and how sure that is; what it looks like only where the headline does not say so."""
        found, told = self.report.mechanism, self.report.sentence
        if found is None or not self.headline:
            return [told]
        return told.split(f" It looks like {SHAPES[found.kind][0]}. ")

    @property
    def following(self) -> str | None:
        """The command to type next: it does what was shown, or writes what was learnt; None if nothing is free."""
        constraint, meant = self.constraint, self.constraint.intention
        if self.out is None:
            return shlex.join([*typed_command(), "--out", "task.json"]) if typed_command() else None
        does, flags = "repeat" if meant is None else "control", ["--html", "run.html"]
        if meant is not None and not meant.common:
            flags = ["--rows", "held", "--target", ",".join(f"{x:.3g}" for x in meant.targets[0])]
        elif meant is None and not (constraint.shown and _goes(self.whole, {})):
            ways = (("along", "0.1", {"distance": 0.1}), ("turn", "10", {"angle": math.radians(10.0)}))
            goes = [(flag, said) for flag, said, way in ways if _goes(self.whole, way)]
            if not goes:
                return None
            does, flags = "control", [f"--{goes[0][0]}", goes[0][1], *flags]
        options = self.options
        return shlex.join([PROGRAM_NAME, does, options.robot, str(self.out), *options.loading.words, *flags])

    def to_dict(self) -> dict[str, Any]:
        """The JSON answer: the keys of the best supported constraint, and all constraints as a list."""
        content = _described(self.constraint, self.report)
        content.update(
            constraints=[_described(c, r) for c, r in zip(self.constraints, self.reports, strict=True)],
            frame=self.frame,
            notes=[*self.notes, *self.report.notes],
            out=None if self.out is None else str(self.out),
            html=None if self.page is None else str(self.page.html),
        )
        return content


def _goes(constraint: Constraint, way: dict[str, Any]) -> bool:
    try:
        motion(constraint, **way)
    except ManipLearnError:
        return False
    return True


def _described(constraint: Constraint, report: LearningReport) -> dict[str, Any]:
    return report.to_dict() | {
        "selection": constraint.selection.tolist(),
        "shown": constraint.provenance.get("shown"),
        "axes": list(report.row_names),
        "free_directions": [list(row) for row in report.free_directions],
    }


def learn_task(options: LearnOptions, progress: Progress | None = None) -> LearntTask:
    """Learn a constraint from recordings; write it, and a replay of the recordings, to files if they are named.

    With `relative_to` the velocity of the frame is seen from that other one, in its axes; `reference` does not count.

    Raises:
        FeatureError: Unknown axes or reference.
        RecordingError: An option that works on recordings in memory, together with `dask`.
        ManipLearnError: Anything else that is wrong with the robot, the recordings, the settings or the output.
    """
    if options.reference not in _REFERENCES:
        raise FeatureError(f"--reference must be world, local or auto, not {options.reference!r}")
    if options.dask is not None:
        in_memory = {"--html": options.html, "--from": options.start, "--until": options.until}
        for option, value in in_memory.items():
            if value is not None:
                instead = "cut the files first" if option in ("--from", "--until") else "give one of the two"
                raise RecordingError(
                    f"{option} works on recordings in memory, not with --dask: {instead}", code="option"
                )
    if progress is not None:
        progress("reading", 0.0)
    robot, demos, frame, notes = load_to_learn(options, progress)
    if isinstance(demos, Demonstrations) and (options.start is not None or options.until is not None):
        demos = Demonstrations([t[options.start : options.until] for t in demos], demos.notes)
    candidates: list[FeatureMap] = [
        FrameJacobian(robot, frame, options.axes, r) for r in _REFERENCES[options.reference]
    ]
    if options.relative_to is not None:
        candidates = [RelativeFrameJacobian(robot, frame, options.relative_to, options.axes)]
    learner = ConstraintLearner(
        candidates,
        options.constraints,
        options.estimator,  # type: ignore[arg-type]  # the learner checks these words
        phases=options.phases,  # type: ignore[arg-type]
        mechanism=options.mechanism,  # type: ignore[arg-type]
        seed=options.seed,
        strength=BELIEVED if options.strength is None else options.strength,
        keep_habits=options.habits,
        joint_offset_std=options.zeros,
        link_error_std=options.links,
    )
    with dask_client(options.dask) as client:
        learner.fit(demos, client=client, progress=progress)
    written = learner.skill_.save(options.out) if options.out is not None else None
    page = None
    if options.html is not None and isinstance(demos, Demonstrations):
        page = _replay_of_recordings(robot, demos, learner, options.html, frame)
    whole = learner.skill_.constraints[0]
    return LearntTask(learner.constraints_, learner.reports_, frame, written, tuple(notes), page, options, whole)


def load_to_learn(
    options: LearnOptions, progress: Progress | None = None
) -> tuple[Robot, Demonstrations | RecordingSource, str, list[str]]:
    """Robot, recordings, frame, and notes on joints that were locked because nothing is recorded for them.

    A joint is locked automatically only if it does not move the frame: then it cannot matter to the constraint
    (the fingers of a gripper, the other arm). For a cluster the recordings stay files, of which the first is read.

    Raises:
        ManipLearnError: Any of the errors of loading robots and recordings.
    """
    loading, keywords = options.loading, options.reading.keywords()
    robot = load_for_files(options.robot, options.recordings, loading)
    held: dict[str, float | None] = {**dict.fromkeys(loading.lock or ()), **robot.locked}
    chosen = choose_frame(robot, options.frame)
    frames = [chosen] if options.relative_to is None else [chosen, robot.frame(options.relative_to).name]
    notes: list[str] = []
    while True:
        try:
            if options.dask is None:
                demos = load_demonstrations(options.recordings, robot, progress=progress, **keywords)
                return robot, demos, chosen, notes
            source = RecordingSource(options.recordings, robot, progress=progress, **keywords)
            next(source.part(0))
            return robot, source, chosen, notes
        except RecordingError as error:
            joint = error.column
            if (
                error.code != "missing-joint"
                or joint not in robot.joint_names
                or any(robot.moves(joint, f) for f in frames)
            ):
                raise
            held[joint] = None
            robot = loading.load(options.robot, held, robot.objects)
            notes.append(
                f"joint {joint!r} is not recorded and does not move {' or '.join(map(repr, frames))}: it was locked"
            )


def _replay_of_recordings(
    robot: Robot, recordings: Demonstrations, learner: ConstraintLearner, html: Path, frame: str
) -> ReplayResult:
    """Write a page that plays the recordings, with what was learnt."""
    from manip_learn.playback import replay

    report = learner.report_
    odd = [f"{name} does not agree with the others: {reason}" for name, reason in report.odd_trajectories]
    named = dict(zip(distinct_names(recordings), recordings, strict=True))
    return replay(
        robot,
        named,
        html,
        tip=frame,
        open_browser=False,
        phases=report.phases,
        mechanism=report.mechanism,
        notes=odd,
        constraint=learner.constraints_ or None,
        report=report,
    )
