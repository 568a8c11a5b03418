"""What the recordings show along the directions that a constraint leaves free: where, which way, how far, how fast."""

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
from manip_learn.constraint.mechanism import CURVE, Mechanism, plain, saved
from manip_learn.constraint.place import Chart, Curve, across
from manip_learn.errors import FeatureError, counted
from manip_learn.linalg import complement_rows, row_basis
from manip_learn.recordings.trajectory import Trajectory, evenly
from manip_learn.robot.rotations import angles_between, rotation_matrix, rotation_vectors

Unit = Literal["m", "rad"]
STARTED = 0.02  # share of the way that a hand has gone when its motion has begun, and that is left when it has ended


def straight_motion(
    features: FeatureMap, selection: Selection, in_hand: int, contacts: Sequence[np.ndarray]
) -> Mechanism | None:
    """Return the line, the plane or the space in which a constraint leaves the hand's place free; None of nothing free.

    Args:
        features: Phi.
        selection: Lambda.
        in_hand: Number of directions of the hand's own axes that are free; 0 if they are not known to be.
        contacts: shape (T, 4, 4) each, poses of the hand along a contact [m].
    """
    axes = np.zeros((0, 3))
    if in_hand:  # they are those in which the hand did move
        places = np.concatenate([c[:, :3, 3] - c[:, :3, 3].mean(axis=0) for c in contacts])
        axes = np.linalg.svd(places, full_matrices=False)[2][:in_hand]
    elif features.own_axes is False:  # translations that the rows show and Lambda leaves free, but for what it leaks
        rows = features.weights_at(contacts[0][:1])[0, :, :3]  # type: ignore[attr-defined]  # of a frame
        shows = row_basis(rows)
        _, sizes, Vt = np.linalg.svd(selection @ rows @ shows.T)
        axes = Vt[int(np.count_nonzero(sizes > 0.1)) :] @ shows  # a learnt row leaks by its uncertainty
    return straight(axes)


def straight(axes: Float[np.ndarray, "k 3"]) -> Mechanism | None:
    """Return the line, the plane or the space in which a hand moves along some directions; None of no direction."""
    made = {1: "line", 2: "plane", 3: "held-orientation"}
    if len(axes) not in made:
        return None
    normal = complement_rows(axes) if len(axes) == 2 else axes
    return Mechanism(made[len(axes)], None if len(axes) == 3 else normal[0] / np.linalg.norm(normal[0]))  # type: ignore[arg-type]


