"""`manip-learn demo`: learn and reproduce a task from recordings that come with the package."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

import manip_learn as ml
from manip_learn.commands.control import run
from manip_learn.commands.learn import fit
from manip_learn.commands.options import ControlOptions, DemoOptions, LearnOptions
from manip_learn.commands.output import Answer, Progress, silent
from manip_learn.errors import UnknownNameError
from manip_learn.recordings.files import shipped_recordings


class DemoScene(NamedTuple):
    """Demo: recordings, and a start that is nearly singular for the learnt task.

    Attributes:
        recordings: Name of the shipped recordings.
        frame: Name of the guided frame.
        title: Title of the page.
        story: Description of the start and its typical outcome, for the terminal.
        start: Joint positions at the start [rad].
        control: Options of the rollouts, as keywords; `rest` is the rest posture of the attractor policy.
        learn: Options for learning.
        target: Target of the feature rows, in the base frame; None to repeat the demonstrated motion, without turning.
    """

    recordings: str
    frame: str
    title: str
    story: str
    start: tuple[float, ...]
    control: Mapping[str, Any]
    learn: Mapping[str, Any] = {}
    target: tuple[float, ...] | None = None


SCENES = {
    "sawyer": DemoScene(
        "sawyer_drawer",
        "right_gripper_tip",
        "a drawer, learnt from 50 guided motions",
        "Both start at the shut drawer, in one posture near a singularity of the task, and open it as far as was "
        "shown, without turning.",
        # of 200 starts near a singularity (3c93471e, seed 20000), number 28: the elbow is at the side
        start=(0.1096, -1.6298, 2.8231, -1.8008, 2.0846, -0.051, 3.049),
        control={"rest": "-0.13,-0.974,0.386,2.142,-0.372,-1.105,3.227"},  # the mean recorded posture
    ),
    "planar3": DemoScene(
        "planar3_reach",
        "tip",
        "reaching, learnt from 20 motions",
        "The arm starts stretched out, the paper's singular start but for a tenth of a degree.",
        start=tuple(np.radians([90.1, 0.0, 0.0]).tolist()),
        control={"rest": ",".join(map(str, np.radians([10.0, -10.0, 10.0]))), "duration": 8.0},
        learn={"axes": "planar", "velocities": "recorded"},  # the positions are Euler steps of these velocities
        target=(0.0, 0.5, 0.0),
    ),
}


def demo(options: DemoOptions, progress: Progress) -> Answer:
    """Learn a task, reproduce it from one nearly singular start without and with singularity avoidance, and write a
    replay.

    The rollout without avoidance has no null-space motion. The rollout with avoidance plans the grasp configuration if
    the task moves a fixture, and uses `ManipulabilityAscent` if the task has a target. `all_policies` compares a plan
    and all policies in one replay. The constraint and the rollouts are also written to files.

    Args:
        options: Options of the command.
        progress: Function that is called with the name of a stage and its completed fraction, 0 to 1.

    Returns:
        Answer of learning, with a row for each rollout.

    Raises:
        UnknownNameError: There is no demo for that robot.
        OutputError: The output folder cannot be written.
    """
    if options.robot not in SCENES:
        raise UnknownNameError("demo robot", options.robot, SCENES)
    scene, out = SCENES[options.robot], options.out
    progress("learning from the recordings", 0.0)
    shipped, file = str(shipped_recordings() / scene.recordings), out / "constraint.json"
    learner, answer_learning = fit(LearnOptions(options.robot, [shipped], scene.frame, out=file, **scene.learn))
    robot, constraint = ml.load_robot(options.robot), learner.constraint_
    rollouts, answers = dict[str, ml.Rollout](), dict[str, Answer]()
    if scene.target is None:  # pause at the handle [s]: a gripper takes this long to close
        task, best = ml.motion(constraint, keep_orientation=True, pause=0.5), "plan"
    else:
        task, best = ml.PointAttractor(scene.target), "manipulability"
    policies = {"without": "zero", "with": best}
    if options.all_policies:
        policies = {name: name for name in (best, "manipulability", "attractor", "zero")}
    for i, (name, policy) in enumerate(policies.items()):
        progress("planning the grasp configuration" if policy == "plan" else f"moving {name}", 0.5 + 0.1 * i)
        how = ControlOptions(options.robot, str(file), policy=policy, plan=policy == "plan", **scene.control)
        how = replace(how, gain=1.0 if policy == "attractor" else how.gain)
        rollouts[name], answer = run(how, constraint, robot, task, np.array(scene.start), silent)
        answers[name] = answer.with_files(rollouts[name].save(out / f"{name}.npz"))
    contents = {name: answer.content for name, answer in answers.items()}
    progress("writing the replay", 0.9)
    is_pair = scene.target is None and not options.all_policies  # with a target, both take nearly the same path
    arguments = {"tip": scene.frame, "report": learner.report_, "notes": answer_learning.notes, "title": scene.title}
    if is_pair:
        arguments |= {"title": _difference(contents), "side_by_side": True, "align": "grasp"}
    opens = options.browser and not options.as_json
    page = ml.replay(robot, rollouts, out / "replay.html", open_browser=opens, **arguments)
    progress("done", 1.0)
    plans = (f"{n}: {a.remarks[0].removeprefix('plan: ')}" for n, a in answers.items() if a.content["plan"])
    stops = (f"{n}: stopped by {c['stopped_by']}" for n, c in contents.items() if c["stopped_by"])
    return replace(
        answer_learning,
        content={"constraint": answer_learning.content, "rollouts": contents, "html": page.html, "bytes": page.bytes},
        remarks=[*answer_learning.remarks, scene.story, *plans],
        rows=[{"policy": name, **answer.facts} for name, answer in answers.items()],
        warnings=[*answer_learning.warnings, *stops],
        page=page,
        following="",
    )


def _difference(contents: Mapping[str, Mapping[str, Any]]) -> str:
    """Describe each rollout: "Without: 1 of 23 cm, then it stops at a singularity. With: all 23 cm."."""
    sentences = []
    for name, way in contents.items():
        cm, total, stopped = 100 * way["done"], 100 * way["wanted"], way["stopped_by"]
        far = f"all {cm:.0f} cm" if stopped is None else f"{cm:.0f} of {total:.0f} cm, then it stops at {stopped}"
        sentences.append(f"{name.capitalize()}: {far}.")
    return " ".join(sentences)
