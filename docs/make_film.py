"""Write the film of `manip-learn teach` that the documentation shows: `python docs/make_film.py [FILE.webp]`.

Needs a Chromium, Playwright, Pillow and the extra `physics`. A mouse takes the arm by the hand, opens and shuts a
drawer five times, and presses Learn; then the arm opens it by itself. Takes about three minutes.
"""

from __future__ import annotations

import base64
import bisect
import io
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from PIL import Image, ImageDraw, ImageFont
from playwright.sync_api import Page, sync_playwright

FLAGS = ["--no-sandbox", "--disable-gpu", "--enable-unsafe-swiftshader"]
MOST_BYTES = 2_000_000
WINDOW = {"width": 1280, "height": 800}  # [px] of the page, in which the whole answer is in view
SIZE = (960, 600)  # [px] of the page in the film
BAR = 40  # [px] for the caption above it
RATE = 9  # pictures a second in the film
STEP = 0.02  # [s] between two places of the mouse
CLOSER = 400  # [px] of the mouse's wheel, until arm and drawer fill the picture
QUALITY = 58  # of the pictures, as WebP counts it: letters stay legible
SEED = 3  # a drawer that stands beside the arm, so that neither hides the other
SHOWN = 5  # motions, as many as the page asks for
FAR = 0.24  # [m] that the drawer is pulled: about as far as drawers go, and where it ends it stops the hand
INK, FAINT, PAPER = (27, 31, 36), (90, 98, 108), (255, 255, 255)


class Scene(NamedTuple):
    """A stretch of what was filmed: from when to when, its seconds in the film, and the words above it."""

    start: float
    end: float
    seconds: float
    words: str


class Camera:
    """Pictures of the page as it changes, with the clock's time [s]."""

    def __init__(self, page: Page):
        self.times: list[float] = []
        self.pictures: list[bytes] = []
        self._session = page.context.new_cdp_session(page)
        self._session.on("Page.screencastFrame", self._take)
        self._session.send("Page.startScreencast", {"format": "jpeg", "quality": 92, "everyNthFrame": 3})

    def _take(self, frame: dict[str, Any]) -> None:
        self.times.append(frame["metadata"]["timestamp"])
        self.pictures.append(base64.b64decode(frame["data"]))
        self._session.send("Page.screencastFrameAck", {"sessionId": frame["sessionId"]})

    def stop(self) -> None:
        """Take no more pictures."""
        self._session.send("Page.stopScreencast")

    def at(self, when: float) -> Image.Image:
        """The picture that was on the screen then."""
        number = max(bisect.bisect_right(self.times, when) - 1, 0)
        return Image.open(io.BytesIO(self.pictures[number])).convert("RGB")


