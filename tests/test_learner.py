"""The learner as a whole: on motions that it was not tuned on, on the recordings that are shipped, and with good, bad
and odd demonstrations, in the spirit of scikit-learn's check_estimator.

A learner may answer, answer with warnings in its report, or refuse with an error of this library; what it may never do
is give a wrong answer in silence.
"""

from __future__ import annotations

import copy
import dataclasses
from collections.abc import Callable
from functools import cache
from typing import Any, NamedTuple

import numpy as np
import pytest
import scale_motions
from generated_motions import arm_features, paper_motions, planar_features
from numpy.testing import assert_allclose, assert_array_equal

import manip_learn as ml
from manip_learn.errors import NotFittedError, NotIdentifiableError
from manip_learn.experiments.paper_setup import Setup, demonstrate
from manip_learn.linalg import orthonormal_rows, row_space_angle


def free_direction_error(learner: ml.ConstraintLearner, truth: np.ndarray) -> float:
    """Angle [deg] between the one free direction and the true one."""
    (free,) = np.array(learner.report_.free_directions)
    truth = truth / np.linalg.norm(truth)
    return float(np.degrees(np.arcsin(min(1.0, np.linalg.norm(free - (free @ truth) * truth)))))


def test_the_drawer():
    """Fifty physical drawers: two rows in the world's frame, free direction within 0.1 degrees of the true one. The
    wrist, 0.1 m behind the grip, is held only roughly: a weak gap, an uncertainty that says so, a warning. `strength`
    is the least that a row must show: what is known beyond doubt stays until more is wanted.
    """
    features, demos = arm_features(), ml.load_demonstrations("sawyer_drawer", ml.load_robot("sawyer"))
    learner = ml.ConstraintLearner(features).fit(demos)
    report = learner.report_
    assert (report.n_constraints, report.kind, report.warnings) == (2, "motion-constrained", ())
    truth = np.array([np.cos(np.radians(25)), np.sin(np.radians(25)), 0.0])
    assert (error := free_direction_error(learner, truth)) < 0.01 and report.gap > 100.0
    assert report.sentence == (
        "The tip can move along (0.91, 0.42, 0.00) and is blocked across it. It looks like a straight line (a drawer). "
        "Direction known to 0.11 degrees."
    )
    assert 0.5 * error < report.uncertainty["noise"] < 2.0 * error and 0.001 < report.uncertainty_deg < 0.2
    shown = learner.constraint_.shown
    assert shown is not None and shown.path[0] == shown.time[0] == 0.0 and shown.path[-1] > 0.15
    assert all(np.all(np.diff(take.time) > 0.0) for take in learner.skill_.steps[-1].takes)
    wrist = ml.ConstraintLearner(ml.FrameJacobian(features.robot, "right_hand")).fit(demos[:25]).report_
    assert 2.0 < wrist.gap < 10.0 and wrist.uncertainty_deg > 0.3 and any("weak gap" in w for w in wrist.warnings)
    usual = ml.ConstraintLearner(features).fit(demos[:5]).report_
    two = ml.ConstraintLearner(features).fit(demos[:2]).report_  # which agree, and whose errors are known from both
    assert two.n_constraints == 2 and 0.2 < two.uncertainty["noise"] / usual.uncertainty["noise"] < 5.0
    assert two.mechanism.uncertainty["axis"] == pytest.approx(two.uncertainty_deg, rel=0.1)
    least = min(row.strength for row in usual.row_evidence[:2])
    strict = ml.ConstraintLearner(features, strength=0.2 * least).fit(demos[:5]).report_
    assert strict.n_constraints == usual.n_constraints == 2
    with pytest.raises(NotIdentifiableError, match=r"no row is confirmed"):
        ml.ConstraintLearner(features, strength=10.0 * least).fit(demos[:5])


@pytest.mark.parametrize(
    ("axes", "free"), [("xyz", [0.2588, 0.1677, 0.9513]), ("pose", [0.0855, 0.0554, 0.3142, 0.5860, 0.6848, -0.2802])]
)
def test_the_door_is_constant_in_the_tools_frame(axes: str, free: list[float]):
    """Doors and flaps: among both references the local one is chosen, and the free twist is right to 0.1 degrees. No
    mechanism is named: what the four doors have in common is no plane of the four flaps.
    """
    robot, candidates = ml.load_robot("sawyer"), [arm_features(axes, reference) for reference in ("world", "local")]
    learner = ml.ConstraintLearner(candidates[:: -1 if axes == "pose" else 1]).fit(
        ml.load_demonstrations("sawyer_door", robot)
    )
    report = learner.report_
    assert report.reference == "local" and report.gap > 100.0 and report.mechanism is None
    assert free_direction_error(learner, np.array(free)) < 0.1


