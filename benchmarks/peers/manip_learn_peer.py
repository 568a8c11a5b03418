"""Ours: a step with a learnt-like dense Lambda (two oblique rows), mu, grad log mu, limits, status; the controller with
its default settings, with and without the ascent of the manipulability.
"""

import time

import numpy as np
from driving import POSTURES, TARGET, TIP, main, read_tasks, report, write

import manip_learn as ml

velocity = np.array([0.05, -0.03])


class Given(ml.Task):
    """A task velocity from elsewhere: what is left is the law itself."""

    def velocity(self, constraint, q, t):
        """The given velocity."""
        return velocity

    def error(self, constraint, q, t):
        """Not known."""
        return 0.0


def step():
    """The law alone, within limits, reaching a point."""
    features = ml.FrameJacobian(ml.load_robot("sawyer"), TIP, "xyz")
    constraint = ml.Constraint(np.linalg.qr(np.random.default_rng(1).normal(size=(3, 2)))[0].T, features)
    ascent, reach = ml.ManipulabilityAscent(constraint, 0.1), ml.PointAttractor(TARGET)
    reaching = ml.ResolvedRateController(constraint, reach, ascent)
    steps = {
        "bare law, b given": ml.ResolvedRateController(constraint, Given(), ascent, limits=False),
        "with limits and status, b given": ml.ResolvedRateController(constraint, Given(), ascent),
        "with limits and status, reaching a point": reaching,
        "task only, reaching a point": ml.ResolvedRateController(constraint, reach),
    }
    assert all(reaching(q).status == "ok" for q in POSTURES[:8])
    report("manip-learn", steps, calls=300)


def control(cases, answer):
    """Through `simulate`."""
    arm, tasks = read_tasks(cases)
    features, runs = ml.FrameJacobian(ml.load_robot(arm.urdf), arm.tip, "xyz"), {}
    for name in ("ours, ascent", "ours, no null-space motion"):
        runs[name] = []
        for case in tasks:
            constraint = ml.Constraint(case.rows, features)
            ascent = ml.ManipulabilityAscent(constraint, case.gain) if name == "ours, ascent" else None
            task = ml.PointAttractor(case.target, gain=arm.task_gain)
            controller = ml.ResolvedRateController(constraint, task, ascent, dt=arm.dt)
            began = time.perf_counter()
            rollout = ml.simulate(features.robot, controller, case.start, arm.duration, arm.dt)
            runs[name].append((rollout.q, rollout.u, (time.perf_counter() - began) / len(rollout), 0))
    write("manip-learn", answer, runs)


if __name__ == "__main__":
    main(step=step, control=control)