@final
@dataclass(frozen=True, eq=False, repr=False)
class Shown:
    """What was done along what a constraint leaves free, over all its contacts; places in the base frame.

    The way is counted from where a contact began; where there is one direction, positive as the recordings went.

    Attributes:
        unit: `"m"` or `"rad"`, of the way.
        extent: From where contacts began to their farthest point, the median.
        spread: Standard deviation of that.
        least, most: The shortest and the longest of the contacts.
        span: From the first to the last place along the way that any contact came to; of a path, the most.
        speed: Mean speed on the way out, the median [m/s or rad/s].
        seconds: From where the motion began to its farthest point, of a path to its end; the median [s].
        back: Whether the hand was taken back to the beginning.
        n: Number of contacts.
        hold: shape (3,), where contacts began [m], the median; None if they scatter by more than 3 mm.
        scatter: The largest distance of a beginning from that median [m].
        path: shape (T, k), along the free coordinates, of the most typical contact [m or rad].
        time: shape (T,), of the path [s], from 0.
        begin: shape (3,), where the path begins: `hold`, or where the typical contact began [m].
        orientation: shape (3, 3), of the hand where the typical contact began.
        turned: Largest angle of a hand from that where the other contacts began [rad].
        one_way: Whether the recordings agree on a sense; always True of paths on a surface.
        mechanism: What the hand goes along, in the sense of the recordings.
        force: What the hand exerted along them at the most, the median over the contacts [N]; None where no efforts
            were recorded, or where they show no such force, as those of an arm that a hand has guided.
        start: shape (k,), coordinates where contacts began, the median, counted from `begin` [m or rad].
        hand: shape (T, 3), rotation vectors by which the typical hand had turned by then [rad]; none in files of 0.2.
        grasps: shape (n, 4, 4), pose of the hand where each contact began, of at most 24 contacts.
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
        """Whether there is one direction, so that the extent says which way was gone."""
        return self.chart.n_ways == 1

    @property
    def chart(self) -> Chart:
        """The chart of the hand that begins the path."""
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = self.orientation, self.begin
        return self.mechanism.at(pose, np.inf)

    @property
    def poses(self) -> Float[np.ndarray, "T 4 4"]:
        """Poses along the path, of a hand that turns with the mechanism only [m]."""
        chart = self.chart
        return np.array([chart.pose(c / chart.sizes) for c in self.path])

    @property
    def points(self) -> Float[np.ndarray, "T 3"]:
        """Places along the path, in the base frame [m]."""
        return self.poses[:, :3, 3]

    @cached_property
    def _ways(self) -> Float[np.ndarray, " T"]:
        """How far along the path each of its points is [m or rad], rising."""
        steps = np.diff(self.path, axis=0)
        ways = self.path[:, 0] if self.is_way else np.append(0.0, np.cumsum(np.linalg.norm(steps, axis=1)))
        return np.maximum.accumulate(ways)

    def turned_at(self, distance: float) -> Float[np.ndarray, "3 3"]:
        """Return the orientation that the typical hand had so far along [m or rad]; not known in files of 0.2."""
        return rotation_matrix(np.array([np.interp(distance, self._ways, x) for x in self.hand.T])) @ self.orientation

    def place_before(self, pose: Float[np.ndarray, "4 4"], far: Float[np.ndarray, " k"]) -> Float[np.ndarray, " 3"]:
        """Return the place of a hand that is taken back along the way from a pose, by such coordinates [m]."""
        chart = self.mechanism.at(pose, np.inf)
        return chart.pose(-far / chart.sizes)[:3, 3]

    def along(self, poses: Float[np.ndarray, "T 4 4"]) -> Float[np.ndarray, "T k"]:
        """Return the coordinates of the path of a hand along a motion [m or rad], 0 at its first pose."""
        return _ways(self.mechanism, poses)

    @property
    def sentence(self) -> str:
        """What was shown, in words."""
        at = "at the same place" if self.hold is not None else f"at places up to {100 * self.scatter:.2g} cm apart"
        where = f"In {counted(self.n, 'contact')} the hand took hold {at}"
        size, unit, digits = (1.0, "m", 2) if self.unit == "m" else (math.degrees(1.0), "degrees", 0)
        far, low, high = (f"{size * x:.{digits}f}" for x in (self.extent, self.least, self.most))
        far += f" {unit}" if low == high else f" {unit} ({low} to {high})"
        took = "" if self.force is None else f" It took up to {self.force:.2g} N."
        if not self.is_way:
            return f"{where}, and went up to {far} from there on a path of {self.time[-1]:.1f} s.{took}"
        back = (", and back" if self.back else "") + ("" if self.one_way else "; not all went the same way")
        return f"{where}, moved {far} at about {size * self.speed:.2g} {unit}/s{back}.{took}"

    def __repr__(self) -> str:
        return f"Shown({self.sentence})"

    def moved(self, transform: Float[np.ndarray, "4 4"]) -> Shown:
        """Return the same at fixtures that stand elsewhere, p' = R p + t."""
        R, t = transform[:3, :3], transform[:3, 3]
        places = {"hold": None if self.hold is None else R @ self.hold + t, "begin": R @ self.begin + t}
        turned = {"orientation": R @ self.orientation, "grasps": transform @ self.grasps}
        return replace(self, **places, **turned, mechanism=self.mechanism.moved(transform))

    def to_dict(self) -> dict[str, Any]:
        """Return plain numbers and lists, for a constraint file."""
        return plain(self, 6)

    @staticmethod
    def from_dict(content: Any) -> Shown | None:
        """Return what `to_dict` wrote; None of anything else."""
        try:
            return saved(Shown, content if "mechanism" in content else {**content, **_of_02(content)})
        except (KeyError, TypeError, ValueError):
            return None


