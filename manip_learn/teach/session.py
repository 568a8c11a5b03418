"""Session of the teaching page: demonstrate, record, learn, reproduce and export a task."""

from __future__ import annotations

import json
import queue
import re
import time
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from itertools import count
from pathlib import Path
from typing import Any, cast, final

import numpy as np
from jaxtyping import Float

from manip_learn.atomic_write import write_atomically
from manip_learn.constraint.constraint import Constraint
from manip_learn.constraint.skill import Skill
from manip_learn.control.contact import STIFFNESS, Contact
from manip_learn.control.controller import ResolvedRateController
from manip_learn.control.driver import run
from manip_learn.control.joint_motion import JointMotion, LawSequence, every_joint
from manip_learn.control.limits import Limits
from manip_learn.control.servo_loop import ServoLoop
from manip_learn.control.tasks.motion import FreeDirection, motion
from manip_learn.drivers.record import record
from manip_learn.errors import ManipLearnError, counted
from manip_learn.linalg import finite
from manip_learn.planning.repeat import Repetition
from manip_learn.playback.live_viewer import LiveProcess
from manip_learn.playback.palette import COLOURS
from manip_learn.recordings import load_demonstrations
from manip_learn.recordings.trajectory import Trajectory
from manip_learn.robot.robot import Robot
from manip_learn.teach.arm import PERIOD, TeachingArm
from manip_learn.teach.picture import TeachingPicture, answer_content, refusal_content, scene_content, truth_content
from manip_learn.teach.scene import MOVES, Kind, place_scene
from manip_learn.teach.worker import TeachingWorker, distance_in_words, first_way, ghost

LEFT = 30.0  # [s] without a page after which the program ends: after Back by mistake a person returns in less
FEW = 3  # smallest number of recordings from which constraints can be learnt


@final
@dataclass
class TaughtRecording:
    """Recording of a teaching session.

    Attributes:
        path: File of the recording.
        motion: Recorded motion.
        phases: Start [s], end [s] and index of the constraint of each phase; the index is -1 for free motion.
        odd: Reason why the recording disagrees with the others; empty if it agrees.
    """

    path: Path
    motion: Trajectory
    phases: list[list[float]] = field(default_factory=list)
    odd: str = ""

    def to_dict(self) -> dict[str, Any]:
        """Return the recording as data for the page, with times relative to its first sample [s]."""
        first = float(self.motion.time[0])
        phases = [[start - first, end - first, k] for start, end, k in self.phases]
        numbers = {"seconds": round(self.motion.duration, 2), "samples": len(self.motion)}
        return {"name": self.path.stem, **numbers, "odd": self.odd, "phases": phases}


