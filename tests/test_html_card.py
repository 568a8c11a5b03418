"""What a notebook and a prompt show: short, escaped, and nothing of the numbers lost."""

from __future__ import annotations

from html.parser import HTMLParser

import pytest
from case import case
from task_sets import sawyer_drawer

import manip_learn as ml
from manip_learn.robot import html_card
from manip_learn.robot.robot import Robot


class Balanced(HTMLParser):
    """Collects the text; fails where an element is closed that is not open."""

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.text: list[str] = []

    def handle_starttag(self, tag: str, attrs: object) -> None:
        self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.text.append(data)


def text_of(html: str) -> str:
    parser = Balanced()
    parser.feed(html)
    assert parser.open == []
    return " ".join(parser.text)


@pytest.fixture(scope="module")
def objects() -> dict[str, object]:
    robot = ml.load_robot("sawyer", locked={"right_j6": 0.5})
    whole, demos, learner = sawyer_drawer()
    task = ml.PointAttractor([0.6, 0.27, 0.35])
    controller = ml.ResolvedRateController(learner.constraint_, task=task)
    rollout = ml.simulate(whole, controller, [1.2, -1.57, 0, 0, 0, 0, 0], duration=0.5, dt=0.01)
    return {
        "robot": robot,
        "demonstrations": demos,
        "trajectory": demos[0],
        "report": learner.report_,
        "constraint": learner.constraint_,
        "rollout": rollout,
    }


def test_a_notebook_shows_the_facts(objects: dict[str, object]):
    """Each card is whole HTML and says what a reader looks for."""
    for name, words in [
        ("robot", ["Robot sawyer", "right_j0", "rad/s", "locked: right_j6 at 0.5"]),
        ("demonstrations", ["6 recordings", "without velocities", "demo_01.csv", "100"]),
        ("report", ["The tip can move along", "10 is clear", "degrees", "Gap for each number of rows", "demo_06.csv"]),
        ("constraint", ["2 of 3 rows", "row of Λ", "FrameJacobian"]),
        ("rollout", ["51 samples over 0.5 s", "right_gripper_tip", "error at the end"]),
    ]:
        with case(name, words):
            text = text_of(objects[name]._repr_html_())  # type: ignore[attr-defined]
            for word in words:
                assert word in text


def test_names_cannot_become_markup_or_move_the_cursor():
    """A recording or joint may be called anything."""
    for character in ("\x1b", "\x07", "\x85", "\u202e", "\ud800"):
        hostile = f"a{character}[31mb"
        robot = Robot(ml.load_robot("planar3").pinocchio_model, name=hostile, warnings=[hostile], locked={hostile: 1.0})
        assert robot.warnings == (f"a{ascii(character)[1:-1]}[31mb",)
        for said in (repr(robot), robot._repr_html_(), *robot.warnings):
            assert character not in said and "[31mb" in said or said == repr(robot)
    card = html_card.card("<b>x", html_card.facts([("<script>", "a & b")]), html_card.warnings(["<i>"]))
    assert "<script>" not in card
    assert text_of(card).count("<") == 3