def _of_02(content: Mapping[str, Any]) -> dict[str, Any]:
    """Return the mechanism and the path of a file of 0.2, which says directions; until 0.4."""
    c, path = content["coordinates"], np.array(content["path"], dtype=np.float64)
    axes, point = (np.array(c[name], dtype=np.float64) for name in ("axes", "point"))
    orientation = "carried" if c["by_hand"] or c["kind"] == "ball" else "free"
    if c["kind"] == "straight":
        mechanism = straight(axes)
        travel = np.eye(3) if len(axes) == 3 else axes if len(axes) == 1 else across(mechanism.axis)  # type: ignore
        return {"mechanism": mechanism.to_dict(), "path": path @ axes @ travel.T}  # type: ignore[union-attr]
    curve = Curve(c["curve"]) if "curve" in c else None
    kind = {"around": "screw" if c["pitch"] else "hinge", "ball": "ball"}.get(c["kind"], "other")
    told: dict[str, Any] = {"pitch": c["pitch"] or None, "radius": c["radius"] if c["kind"] == "sleeve" else None}
    name = CURVE if curve is not None else ""
    axis = None if kind == "ball" or name else axes[0]
    known = Mechanism(kind, axis, point, orientation=orientation, name=name, curve=curve, **told)  # type: ignore[arg-type]
    arcs = np.array([known.radius or 1.0, 1.0]) if kind == "other" and not name else np.ones(1)  # as 0.2 had them
    return {"mechanism": known.to_dict(), "path": path * (known.at(np.eye(4), np.inf).sizes / arcs)}


def _ways(mechanism: Mechanism, poses: Float[np.ndarray, "T 4 4"]) -> Float[np.ndarray, "T k"]:
    chart = mechanism.at(poses[0], np.inf)
    return chart.coordinates(poses)[:, : chart.n_ways] * chart.sizes


def shown_by(
    features: FeatureMap, selection: Selection, mechanism: Mechanism | None, contacts: Sequence[Trajectory]
) -> Shown | None:
    """Return what contacts with one constraint show along its free directions; None where no frame's place is free.

    Args:
        features: Phi.
        selection: Lambda.
        mechanism: What the rows hold, where that has a name.
        contacts: Each contact, from where it began.
    """
    contacts = [contact for contact in contacts if len(contact) > 1]
    if not contacts or features.twist is None:
        return None
    motions = [features.twist.poses(contact.q) for contact in contacts]
    free, flat = mechanism, {"line": 1, "plane": 2, "space": 3, "curve": 1}  # directions of what has no place
    if mechanism is None or (mechanism.axis is None and mechanism.kind in ("line", "plane")):
        free = straight_motion(features, selection, 0 if mechanism is None else flat[mechanism.kind], motions)
    if free is None or (free.point is None and free.kind not in flat):
        return None
    ways = [_ways(free, p) for p in motions]
    is_way = ways[0].shape[1] == 1
    gone = [w[:, int(free.in_fingers) :] for w in ways]  # where the hand turns about itself it goes nowhere
    farthest = [int(np.argmax(np.linalg.norm(w, axis=1))) for w in gone]
    signed = np.array([float(w[i, 0]) for w, i in zip(ways, farthest, strict=True)])
    one_way = True
    if is_way:
        # one side exceeds the other by half of all ways, or is not the way shown
        one_way = abs(float(np.sum(signed))) >= 0.5 * float(np.sum(np.abs(signed)))
        if np.sum(signed) < 0.0:
            free, ways, signed = free.reversed(), [-w for w in ways], -signed
    extents = np.array([float(np.linalg.norm(w[i])) for w, i in zip(gone, farthest, strict=True)])
    if not np.all(np.isfinite(extents)) or float(np.median(extents)) <= 0.0:
        return None
    times = [contact.time - contact.time[0] for contact in contacts]
    seconds = np.array([_duration(t, w, i, is_way) for t, w, i in zip(times, ways, farthest, strict=True)])
    lengths = extents if is_way else np.array([np.linalg.norm(np.diff(w, axis=0), axis=1).sum() for w in ways])
    grasps = np.array([p[0] for p in motions])
    middle = np.median(grasps[:, :3, 3], axis=0)
    scatter = float(np.max(np.linalg.norm(grasps[:, :3, 3] - middle, axis=1)))
    # contacts that begin within 3 mm of their middle begin at one place: a person finds a handle again to a millimetre
    # or two, a hand that is put down on a table does not
    hold = middle if scatter <= 3e-3 else None
    off = np.abs(extents - np.median(extents)) + np.where(signed > 0.0, 0.0, np.inf)  # of those that went as most did
    # of an even number two are as near to the median, but for rounding: the first
    typical = int(np.argmin(np.round(off, 9))) if is_way else _typical(times, ways)
    begin = grasps[typical].copy()
    if hold is not None:
        begin[:3, 3] = hold
    sizes: dict[str, Any] = {"extent": np.median, "spread": np.std, "least": np.min, "most": np.max}
    far: dict[str, Any] = {name: float(size(extents)) for name, size in sizes.items()}
    span = far["most"]
    if is_way:  # grips differ, so that the angle of a hand that is carried says nothing of where another began
        carried = free.orientation == "carried"
        begins = np.zeros(len(ways)) if carried else _ways(free, grasps)[:, 0]
        low, high = (begins + [end(way) for way in ways] for end in (np.min, np.max))
        span = float(np.max(high - low) if carried else np.max(high) - np.min(low))
    return Shown(
        unit="rad" if free.kind in ("hinge", "screw", "ball") else "m",
        **far,
        span=span,
        speed=float(np.median(lengths / np.maximum(seconds, 1e-9))),
        seconds=float(np.median(seconds)),
        back=bool(np.median([np.linalg.norm(w[-1]) for w in ways] / extents) <= 0.1),  # of the way out
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
        grasps=grasps[evenly(len(grasps), 24)],  # 10 kB of a file
    )


