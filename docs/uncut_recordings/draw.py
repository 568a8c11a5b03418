"""Draw the pictures of uncut recordings from the shipped recordings: `python docs/uncut_recordings/draw.py`.

Needs the extras `robots` and `experiments`, and for the picture of the replay Playwright and a Chromium.
"""

from __future__ import annotations

import io
import shutil
import tempfile
from pathlib import Path

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from PIL import Image

import manip_learn as ml
from manip_learn.learning import LearningReport
from manip_learn.playback.palette import phase_kinds

HERE = Path(__file__).parent
RECORDINGS = HERE.parents[1] / "examples" / "data"
FINGERS = ("panda_finger_joint1", "panda_finger_joint2")
FLAGS = ["--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-background-networking"]


def main() -> None:
    """Learn from three folders and draw a picture of each."""
    matplotlib.rcParams.update({"font.size": 9, "svg.hashsalt": "manip_learn", "svg.fonttype": "none"})
    draw_phases(*learnt("panda_drawer_mixed", ml.load_robot("panda", locked=FINGERS), "panda_hand_tcp"))
    draw_hinge(*learnt("ur5_loose_door", ml.load_robot("ur5"), "tool0"))
    photograph_replay(*learnt("xarm7_drawer_then_table", ml.load_robot("xarm7"), "link_eef"))


def learnt(folder: str, robot: ml.Robot, frame: str) -> tuple[ml.Robot, str, ml.Demonstrations, LearningReport]:
    """The recordings of a folder, and what the learner reports of them."""
    recordings = ml.load_demonstrations(RECORDINGS / folder, robot)
    features = ml.FrameJacobian(robot, frame=frame, axes="xyz", reference="world")
    return robot, frame, recordings, ml.ConstraintLearner(features).fit(recordings).report_


def draw_phases(robot: ml.Robot, frame: str, recordings: ml.Demonstrations, report: LearningReport) -> None:
    """Bands over time, above them how fast the tip moves [m/s]."""
    kinds = phase_kinds(report.phases)
    odd = {name for name, _ in report.odd_trajectories}
    figure = Figure(figsize=(7.2, 4.6), layout="constrained")
    rows = figure.subplots(len(recordings), 1, sharex=True, sharey=True)
    for axes, trajectory in zip(rows, recordings, strict=True):
        draw_speed(axes, robot, frame, trajectory)
        for name, start, end, constraint, _ in report.phases:
            if name == trajectory.name:
                kind = kinds[-1 if constraint is None else constraint]
                axes.axvspan(start, end, color=kind.colour, alpha=0.75, linewidth=0)
        label = Path(trajectory.name).stem + ("\n(odd)" if trajectory.name in odd else "")
        axes.set_ylabel(label, rotation=0, ha="right", va="center")
        axes.set_yticks([])
        axes.spines[["top", "right", "left"]].set_visible(False)
    rows[-1].set_xlabel("time [s]; black line: speed of the tip")
    handles = [Line2D([], [], color=k.colour, linewidth=8, label=k.label) for k in kinds]
    figure.legend(handles=handles, loc="outside upper center", ncols=len(kinds), frameon=False)
    figure.savefig(HERE / "phases.svg", metadata={"Date": None})


def draw_speed(axes: Axes, robot: ml.Robot, frame: str, trajectory: ml.Trajectory) -> None:
    """Speed of the tip, smoothed over nine samples."""
    speed = np.linalg.norm(np.gradient(tip_path(robot, frame, trajectory), trajectory.time, axis=0), axis=1)
    smooth = np.convolve(speed, np.full(9, 1.0 / 9.0), mode="same")
    axes.plot(trajectory.time[::3], smooth[::3], color="black", linewidth=1.0)


def draw_hinge(robot: ml.Robot, frame: str, recordings: ml.Demonstrations, report: LearningReport) -> None:
    """A door from above: paths of the tip, the axis and the circle that were found [m]."""
    door = report.mechanism
    if door is None or door.axis is None or door.point is None or door.radius is None:
        raise SystemExit(f"a hinge was expected, got {door}")
    figure = Figure(figsize=(3.8, 4.4), layout="constrained")
    axes = figure.subplots()
    for i, trajectory in enumerate(recordings):
        path = tip_path(robot, frame, trajectory)
        axes.plot(path[:, 0], path[:, 1], color="#0072b2", linewidth=1.5, label=None if i else "tip, six recordings")
    angle = np.linspace(0.0, 2.0 * np.pi, 200)
    x, y = door.point[0] + door.radius * np.cos(angle), door.point[1] + door.radius * np.sin(angle)
    axes.plot(x, y, "--", color="black", linewidth=0.8, label="circle of the hinge")
    axes.plot(door.point[0], door.point[1], "+", color="black", markersize=10, label="axis of the hinge")
    axes.set_aspect("equal")
    axes.set_xlabel("x [m]")
    axes.set_ylabel("y [m]")
    figure.legend(loc="outside lower center", frameon=False)
    figure.savefig(HERE / "hinge.svg", metadata={"Date": None})


def tip_path(robot: ml.Robot, frame: str, trajectory: ml.Trajectory) -> np.ndarray:
    """The tip in the base frame, shape (T, 3) [m]."""
    tip = robot.frame(frame)
    return np.array([robot.pose(q, tip)[:3, 3] for q in trajectory.q])


def photograph_replay(robot: ml.Robot, frame: str, recordings: ml.Demonstrations, report: LearningReport) -> None:
    """The replay of the recordings, at a moment in the second task."""
    from playwright.sync_api import sync_playwright

    browser_file = shutil.which("chromium") or shutil.which("google-chrome")
    with tempfile.TemporaryDirectory() as folder, sync_playwright() as playwright:
        shown = {Path(t.name).stem: t for t in recordings}
        phases = [(Path(p.trajectory).stem, p.start, p.end, p.constraint) for p in report.phases]
        html = Path(folder) / "replay.html"
        ml.replay(robot, shown, html, tip=frame, phases=phases, mechanism=report.mechanism)
        browser = playwright.chromium.launch(executable_path=browser_file, args=[*FLAGS, "--enable-unsafe-swiftshader"])
        page = browser.new_page(viewport={"width": 1000, "height": 640})
        page.goto(html.as_uri())
        while not page.evaluate("window.manipLearnReady === true"):
            page.wait_for_timeout(50)
        page.evaluate("manipLearn.seek(11)")
        page.wait_for_timeout(1000)
        shot = page.screenshot()
        browser.close()
    # 256 colours by octree: a quarter of the size; the median cut would merge the colours of thin lines
    colours = Image.open(io.BytesIO(shot)).convert("RGB").quantize(256, method=Image.Quantize.FASTOCTREE)
    colours.save(HERE / "replay.png", optimize=True)


if __name__ == "__main__":
    main()