def test_refusal_of_the_last_candidate_does_not_hide_an_answer():
    """Of several feature maps those that refuse are passed over; if all refuse, the reason of the first is given."""
    features, (demos, _) = planar_features(), paper_motions([0, 1], np.random.default_rng(74), 30)
    flat = ml.FrameJacobian(features.robot, "tip", "z")
    assert ml.ConstraintLearner([flat, features]).fit(demos).constraint_.features is features
    with pytest.raises(NotIdentifiableError, match="zero"):
        ml.ConstraintLearner([flat]).fit(demos)


def test_nothing_is_learnt_before_a_fit():
    """What was learnt is asked for too early: the error says what to call, and `hasattr` answers no."""
    learner = ml.ConstraintLearner(planar_features())
    for name in ("constraint_", "constraints_", "report_", "reports_"):
        assert not hasattr(learner, name)
        words = rf"call learner.fit\(demonstrations\) first: {name} exists only after it"
        with pytest.raises(NotFittedError, match=words):
            getattr(learner, name)
    with pytest.raises(AttributeError, match="'report'"):
        getattr(learner, "report")  # noqa: B009


def test_a_policy_model_that_is_none():
    """Refused with its name, where a policy is learnt."""
    demos, truth = paper_motions([0, 1], np.random.default_rng(75), 20)
    with pytest.raises(NotIdentifiableError, match="'sextic'"):
        ml.ConstraintLearner(truth.features, estimator="joint", policy_model="sextic").fit(demos)


# ---- what every estimator promises --------------------------------------------------------------------------------

# name -> (estimator, whether the rows are held, accuracy on clean motions [deg])
ESTIMATORS = {
    "null-space": ("null-space", True, 1e-3),
    "joint": ("joint", False, 1e-3),
    "auto on held motions": ("auto", True, 1e-3),
    "auto on moved motions": ("auto", False, 1e-3),
    "separate": ("separate", False, 10.0),  # the paper's own route: its policy model never fits exactly
}
# what each way to an answer must show on its own; of the others one keeps each in the quick run
OWN = {"one row", "the same again", "nothing moves", "of the other kind", "as many rows as joints", "a single one"}
# oblique on purpose: no axis of its own
TWO_ROWS = orthonormal_rows(np.array([[1.0, 0.2, 0.3], [-0.3, 0.9, 0.2]]))
ONE_ROW = orthonormal_rows(np.array([[0.5, 1.0, -0.4]]))
PLANAR, JOINTS = planar_features(), planar_features().robot.joint_names


@cache
def motions(held: bool, rows: str = "two", n: int = 24, points: int = 12, seed: int = 0) -> ml.Demonstrations:
    """A planar arm that reaches for targets along the rows, or that is pushed about while these are held."""
    selection = {"two": TWO_ROWS, "one": ONE_ROW, "turn": np.eye(3)[2:], "place": np.eye(3)[:2]}[rows]
    rng = np.random.default_rng(seed)
    if held:
        return scale_motions.motions(PLANAR, selection, rng, n, points, held=True)
    return demonstrate(Setup("x y", n, points), selection, rng)


def learner(name: str, features: ml.FeatureMap = PLANAR, n: int | None = None) -> ml.ConstraintLearner:
    return ml.ConstraintLearner(features, n, estimator=ESTIMATORS[name][0], velocities="recorded")  # type: ignore[arg-type]


@cache
def clean(name: str) -> ml.ConstraintLearner:
    """Fitted to the default motions."""
    return learner(name).fit(motions(ESTIMATORS[name][1]))


def degrees(found: ml.ConstraintLearner, rows: np.ndarray) -> float:
    return float(np.degrees(row_space_angle(found.constraint_.selection, rows)))


def mapped(given: ml.Demonstrations, **change: Callable[[ml.Trajectory], Any]) -> ml.Demonstrations:
    """ml.Demonstrations in which each field named becomes the function of the trajectory that is given for it."""
    made = [dataclasses.replace(t, exact=False, **{f: make(t) for f, make in change.items()}) for t in given]
    return ml.Demonstrations(made)


