"""A skill: what was learnt, in the order in which it was shown, and done again as one motion."""

from __future__ import annotations

import json
import re
from functools import cache
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation
from task_sets import out_and_back

import manip_learn as ml
from manip_learn.cli import main
from manip_learn.errors import NoPlanError, TargetError

HOME = (0.2, -0.4, 0.1, -2.1, 0.1, 1.8, 0.6)


@cache
def two_tasks() -> tuple[ml.Robot, str, ml.ConstraintLearner, list[Any], list[list[float]], list[ml.Trajectory]]:
    """A drawer and then a table, in each recording."""
    robot, tip, demos, things, ways = out_and_back(("drawer", "table"), "panda", 4201)
    maps = [ml.FrameJacobian(robot, tip, "xyz", reference) for reference in ("world", "local")]
    return robot, tip, ml.ConstraintLearner(maps).fit(demos), things, ways, demos


def test_a_skill_has_its_steps_in_order(tmp_path):
    """Reach and way of the drawer, then of the table, and the retreat; saved, loaded, and read as a constraint."""
    robot, _, learner, things, _, _ = two_tasks()
    skill = learner.skill_
    assert [step.kind for step in skill.steps] == ["reach", "way", "reach", "way", "reach"]
    assert [step.constraint.mechanism.type for step in skill.steps if step.kind == "way"] == ["line", "plane"]
    loaded = ml.Skill.load(skill.save(tmp_path / "task.json"), robot)
    assert repr(loaded) == repr(skill) and len(loaded.constraints) == len(skill.constraints)
    first = ml.Constraint.load(tmp_path / "task.json", robot)
    assert_allclose(first.selection, skill.constraints[0].selection)
    alone = ml.Skill.load(first.save(tmp_path / "one.json"), robot)
    assert [step.kind for step in alone.steps] == ["reach", "way"]


@cache
def repeated(**given) -> ml.Repetition:
    """Both tasks done again."""
    return ml.repeat(two_tasks()[2].skill_, HOME, **given)


def place_at(again: ml.Repetition, tip: str, time: float) -> np.ndarray:
    """Where the hand is at a time of a repetition [m]."""
    rollout = again.rollout
    return again.skill.robot.position(rollout.q[int(np.searchsorted(rollout.time, time - 1e-9))], tip)


def test_both_tasks_are_done_in_order():
    """Each hold is where the thing was taken hold of, each way as far as was shown; the controller does the same."""
    robot, tip, learner, things, ways, _ = two_tasks()
    again = repeated()
    assert again.is_done and [step.kind for step in again.steps] == ["reach", "way", "reach", "way", "reach"]
    starts = [a for name, a, _ in again.rollout.phases if name.endswith(": way")]
    for start, thing in zip(starts, things, strict=True):
        assert np.linalg.norm(place_at(again, tip, start) - thing.handle) < 2e-3
    shown, first = learner.skill_.steps[1].shown, int(np.searchsorted(again.rollout.time, starts[0] - 1e-9))
    hand = robot.pose(again.rollout.q[first], tip)[:3, :3]
    turned = np.linalg.norm(Rotation.from_matrix(hand @ shown.orientation.T).as_rotvec())
    assert turned <= max(shown.turned, np.radians(10.0)) + 1e-3
    drawer = again.steps[1]
    assert drawer.done == pytest.approx(np.median(ways[0]), rel=0.03)
    assert drawer.deviation < 1e-3 and drawer.margin is not None and drawer.margin > 0.0
    run = ml.simulate(robot, again.controller, HOME, again.rollout.time[-1] + 1.0, 0.01)
    assert np.linalg.norm(robot.position(run.q[-1], tip) - robot.position(again.rollout.q[-1], tip)) < 2e-3


def test_fixtures_that_stand_elsewhere():
    """Turned and shifted: the hand takes hold where the things are now, and goes the way they go now."""
    _, tip, learner, things, _, _ = two_tasks()
    T = np.eye(4)
    T[:3, :3] = Rotation.from_rotvec([0.0, 0.0, 0.2]).as_matrix()
    T[:3, 3] = things[0].handle - T[:3, :3] @ things[0].handle + [0.03, -0.04, 0.02]
    again = ml.repeat(learner.skill_, HOME, T)
    ways = [(a, b) for name, a, b in again.rollout.phases if name.endswith(": way")]
    for (start, _), thing in zip(ways, things, strict=True):
        assert np.linalg.norm(place_at(again, tip, start) - (T[:3, :3] @ thing.handle + T[:3, 3])) < 2e-3
    start, end = (place_at(again, tip, t) for t in ways[0])
    assert (end - start) / np.linalg.norm(end - start) @ T[:3, :3] @ things[0].axis > 0.9999


