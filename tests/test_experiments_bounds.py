"""The Cramer-Rao bound is that of the likelihood and is reached; published learners do what their papers say."""

from __future__ import annotations

import json

import numpy as np
import pytest
from numpy.testing import assert_allclose

from manip_learn.experiments import beyond, bounds
from manip_learn.experiments.bounds import (
    NoiseFreeMotion,
    affine_regressors,
    cell,
    draw_selections,
    implied_nmie,
    information,
    least_covariance,
)
from manip_learn.experiments.experiment_result import compare_pairs, median_interval
from manip_learn.experiments.metrics import manipulability_along, nmie
from manip_learn.experiments.paper_setup import (
    REST,
    Setup,
    demonstrate,
    noise_deviations,
    null_policy,
    planar_features,
    tip,
    with_noise,
)
from manip_learn.experiments.ways import closed_form, closed_form_held, fit_places, fit_told_noise
from manip_learn.linalg import complement_rows, orthonormal_rows, row_space_angle


def reaches(rows: str, n: int, rng: np.random.Generator):
    """Noise-free demonstrations of the paper with their truth."""
    setup = Setup(rows, trajectories=n)
    Lambda = setup.selection(rng)
    clean = demonstrate(setup, Lambda, rng)
    q, u = (np.concatenate([getattr(t, name) for t in clean]) for name in ("q", "u"))
    pi = null_policy("attractor", q, REST)
    return clean, NoiseFreeMotion(planar_features(), Lambda, q, u, pi, affine_regressors(q))


