"""Somebody who has never seen the teaching page: teaches, learns and runs a drawer by what is on the screen."""

from __future__ import annotations

import numpy as np
import pytest
from mouse_person import READY, MousePerson, program
from test_playback_browser import browser_page, wait_until

pytestmark = [pytest.mark.browser, pytest.mark.slow, pytest.mark.timeout(900)]  # a busy machine draws slowly

SIZES = {"desk": (1280, 800, False), "laptop": (1024, 700, False), "phone": (390, 844, True)}
SEED, RECORDINGS = 3, 3


class Stranger(MousePerson):
    """Reads the page, presses what is on the screen, drags what is drawn; never scrolls."""

    def __init__(self, page, size, touch):
        super().__init__(page, SEED)
        self.size, self.touch = size, touch
        self.session = page.context.new_cdp_session(page) if touch else None

    def until(self, what):
        """Wait until something is so; learning on a busy machine takes minutes."""
        wait_until(self.page, what, 300.0)

    def press(self, name):
        """Press the large button, which says this and is wholly on the screen, with nothing over it."""
        self.until(f"document.querySelector('#actions .next')?.innerText.startsWith({name!r})")
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
        """Draw the pointer from one place to another."""
        n = round(seconds / 0.03)
        for k in range(1, n + 1):
            self.point("move", start + k / n * (end - start))
            self.page.wait_for_timeout(30)

    def open_and_shut(self, far):
        """Draw the drawer by its handle: the hand comes to it, and follows."""
        rest = np.array(self.teach("scene.handles[0].at"))
        out = np.array(self.teach("scene.furniture[0].fixed.pose")).reshape(4, 4)[:3, 1]
        at, away, shut = (self.screen(rest + by * out) for by in (0.0, 1.6 * far, -0.3 * far))
        self.point("start", at)
        self.until("manipLearnTeach.pose.held[0]")
        self.page.wait_for_timeout(600)
        self.draw(at, away, 2.2)
        self.draw(away, shut, 2.2)
        self.page.wait_for_timeout(400)
        self.point("end", shut)
        self.tap("#grip")
        self.until("!manipLearnTeach.pose.held[0]")


@pytest.mark.parametrize("size", SIZES.values(), ids=SIZES)
def test_a_stranger_teaches_a_drawer_without_scrolling(chromium, tmp_path, size):
    """In every size, by mouse and by finger: the large button for the next step is always on the screen, the drawer is
    a target of a drag, the answer is one line above the arm, and the arm opens the drawer by itself.
    """
    pytest.importorskip("mujoco", reason="NO MUJOCO: TEACHING IS NOT TESTED")
    width, height, touch = size
    with (
        program(tmp_path, "sawyer", "--seed", str(SEED)) as (_, address),
        browser_page(chromium, address, width, height, touch, ready=READY, reduced_motion="no-preference") as page,
    ):
        person = Stranger(page, (width, height), touch)
        for number in range(RECORDINGS):
            person.press(f"Record {number + 1} of 5")
            person.until("manipLearnTeach.state.doing === 'recording'")
            person.open_and_shut(0.15 + 0.02 * number)
            person.press("Stop")
            person.until(f"manipLearnTeach.state.recordings.length === {number + 1}")
        page.keyboard.press("l")
        person.until("manipLearnTeach.state.answer !== null")
        headline = page.locator("#headline")
        assert "straight line, like a drawer" in headline.inner_text()
        assert headline.bounding_box()["y"] + headline.bounding_box()["height"] <= person.size[1] / 4
        person.press("Let the arm do it")
        person.until("manipLearnTeach.state.doing === 'running'")
        person.until("manipLearnTeach.state.run !== null && manipLearnTeach.state.run.ended !== ''")
        assert person.teach("state.run.ordered"), person.teach("state.said")
        person.press("Reset the arm")
        assert page.evaluate("scrollY") == 0
