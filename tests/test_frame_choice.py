"""The frame that was guided: the only likely tip, the one that is named, or an error that lists the likely ones."""

from __future__ import annotations

import pytest

import manip_learn as ml
from manip_learn.commands.loading import choose_frame


def test_a_missing_frame_is_answered_with_the_flag():
    """Of two arms the user must choose one: the error contains the flag and the likely tips, and has a code."""
    words = r"--frame left_gripper; likely tips: left_gripper \(0\.271 m from its last joint\)"
    with pytest.raises(ml.ManipLearnError, match=words) as caught:
        choose_frame(ml.load_robot("baxter"), None)
    assert caught.value.code == "frame"
