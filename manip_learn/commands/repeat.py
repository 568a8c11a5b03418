"""`manip-learn repeat`: all that the recordings show, done again from any start."""

from __future__ import annotations

from contextlib import suppress
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

import manip_learn as ml
from manip_learn.commands.loading import robot_of_constraint
from manip_learn.commands.options import RepeatOptions, vector
from manip_learn.commands.output import Answer, Progress, cells, place
from manip_learn.commands.simulated import scene_of, start_posture, with_rollout
from manip_learn.errors import TargetError, counted

_STEP = (
    "done: {done:.3g} {unit}; of: {wanted:.3g} {unit}; off: {off:.1f} {fine}; "
    "fastest: {fastest:.0%}; margin: {margin:.0%}"
)


def repeat_skill(options: RepeatOptions, progress: Progress) -> Answer:
    """Plan and simulate every step of a skill; write the rollout and a replay to files if they are named.

    Raises:
        NoPlanError: A step that cannot be done; nothing is written.
        TargetError: `--moved` has neither 3 nor 6 numbers.
        ConfigurationError: `--tip-speed` is not positive, or another word.
        ManipLearnError: Anything that is wrong with the robot, the file, the numbers or the output.
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
    made: dict[str, Any] = {"seed": options.seed, "tip_speed": options.tip_speed, "prefer": options.prefer}
    with suppress(ValueError):  # `repeat` refuses other words
        made["tip_speed"] = None if options.tip_speed == "none" else float(options.tip_speed)
    done = ml.repeat(skill, q0, T, scene=scene_of(options.scene, robot), **made, progress=progress)
    rollout, steps, ends, rows = done.rollout, [step.to_dict() for step in done.steps], [], []
    for step, told in zip(done.steps, steps, strict=True):
        if step.kind == "reach":
            missed = "" if step.off is None else f", {1e3 * step.off:.1f} mm from where a contact began"
            ends.append(f"{step.name}: at {place(step.place)}{missed}")
        off = {"off": 1e3 * step.deviation, "fine": "mm" if step.unit == "m" else "mm or mrad"}
        rows.append({"step": step.name} | cells(told | off, _STEP))
    ways = counted(sum(step.kind == "way" for step in done.steps), "way")
    answer = Answer(
        {
            "done": done.is_done,
            "steps": steps,
            "min_manipulability": float(np.min(rollout.manipulability)),
            "duration": float(rollout.time[-1]),
            "tip_path": done.tip_path,
            "tip_speed": done.tip_speed,
            "phases": [list(phase) for phase in rollout.phases],
            "notes": list(done.notes),
        },
        title=f"{ways} done as shown" if done.is_done else "not all of it was done",
        sentences=[begins, done.pace, *ends],
        rows=rows,
        warnings=[f"{step.name}: stopped by {step.stopped_by}" for step in done.steps if step.stopped_by],
        notes=done.notes,
    )
    return with_rollout(answer, rollout, robot, "repeat", options)
