"""Write the pictures of the replay that the documentation shows: `python docs/make_images.py [FOLDER]`.

Needs a Chromium, Playwright and Pillow. The pages are those of the command line, from the shipped recordings.
"""

from __future__ import annotations

import contextlib
import io
import shutil
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from PIL import Image
from playwright.sync_api import Browser, sync_playwright

from manip_learn.cli import main as manip_learn
from manip_learn.commands.demo import shipped_recordings

FLAGS = ["--no-sandbox", "--disable-gpu", "--enable-unsafe-swiftshader"]
MOST_BYTES = 200_000


class Picture(NamedTuple):
    """One picture: the page, what is done in it first, and the window."""

    name: str
    page: str
    steps: Sequence[str]
    dark: bool = False
    width: int = 1280
    height: int = 860


def click(selector: str) -> str:
    """JavaScript that clicks an element."""
    return f"document.querySelector({selector!r}).click()"


def opened(card: str) -> str:
    """JavaScript that opens a card."""
    return f"document.getElementById({card!r}).open = true"


SHOW_ELLIPSOID, FIT = click("[data-shown=ellipsoid]"), click("[name=colours][value=fit]")
TRACKS = [click(f"[data-track={kind}]") for kind in ("singular", "velocity")]
PICTURES = (
    Picture("replay_drawer", "drawer", ["manipLearn.seek(6.6)", *TRACKS], height=960),
    Picture("replay_learn", "learn", ["manipLearn.seek(11)"]),
    Picture("replay_hinge", "hinge", ["manipLearn.seek(1.6)", SHOW_ELLIPSOID]),
    Picture("replay_recordings", "mixed", ["manipLearn.seek(5.2)", FIT, opened("choice")], width=1440),
    Picture("replay_evidence", "mixed", ["manipLearn.seek(5.2)", opened("evidence")], width=1440),
    Picture("replay_dark", "drawer", ["manipLearn.seek(6.6)", TRACKS[0]], dark=True),
    Picture("replay_phone", "hinge", ["manipLearn.seek(1.6)"], width=390, height=844),
)


def write_pages(folder: Path) -> dict[str, str]:
    """Name -> address of the pages, written by the command line as its user types it."""
    for name in ("ur5_loose_door", "panda_drawer_mixed", "xarm7_drawer_then_table"):
        shutil.copytree(shipped_recordings() / name, folder / name)
    fingers = "--lock panda_finger_joint1 --lock panda_finger_joint2"
    commands = {
        "drawer": "demo --no-browser --out .",
        "learn": "learn xarm7 xarm7_drawer_then_table --frame link_eef --html learn.html",
        "hinge": "learn ur5 ur5_loose_door --frame tool0 --html hinge.html",
        "mixed": f"learn panda panda_drawer_mixed --frame panda_hand_tcp {fingers} --html mixed.html",
    }
    with contextlib.chdir(folder):
        for name, words in commands.items():
            if manip_learn(words.split()):
                raise SystemExit(f"the page {name!r} could not be written")
    pages = {name: folder / f"{name}.html" for name in commands} | {"drawer": folder / "replay.html"}
    return {name: page.as_uri() for name, page in pages.items()}


def photograph(browser: Browser, picture: Picture, address: str) -> bytes:
    """The window as a PNG."""
    size = {"width": picture.width, "height": picture.height}
    context = browser.new_context(viewport=size, color_scheme="dark" if picture.dark else "light")  # type: ignore[arg-type]
    page = context.new_page()
    page.goto(address)
    end = time.monotonic() + 60.0
    while not page.evaluate("window.manipLearnReady === true") and time.monotonic() < end:
        page.wait_for_timeout(50)
    for step in picture.steps:
        page.evaluate(step)
    page.wait_for_timeout(800)
    content = page.screenshot()
    context.close()
    return content


def main(folder: Path) -> None:
    """Write all pictures."""
    chromium = next(
        (path for n in ("chromium", "chromium-browser", "google-chrome") if (path := shutil.which(n))), None
    )
    folder.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as scratch, sync_playwright() as playwright:
        pages = write_pages(Path(scratch))
        browser = playwright.chromium.launch(executable_path=chromium, args=FLAGS)
        for picture in PICTURES:
            image = Image.open(io.BytesIO(photograph(browser, picture, pages[picture.page])))
            path = folder / f"{picture.name}.png"
            fewer = image.convert("RGB").quantize(256, Image.Quantize.MAXCOVERAGE, 4, dither=Image.Dither.NONE)
            fewer.save(path, optimize=True)
            size = path.stat().st_size
            print(f"{path}: {size:,} bytes")
            if size > MOST_BYTES:
                raise SystemExit(f"{path} has {size:,} bytes, {MOST_BYTES:,} are allowed: make the window smaller")
        browser.close()


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).parent / "images")
