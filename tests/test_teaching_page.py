"""The page on which an arm is taught, in a browser, with the program behind it."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from contextlib import contextmanager

import numpy as np
import pytest
from test_playback import EVIL, evil_robot
from test_playback_browser import browser_page, wait_until

pytest.importorskip("mujoco", reason="NO MUJOCO: TEACHING IS NOT TESTED")
pytestmark = [pytest.mark.browser, pytest.mark.timeout(900)]  # a busy machine draws slowly
READY = "window.manipLearnReady && manipLearnTeach.allowed && manipLearnTeach.pose !== null"
RECORDINGS = 3


@contextmanager
def program(robot, folder):
    """Run `manip-learn teach` as a child process; give it and the address of its page."""
    command = [sys.executable, "-m", "manip_learn", "teach", robot, "--seed", "3", "--no-browser", "--out", folder]
    child = subprocess.Popen(command, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True)
    try:
        line = next((line for line in child.stderr if "http://" in line), "")
        assert line, "the program ended without a page"
        yield child, re.search(r"http://\S+", line)[0]
    finally:
        child.terminate()
        child.communicate(timeout=20)


@pytest.fixture
def desk(chromium, tmp_path):
    """A program with a planar arm whose names are markup, its page, and what the page posts."""
    more, posts = {"before": "window.errors = 1", "ready": READY}, []  # a test may end the program
    robot = str(evil_robot(tmp_path).source)
    with program(robot, str(tmp_path)) as (child, address), browser_page(chromium, address, **more) as page:
        page.on("request", lambda r: posts.append(json.loads(r.post_data)) if r.method == "POST" else None)
        yield child, page, posts


def press(page, name):
    """Press the large button when it has this name and is enabled; learning on a busy machine takes minutes."""
    wait_until(page, f"document.querySelector('#actions .next')?.innerText.startsWith({name!r})", 300.0)
    assert page.locator("#actions .next").is_enabled()
    page.locator("#actions .next").click()


def until(page, condition):
    """Wait until a condition on the page's state holds."""
    wait_until(page, f"manipLearnTeach.{condition}", 300.0)


def on_screen(page, what):
    """Where a point is on the screen [px]."""
    return np.array(list(page.evaluate(f"manipLearnTeach.{what}").values()))


def draw(page, start, end):
    """Draw the pointer from one point to another within two seconds, and pause."""
    for share in np.linspace(0.0, 1.0, 73):
        page.mouse.move(*(start + share * (end - start)))
        page.wait_for_timeout(30)
    page.wait_for_timeout(400)


def open_and_shut(page, distance):
    """Draw the drawer by its handle: the hand comes to it, and follows."""
    rest = np.array(page.evaluate("manipLearnTeach.scene.handles[0].at"))
    out = np.array(page.evaluate("manipLearnTeach.scene.furniture[0].fixed.pose")).reshape(4, 4)[:3, 1]
    places = [(rest + by * out).tolist() for by in (0.0, 1.6 * distance, -0.3 * distance)]
    at, away, shut = (on_screen(page, f"screenOf({place})") for place in places)
    page.mouse.move(*at)
    page.mouse.down()
    until(page, "pose.held[0]")
    page.wait_for_timeout(600)
    draw(page, at, away)
    draw(page, away, shut)
    page.mouse.up()
    page.locator("#grip").click()
    until(page, "pose.held[0] === false")


