"""What a person takes home: the constraint, the recordings, the replay as one file, and a script of the same steps."""

from __future__ import annotations

import io
import shutil
import zipfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, final

import numpy as np

from manip_learn.atomic_write import write_atomically
from manip_learn.constraint.constraint import Constraint
from manip_learn.constraint.skill import Skill
from manip_learn.recordings import load_demonstrations
from manip_learn.recordings.saved_motion import motion_of_trajectory
from manip_learn.robot.description.catalogue import known_as
from manip_learn.robot.robot import Robot

# every word that comes from outside is written by repr: a robot's name or a file's may hold quotes
SCRIPT = '''"""The same steps as on the teaching page. Run it in the folder of the recordings."""

import manip_learn as ml

robot = ml.load_robot({robot!r}{locked})
demos = ml.load_demonstrations({files!r}, robot)

# 1. which directions the task holds
rows = [ml.FrameJacobian(robot, {tip!r}, {axes!r}, reference) for reference in ("world", "local")]
learner = ml.ConstraintLearner(rows).fit(demos)
print(learner.report_)
learner.skill_.save("constraint_again.json")
{run}'''
RUN = """
# 2. the arm does what was shown, from where it stood
start = {start!r}  # [rad]
again = ml.repeat(learner.skill_, start)
print(again)

# 3. and in the browser
ml.replay(robot, {{"as shown": again.rollout}}, html="again.html")
"""
Taken = tuple[str, str, str]  # name, path, and what it is


@final
@dataclass(frozen=True)
class Lesson:
    """What was shown and learnt.

    Attributes:
        robot: The arm.
        tip: Its frame that was guided.
        files: The recordings.
        file: The constraint, or None if nothing was learnt.
        out: Folder of what is taken home.
        start: Posture in which the arm stood before it did the task [rad or m]; None where there is none to do.
    """

    robot: Robot
    tip: str
    files: Sequence[str]
    file: str | None
    out: Path
    start: Any = None


def _constraint(lesson: Lesson) -> Taken:
    return "constraint.json", str(lesson.file), "what was learnt, for `manip-learn control` and `ml.Constraint.load`"


def _csv(lesson: Lesson) -> Taken:
    return _zipped(lesson, "csv", [Path(f) for f in lesson.files], "the recordings, one CSV file each")


def _lerobot(lesson: Lesson) -> Taken:
    from manip_learn.recordings.writers.lerobot_writer import write_lerobot

    robot, folder = lesson.robot, lesson.out / "lerobot"
    shutil.rmtree(folder, ignore_errors=True)  # of a press before
    write_lerobot(folder, [motion_of_trajectory(t, robot) for t in load_demonstrations(list(lesson.files), robot)])
    inside = [path for path in sorted(folder.rglob("*")) if path.is_file()]
    return _zipped(lesson, "lerobot", inside, "the recordings as a LeRobot data set")


def _replay(lesson: Lesson) -> Taken:
    from manip_learn.planning.repeat import repeat
    from manip_learn.playback.replay_page import replay

    robot, skill = lesson.robot, Skill.load(str(lesson.file), lesson.robot)
    recordings = load_demonstrations(list(lesson.files), robot)
    shown: dict[str, Any] = {Path(f).stem: t for f, t in zip(lesson.files, recordings, strict=True)}
    constraints = skill.constraints
    if lesson.start is not None:
        shown, constraints = {"as shown": repeat(skill, lesson.start).rollout}, None
    html = lesson.out / "replay.html"
    page = replay(robot, shown, html, tip=lesson.tip, constraint=constraints, open_browser=False)
    return "replay.html", str(page.html), "the replay, one file that needs no network"


def _script(lesson: Lesson) -> Taken:
    robot, run = lesson.robot, ""
    learnt = Constraint.load(str(lesson.file), robot)
    firm = learnt.mechanism is not None and learnt.mechanism.grip == "firm"
    if lesson.start is not None:
        run = RUN.format(start=np.round(np.asarray(lesson.start), 4).tolist())
    text = SCRIPT.format(
        robot=known_as(robot.source) or (str(robot.source) if robot.source else robot.name),
        locked=f", locked={dict(robot.locked)!r}" if robot.locked else "",
        files=[Path(f).name for f in lesson.files],
        tip=lesson.tip,
        axes="pose" if firm else "xyz",
        run=run,
    )
    path = write_atomically(lesson.out / "taught.py", text)
    return "taught.py", str(path), f"the same steps in Python; run it in {lesson.out}"


def _zipped(lesson: Lesson, kind: str, files: Sequence[Path], says: str) -> Taken:
    """Write files into one archive, under their places in the lesson's folder, or else by their names."""
    content, out = io.BytesIO(), lesson.out
    with zipfile.ZipFile(content, "w", zipfile.ZIP_DEFLATED) as archive:
        for path in files:
            archive.write(path, path.relative_to(out) if kind == "lerobot" else path.name)
    path = write_atomically(out / f"recordings_{kind}.zip", content.getvalue())
    return path.name, str(path), says


HOMES: dict[str, Callable[[Lesson], Taken]] = {
    "constraint": _constraint,
    "csv": _csv,
    "lerobot": _lerobot,
    "replay": _replay,
    "script": _script,
}
