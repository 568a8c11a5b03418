"""A mechanism in the scene: as lines and surfaces, or as the drawer, the door or the crank that a rollout moves."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import product
from typing import Any, Literal, final

import numpy as np
import pinocchio as pin
from jaxtyping import Float

from manip_learn.constraint.mechanism import Mechanism
from manip_learn.constraint.shown import Intention, Shown
from manip_learn.control.simulation import leads_away
from manip_learn.errors import RecordingError
from manip_learn.linalg import finite, null_basis
from manip_learn.playback.page_writer import packed
from manip_learn.recordings.trajectory import evenly
from manip_learn.robot.rotations import rotation_matrix

CIRCLE_POINTS = 96  # 3.75 degrees apart: looks round when it fills a screen
MARGIN = 0.25  # how far lines and patches reach beyond the motion, relative to its extent
LEAST_MARGIN = 0.06  # [m]
MAX_TURNS = 12.0  # of a screw that is drawn
MAX_NUMBER = 1e9  # [m] what is farther away cannot be drawn
_MAX_TEXT = 400
CORNERS = np.array(list(product((-0.5, 0.5), repeat=3)))  # of a cube with sides of 1
_TURN = 2.0 * np.pi
HANDLE_NEAR = 0.02  # [m] off the line or circle of a handle up to which a hand that is said to hold it does
FARTHEST_DOOR = np.deg2rad(110.0)  # a leaf opens no farther in front of its cupboard: what does is a crank
ON_IT = 0.005  # [m] off its line or circle up to which a hand still moves it: the play of a handle in closed fingers
LEAST_TRAVEL = 0.02  # [m] less than this is a controller that settles, not a drawer that is pulled
_CANDIDATES = 200  # places along the path where the line may be
BOARD, STANDOFF = 0.016, 0.045  # thickness of a board, and of the hand in front of it [m]
_ROUNDING = 1e-9  # [s] of times
UPRIGHT = 0.98  # cosine of the tilt up to which a chest stands on the floor
_KINDS: dict[str, Literal["drawer", "door", "crank"]] = {"line": "drawer", "hinge": "door", "screw": "crank"}
_FRONT, BODY, HANDLE = "front", "body", "handle"
Box = tuple[float, float, float, float, float, float, str]


@final
@dataclass(frozen=True, eq=False)
class MechanismDrawing:
    """What is drawn of a mechanism, in the robot's base frame [m].

    Attributes:
        type: E.g. `"hinge"`.
        sentence: The mechanism in words.
        lines: Polylines, each of shape (n, 3).
        patches: Corners of flat surfaces in order around them, each of shape (4, 3).
        shown: What the recordings did along it, in words; empty if that is not known.
        way: shape (n, 3), from where they began to the farthest point, or along the path on a surface.
        hold: Whether all of them began at one place.
    """

    type: str
    sentence: str
    lines: tuple[Float[np.ndarray, "_n 3"], ...]
    patches: tuple[Float[np.ndarray, "4 3"], ...] = ()
    shown: str = ""
    way: Float[np.ndarray, "_n 3"] = field(default_factory=lambda: np.zeros((0, 3)))
    hold: bool = False

    def to_dict(self) -> dict[str, Any]:
        """For the page."""
        content: dict[str, Any] = {name: getattr(self, name) for name in ("type", "sentence", "shown", "hold")}
        content |= {name: [packed(x, "<f4") for x in getattr(self, name)] for name in ("lines", "patches")}
        return content | {"way": packed(self.way, "<f4")}


@final
@dataclass(frozen=True, eq=False)
class Geometry:
    """Where a mechanism is, as far as that is known.

    Attributes:
        axis: shape (3,), unit vector in the base frame.
        point: shape (3,), on the axis, or the centre [m].
        radius: Of the hand about the axis or the centre [m]; 0 if there is none.
        pitch: Travel along the axis per radian [m/rad]; 0 if there is none.
    """

    axis: Float[np.ndarray, " 3"] | None
    point: Float[np.ndarray, " 3"] | None
    radius: float
    pitch: float

    @staticmethod
    def of(described: Mapping[str, Any]) -> Geometry:
        """The numbers of a mechanism's dictionary.

        Raises:
            RecordingError: Numbers of a wrong size or not finite.
        """
        axis, point = (_numbers(described, name, 3) for name in ("axis", "point"))
        radius, pitch = (float(_numbers(described, name, 0) or 0.0) for name in ("radius", "pitch"))
        length = 0.0 if axis is None else float(np.linalg.norm(axis))
        return Geometry(axis / length if axis is not None and length > 0.0 else None, point, radius, pitch)


def _numbers(described: Mapping[str, Any], name: str, n: int) -> np.ndarray | None:
    """A vector of n numbers, or the single number if n is 0; None where the mechanism has none."""
    given = described.get(name)
    if given is None:
        return None
    what = f"the mechanism's {name} must be {'three finite numbers' if n else 'a finite number'} below {MAX_NUMBER:g}"
    numbers = finite(given, *(n,) * bool(n))
    if numbers is None or not np.all(np.abs(numbers) < MAX_NUMBER):
        raise RecordingError(f"{what}, got {given!r:.80}", code="mechanism")
    return numbers


def mechanism_drawing(
    mechanism: Mechanism | Mapping[str, Any] | None,
    held: Float[np.ndarray, "n 3"],
    shown: Shown | Intention | None = None,
) -> MechanismDrawing:
    """Lines and patches of a mechanism, as large as the motion that it held, and what was shown along it.

    What a mechanism lacks, e.g. the axis of an orientation that is held, is not drawn; its sentence is always shown.

    Args:
        mechanism: Or its dictionary, as a constraint file holds it; None where it has no name.
        held: The tip where the mechanism held it, in the base frame [m]; at least one point.
        shown: What the recordings did along it, or where they went, if that is known.

    Raises:
        RecordingError: Numbers of a wrong size or not finite.
    """
    described = mechanism if isinstance(mechanism, Mapping | None) else mechanism.to_dict()
    if shown is not None:
        plain = MechanismDrawing("", "", ()) if mechanism is None else mechanism_drawing(mechanism, held)
        if isinstance(shown, Intention) or (described or {}).get("relative_to"):
            return replace(plain, shown=shown.sentence)
        return replace(plain, shown=shown.sentence, way=shown.points, hold=shown.hold is not None)
    described = described or {}
    kind = str(described.get("type") or "mechanism")[:_MAX_TEXT]
    sentence = str(described.get("sentence") or kind)[:_MAX_TEXT]
    geometry = Geometry.of(described)
    axis, point = geometry.axis, geometry.point
    if kind == "ball" and point is not None and geometry.radius:
        circles = (_around(axis, point, geometry.radius) for axis in np.eye(3))
        return MechanismDrawing(kind, sentence, tuple(circles))
    if kind == "ball" or axis is None or point is None:
        return MechanismDrawing(kind, sentence, ())
    if kind == "plane":  # a rectangle, its sides along the widest and the narrowest spread of the motion
        basis = np.array(_across(axis))
        flat = (held - point) @ basis.T
        turn = np.linalg.svd(flat - flat.mean(axis=0), full_matrices=False)[2] if len(flat) > 2 else np.eye(2)
        sides = turn @ basis
        within = (held - point) @ sides.T
        low, high = within.min(axis=0), within.max(axis=0)
        margin = _margin(float((high - low).max()))
        (x, y), (right, top) = low - margin, high + margin
        patch = point + np.array([[x, y], [right, y], [right, top], [x, top]]) @ sides
        return MechanismDrawing(kind, sentence, (np.vstack([patch, patch[:1]]),), (patch,))
    along = (held - point) @ axis
    low, high, radius = float(along.min()), float(along.max()), geometry.radius
    reach = _margin(high - low) + 0.3 * radius
    lines = [np.array([point + (low - reach) * axis, point + (high + reach) * axis])]
    if kind == "screw" and geometry.pitch and radius:
        arm, pitch = held[0] - point, geometry.pitch
        first, second = _across(axis)
        phase = np.arctan2(arm @ second, arm @ first) + (low - arm @ axis) / pitch  # at the lowest place held
        turn = np.sign(pitch) * min((high - low) / abs(pitch), _TURN * MAX_TURNS)
        lines.append(_around(axis, point + low * axis, radius, turn, pitch, phase))
    elif kind != "line" and radius:  # the circle of a hinge, the two rims of a cylinder
        heights = (low, high) if kind == "other" else (0.5 * (low + high),)
        lines += [_around(axis, point + h * axis, radius) for h in heights]
    return MechanismDrawing(kind, sentence, tuple(lines))


def _around(
    axis: np.ndarray, point: np.ndarray, radius: float, turn: float = _TURN, pitch: float = 0.0, phase: float = 0.0
) -> Float[np.ndarray, "n 3"]:
    """The circle, or the helix, of a hand that turns about an axis; it begins beside the point, at a phase [rad]."""
    first, second = _across(axis)
    begin = point + radius * (np.cos(phase) * first + np.sin(phase) * second)
    angles = np.linspace(0.0, turn, max(2, round(CIRCLE_POINTS * abs(turn) / _TURN) + 1))[:, None]
    return Mechanism("screw", axis, point, pitch=pitch).places(begin, angles)


def _across(axis: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Two unit vectors that make a right-handed frame with the axis."""
    first = null_basis(axis[None, :])[:, 0]
    return first, np.cross(axis, first)


