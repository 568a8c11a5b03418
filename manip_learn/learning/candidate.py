"""One answer to the demonstrations: the estimate for one feature map, checked, and the choice among several."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, final

import numpy as np

from manip_learn.constraint.features.feature_map import FeatureMap
from manip_learn.errors import NotIdentifiableError, advice, counted
from manip_learn.learning.deciding import (
    BELIEVED_STRENGTH,
    CLEAR_GAP,
    EQUALLY_GOOD,
    EXPLAINED,
    RESIDUAL_RATIO,
    SOFT_ENERGY,
)
from manip_learn.learning.estimators.estimate import Estimate
from manip_learn.learning.estimators.null_space import estimate_null_space, null_space_gap
from manip_learn.learning.excitation import check_fastest, check_samples
from manip_learn.learning.samples import DataSummary, Samples
from manip_learn.linalg import one_thread

EstimatorName = Literal["auto", "joint", "null-space", "separate"]

# one of so many of the chosen samples is enough for a joint estimate that all samples refine afterwards
START_SHARE = 4


@final
@dataclass(frozen=True)
class LearnerSettings:
    """What the user asked for.

    Attributes:
        n_constraints: Number of rows s; None: from the data.
        estimator: One of `EstimatorName`.
        policy_model: Of the joint estimator.
        seed: Of everything random.
        mechanism: Whether to look for a mechanism.
        strength: From which on a row is believed.
    """

    n_constraints: int | None
    estimator: EstimatorName
    policy_model: str
    seed: int
    mechanism: bool = True
    strength: float = BELIEVED_STRENGTH


@final
@dataclass(frozen=True, eq=False)
class Candidate:
    """What was learnt with one feature map.

    Attributes:
        samples: What it was learnt from: all samples, or a choice of them.
        estimate: Lambda with the evidence.
        warnings: Doubts so far.
        rng: For the steps that follow.
    """

    samples: Samples
    estimate: Estimate
    warnings: tuple[str, ...]
    rng: np.random.Generator


def learn_best(
    feature_maps: Sequence[FeatureMap], data: DataSummary, joint_names: tuple[str, ...], settings: LearnerSettings
) -> Candidate:
    """The candidate of the first feature map, unless a later one has a larger gap by more than chance.

    Raises:
        NotIdentifiableError: The data determine no constraint for any of them; the reason for the first.
        RecordingError: Outliers.
    """
    best: Candidate | None = None
    refusals: list[NotIdentifiableError] = []
    for features in feature_maps:
        try:
            candidate = learn_candidate(features, data, joint_names, settings, rival=best)
        except NotIdentifiableError as error:
            refusals.append(error)
            continue
        if best is None or (candidate is not None and candidate.estimate.gap > EQUALLY_GOOD * best.estimate.gap):
            best = candidate
    if best is None:
        raise refusals[0]
    return best


def learn_candidate(
    features: FeatureMap,
    data: DataSummary,
    joint_names: tuple[str, ...],
    settings: LearnerSettings,
    *,
    rival: Candidate | None = None,
) -> Candidate | None:
    """Samples -> estimate -> number of rows, with one feature map; None where the rival's gap cannot be exceeded.

    Args:
        features: Phi.
        data: The samples to learn from.
        joint_names: One per velocity, for messages.
        settings: What the user asked for.
        rival: The best of other feature maps. If its rows are held beyond doubt, the same motion is not self-imposed
            in these.

    Raises:
        NotIdentifiableError: The data determine no constraint; says why.
        RecordingError: Outliers.
    """
    samples = Samples.of(features, data)
    check_fastest(data, joint_names)
    warnings = check_samples(samples, joint_names, settings.n_constraints)
    rival_is_held = rival is not None and rival.estimate.is_held
    if rival is not None and (rival_is_held and settings.estimator == "auto" or settings.estimator == "null-space"):
        if null_space_gap(samples, settings.n_constraints) <= EQUALLY_GOOD * rival.estimate.gap:
            return None
    rng = np.random.default_rng(settings.seed)
    # what all samples refine afterwards need not be as good as these can make it
    share = START_SHARE if len(samples) < data.n_samples else 1
    start = samples.subset(np.arange(len(samples)) % share == 0) if share > 1 else samples
    estimate = _estimate(samples, start, settings, rng, rival_is_held)
    warnings += [*estimate.warnings, *_doubts(estimate, samples.nv, settings.n_constraints)]
    return Candidate(samples, estimate, tuple(warnings), rng)


def _estimate(
    samples: Samples, start: Samples, settings: LearnerSettings, rng: np.random.Generator, rival_is_held: bool
) -> Estimate:
    """By the estimator asked for, or the one that the data select.

    That is the null-space one if the world holds the rows (b = 0), the joint one if the demonstrator moves them.
    """
    if settings.estimator == "joint":
        return _joint(samples, start, settings, rng)
    if settings.estimator == "separate":
        from manip_learn.learning.estimators.separation import estimate_separate

        with one_thread():
            return estimate_separate(samples, settings.n_constraints, rng)
    held = estimate_null_space(samples, settings.n_constraints)
    if settings.estimator == "null-space" or held.is_held or rival_is_held or samples.n_trajectories < 2:
        return held
    try:
        joint = _joint(samples, start, settings, rng, EXPLAINED)
    except NotIdentifiableError:
        return held  # no policy model predicts this motion: the evidence is how little some directions are used
    # both explain the motion: it is held if the held directions show no more than the noise
    is_noise = held.unexplained * samples.energy / held.n_rows <= RESIDUAL_RATIO**2 * joint.noise
    return held if is_noise else joint


def _joint(
    samples: Samples, start: Samples, settings: LearnerSettings, rng: np.random.Generator, unexplained: float = np.inf
) -> Estimate:
    """The joint estimate, if the motion is rich enough for one.

    Raises:
        NotIdentifiableError: It is not, or no policy model leaves less than this share unexplained.
    """
    # loads SciPy, which what is held does without
    from manip_learn.learning.estimators.joint_estimator import estimate_joint

    isotropic = start is not samples
    try:
        with one_thread():
            return estimate_joint(
                start, settings.n_constraints, rng, settings.policy_model, unexplained, isotropic=isotropic
            )
    except np.linalg.LinAlgError as error:
        raise NotIdentifiableError(
            "the motion is too short, or too much the same in all recordings, for a model of the null-space policy: "
            "move further, and differently",
            code="too-few-samples",
        ) from error


def _doubts(estimate: Estimate, nv: int, n_constraints: int | None) -> list[str]:
    """Warnings about the number of rows, and about what the estimate leaves unexplained.

    Raises:
        NotIdentifiableError: It was to be found and the data support none, or no joint motion is left free.
    """
    warnings = []
    s, table, gap = estimate.n_rows, estimate.table, estimate.gap
    verdict = table.verdict(s)
    if verdict == "none" and n_constraints is None:
        raise NotIdentifiableError(
            f"the recordings do not show a constraint: the largest gap is {gap:.2g}, for {counted(s, 'row')}, and "
            f"{table.weak_from:g} is the least that counts",
            code="weak-gap",
            gaps=dict(zip(table.counts, table.gaps, strict=True)),
        )
    if s >= nv:
        raise NotIdentifiableError(f"{s} constraints leave no null space for {nv} joints", code="no-freedom")
    if verdict != "clear":
        warnings.append(
            f"weak gap: {gap:.2g} for {counted(s, 'row')}, {CLEAR_GAP:g} is clear; the constraint may be soft, or the "
            "recordings noisy"
        )
    if n_constraints is not None and table.best != s and table.verdict(table.best) != "none":
        warnings.append(
            f"{counted(s, 'row')} learnt as asked, but the gap supports {table.best}: "
            f"{table.gap(table.best):.3g} against {gap:.3g}"
        )
    if estimate.name == "null-space" and estimate.unexplained > SOFT_ENERGY:
        warnings.append(
            f"{100 * estimate.unexplained:.2g} % of the motion's energy breaks the constraint: it is soft, or the "
            "demonstrator moves the constrained directions on purpose"
            + advice(" (then use {})", "estimator='joint'", "--estimator joint")
        )
    if estimate.name == "joint" and estimate.held_out > EXPLAINED:
        warnings.append(
            f"the policy model predicts only {100 * (1 - estimate.held_out):.0f} % of left-out trajectories: the "
            "null-space motion is not a function of the posture"
        )
    return warnings
