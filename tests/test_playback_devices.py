"""The replay page and the live view on phones, by touch, by keyboard, in the dark, for screen readers and on paper."""

from __future__ import annotations

import base64
import itertools
from contextlib import contextmanager
from dataclasses import replace

import numpy as np
import pytest
from conftest import tip_of
from test_playback import waving
from test_playback_browser import PHASES, opened, wait_until  # noqa: F401

from manip_learn.constraint.constraint import Constraint
from manip_learn.constraint.features import FrameJacobian
from manip_learn.playback import LiveViewer, replay
from manip_learn.playback.palette import COLOURS
from manip_learn.playback.phase_bands import FREE_COLOUR

pytestmark = pytest.mark.browser
# ruff: noqa: F811  the fixture of another file is an argument here

PHONES = (320, 390, 430)  # widths [px]
DESKTOP = (1280, 800)
FINGER = 40  # least width and height of what a finger must hit [px]
# a check box or a choice is hit by its label
CONTROLS = "button, select, summary, input[type=range], label:has(input)"
HINGE = {"type": "hinge", "axis": [0, 0, 1], "point": [0.5, 0.5, 0.1], "radius": 0.6, "sentence": "a hinge"}
PAGES = ("replay", "phases", "plan", "live")
REPORT = {
    "sentence": "the hand is held", "gap": 3940.0, "n_constraints": 2, "held_out_residual": 0.012,
    "uncertainty_deg": 0.2, "n_samples": 600, "n_trajectories": 2, "warnings": ["recordings are few"],
    "odd_trajectories": [["b", "moves 3 mm"]],
}  # fmt: skip
ALL_TRACKS = "document.querySelectorAll('#sheets input').forEach(box => { if (!box.checked) box.click(); })"
# one of the lists and cards open, the others closed; a number beyond them closes all
OPEN_ONE = "n => document.querySelectorAll('details').forEach((list, i) => { list.open = i === n; })"
# place and name of what has the focus; in words, if it does not show that it has
FOCUS = """() => {
    const e = document.activeElement, style = getComputedStyle(e);
    if (parseFloat(style.outlineWidth) < 2 || style.outlineStyle !== "solid") return ["no focus ring", e.outerHTML];
    const name = e.getAttribute("aria-label") || e.textContent.trim() || e.title;
    return [[...document.querySelectorAll("*")].indexOf(e), name];
}"""


PHONE = {"phone": True, "width": PHONES[1], "height": 844}


@contextmanager
def address_of(kind, robot, folder):
    """Where one of `PAGES` is."""
    if kind == "live":
        with LiveViewer(robot, open_browser=False) as viewer:
            viewer.show(np.full(robot.nv, 0.3), manipulability=0.2, time=1.0)
            yield viewer.url
        return
    rollouts = {f"a rather long name of a rollout, number {i}": waving(robot, 3.0 + i, phase=i) for i in range(3)}
    guided = Constraint(np.eye(2), FrameJacobian(robot, tip_of(robot.name), "x y"))
    more = {"constraint": guided, "target": [0.4, 0.3]}
    if kind == "phases":
        rollouts = {"a": waving(robot, 4.0).trajectory("a"), "b": waving(robot, 2.0, phase=1.0).trajectory("b")}
        more = {"phases": PHASES, "mechanism": HINGE, "constraint": (guided, guided), "report": REPORT}
    if kind == "plan":
        parts = (("approach", 0.0, 1.5), ("hold", 1.5, 1.6), ("a rather long name of a phase", 1.6, 3.0))
        rollouts = {name: replace(rollout, phases=parts) for name, rollout in rollouts.items()}
    notes = ["a note about a_very_long_file_name_that_has_no_space_in_it_and_goes_on_and_on.mcap"]
    path = folder / f"{kind}.html"
    yield replay(robot, rollouts, path, title="drawer, 3 times", notes=notes, **more).html.as_uri()


def boxes(page, selector):
    """Text or id, and box, of the controls that can be seen."""
    return page.evaluate(
        """selector => [...document.querySelectorAll(selector)].filter(e => e.checkVisibility()).map(e => {
            const box = e.getBoundingClientRect();
            return [e.id || e.textContent.trim(), box.left, box.right, box.width, box.height];
        })""",
        selector,
    )


SOME_PAGES = ("phases", *(pytest.param(kind, marks=pytest.mark.slow) for kind in PAGES if kind != "phases"))


