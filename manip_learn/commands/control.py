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
from manip_learn.commands.simulated import load_scene, start_posture, write_rollout
from manip_learn.constraint.features.feature_map import sum_in_words
from manip_learn.constraint.features.mechanism_rows import WeighedVelocity
from manip_learn.control.simulation import WayDone, leads_away, simulate_way
from manip_learn.control.tasks.motion import motion_to, null_policy
from manip_learn.errors import TargetError, counted
from manip_learn.linalg import complement_rows
from manip_learn.planning.stations import margin_of

# curve or surface on which the held rows keep the hand
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
    """Comparison of a target with the end of a motion.

    Attributes:
        distance: Distance from the tip to the target [m]; None if the target has no position.
        error: Distance to the target along all rows for which the target has numbers [m or rad].
        off: Distance from the target along the held rows [m or rad]: 0 on the line, plane, ... through the target.
        ignored: Names of the target's directions that are not driven.
        crossed: Motion along the held rows that was necessary to reach the target [m or rad]; 0 for rows that the
            demonstrator moved, too (b varies).
    """

    distance: float | None
    error: float
    off: float
    ignored: tuple[str, ...] = ()
    crossed: float = 0.0


def control(options: ControlOptions, progress: Progress) -> Answer:
    """Simulate a controller; write the rollout and a replay to files if they are named.

    Args:
        options: Options of the command.
        progress: Function that is called with the name of a stage and its completed fraction, 0 to 1.

    Returns:
        Outcome of the motion, with the files that were written.

    Raises:
        TargetError: A target and a distance are both given, `rows` is unknown, or a plan is requested without a motion;
            with `check`, the distance or the target is not reached (then no file is written).
        NoPlanError: With `--plan`, the whole motion is infeasible from every configuration.
        ManipLearnError: Another error in the robot, the constraint file, the numbers or the output.
    """
    target = vector("--target", options.target)
    word = (options.direction or "").strip()  # name of a row of the mechanism
    direction = word if word.isidentifier() else vector("--direction", options.direction)
    constraint, robot = load_constraint(options.robot, options.constraint, options)
    named_way = options.along is not None or options.turn is not None
    if target is not None and named_way:
        raise TargetError("--target names a point, --along and --turn a distance: give one of them")
    moves = named_way or (target is None and (constraint.shown is not None or direction is not None))
    if options.rows not in ("all", "held"):
        raise TargetError(f"--rows must be all or held, not {options.rows!r}")
    if not options.plan and (options.seed, options.scene) != (0, None):
        raise TargetError("--seed and --scene go with --plan")
    used = (options.policy, options.rest, options.duration, options.inverse) != ("manipulability", None, None, "damped")
    if options.plan and used:
        raise TargetError("a plan has its own null-space motion: leave --policy, --rest, --duration and --inverse out")
    q0, begins = start_posture(robot, constraint, options.start, moves or target is not None)
    if moves:
        angle, speed, demo = options.turn, options.speed, constraint.shown
        if speed is not None and (angle is not None or (options.along is None and demo and demo.unit == "rad")):
            speed = math.radians(speed)
        angle = None if angle is None else math.radians(angle)
        flags = {"keep_orientation": options.keep_orientation, "beyond_shown": options.beyond_shown}
        task: ml.Task = ml.motion(constraint, options.along, angle, direction=direction, speed=speed, **flags)
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
    return write_rollout(replace(answer, sentences=[begins, *answer.sentences]), rollout, robot, "control", options)


def run(
    options: ControlOptions,
    constraint: ml.Constraint,
    robot: ml.Robot,
    task: ml.Task,
    q0: np.ndarray,
    progress: Progress,
) -> tuple[ml.Rollout, Answer]:
    """Simulate a task, with or without a plan, and describe its outcome.

    Args:
        options: Options of the command: plan, or policy, gains, duration and step. With `target` the task is complete
            when the tip is at the target; otherwise when the driven rows are.
        constraint: Constraint to keep.
        robot: Robot of the constraint.
        task: Motion along a free direction, or a task with a target.
        q0: Start configuration (nq,).
        progress: Function that is called with the name of a stage and its completed fraction, 0 to 1.

    Returns:
        Rollout, and its outcome as an answer.

    Raises:
        TargetError: A plan is requested for a task without a motion; or an error of `plan`.
        NoPlanError: The whole motion is infeasible from every configuration.
    """
    dt, way, result = options.dt, None, None
    if options.plan:
        if not isinstance(task, ml.FreeDirection):
            raise TargetError("a plan needs a motion: use --plan with --along or --turn")
        around = load_scene(options.scene, robot)
        result = ml.plan(constraint, task, q0, options.seed, scene=around, dt=dt, progress=progress)
        rollout = result.rollout
        way = replace(result.outcome, begins=float(result.approach.time[-1]) + (result.outcome.begins or 0.0))
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
    aim = compare_target(constraint, task, rollout) if options.target and isinstance(task, ml.PointAttractor) else None
    answer = outcome(constraint, rollout, options.tolerance, way, aim)
    if result is not None:
        clear = f"; clear of {', '.join(result.around.names)}" if result.around.names else ""
        remark = f"plan: {result.sentence}; compared: {counted(result.candidates, 'grasp configuration')}{clear}"
        content, warnings = answer.content | {"plan": result.to_dict()}, [*result.notes, *answer.warnings]
        answer = replace(answer, content=content, remarks=[remark, *answer.remarks], warnings=warnings)
    return rollout, answer


