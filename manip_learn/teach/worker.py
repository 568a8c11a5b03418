"""What takes seconds while the arm goes on moving: learning, planning, simulating; in a process of its own."""

from __future__ import annotations

import multiprocessing
import os
import sys
import threading
from collections.abc import Callable
from dataclasses import replace
from multiprocessing.connection import Connection
from typing import Any, final

import numpy as np
from numpy.typing import ArrayLike

from manip_learn.constraint.constraint import Constraint
from manip_learn.constraint.skill import Skill
from manip_learn.errors import ManipLearnError
from manip_learn.playback.live_server import end_with_parent
from manip_learn.recordings.load import Progress
from manip_learn.robot.robot import Robot
from manip_learn.teach.files import taken_home

STEP = 0.01  # [s] of a simulation, as the arm's period


@final
class TeachingWorker:
    """A process that learns, plans and simulates for one robot, one job after the other.

    Args:
        robot: The robot.
        tip: Its frame that is guided.
    """

    def __init__(self, robot: Robot, tip: str):
        self._robot, self._tip = robot, tip
        self._start()

    def _start(self) -> None:
        context = multiprocessing.get_context("spawn")
        self._pipe, theirs = context.Pipe()
        self._process = context.Process(
            target=_serve, args=(theirs, self._robot, self._tip, os.getpid()), name="teaching", daemon=True
        )
        self._process.start()
        theirs.close()
        self.busy = ""

    def ask(self, job: str, **what: Any) -> None:
        """Begin a job; what came before is given up.

        Args:
            job: Name of a function of `JOBS`.
            what: Its keywords.
        """
        self.give_up()
        self.busy = job
        self._pipe.send((job, what))

    def give_up(self) -> None:
        """Give up the job, if there is one."""
        if self.busy:
            self.close()
            self._start()

    def heard(self) -> list[tuple[str, Any]]:
        """What has come since: ("progress", (step, share)), ("done", (job, answer)) or ("failed", (job, sentence))."""
        out: list[tuple[str, Any]] = []
        try:
            while self._pipe.poll():
                out.append(self._pipe.recv())
        except (EOFError, OSError):
            out.append(("failed", (self.busy, "the process that learns has ended: is there memory for it?")))
            self.close()
            self._start()
        if any(kind != "progress" for kind, _ in out):
            self.busy = ""
        return out

    def close(self) -> None:
        """End the process, whatever it does."""
        self._process.terminate()
        self._process.join(1.0)  # [s] to end by itself
        if self._process.is_alive():
            self._process.kill()
            self._process.join()
        self._pipe.close()


def _serve(pipe: Connection, robot: Robot, tip: str, parent: int) -> None:
    """The process: job after job until the pipe closes or the parent is gone."""
    threading.Thread(target=end_with_parent, args=(parent,), daemon=True).start()
    with open(os.devnull, "w") as nowhere:  # its warnings are part of the answers
        sys.stdout = sys.stderr = nowhere
        if (nice := getattr(os, "nice", None)) is not None:  # Windows has none
            nice(10)  # on one core the physics go first
        from manip_learn import learning  # noqa: F401  # now, and not when somebody waits

        def said(step: str, share: float) -> None:
            pipe.send(("progress", (step, float(share))))

        while True:
            try:
                job, what = pipe.recv()
            except (EOFError, OSError, KeyboardInterrupt):
                return
            try:
                pipe.send(("done", (job, JOBS[job](robot, tip, said, **what))))
            except ManipLearnError as error:
                pipe.send(("failed", (job, str(error))))
            except KeyboardInterrupt:
                return
            except Exception as error:  # the arm goes on: whatever failed here is a sentence there
                pipe.send(("failed", (job, f"{type(error).__name__}: {error}")))


# ---- jobs ---------------------------------------------------------------------------------------------------------


def learn(robot: Robot, tip: str, said: Progress, *, files: list[str], file: str) -> dict[str, Any]:
    """Learn from recordings; the skill goes to a file.

    Returns:
        The answer as the page shows it, and the phases of the recordings by their file names.
    """
    from manip_learn.constraint.features import FrameJacobian
    from manip_learn.learning import ConstraintLearner
    from manip_learn.playback.palette import phase_kinds
    from manip_learn.playback.replay_page import evidence_of
    from manip_learn.playback.scene_data import mechanism_drawing
    from manip_learn.recordings import load_demonstrations

    demos = load_demonstrations(files, robot)
    rows = [FrameJacobian(robot, tip, "xyz", reference) for reference in ("world", "local")]
    learner = ConstraintLearner(rows).fit(demos, progress=said)
    report = learner.report_
    skill = with_gripper(learner.skill_)
    skill.save(file)
    names = [c.mechanism.type if c.mechanism is not None else "" for c in learner.constraints_]
    evidence, mechanism, shown = evidence_of(report), report.mechanism, skill.constraints[0].shown
    uncertain, drawn = report.uncertainty_deg, None
    if mechanism is not None:
        uncertain = mechanism.uncertainty.get("axis") if uncertain is None else uncertain
        places = [robot.position(q, tip) for t in demos for q in t.q[::50]] if shown is None else shown.points
        drawn = mechanism_drawing(mechanism, np.array(places), shown).to_dict()
    answer = {
        **{name: evidence[name] for name in ("facts", "rows", "warnings", "odd")},
        "sentence": report.sentence,
        "refused": False,
        "evidence": evidence["words"],
        "phaseKinds": [vars(kind) for kind in phase_kinds(report.phases, names)] if report.phases else [],
        "mechanism": drawn,
    }
    phases = [[name, start, end, -1 if k is None else k] for name, start, end, k, *_ in report.phases]
    return {"answer": answer, "phases": phases, "uncertainty": uncertain}