def of_each(cases: dict[str, Any]):
    """Every estimator with every case, the quick ones with every change."""
    return pytest.mark.parametrize(
        ("name", "what"),
        [
            pytest.param(name, what, id=f"{name}: {what}", marks=() if quick else pytest.mark.slow)
            for name in ESTIMATORS
            for what in cases
            for quick in [name == "null-space" or what in OWN]
        ],
    )


class Bad(NamedTuple):
    """ml.Demonstrations that nobody may answer, or not without a word, unless with these rows."""

    given: Callable[[bool], Any]
    features: ml.FeatureMap = PLANAR
    n: int | None = None
    refused: bool = True
    unless: Callable[[bool], np.ndarray | None] = lambda held: None


def noise(held: bool) -> ml.Demonstrations:
    """Velocities of nothing."""
    rng = np.random.default_rng(6)
    return mapped(motions(held), u=lambda t: rng.standard_normal(t.q.shape))


def nan_somewhere(q: np.ndarray) -> np.ndarray:
    return PLANAR(q) * (np.nan if q[0] in {motions(held)[2].q[4, 0] for held in (True, False)} else 1.0)


ARM = ml.FrameJacobian(ml.load_robot("sawyer"), "right_hand", "xyz")
BAD = {
    "none": Bad(lambda held: []),
    "too few samples": Bad(lambda held: motions(held, n=2, points=2)),
    "nothing moves": Bad(lambda held: mapped(motions(held), u=lambda t: 0.0 * t.u)),
    "features that are not finite": Bad(motions, ml.CustomFeatures(nan_somewhere, PLANAR.row_names, 3)),
    "another robot": Bad(motions, ARM),
    "joints in another order": Bad(lambda held: mapped(motions(held), joint_names=lambda t: JOINTS[::-1])),
    "as many rows as joints": Bad(motions, n=3),
    "a posture that never changes": Bad(
        lambda held: mapped(motions(held), q=lambda t: np.tile(motions(held)[0].q[0], (len(t), 1))), refused=False
    ),
    "without any constraint": Bad(noise, refused=False),
    # motion outside of both rows is the policy's in either half; but there is no row that both halves hold
    "two constraints, half of the motions each": Bad(
        lambda held: [*motions(held, "one"), *motions(held, "turn", seed=8)],
        refused=False,
        unless=lambda held: None if held else np.concatenate([ONE_ROW, np.eye(3)[2:]]),
    ),
    "more rows than there are": Bad(lambda held: motions(held, "one"), n=2, refused=False),
    "fewer rows than there are": Bad(motions, n=1, refused=False),
    "of the other kind": Bad(lambda held: motions(not held), refused=False, unless=lambda held: TWO_ROWS),
    "a single one": Bad(lambda held: motions(held, n=1, points=200), refused=False),
    "one row": Bad(lambda held: motions(held, "one", n=60), refused=False, unless=lambda held: ONE_ROW),
}


@pytest.mark.timeout(300)
@of_each(BAD)
def test_nothing_wrong_is_answered_in_silence(name: str, what: str):
    """Refused with a reason; or, where there is an answer, right or with a warning."""
    bad, (_, held, accuracy) = BAD[what], ESTIMATORS[name]
    found = learner(name, bad.features, bad.n)
    try:
        found.fit(bad.given(held))
    except ml.ManipLearnError as refusal:
        assert len(str(refusal)) >= 20
        return
    assert not bad.refused
    rows = bad.unless(held)
    assert found.report_.warnings or (rows is not None and degrees(found, rows) <= accuracy)


# the same demonstrations otherwise: to the last bit where no accuracy [deg] is given, by the time stamps if need be
SAME: dict[str, tuple[Callable[[ml.Demonstrations], Any], float | None]] = {
    "the same again": (lambda given: given, None),
    "as lists": (lambda given: mapped(given, q=lambda t: t.q.tolist(), u=lambda t: t.u.tolist()), None),
    "made later": (lambda given: mapped(given, time=lambda t: t.time + 1.7e9), 0.0),
    "a hundred times faster": (lambda given: mapped(given, u=lambda t: 100 * t.u, time=lambda t: t.time / 100), 1e-3),
    "in single precision": (
        lambda given: mapped(given, q=lambda t: t.q.astype(np.float32), u=lambda t: t.u.astype(np.float32)), 0.01
    ),
    "of all lengths": (
        lambda given: [*(t.part(slice(0, 1 + (5 * i) % len(t))) for i, t in enumerate(given)), *given[:15]], 1e-3
    ),
}  # fmt: skip


