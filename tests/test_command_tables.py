"""What the commands print: readable on 60 columns, with every term explained on demand."""

from __future__ import annotations

import dataclasses
import inspect
import io
import math
import re

import numpy as np
import pytest
from rich.console import Console
from test_cli import DRAWER, FRAME

import manip_learn as ml
from manip_learn.commands.audit import audit_answer as audited
from manip_learn.commands.control import Aim, outcome
from manip_learn.commands.learn import fit, learning_answer
from manip_learn.commands.options import LearnOptions
from manip_learn.commands.output import Answer, cells
from manip_learn.commands.tables import Glossary, show, table_of
from manip_learn.learning.audit import audit_episodes


def printed(width: int, answer: Answer, explain: bool | None = False) -> str:
    """Return what people see of an answer on a terminal of a width."""
    out = io.StringIO()
    show(Console(file=out, width=width, force_terminal=False), answer, explain)
    return out.getvalue()


def in_line(width: int, answer: Answer, explain: bool | None = False) -> str:
    """Return the same in one line."""
    return " ".join(printed(width, answer, explain).split())


def explained(text: str) -> dict[str, str]:
    """Return the words of the glossary that a text explains."""
    terms = re.findall(r"^    (\w[\w ]*): ([^.]*)", inspect.getdoc(Glossary) or "", re.MULTILINE)
    return {term: first for term, words in terms if f"{term}: {(first := ' '.join(words.split()))}" in text}


@pytest.fixture(scope="module")
def held() -> ml.Constraint:
    """One row of a small arm's tip."""
    return ml.Constraint([[0.0, 1.0]], ml.FrameJacobian(ml.load_robot("planar3"), "tip", "x y", "world"))


@pytest.fixture(scope="module")
def rollout(held: ml.Constraint) -> ml.Rollout:
    """A short motion."""
    return ml.simulate(held.robot, ml.ResolvedRateController(held), [0.1, 0.5, 0.5], 0.2, 0.05)


def test_a_rollout_is_readable(held: ml.Constraint, rollout: ml.Rollout) -> None:
    """On 60 columns no line is too wide and nothing is cut; `--explain` explains every term of the table."""
    answer = outcome(held, rollout, 0.01)
    text, at_length = printed(60, answer), printed(60, answer, explain=True)
    assert text.count("--explain") == 1 and max(map(len, at_length.splitlines())) <= 60
    assert "\u2026" not in text and max(map(len, text.splitlines())) <= 60
    assert list(explained(" ".join(at_length.split()))) == ["error", "mu", "peak", "unhindered"]
    assert "--explain" not in printed(60, answer, explain=None)  # of a command that explains nothing


def test_an_audit_is_readable() -> None:
    """On 60 columns the least telling measures give way, and are named; on 100 all are there."""
    sawyer = ml.load_robot("sawyer")
    constraint = ml.Constraint(np.eye(3)[:2], ml.FrameJacobian(sawyer, FRAME[1], "xyz", "world"))
    answer = audited(audit_episodes(constraint, ml.RecordingSource(DRAWER[:2], sawyer)))
    text, (_, hidden) = printed(60, answer), table_of(answer.rows, 60)
    assert "\u2026" not in text and max(map(len, text.splitlines())) <= 60
    assert hidden and all(name in text for name in hidden) and not table_of(answer.rows, 100)[1]
    assert not set(answer.rows[0]) - {*explained(in_line(200, answer, explain=True)), "episode", "deg", "s"}


def test_cells_are_made_of_the_document() -> None:
    """A missing or non-finite value is a dash without a unit; a name wider than the terminal leaves room for numbers
    and is printed to its end.
    """
    content = {"done": None, "off": math.nan, "top": math.inf, "margin": 0.5, "joint": {"share": 0.25}, "unit": "m"}
    layout = "a: {done:.1f} m; b: {off:.1f} mm; c: {top:.0f}; d: {margin:.0%}; e f: {joint[share]:.2f} {unit}"
    assert cells(content, layout) == {"a": "-", "b": "-", "c": "-", "d": "50 %", "e f": "0.25 m"}
    text = printed(60, Answer({}, rows=[{"name": "long " * 30 + "end", "a": "0.1"}]))
    assert "end" in text and "0.1" in text and max(map(len, text.splitlines())) <= 60


def test_learning_explains_its_words() -> None:
    """Each number stands next to its scale, `--explain` explains the terms, and an uncertainty larger than any angle is
    given in words.
    """
    learner = fit(LearnOptions("sawyer", list(DRAWER), frame=FRAME[1]))[0]
    answer = learning_answer(learner.constraints_, learner.reports_)
    text, report = in_line(60, answer), learner.report_
    assert text.startswith("A straight line (a drawer), demonstrated travel 0.") and "direction known to 0.1" in text
    assert f"gap {report.gap:,.0f} (10 is clear)" in text and report.mechanism is not None
    lost = dataclasses.replace(report.mechanism, uncertainty={**report.mechanism.uncertainty, "axis": 1600.0})
    weak = dataclasses.replace(report, gap=9.94, held_out_residual=9e-6, mechanism=lost, uncertainty_deg=None)
    weakly = in_line(60, learning_answer(learner.constraints_, [weak]))
    kept = "The tip can move along x. It looks like a straight line (a drawer); the hand kept its orientation."
    once = in_line(200, learning_answer(learner.constraints_, [dataclasses.replace(report, sentence=kept)]))
    assert once.count("straight line (a drawer)") == 1 and "The hand kept its orientation." in once
    assert "gap 9.9 (weak: 10 is clear)" in weakly and "left out less than 0.001 % of the motion" in weakly
    assert "direction not determined" in weakly and "1.6e+03" not in weakly and "1600" not in weakly
    terms = explained(in_line(60, answer, explain=True))
    assert list(terms) == ["rows", "gap", "left out", "uncertainty", "strength"]


def test_what_keeps_a_rollout_from_its_goal_is_said(held: ml.Constraint, rollout: ml.Rollout) -> None:
    """Still moving or stalled short of the target, off what is held, or beside a target that is not driven."""
    assert "left after 0.2 s, still moving: try a longer --duration" in in_line(80, outcome(held, rollout, -1.0))
    status = (ml.Status.OK,) * 2 + (ml.Status.STALLED,) * (len(rollout) - 2)
    stalled = outcome(held, dataclasses.replace(rollout, status=status), -1.0)
    assert stalled.content["stalled"] and "limits or a singularity block the rest" in printed(200, stalled)
    aim = Aim(distance=0.25, error=0.3, off=0.125, ignored=("x", "rz"), crossed=0.02)
    aimed = outcome(held, rollout, 0.01, aim=aim)
    assert aimed.title == "0.125 off along the held rows, 0.25 m from the point" and not aimed.content["reached"]
    text = printed(200, aimed)
    assert "the hand moved 0.02 along directions that the recordings show to be blocked" in text
    assert "--rows held leaves x, rz of the target free" in text
    assert outcome(held, rollout, 0.01, aim=aim._replace(error=0.01)).content["reached"]
