"""Write the pictures of the replay and of arms that the documentation shows: `python docs/make_images.py [FOLDER]`.

Needs a Chromium, Playwright, Pillow and the extra `robots`. The pages of the replay are those of the command line, from
the shipped recordings.
"""

from __future__ import annotations

import contextlib
import io
import shutil
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import meshcat
import numpy as np
from PIL import Image
from playwright.sync_api import Browser, sync_playwright

import manip_learn as ml
from manip_learn.cli import main as manip_learn
from manip_learn.control.simulation import simulate_way
from manip_learn.recordings.files import shipped_recordings

FLAGS = ["--no-sandbox", "--disable-gpu", "--enable-unsafe-swiftshader"]
MOST_BYTES, MOST_ARM_BYTES = 200_000, 30_000
SLOWEST = 240_000.0  # [ms] for a page on a machine that has more to do
ARM_WINDOW, ARM_SIZE = (640, 520), (320, 260)  # [px] of the page, which is made smaller to smooth its edges
UR, FRANKA = (40, -85, 95, -100, -90, 0), (25, -30, 0, -125, 0, 105, 45)
ARMS = {  # [deg] a posture in which the arm can be told
    "panda": FRANKA,
    "ur5e": UR,
    "xarm7": (25, -20, 0, 70, 0, 90, 0),
    "so101": (20, -35, 35, 35, 0, 20),
}
FILM, FILM_SECONDS, MOST_FILM_BYTES = (960, 720), 8.0, 1_500_000  # [px], [s] of a loop
# [rad] the hand is at the shut drawer; number 57 of the starts drawn with seed 20000 and brought to within 0.02
# of a singularity of what is held and driven: of these 57, seven stop within a third of the way without a plan
PAIR = (0.5374, -0.8046, 0.7743, -2.7548, 1.6547, 3.2939, -2.7873)
OWN_VIEWER = Path(__file__).parent / "examples" / "your_own_viewer.webp"
ONLY_FILM = "header > :not(h1, p), #notes, .sheet, #transport, #status-key { display: none !important }"
ONLY_ARM = "header, #panel, #transport, #legend, #notes { display: none !important } #stage { grid-row: 1 / -1 }"


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


FIT = click("[name=colours][value=fit]")
TRACKS = [click(f"[data-track={kind}]") for kind in ("singular", "velocity")]
PICTURES = (
    Picture("replay_drawer", "drawer", ["manipLearn.seek(7.1)", *TRACKS], height=960),
    Picture("replay_learn", "learn", ["manipLearn.seek(11)"]),
    Picture("replay_recordings", "mixed", ["manipLearn.seek(5.2)", FIT], width=1440),
    Picture("replay_evidence", "mixed", ["manipLearn.seek(5.2)", opened("evidence")], width=1440),
)


def write_pages(folder: Path) -> dict[str, str]:
    """Name -> address of the pages, written by the command line as its user types it."""
    for name in ("panda_drawer_mixed", "xarm7_drawer_then_table"):
        shutil.copytree(shipped_recordings() / name, folder / name)
    fingers = "--lock panda_finger_joint1 --lock panda_finger_joint2"
    commands = {
        "drawer": "demo --no-browser --out .",
        "learn": "learn xarm7 xarm7_drawer_then_table --frame link_eef --html learn.html",
        "mixed": f"learn panda panda_drawer_mixed --frame panda_hand_tcp {fingers} --html mixed.html",
    }
    with contextlib.chdir(folder):
        for name, words in commands.items():
            if manip_learn(words.split()):
                raise SystemExit(f"the page {name!r} could not be written")
    pages = {name: folder / f"{name}.html" for name in commands} | {"drawer": folder / "replay.html"}
    return {name: page.as_uri() for name, page in pages.items()}


def write_pair(folder: Path) -> str:
    """Address of a page with two panes: a Panda opens the drawer of its recordings without and with what was learnt."""
    robot = ml.load_robot("panda", locked={"panda_finger_joint1": 0.04, "panda_finger_joint2": 0.04})
    demos = ml.load_demonstrations(shipped_recordings() / "panda_drawer_whole", robot)
    learner = ml.ConstraintLearner(ml.FrameJacobian(robot, "panda_hand_tcp")).fit(demos)
    task = ml.motion(learner.constraint_, keep_orientation=True, pause=0.5)
    without, way = simulate_way(robot, ml.ResolvedRateController(learner.constraint_, task), np.array(PAIR))
    again = ml.repeat(learner.skill_, PAIR)
    done = 100.0 * again.steps[1].done
    title = f"Without: {100 * way.done:.0f} of {done:.0f} cm, then a joint is at its limit. With: all {done:.0f} cm."
    runs = {"without": without, "with": again.rollout}
    page = ml.replay(
        robot, runs, folder / "pair.html", tip="panda_hand_tcp", title=title, side_by_side=True, align="grasp"
    )
    return page.html.as_uri()


def write_arms(folder: Path) -> dict[str, str]:
    """Name -> address of a page in which nothing but an arm is seen."""
    pages = {}
    for name, degrees in ARMS.items():
        robot = ml.load_robot(name)
        q = robot.neutral()
        q[: len(degrees)] = np.deg2rad(degrees)
        still = ml.Trajectory(np.array([0.0, 1.0]), np.array([q, q]))
        page = ml.replay(robot, {name: still}, folder / f"{name}.html").html
        pages[name] = page.as_uri()
    return pages


