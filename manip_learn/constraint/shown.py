"""Demonstrated motion along the free directions of a constraint: start, direction, distance and speed."""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from statistics import NormalDist
from typing import Any, Literal, final

import numpy as np
from jaxtyping import Float
from scipy.interpolate import UnivariateSpline

from manip_learn.constraint.features.feature_map import FeatureMap, Selection
from manip_learn.constraint.mechanism import CURVE, Mechanism, from_plain, plain
from manip_learn.constraint.place import Chart, Curve, across
from manip_learn.errors import FeatureError, counted
from manip_learn.linalg import complement_rows, row_basis
from manip_learn.recordings.trajectory import Trajectory, evenly
from manip_learn.robot.rotations import angles_between, rotation_matrix, rotation_vectors

Unit = Literal["m", "rad"]
START_SHARE = 0.02  # share of the distance after which a motion counts as started, and before its end as finished


def straight_motion(
    features: FeatureMap, selection: Selection, in_hand: int, contacts: Sequence[np.ndarray]
) -> Mechanism | None:
    """Return the line, plane or space of the positions that a constraint leaves free, as a mechanism.

    Args:
        features: Feature map Phi.
        selection: Lambda (s, p) with orthonormal rows.
        in_hand: Number of free translations along axes that turn with the hand, whose directions are then taken from
            the motion; 0 if the rows are not along such axes.
        contacts: Poses of the hand during each contact, shape (T, 4, 4) each, base frame [m].

    Returns:
        The mechanism, see `straight_mechanism`; None if no translation is free.
    """
    axes = np.zeros((0, 3))
    if in_hand:  # take the directions in which the hand moved
        places = np.concatenate([c[:, :3, 3] - c[:, :3, 3].mean(axis=0) for c in contacts])
        axes = np.linalg.svd(places, full_matrices=False)[2][:in_hand]
    elif features.own_axes is False:  # translations in the rows that Lambda leaves free, up to its leakage
        rows = features.weights_at(contacts[0][:1])[0, :, :3]  # type: ignore[attr-defined]  # a frame's rows
        visible = row_basis(rows)
        _, sizes, Vt = np.linalg.svd(selection @ rows @ visible.T)
        axes = Vt[int(np.count_nonzero(sizes > 0.1)) :] @ visible  # a learnt row leaks by its uncertainty
    return straight_mechanism(axes)


def straight_mechanism(axes: Float[np.ndarray, "k 3"]) -> Mechanism | None:
    """Return the mechanism that leaves some translations of the hand free.

    Args:
        axes: Free directions (k, 3), linearly independent.

    Returns:
        A line (k = 1), a plane (k = 2) or a held orientation (k = 3), without a point; None for another k.
    """
    types = {1: "line", 2: "plane", 3: "held-orientation"}
    if len(axes) not in types:
        return None
    normal = complement_rows(axes) if len(axes) == 2 else axes
    return Mechanism(types[len(axes)], None if len(axes) == 3 else normal[0] / np.linalg.norm(normal[0]))  # type: ignore[arg-type]


