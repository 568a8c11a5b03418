"""Arms that are not shipped, fixtures with joints in MuJoCo, default options: does the arm do what a person has shown?

The world stands in benchmarks/arms_of_others_physics.py: an arm on servos, and a fixture that nothing of the library
knows. A firm grip is a weld, a loose one a ball joint; `kept` is a wrist that a person holds straight.
"""

from __future__ import annotations

from pathlib import Path

import pytest

mujoco = pytest.importorskip("mujoco", reason="NO MUJOCO: NO ARM IS TRIED ON A FIXTURE")
import arms_of_others_physics as physics  # noqa: E402

TESTS = Path(__file__).parent
ARMS = {
    "six joints": physics.Arm("arms/six_joints.urdf", "tool", (0.0, 0.3, 0.1, 0.0, -0.4, 0.0), 0.75),
    "without ends": physics.Arm("arms/seven_endless.urdf", "tool", (0.0, 0.5, 0.0, 1.6, 0.0, -0.5, 0.0), 0.95),
}
FEW = [("six joints", "skew"), ("six joints", "door"), ("without ends", "drawer_kept"), ("without ends", "knob")]
ALL = [(arm, task, seed) for arm in ARMS for task in physics.TASKS for seed in (91, 92)]


def assert_done(arm: str, task: str, seed: int) -> None:
    """Record, learn, repeat, and look at the fixture."""
    one = physics.run(ARMS[arm], physics.TASKS[task], seed, TESTS)
    assert one.off < physics.TOO_FAR, "the hand closed beside the handle"
    assert physics.WAY[0] <= one.way <= physics.WAY[1], "the fixture did not go as far as was shown"
    assert one.turned < 2.0, "a firm hand turned otherwise than what it holds [deg]"
    assert one.force < physics.MOST_FORCE
    assert one.path <= 1.0, "a detour"
    assert one.left < 1e-3, "an arm that had arrived left again"
    assert one.said_done


@pytest.mark.parametrize(("arm", "task"), FEW)
def test_the_arm_does_what_was_shown(arm, task):
    """A bar that is held anywhere along it, a firm door, a drawer with a straight wrist, a knob."""
    assert_done(arm, task, 90)


@pytest.mark.slow
@pytest.mark.parametrize(("arm", "task", "seed"), ALL)
def test_every_fixture(arm, task, seed):
    """Drawers, doors, lids, a knob, an oven, a table, a peg: on both arms, two seeds each."""
    assert_done(arm, task, seed)
