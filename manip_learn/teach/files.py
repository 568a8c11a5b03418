"""Export of a teaching session: the constraint, the recordings, the replay, and a script with the same steps."""

from __future__ import annotations

import io
import shutil
import zipfile
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float

from manip_learn.atomic_write import write_atomically
from manip_learn.constraint.constraint import Constraint
from manip_learn.constraint.skill import Skill
from manip_learn.errors import OutputError
from manip_learn.recordings import load_demonstrations
from manip_learn.recordings.load import Progress
from manip_learn.recordings.saved_motion import motion_of_trajectory
from manip_learn.robot.description.catalogue import known_as
from manip_learn.robot.robot import Robot

# values from outside are written by repr: the name of a robot or a file may contain quotes
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
# kind of file -> its description
HOMES = {
    "constraint": "what was learnt, for `manip-learn control` and `ml.Constraint.load`",
    "csv": "the recordings, one CSV file each",
    "lerobot": "the recordings as a LeRobot data set",
    "replay": "the replay, one file that needs no network",
    "script": "the same steps in Python; run it in {}",
}


def write_export(
    robot: Robot,
    tip: str,
    said: Progress,
    *,
    what: str,
    files: Sequence[str],
    file: str,
    learnt: bool,
    start: Float[np.ndarray, " nv"] | None,
) -> tuple[Path, str]:
    """Write an export file into the folder of the constraint file.

    Args:
        robot: The arm.
        tip: Name of the guided frame.
        said: Function that is called with the name of a stage and its completed fraction, 0 to 1.
        what: Kind of file: `"constraint"`, `"csv"`, `"lerobot"`, `"replay"` or `"script"`.
        files: Paths of the recordings.
        file: Path of the constraint file.
        learnt: True if a constraint has been learnt.
        start: shape (nv,), start posture of the arm for the task [rad or m]; None for no start.

    Returns:
        Path of the written file, and its description.

    Raises:
        OutputError: The file needs a constraint and none was learnt yet, or `what` is unknown.
    """
    if what not in HOMES:
        raise OutputError(f"the files to take home are {', '.join(HOMES)}, not {what!r}")
    if not learnt and what not in ("csv", "lerobot"):
        raise OutputError("nothing has been learnt yet: press Learn first; recordings can be taken now")
    said("writing", 0.3)
    result, out = Path(file), Path(file).parent
    match what:
        case "csv":
            result = _write_archive(out, what, map(Path, files))
        case "lerobot":
            from manip_learn.recordings.writers.lerobot_writer import write_lerobot

            shutil.rmtree(folder := out / "lerobot", ignore_errors=True)  # left by an earlier request
            write_lerobot(folder, [motion_of_trajectory(t, robot) for t in load_demonstrations(files, robot)])
            result = _write_archive(out, what, (path for path in sorted(folder.rglob("*")) if path.is_file()))
        case "replay":
            from manip_learn.planning.repeat import repeat
            from manip_learn.playback.replay_page import replay

            skill, result = Skill.load(file, robot), out / "replay.html"
            if start is None:
                recordings = load_demonstrations(files, robot)
                motions = {Path(f).stem: t for f, t in zip(files, recordings, strict=True)}
                replay(robot, motions, result, tip=tip, constraint=skill.constraints, open_browser=False)
            else:
                replay(robot, {"as shown": repeat(skill, start).rollout}, result, tip=tip, open_browser=False)
        case "script":
            mechanism = Constraint.load(file, robot).mechanism
            text = SCRIPT.format(
                robot=known_as(robot.source) or str(robot.source or robot.name),
                locked=f", locked={dict(robot.locked)!r}" if robot.locked else "",
                files=[Path(f).name for f in files],
                tip=tip,
                axes="pose" if mechanism is not None and mechanism.grip == "firm" else "xyz",
                run="" if start is None else RUN.format(start=np.round(start, 4).tolist()),
            )
            result = write_atomically(out / "taught.py", text)
    return result, HOMES[what].format(out)


def _write_archive(out: Path, kind: str, files: Iterable[Path]) -> Path:
    """Write files of a folder into one archive there, with their paths in the folder."""
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w", zipfile.ZIP_DEFLATED) as archive:
        for path in files:
            archive.write(path, path.relative_to(out))
    return write_atomically(out / f"recordings_{kind}.zip", content.getvalue())
