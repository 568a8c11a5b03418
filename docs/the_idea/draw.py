"""Draw the pictures of docs/overview.md: `python docs/the_idea/draw.py`.

The arm is the shipped `planar3`, and the library's manipulability chooses its postures. The pictures stand in the page
itself, so that lines and letters take the colour of its text, in light and dark.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

import manip_learn as ml

HERE = Path(__file__).parent
FREE, HELD, ARM = "#0a8f6a", "#d55e00", "#2f81d6"  # contrast of at least 3 on white and on black
ROBOT = ml.load_robot("planar3")
FEATURES = ml.FrameJacobian(ROBOT, "tip", "x y")


class Picture:
    """Shapes of one drawing; places are (x, y) [pixels] from its lower left corner, y upwards."""

    def __init__(self, title: str, width: float, height: float):
        self.title, self.width, self.height = title, width, height
        self.shapes: list[str] = []

    def line(self, points: ArrayLike, colour: str = "currentColor", width: float = 3.0, opacity: float = 1.0) -> None:
        """A line through some points."""
        path = " ".join(f"{x:.1f},{self.height - y:.1f}" for x, y in np.asarray(points, float))
        self.shapes.append(
            f'<polyline points="{path}" fill="none" stroke="{colour}" stroke-width="{width}" '
            f'stroke-linecap="round" stroke-linejoin="round" opacity="{opacity}"/>'
        )

    def box(self, x: float, y: float, width: float, height: float, opacity: float) -> None:
        """A piece of furniture."""
        self.shapes.append(
            f'<rect x="{x}" y="{self.height - y - height}" width="{width}" height="{height}" rx="2" '
            f'fill="currentColor" fill-opacity="{opacity}" stroke="currentColor"/>'
        )

    def words(self, x: float, y: float, text: str) -> None:
        """A label, centred."""
        self.shapes.append(f'<text x="{x}" y="{self.height - y}" text-anchor="middle">{text}</text>')

    def direction(self, place: ArrayLike, half: ArrayLike, colour: str) -> None:
        """A direction both ways: arrow heads at the ends where it is free, bars where it is held."""
        along = np.asarray(half, float) / np.linalg.norm(half)
        across = 7.0 * np.array([-along[1], along[0]])
        ends = [np.asarray(place, float) + sign * np.asarray(half, float) for sign in (-1.0, 1.0)]
        self.line(ends, colour)
        for end, outward in zip(ends, (-along, along), strict=True):
            back = -9.0 * outward if colour == FREE else 0.0 * along
            self.line([end + back + across, end, end + back - across], colour)

    def arm(self, q: ArrayLike, base: ArrayLike, scale: float, opacity: float = 1.0) -> np.ndarray:
        """The arm with its base at a place, scale in pixels per metre; returns the places of joints and tip, (4, 2)."""
        frames = (ROBOT.frame(name) for name in ("joint1", "joint2", "joint3", "tip"))
        places = np.array([np.asarray(base) + scale * ROBOT.pose(q, frame)[:2, 3] for frame in frames])
        self.line(places[0] + np.array([[-12.0, 0.0], [12.0, 0.0]]), width=9.0, opacity=0.6)  # the foot
        self.line(places, ARM, 7.0, opacity)
        for x, y in places[:-1]:
            self.shapes.append(
                f'<circle cx="{x:.1f}" cy="{self.height - y:.1f}" r="5" fill="{ARM}" stroke="currentColor" '
                f'opacity="{opacity}"/>'
            )
        along = (places[3] - places[2]) / scale
        for side in (-7.0, 7.0):
            finger = places[3] + side * np.array([-along[1], along[0]])
            self.line([places[3] - 6 * along, finger - 6 * along, finger + 6 * along], width=3.0, opacity=opacity)
        return places

    def save(self, name: str) -> None:
        """As SVG to stand in a page."""
        head = (
            f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {self.width} {self.height}" role="img" '
            f'aria-label="{self.title}" font-family="sans-serif" font-size="16" fill="currentColor" width="100%">'
        )
        (HERE / f"{name}.svg").write_text("\n".join([head, *self.shapes, "</svg>\n"]), encoding="utf-8")


def posture(tip: ArrayLike, heading: float, bend: float) -> np.ndarray:
    """Joint angles (3,) [rad] that bring the tip to a place [m] with its last link at a heading [rad], bend 1 or -1."""
    x, y = np.asarray(tip) - [np.cos(heading), np.sin(heading)]
    second = bend * np.arccos(np.clip((x * x + y * y - 2.0) / 2.0, -1.0, 1.0))
    first = np.arctan2(y, x) - second / 2.0  # links of one length
    return np.array([first, second, heading - first - second])


def drawer(picture: Picture) -> np.ndarray:
    """A chest, its drawer pulled out, seen from above; returns the place of the handle."""
    picture.box(310, 40, 75, 132, 0.14)
    picture.box(214, 75, 96, 62, 0.06)
    picture.line([[214, 93], [203, 93], [203, 119], [214, 119]])
    return np.array([200, 106])


def draw_held_and_free() -> None:
    """A hand on a drawer."""
    picture = Picture("From above: a hand on a drawer, free along the rails and held across them", 400, 200)
    handle, scale = drawer(picture), 72.0
    base = np.array([35, 50])
    picture.arm(posture((handle - base) / scale, 0.4, -1.0), base, scale)
    picture.direction(handle, [62, 0], FREE)
    picture.direction(handle, [0, 48], HELD)
    picture.words(246, 84, "free")
    picture.words(200, 168, "held")
    picture.save("held_and_free")


def draw_singular() -> None:
    """The same stretched arm at two drawers."""
    picture = Picture("The same stretched arm at two drawers: it cannot correct along itself, only across", 400, 200)
    stretched = np.zeros(3)
    lost, fine = (ml.manipulability(ml.Constraint([row], FEATURES), stretched) for row in ([1, 0], [0, 1]))
    assert lost == 0.0 and fine > 1.0
    for base, free, words in ((20, [0, 1], "task lost"), (220, [1, 0], "no trouble")):
        tip = np.array([base + 3 * 36, 112])
        along, across = np.array(free), np.array([free[1], free[0]])
        for side in (-13, 13):  # rails
            picture.line([tip + side * across - 66 * along, tip + side * across + 66 * along], width=1.0, opacity=0.6)
        picture.arm(stretched, [base, 112], 36.0)
        picture.direction(tip, 52 * along, FREE)
        picture.direction(tip, 34 * across, HELD)
        picture.words(base + 60, 14, words)
    picture.save("singular")


def draw_spare_joints() -> None:
    """Postures of the arm while its hand stays where it is, from the least to the most room across the drawer."""
    picture = Picture("An arm swings its elbow while the hand keeps holding the drawer", 400, 200)
    handle, scale = drawer(picture), 72.0
    base, across = np.array([114, 20]), ml.Constraint([[0, 1]], FEATURES)
    postures = [posture((handle - base) / scale, heading, -1.0) for heading in (1.8, 1.05, 0.3)]
    room = [ml.manipulability(across, q) for q in postures]
    elbows = [picture.arm(q, base, scale, opacity)[1] for q, opacity in zip(postures, (0.35, 0.6, 1.0), strict=True)]
    start, end = (np.arctan2(*(elbow - base)[::-1]) for elbow in (elbows[0], elbows[-1]))
    swing = base + (scale + 16) * np.array([[np.cos(a), np.sin(a)] for a in np.linspace(start, end, 20)])
    picture.line(swing, width=2.0)
    picture.line([swing[-1] + [3, 10], swing[-1], swing[-1] + [11, 1]], width=2.0)
    picture.words(95, 150, f"{room[-1] / room[0]:.1f} times the room")
    picture.save("spare_joints")


if __name__ == "__main__":
    draw_held_and_free()
    draw_singular()
    draw_spare_joints()
