"""The compiled law gives the numbers of the one in Python, state by state and run by run; without it Python does."""

from __future__ import annotations

import copy
import importlib.util
import pickle
import subprocess
import sys
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
import servo_cases
from random_arms import State, law_of, state_of

import manip_learn as ml
from manip_learn.control.law import ACROSS, SCALED_BELOW, STALLED_BELOW
from manip_learn.control.policies import SampledPolicy

built = pytest.mark.skipif(
    importlib.util.find_spec("manip_learn_fast") is None,
    reason="NO manip_learn_fast: THE COMPILED LAW IS NOT TESTED (make fast)",
)
ARMS = ["planar3", "sawyer", "panda", "ur5", "kinova", "gantry", "wrist", "tree", "mimic", "humanoid"]
LAWS, STATES = 30, 20  # of each arm: 6,000 in all
AGREED = 1e-9  # [rad/s or m/s] and of the speed
EPS = float(np.finfo(float).eps)
EXACT, BESIDE = 2e-15, 1e-11  # singular values over the largest: lost to the last bit, and not singular at all


def singular(rows: ml.Constraint, q: np.ndarray) -> np.ndarray | None:
    """A posture at which the rows lose a direction, to the last bit that Newton's method finds; None if it does not."""
    for _ in range(60):
        A, vjp = rows.value_and_vjp(q)
        U, sigma, Vt = np.linalg.svd(A)
        k = len(sigma) - 1
        if sigma[k] <= 1e-15 * sigma[0]:
            break
        slopes = np.array([vjp(np.outer(U[:, k], v)) for v in Vt[k:]])
        step = -np.linalg.pinv(slopes, rcond=1e-3) @ np.array([sigma[k]] + [0.0] * (len(slopes) - 1))
        q = q + step * min(1.0, 0.3 / max(float(np.linalg.norm(step)), 1e-12))
    return q if sigma[k] <= 1e-13 * sigma[0] else None


def slack_of(law: ml.ResolvedRateController, state: State, command: ml.Command) -> float | None:
    """By how much two correct roundings may differ [rad/s or m/s]; None where that is without bound."""
    sigma = np.linalg.svd(law.constraint(state.q), compute_uv=False)
    ratio, policy = min(sigma[-1] / sigma[0] if sigma[0] > 0.0 else 0.0, sigma[-1]), law.null_policy
    w = policy(state.q, 0.0, state.dt) if isinstance(policy, SampledPolicy) else 0.0
    size = 1.0 + float(np.abs(command.velocity).max()) + float(np.abs(w).max())
    # the gradient that is not bounded is as good as infinite there; a single row of zeros has no scale
    if (ratio < 1e-6 and getattr(policy, "max_speed", 1.0) is None) or (ratio < BESIDE and len(sigma) == 1):
        return None
    if EXACT < ratio < BESIDE:
        return None
    beside = 64.0 * EPS / ratio if ratio >= BESIDE else 0.0  # error of a singular vector
    # a joint that rounding alone says moves the hand helps those rows that bounds break, at 1 / ACROSS^2
    A = law.constraint(state.q)
    broken = float(np.linalg.norm(command.task_velocity - A @ command.velocity)) if law.limits is not None else 0.0
    beside += 8.0 * EPS * float(np.abs(A).max()) * broken / ACROSS**2
    tips = 1e-11 / max(ratio, 1e-14) if law.limits is not None and law.limits.barriers.frames else 0.0
    return (AGREED + beside + tips) * size


def undecided(command: ml.Command, law: ml.ResolvedRateController, slack: float) -> bool:
    """Whether a number that decides about the status is at its threshold."""
    near = 1e-9 + 10.0 * slack / max(float(np.linalg.norm(command.task_velocity)), 1e-6)
    numbers = ((command.progress, STALLED_BELOW), (command.task_scale, SCALED_BELOW))
    return any(abs(x - edge) < near for x, edge in (*numbers, (command.smallest_singular_value, law.threshold)))