@pytest.mark.parametrize("kind", SOME_PAGES)
def test_phones_show_everything_without_sideways_scrolling(robot_of, tmp_path, opened, kind):
    """At 320, 390 and 430 pixels nothing is wider than the screen, and every control is large enough for a finger;
    robot and curve are there before anything is scrolled, names and notes below.
    """
    with address_of(kind, robot_of("planar3"), tmp_path) as address:
        page = opened(address, **PHONE)
        if kind != "live":
            (_, top, *_), (_, floor, *_) = (page.locator(s).bounding_box().values() for s in ("#scene", "#transport"))
            chart, legend = (page.locator(s).bounding_box() for s in ("#chart", "#legend"))
            assert 0.0 < top < chart["y"] < chart["y"] + chart["height"] <= floor + 2.0
            assert legend["y"] >= chart["y"] + chart["height"]
        page.evaluate(ALL_TRACKS)
        for width, list_open in itertools.product(PHONES, range(page.locator("details").count())):
            page.set_viewport_size({"width": width, "height": 800})
            page.evaluate(OPEN_ONE, list_open)
            page.wait_for_timeout(50)
            assert page.evaluate("[document.documentElement.scrollWidth, innerWidth]") == [width, width]
            controls = boxes(page, CONTROLS)
            assert len(controls) > 6
            for name, left, right, across, down in controls:
                assert left >= 0 and right <= width and across >= FINGER and down >= FINGER, (width, name)
            for name, left, right, *_ in boxes(
                page, "#legend *, #chart, #tracks, .sheet, #notes, #keys dl, #transport, canvas"
            ):
                assert left >= -0.5 and right <= width + 0.5, (width, name)


def drag(page, *ways):
    """Fingers that move along straight lines, (from, to) each, and are lifted."""
    session, ways = page.context.new_cdp_session(page), np.array(ways, dtype=float)

    def touch(kind, points=()):
        places = [{"x": x, "y": y, "id": i} for i, (x, y) in enumerate(points)]
        session.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": places})

    touch("touchStart", ways[:, 0])
    for share in np.linspace(0.0, 1.0, 12):
        touch("touchMove", ways[:, 0] + share * (ways[:, 1] - ways[:, 0]))
        page.wait_for_timeout(16)
    touch("touchEnd")
    session.detach()
    page.wait_for_timeout(100)


@pytest.mark.slow
def test_fingers_turn_zoom_seek_and_scroll(robot_of, tmp_path, opened):
    """One finger turns the robot, two zoom; across the curve they move in time; up and down they scroll the page."""
    robot = robot_of("planar3")
    page = opened(replay(robot, {"a": waving(robot, 4.0)}, tmp_path / "a.html").html.as_uri(), **PHONE)
    page.set_viewport_size({"width": 390, "height": 600})
    eye = lambda: np.array(page.evaluate("manipLearn.eye"))  # noqa: E731
    page.locator("[data-view=iso]").tap()
    scene, start = page.locator("#scene").bounding_box(), eye()
    x, y = scene["x"] + scene["width"] / 2, scene["y"] + scene["height"] / 2
    drag(page, ((x - 60, y), (x + 60, y + 40)))
    assert np.linalg.norm(eye() - start) > 0.1 * np.linalg.norm(start), "one finger does not turn"
    page.locator("[data-view=iso]").tap()
    start = eye()
    drag(page, ((x - 20, y), (x - 100, y)), ((x + 20, y), (x + 100, y)))
    assert np.linalg.norm(eye()) < 0.6 * np.linalg.norm(start), "two fingers do not zoom"
    assert page.evaluate("[scrollY, manipLearn.time]") == [0, 0]
    legend = page.locator("#legend").bounding_box()
    x, y = legend["x"] + 150, legend["y"] + 20
    drag(page, ((x, y), (x, y - 150)))
    assert page.evaluate("scrollY") > 50, "the page does not scroll"
    box = page.locator("#chart").bounding_box()
    x, y, before = box["x"] + 200, box["y"] + 60, page.evaluate("scrollY")
    drag(page, ((x, y), (x + 5, y + 120)))
    assert page.evaluate("scrollY") < before and page.evaluate("manipLearn.time") == 0.0
    transport = page.locator("#transport").bounding_box()
    swipe = transport["y"] + 4
    drag(page, ((20, swipe), (380, swipe)))  # must not go back in the browser's history
    page.evaluate("scrollTo(0, 150)")
    box = page.locator("#chart").bounding_box()
    drag(page, ((box["x"] + 80, box["y"] + 40), (box["x"] + box["width"] - 14, box["y"] + 42)))
    assert page.evaluate("manipLearn.time") == pytest.approx(4.0, abs=0.02)
    page.touchscreen.tap(box["x"] + 58, box["y"] + 40)
    assert page.evaluate("manipLearn.time") == pytest.approx(0.0, abs=0.02)


