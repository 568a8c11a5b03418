"""A million cycles of servo loops in irregular time, with faults, changes of the task, stops and restarts.

    python benchmarks/irregular_time.py [--cycles 1000000] [--out FILE.md]

Loops made for 1 ms are called 0.2 to 100 ms apart (log-uniform), on position servos that follow at once. Of the
cycles, 1 in 50 brings NaN, infinity, a posture of the wrong size or 1e200 rad, or an old or a repeated time; 1 in
1,000 changes the target, the task or the constraint, stops or starts; 1 in 5,000 blocks the arm, which is reset
later. Limits hold over the time from call to call, or over a period where that is shorter or not known, as around a
fault, where jerk is not counted. A step is the way of the commanded posture from one call to the next.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from closed_loops import robots, table
from controller_cases import inside

import manip_learn as ml

PERIOD = 0.001  # [s]
GAPS = (2e-4, 0.1)  # [s] shortest and longest time between two calls
JERK = 500.0  # [rad/s3]
KINDS = ("position", "velocity", "acceleration", "jerk", "step")


def given(rng: np.random.Generator, q: np.ndarray, t: float) -> tuple[np.ndarray, float]:
    """What the driver hands over: mostly the truth."""
    if rng.random() >= 0.02:
        return q, t
    far, bad = q.copy(), q.copy()
    far[rng.integers(q.size)], bad[rng.integers(q.size)] = 1e200, rng.choice([np.nan, np.inf])
    wrong = [(far, t), (bad, t), (q[1:], t), (q, np.nan), (q, t - 0.01), (q, t - 1e-9), (q, np.inf)]
    return wrong[int(rng.integers(len(wrong)))]


def change(
    loop: ml.ServoLoop, rng: np.random.Generator, constraints: list[ml.Constraint], goals: list[np.ndarray]
) -> None:
    """Something else to do."""
    goal = goals[int(rng.integers(len(goals)))]
    kind = int(rng.integers(5))
    if kind == 0:
        loop.set_task(ml.PointAttractor(goal * rng.choice([1.0, 3.0]), gain=float(rng.choice([0.5, 3.0]))))
    elif kind == 1:
        loop.set_target(goal)
    elif kind == 2:
        loop.set_constraint(constraints[int(rng.integers(len(constraints)))])
    elif kind == 3:
        loop.stop()
    else:
        loop.start()


def run(name: str, robot: ml.Robot, tip: str, cycles: int, jerk: float | None) -> list[str]:
    """One row of the table."""
    features, rng = (
        ml.FrameJacobian(robot, tip),
        np.random.default_rng([20, sorted(robots()).index(name), jerk is None]),
    )
    constraints = [ml.Constraint(np.linalg.qr(rng.normal(size=(3, 3)))[0][:s], features) for s in (1, 2, 3)]
    goals = [features.coordinates(inside(robot, rng)) for _ in range(20)]
    task, climb = ml.PointAttractor(goals[0], gain=2.0), ml.ManipulabilityAscent(constraints[0])
    loop = ml.ServoLoop(ml.ResolvedRateController(constraints[0], task, climb), PERIOD, jerk_limit=jerk)
    worst = dict.fromkeys(KINDS, 0.0)
    raised = moving = blocked = 0
    q, u, rate, at = inside(robot, rng), np.zeros(robot.nv), np.zeros(robot.nv), None
    t, gap, shortest, sure = 0.0, PERIOD, PERIOD, 1  # calls in order before this one

    def note(kind: str, excess: np.ndarray) -> None:
        worst[kind] = float(np.maximum(worst[kind], np.max(excess)))  # NaN, too

    for _ in range(cycles):
        if rng.random() < 1e-3:
            change(loop, rng, constraints, goals)
        if rng.random() < 2e-4:
            blocked = 50
        measured, stamp = given(rng, q, t)
        try:
            command = loop.step(measured, stamp)
        except ml.ManipLearnError:
            raised, command = raised + 1, loop.update(measured, stamp)
        fine = measured is q and stamp == t
        held = min(gap, PERIOD) if fine and sure else PERIOD
        v, tripped, sure = command.velocity, command.status == "following-error", (sure + 1) * fine
        acceleration = (v - u) / held
        note("velocity", np.abs(v) - robot.velocity_limit)
        note("acceleration", (np.abs(acceleration) / loop.acceleration_limit - 1.0))
        if jerk is not None and not tripped and moving and sure > 2:
            note("jerk", np.abs(acceleration - rate) / (jerk * max(held, shortest)) - 1.0)
        moving = not tripped
        if loop.position is not None:
            note("position", np.maximum(loop.position - robot.position_upper, robot.position_lower - loop.position))
            if at is not None:
                note("step", np.abs(loop.position - at) / (robot.velocity_limit * held) - 1.0)
            at = loop.position
            q = q if blocked else at
        blocked -= blocked > 0
        if tripped and not blocked and not v.any():
            loop.reset()
            moving, sure = False, 0  # the loop has forgotten when it was called
        u, rate, shortest = v, acceleration, held
        gap = float(np.exp(rng.uniform(*np.log(GAPS))))
        t += gap
    return [
        name,
        "none" if jerk is None else f"{jerk:g}",
        f"{cycles}",
        f"{raised}",
        *(f"{worst[k]:.0e}" for k in KINDS),
    ]


def main() -> None:
    """Print the table, and write it."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--cycles", type=int, default=1_000_000, help="cycles over all robots")
    parser.add_argument("--out", type=Path)
    arguments = parser.parse_args()
    arms = robots()
    each = arguments.cycles // (2 * len(arms))
    rows = [run(name, robot, tip, each, jerk) for name, (robot, tip) in arms.items() for jerk in (None, JERK)]
    head = ["robot", "jerk limit [rad/s3]", "cycles", "exceptions"]
    head += ["beyond a position limit [rad]", "beyond a velocity limit [rad/s]"]
    head += [f"{kind}, excess as a share of its limit" for kind in KINDS[2:]]
    text = table("Loops in irregular time, with faults:", head, rows)
    print(text)
    if arguments.out is not None:
        arguments.out.write_text(text)


if __name__ == "__main__":
    main()
