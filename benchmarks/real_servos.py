"""A drawer, a door and a table done by arms whose servos have friction, play and delays: what stops them, and what not.

    python benchmarks/real_servos.py [--seed 900] [--postures 2] [--arms panda,ur5,xarm7] [--out docs/figures]
    python benchmarks/real_servos.py --parts exact,wrong,jam,air,hit [--only "friction|play"]

MuJoCo, position servos at 1 kHz, encoder noise of 0.1 mrad; the hand holds the handle by a ball joint. Each row of a
table is a fault, on every arm from two postures that are drawn. "Exact" is what was learnt exactly: a row counts the
ways that were gone to the end. Forces are those of the grip on the handle, as the physics has them.
"""

from __future__ import annotations

import argparse
import logging
import re
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, final

import numpy as np

import manip_learn as ml
from manip_learn.control.simulation import simulate_way

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "examples"))
from drawer_physics import PERIOD, ArmPhysics, drawer
from make_recordings.arms import Arm, load_arm
from make_recordings.mechanisms import Axle, Mechanism, Plane
from table_file import put

Row = tuple[object, ...]

WAY, TURN, RADIUS = 0.15, 0.6, 0.35  # [m], [rad], [m]
SPEED, STIFFNESS = 0.06, 2000.0  # [m/s], [N m/rad]
JAMMED = 0.5 * WAY  # [m]
RESTS = 1.2  # [s] watched after the end
KINDS = ("drawer", "door", "table")
# how an arm follows in free air: late by, and with a first-order lag of [s]
AIR = ("at once", 0.0, 0.0), ("34 ms late", 0.034, 0.0), ("60 ms late", 0.06, 0.0), ("lag of 50 ms", 0.002, 0.05)
AIR_RUNS = 25
SHARE = 0.1  # smallest singular value of the rows held and driven, over a whole way, of a posture that counts


@final
@dataclass(frozen=True)
class Case:
    """A way from a posture."""

    name: str
    arm: Arm
    kind: str
    q: np.ndarray
    axis: np.ndarray  # along the drawer, of the hinge, across the table
    point: np.ndarray  # on the hinge

    @property
    def thing(self) -> Mechanism:
        """What the hand holds."""
        handle, none = self.arm.pose(self.q)[:3, 3], np.empty((0, 3))
        if self.kind == "drawer":
            return drawer(handle, self.axis)
        if self.kind == "table":
            return Plane(handle, none, np.array([0.3, 0.3]), self.axis)
        return Axle(handle, none, np.array([TURN]), self.axis, self.point, firm=False)

    def controller(self, axis: np.ndarray, point: np.ndarray, speed: float) -> ml.ResolvedRateController:
        """The way as it was learnt: about, along or across an axis."""
        robot, tip = self.arm.robot, self.arm.tip.name
        if self.kind == "door":
            rows = ml.MechanismRows(robot, tip, ("radial", "tangential", "axial"), axis=axis, point=point)
            constraint = ml.Constraint(np.eye(3)[[0, 2]], rows)
            task = ml.motion(constraint, angle=TURN, speed=speed / RADIUS)
        else:
            rows = ml.FrameJacobian(robot, tip, "xyz")
            across = np.linalg.svd(axis[None])[2][1:]
            constraint = ml.Constraint(across if self.kind == "drawer" else axis[None], rows)
            along = axis if self.kind == "drawer" else across[0]
            task = ml.motion(constraint, distance=WAY, direction=along, speed=speed)
        return ml.ResolvedRateController(constraint, task, task.ascent())


@final
@dataclass(frozen=True)
class Outcome:
    """What became of a way.

    Attributes:
        way: Share of it that was gone.
        ended: Why the run ended.
        forces: shape (T, 2), across the way and all of it, of the hand on what it holds [N].
        trip: Period in which the loop found the arm blocked; None where it did not.
    """

    way: float
    ended: str
    forces: np.ndarray
    trip: int | None

    def after(self, seconds: float) -> float:
        """Force left a time after the trip, or after the end [N]."""
        at = len(self.forces) - round(RESTS / PERIOD) if self.trip is None else self.trip
        return float(self.forces[min(at + round(seconds / PERIOD), len(self.forces) - 1), 1])

    def above(self, force: float) -> float:
        """For how long the force was larger [ms]."""
        return 1e3 * PERIOD * float(np.sum(self.forces[:, 1] > force))