@pytest.mark.parametrize("schemes", [("light", "dark"), pytest.param(("dark", "light"), marks=pytest.mark.slow)])
@pytest.mark.parametrize("kind", SOME_PAGES)
def test_nothing_keeps_readers_out(robot_of, tmp_path, opened, kind, schemes):
    """Axe finds no violation that is serious or worse, at desktop and phone width, light and dark, all lists open.

    With every change a light desktop and a dark phone; the other way round with `make proofs`.
    """
    base = pytest.importorskip("axe_playwright_python.base", reason="NO AXE: ACCESSIBILITY IS NOT TESTED")
    with address_of(kind, robot_of("planar3"), tmp_path) as address:
        page = opened(address)
        wait_until(page, "getComputedStyle(document.getElementById('panel')).display !== 'none'")
        page.evaluate(base.AXE_SCRIPT)
        page.evaluate(ALL_TRACKS)
        for size, scheme in zip((DESKTOP, (PHONES[1], 844)), schemes, strict=True):
            page.set_viewport_size({"width": size[0], "height": size[1]})
            page.emulate_media(color_scheme=scheme)
            for list_open in range(page.locator("details").count() + 1):
                page.evaluate(OPEN_ONE, list_open)
                found = page.evaluate("axe.run(document, { resultTypes: ['violations'] })")
                bad = [(v["id"], [n["target"] for n in v["nodes"]]) for v in found["violations"]
                       if v["impact"] in ("serious", "critical")]  # fmt: skip
                assert bad == [], (size, scheme, list_open)


def luminance(colour):
    """Relative luminance of an sRGB colour of 0 to 255 (WCAG 2.2)."""
    share = np.asarray(colour, dtype=float) / 255.0
    linear = np.where(share <= 0.04045, share / 12.92, ((share + 0.055) / 1.055) ** 2.4)
    return float(linear @ [0.2126, 0.7152, 0.0722])


def contrast(one, other):
    """Ratio of contrast of two colours."""
    low, high = sorted((luminance(one), luminance(other)))
    return (high + 0.05) / (low + 0.05)


def numbers(colour):
    """`#rrggbb` or `rgb(r, g, b)` -> r, g, b."""
    if colour.startswith("#"):
        return [int(colour[i : i + 2], 16) for i in (1, 3, 5)]
    return [float(x) for x in colour[4:-1].split(",")]


def test_dark_and_light_are_readable(robot_of, tmp_path, opened):
    """The page is dark where the system is; texts of the curve have 4.5:1, lines and bands 3:1 against either page."""
    with address_of("replay", robot_of("planar3"), tmp_path) as address:
        page = opened(address)
        for scheme, is_dark in (("light", False), ("dark", True)):
            page.emulate_media(color_scheme=scheme)
            ground = numbers(page.evaluate("getComputedStyle(document.body).backgroundColor"))
            assert (luminance(ground) < 0.1) == is_dark
            texts = page.evaluate("[...document.querySelectorAll('#chart text')].map(e => getComputedStyle(e).fill)")
            cursor = page.evaluate("getComputedStyle(document.querySelector('#chart [stroke-width=\"1.5\"]')).stroke")
            assert len(texts) > 5
            for colour in (*texts, cursor):
                assert contrast(numbers(colour), ground) >= 4.5, (scheme, colour)
            for colour in (*COLOURS.values(), FREE_COLOUR):
                assert contrast(numbers(colour), ground) >= 3.0, (scheme, colour)


@pytest.mark.slow
def test_every_control_is_reached_by_tab(robot_of, tmp_path, opened):
    """Tab goes through every control that can be seen, each shows that it has the focus, and each has a name."""
    with address_of("replay", robot_of("planar3"), tmp_path) as address:
        page = opened(address)
        wait_until(page, "getComputedStyle(document.getElementById('panel')).display !== 'none'")
        expected = len(boxes(page, "button, select, summary, input, [tabindex]"))
        seen = set()
        for _ in range(expected):
            page.keyboard.press("Tab")
            seen.add(tuple(page.evaluate(FOCUS)))
        assert len(seen) == expected and all(isinstance(place, int) and name for place, name in seen), seen


def test_keys_are_listed_and_leave_the_focus_alone(robot_of, tmp_path, opened):
    """? opens the list of the keys and escape closes it; arrows on the robot turn it and leave time alone."""
    with address_of("replay", robot_of("planar3"), tmp_path) as address:
        page = opened(address)
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
        assert said == "1.00 s of 5.00 s, ok, manipulability 0.540"
        least = page.locator("#chart").get_attribute("aria-label")
        assert "number 0: lowest manipulability" in least and "at 1.57 s" in least