def _margin(extent: float) -> float:
    return max(MARGIN * extent, LEAST_MARGIN)


@final
@dataclass(frozen=True, eq=False)
class Furniture:
    """One piece of furniture, in the frame of its handle where it is shut: x right or away from the hinge, y the way
    it opens, z up or the axis about which it opens, right-handed.

    Attributes:
        kind: What it is.
        pose: shape (4, 4), that frame in the robot's base [m].
        times: shape (T,), from the motion's first sample on [s].
        opening: shape (T,), how far the hand has moved it [m for a drawer, rad for the others].
        pushed_from: How far a drawer that is pushed shut is open at first [m]; 0 for whatever is pulled open.
        pivot: shape (3,), on the axis about which it turns, in that frame [m]; zero for a drawer.
        pitch: Travel along the axis per radian [m/rad].
        fixed, moving: Boxes as (centre x, y, z, size x, y, z, what) [m].
    """

    kind: Literal["drawer", "door", "crank"]
    pose: Float[np.ndarray, "4 4"]
    times: Float[np.ndarray, " T"]
    opening: Float[np.ndarray, " T"]
    pushed_from: float
    pivot: Float[np.ndarray, " 3"]
    pitch: float
    fixed: tuple[Box, ...]
    moving: tuple[Box, ...]

    @property
    def unit(self) -> str:
        """Of the opening."""
        return "m" if self.kind == "drawer" else "rad"

    def moved(self, points: Float[np.ndarray, "n 3"], opening: float) -> Float[np.ndarray, "n 3"]:
        """Points of the moving part in the base frame [m], when the hand has moved it so far [m or rad]."""
        if self.kind == "drawer":
            local = points + [0.0, abs(self.pushed_from - opening), 0.0]
        else:
            c, s = np.cos(opening), np.sin(opening)
            turned = (points - self.pivot) @ np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
            local = self.pivot + turned + [0.0, 0.0, self.pitch * opening]
        return local @ self.pose[:3, :3].T + self.pose[:3, 3]

    def corners(self) -> Float[np.ndarray, "n 3"]:
        """Of all boxes, shut and as far open as it comes, in the base frame [m]."""
        fixed, moving = _corners(self.fixed), _corners(self.moving)
        turned = [self.moved(moving, o) for o in np.linspace(0.0, float(self.opening.max()), 6)]
        return np.concatenate([fixed @ self.pose[:3, :3].T + self.pose[:3, 3], *turned])

    def to_dict(self) -> dict[str, Any]:
        """For the page; the opening is a curve of one of the tracks."""
        return {
            "kind": self.kind,
            "unit": self.unit,
            "pose": [float(x) for x in self.pose.ravel()],
            "pushedFrom": self.pushed_from,
            "pivot": self.pivot.tolist(),
            "pitch": self.pitch,
            "fixed": [list(box) for box in self.fixed],
            "moving": [list(box) for box in self.moving],
        }