def with_gripper(skill: Skill) -> Skill:
    """Return a skill whose ways begin with a gripper that closes, and end with one that opens, as a person has done."""
    steps = [replace(step, gripper="close" if step.kind == "way" else None) for step in skill.steps]
    for k in (k for k in range(1, len(steps)) if steps[k - 1].kind == "way" and steps[k].kind == "reach"):
        steps[k] = replace(steps[k], gripper="open")
    return replace(skill, steps=tuple(steps))


def first_way(skill: Skill) -> Constraint | None:
    """Return the constraint of the first way of a skill, with what was shown along it; None where none is long enough.

    Args:
        skill: As learnt.

    Returns:
        A way of 2 cm, or of 3 degrees, or more.
    """
    for way in (step.as_shown for step in skill.steps if step.kind == "way"):
        if way is not None and way.shown is not None and way.shown.extent > {"m": 0.02, "rad": 0.05}[way.shown.unit]:
            return way
    return None


def distance_in_words(distance: float, unit: str) -> str:
    """Return a distance [m] or an angle [rad] as `"23.4 cm"` or `"41 degrees"`."""
    return f"{100.0 * distance:.1f} cm" if unit == "m" else f"{np.degrees(distance):.0f} degrees"


def _limits(robot: Robot, tip: str) -> Any:
    """Return the limits of what the arm does by itself: at the tip the reduced speed beside people of ISO 10218-1."""
    from manip_learn.control.limits import Limits
    from manip_learn.control.tasks.motion import APPROACH_SPEED

    # [rad/s or m/s] of joints whose description has no limit, in units of which a plan counts its margin
    velocity = np.where(np.isfinite(robot.velocity_limit), robot.velocity_limit, 1.5)
    return Limits(robot, velocity=velocity, tip_speed=APPROACH_SPEED, frames=tip)


def _repeat(robot: Robot, tip: str, said: Progress, *, file: str, start: ArrayLike, scene: Any) -> Any:
    """Return what `repeat` makes of a skill's file.

    Args:
        robot: The robot.
        tip: Its frame that is guided.
        said: As for `repeat`.
        file: Of the skill.
        start: shape (nv,), posture of the arm [rad or m].
        scene: What stands around it.
    """
    from manip_learn.planning.repeat import repeat

    return repeat(Skill.load(file, robot), start, scene=scene, limits=_limits(robot, tip), dt=STEP, progress=said)


def _compare(robot: Robot, tip: str, said: Progress, *, file: str, start: ArrayLike, scene: Any) -> dict[str, Any]:
    """Return ghosts of the task without and with the learnt manipulability, from one start; and both in a sentence.

    Without: the resolved-rate law whose null-space policy is zero. With: as `repeat` plans the way. In both a hand that
    slides keeps its orientation, as a gripper does that has closed on a bar. Arguments as for `_repeat`.
    """
    from manip_learn.control.controller import ResolvedRateController
    from manip_learn.control.policies import ZeroPolicy
    from manip_learn.control.simulation import simulate_way
    from manip_learn.control.tasks.motion import motion
    from manip_learn.planning.plan import plan
    from manip_learn.playback.palette import rollout_colours

    step, limits = next(one for one in Skill.load(file, robot).steps if one.kind == "way"), _limits(robot, tip)
    way: Any = step.as_shown
    task = motion(way, keep_orientation=way.shown.unit == "m")
    law = ResolvedRateController(way, task, ZeroPolicy(robot.nv), dt=STEP, limits=limits)
    alone, stopped = simulate_way(robot, law, np.asarray(start), STEP)
    planned = plan(way, task, start, limits=limits, scene=scene, dt=STEP, progress=said, takes=step.takes)
    ends = (alone, stopped), (planned.rollout, planned.outcome)
    colours = rollout_colours(["the arm itself", "without", "with"], {})[1:]
    ghosts, words = [], []
    for name, (rollout, end), (_, colour) in zip(("without", "with"), ends, colours, strict=True):
        far = distance_in_words(abs(end.done), end.unit)
        words.append(f"all {far}" if end.is_done else f"stops after {far}")
        why = "" if end.is_done else f": {end.stopped_by}"
        made = ghost(robot, name, colour, rollout.time, rollout.q, rollout.manipulability, words[-1] + why)
        ghosts.append(made | {"share": end.done / end.wanted})
    return {"rollouts": ghosts, "sentence": "Without: {}. With: {}.".format(*words)}


def ghost(
    robot: Robot, name: str, colour: str, time: Any, q: Any, curve: Any = None, ended: str = ""
) -> dict[str, Any]:
    """A motion as the page plays it beside the arm.

    Args:
        robot: The robot.
        name: In the legend.
        colour: Hexadecimal value.
        time: shape (T,) [s].
        q: shape (T, nv), postures.
        curve: shape (T,), manipulability, or None.
        ended: How it ended, in words.
    """
    from manip_learn.playback.appearance import joint_tracks
    from manip_learn.playback.page_writer import to_base64
    from manip_learn.recordings.trajectory import evenly

    kept = evenly(len(time), 400)  # 60 a second for seven seconds
    times = np.asarray(time)[kept] - time[0]
    mu = np.zeros(0) if curve is None else np.asarray(curve)[kept]
    return {
        "name": name,
        "colour": colour,
        "duration": float(times[-1]),
        "keyTimes": to_base64(times, "<f8"),
        "tracks": to_base64(joint_tracks(robot, np.asarray(q)[kept]), "<f8"),
        "curveTimes": to_base64(times if len(mu) else mu, "<f8"),
        "curve": to_base64(mu, "<f8"),
        "ended": ended,
    }


JOBS: dict[str, Callable[..., Any]] = {"learn": learn, "repeat": _repeat, "compare": _compare, "take": taken_home}
