"""The frame that was guided: the only likely tip, the one that is named, or an error that lists the likely ones."""

from __future__ import annotations

import pytest

import manip_learn as ml
from manip_learn.commands.loading import choose_frame
from manip_learn.errors import UnknownNameError


def test_a_wrong_frame_is_answered_with_tips():
    """Near names, and the likely tips with their distance."""
    robot = ml.load_robot("sawyer")
    tip = choose_frame(robot, None)
    assert choose_frame(robot, "right_hand") == "right_hand"
    with pytest.raises(UnknownNameError, match=f"likely tips: {tip} \\(0\\.124 m from its last joint\\)"):
        choose_frame(robot, "nowhere")


def test_a_missing_frame_is_answered_with_the_flag(tmp_path):
    """Of two arms the user must choose one: the flag is written out, and the error has a code."""
    arm = '<link name="{0}_link"/><link name="{0}_tool0"/>{1}'
    joints = (
        '<joint name="{0}_joint" type="revolute"><parent link="base"/><child link="{0}_link"/><axis xyz="0 0 1"/>'
        '<limit lower="-1" upper="1" velocity="1" effort="1"/></joint><joint name="{0}_fixed" type="fixed">'
        '<origin xyz="0.3 0.4 0"/><parent link="{0}_link"/><child link="{0}_tool0"/></joint>'
    )
    both = "".join(arm.format(side, joints.format(side)) for side in ("left", "right"))
    path = tmp_path / "two.urdf"
    path.write_text(f'<robot name="two"><link name="base"/>{both}</robot>', encoding="utf-8")
    with pytest.raises(ml.ManipLearnError, match="--frame left_tool0; likely tips: left_tool0 \\(0.5 m from") as caught:
        choose_frame(ml.load_robot(path), None)
    assert caught.value.code == "frame"
