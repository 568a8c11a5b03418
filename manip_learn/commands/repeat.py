"""`manip-learn repeat`: reproduce the demonstrated task from any start."""

from __future__ import annotations

from contextlib import suppress
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

import manip_learn as ml
from manip_learn.commands.loading import robot_of_constraint
from manip_learn.commands.options import RepeatOptions, vector
from manip_learn.commands.output import Answer, Progress, cells, place
from manip_learn.commands.simulated import load_scene, start_posture, write_rollout
from manip_learn.errors import TargetError, counted

_STEP = (
    "done: {done:.3g} {unit}; of: {wanted:.3g} {unit}; off: {off:.1f} {fine}; "
    "fastest: {fastest:.0%}; margin: {margin:.0%}"
)


def repeat_skill(options: RepeatOptions, progress: Progress) -> Answer:
    """Plan and simulate every step of a skill; write the rollout and a replay to files if they are named.

    Args:
        options: Options of the command.
        progress: Function that is called with the name of a stage and its completed fraction, 0 to 1.

    Returns:
        Answer with a row for each step.

    Raises:
        NoPlanError: A step is infeasible; nothing is written.
        TargetError: `--moved` has neither 3 nor 6 numbers.
        ConfigurationError: `--tip-speed` is neither positive nor `shown` or `none`.
        ManipLearnError: An error in the robot, the file, the numbers or the output.
    """
    robot = robot_of_constraint(options.robot, options.task, options)
    skill = ml.Skill.load(options.task, robot)
    moved = vector("--moved", options.moved)
    q0, begins = start_posture(robot, skill.constraints[0], options.start, True)
    T = None
    if moved is not None:  # x, y, z [m], and rotations about the base's x, y and z axes, one after the other [degrees]
        if len(moved) not in (3, 6):
            text = "--moved takes 3 numbers, x,y,z [m], or 6 with rx,ry,rz [degrees about the base's axes]: got "
            raise TargetError(f"{text}{len(moved)}")
        T, turned = np.eye(4), Rotation.from_euler("xyz", moved[3:] or [0.0] * 3, degrees=True)
        T[:3, 3], T[:3, :3] = moved[:3], turned.as_matrix()
    arguments: dict[str, Any] = {"seed": options.seed, "tip_speed": options.tip_speed, "prefer": options.prefer}
    with suppress(ValueError):  # `repeat` refuses other words
        arguments["tip_speed"] = None if options.tip_speed == "none" else float(options.tip_speed)
    result = ml.repeat(skill, q0, T, scene=load_scene(options.scene, robot), **arguments, progress=progress)
    rollout, steps, ends, rows = result.rollout, [step.to_dict() for step in result.steps], [], []
    for step, document in zip(result.steps, steps, strict=True):
        if step.kind == "reach":
            missed = "" if step.off is None else f", {1e3 * step.off:.1f} mm from where a contact began"
            ends.append(f"{step.name}: at {place(step.place)}{missed}")
        off = {"off": 1e3 * step.deviation, "fine": "mm" if step.unit == "m" else "mm or mrad"}
        rows.append({"step": step.name} | cells(document | off, _STEP))
    motions = counted(sum(step.kind == "way" for step in result.steps), "motion")
    answer = Answer(
        {
            "done": result.is_done,
            "steps": steps,
            "min_manipulability": float(np.min(rollout.manipulability)),
            "duration": float(rollout.time[-1]),
            "tip_path": result.tip_path,
            "tip_speed": result.tip_speed,
            "phases": [list(phase) for phase in rollout.phases],
            "notes": list(result.notes),
        },
        title=f"{motions} completed as demonstrated" if result.is_done else "not completed",
        sentences=[begins, result.pace, *ends],
        rows=rows,
        warnings=[f"{step.name}: stopped by {step.stopped_by}" for step in result.steps if step.stopped_by],
        notes=result.notes,
    )
    return write_rollout(answer, rollout, robot, "repeat", options)
