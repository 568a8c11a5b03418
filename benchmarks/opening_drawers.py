"""How often the manipulability of the task decides whether a drawer opens: from how many starts it helps, or hurts.

A Sawyer takes hold of the handle of the learnt drawer (its shipped recordings), for half a second, and opens it by
0.3 m at 0.1 m/s. Starts are drawn with the hand at the shut drawer of one of the three heights, within the joint
limits: anywhere along the self-motion, or brought along it to within SINGULAR of a singularity of what is held and
driven. A drawer counts as opened if the hand came the whole way and was never farther than 2 mm off its line: it
would have to bend the rail, or let go.

    python benchmarks/opening_drawers.py [--starts 200] [--seed 20000] [--out FILE.csv]
    python benchmarks/opening_drawers.py --chest [--starts 60] [--seed 31]   # all three drawers, one after the other
    python benchmarks/opening_drawers.py --physics     # side force on the rail, from the demo's start (MuJoCo)
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import final

import numpy as np
from scipy.optimize import least_squares
from table_file import put

import manip_learn as ml
from manip_learn.commands.demo import SCENES, shipped_recordings
from manip_learn.control.simulation import STRAY, WayDone, simulate_way

SHUT = 0.75  # [m] where the handle is along the drawer's line when it is shut: the middle of the recorded starts
HEIGHTS = (0.2, 0.35, 0.5)  # [m] of the three recorded drawers
WAY, SPEED, PAUSE = 0.3, 0.1, 0.5  # [m], [m/s], [s] as a gripper takes to close
SINGULAR = 0.02  # smallest singular value of the rows held and driven, of a start near a singularity [m or 1]
MARGIN = 0.03  # [rad] of a start from the joint limits
POLICIES = ("zero", "attractor", "manipulability")
NO_PLAN = WayDone(WAY, 0.0, "m", None, None, 0.0, 0.0, ("", 0.0), "no plan")


@final
@dataclass(frozen=True)
class Study:
    """One kind of start and of grip."""

    title: str
    near: bool
    keep_orientation: bool


STUDIES = (
    Study("anywhere, the hand may turn", near=False, keep_orientation=False),
    Study("anywhere, the hand keeps its orientation", near=False, keep_orientation=True),
    Study("near a singularity, the hand keeps its orientation", near=True, keep_orientation=True),
)


class Bench:
    """The learnt drawer, starts at its handle, and ways from there."""

    def __init__(self) -> None:
        scene = SCENES["sawyer"]
        self.robot = ml.load_robot("sawyer")
        demonstrations = ml.load_demonstrations(shipped_recordings() / scene.recordings, self.robot)
        self.features = ml.FrameJacobian(self.robot, scene.frame)
        self.constraint = ml.ConstraintLearner(self.features).fit(demonstrations).constraint_
        self.rest = np.array([float(position) for position in scene.control["rest"].split(",")])
        line = np.linalg.svd(self.constraint.selection)[2][2]
        self.outward = -line * np.sign(line[0])  # the drawer opens towards the robot

    def motion(self, keep_orientation: bool, along: float = WAY, pause: float = PAUSE) -> ml.FreeDirection:
        """The way of one drawer."""
        return ml.motion(
            self.constraint,
            along=along,
            direction=self.outward,
            speed=SPEED,
            pause=pause,
            keep_orientation=keep_orientation,
        )

    def at_handle(self, place: np.ndarray, q: np.ndarray) -> np.ndarray | None:
        """The posture with the tip at a place that is found from q; None if none is."""
        low, high = self.robot.position_lower + MARGIN, self.robot.position_upper - MARGIN
        found = least_squares(
            lambda x: self.robot.position(x, self.features.frame) - place,
            np.clip(q, low + 1e-3, high - 1e-3),
            jac=lambda x: self.features(x),
            bounds=(low, high),
            max_nfev=60,
        )
        return found.x if np.linalg.norm(found.fun) < 1e-6 else None

    def start(self, rng: np.random.Generator, study: Study) -> np.ndarray:
        """A start of a study."""
        rows = self.motion(study.keep_orientation).constraint
        while True:
            place = -SHUT * self.outward + np.array([0.0, 0.0, rng.choice(HEIGHTS)])
            q = self.at_handle(place, rng.uniform(self.robot.position_lower, self.robot.position_upper))
            if q is not None and study.near:
                q = self.nearly_singular(place, q, rows)
            if q is not None:
                return q

    def nearly_singular(self, place: np.ndarray, q: np.ndarray | None, rows: ml.Constraint) -> np.ndarray | None:
        """Along the self-motion down the slope of mu, until a singularity is near; None if none is on the way."""
        for _ in range(60):
            if q is None or np.linalg.svd(rows(q), compute_uv=False)[-1] < SINGULAR:
                return q
            A = self.features(q)
            slope = (np.eye(len(q)) - np.linalg.pinv(A) @ A) @ ml.log_manipulability_gradient(rows, q)
            q = self.at_handle(place, q - 0.08 * slope / np.linalg.norm(slope))
        return None

    def open(self, q: np.ndarray, policy: str, keep_orientation: bool) -> tuple[ml.Rollout, WayDone]:
        """One drawer, opened as far as it gets."""
        task = self.motion(keep_orientation)
        controller = ml.ResolvedRateController(self.constraint, task, self.policy(policy, task.constraint))
        return simulate_way(self.robot, controller, q)

    def planned(self, q: np.ndarray, keep_orientation: bool) -> WayDone:
        """One drawer, opened from the posture in which a plan takes hold."""
        try:
            return ml.plan(self.constraint, self.motion(keep_orientation), q).outcome
        except ml.NoPlanError:
            return NO_PLAN

    def policy(self, name: str, rows: ml.Constraint) -> ml.NullSpacePolicy | None:
        """A null-space policy by its name; the ascent climbs the manipulability of rows."""
        if name == "attractor":
            return ml.JointAttractor(self.rest, robot=self.robot)
        return ml.ManipulabilityAscent(rows) if name == "manipulability" else None

    def chest(self, q: np.ndarray, policy: str, keep_orientation: bool) -> int:
        """How many of the three drawers are opened and shut again, one after the other, the hand never let go."""
        first = self.robot.position(q, self.features.frame)
        heights = [first[2], *(z for z in HEIGHTS if abs(z - first[2]) > 0.01)]
        for number, height in enumerate(heights):
            place = np.array([*first[:2], height])
            if number:
                q, left = self.at(place, q, policy, keep_orientation)
                if left > STRAY:
                    return number
            for along in (WAY, -WAY):
                task = self.motion(keep_orientation, along, pause=0.0)
                controller = ml.ResolvedRateController(self.constraint, task, self.policy(policy, task.constraint))
                rollout, way = simulate_way(self.robot, controller, q)
                q = rollout.q[-1]
                if not opened(way):
                    return number
        return len(heights)

    def at(self, place: np.ndarray, q: np.ndarray, policy: str, keep_orientation: bool) -> tuple[np.ndarray, float]:
        """The posture after going to a place in 4 s, and how much is left [m]."""
        features = ml.FrameJacobian(self.robot, self.features.frame.name, "pose" if keep_orientation else "xyz")
        target = place
        if keep_orientation:
            target = self.robot.pose(q, features.frame).copy()
            target[:3, 3] = place
        task, rows = ml.PointAttractor(target, 3.0, 0.4), ml.Constraint(np.eye(features.n_rows), features)
        controller = ml.ResolvedRateController(rows, task, self.policy(policy, rows))
        rollout = ml.simulate(self.robot, controller, q, 4.0, 0.01)
        return rollout.q[-1], float(rollout.task_error[-1])


def opened(way: WayDone) -> bool:
    """Whether the drawer is open, and the hand stayed on its line."""
    return way.is_done and not way.strays


def all_studies(bench: Bench, n: int, seed: int) -> list[list[object]]:
    """The rows of the table."""
    lines: list[list[object]] = []
    for number, study in enumerate(STUDIES):
        rng = np.random.default_rng([seed, number])
        starts = [bench.start(rng, study) for _ in range(n)]
        ways = {p: [bench.open(q, p, study.keep_orientation)[1] for q in starts] for p in POLICIES}
        ways["plan"] = [bench.planned(q, study.keep_orientation) for q in starts]
        without = np.array([opened(way) for way in ways["zero"]])
        for policy in ways:
            done = np.array([opened(way) for way in ways[policy]])
            off = np.percentile([1e3 * way.deviation for way in ways[policy]], [50, 90])
            times = [way.seconds for way in ways[policy] if way.seconds is not None]
            mu = np.median([way.least_manipulability for way in ways[policy]])
            changed = np.sum(done & ~without), np.sum(~done & without)
            counts = [study.title, policy, f"{np.sum(done)} of {n}", *changed]
            lines.append([*counts, f"{off[0]:.2f}, {off[1]:.1f}", f"{np.median(times):.2f}", f"{mu:.3f}"])
    return lines


def chests(bench: Bench, n: int, seed: int) -> str:
    """The table of whole chests."""
    lines = ["| grip | policy | all three | helped | hurt | drawers, mean |", "|---|---|---|---|---|---|"]
    for study in STUDIES[:2]:
        rng = np.random.default_rng([seed, int(study.keep_orientation)])
        starts = [bench.start(rng, study) for _ in range(n)]
        counts = {p: np.array([bench.chest(q, p, study.keep_orientation) for q in starts]) for p in POLICIES}
        without = counts["zero"] == len(HEIGHTS)
        for policy, count in counts.items():
            done = count == len(HEIGHTS)
            lines.append(
                f"| {study.title} | {policy} | {np.sum(done)} of {n} | {np.sum(done & ~without)} | "
                f"{np.sum(~done & without)} | {np.mean(count):.2f} |"
            )
    return "\n".join(lines)


def side_forces(bench: Bench) -> str:
    """The largest side force on the drawer of example 07, opened by position servos from the demo's start [N]."""
    sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "examples"))
    from drawer_physics import PERIOD, ArmPhysics, drawer

    lines = ["| policy | 400 N m/rad | 2,000 N m/rad |", "|---|---|---|"]
    for policy in POLICIES:
        forces = []
        for stiffness in (400.0, 2000.0):
            task, q = bench.motion(keep_orientation=True), np.array(SCENES["sawyer"].start)
            controller = ml.ResolvedRateController(bench.constraint, task, bench.policy(policy, task.constraint))
            loop = ml.ServoLoop(controller, PERIOD, contact=ml.Contact(latency=0.003))
            loop.reset(q)
            handle = bench.robot.position(q, bench.features.frame)
            held = drawer(handle, bench.outward)
            physics = ArmPhysics("sawyer", q, held, stiffness, np.random.default_rng(7))
            force = []
            for _ in range(round((task.duration + 1.0) / PERIOD)):
                command = loop.update(physics.read()[0], physics.time)
                physics.command(loop.position, command.velocity)
                force.append(physics.side_force)
            forces.append(max(force[50:]))  # what closing the grip takes is over after 50 ms
        lines.append(f"| {policy} | {forces[0]:.1f} | {forces[1]:.1f} |")
    return "\n".join(lines)


def main() -> None:
    """Print the table, or write it."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--starts", type=int, default=200)
    parser.add_argument("--seed", type=int, default=20_000)
    parser.add_argument("--out", type=Path)
    parser.add_argument("--chest", action="store_true")
    parser.add_argument("--physics", action="store_true")
    given = parser.parse_args()
    if given.chest:
        print(chests(Bench(), given.starts, given.seed))
        return
    if given.physics:
        print(side_forces(Bench()))
        return
    header = ["start, grip", "policy", "opened", "helped", "hurt", "off the line [mm]", "time [s]", "least mu"]
    put(header, all_studies(Bench(), given.starts, given.seed), given.out)


if __name__ == "__main__":
    main()
