"""The state of a loop: what a step makes of it depends on nothing else, and a kept one can be gone on from."""

from __future__ import annotations

import numpy as np
import pytest
from servo_cases import law_of, start_of

import manip_learn as ml
from manip_learn.control.servo_loop import LoopRules, State

DT = 0.002


def replayed(rules: LoopRules, state: State, q: np.ndarray, seed: int, n: int) -> list[tuple]:
    """States, readings and times of a loop, and what follows. Its arm is late, pushed now and then, and badly read."""
    rng, steps, t, sent = np.random.default_rng(seed), list[tuple](), 0.0, [q] * 8
    for k in range(n):
        t += DT if rng.uniform() < 0.8 else float(rng.choice([0.0, 0.3 * DT, 3.0 * DT, 0.15, -1.0]))
        reading: object = sent[-4] + rng.normal(0.0, 3e-5, len(q)) + 0.02 * (300 < k % 900 < 360)
        if rng.uniform() < 0.02:
            reading = [np.full(len(q), np.nan), "none", q + 1.0][int(rng.integers(3))]
        steps.append((state, reading, t, *rules.step(state, reading, t)))
        state = steps[-1][3]
        sent = [*sent[1:], q if state.position is None else state.position]
    return steps


@pytest.mark.parametrize(("name", "jerk"), [("sawyer", None), ("ur5", 200.0), ("kinova", None)])
def test_a_kept_state_gives_the_same_command_again(robot_of, name: str, jerk: float | None) -> None:
    """To the bit, in random order, among readings of every kind."""
    robot = robot_of(name)
    loop = ml.ServoLoop(law_of(robot, name), DT, jerk_limit=jerk, contact=ml.Contact(stiffness=2000.0))
    rules, q = loop.rules, robot.configuration(start_of(robot))
    steps, rng = replayed(rules, rules.begin(None, q), q, 5, 2000), np.random.default_rng(6)
    assert {"invalid-input", "stale", "following-error"} <= {str(command.status) for *_, command in steps}
    for k in rng.permutation(len(steps)).tolist():
        *before, _, command = steps[k]
        again = rules.step(*before)[1]
        assert again.velocity.tobytes() == command.velocity.tobytes() and again.status == command.status, k


def test_a_stop_in_the_midst_of_an_update_is_kept(robot_of) -> None:
    """As that of a signal, which comes while a command is computed."""
    law, q = law_of(robot_of("sawyer"), "sawyer"), start_of(robot_of("sawyer"))
    stops = ml.ResolvedRateController(law.constraint, law.task, lambda _q: loop.stop() or np.zeros(7))
    loop = ml.ServoLoop(stops, DT)
    assert loop.update(q, 0.0).status is not ml.Status.STOPPED and loop.update(q, DT).status is ml.Status.STOPPED
    assert loop.state.is_stopped
