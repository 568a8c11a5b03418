"""Reading options: one that matches nothing is an error with near matches, and errors advise what the caller can do."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from case import case
from recording_corpus import HEADER, TABLE, csv, refusal
from test_cli import DRAWER, FRAME

from manip_learn.cli import main
from manip_learn.constraint.constraint import Constraint
from manip_learn.constraint.features.frame_jacobian import FrameJacobian
from manip_learn.control.controller import ResolvedRateController
from manip_learn.control.simulation import simulate
from manip_learn.errors import RecordingError
from manip_learn.learning import ConstraintLearner
from manip_learn.learning.audit import audit_episodes
from manip_learn.recordings import load as trajectory_source
from manip_learn.recordings import load_demonstrations
from manip_learn.recordings.load import RecordingSource
from manip_learn.robot import Robot, load_robot

NOPE = {"nope": "right_j0"}
UNMATCHED = {
    "rename an unknown column": ({"rename": {"jiont1": "joint1"}}, "'jiont1'.*did you mean 'joint1'"),
    "rename to an unknown joint": ({"rename": {"extra": "jiont1"}}, "no joint 'jiont1'.*did you mean 'joint1'"),
    "ignore an unknown column": ({"ignore_columns": ["ti"]}, "nothing in the recordings is called 'ti'.*'time'"),
    "a topic of a table": ({"topics": ["/joint_states"]}, "none of the recordings is one"),
    "names beside a header": ({"joint_names": ["a", "b", "c"]}, "name their columns or joints themselves"),
    "a feature of a table": ({"feature": "qpos"}, "features are those of LeRobot data sets"),
}


@pytest.fixture
def table(tmp_path: Path) -> Path:
    """A text table with a header."""
    path = tmp_path / "demo.csv"
    path.write_text(csv(TABLE))
    return path


def test_an_option_that_matches_nothing_is_an_error(planar3: Robot, table: Path) -> None:
    """A misspelt name must not pass as if it had been obeyed."""
    for name, (options, wanted) in UNMATCHED.items():
        with case(name):
            assert refusal(table, planar3, match=wanted, **options).code == "option"


def test_an_option_may_match_in_one_file_only(planar3: Robot, tmp_path: Path) -> None:
    """A renaming that one file of a set needs is no mistake in the others, however they are read."""
    (tmp_path / "demo_1.csv").write_text(csv(TABLE))
    (tmp_path / "demo_2.csv").write_text(csv(TABLE, HEADER.replace("joint2", "elbow")))
    options = {"rename": {"elbow": "joint2"}}
    assert len(load_demonstrations(tmp_path, planar3, **options)) == 2
    source = RecordingSource(tmp_path, planar3, **options)
    assert sum(len(list(source.part(i))) for i in range(source.n_parts)) == 2


def test_recordings_read_in_parts_are_judged_together(monkeypatch: pytest.MonkeyPatch) -> None:
    """Recordings larger than memory: refused if no part had a use for the option, learning and auditing alike."""
    monkeypatch.setattr(trajectory_source, "PART_BYTES", 1)
    sawyer = load_robot("sawyer")
    features, source = FrameJacobian(sawyer, FRAME[1], "xyz", "world"), RecordingSource(DRAWER[:3], sawyer, rename=NOPE)
    for judge in (
        lambda: ConstraintLearner(features, n_constraints=2).fit(source),
        lambda: audit_episodes(Constraint([[1.0, 0, 0]], features), source),
    ):
        with pytest.raises(RecordingError, match="nope") as caught:
            judge()
        assert caught.value.code == "option"


def test_another_robot_is_suspected() -> None:
    """Columns that are no joints of the robot: first the robot is doubted, and the shipped one named that they fit."""
    for robot, header, said in [
        ("sawyer", HEADER, "it was recorded with 'planar3', not 'sawyer': name that robot"),
        ("sawyer", "time,left_a,left_b,left_c", "was it recorded with another robot than 'sawyer'?"),
        ("planar3", "time,q1,q2,q3", "another robot than 'planar3'? Then name that one; if it is this one, columns="),
    ]:
        with case(robot, header, said) as tmp_path:
            (tmp_path / "demo.csv").write_text(csv(TABLE, header))
            error = refusal(tmp_path, load_robot(robot))
            assert said in str(error) and "lock" not in str(error)


def test_columns_are_ignored_in_every_format(planar3: Robot, tmp_path: Path) -> None:
    """An ignored joint is as good as not recorded, in an archive too."""
    path = tmp_path / "demo.npz"
    np.savez(path, time=TABLE[:, 0], q=TABLE[:, [1, 2, 3, 3]], joint_names=["joint1", "joint2", "joint3", "copy"])
    refusal(path, planar3, match="no joint of robot 'planar3' matches this column")
    assert len(load_demonstrations(path, planar3, ignore_columns=["copy"])) == 1
    refusal(path, planar3, match="nothing is recorded for joint 'joint1'", ignore_columns=["copy", "joint1"])


def test_a_replay_reads_its_recordings_together(tmp_path: Path, capsys) -> None:
    """A renaming for one of the files is no mistake in the other; for rollouts there is nothing to rename."""
    (tmp_path / "demo_1.csv").write_text(csv(TABLE))
    (tmp_path / "demo_2.csv").write_text(csv(TABLE, HEADER.replace("joint2", "elbow")))
    files = [str(tmp_path / f"demo_{i}.csv") for i in (1, 2)]
    page = ["--html", str(tmp_path / "page.html")]
    assert main(["replay", "planar3", *files, *page, "--rename", "elbow=joint2"]) == 0
    assert main(["replay", "planar3", *files[:1], *page, "--rename", "elbow=joint2"]) == 2
    assert "nothing in the recordings is called 'elbow'" in capsys.readouterr().err


def test_options_for_rollouts_are_refused_as_typed(tmp_path: Path, capsys) -> None:
    """A rollout is read as it was written: an option for recordings would be ignored in silence."""
    arm = load_robot("planar3")
    constraint = Constraint([[0.0, 1.0]], FrameJacobian(arm, "tip", "x y", "world"))
    path = tmp_path / "run.npz"
    simulate(arm, ResolvedRateController(constraint), [0.1, 0.5, 0.5], duration=0.2, dt=0.05).save(path)
    for words in (["--degrees"], ["--ignore-column", "x"], ["--topic", "/x"]):
        assert main(["replay", "planar3", str(path), "--html", str(tmp_path / "page.html"), *words]) == 2
        assert f"so {words[0]} has no use" in capsys.readouterr().err
