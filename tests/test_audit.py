"""The audit: measures are right, odd episodes are named, good ones are left alone; JSON, CSV, streams, dask."""

from __future__ import annotations

import csv
import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
from scale_motions import motions

import manip_learn as ml
from manip_learn.cli import main
from manip_learn.commands.audit import write_table
from manip_learn.errors import OutputError, RecordingError
from manip_learn.learning import audit
from manip_learn.learning.audit import AuditReport, EpisodeAudit
from manip_learn.linalg import orthonormal_rows
from manip_learn.recordings import load as trajectory_source
from manip_learn.recordings.velocities import jerk

TWO = orthonormal_rows(np.array([[1.0, 0.2, 0.3], [-0.3, 0.9, 0.2]]))
DRAWER = Path(__file__).resolve().parents[1] / "examples" / "data" / "sawyer_drawer"


@pytest.fixture(scope="module")
def features() -> ml.FrameJacobian:
    return ml.FrameJacobian(ml.load_robot("sawyer"), "right_gripper_tip", "xyz")


@pytest.fixture(scope="module")
def constraint(features: ml.FrameJacobian) -> ml.Constraint:
    return ml.Constraint(TWO, features)


@pytest.fixture(scope="module")
def demos(features: ml.FrameJacobian) -> ml.Demonstrations:
    return motions(features, TWO, np.random.default_rng(1), 12, noise=0.002, held=True)


def measured(constraint: ml.Constraint, t: ml.Trajectory) -> EpisodeAudit:
    """Measures of one recording."""
    return ml.audit_episodes(constraint, [t], velocities="recorded").episodes[0]


def with_one(demos: ml.Demonstrations, index: int, changed: ml.Trajectory) -> list[ml.Trajectory]:
    return [changed if i == index else t for i, t in enumerate(demos)]


def test_measures_are_those_of_the_constraint(constraint: ml.Constraint, demos: ml.Demonstrations) -> None:
    """Singular values, manipulability and residual are what the constraint's own functions give, sample by sample."""
    t = demos[3]
    row = measured(constraint, t)
    sigma = [np.linalg.svd(constraint(q), compute_uv=False)[-1] for q in t.q]
    assert row.sigma_min == pytest.approx(min(sigma), rel=1e-9)
    assert row.sigma_median == pytest.approx(float(np.median(sigma)), rel=1e-9)
    assert row.manipulability_min == pytest.approx(min(ml.manipulability(constraint, q) for q in t.q), rel=1e-9)
    assert row.residual == pytest.approx(constraint.residual([t]), rel=1e-9)
    assert row.n_samples == len(t) and row.duration == pytest.approx(t.duration)


def test_displacement_is_how_far_the_tip_moves_along_held_rows(features: ml.FrameJacobian) -> None:
    """A tip that moves 30 mm along x and turns 12 degrees about z: that is what is reported, in mm and degrees."""
    robot, target = features.robot, ml.FrameJacobian(features.robot, "right_gripper_tip", "pose")
    time = np.arange(301) * 0.01
    rate = np.zeros(6)
    rate[0], rate[5] = 0.030 / 3.0, np.radians(12.0) / 3.0
    q = [np.array(robot.neutral()) + 0.2]
    u = []
    for _ in time:
        u.append(np.linalg.pinv(target(q[-1])) @ rate)
        middle = q[-1] + 0.005 * u[-1]
        q.append(q[-1] + 0.01 * np.linalg.pinv(target(middle)) @ rate)
    held = ml.Constraint(np.eye(6)[[0, 1, 5]], target)
    row = measured(held, ml.Trajectory(time, np.array(q[:-1]), np.array(u), tuple(robot.joint_names)))
    assert row.displacement_mm == pytest.approx(30.0, rel=1e-3)
    assert row.displacement_deg == pytest.approx(12.0, rel=1e-3)


def test_limits_speed_and_rest(constraint: ml.Constraint) -> None:
    """One joint goes 10 % of its range beyond its limit, at half its speed limit, and rests half of the time."""
    robot = ml.load_robot("sawyer")
    limit, width = robot.position_upper[1], robot.position_upper[1] - robot.position_lower[1]
    time = np.linspace(0.0, 4.0, 401)
    speed = 0.5 * robot.velocity_limit[1]
    way = np.where(time > 2.0, (time - 2.0) * speed, 0.0)
    q, u = np.tile(robot.neutral(), (401, 1)), np.zeros((401, robot.nv))
    q[:, 1], u[:, 1] = limit + 0.1 * width - way[-1] + way, np.where(time > 2.0, speed, 0.0)
    row = measured(constraint, ml.Trajectory(time, q, u, tuple(robot.joint_names)))
    assert row.limit_margin == pytest.approx(-0.1, abs=1e-6) and row.limit_joint == robot.joint_names[1]
    assert 0.0 < row.beyond_limits < 0.5
    assert row.peak_speed == pytest.approx(0.5) and row.peak_speed_joint == robot.joint_names[1]
    assert row.too_fast == 0.0
    assert row.rest_share == pytest.approx(0.5, abs=0.01)


