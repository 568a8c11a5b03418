"""`manip-learn demo`: the main job, on recordings that come with the package."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, final

import numpy as np

from manip_learn.commands.control import Controlled, follow, with_margin
from manip_learn.commands.learn import LearntTask, learn_task
from manip_learn.commands.options import DemoOptions, LearnOptions, PlanOptions, ReadingOptions
from manip_learn.constraint.constraint import Constraint
from manip_learn.control.controller import ResolvedRateController
from manip_learn.control.rollout import Rollout
from manip_learn.control.simulation import WayDone, simulate, simulate_way
from manip_learn.control.tasks import PointAttractor, Task, motion
from manip_learn.control.tasks.motion import null_policy
from manip_learn.errors import UnknownNameError
from manip_learn.planning.plan import Plan
from manip_learn.playback import ReplayResult, replay
from manip_learn.recordings.files import shipped_recordings
from manip_learn.recordings.load import Progress
from manip_learn.robot import load_robot

DT, _TOLERANCE = 0.01, 0.01  # [s], as the shipped recordings; [m or rad] of a target that counts as reached
PAUSE = 0.5  # [s] at the handle, as a gripper takes to close


@final
@dataclass(frozen=True)
class DemoScene:
    """One demo: recordings, and a start that is nearly singular for the learnt task.

    Attributes:
        recordings: Folder among the shipped recordings.
        frame: The frame that was guided.
        axes: Feature rows.
        title: For the page.
        story: What the start is, and how typical its outcome, for the terminal.
        start: Joint positions [rad].
        rest: Rest posture of the attractor policy [rad].
        target: For the feature rows, in the base frame; None where the hand does what was shown, without turning.
        duration: Of a demo without a way [s].
        velocities: How recorded ones are used.
    """

    recordings: str
    frame: str
    axes: str
    title: str
    story: str
    start: tuple[float, ...]
    rest: tuple[float, ...]
    target: tuple[float, ...] | None = None
    duration: float = 8.0
    velocities: str | None = None

    def task(self, constraint: Constraint) -> Task:
        """What was shown, or its target."""
        if self.target is not None:
            return PointAttractor(self.target)
        return motion(constraint, keep_orientation=True, pause=PAUSE)


SCENES = {
    "sawyer": DemoScene(
        recordings="sawyer_drawer",
        frame="right_gripper_tip",
        axes="xyz",
        title="a drawer, learnt from 50 guided motions",
        story="Both start at the shut drawer, in one posture near a singularity of the task, and open it as far as was "
        "shown, without turning.",
        # of benchmarks/opening_drawers.py, near a singularity, seed 20000, number 28: the elbow is at the side
        start=(0.1096, -1.6298, 2.8231, -1.8008, 2.0846, -0.051, 3.049),
        rest=(-0.13, -0.974, 0.386, 2.142, -0.372, -1.105, 3.227),  # the mean recorded posture
    ),
    "planar3": DemoScene(
        recordings="planar3_reach",
        frame="tip",
        axes="planar",
        title="reaching, learnt from 20 motions",
        story="The arm starts stretched out, the paper's singular start but for a tenth of a degree.",
        start=tuple(np.radians([90.1, 0.0, 0.0]).tolist()),
        rest=tuple(np.radians([10.0, -10.0, 10.0]).tolist()),
        target=(0.0, 0.5, 0.0),
        velocities="recorded",  # which made the positions, by Euler steps
    ),
}


@final
@dataclass(frozen=True)
class Demo:
    """All results of the demo."""

    learnt: LearntTask
    rollouts: dict[str, Controlled]
    page: ReplayResult
    story: str = ""

    def to_dict(self) -> dict[str, Any]:
        """The JSON answer."""
        return {
            "constraint": self.learnt.to_dict(),
            "rollouts": {name: r.to_dict() for name, r in self.rollouts.items()},
            "html": str(self.page.html),
            "bytes": self.page.bytes,
        }


def demo(options: DemoOptions, progress: Progress | None = None) -> Demo:
    """Learn, move from one nearly singular start without and with what was learnt, write constraint, rollouts, replay.

    "without" leaves the spare joints at rest; "with" plans the posture of hold where a fixture is moved, and climbs mu
    where a target is reached. `all_policies` compares a plan and all policies in one picture.

    Raises:
        UnknownNameError: There is no demo for that robot.
        OutputError: The output folder cannot be written.
    """
    if options.robot not in SCENES:
        raise UnknownNameError("demo robot", options.robot, SCENES)
    scene, out, said = SCENES[options.robot], options.out, progress or (lambda _step, _share: None)
    said("learning from the recordings", 0.0)
    shipped, file = str(shipped_recordings() / scene.recordings), out / "constraint.json"
    asked = LearnOptions(options.robot, [shipped], frame=scene.frame, axes=scene.axes, out=file)
    learnt = learn_task(replace(asked, reading=ReadingOptions(velocities=scene.velocities)))
    robot, constraint, done = load_robot(options.robot), learnt.constraint, dict[str, Controlled]()

    def keep(name: str, rollout: Rollout, task: Task, way: WayDone | None = None, found: Plan | None = None) -> None:
        rollout, margin = with_margin(rollout, task, way, found, robot)
        saved = rollout.save(out / f"{name}.npz")
        done[name] = Controlled.of(constraint, rollout, _TOLERANCE, way, out=saved, plan=found, margin=margin)

    best = "manipulability" if scene.target is not None else "plan"
    shown = {"without": "zero", "with": best}
    if options.all_policies:
        shown = {name: name for name in dict.fromkeys((best, "manipulability", "attractor", "zero"))}
    for i, (name, policy) in enumerate(shown.items()):
        said("planning in which posture to take hold" if policy == "plan" else f"moving {name}", 0.5 + 0.1 * i)
        task, start = scene.task(constraint), np.array(scene.start)
        if policy == "plan":
            found, rollout, way = follow(PlanOptions(plan=True), constraint, task, start, DT)
            keep(name, rollout, task, way, found)
            continue
        spare = null_policy(policy, task, constraint, robot, None, scene.rest)
        controller = ResolvedRateController(constraint, task, spare, dt=DT)
        if scene.target is not None:
            keep(name, simulate(robot, controller, start, scene.duration, DT), task)
        else:
            rollout, way = simulate_way(robot, controller, start, DT)
            keep(name, rollout, task, way)
    said("writing the replay", 0.9)
    is_pair = scene.target is None and not options.all_policies  # both reach a target, on much the same way
    page = replay(
        robot,
        {name: controlled.rollout for name, controlled in done.items()},
        out / "replay.html",
        tip=scene.frame,
        title=_difference(done) if is_pair else scene.title,
        report=learnt.report,
        side_by_side=is_pair,
        align="grasp" if is_pair else "start",
        open_browser=options.browser and not options.as_json,
    )
    said("done", 1.0)
    return Demo(learnt, done, page, scene.story)


def _difference(done: Mapping[str, Controlled]) -> str:
    """Say what each rollout did: "Without: 1 of 23 cm, then it stops at a singularity. With: all 23 cm."."""
    ways, sentences = {name: c.way for name, c in done.items() if c.way is not None}, []
    for name, way in ways.items():
        far = f"{100 * way.done:.0f} of {100 * way.wanted:.0f} cm, then it stops at {way.stopped_by}"
        sentences.append(f"{name.capitalize()}: {f'all {100 * way.done:.0f} cm' if way.stopped_by is None else far}.")
    return " ".join(sentences)
