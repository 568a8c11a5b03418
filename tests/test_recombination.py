"""The recombination test: rows that the world holds are found, and nothing else is called certain."""

from __future__ import annotations

import numpy as np
import pytest
from generated_motions import arm_features, guided_motions, oblique, random_posture, smooth_drive
from task_sets import moving

import manip_learn as ml
from manip_learn.learning.gate import Evidence, recombination_test


def states(found: Evidence) -> list[str]:
    return [row.state for row in found.rows]


def verdict(found: Evidence) -> str:
    return found.verdict(found.n_rows)


def wandering(nv: int, rng: np.random.Generator, size: float | list[float] = 1.0) -> ml.Trajectory:
    """Joints that move independently: the null hypothesis itself."""
    time, drive = np.arange(0.0, rng.uniform(1.5, 3.0), 0.02), smooth_drive(nv, rng)
    u = np.array([drive(t) for t in time]) * size
    return ml.Trajectory(time, 0.02 * np.cumsum(u, axis=0), u)


def held_motions(s: int, seed: int, n: int = 5, noise: float = 0.02) -> tuple[ml.FrameJacobian, list[ml.Trajectory]]:
    features, rng = arm_features(), np.random.default_rng(seed)
    return features, list(guided_motions(features, oblique(s, 3, rng), rng, n, 100, noise=noise)[0])


@pytest.mark.parametrize("kind", ["free", "free_slow", "free_repeated", "free_one_joint", "free_sticking"])
def test_free_motion_is_never_called_held_for_certain(kind):
    """Nothing holds the arm, however it is moved: no set of five demonstrations may give a clear answer."""
    for axes, seed in (("xyz", 0), ("pose", 1)):
        features, demos, _ = moving(kind, "sawyer", seed, 5)
        found = recombination_test(ml.FrameJacobian(features.robot, features.frame.name, axes), demos, seed)
        assert verdict(found) != "clear", (axes, seed, found)


def test_chance_finds_a_row_as_rarely_as_its_p_value_says():
    """Joints that move independently are the null hypothesis itself: p <= 0.2 in about a fifth of the cases."""
    features, p = arm_features(), []
    for seed in range(40):
        rng = np.random.default_rng(seed)
        start = random_posture(features.robot, rng, 0.2)
        made = [wandering(7, rng) for _ in range(5)]
        p.append(recombination_test(features, [ml.Trajectory(t.time, start + t.q, t.u) for t in made], seed).chances[0])
    assert np.count_nonzero(np.array(p) <= 0.2) <= 16  # of 40, 8 expected: chance of more 0.2 %
    assert np.median(p) > 0.2


def test_held_rows_are_counted_and_clear():
    """Five noisy demonstrations of a contact give the right number of rows; one or two a weak answer, however firmly
    they are held, and it says why. Rest, single samples and different lengths are no errors; nothing at all gives no
    rows and says so.
    """
    for s in (1, 2):
        found = recombination_test(*held_motions(s, 0))
        assert (found.n_rows, verdict(found)) == (s, "clear"), found
        assert states(found) == ["held"] * s + ["free"] * (3 - s)
    for n in (1, 2):
        found = recombination_test(*held_motions(2, 10, n, noise=0.0))
        assert (found.n_rows, verdict(found)) == (2, "weak") and "too few to be sure" in found.sentence()
    features, trajectories = held_motions(2, 11, 6)
    joints, q = features.robot.joint_names, trajectories[0].q
    still = ml.Trajectory(np.arange(50.0), q[:50], np.zeros((50, 7)), joints)
    single = ml.Trajectory(np.zeros(1), q[:1], np.ones((1, 7)), joints)
    uneven = [t.part(slice(0, 30 + 14 * i)) for i, t in enumerate(trajectories)]
    found = recombination_test(features, [still, *uneven, single])
    assert (found.n_rows, found.n_pieces) == (2, 6)
    for nothing in ([], [still, still, still]):
        empty = recombination_test(features, nothing)
        assert (empty.n_rows, verdict(empty)) == (0, "none") and "do not move" in empty.sentence()


def of_numbers(strengths, lower=None, p_values=None, levels=(0.01, 0.1, 1.0), **options) -> Evidence:
    """Evidence of five recordings, with numbers of one's own."""
    p, lower = p_values or (0.005,) * 3, lower or strengths
    return Evidence(*map(np.array, (strengths, lower, p, levels)), 5, **options)


def test_the_verdict_is_that_of_its_numbers():
    """A row counts by what its strength exceeds with 99 % confidence: clear from 4, weak from 1.8; no row does with
    more chance than 1 %, none behind one that is hardly stronger than chance unless it was never tried, and one that is
    so itself does not count last.
    """
    found = of_numbers((10.0, 6.0, 0.9))
    assert (found.n_rows, verdict(found), states(found)) == (2, "clear", ["held", "held", "free"])
    assert [row.p_value for row in found.rows] == [0.005] * 3
    for strengths, lower, options, n_rows in (
        ((10.0, 2.0, 0.9), (9.0, 1.58, 0.8), {}, 1),
        ((1.4, 3.0, 0.9), None, {}, 2),  # the first has the least of what noise there is
        ((1.2, 9.0, 0.9), None, {}, 2),  # never tried: the least used, and as little when joints are exchanged
        ((9.0, 1.2, 9.0), None, {}, 1),
        ((9.0, 9.0, 0.9), None, {"p_values": (0.005, 0.011, 0.5)}, 1),
        ((9.0, 8.0, 0.9), None, {"believed": 8.5}, 1),
        ((1.0, 0.9, 0.8), None, {"firm": 2}, 2),
    ):
        assert of_numbers(strengths, lower, **options).n_rows == n_rows
    assert verdict(of_numbers((3.0, 2.5, 0.9))) == "weak"
    assert states(of_numbers((9.0, 1.2, 2.0))) == ["held", "untried", "free"]
    assert states(of_numbers((9.0, 1.0, 0.9), levels=(0.01, 0.2, 1.0))) == ["held", "free", "free"]
