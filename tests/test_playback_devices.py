"""The replay page on a phone, by keyboard, in the dark and for screen readers."""

from __future__ import annotations

import numpy as np
import pytest
from conftest import tip_of
from test_phase_bands import luminance
from test_playback import waving
from test_playback_browser import PHASES, opened  # noqa: F401

from manip_learn.constraint.constraint import Constraint
from manip_learn.constraint.features import FrameJacobian
from manip_learn.playback import replay
from manip_learn.playback.palette import COLOURS
from manip_learn.playback.phase_bands import FREE_COLOUR

pytestmark = pytest.mark.browser
# ruff: noqa: F811  the fixture of another file is an argument here

PHONE_WIDTH = 390  # [px]
FINGER = 40  # least width and height of what a finger must hit [px]
# a check box or a choice is hit by its label
CONTROLS = "button, select, summary, input[type=range], label:has(input)"
HINGE = {"type": "hinge", "axis": [0, 0, 1], "point": [0.5, 0.5, 0.1], "radius": 0.6, "sentence": "a hinge"}
REPORT = {
    "sentence": "the hand is held", "gap": 3940.0, "n_constraints": 2, "held_out_residual": 0.012,
    "uncertainty_deg": 0.2, "n_samples": 600, "n_trajectories": 2, "warnings": ["recordings are few"],
    "odd_trajectories": [["b", "moves 3 mm"]],
}  # fmt: skip
ALL_TRACKS = "document.querySelectorAll('#sheets input').forEach(box => { if (!box.checked) box.click(); })"
# one of the lists and cards open, the others closed; a number beyond them closes all
OPEN_ONE = "n => document.querySelectorAll('details').forEach((list, i) => { list.open = i === n; })"


PHONE = {"phone": True, "width": PHONE_WIDTH, "height": 844}


@pytest.fixture
def phased(robot_of, tmp_path):
    """Address of a page that has all that a page can have."""
    robot = robot_of("planar3")
    guided = Constraint(np.eye(2), FrameJacobian(robot, tip_of(robot.name), "x y"))
    motions = {"a": waving(robot, 4.0).trajectory("a"), "b": waving(robot, 2.0, phase=1.0).trajectory("b")}
    more = {"phases": PHASES, "mechanism": HINGE, "constraint": (guided, guided), "report": REPORT}
    notes = ["a note about a_very_long_file_name_that_has_no_space_in_it_and_goes_on_and_on.mcap"]
    path, more = tmp_path / "phases.html", more | {"target": [0.4, 0.3], "notes": notes}
    return replay(robot, motions, path, title="drawer, 3 times", **more).html.as_uri()


@pytest.fixture
def plain(robot_of, tmp_path):
    """Address of a page of three rollouts with long names."""
    robot = robot_of("planar3")
    rollouts = {f"a rather long name of a rollout, number {i}": waving(robot, 3.0 + i, phase=i) for i in range(3)}
    return replay(robot, rollouts, tmp_path / "plain.html", title="drawer, 3 times").html.as_uri()


def boxes(page, selector):
    """Text or id, and box, of the controls that can be seen."""
    return page.evaluate(
        """selector => [...document.querySelectorAll(selector)].filter(e => e.checkVisibility()).map(e => {
            const box = e.getBoundingClientRect();
            return [e.id || e.textContent.trim(), box.left, box.right, box.width, box.height];
        })""",
        selector,
    )


def test_phones_show_everything_without_sideways_scrolling(phased, opened):
    """On a phone nothing is wider than the screen, and every control is large enough for a finger; robot and curve are
    there before anything is scrolled, names and notes below.
    """
    page = opened(phased, **PHONE)
    (_, top, *_), (_, floor, *_) = (page.locator(s).bounding_box().values() for s in ("#scene", "#transport"))
    chart, legend = (page.locator(s).bounding_box() for s in ("#chart", "#legend"))
    assert 0.0 < top < chart["y"] < chart["y"] + chart["height"] <= floor + 2.0
    assert legend["y"] >= chart["y"] + chart["height"]
    page.evaluate(ALL_TRACKS)
    width = PHONE_WIDTH
    for list_open in range(page.locator("details").count()):
        page.evaluate(OPEN_ONE, list_open)
        page.wait_for_timeout(50)
        assert page.evaluate("[document.documentElement.scrollWidth, innerWidth]") == [width, width]
        for name, left, right, across, down in boxes(page, CONTROLS):
            assert left >= 0 and right <= width and across >= FINGER and down >= FINGER, (width, name)
        for name, left, right, *_ in boxes(page, "#legend *, #chart, #tracks, .sheet, #notes, #transport, canvas"):
            assert left >= -0.5 and right <= width + 0.5, (width, name)


