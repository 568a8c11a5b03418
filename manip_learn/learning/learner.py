"""Learner of a constraint, its evidence, and the demonstrated skill."""

from __future__ import annotations

import inspect
import math
import time
from collections.abc import Sequence
from functools import partial
from typing import TYPE_CHECKING, Any, Literal, Self, final, get_args

from manip_learn.constraint.constraint import Constraint
from manip_learn.constraint.features.feature_map import FeatureMap
from manip_learn.constraint.skill import Skill
from manip_learn.errors import FeatureError, NotFittedError, NumberOfConstraintsError, RecordingError, advice, an
from manip_learn.learning.answer import Answers, add_advice, learn
from manip_learn.learning.repeats import IndependentRecordings
from manip_learn.learning.report import Context, LearningReport, make_reports
from manip_learn.learning.skill import build_skill
from manip_learn.learning.table import (
    MOST_SAMPLES,
    STRENGTH,
    SWITCH,
    ArmErrors,
    EstimatorName,
    EvenChoice,
    Settings,
    Table,
    read_evenly,
    refuse_unusable,
)
from manip_learn.linalg import one_thread
from manip_learn.recordings.given import Given, check_joints, parts_of, recordings_given
from manip_learn.recordings.load import Progress
from manip_learn.recordings.options import Velocities
from manip_learn.recordings.trajectory import Demonstrations
from manip_learn.recordings.velocities import with_velocities
from manip_learn.robot import html_card
from manip_learn.robot.robot import Robot

Switch = Literal["auto", "off"]
_LEARNT = ("constraint_", "constraints_", "report_", "reports_", "skill_")  # attributes that exist after `fit` only
# former names of arguments, until 0.4
_ALIASES = {"zeros": "joint_offset_std", "links": "link_error_std", "most_samples": "max_samples"}
_ALIASES |= {"switch": "switching_cost", "habits": "keep_habits"}


