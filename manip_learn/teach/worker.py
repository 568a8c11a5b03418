"""Learning, planning and simulation in a separate process: they take seconds, and the arm must keep moving."""

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
from manip_learn.teach.files import write_export

STEP = 0.01  # [s] time step of simulations, equal to the arm's period


@final
class TeachingWorker:
    """Process that learns, plans and simulates for one robot, one job at a time.

    Args:
        robot: The robot.
        tip: Name of the guided frame.
    """

    def __init__(self, robot: Robot, tip: str):
        self._robot, self._tip = robot, tip
        self._start()

    def _start(self) -> None:
        """Start the process."""
        context = multiprocessing.get_context("spawn")
        self._pipe, theirs = context.Pipe()
        self._process = context.Process(
            target=_serve, args=(theirs, self._robot, self._tip, os.getpid()), name="teaching", daemon=True
        )
        self._process.start()
        theirs.close()
        self.busy = ""

    def ask(self, job: str, **what: Any) -> None:
        """Start a job, and cancel the previous one.

        Args:
            job: Name of a job, a key of `JOBS`.
            **what: Keyword arguments of the job's function.
        """
        self.give_up()
        self.busy = job
        self._pipe.send((job, what))

    def give_up(self) -> None:
        """Cancel the present job, if there is one."""
        if self.busy:
            self.close()
            self._start()

    def heard(self) -> list[tuple[str, Any]]:
        """Return the messages of the process since the last call.

        Returns:
            Pairs of a kind and its content: `("progress", (name of the stage, completed fraction))`, `("done", (job,
            result))` or `("failed", (job, message of the error))`.
        """
        out: list[tuple[str, Any]] = []
        try:
            while self._pipe.poll():
                out.append(self._pipe.recv())
        except (EOFError, OSError):
            out.append(("failed", (self.busy, "the learning process has ended: is there enough memory?")))
            self.close()
            self._start()
        if any(kind != "progress" for kind, _ in out):
            self.busy = ""
        return out

    def close(self) -> None:
        """Stop the process, even in the middle of a job."""
        self._process.terminate()
        self._process.join(1.0)  # [s] for an orderly end
        if self._process.is_alive():
            self._process.kill()
            self._process.join()
        self._pipe.close()


def _serve(pipe: Connection, robot: Robot, tip: str, parent: int) -> None:
    """Run job after job in the process until the pipe closes or the parent ends."""
    threading.Thread(target=end_with_parent, args=(parent,), daemon=True).start()
    with open(os.devnull, "w") as nowhere:  # warnings are part of the answers
        sys.stdout = sys.stderr = nowhere
        if (nice := getattr(os, "nice", None)) is not None:  # Windows has none
            nice(10)  # on one core the physics have priority
        from manip_learn import learning  # noqa: F401  # load it now, before a person waits

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
            except Exception as error:  # the arm keeps moving: any failure becomes a sentence on the page
                pipe.send(("failed", (job, f"{type(error).__name__}: {error}")))


# ---- jobs ---------------------------------------------------------------------------------------------------------


def learn(robot: Robot, tip: str, said: Progress, *, files: list[str], file: str) -> dict[str, Any]:
    """Learn from recordings, and save the skill.

    Args:
        robot: The robot.
        tip: Name of the guided frame.
        said: Function that is called with the name of a stage and its completed fraction, 0 to 1.
        files: Paths of the recordings.
        file: Path of the file for the skill.

    Returns:
        Answer for the page, with the phases of the recordings by file name.
    """
    from manip_learn.constraint.features.frame_jacobian import FrameJacobian
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
    evidence, mechanism, example = evidence_of(report), report.mechanism, skill.constraints[0].shown
    uncertain, drawn = report.uncertainty_deg, None
    if mechanism is not None:
        uncertain = mechanism.uncertainty.get("axis") if uncertain is None else uncertain
        places = [robot.position(q, tip) for t in demos for q in t.q[::50]] if example is None else example.points
        drawn = mechanism_drawing(mechanism, np.array(places), example).to_dict()
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
    """Return a copy of a skill that closes the gripper at the start of each motion step, and opens it after the step.

    Args:
        skill: The learnt skill.
    """
    steps = [replace(step, gripper="close" if step.kind == "way" else None) for step in skill.steps]
    for k in (k for k in range(1, len(steps)) if steps[k - 1].kind == "way" and steps[k].kind == "reach"):
        steps[k] = replace(steps[k], gripper="open")
    return replace(skill, steps=tuple(steps))


