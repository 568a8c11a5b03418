"""`manip-learn repeat`: all that the recordings show, done again from any start."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast, final

import numpy as np
from scipy.spatial.transform import Rotation

from manip_learn.commands.loading import robot_of_constraint, scene_of, start_posture
from manip_learn.commands.options import RepeatOptions, vector
from manip_learn.constraint.skill import Skill
from manip_learn.errors import TargetError
from manip_learn.planning.repeat import Repetition, TipSpeed, repeat
from manip_learn.recordings.load import Progress

if TYPE_CHECKING:
    from manip_learn.playback import ReplayResult


@final
@dataclass(frozen=True)
class Repeated:
    """A skill done again, and where it was written."""

    repetition: Repetition
    whence: str
    out: Path | None
    page: ReplayResult | None

    def to_dict(self) -> dict[str, Any]:
        """The JSON answer."""
        rollout = self.repetition.rollout
        return {
            "done": self.repetition.is_done,
            "steps": [step.to_dict() for step in self.repetition.steps],
            "min_manipulability": float(np.min(rollout.manipulability)),
            "duration": float(rollout.time[-1]),
            "tip_path": self.repetition.tip_path,
            "tip_speed": self.repetition.tip_speed,
            "phases": [list(phase) for phase in rollout.phases],
            "notes": list(self.repetition.notes),
            "out": None if self.out is None else str(self.out),
            "html": None if self.page is None else str(self.page.html),
        }


def repeat_skill(options: RepeatOptions, progress: Progress | None = None) -> Repeated:
    """Plan and simulate every step of a skill; write the rollout and a replay to files if they are named.

    Raises:
        NoPlanError: A step that cannot be done; nothing is written.
        TargetError: `--moved` has neither 3 nor 6 numbers.
        ConfigurationError: `--tip-speed` is not positive, or another word.
        ManipLearnError: Anything that is wrong with the robot, the file, the numbers or the output.
    """
    robot = robot_of_constraint(options.robot, options.task, options.loading)
    skill = Skill.load(options.task, robot)
    start, moved = vector("--start", options.start), vector("--moved", options.moved)
    q0, whence = start_posture(robot, skill.constraints[0], start, True)
    T = None
    if moved is not None:  # x, y, z [m], and rotations about the base's x, y and z axes, one after the other [degrees]
        if len(moved) not in (3, 6):
            text = "--moved takes 3 numbers, x,y,z [m], or 6 with rx,ry,rz [degrees about the base's axes]: got "
            raise TargetError(f"{text}{len(moved)}")
        T, turns = np.eye(4), [math.radians(a) for a in (*moved[3:], 0.0, 0.0, 0.0)[:3]]
        T[:3, 3], T[:3, :3] = moved[:3], Rotation.from_euler("xyz", turns).as_matrix()
    around, speed = scene_of(options.scene, robot), _tip_speed(options.tip_speed)
    made = {"scene": around, "seed": options.seed, "tip_speed": speed, "prefer": options.prefer}
    done = repeat(skill, q0, T, **made, progress=progress)
    out = None if options.out is None else done.rollout.save(options.out)
    page = None
    if options.html is not None:
        from manip_learn.playback import replay

        page = replay(robot, {"repeat": done.rollout}, options.html, open_browser=False)
    return Repeated(done, whence, out, page)


def _tip_speed(text: str) -> TipSpeed:
    """Return the number, None for `none`, or the word: `repeat` refuses all others."""
    try:
        return None if text == "none" else float(text)
    except ValueError:
        return cast(TipSpeed, text)