@pytest.mark.parametrize("noise", [0.0, 1e-3])
def test_jerk_is_that_of_the_motion_not_of_the_noise(noise: float, rng: np.random.Generator) -> None:
    """A sinusoid of 0.5 Hz has the jerk a w^3 cos(w t), also through noise whose third difference is far larger."""
    time = np.arange(1000) / 100.0
    a, w = 0.4, np.pi
    x = a * np.sin(w * time)[:, None] * [1.0, 0.5] + noise * rng.standard_normal((1000, 2))
    rms, peak = jerk(time, x)
    size = a * w**3 * np.hypot(1.0, 0.5)
    assert rms == pytest.approx(size / np.sqrt(2.0), rel=0.05)
    assert peak == pytest.approx(size, rel=0.25)
    assert all(np.isnan(jerk(time[:6], x[:6])))


def test_false_alarms_are_rare(constraint: ml.Constraint, demos: ml.Demonstrations, monkeypatch) -> None:
    """Of audits of normally distributed measures, at most about one in twenty leaves anything out."""
    names, least = zip(*((c[0], c[3]) for c in audit.CRITERIA), strict=True)
    scale = np.array([np.exp if x else float for x in least])  # ratios are judged by their logarithms
    good = measured(constraint, demos[0])
    for n in (6, 50):
        rng, alarms = np.random.default_rng(n), 0
        for _ in range(400):
            values = [
                [f(10.0 + x) for f, x in zip(scale, rng.standard_normal(len(names)), strict=True)] for _ in range(n)
            ]
            rows = iter([good._replace(**dict(zip(names, own, strict=True))) for own in values])
            monkeypatch.setattr(audit, "_measure", lambda *_, rows=rows: next(rows))
            alarms += bool(ml.audit_episodes(constraint, [demos[0]] * n, velocities="recorded").leave_out)
        assert alarms <= 36, n  # 5 % and four standard errors
    monkeypatch.undo()
    assert ml.audit_episodes(constraint, demos[:4]).threshold == np.inf


def test_an_episode_that_violates_the_constraint_is_left_out(
    features: ml.FrameJacobian, constraint: ml.Constraint, demos: ml.Demonstrations
) -> None:
    """Episodes of one kind stay, ranked by falling score; one of another task among them is first, left out, and the
    reason is given.
    """
    good = ml.audit_episodes(constraint, demos, velocities="recorded")  # with noise that positions do not have
    scores = [e.score for e in good.episodes]
    assert good.leave_out == () and scores == sorted(scores, reverse=True) and len(scores) == 12
    other = motions(features, TWO[:, [2, 0, 1]], np.random.default_rng(3), 1, noise=0.002, held=True)[0]
    given = with_one(demos, 4, dataclasses.replace(other, name="intruder"))
    report = ml.audit_episodes(constraint, given, velocities="recorded")
    assert [e.episode for e in report.leave_out] == ["intruder"]
    worst = report.episodes[0]
    assert worst.number == 4 and any("violates the constraint" in reason for reason in worst.reasons)
    assert report.to_dict()["leave_out"][0]["number"] == 4


def test_a_shaky_episode_is_left_out(constraint: ml.Constraint, features: ml.FrameJacobian) -> None:
    """A tremor of 5 Hz is jerk, and it is named so."""
    demos = ml.load_demonstrations(DRAWER, features.robot, episodes="0:10")
    t = demos[7]
    tremor = 0.01 * np.sin(2 * np.pi * 5.0 * t.time)[:, None]
    shaken = ml.Trajectory(t.time, t.q + tremor * np.linspace(0.5, 1, t.q.shape[1]), t.u, t.joint_names, "shaky")
    report = ml.audit_episodes(constraint, with_one(demos, 7, shaken))
    assert [e.episode for e in report.leave_out] == ["shaky"]
    assert any("jerky" in reason for reason in report.leave_out[0].reasons)