def cases(arms: list[str], postures: int, seed: int) -> list[Case]:
    """Postures from which each thing can be done."""
    found = []
    for name in arms:
        for kind in KINDS:
            rng = np.random.default_rng([seed, len(found)])
            n = 0
            while n < postures:
                case = drawn(name, kind, rng)
                n += case is not None
                found += [case] if case is not None else []
    return found


def drawn(name: str, kind: str, rng: np.random.Generator) -> Case | None:
    """A case whose way an ideal arm does; None if it does not."""
    arm = load_arm(name)
    robot = arm.robot
    q = np.clip(arm.ready + rng.uniform(-0.5, 0.5, robot.nv), robot.position_lower + 0.3, robot.position_upper - 0.3)
    at, turn = arm.pose(q)[:3, 3], rng.uniform(0.0, 2.0 * np.pi)
    axis = np.array([np.cos(turn), np.sin(turn), 0.0])
    point = at + RADIUS * axis
    case = Case(name, arm, kind, q, axis if kind == "drawer" else np.array([0.0, 0.0, 1.0]), point)
    if at[2] < 0.1 or np.linalg.norm(at[:2]) < 0.3:
        return None
    try:
        rollout, done = simulate_way(robot, case.controller(case.axis, case.point, SPEED), q, dt=0.02)
    except ml.ManipLearnError:
        return None
    rows = ml.Constraint(np.eye(3), ml.FrameJacobian(robot, arm.tip.name, "xyz"))
    least = min(np.linalg.svd(rows(x), compute_uv=False)[-1] for x in rollout.q[::10])
    return case if done.is_done and not done.strays and least > SHARE else None


class Watched:
    """An arm whose forces are noted as it is read."""

    simulated, period = True, PERIOD

    def __init__(self, arm: ArmPhysics, case: Case):
        self._arm, self._case, self.command = arm, case, arm.command
        self.start, self.forces = arm.place.copy(), list[tuple[float, float]]()
        self.at_the_jam: Callable[[], object] = lambda: None

    def read(self) -> tuple[np.ndarray, None, None]:
        """Joint positions."""
        force, axis = self._arm.force, self._case.axis
        way = {"drawer": axis, "table": np.linalg.svd(axis[None])[2][1]}.get(self._case.kind)
        if way is None:
            way = np.cross(axis, self._arm.place - self._case.point)
            way /= np.linalg.norm(way)
        across = force - (force @ way) * way
        self.forces.append((float(np.linalg.norm(across)), float(np.linalg.norm(force))))
        if self._case.kind == "drawer" and self._arm.way > JAMMED - 1e-5:
            self.at_the_jam()
        return self._arm.read()

    @property
    def way(self) -> float:
        """How far what is held has gone [m or rad]."""
        return float(np.linalg.norm(self._arm.place - self.start)) if self._case.kind == "table" else abs(self._arm.way)


def done(
    case: Case,
    *,
    contact: dict[str, Any] | None = None,
    axis: np.ndarray | None = None,
    point: np.ndarray | None = None,
    speed: float = SPEED,
    seed: int = 7,
    knows: bool = False,
    **servos: Any,
) -> Outcome:
    """One way of one arm: with an axis or a hinge that was learnt wrongly, settings of the contact, bad servos.

    With `knows` the arm is told to brake in the very period in which the drawer jams.
    """
    controller = case.controller(case.axis if axis is None else axis, case.point if point is None else point, speed)
    stiffness = servos.pop("stiffness", STIFFNESS)
    arm = ArmPhysics(case.name, case.q, case.thing, stiffness, np.random.default_rng(seed), **servos)
    loop = loop_of(controller, {"stiffness": stiffness} | (contact or {}))
    loop.reset(case.q)
    watched = Watched(arm, case)
    if knows:
        watched.at_the_jam = loop.stop
    task = controller.task
    assert isinstance(task, ml.FreeDirection)
    record = ml.run(loop, watched, task.duration + 1.0)
    for _ in range(round(RESTS / PERIOD)):
        watched.read()
        arm.command(loop.position)
    wanted = TURN if case.kind == "door" else WAY
    status = record.rollout.status
    trip = status.index("following-error") if "following-error" in status else None
    return Outcome(watched.way / wanted, record.ended, np.array(watched.forces), trip)