@final
@dataclass(frozen=True, eq=False, repr=False)
class Shown:
    """Demonstrated motion along the free directions of a constraint, over all contacts; positions in the base frame.

    Distances are measured from the start of a contact; with one free direction, they are positive in the demonstrated
    direction.

    Attributes:
        unit: Unit of the distances, `"m"` or `"rad"`.
        extent: Distance from the start of a contact to its farthest point, median.
        spread: Standard deviation of this distance.
        least, most: Shortest and longest of these distances.
        span: Length of the interval that all contacts together cover along the path; of the longest contact if the hand
            turns with the mechanism. With several free directions, the longest distance.
        speed: Mean speed until the farthest point, or over the whole path if there are several free directions; median
            over the contacts [m/s or rad/s].
        seconds: Time from the start of the motion to its farthest point, or to its end if there are several free
            directions; median over the contacts [s].
        back: True if the hand returned to the start.
        n: Number of contacts.
        hold: shape (3,), median start of the contacts [m]; None if they scatter by more than 3 mm.
        scatter: Largest distance of a start from this median [m].
        path: shape (T, k), free coordinates along the path of the most typical contact [m or rad].
        time: shape (T,), time along the path [s], from 0.
        begin: shape (3,), start of the path: `hold`, or the start of the typical contact [m].
        orientation: shape (3, 3), orientation of the hand at the start of the typical contact.
        turned: Largest angle between this orientation and the other contacts' at their starts [rad].
        one_way: True if the recordings agree on a direction; always True with several free directions.
        mechanism: Mechanism that the hand follows, in the direction of the recordings.
        force: Largest force of the hand, median over the contacts [N]; None if no efforts were recorded, or if they
            show no such force, e.g. for a hand-guided arm.
        start: shape (k,), median coordinates of the contacts' starts, relative to `begin` [m or rad].
        hand: shape (T, 3), orientation of the hand along `path`, as rotation vectors relative to the start [rad]; empty
            in files of version 0.2.
        grasps: shape (n, 4, 4), grasp poses at the starts of at most 24 contacts [m].
    """

    unit: Unit
    extent: float
    spread: float
    least: float
    most: float
    span: float
    speed: float
    seconds: float
    back: bool
    n: int
    hold: Float[np.ndarray, " 3"] | None
    scatter: float
    path: Float[np.ndarray, "T k"]
    time: Float[np.ndarray, " T"]
    begin: Float[np.ndarray, " 3"]
    orientation: Float[np.ndarray, "3 3"]
    turned: float
    one_way: bool
    mechanism: Mechanism
    force: float | None = None
    start: Float[np.ndarray, " k"] = field(default_factory=lambda: np.zeros(0))
    grasps: Float[np.ndarray, "n 4 4"] = field(default_factory=lambda: np.zeros((0, 4, 4)))
    hand: Float[np.ndarray, "T 3"] = field(default_factory=lambda: np.zeros((0, 3)))

    @property
    def is_way(self) -> bool:
        """True if the mechanism has one free direction, so that `extent` is a distance along it."""
        return self.chart.n_ways == 1

    @property
    def chart(self) -> Chart:
        """Coordinates along the mechanism, with the start of the path as grasp pose."""
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = self.orientation, self.begin
        return self.mechanism.at(pose, np.inf)

    @property
    def poses(self) -> Float[np.ndarray, "T 4 4"]:
        """Poses (T, 4, 4) along the path in the base frame [m], without rotations of the hand alone."""
        chart = self.chart
        return np.array([chart.pose(c / chart.sizes) for c in self.path])

    @property
    def points(self) -> Float[np.ndarray, "T 3"]:
        """Positions (T, 3) along the path, in the base frame [m]."""
        return self.poses[:, :3, 3]

    @cached_property
    def _ways(self) -> Float[np.ndarray, " T"]:
        """Distance of each path point along the path [m or rad], non-decreasing."""
        steps = np.diff(self.path, axis=0)
        ways = self.path[:, 0] if self.is_way else np.append(0.0, np.cumsum(np.linalg.norm(steps, axis=1)))
        return np.maximum.accumulate(ways)

    def turned_at(self, distance: float) -> Float[np.ndarray, "3 3"]:
        """Return the demonstrated orientation of the hand at a distance along the path.

        The motion must have `hand`, which files of version 0.2 lack.

        Args:
            distance: Distance along the path from its start [m or rad].

        Returns:
            Rotation matrix (3, 3) in the base frame.
        """
        return rotation_matrix(np.array([np.interp(distance, self._ways, x) for x in self.hand.T])) @ self.orientation

    def place_before(self, pose: Float[np.ndarray, "4 4"], far: Float[np.ndarray, " k"]) -> Float[np.ndarray, " 3"]:
        """Return the position from which the hand would have reached a pose by moving along the mechanism.

        Args:
            pose: Pose (4, 4) of the hand [m].
            far: Path coordinates (k,) covered since that position [m or rad].

        Returns:
            Position (3,) in the mechanism's frame [m].
        """
        chart = self.mechanism.at(pose, np.inf)
        return chart.pose(-far / chart.sizes)[:3, 3]

    def along(self, poses: Float[np.ndarray, "T 4 4"]) -> Float[np.ndarray, "T k"]:
        """Return the coordinates of another motion of the hand along this mechanism, from its own first pose.

        Args:
            poses: Poses (T, 4, 4) of the hand, in the frame of `mechanism` [m].

        Returns:
            Coordinates (T, k) along the mechanism [m or rad], 0 at the first pose.
        """
        return _ways(self.mechanism, poses)

    @property
    def sentence(self) -> str:
        """The demonstrated motion, in words."""
        at = "at the same place" if self.hold is not None else f"at places up to {100 * self.scatter:.2g} cm apart"
        where = f"In {counted(self.n, 'contact')} the hand grasped {at}"
        size, unit, digits = (1.0, "m", 2) if self.unit == "m" else (math.degrees(1.0), "degrees", 0)
        distance, low, high = (f"{size * x:.{digits}f}" for x in (self.extent, self.least, self.most))
        distance += f" {unit}" if low == high else f" {unit} ({low} to {high})"
        force = "" if self.force is None else f" It took up to {self.force:.2g} N."
        if not self.is_way:
            return f"{where}, and went up to {distance} from there on a path of {self.time[-1]:.1f} s.{force}"
        back = (", and back" if self.back else "") + ("" if self.one_way else "; not all went the same way")
        return f"{where}, moved {distance} at about {size * self.speed:.2g} {unit}/s{back}.{force}"

    def __repr__(self) -> str:
        return f"Shown({self.sentence})"

    def moved(self, transform: Float[np.ndarray, "4 4"]) -> Shown:
        """Return the demonstrated motion for fixtures (e.g. a cabinet) that were moved by p' = R p + t.

        Args:
            transform: Homogeneous matrix (4, 4) of R and t, in the base frame [m].

        Returns:
            The moved record.
        """
        R, t = transform[:3, :3], transform[:3, 3]
        places = {"hold": None if self.hold is None else R @ self.hold + t, "begin": R @ self.begin + t}
        turned = {"orientation": R @ self.orientation, "grasps": transform @ self.grasps}
        return replace(self, **places, **turned, mechanism=self.mechanism.moved(transform))

    def to_dict(self) -> dict[str, Any]:
        """Return the attributes as a dictionary of JSON values, rounded to 6 decimals."""
        return plain(self, 6)

    @staticmethod
    def from_dict(content: Any) -> Shown | None:
        """Build the record from the output of `to_dict`.

        Args:
            content: The output of `to_dict`, also of version 0.2.

        Returns:
            The record; None if the content is not a valid record, e.g. None.
        """
        try:
            return from_plain(Shown, content if "mechanism" in content else {**content, **_of_02(content)})
        except (KeyError, TypeError, ValueError):
            return None


