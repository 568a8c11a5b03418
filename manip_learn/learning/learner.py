"""Demonstrations -> Constraint, with the evidence."""

from __future__ import annotations

import dataclasses
import inspect
import math
import time
from collections.abc import Sequence
from contextlib import suppress
from functools import partial
from typing import TYPE_CHECKING, Any, Literal, final, get_args

import numpy as np

from manip_learn.constraint.constraint import Constraint
from manip_learn.constraint.features.feature_map import FeatureMap
from manip_learn.constraint.skill import Skill
from manip_learn.errors import (
    FeatureError,
    NotFittedError,
    NotIdentifiableError,
    NumberOfConstraintsError,
    RecordingError,
    advice,
    an,
    listed,
)
from manip_learn.learning.answer import EstimatorName, LearnerSettings, find_answers
from manip_learn.learning.arm_errors import ArmErrors
from manip_learn.learning.checks import check_fastest, refuse_noise, refuse_still_hand
from manip_learn.learning.explanation.evidence import SWITCH_NATS
from manip_learn.learning.explanation.findings import Findings, Part, find
from manip_learn.learning.origin import made
from manip_learn.learning.recombination import BELIEVED_STRENGTH
from manip_learn.learning.repeats import IndependentRecordings
from manip_learn.learning.report import LearningReport, RecordingOverview, advise, build_report
from manip_learn.learning.skill import skill_of
from manip_learn.learning.thinning import MOST_SAMPLES, EvenChoice, read_evenly
from manip_learn.linalg import one_thread
from manip_learn.recordings.given import Given, check_joints, parts_of, recordings_given
from manip_learn.recordings.load import Progress, Reader
from manip_learn.recordings.options import Velocities
from manip_learn.recordings.trajectory import Demonstrations
from manip_learn.recordings.velocities import with_velocities
from manip_learn.robot import html_card
from manip_learn.robot.robot import Robot

_ESTIMATORS = ("auto", "joint", "null-space", "separate")
Switch = Literal["auto", "off"]
SWITCHES = ("auto", "off")
_LEARNT = ("constraint_", "constraints_", "report_", "reports_", "skill_")  # there after `fit` only


