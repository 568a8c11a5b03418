"""Somebody who has never seen the teaching page: teaches, learns and runs a drawer by what is on the screen."""

from __future__ import annotations

import re
import subprocess
import sys
from contextlib import contextmanager

import numpy as np
import pytest
from teaching_person import Unsteady
from test_playback_browser import browser_page, wait_until

pytestmark = [pytest.mark.browser, pytest.mark.timeout(900)]  # a busy machine draws slowly

READY = "window.manipLearnReady && manipLearnTeach.allowed && manipLearnTeach.pose !== null"
SLOW = pytest.mark.slow
SIZES = [
    pytest.param(1280, 800, False, id="desk", marks=SLOW),
    pytest.param(1024, 700, False, id="laptop"),
    pytest.param(390, 844, True, id="phone", marks=SLOW),
]
SEED, RECORDINGS = 3, 3
AXIS = 0.5  # [degrees] from the truth that a lesson may leave
ASTRAY = 3.0  # [px] of the pointer from where it is meant to be, standard deviation


@contextmanager
def program(folder, *more):
    """`manip-learn teach` as a child process: the address of its page."""
    command = [sys.executable, "-m", "manip_learn", "teach", *more, "--no-browser", "--out", str(folder)]
    child = subprocess.Popen(command, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True)
    try:
        said = next((line for line in child.stderr if "http://" in line), "")
        assert said, "the program ended without a page"
        yield re.search(r"http://\S+", said)[0]
    finally:
        child.terminate()
        child.communicate(timeout=20)


class Stranger:
    """Reads the page, presses what is on the screen, drags what is drawn with an unsteady hand; never scrolls."""

    def __init__(self, page, size, touch):
        self.page, self.size, self.touch = page, size, touch
        self.session = page.context.new_cdp_session(page) if touch else None
        self.unsteady = Unsteady(np.random.default_rng(SEED), 2, ASTRAY)

    def teach(self, what):
        """What the page knows of."""
        return self.page.evaluate(f"manipLearnTeach.{what}")

    def until(self, what):
        """Wait until something is so of what the page knows; learning on a busy machine takes minutes."""
        wait_until(self.page, f"manipLearnTeach.{what}", 300.0)

    def press(self, name):
        """Press the large button, which says this and is wholly on the screen, with nothing over it."""
        said = f"document.querySelector('#actions .next')?.innerText.startsWith({name!r})"
        wait_until(self.page, said, 300.0)
        assert self.page.locator("#actions .next").is_enabled()
        box = self.tap("#actions .next")
        assert 0 <= box["y"] and box["y"] + box["height"] <= self.size[1], (name, box)
        assert 0 <= box["x"] and box["x"] + box["width"] <= self.size[0], (name, box)

    def tap(self, what):
        """Press the middle of a control, over which there is nothing; its box."""
        box = self.page.locator(what).bounding_box()
        middle = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
        hit = "([what, x, y]) => Boolean(document.elementFromPoint(x, y).closest(what))"
        assert self.page.evaluate(hit, [what, *middle]), what
        (self.page.touchscreen.tap if self.touch else self.page.mouse.click)(*middle)
        return box

    def point(self, kind, at):
        """Put down, move or lift the pointer: a mouse's, or a finger."""
        if not self.touch:
            self.page.mouse.move(*at)
            {"start": self.page.mouse.down, "end": self.page.mouse.up}.get(kind, lambda: None)()
            return
        event = {"start": "touchStart", "move": "touchMove", "end": "touchEnd"}[kind]
        points = [] if kind == "end" else [{"x": float(at[0]), "y": float(at[1])}]
        self.session.send("Input.dispatchTouchEvent", {"type": event, "touchPoints": points})

    def draw(self, start, end, seconds):
        """Draw the pointer from one place to another, and pause."""
        n = round(seconds / 0.03)
        for k in range(1, n + 1):
            self.point("move", start + k / n * (end - start) + self.unsteady.at(0.03 * k))
            self.page.wait_for_timeout(30)
        self.page.wait_for_timeout(400)

    def open_and_shut(self, far):
        """Draw the drawer by its handle: the hand comes to it, and follows."""
        rest = np.array(self.teach("scene.handles[0].at"))
        out = np.array(self.teach("scene.furniture[0].fixed.pose")).reshape(4, 4)[:3, 1]
        places = [(rest + by * out).tolist() for by in (0.0, 1.6 * far, -0.3 * far)]
        at, away, shut = (np.array(list(self.teach(f"screenOf({place})").values())) for place in places)
        self.point("start", at)
        self.until("pose.held[0]")
        self.page.wait_for_timeout(600)
        self.draw(at, away, 2.2)
        self.draw(away, shut, 2.2)
        self.point("end", shut)
        self.tap("#grip")
        self.until("pose.held[0] === false")


@pytest.mark.parametrize(("width", "height", "touch"), SIZES)
def test_a_stranger_teaches_a_drawer_without_scrolling(chromium, tmp_path, width, height, touch):
    """In every size, by mouse and by finger: the large button for the next step is always on the screen, the drawer is
    a target of a drag, its direction is learnt within half a degree of the truth, which is told only if that is asked
    for; the arm opens the drawer by itself, the constraint goes home, and all is there when the page is loaded again.
    """
    pytest.importorskip("mujoco", reason="NO MUJOCO: TEACHING IS NOT TESTED")
    look = {"ready": READY, "reduced_motion": "no-preference"}
    with (
        program(tmp_path, "sawyer", "--seed", str(SEED)) as address,
        browser_page(chromium, address, width, height, touch, **look) as page,
    ):
        person, headline = Stranger(page, (width, height), touch), page.locator("#headline")
        for number in range(RECORDINGS):
            person.press(f"Record {number + 1} of 5")
            person.until("state.doing === 'recording'")
            person.open_and_shut(0.15 + 0.02 * number)
            person.press("Stop")
            person.until(f"state.recordings.length === {number + 1}")
        page.keyboard.press("l")
        person.until("state.answer !== null")
        sentence = headline.inner_text()
        assert "straight line, like a drawer" in sentence and "degrees off" not in page.locator("#teach").inner_text()
        assert headline.bounding_box()["y"] + headline.bounding_box()["height"] <= height / 4
        person.press("Let the arm do it")
        person.until("state.doing === 'running'")
        person.until("state.run !== null && manipLearnTeach.state.run.ended !== ''")
        assert person.teach("state.run.ordered"), person.teach("state.said")
        # the pose comes apart from the state, and later on a busy machine
        person.until("pose.opening[0] > manipLearnTeach.state.run.wanted - 0.01")
        person.press("Reset the arm")
        assert page.evaluate("scrollY") == 0
        page.locator("#step-learn > summary").click()
        page.locator("#truth").click()
        wait_until(page, "document.querySelector('#truth-words dl') !== null")
        error = re.search(r"([-0-9.e]+) degrees off", page.locator("#truth-words dl").inner_text())
        assert float(error[1]) < AXIS
        page.locator("#step-take summary").click()
        with page.expect_download() as download:
            page.locator("[data-take=constraint]").click()
        assert download.value.suggested_filename == "constraint.json"
        page.reload()
        wait_until(page, f"{READY} && manipLearnTeach.state.answer !== null")
        assert page.locator("#recordings li").count() == RECORDINGS and headline.inner_text() == sentence