def furniture_of(
    mechanism: Mapping[str, Any] | None,
    times: Float[np.ndarray, " T"],
    path: Float[np.ndarray, "T 3"],
    ways: Sequence[tuple[float, float]] | None = None,
    shown: Shown | None = None,
) -> Furniture | None:
    """What the hand moves along its mechanism; None if that is nothing that opens, or nobody knows where it stands.

    Where the recordings took hold at one place, the furniture is shut with its handle there, and opens as they went. A
    hand that takes hold in the middle of the way has it open by that much. Elsewhere the handle is shut where the
    motion along the mechanism begins, or the first of the given ways. The furniture follows the hand, and stays where
    the hand leaves it. What is moved away from the robot's base is a drawer that is pushed: it is open at first, and
    shut in the end.

    Args:
        mechanism: Its dictionary, as a constraint keeps it.
        times: From the motion's first sample on [s].
        path: The hand in the base frame [m].
        ways: Start and end of the times during which the hand has hold of it, if that is known; the furniture stands
            still outside of them [s]. None: the largest sweep along it.
        shown: What the recordings show along the mechanism, where that is known.

    Raises:
        RecordingError: A mechanism with numbers of a wrong size or not finite.
    """
    if not mechanism or str(mechanism.get("type")) not in _KINDS or not len(path):
        return None
    geometry, kind = Geometry.of(mechanism), _KINDS[mechanism["type"]]
    axis, point, pitch = geometry.axis, geometry.point, geometry.pitch
    if axis is None or (kind != "drawer" and point is None):
        return None
    if kind == "door" and shown is not None and shown.hold is not None and shown.most > FARTHEST_DOOR:
        kind = "crank"
    centre = point if kind != "drawer" else None
    along, across, lever = _coordinates(axis, centre, pitch, path)
    spans = [slice(*np.searchsorted(times, (a - _ROUNDING, b + _ROUNDING))) for a, b in ways or ()]
    if ways is None:
        found = _stretch(lever * along, across)
    elif not spans or len(along[spans[0]]) < 2:
        found = None
    else:  # it begins where it is shut
        first, off = spans[0].start, across[spans[0]]
        k = int(np.argmin(np.linalg.norm(off - np.median(off, axis=0), axis=1)))
        begin, end = (first + n for n in _run(off, off[k], k))
        moved = lever * (along[begin:end] - along[begin])
        far = float(moved[np.argmax(np.abs(moved))])
        found = None if abs(far) < LEAST_TRAVEL else (begin, end, first + k, float(np.sign(far)))
    held, least = np.zeros(len(along), dtype=bool), 0.0
    if shown is not None and shown.hold is not None:
        along_it = axis if shown.mechanism.axis is None else shown.mechanism.axis
        handle, sense, least = shown.hold, float(np.sign(axis @ along_it)) or 1.0, shown.most
        shut, circle, _ = _coordinates(axis, centre, pitch, handle[None])
        if ways is None and found is not None:
            spans = [slice(found[0], found[1])]
        if centre is not None and spans and spans[0].start < len(along):  # which turn it is
            first = spans[0].start
            turns = -sense * np.floor(sense * (along[first] - shut[0]) / _TURN + 0.25)
            if pitch:
                turns = np.round((across[first, 1] - circle[0, 1]) / (_TURN * pitch))
            along, across = along + _TURN * turns, across - [0.0, _TURN * turns * pitch]
        for span in spans:
            held[span] = np.linalg.norm(across[span] - circle, axis=1) <= HANDLE_NEAR
        begin = int(np.argmax(held))
        moved = sense * (along - shut) * np.any(held)
    elif found is None:
        return None
    else:
        begin, end, middle, sense = found
        back = along[begin] - along[middle]
        handle = path[middle] + back * axis
        if centre is not None:
            handle = centre + rotation_matrix(back * axis) @ (path[middle] - centre) + pitch * back * axis
        held[begin:end] = True
        for later in spans[1:]:
            held[later] = np.linalg.norm(across[later] - across[middle], axis=1) <= ON_IT
        moved = sense * (along - along[begin])
    moved = np.maximum(moved, 0.0)[np.maximum.accumulate(np.where(held, np.arange(len(along)), begin))]
    if centre is not None and kind != "drawer":
        if np.linalg.norm(np.cross(axis, handle - centre)) < LEAST_TRAVEL:
            return None  # on the axis itself
        pose, pivot = about(sense * axis, centre, handle, STANDOFF if kind == "door" else 0.0)
        boxes = door_boxes(pivot) if kind == "door" else crank_boxes(-float(pivot[0]))
        return Furniture(kind, pose, times, moved, 0.0, pivot, pitch, *boxes)
    out, travel = sense * axis, max(float(moved.max()), least)
    is_pushed = leads_away(handle, out)
    pose = facing(-out, handle + travel * out) if is_pushed else facing(out, handle)
    return Furniture(kind, pose, times, moved, travel * is_pushed, np.zeros(3), 0.0, *drawer_boxes(travel, pose))


