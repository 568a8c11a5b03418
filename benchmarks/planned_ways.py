"""How often a plan opens what a greedy policy does not, and what an exhaustive search finds beyond it.

Arms take hold of a drawer's handle that is where their hand happens to be: start postures are random, clear of
self-collision, and the rail points in a random horizontal direction, 0.4 m long at 0.3 m/s. Four columns: whether the
way is done (the whole of it, never 2 mm off the rail, within all limits) from the start without null-space motion, with
the ascent of mu, by `ml.plan`, and, where there is no plan, from any of 2,000 postures of the same hand: an exhaustive
search without the planner's graph, each posture carried along the way for itself, and simulated if it comes to the end.

    python benchmarks/planned_ways.py [--starts 60] [--seed 60000] [--arms sawyer panda xarm7 ur5 ur10] [--out FILE]
    python benchmarks/planned_ways.py --physics [--starts 100]   # plans in MuJoCo, by position servos and the loop
    python benchmarks/planned_ways.py --margins                  # the margin by the number of candidates, and the time
"""

from __future__ import annotations

import argparse
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import final

import numpy as np
from table_file import put

import manip_learn as ml
from manip_learn.control.simulation import WayDone, simulate_way
from manip_learn.planning.clearance import links_of
from manip_learn.planning.stations import Stations
from manip_learn.planning.ways import marches_of

TIPS = {"sawyer": "right_hand", "panda": "panda_hand_tcp", "xarm7": "link_eef", "ur5": "tool0", "ur10": "tool0"}
LOCKED = {"panda": ("panda_finger_joint1", "panda_finger_joint2")}
WAY, SPEED = 0.4, 0.3  # [m], [m/s]
EXHAUSTIVE = 2000  # postures
LOWEST, NARROWEST, FARTHEST = 0.1, 0.25, 0.9  # [m] of the handle: above the floor, from the base's axis
OPEN = 5.0  # [mm] that servos which give way may leave of a drawer that counts as opened
NEAR = 0.006  # [m] between links of a start
STIFFNESS = 2000.0  # [N m/rad] of position servos
FORCE = 60.0  # [N] at which the loop stops: at 0.3 m/s the joints' own friction looks like 16 N on a Panda's hand
DT = 0.02  # [s] of the exhaustive search; a plan is simulated at 0.01


@final
@dataclass(frozen=True)
class Case:
    """One arm at one handle."""

    robot: ml.Robot
    constraint: ml.Constraint
    motion: ml.FreeDirection
    start: np.ndarray


def say(*words: object) -> None:
    """How far the run is."""
    print(*words, file=sys.stderr, flush=True)


def case(name: str, keep_orientation: bool, rng: np.random.Generator) -> Case:
    """A random posture, and a rail through the hand."""
    robot = ml.load_robot(name, locked=LOCKED.get(name, ()))
    links = links_of(robot)[0]
    while True:
        q = robot.positions(robot.random_configuration(rng))
        q = np.clip(q, np.maximum(robot.position_lower, -np.pi), np.minimum(robot.position_upper, np.pi))
        place = robot.position(q, TIPS[name])
        near = place[2] > LOWEST and NARROWEST < np.hypot(*place[:2]) < FARTHEST
        if near and (links is None or not links.closer_than(robot.configuration(q), NEAR)):
            break
    angle = rng.uniform(0.0, 2.0 * np.pi)
    across = [[-np.sin(angle), np.cos(angle), 0.0], [0.0, 0.0, 1.0]]
    constraint = ml.Constraint(across, ml.FrameJacobian(robot, TIPS[name]))
    motion = ml.motion(constraint, distance=WAY, speed=SPEED, keep_orientation=keep_orientation)
    return Case(robot, constraint, motion, q)


def done(outcome: WayDone) -> bool:
    """The whole way, and the hand on the rail."""
    return outcome.is_done and not outcome.strays


