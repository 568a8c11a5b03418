"""The uncertainty that is reported is the error that is made, where the joints' zeros are off, too."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest
from generated_motions import PLANAR_ROWS, angle_deg, arm_features, guided_motions, oblique, paper_motions
from scipy.spatial.transform import Rotation
from task_sets import arm, generated

from manip_learn.constraint.constraint import Constraint
from manip_learn.constraint.features import CustomFeatures, FrameJacobian
from manip_learn.constraint.features.mechanism_rows import MechanismRows
from manip_learn.learning import ConstraintLearner
from manip_learn.learning.fit import Motion, RowFit, changes_by_links, errors_of, groups_of
from manip_learn.learning.report import JOINT_ZEROS, NOISE, PARTS, POLICY, parts_in_words
from manip_learn.learning.table import ArmErrors, Settings, Stretch, Table, View
from manip_learn.linalg import orthonormal_rows
from manip_learn.recordings.trajectory import Demonstrations, Trajectory
from manip_learn.robot.robot import Robot


def held(seed: int, offset: float, noise: float = 0.005, motions: int = 10):
    """Ten motions of an arm with two held rows, and its joints' zeros off by Gaussian offsets [rad]."""
    rng = np.random.default_rng([61, seed])
    demos, truth = guided_motions(arm_features(), oblique(2, 3, rng), rng, motions, 20, 0.05, noise=noise)
    delta = offset * rng.standard_normal(7)
    shifted = [replace(t, q=t.q + delta) for t in demos]
    return Demonstrations(shifted), truth, delta


def learnt(demos, truth, **settings):
    """Two held rows of cut recordings."""
    return ConstraintLearner(truth.features, 2, "null-space", phases="off", mechanism="off", **settings).fit(demos)


def ratios(offset: float, sets: int, **settings) -> tuple[np.ndarray, np.ndarray]:
    """The true angle over the stated one, and the true share of mu over the stated one at the median posture."""
    angles, mu = [], []
    for seed in range(sets):
        demos, truth, delta = held(seed, offset)
        learner = learnt(demos, truth, **settings)
        angles.append(angle_deg(learner.constraint_, truth) / learner.report_.uncertainty_deg)
        few = np.concatenate([t.q for t in demos])[::7]
        off = [learner.constraint_.manipulability(q) / truth.manipulability(q - delta) - 1.0 for q in few]
        mu.append(np.median(np.abs(off)) / learner.report_.mu_uncertainty)
    return np.array(angles), np.array(mu)


@pytest.mark.parametrize("zeros", [0.1, pytest.param(1.0, marks=pytest.mark.slow)])
def test_an_arm_as_far_off_as_was_said_is_within_what_is_stated(zeros: float):
    """Zeros off by what the learner was told: angle and mu within what is stated in two of three of 20 sets, within
    twice that in nine of ten, and not by stating everything: the median is no less than a third of it.
    """
    for ratio in ratios(np.radians(zeros), 20, zeros=zeros, links=0.0):
        assert np.mean(ratio <= 1.0) >= 0.5 and np.mean(ratio <= 2.0) >= 0.9
        assert np.median(ratio) > 0.2


def test_a_doors_mu_is_within_what_is_stated():
    """Zeros off by 0.3 degrees, as the learner was told: within twice what is stated, and that is no more than 20 %."""
    truth, made = generated("door", "panda", 2031, 5, whole=False)
    robot, door = arm("panda"), truth["mechanisms"][0]
    delta = np.radians(0.3) * np.random.default_rng(2031).standard_normal(robot.nv)
    demos = [Trajectory(t.time, t.q + delta, None, robot.joint_names, t.name) for t in made]
    learner = ConstraintLearner(FrameJacobian(robot, truth["tip"]), zeros=0.3, links=0.0).fit(demos)
    rows = MechanismRows(robot, truth["tip"], "radial axial", axis=door["axis"], point=door["point"])
    true, few = Constraint(np.eye(2), rows), np.concatenate([t.q for t in made])[::29]
    assert learner.report_.n_constraints == 2 and learner.report_.mechanism.type == "hinge"
    off = [learner.constraint_.manipulability(q + delta) / true.manipulability(q) - 1.0 for q in few]
    assert np.median(np.abs(off)) < 2.0 * learner.report_.mu_uncertainty < 0.2
    assert ", mu to " in learner.report_.known_to()


