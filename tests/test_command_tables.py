"""What the commands print: readable on 60 columns, with every term explained on demand."""

from __future__ import annotations

import dataclasses
import io
import math
from types import SimpleNamespace

import numpy as np
import pytest
from rich.console import Console
from test_cli import DRAWER, FRAME

from manip_learn.commands.control import Aim, Controlled
from manip_learn.commands.learn import LearntTask, learn_task
from manip_learn.commands.options import LearnOptions
from manip_learn.commands.tables import (
    AUDIT_TERMS,
    MEASURES,
    ROLLOUT_TERMS,
    WORDS,
    audit_table,
    print_controlled,
    print_learnt,
    print_replayed,
)
from manip_learn.constraint.constraint import Constraint
from manip_learn.constraint.features.frame_jacobian import FrameJacobian
from manip_learn.control.command import Status
from manip_learn.control.controller import ResolvedRateController
from manip_learn.control.simulation import WayDone, simulate
from manip_learn.learning.audit import EpisodeAudit, audit_episodes
from manip_learn.recordings.load import RecordingSource
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
    """No line is wider than the terminal, nothing is cut, every term of the table is explained if that is asked for."""
    text = printed(width, print_controlled, controlled)
    assert text.count("--explain") == 1
    at_length = printed(width, print_controlled, controlled, explain=True)
    assert max(map(len, at_length.splitlines())) <= width
    assert "\u2026" not in text and max(map(len, text.splitlines())) <= width
    assert "unhindered" in text and f"{controlled.rollout.manipulability.mean():.3f}" in text
    words = " ".join(at_length.split())
    assert all(f"{term}: {WORDS[term]}" in words for term in ROLLOUT_TERMS)


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
        assert header == ["episode", *(name for name in MEASURES if name not in hidden)]
    assert not hidden
    assert all(term in WORDS for term in AUDIT_TERMS)


@pytest.fixture(scope="module")
def learnt() -> LearntTask:
    """The drawer."""
    return learn_task(LearnOptions("sawyer", list(DRAWER), frame=FRAME[1]))


def test_learning_explains_its_words(learnt: LearntTask) -> None:
    """A number has its scale beside it, and --explain says what the words mean, each once."""
    text = " ".join(printed(60, print_learnt, learnt).split())
    assert text.startswith("A straight line (a drawer), moved 0.")
    report, held = learnt.report, [row for row in learnt.report.row_evidence if row.state == "held"]
    strengths = " and ".join(f"{row.strength:.3g}" for row in held)
    for fact in (
        f"number of rows 2 of 3, gap {report.gap:,.0f} (10 is clear)",
        f"left out {100 * report.held_out_residual:.2g} % of the motion unexplained",
        f"strength {strengths}, p = {max(row.p_value for row in held):.2g} (recombination test)",
        f"learnt from {report.n_samples:,} samples of 6 recordings in {report.seconds:.2g} s",
    ):
        assert fact in text
    weak = dataclasses.replace(report, gap=9.94, held_out_residual=9e-6)
    weakly = " ".join(printed(60, print_learnt, dataclasses.replace(learnt, reports=(weak,))).split())
    assert "gap 9.9 (weak: 10 is clear)" in weakly and "left out less than 0.001 % of the motion" in weakly
    at_length = " ".join(printed(60, print_learnt, learnt, explain=True).split())
    for term in ("row", "gap", "left out", "uncertainty", "strength"):
        assert at_length.count(f"{term}: {WORDS[term]}") == 1 and WORDS[term] not in text


def test_an_axis_that_nothing_determines_has_no_angle(learnt: LearntTask) -> None:
    """An uncertainty beyond any angle is said in words: +- 1,600 degrees means nothing to a reader."""
    found = learnt.report.mechanism
    assert found is not None and "direction known to 0.1" in printed(100, print_learnt, learnt)
    lost = dataclasses.replace(found, uncertainty={**found.uncertainty, "axis": 1600.0})
    report = dataclasses.replace(learnt.report, mechanism=lost, uncertainty_deg=None)
    text = printed(100, print_learnt, dataclasses.replace(learnt, reports=(report, *learnt.reports[1:])))
    assert "direction not determined" in text and "1.6e+03" not in text and "1600" not in text