@of_each(SAME)
def test_what_an_answer_does_not_depend_on(name: str, what: str):
    """Lists, clock, pace and number of samples leave the answer, and the report, as they are."""
    change, accuracy = SAME[what]
    _, held, least = ESTIMATORS[name]
    expected, found = clean(name), learner(name).fit(change(motions(held)))
    if accuracy:
        assert degrees(found, TWO_ROWS) <= max(accuracy, 2.0 * least if accuracy == 0.01 else least)
        return
    allowed = 1e-6 if accuracy == 0.0 else 0.0  # stamps of 1.7e9 s are known to 2e-7 s only
    assert_allclose(found.constraint_.selection, expected.constraint_.selection, rtol=0, atol=allowed)
    if accuracy is None:
        reports = [repr(dataclasses.replace(x.report_, seconds=0.0)) for x in (found, expected)]
        assert reports[0] == reports[1]  # as text: NaN is not equal to itself


@pytest.mark.parametrize("name", ["null-space", "joint"])
def test_what_the_rows_are_does_not_matter(name: str):
    """Units of the rows change the columns of Lambda, nothing else; rows of zero are left out, and said."""
    given, units, accuracy = motions(ESTIMATORS[name][1]), np.array([0.01, 100.0, 57.3]), ESTIMATORS[name][2]
    other = ml.CustomFeatures(lambda q: units[:, None] * PLANAR(q), PLANAR.row_names, 3)
    assert degrees(learner(name, other).fit(given), TWO_ROWS / units) <= 100.0 * accuracy
    found = learner(name, ml.FrameJacobian(PLANAR.robot, "tip", "pose")).fit(given)
    assert degrees(found, np.insert(TWO_ROWS, [2, 2, 2], 0.0, axis=1)) <= accuracy
    assert any("always zero" in w for w in found.report_.warnings)


@pytest.mark.parametrize("name", ESTIMATORS)
def test_a_clean_motion_is_learnt(name: str):
    """Two oblique rows are found without being told, orthonormal, over the features that were given, with a report that
    is true of the answer and says whether they are held or driven; a copy answers the same.
    """
    (_, held, accuracy), found = ESTIMATORS[name], clean(name)
    given = motions(held)
    assert found.report_.kind == ("motion-constrained" if held else "self-imposed")
    assert (found.report_.estimator == "null-space") == held
    report, selection = found.report_, found.constraint_.selection
    assert degrees(found, TWO_ROWS) <= accuracy and not report.warnings
    assert_allclose(selection @ selection.T, np.eye(2), rtol=0, atol=1e-12)
    assert not selection.flags.writeable
    assert found.constraint_.features is PLANAR and report.row_names == PLANAR.row_names and report.sentence
    assert (report.n_constraints, report.n_samples, report.n_trajectories) == (2, given.n_samples, len(given))
    assert_allclose(selection @ np.array(report.free_directions).T, 0.0, atol=1e-9)
    assert sum(report.excitation.values()) == pytest.approx(1.0)
    assert copy.deepcopy(found).report_ == report


def test_a_fit_forgets_the_one_before_and_keeps_nothing_of_the_callers():
    """A second fit answers as if it were the first, one that refuses leaves no answer behind; arrays are left alone,
    what becomes of them later does not matter, and notes are kept.
    """
    arrays = [(t.time.copy(), t.q.copy(), np.array(t.u)) for t in motions(True)]
    given = ml.Demonstrations([ml.Trajectory(*array, JOINTS) for array in arrays], ["the first second was cut off"])
    found = learner("null-space").fit(motions(True, "place", seed=3))
    shares: list[float] = []
    assert found.fit(given, progress=lambda _stage, share: shares.append(share)) is found
    assert shares == sorted(shares) and shares[-1] == 1.0 and "the first second was cut off" in found.report_.notes
    for (time, q, u), t in zip(arrays, motions(True), strict=True):
        for array, kept in ((time, t.time), (q, t.q), (u, t.u)):
            assert_array_equal(array, kept)
            array[:] = 0.0
    assert_array_equal(found.constraint_.selection, clean("null-space").constraint_.selection)
    with pytest.raises(ml.ManipLearnError):
        found.fit(mapped(motions(True), u=lambda t: 0.0 * t.u))
    assert not {"constraint_", "report_"} & set(vars(found))