def own_viewer(browser: Browser) -> Image.Image:
    """Meshcat's page with the arm, the drawer's line and the grasps of its recordings, as example 11 draws them."""
    viewer = meshcat.Visualizer()
    robot = ml.load_robot("sawyer")
    demos = ml.load_demonstrations("sawyer_drawer", robot)
    learner = ml.ConstraintLearner(ml.FrameJacobian(robot, "right_gripper_tip")).fit(demos)
    page = browser.new_page(viewport={"width": ARM_WINDOW[0], "height": ARM_WINDOW[1]}, device_scale_factor=2.0)
    page.goto(viewer.url())
    viewer.wait()
    ml.show(robot, viewer, learner.constraint_, demos[0].q[-1])
    viewer["/Cameras/default/rotated/<object>"].set_property("position", [1.1, 0.9, 0.9])
    for part in ("/Background", "/Grid", "/Axes"):
        viewer[part].set_property("visible", False)
    page.add_style_tag(content=".dg { display: none !important }")  # the controls of the viewer
    page.wait_for_timeout(3000)
    image = Image.open(io.BytesIO(page.screenshot())).convert("RGB")
    page.close()
    return image.crop((500, 100, 1140, 620))  # [px] around the arm


def photograph(browser: Browser, picture: Picture, address: str) -> Image.Image:
    """The window."""
    size, scheme = {"width": picture.width, "height": picture.height}, "dark" if picture.dark else "light"
    context = browser.new_context(viewport=size, color_scheme=scheme, reduced_motion="reduce")  # type: ignore[arg-type]
    context.set_default_timeout(SLOWEST)
    page = context.new_page()
    page.goto(address)
    page.wait_for_function("window.manipLearnReady === true")
    for step in picture.steps:
        page.evaluate(step)
    page.wait_for_timeout(2_000)  # a full frame follows when nothing moves
    content = page.screenshot()
    context.close()
    return Image.open(io.BytesIO(content))


def film(browser: Browser, address: str) -> list[Image.Image]:
    """Frames of the two panes, from the approach to a while after the end of the way."""
    context = browser.new_context(viewport={"width": FILM[0], "height": FILM[1]}, reduced_motion="reduce")
    context.set_default_timeout(SLOWEST)
    page = context.new_page()
    page.goto(address)
    page.wait_for_function("window.manipLearnReady === true")
    page.add_style_tag(content=ONLY_FILM)
    page.locator("#scene").press("+")  # nearer
    page.evaluate("document.activeElement.blur()")
    page.wait_for_timeout(500)
    frames, zero = [], page.evaluate("JSON.parse(document.getElementById('data').textContent).zero")
    for t in np.concatenate([np.linspace(zero - 3.0, zero - 0.1, 14), np.linspace(zero, zero + 1.6, 26)]).tolist():
        page.evaluate("t => manipLearn.seek(t)", t)
        page.wait_for_timeout(1_500)  # a full frame follows when nothing moves
        frames.append(Image.open(io.BytesIO(page.screenshot())).convert("RGB"))
    context.close()
    return frames


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
            image = photograph(browser, picture, pages[picture.page]).convert("RGB")
            fewer = image.quantize(112, Image.Quantize.MAXCOVERAGE, 4, dither=Image.Dither.NONE)
            save(fewer, folder / f"{picture.name}.png", MOST_BYTES)
        first, *others = film(browser, write_pair(Path(scratch)))
        times = [round(1000.0 * FILM_SECONDS / 44)] * len(others) + [round(4000.0 * FILM_SECONDS / 44)]
        made = folder / "pair.webp"
        first.save(made, save_all=True, append_images=others, duration=times, loop=0, quality=62, method=6)
        if made.stat().st_size > MOST_FILM_BYTES:
            raise SystemExit(f"{made} has {made.stat().st_size:,} bytes, {MOST_FILM_BYTES:,} are allowed")
        save(own_viewer(browser).resize(ARM_SIZE, Image.Resampling.LANCZOS), OWN_VIEWER, MOST_ARM_BYTES)
        alone = f"document.head.append(Object.assign(document.createElement('style'), {{ textContent: {ONLY_ARM!r} }}))"
        for name, address in write_arms(Path(scratch)).items():
            image = photograph(browser, Picture(name, name, [alone], False, *ARM_WINDOW), address).convert("RGB")
            save(image.resize(ARM_SIZE, Image.Resampling.LANCZOS), folder / "arms" / f"{name}.webp", MOST_ARM_BYTES)
        browser.close()


def save(image: Image.Image, path: Path, most: int) -> None:
    """Write a picture that is small enough."""
    path.parent.mkdir(parents=True, exist_ok=True)
    image.save(path, optimize=True, quality=86, method=6)
    size = path.stat().st_size
    print(f"{path}: {size:,} bytes")
    if size > most:
        raise SystemExit(f"{path} has {size:,} bytes, {most:,} are allowed: make the window smaller")


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).parent / "images")
