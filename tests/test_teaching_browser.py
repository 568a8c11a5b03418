"""`manip-learn teach` as a person meets it: the program as a child process, its page in Chromium, a mouse, keys."""

from __future__ import annotations

import re
from contextlib import contextmanager
from urllib.parse import urlsplit

import numpy as np
import pytest
from mouse_person import MousePerson, program
from test_playback_browser import wait_until

pytestmark = [pytest.mark.browser, pytest.mark.timeout(400)]

WINDOW = {"width": 900, "height": 640}
SEED, RECORDINGS = 3, 3
AXIS = 0.5  # [degrees] from the truth that a lesson may leave


@contextmanager
def tab(chromium, address):
    """The page in a window of its own; what goes wrong in it, or wants another host, fails at last."""
    pytest.importorskip("mujoco", reason="NO MUJOCO: TEACHING IS NOT TESTED")
    trouble = []
    context = chromium.new_context(viewport=WINDOW)
    page = context.new_page()
    page.on("pageerror", lambda error: trouble.append(str(error)))
    own = (f"http://{urlsplit(address).netloc}/", "data:", "blob:")
    context.on("request", lambda one: None if one.url.startswith(own) else trouble.append(one.url))
    page.goto(address)
    wait_until(page, "window.manipLearnReady && manipLearnTeach.allowed && manipLearnTeach.pose !== null")
    yield page
    context.close()
    assert trouble == []


def test_a_lesson(chromium, tmp_path):
    """A drawer is opened by the mouse, with an unsteady hand and pauses, a few times; Learn finds its direction within
    half a degree of the truth, Run opens it, the constraint goes home, and all is there when the page is loaded again.
    """
    pytest.importorskip("mujoco", reason="NO MUJOCO: TEACHING IS NOT TESTED")
    with program(tmp_path, "sawyer", "--seed", str(SEED)) as (_, address), tab(chromium, address) as page:
        person = MousePerson(page, seed=1)
        out = np.array(person.teach("scene.furniture[0].fixed.pose")).reshape(4, 4)[:3, 1]
        for _ in range(RECORDINGS):
            person.demonstrate(lambda one: one.open_and_shut(float(one.rng.uniform(0.16, 0.22)), out))
        assert person.teach("drawnSeq") > 0
        assert page.locator("#recordings li").count() == RECORDINGS
        page.keyboard.press("l")
        wait_until(page, "manipLearnTeach.state.answer !== null")
        assert not person.teach("state.answer.refused"), person.teach("state.said")
        assert "degrees off" not in page.locator("#teach").inner_text()  # the truth is not told unasked
        page.locator("#step-learn > summary").click()
        page.locator("#truth").click()
        wait_until(page, "document.querySelector('#truth-words dl') !== null")
        error = re.search(r"([-0-9.e]+) degrees off", page.locator("#truth-words dl").inner_text())
        assert float(error[1]) < AXIS
        page.locator("#run").click()
        wait_until(page, "manipLearnTeach.state.run !== null && manipLearnTeach.state.run.ended !== ''")
        assert person.teach("state.run.ordered"), person.teach("state.said")
        # the pose comes apart from the state, and later on a busy machine
        wait_until(page, "Math.abs(manipLearnTeach.pose.opening[0] - manipLearnTeach.state.run.wanted) < 0.01")
        page.locator("#step-take summary").click()
        with page.expect_download() as download:
            page.locator("[data-take=constraint]").click()
        assert download.value.suggested_filename == "constraint.json"
        sentence = page.locator("#answer .headline").text_content()
        page.reload()
        wait_until(page, "window.manipLearnReady && manipLearnTeach.allowed && manipLearnTeach.state.answer !== null")
        assert page.locator("#recordings li").count() == RECORDINGS
        assert page.locator("#answer .headline").text_content() == sentence
