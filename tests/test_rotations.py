"""Rotation vectors and matrices against SciPy's."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from manip_learn.robot.rotations import rotation_matrix, rotation_vector

ANGLES = [0.0, 1e-300, 1e-12, 1e-6, 0.1, 1.0, 3.0, np.pi - 1e-2, np.pi - 1e-6, np.pi - 1e-12, np.pi]


@pytest.mark.parametrize("angle", ANGLES)
def test_there_and_back(angle: float, rng: np.random.Generator) -> None:
    """Both ways to 1e-14 at every angle, up to the sign at half a turn."""
    axes = [*np.eye(3), *-np.eye(3), *rng.normal(size=(50, 3))]
    for axis in axes:
        vector = angle * axis / np.linalg.norm(axis)
        R = Rotation.from_rotvec(vector).as_matrix()
        np.testing.assert_allclose(rotation_matrix(vector), R, rtol=0, atol=1e-15)
        got = rotation_vector(R)
        if angle > np.pi - 1e-9 and got @ vector < 0.0:
            got = -got
        np.testing.assert_allclose(got, vector, rtol=0, atol=2e-15)
        assert np.linalg.norm(got) <= np.pi + 1e-15


def test_more_than_a_turn() -> None:
    """A vector of several turns gives the matrix of what is left, and that the short vector."""
    R = rotation_matrix(np.array([0.0, 0.0, 4.0 * np.pi + 0.3]))
    np.testing.assert_allclose(rotation_vector(R), [0.0, 0.0, 0.3], rtol=0, atol=1e-14)
