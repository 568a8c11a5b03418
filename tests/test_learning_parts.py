"""The learner's parts on their own: samples, gaps, policy models, starts, words, report."""

from __future__ import annotations

import dataclasses
import json
import math

import numpy as np
import pytest
from case import case
from generated_motions import arm_features, guided_motions, oblique, paper_motions

from manip_learn.constraint.features import CustomFeatures, FrameJacobian, MechanismRows
from manip_learn.constraint.mechanism import Mechanism
from manip_learn.constraint.selection_in_words import describe, free_directions
from manip_learn.errors import NotIdentifiableError, RecordingError
from manip_learn.learning import ConstraintLearner
from manip_learn.learning.answer import Answer, Candidate, doubts_of_estimate
from manip_learn.learning.checks import check_fastest, check_postures, check_samples
from manip_learn.learning.estimate import (
    Estimate,
    GapTable,
    fit_null_space,
    gaps_of_levels,
    held_out_share,
    levels,
    trajectory_moments,
)
from manip_learn.learning.imposed import without_noise
from manip_learn.learning.policy import Regressors, monomials
from manip_learn.learning.recombination import RowEvidence
from manip_learn.learning.samples import Samples
from manip_learn.linalg import orthonormal_rows, row_space_angle
from manip_learn.recordings.trajectory import Demonstrations, Trajectory
from manip_learn.robot import load_robot


@pytest.fixture(scope="module")
def reaching():
    demos, truth = paper_motions([0, 1], np.random.default_rng(1), n_trajectories=40, noise=0.01)
    return Samples.collect(truth.features, demos), truth


def test_features_are_whitened(reaching):
    """sum Phi' Phi'^T / n = I, and a selection in whitened coordinates comes back in the features' own."""
    samples, truth = reaching
    total = sum(np.einsum("npv,nqv->pq", b.Phi, b.Phi) for b in samples.blocks())
    np.testing.assert_allclose(total / len(samples), np.eye(samples.n_rows), atol=1e-9)
    whitened = truth.selection @ np.linalg.pinv(samples.whitening)
    assert row_space_angle(samples.selection(whitened), truth.selection) < 1e-9
    assert max(np.max(np.abs(b.x)) for b in samples.blocks()) <= 1.0 + 1e-12


def moving(u: np.ndarray, q: np.ndarray | None = None, n_trajectories: int = 5) -> Samples:
    """Samples with these velocities, of rows that are the joints themselves."""
    q = np.cumsum(u, axis=0) if q is None else q
    features = CustomFeatures(lambda _: np.eye(u.shape[1]), tuple("abcdefgh"[: u.shape[1]]), u.shape[1])
    return Samples.collect(features, recorded(q, u, n_trajectories))


def recorded(q: np.ndarray, u: np.ndarray, n_trajectories: int) -> Demonstrations:
    """Samples in recordings that are as long as each other, or by one longer."""
    names = tuple("abcdefgh"[: u.shape[1]])
    parts = zip(np.array_split(q, n_trajectories), np.array_split(u, n_trajectories), strict=True)
    return Demonstrations([Trajectory(np.arange(len(a)), a, b, names) for a, b in parts])


