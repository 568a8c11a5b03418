"""What validation of a robot description says, next to the verdicts of the corpus."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from urdf_corpus import ARM, Case, corpus, edited

from manip_learn.errors import ManipLearnError, RobotError
from manip_learn.robot import loading
from manip_learn.robot.description import text
from manip_learn.robot.description.text import parse_xml
from manip_learn.robot.description.validation import validate_urdf
from manip_learn.robot.loading import robot_from_text

PATH = Path("some/arm.urdf")
GOLDEN = Path(__file__).with_name("golden") / "robot_sentences.txt"


def said_about(case: Case) -> tuple[str, ...]:
    """The refusal of a description, or its warnings."""
    try:
        return robot_from_text(case.content, PATH, locked=case.options.get("locked", ())).warnings
    except ManipLearnError as error:
        return (str(error),)


def test_sentences_are_those_agreed_upon():
    """Of each description of the corpus: file, line, whose fault, value found, value expected, remedy, word by word.

    After a change of words: `python tests/test_robot_validation.py` writes the golden file; read what has changed.
    """
    assert sentences() == GOLDEN.read_text(encoding="utf-8").splitlines()


def sentences() -> list[str]:
    """All sentences, each with the first description that it is said about."""
    first: dict[str, str] = {}
    for case in corpus():
        if case.content and not case.special and not case.category.startswith("mesh") and len(case.content) < 200_000:
            for sentence in said_about(case):
                assert "\n" not in sentence and len(sentence) < 600, case.name
                first.setdefault(sentence, f"{case.category}, {case.name}: {sentence}")
    return list(first.values())


def test_bounds_of_a_document(monkeypatch):
    """The last element, level, character, angle and length of an axis that are read, and the first that are not."""
    assert text.MAX_ELEMENTS == 200_000
    monkeypatch.setattr(text, "MAX_ELEMENTS", 500)
    for most, code, document in (
        (500, "xml-too-large", lambda n: f"<robot>{'<a/>' * (n - 1)}</robot>"),
        (60, "xml-too-deep", lambda n: "<a>" * n + "</a>" * n),
        (100_000, "xml-too-large", lambda n: f'<robot name="{"r" * n}"/>'),
    ):
        parse_xml(document(most).encode(), PATH)
        with pytest.raises(RobotError) as caught:
            parse_xml(document(most + 1).encode(), PATH)
        assert caught.value.code == code
    angle, limits, axis = 4.0 * np.pi, 'lower="-2" upper="2.5"', 'xyz="0 0 1"'
    for old, new, code in (
        (limits, f'lower="-{angle}" upper="{angle}"', None),
        (limits, f'lower="-{angle}" upper="12.567"', "limit-degrees"),
        (limits, 'lower="-999" upper="1000.1"', None),
        *((axis, f'xyz="0 0 {length}"', None) for length in (0.0011, 999.0)),
        *((axis, f'xyz="0 0 {length}"', "axis-norm") for length in (0.0009, 1001.0)),
        ('xyz="0 0 0.3"', 'xyz="0 0 -1e6"', None),
        *(('xyz="0 0 0.3"', f'xyz="{x}"', "far-away") for x in ("0 0 -1000001", "0 -1000001 0", "-1000001 0 0")),
    ):
        seen = None
        try:
            assert validate_urdf(edited((old, new)), PATH).urdf.root == "base"
        except RobotError as error:
            seen = error.code
        assert seen == code, new
    massless = edited(('ixx="0.1"', 'ixx="0"'), ('iyy="0.1"', 'iyy="0"'), ('izz="0.1"', 'izz="0"'))
    assert validate_urdf(massless, PATH).warnings == ()


def test_what_pinocchio_refuses_is_refused(monkeypatch):
    """Its reason is in the sentence."""

    def failing(*arguments):
        raise ValueError("the reason")

    monkeypatch.setattr(loading.pin, "buildModelFromXML", failing)
    with pytest.raises(RobotError, match="the reason") as caught:
        robot_from_text(ARM.encode(), PATH)
    assert caught.value.code == "pinocchio"


def test_warnings_have_an_end():
    """A file with very many oddities gives a hundred warnings and the number of the others."""
    junk = "".join(f"<x{i}/>" for i in range(100_000))
    warnings = validate_urdf(edited(('<link name="base"/>', f'<link name="base">{junk}</link>')), PATH).warnings
    assert len(warnings) == 101 and warnings[-1] == "99900 more warnings are left out"


if __name__ == "__main__":
    GOLDEN.write_text("\n".join(sentences()) + "\n", encoding="utf-8")