@final
class TeachingSession:
    """Teaching session: one arm, one scene at a time, and the person's recordings of it.

    `hear` and `end` may be called from any thread; everything else runs in the thread of `run`, between two periods of
    the simulation.

    Args:
        robot: The arm.
        tip: Name of the guided frame.
        keep: Folder for recordings and learnt constraints.
        kind: Kind of the first scene.
        seed: Seed of positions and noise. The first scene of each kind has this seed, the next ones the following
            seeds.
        shows: Process that shows pictures and texts.
        in_real_time: True to run the simulation in real time.

    Raises:
        ManipLearnError: The robot cannot be simulated in a teaching scene, or cannot reach the scene.
    """

    def __init__(
        self, robot: Robot, tip: str, keep: Path, kind: Kind, seed: int, shows: LiveProcess, in_real_time: bool = True
    ):
        self.robot, self.tip, self.keep = robot, tip, keep
        self._shows, self._real = shows, in_real_time
        self._seed, self._placed = seed, Counter[str]()
        self._heard: queue.SimpleQueue[Mapping[str, Any]] = queue.SimpleQueue()
        self._picture = TeachingPicture(robot, tip)
        self._worker = TeachingWorker(robot, tip)
        self._pages: list[str] = []
        self._leader, self._left = "", np.inf
        self._mode: Callable[[], None] | None = None
        self._doing, self._sentence, self._wrong = "idle", "", False
        self._ended = self._stop = False
        self._seq = self._number = 0
        self._numbers = count(1)  # numbers of ghosts and files, in their order
        self._put: dict[str, str] = {}
        self._looked = self._began = 0.0
        self._acts: dict[str, Callable[[Mapping[str, Any]], None]] = {
            "pull": self._pull,
            "release": lambda _: self.arm.let_go(),
            "grip": self._grip,
            "scene": lambda said: self._begin(lambda kind=str(said["kind"]): self._place(cast(Kind, kind))),
            "home": lambda _: self._begin(self._home),
            "record": lambda _: self._start_or_stop(),
            "rename": self._rename,
            "delete": self._delete,
            "replay": self._replay,
            "ghosts": lambda _: self._show("ghosts", None),
            "learn": lambda _: self._learn(),
            "truth": lambda said: setattr(self, "_truth_shown", bool(said["show"])),
            "run": lambda _: self._begin(self._run),
            "stop": lambda _: setattr(self, "_stop", True),
            "compare": lambda _: self._compare(),
            "take": self._take,
            "drop": self._drop,
        }
        try:
            self._place(kind)
        except ManipLearnError:
            self._worker.close()
            raise

    # ---- the thread of the physics --------------------------------------------------------------------------------

    def hear(self, heard: Mapping[str, Any]) -> None:
        """Accept a message from the page or the server, in any thread.

        Args:
            heard: The message, decoded from JSON.
        """
        self._heard.put(heard)

    def end(self) -> None:
        """End `run` soon; may be called in any thread."""
        self._heard.put({"end": True})

    @property
    def files(self) -> tuple[Path, ...]:
        """Files of the recordings of the present scene."""
        return tuple(one.path for one in self._recordings)

    @property
    def sentence(self) -> str:
        """Sentence on the constraint learnt in the present scene; empty if none was learnt."""
        return "" if self._answer is None else str(self._answer["sentence"])

    def run(self) -> None:
        """Run the session until the last page is closed, or `end` is called."""
        try:
            while not self._ended:
                mode, self._mode, self._stop = self._mode or self._idle, None, False
                try:
                    mode()
                except ManipLearnError as refusal:
                    self._say(str(refusal), wrong=True)
        finally:
            self._show("ended", True)
            self._worker.close()

    def _idle(self) -> None:
        """Let the arm be guided until the next mode."""
        self._doing = "idle"
        self.arm.release()
        while self._mode is None and not self._ended:
            self.arm.wait()

    def _period(self) -> None:
        """Handle messages and show a picture, between two periods of the physics."""
        while not self._heard.empty():
            heard = self._heard.get()
            self._ended |= "end" in heard
            if "pages" in heard:
                self._set_pages(heard["pages"])
            self._obey(str(heard.get("page", "")), heard.get("said"))
        self._touched |= self.arm.held
        self._ended |= time.monotonic() - self._left > LEFT
        self._stop |= self._ended
        for kind, what in self._worker.heard():
            self._handle_answer(kind, what)
        if self.arm.hand.pull is not None and self._doing in ("idle", "recording") and self.arm.close_when_near():
            self._report_grasp()
        pose = self._picture.pose(self.arm, self.constraint, self._rows)
        pose |= {"seq": self._seq, "trail": self._doing == "recording"}
        self._shows.put(lambda: json.dumps(pose, allow_nan=False), "pose")
        now = time.monotonic()
        if now - self._looked > 0.1 or not self._real:  # [s] between two states: only poses are sent more often
            self._looked = now
            self._show_state()

    def _set_pages(self, pages: list[str]) -> None:
        """Note the open pages, the first of which leads if the leader has closed."""
        if pages or self._pages:
            self._left = np.inf if pages else time.monotonic()
        self._pages = pages
        if self._leader not in pages:
            if self._leader and self.arm.hand.pull is not None:
                self.arm.let_go()
            self._leader = pages[0] if pages else ""

    def _say(self, sentence: str, wrong: bool = False) -> None:
        """Show a sentence on the page."""
        self._sentence, self._wrong = sentence, wrong

    # ---- requests of the page -------------------------------------------------------------------------------------

    def _obey(self, page: str, said: Any) -> None:
        """Do what a page requests, if it is the leading page."""
        do = said.get("do") if isinstance(said, Mapping) else None
        if do == "lead" and page in self._pages:
            self.arm.let_go()
            self._leader = page
            return
        act = self._acts.get(str(do))
        if act is None or (page != self._leader and self._pages):
            return
        try:
            act(said)
        except ManipLearnError as refusal:
            self._say(str(refusal), wrong=True)
        except (KeyError, TypeError, ValueError, OSError) as error:
            self._say(f"The page sent an invalid request {do!r}: {error}", wrong=True)

    def _begin(self, mode: Callable[[], None]) -> None:
        """Stop the present mode, and begin this one."""
        self._stop, self._mode = True, mode

    def _pull(self, said: Mapping[str, Any]) -> None:
        """Pull the arm to a target."""
        link, turn = said.get("link"), said.get("turn")
        at = None if link is None else _three(said["at"])
        to, turn = _three(said["to"]), None if turn is None else _three(turn)
        self._seq = int(said.get("seq", 0))
        self.arm.pull(link, at, to, turn)

    def _grip(self, said: Mapping[str, Any]) -> None:
        """Close or open the gripper."""
        if not said["closed"]:
            self.arm.grip(False)
            self._say("The gripper is open.")
        elif self.arm.grip(True):
            self._report_grasp()
        else:
            self._say("No handle is within reach of the gripper: take the hand to one first.")

    def _report_grasp(self) -> None:
        """Show that the gripper holds the handle."""
        handle = self.arm.scene.handle
        self._say(f"Holding the {handle.name}. {MOVES[handle.type][0]}.")

    def _start_or_stop(self) -> None:
        """Start a recording, or stop it."""
        if self._doing == "recording":
            self._stop = True
        else:
            self._begin(self._record)

    def _recording_by_name(self, name: Any) -> TaughtRecording:
        """Return the recording of a name."""
        for one in self._recordings:
            if one.path.stem == name:
                return one
        raise ValueError(f"there is no recording {name!r}")

    def _read(self, path: Path) -> TaughtRecording:
        """Read a recording and add it."""
        self._recordings.append(one := TaughtRecording(path, load_demonstrations([str(path)], self.robot)[0]))
        return one

    def _rename(self, said: Mapping[str, Any]) -> None:
        """Rename a recording."""
        one, to = self._recording_by_name(said["name"]), str(said["to"]).strip()
        path = one.path.with_name(f"{to}.csv")
        if not re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9 ._-]{0,60}", to):
            raise ManipLearnError("A name has letters, digits, spaces, dots and dashes, up to 60 of them.")
        if path.exists():
            raise ManipLearnError(f"There is a recording {to!r} already: choose another name.")
        one.path = one.path.rename(path)

    def _delete(self, said: Mapping[str, Any]) -> None:
        """Delete a recording."""
        one = self._recording_by_name(said["name"])
        one.path.unlink(missing_ok=True)
        self._recordings.remove(one)
        self._say(f"{one.path.stem} is deleted.")

    def _replay(self, said: Mapping[str, Any]) -> None:
        """Show a recording as a ghost."""
        one = self._recording_by_name(said["name"])
        motion_ghost = ghost(self.robot, one.path.stem, COLOURS["vermilion"], one.motion.time, one.motion.q)
        self._show_ghosts("replay", [motion_ghost])

    def _drop(self, said: Mapping[str, Any]) -> None:
        """Add a recording that was dropped on the page, if it belongs to this robot."""
        stem = re.sub(r"[^A-Za-z0-9._-]+", "_", Path(str(said["name"])).stem)[:60].lstrip(".") or "dropped"
        self.folder.mkdir(parents=True, exist_ok=True)
        path, number = self.folder / f"{stem}.csv", 2
        while path.exists():
            path, number = self.folder / f"{stem}_{number}.csv", number + 1
        write_atomically(path, str(said["text"]))
        try:
            one = self._read(path)
        except ManipLearnError as refusal:
            path.unlink()
            raise ManipLearnError(f"{said['name']} is not a recording of {self.robot.name!r}: {refusal}") from refusal
        self._say(f"{path.stem} is added: {counted(len(one.motion), 'sample')}.")

    # ---- scene ----------------------------------------------------------------------------------------------------

    def _place(self, kind: Kind) -> None:
        """Begin another scene of a kind; recordings and answers of the former scene stay on the disk."""
        rng = np.random.default_rng(self._seed + self._placed[kind])  # the first of each kind is always the same
        scene = place_scene(kind, self.robot, self.tip, rng)
        self._placed[kind] += 1
        self._worker.give_up()
        self.arm = TeachingArm(scene, rng, in_real_time=self._real, shown=self._period)
        self._recordings: list[TaughtRecording] = []
        self._learnt_from: list[TaughtRecording] = []
        self._forget()
        self._touched = False
        self._progress: dict[str, Any] | None = None
        self._planned: Repetition | None = None
        self._files: dict[str, tuple[Path, str, int]] = {}
        self._truth_shown = False
        self._number += 1
        while (folder := self.keep / f"{self._number:02d}_{kind}").exists():
            self._number += 1
        self.folder, self._file = folder, folder / "constraint.json"
        self._say("")
        self._show("scene", scene_content(scene, self._number))
        self._show("ghosts", None)

    def _forget(self, answer: dict[str, Any] | None = None) -> None:
        """Forget all results of the scene except this answer."""
        self._answer, self._outcome = answer, None
        self.constraint: Constraint | None = None
        self._way: Constraint | None = None  # constraint whose motion the arm can reproduce
        self._rows: Constraint | None = None  # constraint whose manipulability counts in it

    def _home(self) -> None:
        """Move the arm back to its start, and shut everything."""
        self._doing, self._outcome = "moving", None
        self.arm.shut()
        limits = Limits(self.robot)
        task = JointMotion(limits, [self.arm.q, self.arm.scene.start], 0.5)  # share of joint speed limits near people
        law = ResolvedRateController(every_joint(self.robot), task, limits=limits, dt=PERIOD)
        self._drive(LawSequence(law), task.duration)
        self._say("Everything is back at its start.")

    # ---- show -----------------------------------------------------------------------------------------------------

    def _record(self) -> None:
        """Record until the person stops, from shut furniture; the file grows meanwhile."""
        if not self.arm.held:
            self.arm.shut()
        self._doing, self._began, self._touched = "recording", self.arm.time, self.arm.held
        self._say("Recording: show the task, then press Stop.")
        first = iter(["start or stop"])

        def key() -> Any:
            return "end" if self._ended else "start or stop" if self._stop else next(first, "")

        recorded = record(self.arm, self.folder, "shown", by="key", motions=1, key=key)
        self._ended |= recorded.ended == "Ctrl-C"
        if not recorded.files or recorded.samples < 2:
            raise ManipLearnError("Nothing was recorded.")
        if not self._touched:
            recorded.files[0].unlink()
            raise ManipLearnError("The gripper grasped nothing, so this recording was deleted. Record again.")
        one = self._read(recorded.files[0])
        self._say(f"{one.path.stem} is saved, {one.motion.duration:.1f} s.")

    # ---- learn ----------------------------------------------------------------------------------------------------

    def _ask(self, job: str, step: str, **what: Any) -> None:
        """Give the worker a job that takes a while."""
        self._worker.ask(job, file=str(self._file), **what)
        self._progress = {"step": step, "share": 0.0}

    def _learn(self) -> None:
        """Learn from the recordings, if there are enough."""
        if not self._recordings:
            raise ManipLearnError("There is nothing to learn from yet: record the task first.")
        if len(self._recordings) < FEW:
            self._show_refusal(f"Fewer than {FEW} recordings cannot tell a held direction from a habit of the person.")
        else:
            self._learnt_from = list(self._recordings)
            self._ask("learn", "reading", files=list(map(str, self.files)))
            self._say("Learning from " + counted(len(self._recordings), "recording") + ".")

    def _handle_answer(self, kind: str, what: Any) -> None:
        """Handle a message of the worker."""
        if kind == "progress":
            self._progress = {"step": what[0], "share": what[1]}
            return
        job, answer = what
        self._progress = None
        if job == "learn":
            (self._adopt_answer if kind == "done" else self._show_refusal)(answer)
        elif kind == "failed":
            self._say(answer, wrong=True)
        elif job == "repeat":
            self._planned = answer
        elif job == "take":
            path, says = answer
            self._files[path.name] = path, says, next(self._numbers)
            self._shows.offer({name: path for name, (path, *_) in self._files.items()})
            self._say(f"Ready to take home: {path.name}.")
        else:
            self._show_ghosts(job, answer["rollouts"])
            self._say(answer["sentence"])

    def _show_refusal(self, why: str) -> None:
        """Show why learning failed, and the next step."""
        self._forget(refusal_content(why, len(self._recordings)))
        self._say(cast(Any, self._answer)["next"], wrong=True)

    def _adopt_answer(self, content: Mapping[str, Any]) -> None:
        """Take over a learnt skill, and show the answer."""
        skill, answer = Skill.load(self._file, self.robot), answer_content(content)
        self._forget(answer)
        self.constraint, self._way = skill.constraints[0], first_way(skill)
        self._rows = None if self._way is None else motion(self._way).constraint
        odd = {name: why for name, why in content["answer"]["odd"]}
        for one in self._recordings:
            one.phases = [phase[1:] for phase in content["phases"] if phase[0] == one.path.name]
            one.odd = odd.get(one.path.name, "")
        self._say(answer["next"])

    # ---- run ------------------------------------------------------------------------------------------------------

    def _run(self) -> None:
        """Reproduce the demonstrated task from shut furniture, planned by `repeat`."""
        if self._way is None:
            raise ManipLearnError("Nothing to reproduce yet: learn from recordings that grasp and move something.")
        self._doing, self._planned, self._outcome = "planning", None, None
        self.arm.shut()
        self.arm.hold()
        self._say("Planning the whole motion.")
        self._ask("repeat", "planning", start=self.arm.q, scene=self.arm.scene.handle.surroundings)
        while self._worker.busy and not self._stop:
            self.arm.command(self.arm.q_held, np.zeros(self.robot.nv))
        again = self._planned
        if self._stop or again is None:
            self._worker.give_up()
            self._progress = None
            return
        self._doing = "running"
        self._say(f"The arm does it by itself: {again.pace}.")
        why, ordered = self._drive(again.controller, float(again.rollout.time[-1]))
        outcome = self._outcome or {"done": 0.0, "wanted": 0.0, "unit": "m"}
        way_done, way_wanted = (distance_in_words(outcome[name], outcome["unit"]) for name in ("done", "wanted"))
        why = why if ordered else f"it was pushed off its path and stopped: {why}"
        self._outcome = outcome | {"ended": why, "ordered": ordered, "notes": list(again.notes)}
        self._say(f"Moved {way_done} of {way_wanted}: {why}.", wrong=not ordered)

    def _drive(self, controller: LawSequence, seconds: float) -> tuple[str, bool]:
        """Run a controller until its motion is over, a limit trips, or the person stops it.

        The loop yields to a person, but not to friction or to its own acceleration; the servos are simulated by
        `MuJoCoDriver`.

        Args:
            controller: Controller that starts at the arm's posture.
            seconds: Duration of its motion if nothing slows it down [s].

        Returns:
            Reason for the end, and True if it ended in order.
        """
        # [N] force at the hand at which the arm relaxes; [rad/s^2] acceleration of its own motion
        contact = Contact(max_lateral_force=45.0, max_axial_force=45.0, stiffness=STIFFNESS)
        loop, began = ServoLoop(controller, dt=PERIOD, acceleration_limit=2.0, contact=contact), self.arm.time

        def over() -> str:
            laws, task = cast(LawSequence, loop.controller), cast(LawSequence, loop.controller).law.task
            if isinstance(task, FreeDirection):
                way, goal = abs(task.progress(self.arm.q)), abs(task.wanted)
                self._outcome = {"done": way, "wanted": goal, "unit": task.unit, "ended": "", "ordered": True}
            if self._stop:
                return "stopped by hand"
            if laws.gripper == "close" and not self.arm.held:
                return "the gripper found no handle: reset the arm, and try again"
            at_rest = float(np.max(np.abs(loop.state.velocity))) < 1e-3  # [rad/s or m/s]
            is_last = laws.number == len(laws.laws) - 1
            return "the motion is complete" if is_last and at_rest and self.arm.time - began > seconds else ""

        self.arm.hold()
        outcome = run(loop, self.arm, duration=2.0 * seconds + 5.0, until=over)  # longer: a person may push against it
        self._ended |= outcome.ended.startswith("Ctrl-C")
        return outcome.ended, outcome.ordered

    def _compare(self) -> None:
        """Compare the task without and with the learnt manipulability."""
        if self._way is None or (start := self.arm.scene.hard_start) is None:
            raise ManipLearnError("There is nothing to compare yet: learn first.")
        self._ask("compare", "planning", start=start, scene=self.arm.scene.handle.surroundings)

    def _take(self, said: Mapping[str, Any]) -> None:
        """Write a file to take home."""
        if not self._recordings:
            raise ManipLearnError("There is nothing to take home yet: record the task first.")
        start = None if self._way is None else self.arm.scene.start
        lesson = {"files": list(map(str, self.files)), "learnt": self.constraint is not None, "start": start}
        self._ask("take", "writing", what=str(said["what"]), **lesson)

    # ---- pictures -------------------------------------------------------------------------------------------------

    def _show(self, slot: str, content: Any) -> None:
        """Send content to a slot of the page, if it has changed."""
        text = json.dumps(content, allow_nan=False)
        if self._put.get(slot) != text:
            self._put[slot] = text
            self._shows.put(lambda: text, slot)

    def _show_ghosts(self, kind: str, rollouts: list[dict[str, Any]]) -> None:
        """Show motions beside the arm."""
        self._show("ghosts", {"number": next(self._numbers), "kind": kind, "rollouts": rollouts})

    def _show_state(self) -> None:
        """Send the state of the session to the page."""
        arm, can_run = self.arm, self._way is not None
        recording = {"name": "recording", "seconds": round(arm.time - self._began, 1)}
        self._show(
            "state",
            {
                "leader": self._leader,
                "doing": "learning" if self._doing == "idle" and self._worker.busy == "learn" else self._doing,
                "said": self._sentence,
                "wrong": self._wrong,
                "recordings": [one.to_dict() for one in self._recordings],
                "unlearnt": sum(one not in self._learnt_from for one in self._recordings),
                "recording": recording if self._doing == "recording" else None,
                "progress": self._progress,
                "answer": self._answer,
                "truth": truth_content(arm.scene, self.constraint) if self._truth_shown else None,
                "can": {"run": can_run, "compare": can_run and arm.scene.hard_start is not None},
                "run": self._outcome,
                "files": [{"name": name, "says": says, "number": n} for name, (_, says, n) in self._files.items()],
                "keep": str(self.folder),
            },
        )


def _three(values: object) -> Float[np.ndarray, " 3"]:
    """Return a vector that a page has sent.

    Raises:
        ValueError: Not three finite numbers, or one above 100 m or rad: that is out of any arm's reach, and its square
            is still finite.
    """
    if (vector := finite(values, 3)) is None or np.max(np.abs(vector)) > 100.0:
        raise ValueError(f"three numbers up to 100 are needed, not {values!r:.60}")
    return vector
