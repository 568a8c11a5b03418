"""Which frame of a robot the hand guided."""

from __future__ import annotations

from manip_learn.errors import ManipLearnError, UnknownNameError
from manip_learn.robot import Robot
from manip_learn.robot.tips import distance_to_last_joint, likely_tips


def choose_frame(robot: Robot, frame: str | None) -> str:
    """Return the frame that the hand guided: the one that was named, checked, or the only likely tip.

    Raises:
        UnknownNameError: No such frame.
        ManipLearnError: None was named and there is more than one candidate.
    """
    tips = likely_tips(robot)
    if frame is None and len(tips) == 1:
        return tips[0]
    if frame in robot.frame_names:
        return robot.frame(frame).name
    shown = [f"{tip} ({distance_to_last_joint(robot, tip):.3g} m from its last joint)" for tip in tips[:6]]
    likely = f"likely tips: {', '.join(shown) or 'none'}; `manip-learn inspect` lists all frames"
    if frame is not None:
        raise UnknownNameError("frame", frame, robot.frame_names, f"robot {robot.name!r}", f"; {likely}")
    name = tips[0] if tips else "NAME"
    raise ManipLearnError(
        f"which frame of {robot.name!r} was guided? Name it, e.g. --frame {name}; {likely}", code="frame"
    )
