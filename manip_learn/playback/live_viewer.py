"""Live view of a moving robot: in a page served by a process of its own, or in the user's own meshcat viewer."""

from __future__ import annotations

import contextlib
import json
import logging
import secrets
import select
import subprocess
import sys
import threading
import time as clock
import traceback
import weakref
import webbrowser
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from itertools import pairwise
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, final

import numpy as np
import pinocchio as pin
from jaxtyping import Float, Int
from numpy.typing import ArrayLike

from manip_learn.constraint.constraint import Constraint
from manip_learn.errors import ConfigurationError, OutputError
from manip_learn.playback.appearance import appearance, joint_tracks
from manip_learn.playback.palette import COLOURS, hex_to_rgb
from manip_learn.playback.replay_page import live_page
from manip_learn.playback.scene_data import mechanism_drawing
from manip_learn.robot.description.catalogue import known_as
from manip_learn.robot.robot import Robot
from manip_learn.robot.tips import default_tip

_LOGGER = logging.getLogger("manip_learn")
SERVER = Path(__file__).with_name("live_server.py")
MESH = "TriangularMeshGeometry"


@final
class LiveProcess:
    """Server process of a live page, with a thread that writes messages to it and a thread that reads its messages.

    Each message has a slot (a name). Pages receive the newest message of each slot; a page that opens later receives
    the newest ones of all slots at once. `put` never waits: the writing thread sends the newest messages at the frame
    rate of a screen, and only this thread waits if the server is slow. Messages are sent in the order in which they
    were put. If a callback fails, the error is logged once and the server continues.

    Args:
        make_page: Function that takes the token, the secret part of the address, and returns the HTML of the page.
        timeout: Largest start-up time of the server [s].
        heard: Callback for messages from pages, called in a thread of its own with one dictionary at a time: `{"page":
            id, "said": {...}}` when a page posts a message, `{"pages": [ids]}` with the ids of the open pages, oldest
            first, when a page opens or closes. It is not called after `close` has returned, unless one call takes
            longer than 2 s. None: pages cannot post.
        frames_per_second: Largest rate at which the newest messages are written; the default is the rate of most
            screens.

    Raises:
        OutputError: The server does not start.
    """

    def __init__(
        self,
        make_page: Callable[[str], str],
        timeout: float,
        heard: Callable[[Mapping[str, Any]], object] | None = None,
        frames_per_second: float = 60.0,
    ):
        token = secrets.token_urlsafe(18)
        header = json.dumps({"page": make_page(token), "token": token, "hears": heard is not None})
        self._heard = (lambda _: None) if heard is None else heard
        self._interval = 1.0 / frames_per_second
        self._failed = set[tuple[Any, ...]]()
        self._newest = {"begin": lambda: header}  # message of each slot, in the order of `put`
        self._lock = threading.RLock()  # guards these; reentrant, because a signal handler may call `put` meanwhile
        self._wake = threading.Event()
        self._at_end = contextlib.ExitStack()
        self._threads = [threading.Thread(target=work, daemon=True) for work in (self._feed, self._listen)]
        pipes: dict[str, Any] = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": subprocess.DEVNULL}
        try:  # in a session of its own: Ctrl-C reaches only the program, which then closes this process
            self._process: Any = subprocess.Popen([sys.executable, "-I", SERVER], **pipes, start_new_session=True)
        except OSError as error:
            raise OutputError(f"the live view's server cannot be started: {error}") from error
        self._wake.set()
        self._threads[0].start()
        stdout = self._process.stdout
        port = stdout.readline().decode().strip() if select.select([stdout], [], [], timeout)[0] else ""
        if not port.isdigit():
            self.close()
            remedy = "check that another process can start and listen on 127.0.0.1"
            raise OutputError(f"the live view's server did not start within {timeout:g} s: {remedy}")
        self._threads[1].start()
        self.url = f"http://127.0.0.1:{port}/{token}/"

    @property
    def is_open(self) -> bool:
        """True while the server process runs."""
        return self._process.poll() is None

    def put(self, message: Callable[[], str], slot: str = "message") -> None:
        """Send a message to the pages, as the newest one of its slot; the call returns at once.

        Args:
            message: Function that returns one line of JSON; it is called in the writing thread.
            slot: Name of the event in the page, one word; `"message"` for the unnamed event.
        """
        with self._lock:
            self._newest.pop(slot, None)  # so that it moves to the end
            self._newest[slot] = message
        self._wake.set()

    def offer(self, files: Mapping[str, Path]) -> None:
        """Serve files for download under `files/NAME`, instead of the files of an earlier call.

        Args:
            files: Mapping from names to files. A file that does not exist when it is requested is reported as not
                found.
        """
        line = json.dumps({f"files/{name}": str(path.absolute()) for name, path in files.items()})
        self.put(lambda: line, "files")

    def open_in_browser(self) -> None:
        """Open the page in a browser.

        The browser opens a file that only this user may read and that redirects to the page, because its command line,
        and thus the secret address, would be visible to all users.
        """
        file = Path(self._at_end.enter_context(TemporaryDirectory(prefix="manip_learn_"))) / "page.html"
        file.write_text(f'<meta http-equiv="refresh" content="0; url={self.url}">')
        webbrowser.open(file.as_uri())

    def close(self) -> None:
        """Stop the server and the threads; a second call has no effect."""
        self._process.kill()
        self._process.wait()
        self._wake.set()
        self._at_end.close()
        for thread in self._threads:
            if thread.is_alive() and thread is not threading.current_thread():
                thread.join(2.0)  # [s] for a callback to return
        self._process.communicate()  # closes the pipes

    def _listen(self) -> None:
        """Pass each line of the server to the callback until the server ends."""
        for line in iter(self._process.stdout.readline, b""):
            with self._logged():
                self._heard(json.loads(line))
            if not self.is_open:
                return

    def _feed(self) -> None:
        """Write new messages until the process is closed or the server ends."""
        while self.is_open:
            self._wake.wait()
            self._wake.clear()
            due = clock.monotonic() + self._interval
            with self._lock:
                newest, self._newest = self._newest, {}
            for slot, message in newest.items():
                with self._logged():
                    line = f"{slot} {message()}\n".encode()
                    with contextlib.suppress(OSError, ValueError):  # the server is gone, or the pipe was closed
                        self._process.stdin.write(line)
                        self._process.stdin.flush()
            clock.sleep(max(due - clock.monotonic(), 0.0))

    @contextlib.contextmanager
    def _logged(self) -> Iterator[None]:
        """Log an exception in this block once per location: at 60 per second the first would be lost."""
        try:
            yield
        except Exception as error:  # a callback may raise anything; the thread continues
            *_, (frame, number) = traceback.walk_tb(error.__traceback__)
            place = type(error), frame.f_code.co_filename, number
            if place not in self._failed:
                self._failed.add(place)
                _LOGGER.exception("live view: a callback of the program failed; repetitions are not logged")