def greedy(case: Case, climbs: bool, q: np.ndarray | None = None, dt: float = 0.01) -> bool:
    """From a posture, the start by default, with spare joints at rest or climbing the rows held and driven."""
    motion = case.motion.with_distance(case.motion.wanted)
    law = ml.ResolvedRateController(case.constraint, motion, motion.ascent() if climbs else None, dt=dt)
    rollout, outcome = simulate_way(case.robot, law, case.start if q is None else q, dt)
    links = links_of(case.robot)[0]
    return done(outcome) and (links is None or not any(links.closer_than(x, 0.0) for x in rollout.q[::10]))


def exhaustive(case: Case, rng: np.random.Generator) -> bool | None:
    """Whether the way is done from any of many postures of the same hand; None where a station has no posture.

    The hand of each posture is carried along the way, spare joints at rest, drawn to the middle of their ranges, or up
    mu; those that come to the end, clear of the arm's own links at the start, are simulated.
    """
    stations = Stations.of(case.motion, case.start, ml.Limits(case.robot))
    marches = marches_of(stations, case.start, EXHAUSTIVE, rng)
    if not np.isfinite(marches.least).any(axis=0).all():
        return None
    links = links_of(case.robot)[0]
    whole = marches.q[np.isfinite(marches.least).all(axis=1), 0]
    clear = [q for q in whole if links is None or not links.closer_than(case.robot.configuration(q), NEAR)]
    return any(greedy(case, climbs, q, DT) for q in clear for climbs in (False, True))


def row(name: str, keep_orientation: bool, starts: int, seed: int, report: bool) -> list[object]:
    """One line of the table."""
    counts = {"zero": 0, "mu": 0, "plan": 0, "lost": 0, "beyond": 0, "none": 0}
    times, margins, bad = [], [], 0
    for i in range(starts):
        rng = np.random.default_rng([seed, i, keep_orientation])
        one = case(name, keep_orientation, rng)
        zero, mu = greedy(one, False), greedy(one, True)
        began = time.perf_counter()
        try:
            plan = ml.plan(one.constraint, one.motion, one.start, scene=None)
            times.append(time.perf_counter() - began)
            margins.append(plan.margin)
            bad += not sound(one, plan)
            counts["plan"] += 1
        except ml.NoPlanError:
            counts["lost"] += zero or mu
            found = exhaustive(one, rng)
            counts["beyond"] += found is True
            counts["none"] += found is None
        counts["zero"] += zero
        counts["mu"] += mu
        if report:
            say(name, keep_orientation, i + 1, counts, f"{np.median(times or [0]):.2f} s")
    grip = "keeps its orientation" if keep_orientation else "may turn"
    possible = counts["plan"] + counts["beyond"]
    took = [f"{np.median(margins):.2f}", f"{np.median(times):.2f}, {np.max(times):.2f}"] if times else ["", ""]
    head = [name, grip, *(counts[key] for key in ("zero", "mu", "plan", "beyond"))]
    return [*head, f"{starts - possible} ({counts['none']})", counts["lost"], bad, *took]


def sound(one: Case, plan: ml.Plan) -> bool:
    """Whether approach and way are within the limits and clear of self-collision."""
    robot, links = one.robot, links_of(one.robot)[0]
    for rollout in (plan.approach, plan.way):
        q = np.array([robot.positions(x) for x in rollout.q])
        inside = np.all((q >= robot.position_lower - 1e-9) & (q <= robot.position_upper + 1e-9))
        slow = np.all(np.abs(rollout.u) <= robot.velocity_limit * (1.0 + 1e-9))
        clear = links is None or not any(links.closer_than(robot.configuration(x), 0.0) for x in q[::5])
        if not (inside and slow and clear):
            return False
    return bool(np.max(np.abs(plan.approach.q[0] - one.start)) < 1e-9)