def _of_02(content: Mapping[str, Any]) -> dict[str, Any]:
    """Return the mechanism and the path of a file of 0.2, which stores directions; until 0.4."""
    c, path = content["coordinates"], np.array(content["path"], dtype=np.float64)
    axes, point = (np.array(c[name], dtype=np.float64) for name in ("axes", "point"))
    orientation = "carried" if c["by_hand"] or c["kind"] == "ball" else "free"
    if c["kind"] == "straight":
        mechanism = straight_mechanism(axes)
        travel = np.eye(3) if len(axes) == 3 else axes if len(axes) == 1 else across(mechanism.axis)  # type: ignore
        return {"mechanism": mechanism.to_dict(), "path": path @ axes @ travel.T}  # type: ignore[union-attr]
    curve = Curve(c["curve"]) if "curve" in c else None
    kind = {"around": "screw" if c["pitch"] else "hinge", "ball": "ball"}.get(c["kind"], "other")
    sizes: dict[str, Any] = {"pitch": c["pitch"] or None, "radius": c["radius"] if c["kind"] == "sleeve" else None}
    name = CURVE if curve is not None else ""
    axis = None if kind == "ball" or name else axes[0]
    mechanism = Mechanism(kind, axis, point, orientation=orientation, name=name, curve=curve, **sizes)  # type: ignore[arg-type]
    arcs = np.array([mechanism.radius or 1.0, 1.0]) if kind == "other" and not name else np.ones(1)  # units of 0.2
    return {"mechanism": mechanism.to_dict(), "path": path * (mechanism.at(np.eye(4), np.inf).sizes / arcs)}


