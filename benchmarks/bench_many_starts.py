"""A table of starts through `simulate`, over the same starts one by one (a step and start, 7 joints).

Promise: at most a twentieth for 400 starts of a Sawyer that reach a point along two oblique rows and climb mu. Two
thirds of the steps are at bounds, so that most of them need a program. Beside it how the time falls with the number of
starts, and how many steps the controller takes by itself.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from timing import Ratio, keep, rounds_of, summary

from manip_learn.constraint.constraint import Constraint
from manip_learn.constraint.features import FrameJacobian
from manip_learn.control.batch import BatchLaw
from manip_learn.control.controller import ResolvedRateController
from manip_learn.control.policies import ManipulabilityAscent
from manip_learn.control.simulation import simulate
from manip_learn.control.tasks import PointAttractor
from manip_learn.robot import load_robot

pytestmark = [pytest.mark.bench, pytest.mark.timeout(600)]
STARTS, STEPS, DT, ROUNDS = 400, 100, 0.01, 5
ALONE = 8  # starts that are simulated one by one
PROMISED = 0.05


def test_table_of_starts() -> None:
    """The promise, with the time a step and start in microseconds."""
    robot = load_robot("sawyer")
    rng = np.random.default_rng(0)
    rows = np.linalg.qr(rng.normal(size=(3, 3)))[0][:2]
    constraint = Constraint(rows, FrameJacobian(robot, "right_hand"))
    law = ResolvedRateController(constraint, PointAttractor([0.5, 0.3, 0.4]), ManipulabilityAscent(constraint))
    starts = np.stack([robot.random_configuration(rng) for _ in range(STARTS)])

    def table(n: int) -> Callable[[], object]:
        return lambda: simulate(robot, law, starts[:n], STEPS * DT, DT)

    candidates: dict[str, Callable[[], object]] = {f"{n} starts": table(n) for n in (STARTS, 100, 25, ALONE)}
    candidates["one by one"] = lambda: [simulate(robot, law, start, STEPS * DT, DT) for start in starts[:ALONE]]
    counts = {name: ALONE if name == "one by one" else int(name.split()[0]) for name in candidates}
    seconds = rounds_of(candidates, 1, ROUNDS)
    best = {name: summary(values).best / counts[name] / STEPS for name, values in seconds.items()}
    bulk = BatchLaw.of(law, robot)
    assert bulk is not None
    motions = bulk.simulate(starts, STEPS, DT, lambda fraction: None)
    print("\nus a step and start, best of rounds: " + ", ".join(f"{name} {1e6 * x:.1f}" for name, x in best.items()))
    print(f"free {np.mean(motions.status == 'ok'):.3f}, by the controller itself {np.mean(motions.alone):.4f} of all")
    ratios = {name: x / best["one by one"] for name, x in best.items() if name != "one by one"}
    keep("many starts", {f"{name}, share of one by one": Ratio(x) for name, x in ratios.items()})
    assert ratios[f"{STARTS} starts"] <= PROMISED, f"slower than promised: {ratios}, promised {PROMISED}"
