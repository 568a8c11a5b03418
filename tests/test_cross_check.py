"""Forward kinematics compared with an independent implementation."""

from __future__ import annotations

import pytest
from case import case
from urdf_corpus import ARM, mimic_chain

import manip_learn as ml
from manip_learn.errors import RobotError
from manip_learn.robot.description.catalogue import example_robots
from manip_learn.robot.robot_summary import cross_check

# Refused with good reason: limits 0 ... 0, a mimic of nothing.
REFUSED = {
    "alex_psyonic_hands": "mimic-unknown",
    "double_pendulum": "limit-order",
    "double_pendulum_simple": "limit-order",
}
FILES = {str(path): name for name, path in sorted(example_robots().items())}
NAMES = sorted(FILES.values())


@pytest.mark.parametrize("part", [0, *(pytest.param(part, marks=pytest.mark.slow) for part in (1, 2, 3))])
def test_both_readers_agree(part, rng):
    """Every link of every robot that loads is where yourdfpy has it, to 1e-9; the others are refused as known."""
    for name in [*NAMES[part::4], *(REFUSED if part == 0 else ())]:
        with case(name):
            if name in REFUSED:
                with pytest.raises(RobotError) as caught:
                    ml.load_robot(name)
                assert caught.value.code == REFUSED[name]
                continue
            robot = ml.load_robot(name)
            check = cross_check(robot, rng, n=3)
            assert check.largest_difference <= 1e-9 and check.agrees
            assert check.links == len(robot.pinocchio_model.frames[1:]) // 2 + 1


def test_chains_of_mimics_locked_joints_and_moving_bases_agree(tmp_path, rng):
    """yourdfpy gets the chains shortened, since it would take a mimic of a mimic for one at rest; a moving base is
    taken out.
    """
    for order in [(0, 1, 2), (1, 2, 0)]:
        with case(order):
            path = tmp_path / "chain.urdf"
            path.write_bytes(mimic_chain(order).replace(b'multiplier="-0.5"', b'multiplier="-0.5" offset="0.2"'))
            assert cross_check(ml.load_robot(path), rng).agrees
    path = tmp_path / "arm.urdf"
    path.write_text(ARM, encoding="utf-8")
    assert cross_check(ml.load_robot(path, locked={"elbow": 0.7}), rng).agrees
    floating = cross_check(ml.load_robot(path, base="floating"), rng)
    assert floating.agrees and "root_joint" in floating.left_out