class Person:
    """Moves the mouse as a person does, and remembers where it was."""

    def __init__(self, page: Page):
        self.page, self.x, self.y, self.down = page, 420.0, 330.0, False
        self.track: list[tuple[float, float, float, bool]] = []
        self._move(self.x, self.y)
        self._handle, self._home = (np.array(self.say(where)) for where in ("scene.handles[0].at", "tip()"))

    def say(self, expression: str) -> Any:
        """Something of the page's teaching object."""
        return self.page.evaluate(
            f"(({{ scene, state, pose, tip, tipOnScreen, screenOf, toEye }}) => {expression})(manipLearnTeach)"
        )

    def _move(self, x: float, y: float) -> None:
        self.x, self.y = x, y
        self.page.mouse.move(x, y)
        self.track.append((time.time(), x, y, self.down))

    def go(self, x: float, y: float, seconds: float = 0.7) -> None:
        """The mouse to a place of the page."""
        x0, y0, began = self.x, self.y, time.time()
        while (share := (time.time() - began) / seconds) < 1.0:
            self._move(x0 + smooth(share) * (x - x0), y0 + smooth(share) * (y - y0))
            self.rest(STEP)
        self._move(x, y)

    def rest(self, seconds: float) -> None:
        """Wait while the page goes on."""
        self.page.wait_for_timeout(1000.0 * seconds)

    def press(self, selector: str) -> None:
        """Click a button where it is."""
        button = self.page.locator(selector)
        button.scroll_into_view_if_needed()
        box = button.bounding_box()
        assert box is not None  # it can be seen
        self.go(box["x"] + 0.6 * box["width"], box["y"] + 0.6 * box["height"])
        self.down = True
        self._move(self.x, self.y)
        self.page.mouse.down()
        self.rest(0.12)
        self.page.mouse.up()
        self.down = False
        self._move(self.x, self.y)

    def take_hand(self) -> None:
        """Press on the tip of the arm."""
        at = self.say("tipOnScreen()")
        self.go(at["x"], at["y"])
        self.down = True
        self.page.mouse.down()
        self._move(at["x"], at["y"])

    def let_go(self) -> None:
        """Let the arm go."""
        self.page.mouse.up()
        self.down = False
        self._move(self.x, self.y)

    def drag(self, to: Sequence[float] | np.ndarray, seconds: float) -> None:
        """The mouse to where a place of the robot's base is on the page."""
        at = self.say(f"screenOf({list(map(float, to))})")
        self.go(at["x"], at["y"], seconds)

    def wait_for(self, condition: str, seconds: float) -> None:
        """Wait until something of the page's teaching object is so."""
        end = time.time() + seconds
        while not self.say(condition):
            if time.time() > end:
                raise SystemExit(f"{condition} did not come to pass; the page says {self.say('state.said')!r}")
            self.rest(0.05)

    def demonstrate(self, rng: np.random.Generator) -> None:
        """Record one motion: to the handle, open, shut, and away."""
        known = self.say("state.recordings.length")
        self.press("#record")
        self.wait_for("state.doing === 'recording'", 5.0)
        self.take_hand()
        handle, home = self._handle, self._home
        out, eye = (home - handle) / np.linalg.norm(home - handle), np.array(self.say("toEye()"))
        self.drag(handle, rng.uniform(1.2, 1.6))
        self.wait_for("pose.held[0]", 10.0)
        self.rest(0.4)
        # a pull in the plane of the view does less along a way that comes out of it
        far = FAR * rng.uniform(0.9, 1.0) / (1.0 - (out @ eye) ** 2)
        for way in (far, 0.0):
            self.drag(handle + way * out, rng.uniform(1.5, 2.0))
            self.rest(0.2)
        self.page.keyboard.press("g")
        self.wait_for("pose.held[0] === false", 5.0)
        self.drag(home + rng.normal(0.0, 0.03, 3), rng.uniform(0.9, 1.2))
        self.let_go()
        self.rest(0.3)
        self.press("#record")
        self.wait_for(f"state.recordings.length > {known}", 10.0)


def smooth(share: float) -> float:
    """From 0 to 1 without a jerk."""
    x = min(max(share, 0.0), 1.0)
    return x * x * (3.0 - 2.0 * x)


@contextmanager
def program(folder: Path) -> Iterator[str]:
    """`manip-learn teach` as a process; its page's address."""
    command = [sys.executable, "-m", "manip_learn", "teach", "sawyer", "--no-browser", "--seed", str(SEED)]
    running = subprocess.Popen(
        [*command, "--out", str(folder)],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, "OMP_NUM_THREADS": "1"},
    )
    assert running.stderr is not None  # a pipe was asked for
    try:
        address = next((found[0] for line in running.stderr if (found := re.search(r"http://\S+", line))), None)
        if address is None:
            raise SystemExit("manip-learn teach has not started; run it by hand to see why")
        yield address
    finally:
        running.terminate()
        running.wait(20.0)


def act(page: Page, person: Person) -> list[Scene]:
    """All that is filmed."""
    rng, marks = np.random.default_rng(SEED), [time.time()]

    def scene(seconds: float, words: str) -> Scene:
        marks.append(time.time())
        return Scene(marks[-2], marks[-1], seconds, words)

    person.rest(0.5)
    person.demonstrate(rng)
    scenes = [scene(5.5, "1   Take the arm by the hand: open a drawer")]
    for _ in range(SHOWN - 1):
        person.demonstrate(rng)
    scenes += [scene(2.2, f"1   Show it {SHOWN} times")]
    person.press("#learn")
    person.wait_for("state.answer !== null && state.progress === null", 120.0)
    if person.say("state.answer.refused") or not person.say("state.can.run"):
        raise SystemExit(f"nothing was learnt: {person.say('state.answer.evidence')}")
    page.locator("#answer").scroll_into_view_if_needed()
    scenes += [scene(1.2, "2   Learn")]
    person.go(520.0, 120.0, 0.4)  # off the sentence
    person.rest(2.6)
    scenes += [scene(3.0, "2   It says what it understood")]
    person.press("#run")
    person.wait_for("state.doing === 'running'", 60.0)
    scenes += [scene(1.2, "3   It plans the whole motion")]
    person.wait_for("state.run && state.run.ended && state.doing === 'idle'", 60.0)
    scenes += [scene(6.0, "3   The arm opens the drawer by itself")]
    if person.say("pose.opening[0]") < 0.9 * person.say("state.run.wanted"):
        raise SystemExit(f"the drawer was not opened: {person.say('state.said')}")
    person.rest(2.2)
    return [*scenes, scene(2.2, "3   The arm opens the drawer by itself")]