def test_what_is_too_little_or_too_odd_to_learn_from(rng):
    """Thresholds, each from both sides: an outlier is 1e4 times the usual, a joint hardly moves below a millionth of
    the energy, fewer than 1.6 joints at a time are friction's way, five trajectories are not few.
    """
    names, u = tuple("abcd"), rng.standard_normal((40, 4))
    assert check_samples(moving(u), names, None) == []
    fast, far = u / np.linalg.norm(u, axis=1)[:, None], rng.standard_normal((40, 4))
    far[11] = [1e9, *np.median(far, axis=0)[1:]]
    middle = np.median(far, axis=0)
    usual = np.quantile(np.linalg.norm(far - middle, axis=1), 0.9)
    for factor in (0.98e4, 1.02e4):
        fast[7], far[11] = [0.0, 0.0, -factor, 0.0], middle + [factor * usual, 0.0, 0.0, 0.0]
        given, samples = recorded(u, fast, 4), moving(u, far, 4)
        if factor < 1e4:
            check_fastest(given)
            check_postures(samples)
            continue
        with pytest.raises(
            RecordingError, match=r"sample 7 \(trajectory 0\) moves at -1.02e\+04 in joint 'c', 1.0e\+04"
        ):
            check_fastest(given)
        with pytest.raises(RecordingError, match=r"sample 11 \(trajectory 1\) is 1\.0e\+04 times"):
            check_postures(samples)
    for share, named in ((0.9e-6, True), (1.1e-6, False)):
        slow = rng.standard_normal((4000, 4))
        slow[:, 2] *= np.sqrt(share * np.sum(slow[:, [0, 1, 3]] ** 2) / np.sum(slow[:, 2] ** 2))
        said = check_samples(moving(slow), names, None)
        assert bool([w for w in said if w.startswith("joint c hardly moved")]) == named
    for second, warned in ((0.5, True), (0.65, False)):  # (1 + x^2)^2 / (1 + x^4): 1.47 and 1.72
        two = np.tile([1.0, second, 0.0, 0.0], (40, 1)) * rng.uniform(0.5, 1.0, (40, 1))
        assert any("joints move at a time" in w for w in check_samples(moving(two), names, None)) == warned
    for different, rows, asked in ((5, 4, None), (4, 2, None), (7, 4, 2)):
        few = np.tile(rng.standard_normal((different, rows)), (9, 1))
        samples = moving(few, few, 1)
        if (different, rows) != (7, 4):
            with pytest.raises(
                NotIdentifiableError, match=f"{different} different moving samples.*{different + 1} can"
            ):
                check_samples(samples, names[:rows], asked)
        else:
            check_samples(samples, names, asked)
    with pytest.raises(NotIdentifiableError, match="single joint"):
        check_postures(moving(u[:, :1]))


def test_null_space_fit_from_random_starts():
    """The closed-form start leads to the best optimum that random starts find, and nearly all of them find it."""
    rng = np.random.default_rng(2)
    demos, truth = guided_motions(arm_features(), oblique(2, 3, rng), rng, 8, 15, 0.05, noise=0.05)
    samples = Samples.collect(truth.features, demos)
    _, directions = levels(samples)
    best = fit_null_space(samples, directions[:2])
    assert np.max(np.abs(best.scores.sum(axis=0))) < 1e-6 * np.max(np.abs(best.scores))
    assert row_space_angle(best.whitened_selection, directions[:2]) < 0.1
    others = [fit_null_space(samples, rng.standard_normal((2, 3))) for _ in range(12)]
    assert min(other.cost for other in others) >= best.cost * (1.0 - 1e-9)
    assert sum(row_space_angle(other.whitened_selection, best.whitened_selection) < 1e-6 for other in others) >= 10


def held_samples(n_trajectories: int, n_samples: int = 8) -> Samples:
    """Motions of an arm with two held rows, and noise."""
    rng = np.random.default_rng([4, n_trajectories])
    demos, truth = guided_motions(arm_features(), oblique(2, 3, rng), rng, n_trajectories, n_samples, 0.05, noise=0.1)
    return Samples.collect(truth.features, demos)


def each_of(samples: Samples):
    """(Phi, u, trajectory) of each sample."""
    for block in samples.blocks():
        yield from zip(block.Phi, block.u, block.trajectory.tolist(), strict=True)


def moments_of(samples: Samples, chosen) -> np.ndarray:
    """sum Phi u u^T Phi^T over the samples of chosen trajectories."""
    return sum(np.outer(Phi @ u, Phi @ u) for Phi, u, t in each_of(samples) if t in chosen)


@pytest.mark.parametrize("n", [2, 12])
def test_the_held_out_share_is_that_of_trajectories_that_were_not_seen(n):
    """Each trajectory is judged by the constraint of the others; beyond ten of them there are ten folds."""
    samples = held_samples(n)
    folds = [{t for t in range(n) if t % min(n, 10) == fold} for fold in range(min(n, 10))]
    broken = energy = 0.0
    for fold in folds:
        Lambda = np.linalg.eigh(moments_of(samples, set(range(n)) - fold))[1][:, :2].T
        for Phi, u, t in each_of(samples):
            if t in fold:
                A = Lambda @ Phi
                broken += float(u @ np.linalg.pinv(A) @ A @ u)
                energy += float(u @ u)
    assert held_out_share(samples, 2, trajectory_moments(samples)) == pytest.approx(broken / energy, rel=1e-9)


