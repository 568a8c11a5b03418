"""What takes seconds while the arm goes on moving: learning, planning, simulating; in a process of its own."""

from __future__ import annotations

import multiprocessing
import os
import sys
import threading
import time
from collections.abc import Callable, Mapping
from multiprocessing.connection import Connection
from typing import Any, final

import numpy as np
from numpy.typing import ArrayLike

from manip_learn.constraint.shown import Shown
from manip_learn.errors import ManipLearnError, OutputError, counted
from manip_learn.recordings.load import Progress
from manip_learn.robot.robot import Robot
from manip_learn.teach.scene import posture_at
from manip_learn.teach.way import STEP, TaughtWay, held_by_handles

PARENT_CHECK_SECONDS = 0.5  # between two looks for the parent
_STOP_SECONDS = 1.0  # for the process to end by itself
GENTLE = 10  # steps of niceness: on one core the physics go first
MOST_KEYS = 400  # key frames of a ghost: 60 a second for seven seconds
BAD_POSTURES, _TRIED = 400, 24  # at random, a millisecond each; the worst of them are simulated, 0.2 s each


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
        self._process.join(_STOP_SECONDS)
        if self._process.is_alive():
            self._process.kill()
            self._process.join()
        self._pipe.close()


def _serve(pipe: Connection, robot: Robot, tip: str, parent: int) -> None:
    """The process: job after job until the pipe closes or the parent is gone."""
    threading.Thread(target=_end_with, args=(parent,), daemon=True).start()
    with open(os.devnull, "w") as nowhere:  # its warnings are part of the answers
        sys.stdout = sys.stderr = nowhere
        if (nice := getattr(os, "nice", None)) is not None:  # Windows has none
            nice(GENTLE)
        from manip_learn import learning  # noqa: F401  # now, and not when somebody waits

        while True:
            try:
                job, what = pipe.recv()
            except (EOFError, OSError, KeyboardInterrupt):
                return
            try:
                pipe.send(("done", (job, JOBS[job](robot, tip, _said(pipe), **what))))
            except ManipLearnError as error:
                pipe.send(("failed", (job, str(error))))
            except KeyboardInterrupt:
                return
            except Exception as error:  # the arm goes on: whatever failed here is a sentence there
                pipe.send(("failed", (job, f"{type(error).__name__}: {error}")))


def _end_with(parent: int) -> None:
    while os.getppid() == parent:
        time.sleep(PARENT_CHECK_SECONDS)
    os._exit(0)


def _said(pipe: Connection) -> Progress:
    return lambda step, share: pipe.send(("progress", (step, float(share))))


# ---- jobs ---------------------------------------------------------------------------------------------------------


def learn(
    robot: Robot, tip: str, said: Progress, *, files: list[str], handles: list[np.ndarray], out: str
) -> dict[str, Any]:
    """Learn from recordings; the skill goes to a file.

    Returns:
        The answer as the page shows it, and the phases of the recordings by their file names.
    """
    from manip_learn.constraint.features import FrameJacobian
    from manip_learn.learning import ConstraintLearner
    from manip_learn.playback.phase_bands import phase_kinds
    from manip_learn.playback.replay_page import evidence_of
    from manip_learn.recordings import load_demonstrations

    demos = load_demonstrations(files, robot)
    rows = [FrameJacobian(robot, tip, "xyz", reference) for reference in ("world", "local")]
    learner = ConstraintLearner(rows).fit(demos, progress=said)
    report = learner.report_
    skill = held_by_handles(learner.skill_, handles)
    skill.save(out)
    names = [c.mechanism.type if c.mechanism is not None else "" for c in learner.constraints_]
    evidence = evidence_of(report)
    answer = {
        "sentence": report.sentence,
        "refused": False,
        "evidence": evidence["words"],
        "facts": evidence["facts"],
        "rows": evidence["rows"],
        "warnings": evidence["warnings"],
        "odd": evidence["odd"],
        "phaseKinds": [vars(kind) for kind in phase_kinds(report.phases, names)] if report.phases else [],
        "mechanism": None
        if report.mechanism is None
        else _drawn(robot, tip, report.mechanism, demos, report.phases, skill.constraints[0].shown),
        "others": [c.mechanism.sentence for c in learner.constraints_[1:] if c.mechanism is not None],
    }
    uncertain = report.uncertainty_deg
    if uncertain is None and report.mechanism is not None:
        uncertain = report.mechanism.uncertainty.get("axis")
    phases = [[name, start, end, -1 if k is None else k] for name, start, end, k, *_ in report.phases]
    return {"answer": answer, "phases": phases, "uncertainty": uncertain, "warned": bool(report.warnings)}


def _drawn(robot: Robot, tip: str, mechanism: Any, demos: Any, phases: Any, shown: Shown | None) -> dict[str, Any]:
    """Lines and patches of a mechanism, as large as the motion that it held, and what was shown along it."""
    from manip_learn.playback.mechanism_drawing import mechanism_drawing

    held = [
        robot.position(t.q[k], tip)
        for t in demos
        for name, start, end, number, *_ in phases
        if name == t.name and number == 0
        for k in np.flatnonzero((t.time >= start) & (t.time <= end))[::10]
    ]
    places = np.array(held or [robot.position(t.q[0], tip) for t in demos])
    drawing = mechanism_drawing(mechanism, places, shown)
    return drawing.to_dict()