class Arm:
    """An arm that goes where it is sent, and notes the way of the hand, and where its gripper was told something."""

    simulated, period = True, 0.01

    def __init__(self, robot: ml.Robot, tip: str, q: np.ndarray):
        self.robot, self.tip, self.q, self.told = robot, tip, q, list[tuple[str, np.ndarray]]()
        self.places = [robot.position(q, tip)]

    def read(self) -> tuple[np.ndarray, None, None]:
        """Where it is."""
        return self.q, None, None

    def command(self, q: np.ndarray, u: np.ndarray) -> None:
        """Go there."""
        self.q = np.array(q)
        self.places.append(self.robot.position(q, self.tip))

    def gripper(self, word: str) -> None:
        """Note it."""
        self.told.append((word, self.robot.position(self.q, self.tip)))


@pytest.mark.parametrize("by", [pytest.param("position", marks=pytest.mark.slow), "effort"])
def test_a_gripper_closes_at_the_handle_and_opens_at_the_end_of_the_way(by, tmp_path):
    """Learnt from the finger's joint or its effort; the driver is told where the hand is there; the finger goes too."""
    _, tip, demos, (thing,), _ = out_and_back(("drawer",), "panda", 70000)
    robot, guided = ml.load_robot("panda"), []
    assert robot.joint_names[-1] == "panda_finger_joint1"
    for number, demo in enumerate(demos):
        at = [np.linalg.norm(robot.position([*q, 0.0], tip) - thing.handle) < 2e-3 for q in demo.q]
        first, last = np.flatnonzero(at)[[0, -1]]
        holds = (np.arange(len(at)) >= first) & (np.arange(len(at)) <= last)
        finger = np.where(holds, 0.012, 0.038) if by == "position" else np.full(len(at), 0.02)
        finger += 0.002 * (number == 0)  # another handle, once
        finger = np.convolve(np.pad(finger, 15, mode="edge"), np.ones(31) / 31, "valid")  # a third of a second
        effort = np.column_stack([np.zeros((len(at), 7)), np.where(holds, 20.0, 9.5)]) if by == "effort" else None
        q = np.column_stack([demo.q, finger])
        guided.append(ml.Trajectory(demo.time, q, None, robot.joint_names, effort=effort))
    skill = ml.ConstraintLearner(ml.FrameJacobian(robot, tip, "xyz")).fit(guided).skill_
    skill = ml.Skill.load(skill.save(tmp_path / "task.json"), robot)
    assert [step.gripper for step in skill.steps] == [None, "close", "open"]
    told = [step.fingers["panda_finger_joint1"] for step in skill.steps[1:]]
    assert_allclose(told, [0.012, 0.038] if by == "position" else 0.02, atol=1e-5)
    start = guided[0].q[0]
    again = ml.repeat(skill, start)
    phases, rollout = {name: (a, b) for name, a, b in again.rollout.phases}, again.rollout
    names = [name.split(": ")[-1] for name in phases]  # a hand that has come to the handle need not settle
    assert [name for name in names if name != "hold"] == ["approach", "close", "way", "open", "retreat"]
    begin, end = phases["line: way"]
    if by == "position":
        assert_allclose(rollout.q[(rollout.time > begin) & (rollout.time < end), -1], 0.012, atol=1e-3)
        assert rollout.q[0, -1] == rollout.q[np.searchsorted(rollout.time, 0.5), -1] == start[-1]
    arm = Arm(robot, tip, start)
    done = ml.run(ml.ServoLoop(again.controller, dt=0.01), arm, rollout.time[-1] + 2.0)
    assert [word for word, _ in arm.told] == ["close", "open"] and "whether the handle stayed" in done.notes[0]
    (_, closed), (_, opened) = arm.told
    assert np.linalg.norm(closed - thing.handle) < 2e-3
    assert np.linalg.norm(opened - place_at(again, tip, end)) < 3e-3


@cache
def fast_drawer() -> tuple[ml.Robot, str, ml.Skill, np.ndarray]:
    """A drawer that was opened at more than 0.25 m/s."""
    robot, tip = ml.load_robot("sawyer"), "right_gripper_tip"
    demos = ml.load_demonstrations("sawyer_drawer", robot)[:6]
    return robot, tip, ml.ConstraintLearner(ml.FrameJacobian(robot, tip)).fit(demos).skill_, demos[0].q[0]


