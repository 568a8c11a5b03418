"""Frames that look like the tip of an arm."""

from __future__ import annotations

import re

import pinocchio as pin

from manip_learn.robot.robot import Robot

# In order of conviction: the first kind that occurs at the end of a chain is the answer.
KINDS = (
    re.compile(r"(^|_|-)(tcp|tool_?cent(er|re)_?point|pinch(_site)?|grasp(ing)?(_?(frame|link|point|target))?)($|_|-)"),
    re.compile(
        r"(^|_|-)(tool_?0?|tip|ee|eef|eff|end_?_?effector|endeff|tool_?(link|frame|tip))($|_|-)|attachment_site"
    ),
    re.compile(r"gripper_?(frame|base|link)?|hand|flange|palm|wrist"),
)
NOT_A_TIP = re.compile(
    r"camera|lens|optical|imu|sensor|laser|lidar|marker|light|screw|rotor|antenna|sonar|display|gps|mount|collision"
    r"|accelero|range|force"
)


def likely_tips(robot: Robot) -> tuple[str, ...]:
    """Links that may be the tip, the most likely first; more than one is a question to the user, not an answer.

    Looked at are links that move, named like a tool centre point, else like a tool, else like a hand, and not above
    another link of that kind; without such names, the ends of the chains that count the most joints.
    """
    depth = _moving_joints_above(robot)
    moving = {name: d for name, d in depth.items() if d > 0 and not NOT_A_TIP.search(name.lower())}
    for kind in KINDS:
        # between two finger tips is better than on one of them
        named = [n for n in moving if kind.search(n.lower()) and "finger" not in n.lower()]
        if named:
            return _sorted(_lowest(robot, named), moving)
    ends = _lowest(robot, list(moving))
    deepest = max((moving[n] for n in ends), default=0)
    return _sorted([n for n in ends if moving[n] == deepest], moving)


def _moving_joints_above(robot: Robot) -> dict[str, int]:
    model = robot.pinocchio_model
    return {
        f.name: len(model.supports[f.parentJoint]) - 1
        for f in model.frames
        if f.type == pin.FrameType.BODY and f.name in robot.frame_names
    }


def _lowest(robot: Robot, names: list[str]) -> list[str]:
    """Those of the names below which no other of the names hangs."""
    frames = robot.pinocchio_model.frames
    above: set[str] = set()
    for name in names:
        index = frames[robot.frame(name).index].parentFrame
        while index != 0:
            if frames[index].type == pin.FrameType.BODY:  # a joint may have the name of a link
                above.add(frames[index].name)
            index = frames[index].parentFrame
    return [n for n in names if n not in above]


def _sorted(names: list[str], depth: dict[str, int]) -> tuple[str, ...]:
    return tuple(sorted(names, key=lambda n: (-depth[n], n)))
