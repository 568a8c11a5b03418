"""The part of the contract about what an answer must not depend on."""

from __future__ import annotations

import copy
import dataclasses

import numpy as np

from estimator_checks.motions import ROUNDING_DEG, changed, mapped, velocities
from estimator_checks.subject import Learner, Subject
from manip_learn.constraint.features.frame_jacobian import FrameJacobian
from manip_learn.constraint.features.other_features import CustomFeatures
from manip_learn.recordings.trajectory import Trajectory


def refit_forgets(subject: Subject) -> None:
    """A second fit gives what it would have given first."""
    first, second = subject.motion(), subject.motion(selection=np.eye(3)[:2], seed=3)
    learner = subject.fitted(first.features, first.demonstrations)
    learner.fit(second.demonstrations)
    _must_equal(subject, learner, subject.fitted(second.features, second.demonstrations))


def same_answer_twice(subject: Subject) -> None:
    """The same demonstrations give the same answer and the same evidence, bit for bit."""
    motion, first = subject.clean
    _must_equal(subject, first, subject.fitted(motion.features, motion.demonstrations))


def input_is_unchanged(subject: Subject) -> None:
    """The caller's arrays are left alone, and later changes to them do not reach the learner."""
    motion = subject.motion()
    arrays = [(t.time.copy(), t.q.copy(), velocities(t)) for t in motion.demonstrations]
    kept = copy.deepcopy(arrays)
    names = motion.demonstrations.joint_names
    learner = subject.fitted(motion.features, [Trajectory(t, q, u, names) for t, q, u in arrays])
    if any(not np.array_equal(x, y) for a, b in zip(arrays, kept, strict=True) for x, y in zip(a, b, strict=True)):
        subject.broken("the caller's arrays were changed")
    before = learner.constraint_.selection.copy()
    for _, q, u in arrays:
        q[:], u[:] = 0.0, 0.0
    if not np.array_equal(before, learner.constraint_.selection):
        subject.broken("the constraint changed with the caller's arrays")


def other_kinds_of_arrays(subject: Subject) -> None:
    """Lists, Fortran order, strides, read-only and big-endian arrays of the same numbers give the same answer."""
    motion, expected = subject.clean
    read_only = [np.array(t.q) for t in motion.demonstrations]
    for array in read_only:
        array.setflags(write=False)
    kinds = {
        "lists": lambda a: a.tolist(),
        "Fortran order": np.asfortranarray,
        "strided": lambda a: np.repeat(a, 2, axis=0)[::2],
        "big-endian": lambda a: a.astype(">f8"),
    }
    for kind, convert in kinds.items():
        same = mapped(motion.demonstrations, q=lambda t, c=convert: c(t.q), u=lambda t, c=convert: c(velocities(t)))
        learner = subject.fitted(motion.features, same)
        if not np.array_equal(learner.constraint_.selection, expected.constraint_.selection):
            subject.broken(f"{kind} give another answer than plain arrays of the same numbers")


def single_precision(subject: Subject) -> None:
    """float32 input is as good as its digits."""
    motion = subject.motion()
    single = mapped(
        motion.demonstrations, q=lambda t: t.q.astype(np.float32), u=lambda t: velocities(t).astype(np.float32)
    )
    subject.must_agree(subject.fitted(motion.features, single), motion.selection, max(0.01, 2.0 * subject.accuracy_deg))


def integers(subject: Subject) -> None:
    """Integer input (ticks of an encoder) gives the answer of the same numbers as floats."""
    motion = subject.motion()
    ticks = CustomFeatures(lambda q: motion.features(1e-6 * q), motion.features.row_names, 3)
    whole = mapped(
        motion.demonstrations,
        q=lambda t: np.rint(1e6 * t.q).astype(np.int64),
        u=lambda t: np.rint(1e6 * velocities(t)).astype(np.int64),
    )
    floats = mapped(whole, q=lambda t: t.q.astype(np.float64), u=lambda t: velocities(t))
    _must_equal(subject, subject.fitted(ticks, whole), subject.fitted(ticks, floats))
    subject.must_agree(subject.fitted(ticks, whole), motion.selection, max(0.01, 2.0 * subject.accuracy_deg))


def time_offset(subject: Subject) -> None:
    """When the recordings were made does not matter."""
    motion, expected = subject.clean
    later = mapped(motion.demonstrations, time=lambda t: t.time + 1.7e9)
    _must_equal(subject, expected, subject.fitted(motion.features, later), same_clock=False)


def order_of_trajectories(subject: Subject) -> None:
    """The order of the demonstrations does not matter."""
    motion = subject.motion()
    shuffled = [motion.demonstrations[i] for i in np.random.default_rng(4).permutation(len(motion.demonstrations))]
    subject.must_agree(subject.fitted(motion.features, shuffled), motion.selection)


def trajectories_twice(subject: Subject) -> None:
    """Every demonstration given twice tells nothing new."""
    motion, once = subject.clean
    again = [changed(t, name=f"{t.name} again") for t in motion.demonstrations]
    twice = subject.fitted(motion.features, [*motion.demonstrations, *again])
    subject.must_agree(twice, once.constraint_.selection, max(ROUNDING_DEG, 2.0 * subject.accuracy_deg))


def faster_motion(subject: Subject) -> None:
    """The same motion a hundred times faster or slower has the same constraint."""
    motion = subject.motion()
    for factor in (0.01, 100.0):
        scaled = mapped(
            motion.demonstrations, u=lambda t, f=factor: f * velocities(t), time=lambda t, f=factor: t.time / f
        )
        subject.must_agree(subject.fitted(motion.features, scaled), motion.selection)


def units_of_the_rows(subject: Subject) -> None:
    """A row in other units changes its column of Lambda, and nothing else: the rows found span the same motions."""
    motion = subject.motion()
    for factors in (np.array([0.01, 1.0, 1.0]), np.array([1.0, 100.0, 57.3])):
        scaled = CustomFeatures(lambda q, f=factors: f[:, None] * motion.features(q), motion.features.row_names, 3)
        learner = subject.fitted(scaled, motion.demonstrations)
        subject.must_agree(learner, motion.selection / factors, 100.0 * subject.accuracy_deg)


def order_of_the_rows(subject: Subject) -> None:
    """Axes named in another order give the columns of Lambda in that order."""
    motion = subject.motion()
    features = FrameJacobian(motion.features.robot, "tip", "rz y x")  # type: ignore[attr-defined]
    subject.must_agree(subject.fitted(features, motion.demonstrations), motion.selection[:, ::-1])


def _must_equal(subject: Subject, one: Learner, other: Learner, *, same_clock: bool = True) -> None:
    if not np.array_equal(one.constraint_.selection, other.constraint_.selection):
        subject.broken("two answers that must be the same differ")
    reports = [dataclasses.replace(learner.report_, seconds=0.0) for learner in (one, other)]
    if not same_clock:
        # stamps of 1.7e9 s are known to 2e-7 s only: what is weighted by the steps between them differs by that
        strengths = [[row.strength for row in report.row_evidence] for report in reports]
        if not np.allclose(*strengths, rtol=1e-3):
            subject.broken("the evidence depends on the clock")
        reports = [dataclasses.replace(report, phases=(), row_evidence=(), evidence="") for report in reports]
    if repr(reports[0]) != repr(reports[1]):  # NaN is not equal to itself
        subject.broken("two reports that must be the same differ")