def _ways(mechanism: Mechanism, poses: Float[np.ndarray, "T 4 4"]) -> Float[np.ndarray, "T k"]:
    """Return the coordinates along the mechanism, in one unit, of a hand along a motion; 0 at its first pose."""
    chart = mechanism.at(poses[0], np.inf)
    return chart.coordinates(poses)[:, : chart.n_ways] * chart.sizes


def demonstrated_motion(
    features: FeatureMap, selection: Selection, mechanism: Mechanism | None, contacts: Sequence[Trajectory]
) -> Shown | None:
    """Summarise the demonstrated motion along the free directions of a constraint.

    Args:
        features: Feature map Phi.
        selection: Lambda (s, p) with orthonormal rows.
        mechanism: Mechanism that these rows describe; None if it is not known.
        contacts: One trajectory per contact with the constraint, each from the start of the contact.

    Returns:
        The motion; None if the features have no frame, if no translation or known mechanism is free, or if the hand did
        not move.
    """
    contacts = [contact for contact in contacts if len(contact) > 1]
    if not contacts or features.twist is None:
        return None
    motions = [features.twist.poses(contact.q) for contact in contacts]
    free, flat = mechanism, {"line": 1, "plane": 2, "space": 3, "curve": 1}  # number of free directions
    if mechanism is None or (mechanism.axis is None and mechanism.kind in ("line", "plane")):
        free = straight_motion(features, selection, 0 if mechanism is None else flat[mechanism.kind], motions)
    if free is None or (free.point is None and free.kind not in flat):
        return None
    ways = [_ways(free, p) for p in motions]
    is_way = ways[0].shape[1] == 1
    travels = [w[:, int(free.in_fingers) :] for w in ways]  # a rotation of the hand about itself is no travel
    farthest = [int(np.argmax(np.linalg.norm(w, axis=1))) for w in travels]
    signed = np.array([float(w[i, 0]) for w, i in zip(ways, farthest, strict=True)])
    one_way = True
    if is_way:
        # one direction must exceed the other by half of the total distance to count as the demonstrated one
        one_way = abs(float(np.sum(signed))) >= 0.5 * float(np.sum(np.abs(signed)))
        if np.sum(signed) < 0.0:
            free, ways, signed = free.reversed(), [-w for w in ways], -signed
    extents = np.array([float(np.linalg.norm(w[i])) for w, i in zip(travels, farthest, strict=True)])
    if not np.all(np.isfinite(extents)) or float(np.median(extents)) <= 0.0:
        return None
    times = [contact.time - contact.time[0] for contact in contacts]
    seconds = np.array([_duration(t, w, i, is_way) for t, w, i in zip(times, ways, farthest, strict=True)])
    lengths = extents if is_way else np.array([np.linalg.norm(np.diff(w, axis=0), axis=1).sum() for w in ways])
    grasps = np.array([p[0] for p in motions])
    middle = np.median(grasps[:, :3, 3], axis=0)
    scatter = float(np.max(np.linalg.norm(grasps[:, :3, 3] - middle, axis=1)))
    # starts within 3 mm of their median count as one place: people return to a handle within one or two millimetres,
    # but not to a spot on a table
    hold = middle if scatter <= 3e-3 else None
    # only contacts in the common direction
    deviation = np.abs(extents - np.median(extents)) + np.where(signed > 0.0, 0.0, np.inf)
    # for an even number, two are equally near to the median up to rounding: take the first
    typical = int(np.argmin(np.round(deviation, 9))) if is_way else _typical(times, ways)
    begin = grasps[typical].copy()
    if hold is not None:
        begin[:3, 3] = hold
    sizes: dict[str, Any] = {"extent": np.median, "spread": np.std, "least": np.min, "most": np.max}
    statistics: dict[str, Any] = {name: float(size(extents)) for name, size in sizes.items()}
    span = statistics["most"]
    if is_way:  # grips differ, so the angles of a carried hand cannot be compared between contacts
        carried = free.orientation == "carried"
        begins = np.zeros(len(ways)) if carried else _ways(free, grasps)[:, 0]
        low, high = (begins + [end(way) for way in ways] for end in (np.min, np.max))
        span = float(np.max(high - low) if carried else np.max(high) - np.min(low))
    return Shown(
        unit="rad" if free.kind in ("hinge", "screw", "ball") else "m",
        **statistics,
        span=span,
        speed=float(np.median(lengths / np.maximum(seconds, 1e-9))),
        seconds=float(np.median(seconds)),
        back=bool(np.median([np.linalg.norm(w[-1]) for w in ways] / extents) <= 0.1),  # share of the outbound distance
        n=len(ways),
        hold=hold,
        scatter=scatter,
        **_path(free, times[typical], ways[typical], farthest[typical], motions[typical], begin),
        begin=begin[:3, 3],
        orientation=begin[:3, :3],
        turned=float(np.max(angles_between(begin[:3, :3], grasps[:, :3, :3]))),
        one_way=one_way,
        mechanism=free,
        force=_force(features, free, contacts) if all(c.effort is not None for c in contacts) else None,
        start=np.median([_ways(free, np.array([begin, grasp]))[1] for grasp in grasps], axis=0),
        grasps=grasps[evenly(len(grasps), 24)],  # at most 10 kB in a file
    )


