"""What a person does on the teaching page, and what becomes of it: show, record, learn, run, take home."""

from __future__ import annotations

import json
import queue
import re
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Protocol, cast, final

import numpy as np
from jaxtyping import Float

from manip_learn.atomic_write import write_atomically
from manip_learn.constraint.constraint import Constraint
from manip_learn.constraint.skill import Skill
from manip_learn.control.command import Controller
from manip_learn.control.contact import STIFFNESS, Contact
from manip_learn.control.controller import ResolvedRateController
from manip_learn.control.driver import run
from manip_learn.control.joint_motion import FollowMotion
from manip_learn.control.limits import RETURN_SPEED
from manip_learn.control.servo_loop import ServoLoop
from manip_learn.control.tasks import FreeDirection
from manip_learn.drivers.record import record
from manip_learn.errors import ManipLearnError, counted
from manip_learn.linalg import finite
from manip_learn.playback.palette import COLOURS
from manip_learn.recordings import load_demonstrations
from manip_learn.recordings.trajectory import Trajectory
from manip_learn.robot.robot import Robot
from manip_learn.teach.arm import PERIOD, TeachingArm
from manip_learn.teach.picture import (
    ENOUGH,
    TeachingPicture,
    answer_content,
    refusal_content,
    scene_content,
    truth_content,
)
from manip_learn.teach.scene import MOVES, TITLES, Kind, place_scene
from manip_learn.teach.way import ARRIVES, TaughtRecording, TaughtWay, handle_near, limits_of
from manip_learn.teach.worker import TeachingWorker, ghost

LEFT = 30.0  # [s] without a page after which the program ends: who pressed Back by mistake comes back in less
_SAID = 0.1  # [s] between two looks at the state as a whole
_FEW = 3  # recordings below which no evidence can be had
FARTHEST = 100.0  # [m or rad] that a page may ask for: no arm reaches so far, and its square is still a number
STAYS = 0.3  # [s] at the end of a way before a run counts as done
YIELDS, GENTLY = 45.0, 2.0  # [N] at the hand on which the arm lets go, and [rad/s2] with which it moves by itself
SLOWER = 3.0  # times, and seconds, that a run may take beyond what its way needs: a person may push against it
_NEAR = 0.01  # [rad or m] from a posture at which the arm is there
THERE, BY_HAND = "there", "stopped by hand"  # why a motion ended
NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9 ._-]{0,60}")


class Shows(Protocol):
    """Where messages go, as `LiveProcess` takes them."""

    def put(self, message: Callable[[], str], slot: str) -> None:
        """The newest message of a slot."""
        ...

    def offer(self, files: Mapping[str, Path]) -> None:
        """Files that may be fetched by their names."""
        ...


