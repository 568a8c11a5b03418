"""The contract that every estimator must keep: the library's own checks on the library's own estimators."""

from __future__ import annotations

import numpy as np
import pytest
from estimator_checks.checks import check_learner, checks
from estimator_checks.subject import EstimatorCheckError, Subject

from manip_learn.constraint.constraint import Constraint
from manip_learn.learning import ConstraintLearner

# name -> (estimator, kind of motion, accuracy on clean motions [deg])
ESTIMATORS = {
    "null-space": ("null-space", "held", 1e-3),
    "joint": ("joint", "moved", 1e-3),
    "auto on held motions": ("auto", "held", 1e-3),
    "auto on moved motions": ("auto", "moved", 1e-3),
    "separate": ("separate", "moved", 10.0),  # the paper's own route: its policy model never fits exactly
}


def subject_of(name: str) -> Subject:
    estimator, kind, accuracy = ESTIMATORS[name]
    return Subject(lambda features, n: ConstraintLearner(features, n, estimator=estimator), kind, accuracy)


# what each way to an answer must show on its own; other promises are about what all estimators share, so that one of
# them keeps each in the quick run, and all of them in the long one
OWN = {
    *("clean_motion_is_learnt", "one_row_is_learnt", "report_is_complete", "same_answer_twice", "units_of_the_rows"),
    *("zero_actions", "too_few_samples", "random_motion", "two_constraints_mixed", "motion_of_the_other_kind"),
    *("more_constraints_than_there_are", "as_many_constraints_as_joints", "one_trajectory"),
}
# long searches, which "joint" shows
SEARCHED = {"random_motion", "two_constraints_mixed", "more_constraints_than_there_are", "units_of_the_rows"}
QUICK = {"null-space": set(checks()), "joint": OWN, "auto on held motions": OWN}
CASES = [
    pytest.param(name, check, marks=[] if check in QUICK.get(name, OWN - SEARCHED) else [pytest.mark.slow])
    for name in ESTIMATORS
    for check in checks()
]


@pytest.mark.parametrize(("name", "check"), CASES)
def test_contract(name: str, check: str):
    """Each estimator keeps each point of the contract."""
    checks()[check](subject_of(name))


def test_there_are_at_least_thirty_checks():
    """The battery does not shrink unnoticed; each check says in one sentence what must hold."""
    assert len(checks()) >= 50
    for name, check in checks().items():
        assert check.__name__ == name
        assert check.__doc__ and check.__doc__.strip().splitlines()[0].endswith(".")


class Gullible:
    """An estimator as they are often written: it answers whatever it is given."""

    def __init__(self, features, n_constraints=None):
        self.features, self.n_constraints = features, n_constraints

    def fit(self, demonstrations):
        moments = 0.0
        for t in demonstrations:
            for q, u in zip(t.q, t.u, strict=True):
                r = self.features(q) @ u
                moments = moments + np.outer(r, r)
        selection = np.linalg.eigh(moments)[1].T[: self.n_constraints or 2]
        self.constraint_ = Constraint(selection, self.features)
        self.report_ = ConstraintLearner(self.features).fit(GOOD).report_
        return self


GOOD = list(subject_of("null-space").motion().demonstrations)


@pytest.mark.parametrize(
    "check", ["zero_actions", "duplicated_rows", "random_motion", "no_trajectories_at_all", "one_row"]
)
def test_the_contract_bites(check: str):
    """An estimator that believes a perfect training cost does not pass."""
    with pytest.raises(EstimatorCheckError, match=check):
        check_learner(Gullible, only=[check])


def test_check_learner_runs_what_it_is_asked_for():
    """Users run the checks on their own estimator: it names those that ran; names that do not exist are refused."""
    chosen = ["clean_motion_is_learnt", "zero_actions"]
    make = subject_of("joint").make
    assert check_learner(make, "moved", only=chosen) == tuple(chosen)
    with pytest.raises(EstimatorCheckError, match="unknown check 'typo'"):
        check_learner(make, only=["typo"])


def test_all_failures_are_named():
    """One run tells every check that does not hold, with its reason."""
    with pytest.raises(EstimatorCheckError) as caught:
        check_learner(Gullible, only=["zero_actions", "fit_returns_the_learner", "one_row"])
    message = str(caught.value)
    assert message.startswith("2 of 3 checks do not hold")
    assert "zero_actions: must refuse" in message and "one_row: must refuse" in message
