"""Pictures of results: what was measured is what is drawn, on the axes that were given."""

from __future__ import annotations

import dataclasses
import sys
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from task_sets import sawyer_drawer

import manip_learn as ml
from manip_learn.errors import ManipLearnError, MissingExtraError
from manip_learn.learning import LearningReport

matplotlib = pytest.importorskip("matplotlib", reason="the extra 'plots' is not installed")
matplotlib.use("Agg")

from matplotlib import pyplot as plt  # noqa: E402

from manip_learn import plots  # noqa: E402


@pytest.fixture
def ax() -> Iterator[Any]:
    """Axes of somebody's own figure."""
    figure, axes = plt.subplots()
    yield axes
    plt.close(figure)


@pytest.fixture(scope="module")
def runs() -> dict[str, ml.Rollout]:
    """What was shown once more, with two policies: a line of Python, and nothing."""
    _, demos, learner = sawyer_drawer()
    constraint, start = learner.constraint_, demos[0].q[0]
    policies: dict[str, Any] = {"towards zero": lambda q: -q, "nothing": None}
    task = ml.motion(constraint)
    return {
        name: ml.simulate(
            constraint.robot, ml.ResolvedRateController(constraint, task, policy), start, duration=0.5, dt=0.01
        )
        for name, policy in policies.items()
    }


def report() -> LearningReport:
    return sawyer_drawer()[2].report_


def words(ax: Any) -> set[str]:
    """The legend."""
    return {text.get_text() for text in ax.get_legend().get_texts()}


def test_mu_is_drawn_with_its_status_and_what_was_shown(ax, runs):
    """Each rollout is a curve with its name; a line "singular" at 0; the band of the recordings; the unit of mu."""
    assert plots.manipulability(runs, ax) is ax
    for line, rollout in zip(ax.lines, runs.values(), strict=False):
        assert np.array_equal(line.get_xydata(), np.column_stack([rollout.time, rollout.mu]))
    assert words(ax) == {*runs, "as shown", "singular"}
    assert set(ax.lines[-1].get_ydata()) == {0.0} and ax.get_ylabel() == "manipulability μ [m³]"


def test_the_strip_shows_where_the_arm_was_slowed_down_or_stood(ax, runs):
    """A row below zero for the rollout that did not always move as asked, dark where it stood, as long as it did."""
    run = runs["nothing"]
    halves = dataclasses.replace(run, status=(*[ml.Status.DAMPED] * 20, *[ml.Status.STALLED] * (len(run) - 20)))
    plots.manipulability({"well": dataclasses.replace(run, status=(ml.Status.OK,) * len(run)), "badly": halves}, ax)
    slowed, stopped = (np.concatenate([path.vertices for path in c.get_paths()]) for c in ax.collections)
    assert np.ptp(slowed[:, 0]) == pytest.approx(run.time[20]) and np.ptp(stopped[:, 0]) == pytest.approx(
        run.time[-1] - run.time[20]
    )
    assert max(slowed[:, 1].max(), stopped[:, 1].max()) < 0.0 and ax.get_ylim()[0] < min(slowed[:, 1])
    assert all(tick >= 0.0 for tick in ax.get_yticks())


def test_a_column_of_a_paper_can_be_read(runs):
    """3.5 in wide, all letters 8 pt, names at the curves that do not overlap, nothing outside of the figure."""
    for ax in (
        plots.manipulability({**runs, "again": runs["nothing"]}, style="column"),
        plots.gap(report(), style="column"),
        plots.evidence(report(), style="column"),
    ):
        figure: Any = ax.figure
        figure.canvas.draw()
        assert figure.get_figwidth() == 3.5 and ax.get_legend() is None
        drawn: list[Any] = ax.findobj(matplotlib.text.Text)
        texts = [text for text in drawn if text.get_text() and text.get_visible()]
        assert {text.get_fontsize() for text in texts} <= {8.0}
        boxes = [text.get_window_extent() for text in ax.texts if text.get_text()]
        assert not any(a.overlaps(b) for i, a in enumerate(boxes) for b in boxes[:i])
        assert all(0.0 <= box.x0 and box.x1 <= figure.bbox.width and 0.0 <= box.y0 for box in boxes)
    plt.close("all")
    with pytest.raises(ManipLearnError, match="style must be one of 'page', 'column', not 'poster'"):
        plots.gap(report(), style="poster")  # type: ignore[arg-type]


