"""An estimator under check, and what the checks of its contract ask of it."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal, NoReturn, Protocol, final

import numpy as np

from estimator_checks.motions import Motion, MotionKind, planar_motion
from manip_learn.constraint.constraint import Constraint
from manip_learn.constraint.features.feature_map import FeatureMap
from manip_learn.errors import ManipLearnError
from manip_learn.learning.report import LearningReport
from manip_learn.linalg import row_space_angle
from manip_learn.recordings.trajectory import Trajectory

Verdict = Literal["accepted", "warned", "refused"]
# what bad input must not end in
FOREIGN = (ArithmeticError, AttributeError, LookupError, MemoryError, RuntimeError, TypeError, ValueError, Warning)


class Learner(Protocol):
    """What `ConstraintLearner` is, seen from the contract."""

    constraint_: Constraint
    report_: LearningReport

    def fit(self, demonstrations: Any) -> Any:
        """Learn; returns itself."""


MakeLearner = Callable[[FeatureMap | Sequence[FeatureMap], int | None], Learner]
Check = Callable[["Subject"], None]


class EstimatorCheckError(Exception):
    """An estimator does not do what every estimator must."""


@final
@dataclass(frozen=True)
class Outcome:
    """What came of a fit.

    Attributes:
        verdict: `"accepted"`, `"warned"` or `"refused"`.
        learner: The fitted learner; None if it refused.
        message: Of the refusal or the warnings.
    """

    verdict: Verdict
    learner: Learner | None
    message: str


@final
@dataclass(frozen=True)
class Subject:
    """The estimator under check.

    Attributes:
        make: (features, n_constraints or None) -> a new learner.
        kind: Motions that it is made for: `"held"` (b = 0) or `"moved"` (b unknown).
        accuracy_deg: How far from the truth a right answer on clean motions may be.
    """

    make: MakeLearner
    kind: MotionKind
    accuracy_deg: float

    def motion(self, **settings: Any) -> Motion:
        """A clean motion of its own kind, see `planar_motion`."""
        return planar_motion(self.kind, **settings)

    @cached_property
    def clean(self) -> tuple[Motion, Learner]:
        """The default motion with a learner fitted to it, for checks that change neither."""
        motion = self.motion()
        return motion, self.fitted(motion.features, motion.demonstrations)

    def fitted(
        self, features: FeatureMap, demonstrations: Iterable[Trajectory], n_constraints: int | None = None
    ) -> Learner:
        """A learner fitted to demonstrations that it must answer."""
        outcome = self.outcome(features, lambda: demonstrations, n_constraints)
        if outcome.learner is None:
            self.broken(f"refused good demonstrations: {outcome.message}")
        return outcome.learner

    def outcome(
        self, features: FeatureMap, demonstrations: Callable[[], Any], n_constraints: int | None = None
    ) -> Outcome:
        """What comes of a fit; the demonstrations are made inside, as making them may be refused already."""
        try:
            learner = self.make(features, n_constraints)
            learner.fit(demonstrations())
        except ManipLearnError as error:
            return Outcome("refused", None, str(error))
        except FOREIGN as error:
            self.broken(f"{type(error).__name__} instead of an error of manip_learn: {error}", error)
        warnings = learner.report_.warnings
        return Outcome("warned" if warnings else "accepted", learner, "; ".join(warnings))

    def must_refuse(
        self, features: FeatureMap, demonstrations: Callable[[], Any], n_constraints: int | None = None
    ) -> None:
        """Only a refusal with a reason will do."""
        outcome = self.outcome(features, demonstrations, n_constraints)
        if outcome.verdict != "refused":
            self.broken(f"must refuse, but {outcome.verdict} it {outcome.message}".rstrip())
        if len(outcome.message) < 20:
            self.broken(f"refused without a reason: {outcome.message!r}")

    def must_not_be_silent(
        self,
        features: FeatureMap,
        demonstrations: Callable[[], Any],
        n_constraints: int | None = None,
        unless: np.ndarray | None = None,
    ) -> None:
        """A refusal or a warning; or the right answer, where there is one."""
        outcome = self.outcome(features, demonstrations, n_constraints)
        if outcome.verdict != "accepted" or outcome.learner is None:
            return
        found = outcome.learner.constraint_.selection
        if unless is None or self.angle_deg(found, unless) > self.accuracy_deg:
            self.broken(f"accepted it in silence and answered {np.round(found, 4).tolist()}")

    def must_agree(self, learner: Learner, selection: np.ndarray, accuracy_deg: float | None = None) -> None:
        """The row space learnt is the one expected."""
        allowed = self.accuracy_deg if accuracy_deg is None else accuracy_deg
        angle = self.angle_deg(learner.constraint_.selection, selection)
        if not angle <= allowed:
            self.broken(f"the answer is {angle:.3g} degrees off, {allowed:g} are allowed")

    @staticmethod
    def angle_deg(found: np.ndarray, expected: np.ndarray) -> float:
        """Largest principal angle [deg]; 90 if the numbers of rows differ."""
        return float(np.degrees(row_space_angle(found, expected)))

    def broken(self, what: str, cause: BaseException | None = None) -> NoReturn:
        """The check has failed."""
        raise EstimatorCheckError(what) from cause
