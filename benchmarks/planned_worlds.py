"""Whether plans keep clear of a world, by the true meshes of the arm, and what is missed among the starts without one.

A hand is at the handle of a drawer or a door of a cabinet, or on a table that it wipes; a floor and two random boxes
stand around. Each start is planned twice: with the world as a scene, and with what a plan assumes where nobody says
what stands around. The check knows nothing of the planner: Pinocchio reads the description's collision meshes (the
drawn shapes where there are none), Coal takes their triangles, not convex hulls, and 200 stations of the plan are
looked at. Where there is no plan, 2,000 postures of the same hand are followed, each with its own approach.

    python benchmarks/planned_worlds.py [--starts 40] [--seed 100000] [--arms sawyer panda ...] [--out FILE.jsonl]
    python benchmarks/planned_worlds.py --physics ...            # plans in MuJoCo, with contacts, by the loop
    python benchmarks/planned_worlds.py --table OUT.csv --out FILE.jsonl
"""

from __future__ import annotations

import argparse
import csv
import json
import time
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache, cached_property
from pathlib import Path
from typing import Any, final

import coal
import numpy as np
import pinocchio as pin
from planned_ways import FARTHEST, LOCKED, LOWEST, NARROWEST, NEAR, SPEED, WAY, say
from planned_ways import TIPS as FLANGES
from scipy.interpolate import CubicSpline

import manip_learn as ml
from manip_learn.control.limits import Limits
from manip_learn.control.simulation import simulate_way
from manip_learn.planning.clearance import Clearance, Surroundings, hand_of, links_of
from manip_learn.planning.joint_path import joint_path
from manip_learn.planning.plan import FOLLOWING, SPARE, PathPolicy
from manip_learn.planning.stations import Stations
from manip_learn.planning.ways import marches_of

TIPS = FLANGES | {"sawyer": "right_gripper_tip"}  # whose shapes have a gripper: its flange is behind that
KINDS = ("drawer", "door", "wipe", "drawer", "door", "wipe", "drawer", "door", "wipe", "drawer")
BEHIND = 0.04  # [m] from a handle to the front that carries it: the hold of a usual bar handle
SPONGE = 0.02  # [m] between a flange that wipes and the table
TURN, RATE = np.radians(60.0), 1.0  # [rad], [rad/s] of a door
RADIUS = 0.25, 0.45  # [m] from a door's hinge to its handle
CABINET = (0.5, 0.8, 0.7)  # [m] depth, width, height
TABLE = (0.5, 0.8, 0.04)  # [m] of a board
LEAF = (0.018, 0.5)  # [m] thickness, height of a door's leaf
TILTED = np.cos(np.radians(45.0))  # a hand reaches into a handle, or onto a table, within 45 degrees
SIDE = np.radians(35.0)  # between a hand and the rail it pulls, at most, from above
EDGES = 0.1, 0.4  # [m] of the random boxes
FREE_START, FREE_WAY = 0.03, 0.1  # [m] from a random box to the arm at the start, to the way of the handle
START_CLEAR = 0.011  # [m] of the arm's links from what stands around: twice the clearance of a plan, and a little
STATIONS = 200  # of approach and way together
CLEAR = 0.005  # [m] that a plan promises
EXHAUSTIVE, EXHAUSTIVE_SECONDS = 2000, 40.0  # postures; [s] of processor for one start
Q = np.ndarray


@final
@dataclass(frozen=True)
class Solid:
    """A box of the world.

    Attributes:
        name: What it is called.
        size: shape (3,), edges [m].
        pose: shape (4, 4), of its middle [m].
        held: Whether the hand may touch it.
    """

    name: str
    size: np.ndarray
    pose: np.ndarray
    held: bool = False

    @cached_property
    def coal(self) -> tuple[Any, Any]:
        """For distances."""
        return coal.Box(*self.size), coal.Transform3s(self.pose[:3, :3], self.pose[:3, 3])


@final
@dataclass(frozen=True)
class World:
    """A start and what stands around it."""

    arm: str
    kind: str
    robot: ml.Robot
    constraint: ml.Constraint
    motion: ml.FreeDirection
    start: Q
    cabinet: Solid
    boxes: tuple[Solid, ...]
    hinge: np.ndarray | None = None

    def scene(self) -> ml.Scene:
        """The world as it is given to a plan."""
        boxes = [ml.Box(s.size, s.pose, s.name) for s in (self.cabinet, *self.boxes)]
        return ml.Scene(floor=0.0, boxes=boxes, handled=(self.cabinet.name,))