def speeds(robot: ml.Robot, tip: str, rollout: ml.Rollout) -> np.ndarray:
    """Speed of the tip over each step [m/s]."""
    places = np.array([robot.position(q, tip) for q in rollout.q])
    return np.linalg.norm(np.diff(places, axis=0), axis=1) / np.diff(rollout.time)


@pytest.mark.parametrize(
    ("given", "slow", "most"),
    [({}, None, 0.25), ({"tip_speed": 0.1}, None, 0.1),
     pytest.param({"tip_speed": 0.5}, 0.08, 0.08, id="limits that are lower", marks=pytest.mark.slow)],
)  # fmt: skip
def test_no_step_is_faster_than_asked(given, slow, most):
    """Approach, ways, reach and retreat, as simulated and as a loop sends it; what is done stays the same."""
    robot, tip, learner, _, _, _ = two_tasks()
    limits = {} if slow is None else {"limits": ml.Limits(robot, tip_speed=slow, frames=tip)}
    again = ml.repeat(learner.skill_, HOME, **given, **limits) if limits else repeated(**given)
    fast, time = speeds(robot, tip, again.rollout), again.rollout.time
    assert 0.9 * most < fast.max() <= most and again.tip_speed == pytest.approx(fast.max(), rel=1e-9)
    assert again.tip_path == pytest.approx(float(np.sum(fast * np.diff(time))), rel=1e-9)
    assert again.is_done
    for step in again.steps:
        assert step.done == pytest.approx(step.wanted, abs=2e-3) and step.deviation < 2e-3
    arm = Arm(robot, tip, np.array(HOME))
    ml.run(ml.ServoLoop(again.controller, dt=arm.period), arm, time[-1] + 1.0)
    sent = np.linalg.norm(np.diff(arm.places, axis=0), axis=1) / arm.period
    assert 0.9 * most < sent.max() <= most
    assert np.linalg.norm(arm.places[-1] - robot.position(again.rollout.q[-1], tip)) < 2e-3


def test_what_was_doubted_when_it_was_learnt_is_said_again():
    """All warnings of the answers that it follows, in one note; none where there were none."""
    _, _, skill, start = fast_drawer()
    way = skill.constraints[0]
    doubted = ml.Constraint(way.selection, way.features, way.provenance | {"warnings": ["weak gap: 6", "only 2"]})
    clear = ml.Constraint(way.selection, way.features, way.provenance | {"warnings": []})
    (note,) = [n for n in ml.repeat(doubted, start).notes if "warning" in n]
    assert note.startswith("learnt with 2 warnings") and note.endswith("weak gap: 6; only 2")
    assert not any("warning" in n for n in ml.repeat(clear, start).notes)


def test_as_fast_as_was_shown_is_faster_only_where_that_is_asked_for():
    """By default 0.25 m/s, and the note has both times; "shown" has the time that was shown; None limits nothing, and
    however fast a tip may be, no way is faster than it was shown.
    """
    robot, tip, skill, start = fast_drawer()
    made = {speed: ml.repeat(skill, start, tip_speed=speed) for speed in (0.25, 0.05, "shown", None, 50.0)}
    fastest = {speed: speeds(robot, tip, again.rollout).max() for speed, again in made.items()}
    took = {speed: again.rollout.ways[0]["seconds"] for speed, again in made.items()}
    shown = skill.steps[-1].shown
    assert shown is not None and shown.speed > 0.2
    for speed in (0.25, 0.05):
        assert fastest[speed] <= speed and took[speed] > 1.1 * shown.seconds
        (note,) = [n for n in made[speed].notes if n.startswith(f"{speed} m/s at the tip: {shown.extent:.3g} m takes ")]
        slow, before = map(float, re.findall(r"([\d.]+) s", note))
        assert slow == pytest.approx(took[speed], rel=0.15) and before == pytest.approx(shown.seconds, rel=0.02)
    assert fastest["shown"] > 0.3 and not any("m/s" in n for n in made["shown"].notes)
    assert took["shown"] == pytest.approx(shown.seconds, rel=0.15)
    assert fastest[None] >= fastest["shown"]
    assert made[50.0].tip_speed == pytest.approx(made["shown"].tip_speed, rel=1e-6)
    assert {round(again.steps[-1].done, 3) for again in made.values()} == {round(shown.extent, 3)}