@final
class LiveViewer(contextlib.AbstractContextManager["LiveViewer"]):
    """Live view of a robot while a controller runs.

        with LiveViewer(robot) as viewer:
            while running:
                ...
                viewer.show(q, manipulability=command.manipulability)

    The page is served by a process of its own, on this machine only (127.0.0.1) and under an address that cannot be
    guessed. `show` never waits for this process, and the program continues if the process dies. The process ends when
    the viewer is closed, and when the program ends for any reason.

    Args:
        robot: The robot.
        constraint: Learnt constraint, whose mechanism is drawn in the robot's base frame, or else its held directions
            at the tip; None for none.
        target: Target of the constraint's task, as returned by `Task.goal`; None for none.
        title: Name in the legend; default: the name of the robot.
        open_browser: True to open the page at once; in both cases its address is `url`.
        timeout: Largest start-up time of the server [s].

    Attributes:
        url: Address of the page.

    Raises:
        OutputError: The server does not start.
        ConstraintMismatchError: The constraint belongs to another robot.
        TargetError: The target is not finite numbers.
    """

    def __init__(
        self,
        robot: Robot,
        *,
        constraint: Constraint | None = None,
        target: ArrayLike | None = None,
        title: str = "",
        open_browser: bool = True,
        timeout: float = 10.0,
    ):
        self._robot = robot
        name = title or known_as(robot.source) or robot.name or "robot"
        self._process = LiveProcess(partial(live_page, robot, name, constraint=constraint, target=target), timeout)
        self.url, self._start = self._process.url, clock.monotonic()
        self._finalizer = weakref.finalize(self, self._process.close)
        if open_browser:
            self._process.open_in_browser()

    @property
    def is_open(self) -> bool:
        """False after the viewer was closed or its server ended."""
        return self._process.is_open

    def show(self, q: ArrayLike, manipulability: float | None = None, time: float | None = None) -> None:
        """Show a configuration; returns at once. After `close`, or if the server has ended, nothing is shown.

        Args:
            q: Joint configuration (nq,) or positions (nv,) [rad or m].
            manipulability: Manipulability mu(q) to plot as a curve; None for no curve.
            time: Time [s]; None for the time since the viewer was created.

        Raises:
            ConfigurationError: q has the wrong size, or contains NaN or infinity.
        """
        robot = self._robot
        posture = np.array(robot.configuration(q))  # a copy: the caller may change its own array
        now = clock.monotonic() - self._start if time is None else float(time)
        mu = None if manipulability is None else float(manipulability)
        if not np.isfinite([now, mu or 0.0]).all():
            raise ConfigurationError(f"manipulability and time must be finite, got {mu} at time {now}")

        def message() -> str:
            """Return the picture as one line of JSON."""
            values = joint_tracks(robot, posture[None])[0]
            return json.dumps({"time": now, "values": values.tolist(), "mu": mu}, allow_nan=False)

        self._process.put(message)

    def close(self) -> None:
        """Stop the server; a second call has no effect. The browser keeps the last picture."""
        self._finalizer()

    def __exit__(self, *failure: object) -> None:
        self.close()


