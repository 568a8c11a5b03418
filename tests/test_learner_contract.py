"""The contract that every estimator must keep: the library's own checks on the library's own estimators."""

from __future__ import annotations

import numpy as np
import pytest
from estimator_checks import answers, invariance, refusals
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
PARTS = {part.__name__.rpartition(".")[2]: set(vars(part)) for part in (answers, invariance, refusals)}


def make(name: str):
    return lambda features, n: ConstraintLearner(features, n, estimator=ESTIMATORS[name][0], velocities="recorded")


@pytest.mark.timeout(300)
@pytest.mark.parametrize("part", PARTS)
@pytest.mark.parametrize("quick", [True, pytest.param(False, marks=pytest.mark.slow)])
@pytest.mark.parametrize("name", ESTIMATORS)
def test_contract(name: str, part: str, quick: bool):
    """Each estimator keeps each point of the contract; those that it does not keep are named."""
    own = QUICK.get(name, OWN - SEARCHED)
    only = [check for check in checks() if check in PARTS[part] and (check in own) == quick]
    _, kind, accuracy = ESTIMATORS[name]
    assert check_learner(make(name), kind, accuracy_deg=accuracy, only=only) == tuple(only)


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


GOOD = list(Subject(make("null-space"), "held", 1e-3).motion().demonstrations)


def test_the_contract_bites():
    """An estimator that believes a perfect training cost does not pass: one run names every check that does not hold,
    with its reason, and none that does; names that do not exist are refused.
    """
    bad = ["zero_actions", "duplicated_rows", "random_motion", "no_trajectories_at_all", "one_row"]
    with pytest.raises(EstimatorCheckError) as caught:
        check_learner(Gullible, only=[*bad, "rows_are_orthonormal"])
    message = str(caught.value)
    assert message.startswith("5 of 6 checks do not hold") and "rows_are_orthonormal" not in message
    assert all(f"\n{name}: " in message for name in bad) and "zero_actions: must refuse" in message
    with pytest.raises(EstimatorCheckError, match="unknown check 'typo'"):
        check_learner(make("joint"), only=["typo"])
