"""What a person takes home: the constraint, the recordings, the replay as one file, and a script of the same steps."""

from __future__ import annotations

import io
import shutil
import zipfile
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from manip_learn.atomic_write import write_atomically
from manip_learn.constraint.constraint import Constraint
from manip_learn.recordings import load_demonstrations
from manip_learn.recordings.saved_motion import motion_of_trajectory
from manip_learn.robot.description.catalogue import known_as
from manip_learn.robot.robot import Robot
from manip_learn.teach.way import STEP, task_of

Taken = list[tuple[str, str, str]]
SCRIPT = '''"""{title}: the same steps as on the page. Run it in the folder of the recordings."""

import manip_learn as ml

robot = ml.load_robot({robot!r}{locked})
demos = ml.load_demonstrations({files!r}, robot)

# 1. which directions the task holds
rows = [ml.FrameJacobian(robot, {tip!r}, {axes!r}, reference) for reference in ("world", "local")]
learner = ml.ConstraintLearner(rows).fit(demos)
print(learner.report_)
constraint = learner.constraint_
constraint.save("constraint_again.json")
{run}'''
RUN = """
# 2. the arm does it, while its null space climbs the manipulability of the task
start = {start!r}  # [rad] the hand is at the handle
task = ml.motion(constraint, {way})
controller = ml.ResolvedRateController(constraint, task=task, null_policy=task.ascent())
rollout = ml.simulate(robot, controller, start, duration=task.duration + 1.0, dt=0.01)
print(rollout)

# 3. and in the browser
ml.replay(robot, {{"as learnt": rollout}}, html="again.html")
"""


def _constraint(
    robot: Robot, tip: str, files: Sequence[str], file: str | None, out: Path, way: Any, start: Any
) -> Taken:
    return [("constraint.json", str(file), "what was learnt, for `manip-learn control` and `ml.Constraint.load`")]


def _csv(robot: Robot, tip: str, files: Sequence[str], file: str | None, out: Path, way: Any, start: Any) -> Taken:
    path = write_atomically(out / "recordings_csv.zip", _zipped([(Path(f).name, Path(f)) for f in files]))
    return [(path.name, str(path), "the recordings, one CSV file each")]


def _lerobot(robot: Robot, tip: str, files: Sequence[str], file: str | None, out: Path, way: Any, start: Any) -> Taken:
    from manip_learn.recordings.writers.lerobot_writer import write_lerobot

    folder = out / "lerobot"
    shutil.rmtree(folder, ignore_errors=True)  # of a press before
    write_lerobot(folder, [motion_of_trajectory(t, robot) for t in load_demonstrations(list(files), robot)])
    inside = [(str(p.relative_to(out)), p) for p in sorted(folder.rglob("*")) if p.is_file()]
    path = write_atomically(out / "recordings_lerobot.zip", _zipped(inside))
    return [(path.name, str(path), "the recordings as a LeRobot data set")]


def _replay(robot: Robot, tip: str, files: Sequence[str], file: str | None, out: Path, way: Any, start: Any) -> Taken:
    from manip_learn.control.controller import ResolvedRateController
    from manip_learn.control.way import simulate_way
    from manip_learn.playback.replay_page import replay

    constraint = Constraint.load(str(file), robot)
    recordings = load_demonstrations(list(files), robot)
    shown: dict[str, Any] = {Path(f).stem: t for f, t in zip(files, recordings, strict=True)}
    if way is not None:
        task = task_of(constraint, way)
        law = ResolvedRateController(constraint, task, task.ascent(), dt=STEP)
        shown = {"as learnt": simulate_way(robot, law, start, STEP)[0]}
    page = replay(robot, shown, out / "replay.html", tip=tip, constraint=constraint, open_browser=False)
    return [("replay.html", str(page.html), "the replay, one file that needs no network")]


def _script(robot: Robot, tip: str, files: Sequence[str], file: str | None, out: Path, way: Any, start: Any) -> Taken:
    name = known_as(robot.source) or (str(robot.source) if robot.source else robot.name)
    locked = f", locked={robot.locked!r}" if robot.locked else ""
    learnt = Constraint.load(str(file), robot)
    firm = learnt.mechanism is not None and learnt.mechanism.grip == "firm"
    text = SCRIPT.format(
        title=f"What {robot.name} was taught",
        robot=name,
        locked=locked,
        files=[Path(f).name for f in files],
        tip=tip,
        axes="pose" if firm else "xyz",
        run="" if way is None else RUN.format(start=np.round(np.asarray(start), 4).tolist(), way=_way(way)),
    )
    path = write_atomically(out / "taught.py", text)
    return [("taught.py", str(path), f"the same steps in Python; run it in {out}")]


def _way(way: Mapping[str, Any]) -> str:
    amount = f"{'along' if way['unit'] == 'm' else 'turn'}={way['value']:.4f}"
    return amount if way["direction"] is None else f"{amount}, direction={np.round(way['direction'], 4).tolist()}"


def _zipped(files: Sequence[tuple[str, Path]]) -> bytes:
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, path in files:
            archive.write(path, name)
    return content.getvalue()


HOMES: dict[str, Callable[..., Taken]] = {
    "constraint": _constraint,
    "csv": _csv,
    "lerobot": _lerobot,
    "replay": _replay,
    "script": _script,
}
