"""Demonstrations -> Constraint, with the evidence."""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Literal, final

import numpy as np

from manip_learn.constraint import Constraint
from manip_learn.demonstrations import Demonstrations, Trajectory
from manip_learn.errors import FeatureError, NotIdentifiableError, RecordingError
from manip_learn.features.feature_map import FeatureMap
from manip_learn.learning.bootstrap import bootstrap_angle_deg
from manip_learn.learning.estimate import Estimate
from manip_learn.learning.excitation import check_samples, excitation
from manip_learn.learning.joint_estimator import estimate_joint
from manip_learn.learning.null_space_estimator import estimate_null_space
from manip_learn.learning.rank import CLEAR_GAP
from manip_learn.learning.report import LearningReport
from manip_learn.learning.samples import Samples
from manip_learn.learning.words import free_directions, in_words
from manip_learn.velocities import VelocityMethod, with_velocities

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
        policy_model: Joint estimator: `"auto"` (cross-validation), `"constant"`, `"affine"`, `"quadratic"`, `"cubic"`
            or `"rbf"`.
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
        for candidate in candidates:
            if n_constraints is not None and not 1 <= n_constraints <= min(candidate.n_rows, candidate.nv):
                raise FeatureError(
                    f"n_constraints must be between 1 and {min(candidate.n_rows, candidate.nv)} for {candidate!r}, "
                    f"got {n_constraints}"
                )
        self._candidates = candidates

    def fit(self, demonstrations: Demonstrations | Sequence[Trajectory]) -> ConstraintLearner:
        """Learn from demonstrations; a second fit forgets the first.

        Raises:
            NotIdentifiableError: The demonstrations do not determine a constraint; says why.
            RecordingError: They cannot be used (no velocities to be had, outliers, another robot's joints).
        """
        demos = demonstrations if isinstance(demonstrations, Demonstrations) else Demonstrations(demonstrations)
        for features in self._candidates:
            _check_joints(features, demos)
        demos = with_velocities(demos, getattr(self._candidates[0], "robot", None), self.velocities)
        outcomes: list[tuple[Constraint, LearningReport]] = []
        refusals: list[NotIdentifiableError] = []
        for features in self._candidates:
            try:
                outcomes.append(self._fit_one(features, demos))
            except NotIdentifiableError as error:
                refusals.append(error)
        if not outcomes:
            raise refusals[0]
        # the first candidate wins unless another is better by more than chance
        self.constraint_, self.report_ = outcomes[0]
        for constraint, report in outcomes[1:]:
            if report.gap > CHANCE * self.report_.gap:
                self.constraint_, self.report_ = constraint, report
        return self

    def _fit_one(self, features: FeatureMap, demos: Demonstrations) -> tuple[Constraint, LearningReport]:
        started = time.perf_counter()
        samples = Samples.collect(features, demos)
        names = demos.joint_names
        warnings = check_samples(samples, names, self.n_constraints)
        rng = np.random.default_rng(self.seed)
        estimate = self._estimate(samples, rng)
        warnings += self._doubts(samples, estimate)
        uncertainty = bootstrap_angle_deg(samples, estimate.selection, estimate.gradients, estimate.hessians, rng)
        return self._concluded(samples, demos, estimate, uncertainty, warnings, started)

    def _estimate(self, samples: Samples, rng: np.random.Generator) -> Estimate:
        if self.estimator == "null-space":
            return estimate_null_space(samples, self.n_constraints)
        if self.estimator == "joint":
            return estimate_joint(samples, self.n_constraints, rng, self.policy_model)
        if self.estimator == "separate":
            from manip_learn.learning.separation_estimator import estimate_separate

            return estimate_separate(samples, self.n_constraints, rng)
        return self._found_out(samples, rng)

    def _found_out(self, samples: Samples, rng: np.random.Generator) -> Estimate:
        """Whether the world holds the rows (b = 0) or the demonstrator moves them."""
        held = estimate_null_space(samples, self.n_constraints)
        s = held.selection.shape[0]
        clearly_held = held.table.gap(s) >= CLEAR_GAP and held.unexplained < HELD_FRACTION**2
        if clearly_held or samples.n_groups < 2:
            return held
        try:
            joint = estimate_joint(samples, self.n_constraints, rng, self.policy_model)
        except NotIdentifiableError:
            return held
        if joint.held_out > EXPLAINED:
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
                f"{s} constraints leave {samples.nv} joints no freedom: there is nothing to learn from", code="no-freedom"
            )
        if verdict != "clear":
            warnings.append(
                f"weak gap: {gap:.2g} for {s} row(s), {CLEAR_GAP:g} and above would be clear; the constraint may be "
                "soft, or the recordings noisy"
            )
        if self.n_constraints is not None and table.best != s and table.verdict(table.best) != "none":
            warnings.append(
                f"you asked for {s} row(s); the data speak for {table.best} (gap {table.gap(table.best):.3g} against {gap:.3g})"
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

    def _concluded(
        self,
        samples: Samples,
        demos: Demonstrations,
        estimate: Estimate,
        uncertainty: float | None,
        warnings: list[str],
        started: float,
    ) -> tuple[Constraint, LearningReport]:
        features = samples.features
        selection = samples.selection(estimate.selection)
        s = selection.shape[0]
        used = np.linalg.norm(samples.whitening, axis=0) > 0.0
        unused = [n for n, u in zip(features.row_names, used, strict=True) if not u]
        if unused:
            warnings.append(f"row(s) {', '.join(unused)} are always zero for this robot and frame and were left out")
        kind = "motion-constrained" if estimate.name == "null-space" else "self-imposed"
        free = free_directions(selection, used)
        report = LearningReport(
            sentence=in_words(kind, selection, free, features, used, uncertainty),
            estimator=estimate.name,
            kind=kind,
            n_constraints=s,
            row_names=features.row_names,
            reference=getattr(features, "reference", None),
            free_directions=tuple(tuple(float(c) for c in row) for row in free),
            gap=float(estimate.table.gap(s)),
            gap_table=dict(zip(estimate.table.counts, estimate.table.gaps, strict=True)),
            levels=(),
            energy_fraction=float(estimate.unexplained),
            held_out_residual=float(np.sqrt(estimate.held_out)),
            uncertainty_deg=uncertainty,
            excitation=dict(zip(demos.joint_names, excitation(samples).tolist(), strict=True)),
            policy_model=estimate.policy_model,
            policy_residuals=estimate.policy_residuals,
            n_samples=len(samples),
            n_trajectories=samples.n_groups,
            seconds=time.perf_counter() - started,
            notes=tuple(demos.notes),
            warnings=tuple(warnings),
        )
        provenance = {
            key: value
            for key, value in report.to_dict().items()
            if key in ("estimator", "kind", "gap", "uncertainty_deg", "n_samples", "n_trajectories", "sentence", "warnings")
        }
        return Constraint(selection, features, provenance), report

    def __repr__(self) -> str:
        return f"ConstraintLearner({self.features!r}, n_constraints={self.n_constraints}, estimator={self.estimator!r})"


def _check_joints(features: FeatureMap, demos: Demonstrations) -> None:
    robot = getattr(features, "robot", None)
    if robot is not None and tuple(demos.joint_names) != tuple(robot.joint_names):
        raise RecordingError(
            f"the demonstrations have the joints {', '.join(demos.joint_names)}; robot {robot.name!r} has "
            f"{', '.join(robot.joint_names)}: load them with load_demonstrations(files, robot), which sorts by name",
            code="joint-names",
        )