# ---- the independent check --------------------------------------------------------------------------------------


@final
class Meshes:
    """The triangles of an arm's links, read by Pinocchio, and their distances.

    Args:
        arm: Its name.
    """

    def __init__(self, arm: str):
        robot = ml.load_robot(arm, locked=LOCKED.get(arm, ()))
        source = robot.source
        assert source is not None
        self.robot = robot
        self.model = model = pin.buildModelFromUrdf(str(source))
        roots = [str(p) for p in source.parents]
        for kind in (pin.GeometryType.COLLISION, pin.GeometryType.VISUAL):
            geometry = pin.GeometryModel()
            pin.buildGeomFromUrdf(model, str(source), kind, geometry, roots)
            if len(geometry.geometryObjects):
                break
        self.data, self.things = model.createData(), list(geometry.geometryObjects)
        self.links = [model.frames[thing.parentFrame].name for thing in self.things]
        hand = hand_of(robot, robot.frame(TIPS[arm]))
        self.is_hand = np.array([link in hand for link in self.links])
        self.joints = [thing.parentJoint for thing in self.things]
        self.middles, self.radii = np.zeros((len(self.things), 3)), np.zeros(len(self.things))
        for k, thing in enumerate(self.things):
            thing.geometry.computeLocalAABB()
            self.middles[k], self.radii[k] = thing.geometry.aabb_center, thing.geometry.aabb_radius
        self.pairs = [p for p in self._apart() if self._moves(*p)]
        touching = {p for p in self.pairs if self._between(*p, self._places(robot.positions(robot.neutral()))) <= 0.0}
        self.pairs = [p for p in self.pairs if p not in touching]

    def _apart(self) -> Iterator[tuple[int, int]]:
        """Pairs with two moving joints or more between them."""
        supports = [set(s) for s in self.model.supports]
        locked = {self.model.getJointId(n) for n in LOCKED.get(self.robot.name, ())}
        for a in range(len(self.things)):
            for b in range(a + 1, len(self.things)):
                between = (supports[self.joints[a]] ^ supports[self.joints[b]]) - locked
                if len(between) > 1:
                    yield a, b

    def _moves(self, a: int, b: int) -> bool:
        names = {self.links[a], self.links[b]}
        known = links_of(self.robot)[0]
        # links that overlap at every posture, by the planner's list: only pairs that can be told apart count
        return known is None or tuple(sorted(names)) in {tuple(sorted(p)) for p in known.link_pairs}

    def _places(self, positions: Q) -> list[Any]:
        q = pin.neutral(self.model)
        for name, value in zip(self.robot.joint_names, positions, strict=True):
            joint = self.model.joints[self.model.getJointId(name)]
            q[joint.idx_q : joint.idx_q + joint.nq] = value if joint.nq == 1 else (np.cos(value), np.sin(value))
        pin.forwardKinematics(self.model, self.data, q)
        return [self.data.oMi[thing.parentJoint] * thing.placement for thing in self.things]

    @staticmethod
    def _far(a: Any, T: Any, b: Any, U: Any) -> float:
        return float(coal.distance(a, T, b, U, coal.DistanceRequest(), coal.DistanceResult()))

    def _between(self, a: int, b: int, places: list[Any], least: float = np.inf) -> float:
        bound = np.linalg.norm(places[a].act(self.middles[a]) - places[b].act(self.middles[b]))
        bound -= self.radii[a] + self.radii[b]
        if bound >= least:
            return np.inf
        T, U = (coal.Transform3s(places[k].rotation, places[k].translation) for k in (a, b))
        return self._far(self.things[a].geometry, T, self.things[b].geometry, U)

    def nearest(self, positions: Q, solids: tuple[Solid, ...], floor: float | None, own: bool = True) -> dict:
        """Least distances: of links that move from each solid and the floor, of the hand from what it holds, own ones.

        Returns:
            Kind ("around", "hand", "own") -> (distance [m], link, the other).
        """
        places = self._places(positions)
        out = {key: (np.inf, "", "") for key in ("around", "hand", "own")}
        for k, thing in enumerate(self.things):
            middle, T = places[k].act(self.middles[k]), coal.Transform3s(places[k].rotation, places[k].translation)
            carrier = self.joints[k]
            if not carrier or self.model.names[carrier] in LOCKED.get(self.robot.name, ()) and not self.is_hand[k]:
                continue
            for solid in solids:
                key = "hand" if solid.held and self.is_hand[k] else "around"
                away = np.abs((middle - solid.pose[:3, 3]) @ solid.pose[:3, :3]) - 0.5 * solid.size
                if np.linalg.norm(np.maximum(away, 0.0)) - self.radii[k] < out[key][0]:
                    d = self._far(thing.geometry, T, *solid.coal)
                    out[key] = min(out[key], (d, self.links[k], solid.name))
            if floor is not None and carrier > 1 and middle[2] - self.radii[k] - floor < out["around"][0]:
                below = coal.Halfspace(np.array([0.0, 0.0, 1.0]), floor)
                d = (
                    self._far(thing.geometry, T, below, coal.Transform3s())
                    if _is_solid(thing)
                    else self._low(k, places)
                )
                out["around"] = min(out["around"], (d - (0.0 if _is_solid(thing) else floor), self.links[k], "floor"))
        for a, b in self.pairs if own else ():
            d = self._between(a, b, places, out["own"][0])
            out["own"] = min(out["own"], (d, self.links[a], self.links[b]))
        return out

    def _low(self, k: int, places: list[Any]) -> float:
        """Height of the lowest vertex [m]."""
        return float(np.min(self._vertices(k) @ places[k].rotation[2] + places[k].translation[2]))

    @cache  # noqa: B019 - as many as there are arms
    def _vertices(self, k: int) -> np.ndarray:
        return np.array(self.things[k].geometry.vertices())


