"""Forward kinematics compared with independent implementations; the script that writes planar arms."""

from __future__ import annotations

import runpy
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from case import case
from urdf_corpus import ARM, mimic_chain

import manip_learn as ml
from manip_learn.errors import RobotError
from manip_learn.robot.description.catalogue import example_robots
from manip_learn.robot.loading import robot_from_text
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


SCRIPT = Path(__file__).resolve().parents[1] / "robots" / "make_planar3.py"


def test_a_script_writes_the_shipped_planar_arm() -> None:
    """The same to the byte. A length that is no positive number is named, with exit code 2 and without a traceback."""
    for length in ("1", "0", "nan"):
        with case(length):
            done = subprocess.run([sys.executable, SCRIPT, "1", "1", length], capture_output=True, timeout=60)
            if length == "1":
                assert done.returncode == 0 and done.stdout == SCRIPT.with_name("planar3.urdf").read_bytes()
                continue
            said = done.stderr.decode()
            assert done.returncode == 2 and f"length {length} m" in said and "Traceback" not in said


def test_planar_arms_obey_the_textbook_formula(rng) -> None:
    """Any number of links and lengths: the tip is at the sum of the links turned by the summed angles.

    Inertias are those of solid bodies: positive masses, principal moments that obey the triangle inequality.
    """
    write = runpy.run_path(str(SCRIPT))["planar_arm_urdf"]
    for lengths in [[1.0, 1.0, 1.0], [0.7], [0.1, 0.2, 0.3, 1e-3, 2.5, 1 / 3, 0.4]]:
        with case(lengths):
            robot = robot_from_text(write(lengths, "arm").encode(), Path("arm.urdf"))
            assert list(robot.joint_names) == [f"joint{i + 1}" for i in range(len(lengths))]
            for q in rng.uniform(-2 * np.pi, 2 * np.pi, (20, len(lengths))):
                heading, pose = np.cumsum(q), robot.pose(q, "tip")
                tip = [np.dot(lengths, np.cos(heading)), np.dot(lengths, np.sin(heading)), 0.0]
                np.testing.assert_allclose(pose[:3, 3], tip, atol=1e-13)
                np.testing.assert_allclose(pose[:2, 0], [np.cos(q.sum()), np.sin(q.sum())], atol=1e-13)
            for inertia in list(robot.pinocchio_model.inertias)[1:]:
                moments = np.linalg.eigvalsh(inertia.inertia)
                assert inertia.mass > 0.0 and moments[0] > 0.0
                assert moments[0] + moments[1] >= moments[2] * (1 - 1e-6)
