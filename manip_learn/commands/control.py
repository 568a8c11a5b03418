"""`manip-learn control`: one rollout of a learnt or hand-written constraint."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, final

import numpy as np

from manip_learn.commands.loading import robot_of_constraint, scene_of, start_posture
from manip_learn.commands.options import ControlOptions, PlanOptions, vector
from manip_learn.constraint.constraint import Constraint
from manip_learn.constraint.features.feature_map import sum_in_words
from manip_learn.constraint.features.mechanism_rows import WeighedVelocity
from manip_learn.control.command import Status
from manip_learn.control.controller import ResolvedRateController
from manip_learn.control.rollout import Rollout
from manip_learn.control.simulation import WayDone, leads_away, simulate, simulate_way
from manip_learn.control.tasks import FreeDirection, Hold, PointAttractor, Task, motion
from manip_learn.control.tasks.motion import motion_to, null_policy
from manip_learn.errors import TargetError
from manip_learn.linalg import complement_rows
from manip_learn.planning.plan import Plan, plan
from manip_learn.planning.stations import margin_of
from manip_learn.recordings.load import Progress
from manip_learn.robot.robot import Robot

if TYPE_CHECKING:
    from manip_learn.playback import ReplayResult

_ROWS = ("all", "held")
# curve or surface that the held rows keep the hand on
_PLACES = {"line": "line", "plane": "plane", "hinge": "circle", "ball": "sphere", "screw": "helix", "other": "cylinder"}


@final
@dataclass(frozen=True)
class Aim:
    """How a typed target and the end of a motion compare.

    Attributes:
        distance: Full distance from the tip to the target [m]; None if the target has no position.
        error: Distance to the target along all rows that it has numbers for [m or rad].
        off: Distance from the target along the held rows [m or rad]: 0 on the line, the plane, ... through the target.
        ignored: Directions of the target that are not driven, in words.
        crossed: How far the held rows had to move to come to the target's [m or rad]; 0 where they may (b varies).
    """

    distance: float | None
    error: float
    off: float
    ignored: tuple[str, ...]
    crossed: float


@final
@dataclass(frozen=True)
class Controlled:
    """A rollout and whether it arrived.

    Attributes:
        rollout: The motion.
        out: File that it was written to.
        tolerance: Final error that counts as reached [m or rad].
        place: What the held rows keep the hand on, e.g. `"line"`; empty if that has no name.
        aim: What became of the typed target; None without one.
        way: What became of a way along the mechanism; None without one.
        start: Where the start posture came from, if it was not given.
        verb: What the way did to the thing, e.g. `"opened"`.
        plan: The plan that was followed; None without one.
        margin: Least share of its own limits that the way left, as that of a plan; None without a way.
        hold: Where the hand was when the way began, in the base frame [m]; None without a way.
        page: The replay that was written.
        notes: What loading the constraint had to say, e.g. that joints are locked elsewhere than when it was learnt.
    """

    rollout: Rollout
    out: Path | None
    tolerance: float
    place: str = ""
    aim: Aim | None = None
    way: WayDone | None = None
    start: str = ""
    verb: str = "moved"
    plan: Plan | None = None
    margin: float | None = None
    hold: tuple[float, ...] | None = None
    page: ReplayResult | None = None
    notes: tuple[str, ...] = ()

    @staticmethod
    def of(constraint: Constraint, rollout: Rollout, tolerance: float, way: WayDone | None, **more: Any) -> Controlled:
        """A rollout of a constraint, with the words for what the hand moves on and what it did there."""
        known = constraint.mechanism
        place, verb = "" if known is None else _PLACES.get(known.type, ""), verb_of(constraint, rollout, way)
        words: dict[str, Any] = {"out": None, "place": place, "verb": verb, "notes": constraint.notes, **more}
        robot, frame = constraint.robot, getattr(constraint.features, "frame", None)
        if way is not None and way.begins is not None and robot is not None and frame is not None:
            words["hold"] = tuple(robot.position(rollout.q[_beginning(rollout, way)], frame).tolist())
        return Controlled(rollout, tolerance=tolerance, way=way, **words)

    @property
    def final_error(self) -> float:
        """Distance to the target at the end, along the rows that are driven [m or rad]."""
        return float(self.rollout.task_error[-1])

    @property
    def reached(self) -> bool:
        """Whether the way was done, or the tip is at the target, all of it, within the tolerance."""
        if self.way is not None:
            return self.way.is_done
        return (self.final_error if self.aim is None else self.aim.error) <= self.tolerance

    @property
    def stalled(self) -> bool:
        """Whether the arm ended at rest, or nearly, short of where it was to go."""
        last = self.rollout.status[-max(1, len(self.rollout) // 20) :]
        short = self.final_error > self.tolerance and not (self.way is not None and self.way.is_done)
        return short and last.count(Status.STALLED) + last.count(Status.SINGULAR) > 0.5 * len(last)

    @property
    def sentence(self) -> str:
        """What was done, in words."""
        way, aim = self.way, self.aim
        if way is not None:
            size, unit, digits = (1.0, "m", 3) if way.unit == "m" else (math.degrees(1.0), "degrees", 1)
            return f"{self.verb} {abs(size * way.done):.{digits}f} of {abs(size * way.wanted):.{digits}f} {unit}"
        if aim is None:
            return "held what is held: --along, --turn or --target names a task"
        if self.reached:
            return "at the target"
        where = f"on the {self.place}" if self.place else "where the held rows are to be"
        if aim.off > self.tolerance:
            where = f"{aim.off:.3g} off " + (f"the {self.place}" if self.place else "along the held rows")
        far = f"{aim.error:.3g} from the target" if aim.distance is None else f"{aim.distance:.3g} m from the point"
        return f"{where}, {far}"

    def to_dict(self) -> dict[str, Any]:
        """The JSON answer."""
        r = self.rollout
        way = {"wanted": None, "done": None, "deviation": None, "seconds": None, "stopped_by": None}
        return {
            "sentence": self.sentence,
            "reached": self.reached,
            "stalled": self.stalled,
            "tip_to_target": None if self.aim is None else self.aim.distance,
            "ignored_target_axes": [] if self.aim is None else list(self.aim.ignored),
            "final_error": self.final_error,
            "tolerance": self.tolerance,
            **(way if self.way is None else self.way.to_dict()),
            "plan": None if self.plan is None else self.plan.to_dict(),
            "margin": self.margin,
            "hold": None if self.hold is None else list(self.hold),
            "min_manipulability": float(r.manipulability.min()),
            "mean_manipulability": float(r.manipulability.mean()),
            "max_velocity": float(np.abs(r.u).max()),
            "status_counts": r.status_counts,
            "notes": list(self.notes),
            "duration": float(r.time[-1]),
            "final_posture": r.q[-1].tolist(),
            "out": None if self.out is None else str(self.out),
            "html": None if self.page is None else str(self.page.html),
        }


def control(options: ControlOptions, progress: Progress | None = None) -> Controlled:
    """Simulate a controller; write the rollout and a replay to files if they are named.

    Raises:
        TargetError: A target beside a way, an unknown word for `rows`, a plan without a way; with `check`, a way or a
            target that is not reached, before anything is written.
        NoPlanError: With `--plan`, from no posture can the whole way be done.
        ManipLearnError: Anything else that is wrong with the robot, the constraint file, the numbers or the output.
    """
    start, target = vector("--start", options.start), vector("--target", options.target)
    named = (options.direction or "").strip()  # a row of the mechanism, by its name
    direction = named if named.isidentifier() else vector("--direction", options.direction)
    rest = vector("--rest", options.rest)
    robot = robot_of_constraint(options.robot, options.constraint, options.loading)
    constraint = Constraint.load(options.constraint, robot)
    named_way = options.along is not None or options.turn is not None
    if target is not None and named_way:
        raise TargetError("--target names the point, --along and --turn the way: give one of them")
    moves = named_way or (target is None and (constraint.shown is not None or direction is not None))
    if options.rows not in _ROWS:
        raise TargetError(f"--rows must be {' or '.join(_ROWS)}, not {options.rows!r}")
    if options.planned.plan and (
        options.policy != "manipulability" or rest or options.duration is not None or options.inverse != "damped"
    ):
        raise TargetError("a plan has its own null-space motion: leave --policy, --rest, --duration and --inverse out")
    q0, whence = start_posture(robot, constraint, start, moves or target is not None)
    task = _task(options, constraint, q0, target, direction, moves)
    found, way = None, None
    if options.planned.plan:
        found, rollout, way = follow(options.planned, constraint, task, q0, options.dt, progress)
    else:
        policy = null_policy(options.policy, task, constraint, robot, options.gain, rest)
        law = ResolvedRateController(constraint, task, policy, options.inverse, dt=options.dt)  # type: ignore[arg-type]
        if isinstance(task, FreeDirection):
            rollout, way = simulate_way(robot, law, q0, options.dt, options.duration, progress=progress)
        else:
            error = law.task_error(q0)
            # an attraction leaves e^(-gain t) of the way: half a tolerance of it
            far = max(2.0 * error / options.tolerance, 1.0) if options.tolerance > 0.0 else 1.0
            enough = max(5.0, math.log(far) / options.task_gain if options.task_gain > 0.0 else 5.0)  # [s]
            length = enough if options.duration is None else options.duration
            rollout = simulate(robot, law, q0, length, options.dt, progress=progress)
    aim = aim_of(constraint, task, rollout) if isinstance(task, PointAttractor) else None
    rollout, margin = with_margin(rollout, task, way, found, robot)
    done = Controlled.of(constraint, rollout, options.tolerance, way, aim=aim, start=whence, plan=found, margin=margin)
    if options.check and not done.reached:
        because = "" if way is None else f": stopped by {way.stopped_by}"
        raise TargetError(f"{done.sentence}{because}; ask for less, or start elsewhere (--start)", code="not-reached")
    page = None
    if options.html is not None:
        from manip_learn.playback import replay

        page = replay(robot, {"control": rollout}, options.html, open_browser=False)
    return replace(done, out=rollout.save(options.out) if options.out is not None else None, page=page)


def _task(
    options: ControlOptions,
    constraint: Constraint,
    q0: np.ndarray,
    target: list[float] | None,
    direction: list[float] | str | None,
    moves: bool,
) -> Task:
    """The way or the target that was named; else what was shown; else to stay on what is held."""
    speed, keep = options.speed, options.keep_orientation
    if moves:
        angle = None if options.turn is None else math.radians(options.turn)
        turns = angle is not None or (
            options.along is None and constraint.shown is not None and constraint.shown.unit == "rad"
        )
        return motion(
            constraint,
            options.along,
            angle,
            direction=direction,
            speed=math.radians(speed) if turns and speed is not None else speed,
            keep_orientation=keep,
            beyond_shown=options.beyond_shown,
        )
    if target is None:
        return Hold() if constraint.intention is None else motion(constraint)
    if options.rows == "all" and isinstance(constraint.features, WeighedVelocity):
        return motion_to(constraint, target, q0, speed=speed, keep_orientation=keep)
    task = PointAttractor(target, options.task_gain, speed, driven="all" if options.rows == "all" else "held")
    task.displacement(task.rows(constraint), q0)  # a wrong size is refused before the simulation
    return task


def follow(
    options: PlanOptions,
    constraint: Constraint,
    task: Task,
    q0: np.ndarray,
    dt: float,
    progress: Progress | None = None,
) -> tuple[Plan, Rollout, WayDone]:
    """A plan, its approach and way as one motion, and what became of the way in that.

    Raises:
        TargetError: The task is no way; or as `plan` raises it.
        NoPlanError: From no posture can the whole way be done.
    """
    if not isinstance(task, FreeDirection):
        raise TargetError("only a way is planned: --plan goes with --along or --turn")
    around = scene_of(options.scene, constraint.robot)
    found = plan(constraint, task, q0, options.seed, scene=around, dt=dt, progress=progress)
    begins = float(found.approach.time[-1]) + (found.outcome.begins or 0.0)
    return found, found.rollout, replace(found.outcome, begins=begins)


def _beginning(rollout: Rollout, way: WayDone | None) -> int:
    """The sample at which a way began; the first where it did not."""
    return 0 if way is None or way.begins is None else int(np.searchsorted(rollout.time, way.begins - 1e-9))


def with_margin(
    rollout: Rollout, task: Task, way: WayDone | None, found: Plan | None, robot: Robot
) -> tuple[Rollout, float | None]:
    """A rollout that says the margin of its way, and that margin: that of its plan, else as it was simulated."""
    if found is not None or way is None or not isinstance(task, FreeDirection):
        return rollout, None if found is None else found.margin
    margin = margin_of(task, rollout, way.begins, robot)
    return replace(rollout, ways=({**rollout.ways[0], "margin": margin},)), margin


def verb_of(constraint: Constraint, rollout: Rollout, way: WayDone | None) -> str:
    """What a way along a mechanism does to it: a drawer is opened or pushed in, a door opened, a screw turned."""
    known, frame = constraint.mechanism, getattr(constraint.features, "frame", None)
    if known is None or known.type not in ("line", "hinge") or constraint.robot is None or frame is None:
        return "turned" if known is not None and known.type in ("screw", "ball") else "moved"
    first, last = (constraint.robot.position(q, frame) for q in rollout.q[[_beginning(rollout, way), -1]])
    return "pushed in" if known.type == "line" and leads_away(first, last - first) else "opened"


def aim_of(constraint: Constraint, task: PointAttractor, rollout: Rollout) -> Aim:
    """What became of a target at the end of a motion."""
    features, q = constraint.features, rollout.q[-1]
    if task.target.shape != (features.n_rows,):  # given along the constrained rows: nothing of it is ignored
        error = task.error(constraint, q, 0.0)
        return Aim(None, error, error, (), 0.0)
    error = features.error_to(task.target, q)
    linear = [i for i, name in enumerate(features.row_names) if name in ("x", "y", "z")]
    distance = float(np.linalg.norm(error[linear])) if linear else None
    off, size = (float(np.linalg.norm(x)) for x in (constraint.selection @ error, error))
    if task.driven == "all":
        at_first = features.error_to(task.target, rollout.q[0])
        blocked = constraint.provenance.get("kind") == "motion-constrained"
        return Aim(distance, size, off, (), float(np.linalg.norm(constraint.selection @ at_first)) if blocked else 0.0)
    free = complement_rows(constraint.selection)
    weights = np.linalg.norm(free, axis=0)
    whole = weights > 1.0 - 1e-6
    if np.count_nonzero(whole) == len(free):  # the free directions are axes of the target
        ignored = tuple(name for name, counts in zip(features.row_names, whole, strict=True) if counts)
    else:
        ignored = tuple(sum_in_words(row, features.row_names, "+.3g", 1e-3) for row in free)
    return Aim(distance, size, off, ignored, 0.0)
