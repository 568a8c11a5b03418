"""Pictures of results: what was measured is what is drawn, on the axes that were given, and in a notebook's cards."""

from __future__ import annotations

import dataclasses
import sys
from collections.abc import Iterator
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest
from task_sets import sawyer_drawer

import manip_learn as ml
from manip_learn.errors import ManipLearnError, MissingExtraError
from manip_learn.robot import html_card
from manip_learn.robot.robot import Robot

matplotlib = pytest.importorskip("matplotlib", reason="the extra 'plots' is not installed")
matplotlib.use("Agg")

from matplotlib import pyplot as plt  # noqa: E402

from manip_learn import plots  # noqa: E402


@pytest.fixture
def ax() -> Iterator[Any]:
    """Axes of somebody's own figure."""
    figure, axes = plt.subplots()
    yield axes
    plt.close("all")


@pytest.fixture(scope="module")
def runs() -> dict[str, ml.Rollout]:
    """The demonstrated motion with two policies: a line of Python, and none."""
    robot, demos, learner = sawyer_drawer()
    policies: dict[str, Any] = {"towards zero": lambda q: -q, "nothing": None}
    task, start = ml.motion(learner.constraint_), demos[0].q[0]
    laws = {n: ml.ResolvedRateController(learner.constraint_, task, policy) for n, policy in policies.items()}
    return {name: ml.simulate(robot, law, start, duration=0.5, dt=0.01) for name, law in laws.items()}


def words(ax: Any) -> set[str]:
    """The legend."""
    return {text.get_text() for text in ax.get_legend().get_texts()}


def test_mu_is_drawn_with_its_name_and_unit(ax, runs):
    """Each rollout is a named curve; a line "singular" is at 0, and a band shows the demonstrations. One rollout or a
    list needs no names; anything else is refused.
    """
    assert plots.manipulability(runs, ax) is ax
    for line, rollout in zip(ax.lines, runs.values(), strict=False):
        assert np.array_equal(line.get_xydata(), np.column_stack([rollout.time, rollout.mu]))
    assert words(ax) == {*runs, "as shown", "singular"}
    assert set(ax.lines[-1].get_ydata()) == {0.0} and ax.get_ylabel() == "manipulability μ [m³]"
    run = runs["nothing"]
    assert words(plots.manipulability(run, plt.subplots()[1])) == {"as shown", "singular"}
    assert "rollout 2" in words(plots.manipulability([run, run], ax))
    nobodys = plots.manipulability(dataclasses.replace(run, constraint=None), plt.subplots()[1])
    assert nobodys.get_ylabel() == "manipulability μ" and words(nobodys) == {"singular"}
    for wrong in ({}, [], run.constraint, ["run.npz"], sawyer_drawer()[2].report_):
        with pytest.raises(ManipLearnError, match="give plots.manipulability a rollout"):
            plots.manipulability(wrong, ax)  # type: ignore[arg-type]


def test_a_strip_shows_where_the_arm_was_slowed_down_or_stopped(ax, runs):
    """Below zero, a rollout has a strip as long as it was slowed down and one as long as it was stopped."""
    run = runs["nothing"]
    status = (*[ml.Status.DAMPED] * 20, *[ml.Status.STALLED] * (len(run) - 20))
    plots.manipulability(dataclasses.replace(run, status=status), ax)
    slowed, stopped = (np.concatenate([path.vertices for path in c.get_paths()]) for c in ax.collections[-2:])
    lengths = [np.ptp(strip[:, 0]) for strip in (slowed, stopped)]
    assert lengths == pytest.approx([run.time[20], run.time[-1] - run.time[20]])
    assert max(slowed[:, 1].max(), stopped[:, 1].max()) < 0.0


def test_a_figure_for_the_column_of_a_paper(runs):
    """It is 3.5 in wide, all letters have 8 pt, and names are at the curves; another style is refused."""
    report = sawyer_drawer()[2].report_
    for draw, content in ((plots.manipulability, runs), (plots.gap, report), (plots.evidence, report)):
        column: Any = draw(content, style="column")  # type: ignore[operator]
        column.figure.canvas.draw()
        assert column.figure.get_figwidth() == 3.5 and column.get_legend() is None
        texts = [text for text in column.findobj(matplotlib.text.Text) if text.get_text() and text.get_visible()]
        assert {text.get_fontsize() for text in texts} <= {8.0}
    with pytest.raises(ManipLearnError, match="style must be one of 'page', 'column', not 'poster'"):
        plots.gap(report, style="poster")  # type: ignore[arg-type]
    with pytest.raises(ManipLearnError, match="give the report of a learner.*not the class Robot"):
        plots.gap(ml.Robot)  # type: ignore[arg-type]


