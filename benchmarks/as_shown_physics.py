"""What is shown, done again in rigid-body dynamics through `run`: how far furniture goes, how hard it is pressed.

    PYTHONPATH=tests:examples python benchmarks/as_shown_physics.py --seed 65000

Each joint has a position servo of 2000 N m/rad with dry friction; commands and measurements travel for 1 ms each; the
arm comes from a home posture of its own and closes its gripper when `run` says so. One line a repetition: how far the
furniture went over the median one shown, and the largest force of the hand across its way [N].
"""

from __future__ import annotations

import argparse
from dataclasses import replace

import numpy as np
from as_shown import ARMS, homes
from drawer_physics import PERIOD, ArmPhysics
from jaxtyping import Float
from make_recordings.mechanisms import Axle, Mechanism, Slide
from shown_motions import Thing, recordings

import manip_learn as ml

KINDS = ("drawer", "door", "lid", "crank")
STIFFNESS = 2000.0  # [N m/rad]
NO_BAR = np.empty((0, 3))


def furniture(thing: Thing) -> Mechanism:
    """What moves as the thing does."""
    if thing.unit == "m":
        return Slide(thing.hold, NO_BAR, np.array([thing.size]), thing.axis)
    middle = 0.5 * (thing.hold + thing.place(np.array([[np.pi]]))[0])
    return Axle(thing.hold, NO_BAR, np.array([thing.size]), thing.axis, middle, firm=False)


class Gripping:
    """The arm, which closes and opens its grip as it is told, and notes the force across the way."""

    simulated, period = True, PERIOD

    def __init__(self, physics: ArmPhysics, thing: Thing):
        self.physics, self._thing, self.across = physics, thing, list[float]()

    def read(self) -> tuple[Float[np.ndarray, " n"], None, None]:
        """Joint positions."""
        return self.physics.read()

    def command(self, q: Float[np.ndarray, " n"], u: Float[np.ndarray, " n"]) -> None:
        """Go on by a period."""
        self.physics.command(q, u)
        ends = self._thing.place(np.array([[self.physics.way - 1e-4], [self.physics.way + 1e-4]]))
        way = (ends[1] - ends[0]) / np.linalg.norm(ends[1] - ends[0])
        force = self.physics.force
        self.across.append(float(np.linalg.norm(force - (force @ way) * way)))

    def gripper(self, word: str) -> None:
        """Take hold, or let go."""
        self.physics.gripper(word)


def on_the_handle(robot: ml.Robot, tip: str, q: Float[np.ndarray, " n"], place: Float[np.ndarray, " 3"]) -> np.ndarray:
    """A posture with the hand at a place, next to another."""
    for _ in range(30):
        J = robot.jacobian(q, robot.frame(tip))[:3]
        q = q + np.linalg.pinv(J) @ (place - robot.position(q, tip))
    return q


def done(kind: str, arm: str, seed: int) -> tuple[float, float, str]:
    """The way over the median one shown, the largest force across it [N], and why the run ended."""
    robot, tip, demos, (thing,), (ways,) = recordings((kind,), arm, seed)
    maps = [ml.FrameJacobian(robot, tip, "xyz", r) for r in ("world", "local")]
    skill = ml.ConstraintLearner(maps).fit(demos).skill_
    steps = tuple(replace(step, gripper="close" if step.kind == "way" else None) for step in skill.steps)
    steps = tuple(replace(s, gripper="open") if s.place is not None else s for s in steps)
    rng = np.random.default_rng([seed, len(arm)])
    (home,) = homes(robot, arm, rng, 1)
    again = ml.repeat(replace(skill, steps=steps), home)
    nearest = min((q for demo in demos for q in demo.q[::5]), key=lambda q: _far(robot, tip, q, thing.hold))
    grasp = on_the_handle(robot, tip, nearest, thing.hold)
    driver = Gripping(ArmPhysics(arm, grasp, furniture(thing), STIFFNESS, rng, start=np.array(home)), thing)
    loop = ml.ServoLoop(again.controller, dt=PERIOD)
    record = ml.run(loop, driver, float(again.rollout.time[-1]) + 3.0)
    return driver.physics.way / float(np.median(ways)), max(driver.across), record.ended


def _far(robot: ml.Robot, tip: str, q: Float[np.ndarray, " n"], place: Float[np.ndarray, " 3"]) -> float:
    return float(np.linalg.norm(robot.position(q, tip) - place))


def main() -> None:
    """Make, learn, repeat, measure."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seed", type=int, default=65000)
    parser.add_argument("--sets", type=int, default=1, help="per kind and arm")
    parser.add_argument("--arms", default=",".join(ARMS))
    options = parser.parse_args()
    good = total = 0
    for kind in KINDS:
        for arm in options.arms.split(","):
            for seed in range(options.seed, options.seed + options.sets):
                total += 1
                try:
                    way, across, ended = done(kind, arm, seed)
                except (RuntimeError, ml.ManipLearnError) as error:
                    print(f"{kind} {arm} {seed}: {error}"[:200], flush=True)
                    continue
                fine = abs(way - 1.0) <= 0.03 and across <= 30.0
                good += fine
                mark = "" if fine else "  <---"
                print(f"{kind} {arm} {seed}: way {way:.3f}, across {across:.1f} N; {ended}{mark}", flush=True)
    print(f"{good} of {total}")


if __name__ == "__main__":
    main()