def test_nothing_keeps_readers_out(phased, opened):
    """Axe finds no violation that is serious or worse, light and dark, whichever list is open."""
    base = pytest.importorskip("axe_playwright_python.base", reason="NO AXE: ACCESSIBILITY IS NOT TESTED")
    page = opened(phased)
    page.evaluate(base.AXE_SCRIPT)
    page.evaluate(ALL_TRACKS)
    for scheme in ("light", "dark"):
        page.emulate_media(color_scheme=scheme)
        for list_open in range(page.locator("details").count() + 1):
            page.evaluate(OPEN_ONE, list_open)
            found = page.evaluate("axe.run(document, { resultTypes: ['violations'] })")
            serious = [v for v in found["violations"] if v["impact"] in ("serious", "critical")]
            assert [(v["id"], [n["target"] for n in v["nodes"]]) for v in serious] == [], (scheme, list_open)


def contrast(one, other):
    """Ratio of contrast of two colours."""
    low, high = sorted(luminance(f"#{bytes(map(round, colour)).hex()}") for colour in (one, other))
    return (high + 0.05) / (low + 0.05)


def numbers(colour):
    """`#rrggbb` or `rgb(r, g, b)` -> r, g, b."""
    if colour.startswith("#"):
        return [int(colour[i : i + 2], 16) for i in (1, 3, 5)]
    return [float(x) for x in colour[4:-1].split(",")]


def test_dark_and_light_are_readable(plain, opened):
    """The page is dark where the system is; texts of the curve have 4.5:1, lines and bands 3:1 against either page."""
    page = opened(plain)
    for scheme, is_dark in (("light", False), ("dark", True)):
        page.emulate_media(color_scheme=scheme)
        ground = numbers(page.evaluate("getComputedStyle(document.body).backgroundColor"))
        assert (max(ground) < 90.0) == is_dark
        texts = page.evaluate("[...document.querySelectorAll('#chart text')].map(e => getComputedStyle(e).fill)")
        cursor = page.evaluate("getComputedStyle(document.querySelector('#chart [stroke-width=\"1.5\"]')).stroke")
        assert len(texts) > 5
        for colour in (*texts, cursor):
            assert contrast(numbers(colour), ground) >= 4.5, (scheme, colour)
        for colour in (*COLOURS.values(), FREE_COLOUR):
            assert contrast(numbers(colour), ground) >= 3.0, (scheme, colour)


def test_keys_are_listed_and_leave_the_focus_alone(plain, opened):
    """? opens the list of the keys and escape closes it; arrows on the robot turn it and leave time alone."""
    page = opened(plain)
    page.keyboard.press("?")
    words = page.locator("#keys dl").inner_text()
    for key in ("space", "← →", "↑ ↓", "home end", "F 1 2 3 4", "L", "R", "tab", "?", "esc"):
        assert key in words
    page.keyboard.press("Escape")
    assert not page.locator("#keys dl").is_visible()
    start = page.evaluate("manipLearn.eye")
    page.locator("#scene").focus()
    for key in ("ArrowDown", "ArrowLeft", "+"):
        page.keyboard.press(key)
        moved = page.evaluate("manipLearn.eye")
        assert np.linalg.norm(np.subtract(moved, start)) > 0.02
        start = moved
    assert page.evaluate("manipLearn.time") == 0.0
    page.keyboard.press("f")
    page.locator("#speed").focus()
    page.keyboard.press("ArrowDown")
    assert page.evaluate("[document.activeElement.id, document.activeElement.value]") == ["speed", "2"]
    page.evaluate("manipLearn.seek(1)")
    said = page.locator("#scrub").get_attribute("aria-valuetext")
    assert said == "1.00 s of 5.00 s, ok, manipulability 0.54"
    least = page.locator("#chart").get_attribute("aria-label")
    assert "number 0: lowest manipulability" in least and "at 1.57 s" in least


def test_no_3d_graphics_says_what_to_do(plain, opened):
    """Without WebGL the page says what to do, and its curves and numbers still play."""
    page = opened(plain, before="HTMLCanvasElement.prototype.getContext = () => null")
    assert not page.evaluate("manipLearn.drawing")
    words = page.locator("#no-webgl").inner_text()
    assert "WebGL" in words and "hardware acceleration" in words and "another browser" in words
    page.evaluate("manipLearn.seek(1)")
    assert page.locator("#clock").inner_text() == "1.00 s" and page.locator("#chart polyline").count() == 3