def outcome(
    constraint: ml.Constraint, rollout: ml.Rollout, tolerance: float, way: WayDone | None = None, aim: Aim | None = None
) -> Answer:
    """Describe the outcome of a rollout in numbers and in words.

    Args:
        constraint: Constraint to keep.
        rollout: The motion.
        tolerance: Final error that counts as reached [m or rad].
        way: Outcome of a motion along the mechanism; None if there was none.
        aim: Comparison with a target; None if there was none.

    Returns:
        Answer with the rows of the result table.
    """
    r, error = rollout, float(rollout.task_error[-1])
    completed = way is not None and way.is_done
    last = r.status[-max(1, len(r) // 20) :]
    at_rest = last.count(ml.Status.STALLED) + last.count(ml.Status.SINGULAR) > 0.5 * len(last)
    content: dict[str, Any] = {
        "sentence": "",
        "reached": completed if way is not None else (error if aim is None else aim.error) <= tolerance,
        "stalled": at_rest and error > tolerance and not completed,
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
        verb, content["hold"] = _effect(constraint, r, way)
        digits, unit = (3, "m") if way.unit == "m" else (1, "degrees")
        moved, requested = (f"{abs(content[key]):.{digits}f}" for key in ("done", "wanted"))
        content["sentence"] = f"{verb} {moved} of {requested} {unit}"
        facts = {verb: f"{moved} {content['unit']}"} | cells(content | {"millimetres": 1e3 * way.deviation}, _WAY)
    return Answer(
        content,
        title=content["sentence"],
        sentences=[f"grasp at {place(content['hold'])}" if content["hold"] else ""],
        facts=facts,
        remarks=[f"steps: {', '.join(f'{status} {n}' for status, n in r.status_counts.items())}"],
        warnings=list(_obstacles(content, way, aim)),
        notes=constraint.notes,
    )


def _arrival(reached: bool, aim: Aim | None, known: ml.Mechanism | None, tolerance: float) -> str:
    """Return the final position of the hand in words, for a task without a motion along the mechanism."""
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
    """Yield the reasons why a rollout did not reach its goal, in sentences."""
    error, tolerance = content["final_error"], content["tolerance"]
    if way is not None and way.stopped_by is not None:
        yield f"stopped by {way.stopped_by}"
    if way is not None and way.strays:  # a rigid mechanism pushes back
        far = f"the hand deviated {1e3 * way.deviation:.1f} mm from the mechanism"
        yield f"{far}, near a singularity or a limit: start from another posture"
    if aim is not None and aim.crossed > tolerance:
        far = f"the hand moved {aim.crossed:.3g} along directions that the recordings show to be blocked"
        yield f"{far}, to reach the target: a hand that grasps the object needs a target on its path, or --along"
    if aim is not None and aim.ignored and not content["reached"]:
        yield f"--rows held leaves {', '.join(aim.ignored)} of the target free"
    if way is None and content["stalled"]:
        yield f"stalled, {error:.3g} left: limits or a singularity block the rest; try a nearer target or --start"
    elif way is None and error > tolerance:
        yield f"{error:.3g} left after {content['duration']:g} s, still moving: try a longer --duration"


def _effect(constraint: ml.Constraint, rollout: ml.Rollout, way: WayDone) -> tuple[str, list[float] | None]:
    """Return the effect of a motion on its mechanism, in words, and the position of the grasp in the base frame [m]."""
    mechanism, frame, robot = constraint.mechanism, getattr(constraint.features, "frame", None), constraint.robot
    verb = "turned" if mechanism is not None and mechanism.type in ("screw", "ball") else "moved"
    if robot is None or frame is None:
        return verb, None
    begins = 0 if way.begins is None else int(np.searchsorted(rollout.time, way.begins - 1e-9))
    first, last = (robot.position(q, frame) for q in rollout.q[[begins, -1]])
    if mechanism is not None and mechanism.type in ("line", "hinge"):  # a hand that pulls comes towards the base
        verb = "pushed in" if mechanism.type == "line" and leads_away(first, last - first) else "opened"
    return verb, None if way.begins is None else first.tolist()


def compare_target(constraint: ml.Constraint, task: ml.PointAttractor, rollout: ml.Rollout) -> Aim:
    """Compare a target with the end of a motion.

    Args:
        constraint: Constraint with the rows of the target.
        task: Task with the target.
        rollout: The motion.

    Returns:
        Distances to the target, along all rows and along the held rows.
    """
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