# ---- in the user's own meshcat viewer ------------------------------------------------------------------------------


def show(
    robot: Robot, viewer: Any, constraint: Constraint | None = None, q: ArrayLike | None = None
) -> Callable[[ArrayLike], None]:
    """Draw a robot, a constraint and its demonstrated motion in a meshcat viewer.

    The drawing has the path `manip_learn` in the viewer's scene tree, and replaces the drawing of an earlier call. Its
    parts are `arm`, `mechanism` (line, circle, plane or curve), `path` (of the most typical recording along the
    mechanism), `grasps` (grasp points of the recordings) and `target` (end of that path).

    Args:
        robot: The robot.
        viewer: A `meshcat.Visualizer`, or Pinocchio's `MeshcatVisualizer` of the same robot, which then draws the arm
            with its own meshes.
        constraint: A learnt constraint, whose mechanism is drawn in the robot's base frame; None for the arm alone.
        q: Joint configuration (nq,) or positions (nv,) to show first [rad or m]; None for `robot.neutral()`.

    Returns:
        The function `show(q)`, which moves the arm to a configuration or joint positions.

    Raises:
        ConfigurationError: The viewer is of another kind or of another robot, or `q` has the wrong size.

    Example:
        >>> import meshcat  # doctest: +SKIP
        >>> move = ml.show(robot, meshcat.Visualizer(), constraint)  # doctest: +SKIP
        >>> for posture in rollout.q:  # doctest: +SKIP
        ...     move(posture)
    """
    meshcat_viewer = getattr(viewer, "viewer", viewer)  # Pinocchio's visualizer contains one
    if getattr(meshcat_viewer, "set_object", None) is None:
        remedy = "pass a meshcat.Visualizer, or a MeshcatVisualizer after initViewer()"
        raise ConfigurationError(f"got {type(viewer).__name__}: {remedy}")
    model, posture = robot.pinocchio_model, robot.neutral() if q is None else q
    if meshcat_viewer is not viewer and viewer.model.nq != model.nq:
        sizes = f"the viewer has nq {viewer.model.nq}, {robot.name!r} has {model.nq}"
        raise ConfigurationError(f"{sizes}: build it with robot.pinocchio_model")
    scene, data = meshcat_viewer["manip_learn"], model.createData()
    scene.delete()
    if meshcat_viewer is viewer:
        _draw_arm(scene["arm"], robot)
    if constraint is not None:
        _draw_constraint(scene, robot, constraint, posture)

    def move(q: ArrayLike) -> None:
        """Move the arm.

        Args:
            q: Joint configuration (nq,) or positions (nv,) [rad or m].
        """
        full = robot.pinocchio_configuration(q)
        if meshcat_viewer is not viewer:
            return viewer.display(full)
        pin.forwardKinematics(model, data, full)
        for joint, pose in enumerate(data.oMi):
            scene["arm"][str(joint)].set_transform(pose.homogeneous)

    move(posture)
    return move