def test_what_cannot_be_done_is_refused_by_its_step():
    """Out of reach, no rigid motion, no skill: which step, and nothing is returned of the others."""
    skill = two_tasks()[2].skill_
    far = np.eye(4)
    far[:3, 3] = 2.0, 0.0, 0.0
    with pytest.raises(NoPlanError, match="step 'line 1'"):
        ml.repeat(skill, HOME, far)
    with pytest.raises(TargetError, match="rigid"):
        ml.repeat(skill, HOME, 2.0 * np.eye(4))
    with pytest.raises(ml.ManipLearnError, match="learner.skill_"):
        ml.repeat("task.json", HOME)  # type: ignore[arg-type]


def test_the_command_line(tmp_path, capsys):
    """The answer describes the rollout that is written; a slower tip, fixtures out of reach and typing errors."""
    task, run = two_tasks()[2].skill_.save(tmp_path / "task.json"), tmp_path / "run.npz"
    start = ["--start", ",".join(map(str, HOME)), "--json"]

    def repeat(*words):
        code = main(["repeat", "panda", str(task), *words])
        out, err = capsys.readouterr()
        return json.loads(out) if code == 0 else (code, err)

    answer = repeat(*start, "--out", str(run))
    rollout = ml.Rollout.load(run)
    assert answer["done"] is True and answer["duration"] == rollout.time[-1]
    assert answer["min_manipulability"] == rollout.manipulability.min()
    assert len(answer["steps"]) == 5 and answer["tip_speed"] <= 0.25 and answer["tip_path"] > 0.5
    slower = repeat(*start, "--tip-speed", "0.1")
    assert slower["tip_speed"] <= 0.1 and slower["duration"] > answer["duration"]
    for words, error in (
        ([*start[:2], "--moved", "3,0,0"], "step 'line 1'"),
        (["--moved", "1,2"], "--moved takes 3 numbers"),
        (["--tip-speed", "quick"], "--tip-speed is 'quick': it must be a positive number"),
    ):
        code, err = repeat(*words)
        assert code == 2 and error in err


@pytest.mark.parametrize("prefer", ["shown", "room"])
def test_the_hand_takes_hold_where_a_contact_began(prefer, tmp_path):
    """As one recording did, or in the posture with most room: within 5 mm of a shown grasp; the steps say so, a loaded
    skill does the same, and a repetition can be pickled.
    """
    robot, tip, learner, _, _, demos = two_tasks()
    again = repeated(prefer=prefer)
    assert again.is_done and any("follows" in note for note in again.notes) == (prefer == "shown")
    holds = [step for step in again.steps if step.grasp is not None and step.kind == "reach"]
    assert len(holds) == 2 and max(step.off for step in holds) < 5e-3
    grasps = np.concatenate([step.shown.grasps for step in learner.skill_.steps if step.shown is not None])
    for step in holds:
        off = np.linalg.norm(grasps[:, :3, 3] - step.grasp[:3, 3], axis=1).min()
        assert off == pytest.approx(step.off, abs=1e-6) or off < step.off
    loaded = ml.Skill.load(learner.skill_.save(tmp_path / "task.json"), robot)
    same = ml.repeat(loaded, HOME, prefer=prefer)
    assert np.max(np.abs(same.rollout.q[-1] - again.rollout.q[-1])) < 1e-3
    if prefer == "shown":  # the postures are those of a recording
        recorded = np.concatenate([robot.positions(q)[None] for demo in demos for q in demo.q[::5]])
        closes = again.rollout.q[np.searchsorted(again.rollout.time, again.rollout.phases[0][2])]
        assert np.min(np.max(np.abs(recorded - closes), axis=1)) < 0.1


def test_recordings_cut_to_the_contact_that_begin_at_rest_are_repeated(tmp_path):
    """The arm stands still for the first samples of the contact and has no approach: `repeat` comes from elsewhere and
    opens the drawer as far as demonstrated, with the skill in memory and from its file.
    """
    robot, start = ml.load_robot("sawyer"), [1.2, -1.57, 0, 0, 0, 0, 0]
    cut = [np.vstack([demo.q[:1].repeat(30, 0), demo.q]) for demo in ml.load_demonstrations("sawyer_drawer", robot)[:6]]
    demos = ml.Demonstrations([ml.Trajectory(0.01 * np.arange(len(q)), q) for q in cut])
    skill = ml.ConstraintLearner(ml.FrameJacobian(robot, frame="right_gripper_tip")).fit(demos).skill_
    for one in (skill, ml.Skill.load(skill.save(tmp_path / "task.json"), robot)):
        repetition = ml.repeat(one, start)
        assert repetition.is_done and repetition.steps[1].done == pytest.approx(skill.steps[1].shown.extent, rel=1e-3)