def cursor(draw: ImageDraw.ImageDraw, x: float, y: float, down: bool) -> None:
    """An arrow at the mouse, with a ring while a button is down."""
    if down:
        draw.ellipse((x - 13, y - 13, x + 13, y + 13), outline=(0, 114, 178), width=3)
    arrow = ((0, 0), (0, 17), (4, 13), (7, 20), (10, 19), (7, 12), (13, 12))
    draw.polygon([(x + a, y + b) for a, b in arrow], fill=INK, outline=PAPER)


def draw_picture(camera: Camera, person: Person, when: float, words: str, speed: float) -> Image.Image:
    """One picture of the film."""
    page, film = (
        camera.at(when).resize(SIZE, Image.Resampling.LANCZOS),
        Image.new("RGB", (SIZE[0], SIZE[1] + BAR), PAPER),
    )
    film.paste(page, (0, BAR))
    draw, scale = ImageDraw.Draw(film), SIZE[0] / WINDOW["width"]
    draw.text((14, BAR / 2), words, INK, ImageFont.load_default(22), anchor="lm")
    if speed >= 1.5:
        faster = f"{speed:.0f} times as fast"
        draw.text((SIZE[0] - 14, BAR / 2), faster, FAINT, ImageFont.load_default(15), anchor="rm")
    number = max(bisect.bisect_right([at for at, *_ in person.track], when) - 1, 0)
    _, x, y, down = person.track[number]
    cursor(draw, scale * x, BAR + scale * y, down)
    return film


def cut(camera: Camera, person: Person, scenes: Sequence[Scene]) -> list[Image.Image]:
    """The pictures of the film, evenly spaced."""
    pictures = []
    for start, end, seconds, words in scenes:
        n, speed = round(RATE * seconds), (end - start) / seconds
        moments = start + (end - start) * (np.arange(n) + 0.5) / n
        pictures += [draw_picture(camera, person, when, words, speed) for when in moments]
    return pictures


def film(folder: Path) -> list[Image.Image]:
    """Start the program and the browser, do it all, and cut the film."""
    names = ("chromium", "chromium-browser", "google-chrome")
    chromium = next((path for name in names if (path := shutil.which(name))), None)
    with program(folder) as address, sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=chromium, args=FLAGS)
        page = browser.new_page(viewport=WINDOW, color_scheme="light")  # type: ignore[arg-type]
        page.goto(address)
        page.wait_for_function(
            "window.manipLearnTeach && manipLearnTeach.state && manipLearnTeach.pose", timeout=30_000
        )
        person = Person(page)
        page.mouse.wheel(0, -CLOSER)
        person.rest(1.5)
        camera = Camera(page)
        scenes = act(page, person)
        camera.stop()
        person.rest(0.5)  # until the last picture has come
        browser.close()
    return cut(camera, person, scenes)


def main(path: Path) -> None:
    """Write the film."""
    with tempfile.TemporaryDirectory() as scratch:
        first, *others = film(Path(scratch) / "taught")
    first.save(path, save_all=True, append_images=others, duration=1000 // RATE, loop=0, quality=QUALITY, method=4)
    size = path.stat().st_size
    print(f"{path}: {size:,} bytes, {(1 + len(others)) / RATE:.1f} s")
    if size > MOST_BYTES:
        raise SystemExit(f"{path} has {size:,} bytes, {MOST_BYTES:,} are allowed: lower QUALITY or RATE")


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).parent / "images" / "teach.webp")
