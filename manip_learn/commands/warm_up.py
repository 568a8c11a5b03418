"""`manip-learn warm-up`: compile ahead of time what control loops need."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any, final

from manip_learn.commands.options import WarmUpOptions
from manip_learn.control.driver import controllers_to_warm_up
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
    """Compile, or read from disk, every kind of control step."""
    controllers = controllers_to_warm_up(load_robot("planar3"))
    seconds, compiled = 0.0, True
    for number, controller in enumerate(controllers):
        progress("compiling control steps", number / len(controllers))
        done = warm_up_controller(controller, lambda _sentence: None)
        seconds, compiled = seconds + done.seconds, compiled and (done.step or done.limits)
    progress("compiling control steps", 1.0)
    return Warmed(compiled, seconds)
