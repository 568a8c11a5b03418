"""`manip-learn learn`: recordings -> constraint file."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, final, get_args

from manip_learn.commands.cluster import cluster_client
from manip_learn.commands.recording_loading import load_for_recordings, source_for_recordings
from manip_learn.commands.robot_options import RobotOptions
from manip_learn.commands.typed_command import typed_command
from manip_learn.constraint.constraint import Constraint
from manip_learn.constraint.features import FeatureMap, FrameJacobian, RelativeFrameJacobian
from manip_learn.errors import FeatureError, RecordingError
from manip_learn.learning import ConstraintLearner, LearningReport
from manip_learn.learning.answer import EstimatorName
from manip_learn.learning.deciding import BELIEVED_STRENGTH
from manip_learn.learning.learner import ESTIMATORS, Switch
from manip_learn.recordings.demonstrations import Demonstrations, distinct_names
from manip_learn.recordings.episode_numbers import numbers_read
from manip_learn.recordings.load_demonstrations import ReadOptions
from manip_learn.recordings.preprocessing import subsample
from manip_learn.recordings.trajectory_source import Progress
from manip_learn.recordings.velocities import with_velocities
from manip_learn.robot.robot import Reference, Robot

if TYPE_CHECKING:
    from manip_learn.playback import ReplayResult

REFERENCES: dict[str, tuple[Reference, ...]] = {"world": ("world",), "local": ("local",), "auto": ("world", "local")}


@final
@dataclass(frozen=True)
class Learnt:
    """What was learnt, and where it was written."""

    constraints: tuple[Constraint, ...]
    reports: tuple[LearningReport, ...]
    frame: str
    out: Path | None
    notes: tuple[str, ...]
    page: ReplayResult | None = None

    @property
    def constraint(self) -> Constraint:
        """The best supported one."""
        return self.constraints[0]

    @property
    def report(self) -> LearningReport:
        """The evidence for it."""
        return self.reports[0]

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


def _described(constraint: Constraint, report: LearningReport) -> dict[str, Any]:
    return report.to_dict() | {
        "selection": constraint.selection.tolist(),
        "axes": list(report.row_names),
        "free_directions": [list(row) for row in report.free_directions],
    }


def learn(
    robot_name: str,
    recordings: list[str],
    *,
    frame: str | None = None,
    relative_to: str | None = None,
    axes: str = "xyz",
    reference: str = "auto",
    n_constraints: int | None = None,
    estimator: str = "auto",
    out: Path | None = None,
    html: Path | None = None,
    seed: int = 0,
    points: int | None = None,
    phases: str = "auto",
    mechanism: str = "auto",
    strength: float | None = None,
    start: float | None = None,
    until: float | None = None,
    robot_options: RobotOptions | None = None,
    options: ReadOptions | None = None,
    dask: str | None = None,
    progress: Progress | None = None,
) -> Learnt:
    """Learn a constraint from recordings; write it, and a replay of the recordings, to files if they are named.

    With `relative_to` the velocity of the frame is seen from that other one, in its axes; `reference` does not count.

    Raises:
        FeatureError: Unknown axes or reference.
        RecordingError: `points` or `html` together with `dask`.
        ManipLearnError: Anything else that is wrong with the robot, the recordings, the settings or the output.
    """
    if reference not in REFERENCES:
        raise FeatureError(f"--reference must be world, local or auto, not {reference!r}")
    for option, value in (("--points", points), ("--html", html)):
        if value is not None and dask is not None:
            raise RecordingError(
                f"{option} works on recordings in memory, not with --dask: give one of the two", code="option"
            )
    if dask is not None and not (start is None and until is None):
        raise RecordingError(
            "--from and --until cut recordings in memory, not with --dask: cut the files first", code="option"
        )
    if progress is not None:
        progress("reading", 0.0)
    load = load_for_recordings if dask is None else source_for_recordings
    robot, demos, chosen, notes = load(
        robot_name, recordings, frame, robot_options or RobotOptions(), options, relative_to
    )
    if isinstance(demos, Demonstrations) and (start is not None or until is not None):
        demos = Demonstrations([t[start:until] for t in demos], demos.notes)
    recorded = demos
    if points is not None and isinstance(demos, Demonstrations):
        demos = Demonstrations([subsample(t, points) for t in with_velocities(demos, robot)], demos.notes)
    candidates: list[FeatureMap] = [FrameJacobian(robot, chosen, axes, r) for r in REFERENCES[reference]]
    if relative_to is not None:
        candidates = [RelativeFrameJacobian(robot, chosen, relative_to, axes)]
    learner = ConstraintLearner(
        candidates,
        n_constraints,
        _estimator(estimator),
        phases=_switch("--phases", phases),
        mechanism=_switch("--mechanism", mechanism),
        seed=seed,
        strength=BELIEVED_STRENGTH if strength is None else strength,
    )
    with cluster_client(dask) as client:
        learner.fit(demos, client=client, progress=progress)
    written = learner.constraint_.save(out) if out is not None else None
    page = None
    if html is not None and isinstance(recorded, Demonstrations):
        numbers = numbers_read(recordings, robot, **(options or {}))
        constraints = learner.constraints_
        page = replay_of_recordings(robot, recorded, learner.report_, html, chosen, constraints, numbers)
    return Learnt(learner.constraints_, learner.reports_, chosen, written, tuple(notes), page)


def replay_of_recordings(
    robot: Robot,
    recordings: Demonstrations,
    report: LearningReport,
    html: Path,
    frame: str,
    constraints: Sequence[Constraint] = (),
    numbers: Sequence[int] = (),
) -> ReplayResult:
    """Write a page that plays the recordings, with what was learnt about them.

    Args:
        robot: Whose joints were recorded.
        recordings: What was learnt from.
        report: Phases, mechanism and odd trajectories.
        html: File to write.
        frame: Frame that was guided.
        constraints: What was learnt, best supported first.
        numbers: Of the recordings, as `--episodes` counts them.

    Raises:
        RecordingError: A recording that cannot be played.
        OutputError: The file cannot be written.
    """
    from manip_learn.playback import RecordingChoice, replay

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
        constraint=constraints or None,
        report=report,
        choice=RecordingChoice.of(typed_command(), tuple(named), numbers),
    )


def _switch(option: str, value: str) -> Switch:
    for known in get_args(Switch):
        if value == known:
            return known
    raise FeatureError(f"{option} must be auto or off, not {value!r}")


def _estimator(name: str) -> EstimatorName:
    for known in get_args(EstimatorName):
        if name == known:
            return known
    raise FeatureError(f"--estimator must be one of {', '.join(ESTIMATORS)}, not {name!r}")