def test_gap_and_evidence_show_the_numbers_of_the_report(ax):
    """Every level is a point, held and free ones apart, with the gap between them; without levels there is a bar for
    each number of rows. Strengths are bars with their p-values; a report without row tests is refused.
    """
    report = sawyer_drawer()[2].report_
    plots.gap(report, ax)
    held, free = (line.get_ydata() for line in ax.lines[:2])
    assert (*held, *free) == pytest.approx(report.levels) and len(held) == report.n_constraints
    assert any(f"gap {report.gap:.3g}" in text.get_text() for text in ax.texts)
    bars = plots.gap(dataclasses.replace(report, levels=()), plt.subplots()[1]).patches
    assert [bar.get_height() for bar in bars] == pytest.approx(list(report.gap_table.values()))
    ax = plots.evidence(report, plt.subplots()[1])
    assert [bar.get_width() + 1.0 for bar in ax.patches] == pytest.approx([row.strength for row in report.row_evidence])
    assert [text.get_text().strip() for text in ax.texts] == [f"p = {row.p_value:.2g}" for row in report.row_evidence]
    with pytest.raises(ManipLearnError, match="plots.gap"):
        plots.evidence(dataclasses.replace(report, row_evidence=()), ax)


def test_a_rollout_is_a_table_and_missing_extras_are_named(monkeypatch, runs):
    """A row per sample under the names of the joints; without pandas or matplotlib, what to install."""
    run = runs["nothing"]
    table = run.to_frame()
    assert list(table["mu"]) == list(run.mu) == list(run.manipulability) and list(table["status"]) == list(run.status)
    assert np.array_equal(table[list(run.joint_names)].to_numpy(), run.q)
    for module, made in (("pandas", run.to_frame), ("matplotlib.pyplot", lambda: plots.manipulability(runs))):
        monkeypatch.setitem(sys.modules, module, None)
        with pytest.raises(MissingExtraError, match=rf"pip install .*{'plots' if '.' in module else 'pandas'}"):
            made()


def test_a_rollout_knows_its_robot(tmp_path, runs):
    """The file of a rollout leads to its robot, by name or description file; a missing description is named."""
    again = ml.Rollout.load(runs["nothing"].save(tmp_path / "run.npz")).robot
    assert again is not None and again.load().fingerprint == again.fingerprint
    own = tmp_path / "own.urdf"
    own.write_bytes(ml.load_robot("planar3").source.read_bytes())  # type: ignore[union-attr]
    robot = ml.load_robot(own, locked={"joint3": 0.2})
    constraint = ml.Constraint([[0, 1]], ml.FrameJacobian(robot, "tip", axes="x y"))
    run = ml.simulate(robot, ml.ResolvedRateController(constraint), [0.3, 0.8], duration=0.1)
    kept = ml.Rollout.load(run.save(tmp_path / "own.npz")).robot
    assert kept is not None and dict(kept.load().locked) == {"joint3": 0.2}
    own.unlink()
    with pytest.raises(ManipLearnError, match=r"own\.urdf"):
        kept.load()


def test_a_notebook_shows_the_facts(runs, monkeypatch):
    """Each card is balanced HTML with its main facts, and has its picture without matplotlib."""
    for name in [name for name in sys.modules if name.partition(".")[0] == "matplotlib"]:
        monkeypatch.setitem(sys.modules, name, None)
    robot, demos, learner = sawyer_drawer()
    for content, expected in (
        (ml.load_robot("sawyer", locked={"right_j6": 0.5}), "Robot sawyer|right_j0|rad/s|locked: right_j6 at 0.5"),
        (demos, "6 recordings|without velocities|demo_01.csv|100"),
        (learner.report_, "The tip can move along|10 is clear|degrees|Gap for each number of rows|demo_06.csv"),
        (learner, "<path|held, "),
        (ml.ConstraintLearner(learner.features), "Nothing is learnt yet"),
        (learner.constraint_, "2 of 3 rows|row of Λ|FrameJacobian"),
        (runs["nothing"], "<polyline|51 samples over 0.5 s|right_gripper_tip|error at the end|at the least"),
    ):
        card: str = content._repr_html_()  # type: ignore[attr-defined]
        text = " ".join(ElementTree.fromstring(f"<div>{card}</div>").itertext())  # every element is closed
        assert all(word in text or word in card for word in expected.split("|")), text


def test_names_cannot_become_markup_or_move_the_cursor():
    """Names and warnings are escaped in cards, and control characters of the terminal are replaced everywhere."""
    for character in ("\x1b", "\x07", "\x85", "\u202e", "\ud800"):
        hostile = f"a{character}[31mb"
        robot = Robot(ml.load_robot("planar3").pinocchio_model, name=hostile, warnings=[hostile], locked={hostile: 1.0})
        assert robot.warnings == (f"a{ascii(character)[1:-1]}[31mb",)
        assert all(character not in text for text in (repr(robot), robot._repr_html_()))
    card = html_card.card("<b>x", html_card.facts([("<script>", "a & b")]), html_card.warnings(["<i>"]))
    assert "<script>" not in card and "".join(ElementTree.fromstring(card).itertext()).count("<") == 3