def _force(features: FeatureMap, free: Mechanism, contacts: Sequence[Trajectory]) -> float | None:
    """Return the largest force along the free coordinates, from the efforts minus the gravity torques; see
    `Shown.force`.

    The force on the hand is the least-squares fit to these efforts, which include joint friction. One in twenty samples
    may exceed it. The efforts are not used if they are not in newton metres or have gravity removed, or if the force
    across the free directions is larger.
    """
    twist = features.twist
    if twist.relative_to is not None or twist.robot.nq != twist.robot.nv:
        return None
    robot, frame, largest = twist.robot, twist.frame, list[Float[np.ndarray, " 2"]]()
    n = free.at(robot.pose(contacts[0].q[0], frame), np.inf).n_ways
    for contact in contacts:
        samples, forces = evenly(len(contact), 200), []  # 200 samples per contact
        effort: Any = contact.effort
        weights = np.array([robot.weight_effort(q) for q in contact.q[samples]])
        carried = float(np.sum(weights * effort[samples])), float(np.sum(weights**2))
        if not abs(carried[0] - carried[1]) < 0.3 * carried[1]:  # margin for payloads, friction, the force itself
            return None
        for q, rest in zip(contact.q[samples], effort[samples] - weights, strict=True):
            # efforts determine no force along directions with less than 2 % of the hand's largest mobility
            force = np.linalg.pinv(robot.jacobian(q, frame).T, rcond=0.02)[:3] @ rest
            ways = free.at(robot.pose(q, frame), np.inf).twist([])[:3, :n]
            along = (ways / np.linalg.norm(ways, axis=0)).T @ force
            forces.append((np.linalg.norm(along), math.sqrt(max(0.0, float(force @ force - along @ along)))))
        largest.append(np.quantile(forces, 0.95, axis=0))
    along, across = np.median(largest, axis=0).tolist()
    return along if along > max(across, 10.0) else None  # [N] more than the friction of a hand-guided arm


