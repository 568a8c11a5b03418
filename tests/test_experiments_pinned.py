"""The paper's generator, one seed of its table, both starts and an RMSE stay what they are.

    PYTHONPATH=. python tests/test_experiments_pinned.py     # where a change is meant: writes golden/experiments.json

Only numbers that rounding does not amplify: the generator's demonstrations, one seed of the table, the starts' rollouts
where they are not chaotic, and the RMSE of a constraint that is off by a known angle.
"""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.testing import assert_allclose
from rounding import rounding

from manip_learn.constraint.constraint import Constraint
from manip_learn.control.simulation import simulate
from manip_learn.experiments import rmse, sawyer
from manip_learn.experiments.metrics import policy_rmse
from manip_learn.experiments.paper_setup import (
    SELECTIONS,
    Setup,
    demonstrate,
    draw_starts,
    draw_targets,
    planar_arm,
    planar_features,
    true_constraint,
)
from manip_learn.experiments.singular_starts import DURATION, NEAR_SINGULAR, SINGULAR, STEPS, BadStart
from manip_learn.experiments.table import LearningCase, learning_trial
from manip_learn.linalg import one_thread
from manip_learn.recordings.trajectory import Demonstrations

PATH = Path(__file__).resolve().parent / "golden" / "experiments.json"
BESIDE = (0.1, -0.2, 0.15)  # [rad]
# (start of a place, relative, absolute tolerance). The separation of task and null space ends where five steps gain
# less than a millionth of the cost each: its error, of which the cost is the square, is known to 0.2 %, and the square
# to half a percent. Each of the 501 steps of a rollout adds the rounding of its factorisation, which the damping of
# 0.05 raises by 20 at most, to angles of up to a turn
LOOSER = (("table/separate", 5e-3, 1e-12), ("starts/", 1e-12, rounding(501 * 4 * 2 * 3, 2.0 * np.pi, 20.0)))


def ends(demos: Demonstrations) -> list[Any]:
    """First and last sample of the first and the last demonstration."""
    return [[t.q[[0, 9]].tolist(), t.u[[0, 9]].tolist()] for t in (demos[0], demos[-1]) if t.u is not None]


def generator() -> dict[str, Any]:
    """Of each constraint, and of the variants that draw more."""
    setups = {rows: Setup(rows) for rows in SELECTIONS}
    setups |= {"noise": Setup(noise=0.05), "own": Setup(policy="own"), "sinusoidal": Setup(policy="sinusoidal")}
    out: dict[str, Any] = {}
    for name, setup in setups.items():
        rng = np.random.default_rng(0)
        out[name] = ends(demonstrate(setup, setup.selection, rng))
    drawer = sawyer.CASES["model, 10 points each | constrained row | x"]
    return out | {"drawer": ends(sawyer.drawn(drawer, np.random.default_rng(0))[0])}


def table_seed() -> dict[str, Any]:
    """NMIE on both sets of one seed."""
    case = LearningCase(Setup("x y"), ("joint-affine", "separate", "true-w"))
    outcome = learning_trial(case, np.random.default_rng(0))
    return {name: [t["train"], t["test"], t["angle_deg"]] for name, t in outcome.items()}


def rollout(setting: BadStart, policy: str, dt: float, product: bool) -> dict[str, Any]:
    """Some samples of a rollout with the true Lambda."""
    law = setting.law(policy, true_constraint("x y"), product=product)
    r = simulate(planar_arm(), law, setting.start, DURATION, dt)
    shown = [0, 1, 2, 3, 20, 37, 72, 150, len(r) - 1]
    return {"n": len(r), "q": r.q[shown].tolist(), "mu": r.manipulability[shown].tolist()}


def starts() -> dict[str, Any]:
    """The rollouts that rounding leaves alone; of the leap, the order of magnitude."""
    out: dict[str, Any] = {
        f"singular, {policy}, dt {dt:g}": rollout(SINGULAR, policy, dt, False)
        for policy in ("zero", "attractor")
        for dt in STEPS
    }
    # from the exact starts these are chaotic, or go one way or the other by rounding
    for name, setting in {"singular": SINGULAR, "near-singular": NEAR_SINGULAR}.items():
        beside = replace(setting, start=tuple(np.array(setting.start) + BESIDE))
        out[f"beside {name}, manipulability"] = rollout(beside, "manipulability", 0.02, False)
        out[f"beside {name}, attractor, ours"] = rollout(beside, "attractor", 0.02, True)
    leap = NEAR_SINGULAR.law("zero", true_constraint("x y"))(NEAR_SINGULAR.start).velocity
    out["near-singular, leap"] = int(np.floor(np.log10(np.max(np.abs(leap)))))
    out["near-singular, start"] = list(NEAR_SINGULAR.start)
    return out


def turned_rmse() -> dict[str, Any]:
    """RMSE of both kinds for rows that are turned by 1e-3 rad."""
    rng, angle = np.random.default_rng(0), 1e-3
    learnt = np.array([[np.cos(angle), 0.0, np.sin(angle)], [0.0, 1.0, 0.0]])
    true, turned = true_constraint("x y"), Constraint(learnt, planar_features())
    where = draw_starts(3, rng), draw_targets(3, rng)
    (q, pi), (own_q, own_pi) = (rmse.climbing(true, *where, climbed) for climbed in (None, turned))
    return {"policies": policy_rmse(pi, own_pi).tolist(), "postures": policy_rmse(q, own_q).tolist()}


def computed() -> dict[str, Any]:
    """Everything that is written."""
    with one_thread():  # sums that are split among threads differ in their last digits
        return {"generator": generator(), "table": table_seed(), "starts": starts(), "rmse": turned_rmse()}


def assert_same(found: Any, expected: Any, where: str = "") -> None:
    """The same structure, and the same numbers, to 1e-12 but for those of `LOOSER`."""
    if isinstance(expected, dict):
        assert set(found) == set(expected), where
        for key in expected:
            assert_same(found[key], expected[key], f"{where}/{key}".strip("/"))
    else:
        rtol, atol = next(((r, a) for start, r, a in LOOSER if where.startswith(start)), (1e-12, 1e-12))
        assert_allclose(found, expected, rtol=rtol, atol=atol, err_msg=where)


def test_numbers_stay():
    """Those of golden/experiments.json."""
    assert_same(computed(), json.loads(PATH.read_text(encoding="utf-8")))


if __name__ == "__main__":
    PATH.write_text(json.dumps(computed(), indent=1) + "\n", encoding="utf-8")
