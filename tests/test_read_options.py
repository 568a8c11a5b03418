"""Reading options: one that matches nothing is an error with near matches, and errors advise what the caller can do."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from case import case
from recording_corpus import CASES, HEADER, TABLE, csv, refusal, write_corpus
from test_cli import DRAWER, FRAME

from manip_learn.cli import main
from manip_learn.commands.command_line import flags_of
from manip_learn.commands.program import program
from manip_learn.constraint.constraint import Constraint
from manip_learn.constraint.features.frame_jacobian import FrameJacobian
from manip_learn.control.controller import ResolvedRateController
from manip_learn.control.simulation import simulate
from manip_learn.errors import RecordingError, advice, advice_for_command
from manip_learn.learning import ConstraintLearner
from manip_learn.learning.audit import audit_episodes
from manip_learn.recordings import load_demonstrations, trajectory_source
from manip_learn.recordings.trajectory_source import RecordingSource
from manip_learn.robot import Robot, load_robot

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
    for option in [{"rename": {"nope": "right_j0"}}, {"ignore_columns": ["nope"]}]:
        with case(option):
            sawyer = load_robot("sawyer")
            features = FrameJacobian(sawyer, FRAME[1], "xyz", "world")
            with pytest.raises(RecordingError, match="nope") as caught:
                ConstraintLearner(features, n_constraints=2).fit(RecordingSource(DRAWER, sawyer, **option))
            assert caught.value.code == "option"
            with pytest.raises(RecordingError, match="nope"):
                audit_episodes(Constraint([[1.0, 0, 0]], features), RecordingSource(DRAWER, sawyer, **option))


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


def test_a_header_may_be_missing_if_names_are_given(planar3: Robot, tmp_path: Path) -> None:
    """A table of bare numbers is read with the caller's names, first line included; their number must fit."""
    path = tmp_path / "bare.csv"
    path.write_text(csv(TABLE).split("\n", 1)[1])
    (demo,) = load_demonstrations(path, planar3, joint_names=["time", "joint3", "joint2", "joint1"])
    with_header = tmp_path / "named.csv"
    with_header.write_text(csv(TABLE))
    np.testing.assert_array_equal(demo.q, load_demonstrations(with_header, planar3)[0].q[:, ::-1])
    assert len(demo) == len(TABLE)
    refusal(path, planar3, match="4 fields and 3 column names", joint_names=["joint1", "joint2", "joint3"])
    refusal(path, planar3, match="no column 'time'", joint_names=["t0", "joint1", "joint2", "joint3"])


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


def test_advice_is_in_the_words_of_the_caller() -> None:
    """A Python argument in Python, a flag on the command line, nothing where the command lacks the flag."""
    assert advice("; pass {}", "rate=10", "--rate 10") == "; pass rate=10"
    with advice_for_command(["--rate"]):
        assert advice("; pass {}", "rate=10", "--rate 10") == "; pass --rate 10"
        assert advice("; pass {}", "x=1", "--x 1") == ""
    assert advice("name {a} {}", "x", "--x") == "name {a} x"


COMMANDS = {
    "learn": ("learn", "planar3", "{}", "--frame", "tip", "--axes", "x y"),
    "replay": ("replay", "planar3", "{}", "--html", "{out}"),
    "audit": ("audit", "planar3", "{constraint}", "{}"),
    "export": ("export", "planar3", "{}", "--out", "{out}.csv"),
}


@pytest.mark.timeout(400)  # many commands
def test_errors_name_only_flags_of_the_command(planar3: Robot, capsys) -> None:
    """Every flag in the text of an error exists for the command that printed it, and Python's words are not used."""
    for command in COMMANDS:
        with case(command) as tmp_path:
            corpus = tmp_path / "corpus"
            write_corpus(corpus)
            constraint = tmp_path / "line.json"
            Constraint([[0.0, 1.0]], FrameJacobian(planar3, "tip", "x y", "world")).save(constraint)
            flags = flags_of(program, [command])
            named = set()
            for path in (corpus / case.name for case in CASES if case.verdict not in ("accept", "note")):
                if not path.is_file():
                    continue
                words = [w.format(path, out=tmp_path / "page.html", constraint=constraint) for w in COMMANDS[command]]
                if main(words) == 0:
                    continue
                said = capsys.readouterr().err
                found = set(re.findall(r"(?<![\w-])--[a-z][a-z-]*", said))
                assert found <= flags, f"{path.name}: {sorted(found - flags)} in {said!r}"
                assert not re.search(r"\w=\[|\w=\{|\w='|=True", said), said
                named |= found
            assert {"--rename", "--outside-limits", "--degrees"} <= named


DEGREES = np.column_stack([TABLE[:, 0], np.degrees(TABLE[:, 1:])])
FAULTS = {
    "a misspelt joint": csv(TABLE, HEADER.replace("joint2", "jiont2")),
    "another name for the time": csv(TABLE, HEADER.replace("time", "my_time")),
    "a column of no joint": csv(np.column_stack([TABLE, TABLE[:, 1]]), HEADER + ",joint11"),
    "degrees": csv(DEGREES),
}


def test_what_an_error_advises_works(capsys) -> None:
    """The flags in the text of an error, typed as they stand there, make the command succeed."""
    for fault in FAULTS:
        for command in ["replay", "export"]:
            with case(fault, command) as tmp_path:
                path = tmp_path / "demo.csv"
                path.write_text(FAULTS[fault])
                words = [w.format(path, out=tmp_path / "page.html", constraint="") for w in COMMANDS[command]]
                assert main(words) == 2
                said = capsys.readouterr().err
                advised = re.findall(
                    r"(?<![\w-])(--[a-z-]+)(?: ([\w./=:-]*\w))?", said.replace("--degrees, or", "--degrees;")
                )
                assert advised, said
                flag, value = advised[0]
                assert main([*words, flag, *([value] if value and flag != "--degrees" else [])]) == 0, (
                    said,
                    capsys.readouterr(),
                )