def loop_of(controller: ml.ResolvedRateController, contact: dict[str, Any]) -> ml.ServoLoop:
    """The loop of a run."""
    return ml.ServoLoop(controller, PERIOD, contact=ml.Contact(**contact))


FAULTS: dict[str, dict[str, Any]] = {
    "none": {},
    "friction 3 N m": {"friction": 3.0},
    "friction 6 N m": {"friction": 6.0},
    "play 2 mrad": {"play": 0.002},
    "play 10 mrad, 200 N m/rad": {"play": 0.010, "stiffness": 200.0},
    "play 10 mrad": {"play": 0.010},
    "20 ms late": {"latency": 0.020},
    "60 ms late": {"latency": 0.060},
    "200 N m/rad": {"stiffness": 200.0},
    "200 N m/rad, not told": {"stiffness": 200.0, "contact": {"stiffness": None}},
    "2,000 N m/rad, not told": {"contact": {"stiffness": None}},
    "20,000 N m/rad": {"stiffness": 20_000.0},
    "20,000 N m/rad, not told": {"stiffness": 20_000.0, "contact": {"stiffness": None}},
    "payload 3 kg": {"payload": 3.0},
    "sticks up to 25 N": {"sticks": 25.0},
    "sticks up to 50 N": {"sticks": 50.0},
    "encoder steps of 0.5 mrad": {"step": 5e-4},
    "all of them": {
        "friction": 3.0, "play": 0.002, "latency": 0.020, "step": 1e-4, "payload": 1.0, "sticks": 25.0,
    },
}  # fmt: skip


def exact(found: list[Case]) -> list[Row]:
    """What was learnt exactly, with each fault: how many ways were gone to the end, and the force across them."""
    rows: list[Row] = [("servos", "whole ways", "trips", "across the way, median and largest [N]")]
    for name, fault in FAULTS.items():
        outcomes = []
        for case in found:
            given = dict(fault)
            if "sticks" in given and case.kind == "door":
                given["sticks"] *= RADIUS
            outcomes.append(done(case, **given))
            say(name, case, outcomes[-1])
        rows.append(exact_row(name, outcomes))
    return rows


def exact_row(name: str, outcomes: list[Outcome]) -> Row:
    """A row of that table."""
    across = [o.forces[:, 0].max() for o in outcomes]
    whole = sum(o.trip is None and abs(o.way - 1.0) < 0.1 for o in outcomes)
    trips = sum(o.trip is not None for o in outcomes)
    return name, f"{whole} of {len(outcomes)}", trips, f"{np.median(across):.0f}, {max(across):.0f}"


def turned(axis: np.ndarray, degrees: float, about: float) -> np.ndarray:
    """An axis that is off by an angle, to a side."""
    aside = np.linalg.svd(axis[None])[2][1:]
    wrong = axis + np.tan(np.deg2rad(degrees)) * (np.cos(about) * aside[0] + np.sin(about) * aside[1])
    return wrong / np.linalg.norm(wrong)


def wrong(found: list[Case]) -> list[Row]:
    """What was learnt wrongly: how hard it is pressed across the way, and what is left half a second after the trip."""
    rows: list[Row] = [("learnt", "servos", "trips", "across, median and largest [N]", "after 0.5 s, largest [N]")]
    errors = {"3 degrees off": 3.0, "8 degrees off": 8.0, "hinge 30 mm off": 0.03}
    for servos, fault in {"ideal": {}, "friction 3 N m": {"friction": 3.0}, "20 ms late": {"latency": 0.02}}.items():
        for name, size in errors.items():
            outcomes = []
            for number, case in enumerate(found):
                about = 0.5 * np.pi * number + 0.7
                if (case.kind == "door") != (size < 1.0) or (case.kind == "table" and size < 1.0):
                    continue
                given: dict[str, Any] = {"axis": turned(case.axis, size, about)} if size >= 1.0 else {}
                if size < 1.0:
                    given = {"point": case.point + size * np.array([np.cos(about), np.sin(about), 0.0])}
                outcomes.append(done(case, **given, **fault))
                say(f"{name}, {servos}", case, outcomes[-1])
            across = [o.forces[:, 0].max() for o in outcomes]
            trips = sum(o.trip is not None for o in outcomes)
            left = max(o.after(0.5) for o in outcomes)
            pressed = f"{np.median(across):.0f}, {max(across):.0f}"
            rows.append((name, servos, f"{trips} of {len(outcomes)}", pressed, f"{left:.1f}"))
    return rows


