"""The learner as a whole, on motions that it was not tuned on and on the recordings that are shipped."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
import pytest
from generated_motions import (
    PLANAR_ROWS,
    angle_deg,
    arm_features,
    guided_motions,
    oblique,
    paper_motions,
    planar_features,
)

from manip_learn.constraint.constraint import Constraint
from manip_learn.constraint.features import CustomFeatures, FrameJacobian
from manip_learn.errors import FeatureError, NotFittedError, NotIdentifiableError
from manip_learn.experiments.metrics import manipulability_along, nmie
from manip_learn.learning import ConstraintLearner
from manip_learn.recordings import load_demonstrations
from manip_learn.recordings.trajectory import Demonstrations
from manip_learn.robot.loading import load_robot

RECORDINGS = Path(__file__).resolve().parents[1] / "examples" / "data"


@cache
def shipped(folder: str, robot: str) -> Demonstrations:
    how = "recorded" if folder == "planar3_reach" else "auto"  # Euler steps
    return load_demonstrations(sorted((RECORDINGS / folder).glob("*.csv")), load_robot(robot), velocities=how)


def nmie_along(demos: Demonstrations, truth: Constraint, learnt: Constraint) -> float:
    """NMIE over all samples."""
    q = np.concatenate([t.q for t in demos])
    return nmie(*(manipulability_along(c.features, c.selection, q) for c in (truth, learnt)))


def free_direction_error(learner: ConstraintLearner, truth: np.ndarray) -> float:
    """Angle [deg] between the one free direction and the true one."""
    (free,) = np.array(learner.report_.free_directions)
    truth = truth / np.linalg.norm(truth)
    return float(np.degrees(np.arcsin(min(1.0, np.linalg.norm(free - (free @ truth) * truth)))))


@pytest.mark.parametrize(
    ("rows", "model", "allowed"), [("xy", "auto", 1e-25), ("x-theta", "rbf", 1e-10), ("y-theta", "affine", 1e-25)]
)
def test_the_papers_setup(rows: str, model: str, allowed: float):
    """Reaching with unknown targets, raw u, 1,000 points: both rows found, NMIE at rounding, on test motions."""
    demos, truth = paper_motions(PLANAR_ROWS[rows], np.random.default_rng(41))
    test, _ = paper_motions(PLANAR_ROWS[rows], np.random.default_rng(42), n_trajectories=20)
    learner = ConstraintLearner(truth.features, policy_model=model).fit(demos)
    assert learner.report_.n_constraints == 2
    assert learner.report_.kind == "self-imposed"
    assert not learner.report_.warnings
    assert nmie_along(test, truth, learner.constraint_) <= allowed


@pytest.mark.parametrize("s", [1, 2])
@pytest.mark.parametrize(("noise", "allowed_deg"), [(0.0, 1e-10), (0.05, 0.5)])
def test_an_arm_held_along_oblique_rows(s: int, noise: float, allowed_deg: float):
    """Seven joints, b = 0: number of rows found, row space right in proportion to the noise."""
    rng = np.random.default_rng(50)
    demos, truth = guided_motions(arm_features(), oblique(s, 3, rng), rng, noise=noise, n_points=25)
    learner = ConstraintLearner(truth.features).fit(demos)
    assert learner.report_.kind == "motion-constrained"
    assert angle_deg(learner.constraint_, truth) <= allowed_deg


@pytest.mark.parametrize(("noise", "allowed_deg"), [(0.01, 1.0), (0.05, 5.0)])
def test_noise_on_the_papers_setup(noise: float, allowed_deg: float):
    """Self-imposed rows under noise: the number is found, and the row space is right in proportion to the noise."""
    demos, truth = paper_motions([0, 1], np.random.default_rng(60), noise=noise)
    learner = ConstraintLearner(truth.features).fit(demos)
    assert learner.report_.n_constraints == 2
    assert angle_deg(learner.constraint_, truth) <= allowed_deg


def test_ten_per_cent_noise_is_not_answered_proudly():
    """With 10 % noise the paper's setup has a weak gap, and the report says so."""
    demos, truth = paper_motions([0, 1], np.random.default_rng(70), noise=0.1)
    learner = ConstraintLearner(truth.features, n_constraints=2).fit(demos)
    assert any("weak gap" in w for w in learner.report_.warnings)
    assert learner.report_.uncertainty_deg > 0.5


