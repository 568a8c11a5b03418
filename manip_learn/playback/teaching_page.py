"""The page on which an arm is taken by the hand, shown a task, and watched while it does it."""

from __future__ import annotations

from manip_learn.playback.kinematic_tree import kinematic_tree
from manip_learn.playback.live_viewer import live_page
from manip_learn.robot.robot import Robot


def teaching_page(robot: Robot, name: str, token: str) -> bytes:
    """HTML of the page for `manip-learn teach`, self-contained; it speaks to the server that it came from alone.

    Args:
        robot: The robot; its poses, furniture and recordings arrive as events.
        name: Headline.
        token: Of the address under which it is served.

    Raises:
        OutputError: Meshcat's viewer is missing.
    """
    return live_page(robot, kinematic_tree(robot), name, token, "teach")