def _duration(time: Float[np.ndarray, " T"], way: Float[np.ndarray, "T k"], farthest: int, is_way: bool) -> float:
    """Return the duration of the motion [s]: from its start to the farthest point, without rest at either end."""
    if not is_way:
        return float(time[-1])
    out = np.abs(way[: farthest + 1, 0]) / abs(float(way[farthest, 0]) or 1.0)
    first = int(np.flatnonzero(out <= START_SHARE)[-1])
    last = first + int(np.flatnonzero(out[first:] >= 1.0 - START_SHARE)[0])
    levels = ((first, START_SHARE), (last - 1, 1.0 - START_SHARE))  # each is crossed between two samples
    begins, ends = (np.interp(level, out[k : k + 2], time[k : k + 2]) for k, level in levels)
    return float(ends - begins) / (1.0 - 2.0 * START_SHARE)


def _typical(times: Sequence[np.ndarray], ways: Sequence[np.ndarray]) -> int:
    """Return the contact whose path is nearest on average to the other paths, compared at equal shares of the time."""
    shares = np.linspace(0.0, 1.0, 50)  # several samples per stroke, for paths of a few strokes
    even = np.array([[np.interp(shares * t[-1], t, c) for c in w.T] for t, w in zip(times, ways, strict=True)])
    apart = np.linalg.norm(even[:, None] - even[None], axis=2).mean(axis=(1, 2)) if len(ways) > 1 else np.zeros(1)
    return int(np.argmin(apart))


def _path(
    free: Mechanism, time: np.ndarray, way: np.ndarray, farthest: int, poses: np.ndarray, begin: np.ndarray
) -> dict[str, Any]:
    """Return the path of a contact at even times, these times, and the rotations of the hand.

    The path ends at its farthest point; on a surface it is the whole contact without rest at its ends. On a surface it
    is smoothed by a cubic spline with a residual of the size of the noise (Reinsch, "Smoothing by spline functions",
    1967), because encoder steps would become motions of the hand.

    Args:
        free: Mechanism that the hand follows.
        time: Times (T,) of the contact [s].
        way: Coordinates (T, k) along the mechanism [m or rad].
        farthest: Index of its farthest sample.
        poses: Poses (T, 4, 4) of the hand [m].
        begin: Pose (4, 4) where the coordinates of the path are 0 [m].
    """
    turns, first, last, is_way = rotation_vectors(poses[:, :3, :3] @ poses[0, :3, :3].T), 0, farthest + 1, True
    if way.shape[1] > 1:
        near, is_way = START_SHARE * float(np.max(np.linalg.norm(way, axis=1))), False
        first = int(np.flatnonzero(np.linalg.norm(way, axis=1) > near)[0]) - 1
        last = int(np.flatnonzero(np.linalg.norm(way - way[-1], axis=1) > near)[-1]) + 2
    at, way = time[first:last] - time[first], way[first:last]
    even = np.linspace(0.0, float(at[-1]), min(400, max(len(at), 2)))  # 1 mm apart on a wipe of 0.4 m
    path = np.column_stack([np.interp(even, at, c) for c in way.T])
    if not is_way and len(even) >= 8:  # enough points to smooth by a cubic spline
        # a hand has no third derivative between two samples: third differences are noise, with variance 1 + 9 + 9 + 1
        noise = np.median(np.abs(np.diff(path, 3, axis=0)), axis=0) / (NormalDist().inv_cdf(0.75) * math.sqrt(20.0))
        least = len(even) * noise**2
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # the knot search ends slightly above or below the noise
            path = np.column_stack([UnivariateSpline(even, c, s=s)(even) for c, s in zip(path.T, least, strict=True)])
    path -= path[0] * np.linspace(1.0, 0.0, len(path))[:, None]  # start at the grasp
    if free.kind == "ball":  # each chart has its own axes
        old, new = (chart.turn[: chart.n_ways] for chart in (free.at(poses[0], np.inf), free.at(begin, np.inf)))
        path = path @ old @ new.T
    hand = np.column_stack([np.interp(float(time[first]) + even, time, x) for x in turns.T])
    return {"path": path, "time": even, "hand": hand}


