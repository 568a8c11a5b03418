"""`manip-learn record`: record hand-guided motions, one file each, and learn from them."""

from __future__ import annotations

import importlib.util
import os
import select
import shlex
import sys
import time
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import asdict
from pathlib import Path
from typing import Any, get_args

import manip_learn as ml
from manip_learn.commands.loading import choose_frame, with_joints
from manip_learn.commands.options import RecordOptions
from manip_learn.commands.output import Answer, Progress
from manip_learn.drivers.record import LOOK, MOVES, By, Key
from manip_learn.errors import ConfigurationError, OutputError, counted
from manip_learn.recordings.trajectory import EFFORT_SUFFIX, VELOCITY_SUFFIX


def record_motions(options: RecordOptions, progress: Progress) -> Answer:
    """Record motions from a driver, and learn from all of them.

    Args:
        options: Options of the command.
        progress: Function that is called with the name of a stage and its completed fraction, 0 to 1.

    Returns:
        Answer with the files, and the result of learning from them.

    Raises:
        ConfigurationError: DRIVER does not name a driver, or `--by` is neither motion nor key.
        OutputError: Recording had to end; the files are kept.
        ManipLearnError: Another error in robot or driver.
    """
    if options.by not in get_args(By):
        raise ConfigurationError(f"--by must be motion or key, not {options.by!r}")
    driver, robot, viewer = load_driver(options.driver), None, None
    if options.robot is not None:
        robot = options.load(options.robot)
        names = getattr(driver, "joint_names", None) or robot.joint_names
        robot = with_joints(robot, [name for name in robot.joint_names if name in names], options.robot, options)
    begun = list[tuple[Path, float]]()  # files, and when each began

    def began(file: Path | None) -> None:
        if file is not None:
            begun.append((file, time.monotonic()))

    def shown(q: Mapping[str, float], recorded: bool) -> None:
        if viewer is not None and robot is not None and all(name in q for name in robot.joint_names):
            viewer.show([q[name] for name in robot.joint_names])
        waits = "waiting for a motion" if options.by == "motion" else "Enter begins, q ends"
        doing = f"recording {begun[-1][0].name}, {time.monotonic() - begun[-1][1]:.1f} s" if recorded else waits
        progress(f"{doing}; {counted(len(begun), 'motion')}", 0.0)

    with ExitStack() as opened:
        if robot is not None:
            page = ml.LiveViewer(robot, title=options.name, open_browser=not options.no_browser)
            viewer = opened.enter_context(page)
            if options.no_browser and not options.as_json:
                print(f"live picture: {viewer.url}", file=sys.stderr, flush=True)
        pressed = _keys(opened) if options.by == "key" else None
        hooks: dict[str, Any] = {"key": pressed, "shown": shown, "began": began}
        ends: dict[str, Any] = {"by": options.by, "motions": options.motions, "duration": options.duration}
        result = ml.record(driver, options.out, options.name, release=not options.no_release, **ends, **hooks)
    if not result.ordered:
        files = f"; kept: {', '.join(map(str, result.files))}" if result.files else ""
        raise OutputError(f"recording ended: {result.sentence}{files}")
    sentence, advice = _learn_from_files(options, robot, result, progress)
    return Answer(
        asdict(result) | {"sentence": sentence, "advice": advice},
        title=sentence,
        sentences=[result.sentence],
        notes=result.notes,
        written=[*(f"recorded: {file}" for file in result.files), advice],
    )


def _learn_from_files(
    options: RecordOptions, robot: ml.Robot | None, done: ml.RecordedFiles, progress: Progress
) -> tuple[str, str]:
    """Return the result of learning from all recordings of that name, and the next step, in words."""
    enough = 1.0  # [deg] required accuracy of a direction: 9 mm at 0.5 m, more than a gripper gives way
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
        rows = [ml.FrameJacobian(robot, tip, "xyz", reference) for reference in ("world", "local")]
        demos = ml.load_demonstrations(files, robot, ignore_columns=columns)
        report = ml.ConstraintLearner(rows).fit(demos, progress=progress).report_
    except ml.ManipLearnError as refusal:
        return "", f"not enough yet: {refusal}"
    if report.warnings:
        return report.sentence, f"show it once more, from another posture: {report.warnings[0]}"
    if report.uncertainty_deg is None or report.uncertainty_deg > enough:
        return report.sentence, f"show it once more, from another posture, until it is known to {enough:g} degree"
    words = shlex.join(["--frame", tip, *options.words, "--out", f"{options.name}.json"])
    return report.sentence, f"enough: manip-learn learn {shlex.quote(str(options.robot))} {pattern} {words}"


def load_driver(spec: str) -> ml.Driver:
    """Return the driver that `FILE.py:NAME` or `package.module:NAME` names.

    Args:
        spec: Argument of the command. NAME is a driver, or a function without arguments that returns one.

    Raises:
        ConfigurationError: NAME does not exist or is not a driver, or its code raises an error.
    """
    place, _, name = spec.rpartition(":")
    if not place:
        raise ConfigurationError(f"DRIVER must be FILE.py:NAME or package.module:NAME, got {spec!r}")
    # as for a script in Python: modules in its folder can be imported
    sys.path[:0] = [str(Path(place).parent.absolute()), os.getcwd()]
    try:
        if place.endswith(".py"):
            specification = importlib.util.spec_from_file_location(Path(place).stem, place)
            if specification is None or specification.loader is None or not Path(place).is_file():
                raise ConfigurationError(f"no driver: the file {place} does not exist")
            module = sys.modules[specification.name] = importlib.util.module_from_spec(specification)
            specification.loader.exec_module(module)
        else:
            module = importlib.import_module(place)
        result = getattr(module, name)
        driver = result if _is_driver(result) else result()
    except ml.ManipLearnError:
        raise
    except Exception as error:  # any error in the user's own file becomes a sentence
        raise ConfigurationError(f"no driver {spec}: {type(error).__name__}: {error}") from error
    if not _is_driver(driver):
        raise ConfigurationError(f"{spec} is no driver: it needs a period [s] and read(), see `manip_learn.Driver`")
    return driver


def _is_driver(candidate: object) -> bool:
    ready = isinstance(getattr(candidate, "period", None), float | int) and callable(getattr(candidate, "read", None))
    return ready and not isinstance(candidate, type)


def _keys(opened: ExitStack) -> Callable[[], Key]:
    """Return a function that reads enter, space and q; on a terminal without waiting for the end of a line."""
    source, meanings = sys.stdin.fileno(), dict[bytes, Key]({b"q": "end", b"": "end"})  # b"": the input is closed
    meanings |= dict.fromkeys((b"\n", b"\r", b" "), "start or stop")
    if os.isatty(source):
        import termios
        import tty

        opened.callback(termios.tcsetattr, source, termios.TCSADRAIN, termios.tcgetattr(source))
        tty.setcbreak(source)

    def pressed() -> Key:
        return meanings.get(os.read(source, 1), "") if select.select([source], [], [], 0.0)[0] else ""

    return pressed
