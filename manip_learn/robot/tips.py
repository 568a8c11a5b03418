"""Detection of frames that are likely tips of an arm."""

from __future__ import annotations

import re

import numpy as np
import pinocchio as pin

from manip_learn.robot.joints import joint_motions
from manip_learn.robot.robot import Robot

# by priority: the first pattern that matches a link at the end of a chain decides
TIP_NAMES = (
    re.compile(r"(^|_|-)(tcp|tool_?cent(er|re)_?point|pinch(_site)?|grasp(ing)?(_?(frame|link|point|target))?)($|_|-)"),
    re.compile(r"(^|_|-)(tool_?(0|link|frame|tip)?|tip|eef?|eff|end_?_?effector|endeff)($|_|-)|attachment_site"),
    re.compile(r"gripper_?(frame|base|link)?|hand|flange|palm|wrist"),
)
NOT_A_TIP = re.compile(
    r"camera|lens|optical|imu|sensor|laser|lidar|marker|light|screw|rotor|antenna|sonar|display|gps|mount|collision"
    r"|accelero|range|force"
)

FINGER = re.compile(r"finger|thumb|knuckle|jaw|claw")


def likely_tips(robot: Robot) -> tuple[str, ...]:
    """Return the names of links that may be the tip of the arm, the most likely first.

    Candidates are links at the ends of chains, without fingers unless the robot is a gripper: links named like a tool
    centre point; if there are none, like a tool; if there are none, like a hand; else the ends of the chains with the
    most joints. A link above another candidate is left out, and so is a copy of the link above it.

    Args:
        robot: A loaded robot.
    """
    movers = _joints_above(robot)
    moving = {n: joints for n, joints in movers.items() if joints and not NOT_A_TIP.search(n.lower())}
    fingers = _finger_joints(robot, moving)
    moving = {n: joints for n, joints in moving.items() if not joints & fingers} or moving
    ends = [n for n, joints in moving.items() if not any(joints < longer for longer in moving.values())]
    # a frame between two finger tips is better than one of them
    matches = ([n for n in ends if kind.search(n.lower()) and "finger" not in n.lower()] for kind in TIP_NAMES)
    candidates = next(filter(None, matches), [])
    if not candidates:
        deepest, frames = max((len(moving[n]) for n in ends), default=0), robot.pinocchio_model.frames
        places = {n: frames[robot.frame(n).index] for n in ends if len(moving[n]) == deepest}
        first = {(f.parentJoint, *f.placement.homogeneous.round(9).flat): n for n, f in reversed(places.items())}
        candidates = list(first.values())  # links at the same place are copies
    return tuple(sorted(_lowest(robot, candidates), key=lambda n: (-len(movers[n]), n)))


def _finger_joints(robot: Robot, movers: dict[str, frozenset[int]]) -> set[int]:
    """Return the joints that open and close grippers, among the joints that move links.

    A finger joint is named like a finger; or it is the last one of a chain, and its link is named like a finger or the
    joint belongs to a gripper; or it is one of several similar joints on one link, with a chain shorter than the chain
    above it.
    """
    model, followers = robot.pinocchio_model, {m.joint for m in robot.mimics}
    joints, kinds = frozenset[int]().union(*movers.values()), [m and m[0] for m in joint_motions(model)]
    above = {j: len(model.supports[j]) - 2 for j in joints}  # joints between the root and it
    length = {j: max(above[k] for k in model.subtrees[j] if k in joints) - above[j] + 1 for j in joints}
    short = {j for j in joints if length[j] < above[j]}
    fingers = set[int]()
    for j in joints:
        name, frame = model.names[j].lower(), model.frames[model.getFrameId(model.names[j], pin.FrameType.JOINT)]
        link = next((n for n in movers if max(movers[n], default=0) == j), "").lower()
        is_last = all(model.names[k] in followers for k in joints if model.parents[k] == j)
        grips = "gripper" in name + model.frames[frame.parentFrame].name.lower() or FINGER.search(link)
        alike = [k for k in short if model.parents[k] == model.parents[j] and kinds[k] == kinds[j]]
        if FINGER.search(name) or (is_last and grips) or (j in short and len(alike) > 1):
            fingers.add(j)
    return fingers


def default_tip(robot: Robot) -> str:
    """Return the default tip frame, the first of `likely_tips`.

    Among several it is the link moved by the most joints, then the first by name. Without any, it is the last link with
    the most joints above it. `manip-learn learn` without `--frame` uses it only if there is exactly one.

    Args:
        robot: A loaded robot.

    Returns:
        Name of the frame; an empty string for a robot without frames.
    """
    above = _joints_above(robot)
    last = max(reversed(above), key=lambda name: len(above[name]), default=next(iter(robot.frame_names), ""))
    return next(iter(likely_tips(robot)), last)


def distance_to_last_joint(robot: Robot, frame: str) -> float:
    """Return the distance from the origin of a frame to the origin of the moving joint that carries it [m].

    It does not depend on the configuration.

    Args:
        robot: A loaded robot.
        frame: Name of the frame.
    """
    placement = robot.pinocchio_model.frames[robot.frame(frame).index].placement
    return float(np.linalg.norm(placement.translation))


def _joints_above(robot: Robot) -> dict[str, frozenset[int]]:
    """Return for each link of the robot itself the joints that move it."""
    model = robot.pinocchio_model
    return {
        f.name: frozenset(model.supports[f.parentJoint]) - {0}
        for f in model.frames
        if f.type == pin.FrameType.BODY and f.name in robot.frame_names and f.name not in robot.objects
    }


def _lowest(robot: Robot, names: list[str]) -> list[str]:
    """Return the names of frames that have no other named frame below them in the tree."""
    frames, places, above = robot.pinocchio_model.frames, {robot.frame(n).index: n for n in names}, set[int]()
    for index in reversed(range(len(frames))):  # children come after their parents
        if index in places or index in above:
            above.add(frames[index].parentFrame)
    return [name for index, name in places.items() if index not in above]
