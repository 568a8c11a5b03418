"""The check of shapes that runs beside all tests notices what it is there for."""

from __future__ import annotations

import os

import numpy as np
import pytest
import shape_checker
from jaxtyping import Float
from shape_checker import check_shapes

from manip_learn import linalg
from manip_learn.robot.frame_kinematics import FrameKinematics

Rows = Float[np.ndarray, "s p"]


@check_shapes
def product(a: Rows, b: Float[np.ndarray, " p"] | None = None, rows: int = 2) -> Float[np.ndarray, " s"]:
    """Rows times a column; `rows` makes the result wrong."""
    return np.zeros(rows) if b is None else a @ b


def test_wrong_shapes_are_noticed():
    """Also after a call that was right, which is remembered; the message names the argument."""
    product(np.ones((2, 3)), np.ones(3))
    product(np.ones((2, 3)))
    for given, named in (
        ((np.ones((2, 3)), np.ones(4)), "b"),
        ((np.ones(3), np.ones(3)), "a"),
        ((np.ones((2, 3), dtype=int), np.ones(3)), "a"),
        (([[1.0, 2.0]], np.ones(2)), "a"),
        ((np.ones((2, 3)), None, 3), "return"),
        ((np.ones((3, 3)),), "return"),
    ):
        with pytest.raises(TypeError, match=f"product: {named} is not"):
            product(*given)


@pytest.mark.skipif(os.environ.get("CHECK_SHAPES", "1") == "0", reason="the checks are switched off")
def test_the_library_is_checked(monkeypatch):
    """Functions and methods of the library have been decorated, and a wrong call of one fails: each of the first, and
    one in so many of those that come after a thousand.
    """
    monkeypatch.setattr(shape_checker, "ONE_IN", 1)
    assert hasattr(FrameKinematics.jacobian, "__wrapped__")
    with pytest.raises(TypeError, match="null_basis: A is not"):
        linalg.null_basis(np.ones(3))