def _is_solid(thing: Any) -> bool:
    return not isinstance(thing.geometry, coal.BVHModelBase)


meshes_of = cache(Meshes)


# ---- starts -----------------------------------------------------------------------------------------------------


def upright(place: np.ndarray, x: np.ndarray) -> np.ndarray:
    """A pose whose x axis is horizontal."""
    pose = np.eye(4)
    pose[:3, :3] = np.column_stack([x, np.cross([0.0, 0.0, 1.0], x), [0.0, 0.0, 1.0]])
    pose[:3, 3] = place
    return pose


def world(arm: str, kind: str, number: int, seed: int) -> World:
    """A random start in a random world."""
    rng = np.random.default_rng([seed, number, list(TIPS).index(arm)])
    meshes = meshes_of(arm)
    robot = meshes.robot
    own = links_of(robot)[0]
    while True:
        q = robot.positions(robot.random_configuration(rng))
        q = np.clip(q, np.maximum(robot.position_lower, -np.pi), np.minimum(robot.position_upper, np.pi))
        T = robot.pose(q, TIPS[arm])
        place, z = T[:3, 3], T[:3, 2]
        if not (LOWEST < place[2] and NARROWEST < np.hypot(*place[:2]) < FARTHEST):
            continue
        if (z[2] > -TILTED) if kind == "wipe" else (np.hypot(z[0], z[1]) < TILTED):
            continue
        if own is not None and not own.is_clear(robot.configuration(q), NEAR):
            continue
        angle = rng.uniform(0.0, 2.0 * np.pi) if kind == "wipe" else np.arctan2(-z[1], -z[0]) + rng.uniform(-SIDE, SIDE)
        n = np.array([np.cos(angle), np.sin(angle), 0.0])
        hinge = None
        if kind == "wipe":
            middle = place + 0.5 * WAY * n - [0.0, 0.0, SPONGE + 0.5 * TABLE[2]]
            cabinet = Solid("table", np.array([WAY + 0.3, *TABLE[1:]]), upright(middle, n), True)
            constraint = ml.Constraint([[0.0, 0.0, 1.0]], ml.FrameJacobian(robot, TIPS[arm], ("x", "y", "z")))
            if "x" in constraint.features.row_names:
                constraint = ml.Constraint([[0.0, 0.0, 1.0]], ml.FrameJacobian(robot, TIPS[arm]))
            motion = ml.motion(constraint, distance=WAY, direction=n, speed=SPEED, keep_orientation=True)
        else:
            wide = rng.uniform(-0.25, 0.25) * CABINET[1]
            middle = place - (BEHIND + 0.5 * CABINET[0]) * n + wide * np.array([-n[1], n[0], 0.0])
            low = max(0.0, place[2] - rng.uniform(0.1, 0.6))
            middle[2] = low + 0.5 * CABINET[2]
            cabinet = Solid("cabinet", np.array(CABINET), upright(middle, n), True)
            if kind == "drawer":
                across = [[-n[1], n[0], 0.0], [0.0, 0.0, 1.0]]
                constraint = ml.Constraint(across, ml.FrameJacobian(robot, TIPS[arm]))
                sense = 1.0 if _leads_along(constraint, n) else -1.0
                motion = ml.motion(constraint, distance=sense * WAY, speed=SPEED, keep_orientation=number % 2 == 0)
            else:
                side = rng.choice([-1.0, 1.0])
                hinge = (
                    place + side * rng.uniform(*RADIUS) * np.array([-n[1], n[0], 0.0]) - (BEHIND + 0.5 * LEAF[0]) * n
                )
                features = ml.MechanismRows(robot, TIPS[arm], ("radial", "axial"), axis=(0, 0, 1), point=hinge)
                constraint = ml.Constraint(np.eye(2), features)
                sense = np.sign(np.cross([0.0, 0.0, 1.0], place - hinge) @ n)
                motion = ml.motion(constraint, angle=sense * TURN, speed=RATE)
        if _distance_to_point(cabinet, np.array([0.0, 0.0, 0.1])) < 0.2:  # the base is screwed on there
            continue
        near = meshes.nearest(q, (cabinet,), 0.0)
        if near["around"][0] < START_CLEAR or near["own"][0] < NEAR or near["hand"][0] < CLEAR:
            continue
        way = Stations.of(motion, q, Limits(robot)).places
        boxes = []
        while len(boxes) < 2:
            size, radius, turn, phi = rng.uniform(*EDGES, 3), rng.uniform(0.2, 1.0), *rng.uniform(0, 2 * np.pi, 2)
            middle = np.array([radius * np.cos(turn), radius * np.sin(turn), rng.uniform(0.5 * size[2], 0.9)])
            box = Solid(f"box {len(boxes) + 1}", size, upright(middle, np.array([np.cos(phi), np.sin(phi), 0.0])))
            free = min(_distance_to_point(box, p) for p in way) > FREE_WAY
            if free and _distance_to_point(box, np.array([0.0, 0.0, 0.1])) > 0.2:
                if meshes.nearest(q, (box,), None, own=False)["around"][0] > FREE_START:
                    boxes.append(box)
        return World(arm, kind, robot, constraint, motion, q, cabinet, tuple(boxes), hinge)