def test_what_an_audit_cannot_tell_is_said(
    features: ml.FrameJacobian, constraint: ml.Constraint, demos: ml.Demonstrations
) -> None:
    """Rows that the demonstrator moves are not held against an episode; of four nobody can say which is odd; a larger
    chance of false alarms is a smaller threshold; joints of another robot, no recordings and no chance are refused.
    """
    imposed = ml.Constraint(TWO[:, [2, 0, 1]], features, {"kind": "self-imposed"})
    report = ml.audit_episodes(imposed, demos)
    assert not {"violation", "displacement", "rotation"} & set(report.criteria)
    assert any("on purpose" in note for note in report.notes)
    few = ml.audit_episodes(constraint, demos[:4])
    assert few.leave_out == () and any("too few" in note for note in few.notes)
    assert 3.5 <= ml.audit_episodes(imposed, demos, false_alarms=0.9).threshold < report.threshold
    foreign = ml.Trajectory(np.arange(10) * 0.1, np.zeros((10, 7)), np.zeros((10, 7)), tuple("abcdefg"))
    for given, options, code in (
        ([foreign], {}, "joint-names"),
        ([], {}, "empty"),
        (demos, {"false_alarms": 5}, "option"),
    ):
        with pytest.raises(RecordingError) as caught:
            ml.audit_episodes(constraint, given, **options)
        assert caught.value.code == code


def test_read_part_by_part(constraint: ml.Constraint, features: ml.FrameJacobian, tmp_path: Path, monkeypatch) -> None:
    """Files read part by part, one after the other, give the report of the same files in memory."""
    monkeypatch.setattr(trajectory_source, "PART_BYTES", 30_000)
    for i, t in enumerate(motions(features, TWO, np.random.default_rng(5), 9, noise=0.002, held=True)):
        arrays = {"time": t.time, "q": t.q, "u": np.asarray(t.u), "joint_names": np.array(t.joint_names)}
        np.savez(tmp_path / f"demo_{i}.npz", **arrays)  # type: ignore[arg-type]
    source = ml.RecordingSource(tmp_path, features.robot)
    assert source.n_parts > 2
    here = ml.audit_episodes(constraint, ml.load_demonstrations(tmp_path, features.robot))
    told: list[float] = []
    there = ml.audit_episodes(constraint, source, progress=lambda _step, share: told.append(share))
    assert told == sorted(told) and told[-1] == 1.0
    for a, b in zip(here.episodes, there.episodes, strict=True):
        assert (a.number, a.reasons) == (b.number, b.reasons) and a.score == pytest.approx(b.score, rel=1e-9)


def test_command_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """JSON is one document, CSV has one line per episode in the same order, the terminal names what to leave out."""
    file = str(tmp_path / "drawer.json")
    words = ["learn", "sawyer", str(DRAWER), "--frame", "right_gripper_tip", "--reference", "world", "--out", file]
    assert main([*words, "--episodes", "0:10"]) == 0
    capsys.readouterr()
    words = ["audit", "sawyer", file, str(DRAWER), "--episodes", "0:12", "--csv", str(tmp_path / "audit.csv")]
    assert main([*words, "--json"]) == 0
    answer = json.loads(capsys.readouterr().out)
    assert answer["n_episodes"] == 12 and answer["leave_out"] == [] and answer["rule"]["threshold"] > 3.5
    with (tmp_path / "audit.csv").open(newline="") as table:
        rows = list(csv.DictReader(table))
    assert [r["episode"] for r in rows] == [e["episode"] for e in answer["episodes"]]
    assert float(rows[0]["sigma_min"]) == pytest.approx(answer["episodes"][0]["sigma_min"])
    assert main(words) == 0
    assert "leave out 0 of 12 episodes" in capsys.readouterr().out


def test_command_line_errors(tmp_path: Path, capsys: pytest.CaptureFixture[str], constraint: ml.Constraint) -> None:
    """A missing constraint, recordings of another robot, a table that cannot be written: one sentence, exit code 2."""
    assert main(["audit", "sawyer", str(tmp_path / "no.json"), str(DRAWER)]) == 2
    assert "no such file" in capsys.readouterr().err
    file = str(constraint.save(tmp_path / "c.json"))
    assert main(["audit", "planar3", file, str(DRAWER)]) == 2
    assert main(["audit", "sawyer", file, str(DRAWER), "--episodes", "77"]) == 2
    assert "nearest" in capsys.readouterr().err
    with pytest.raises(OutputError):
        write_table(AuditReport((), (), 3.5), tmp_path / "c.json" / "a.csv")