def residual(motion: NoiseFreeMotion, B: np.ndarray, theta: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """What is left of each whitened u - pi for the best b_n, from the model itself: its square is -2 log likelihood."""
    Lambda = motion.selection + B @ complement_rows(motion.selection)
    back, out = np.linalg.inv(np.linalg.cholesky(covariance)), []
    for q, u, beta in zip(motion.q, motion.u, motion.beta, strict=True):
        # u = A^T c + pi + e for any c
        task, y = back @ (Lambda @ motion.features(q)).T, back @ (u - beta @ theta)
        out.append(y - task @ np.linalg.lstsq(task, y, rcond=None)[0])
    return np.concatenate(out)


@pytest.mark.parametrize("rows", ["x y", "x rz", "y rz"])
def test_information_is_the_curvature_of_the_likelihood(rows, rng):
    """Derivatives of the likelihood by B and Theta by differences; Theta eliminated by a Schur complement."""
    _, motion = reaches(rows, 8, rng)
    covariance = np.diag([0.02, 0.05, 0.03]) ** 2
    theta = np.linalg.lstsq(motion.beta, motion.pi, rcond=None)[0]
    assert np.max(np.abs(residual(motion, np.zeros((2, 1)), theta, covariance))) < 1e-9
    columns, h = [], 1e-5
    for direction in np.eye(2 + theta.size):
        B, change = h * direction[:2].reshape(2, 1), h * direction[2:].reshape(theta.shape)
        plus, minus = (residual(motion, s * B, theta + s * change, covariance) for s in (1.0, -1.0))
        columns.append((plus - minus) / (2.0 * h))
    J, K = np.array(columns[:2]).T, np.array(columns[2:]).T
    rest = J - K @ np.linalg.lstsq(K, J, rcond=1e-8)[0]
    assert_allclose(information(motion, covariance), rest.T @ rest, rtol=1e-3, atol=1e-3 * np.max(rest.T @ rest))


@pytest.mark.parametrize("rows", ["x y", "x rz", "y rz"])
def test_bound_is_reached_by_maximum_likelihood_at_small_noise(rows):
    """Over 60 noises of 0.02 %, the covariance of the estimate told the noise is the bound's, but for chance."""
    rng = np.random.default_rng(3)
    clean, motion = reaches(rows, 40, rng)
    deviations = noise_deviations(clean, 2e-4)
    bound = least_covariance(motion, np.diag(deviations**2))
    perp, errors = complement_rows(motion.selection), []
    for _ in range(60):
        noisy = with_noise(clean, 2e-4, rng)
        learnt = orthonormal_rows(fit_told_noise(planar_features(), noisy, motion.selection, deviations))
        errors.append(np.linalg.solve(learnt @ motion.selection.T, learnt @ perp.T).ravel())
    whitened = np.linalg.solve(np.linalg.cholesky(bound), np.array(errors).T)
    # 120 squares of standard normal numbers: mean 1, standard deviation 0.13
    assert 0.6 < np.mean(whitened**2) < 1.5


def test_bound_falls_with_data_and_rises_with_noise(rng):
    """Twice the noise is twice the error; more trajectories never hurt; one trajectory does not tell the rows."""
    clean, motion = reaches("x y", 30, rng)
    covariance = np.diag(noise_deviations(clean, 0.01) ** 2)
    whole = least_covariance(motion, covariance)
    assert_allclose(least_covariance(motion, 4.0 * covariance), 4.0 * whole, rtol=1e-6)
    half, one = (
        NoiseFreeMotion(
            motion.features, motion.selection, *(x[:n] for x in (motion.q, motion.u, motion.pi, motion.beta))
        )
        for n in (150, 10)
    )
    assert np.min(np.linalg.eigvalsh(least_covariance(half, covariance) - whole)) > 0.0
    assert np.trace(least_covariance(one, covariance)) > 1e3 * np.trace(whole)


def test_implied_nmie_is_the_nmie_of_the_answers(rng):
    """The fast form agrees with the metric; the drawn answers have the bound's covariance."""
    _, motion = reaches("x rz", 20, rng)
    bound = np.array([[1e-4, 2e-5], [2e-5, 5e-5]])
    learnt = draw_selections(motion.selection, bound, 3000, rng)
    assert_allclose(learnt @ learnt.transpose(0, 2, 1), np.tile(np.eye(2), (3000, 1, 1)), atol=1e-12)
    mu = manipulability_along(planar_features(), motion.selection, motion.q)
    fast = implied_nmie(planar_features(), motion.selection, learnt[:5], motion.q)
    slow = [nmie(mu, manipulability_along(planar_features(), rows, motion.q)) for rows in learnt[:5]]
    assert_allclose(fast, slow, rtol=1e-8)
    perp = complement_rows(motion.selection)
    B = np.array([np.linalg.solve(rows @ motion.selection.T, rows @ perp.T).ravel() for rows in learnt])
    assert_allclose(np.cov(B.T), bound, rtol=0.15, atol=3e-6)


@pytest.mark.parametrize("rows", ["x y", "x rz", "y rz"])
def test_closed_form_is_exact_without_noise(rows, rng):
    """One decomposition finds the rows of reaches with unknown targets, and of held motion."""
    clean, motion = reaches(rows, 30, rng)
    rates = np.array([np.einsum("npv,nv->np", planar_features().batch(t.q), t.u) for t in clean])
    learnt = closed_form(rates, np.array([tip(t.q) for t in clean]), 2)
    assert np.degrees(row_space_angle(motion.selection, learnt)) < 1e-6
    across = complement_rows(motion.selection)
    held = rng.standard_normal((200, 1)) @ across
    assert row_space_angle(closed_form_held(held, 2), motion.selection) < 1e-12


def test_line_through_the_places(rng):
    """Parallel lines give the two rows across them."""
    axis = np.array([[0.6, 0.0, 0.8]])
    places = [rng.standard_normal(3) + rng.standard_normal((20, 1)) @ axis for _ in range(4)]
    assert row_space_angle(fit_places(places, 2), complement_rows(axis)) < 1e-12


def test_interval_of_a_median(rng):
    """The 95 % interval holds the median in at least 95 % of draws, whatever the law; six values are the least."""
    inside = 0
    for _ in range(400):
        low, high = median_interval(rng.exponential(size=20).tolist())
        assert low is not None and high is not None
        inside += low <= np.log(2.0) <= high
    assert inside / 400 > 0.93
    assert median_interval([1.0, 2.0, 3.0]) == (None, None)
    assert median_interval([3.0, 1.0, 2.0, 6.0, 5.0, 4.0]) == (1.0, 6.0)


def test_paired_comparison():
    """Ratio, interval, wins and p of pairs; what one of them refused is left out."""
    ours = [1.0] * 10
    pair = compare_pairs([*ours, None, 1.0], [2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0, 9.0, 10.0, 0.5, 1.0, None])
    assert pair["n"] == 10 and pair["wins"] == 9
    assert pair["ratio"] == pytest.approx(np.sqrt(30.0))
    assert pair["p"] is not None and pair["p"] < 0.05 and pair["low"] < pair["ratio"] < pair["high"]
    assert compare_pairs([None], [1.0])["ratio"] is None
    assert compare_pairs([1.0] * 5, [2.0] * 5)["p"] is None and compare_pairs([1.0] * 6, [2.0] * 6)["p"] == 2.0**-5


def test_a_noisy_trial_has_bound_and_learners():
    """Every learner answers or says why not, on the same recordings, and the cell says how far it is from the bound."""
    name = "noise 1 %, 20 trajectories | y rz"
    trials = [bounds.bounds_trial(bounds.CASES[name], np.random.default_rng(i)) for i in range(2)]
    for t in trials:
        assert set(t) == {"bound", "joint-told", *bounds.LEARNERS}
        assert t["auto"]["rows"] == 2 and t["auto"]["b2"] > 0.0 and len(t["bound"]["nmie"]) == bounds.DRAWS
    result = bounds.BoundsResult({name: trials})
    one = result.to_dict()["ours"]["noise 1 %, 20 trajectories"]["y rz"]
    assert one == cell(bounds.CASES[name].setup, trials) and (one["noise"], one["trajectories"]) == (0.01, 20)
    assert one["bound"]["nmie"] == np.median([t["bound"]["nmie"] for t in trials])
    assert one["auto"]["ratio"] == one["auto"]["nmie"]["median"] / one["bound"]["nmie"]
    b2 = [t["auto"]["b2"] / t["bound"]["trace"] for t in trials]
    assert one["auto"]["efficiency"] == pytest.approx(np.sqrt(np.mean(b2)))
    assert (one["why"] == "") == (one["auto"]["ratio"] <= 2.0)
    assert "refused" not in result.markdown().split("|")[8]
    json.dumps(one, allow_nan=False)


def test_a_cell_says_why_it_is_not_within_twice_the_bound():
    """In this order: not determined, all refused, chance, unequal noise that was not told, errors that are large."""

    def why(ours: list[float | None], told: float = 5.0, angle: float = 3.0) -> str:
        answers = [{"test": value, "angle_deg": 1.0} if value is not None else {"refused": "x"} for value in ours]
        others = dict.fromkeys(("joint-told", "joint-affine", *bounds.OTHERS), {"test": told, "angle_deg": 1.0})
        bound = {"nmie": [1.0], "angle_deg": angle, "trace": 1.0}
        return cell(Setup(), [{"auto": a, "bound": bound, **others} for a in answers])["why"]

    assert why([1.0, 2.0, 2.0]) == ""
    assert why([2.0, 9.0, None], angle=15.1) == "not determined: the bound itself is beyond 15 degrees; 33 % refused"
    assert why([None, None]) == "all refused"
    assert why([1.0, 2.1, 2.1, 2.1, 2.1, 2.1]).startswith("chance")
    assert why([2.1] * 6, told=1.9) == "the noise differs between joints and is taken as equal: told so, 1.9 times"
    assert why([2.1] * 6).startswith("no estimator here is at the bound")


def test_noises_and_sizes_are_those_announced():
    """0.1 to 10 % of noise, 1 to 200 trajectories, all three constraints."""
    setups = [case.setup for case in bounds.CASES.values()]
    assert {s.noise for s in setups} == {0.001, 0.005, 0.01, 0.02, 0.05, 0.1}
    assert {s.trajectories for s in setups if s.noise == 0.01} == {1, 2, 5, 10, 20, 50, 100, 200}
    assert len(setups) == len(set(setups)) == 39


@pytest.mark.parametrize("case", beyond.FOLDERS, ids=lambda c: c.folder)
def test_uncut_recordings_and_mechanisms(case):
    """Without one recording, every mechanism is found with its axis within 0.1 degrees, and the odd ones are named."""
    outcome = beyond.recorded_trial(case, np.random.default_rng(1))
    assert outcome["types_right"] and outcome["odd_right"]
    assert outcome["axis_deg"] < 0.1 and outcome["overlap"] > 0.8


def test_overlap_of_spans():
    """Time in both over time in either."""
    assert beyond.overlap({"a": [(0.0, 2.0)]}, {"a": [(1.0, 3.0)]}) == pytest.approx(1.0 / 3.0)
    assert beyond.overlap({"a": [(0.0, 1.0), (2.0, 3.0)]}, {"a": [(0.0, 1.0), (2.0, 3.0)]}) == 1.0