def test_levels_are_relative_to_a_motion_of_all_joints():
    """Ten times as fast, a motion has the same levels; they are root mean squares along whitened directions."""
    samples = held_samples(4)
    sizes, directions = levels(samples)
    faster, _ = levels(dataclasses.replace(samples, u=10.0 * samples.u))
    np.testing.assert_allclose(faster, sizes, rtol=1e-9)
    energy = np.mean([u @ u for _, u, _ in each_of(samples)])
    for size, direction in zip(sizes, directions, strict=True):
        square = np.mean([(direction @ Phi @ u) ** 2 for Phi, u, _ in each_of(samples)])
        assert size == pytest.approx(math.sqrt(samples.nv * square / energy), rel=1e-9)


def test_the_exact_policys_fit_is_an_optimum(reaching):
    """No small rotation of Lambda lowers the cost, with the policy refitted; the gradients sum to zero."""
    samples, truth = reaching
    affine, rng = [monomials(0), monomials(1)], np.random.default_rng(4)
    start = orthonormal_rows(truth.selection @ np.linalg.pinv(samples.whitening))
    _, fit = without_noise(samples, start, [("", affine)])
    for _ in range(5):
        turned = orthonormal_rows(fit.Lambda + 1e-3 * rng.standard_normal(fit.Lambda.shape))
        assert type(fit)(samples, Regressors.of(samples, affine), turned).cost > fit.cost
    gradients, hessians = fit.scores()
    assert np.max(np.abs(gradients.sum(axis=0))) < 1e-3 * np.max(np.linalg.norm(gradients, axis=1))
    # the policy's part is orthonormal and already eliminated from Lambda's
    k, total = hessians.shape[1] - len(fit.Lambda) * (samples.n_rows - len(fit.Lambda)), hessians.sum(axis=0)
    np.testing.assert_allclose(total[:k, :k], np.eye(k), atol=1e-4)
    assert np.max(np.abs(total[:k, k:])) < 1e-3 * np.sqrt(np.max(np.diag(total)[k:]))


def test_gaps():
    """The largest ratio of levels; clear, weak and none as documented."""
    table = gaps_of_levels(np.array([1e-3, 2e-3, 0.5, 1.0]), 6)
    assert (table.best, table.verdict(2), table.verdict(1)) == (2, "clear", "none")
    assert gaps_of_levels(np.array([0.1, 0.5, 0.6]), 6).verdict(1) == "weak"
    # levels below rounding say nothing, whatever their ratio
    assert gaps_of_levels(np.array([0.0, 2e-8, 1.0]), 6).best == 2
    for gap, verdict in ((10.0, "clear"), (9.99, "weak"), (3.0, "weak"), (2.99, "none")):
        assert GapTable((2,), (gap,), 3.0, 2).verdict(2) == verdict


def estimate_of(gap: float, unexplained: float, name: str = "null-space", **changes) -> Estimate:
    """Two of three rows, with a gap and a share of the energy that is left."""
    table, nothing = GapTable((1, 2), (2.0, gap), 3.0, 2), np.zeros((1, 2))
    return Estimate(name, np.eye(3)[:2], table, unexplained, 0.0, nothing, np.zeros((1, 2, 2)), **changes)