def test_it_finds_out_whether_the_rows_are_held():
    """The same arm and policy as above with b = 0 in place of b = r* - r: told apart, and right."""
    demos, truth = paper_motions([0, 1], np.random.default_rng(71), gain=0.0)
    learner = ConstraintLearner(truth.features).fit(demos)
    assert learner.report_.estimator == "null-space"
    assert angle_deg(learner.constraint_, truth) < 1e-9


def test_the_drawer():
    """Fifty physical drawers: two rows in the world's frame, free direction within 0.1 degrees of the true one."""
    features = FrameJacobian(load_robot("sawyer"), "right_gripper_tip")
    learner = ConstraintLearner(features).fit(shipped("sawyer_drawer", "sawyer"))
    report = learner.report_
    assert (report.n_constraints, report.kind, report.warnings) == (2, "motion-constrained", ())
    truth = np.array([np.cos(np.radians(25)), np.sin(np.radians(25)), 0.0])
    assert (error := free_direction_error(learner, truth)) < 0.01
    assert report.gap > 100.0
    assert report.sentence == (
        "The tip can move along (0.91, 0.42, 0.00) and is blocked across it. It looks like a straight line (a drawer). "
        "Direction known to 0.11 degrees."
    )
    assert 0.5 * error < report.uncertainty["noise"] < 2.0 * error
    assert 0.001 < report.uncertainty_deg < 0.2


def test_the_wrong_frame_of_the_drawer_warns():
    """The wrist, 0.1 m behind the grip, is held only roughly: a weak gap, an uncertainty that says so, a warning."""
    features = FrameJacobian(load_robot("sawyer"), "right_hand")
    learner = ConstraintLearner(features).fit(shipped("sawyer_drawer", "sawyer")[:25])
    report = learner.report_
    assert 2.0 < report.gap < 10.0
    assert any("weak gap" in w for w in report.warnings)
    assert report.uncertainty_deg > 0.3


@pytest.mark.parametrize(
    ("axes", "free"), [("xyz", [0.2588, 0.1677, 0.9513]), ("pose", [0.0855, 0.0554, 0.3142, 0.5860, 0.6848, -0.2802])]
)
def test_the_door_is_constant_in_the_tools_frame(axes: str, free: list[float]):
    """Doors and flaps: among both references the local one is chosen, and the free twist is right to 0.1 degrees. No
    mechanism is named: what the four doors have in common is no plane of the four flaps.
    """
    robot = load_robot("sawyer")
    candidates = [FrameJacobian(robot, "right_gripper_tip", axes, reference) for reference in ("world", "local")]
    learner = ConstraintLearner(candidates[:: -1 if axes == "pose" else 1]).fit(shipped("sawyer_door", "sawyer"))
    assert learner.report_.reference == "local"
    assert learner.report_.gap > 100.0
    assert learner.report_.mechanism is None
    assert free_direction_error(learner, np.array(free)) < 0.1


def test_the_planar_reach():
    """The recorded control law, printed to seven digits: rows x and y, NMIE <= 1e-9 on its own states."""
    demos = shipped("planar3_reach", "planar3")
    learner = ConstraintLearner(planar_features()).fit(demos)
    _, truth = paper_motions([0, 1], np.random.default_rng(0), n_trajectories=1, n_points=1)
    assert learner.report_.n_constraints == 2
    assert nmie_along(demos, truth, learner.constraint_) < 1e-9
    assert learner.report_.sentence.startswith("The tip is steered on purpose along x and y; it can turn about z.")