def test_what_no_residual_shows_is_as_large_as_was_said():
    """The zero of the first joint turns all rows; it is stated as large as the prior is, and more than for an arm that
    is as described. mu does not care how the base stands.
    """
    demos, truth, _ = held(11, 0.0)
    stated = {zeros: learnt(demos, truth, zeros=zeros, links=0.0).report_ for zeros in (0.0, 0.2, 2.0)}
    parts = [report.uncertainty[JOINT_ZEROS] for report in stated.values()]
    assert parts[0] < 0.05 < 0.1 < parts[1] < 0.6 and parts[2] > 4.0 * parts[1]
    assert stated[2.0].uncertainty[NOISE] == stated[0.0].uncertainty[NOISE]
    turned = [replace(t, q=t.q + np.eye(7)[0]) for t in demos]
    mu = [learnt(Demonstrations(d), truth).constraint_.manipulability(d[0].q[3]) for d in (demos, turned)]
    assert mu[1] == pytest.approx(mu[0], rel=1e-6)


def test_what_is_thought_of_the_arm_is_stated():
    """Without noise and zeros nothing is left over to tell errors of the arm from; with a prior they are as was said,
    and wider by half with links that are ten times as far off, which are not thought of without zeros.
    """
    demos, truth, _ = held(12, 0.0, noise=0.0)
    assert learnt(demos, truth, zeros=0.0, links=5.0).report_.uncertainty[JOINT_ZEROS] == 0.0
    wide = [learnt(demos, truth, zeros=0.1, links=links).report_.uncertainty[JOINT_ZEROS] for links in (0.0, 0.5, 5.0)]
    assert 0.05 < wide[0] <= 1.05 * wide[1] and 1.5 * wide[1] < wide[2]


PLACE = {"axis": [0.3, 0.4, 0.5], "point": [0.2, 0.1, 0.0]}
ROWS = {
    "tool": lambda robot: FrameJacobian(robot, "right_gripper_tip", "pose", "local"),
    "hinge": lambda robot: MechanismRows(robot, "right_gripper_tip", "radial axial turn slide", **PLACE),
}