def test_its_own_tests_decide_on_an_answer():
    """Fewer rows by recombination, or a gap twice as large at another number: refused, with what says so; clear needs
    both.
    """
    for gap, strengths, says, clear in (
        (12.0, (30.0, 9.0), "", True),
        (12.0, (9.0, 3.5), "", False),
        (4.1, (12.0, 10.0), "", False),
        (12.0, (9.0, 1.2), "the recombination test supports 1: ", False),
        (12.0, (0.9, 1.2), "the recombination test supports 0: ", False),
        (1.1, (12.0, 10.0), "", False),
        (0.9, (12.0, 10.0), "the gap supports 1: 2 against 0.9", False),
    ):
        with case(gap, strengths):
            rows = RowEvidence(strengths, (0.005, 0.005), (0.1, 0.1), np.eye(3)[:2], 5, 200, (0.0, 0.0))
            estimate = estimate_of(gap, 0.0)
            estimate = dataclasses.replace(estimate, table=dataclasses.replace(estimate.table, best=1 + (gap > 2.0)))
            candidate = Candidate(None, estimate, (), np.random.default_rng(0))  # type: ignore[arg-type]
            answer = Answer(None, candidate, rows, None, ())  # type: ignore[arg-type]
            assert answer.contradiction.startswith(says) and bool(says) == bool(answer.contradiction)
            assert answer.clear == clear
            if says:
                assert answer.refusal().code == "no-evidence" and says in str(answer.refusal())
    assert Answer(None, candidate, None, None, ()).contradiction  # type: ignore[arg-type]


def test_an_estimate_is_doubted_by_its_numbers():
    """Held beyond doubt: gap 10, 1e-4 of the energy; soft from 1 %; refused below 3; a policy predicts 70 %."""
    for gap, left, held in ((10.0, 0.9e-4, True), (9.9, 0.9e-4, False), (10.0, 1.1e-4, False)):
        assert estimate_of(gap, left).is_held == held
    assert not estimate_of(20.0, 0.0, "joint").is_held
    assert doubts_of_estimate(estimate_of(10.0, 0.009), 7, None) == []
    (weak,) = doubts_of_estimate(estimate_of(9.9, 0.009), 7, None)
    assert weak.startswith("weak gap: 9.9 for 2 rows, 10 is clear")
    (soft,) = doubts_of_estimate(estimate_of(10.0, 0.011), 7, None)
    assert soft.startswith("1.1 % of the motion's energy breaks the constraint") and soft.endswith(
        "(then use estimator='joint')"
    )
    with pytest.raises(NotIdentifiableError, match="largest gap is 2.9, for 2 rows, and 3 is the least") as refusal:
        doubts_of_estimate(estimate_of(2.9, 0.0), 7, None)
    assert refusal.value.code == "weak-gap" and refusal.value.gaps == {1: 2.0, 2: 2.9}
    assert len(doubts_of_estimate(estimate_of(2.9, 0.0), 7, 2)) == 1  # asked for: a warning
    with pytest.raises(NotIdentifiableError, match="2 constraints leave no null space for 2 joints"):
        doubts_of_estimate(estimate_of(10.0, 0.0), 2, None)
    other = dataclasses.replace(estimate_of(10.0, 0.0), whitened_selection=np.eye(3)[:1])
    assert "1 row learnt, but the gap supports 2: 10 against 2" in doubts_of_estimate(other, 7, 1)
    assert doubts_of_estimate(estimate_of(10.0, 0.5, "joint"), 7, None) == []
    poor = dataclasses.replace(estimate_of(10.0, 0.5, "joint"), held_out=0.31)
    assert doubts_of_estimate(poor, 7, None)[0].startswith("the policy model predicts only 69 % of left-out")
    assert doubts_of_estimate(dataclasses.replace(poor, held_out=0.29), 7, None) == []


LINE = Mechanism("line", axis=np.array([0.8, 0.6, 0.0]), uncertainty={"axis": 0.3})
HINGE = Mechanism(
    "hinge",
    axis=np.array([0.0, 0.0, 1.0]),
    point=np.array([0.4, 0.1, 0.0]),
    radius=0.3,
    orientation="carried",
    uncertainty={"axis": 0.004, "point": 7e-5},
)
SENSORS = CustomFeatures(lambda q: np.eye(3), ("a", "b", "c"), 3)
ACROSS = np.array([[-0.6, 0.8, 0.0], [0.0, 0.0, 1.0]])


