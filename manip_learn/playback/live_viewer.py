"""A robot that is moving now, shown in the browser."""

from __future__ import annotations

import json
import math
import time as clock
import weakref
import webbrowser
from types import TracebackType
from typing import final

import numpy as np
from numpy.typing import ArrayLike

from manip_learn.errors import ConfigurationError
from manip_learn.playback.appearance import appearance
from manip_learn.playback.kinematic_tree import TreeJoint, joint_tracks, kinematic_tree
from manip_learn.playback.live_process import LiveProcess
from manip_learn.playback.page_writer import page
from manip_learn.playback.palette import rollout_colours
from manip_learn.playback.recorded_motion import RecordedMotion
from manip_learn.playback.scene_data import scene_data
from manip_learn.playback.tip_frame import tip_frame
from manip_learn.robot.robot import Robot

POSTURES_FOR_CAMERA = 119


@final
class LiveViewer:
    """Shows a robot while a controller runs.

        with LiveViewer(robot) as viewer:
            while running:
                ...
                viewer.show(q, manipulability=command.manipulability)

    The page is served by a process of its own, on this machine only (127.0.0.1) and under an address that cannot be
    guessed. `show` never waits for it; if the process dies, the program goes on without a picture. The process ends
    when the viewer is closed, and when the program ends in whatever way.

    Args:
        robot: The robot.
        title: Name in the legend.
        open_browser: Show the page now; it is at `url` in any case.
        timeout: How long the server may take to start [s].

    Raises:
        OutputError: The server does not start.
    """

    def __init__(self, robot: Robot, *, title: str = "", open_browser: bool = True, timeout: float = 10.0):
        self._robot = robot
        self._tree = kinematic_tree(robot)
        name = title or robot.name or "robot"
        self._process = LiveProcess(lambda token: _live_page(robot, self._tree, name, token), timeout)
        self._start = clock.monotonic()
        self._finalizer = weakref.finalize(self, self._process.close)
        if open_browser:
            webbrowser.open(self.url)

    @property
    def url(self) -> str:
        """Where the page is."""
        return self._process.url

    @property
    def is_open(self) -> bool:
        """False once the viewer is closed or its server is gone."""
        return self._process.is_open

    def show(self, q: ArrayLike, manipulability: float | None = None, time: float | None = None) -> None:
        """Show a posture; returns at once. After `close`, or if the server is gone, nothing happens.

        Args:
            q: Configuration (nq) or joint positions (nv).
            manipulability: mu(q), for the curve.
            time: [s]; None for the time since the viewer was made.

        Raises:
            ConfigurationError: Wrong size, NaN or infinity.
        """
        posture = np.array(self._robot.configuration(q))  # a copy: the caller may go on writing to its own
        now = clock.monotonic() - self._start if time is None else float(time)
        mu = None if manipulability is None else float(manipulability)
        if not math.isfinite(now) or (mu is not None and not math.isfinite(mu)):
            raise ConfigurationError(f"manipulability {mu} at time {now}: finite numbers are needed")
        robot, tree = self._robot, self._tree

        def message() -> str:
            values = joint_tracks(robot, tree, posture[None])[0]
            return json.dumps({"time": now, "values": values.tolist(), "mu": mu}, allow_nan=False)

        self._process.put(message)

    def close(self) -> None:
        """End the server; twice does no harm. The browser keeps the last picture."""
        self._finalizer()

    def __enter__(self) -> LiveViewer:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def _live_page(robot: Robot, tree: tuple[TreeJoint, ...], name: str, token: str) -> bytes:
    rest, tip = robot.neutral(), tip_frame(robot)
    rng = np.random.default_rng(0)
    postures = np.array([rest, *(robot.random_configuration(rng) for _ in range(POSTURES_FOR_CAMERA))])
    none = np.zeros(0)
    still = RecordedMotion(
        name=name,
        key_times=np.zeros(1),
        tracks=joint_tracks(robot, tree, rest[None]),
        postures=postures,
        path_times=np.zeros(1),
        path=robot.pose(rest, robot.frame(tip))[None, :3, 3],
        curve_times=none,
        curve=none,
        status=(),
        duration=0.0,
    )
    looks = appearance(robot, tree)
    data = scene_data(robot, tree, looks, tip, [still], rollout_colours([name], {}), looks.notes)
    data["events"] = f"/{token}/events"
    return page(data, robot=robot.name or "robot", subtitle="", mode="live").encode("utf-8")
