"""Our own step: learnt-like dense Lambda (two oblique rows), mu, grad log mu, limits, status."""

import numpy as np
from common import POSTURES, TARGET, TIP, report

import manip_learn as ml
from manip_learn.control.compiled_controller import CompiledController
from manip_learn.errors import MissingExtraError

robot = ml.load_robot("sawyer")
features = ml.FrameJacobian(robot, TIP, "xyz")
rows = np.linalg.qr(np.random.default_rng(1).normal(size=(3, 2)))[0].T
constraint = ml.Constraint(rows, features)
velocity = np.array([0.05, -0.03])


class Given(ml.Task):
    """A task velocity from elsewhere: what is left is the law itself."""

    def velocity(self, constraint, q, t):
        """The given velocity."""
        return velocity

    def error(self, constraint, q, t):
        """Not known."""
        return 0.0


ascent, reach = ml.ManipulabilityAscent(constraint, 0.1), ml.PointAttractor(TARGET)
bare = ml.ResolvedRateController(constraint, Given(), ascent, limits=False)
limited = ml.ResolvedRateController(constraint, Given(), ascent)
reaching = ml.ResolvedRateController(constraint, reach, ascent)
steps = {
    "bare law, b given": bare,
    "with limits and status, b given": limited,
    "with limits and status, reaching a point": reaching,
    "task only, reaching a point": ml.ResolvedRateController(constraint, reach),
}
try:
    compiled = CompiledController(reaching)
    steps["compiled, reaching a point"] = compiled
    STEPS = 500

    def rollout(q):
        """500 steps at once."""
        return compiled.rollout(q, STEPS, 0.01)

    steps["compiled rollout of 500 steps"] = rollout
except MissingExtraError:
    pass
assert all(reaching(q).status == "ok" for q in POSTURES[:8])
report("manip-learn", steps, calls=300)
