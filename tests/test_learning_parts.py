"""The learner's parts on their own: table, fit, gaps, doubts, words, report; and the recombination test: rows that the
world holds are found, and nothing else is called certain.
"""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from case import rows_in
from generated_motions import arm_features, guided_motions, oblique, random_posture, smooth_drive
from numpy.testing import assert_allclose
from task_sets import moving

import manip_learn as ml
from manip_learn.constraint.constraint import describe, free_directions
from manip_learn.errors import NotIdentifiableError, RecordingError
from manip_learn.learning import table
from manip_learn.learning.answer import Answer
from manip_learn.learning.fit import Motion, RowFit
from manip_learn.learning.gate import Evidence, recombination_test
from manip_learn.learning.table import Stretch, Table, View


def held(n_trajectories: int) -> View:
    """Noisy motions of an arm with two held rows."""
    rng = np.random.default_rng([4, n_trajectories])
    demos, truth = guided_motions(arm_features(), oblique(2, 3, rng), rng, n_trajectories, 8, 0.05, noise=0.1)
    return View(truth.features, Table(list(demos)))


def whole(view: View) -> list[Stretch]:
    return [Stretch(i, *map(float, ends)) for i, ends in enumerate(view.table.ends)]


def quarters(q: np.ndarray, u: np.ndarray) -> list[ml.Trajectory]:
    """Samples in four recordings, of joints a, b, ..."""
    parts, names = np.array_split(np.arange(len(q)), 4), tuple("abcd"[: q.shape[1]])
    return [ml.Trajectory(1.0 * k, q[k], u[k], names) for k in parts]


def test_the_fastest_sample_may_not_be_far_out_of_line(rng):
    """An outlier is 1e4 times the usual speed, and named."""
    u = rng.standard_normal((40, 4))
    fast = u / np.linalg.norm(u, axis=1)[:, None]
    way = np.outer(np.linspace(0.0, 1.0, 40), np.ones(4))
    moves = ml.Demonstrations([ml.Trajectory(0.01 * np.arange(40), way)])

    def check(factor: float) -> None:
        fast[7] = [0.0, 0.0, -factor, 0.0]
        table.refuse_unusable(moves, ml.Demonstrations(quarters(np.cumsum(u, axis=0), fast)), SENSORS)

    check(0.98e4)
    with pytest.raises(RecordingError, match=r"sample 7 \(trajectory 0\) moves at -1.02e\+04 in joint 'c', 1.0e\+04"):
        check(1.02e4)


def test_what_is_too_little_or_too_odd_to_learn_from(rng):
    """An outlier is 1e4 times as far as the usual; too few different moving samples, one joint, and no motion."""

    def said(q: np.ndarray, u: np.ndarray, r: int, asked: int | None = None) -> NotIdentifiableError | None:
        return table.table_refusal(Table(quarters(q, u)), r, asked)

    u, far = rng.standard_normal((2, 40, 4))
    middle = np.median(far, axis=0)
    usual = np.quantile(np.linalg.norm(far - middle, axis=1), 0.9)
    for factor in (0.98e4, 1.02e4):
        far[11] = middle + [factor * usual, 0.0, 0.0, 0.0]
        told = said(far, u, 4)
        assert (told is None) == (factor < 1e4)
    assert told.code == "outlier" and "sample 11 (trajectory 1) is 1.0e+04 times" in str(told)
    for different, rows, asked, needed in ((5, 4, None, 6), (4, 2, None, 5), (7, 4, 2, None)):
        few = np.tile(rng.standard_normal((different, rows)), (9, 1))
        told = said(few, few, rows, asked)
        assert (told is None) == (needed is None)
        assert needed is None or f"{different} different moving samples" in str(told) and f"{needed} can" in str(told)
    for q, moved, r, code in (
        (u[:, :1], u[:, :1], 1, "no-freedom"),
        (u, 0.0 * u, 4, "no-motion"),
        (0.0 * u, u, 4, "constant-posture"),
    ):
        assert said(q, moved, r).code == code