def _coordinates(
    axis: Float[np.ndarray, " 3"], point: Float[np.ndarray, " 3"] | None, pitch: float, path: Float[np.ndarray, "T 3"]
) -> tuple[Float[np.ndarray, " T"], Float[np.ndarray, "T 2"], float]:
    """Where the hand is along the axis [m], or around it [rad] if a point of it is given; what stays the same while it
    is on its line or circle [m]; and the travel for one unit of the first.
    """
    basis = null_basis(axis[None, :]).T
    if point is None:
        return path @ axis, path @ basis.T, 1.0
    arm = path - point
    x, y = arm @ basis[0], arm @ np.cross(axis, basis[0])
    angle, radius = np.unwrap(np.arctan2(y, x)), np.hypot(x, y)
    return angle, np.column_stack([radius, arm @ axis - pitch * angle]), float(np.hypot(np.median(radius), pitch))


def _stretch(along: Float[np.ndarray, " T"], across: Float[np.ndarray, "T k"]) -> tuple[int, int, int, float] | None:
    """The motion on the mechanism: first sample, end, a sample in the middle of its line, and its sense.

    It is where the largest sweep along the mechanism is made.

    Args:
        along: Where the hand is along the mechanism [m].
        across: What is constant while the hand is on one line or circle [m].
    """
    ways = [(_sweep(along, *_run(across, across[k], k)), k) for k in evenly(len(along), _CANDIDATES)]
    k = max(ways, key=lambda way: way[0][0])[1]
    start, end = _run(across, across[k], k)
    for _ in range(2):  # a place at the rim of the line is on it too: from there to its middle
        centre = np.median(across[start:end], axis=0)
        k = start + int(np.argmin(np.linalg.norm(across[start:end] - centre, axis=1)))
        start, end = _run(across, centre, k)
    travel, sense, last = _sweep(along, start, end)
    if travel < LEAST_TRAVEL:
        return None
    run = sense * along[start:end]
    # a hand that comes along the axis has not taken hold yet; one that opens twice has shut it before
    begin = int(np.flatnonzero(run <= run[: last + 1].min() + 0.1 * ON_IT)[0])
    return start + begin, end, k, sense


