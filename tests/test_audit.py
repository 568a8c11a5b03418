"""The audit: measures are right, odd episodes are named, good ones are left alone; JSON, CSV, files read in parts."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from scale_motions import TWO, motions
from task_sets import DATA

import manip_learn as ml
from manip_learn.cli import main
from manip_learn.errors import RecordingError
from manip_learn.learning import audit
from manip_learn.learning.audit import EpisodeAudit
from manip_learn.recordings import load as trajectory_source

OTHER = TWO[:, [2, 0, 1]]
DRAWER, TIP = DATA / "sawyer_drawer", "right_gripper_tip"


@pytest.fixture(scope="module")
def constraint(features: ml.FrameJacobian) -> ml.Constraint:
    return ml.Constraint(TWO, features)


def held(features: ml.FrameJacobian, seed: int, n: int, rows: np.ndarray = TWO) -> ml.Demonstrations:
    return motions(features, rows, np.random.default_rng(seed), n, noise=0.002, held=True)


@pytest.fixture(scope="module")
def demos(features: ml.FrameJacobian) -> ml.Demonstrations:
    return held(features, 1, 12)


def measured(constraint: ml.Constraint, t: ml.Trajectory) -> EpisodeAudit:
    """Measures of one recording."""
    return ml.audit_episodes(constraint, [t], velocities="recorded").episodes[0]


def test_displacement_is_how_far_the_tip_moves_along_held_rows(features: ml.FrameJacobian) -> None:
    """A tip that moves 30 mm along x and turns 12 degrees about z: that is what is reported, in mm and degrees."""
    robot, target = features.robot, ml.FrameJacobian(features.robot, TIP, "pose")
    time, rate = np.arange(301) * 0.01, np.array([0.010, 0.0, 0.0, 0.0, 0.0, np.radians(4.0)])
    q, u = [np.array(robot.neutral()) + 0.2], []
    for _ in time:
        u.append(np.linalg.pinv(target(q[-1])) @ rate)
        q.append(q[-1] + 0.01 * np.linalg.pinv(target(q[-1] + 0.005 * u[-1])) @ rate)
    tip = ml.Constraint(np.eye(6)[[0, 1, 5]], target)
    row = measured(tip, ml.Trajectory(time, np.array(q[:-1]), np.array(u), tuple(robot.joint_names)))
    assert row.displacement_mm == pytest.approx(30.0, rel=1e-3)
    assert row.displacement_deg == pytest.approx(12.0, rel=1e-3)


def test_limits_speed_and_rest(constraint: ml.Constraint) -> None:
    """One joint goes 10 % of its range beyond its limit, at half its speed limit, and rests half of the time."""
    robot, time = constraint.robot, np.linspace(0.0, 4.0, 401)
    limit, width = robot.position_upper[1], robot.position_upper[1] - robot.position_lower[1]
    speed = 0.5 * robot.velocity_limit[1]
    way = np.where(time > 2.0, (time - 2.0) * speed, 0.0)
    q, u = np.tile(robot.neutral(), (401, 1)), np.zeros((401, robot.nv))
    q[:, 1], u[:, 1] = limit + 0.1 * width - way[-1] + way, np.where(time > 2.0, speed, 0.0)
    row = measured(constraint, ml.Trajectory(time, q, u, tuple(robot.joint_names)))
    assert row.limit_margin == pytest.approx(-0.1, abs=1e-6) and row.limit_joint == robot.joint_names[1]
    assert 0.0 < row.beyond_limits < 0.5 and row.too_fast == 0.0
    assert row.peak_speed == pytest.approx(0.5) and row.peak_speed_joint == robot.joint_names[1]
    assert row.rest_share == pytest.approx(0.5, abs=0.01)


def test_false_alarms_are_rare(constraint: ml.Constraint, demos: ml.Demonstrations, monkeypatch) -> None:
    """Of audits of normally distributed measures, at most about one in twenty leaves anything out."""
    scales = {c[0]: np.exp if c[3] else float for c in audit.CRITERIA}  # ratios are judged by their logarithms
    good, rng, alarms = measured(constraint, demos[0]), np.random.default_rng(6), 0

    def drawn(*_given) -> EpisodeAudit:
        return good._replace(**{name: scale(10.0 + rng.standard_normal()) for name, scale in scales.items()})

    monkeypatch.setattr(audit, "_measure", drawn)
    for _ in range(400):
        alarms += bool(ml.audit_episodes(constraint, [demos[0]] * 6, velocities="recorded").leave_out)
    assert alarms <= 36  # 5 % and four standard errors


def test_small_differences_do_not_matter(constraint: ml.Constraint, demos: ml.Demonstrations, monkeypatch) -> None:
    """Where episodes are alike, scores are in units of 10 % of a measure, or of 5 points of a share."""
    good = measured(constraint, demos[0])._replace(duration=1.0, rest_share=0.2)
    rows = iter([good] * 8 + [good._replace(duration=1.2, rest_share=0.3)])
    monkeypatch.setattr(audit, "_measure", lambda *_: next(rows))
    report = ml.audit_episodes(constraint, [demos[0]] * 9, velocities="recorded")
    assert report.leave_out == () and report.episodes[0].number == 8
    assert report.episodes[0].score == pytest.approx(np.hypot(np.log(1.2) / 0.1, 0.1 / 0.05))


def test_an_odd_episode_is_left_out(features, constraint: ml.Constraint, demos: ml.Demonstrations) -> None:
    """Episodes of one kind stay, ranked by falling score; one of another task, or with a tremor of 5 Hz, among them is
    first, left out, and the reason is given.
    """
    good = ml.audit_episodes(constraint, demos, velocities="recorded")  # with noise that positions do not have
    scores = [e.score for e in good.episodes]
    assert good.leave_out == () and scores == sorted(scores, reverse=True) and len(scores) == 12
    intruder = held(features, 3, 1, OTHER)[0]
    drawers = ml.load_demonstrations(DRAWER, features.robot, episodes="0:10")
    tremor = 0.01 * np.sin(2 * np.pi * 5.0 * drawers[4].time)[:, None] * np.linspace(0.5, 1, 7)
    shaken = dataclasses.replace(drawers[4], q=drawers[4].q + tremor)
    for given, odd, words in ((demos, intruder, "violates the constraint"), (drawers, shaken, "jerky")):
        some = [dataclasses.replace(odd, name="odd") if i == 4 else t for i, t in enumerate(given)]
        report = ml.audit_episodes(constraint, some, velocities="recorded" if given is demos else "auto")
        assert [e.episode for e in report.leave_out] == ["odd"] and report.episodes[0].number == 4
        assert any(words in reason for reason in report.episodes[0].reasons)
        assert report.to_dict()["leave_out"][0]["number"] == 4


def test_what_an_audit_cannot_tell_is_said(features, constraint: ml.Constraint, demos: ml.Demonstrations) -> None:
    """Rows that the demonstrator moves are not held against an episode; of four nobody can say which is odd; a larger
    chance of false alarms is a smaller threshold; joints of another robot, no recordings and no chance are refused.
    """
    imposed = ml.Constraint(OTHER, features, {"kind": "self-imposed"})
    report, few = ml.audit_episodes(imposed, demos), ml.audit_episodes(constraint, demos[:4])
    assert not {"violation", "displacement", "rotation"} & set(report.criteria)
    assert "demonstrator drives" in " ".join(report.notes)
    assert few.leave_out == () and few.threshold == np.inf and "too few" in " ".join(few.notes)
    assert 3.5 <= ml.audit_episodes(imposed, demos, false_alarms=0.9).threshold < report.threshold
    foreign = ml.Trajectory(np.arange(10) * 0.1, np.zeros((10, 7)), np.zeros((10, 7)), tuple("abcdefg"))
    for given, chance, code in (([foreign], 0.05, "joint-names"), ([], 0.05, "empty"), (demos, 5, "option")):
        with pytest.raises(RecordingError) as caught:
            ml.audit_episodes(constraint, given, false_alarms=chance)
        assert caught.value.code == code


def test_read_part_by_part(constraint: ml.Constraint, features: ml.FrameJacobian, monkeypatch) -> None:
    """Files read part by part, one after the other, give the report of the same files in memory."""
    files, shares = sorted(DRAWER.glob("*.csv"))[:6], []
    here = ml.audit_episodes(constraint, ml.load_demonstrations(files, features.robot))
    monkeypatch.setattr(trajectory_source, "PART_BYTES", 30_000)
    source = ml.RecordingSource(files, features.robot)
    assert source.n_parts > 2
    there = ml.audit_episodes(constraint, source, progress=lambda _step, share: shares.append(share))
    assert here.episodes == there.episodes and shares == sorted(shares) and shares[-1] == 1.0


def test_command_line(tmp_path: Path, capsys: pytest.CaptureFixture[str], constraint: ml.Constraint) -> None:
    """JSON is one document, CSV has one line per episode in the same order; missing recordings give exit code 2."""
    file, table = str(constraint.save(tmp_path / "drawer.json")), tmp_path / "audit.csv"
    words = ["audit", "sawyer", file, str(DRAWER), "--csv", str(table), "--episodes"]
    assert main([*words, "0:12", "--json"]) == 0
    answer = json.loads(capsys.readouterr().out)
    assert answer["n_episodes"] == 12 and answer["leave_out"] == [] and answer["rule"]["threshold"] > 3.5
    rows = pd.read_csv(table)
    assert rows.episode.tolist() == [e["episode"] for e in answer["episodes"]]
    assert rows.sigma_min[0] == pytest.approx(answer["episodes"][0]["sigma_min"])
    assert main([*words, "77"]) == 2 and "nearest" in capsys.readouterr().err