def test_units_are_printed_with_their_numbers(controlled: Controlled) -> None:
    """Lengths in m and mm, angles in degrees, times in s, shares in percent; red where the hand strays."""
    way = WayDone(0.3, 0.2, "m", 0.5, 12.34, 0.0015, 0.1234, ("joint2", 0.421), "a limit")
    told = dataclasses.replace(controlled, way=way, verb="opened")
    assert told.sentence == "opened 0.200 of 0.300 m" and not told.reached
    text = printed(80, print_controlled, told)
    for cells in ("opened 0.200 m", "time 12.3 s", "off 1.5 mm", "fastest 42 %", "least mu 0.123"):
        assert cells in " ".join(text.split())
    assert "stopped by a limit" in text and "strayed 1.5" not in text
    turned = dataclasses.replace(way, wanted=-math.pi, done=-math.pi / 2, unit="rad", seconds=None, deviation=0.0035)
    told = dataclasses.replace(controlled, way=turned, verb="turned")
    assert told.sentence == "turned 90.0 of 180.0 degrees"
    text = " ".join(printed(80, print_controlled, told).split())
    assert "turned 90.0 deg" in text and "time - " in text and "the hand strayed 3.5 mm from what holds it" in text
    r = controlled.rollout
    text = " ".join(printed(80, print_controlled, controlled).split())
    expected = (
        f"error {r.task_error[-1]:.4f} min mu {r.manipulability[2:].min():.4f} mean mu {r.manipulability.mean():.3f}"
    )
    share = 100.0 * r.status.count("ok") / len(r)
    assert f"{expected} peak {abs(r.u).max():.2f}/s unhindered {share:.0f} %" in text
    values = dict.fromkeys(EpisodeAudit._fields, 0.5)
    episode = EpisodeAudit(**values | {"episode": "a", "reasons": ("odd",), "limit_margin": float("nan")})
    table, _ = audit_table([episode], 100)
    out = printed(100, lambda console, t: console.print(t), table).split()
    cells = "0.5 0.500 50.0 % 0.5 0.5 - 50 % 0.5 50 % 0.5"
    assert " ".join(out[-len(cells.split()) :]) == cells
    report = SimpleNamespace(html="a.html", bytes=1_234_567, notes=("n",))
    assert printed(80, print_replayed, report).split("\n")[:2] == ["note: n", "replay: a.html (1.2 MB)"]


def test_what_keeps_a_rollout_from_its_goal_is_said(controlled: Controlled) -> None:
    """Still moving or stalled short of the target, off what is held, or beside a target that is not driven."""
    text = " ".join(printed(80, print_controlled, dataclasses.replace(controlled, tolerance=-1.0)).split())
    assert "left after 0.2 s, still moving: try a longer --duration" in text
    status = (Status.OK,) * 2 + (Status.STALLED,) * (len(controlled.rollout) - 2)
    stalled = dataclasses.replace(
        controlled, rollout=dataclasses.replace(controlled.rollout, status=status), tolerance=-1.0
    )
    assert stalled.stalled and "limits or a singularity block the rest" in printed(200, print_controlled, stalled)
    aim = Aim(distance=0.25, error=0.3, off=0.125, ignored=("x", "rz"), crossed=0.02)
    aimed = dataclasses.replace(controlled, aim=aim, place="line")
    assert aimed.sentence == "0.125 off the line, 0.25 m from the point" and not aimed.reached
    text = printed(200, print_controlled, aimed)
    assert "the hand moved 0.02 along what the recordings show to be blocked" in text
    assert "--rows held leaves x, rz of the target free" in text
    beside = dataclasses.replace(aimed, aim=dataclasses.replace(aim, off=0.01, distance=None))
    assert beside.sentence == "on the line, 0.3 from the target"
    assert dataclasses.replace(aimed, aim=dataclasses.replace(aim, error=0.01)).reached
