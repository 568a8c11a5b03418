"""What validation of a robot description says, next to the verdicts of the corpus."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from urdf_corpus import corpus
from urdf_corpus_case import ARM, edited

from manip_learn.errors import RobotError
from manip_learn.robot import loading
from manip_learn.robot.description.validation import validate_urdf
from manip_learn.robot.loading import robot_from_text

PATH = Path("some/arm.urdf")


def refusal(content: bytes) -> RobotError:
    """The error that a description gives."""
    with pytest.raises(RobotError) as caught:
        validate_urdf(content, PATH)
    return caught.value


def test_an_error_says_what_where_found_expected_and_remedy():
    """The message has file, line, joint, value found, value expected and remedy; the error has code, path and line."""
    error = refusal(edited(('lower="-2" upper="2.5"', 'lower="-180" upper="90"')))
    assert (error.code, error.path, error.line) == ("limit-degrees", PATH, 11)
    sentence = str(error)
    for part in ("some/arm.urdf:11", "'shoulder'", "-180 ... 90", "radians", "-3.1416 ... 1.5708"):
        assert part in sentence
    assert "\n" not in sentence


def test_lines_are_those_of_the_element():
    """The line is that of the number, not of the joint it belongs to."""
    assert refusal(edited(('<axis xyz="0 1 0"/>', '<axis xyz="0 0 0"/>'))).line == 15
    assert refusal(edited(('rpy="0 0 0.1"', 'rpy="0 0 one"'))).line == 10


def test_misspelt_names_are_answered_with_near_ones():
    """Unknown links, leaders and joint types name what was probably meant."""
    assert "'upper'" in str(refusal(edited(('<parent link="upper"/>', '<parent link="uper"/>'))))
    assert "'revolute'" in str(refusal(edited(('type="revolute"', 'type="revolut"'))))
    assert "'shoulder'" in str(refusal(edited(('effort="20"/>', 'effort="20"/><mimic joint="sholder"/>'))))


def test_xacro_in_a_urdf_says_how_to_load_it():
    """The commonest mistake of all: a macro file under the name of a description."""
    assert "xacro=True" in str(refusal(edited(("0 0 0.3", "0 0 ${height}"))))


def test_all_refusals_of_the_corpus_are_sentences(tmp_path):
    """One line, not longer than 600 characters, naming the file."""
    for i, case in enumerate(c for c in corpus() if c.verdict.startswith("refuse:") and c.content and not c.special):
        if len(case.content) > 1_000_000 or case.options:
            continue
        try:
            validate_urdf(case.content, tmp_path / "x.urdf")
        except RobotError as error:
            text = str(error)
            assert str(tmp_path / "x.urdf") in text, case.name
            assert "\n" not in text and len(text) - len(str(tmp_path)) < 600, f"{i} {case.name}: {text}"


def test_what_the_c_library_says_is_kept(monkeypatch):
    """Words on the C library's stderr become warnings of the robot; nothing is printed."""
    built = loading.pin.buildModelFromXML

    def chatty(*arguments):
        import os

        os.write(2, b"Warning:   the joint is odd\n         at line 7\n")
        return built(*arguments)

    monkeypatch.setattr(loading.pin, "buildModelFromXML", chatty)
    robot = robot_from_text(ARM.encode(), PATH)
    assert [w for w in robot.warnings if re.search("the joint is odd", w)]


def test_what_the_c_library_says_is_in_the_error(monkeypatch, capfd):
    """The error gives Pinocchio's reason for rejecting a file, which its exception does not contain."""

    def failing(*arguments):
        import os

        os.write(2, b"Error: the reason\n")
        raise ValueError("The XML stream does not contain a valid URDF model.")

    monkeypatch.setattr(loading.pin, "buildModelFromXML", failing)
    with pytest.raises(RobotError, match="the reason") as caught:
        robot_from_text(ARM.encode(), PATH)
    assert caught.value.code == "pinocchio"
    assert capfd.readouterr().err == ""


def test_a_model_that_lost_something_is_refused(monkeypatch):
    """If Pinocchio dropped a link in silence, the counts would tell."""
    smaller = edited(('<link name="tip"/>', ""), (ARM[ARM.index('  <joint name="elbow"') : ARM.index("</robot>")], ""))
    built = loading.pin.buildModelFromXML
    monkeypatch.setattr(loading.pin, "buildModelFromXML", lambda text: built(smaller.decode()))
    with pytest.raises(RobotError, match="3 links, the loaded model 2") as caught:
        robot_from_text(ARM.encode(), PATH)
    assert caught.value.code == "counts"


def test_warnings_have_an_end():
    """A file with very many oddities gives a hundred warnings and the number of the others."""
    junk = "".join(f"<x{i}/>" for i in range(100_000))
    warnings = validate_urdf(edited(('<link name="base"/>', f'<link name="base">{junk}</link>')), PATH).warnings
    assert len(warnings) == 101 and warnings[-1] == "99900 more warnings are left out"


def test_nothing_is_said_about_a_sound_robot():
    """A robot without oddities has no warnings."""
    assert validate_urdf(ARM.encode(), PATH).warnings == ()