def _leads_along(constraint: ml.Constraint, n: np.ndarray) -> bool:
    """Whether the positive sense along a line is n: that of the largest number of its direction."""
    return bool(n[np.argmax(np.abs(n))] > 0.0)


def _distance_to_point(solid: Solid, point: np.ndarray) -> float:
    away = np.abs((point - solid.pose[:3, 3]) @ solid.pose[:3, :3]) - 0.5 * solid.size
    return float(np.linalg.norm(np.maximum(away, 0.0)) + min(0.0, away.max()))


def leaf_at(one: World, place: np.ndarray) -> Solid:
    """A door's leaf where its handle is."""
    assert one.hinge is not None
    arm = place - one.hinge
    height, arm = place[2], arm * [1.0, 1.0, 0.0]
    first = (one.robot.position(one.start, TIPS[one.arm]) - one.hinge) * [1.0, 1.0, 0.0]
    turned = np.arctan2(*(np.cross(first, arm)[2], first @ arm))
    normal = one.cabinet.pose[:3, 0]
    rotation = np.array([[np.cos(turned), -np.sin(turned), 0], [np.sin(turned), np.cos(turned), 0], [0, 0, 1]])
    out, along = rotation @ normal, rotation @ (first - (first @ normal) * normal)
    low = max(0.005, height - 0.5 * LEAF[1])
    wide = np.linalg.norm(along) + 0.03
    middle = one.hinge + 0.5 * wide * along / np.linalg.norm(along)
    middle[2] = 0.5 * (low + height + 0.5 * LEAF[1])
    return Solid("leaf", np.array([LEAF[0], wide, height + 0.5 * LEAF[1] - low]), upright(middle, out), True)