def test_one_rollout_needs_no_name(ax, runs):
    """One, or a list, without names; and what is no rollout is told."""
    run = runs["nothing"]
    assert words(plots.manipulability(run, ax)) == {"as shown", "singular"}
    assert "rollout 2" in words(plots.manipulability([run, run], ax))
    for wrong in ({}, [], run.constraint, ["run.npz"], report()):
        with pytest.raises(ManipLearnError, match="give plots.manipulability a rollout"):
            plots.manipulability(wrong, ax)  # type: ignore[arg-type]


def test_the_gap_stands_between_held_and_free(ax):
    """Every level is a point, the held ones apart from the free ones, and the gap is written between them."""
    plots.gap(report(), ax)
    held, free = (line.get_ydata() for line in ax.lines[:2])
    assert (*held, *free) == pytest.approx(report().levels) and len(held) == report().n_constraints
    assert any(f"gap {report().gap:.3g}" in text.get_text() for text in ax.texts)


def test_an_estimate_without_levels_shows_a_gap_for_each_number_of_rows(ax):
    """The joint estimator's gaps, a bar each."""
    plots.gap(dataclasses.replace(report(), levels=()), ax)
    assert [bar.get_height() for bar in ax.patches] == pytest.approx(list(report().gap_table.values()))


def test_the_evidence_has_a_row_for_each_row(ax):
    """Strength as a bar, the chance beside it; rows that are not tested so are told."""
    plots.evidence(report(), ax)
    rows = report().row_evidence
    assert [bar.get_width() + 1.0 for bar in ax.patches] == pytest.approx([row.strength for row in rows])
    assert [text.get_text().strip() for text in ax.texts] == [f"p = {row.p_value:.2g}" for row in rows]
    with pytest.raises(ManipLearnError, match="plots.gap"):
        plots.evidence(dataclasses.replace(report(), row_evidence=()), ax)


def test_new_axes_need_matplotlib(monkeypatch, runs):
    """Without axes there are new ones; without matplotlib, one sentence that says what to install."""
    plots.manipulability(runs)
    plt.close("all")
    monkeypatch.setitem(sys.modules, "matplotlib.pyplot", None)
    with pytest.raises(MissingExtraError, match=r"pip install 'manip_learn\[plots\]'"):
        plots.gap(report())


def test_a_notebook_shows_the_same_small(runs, monkeypatch):
    """The cards of a learner and of a rollout have a picture, for which matplotlib is not needed."""
    for name in [name for name in sys.modules if name.partition(".")[0] == "matplotlib"]:
        monkeypatch.setitem(sys.modules, name, None)
    learner = sawyer_drawer()[2]
    assert "held, " in learner._repr_html_() and learner._repr_html_().count("<path") == len(report().levels)
    assert "<polyline" in runs["nothing"]._repr_html_() and "at the least" in runs["nothing"]._repr_html_()
    assert "Nothing is learnt yet" in ml.ConstraintLearner(learner.features)._repr_html_()


def test_a_rollout_is_a_table_of_pandas(runs, monkeypatch):
    """A row per sample under the names of the joints; without pandas one sentence."""
    run = runs["nothing"]
    table = run.to_frame()
    assert list(table["mu"]) == list(run.mu) == list(run.manipulability) and list(table["status"]) == list(run.status)
    assert np.array_equal(table[list(run.joint_names)].to_numpy(), run.q)
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(MissingExtraError, match="pandas"):
        run.to_frame()


def test_a_rollout_knows_its_robot(tmp_path, runs):
    """From the file alone: by its name, or from the file that it was loaded from; a file that is gone is told."""
    again = ml.Rollout.load(runs["nothing"].save(tmp_path / "run.npz")).robot
    assert again is not None and again.load().fingerprint == again.fingerprint
    own = tmp_path / "own.urdf"
    own.write_bytes(ml.load_robot("planar3").source.read_bytes())  # type: ignore[union-attr]
    robot = ml.load_robot(own, locked={"joint3": 0.2})
    constraint = ml.Constraint([[0, 1]], ml.FrameJacobian(robot, "tip", axes="x y"))
    run = ml.simulate(robot, ml.ResolvedRateController(constraint), [0.3, 0.8], duration=0.1)
    kept = ml.Rollout.load(run.save(tmp_path / "own.npz"))
    assert kept.robot is not None and dict(kept.robot.load().locked) == {"joint3": 0.2}
    own.unlink()
    with pytest.raises(ManipLearnError, match=r"own\.urdf"):
        kept.robot.load()
    assert plots.manipulability(kept).lines  # without what was shown