def first_way(skill: Skill) -> Constraint | None:
    """Return the constraint, with its demonstrated motion, of the first motion step of a skill that is long enough.

    Args:
        skill: The learnt skill.

    Returns:
        Constraint whose motion is longer than 0.02 m or 0.05 rad; None if there is none.
    """
    for way in (step.as_shown for step in skill.steps if step.kind == "way"):
        if way is not None and way.shown is not None and way.shown.extent > {"m": 0.02, "rad": 0.05}[way.shown.unit]:
            return way
    return None


def distance_in_words(distance: float, unit: str) -> str:
    """Return a distance as `"23.4 cm"`, or an angle as `"41 degrees"`.

    Args:
        distance: Distance or angle [m or rad].
        unit: `"m"` or `"rad"`.
    """
    return f"{100.0 * distance:.1f} cm" if unit == "m" else f"{np.degrees(distance):.0f} degrees"


def _limits(robot: Robot, tip: str) -> Any:
    """Return the limits of the arm's own motion: at the tip, the reduced speed near people of ISO 10218-1."""
    from manip_learn.control.limits import Limits
    from manip_learn.control.tasks.motion import APPROACH_SPEED

    # [rad/s or m/s] 1.5 for joints without a limit in the description; a plan needs a limit as the scale of its margin
    velocity = np.where(np.isfinite(robot.velocity_limit), robot.velocity_limit, 1.5)
    return Limits(robot, velocity=velocity, tip_speed=APPROACH_SPEED, frames=tip)


def _repeat(robot: Robot, tip: str, said: Progress, *, file: str, start: ArrayLike, scene: Any) -> Any:
    """Return the result of `repeat` for a skill.

    Args:
        robot: The robot.
        tip: Its guided frame.
        said: As for `repeat`.
        file: File of the skill.
        start: shape (nv,), posture of the arm [rad or m].
        scene: Its surroundings.
    """
    from manip_learn.planning.repeat import repeat

    return repeat(Skill.load(file, robot), start, scene=scene, limits=_limits(robot, tip), dt=STEP, progress=said)


def _compare(robot: Robot, tip: str, said: Progress, *, file: str, start: ArrayLike, scene: Any) -> dict[str, Any]:
    """Return ghosts of the task without and with the learnt manipulability, from one start; and both in a sentence.

    Without: the resolved-rate law whose null-space policy is zero. With: the plan of `repeat`. In both, a hand that
    slides keeps its orientation, like a gripper that has closed on a bar. Arguments as for `_repeat`.
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
        content = ghost(robot, name, colour, rollout.time, rollout.q, rollout.manipulability, words[-1] + why)
        ghosts.append(content | {"share": end.done / end.wanted})
    return {"rollouts": ghosts, "sentence": "Without: {}. With: {}.".format(*words)}


def ghost(
    robot: Robot, name: str, colour: str, time: Any, q: Any, curve: Any = None, ended: str = ""
) -> dict[str, Any]:
    """Return a motion that the page plays next to the arm, as data for JSON.

    Args:
        robot: The robot.
        name: Name in the legend.
        colour: Colour as a hexadecimal text.
        time: shape (T,), time of each sample [s].
        q: shape (T, nq) or (T, nv), postures.
        curve: shape (T,), manipulability; None to show none.
        ended: Reason for the end of the motion, in words; empty if it is complete.
    """
    from manip_learn.playback.appearance import joint_tracks
    from manip_learn.playback.page_writer import to_base64
    from manip_learn.recordings.trajectory import evenly

    indices = evenly(len(time), 400)  # 60 per second for seven seconds
    times = np.asarray(time)[indices] - time[0]
    mu = np.zeros(0) if curve is None else np.asarray(curve)[indices]
    return {
        "name": name,
        "colour": colour,
        "duration": float(times[-1]),
        "keyTimes": to_base64(times, "<f8"),
        "tracks": to_base64(joint_tracks(robot, np.asarray(q)[indices]), "<f8"),
        "curveTimes": to_base64(times if len(mu) else mu, "<f8"),
        "curve": to_base64(mu, "<f8"),
        "ended": ended,
    }


JOBS: dict[str, Callable[..., Any]] = {"learn": learn, "repeat": _repeat, "compare": _compare, "take": write_export}
