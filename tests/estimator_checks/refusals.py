"""The part of the contract about bad input: what must be refused, and what must not be answered in silence."""

from __future__ import annotations

import numpy as np

from estimator_checks.motions import (
    ONE_ROW,
    TWO_ROWS,
    changed,
    mapped,
    planar_features,
    planar_motion,
    velocities,
)
from estimator_checks.subject import Subject
from manip_learn.constraint.features.frame_jacobian import FrameJacobian
from manip_learn.constraint.features.other_features import CustomFeatures
from manip_learn.errors import ManipLearnError
from manip_learn.recordings.trajectory import Trajectory
from manip_learn.robot.loading import load_robot


def no_demonstrations(subject: Subject) -> None:
    """Nothing to learn from: refused."""
    subject.must_refuse(planar_features(), lambda: [])


def no_trajectories_at_all(subject: Subject) -> None:
    """Numbers, text or None where trajectories belong: refused, by an error of this library."""
    for nonsense in (None, "demo.csv", 3.0, [np.zeros((5, 3))]):
        subject.must_refuse(planar_features(), lambda given=nonsense: given)


def one_row(subject: Subject) -> None:
    """A single sample: refused."""
    motion = subject.motion()
    subject.must_refuse(motion.features, lambda: [motion.demonstrations[0].part(slice(0, 1))])


def too_few_samples(subject: Subject) -> None:
    """Fewer samples than unknowns: refused."""
    motion = subject.motion(n_trajectories=2, n_points=2)
    subject.must_refuse(motion.features, lambda: motion.demonstrations)


def one_column(subject: Subject) -> None:
    """A system with one joint: a constraint leaves it no freedom; refused."""
    features = CustomFeatures(lambda q: np.array([[1.0 + 0.1 * q[0]]]), ("x",), 1)
    wave = np.sin(np.arange(60.0))[:, None]
    subject.must_refuse(features, lambda: [Trajectory(np.arange(60.0), wave, wave + k, ("j",)) for k in range(5)])


def zero_actions(subject: Subject) -> None:
    """Nothing moves: any constraint has a perfect training cost; refused."""
    motion = subject.motion()
    subject.must_refuse(motion.features, lambda: mapped(motion.demonstrations, u=lambda t: 0.0 * velocities(t)))


def constant_state(subject: Subject) -> None:
    """Velocities, but a posture that never changes: not silently."""
    motion = subject.motion()
    posture = motion.demonstrations[0].q[0]
    still = mapped(motion.demonstrations, q=lambda t: np.tile(posture, (len(t), 1)))
    subject.must_not_be_silent(motion.features, lambda: still)


def duplicated_rows(subject: Subject) -> None:
    """Three samples, two hundred times: as little as three; refused."""
    motion = subject.motion(n_points=3)
    few = motion.demonstrations[0]
    copies = [changed(few, time=few.time + 10.0 * k, name=f"copy {k}") for k in range(200)]
    subject.must_refuse(motion.features, lambda: copies)


def rows_with_nan(subject: Subject) -> None:
    """NaN or infinity in positions, velocities or time: refused."""
    motion = subject.motion()
    for field in ("q", "u", "time"):
        for value in (np.nan, np.inf):
            spoiled = np.array(getattr(motion.demonstrations[0], field))
            spoiled[3] = value
            subject.must_refuse(
                motion.features,
                lambda f=field, s=spoiled: [changed(motion.demonstrations[0], **{f: s}), *motion.demonstrations[1:]],
            )


def features_with_nan(subject: Subject) -> None:
    """Features that are not finite somewhere on the motion: refused."""
    motion = subject.motion()
    worst = float(motion.demonstrations[2].q[4, 0])
    features = CustomFeatures(
        lambda q: motion.features(q) * (np.nan if q[0] == worst else 1.0), motion.features.row_names, 3
    )
    subject.must_refuse(features, lambda: motion.demonstrations)


def outlier_in_velocity(subject: Subject) -> None:
    """One velocity of 1e8: not silently."""
    motion = subject.motion()
    u = velocities(motion.demonstrations[4])
    u[5, 1] = 1e8
    wrong = [changed(t, u=u) if i == 4 else t for i, t in enumerate(motion.demonstrations)]
    subject.must_not_be_silent(motion.features, lambda: wrong)


def velocities_of_other_samples(subject: Subject) -> None:
    """Velocities shuffled among the samples, so that they have nothing to do with the postures: not silently."""
    motion, rng = subject.motion(), np.random.default_rng(5)
    u = rng.permutation(np.concatenate([velocities(t) for t in motion.demonstrations]))
    parts = np.split(u, np.cumsum([len(t) for t in motion.demonstrations])[:-1])
    mixed = [changed(t, u=part) for t, part in zip(motion.demonstrations, parts, strict=True)]
    subject.must_not_be_silent(motion.features, lambda: mixed)


def random_motion(subject: Subject) -> None:
    """Velocities without any constraint: not silently."""
    motion, rng = subject.motion(), np.random.default_rng(6)
    noise = mapped(motion.demonstrations, u=lambda t: rng.standard_normal(t.q.shape))
    subject.must_not_be_silent(motion.features, lambda: noise)


