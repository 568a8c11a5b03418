"""Demonstrations -> Constraint, with the evidence."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Iterable, Iterator, Sequence
from typing import Any, Literal, final

import numpy as np

from manip_learn.constraint.constraint import Constraint
from manip_learn.constraint.features.feature_map import FeatureMap
from manip_learn.errors import FeatureError, NotIdentifiableError, RecordingError
from manip_learn.learning.bootstrap import bootstrap_angle_deg
from manip_learn.learning.conclusion import Outcome, concluded
from manip_learn.learning.estimators.estimate import Estimate
from manip_learn.learning.estimators.joint_estimator import estimate_joint
from manip_learn.learning.estimators.null_space_estimator import estimate_null_space
from manip_learn.learning.estimators.rank import CLEAR_GAP
from manip_learn.learning.excitation import check_fastest, check_samples
from manip_learn.learning.report import LearningReport
from manip_learn.learning.samples import Samples
from manip_learn.learning.streaming.executor import Progress
from manip_learn.learning.streaming.made_by import made_by
from manip_learn.learning.streaming.refinement import polished
from manip_learn.learning.streaming.sample_stream import reading
from manip_learn.learning.streaming.summary_pass import Extent, Survey
from manip_learn.learning.streaming.trajectory_buffer import KeptTrajectories
from manip_learn.linalg import one_thread
from manip_learn.recordings.demonstrations import Demonstrations
from manip_learn.recordings.trajectory import Trajectory
from manip_learn.recordings.trajectory_source import ListedTrajectories, TrajectorySource, source_of
from manip_learn.recordings.velocities import VelocityMethod, with_velocities

EstimatorName = Literal["auto", "joint", "null-space", "separate"]
ESTIMATORS = ("auto", "joint", "null-space", "separate")

# share of the motion's energy in the constrained rows below which the motion counts as held there (b = 0)
HELD_FRACTION = 1e-2
# a policy model explains the motion if it predicts this much of trajectories that it has not seen
EXPLAINED = 0.3
# how far above the noise that the joint estimator sees a held direction may lie (root mean square)
NOISE_MARGIN = 1.3
# how much larger the gap of a later candidate must be
CHANCE = 1.1
# one of so many of the chosen samples is enough for a joint estimate that all samples improve on afterwards
START_SHARE = 4


@final
class ConstraintLearner:
    """Learns Lambda of A(q) = Lambda Phi(q) from demonstrations.

    Args:
        features: Phi; or several candidates (e.g. the same axes in the world's and in the tool's frame), of which the
            one with the larger gap wins.
        n_constraints: Number of rows s; found from the data by default.
        estimator: `"null-space"` for motions that the world constrains (b = 0); `"joint"` for motions whose
            constrained rows the demonstrator moves on purpose (b unknown, a null-space policy that depends on the
            posture); `"separate"` for the paper's own route; `"auto"` finds out which it is.
        policy_model: Joint estimator: `"auto"` (cross-validation), `"constant"`, `"affine"`, `"quadratic"`, `"cubic"`,
            `"rbf"`, or `"own"` (affine, with a rest posture of its own for each trajectory).
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
            raise FeatureError(f"n_constraints must be a whole number or None, got {n_constraints!r}")
        for candidate in candidates:
            if n_constraints is not None and not 1 <= n_constraints <= min(candidate.n_rows, candidate.nv):
                raise FeatureError(
                    f"n_constraints must be between 1 and {min(candidate.n_rows, candidate.nv)} for {candidate!r}, "
                    f"got {n_constraints}"
                )
        self._candidates = candidates
        self._kept: KeptTrajectories | None = None

    def fit(
        self,
        demonstrations: TrajectorySource | Iterable[Trajectory],
        *,
        client: Any = None,
        progress: Progress | None = None,
    ) -> ConstraintLearner:
        """Learn from demonstrations; a second fit forgets the first.

        Up to 16,384 samples are learnt from directly. Of more, that many are chosen evenly for a first answer, which
        Gauss-Newton steps over all of them then carry to the optimum, one part of them in memory at a time.

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
        self._kept = None
        self._learn(self._source(demonstrations), client, progress)
        return self

    def partial_fit(self, demonstrations: TrajectorySource | Iterable[Trajectory]) -> ConstraintLearner:
        """Learn from these demonstrations and all that came by `partial_fit` before: the same as one fit to all.

        What a motion says about Lambda cannot be boiled down to sums before Lambda is known, so times, positions and
        velocities are kept: 120 bytes a sample of a 7-joint arm, up to 256 MB in memory, then in a temporary file.

        Raises:
            NotIdentifiableError: Not enough yet; the demonstrations are kept all the same.
            RecordingError: They cannot be used; nothing of them is kept.
        """
        kept = self._kept or KeptTrajectories()
        kept.add(self._source(demonstrations), self._candidates, self.velocities)
        self._kept = kept
        self._learn(kept, None, None)
        return self

    def _source(self, demonstrations: TrajectorySource | Iterable[Trajectory]) -> TrajectorySource:
        """The demonstrations as a source; those in memory get their velocities once and for all."""
        if not isinstance(demonstrations, Demonstrations | Sequence | Iterator):
            return source_of(demonstrations)
        for learnt in ("constraint_", "report_"):
            vars(self).pop(learnt, None)  # a fit that refuses must not leave the answer to other demonstrations behind
        demos = demonstrations if isinstance(demonstrations, Demonstrations) else Demonstrations(demonstrations)
        for features in self._candidates:
            _check_joints(features, demos)
        demos = with_velocities(demos, getattr(self._candidates[0], "robot", None), self.velocities)
        return ListedTrajectories(demos.trajectories, demos.notes)

    def _learn(self, source: TrajectorySource, client: Any, progress: Progress | None) -> None:
        with one_thread():
            started = time.perf_counter()
            read = reading(source, self._candidates, self.velocities)
            with made_by(client, read, progress) as passes:
                extent: Extent = passes.total(Survey(), {}, "all samples, a first look")
                best = self._best_candidate(extent, read.joint_names)
                estimate, note = polished(best.estimate, best.samples, extent, passes)
                best = dataclasses.replace(best, estimate=estimate)
            if note:
                extent = dataclasses.replace(extent, notes=(*extent.notes, note))
            uncertainty = bootstrap_angle_deg(
                best.samples, estimate.selection, estimate.gradients, estimate.hessians, best.rng
            )
            seconds = time.perf_counter() - started
            self.constraint_, self.report_ = concluded(best, extent, read.joint_names, uncertainty, seconds)

    def _best_candidate(self, extent: Extent, joint_names: tuple[str, ...]) -> Outcome:
        """The first candidate, unless another is better by more than chance."""
        best: Outcome | None = None
        refusals: list[NotIdentifiableError] = []
        for features in self._candidates:
            try:
                rival_is_held = best is not None and _clearly_held(best.estimate)
                outcome = self._outcome(features, extent, joint_names, rival_is_held)
            except NotIdentifiableError as error:
                refusals.append(error)
                continue
            if best is None or outcome.gap > CHANCE * best.gap:
                best = outcome
        if best is None:
            raise refusals[0]
        return best

    def _outcome(
        self, features: FeatureMap, extent: Extent, joint_names: tuple[str, ...], rival_is_held: bool
    ) -> Outcome:
        _, group = np.unique(extent.group, return_inverse=True)
        samples = Samples.of(features, extent.q, extent.u, group, extent.low, extent.high)
        check_fastest(samples, extent, joint_names)
        warnings = check_samples(samples, joint_names, self.n_constraints)
        rng = np.random.default_rng(self.seed)
        # what all samples will improve on afterwards need not be as good as these can make it
        share = START_SHARE if len(samples) < extent.n_samples else 1
        some = samples.subset(np.arange(len(samples)) % share == 0) if share > 1 else samples
        estimate = self._estimate(samples, some, rng, rival_is_held)
        return Outcome(samples, estimate, warnings + self._doubts(samples, estimate), rng)

    def _estimate(self, samples: Samples, some: Samples, rng: np.random.Generator, rival_is_held: bool) -> Estimate:
        if self.estimator == "null-space":
            return estimate_null_space(samples, self.n_constraints)
        if self.estimator == "joint":
            return estimate_joint(some, self.n_constraints, rng, self.policy_model)
        if self.estimator == "separate":
            from manip_learn.learning.estimators.separation_estimator import estimate_separate

            return estimate_separate(samples, self.n_constraints, rng)
        return self._found_out(samples, some, rng, rival_is_held)

    def _found_out(self, samples: Samples, some: Samples, rng: np.random.Generator, rival_is_held: bool) -> Estimate:
        """Whether the world holds the rows (b = 0) or the demonstrator moves them."""
        held = estimate_null_space(samples, self.n_constraints)
        # the same motion held in another frame's rows is not self-imposed in these
        if _clearly_held(held) or rival_is_held or samples.n_groups < 2:
            return held
        s = held.selection.shape[0]
        try:
            joint = estimate_joint(some, self.n_constraints, rng, self.policy_model, EXPLAINED)
        except NotIdentifiableError:
            return held  # no policy model predicts this motion: what is left is how little some directions are used
        # both explain the motion: it is held if the held directions show no more than the noise
        return held if held.unexplained * samples.energy / s <= NOISE_MARGIN**2 * joint.noise else joint

    def _doubts(self, samples: Samples, estimate: Estimate) -> list[str]:
        """Warnings about the answer.

        Raises:
            NotIdentifiableError: The number of rows was to be found and nothing speaks for any.
        """
        warnings = list(estimate.warnings)
        s, table = estimate.selection.shape[0], estimate.table
        verdict, gap = table.verdict(s), table.gap(s)
        if verdict == "none" and self.n_constraints is None:
            raise NotIdentifiableError(
                f"the demonstrations do not show a constraint: the largest gap, {gap:.2g} for {s} row(s), is below "
                f"{table.weak_from:g}; record more varied motions, other axes or the other reference, or give "
                "n_constraints if you know it",
                code="weak-gap",
            )
        if s >= samples.nv:
            raise NotIdentifiableError(
                f"{s} constraints leave {samples.nv} joints no freedom: there is nothing to learn from",
                code="no-freedom",
            )
        if verdict != "clear":
            warnings.append(
                f"weak gap: {gap:.2g} for {s} row(s), {CLEAR_GAP:g} and above would be clear; the constraint may be "
                "soft, or the recordings noisy"
            )
        if self.n_constraints is not None and table.best != s and table.verdict(table.best) != "none":
            warnings.append(
                f"you asked for {s} row(s); the data speak for {table.best} (gap {table.gap(table.best):.3g} against "
                f"{gap:.3g})"
            )
        if estimate.name == "null-space" and estimate.unexplained > HELD_FRACTION:
            warnings.append(
                f"{100 * estimate.unexplained:.2g} % of the motion's energy breaks the constraint: it is soft, or the "
                "demonstrator moves the constrained directions on purpose (then use estimator='joint')"
            )
        if estimate.name == "joint" and estimate.held_out > EXPLAINED:
            warnings.append(
                f"the policy model predicts only {100 * (1 - estimate.held_out):.0f} % of left-out trajectories: the "
                "null-space motion is not a function of the posture"
            )
        return warnings

    def __repr__(self) -> str:
        return f"ConstraintLearner({self.features!r}, n_constraints={self.n_constraints}, estimator={self.estimator!r})"


def _clearly_held(estimate: Estimate) -> bool:
    gap = estimate.table.gap(estimate.selection.shape[0])
    return estimate.name == "null-space" and gap >= CLEAR_GAP and estimate.unexplained < HELD_FRACTION**2


def _check_joints(features: FeatureMap, demos: Demonstrations) -> None:
    robot = getattr(features, "robot", None)
    if robot is not None and tuple(demos.joint_names) != tuple(robot.joint_names):
        raise RecordingError(
            f"the demonstrations have the joints {', '.join(demos.joint_names)}; robot {robot.name!r} has "
            f"{', '.join(robot.joint_names)}: load them with load_demonstrations(files, robot), which sorts by name",
            code="joint-names",
        )