@final
class ConstraintLearner:
    """Learns Lambda of A(q) = Lambda Phi(q) from demonstrations.

    Args:
        features: Phi; or several candidates (e.g. the same axes in the world's and in the tool's frame), of which the
            one with the larger gap wins.
        n_constraints: Number of rows s; found from the data by default.
        estimator: `"null-space"` for motions that the world constrains (b = 0); `"joint"` for motions whose
            constrained rows the demonstrator moves on purpose (b unknown, a null-space policy that depends on the
            posture); `"separate"` for the paper's own route; `"auto"` selects the first or the second from the data.
        policy_model: Joint estimator: `"auto"` (a general prior), `"constant"`, `"affine"`, `"quadratic"`, `"cubic"`,
            `"rbf"`, or `"affine-offset"` (affine, with a separate rest posture for each trajectory).
        velocities: `"auto"` and `"derive"`: derived from the positions, whatever was recorded; `"recorded"`: recorded
            ones as they are.
        phases: `"auto"` looks for the stretches in which a constraint holds where no single one fits the recordings;
            `"off"` takes every recording as a whole.
        mechanism: `"auto"` looks for a mechanism (line, plane, hinge, ball, screw, held orientation) where Phi is a
            `FrameJacobian`; `"off"` does not.
        strength: How much less than by chance a row must be used, with 99 % confidence, to be believed. A larger number
            refuses more, a smaller one believes more; free motion reaches 1.5 now and then.
        switch: What a change between a contact and free motion costs [nats]. A larger number finds fewer and longer
            phases: 16 is a chance of exp(-16) for each tenth of a second, that of a change in some months.
        habits: Whether rows that may be kept by the way of moving only are learnt beside those that are clearly held;
            they are named in any case.
        most_samples: Of more samples so many are chosen evenly. More of them take time and teach next to nothing:
            their half turns a drawer by 0.0005 degrees.
        zeros: Standard deviation [deg] of the errors of the joints' zeros, as it is thought of the arm beforehand: an
            industrial arm has 0.05 to 0.2, one of hobby servos 1. The recordings correct it where they show the errors.
            0: an arm whose joints and links are as described, unless the recordings show that they are not.
        links: The same of its links [mm and mrad]: of the place and the turn of each joint seen from the one before.
        seed: Seed of everything random (bootstrap, recombination, random starts, k-means).

    Attributes:
        constraint_: The learnt `Constraint`, after `fit`: the best supported one.
        constraints_: Every constraint that was found, clear ones first, then best supported first.
        report_: The evidence for the first, a `LearningReport`, after `fit`.
        reports_: One report per constraint.
        skill_: The constraints in the order in which they were shown, with what was done along each: a `Skill`.

    Raises:
        FeatureError: No features, features that are something else, or settings out of range.
        NotFittedError: What was learnt is asked for before `fit`.

    Example:
        >>> import numpy as np
        >>> import manip_learn as ml
        >>> robot = ml.load_robot("sawyer")
        >>> demos = ml.load_demonstrations("sawyer_drawer", robot)[:6]  # or a folder of your own
        >>> features = ml.FrameJacobian(robot, "right_gripper_tip", axes="xyz")
        >>> learner = ml.ConstraintLearner(features).fit(demos)
        >>> learner.report_.n_constraints, learner.report_.gap > 10.0  # two directions are held, clearly
        (2, True)
        >>> np.abs(learner.report_.free_directions).round(2)  # the drawer opens along this one
        array([[0.91, 0.42, 0.  ]])
    """

    constraint_: Constraint
    constraints_: tuple[Constraint, ...]
    report_: LearningReport
    reports_: tuple[LearningReport, ...]
    skill_: Skill

    def __init__(
        self,
        features: FeatureMap | Sequence[FeatureMap],
        n_constraints: int | None = None,
        estimator: EstimatorName = "auto",
        *,
        policy_model: str = "auto",
        velocities: Velocities = "auto",
        phases: Switch = "auto",
        mechanism: Switch = "auto",
        strength: float = BELIEVED_STRENGTH,
        switch: float = SWITCH_NATS,
        habits: bool = False,
        most_samples: int = MOST_SAMPLES,
        zeros: float = 0.1,
        links: float = 0.5,
        seed: int = 0,
    ):
        for name, value in (("phases", phases), ("mechanism", mechanism)):
            if value not in SWITCHES:
                asked = advice("{}", name, f"--{name}") or name
                raise FeatureError(f"{asked} must be 'auto' or 'off', not {value!r}")
        if estimator not in _ESTIMATORS:
            asked = advice("{}", "estimator", "--estimator") or "estimator"
            raise FeatureError(f"{asked} must be one of {', '.join(_ESTIMATORS)}, not {estimator!r}")
        self.features = features
        self.n_constraints = n_constraints
        self.estimator: EstimatorName = estimator
        self.policy_model = policy_model
        if velocities not in (choices := get_args(Velocities)):
            raise FeatureError(f"velocities must be one of {', '.join(choices)}, not {velocities!r}")
        self.velocities: Velocities = velocities
        self.phases: Switch = phases
        self.mechanism: Switch = mechanism
        for name, number, what, least in (
            ("strength", strength, "", 1),
            ("switch", switch, " of nats", 0),
            ("zeros", zeros, " of degrees", 0),
            ("links", links, " of mm and mrad", 0),
        ):
            if isinstance(number, bool) or not isinstance(number, int | float) or not least <= number < math.inf:
                raise FeatureError(f"{name} must be a finite number{what} of at least {least}, got {number!r}")
        if isinstance(most_samples, bool) or not isinstance(most_samples, int) or most_samples < 100:
            raise FeatureError(f"most_samples must be an integer of at least 100, got {most_samples!r}")
        self.strength, self.switch, self.most_samples = float(strength), float(switch), most_samples
        self.zeros, self.links = float(zeros), float(links)
        self.habits, self.seed = bool(habits), seed
        candidates = [features] if not isinstance(features, Sequence) else list(features)
        if not candidates:
            raise FeatureError("give the learner at least one feature map")
        for given in candidates:
            if not isinstance(given, FeatureMap):
                raise FeatureError(
                    f'call ConstraintLearner(features), e.g. of FrameJacobian(robot, frame="tool"): got {an(given)} '
                    "where features belong"
                )
        if n_constraints is not None and (isinstance(n_constraints, bool) or not isinstance(n_constraints, int)):
            raise FeatureError(f"n_constraints must be an integer or None, got {n_constraints!r}")
        for candidate in candidates:
            most = min(candidate.n_rows, candidate.nv)
            if n_constraints is not None and not 1 <= n_constraints <= most:
                raise NumberOfConstraintsError(n_constraints, most, repr(candidate))
        self._feature_maps = candidates

    def fit(
        self, demonstrations: Given, *others: object, client: Any = None, progress: Progress | None = None
    ) -> ConstraintLearner:
        """Learn from demonstrations; a second fit forgets the first.

        At most 20,000 samples are learnt from. Of more, that many are chosen evenly while they are read, so that
        recordings that are not in memory need none.

        Args:
            demonstrations: `Demonstrations`; or a trajectory; or arrays `(time, q)` or `(time, q, u)`, one column per
                joint in the robot's order [s, rad or m]; or a data frame of pandas; or a list of these; or an iterable
                of motions, which is read once; or a `manip_learn.RecordingSource`, for files larger than memory.
            others: Nothing: `fit(q, u)`, as other libraries have it, is answered with what to write.
            client: A `dask.distributed.Client` whose workers read the parts of a source and choose from them; the
                answer does not depend on their number. What is in memory needs none.
            progress: Called with what is being done and the share of it that is done.

        Raises:
            NotIdentifiableError: The demonstrations do not determine a constraint; says why.
            RecordingError: They cannot be used (no velocities to be had, outliers, another robot's joints).
            ManipLearnError: Workers of the client die again and again, or their scheduler does.
        """
        self._forget()
        if others:  # fit(X, y), as other libraries have it
            raise RecordingError(
                f"fit takes all recordings as one argument: got {listed(map(an, (demonstrations, *others)))}; "
                "write fit((time, q, u)) for the arrays of one recording, fit([(time, q, u), ...]) for several, time "
                "in seconds",
                code="type",
            )
        given = self._given(demonstrations)
        if not isinstance(given, Demonstrations):
            given = read_evenly(self._choose, given, client, progress).demonstrations
        self._learn(given)
        if progress is not None:
            progress("learning", 1.0)
        return self

    def _given(self, demonstrations: Given) -> Demonstrations | list[Reader]:
        """What was given, with the joints of the features."""
        for features in self._feature_maps:
            robot = getattr(features, "robot", None)
            if robot is not None and self._robot is not None:
                check_joints(self._robot.joint_names, robot)
        return recordings_given(demonstrations, self._robot, self._feature_maps[0].nv, self.velocities)

    def _learn(self, given: Demonstrations) -> None:
        """What repeats counts once -> one table -> what explains it -> a constraint for each part -> reports."""
        with one_thread():
            started = time.perf_counter()
            recordings = IndependentRecordings.of(given)
            demonstrations = with_velocities(recordings.demonstrations, self._robot, self.velocities)
            refuse_noise(recordings.demonstrations)
            check_fastest(demonstrations)
            refuse_still_hand(self._feature_maps[0], demonstrations)
            few = self._choose(*parts_of(demonstrations))
            demonstrations, recordings = few.demonstrations, recordings.only([k.number for k in few.kept])
            everything = Part.of_all(demonstrations, self._feature_maps)
            arm = ArmErrors(math.radians(self.zeros), 1e-3 * self.links)
            settings = LearnerSettings(
                self.n_constraints,
                self.estimator,
                self.policy_model,
                self.seed,
                mechanism=self.mechanism == "auto",
                strength=self.strength,
                habits=self.habits,
                arm=arm,
            )
            findings = self._explained(everything)
            findings = dataclasses.replace(findings, warnings=(*recordings.warnings, *findings.warnings))
            try:
                answers, findings = find_answers(findings, everything, settings)
            except NotIdentifiableError as refusal:

                def fits(rows: FeatureMap) -> bool:
                    other = dataclasses.replace(everything, feature_maps=(rows,), asked=(rows,))
                    found = self._explained(other)
                    with suppress(NotIdentifiableError):
                        return found.explained and bool(find_answers(found, other, settings)[0])
                    return False

                why = advise(refusal, everything, findings, fits, recordings=recordings, phases=self.phases)
                raise why from refusal
            overview = RecordingOverview.of(answers, findings, recordings)
            names = demonstrations.joint_names
            origin = made(given, self._settings)
            learnt = [build_report(answer, overview, names, arm, started, origin) for answer in answers]
            self.constraints_, self.reports_ = zip(*learnt, strict=True)
            self.constraint_, self.report_ = learnt[0]
            self.skill_ = skill_of(self.constraints_, answers)

    def _explained(self, everything: Part) -> Findings:
        """What explains the recordings; everything is one part where the demonstrator is said to impose the rows."""
        if self.estimator in ("joint", "separate"):
            return Findings((everything,))
        return find(
            everything,
            np.random.default_rng(self.seed),
            switch=self.switch if self.phases == "auto" else math.inf,
            mechanisms=self.mechanism == "auto" and self.n_constraints is None,
            strength=self.strength,
        )

    @property
    def _settings(self) -> dict[str, Any]:
        """Arguments of the constructor, as they can be written down; the features stand in the constraint itself."""
        names = [name for name in inspect.signature(type(self)).parameters if name != "features"]
        return {name: getattr(self, name) for name in names}

    @property
    def _choose(self) -> partial[EvenChoice]:
        derive = partial(with_velocities, robot=self._robot, velocities=self.velocities)
        return partial(EvenChoice, self.most_samples, derive)

    @property
    def _robot(self) -> Robot | None:
        return getattr(self._feature_maps[0], "robot", None)

    if not TYPE_CHECKING:  # else every name would be an attribute

        def __getattr__(self, name: str) -> Any:
            if name in _LEARNT:
                raise NotFittedError(name)
            gone = ": keep the recordings in a list and call fit again" if name == "partial_fit" else ""  # until 0.4
            raise AttributeError(f"{type(self).__name__} has no attribute {name!r}{gone}", name=name, obj=self)

    def _forget(self) -> None:
        """A fit that refuses must not leave the answer to other demonstrations behind."""
        for learnt in _LEARNT:
            vars(self).pop(learnt, None)

    def __repr__(self) -> str:
        return f"ConstraintLearner({self.features!r}, n_constraints={self.n_constraints}, estimator={self.estimator!r})"

    def _repr_html_(self) -> str:
        report = vars(self).get("report_")
        return (
            html_card.card("Nothing is learnt yet", html_card.sentence(repr(self)))
            if report is None
            else report._repr_html_()
        )
