"""Somebody who has never seen the teaching page: teaches, learns and runs a drawer by what is on the screen."""

from __future__ import annotations

import re
import subprocess
import sys
from contextlib import contextmanager

import numpy as np
import pytest
from test_playback_browser import browser_page, wait_until

pytestmark = [pytest.mark.browser, pytest.mark.timeout(900)]  # a busy machine draws slowly

RECORDINGS = 3
READY = "window.manipLearnReady && manipLearnTeach.allowed && manipLearnTeach.pose !== null"


@contextmanager
def program(folder):
    """Run `manip-learn teach` as a child process, and give the address of its page."""
    command = [sys.executable, "-m", "manip_learn", "teach", "sawyer", "--seed", "3", "--no-browser", "--out", folder]
    child = subprocess.Popen(command, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True)
    try:
        line = next((line for line in child.stderr if "http://" in line), "")
        assert line, "the program ended without a page"
        yield re.search(r"http://\S+", line)[0]
    finally:
        child.terminate()
        child.communicate(timeout=20)


def press(page, name):
    """Press the large button when it has this name and is enabled; learning on a busy machine takes minutes."""
    wait_until(page, f"document.querySelector('#actions .next')?.innerText.startsWith({name!r})", 300.0)
    assert page.locator("#actions .next").is_enabled()
    page.locator("#actions .next").click()


def until(page, condition):
    """Wait until a condition on the page's state holds."""
    wait_until(page, f"manipLearnTeach.{condition}", 300.0)


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
    at, away, shut = (np.array(list(page.evaluate(f"manipLearnTeach.screenOf({place})").values())) for place in places)
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
    pytest.importorskip("mujoco", reason="NO MUJOCO: TEACHING IS NOT TESTED")
    with program(str(tmp_path)) as address, browser_page(chromium, address, 1024, ready=READY) as page:
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