@final
class TeachingSession:
    """One arm, one scene at a time, and the person's recordings of it.

    `hear` may be called from any thread; all else happens in the thread of `run`, between two periods of the physics.

    Args:
        robot: The arm.
        tip: Its frame that is guided.
        keep: Folder for all that is recorded and learnt.
        kind: First scene.
        seed: Of places and noise.
        shows: Where pictures and words go.
        in_real_time: Whether the physics wait for the clock.

    Raises:
        ManipLearnError: A robot that cannot be taught, or a scene that it cannot reach.
    """

    def __init__(
        self, robot: Robot, tip: str, keep: Path, kind: Kind, seed: int, shows: Shows, *, in_real_time: bool = True
    ):
        self.robot, self.tip, self.keep = robot, tip, keep
        self._limits = limits_of(robot, tip)
        self._shows, self._real = shows, in_real_time
        self._rng = np.random.default_rng(seed)
        self._heard: queue.SimpleQueue[Mapping[str, Any]] = queue.SimpleQueue()
        self._picture = TeachingPicture(robot, tip)
        self._worker = TeachingWorker(robot, tip)
        self._pages: list[str] = []
        self._leader, self._left, self._opened = "", np.inf, False
        self._mode: Callable[[], None] | None = None
        self._doing, self._sentence, self._wrong = "idle", "", False
        self._ended, self._stop, self._seq, self._number = False, False, 0, 0
        self._number_of_ghosts = self._files_written = 0
        self._put: dict[str, str] = {}
        self._looked = self._began = 0.0
        self._acts = self._buttons()
        try:
            self._place(kind)
        except ManipLearnError:
            self._worker.close()
            raise

    # ---- the thread of the physics --------------------------------------------------------------------------------

    def hear(self, heard: Mapping[str, Any]) -> None:
        """Take what a page or the server said; from any thread."""
        self._heard.put(heard)

    def end(self) -> None:
        """Ask `run` to return; from any thread."""
        self._heard.put({"end": True})

    @property
    def files(self) -> tuple[Path, ...]:
        """The recordings of this scene."""
        return tuple(one.path for one in self._recordings)

    @property
    def sentence(self) -> str:
        """The answer about this scene; empty without one."""
        return "" if self._answer is None else str(self._answer["sentence"])

    @property
    def waits_for_worker(self) -> bool:
        """Whether the process that learns has a job."""
        return bool(self._worker.busy)

    @property
    def notes(self) -> tuple[str, ...]:
        """Assumptions about the robot."""
        return self.arm.scene.notes

    def run(self) -> None:
        """Until the last page is closed, or `end`."""
        try:
            while not self._ended:
                mode, self._mode, self._stop = self._mode, None, False
                if mode is None:
                    self._doing = "idle"
                    self.arm.release()
                    while self._mode is None and not self._ended:
                        self.arm.wait()
                    continue
                try:
                    mode()
                except ManipLearnError as refusal:
                    self._say(str(refusal), wrong=True)
        finally:
            self._show("ended", True)
            self._worker.close()

    def _period(self) -> None:
        """Between two periods of the physics."""
        while not self._heard.empty():
            heard = self._heard.get()
            if "pages" in heard:
                self._pages_are(heard["pages"])
            elif "end" in heard:
                self._finish()
            else:
                self._obey(str(heard.get("page", "")), heard.get("said"))
        self._touched |= self.arm.held is not None
        if time.monotonic() - self._left > LEFT:
            self._finish()
        for kind, what in self._worker.heard():
            self._answered(kind, what)
        if self.arm.hand.pull is not None and self._doing in ("idle", "recording") and self.arm.close_when_near():
            self._gripped()
        self._show_pose()
        now = time.monotonic()
        if now - self._looked > _SAID or not self._real:
            self._looked = now
            self._show_state()

    def _finish(self) -> None:
        self._ended = self._stop = True

    def _pages_are(self, pages: list[str]) -> None:
        self._pages, self._opened = pages, self._opened or bool(pages)
        if self._leader not in pages:
            if self._leader and self.arm.hand.pull is not None:
                self.arm.let_go()
            self._leader = pages[0] if pages else ""
        if pages:
            self._left = np.inf
        elif self._opened:
            self._left = min(self._left, time.monotonic())

    def _say(self, sentence: str, wrong: bool = False) -> None:
        self._sentence, self._wrong = sentence, wrong

    # ---- what a person says ---------------------------------------------------------------------------------------

    def _obey(self, page: str, said: Any) -> None:
        """Do what a page asks, if it is the one that leads."""
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
            self._say(f"The page asked for {do!r} in a way that is not understood: {error}", wrong=True)

    def _buttons(self) -> dict[str, Callable[[Mapping[str, Any]], None]]:
        return {
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
            "run": self._start,
            "way": self._set_way,
            "target": self._target,
            "disturb": lambda said: self.arm.disturb("elbow" if said["what"] == "elbow" else "hand", self._rng),
            "stop": lambda _: setattr(self, "_stop", True),
            "policies": lambda _: self._ask_for_ghosts("policies"),
            "compare": lambda _: self._ask_for_ghosts("compare"),
            "take": self._take,
            "drop": self._drop,
        }

    def _begin(self, mode: Callable[[], None]) -> None:
        """Stop, and do this next."""
        self._stop, self._mode = True, mode

    def _pull(self, said: Mapping[str, Any]) -> None:
        link, turn = said.get("link"), said.get("turn")
        at = None if link is None else _three(said["at"])
        to, turn = _three(said["to"]), None if turn is None else _three(turn)
        self._seq = int(said.get("seq", 0))
        self.arm.pull(link, at, to, turn)

    def _grip(self, said: Mapping[str, Any]) -> None:
        if said["closed"]:
            if self.arm.grip(True):
                self._gripped()
            else:
                self._say("No handle is within reach of the gripper: take the hand to one first.")
        else:
            self.arm.grip(False)
            self._say("The gripper is open.")

    def _gripped(self) -> None:
        handle = self.arm.scene.handles[self.arm.held or 0]
        self._say(f"Holding the {handle.name}. {MOVES[handle.type]}.")

    def _start_or_stop(self) -> None:
        if self._doing == "recording":
            self._stop = True
        else:
            self._begin(self._record)

    def _shown_by(self, name: Any) -> TaughtRecording:
        found = next((one for one in self._recordings if one.path.stem == name), None)
        if found is None:
            raise ValueError(f"there is no recording {name!r}")
        return found

    def _rename(self, said: Mapping[str, Any]) -> None:
        one, to = self._shown_by(said["name"]), str(said["to"]).strip()
        path = one.path.with_name(f"{to}.csv")
        if not NAME.fullmatch(to):
            self._say("A name has letters, digits, spaces, dots and dashes, up to 60 of them.", wrong=True)
        elif path.exists():
            self._say(f"There is a recording {to!r} already: choose another name.", wrong=True)
        else:
            one.path = one.path.rename(path)

    def _delete(self, said: Mapping[str, Any]) -> None:
        one = self._shown_by(said["name"])
        one.path.unlink(missing_ok=True)
        self._recordings.remove(one)
        self._say(f"{one.path.stem} is deleted.")

    def _replay(self, said: Mapping[str, Any]) -> None:
        one = self._shown_by(said["name"])
        made = ghost(self.robot, one.path.stem, COLOURS["vermilion"], one.time, one.q)
        self._show_ghosts("replay", [made])

    def _drop(self, said: Mapping[str, Any]) -> None:
        """Take in a recording that was dropped on the page, if it is one of this robot."""
        stem = re.sub(r"[^A-Za-z0-9._-]+", "_", Path(str(said["name"])).stem)[:60].lstrip(".") or "dropped"
        path = self._free_path(stem)
        write_atomically(path, str(said["text"]))
        try:
            read = load_demonstrations([str(path)], self.robot)[0]
        except ManipLearnError as refusal:
            path.unlink()
            name = self.robot.name
            self._say(f"{said['name']} is no recording of {name!r}: {refusal}", wrong=True)
            return
        self._recordings.append(TaughtRecording(path, read.q, read.time))
        self._say(f"{path.stem} is taken in: {counted(len(read.time), 'sample')}.")

    def _free_path(self, stem: str) -> Path:
        self.folder.mkdir(parents=True, exist_ok=True)
        path, number = self.folder / f"{stem}.csv", 2
        while path.exists():
            path, number = self.folder / f"{stem}_{number}.csv", number + 1
        return path

    # ---- scene ----------------------------------------------------------------------------------------------------

    def _place(self, kind: Kind) -> None:
        """Another scene of a kind; recordings and answers of the one before stay on the disk."""
        scene = place_scene(kind, self.robot, self.tip, self._rng)
        self._worker.give_up()
        self.arm = TeachingArm(scene, self._rng, in_real_time=self._real, shown=self._period)
        self.constraint: Constraint | None = None
        self._rows: Constraint | None = None
        self._recordings: list[TaughtRecording] = []
        self._learnt_from: list[TaughtRecording] = []
        self._touched = False
        self._answer: dict[str, Any] | None = None
        self._ways: list[TaughtWay] = []
        self._progress: dict[str, Any] | None = None
        self._outcome: dict[str, Any] | None = None
        self._planned: dict[str, Any] | None = None
        self._files: dict[str, tuple[Path, str, int]] = {}
        self._truth_shown = False
        self._loop: ServoLoop | None = None
        self._number += 1
        self.folder = self.keep / f"{self._number:02d}_{kind}"
        while self.folder.exists():
            self._number += 1
            self.folder = self.keep / f"{self._number:02d}_{kind}"
        self._say("")
        self._show("scene", scene_content(scene, self._number))
        self._show("ghosts", None)

    def _home(self) -> None:
        """The arm back to where it began, everything shut."""
        self._doing = "moving"
        self.arm.shut()
        start, away = self.arm.scene.start, np.abs(self.robot.difference(self.arm.q, self.arm.scene.start))
        seconds = 1.0 + float(np.max(away / (RETURN_SPEED * self.robot.velocity_limit)))
        self._follow(np.array([0.0, seconds]), np.array([self.arm.q, start]))
        self._outcome = None
        self._say("Everything is as it was at first.")

    # ---- show -----------------------------------------------------------------------------------------------------

    def _record(self) -> None:
        """Record until the person stops; the file grows as it goes."""
        self._doing, self._began, self._touched = "recording", self.arm.time, self.arm.held is not None
        self.arm.close_again()
        started = [False]

        def key() -> Any:
            if self._ended:
                return "end"
            if not started[0] or self._stop:
                started[0] = True
                return "start or stop"
            return ""

        self._say("Recording: show the task, then press Stop.")
        done = record(self.arm, self.folder, "shown", by="key", motions=1, key=key)
        self._ended |= done.ended == "Ctrl-C"
        if not done.files or done.samples < 2:
            self._say("Nothing was recorded.", wrong=True)
            return
        if self.arm.scene.handles and not self._touched:
            done.files[0].unlink()
            self._say("The gripper took hold of nothing, so this was not kept. Record again.", wrong=True)
            return
        read = load_demonstrations([str(done.files[0])], self.robot)[0]
        self._recordings.append(TaughtRecording(done.files[0], read.q, read.time))
        left = ENOUGH - len(self._recordings)
        more = "that is enough to learn from." if left <= 0 else f"{left} more would be good."
        self._say(f"{done.files[0].stem} is kept, {read.time[-1] - read.time[0]:.1f} s; {more}")

    # ---- learn ----------------------------------------------------------------------------------------------------

    def _learn(self) -> None:
        if not self._recordings:
            self._say("There is nothing to learn from: record the task first.", wrong=True)
            return
        if len(self._recordings) < _FEW:
            self._refused(f"From fewer than {_FEW} recordings what is held cannot be told from how a person moves.")
            return
        files, self._learnt_from = [str(one.path) for one in self._recordings], list(self._recordings)
        self._worker.ask("learn", files=files, handles=self._stations, out=str(self._constraint_file))
        self._progress = {"step": "reading", "share": 0.0}
        self._say("Learning from " + counted(len(self._recordings), "recording") + ".")

    @property
    def _stations(self) -> list[Float[np.ndarray, "n 3"]]:
        """Places along the way of each handle, from where it is shut [m]."""
        return [np.array([pose[:3, 3] for pose in handle.stations()]) for handle in self.arm.scene.handles]

    @property
    def _constraint_file(self) -> Path:
        return self.folder / "constraint.json"

    def _answered(self, kind: str, what: Any) -> None:
        """What the worker says."""
        if kind == "progress":
            self._progress = {"step": what[0], "share": what[1]}
            return
        job, answer = what
        self._progress = None
        if kind == "failed":
            if job == "learn":
                self._refused(answer)
            else:
                self._planned = None
                self._say(answer, wrong=True)
        elif job == "learn":
            self._learnt(answer)
        elif job == "plan":
            self._planned = answer
        elif job == "take":
            self._files_written += 1
            self._files |= {name: (Path(path), says, self._files_written) for name, path, says in answer}
            self._shows.offer({name: path for name, (path, *_) in self._files.items()})
            self._say("Ready to take home: " + ", ".join(name for name, *_ in answer) + ".")
        else:
            self._show_ghosts(job, answer["rollouts"])
            self._say(answer["sentence"])

    def _refused(self, why: str) -> None:
        self._answer = refusal_content(why, len(self._recordings), bool(self.arm.scene.handles))
        self.constraint, self._rows, self._ways = None, None, []
        self._say(self._answer["next"], wrong=True)

    def _learnt(self, content: Mapping[str, Any]) -> None:
        skill = Skill.load(self._constraint_file, self.robot)
        self.constraint = skill.constraints[0]
        names = {one.path.name: one for one in self._recordings}
        odd = {name: why for name, why in content["answer"]["odd"]}
        for one in self._recordings:
            one.phases = [phase[1:] for phase in content["phases"] if names.get(phase[0]) is one]
            one.odd = odd.get(one.path.name, "")
        self._answer = answer_content(content)
        self._ways = TaughtWay.all_of(skill)
        self._rows = self._way.task().constraint if self._way is not None else None
        self._say(self._answer["next"])

    # ---- run ------------------------------------------------------------------------------------------------------

    def _follow(self, times: np.ndarray, postures: np.ndarray, until: Callable[[], str] | None = None) -> str:
        """Follow a motion of the joints; why it ended."""
        self.arm.hold()
        motion = Trajectory(times, postures, joint_names=self.robot.joint_names)
        loop = self._loop_of(FollowMotion(self.robot, motion, self._limits))
        goal, rested = postures[-1], [0.0]

        def over() -> str:
            if self._stop:
                return BY_HAND
            near = float(np.max(np.abs(self.robot.difference(self.arm.q, goal)))) < _NEAR
            rested[0] = rested[0] + PERIOD if near else 0.0
            return THERE if rested[0] > STAYS else "" if until is None else until()

        ended = run(loop, self.arm, until=over).ended
        self._ended |= ended.startswith("Ctrl-C")
        return ended

    def _loop_of(self, controller: Controller) -> ServoLoop:
        """Return a loop that yields to a person, not to friction or to its own acceleration.

        The servos are those of `MuJoCoDriver`.
        """
        contact = Contact(max_lateral_force=YIELDS, max_axial_force=YIELDS, stiffness=STIFFNESS)
        return ServoLoop(controller, dt=PERIOD, acceleration_limit=GENTLY, contact=contact)

    @property
    def _way(self) -> TaughtWay | None:
        """The way that the slider changes: the first one."""
        return self._ways[0] if self._ways else None

    def _start(self, said: Mapping[str, Any]) -> None:
        if self._way is None:
            self._say("There is no way to do yet: learn from recordings that hold something and move it.", wrong=True)
            return
        self._way.set(float(said.get("along", said.get("turn", self._way.value))))
        policy, planned = str(said.get("policy", "manipulability")), bool(said.get("plan"))
        self._begin(lambda: self._run(policy, planned))

    def _run(self, policy: str, planned: bool) -> None:
        """Every way in the order shown: take hold where it was shown, and go as far under the learnt constraint."""
        for way in self._ways:
            if way.number > 0:
                self.arm.grip(False)  # what the way before moved
            if self.arm.held is None and not self._take_hold(way, policy, planned):
                return
            if way.shown.is_way and abs(way.value - way.at(self.arm.place)) < ARRIVES[way.unit]:
                self._say("The hand is there already: move the slider.")
                return
            self._doing = "running"
            self._say(f"The arm does it by itself, with the {policy} policy.")
            outcome = self._drive(way, policy)
            self._say(f"Moved {way.in_words(outcome['done'])}: {outcome['ended']}.", wrong=not outcome["ordered"])
            if not outcome["ordered"] or self._stop:
                return

    def _take_hold(self, way: TaughtWay, policy: str, planned: bool) -> bool:
        """Go where the recordings took hold, straight or as a plan says, and close the gripper."""
        self._doing = "moving"
        self._say("The hand goes to the handle, as it was shown.")
        if (handle := handle_near(way.shown.begin, self._stations)) is None:
            self._say("There is no handle here where the recordings hold something: show this scene.", wrong=True)
            return False
        place = self.arm.handle_place(handle)
        if planned:
            ended = self._change_posture(way, place)
        else:
            task = way.task(place)
            loop = self._loop_of(self._law(task, policy))
            there = lambda: BY_HAND if self._stop else THERE if task.way_begins is not None else ""  # noqa: E731
            self.arm.hold()
            ended = run(loop, self.arm, duration=SLOWER * (1.0 + task.duration_from(self.arm.q)), until=there).ended
            self._ended |= ended.startswith("Ctrl-C")
        if ended != THERE:
            self._say(f"The hand did not come to the handle: {ended}.", wrong=ended != BY_HAND)
            return False
        if not self.arm.grip(True):
            self._say("The hand did not come to the handle: reset the arm, and try again.", wrong=True)
            return False
        closing = self.arm.time + 2.0 * STAYS
        while self.arm.time < closing and not self._stop:
            self.arm.command(self.arm.q_held, np.zeros(self.robot.nv))
        return not self._stop

    def _law(self, task: FreeDirection, policy: str) -> ResolvedRateController:
        from manip_learn.control.tasks.motion import null_policy

        chosen = null_policy(policy, task, task.learnt, self.robot, None, self.arm.scene.start)
        return ResolvedRateController(task.learnt, task, chosen, dt=PERIOD, limits=self._limits)

    def _change_posture(self, way: TaughtWay, place: Float[np.ndarray, " 3"]) -> str:
        """To the handle, in the posture from which the whole way can be done; why that ended."""
        self._doing, self._planned = "planning", None
        self.arm.hold()
        self._worker.ask("plan", file=str(self._constraint_file), way=way.asked(), start=self.arm.q, place=place)
        while self._worker.busy and not self._stop:
            self.arm.command(self.arm.q_held, np.zeros(self.robot.nv))
        if self._stop or self._planned is None:
            return BY_HAND if self._stop else self._sentence.rstrip(".")
        self._doing = "moving"
        self._say(self._planned["sentence"])
        return self._follow(self._planned["time"], self._planned["q"])

    def _drive(self, way: TaughtWay, policy: str) -> dict[str, Any]:
        """Run the controller until the way is done, something trips, or the person stops it."""
        self.arm.hold()
        task, rested = way.rest(self.arm.q), [0.0]
        loop = self._loop = self._loop_of(self._law(task, policy))

        def so_far(ended: str, ordered: bool) -> dict[str, Any]:
            done = way.at(self.arm.place) if way.shown.is_way else task.progress(self.arm.q)
            return {"policy": policy, "done": done, "wanted": way.value, "ended": ended, "ordered": ordered}

        def over() -> str:
            if self._stop:
                return BY_HAND
            self._outcome = so_far("", True)
            there = abs(way.value - self._outcome["done"]) < ARRIVES[way.unit]
            rested[0] = rested[0] + PERIOD if there else 0.0
            return "all of the way is done" if rested[0] > STAYS else ""

        longest = SLOWER * (1.0 + task.duration_from(self.arm.q))
        done = run(loop, self.arm, duration=longest, until=over)
        self._ended |= done.ended.startswith("Ctrl-C")
        ended = (
            done.ended
            if done.ordered
            else f"it was pushed off its way and stopped, Run goes on from there: {done.ended}"
        )
        self._loop, self._outcome = None, so_far(ended, done.ordered)
        return self._outcome

    def _set_way(self, said: Mapping[str, Any]) -> None:
        way = self._way
        if way is None:
            return
        way.set(float(said["value"]))
        if self._loop is not None and way.shown.is_way and abs(way.value - way.at(self.arm.place)) > ARRIVES[way.unit]:
            self._loop.set_task(way.rest(self.arm.q))

    def _target(self, said: Mapping[str, Any]) -> None:
        """The way that comes nearest to a place that was dragged."""
        at = _three(said["at"])
        if self._way is not None:
            self._set_way({"value": self._way.at(at)})

    def _ask_for_ghosts(self, job: str) -> None:
        if self._way is None:
            self._say("There is no way to do yet: learn first.", wrong=True)
            return
        self._worker.ask(job, file=str(self._constraint_file), way=self._way.asked(), start=self.arm.scene.start)
        self._progress = {"step": "simulating", "share": 0.0}

    def _take(self, said: Mapping[str, Any]) -> None:
        if not self._recordings:
            self._say("There is nothing to take home yet: record the task first.", wrong=True)
            return
        learnt = self.constraint is not None and self._constraint_file.exists()
        self._worker.ask(
            "take",
            what=str(said["what"]),
            files=[str(one.path) for one in self._recordings],
            file=str(self._constraint_file) if learnt else None,
            start=None if self._way is None else self.arm.scene.start,
            out=self.folder,
        )
        self._progress = {"step": "writing", "share": 0.0}

    # ---- pictures -------------------------------------------------------------------------------------------------

    def _show(self, slot: str, content: Any) -> None:
        """Send a slot if it says something new."""
        text = json.dumps(content, allow_nan=False)
        if self._put.get(slot) != text:
            self._put[slot] = text
            self._shows.put(lambda: text, slot)

    def _show_ghosts(self, kind: str, rollouts: list[dict[str, Any]]) -> None:
        self._number_of_ghosts += 1
        self._show("ghosts", {"number": self._number_of_ghosts, "kind": kind, "rollouts": rollouts})

    def _show_pose(self) -> None:
        pose = self._picture.pose(self.arm, self.constraint, self._rows)
        pose |= {"seq": self._seq, "trail": self._doing == "recording"}
        self._shows.put(lambda: json.dumps(pose, allow_nan=False), "pose")

    def _show_state(self) -> None:
        arm, way = self.arm, self._way
        recording = None
        if self._doing == "recording":
            recording = {"name": "recording", "seconds": round(arm.time - self._began, 1)}
        doing = "learning" if self._doing == "idle" and self._worker.busy == "learn" else self._doing
        self._show(
            "state",
            {
                "leader": self._leader,
                "doing": doing,
                "said": self._sentence,
                "wrong": self._wrong,
                "scenes": [{"kind": kind, "title": title} for kind, title in TITLES.items()],
                "recordings": [one.to_dict() for one in self._recordings],
                "unlearnt": sum(one not in self._learnt_from for one in self._recordings),
                "recording": recording,
                "progress": self._progress,
                "answer": self._answer,
                "truth": truth_content(arm.scene, self.constraint) if self._truth_shown else None,
                "way": None if way is None else way.to_dict(),
                "run": self._outcome,
                "files": [{"name": name, "says": says, "number": n} for name, (_, says, n) in self._files.items()],
                "keep": str(self.folder),
            },
        )


def _three(values: object) -> Float[np.ndarray, " 3"]:
    """A vector that a page has sent.

    Raises:
        ValueError: Not three finite numbers, or one that is too large.
    """
    if (vector := finite(values, 3)) is None or np.max(np.abs(vector)) > FARTHEST:
        raise ValueError(f"three numbers up to {FARTHEST:g} are needed, not {values!r:.60}")
    return vector
