"""Demonstrations -> Constraint, with the evidence."""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator, Sequence
from typing import TYPE_CHECKING, Any, final

from manip_learn.constraint.constraint import Constraint
from manip_learn.constraint.features.feature_map import FeatureMap
from manip_learn.errors import FeatureError, NumberOfConstraintsError
from manip_learn.learning.bootstrap import bootstrap_angle_deg
from manip_learn.learning.calibration import JointOffsets
from manip_learn.learning.candidate import Candidate, EstimatorName, LearnerSettings, learn_best
from manip_learn.learning.data_summary import IN_MEMORY_SAMPLES, DataSummary, check_joints
from manip_learn.learning.report import LearningReport, build_report
from manip_learn.linalg import one_thread
from manip_learn.recordings.demonstrations import Demonstrations
from manip_learn.recordings.trajectory import Trajectory
from manip_learn.recordings.trajectory_source import Progress, TrajectorySource, source_of
from manip_learn.recordings.velocities import VelocityMethod, with_velocities

if TYPE_CHECKING:
    from manip_learn.learning.streaming.trajectory_buffer import TrajectoryBuffer

ESTIMATORS = ("auto", "joint", "null-space", "separate")


@final
class ConstraintLearner:
    """Learns Lambda of A(q) = Lambda Phi(q) from demonstrations.

    Args:
        features: Phi; or several candidates (e.g. the same axes in the world's and in the tool's frame), of which the
            one with the larger gap wins.
        n_constraints: Number of rows s; found from the data by default.
        estimator: `"null-space"` for motions that the world constrains (b = 0); `"joint"` for motions whose
            constrained rows the demonstrator moves on purpose (b unknown, a null-space policy that depends on the
            posture); `"separate"` for the paper's own route; `"auto"` selects the first or the second from the data.
        policy_model: Joint estimator: `"auto"` (cross-validation), `"constant"`, `"affine"`, `"quadratic"`, `"cubic"`,
            `"rbf"`, or `"affine-offset"` (affine, with a separate rest posture for each trajectory).
        velocities: How missing velocities are derived, see `derive_velocities`.
        seed: Seed of everything random (bootstrap, random starts, k-means).

    Attributes:
        constraint_: The learnt `Constraint`, after `fit`.
        report_: The evidence, a `LearningReport`, after `fit`.

    Raises:
        FeatureError: No features, or settings out of range.
    """

    constraint_: Constraint
    report_: LearningReport

    def __init__(
        self,
        features: FeatureMap | Sequence[FeatureMap],
        n_constraints: int | None = None,
        estimator: EstimatorName = "auto",
        *,
        policy_model: str = "auto",
        velocities: VelocityMethod = "auto",
        seed: int = 0,
    ):
        if estimator not in ESTIMATORS:
            raise FeatureError(f"estimator must be one of {', '.join(ESTIMATORS)}, not {estimator!r}")
        self.features = features
        self.n_constraints = n_constraints
        self.estimator: EstimatorName = estimator
        self.policy_model = policy_model
        self.velocities: VelocityMethod = velocities
        self.seed = seed
        candidates = [features] if isinstance(features, FeatureMap) else list(features)
        if not candidates:
            raise FeatureError("give the learner at least one feature map")
        if n_constraints is not None and (isinstance(n_constraints, bool) or not isinstance(n_constraints, int)):
            raise FeatureError(f"n_constraints must be an integer or None, got {n_constraints!r}")
        for candidate in candidates:
            most = min(candidate.n_rows, candidate.nv)
            if n_constraints is not None and not 1 <= n_constraints <= most:
                raise NumberOfConstraintsError(n_constraints, most, repr(candidate))
        self._feature_maps = candidates
        self._buffer: TrajectoryBuffer | None = None

    def fit(
        self,
        demonstrations: TrajectorySource | Iterable[Trajectory],
        *,
        client: Any = None,
        progress: Progress | None = None,
    ) -> ConstraintLearner:
        """Learn from demonstrations; a second fit forgets the first.

        Up to 16,384 samples are learnt from directly. Of more, that many are chosen evenly for a first answer, which
        Gauss-Newton steps over all of them then refine to the optimum, one part of them in memory at a time.

        Args:
            demonstrations: Trajectories in memory; or an object that yields them anew each time it is iterated over;
                or a `TrajectorySource`, e.g. `manip_learn.recordings.RecordingSource` for files larger than memory.
            client: A `dask.distributed.Client` whose workers make the passes over the samples; the answer does not
                depend on their number.
            progress: Called with what is being done and the share of it that is done.

        Raises:
            NotIdentifiableError: The demonstrations do not determine a constraint; says why.
            RecordingError: They cannot be used (no velocities to be had, outliers, another robot's joints).
            MissingExtraError: A client without the extra `dask`.
        """
        self._buffer = None
        self._forget()
        data = self._with_velocities(demonstrations)
        if client is None and isinstance(data, Demonstrations) and data.n_samples <= IN_MEMORY_SAMPLES:
            self._fit_in_memory(data, progress)
        else:
            self._fit_stream(source_of(data), client, progress)
        return self

    def partial_fit(self, demonstrations: TrajectorySource | Iterable[Trajectory]) -> ConstraintLearner:
        """Learn from these demonstrations and all that came by `partial_fit` before: the same as one fit to all.

        The evidence about Lambda has no fixed-size sufficient statistic, so times, positions and velocities are kept:
        120 bytes per sample of a 7-joint arm, up to 256 MB in memory, then in a temporary file.

        Raises:
            NotIdentifiableError: Not enough yet; the demonstrations are kept all the same.
            RecordingError: They cannot be used; nothing of them is kept.
        """
        from manip_learn.learning.streaming.trajectory_buffer import TrajectoryBuffer

        self._forget()
        buffer = self._buffer or TrajectoryBuffer()
        buffer.add(source_of(self._with_velocities(demonstrations)), self._feature_maps, self.velocities)
        self._buffer = buffer
        self._fit_stream(buffer, None, None)
        return self

    def _fit_in_memory(self, demonstrations: Demonstrations, progress: Progress | None) -> None:
        """Samples -> estimate and number of rows -> uncertainty -> report."""
        with one_thread():
            started = time.perf_counter()
            data = DataSummary.of(demonstrations)
            best = learn_best(self._feature_maps, data, demonstrations.joint_names, self._settings)
            if progress is not None:
                progress("learning", 1.0)
            self._conclude(best, data, demonstrations.joint_names, started)

    def _fit_stream(self, source: TrajectorySource, client: Any, progress: Progress | None) -> None:
        """The same from a choice of the samples, and the estimate refined on all of them before its uncertainty."""
        from manip_learn.learning.streaming.executor import open_executor
        from manip_learn.learning.streaming.refinement import refine
        from manip_learn.learning.streaming.sample_stream import open_stream
        from manip_learn.learning.streaming.summary_pass import SummaryAccumulator

        with one_thread():
            started = time.perf_counter()
            stream = open_stream(source, self._feature_maps, self.velocities)
            with open_executor(client, stream, progress) as executor:
                summary = executor.total(SummaryAccumulator(IN_MEMORY_SAMPLES), {}, "all samples, first pass")
                chosen = learn_best(self._feature_maps, summary.data, stream.joint_names, self._settings)
                best, data = refine(chosen, summary, executor)
            self._conclude(best, data, stream.joint_names, started)

    def _conclude(self, best: Candidate, data: DataSummary, joint_names: tuple[str, ...], started: float) -> None:
        """Uncertainty -> report."""
        estimate = best.estimate
        held = estimate.name == "null-space"
        uncertainty_deg = bootstrap_angle_deg(
            best.samples,
            estimate.whitened_selection,
            estimate.gradients,
            estimate.hessians,
            best.rng,
            offsets=JointOffsets.of(best.samples, estimate.whitened_selection) if held else None,
        )
        seconds = time.perf_counter() - started
        self.constraint_, self.report_ = build_report(best, data, joint_names, uncertainty_deg, seconds)

    @property
    def _settings(self) -> LearnerSettings:
        return LearnerSettings(self.n_constraints, self.estimator, self.policy_model, self.seed)

    def _with_velocities(
        self, demonstrations: TrajectorySource | Iterable[Trajectory]
    ) -> Demonstrations | TrajectorySource | Iterable[Trajectory]:
        """Demonstrations in memory with the joints of the features and with velocities; a stream as it is."""
        if not isinstance(demonstrations, Demonstrations | Sequence | Iterator):
            return demonstrations
        demos = demonstrations if isinstance(demonstrations, Demonstrations) else Demonstrations(demonstrations)
        for features in self._feature_maps:
            check_joints(demos.joint_names, getattr(features, "robot", None))
        return with_velocities(demos, getattr(self._feature_maps[0], "robot", None), self.velocities)

    def _forget(self) -> None:
        """A fit that refuses must not leave the answer to other demonstrations behind."""
        for learnt in ("constraint_", "report_"):
            vars(self).pop(learnt, None)

    def __repr__(self) -> str:
        return f"ConstraintLearner({self.features!r}, n_constraints={self.n_constraints}, estimator={self.estimator!r})"