def jam(found: list[Case]) -> list[Row]:
    """A drawer that is stuck half way: how hard it is hit, for how long, and what is left."""
    forces = ("largest, median and worst [N]", "over 30 N, median and worst [ms]", "after 1 s, worst [N]")
    rows: list[Row] = [("speed [m/s]", "driven [N]", "trips", *forces)]
    drawers = [case for case in found if case.kind == "drawer"]
    for speed, driven in ((0.06, 60.0), (0.06, 15.0), (0.25, 60.0)):
        outcomes = []
        for case in drawers:
            outcomes.append(done(case, speed=speed, jammed_at=JAMMED, contact={"driven": driven}))
            say(f"jam at {speed}, {driven:.0f} N", case, outcomes[-1])
        most, over = [o.forces[:, 1].max() for o in outcomes], [o.above(30.0) for o in outcomes]
        trips = sum(o.trip is not None for o in outcomes)
        spreads = (f"{np.median(some):.0f}, {max(some):.0f}" for some in (most, over))
        left = max(o.after(1.0) for o in outcomes)
        rows.append((f"{speed:g}", f"{driven:.0f}", f"{trips} of {len(outcomes)}", *spreads, f"{left:.1f}"))
    for speed in (0.06, 0.25):  # what no loop can do better: the servos' dampers and momentum
        most = [done(case, speed=speed, jammed_at=JAMMED, knows=True).forces[:, 1].max() for case in drawers]
        rows.append((f"{speed:g}", "brakes at once", "", f"{np.median(most):.0f}, {max(most):.0f}", "", ""))
    return rows


def air(found: list[Case]) -> list[Row]:
    """Ten seconds in free air, of an arm that follows late: how many are stopped, and how late it is said to follow."""
    table: list[Row] = [("follows", "runs", "stopped", "said, median [ms]")]
    for name, late, lag in AIR:
        stopped, said = 0, []
        for number in range(AIR_RUNS):
            case, rng = found[number % len(found)], np.random.default_rng([number, 5])
            robot, q, dt = case.arm.robot, case.q, 0.002
            rows = ml.Constraint(np.eye(3), ml.FrameJacobian(robot, case.arm.tip.name, "xyz"))
            place, size = robot.position(q, case.arm.tip.name), rng.uniform(0.02, 0.1, 3)
            rate = rng.uniform(0.3, 2.0, 3)
            task = ml.Track(lambda t, p=place, s=size, w=rate: p + s * (1.0 - np.cos(w * t)), gain=2.0)
            loop = ml.ServoLoop(ml.ResolvedRateController(rows, task, ml.ManipulabilityAscent(rows)), dt)
            loop.reset(q)
            sent, arm = [q] * (round(late / dt) + 1), q.copy()
            for k in range(round(10.0 / dt)):
                arm = arm + (sent[-1 - round(late / dt)] - arm) * (1.0 if lag == 0.0 else dt / (lag + dt))
                status = loop.update(arm + rng.normal(0.0, 1e-4, robot.nv), k * dt).status
                sent.append(loop.position)
                if status == "following-error":
                    stopped += 1
                    print(name, number, loop.stopped_by, file=sys.stderr, flush=True)
                    break
            said += [float(note.split()[3]) for note in loop.notes if note.startswith("the arm follows")]
        table.append((name, AIR_RUNS, stopped, f"{np.median(said) if said else 0.0:.0f}"))
    return table


def hit(found: list[Case]) -> list[Row]:
    """A person pushes for 0.4 s: what trips, what gives way, and what comes back."""
    rows: list[Row] = [("pushed", "force [N]", "trips", "gives way, median [mm]", "off after 1 s, median [mm]")]
    for what in ("free hand", "hand on a drawer, across", "hand on a drawer, against the way", "elbow"):
        for force in (20.0, 40.0, 80.0):
            trips, ways, left = 0, [], []
            for case in found:
                if case.kind == "drawer":
                    tripped, way, off = pushed(case, what, force)
                    trips, ways, left = trips + tripped, [*ways, way], [*left, off]
            medians = (f"{np.median(some):.1f}" for some in (ways, left))
            rows.append((what, f"{force:.0f}", f"{trips} of {len(ways)}", *medians))
            print(*rows[-1], file=sys.stderr, flush=True)
    return rows