def test_rows_of_no_frame_are_found_beside_those_of_a_frame():
    """One joint goes back twice as far as another goes on, and the hand is held nowhere: the rows of one's own win."""
    robot, rng, rows = load_robot("sawyer"), np.random.default_rng(3), np.zeros((3, 7))
    rows[0, [1, 3]], rows[1, [0, 5]], rows[2, [2, 4]] = (1.0, 2.0), (1.0, -1.0), (1.0, 1.0)
    time, across, demos = np.arange(0.0, 4.0, 0.01), np.eye(7) - np.outer(rows[0], rows[0]) / 5.0, []
    for _ in range(6):
        waves = [np.sin(rng.uniform(0.5, 2.0) * time + rng.uniform(0.0, 6.0)) for _ in range(4)]
        way = sum(np.outer(wave, rng.normal(0.0, 0.25, 7)) for wave in waves) @ across
        demos.append((time, rng.uniform(-0.4, 0.4, 7) + way - way[0] + rng.normal(0.0, 1e-5, way.shape)))
    own = CustomFeatures(lambda q: rows, ("a", "b", "c"), 7)
    report = ConstraintLearner([FrameJacobian(robot, "right_gripper_tip"), own]).fit(demos).report_
    assert report.row_names == ("a", "b", "c") and report.n_constraints == 1 and not report.warnings


def test_refusal_of_the_last_candidate_does_not_hide_an_answer():
    """Of several feature maps those that refuse are passed over; if all refuse, the reason of the first is given."""
    rng = np.random.default_rng(74)
    features = planar_features()
    flat = FrameJacobian(features.robot, "tip", "z")
    demos, _ = paper_motions([0, 1], rng, n_trajectories=30)
    assert ConstraintLearner([flat, features]).fit(demos).constraint_.features is features
    with pytest.raises(NotIdentifiableError, match="zero"):
        ConstraintLearner([flat]).fit(demos)


def test_nothing_is_learnt_before_a_fit():
    """What was learnt is asked for too early: the error says what to call, and `hasattr` answers no."""
    learner = ConstraintLearner(planar_features())
    for name in ("constraint_", "constraints_", "report_", "reports_"):
        assert not hasattr(learner, name)
        with pytest.raises(NotFittedError, match=rf"call learner.fit\(demonstrations\) first: there is no {name}"):
            getattr(learner, name)
    with pytest.raises(AttributeError, match="'report'"):
        getattr(learner, "report")  # noqa: B009


def test_settings_out_of_range():
    """Unknown words, no features, and numbers that are none or too small: refused at once, each by its name."""
    features = planar_features()
    for words, settings in {
        "'magic'": {"estimator": "magic"},
        "phases must be 'auto' or 'off'": {"phases": "often"},
        "velocities must be one of": {"velocities": "guessed"},
        "at least one": {"features": []},
        "where features belong": {"features": [3]},
        "between 1 and 3": {"n_constraints": 4},
        "an integer": {"n_constraints": 1.5},
    }.items():
        with pytest.raises(FeatureError, match=words):
            ConstraintLearner(**{"features": features, **settings})  # type: ignore[arg-type]
    least = {
        "strength": 0.5,
        "switching_cost": -1.0,
        "joint_offset_std": -0.1,
        "link_error_std": -0.1,
        "max_samples": 99,
    }
    for name, bad in least.items():
        for value in (bad, np.nan, np.inf, True, "some"):
            with pytest.raises(FeatureError, match=f"{name} must be"):
                ConstraintLearner(features, **{name: value})
    demos, _ = paper_motions([0, 1], np.random.default_rng(75), n_trajectories=20)
    with pytest.raises(NotIdentifiableError, match="'sextic'"):
        ConstraintLearner(features, estimator="joint", policy_model="sextic").fit(demos)


def test_a_user_may_ask_for_more_evidence():
    """`strength` is the least that a row must show: what is known beyond doubt stays until more is wanted."""
    demos = shipped("sawyer_drawer", "sawyer")[:5]
    features = FrameJacobian(load_robot("sawyer"), "right_gripper_tip", axes="xyz")
    usual = ConstraintLearner(features).fit(demos).report_
    least = min(row.strength for row in usual.row_evidence[:2])
    strict = ConstraintLearner(features, strength=0.2 * least).fit(demos).report_
    assert strict.n_constraints == usual.n_constraints == 2
    with pytest.raises(NotIdentifiableError, match=r"is the least that counts"):
        ConstraintLearner(features, strength=10.0 * least).fit(demos)
