"""What is drawn of a mechanism: every line and patch where the mechanism is."""

from __future__ import annotations

import numpy as np
import pytest

from manip_learn.errors import RecordingError
from manip_learn.playback.scene_data import mechanism_drawing

AXIS, POINT, RADIUS = np.array([0.6, 0.0, 0.8]), np.array([0.3, -0.1, 0.2]), 0.4
FIRST = np.array([0.8, 0.0, -0.6])  # across the axis
SECOND = np.cross(AXIS, FIRST)


def around(angle: np.ndarray, along: np.ndarray) -> np.ndarray:
    """Points at a radius from the axis, shape (n, 3)."""
    turned = np.cos(angle)[:, None] * FIRST + np.sin(angle)[:, None] * SECOND
    return POINT + RADIUS * turned + along[:, None] * AXIS


def described(kind: str, **more: object) -> dict[str, object]:
    """A mechanism's dictionary; its axis is twice as long as it need be."""
    return {"type": kind, "axis": (2.0 * AXIS).tolist(), "point": POINT.tolist(), **more}


def in_the_axes(points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Distance from the axis, angle about it, and place along it."""
    arm = points - POINT
    x, y = arm @ FIRST, arm @ SECOND
    return np.hypot(x, y), np.arctan2(y, x), arm @ AXIS


def test_a_hinge_is_an_axis_and_a_circle() -> None:
    """The circle lies in the middle of what was held; the axis is a quarter longer at each end, and 0.3 radii."""
    held = around(np.linspace(0.2, 1.2, 30), np.linspace(-0.1, 0.3, 30))
    axis, circle = mechanism_drawing(described("hinge", radius=RADIUS), held).lines
    reach = 0.25 * 0.4 + 0.3 * RADIUS
    np.testing.assert_allclose(axis, [POINT - (0.1 + reach) * AXIS, POINT + (0.3 + reach) * AXIS], atol=1e-12)
    radius, angle, along = in_the_axes(circle)
    np.testing.assert_allclose([radius, along], np.outer([RADIUS, 0.1], np.ones(len(circle))), atol=1e-12)
    np.testing.assert_allclose(np.abs(np.diff(np.unwrap(angle))), np.deg2rad(3.75), atol=1e-9)
    np.testing.assert_allclose(circle[0], circle[-1], atol=1e-12)


@pytest.mark.parametrize("pitch", [0.05, -0.08])
def test_a_screw_is_a_helix_through_the_hand(pitch: float) -> None:
    """Every point that was held lies on the helix, which begins and ends where they do, right- and left-handed."""
    angle = np.linspace(0.5, 4.0, 400)
    held = around(angle, pitch * angle)
    _, helix = mechanism_drawing(described("screw", radius=RADIUS, pitch=pitch), held).lines
    radius, turned, along = in_the_axes(helix)
    np.testing.assert_allclose(radius, RADIUS, atol=1e-12)
    np.testing.assert_allclose([along.min(), along.max()], np.sort(pitch * angle[[0, -1]]), atol=1e-12)
    np.testing.assert_allclose(np.diff(along), pitch * np.diff(np.unwrap(turned)), atol=1e-9)
    nearest = np.linalg.norm(held[:, None] - helix[None], axis=2).min(axis=1)
    assert nearest.max() < 0.02  # half the distance of two points of the helix
    turns = mechanism_drawing(described("screw", radius=RADIUS, pitch=1e-4), held).lines[1]
    _, angle, _ = in_the_axes(turns)
    assert np.ptp(np.unwrap(angle)) == pytest.approx(2.0 * np.pi * 12.0)


def test_a_cylinder_has_two_rims_and_a_line_none() -> None:
    """Rims at the ends of what was held; a line is its axis alone, 0.06 m longer than a motion of nothing."""
    held = around(np.linspace(0.0, 1.0, 9), np.linspace(-0.2, 0.2, 9))
    _, low, high = mechanism_drawing(described("other", radius=RADIUS), held).lines
    np.testing.assert_allclose([in_the_axes(low)[2].mean(), in_the_axes(high)[2].mean()], [-0.2, 0.2], atol=1e-12)
    (line,) = mechanism_drawing(described("line"), POINT[None]).lines
    np.testing.assert_allclose(line, [POINT - 0.06 * AXIS, POINT + 0.06 * AXIS], atol=1e-12)


def test_a_table_is_a_patch_around_the_motion() -> None:
    """Its corners lie in the plane, its sides along the motion's widest spread, a quarter of that beyond it."""
    round_it = np.linspace(0.0, 2.0 * np.pi, 48, endpoint=False)
    along, across = 0.4 - 0.4 * np.cos(round_it), 0.1 * np.sin(round_it)
    turned = np.cos(0.3) * FIRST + np.sin(0.3) * SECOND
    held = POINT + along[:, None] * turned + across[:, None] * np.cross(AXIS, turned)
    drawn = mechanism_drawing(described("plane"), held)
    (patch,), (edge,) = drawn.patches, drawn.lines
    np.testing.assert_array_equal(edge, [*patch, patch[0]])
    np.testing.assert_allclose((patch - POINT) @ AXIS, 0.0, atol=1e-12)
    sides = np.sort(np.linalg.norm(np.diff(edge, axis=0), axis=1))
    np.testing.assert_allclose(sides, [0.2 + 0.4, 0.2 + 0.4, 1.2, 1.2], atol=1e-9)
    np.testing.assert_allclose(patch.mean(axis=0), POINT + 0.4 * turned, atol=1e-9)


def test_a_ball_is_three_circles_and_what_is_not_known_is_not_drawn() -> None:
    """Great circles around the centre; without a centre, or of a held orientation, the sentence alone."""
    circles = mechanism_drawing(described("ball", radius=RADIUS), POINT[None]).lines
    assert len(circles) == 3
    for normal, circle in zip(np.eye(3), circles, strict=True):
        np.testing.assert_allclose(np.linalg.norm(circle - POINT, axis=1), RADIUS, atol=1e-12)
        np.testing.assert_allclose((circle - POINT) @ normal, 0.0, atol=1e-12)
    for lacking in ({"type": "ball", "radius": 0.1}, {"type": "hinge", "axis": [0, 0, 1]}, {"type": "orientation"}):
        drawn = mechanism_drawing({**lacking, "sentence": "in words"}, POINT[None])
        assert not drawn.lines and not drawn.patches and drawn.sentence == "in words"


@pytest.mark.parametrize(
    ("key", "value"),
    [("axis", [0, 1]), ("point", [0, 0, np.nan]), ("radius", "wide"), ("pitch", 2e9), ("point", [1e9, 0, 0])],
)
def test_bad_numbers_are_named(key: str, value: object) -> None:
    """The error names the number that it cannot use."""
    with pytest.raises(RecordingError, match=f"the mechanism's {key} must be") as caught:
        mechanism_drawing({**described("hinge", radius=RADIUS), key: value}, POINT[None])
    assert caught.value.code == "mechanism"
