"""`manip-learn record`: motions shown by hand, a file each, and what can be learnt from them."""

from __future__ import annotations

import importlib
import importlib.util
import os
import select
import shlex
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import Any, get_args

from manip_learn.commands.guided_frame import choose_frame
from manip_learn.commands.loading import with_joints
from manip_learn.commands.options import RecordOptions
from manip_learn.commands.output import Answer, Progress
from manip_learn.constraint.features.frame_jacobian import FrameJacobian
from manip_learn.control.driver import Driver
from manip_learn.drivers.record import LOOK, MOVES, By, Key, RecordedFiles, record
from manip_learn.errors import ConfigurationError, ManipLearnError, OutputError, counted
from manip_learn.learning import ConstraintLearner
from manip_learn.recordings import load_demonstrations
from manip_learn.recordings.trajectory import EFFORT_SUFFIX, VELOCITY_SUFFIX
from manip_learn.robot import Robot

_ENOUGH = 1.0  # [degrees] to which a direction is to be known: at 0.5 m that is 9 mm, more than a gripper gives way


def record_motions(options: RecordOptions, progress: Progress) -> Answer:
    """Record from a driver, and learn from what there is.

    Raises:
        ConfigurationError: DRIVER is none, or `--by` is neither motion nor key.
        OutputError: Recording had to end; the files are kept.
        ManipLearnError: Anything else that is wrong with robot or driver.
    """
    if options.by not in get_args(By):
        raise ConfigurationError(f"--by must be motion or key, not {options.by!r}")
    driver, robot, viewer = driver_of(options.driver), None, None
    if options.robot is not None:
        robot, names = options.load(options.robot), getattr(driver, "joint_names", None)
        if names is not None:
            moving = [name for name in robot.joint_names if name in names]
            robot = with_joints(robot, moving, options.robot, options)
    told = {"file": "", "since": 0.0, "files": 0, "said": 0.0}

    def began(file: Path | None) -> None:
        told.update(file="" if file is None else file.name, since=time.monotonic())
        told["files"] += file is not None

    def shown(q: Mapping[str, float], recorded: bool) -> None:
        if viewer is not None and robot is not None and all(name in q for name in robot.joint_names):
            viewer.show([q[name] for name in robot.joint_names])
        now = time.monotonic()
        if now - told["said"] > 0.1:  # [s] between two words on the state
            told["said"] = now
            waits = "waiting for a motion" if options.by == "motion" else "Enter begins, q ends"
            doing = f"recording {told['file']}, {now - told['since']:.1f} s" if recorded else waits
            progress(f"{doing}; {counted(told['files'], 'motion')}", 0.0)

    with ExitStack() as opened:
        if robot is not None:
            from manip_learn.playback import LiveViewer

            page = LiveViewer(robot, title=options.name, open_browser=not options.no_browser)
            viewer = opened.enter_context(page)
            if options.no_browser and not options.as_json:
                print(f"live picture: {viewer.url}", file=sys.stderr, flush=True)
        pressed = opened.enter_context(_keys()) if options.by == "key" else None
        done = record(
            driver,
            options.out,
            options.name,
            by=options.by,  # type: ignore[arg-type]
            motions=options.motions,
            duration=options.duration,
            release=not options.no_release,
            key=pressed,
            shown=shown,
            began=began,
        )
    if not done.ordered:
        kept = f"; kept: {', '.join(map(str, done.files))}" if done.files else ""
        raise OutputError(f"recording ended: {done.sentence}{kept}")
    sentence, advice = _learnt(options, robot, done, progress)
    return Answer(
        asdict(done) | {"sentence": sentence, "advice": advice},
        title=sentence,
        sentences=[done.sentence],
        notes=done.notes,
        written=[*(f"recorded: {file}" for file in done.files), advice],
    )