def _force(features: FeatureMap, free: Mechanism, contacts: Sequence[Trajectory]) -> float | None:
    """Return the largest force along free coordinates, by the efforts beside what carries the links; see `Shown.force`.

    The force on the hand is the one that explains the rest best, joint friction included. One in twenty samples may
    exceed it. Efforts that are not in newton metres, or leave weights out, say nothing, and neither do forces that are
    larger across what is free.
    """
    twist = features.twist
    if twist.relative_to is not None or twist.robot.nq != twist.robot.nv:
        return None
    robot, frame, largest = twist.robot, twist.frame, list[Float[np.ndarray, " 2"]]()
    n = free.at(robot.pose(contacts[0].q[0], frame), np.inf).n_ways
    for contact in contacts:
        chosen, forces = evenly(len(contact), 200), []  # samples whose efforts are looked at
        effort: Any = contact.effort
        weights = np.array([robot.weight_effort(q) for q in contact.q[chosen]])
        carried = float(np.sum(weights * effort[chosen])), float(np.sum(weights**2))
        if not abs(carried[0] - carried[1]) < 0.3 * carried[1]:  # payloads, friction, the force itself
            return None
        for q, rest in zip(contact.q[chosen], effort[chosen] - weights, strict=True):
            # in directions in which the hand moves by less than 2 % of its most, efforts tell no force
            force = np.linalg.pinv(robot.jacobian(q, frame).T, rcond=0.02)[:3] @ rest
            ways = free.at(robot.pose(q, frame), np.inf).twist([])[:3, :n]
            along = (ways / np.linalg.norm(ways, axis=0)).T @ force
            forces.append((np.linalg.norm(along), math.sqrt(max(0.0, float(force @ force - along @ along)))))
        largest.append(np.quantile(forces, 0.95, axis=0))
    along, across = np.median(largest, axis=0).tolist()
    return along if along > max(across, 10.0) else None  # [N]: friction of an arm that a hand guides is less


def _duration(time: Float[np.ndarray, " T"], way: Float[np.ndarray, "T k"], farthest: int, is_way: bool) -> float:
    """Return how long the motion took [s]: a way out to its farthest point, rest at either end left out."""
    if not is_way:
        return float(time[-1])
    out = np.abs(way[: farthest + 1, 0]) / abs(float(way[farthest, 0]) or 1.0)
    begun = int(np.flatnonzero(out <= STARTED)[-1])
    there = begun + int(np.flatnonzero(out[begun:] >= 1.0 - STARTED)[0])
    levels = ((begun, STARTED), (there - 1, 1.0 - STARTED))  # each is passed between two samples
    begins, ends = (np.interp(level, out[k : k + 2], time[k : k + 2]) for k, level in levels)
    return float(ends - begins) / (1.0 - 2.0 * STARTED)


def _typical(times: Sequence[np.ndarray], ways: Sequence[np.ndarray]) -> int:
    """Return the contact whose path is nearest to those of the others on average, each at equal shares of its time."""
    shares = np.linspace(0.0, 1.0, 50)  # a path of some strokes, each seen several times
    even = np.array([[np.interp(shares * t[-1], t, c) for c in w.T] for t, w in zip(times, ways, strict=True)])
    apart = np.linalg.norm(even[:, None] - even[None], axis=2).mean(axis=(1, 2)) if len(ways) > 1 else np.zeros(1)
    return int(np.argmin(apart))


