"""The part of the contract about good input: right answers, told in full, that can be kept and sent."""

from __future__ import annotations

import copy

import numpy as np

from estimator_checks.motions import ONE_ROW, ROUNDING_DEG
from estimator_checks.subject import Subject
from manip_learn.constraint.features.frame_jacobian import FrameJacobian
from manip_learn.constraint.features.other_features import CustomFeatures
from manip_learn.recordings.demonstrations import Demonstrations


def clean_motion_is_learnt(subject: Subject) -> None:
    """Two oblique rows are found without being told, and without a warning; `fit` returns the learner itself."""
    motion, learner = subject.clean
    subject.must_agree(learner, motion.selection)
    if learner.report_.warnings:
        subject.broken(f"warned of a clean motion: {'; '.join(learner.report_.warnings)}")
    if learner.fit(motion.demonstrations) is not learner:
        subject.broken("fit must return the learner itself")


def one_row_is_learnt(subject: Subject) -> None:
    """One oblique row is found without being told, or at least not missed in silence."""
    motion = subject.motion(selection=ONE_ROW, n_trajectories=60)
    subject.must_not_be_silent(motion.features, lambda: motion.demonstrations, unless=motion.selection)


def rows_are_orthonormal(subject: Subject) -> None:
    """Lambda Lambda^T = I, over the very features that were given."""
    motion, learner = subject.clean
    selection = learner.constraint_.selection
    if not np.allclose(selection @ selection.T, np.eye(len(selection)), rtol=0.0, atol=1e-12):
        subject.broken("the rows of the selection matrix are not orthonormal")
    if learner.constraint_.features is not motion.features:
        subject.broken("the constraint has other features than the learner")


def report_is_complete(subject: Subject) -> None:
    """The report names rows and numbers that are true of the answer, and every number in it is finite or absent."""
    motion, learner = subject.clean
    report, selection = learner.report_, learner.constraint_.selection
    if report.n_constraints != len(selection) or report.n_samples != motion.demonstrations.n_samples:
        subject.broken("n_constraints or n_samples of the report do not belong to the answer")
    if report.n_trajectories != len(motion.demonstrations) or report.row_names != motion.features.row_names:
        subject.broken("n_trajectories or row_names of the report do not belong to the answer")
    free = np.array(report.free_directions)
    if free.size and np.max(np.abs(selection @ free.T)) > 1e-9:
        subject.broken("free_directions of the report are not free")
    if abs(sum(report.excitation.values()) - 1.0) > 1e-9 or not report.sentence:
        subject.broken("excitation must sum to 1, and there must be a sentence")


def learner_can_be_copied(subject: Subject) -> None:
    """A copy of a fitted learner (the way pickle makes it too) answers the same, and can be fitted again."""
    motion, learner = subject.clean
    copied = copy.deepcopy(learner)
    q = motion.demonstrations[0].q[3]
    if not np.array_equal(copied.constraint_(q), learner.constraint_(q)) or copied.report_ != learner.report_:
        subject.broken("a copy of the learner is not the same")
    copied.fit(motion.demonstrations)
    subject.must_agree(copied, learner.constraint_.selection, ROUNDING_DEG)


def notes_are_kept(subject: Subject) -> None:
    """What was done to the recordings stands in the report."""
    motion = subject.motion()
    noted = Demonstrations(motion.demonstrations, ["the first second was cut off"])
    if "the first second was cut off" not in subject.fitted(motion.features, noted).report_.notes:
        subject.broken("the notes of the demonstrations are lost")


def planar_arm_in_six_rows(subject: Subject) -> None:
    """All six axes of an arm that moves in a plane: the three that are always zero are left out, and that is said."""
    motion = subject.motion()
    pose = FrameJacobian(motion.features.robot, "tip", "pose")  # type: ignore[attr-defined]
    outcome = subject.outcome(pose, lambda: motion.demonstrations)
    if outcome.verdict != "warned" or outcome.learner is None:
        subject.broken(f"{outcome.verdict} six axes of a planar arm without a word: {outcome.message}")
    found = outcome.learner.constraint_.selection
    if np.max(np.abs(found[:, 2:5])) > 1e-9:
        subject.broken("rows that are always zero take part in the constraint")
    subject.must_agree(outcome.learner, np.insert(motion.selection, [2, 2, 2], 0.0, axis=1))


def repeated_rows(subject: Subject) -> None:
    """A row given twice (Phi of lower rank than rows): the motions that are held stay the same."""
    motion = subject.motion()
    double = CustomFeatures(lambda q: motion.features(q)[[0, 1, 2, 1]], ("x", "y", "rz", "y again"), 3)
    learner = subject.fitted(double, motion.demonstrations)
    q = motion.demonstrations[0].q[0]
    angle = subject.angle_deg(learner.constraint_(q), motion.selection @ motion.features(q))
    if not angle <= 100.0 * subject.accuracy_deg:
        subject.broken(f"a row given twice turns the constraint by {angle:.3g} degrees")


def trajectories_of_all_lengths(subject: Subject) -> None:
    """Demonstrations may be of different lengths, down to a single sample."""
    motion = subject.motion()
    cut = [t.part(slice(0, 1 + (5 * i) % len(t))) for i, t in enumerate(motion.demonstrations)]
    subject.must_agree(subject.fitted(motion.features, [*cut, *motion.demonstrations[:15]]), motion.selection)
