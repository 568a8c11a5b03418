"""Frames that look like the tip of an arm."""

from __future__ import annotations

import re

import numpy as np
import pinocchio as pin

from manip_learn.robot.robot import Robot

# By priority: the first kind that occurs at the end of a chain decides.
TIP_NAMES = (
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


# joints of a gripper's own motor: what they move opens and closes, and does not go where the hand goes
GRIPPER_JOINTS = re.compile(r"gripper|finger|thumb|knuckle|jaw|claw")


def likely_tips(robot: Robot) -> tuple[str, ...]:
    """Links that may be the tip, the most likely first; with more than one, the user must choose.

    Candidates are links that move, named like a tool centre point, else like a tool, else like a hand; without such
    names, the ends of the chains that count the most joints. A link above another one of them, or moved by some of its
    joints only, is not a candidate; nor is one that the gripper's own motor moves, unless the robot is a gripper.
    """
    movers = _joints_above(robot)
    names = robot.pinocchio_model.names
    grips = {i for i in range(robot.pinocchio_model.njoints) if GRIPPER_JOINTS.search(names[i].lower())}
    moving = [n for n, joints in movers.items() if joints and not NOT_A_TIP.search(n.lower())]
    moving = [n for n in moving if not movers[n] & grips] or moving
    candidates: list[str] = []
    for kind in TIP_NAMES:
        # a frame between two finger tips is better than one of them
        candidates = candidates or [n for n in moving if kind.search(n.lower()) and "finger" not in n.lower()]
    if not candidates:
        candidates = _lowest(robot, moving)
        deepest = max((len(movers[n]) for n in candidates), default=0)
        candidates = [n for n in candidates if len(movers[n]) == deepest]
    candidates = _lowest(robot, candidates)
    free = [n for n in candidates if not any(movers[n] < movers[other] for other in candidates)]
    return tuple(sorted(free, key=lambda n: (-len(movers[n]), n)))


def default_tip(robot: Robot) -> str:
    """The frame taken for the tip if none is named: the first of `likely_tips`.

    That is the only one where there is only one, as in `manip-learn learn` without --frame; of several, the one moved
    by the most joints, by name among equals. Without any: the last link of those with the most joints above them; an
    empty string for a robot without frames.
    """
    tips = likely_tips(robot)
    if tips:
        return tips[0]
    above = {name: len(joints) for name, joints in _joints_above(robot).items()}
    most = max(above.values(), default=0)
    return next((name for name in reversed(above) if above[name] == most), next(iter(robot.frame_names), ""))


def distance_to_last_joint(robot: Robot, frame: str) -> float:
    """Distance from the origin of a frame to that of the last moving joint above it [m]; the same at every posture."""
    placement = robot.pinocchio_model.frames[robot.frame(frame).index].placement
    return float(np.linalg.norm(placement.translation))


def _joints_above(robot: Robot) -> dict[str, frozenset[int]]:
    """Of each link of the robot itself the joints that move it."""
    model = robot.pinocchio_model
    return {
        f.name: frozenset(model.supports[f.parentJoint]) - {0}
        for f in model.frames
        if f.type == pin.FrameType.BODY and f.name in robot.frame_names and f.name not in robot.objects
    }


def _lowest(robot: Robot, names: list[str]) -> list[str]:
    """The names that have none of the other names below them in the tree."""
    frames = robot.pinocchio_model.frames
    above: set[str] = set()
    for name in names:
        index = robot.frame(name).index
        while index := frames[index].parentFrame:
            if frames[index].type == pin.FrameType.BODY:  # a joint may have the name of a link
                above.add(frames[index].name)
    return [n for n in names if n not in above]