def _draw_arm(arm: Any, robot: Robot) -> None:
    """Draw the shapes of each link below its joint."""
    looks = appearance(robot)
    for k, shape in enumerate(looks.shapes):
        kind, size, pose = shape.kind.title(), shape.size, shape.pose
        if shape.mesh is not None:
            kind, size = MESH, looks.meshes[shape.mesh][:2]
        elif kind == "Box":
            size = (size,)
        elif kind != "Sphere":  # the axis of meshcat's cylinders is y, ours is z
            kind, size, pose = "Cylinder", size[::-1], pose[:, [0, 2, 1, 3]] * [1.0, 1.0, -1.0, 1.0]
        _put(arm[str(shape.joint)][str(k)], kind, size, shape.colour, pose)


def _draw_constraint(scene: Any, robot: Robot, constraint: Constraint, q: ArrayLike) -> None:
    """Draw the mechanism of a constraint, its demonstrated path, the grasp points, and the end of the path."""
    motion, twist, mechanism = constraint.shown, constraint.features.twist, scene["mechanism"]
    tip = default_tip(robot) if twist is None else twist.frame
    path = robot.position(q, tip)[None] if motion is None else motion.points
    width = 0.004  # [m] radius of the tubes drawn for lines, because WebGL lines are one pixel wide
    blue, vermilion = (tuple(x / 255.0 for x in hex_to_rgb(COLOURS[name])) for name in ("blue", "vermilion"))
    if constraint.mechanism is not None:
        drawing = mechanism_drawing(constraint.mechanism, path)
        for k, line in enumerate(drawing.lines):
            _put(mechanism[f"line{k}"], MESH, _tube(line, width), (*blue, 1.0))
        for k, corners in enumerate(drawing.patches):
            _put(mechanism[f"patch{k}"], MESH, (corners, np.array([[0, 1, 2], [0, 2, 3]])), (*blue, 0.2))
    if motion is not None:
        _put(scene["path"], MESH, _tube(path, 2.0 * width), (*vermilion, 1.0))
        for name, places, radius in (("grasps", motion.grasps[:, :3, 3], 2.0), ("target", path[-1:], 4.0)):
            for k, place in enumerate(places):
                pose = pin.SE3(np.eye(3), place).homogeneous
                _put(scene[name][str(k)], "Sphere", (radius * width,), (*vermilion, 0.8), pose)


def _put(
    node: Any, kind: str, size: tuple[Any, ...], colour: tuple[float, ...], pose: Float[np.ndarray, "4 4"] | None = None
) -> None:
    """Draw a geometry of meshcat in red, green, blue and opacity."""
    import meshcat.geometry as g  # imported here, because it loads IPython

    number, opacity = int(np.rint(255.0 * np.array(colour[:3])) @ (1 << 16, 1 << 8, 1)), colour[3]
    material = g.MeshPhongMaterial(color=number, opacity=opacity, transparent=opacity < 1.0)
    node.set_object(getattr(g, kind)(*size), material)
    if pose is not None:
        node.set_transform(pose)


def _tube(points: Float[np.ndarray, "n 3"], radius: float) -> tuple[Float[np.ndarray, "v 3"], Int[np.ndarray, "f 3"]]:
    """Return vertices and faces of a round tube along a polyline; a stub if all its points coincide."""
    from trimesh.creation import cylinder
    from trimesh.util import concatenate

    pieces = [pair for pair in pairwise(points) if np.any(pair[0] != pair[1])] or [(points[0], points[0] + radius)]
    tube: Any = concatenate([cylinder(radius, segment=pair, sections=8) for pair in pieces])
    return np.array(tube.vertices), np.array(tube.faces)