def _learnt(options: RecordOptions, robot: Robot | None, done: RecordedFiles, progress: Progress) -> tuple[str, str]:
    """What all recordings of that name show, and what to do next."""
    pattern = f"{shlex.quote(str(options.out / options.name))}_*.csv"
    if not done.files:
        return "", f"no joint moved by {MOVES:g} rad within {LOOK:g} s: guide the arm while this runs, or use --by key"
    if robot is None:
        return "", f"say --robot ROBOT to see the arm, or: manip-learn learn ROBOT {pattern}"
    files = sorted(str(file) for file in options.out.glob(f"{options.name}_*.csv"))
    others = [name for name in done.joint_names if name not in robot.joint_names]
    columns = [name + suffix for name in others for suffix in ("", VELOCITY_SUFFIX, EFFORT_SUFFIX)]
    try:
        tip = choose_frame(robot, options.frame)
        rows = [FrameJacobian(robot, tip, "xyz", reference) for reference in ("world", "local")]
        demos = load_demonstrations(files, robot, ignore_columns=columns)
        report = ConstraintLearner(rows).fit(demos, progress=progress).report_
    except ManipLearnError as refusal:
        return "", f"not enough yet: {refusal}"
    if report.warnings:
        return report.sentence, f"show it once more, from another posture: {report.warnings[0]}"
    if report.uncertainty_deg is None or report.uncertainty_deg > _ENOUGH:
        return report.sentence, f"show it once more, from another posture, until it is known to {_ENOUGH:g} degree"
    words = shlex.join(["--frame", tip, *options.words, "--out", f"{options.name}.json"])
    return report.sentence, f"enough: manip-learn learn {shlex.quote(str(options.robot))} {pattern} {words}"


def driver_of(spec: str) -> Driver:
    """Return the driver that `FILE.py:NAME` or `package.module:NAME` names, or that calling what it names makes.

    Raises:
        ConfigurationError: There is none, or its code fails.
    """
    place, _, name = spec.rpartition(":")
    if not place:
        raise ConfigurationError(f"DRIVER must be FILE.py:NAME or package.module:NAME, got {spec!r}")
    # as Python does for a script: its neighbours are found
    sys.path[:0] = [str(Path(place).parent.absolute()), os.getcwd()]
    try:
        module = _file_as_module(Path(place)) if place.endswith(".py") else importlib.import_module(place)
        found = getattr(module, name)
        driver = found if _is_driver(found) else found()
    except ManipLearnError:
        raise
    except Exception as error:  # whatever the user's own file raises, he gets a sentence
        raise ConfigurationError(f"no driver {spec}: {type(error).__name__}: {error}") from error
    if not _is_driver(driver):
        raise ConfigurationError(f"{spec} is no driver: it needs a period [s] and read(), see `manip_learn.Driver`")
    return driver


def _is_driver(found: object) -> bool:
    ready = isinstance(getattr(found, "period", None), float | int) and callable(getattr(found, "read", None))
    return ready and not isinstance(found, type)


def _file_as_module(path: Path) -> Any:
    spec = importlib.util.spec_from_file_location(path.stem, path)
    if spec is None or spec.loader is None or not path.is_file():
        raise ConfigurationError(f"no driver: the file {path} does not exist")
    module = sys.modules[path.stem] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@contextmanager
def _keys() -> Iterator[Callable[[], Key]]:
    """Enter or space and q as they are pressed; of a terminal without waiting for the end of a line."""
    source, before = sys.stdin.fileno(), None
    if os.isatty(source):
        import termios
        import tty

        before = termios.tcgetattr(source)
        tty.setcbreak(source)

    def pressed() -> Key:
        letter = os.read(source, 1) if select.select([source], [], [], 0.0)[0] else None
        if letter in (b"q", b""):  # or nobody is there to press one
            return "end"
        return "start or stop" if letter in (b"\n", b"\r", b" ") else ""

    try:
        yield pressed
    finally:
        if before is not None:
            termios.tcsetattr(source, termios.TCSADRAIN, before)