@pytest.mark.parametrize("make", ROWS.values(), ids=ROWS)
def test_links_change_the_rates_of_rows(make, rng):
    """As the differences of arms whose joints, or whose tip, stand a little elsewhere on the link before."""
    robot = arm_features().robot
    tip, q, u = robot.frame("right_gripper_tip"), rng.uniform(-1.0, 1.0, (3, 7)), rng.standard_normal((3, 7))
    changes = changes_by_links(make(robot), q, u)
    joints, size = [*robot.pinocchio_model.supports[tip.parent_joint]][2:], 1e-6
    assert changes.shape[2] == 6 * (len(joints) + 1)
    for number in range(changes.shape[2]):
        rates = []
        for step in (size, -size):
            model, off = pin.Model(robot.pinocchio_model), pin.exp6(step * np.eye(6)[number % 6])
            places, i = (model.jointPlacements, joints[number // 6]) if number < 6 * len(joints) else (None, 0)
            old = model.frames[tip.index].placement if places is None else places[i]
            new = pin.SE3(off.rotation @ old.rotation, old.translation + off.translation)
            if places is None:
                model.frames[tip.index].placement = new
            else:
                places[i] = new
            rates.append(make(Robot(model, mimics=robot.mimics)).batch(q) @ u[:, :, None])
        assert np.abs((rates[0] - rates[1]) / (2.0 * size) - changes[..., number, None]).max() < 1e-7


def test_features_of_no_frame_have_no_links():
    """Rows that somebody wrote know nothing of links."""
    features = CustomFeatures(lambda q: np.eye(3) * q[0], "abc", 3)
    assert changes_by_links(features, np.ones((2, 3)), np.ones((2, 3))).shape == (2, 3, 0)


def fitted(demos, truth) -> tuple[View, RowFit]:
    """Two rows by positions."""
    view = View(truth.features, Table(list(demos)))
    whole = [Stretch(i, *map(float, ends)) for i, ends in enumerate(view.table.ends)]
    motion = Motion.of(view, whole, Settings())
    return view, RowFit(motion, orthonormal_rows(motion.levels.directions[:2])).best()


def test_the_error_of_lambda_is_linear_in_the_offsets():
    """Noise-free and with known small offsets, Lambda turns by what the response foretells, to first order."""
    rng = np.random.default_rng(5)
    demos, truth = guided_motions(arm_features(), oblique(2, 3, rng), rng, 10, 100, 0.01)
    delta = 1e-4 * rng.standard_normal(7)
    view, fit = fitted([replace(t, q=t.q + delta) for t in demos], truth)
    G, m = np.sum([*fit.G.values()], axis=0), fit.m
    foretold = np.linalg.solve(G[:m, :m], G[:m, m : m + 7]) @ delta
    true = truth.selection @ np.linalg.pinv(view.W)
    # the truth beside the learnt rows: (1, B) with learnt + B perp
    B = np.linalg.solve(true @ fit.rows.T, true @ fit.perp.T).reshape(-1)
    assert np.linalg.norm(B - foretold) < 0.1 * np.linalg.norm(B)


@pytest.mark.parametrize("apart", [0.0, 2.0])
def test_recordings_that_share_a_place_are_one_group(apart):
    """Whatever the joints' zeros; of two pairs of rows some degrees apart each recording is in the group of its own."""
    rng, given = np.random.default_rng(4), []
    selection = oblique(2, 3, rng)
    turn = Rotation.from_rotvec(np.radians(apart) * np.cross(*selection)[[1, 2, 0]]).as_matrix()
    zeros = np.radians(0.5) * rng.standard_normal(7)
    for rows in (selection, selection @ turn.T):
        demos, truth = guided_motions(arm_features(), rows, rng, 4, 200, 0.01)
        given += [replace(t, q=t.q + zeros + rng.normal(0.0, 1e-4, t.q.shape)) for t in demos]
    _, fit = fitted(given, truth)
    assert sorted(map(sorted, groups_of(fit))) == ([list(range(8))] if not apart else [[0, 1, 2, 3], [4, 5, 6, 7]])


@pytest.mark.parametrize("apart", [0.0, 5e-3])
def test_the_stated_noise_is_the_error_that_is_made(apart):
    """With white noise alone, or with rows that scatter between recordings: over 30 sets the error of Lambda is as
    large as the stated draws, larger than about half of them (0.39 and 0.44). Twice the variance, or a scatter between
    recordings that is counted with a wrong sign, weight or freedom, is far from that.
    """
    ranks = []
    for seed in range(30):
        rng, given = np.random.default_rng([7, seed]), []
        rows = oblique(2, 3, rng)
        for _ in range(6):
            turn = Rotation.from_rotvec(apart * rng.standard_normal(3)).as_matrix()
            demos, truth = guided_motions(arm_features(), rows @ turn.T, rng, 1, 20, 0.05)
            given += [replace(t, q=t.q + rng.normal(0.0, 1e-4, t.q.shape)) for t in demos]
        view, fit = fitted(given, truth)
        true, noise = rows @ np.linalg.pinv(view.W), errors_of(fit, ArmErrors(), rng).noise
        B = np.linalg.solve(true @ fit.rows.T, true @ fit.perp.T).reshape(-1)
        made, stated = (np.einsum("...i,ij,...j", b, np.linalg.inv(np.cov(noise.T)), b) for b in (B, noise))
        ranks.append(np.mean(stated < made))
    assert 0.33 < np.mean(ranks) < 0.58


@pytest.mark.parametrize("motions", [5, 60])
def test_noise_alone_is_no_offset_however_much_is_recorded(motions):
    """Of an arm that nobody thinks to be off: what its zeros may turn the rows by is less than the scatter."""
    for seed in range(2):
        demos, truth, _ = held(200 + seed, 0.0, motions=motions)
        rng = np.random.default_rng(seed)
        noisy = [replace(t, q=t.q + rng.normal(0.0, 1e-3, t.q.shape)) for t in demos]
        _, fit = fitted(noisy, truth)
        errors = errors_of(fit, ArmErrors(), rng)
        zeros, scatter = (np.sqrt(np.mean(B**2)) for B in (errors.arm, errors.noise))
        assert zeros < 0.3 * scatter


def test_the_report_states_the_parts():
    """The total is the root of the sum of squares; what does not apply is None; words, JSON and the file say it."""
    demos, truth, _ = held(9, 2e-3)
    learner = learnt(demos, truth)
    report = learner.report_
    assert tuple(report.uncertainty) == PARTS
    assert report.uncertainty[POLICY] is None
    known = [part for part in report.uncertainty.values() if part is not None]
    assert len(known) == 2 and report.uncertainty_deg == pytest.approx(np.linalg.norm(known))
    assert json.loads(json.dumps(report.to_dict()))["uncertainty"] == report.uncertainty
    assert learner.constraint_.provenance["uncertainty"] == report.uncertainty
    said = report.known_to()
    assert "noise" in said and "joint zeros" in said and "policy" not in said
    assert "not included: a base that stands turned" in said
    assert report.mu_uncertainty is not None and 0.0 < report.mu_uncertainty < 0.1 and ", mu to 0." in said
    assert json.loads(json.dumps(report.to_dict()))["mu_uncertainty"] == report.mu_uncertainty


def test_the_policy_is_a_part_of_the_joint_estimators_angle():
    """With the policy integrated out, and no joint zeros, which the joint estimator leaves out and says so."""
    demos, truth = paper_motions(list(PLANAR_ROWS.values())[0], np.random.default_rng(4), n_trajectories=40, noise=0.01)
    report = ConstraintLearner(truth.features, 2, "joint").fit(demos).report_
    assert report.uncertainty[JOINT_ZEROS] is None
    assert report.uncertainty[POLICY] is not None and report.uncertainty[NOISE] is not None
    assert "not included: joint zeros that are off and a base that stands turned" in report.known_to()


def test_one_trajectory_has_no_parts():
    """None for each, as the total is; rows in the tool's axes do not care how the base stands."""
    demos, truth, _ = held(10, 0.0, motions=1)
    report = learnt(demos, truth).report_
    assert report.uncertainty == dict.fromkeys(PARTS) and report.uncertainty_deg is None
    assert report.mu_uncertainty is None
    parts = {NOISE: 0.01, JOINT_ZEROS: 0.02, POLICY: None}
    assert parts_in_words(parts, "local") == "noise 0.01 degrees, joint zeros 0.02 degrees"


def held_arm(seed: int):
    rng = np.random.default_rng(seed)
    return guided_motions(arm_features(), oblique(2, 3, rng), rng, 10, 12, 0.05, noise=0.02)


def reaching(seed: int):
    rows = list(PLANAR_ROWS.values())[seed % 3]
    return paper_motions(rows, np.random.default_rng(seed), n_trajectories=40, noise=0.01)


@pytest.mark.parametrize(
    ("make", "settings"),
    [
        (held_arm, {"estimator": "null-space", "zeros": 0.0, "phases": "off", "mechanism": "off"}),
        pytest.param(reaching, {"estimator": "joint", "policy_model": "affine"}, marks=pytest.mark.slow),
    ],
    ids=["held arm", "reaching"],
)
def test_the_true_angle_lies_inside_about_two_times_in_three(make, settings):
    """Over two dozen noisy data sets the true angle is below the reported 68 % angle in 50 to 85 % of them."""
    inside, ratios, sets = 0, [], 24
    for seed in range(sets):
        demos, truth = make(7000 + seed)
        learner = ConstraintLearner(truth.features, n_constraints=2, **settings).fit(demos)
        angle, reported = angle_deg(learner.constraint_, truth), learner.report_.uncertainty_deg
        inside += angle <= reported
        ratios.append(angle / reported)
    assert 0.5 <= inside / sets <= 0.85
    assert np.quantile(ratios, 0.95) < 3.0