def by_candidates(starts: int, seed: int) -> str:
    """The margin and the time by the number of candidates."""
    lines = ["| candidates | plans | margin, mean | seconds, median |", "|---|---|---|---|"]
    cases = [case("sawyer", True, np.random.default_rng([seed, i, 1])) for i in range(starts)]
    for candidates in (96, 192, 384, 768, 2000):
        margins, times = [], []
        for one in cases:
            began = time.perf_counter()
            try:
                margins.append(ml.plan(one.constraint, one.motion, one.start, candidates=candidates, scene=None).margin)
                times.append(time.perf_counter() - began)
            except ml.NoPlanError:
                margins.append(0.0)
        found = sum(m != 0.0 for m in margins)
        lines.append(f"| {candidates} | {found} of {starts} | {np.mean(margins):.3f} | {np.median(times):.2f} |")
    return "\n".join(lines)


def in_physics(starts: int, seed: int) -> str:
    """How many plans open the drawer in MuJoCo, where the loop runs them on position servos."""
    sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "examples"))
    from drawer_physics import PERIOD, ArmPhysics, drawer

    lines = ["| arm | plans | opened | short by, median and largest [mm] | side force, median and largest [N] |"]
    lines.append("|---|---|---|---|---|")
    for name in ("sawyer", "panda"):
        short, forces, number = [], [], 0
        while len(short) < starts:
            one = case(name, True, np.random.default_rng([seed, number, 1]))
            number += 1
            try:
                plan = ml.plan(one.constraint, one.motion, one.start, scene=None)
            except ml.NoPlanError:
                continue
            first, last = (one.robot.position(q, TIPS[name]) for q in plan.way.q[[0, -1]])
            rail = drawer(first, (last - first) / np.linalg.norm(last - first))
            physics = ArmPhysics(
                name, plan.hold, rail, STIFFNESS, np.random.default_rng(number), start=one.robot.positions(one.start)
            )
            contact = ml.Contact(max_lateral_force=FORCE, max_axial_force=FORCE, latency=0.003, stiffness=STIFFNESS)
            loop = ml.ServoLoop(plan.controller, PERIOD, contact=contact)
            loop.reset(one.start)
            force, sequence = [], loop.controller
            for _ in range(round((plan.rollout.time[-1] + 1.0) / PERIOD)):
                command = loop.update(physics.read()[0], physics.time)
                if sequence.number > 0 and not force:
                    physics.take_hold()
                physics.command(loop.position, command.velocity)
                if sequence.number > 0:
                    force.append(physics.side_force)
            short.append(1e3 * (WAY - physics.way))
            forces.append(max(force[50:], default=np.inf))
            say(name, len(short), f"{short[-1]:.1f} mm, {forces[-1]:.1f} N", command.status)
        opened = sum(abs(mm) < OPEN for mm in short)
        lines.append(
            f"| {name} | {starts} | {opened} | {np.median(short):.1f}, {max(short):.1f} | "
            f"{np.median(forces):.1f}, {max(forces):.1f} |"
        )
    return "\n".join(lines)


def main() -> None:
    """Print the table, or write it."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--starts", type=int, default=60)
    parser.add_argument("--seed", type=int, default=60_000)
    parser.add_argument("--arms", nargs="+", default=list(TIPS))
    parser.add_argument("--out", type=Path)
    parser.add_argument("--margins", action="store_true")
    parser.add_argument("--physics", action="store_true")
    given = parser.parse_args()
    if given.margins or given.physics:
        print((by_candidates if given.margins else in_physics)(given.starts, given.seed))
        return
    header = ["arm", "hand", "zero", "mu", "plan", "beyond the plan", f"none of {EXHAUSTIVE:,} (out of reach)"]
    lines = [row(name, keep, given.starts, given.seed, True) for name in given.arms for keep in (False, True)]
    put([*header, "greedy only", "unsound", "margin", "seconds"], lines, given.out)


if __name__ == "__main__":
    main()
