"""`manip-learn warm-up`: compile ahead of time what control loops need."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any, final

from manip_learn.commands.options import WarmUpOptions
from manip_learn.constraint.constraint import Constraint
from manip_learn.constraint.features.frame_jacobian import FrameJacobian
from manip_learn.control.controller import ResolvedRateController
from manip_learn.control.driver import warm_up as warm_up_controller
from manip_learn.recordings.trajectory_source import Progress
from manip_learn.robot import load_robot


@final
@dataclass(frozen=True)
class Warmed:
    """What is compiled now, and how long that took [s]."""

    compiled: bool
    seconds: float

    def to_dict(self) -> dict[str, Any]:
        """The JSON answer."""
        return asdict(self)


def warm_up(options: WarmUpOptions, progress: Progress) -> Warmed:
    """Compile the control step, or read it from disk: every controller that can be compiled shares its code."""
    constraint = Constraint([[1, 0]], FrameJacobian(load_robot("planar3"), "tip", "x y"))
    progress("compiling control steps", 0.0)
    done = warm_up_controller(ResolvedRateController(constraint), lambda _sentence: None)
    progress("compiling control steps", 1.0)
    return Warmed(done.step, done.seconds)