def _path(
    free: Mechanism, time: np.ndarray, way: np.ndarray, farthest: int, poses: np.ndarray, begin: np.ndarray
) -> dict[str, Any]:
    """Return the path of a contact at even times, these times, and how the hand had turned by then.

    The path is a way out to its farthest point, or one on a surface without rest at its ends. On a surface it is
    smoothed, by a cubic spline that leaves out as much as the noise is (Reinsch, "Smoothing by spline functions",
    1967): steps of encoders would be strokes of the hand.

    Args:
        free: What the hand goes along.
        time: shape (T,), of the contact [s].
        way: shape (T, k), coordinates along it [m or rad].
        farthest: Number of its farthest sample.
        poses: shape (T, 4, 4), of the hand.
        begin: shape (4, 4), pose from which the coordinates of the path are counted.
    """
    turns, begun, last, is_way = rotation_vectors(poses[:, :3, :3] @ poses[0, :3, :3].T), 0, farthest + 1, True
    if way.shape[1] > 1:
        near, is_way = STARTED * float(np.max(np.linalg.norm(way, axis=1))), False
        begun = int(np.flatnonzero(np.linalg.norm(way, axis=1) > near)[0]) - 1
        last = int(np.flatnonzero(np.linalg.norm(way - way[-1], axis=1) > near)[-1]) + 2
    at, way = time[begun:last] - time[begun], way[begun:last]
    even = np.linspace(0.0, float(at[-1]), min(400, max(len(at), 2)))  # a millimetre apart on a wipe of 0.4 m
    path = np.column_stack([np.interp(even, at, c) for c in way.T])
    if not is_way and len(even) >= 8:  # a cubic spline has something to smooth
        # a hand has no third derivative between two samples: third differences are noise, of variance 1 + 9 + 9 + 1
        noise = np.median(np.abs(np.diff(path, 3, axis=0)), axis=0) / (NormalDist().inv_cdf(0.75) * math.sqrt(20.0))
        least = len(even) * noise**2
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of a search for knots that ends a little above or below the noise
            path = np.column_stack([UnivariateSpline(even, c, s=s)(even) for c, s in zip(path.T, least, strict=True)])
    path -= path[0] * np.linspace(1.0, 0.0, len(path))[:, None]  # it begins where the hand took hold
    if free.kind == "ball":  # each chart has axes of its own
        own, kept = (chart.turn[: chart.n_ways] for chart in (free.at(poses[0], np.inf), free.at(begin, np.inf)))
        path = path @ own @ kept.T
    hand = np.column_stack([np.interp(float(time[begun]) + even, time, x) for x in turns.T])
    return {"path": path, "time": even, "hand": hand}


@final
@dataclass(frozen=True, eq=False)
class Take:
    """How the joints went in one recording: to a contact, along it, and away from it.

    Attributes:
        name: Of the recording.
        time: shape (k,), from where the contact began [s].
        q: shape (k, nv), joint positions, thinned [rad or m].
        end: When the contact ended [s].
        moved: shape (4, 4): the fixtures stand elsewhere now, p' = R p + t.
    """

    name: str
    time: Float[np.ndarray, " k"]
    q: Float[np.ndarray, "k nv"]
    end: float
    moved: Float[np.ndarray, "4 4"] = field(default_factory=lambda: np.eye(4))

    @staticmethod
    def of(robot: Any, whole: Trajectory, since: float, begin: float, end: float, until: float) -> Take:
        """Return a recording, thinned evenly along its path before, during and after a contact.

        Args:
            robot: The robot.
            whole: The recording.
            since: When the contact before it ended [s].
            begin: When the contact began, a time of a sample [s].
            end: When it ended, likewise.
            until: When the next one begins [s].
        """
        time, q = whole.time, robot.unwrapped(whole.q)
        thin = []  # times and joint positions, the first and the last sample of each part among them
        for first, last, most in ((since, begin, 24), (begin, end, 40), (end, until, 16)):  # 4 kB of a file for an arm
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
        """Joint positions up to the contact, the first one of it included."""
        return self.q[self.time <= 0.0]

    @property
    def along(self) -> Float[np.ndarray, "k nv"]:
        """Joint positions of the contact."""
        return self.q[(self.time >= 0.0) & (self.time <= self.end)]

    @property
    def after(self) -> Float[np.ndarray, "k nv"]:
        """Joint positions from the last one of the contact on."""
        return self.q[self.time >= self.end]

    def to_dict(self) -> dict[str, Any]:
        """Return plain numbers, for a skill's file."""
        plain = {"name": self.name, "time": np.round(self.time, 4).tolist(), "q": np.round(self.q, 5).tolist()}
        return plain | {"end": round(self.end, 4), "moved": self.moved.tolist()}

    @staticmethod
    def from_dict(content: Mapping[str, Any]) -> Take:
        """Return what `to_dict` wrote."""
        arrays = {name: np.array(content[name], dtype=np.float64) for name in ("time", "q", "moved")}
        return Take(name=str(content["name"]), end=float(content["end"]), **arrays)