def test_a_drawer_is_taught_in_the_browser(chromium, tmp_path):
    """The page's large button leads through the lesson, and the drawer is opened by a drag. Its direction is learnt
    within half a degree of the truth, which is only shown on request. The arm opens the drawer by itself, the
    constraint can be downloaded, and everything is there after a reload.
    """
    with program("sawyer", str(tmp_path)) as (_, address), browser_page(chromium, address, 1024, ready=READY) as page:
        for number in range(RECORDINGS):
            press(page, f"Record {number + 1} of 5")
            until(page, "state.doing === 'recording'")
            open_and_shut(page, 0.15 + 0.02 * number)
            press(page, "Stop")
            until(page, f"state.recordings.length === {number + 1}")
        page.keyboard.press("l")
        until(page, "state.answer !== null")
        sentence = page.locator("#headline").inner_text()
        assert "straight line, like a drawer" in sentence and "degrees off" not in page.locator("#teach").inner_text()
        press(page, "Let the arm do it")
        until(page, "state.run && manipLearnTeach.state.run.ended !== ''")
        assert page.evaluate("manipLearnTeach.state.run.ordered"), page.evaluate("manipLearnTeach.state.said")
        until(page, "pose.opening[0] > manipLearnTeach.state.run.wanted - 0.01")  # poses may come later than the state
        press(page, "Reset the arm")
        page.locator("#step-learn > summary").click()
        page.locator("#truth").click()
        wait_until(page, "document.querySelector('#truth-words dl') !== null")
        error = re.search(r"([-0-9.e]+) degrees off", page.locator("#truth-words dl").inner_text())
        assert float(error[1]) < 0.5
        page.locator("#step-take summary").click()
        with page.expect_download() as download:
            page.locator("[data-take=constraint]").click()
        assert download.value.suggested_filename == "constraint.json"
        page.reload()
        wait_until(page, f"{READY} && manipLearnTeach.state.answer !== null")
        assert page.locator("#recordings li").count() == RECORDINGS
        assert page.locator("#headline").inner_text() == sentence


def test_dragging_the_tip_pulls_it_in_the_plane_of_the_view(desk):
    """A pull goes from the tip, in the plane across the view, to the pointer, and ends with a release. With x, y or z
    down it moves along that axis of the base alone; with shift the hand turns instead.
    """
    _, page, posts = desk
    to_eye = np.array(page.evaluate("manipLearnTeach.toEye()"))
    for key in ("", "x", "y", "z", "Shift"):
        posts.clear()
        start = on_screen(page, "tipOnScreen()")
        page.mouse.move(*start)
        page.mouse.down()
        page.keyboard.down(key) if key else None
        page.mouse.move(*(start + [60, -50]), steps=8)
        page.wait_for_timeout(500)
        page.mouse.up()
        page.keyboard.up(key) if key else None
        page.wait_for_timeout(200)
        assert posts[-1] == {"do": "release"}
        pulls = [post for post in posts if post["do"] == "pull"]
        moved = np.array(pulls[-1]["to"]) - pulls[0]["to"]
        if key == "Shift":
            turn = np.array(pulls[-1]["turn"])
            assert np.linalg.norm(np.cross(turn, to_eye)) < 1e-9 < np.linalg.norm(turn)
        elif key:
            np.testing.assert_allclose(np.delete(moved, "xyz".index(key)), 0.0, atol=1e-9)
            assert np.linalg.norm(moved) > 0.01
        else:
            assert abs(to_eye @ moved) < 1e-9 < np.linalg.norm(moved)
            np.testing.assert_allclose(on_screen(page, f"screenOf({pulls[-1]['to']})"), start + [60, -50], atol=0.1)


def test_hostile_names_are_text_and_another_tab_may_take_the_arm(desk):
    """Markup in the names of the robot and of a dropped file is shown as text. Where another tab has the arm, a banner
    says so, and the only thing that can be done is to take it back.
    """
    _, page, posts = desk
    page.evaluate(
        """name => {
            const data = new DataTransfer();
            data.items.add(new File(["no table"], name));
            document.dispatchEvent(new DragEvent("drop", { dataTransfer: data, bubbles: true, cancelable: true }));
        }""",
        f"{EVIL}.csv",
    )
    wait_until(page, "document.getElementById('said').textContent.includes('is not a recording of')")
    assert EVIL in page.locator("#said").inner_text() and page.locator("img").count() == 0
    other = page.context.new_page()
    other.goto(page.url)
    wait_until(other, "window.manipLearnReady && document.getElementById('banner').checkVisibility()")
    assert "Another tab has the arm" in other.locator("#banner").inner_text()
    other.locator("#lead").click()
    wait_until(page, "document.getElementById('banner').checkVisibility()")
    assert page.locator("#record").is_disabled()
    posts.clear()
    page.keyboard.press("r")
    page.locator("#lead").click()
    wait_until(page, "manipLearnTeach.allowed")
    assert posts == [{"do": "lead"}]
    assert page.evaluate("window.hacked") is None and other.evaluate("window.hacked") is None


def test_the_page_says_when_the_program_has_ended(desk):
    """When the program has ended, the page says so and disables everything."""
    child, page, _ = desk
    child.kill()
    wait_until(page, "document.getElementById('banner').innerText.includes('connection to the program is lost')")
    assert page.locator("#record").is_disabled() and not page.evaluate("manipLearnTeach.allowed")
