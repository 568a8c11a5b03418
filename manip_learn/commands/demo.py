"""`manip-learn demo`: the main job, on recordings that come with the package."""

from __future__ import annotations

import importlib.resources
from dataclasses import dataclass
from pathlib import Path
from typing import Any, final

import numpy as np

from manip_learn.commands.control import Controlled
from manip_learn.commands.learn import Learnt, learn
from manip_learn.control.controller import ResolvedRateController
from manip_learn.control.policies import JointAttractor, ManipulabilityAscent, ZeroPolicy
from manip_learn.control.simulation import simulate
from manip_learn.control.tasks import PointAttractor
from manip_learn.errors import UnknownNameError
from manip_learn.playback import ReplayResult, replay
from manip_learn.recordings.trajectory_source import Progress
from manip_learn.robot import Robot, load_robot

DT, TOLERANCE = 0.01, 0.01


@final
@dataclass(frozen=True)
class Scene:
    """One demo: recordings, and a start at which the learnt constraint is nearly singular.

    Attributes:
        recordings: Folder among the shipped recordings.
        frame: The frame that was guided.
        axes: Feature rows.
        title: For the page.
        start: Joint positions [rad].
        target: For the feature rows, in the base frame.
        rest: Rest posture of the attractor policy [rad].
        duration: [s].
    """

    recordings: str
    frame: str
    axes: str
    title: str
    start: tuple[float, ...]
    target: tuple[float, ...]
    rest: tuple[float, ...]
    duration: float


SCENES = {
    "sawyer": Scene(
        recordings="sawyer_drawer",
        frame="right_gripper_tip",
        axes="xyz",
        title="a drawer, learnt from 50 guided motions",
        # upright but for a milliradian: no joint can move the tip up or down
        start=(1.2, -1.57, 0.0, 0.0, 0.0, 0.0, 0.0),
        # the middle of the recorded drawers, and the mean recorded posture
        target=(0.6, 0.27, 0.35),
        rest=(-0.13, -0.974, 0.386, 2.142, -0.372, -1.105, 3.227),
        duration=6.0,
    ),
    "planar3": Scene(
        recordings="planar3_reach",
        frame="tip",
        axes="planar",
        title="reaching, learnt from 20 motions",
        # the paper's singular start, but for a tenth of a degree
        start=tuple(np.radians([90.1, 0.0, 0.0]).tolist()),
        target=(0.0, 0.5, 0.0),
        rest=tuple(np.radians([10.0, -10.0, 10.0]).tolist()),
        duration=8.0,
    ),
}


@final
@dataclass(frozen=True)
class Demo:
    """All results of the demo."""

    learnt: Learnt
    rollouts: dict[str, Controlled]
    page: ReplayResult

    def to_dict(self) -> dict[str, Any]:
        """The JSON answer."""
        return {
            "constraint": self.learnt.to_dict(),
            "rollouts": {name: r.to_dict() for name, r in self.rollouts.items()},
            "html": str(self.page.html),
            "bytes": self.page.bytes,
        }


def shipped_recordings() -> Path:
    """Folder of the recordings that come with this package, in an installed wheel or in a checkout."""
    installed = Path(str(importlib.resources.files("manip_learn"))) / "_recordings"
    return installed if installed.is_dir() else Path(__file__).resolve().parents[2] / "examples" / "data"


def demo(robot_name: str, out: Path, open_browser: bool, progress: Progress | None = None) -> Demo:
    """Learn, compare the three policies from a nearly singular start, write constraint, rollouts and replay.

    Raises:
        UnknownNameError: There is no demo for that robot.
        OutputError: The output folder cannot be written.
    """
    if robot_name not in SCENES:
        raise UnknownNameError("demo robot", robot_name, SCENES)
    scene, said = SCENES[robot_name], progress or (lambda _step, _share: None)
    said("learning from the recordings", 0.0)
    learnt = learn(
        robot_name,
        [str(shipped_recordings() / scene.recordings)],
        frame=scene.frame,
        axes=scene.axes,
        out=out / "constraint.json",
    )
    robot = load_robot(robot_name)
    rollouts = {}
    for i, (name, controller) in enumerate(controllers(robot, learnt, scene).items()):
        said(f"moving with the {name} policy", 0.5 + 0.12 * i)
        rollout = simulate(robot, controller, scene.start, scene.duration, DT)
        rollouts[name] = Controlled(rollout, rollout.save(out / f"{name}.npz"), TOLERANCE)
    said("writing the replay", 0.9)
    page = replay(
        robot,
        {name: r.rollout for name, r in rollouts.items()},
        out / "replay.html",
        tip=scene.frame,
        title=scene.title,
        report=learnt.report,
        open_browser=open_browser,
    )
    said("done", 1.0)
    return Demo(learnt, rollouts, page)


def controllers(robot: Robot, learnt: Learnt, scene: Scene) -> dict[str, ResolvedRateController]:
    """The three policies that are compared, the recommended one first."""
    constraint = learnt.constraint
    policies = {
        "manipulability": ManipulabilityAscent(constraint),
        "attractor": JointAttractor(scene.rest, robot=robot),
        "zero": ZeroPolicy(robot.nv),
    }
    return {
        name: ResolvedRateController(constraint, PointAttractor(scene.target), policy, dt=DT)
        for name, policy in policies.items()
    }