# ---- one start --------------------------------------------------------------------------------------------------


def checked(one: World, q: list[np.ndarray], with_boxes: bool) -> dict[str, Any]:
    """Least distances over the stations of each phase."""
    meshes, out = meshes_of(one.arm), {}
    solids = (one.cabinet, *(one.boxes if with_boxes else ()))
    for phase, rows in zip(("approach", "way"), q, strict=True):
        picked = rows[np.unique(np.round(np.linspace(0, len(rows) - 1, STATIONS // 2)).astype(int))]
        found = {key: (np.inf, "", "", 0.0) for key in ("around", "hand", "own", "leaf")}
        for i, x in enumerate(picked):
            x = one.robot.positions(x)
            here = meshes.nearest(x, solids, 0.0)
            if one.hinge is not None and phase == "way":
                leaf = leaf_at(one, one.robot.position(x, TIPS[one.arm]))
                here["leaf"] = meshes.nearest(x, (leaf,), None, own=False)["around"]
            for key, value in here.items():
                found[key] = min(found[key], (*value, i / max(1, len(picked) - 1)))
        out[phase] = found
    return out


def planned(one: World, scene: ml.Scene | str | None, seed: int = 0) -> tuple[Any, float, str]:
    """A plan, the processor time that it took, and the outcome in a word."""
    began = time.process_time()
    try:
        plan = ml.plan(one.constraint, one.motion, one.start, seed, scene=scene)
        return plan, time.process_time() - began, "plan"
    except ml.NoPlanError as error:
        return error, time.process_time() - began, "refused"
    except Exception as error:  # what a benchmark finds
        return error, time.process_time() - began, type(error).__name__


def exhaustive(one: World, scene: ml.Scene | str | None, seed: int) -> dict[str, Any]:
    """Whether the way is done from any of many postures of the same hand, and how far the first obstacles let it."""
    began, rng = time.process_time(), np.random.default_rng([seed, 7])
    robot, limits, motion = one.robot, Limits(one.robot), one.motion.with_distance(one.motion.wanted)
    frame = robot.frame(TIPS[one.arm])
    stations = Stations.of(motion, one.start, limits)
    marches = marches_of(stations, one.start, EXHAUSTIVE, rng)
    margin = float(np.max(marches.along[:, -1], initial=-np.inf))
    if -np.inf < margin < 0.0:
        motion = motion.slowed(SPARE * (1.0 - margin))
        stations = Stations.of(motion, one.start, limits)
        marches = marches_of(stations, one.start, EXHAUSTIVE, rng)
    given = scene if isinstance(scene, ml.Scene) else None
    around = Surroundings.of(given, robot, frame) if scene else Surroundings()
    clear, whole = Clearance(robot, True, around, one.start), np.flatnonzero(np.isfinite(marches.along[:, -1]))
    reached = int(marches.reached)
    counts: dict[str, Any] = {"postures": int(np.isfinite(marches.least[:, 0]).sum()), "whole": len(whole)}
    counts |= {"clear": 0, "reached": 0, "share": max(reached, 0) / (len(stations) - 1)}
    holding = clear.holding(marches.q[whole, 0])
    for march in whole[np.argsort(-marches.along[whole, -1])].tolist():
        if time.process_time() - began > EXHAUSTIVE_SECONDS:
            return counts | {"found": None}
        path = marches.q[march]
        if not holding.of_way(path):
            continue
        counts["clear"] += 1
        if joint_path(robot, one.start, path[0], limits, holding, seed) is None:
            continue
        counts["reached"] += 1
        task = motion.with_distance(motion.wanted)
        spline = CubicSpline(stations.time, path, bc_type="natural")
        policy = PathPolicy(spline, FOLLOWING, robot, stations.moving, task)
        law = ml.ResolvedRateController(one.constraint, task, policy, limits=limits, dt=0.01)
        outcome = simulate_way(robot, law, robot.configuration(path[0]), 0.01)[1]
        if outcome.is_done and not outcome.strays:
            return counts | {"found": True, "margin": float(marches.along[march, -1]), "posture": path[0].tolist()}
    return counts | {"found": False}


def record(arm: str, number: int, seed: int, given: argparse.Namespace) -> Iterator[dict[str, Any]]:
    """What became of one start, for each variant."""
    kind = KINDS[number % len(KINDS)]
    one = world(arm, kind, number, seed)
    for variant in given.variants:
        scene = {"scene": one.scene(), "assumed": "assumed", "nothing": None}[variant]
        plan, seconds, outcome = planned(one, scene)
        out = {"arm": arm, "kind": kind, "number": number, "variant": variant, "outcome": outcome, "seconds": seconds}
        if outcome == "plan":
            out |= {"margin": plan.margin, "approach": float(plan.approach.time[-1]), "notes": list(plan.notes)}
            out["near"] = checked(one, [plan.approach.q, plan.way.q], variant == "scene")
            if given.physics and (variant == "scene" or kind == "door"):
                from worlds_physics import executed  # which needs MuJoCo

                out["executed"] = executed(one, plan, variant == "scene", variant == "assumed")
        else:
            out |= {"error": str(plan), "stopped_by": getattr(plan, "stopped_by", "")}
            if not given.no_search and variant == "scene" and outcome == "refused":
                out["search"] = exhaustive(one, scene, seed)
        yield out


KEYS = {"around": "nearest obstacle", "own": "nearest own link", "hand": "hand to what it holds", "leaf": "leaf"}


def write_table(lines: Path, table: Path) -> None:
    """One line for each start and world: the outcome, and the least distances over approach and way [mm]."""
    rows = []
    for out in map(json.loads, lines.read_text(encoding="utf-8").splitlines()):
        row = {"arm": out["arm"], "start": out["number"], "kind": out["kind"], "world": out["variant"]}
        row |= {"outcome": out["outcome"], "processor s": round(out["seconds"], 2)}
        row |= {"margin": round(out["margin"], 3) if "margin" in out else ""}
        phases = out.get("near", {}).values()
        for key, said in KEYS.items():
            least = min((p[key][0] for p in phases), default=np.inf)
            row[f"{said} [mm]"] = round(1e3 * least, 1) if np.isfinite(least) else ""
        run, found = out.get("executed", {}), out.get("search", {}).get("found", "")
        row["short in MuJoCo [mm]"] = round(run["short"], 1) if run else ""
        row["touched in MuJoCo"] = "; ".join(run.get("touched", ()))
        row["of 2,000 postures"] = {True: "some", False: "none", None: "not ended"}.get(found, "")
        rows.append(row)
    with table.open("w", encoding="utf-8", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)


def main() -> None:
    """Run, or make the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--starts", type=int, default=40)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--seed", type=int, default=100_000)
    parser.add_argument("--arms", nargs="+", default=list(TIPS))
    parser.add_argument("--variants", nargs="+", default=["scene", "assumed"])
    parser.add_argument("--no-search", action="store_true")
    parser.add_argument("--physics", action="store_true")
    parser.add_argument("--step", type=int, default=1)
    parser.add_argument("--out", type=Path)
    parser.add_argument("--table", type=Path)
    given = parser.parse_args()
    if given.table is not None:
        write_table(given.out, given.table)
        return
    for number in range(given.first, given.starts, given.step):
        for arm in given.arms:
            for out in record(arm, number, given.seed, given):
                line = json.dumps(out, default=float)
                if given.out is None:
                    print(line)
                else:
                    with given.out.open("a", encoding="utf-8") as file:
                        file.write(line + "\n")
                near = out.get("near")
                least = (
                    ""
                    if near is None
                    else " ".join(
                        f"{p[0]}:{k}={1e3 * v[0]:.1f}({v[1]},{v[2]})"
                        for p, rows in near.items()
                        for k, v in rows.items()
                        if v[0] < CLEAR
                    )
                )
                say(
                    arm,
                    number,
                    out["kind"],
                    out["variant"],
                    out["outcome"],
                    f"{out['seconds']:.2f} s",
                    least,
                    out.get("error", "")[:200],
                    out.get("search", ""),
                )


if __name__ == "__main__":
    main()
