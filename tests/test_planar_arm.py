"""The script that writes planar arms, and the shipped robots/planar3.urdf."""

from __future__ import annotations

import runpy
import subprocess
import sys
from pathlib import Path

import numpy as np
import pinocchio as pin
from case import case

ROBOTS = Path(__file__).resolve().parents[1] / "robots"
SCRIPT = ROBOTS / "make_planar3.py"
planar_arm_urdf = runpy.run_path(str(SCRIPT))["planar_arm_urdf"]


def test_the_script_writes_the_shipped_file() -> None:
    """The file regenerated is the same to the byte."""
    done = subprocess.run([sys.executable, str(SCRIPT), "1", "1", "1"], capture_output=True, check=True, timeout=60)
    assert done.stdout == (ROBOTS / "planar3.urdf").read_bytes()


def test_a_bad_length_is_one_sentence_and_code_2() -> None:
    """A length that is no positive number ends the script with exit code 2, is named, and prints no traceback."""
    for length in ["0", "nan"]:
        with case(length):
            done = subprocess.run(
                [sys.executable, str(SCRIPT), "1", length], capture_output=True, text=True, timeout=60
            )
            assert done.returncode == 2 and f"length {length} m" in done.stderr and "Traceback" not in done.stderr


def test_forward_kinematics_is_the_textbook_formula() -> None:
    """Any number of links and lengths: the tip is at the sum of the links turned by the summed angles.

    Inertias are those of solid bodies: positive masses, principal moments that obey the triangle inequality.
    """
    for lengths in [[1.0, 1.0, 1.0], [0.7], [0.1, 0.2, 0.3, 1e-3, 2.5, 1 / 3, 0.4]]:
        with case(lengths):
            model = pin.buildModelFromXML(planar_arm_urdf(lengths, "arm"))
            data = model.createData()
            assert list(model.names)[1:] == [f"joint{i + 1}" for i in range(len(lengths))]
            for q in np.random.default_rng(0).uniform(-2 * np.pi, 2 * np.pi, (20, len(lengths))):
                heading = np.cumsum(q)
                pin.framesForwardKinematics(model, data, q)
                pose = data.oMf[model.getFrameId("tip")]
                tip = [np.dot(lengths, np.cos(heading)), np.dot(lengths, np.sin(heading)), 0.0]
                np.testing.assert_allclose(pose.translation, tip, atol=1e-13)
                np.testing.assert_allclose(pose.rotation[:2, 0], [np.cos(q.sum()), np.sin(q.sum())], atol=1e-13)
            for inertia in list(model.inertias)[1:]:
                moments = np.linalg.eigvalsh(inertia.inertia)
                assert inertia.mass > 0.0 and moments[0] > 0.0
                assert moments[0] + moments[1] >= moments[2] * (1 - 1e-6)
