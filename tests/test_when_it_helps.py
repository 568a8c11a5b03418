"""The benchmark of when manipulability helps: its rule of what is done, its intervals and its table."""

from __future__ import annotations

import functools
import sys
from pathlib import Path

import pytest

import manip_learn as ml
from manip_learn.control.way import SLACK, simulate_way

BENCHMARKS = Path(__file__).resolve().parents[1] / "benchmarks"
sys.path.insert(0, str(BENCHMARKS))

import when_cases  # noqa: E402
import when_it_helps  # noqa: E402
import when_runs  # noqa: E402

DOOR = ("so101", "door 60 deg", "free", "near")


@functools.cache
def door() -> when_cases.Case:
    return when_cases.cases_of(*DOOR, 1, 41_000)[0]


def test_intervals_and_marks() -> None:
    """Wilson's published values: 10 of 10 and 0 of 10 leave 0.278 of a share open, 15 of 20 is 0.531 to 0.888.

    The exact sign test: 6 to 0 has p = 0.031, 5 to 0 has 0.063; starts on which both agree do not count.
    """
    assert when_it_helps.wilson(10, 10) == pytest.approx((0.7225, 1.0), abs=1e-4)
    assert when_it_helps.wilson(0, 10) == pytest.approx((0.0, 0.2775), abs=1e-4)
    assert when_it_helps.wilson(15, 20) == pytest.approx((0.5313, 0.8881), abs=1e-4)
    assert when_it_helps.wilson(0, 0) == (0.0, 1.0)
    assert when_it_helps.differs([True] * 6 + [True] * 9, [False] * 6 + [True] * 9)
    assert not when_it_helps.differs([True] * 5 + [False] * 9, [False] * 5 + [False] * 9)
    assert not when_it_helps.differs([], [])


def test_any_joint_path_is_judged_as_a_simulated_way_is() -> None:
    """Done, time, deviation, fastest joint and mu of a rollout are the same from its postures alone."""
    case = door()
    task = case.motion(0)
    law = ml.ResolvedRateController(case.constraint, task, ml.ManipulabilityAscent(task.constraint))
    rollout, way = simulate_way(case.constraint.robot, law, case.start)
    theirs = when_runs.scored(way, rollout.manipulability[rollout.time >= way.begins - 1e-9]).score
    ours = when_runs.judged(case.motion(0), rollout.time, rollout.q, rollout.u, task.pause).score
    assert ours.done == theirs.done and ours.seconds == pytest.approx(theirs.seconds)
    assert ours[2:6] == pytest.approx(theirs[2:6], rel=1e-6)
    # a hand that leaves the circle by 3 mm, or that stops half way, has not opened the door
    half = len(rollout) // 2
    first = rollout.time[:half], rollout.q[:half], rollout.u[:half]
    assert not when_runs.judged(case.motion(0), *first, task.pause).score.done
    off = rollout.q.copy()
    off[half, 0] += 0.02  # [rad], 0.25 m from the pan axis
    assert not when_runs.judged(case.motion(0), rollout.time, off, rollout.u, task.pause).score.done
    assert rollout.time[-1] < task.duration + SLACK


def test_a_cell_is_the_same_again_and_is_counted_right(tmp_path: Path) -> None:
    """Two starts of a cell, measured twice and from the cache; the table counts what was done."""
    cell = when_it_helps.Cell("so101", "reach", "held", "anywhere")
    job = when_it_helps.Job(cell, {"none": 2, "learnt": 2, "plan": 0}, 41_000, {}, tmp_path)
    first = when_it_helps.measure(job)
    assert first == when_it_helps.measure(job) == when_it_helps.measure(job._replace(cache=None))
    assert len(list(tmp_path.iterdir())) == 3
    scores = first[2]
    cannot = when_it_helps.Cell("so101", "drawer 0.3 m", "held", "near")
    lines = when_it_helps.table({cell: scores, cannot: {}}, {cell: first[1][0]})
    assert {len(line) for line in lines} == {len(when_it_helps.HEADER)}
    rows = [dict(zip(when_it_helps.HEADER, line, strict=True)) for line in lines]
    assert [row["task"] for row in rows if row["note"]] == [cannot.task]
    assert "cannot be" in rows[-1]["note"] and rows[-1]["policy"] == ""
    for policy in ("none", "learnt"):
        shown = [row for row in rows if row["policy"] == when_it_helps.TITLES[policy] and row["task"] == "reach"]
        assert {(row["done"], row["of"]) for row in shown} == {(sum(s.done for s in scores[policy]), 2)}
        assert [row["mu least"] != "" for row in shown] == [row["arm"] != "all" for row in shown]
