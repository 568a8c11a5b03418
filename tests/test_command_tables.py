"""What the commands print: readable on 60 columns, with every term explained where it is printed."""

from __future__ import annotations

import dataclasses
import io

import numpy as np
import pytest
from rich.console import Console
from test_cli import DRAWER, FRAME

from manip_learn.cli import main
from manip_learn.commands.control import Controlled
from manip_learn.commands.learn import learn
from manip_learn.commands.options import LearnOptions
from manip_learn.commands.tables import (
    AUDIT_TERMS,
    ROLLOUT_TERMS,
    SHOWN_ORDER,
    WORDS,
    audit_table,
    print_controlled,
    print_learnt,
)
from manip_learn.constraint.constraint import Constraint
from manip_learn.constraint.features.frame_jacobian import FrameJacobian
from manip_learn.control.controller import ResolvedRateController
from manip_learn.control.simulation import simulate
from manip_learn.learning.audit import audit_episodes
from manip_learn.recordings.recording_source import RecordingSource
from manip_learn.robot import load_robot


def printed(width: int, show, *values, **options) -> str:
    """What a printer writes to a terminal of a width."""
    out = io.StringIO()
    show(Console(file=out, width=width, force_terminal=False), *values, **options)
    return out.getvalue()


@pytest.fixture(scope="module")
def controlled() -> Controlled:
    """A short motion."""
    arm = load_robot("planar3")
    constraint = Constraint([[0.0, 1.0]], FrameJacobian(arm, "tip", "x y", "world"))
    return Controlled(simulate(arm, ResolvedRateController(constraint), [0.1, 0.5, 0.5], 0.2, 0.05), None, 0.01)


@pytest.mark.parametrize("width", [60, 100])
def test_a_rollout_is_readable(width: int, controlled: Controlled) -> None:
    """No line is wider than the terminal, nothing is cut, every term of the table is explained below it."""
    text = printed(width, print_controlled, controlled)
    assert "\u2026" not in text and max(map(len, text.splitlines())) <= width
    assert "unhindered" in text and f"{controlled.rollout.manipulability.mean():.3f}" in text
    words = " ".join(text.split())
    assert all(f"{term}: {WORDS[term][0].split(';')[0]}" in words for term in ROLLOUT_TERMS)


def test_an_audit_is_readable() -> None:
    """On 60 columns the least telling measures give way, and are named; on 100 all are there."""
    sawyer = load_robot("sawyer")
    constraint = Constraint(np.eye(3)[:2], FrameJacobian(sawyer, FRAME[1], "xyz", "world"))
    report = audit_episodes(constraint, RecordingSource(DRAWER[:2], sawyer))
    for width in (60, 100):
        table, hidden = audit_table(report.episodes, width)
        text = printed(width, lambda console, t: console.print(t), table)
        assert "\u2026" not in text and max(map(len, text.splitlines())) <= width
        header = text.splitlines()[0].split()
        assert header == ["episode", *(name for name in SHOWN_ORDER if name not in hidden)]
    assert not hidden
    assert all(term in WORDS for term in AUDIT_TERMS)


def test_learning_explains_its_words() -> None:
    """A number has its scale beside it, and each word its line; --explain says more."""
    learnt = learn(LearnOptions("sawyer", list(DRAWER), frame=FRAME[1]))
    text = " ".join(printed(60, print_learnt, learnt).split())
    assert f"gap {learnt.report.gap:,.0f} (10 is clear)" in text
    for term in ("row", "gap", "left out", "uncertainty", "strength"):
        assert f"{term}: {WORDS[term][0].split(';')[0]}" in text
    at_length = " ".join(printed(60, print_learnt, learnt, explain=True).split())
    assert WORDS["gap"][1] in at_length and WORDS["gap"][1] not in text


def test_an_axis_that_nothing_determines_has_no_angle() -> None:
    """An uncertainty beyond any angle is said in words: +- 1,600 degrees means nothing to a reader."""
    learnt = learn(LearnOptions("sawyer", list(DRAWER), frame=FRAME[1]))
    found = learnt.report.mechanism
    assert found is not None and "direction known to 0.00" in printed(100, print_learnt, learnt)
    lost = dataclasses.replace(found, uncertainty={**found.uncertainty, "axis": 1600.0})
    report = dataclasses.replace(learnt.report, mechanism=lost, uncertainty_deg=None)
    text = printed(100, print_learnt, dataclasses.replace(learnt, reports=(report, *learnt.reports[1:])))
    assert "direction not determined" in text and "1.6e+03" not in text and "1600" not in text


def test_explain_is_a_flag(tmp_path, capsys, monkeypatch) -> None:
    """As it is typed."""
    monkeypatch.chdir(tmp_path)
    arm = load_robot("planar3")
    Constraint([[0.0, 1.0]], FrameJacobian(arm, "tip", "x y", "world")).save(tmp_path / "line.json")
    words = ["control", "planar3", "line.json", "--start", "0.1,0.5,0.5", "--duration", "0.1"]
    assert main([*words, "--explain"]) == 0
    assert WORDS["unhindered"][1] in " ".join(capsys.readouterr().out.split())