def two_constraints_mixed(subject: Subject) -> None:
    """Half of the demonstrations obey one row, half another: not silently; or both rows, where the task moves them.

    (Motion outside of both rows is the policy's in either half; but there is no row that both halves hold.)
    """
    other = np.array([[0.0, 0.0, 1.0]])
    first, second = subject.motion(selection=ONE_ROW), subject.motion(selection=other, seed=8)
    both = np.concatenate([ONE_ROW, other]) if subject.kind == "moved" else None
    subject.must_not_be_silent(first.features, lambda: [*first.demonstrations, *second.demonstrations], unless=both)


def features_of_another_robot(subject: Subject) -> None:
    """Features of a robot with other joints: refused."""
    motion = subject.motion()
    other = FrameJacobian(load_robot("sawyer"), "right_hand", "xyz")
    subject.must_refuse(other, lambda: motion.demonstrations)


def features_of_another_size(subject: Subject) -> None:
    """Features that act on another number of velocities: refused, also without joint names to compare."""
    motion = subject.motion()
    features = CustomFeatures(lambda q: np.ones((2, 4)), ("a", "b"), 4)
    subject.must_refuse(features, lambda: motion.demonstrations)


def joints_in_another_order(subject: Subject) -> None:
    """Joint names of the robot in another order: refused, never read as if they were in its own."""
    motion = subject.motion()
    names = motion.demonstrations.joint_names[::-1]
    subject.must_refuse(motion.features, lambda: mapped(motion.demonstrations, joint_names=lambda t: names))


def rows_that_are_zero(subject: Subject) -> None:
    """Axes along which the frame cannot move: refused."""
    motion = subject.motion()
    flat = FrameJacobian(motion.features.robot, "tip", "z rx ry")  # type: ignore[attr-defined]
    subject.must_refuse(flat, lambda: motion.demonstrations)


def as_many_constraints_as_joints(subject: Subject) -> None:
    """Rows that would leave no freedom: refused."""
    motion = subject.motion()
    subject.must_refuse(motion.features, lambda: motion.demonstrations, 3)


def more_constraints_than_there_are(subject: Subject) -> None:
    """Two rows asked for where one holds: not silently."""
    motion = subject.motion(selection=ONE_ROW)
    subject.must_not_be_silent(motion.features, lambda: motion.demonstrations, 2)


def fewer_constraints_than_there_are(subject: Subject) -> None:
    """One row asked for where two hold: not silently."""
    motion = subject.motion(selection=TWO_ROWS)
    subject.must_not_be_silent(motion.features, lambda: motion.demonstrations, 1)


def motion_of_the_other_kind(subject: Subject) -> None:
    """b = 0 for an estimator that looks for b, and b != 0 for one that does not: right, or not silently."""
    motion = planar_motion("held" if subject.kind == "moved" else "moved")
    subject.must_not_be_silent(motion.features, lambda: motion.demonstrations, unless=motion.selection)


def stiction(subject: Subject) -> None:
    """One joint of an arm with seven moves at a time: friction looks like a constraint; not silently."""
    robot, rng = load_robot("sawyer"), np.random.default_rng(9)
    middle = 0.5 * (robot.position_lower + robot.position_upper)
    recorded = []
    for k in range(12):
        q, u = np.tile(middle, (28, 1)), np.zeros((28, 7))
        for joint in rng.permutation(7)[:4]:
            u[4 * joint : 4 * joint + 4, joint] = rng.uniform(-0.5, 0.5)
        q += rng.uniform(-0.3, 0.3, 7) + 0.02 * np.cumsum(u, axis=0)
        recorded.append(Trajectory(0.02 * np.arange(28), q, u, robot.joint_names, f"stiff {k}"))
    subject.must_not_be_silent(FrameJacobian(robot, "right_hand", "xyz"), lambda: recorded)


def joint_that_never_moved(subject: Subject) -> None:
    """What an arm did not try cannot be told from what it could not do: not silently."""
    motion, rng = subject.motion(), np.random.default_rng(10)

    def without_the_first(n: int) -> np.ndarray:
        u = np.sin(0.02 * np.arange(n)[:, None] * rng.uniform(1.0, 5.0, 3) + rng.uniform(0.0, 6.0, 3))
        u[:, 0] = 0.0
        return u

    stuck = mapped(motion.demonstrations, u=lambda t: without_the_first(len(t)))
    subject.must_not_be_silent(motion.features, lambda: stuck)


def one_trajectory(subject: Subject) -> None:
    """A single demonstration, however long: not silently."""
    motion = subject.motion(n_trajectories=1, n_points=200)
    subject.must_not_be_silent(motion.features, lambda: motion.demonstrations)


def after_a_refusal_there_is_no_old_answer(subject: Subject) -> None:
    """A fit that refuses leaves no constraint of an earlier fit behind."""
    motion = subject.motion()
    learner = subject.fitted(motion.features, motion.demonstrations)
    try:
        learner.fit(mapped(motion.demonstrations, u=lambda t: 0.0 * velocities(t)))
    except ManipLearnError:
        if "constraint_" in vars(learner) or "report_" in vars(learner):
            subject.broken("constraint_ or report_ of an earlier fit is still there after a refusal")
        return
    subject.broken("must refuse zero actions in a second fit too")