@final
@dataclass(frozen=True, eq=False)
class Take:
    """Joint motion of one recording: to a contact, along it, and away from it.

    Attributes:
        name: Name of the recording.
        time: shape (k,), time from the start of the contact, negative before it [s].
        q: shape (k, nv), joint positions at these times, thinned out to at most 80 [rad or m].
        end: Time from the start to the end of the contact [s].
        moved: shape (4, 4): rigid motion of the fixtures since the recording, p' = R p + t [m].
    """

    name: str
    time: Float[np.ndarray, " k"]
    q: Float[np.ndarray, "k nv"]
    end: float
    moved: Float[np.ndarray, "4 4"] = field(default_factory=lambda: np.eye(4))

    @staticmethod
    def of(robot: Any, whole: Trajectory, since: float, begin: float, end: float, until: float) -> Take:
        """Build a take from one contact of a recording.

        The samples before, during and after the contact are thinned out evenly along the joint path.

        Args:
            robot: The robot.
            whole: The recording; the following times are on its time axis.
            since: End of the previous contact [s].
            begin: Start of the contact, the time of a sample [s].
            end: End of the contact, the time of a sample [s].
            until: Start of the next contact [s].

        Returns:
            The take; its time is 0 at `begin`.
        """
        time, q = whole.time, robot.unwrapped(whole.q)
        thin = []  # times and joint positions, including the first and the last sample of each part
        for first, last, most in ((since, begin, 24), (begin, end, 40), (end, until, 16)):  # 4 kB per arm in a file
            part = (first <= time) & (time <= last)
            samples, steps = np.c_[time[part] - begin, q[part]], np.diff(q[part], axis=0)
            ways = np.append(0.0, np.cumsum(np.linalg.norm(steps, axis=1)))
            even = np.linspace(0.0, ways[-1], min(len(samples), most))
            thin.append(np.column_stack([np.interp(even, ways, x) for x in samples.T]) if ways[-1] else samples[:1])
            thin[-1][0] = samples[0]  # interpolation begins where the arm, which may stand at first, sets off
        knots = np.concatenate([thin[0][:-1], thin[1], thin[2][1:]])
        return Take(whole.name, knots[:, 0], knots[:, 1:], end - begin)

    @property
    def before(self) -> Float[np.ndarray, "k nv"]:
        """Joint positions (n, nv) up to the first sample of the contact [rad or m]."""
        return self.q[self.time <= 0.0]

    @property
    def along(self) -> Float[np.ndarray, "k nv"]:
        """Joint positions (n, nv) during the contact [rad or m]."""
        return self.q[(self.time >= 0.0) & (self.time <= self.end)]

    @property
    def after(self) -> Float[np.ndarray, "k nv"]:
        """Joint positions (n, nv) from the last sample of the contact on [rad or m]."""
        return self.q[self.time >= self.end]

    def to_dict(self) -> dict[str, Any]:
        """Return the attributes as a dictionary of JSON values, as in a skill file."""
        plain = {"name": self.name, "time": np.round(self.time, 4).tolist(), "q": np.round(self.q, 5).tolist()}
        return plain | {"end": round(self.end, 4), "moved": self.moved.tolist()}

    @staticmethod
    def from_dict(content: Mapping[str, Any]) -> Take:
        """Build a take from the output of `to_dict`.

        Args:
            content: The output of `to_dict`.

        Returns:
            The take.
        """
        arrays = {name: np.array(content[name], dtype=np.float64) for name in ("time", "q", "moved")}
        return Take(name=str(content["name"]), end=float(content["end"]), **arrays)