@pytest.mark.parametrize(
    ("features", "held", "imposed", "angle", "mechanism", "words"),
    [
        (("xyz", "world"), ACROSS, False, 0.00084, LINE,
         "The tip can move along (0.80, 0.60, 0.00) and is blocked across it. It looks like a straight line "
         "(a drawer). Direction known to 0.0008 degrees."),
        (("x z", "world"), np.eye(2)[:1], False, None, None, "The tip can move along z and is blocked along x."),
        (("xyz", "local"), ACROSS, False, None, LINE,
         "In its own axes, the tip can move along (0.80, 0.60, 0.00) and is blocked across it. "
         "It looks like a straight line (a drawer), along (0.80, 0.60, 0.00). Axis known to 0.3 degrees."),
        (("xyz", "world"), ACROSS[:1], False, 2.0, LINE,
         "The tip can move along (0.80, 0.60, 0.00) and z and is blocked along (-0.60, 0.80, 0.00). The path alone "
         "looks like a straight line (a drawer), along (0.80, 0.60, 0.00). "
         "Direction known to 2 degrees and axis to 0.3 degrees."),
        (("xyz", "world"), ACROSS[:1], False, None, None,
         "The tip can move along (0.80, 0.60, 0.00) and z and is blocked along (-0.60, 0.80, 0.00)."),
        (("xyz", "world"), np.eye(3), False, None, None, "The tip cannot move."),
        (("xyz", "world"), np.eye(3)[:2], True, 7.4, None,
         "The tip can move along z and is steered on purpose across it. Direction known to 7.4 degrees."),
        (("x y rz", "world"), np.eye(3)[:2], True, 3e-6, None,
         "The tip is steered on purpose along x and y; it can turn about z. "
         "Direction known to better than 0.0001 degrees."),
        (("pose", "world"), np.eye(6)[3:5], False, None, None,
         "The tip can move freely; it can turn about z and is blocked about every other axis."),
        (("pose", "world"), np.eye(6)[[0, 1, 3, 4, 5]], False, None, None,
         "The tip can move along z and is blocked across it; it cannot turn."),
        (("pose", "local"), np.insert(np.eye(6)[[0, 1, 5]], 0, [0, 0, 0.6, 0.8, 0, 0], axis=0), False, None, None,
         "In its own axes, the tip can move along (0.00, 0.00, 0.80) while turning about (-0.60, 0.00, 0.00) and turn "
         "about y, and is blocked in every other way."),
        (("radial axial", None), np.eye(2), False, None, HINGE,
         "The tip can move on a circle of radius 0.300 m about the axis (0.00, 0.00, 1.00) through (0.40, 0.10, 0.00) "
         "and cannot leave it. It looks like a hinge (a door); the hand turns with it. "
         "Axis known to 0.004 degrees and place to 0.07 mm."),
        (SENSORS, ACROSS, False, 0.5, None,
         "The motion is free along (0.80, 0.60, 0.00) in (a, b, c) and blocked in every other way. "
         "Direction known to 0.5 degrees."),
    ],
)  # fmt: skip
def test_the_first_sentence(features, held, imposed, angle, mechanism, words):
    """What can move, what is blocked, what it looks like, how sure: each said once, for every kind of rows."""
    if isinstance(features, tuple):
        axes, reference = features
        robot, frame = load_robot("sawyer"), "right_gripper_tip"
        features = FrameJacobian(robot, frame, axes, reference) if reference else MechanismRows(robot, frame, axes)
    kind = "self-imposed" if imposed else "motion-constrained"
    used = np.ones(features.n_rows, dtype=bool)
    assert describe(kind, free_directions(held, used), features, used, angle, mechanism) == words


def test_report_in_json_and_in_words():
    """NaN becomes null, tuples become lists, and the warnings are printed under the sentence."""
    demos, truth = guided_motions(arm_features(), np.eye(3)[:2], np.random.default_rng(6), 1, 60, noise=0.01)
    report = ConstraintLearner(truth.features, estimator="null-space").fit(demos).report_
    plain = json.loads(json.dumps(report.to_dict(), allow_nan=False))
    assert plain["uncertainty_deg"] is None
    assert isinstance(plain["warnings"], list) and set(plain["gap_table"]) == {"1", "2", "3"}
    assert str(report).splitlines()[0] == report.sentence
    assert "warning: only one trajectory" in str(report)