def test_columns_of_the_fit_are_derivatives():
    """Where the rows hold: by the rows, by the joints' zeros and, scaled to these, by the links, central differences
    of what is left of the displacements, weighted, less the constants of each stretch.
    """
    rng = np.random.default_rng(3)
    demos, truth = guided_motions(arm_features(), oblique(2, 3, rng), rng, 3, 40, 0.005)
    view = View(truth.features, Table(list(demos)))
    moved = Motion.of(view, whole(view), table.Settings(arm=table.ArmErrors(np.radians(0.1), 5e-4)))
    true = np.linalg.qr((truth.selection @ np.linalg.pinv(view.W)).T)[0].T
    fit, h, nv = RowFit(moved, true), 1e-6, moved.x.shape[1]

    def residual(rows: np.ndarray, zeros: np.ndarray) -> np.ndarray:
        off = [replace(t, q=t.q + zeros) for t in moved.view.table.moved]
        shifted = View(moved.view.features, Table(off))
        y = shifted.y @ np.linalg.solve(shifted.W.T, moved.view.W.T)
        return fit.centre(np.einsum("nai,ni->na", fit.root, y @ rows.T)[:, :, None])[:, :, 0]

    steps = [(B.reshape(2, -1) @ fit.perp, np.zeros(nv)) for B in np.eye(fit.m)]
    steps += [(np.zeros_like(true), delta) for delta in np.eye(nv)]
    for column, (rows, zeros) in enumerate(steps):
        slope = residual(true + h * rows, h * zeros) - residual(true - h * rows, -h * zeros)
        assert_allclose(fit.X[:, :, column], slope / (2.0 * h), atol=1e-6)
    n_errors = fit.X.shape[2] - fit.m - 1
    assert n_errors == nv + 6 * len(moved.view.features.robot.joint_names)  # of each link behind the first, and the tip


@pytest.mark.parametrize(("gap", "strengths", "says", "clear"), rows_in("verdicts.txt"))
def test_its_own_tests_decide_on_an_answer(gap: str, strengths: str, says: str, clear: str):
    """Fewer rows by recombination, or a gap thrice as large at another number, speak against it; clear needs both."""
    view, strength, p = held(4), np.array(json.loads(strengths)), np.full(2, 0.005)
    rows = Evidence(strength, strength, p, np.full(2, 0.1), 5)
    answer = Answer(view, whole(view), np.eye(3)[:2], np.ones(3), {1: 2.0, 2: float(gap)}, evidence=rows)
    assert answer.contradiction.startswith(says) and bool(says) == bool(answer.contradiction)
    assert answer.clear == (clear == "yes")


LINE = ml.Mechanism("line", axis=np.array([0.8, 0.6, 0.0]), uncertainty={"axis": 0.3})
KNOWN = {"axis": 0.004, "point": 7e-5}
HINGE = ml.Mechanism("hinge", np.eye(3)[2], np.array([0.4, 0.1, 0.0]), 0.3, orientation="carried", uncertainty=KNOWN)
SENSORS = ml.CustomFeatures(lambda q: np.eye(3), ("a", "b", "c"), 3)


@pytest.mark.parametrize(("what", "held", "kind", "angle", "path", "words"), rows_in("first_sentences.txt"))
def test_the_first_sentence(sawyer, what, held, kind, angle, path, words):
    """What can move, what is blocked, what it looks like, how sure: each said once, for every kind of rows."""
    features = {
        "world": arm_features(),
        "x y rz": arm_features("x y rz"),
        "radial axial": ml.MechanismRows(sawyer, "right_gripper_tip", "radial axial"),
        "sensors": SENSORS,
    }[what]
    used, mechanism = np.ones(features.n_rows, dtype=bool), {"line": LINE, "hinge": HINGE}.get(path)
    free = free_directions(np.array(json.loads(held)), used)
    assert describe(kind, free, features, used, json.loads(angle), mechanism) == words


# ---- the recombination test ---------------------------------------------------------------------------------------


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


def of_numbers(strengths, lower=None, p_values=None, levels=(0.01, 0.1, 1.0), recordings=5, **options) -> Evidence:
    """Evidence with numbers of one's own."""
    p, lower = p_values or (0.005,) * 3, lower or strengths
    return Evidence(*map(np.array, (strengths, lower, p, levels)), recordings, **options)


def test_the_verdict_is_that_of_its_numbers():
    """A row counts by what its strength exceeds with 99 % confidence: clear from 4, weak from 1.8; no row does with
    more chance than 1 %, none behind one that is hardly stronger than chance unless it was never tried, and one that is
    so itself does not count last.
    """
    found = of_numbers((10.0, 6.0, 0.9))
    assert (found.n_rows, verdict(found), states(found)) == (2, "clear", ["held", "held", "free"])
    assert [row.p_value for row in found.rows] == [0.005] * 3
    assert [verdict(of_numbers((10.0, 6.0, 0.9), recordings=n)) for n in (2, 3)] == ["weak", "clear"]
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