def pushed(case: Case, what: str, force: float) -> tuple[bool, float, float]:
    """Whether the loop trips, how far the hand gives way, and how far off it is a second after the push [mm]."""
    free, robot, tip = what in ("free hand", "elbow"), case.arm.robot, case.arm.tip.name
    aside = np.linalg.svd(case.axis[None])[2][1]
    way = -case.axis if "against" in what else aside
    begins = 1.2  # [s] in full motion

    def push(t: float) -> tuple[np.ndarray, int]:
        joint = 3 if what == "elbow" else -1
        return (force * way if begins <= t < begins + 0.4 else np.zeros(3)), joint

    controller = case.controller(case.axis, case.point, SPEED)
    if free:  # a motion to a point
        rows = ml.Constraint(np.eye(3), ml.FrameJacobian(robot, tip, "xyz"))
        task = ml.PointAttractor(robot.position(case.q, tip) + WAY * case.axis, gain=1.0, max_speed=SPEED)
        controller = ml.ResolvedRateController(rows, task, ml.ManipulabilityAscent(rows))
    places = {}
    for name, given in (("with", push), ("without", None)):
        thing = None if free else case.thing
        arm = ArmPhysics(case.name, case.q, thing, STIFFNESS, np.random.default_rng(7), push=given)
        loop = loop_of(controller, {"stiffness": STIFFNESS})
        loop.reset(case.q)
        seen, tripped = [], False
        for k in range(round((begins + 1.4) / PERIOD)):
            tripped = loop.update(arm.read()[0], PERIOD * k).status == "following-error" or tripped
            arm.command(loop.position)
            seen.append(arm.place.copy())
        places[name] = np.array(seen), tripped
    off = 1e3 * np.linalg.norm(places["with"][0] - places["without"][0], axis=1)
    at = round(begins / PERIOD)
    return places["with"][1], float(off[at : at + 400].max()), float(off[-1])


def say(what: str, case: Case, outcome: Outcome) -> None:
    """Progress, one line a run."""
    across, most = outcome.forces.max(axis=0)
    where = "whole" if outcome.trip is None else f"tripped after {PERIOD * outcome.trip:.2f} s"
    after = f"{outcome.after(0.5):.1f} N after 0.5 s, {outcome.above(30.0):.0f} ms over 30 N"
    print(
        f"{what}; {case.name} {case.kind}: way {outcome.way:.3f}, {where}; across {across:.0f} N, in all {most:.0f} N; "
        f"{after}; "
        f"{outcome.ended}",
        file=sys.stderr,
        flush=True,
    )


# the name of a part -> the table that it makes, and the file of that table
PARTS: dict[str, tuple[Callable[[list[Case]], list[Row]], str]] = {
    "exact": (exact, "servos_faults.csv"),
    "wrong": (wrong, "servos_wrong.csv"),
    "jam": (jam, "servos_jams.csv"),
    "air": (air, "servos_air.csv"),
    "hit": (hit, "servos_pushes.csv"),
}


def main() -> None:
    """Measure, and write the tables."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--seed", type=int, default=900)
    parser.add_argument("--postures", type=int, default=2)
    parser.add_argument("--arms", default="panda,ur5,xarm7")
    parser.add_argument("--parts", default=",".join(PARTS))
    parser.add_argument("--only", default="", help="faults whose names match this pattern")
    parser.add_argument("--out", type=Path, help="folder of the tables; they are printed where none is given")
    given = parser.parse_args()
    logging.getLogger("manip_learn").setLevel(logging.ERROR)
    for name in [name for name in FAULTS if not re.search(given.only, name)]:
        del FAULTS[name]
    found = cases(given.arms.split(","), given.postures, given.seed)
    for part in given.parts.split(","):
        table, file = PARTS[part]
        head, *rows = table(found)
        put([str(word) for word in head], rows, given.out and given.out / file)


if __name__ == "__main__":
    main()
