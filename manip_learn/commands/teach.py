"""`manip-learn teach`: serve a page on which a simulated arm is guided by hand, and reproduces the task."""

from __future__ import annotations

import signal
import sys
import threading
import time
from contextlib import ExitStack, closing
from functools import partial

from manip_learn.commands.loading import choose_frame, with_joints
from manip_learn.commands.options import TeachOptions
from manip_learn.commands.output import Answer, Progress
from manip_learn.errors import OutputError, counted
from manip_learn.playback.live_viewer import LiveProcess
from manip_learn.robot.description.catalogue import known_as
from manip_learn.teach.arm import PERIOD
from manip_learn.teach.picture import teaching_page
from manip_learn.teach.scene import FIRST_SEED, physics
from manip_learn.teach.session import TeachingSession


def teach(options: TeachOptions, progress: Progress) -> Answer:
    """Serve the page until it is closed.

    Args:
        options: Options of the command.
        progress: Function that is called with the name of a stage and its completed fraction, 0 to 1.

    Returns:
        Answer with the folder and the recordings.

    Raises:
        ManipLearnError: No frame is named and the robot has not exactly one likely tip, or the robot cannot be
            simulated in a teaching scene.
        MissingExtraError: MuJoCo is not installed.
        OutputError: The server does not start, or the folder cannot be written to.
    """
    progress("preparing the scene", 0.0)
    physics()
    robot = options.load(options.robot)
    tip = choose_frame(robot, options.frame)
    robot = with_joints(robot, [name for name in robot.joint_names if robot.moves(name, tip)], options.robot, options)
    if options.out.exists() and not options.out.is_dir():
        raise OutputError(f"--out {options.out} is a file: name a folder")
    name = known_as(robot.source) or robot.name or "robot"
    seed = FIRST_SEED if options.seed is None else options.seed
    # 20 s for the server to start: a busy machine takes a few
    pages = LiveProcess(partial(teaching_page, robot, name), 20.0, lambda said: session.hear(said), 1.0 / PERIOD)
    with closing(pages) as server, ExitStack() as handlers:
        session = TeachingSession(robot, tip, options.out, options.scene, seed, server)  # type: ignore[arg-type]
        progress("ready", 1.0)
        if options.no_browser:
            print(f"the page: {server.url}", file=sys.stderr, flush=True)
        else:
            server.open_in_browser()
        # Ctrl-C, a closed terminal and SIGTERM end the session at any time
        names = ("SIGINT", "SIGTERM", "SIGHUP") if threading.current_thread() is threading.main_thread() else ()
        for number in [number for number in signal.Signals if number.name in names]:  # Windows has no SIGHUP
            handlers.callback(signal.signal, number, signal.signal(number, lambda *_: session.end()))
        session.run()
        time.sleep(0.2)  # [s] so that open pages receive the end of the program
    notes = session.arm.scene.notes
    location = f"{counted(len(session.files), 'recording')} kept in: {session.folder}"
    return Answer(
        {"folder": session.folder, "recordings": session.files, "sentence": session.sentence, "notes": notes},
        title=session.sentence,
        notes=notes,
        written=[location if session.files else "nothing was recorded"],
    )