def policies(
    robot: Robot, tip: str, said: Progress, *, file: str, way: Mapping[str, Any], start: ArrayLike
) -> dict[str, Any]:
    """Three null-space policies from a posture, as ghosts."""
    names = ("manipulability", "attractor", "zero")  # the recommended one first
    taught = TaughtWay.asked_for(file, robot, way)
    ghosts = _simulated(robot, dict(zip(names, names, strict=True)), taught, np.asarray(start))
    return {"rollouts": ghosts, "sentence": "The three policies start from the same posture."}


def _compare(
    robot: Robot, tip: str, said: Progress, *, file: str, way: Mapping[str, Any], start: ArrayLike
) -> dict[str, Any]:
    """With and without the learnt manipulability, as ghosts, from a posture in which doing without fails.

    Of many random postures at the handle the worst ones are tried, by their manipulability; they may be singular.
    """
    from manip_learn.constraint.manipulability import manipulability

    taught, place = TaughtWay.asked_for(file, robot, way), np.eye(4)
    place[:3, :3], place[:3, 3] = taught.shown.orientation, taught.shown.begin
    rows, rng = taught.task().constraint, np.random.default_rng(0)
    drawn = (robot.positions(robot.random_configuration(rng)) for _ in range(BAD_POSTURES))
    found = [q for d in drawn if (q := posture_at(robot, tip, d, place, firm=False, weakest=0.0)) is not None]
    inside = [q for q in found if np.all((robot.position_lower < q) & (q < robot.position_upper))]
    bad = sorted([*inside, np.asarray(start, dtype=np.float64)], key=lambda q: manipulability(rows, q))[:_TRIED]
    with_it, without = {"with": "manipulability"}, {"without": "zero"}
    for k, q in enumerate(bad):
        said("looking for a start that matters", k / len(bad))
        if not _simulated(robot, without, taught, q)[0]["failed"]:
            continue
        ghosts = _simulated(robot, with_it | without, taught, q)
        if not ghosts[0]["failed"]:
            return {"rollouts": ghosts, "sentence": f"Without the learnt manipulability: {ghosts[1]['ended']}."}
    none = f"Of the {counted(len(bad), 'worst start')} none was found from which only doing without fails."
    return {"rollouts": _simulated(robot, with_it | without, taught, bad[0]), "sentence": none}


def _plan(
    robot: Robot, tip: str, said: Progress, *, file: str, way: Mapping[str, Any], start: ArrayLike, place: ArrayLike
) -> dict[str, Any]:
    """The posture in which to take hold, and the way of the joints to it: times [s] and postures."""
    from manip_learn.planning.plan import plan as planned

    taught = TaughtWay.asked_for(file, robot, way)
    task = taught.task(place)
    found = planned(task.learnt, task, start, limits=taught.limits, progress=said)
    return {"time": found.approach.time, "q": found.approach.q, "sentence": found.sentence}


def _simulated(robot: Robot, named: Mapping[str, str], way: TaughtWay, start: np.ndarray) -> list[dict[str, Any]]:
    """Rollouts of some policies, as the page plays them."""
    from manip_learn.control.controller import ResolvedRateController
    from manip_learn.control.simulation import simulate_way
    from manip_learn.control.tasks.motion import null_policy
    from manip_learn.playback.palette import rollout_colours

    ghosts = []
    colours_of = rollout_colours(["the arm itself", *named], {})[1:]
    for (name, policy), (_, colour) in zip(named.items(), colours_of, strict=True):
        task = way.task()
        chosen = null_policy(policy, task, task.learnt, robot, None, start)
        controller = ResolvedRateController(task.learnt, task, chosen, dt=STEP, limits=way.limits)
        rollout, done = simulate_way(robot, controller, start, STEP)
        ended = way.in_words(done.done) + (f", stopped by {done.stopped_by}" if done.stopped_by else "")
        made = ghost(robot, name, colour, rollout.time, rollout.q, rollout.manipulability, ended)
        ghosts.append({**made, "failed": not done.is_done})
    return ghosts


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
    from manip_learn.playback.kinematic_tree import joint_tracks, kinematic_tree
    from manip_learn.playback.page_writer import packed
    from manip_learn.recordings.trajectory import evenly

    kept = evenly(len(time), MOST_KEYS)
    times = np.asarray(time)[kept] - time[0]
    mu = np.zeros(0) if curve is None else np.asarray(curve)[kept]
    return {
        "name": name,
        "colour": colour,
        "duration": float(times[-1]),
        "keyTimes": packed(times, "<f8"),
        "tracks": packed(joint_tracks(robot, kinematic_tree(robot), np.asarray(q)[kept]), "<f8"),
        "curveTimes": packed(times if len(mu) else mu, "<f8"),
        "curve": packed(mu, "<f8"),
        "ended": ended,
    }


def take(robot: Robot, tip: str, said: Progress, *, what: str, **lesson: Any) -> list[tuple[str, str, str]]:
    """Files to take home: name, path and what each is.

    Args:
        robot: The robot.
        tip: Its frame that is guided.
        said: Told how far it is.
        what: constraint, csv, lerobot, replay or script.
        lesson: The other fields of `Lesson`.

    Raises:
        OutputError: Nothing was learnt that could be taken, or a word that is none of these.
    """
    from manip_learn.teach.files import HOMES, Lesson

    if what not in HOMES:
        raise OutputError(f"what can be taken home is {', '.join(HOMES)}, not {what!r}")
    if lesson["file"] is None and what not in ("csv", "lerobot"):
        raise OutputError("nothing has been learnt yet: press Learn first; the recordings can be taken as they are")
    said("writing", 0.3)
    return HOMES[what](Lesson(robot, tip, **lesson))


JOBS: dict[str, Callable[..., Any]] = {
    "learn": learn,
    "policies": policies,
    "compare": _compare,
    "plan": _plan,
    "take": take,
}
