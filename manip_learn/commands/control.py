"""`manip-learn control`: one rollout of a learnt or hand-written constraint."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

import manip_learn as ml
from manip_learn.commands.loading import load_constraint
from manip_learn.commands.options import ControlOptions, vector
from manip_learn.commands.output import Answer, Progress, cells, place
from manip_learn.commands.simulated import scene_of, start_posture, with_rollout
from manip_learn.constraint.features.feature_map import sum_in_words
from manip_learn.constraint.features.mechanism_rows import WeighedVelocity
from manip_learn.control.simulation import WayDone, leads_away, simulate_way
from manip_learn.control.tasks.motion import motion_to, null_policy
from manip_learn.errors import TargetError, counted
from manip_learn.linalg import complement_rows
from manip_learn.planning.stations import margin_of

# curve or surface that the held rows keep the hand on
_PLACES = {"line": "line", "plane": "plane", "hinge": "circle", "ball": "sphere", "screw": "helix", "other": "cylinder"}
_WAY = (
    "time: {seconds:.1f} s; off: {millimetres:.1f} mm; fastest: {fastest_joint[share_of_limit]:.0%}; "
    "margin: {margin:.0%}; least mu: {least_manipulability:.3f}"
)
_ROLLOUT = (
    "error: {final_error:.4f}; min mu: {least:.4f}; mean mu: {mean_manipulability:.3f}; peak: {max_velocity:.2f}/s; "
    "unhindered: {unhindered:.0%}"
)


class Aim(NamedTuple):
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
    ignored: tuple[str, ...] = ()
    crossed: float = 0.0


def control(options: ControlOptions, progress: Progress) -> Answer:
    """Simulate a controller; write the rollout and a replay to files if they are named.

    Raises:
        TargetError: A target beside a way, an unknown word for `rows`, a plan without a way; with `check`, a way or a
            target that is not reached, before anything is written.
        NoPlanError: With `--plan`, from no posture can the whole way be done.
        ManipLearnError: Anything else that is wrong with the robot, the constraint file, the numbers or the output.
    """
    target = vector("--target", options.target)
    named = (options.direction or "").strip()  # a row of the mechanism, by its name
    direction = named if named.isidentifier() else vector("--direction", options.direction)
    constraint, robot = load_constraint(options.robot, options.constraint, options)
    named_way = options.along is not None or options.turn is not None
    if target is not None and named_way:
        raise TargetError("--target names the point, --along and --turn the way: give one of them")
    moves = named_way or (target is None and (constraint.shown is not None or direction is not None))
    if options.rows not in ("all", "held"):
        raise TargetError(f"--rows must be all or held, not {options.rows!r}")
    if not options.plan and (options.seed, options.scene) != (0, None):
        raise TargetError("--seed and --scene go with --plan")
    own = (options.policy, options.rest, options.duration, options.inverse) != ("manipulability", None, None, "damped")
    if options.plan and own:
        raise TargetError("a plan has its own null-space motion: leave --policy, --rest, --duration and --inverse out")
    q0, begins = start_posture(robot, constraint, options.start, moves or target is not None)
    if moves:
        angle, speed, shown = options.turn, options.speed, constraint.shown
        if speed is not None and (angle is not None or (options.along is None and shown and shown.unit == "rad")):
            speed = math.radians(speed)
        angle = None if angle is None else math.radians(angle)
        kept = {"keep_orientation": options.keep_orientation, "beyond_shown": options.beyond_shown}
        task: ml.Task = ml.motion(constraint, options.along, angle, direction=direction, speed=speed, **kept)
    elif target is None:
        task = ml.Hold() if constraint.intention is None else ml.motion(constraint)
    elif options.rows == "all" and isinstance(constraint.features, WeighedVelocity):
        task = motion_to(constraint, target, q0, speed=options.speed, keep_orientation=options.keep_orientation)
    else:
        task = ml.PointAttractor(target, options.task_gain, options.speed, driven=options.rows)  # type: ignore[arg-type]
        task.displacement(task.rows(constraint), q0)  # a wrong size is refused before the simulation
    rollout, answer = run(options, constraint, robot, task, q0, progress)
    if options.check and not answer.content["reached"]:
        because = f": stopped by {answer.content['stopped_by']}" if isinstance(task, ml.FreeDirection) else ""
        raise TargetError(f"{answer.title}{because}; ask for less, or start elsewhere (--start)", code="not-reached")
    return with_rollout(replace(answer, sentences=[begins, *answer.sentences]), rollout, robot, "control", options)


def run(
    options: ControlOptions,
    constraint: ml.Constraint,
    robot: ml.Robot,
    task: ml.Task,
    q0: np.ndarray,
    progress: Progress,
) -> tuple[ml.Rollout, Answer]:
    """Simulate a task, planned or not, and say how far it came.

    Args:
        options: Plan, or policy, gains, duration and step. If `target` was typed, it is reached when the tip is there;
            else, when the rows that are driven are.
        constraint: What is held.
        robot: Its robot.
        task: The way or the target.
        q0: Start posture.
        progress: As for `simulate`.

    Raises:
        TargetError: A plan of a task that is no way; or as `plan` raises it.
        NoPlanError: From no posture can the whole way be done.
    """
    dt, way, found = options.dt, None, None
    if options.plan:
        if not isinstance(task, ml.FreeDirection):
            raise TargetError("only a way is planned: --plan goes with --along or --turn")
        around = scene_of(options.scene, robot)
        found = ml.plan(constraint, task, q0, options.seed, scene=around, dt=dt, progress=progress)
        rollout = found.rollout
        way = replace(found.outcome, begins=float(found.approach.time[-1]) + (found.outcome.begins or 0.0))
    else:
        policy = null_policy(options.policy, task, constraint, robot, options.gain, vector("--rest", options.rest))
        law = ml.ResolvedRateController(constraint, task, policy, options.inverse, dt=dt)  # type: ignore[arg-type]
        if isinstance(task, ml.FreeDirection):
            rollout, way = simulate_way(robot, law, q0, dt, options.duration, progress=progress)
            rollout = replace(rollout, ways=({**way.to_dict(), "margin": margin_of(task, rollout, way.begins, robot)},))
        else:
            # an attraction leaves e^(-gain t) of the way: half a tolerance of it
            far = max(2.0 * law.task_error(q0) / options.tolerance, 1.0) if options.tolerance > 0.0 else 1.0
            enough = max(5.0, math.log(far) / options.task_gain if options.task_gain > 0.0 else 5.0)  # [s]
            length = enough if options.duration is None else options.duration
            rollout = ml.simulate(robot, law, q0, length, dt, progress=progress)
    aim = aim_of(constraint, task, rollout) if options.target and isinstance(task, ml.PointAttractor) else None
    answer = outcome(constraint, rollout, options.tolerance, way, aim)
    if found is not None:
        clear = f"; clear of {', '.join(found.around.names)}" if found.around.names else ""
        said = f"plan: {found.sentence}; of {counted(found.candidates, 'posture')} that take hold{clear}"
        content, warnings = answer.content | {"plan": found.to_dict()}, [*found.notes, *answer.warnings]
        answer = replace(answer, content=content, remarks=[said, *answer.remarks], warnings=warnings)
    return rollout, answer


def outcome(
    constraint: ml.Constraint, rollout: ml.Rollout, tolerance: float, way: WayDone | None = None, aim: Aim | None = None
) -> Answer:
    """Say what a rollout did, in numbers and in words.

    Args:
        constraint: What is held.
        rollout: The motion.
        tolerance: Final error that counts as reached [m or rad].
        way: What became of a way along the mechanism; None without one.
        aim: What became of a typed target; None without one.
    """
    r, error = rollout, float(rollout.task_error[-1])
    done = way is not None and way.is_done
    last = r.status[-max(1, len(r) // 20) :]
    at_rest = last.count(ml.Status.STALLED) + last.count(ml.Status.SINGULAR) > 0.5 * len(last)
    content: dict[str, Any] = {
        "sentence": "",
        "reached": done if way is not None else (error if aim is None else aim.error) <= tolerance,
        "stalled": at_rest and error > tolerance and not done,
        "tip_to_target": None if aim is None else aim.distance,
        "ignored_target_axes": [] if aim is None else list(aim.ignored),
        "final_error": error,
        "tolerance": tolerance,
        **(dict.fromkeys(("wanted", "done", "deviation", "seconds", "stopped_by")) if way is None else way.to_dict()),
        "plan": None,
        "margin": r.ways[-1].get("margin") if r.ways else None,
        "hold": None,
        "min_manipulability": float(r.manipulability.min()),
        "mean_manipulability": float(r.manipulability.mean()),
        "max_velocity": float(np.abs(r.u).max()),
        "status_counts": r.status_counts,
        "notes": list(constraint.notes),
        "duration": float(r.time[-1]),
        "final_posture": r.q[-1].tolist(),
    }
    if way is None:
        content["sentence"] = _arrival(content["reached"], aim, constraint.mechanism, tolerance)
        later = r.manipulability[r.time >= min(0.1, r.time[-1])]  # [s] a nearly singular start is not due to the policy
        shares = {"least": float(later.min()), "unhindered": r.status.count(ml.Status.OK) / len(r)}
        facts = cells(content | shares, _ROLLOUT)
    else:
        verb, content["hold"] = _deed(constraint, r, way)
        digits, unit = (3, "m") if way.unit == "m" else (1, "degrees")
        far, wanted = (f"{abs(content[key]):.{digits}f}" for key in ("done", "wanted"))
        content["sentence"] = f"{verb} {far} of {wanted} {unit}"
        facts = {verb: f"{far} {content['unit']}"} | cells(content | {"millimetres": 1e3 * way.deviation}, _WAY)
    return Answer(
        content,
        title=content["sentence"],
        sentences=[f"the hand took hold at {place(content['hold'])}" if content["hold"] else ""],
        facts=facts,
        remarks=[f"steps: {', '.join(f'{status} {n}' for status, n in r.status_counts.items())}"],
        warnings=list(_obstacles(content, way, aim)),
        notes=constraint.notes,
    )


def _arrival(reached: bool, aim: Aim | None, known: ml.Mechanism | None, tolerance: float) -> str:
    """Return in words where the hand ended without a way."""
    if aim is None:
        return "held what is held: --along, --turn or --target names a task"
    if reached:
        return "at the target"
    curve = "" if known is None or known.type not in _PLACES else f"the {_PLACES[known.type]}"
    where = f"on {curve}" if curve else "where the held rows are to be"
    if aim.off > tolerance:
        where = f"{aim.off:.3g} off {curve or 'along the held rows'}"
    far = f"{aim.error:.3g} from the target" if aim.distance is None else f"{aim.distance:.3g} m from the point"
    return f"{where}, {far}"


def _obstacles(content: dict[str, Any], way: WayDone | None, aim: Aim | None) -> Iterator[str]:
    """Yield in sentences what kept a rollout from its goal."""
    left, tolerance = content["final_error"], content["tolerance"]
    if way is not None and way.stopped_by is not None:
        yield f"stopped by {way.stopped_by}"
    if way is not None and way.strays:  # what is rigid pushes back
        far = f"the hand strayed {1e3 * way.deviation:.1f} mm from what holds it"
        yield f"{far}, near a singularity or a limit: start in another posture"
    if aim is not None and aim.crossed > tolerance:
        far = f"the hand moved {aim.crossed:.3g} along what the recordings show to be blocked"
        yield f"{far}, to come to the target: a hand that holds the thing needs a target on its way, or --along"
    if aim is not None and aim.ignored and not content["reached"]:
        yield f"--rows held leaves {', '.join(aim.ignored)} of the target free"
    if way is None and content["stalled"]:
        yield f"stalled, {left:.3g} left: limits or a singularity block the rest; try a nearer target or --start"
    elif way is None and left > tolerance:
        yield f"{left:.3g} left after {content['duration']:g} s, still moving: try a longer --duration"


def _deed(constraint: ml.Constraint, rollout: ml.Rollout, way: WayDone) -> tuple[str, list[float] | None]:
    """Return what a way did to its mechanism, and where the hand was when it began, in the base frame [m]."""
    known, frame, robot = constraint.mechanism, getattr(constraint.features, "frame", None), constraint.robot
    verb = "turned" if known is not None and known.type in ("screw", "ball") else "moved"
    if robot is None or frame is None:
        return verb, None
    begins = 0 if way.begins is None else int(np.searchsorted(rollout.time, way.begins - 1e-9))
    first, last = (robot.position(q, frame) for q in rollout.q[[begins, -1]])
    if known is not None and known.type in ("line", "hinge"):  # a hand that pulls comes towards the base
        verb = "pushed in" if known.type == "line" and leads_away(first, last - first) else "opened"
    return verb, None if way.begins is None else first.tolist()


def aim_of(constraint: ml.Constraint, task: ml.PointAttractor, rollout: ml.Rollout) -> Aim:
    """Return what became of a target at the end of a motion."""
    features, q = constraint.features, rollout.q[-1]
    if task.target.shape != (features.n_rows,):  # given along the constrained rows: nothing of it is ignored
        error = task.error(constraint, q, 0.0)
        return Aim(None, error, error)
    error = features.error_to(task.target, q)
    linear = [i for i, name in enumerate(features.row_names) if name in ("x", "y", "z")]
    distance = float(np.linalg.norm(error[linear])) if linear else None
    off, size = (float(np.linalg.norm(x)) for x in (constraint.selection @ error, error))
    if task.driven == "all":
        at_first = constraint.selection @ features.error_to(task.target, rollout.q[0])
        blocked = constraint.provenance.get("kind") == "motion-constrained"
        return Aim(distance, size, off, crossed=float(np.linalg.norm(at_first)) if blocked else 0.0)
    free = complement_rows(constraint.selection)
    whole = np.linalg.norm(free, axis=0) > 1.0 - 1e-6
    if np.count_nonzero(whole) == len(free):  # the free directions are axes of the target
        ignored = tuple(name for name, counts in zip(features.row_names, whole, strict=True) if counts)
    else:
        ignored = tuple(sum_in_words(row, features.row_names, "+.3g", 1e-3) for row in free)
    return Aim(distance, size, off, ignored)
