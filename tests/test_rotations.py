"""Rotation vectors and matrices against SciPy's."""

from __future__ import annotations

import numpy as np
from case import case
from rounding import rounding
from scipy.spatial.transform import Rotation

from manip_learn.robot.rotations import (
    left_jacobian,
    left_jacobian_inverse,
    rotation_matrix,
    rotation_vector,
    rotation_vectors,
)

ANGLES = [0.0, 1e-300, 1e-12, 1e-6, 0.1, 1.0, 3.0, np.pi - 1e-2, np.pi - 1e-6, np.pi - 1e-12, np.pi]


def test_there_and_back(rng: np.random.Generator) -> None:
    """Both ways to rounding at every angle, up to the sign at half a turn."""
    for angle in ANGLES:
        with case(angle):
            axes = [*np.eye(3), *-np.eye(3), *rng.normal(size=(50, 3))]
            for axis in axes:
                vector = angle * axis / np.linalg.norm(axis)
                R = Rotation.from_rotvec(vector).as_matrix()
                known = rounding(16, max(1.0, angle))  # products and sums on either way, of an angle of this size
                np.testing.assert_allclose(rotation_matrix(vector), R, rtol=0, atol=known)
                got = rotation_vector(R)
                if angle > np.pi - 1e-9 and got @ vector < 0.0:
                    got = -got
                np.testing.assert_allclose(got, vector, rtol=0, atol=known)
                assert np.linalg.norm(got) <= np.pi + known


def test_many_at_once(rng: np.random.Generator) -> None:
    """A table of rotations gives the vectors of each of them, at every angle and about every axis."""
    axes = np.concatenate([np.eye(3), -np.eye(3), rng.normal(size=(50, 3))])
    vectors = np.concatenate([angle * axes / np.linalg.norm(axes, axis=1, keepdims=True) for angle in ANGLES])
    R = Rotation.from_rotvec(vectors).as_matrix()
    one_by_one, known = [rotation_vector(one) for one in R], rounding(16, np.pi)
    np.testing.assert_allclose(rotation_vectors(R), one_by_one, rtol=0, atol=known)
    assert rotation_vectors(np.zeros((0, 3, 3))).shape == (0, 3)


def test_jacobians(rng: np.random.Generator) -> None:
    """The left Jacobian turns rates of the vector into angular velocities, and its inverse is one, at every angle."""
    for angle in [*ANGLES[:-3], 0.0999999, 0.1000001]:
        with case(angle):
            for axis in rng.normal(size=(10, 3)):
                r = angle * axis / np.linalg.norm(axis)
                J, inverse, h = left_jacobian(r), left_jacobian_inverse(r), 1e-5
                np.testing.assert_allclose(J @ inverse, np.eye(3), rtol=0, atol=rounding(24, J, inverse))
                np.testing.assert_allclose(inverse @ r, r, rtol=0, atol=rounding(24, inverse, r))
                for rate in np.eye(3):
                    turned = rotation_matrix(r + h * rate) @ rotation_matrix(r - h * rate).T
                    np.testing.assert_allclose(J @ rate, rotation_vector(turned) / (2.0 * h), rtol=0, atol=1e-9)
