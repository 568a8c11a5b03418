"""Whether the compiled law is found, and moves an arm as the one in Python does."""

import os

import numpy as np

import manip_learn as ml

robot = ml.load_robot("sawyer")
rows = ml.Constraint([[0.6, 0.8, 0.0], [0.0, 0.0, 1.0]], ml.FrameJacobian(robot, "right_hand"))
runs = []
for engine in ("native", "python"):
    os.environ["MANIP_LEARN_ENGINE"] = engine
    law = ml.ResolvedRateController(rows, ml.PointAttractor([0.5, 0.3, 0.4]), ml.ManipulabilityAscent(rows))
    assert law.engine == engine, f"the engine is {law.engine}"
    runs.append(ml.simulate(robot, law, [0.1, -0.6, 0.2, 1.3, -0.2, 0.7, 0.4]))
off = float(np.abs(runs[0].q - runs[1].q).max())
assert off < 1e-9, off
print(f"two engines, {off:.1e} rad apart after {len(runs[0]):,} steps")