@final
@dataclass(frozen=True, eq=False)
class Intention:
    """b = gain (r* - Lambda r(q)): a point towards which the constrained rows were moved.

    Attributes:
        target: shape (s,), r* along the rows of Lambda, the mean over the recordings [m or rad].
        gain: Rate at which the distance was taken back [1/s].
        targets: shape (n, s), of each recording.
        spread: Root mean square distance of these from their mean [m or rad].
        common: Whether they are one target.
        unexplained: Share of the rows' motion that is something else.
    """

    target: Float[np.ndarray, " s"]
    gain: float
    targets: Float[np.ndarray, "n s"]
    spread: float
    common: bool
    unexplained: float

    @property
    def sentence(self) -> str:
        """What was meant, in words."""
        where = "(" + ", ".join(f"{x:.3g}" for x in self.target) + ")"
        if not self.common:
            return f"The {len(self.targets)} recordings go to different targets, {self.spread:.2g} (m or rad) apart."
        return f"The recordings go to one target, {where} along the steered rows, at a rate of {self.gain:.2g} /s."

    def to_dict(self) -> dict[str, Any]:
        """Return plain numbers and lists, for a constraint file."""
        return plain(self)

    @staticmethod
    def from_dict(content: Any) -> Intention | None:
        """Return what `to_dict` wrote; None of anything else."""
        try:
            return saved(Intention, content)
        except (KeyError, TypeError, ValueError):
            return None


def intention_of(
    features: FeatureMap, selection: Selection, recordings: Sequence[tuple[np.ndarray, np.ndarray]]
) -> Intention | None:
    """Return the attractor that explains how the rows were moved; None if none does, or the rows have no coordinates.

    One gain for all recordings, a target for each, by least squares of Lambda Phi(q) u on Lambda r(q).

    Args:
        features: Phi.
        selection: Lambda.
        recordings: Configurations (T, n) and velocities (T, nv) of each recording.
    """
    # two numbers a row are fitted: more than 2000 samples cost time and tell nothing new
    step = max(1, sum(len(q) for q, _ in recordings) // 2000)
    try:
        places = [np.array([selection @ features.coordinates(row) for row in q[::step]]) for q, _ in recordings]
    except FeatureError:
        return None
    rates = [np.einsum("sp,npv,nv->ns", selection, features.batch(q[::step]), u[::step]) for q, u in recordings]
    x, y = (np.concatenate([part - part.mean(axis=0) for part in parts]) for parts in (places, rates))
    moved, energy = float(np.sum(x * x)), float(sum(np.sum(rate * rate) for rate in rates))
    gain = -float(np.sum(x * y)) / moved if moved > 0.0 else 0.0
    left = float(np.sum((y + gain * x) ** 2)) / energy if energy > 0.0 else 1.0
    if gain <= 0.0 or left > 0.1:  # an attractor leaves a third of the rows' motion unexplained, in amplitude
        return None
    targets = np.array([r.mean(axis=0) + b.mean(axis=0) / gain for r, b in zip(places, rates, strict=True)])
    spread = float(np.sqrt(np.mean(np.sum((targets - targets.mean(axis=0)) ** 2, axis=1))))
    far = float(np.mean([np.linalg.norm(r[0] - r[-1]) for r in places]))
    # they are one target if they spread by up to a tenth of the distance at which recordings began
    return Intention(targets.mean(axis=0), gain, targets, spread, spread <= 0.1 * far, left)
