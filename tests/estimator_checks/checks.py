"""What every estimator of a constraint must do with good, bad and odd demonstrations: checks to run on your own.

In the spirit of scikit-learn's check_estimator. A learner may answer, answer with warnings in its report, or refuse
with an error of this library; what it may never do is give a wrong answer in silence.
"""

from __future__ import annotations

from collections.abc import Iterable
from inspect import isfunction, signature

from estimator_checks import answers, invariance, refusals
from estimator_checks.motions import MotionKind
from estimator_checks.subject import Check, EstimatorCheckError, MakeLearner, Subject


def checks() -> dict[str, Check]:
    """Name -> check, all there are: what three modules define that takes a subject alone."""
    parts = (answers, invariance, refusals)
    functions = {name: each for part in parts for name, each in vars(part).items() if isfunction(each)}
    return {
        name: each
        for name, each in functions.items()
        if name[0] != "_" and list(signature(each).parameters) == ["subject"]
    }


def check_learner(
    make: MakeLearner, kind: MotionKind = "held", *, accuracy_deg: float = 1e-3, only: Iterable[str] | None = None
) -> tuple[str, ...]:
    """Run the contract's checks on an estimator of your own.

    Args:
        make: (features, n_constraints or None) -> a new learner, e.g.
            `lambda features, n: ConstraintLearner(features, n, estimator="joint")`.
        kind: Motions that it is made for: `"held"` (the world holds the rows, b = 0) or `"moved"`.
        accuracy_deg: How far from the truth [deg] an answer to clean motions may be.
        only: Names of the checks to run; all by default.

    Returns:
        The names of the checks that were run; every one holds.

    Raises:
        EstimatorCheckError: Names every check that does not hold, and why.
    """
    subject, known = Subject(make, kind, accuracy_deg), checks()
    names = tuple(known) if only is None else tuple(only)
    unknown = [name for name in names if name not in known]
    if unknown:
        raise EstimatorCheckError(f"unknown check {unknown[0]!r}: there are {', '.join(known)}")
    failures = []
    for name in names:
        try:
            known[name](subject)
        except EstimatorCheckError as error:
            failures.append(f"{name}: {error}")
    if failures:
        raise EstimatorCheckError(f"{len(failures)} of {len(names)} checks do not hold:\n" + "\n".join(failures))
    return names
