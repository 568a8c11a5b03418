"""The systems that the experiments run on: demonstrations obey what they claim, starts and readings are the paper's."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose
from rounding import rounding

from manip_learn.constraint.constraint import Constraint
from manip_learn.constraint.manipulability import manipulability_gradient
from manip_learn.experiments import rmse, sawyer, singular_starts
from manip_learn.experiments.paper_setup import (
    REST,
    STEP,
    Setup,
    demonstrate,
    draw_starts,
    draw_targets,
    null_parts,
    planar_arm,
    planar_features,
    tip,
)
from manip_learn.experiments.table import LABELS, LearningCase, learning_trial

pytestmark = pytest.mark.timeout(400)  # fixtures of half a minute, which others on the machine may stretch


def differences(function, q: np.ndarray, h: float = 1e-6) -> np.ndarray:
    """Central differences, the derivative index last."""
    steps = h * np.eye(len(q))
    return np.stack([(np.asarray(function(q + s)) - np.asarray(function(q - s))) / (2 * h) for s in steps], axis=-1)


def test_tip_is_that_of_the_shipped_arm(rng):
    """The closed form agrees with the robot, and its derivative is Phi."""
    q = rng.uniform(-3.0, 3.0, size=(5, 3))
    for row, point in zip(q, tip(q), strict=True):
        pose, known = planar_arm().pose(row, planar_arm().frame("tip")), rounding(8 * 3, row, 3.0)  # [m] long
        assert_allclose(pose[:2, 3], point[:2], atol=known)
        assert_allclose(differences(lambda p: tip(p[None])[0], row), planar_features().batch(row[None])[0], atol=1e-8)


def test_demonstrations_follow_the_papers_law(rng):
    """A u = r* - r on the constrained rows along a trajectory, N u = N (rest - q), and each step is an Euler step."""
    Lambda = Setup("x rz").selection
    demos = demonstrate(Setup("x rz", trajectories=6), Lambda, rng)
    assert len(demos) == 6 and len(demos[0]) == 10
    w = null_parts(planar_features(), demos, Lambda).reshape(6, 10, 3)
    for t, part in zip(demos, w, strict=True):
        assert_allclose(np.diff(t.q, axis=0), STEP * t.u[:-1], atol=1e-14)
        A = Lambda @ planar_features().batch(t.q)
        goal = np.einsum("nsv,nv->ns", A, t.u) + tip(t.q) @ Lambda.T
        assert_allclose(goal, np.tile(goal[0], (10, 1)), atol=1e-12)
        N = np.eye(3) - np.linalg.pinv(A) @ A
        assert_allclose(part, np.einsum("nij,nj->ni", N, REST - t.q), atol=1e-12)


def test_climbing_rollouts_are_euler_steps_of_the_papers_law(rng):
    """From posture to posture in 0.02 s: u = A^+ b + N grad mu, and the policies returned are grad mu."""
    constraint = Constraint(Setup("x y").selection, planar_features())
    starts, targets = draw_starts(3, rng), draw_targets(3, rng)
    for q, pi, target in zip(*rmse.climbing(constraint, starts, targets), targets, strict=True):
        assert q.shape == (100, 3)
        assert_allclose(pi[7], manipulability_gradient(constraint, q[7]), atol=1e-12)
        for i in (0, 1, 40, 98):
            A = constraint(q[i])
            N, b = np.eye(3) - np.linalg.pinv(A) @ A, (target - tip(q[i][None])[0])[:2]
            u = np.linalg.pinv(A) @ b + N @ manipulability_gradient(constraint, q[i])
            assert_allclose((q[i + 1] - q[i]) / 0.02, u, atol=1e-9)


def test_every_way_to_learn_learns(rng):
    """Each estimator of the table finds x, y on clean demonstrations, as well as it claims."""
    assert len(set(LABELS.values())) == len(LABELS)
    outcome = learning_trial(LearningCase(Setup("x y"), tuple(LABELS)), rng)
    for name in LABELS:
        assert outcome[name]["test"] < (1e-5 if "separate" in name else 1e-12), name
        assert outcome[name]["rows"] == 2
    assert outcome["joint-affine"]["test"] < 1e-24
    few = learning_trial(LearningCase(Setup("x y", trajectories=1), ("joint-affine",)), rng)
    assert set(few["joint-affine"]) == {"refused"}  # what cannot be learnt is recorded as such


@pytest.fixture(scope="module")
def singular():
    """One result of the first comparison."""
    return singular_starts.SINGULAR.run(1, np.random.default_rng(0))


@pytest.fixture(scope="module")
def near_singular():
    """One result of the second comparison."""
    return singular_starts.NEAR_SINGULAR.run(1, np.random.default_rng(0))


def test_singular_start_is_the_papers_picture(singular):
    """Zero is stuck at 3 m, the attractor dips, climbing keeps mu above 0.866 from step 3; the threshold is Matlab's.

    The dip is at step 37 of 50 Hz and not "around 70": that is 100 Hz, and the verdict says both.
    """
    printed = {c.text: c for c in singular.claims}
    late = printed.pop("... after around 70 steps")
    assert all(c.holds for c in printed.values()) and any("1.332e-15" in text for text in printed)
    assert not late.holds and late.verdict == "**no** at the paper's 50 Hz, yes at 100 Hz"
    assert late.seen == "lowest at step 37 at 50 Hz; lowest at step 72 at 100 Hz"
    numbers = singular.to_dict()["ours"]
    assert numbers["manipulability, dt 0.02 s"]["min_manipulability"] > 0.866
    assert numbers["attractor, dt 0.01 s"]["min_manipulability"] == pytest.approx(0.0312, abs=1e-3)
    assert numbers["attractor, dt 0.02 s"]["min_manipulability"] == pytest.approx(0.0831, abs=1e-3)


@pytest.mark.slow
def test_near_singular_start_is_not(near_singular):
    """The leap of 6e11 rad/s happens in joint 2 only, whatever the policy; what Figure 2 shows of the policies holds.

    After it nothing is printed: neither the tables nor the JSON have a digit of what is rounding noise.
    """
    printed = {c.text: c.holds for c in near_singular.claims}
    assert not printed.pop("The next state is beyond 1e9 rad for each joint")
    assert len(printed) == 2 and all(text.startswith("Figure 2") and holds for text, holds in printed.items())
    for law, numbers in near_singular.to_dict()["ours"].items():
        chaotic = "our controller" not in law
        assert numbers["chaotic"] == chaotic
        assert (numbers["final_error"] is None) == (numbers["min_manipulability"] is None) == chaotic
    assert near_singular.markdown().count("| chaotic | chaotic |") == 6
    for law, rollout in near_singular.rollouts.items():
        if "our controller" not in law:
            assert np.max(np.abs(rollout.u[0])) == pytest.approx(5.73e11, rel=1e-2)
            assert np.all(np.isfinite(rollout.q))


def test_figure_2_is_judged_over_starts_that_differ_by_rounding(near_singular, singular):
    """Zero and manipulability policies rest on the target from all of them, the attractor from none."""
    rounding = near_singular.to_dict()["rounding"]
    assert not singular.rounding
    for policy in ("zero", "manipulability"):
        assert rounding[policy]["at_rest"] == rounding[policy]["n"]
    assert rounding["attractor"]["at_rest"] == 0 and rounding["attractor"]["least_late_speed"] > 1e6


@pytest.mark.parametrize(
    "case",
    [
        pytest.param(c, marks=pytest.mark.slow) if c.direction == "y" or c.points is None else c
        for c in sawyer.CASES.values()
    ],
    ids=lambda c: c.name.replace(sawyer.BETWEEN, "-"),
)
def test_drawer_is_learnt(case):
    """Every reading finds its rows by itself; the model to rounding, kind physics to 0.1 and hard to 2 degrees.

    All samples, and a drawer along y, which opens as that along x does, are for long runs.
    """
    outcome = sawyer.sawyer_trial(case, np.random.default_rng(0))
    assert outcome["rows"] == case.constraint.n_constraints == outcome["rows_true"]
    assert outcome["angle_deg"] < {"model": 1e-9, "kind physics": 0.1, "hard physics": 2.0}[case.source]
    assert len(outcome["rmse"]) == 20 and max(outcome["rmse"]) < 0.05
    assert outcome["nmie_held"] < 1e-3
