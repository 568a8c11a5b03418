"""Hostile, unusual and mutated robot descriptions: each gets its verdict and its sentence, or works."""

from __future__ import annotations

import random
import re
from collections import Counter
from pathlib import Path

import hypothesis
import numpy as np
import pytest
from case import case
from hypothesis import strategies as st
from urdf_corpus import ARM, CASES, chain, edited, mimic_chain

from manip_learn.errors import RobotError, UnknownNameError
from manip_learn.robot import loading
from manip_learn.robot.description import text
from manip_learn.robot.description.text import parse_xml
from manip_learn.robot.description.urdf import validate_urdf
from manip_learn.robot.loading import robot_from_text
from manip_learn.robot.robot import Robot
from manip_learn.robot.visuals.visual_shapes import visual_shapes

PATH = Path("some/arm.urdf")
GOLDEN = Path(__file__).with_name("golden") / "robot_sentences.txt"


def use(robot: Robot, rng: np.random.Generator) -> None:
    """Evaluate the last frame at a random posture, so that a robot that only looks loaded is found out."""
    q, frame = robot.random_configuration(rng), robot.frame(robot.frame_names[-1])
    numbers = [robot.pose(q, frame), robot.jacobian(q, frame), *robot.jacobian_and_derivative(q, frame)]
    assert all(np.isfinite(x).all() for x in numbers) and numbers[1].shape == (6, robot.nv)


def verdict(content: bytes, path: Path, options: dict, rng: np.random.Generator) -> tuple[str, tuple[str, ...]]:
    """What became of a description, and the refusal or the warnings."""
    try:
        robot = robot_from_text(content, path, **options)
    except UnknownNameError as error:
        return f"unknown-{error.kind}", (str(error),)
    except RobotError as error:
        return error.code, (str(error),)
    use(robot, rng)
    return "warn" if robot.warnings else "accept", robot.warnings


def sentences(rng: np.random.Generator) -> list[str]:
    """All sentences, each with the first description that it is said about; every case has its verdict."""
    first: dict[str, str] = {}
    for category, name, expected, content, options in CASES:
        with case(category, name):
            seen, said = verdict(content, PATH, options, rng)
            assert seen == expected
            for sentence in said:
                assert "\n" not in sentence and len(sentence) < 600
                if len(content) < 200_000:
                    first.setdefault(sentence, f"{category}, {name}: {sentence}")
    return list(first.values())


def test_every_case_gets_its_verdict_and_its_sentence(rng):
    """File, line, whose fault, value found, value expected, remedy, word by word.

    After a change of words: `python tests/test_urdf_corpus.py` writes the golden file; read what has changed.
    """
    assert sentences(rng) == GOLDEN.read_text(encoding="utf-8").splitlines()


MJCF = """<mujoco model="m"><compiler angle="degree" eulerseq="xyz"/>
  <default><joint axis="0 1 0"/><default class="c"><joint type="slide" range="0 0.2"/></default></default>
  <asset><mesh name="mesh" file="a.stl" scale="1 1 1"/></asset>
  <worldbody><geom type="plane" size="1 1 1"/>
    <body name="a" pos="0 0 0.3" euler="10 20 30"><joint name="j" range="-90 90" pos="0.1 0 0" ref="5"/>
      <inertial pos="0 0 0" mass="1" diaginertia="0.1 0.1 0.1"/><geom type="capsule" size="0.1 0.2" rgba="1 0 0 1"/>
      <body name="b" axisangle="0 0 1 45" childclass="c"><joint name="k"/><joint name="l" class="main" limited="false"/>
        <geom mesh="mesh" type="mesh" quat="1 0 0 0"/><site name="tip" pos="0.1 0 0"/></body></body>
    <body name="d" xyaxes="1 0 0 0 1 0"><freejoint name="f"/></body></worldbody>
  <equality><joint joint1="l" joint2="j" polycoef="0.1 2 0 0 0"/></equality></mujoco>"""
VALUES = (
    "nan inf -inf 0 -0 1 -1 1e308 1e-308 4e-324 1e999 4294967296 9223372036854775808 0x10 1e 1.2.3 1,5 universe world "
    "root_joint revolute continuous prismatic planar floating fixed spherical mimic package://a/b.stl x"
).split() + ["", " ", "0 0 0", "0 0 1e-4", "1 1", "1 2 3 4", "\u2028", "\U0001f916", "&amp;", "%n%s", "a" * 5000]
PIECES = (  # values, numbers, elements, names
    r'(?<=")[^"<]*(?=")',
    r'(?<=[" ])-?\d+\.?\d*(?=[" ])',
    r"<[^<>/!?]*/>|<(?P<tag>joint|link|visual|inertial|body)\b.*?</(?P=tag)>",
    r"(?<=[</ ])[a-z]+(?=[ =>/])",
)
PARENTS = [ARM, ARM.replace('"revolute"', '"planar"', 1), MJCF, chain(4, "continuous").decode()]
PARENTS += [chain(3, "floating").decode(), mimic_chain((2, 0, 1)).decode()]


def mutant(seed: int) -> bytes:
    """One to four pieces of a description dropped, doubled or replaced; sometimes its bytes are cut or turned."""
    rng = random.Random(seed)
    written = rng.choice(PARENTS)
    for _ in range(rng.choice((1, 1, 1, 2, 2, 3, 4))):
        pieces = list(re.finditer(rng.choice(PIECES), written, re.DOTALL))
        if pieces:
            here, other = rng.choice(pieces), rng.choice(pieces).group()
            new = rng.choice(("", rng.choice(VALUES), other, here.group() + other))
            written = written[: here.start()] + new + written[here.end() :]
    content = bytearray(written.encode("utf-8", "surrogatepass"))
    if content and rng.random() < 0.2:
        content[rng.randrange(len(content))] ^= 1 << rng.randrange(8)
        del content[rng.choice((len(content), rng.randrange(len(content)))) :]
    return bytes(content)


@pytest.mark.fuzz
def test_mutants_are_refused_or_work(rng):
    """No error but ours; what loads gives finite poses and derivatives, and shapes or their faults."""
    seen = Counter[str]()

    @hypothesis.settings(max_examples=max(300, hypothesis.settings.default.max_examples))
    @hypothesis.given(st.integers(0, 2**63))
    def attempt(seed: int) -> None:
        content = mutant(seed)
        said = verdict(content, PATH, {}, rng)[0]
        seen[said] += 1
        if said in ("accept", "warn"):
            visual_shapes(robot_from_text(content, PATH))

    attempt()
    assert seen["accept"] + seen["warn"] > 0.05 * seen.total(), "too wild to test what comes after validation"


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
            assert validate_urdf(parse_xml(edited((old, new)), PATH)).root == "base"
        except RobotError as error:
            seen = error.code
        assert seen == code, new
    massless = edited(('ixx="0.1"', 'ixx="0"'), ('iyy="0.1"', 'iyy="0"'), ('izz="0.1"', 'izz="0"'))
    assert validate_urdf(parse_xml(massless, PATH)).warnings == ()


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
    junk = "".join(f"<x{i}/>" for i in range(1000))
    warnings = validate_urdf(
        parse_xml(edited(('<link name="base"/>', f'<link name="base">{junk}</link>')), PATH)
    ).warnings
    assert len(warnings) == 101 and warnings[-1] == "900 more warnings are left out"


if __name__ == "__main__":
    GOLDEN.write_text("\n".join(sentences(np.random.default_rng(0))) + "\n", encoding="utf-8")