def _run(across: Float[np.ndarray, "T k"], centre: Float[np.ndarray, " k"], k: int) -> tuple[int, int]:
    """First sample and end of the time around sample k that the hand stays on the line through a place."""
    off = np.flatnonzero(np.linalg.norm(across - centre, axis=1) > ON_IT)
    place = int(np.searchsorted(off, k))
    return int(off[place - 1]) + 1 if place else 0, int(off[place]) if place < off.size else len(across)


def _sweep(along: Float[np.ndarray, " T"], start: int, end: int) -> tuple[float, float, int]:
    """The longest way between two samples [m], its sense, and its last sample, counted from `start`."""
    ways = []
    for sense in (1.0, -1.0):
        swept = sense * along[start:end] - np.minimum.accumulate(sense * along[start:end])
        ways.append((float(swept.max()), sense, int(np.argmax(swept))))
    return max(ways)


def facing(out: Float[np.ndarray, " 3"], handle: Float[np.ndarray, " 3"]) -> Float[np.ndarray, "4 4"]:
    """Pose of a handle that is pulled along `out`, as upright as that allows."""
    up = np.array([0.0, 0.0, 1.0]) if abs(out[2]) < UPRIGHT else np.array([1.0, 0.0, 0.0])
    up = up - (up @ out) * out
    up /= np.linalg.norm(up)
    return pin.SE3(np.column_stack([np.cross(out, up), out, up]), handle).homogeneous


def about(
    axis: Float[np.ndarray, " 3"], point: Float[np.ndarray, " 3"], handle: Float[np.ndarray, " 3"], standoff: float
) -> tuple[Float[np.ndarray, "4 4"], Float[np.ndarray, " 3"]]:
    """Pose of a handle that turns about an axis and stands off the leaf, which reaches to the axis; and that axis."""
    arm = handle - point
    arm = arm - (arm @ axis) * axis
    radius = float(np.linalg.norm(arm))
    right, out = arm / radius, np.cross(axis, arm / radius)
    sine = min(standoff / radius, 0.5)
    cosine = float(np.sqrt(1.0 - sine**2))
    turned = np.column_stack([cosine * right - sine * out, sine * right + cosine * out, axis])
    return pin.SE3(turned, handle).homogeneous, np.array([-cosine * radius, -sine * radius, 0.0])


def _corners(boxes: tuple[Box, ...]) -> Float[np.ndarray, "n 3"]:
    return np.concatenate([np.array(box[:3]) + CORNERS * np.array(box[3:6]) for box in boxes])