@final
@dataclass(frozen=True, eq=False)
class Intention:
    r"""Point attractor towards which a demonstrator drove the constrained directions on purpose.

    .. math::

        A(q) \, u = b = k \, (r^* - \Lambda \, r(q))

    with the task coordinates r(q) of the features, see `FeatureMap.coordinates`.

    Attributes:
        target: Target :math:`r^*` along the rows of Lambda, mean over the recordings, shape (s,) [m or rad].
        gain: Gain k of the attractor [1/s].
        targets: Target of each recording, shape (n, s) [m or rad].
        spread: Root mean square distance of the targets from their mean [m or rad].
        common: True if the targets are close enough together to count as one.
        unexplained: Share of the motion energy along the rows that the attractor does not explain, 0 to 1.
    """

    target: Float[np.ndarray, " s"]
    gain: float
    targets: Float[np.ndarray, "n s"]
    spread: float
    common: bool
    unexplained: float

    @property
    def sentence(self) -> str:
        """The target in words."""
        where = "(" + ", ".join(f"{x:.3g}" for x in self.target) + ")"
        if not self.common:
            return f"The {len(self.targets)} recordings go to different targets, {self.spread:.2g} (m or rad) apart."
        return f"The recordings go to one target, {where} along the steered rows, at a rate of {self.gain:.2g} /s."

    def to_dict(self) -> dict[str, Any]:
        """Return the attributes as a dictionary of JSON values."""
        return plain(self)

    @staticmethod
    def from_dict(content: Any) -> Intention | None:
        """Build the record from the output of `to_dict`.

        Args:
            content: The output of `to_dict`.

        Returns:
            The record; None if the content is not a valid record, e.g. None.
        """
        try:
            return from_plain(Intention, content)
        except (KeyError, TypeError, ValueError):
            return None


def fit_intention(
    features: FeatureMap, selection: Selection, recordings: Sequence[tuple[np.ndarray, np.ndarray]]
) -> Intention | None:
    """Fit a point attractor to the motion along the constrained directions.

    Least squares of the velocities Lambda Phi(q) u on the coordinates Lambda r(q) give one gain for all recordings, and
    a target for each.

    Args:
        features: Feature map Phi.
        selection: Lambda (s, p).
        recordings: Joint configurations (T, nq) or positions (T, nv) [rad or m], and velocities (T, nv) [rad/s or m/s],
            of each recording.

    Returns:
        The attractor; None if it leaves more than a tenth of the motion energy unexplained, or if the features have no
        task coordinates.
    """
    # two numbers per row are fitted: more than 2000 samples only cost time
    step = max(1, sum(len(q) for q, _ in recordings) // 2000)
    try:
        places = [np.array([selection @ features.coordinates(row) for row in q[::step]]) for q, _ in recordings]
    except FeatureError:
        return None
    rates = [np.einsum("sp,npv,nv->ns", selection, features.batch(q[::step]), u[::step]) for q, u in recordings]
    x, y = (np.concatenate([part - part.mean(axis=0) for part in parts]) for parts in (places, rates))
    variance, energy = float(np.sum(x * x)), float(sum(np.sum(rate * rate) for rate in rates))
    gain = -float(np.sum(x * y)) / variance if variance > 0.0 else 0.0
    residual = float(np.sum((y + gain * x) ** 2)) / energy if energy > 0.0 else 1.0
    if gain <= 0.0 or residual > 0.1:  # at most a third of the rows' motion, in amplitude, may be unexplained
        return None
    targets = np.array([r.mean(axis=0) + b.mean(axis=0) / gain for r, b in zip(places, rates, strict=True)])
    spread = float(np.sqrt(np.mean(np.sum((targets - targets.mean(axis=0)) ** 2, axis=1))))
    distance = float(np.mean([np.linalg.norm(r[0] - r[-1]) for r in places]))
    # one target if the spread is at most a tenth of the mean distance covered by the recordings
    return Intention(targets.mean(axis=0), gain, targets, spread, spread <= 0.1 * distance, residual)