@final
class ConstraintLearner:
    r"""Learner of task constraints from kinesthetic demonstrations.

    It estimates the selection matrix Lambda of the constraint

    .. math::

        A(q) = \Lambda \, \Phi(q), \qquad A(q) \, u = b

    The learner always searches all six components of the end effector's twist. The axes of `features` only select the
    rows of `constraint_`; `skill_` has all rows.

    Args:
        features: Feature map Phi, e.g. `FrameJacobian`; or several (e.g. the same axes in the world and in the tool
            frame), from which the learner chooses by evidence.
        n_constraints: Number of rows s; None to determine it from the data.
        estimator: `"null-space"` for motions constrained by the environment (b = 0); `"joint"` for motions whose
            constrained rows the demonstrator drives on purpose (b unknown, a null-space policy that depends on the
            configuration); `"separate"` for the method of Manavalan and Howard; `"auto"` selects `"null-space"` or
            `"joint"` from the data.
        policy_model: Null-space policy of the joint estimator: `"auto"` (a general prior), `"constant"`, `"affine"`,
            `"quadratic"`, `"cubic"`, `"rbf"`, or `"affine-offset"` (affine, with a rest configuration of its own for
            each trajectory).
        velocities: `"auto"` and `"derive"`: derived from the positions; `"recorded"`: recorded velocities as they are.
        phases: `"auto"` finds the stretches in which a constraint acts where no single constraint fits the recordings;
            `"off"` treats every recording as one stretch.
        mechanism: `"auto"` identifies a mechanism (line, plane, hinge, ball, screw, held orientation); `"off"` does
            not.
        strength: Smallest ratio with which a row is accepted as constrained, at 99 % confidence: motion along the row
            with joints recombined from different recordings, divided by the recorded motion. A larger value rejects
            more rows; free motion occasionally reaches 1.5.
        switching_cost: Cost of a transition between contact and free motion [nats]. A larger value gives fewer and
            longer phases; 16 is a probability of exp(-16) for each tenth of a second.
        keep_habits: True to also learn rows that may only be habits of the demonstrator; the report names them in both
            cases.
        max_samples: Largest number of samples used; larger sets are subsampled evenly. Using half of the samples
            changes the direction of a drawer by 0.0005 degrees.
        joint_offset_std: Prior standard deviation of the joint offsets [deg]: 0.05 to 0.2 for industrial arms, 1 for
            hobby servos. It is replaced by an estimate if the data show the offsets. With 0, joint offsets and link
            errors are assumed to be zero unless the data show them.
        link_error_std: Prior standard deviation of the link errors [mm and mrad]: position and orientation of each
            joint in the frame of the previous link.
        seed: Seed of all random draws (recombination, uncertainty, random initial guesses).
        **renamed: Former names of arguments, valid until 0.4: `zeros`, `links`, `most_samples`, `switch`, `habits`.

    Attributes:
        constraint_: The best supported `Constraint`, available after `fit` like the other attributes.
        constraints_: All learnt constraints: clear ones first, then by support.
        report_: `LearningReport` with the evidence for `constraint_`.
        reports_: One report per constraint.
        skill_: `Skill` of all constraints with all their rows, in the demonstrated order.

    Raises:
        FeatureError: There are no features, an object is no feature map, or an argument is out of range.
        NotFittedError: An attribute with a trailing underscore is read before `fit`.
        TypeError: An unknown argument.

    Example:
        >>> import numpy as np
        >>> import manip_learn as ml
        >>> robot = ml.load_robot("sawyer")
        >>> demos = ml.load_demonstrations("sawyer_drawer", robot)[:6]  # or a folder of your own
        >>> features = ml.FrameJacobian(robot, "right_gripper_tip", axes="xyz")
        >>> learner = ml.ConstraintLearner(features).fit(demos)
        >>> learner.report_.n_constraints, learner.report_.gap > 10.0  # two directions are constrained, clearly
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
        strength: float = STRENGTH,
        switching_cost: float = SWITCH,
        keep_habits: bool = False,
        max_samples: int = MOST_SAMPLES,
        joint_offset_std: float = 0.1,
        link_error_std: float = 0.5,
        seed: int = 0,
        **renamed: Any,
    ):
        self.features, self.n_constraints, self.policy_model, self.seed = features, n_constraints, policy_model, seed
        self.estimator: EstimatorName = estimator
        self.velocities: Velocities = velocities
        self.phases, self.mechanism, self.strength, self.switching_cost = phases, mechanism, strength, switching_cost
        self.keep_habits, self.max_samples = keep_habits, max_samples
        self.joint_offset_std, self.link_error_std = joint_offset_std, link_error_std
        for name, value in renamed.items():
            if name not in _ALIASES:
                raise TypeError(f"{type(self).__name__}() got an unexpected keyword argument {name!r}")
            setattr(self, _ALIASES[name], value)
        self._feature_maps = list(features) if isinstance(features, Sequence) else [features]
        self._check()
        self._robot: Robot | None = getattr(self._feature_maps[0], "robot", None)

    def _check(self) -> None:
        """Refuse settings out of range."""
        choices = {"phases": get_args(Switch), "mechanism": get_args(Switch), "estimator": get_args(EstimatorName)}
        for name, allowed in (choices | {"velocities": get_args(Velocities)}).items():
            if (value := getattr(self, name)) not in allowed:
                called = advice("{}", name, f"--{name}") or name
                options = " or ".join(map(repr, allowed)) if len(allowed) < 3 else f"one of {', '.join(allowed)}"
                raise FeatureError(f"{called} must be {options}, not {value!r}")
        least = {"strength": (1, ""), "switching_cost": (0, " of nats")}
        least |= {"joint_offset_std": (0, " of degrees"), "link_error_std": (0, " of mm and mrad")}
        for name, (lowest, unit) in least.items():
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, int | float) or not lowest <= value < math.inf:
                raise FeatureError(f"{name} must be a finite number{unit} of at least {lowest}, got {value!r}")
        most, s = self.max_samples, self.n_constraints
        if isinstance(most, bool) or not isinstance(most, int) or most < 100:
            raise FeatureError(f"max_samples must be an integer of at least 100, got {most!r}")
        if isinstance(s, bool) or not isinstance(s, int | None):
            raise FeatureError(f"n_constraints must be an integer or None, got {s!r}")
        if not self._feature_maps:
            raise FeatureError("give the learner at least one feature map")
        for features in self._feature_maps:
            if not isinstance(features, FeatureMap):
                raise FeatureError(f'features must be e.g. FrameJacobian(robot, frame="tool"), got {an(features)}')
            if s is not None and not (most := min(features.n_rows, features.nv)) >= s >= 1:
                raise NumberOfConstraintsError(s, most, repr(features))

    def fit(self, demonstrations: Given, *others: object, client: Any = None, progress: Progress | None = None) -> Self:
        """Learn the constraints of demonstrations; a second call replaces the results of the first.

        At most `max_samples` samples are used. Larger sets are subsampled while they are read, so that the recordings
        of a source need not fit in memory.

        Args:
            demonstrations: `Demonstrations`; or a trajectory; or arrays `(time, q)` or `(time, q, u)` [s, rad or m,
                rad/s or m/s], one column per joint in the robot's order; or a pandas data frame; or a list of these; or
                an iterable of trajectories, which is read once; or a `manip_learn.RecordingSource` for files larger
                than memory.
            others: Must be empty. A call `fit(q, u)`, as in other libraries, raises an error with the correct call.
            client: A `dask.distributed.Client` whose workers read and subsample the parts of a source; the result does
                not depend on their number. None to read in this process.
            progress: Function that is called with the name of each stage and its completed share, 0 to 1; None for
                none.

        Returns:
            The learner itself.

        Raises:
            NotIdentifiableError: The demonstrations do not determine a constraint; the message gives the reason.
            RecordingError: The demonstrations cannot be used: velocities cannot be derived, a velocity is an outlier,
                or the joints are of another robot.
            ManipLearnError: The workers of the client died.
            ConfigurationError: Recordings without joint names have another number of columns than the robot has joints.
        """
        for name_of_result in _LEARNT:  # a fit that raises must not leave the result of other demonstrations behind
            vars(self).pop(name_of_result, None)
        if others:  # fit(X, y), as other libraries have it
            got = " and ".join(map(an, (demonstrations, *others)))
            why = f"fit takes all recordings as one argument, got {got}: write fit((time, q, u)), or a list of these"
            raise RecordingError(why, code="type")
        for features in self._feature_maps:
            robot = getattr(features, "robot", None)
            if robot is not None and self._robot is not None:
                check_joints(self._robot.joint_names, robot)
        derive = partial(with_velocities, robot=self._robot, velocities=self.velocities)
        choose = partial(EvenChoice, self.max_samples, derive)
        recorded = recordings_given(demonstrations, self._robot, self._feature_maps[0].nv, self.velocities)
        if not isinstance(recorded, Demonstrations):
            recorded = read_evenly(choose, recorded, client, progress).demonstrations
        with one_thread():  # independent recordings -> one table -> hypotheses -> answers -> reports and a skill
            started, progress = time.perf_counter(), progress or (lambda stage, share: None)
            recordings = IndependentRecordings.of(recorded)
            derived = derive(recordings.demonstrations)
            refuse_unusable(recordings.demonstrations, derived, self._feature_maps[0])
            exact = self._robot is None or all(t.exact for t in recordings.demonstrations)
            if sum(map(len, derived)) > self.max_samples:
                choice = choose(*parts_of(derived))
                derived, origins = choice.demonstrations, tuple(recordings.origins[k.number] for k in choice.kept)
                recordings = recordings._replace(origins=origins)
            recordings, table = recordings._replace(demonstrations=derived), Table(list(derived))
            arm = ArmErrors(math.radians(self.joint_offset_std), 1e-3 * self.link_error_std)
            options: dict[str, Any] = {"arm": arm, "seed": self.seed, "asked": tuple(self._feature_maps)}
            options |= {"phases": self.phases == "auto", "mechanism": self.mechanism == "auto"}
            options |= {"strength": self.strength, "switch": self.switching_cost, "habits": self.keep_habits}
            options |= {"by_rates": exact or self.velocities == "recorded"}
            settings = Settings(self.n_constraints, self.estimator, self.policy_model, **options)
            result = learn(table, settings, progress)
            if not isinstance(result, Answers):
                raise add_advice(result, table, settings, recordings.warnings)
            # for the provenance; the features are stored in the constraint itself
            names = [name for name in inspect.signature(type(self)).parameters if name not in ("features", "renamed")]
            context = Context(table, recordings, {name: getattr(self, name) for name in names}, started)
            wholes, self.constraints_, self.reports_ = zip(*make_reports(result, context), strict=True)
            self.constraint_, self.report_ = self.constraints_[0], self.reports_[0]
            self.skill_ = build_skill(wholes, result, table)
            progress("learning", 1.0)
        return self

    if not TYPE_CHECKING:  # otherwise every name would be an attribute

        def __getattr__(self, name: str) -> Any:
            if name in _LEARNT:
                raise NotFittedError(name)
            if name in _ALIASES:
                return getattr(self, _ALIASES[name])
            gone = ": keep the recordings in a list and call fit again" if name == "partial_fit" else ""  # until 0.4
            raise AttributeError(f"{type(self).__name__} has no attribute {name!r}{gone}", name=name, obj=self)

    def __repr__(self) -> str:
        return f"ConstraintLearner({self.features!r}, n_constraints={self.n_constraints}, estimator={self.estimator!r})"

    def _repr_html_(self) -> str:
        if report := vars(self).get("report_"):
            return report._repr_html_()
        return html_card.card("Nothing is learnt yet", html_card.sentence(repr(self)))
