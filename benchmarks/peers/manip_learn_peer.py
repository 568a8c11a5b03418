"""Ours: a step with a learnt-like dense Lambda (two oblique rows), mu, grad log mu, limits, status; the controller
with and without the ascent of the manipulability.
"""

import functools

import numpy as np
from driving import POSTURES, TARGET, TIP, answer, beyond, main, read_tasks, report, write

import manip_learn as ml

velocity = np.array([0.05, -0.03])
KINDS = ("ascent", "no null-space motion", "ascent, accelerations limited")


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


def laws(arm, rows, target, gain):
    """Controllers by either engine: with the peers' limits, and with the default ones that bound accelerations too."""
    from control_states import engines  # whose folder driving has found

    constraint = ml.Constraint(rows, features_of(arm.urdf, arm.tip))
    task, ascent = ml.PointAttractor(target, gain=arm.task_gain), ml.ManipulabilityAscent(constraint, gain)
    same = ml.Limits(constraint.robot, acceleration=np.inf)
    kinds = dict(zip(KINDS, ((ascent, same), (None, same), (ascent, True)), strict=True))
    return {
        f"ours, {'compiled' if engine == 'native' else 'Python'}, {kind}": law
        for kind, (policy, limits) in kinds.items()
        for engine, law in engines(
            ml.ResolvedRateController(constraint, task, policy, dt=arm.dt, limits=limits)
        ).items()
    }


@functools.cache
def features_of(urdf, tip):
    """The tip's place."""
    return ml.FrameJacobian(ml.load_robot(urdf), tip, "xyz")


def control(cases, path):
    """Through `simulate`."""
    arm, tasks = read_tasks(cases)
    runs = {}
    for case in tasks:
        for name, law in laws(arm, case.rows, case.target, case.gain).items():
            rollout = ml.simulate(law.constraint.robot, law, case.start, arm.duration, arm.dt)
            excess = [beyond(arm, q, u) for q, u in zip(rollout.q, rollout.u, strict=True)]
            worst = np.maximum(np.max(excess, axis=0), 0.0)
            runs.setdefault(name, []).append((rollout.q[-1], 0, worst))
    write("manip-learn", path, runs)


def stepper(name):
    """One call of a controller."""

    def make(arm, case):
        law = laws(arm, case.rows, case.target, case.gain)[name]
        return lambda q: law(q, 0.0, arm.dt).velocity

    return make


NAMES = [f"ours, {engine}, {kind}" for engine in ("compiled", "Python") for kind in KINDS[:2]]

if __name__ == "__main__":
    main(step=step, control=control, timings=lambda: answer("manip-learn", {name: stepper(name) for name in NAMES}))