@built
@pytest.mark.parametrize("name", ARMS)
def test_both_engines_agree_in_every_state(name, robot_of, monkeypatch):
    """Hundreds of states of an arm: the same velocities, parts, scales and statuses, and the same errors."""
    robot, seen, compared = robot_of(name), Counter[str](), 0
    for i in range(LAWS):
        rng = np.random.default_rng([7, ARMS.index(name), i])
        native = law_of(robot, name, rng)
        monkeypatch.setenv("MANIP_LEARN_ENGINE", "python")
        python = ml.ResolvedRateController(
            native.learnt, native.task, native.null_policy, native.inverse, threshold=native.threshold,
            limits=native.limits or False,
        )  # fmt: skip
        assert python.engine == "python"
        monkeypatch.delenv("MANIP_LEARN_ENGINE")
        if native.engine == "python":
            continue
        special = None if rng.random() < 0.5 else singular(native.constraint, state_of(robot, None, rng).q)
        for _ in range(STATES):
            state = state_of(robot, special, rng)
            try:
                expected = python(state.q, 0.0, *state[1:])
            except ml.ManipLearnError as error:
                with pytest.raises(type(error)) as raised:
                    native(state.q, 0.0, *state[1:])
                assert str(raised.value) == str(error)
                continue
            got, slack = native(state.q, 0.0, *state[1:]), slack_of(native, state, expected)
            where = f"{name} {i} {native!r} {state}"
            if slack is None:
                assert np.all(np.isfinite(got.velocity)), where
                continue
            compared += 1
            seen[expected.status] += 1
            np.testing.assert_allclose(got.velocity, expected.velocity, rtol=0, atol=slack, err_msg=where)
            if undecided(expected, native, slack):
                continue
            assert got.status is expected.status, where
            for part in ("task_velocity", "task_part", "null_part", "escape_part"):
                one, other = getattr(got, part), getattr(expected, part)
                assert (one is None) == (other is None), where
                if one is not None:
                    size = 1.0 + float(np.abs(other).max())
                    np.testing.assert_allclose(one, other, rtol=0, atol=10.0 * slack * size, err_msg=f"{part} {where}")
            assert got.manipulability == pytest.approx(expected.manipulability, rel=1e-9, abs=1e-12), where
            assert got.outside == expected.outside and got.limiting_joint == expected.limiting_joint, where
            assert got.smallest_singular_value == pytest.approx(expected.smallest_singular_value, rel=1e-9, abs=1e-12)
    words = {"ok", "acceleration-limited"} | ({"damped"} if name != "humanoid" else set())  # seldom near a singularity
    assert compared > 0.5 * LAWS * STATES and words <= set(seen), seen


def test_a_start_outside_of_all_bounds_is_none(robot_of, rng):
    """No encoder says that: it is refused in a table as the servo loop refuses it, and the others are done."""
    robot = robot_of("sawyer")
    starts = np.stack([robot.positions(robot.random_configuration(rng)) for _ in range(4)])
    starts[2, 0] = 1e3
    assert (
        ml.simulate(robot, servo_cases.law_of(robot, "sawyer"), starts, 0.1, 0.01)[2].status[0]
        is ml.Status.INVALID_INPUT
    )


@built
def test_the_engine_is_named_copied_and_pickled(robot_of, rng):
    """`engine` says which; other limits make another one; copies work elsewhere."""
    robot = robot_of("sawyer")
    law, q = servo_cases.law_of(robot, "sawyer"), robot.neutral() + 0.3
    assert law.engine == "native"
    slow = law.with_limits(ml.Limits(robot, velocity=0.01))
    assert slow.engine == "native" and np.abs(slow(q).velocity).max() <= 0.01 < np.abs(law(q).velocity).max()
    for other in (copy.deepcopy(law), pickle.loads(pickle.dumps(law))):
        assert other.engine == "native"
        np.testing.assert_array_equal(other(q).velocity, law(q).velocity)


def told_by(folder: Path, **environment: str) -> tuple[str, str]:
    """What a Python with this folder first on its path prints."""
    path = f"{folder}:{Path(ml.__file__).parents[1]}"
    program = """import logging
logging.basicConfig()
import manip_learn as ml
rows = ml.Constraint([[0, 1]], ml.FrameJacobian(ml.load_robot("planar3"), "tip", "x y"))
laws = [ml.ResolvedRateController(rows) for _ in range(3)]
print([law.engine for law in laws], laws[0]([0.3, 0.8, 0.4]).status)"""
    ran = subprocess.run(
        [sys.executable, "-c", program], env={"PYTHONPATH": path, **environment}, capture_output=True, text=True,
        check=True,
    )  # fmt: skip
    return ran.stdout, ran.stderr


def test_without_a_usable_engine_python_does_the_work(tmp_path):
    """Another version of the law, and a module that is half built, are told of once; switched off, it is silent."""
    package = tmp_path / "manip_learn_fast"
    package.mkdir()
    for source, said in (("LAW_VERSION = 0", "version 0 of the law"), ("", "cannot be loaded")):
        (package / "__init__.py").write_text(source, encoding="utf-8")
        printed, logged = told_by(tmp_path)
        assert "['python', 'python', 'python'] ok" in printed
        assert logged.count(said) == 1 and logged.count("pip install ./fast") == 1, logged
    printed, logged = told_by(tmp_path, MANIP_LEARN_ENGINE="python")
    assert "['python', 'python', 'python'] ok" in printed and not logged