@pytest.mark.slow
def test_little_motion_is_respected(robot_of, tmp_path, opened):
    """Nothing moves by itself; who asked for reduced motion gets no repetition either, until it is switched on."""
    robot = robot_of("planar3")
    address = replay(robot, {"a": waving(robot, 0.3)}, tmp_path / "a.html").html.as_uri()
    for wish, repeats in (("reduce", "false"), ("no-preference", "true")):
        page = opened(address, reduced_motion=wish)
        assert page.locator("#loop").get_attribute("aria-pressed") == repeats
        assert not page.evaluate("manipLearn.playing")
        page.evaluate("manipLearn.play()")
        wait_until(page, "manipLearn.time > 0.2")
        wait_until(page, "manipLearn.time < 0.15" if repeats == "true" else "!manipLearn.playing")


def test_no_3d_graphics_says_what_to_do(robot_of, tmp_path, opened):
    """Without WebGL the page says what to do, and its curves and numbers still play."""
    robot = robot_of("planar3")
    address = replay(robot, {"a": waving(robot)}, tmp_path / "a.html").html.as_uri()
    page = opened(address, before="HTMLCanvasElement.prototype.getContext = () => null")
    assert not page.evaluate("manipLearn.drawing")
    words = page.locator("#no-webgl").inner_text()
    assert "WebGL" in words and "hardware acceleration" in words and "another browser" in words
    page.evaluate("manipLearn.seek(1)")
    assert page.locator("#clock").inner_text() == "1.00 s" and page.locator("#chart polyline").count() == 1


@pytest.mark.slow
def test_paper_shows_the_moment(robot_of, tmp_path, opened):
    """On paper the robot is a picture on white, without controls, and a sentence says how to play it."""
    robot = robot_of("planar3")
    page = opened(replay(robot, {"a": waving(robot)}, tmp_path / "a.html").html.as_uri(), color_scheme="dark")
    page.emulate_media(media="print", color_scheme="dark")
    page.evaluate("window.dispatchEvent(new Event('beforeprint'))")
    picture = page.locator("#scene img")
    wait_until(page, "document.querySelector('#scene img').complete")
    assert picture.bounding_box()["width"] > 300
    assert page.evaluate(SHARES, picture.get_attribute("src").split(",")[1])["drawn"] > 0.01
    assert numbers(page.evaluate("getComputedStyle(document.body).backgroundColor")) == [255, 255, 255]
    assert not page.locator("#transport").is_visible() and not page.locator("#views").is_visible()
    assert "open the HTML file in a browser" in page.locator("#printed").inner_text()
    page.evaluate("window.dispatchEvent(new Event('afterprint'))")
    assert picture.count() == 0


# of a picture as PNG: pixels that are drawn and bright, those of them without any shade left, and how they spread
SHARES = """async png => {
    const image = new Image();
    image.src = "data:image/png;base64," + png;
    await image.decode();
    const canvas = Object.assign(document.createElement("canvas"), { width: image.width, height: image.height });
    const pen = canvas.getContext("2d");
    pen.drawImage(image, 0, 0);
    const data = pen.getImageData(0, 0, image.width, image.height).data;
    let bright = 0, clipped = 0, drawn = 0, sum = 0, squares = 0;
    for (let i = 0; i < data.length; i += 4) {
        const low = Math.min(data[i], data[i + 1], data[i + 2]);
        if (data[i + 3] > 0) drawn += 1;
        if (low < 100) continue;
        bright += 1; sum += low; squares += low * low;
        if (low >= 254) clipped += 1;
    }
    const n = data.length / 4, mean = sum / bright;
    const spread = Math.sqrt(squares / bright - mean * mean);
    return { drawn: drawn / n, bright: bright / n, clipped: clipped / bright, spread };
}"""


@pytest.mark.slow
def test_white_robots_keep_their_shades(robot_of, tmp_path, opened):
    """Of a white robot's pixels in the dark less than 1 % are at full white (28 % were), and they differ in level."""
    robot = robot_of("xarm7")
    page = opened(replay(robot, {"a": waving(robot)}, tmp_path / "a.html").html.as_uri(), color_scheme="dark")
    for view in ("iso", "front", "side"):
        page.locator(f"[data-view={view}]").click()
        page.wait_for_timeout(150)
        shot = page.locator("#scene canvas").screenshot(style="#legend, #notes { visibility: hidden }")
        shares = page.evaluate(SHARES, base64.b64encode(shot).decode())
        assert shares["bright"] > 0.02 and shares["clipped"] < 0.01 and shares["spread"] > 20.0, (view, shares)