def drawer_boxes(travel: float, pose: Float[np.ndarray, "4 4"]) -> tuple[tuple[Box, ...], tuple[Box, ...]]:
    """A chest, on the floor if it is upright, and its drawer, deep enough to be pulled so far."""
    width, depth = float(np.clip(1.2 * travel, 0.26, 0.5)), travel + 0.08
    height = 0.42 * width
    inner, face = width - 4.0 * BOARD, -STANDOFF
    low = 0.5 * BOARD - 0.4 * height
    sides = (-0.5 * (inner - BOARD), 0.5 * (inner - BOARD))
    moving = (
        *_handle(0.36 * width),
        (0.0, face - 0.5 * BOARD, 0.0, width, BOARD, height, _FRONT),
        (0.0, face - 0.5 * depth, low, inner, depth - BOARD, BOARD, BODY),
        *((x, face - 0.5 * depth, 0.0, BOARD, depth - BOARD, 0.8 * height, BODY) for x in sides),
        (0.0, face - depth, 0.0, inner, BOARD, 0.8 * height, BODY),
    )
    chest = _case(-0.5 * width, 0.5 * width, -0.5 * height, 0.5 * height, depth + BOARD, face - BOARD)
    below = float(pose[2, 3]) - 0.5 * height - BOARD
    if pose[2, 2] > UPRIGHT and below > 0.05:
        n = max(1, round(below / height))
        step = below / n
        back = face - 1.5 * BOARD - 0.5 * depth
        chest += ((0.0, back, -0.5 * height - BOARD - 0.5 * below, width + 2.0 * BOARD, depth + BOARD, below, BODY),)
        for k in range(n):
            z = -0.5 * height - BOARD - (k + 0.5) * step
            chest += ((0.0, face - 0.5 * BOARD, z, width, BOARD, step - 0.6 * BOARD, _FRONT), *_handle(0.36 * width, z))
    return chest, moving


def door_boxes(pivot: Float[np.ndarray, " 3"]) -> tuple[tuple[Box, ...], tuple[Box, ...]]:
    """A cupboard and its door, from the axis to a little beyond the handle."""
    left, face = float(pivot[0]), float(pivot[1])
    right, half = -0.18 * left + 0.03, float(np.clip(-0.7 * left, 0.14, 0.4))
    bar = 0.35 * half
    feet = ((0.0, 0.5 * face, z * 0.8 * bar, 0.01, -face, 0.01, HANDLE) for z in (-1.0, 1.0))
    leaf = (0.5 * (left + right), face - 0.5 * BOARD, 0.0, right - left, BOARD, 2.0 * half, _FRONT)
    case = _case(left, right, -half, half, 0.05 - 0.5 * left, face - BOARD)
    hinge = (left, face, 0.0, 0.016, 0.016, 2.0 * half, HANDLE)
    return (*case, hinge), (leaf, (0.0, 0.0, 0.0, 0.014, 0.014, 2.0 * bar, HANDLE), *feet)


def crank_boxes(radius: float) -> tuple[tuple[Box, ...], tuple[Box, ...]]:
    """A crank on its spindle."""
    arm = (-0.5 * radius, 0.0, -0.03, radius + 0.02, 0.02, 0.015, _FRONT)
    spindle = (-radius, 0.0, -0.08, 0.025, 0.025, 0.12, BODY)
    return (spindle,), (arm, (0.0, 0.0, 0.0, 0.02, 0.02, 0.06, HANDLE))


def _case(left: float, right: float, low: float, high: float, depth: float, front: float) -> tuple[Box, ...]:
    """Five boards that are open in front, around an inner box [m]."""
    x, z, y = 0.5 * (left + right), 0.5 * (low + high), front - 0.5 * depth
    wide, tall = right - left + 2.0 * BOARD, high - low
    return (
        *((x, y, end, wide, depth, BOARD, BODY) for end in (low - 0.5 * BOARD, high + 0.5 * BOARD)),
        *((end, y, z, BOARD, depth, tall, BODY) for end in (left - 0.5 * BOARD, right + 0.5 * BOARD)),
        (x, front - depth + 0.5 * BOARD, z, wide, BOARD, tall, BODY),
    )


def _handle(width: float, z: float = 0.0) -> tuple[Box, ...]:
    """A bar across, at which the hand is, and its two feet."""
    feet = ((x * 0.42 * width, -0.5 * STANDOFF, z, 0.01, STANDOFF, 0.01, HANDLE) for x in (-1.0, 1.0))
    return ((0.0, 0.0, z, width, 0.014, 0.014, HANDLE), *feet)
