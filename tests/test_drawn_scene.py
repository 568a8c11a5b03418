"""What a page draws and says: what was learnt and stated, nothing that an arm goes through, and every warning."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mechanism_motions import about, along, demonstrate
from scipy.spatial.transform import Rotation
from test_mechanism import MIDDLE, TIP
from test_playback import data_in, unpacked, waving

import manip_learn as ml
from manip_learn.cli import main
from manip_learn.commands import tables
from manip_learn.commands.output import Answer
from manip_learn.control.command import Status
from manip_learn.errors import NoPlanError, RecordingError

DATA = Path(__file__).resolve().parents[1] / "examples" / "data"
SHIPPED = {  # folder -> robot, tip, and how many recordings are enough
    "sawyer_drawer": ("sawyer", "right_gripper_tip", 4),
    "sawyer_door": ("sawyer", "right_gripper_tip", 3),
    "panda_drawer_whole": ("panda", "panda_hand_tcp", 3),
    "ur5_loose_door": ("ur5", "tool0", 4),
    "xarm7_drawer_then_table": ("xarm7", "link_eef", 3),
}
ARMS = {  # of generated tasks -> tip, and a posture about which the hand takes hold
    **{name: (TIP[name], MIDDLE[name]) for name in ("panda", "ur5")},
    "sawyer": ("right_gripper_tip", [0.2, -0.5, 0.1, 1.4, 0.1, 0.6, 0.3]),
    "xarm7": ("link_eef", [0.2, -0.3, 0.1, 1.2, 0.1, 1.4, 0.2]),
    "kinova": ("j2s6s200_end_effector", [3.1, 3.4, 1.9, 1.5, 2.0, 1.6]),
    "arms/six_joints.urdf": ("tool", [0.2, 0.5, 0.1, 0.2, -0.6, 0.1]),
    "arms/seven_endless.urdf": ("tool", [0.2, 0.6, 0.1, 1.5, 0.1, -0.5, 0.1]),
}
FINGERS = ("panda_finger_joint1", "panda_finger_joint2")
AROUND = np.array([[0.35, -0.8, 0.15], [0.35, 0.8, 0.15]])  # [m] where boxes are stated beside the arms


def centre_line(robot: dict[str, Any], values: np.ndarray) -> np.ndarray:
    """Return points on the lines that join the origins of the joints and the tip, as the page places them (n, 3)."""
    poses = [np.eye(4)]
    for joint, value in zip(robot["joints"][1:], values, strict=False):
        motion, axis = np.eye(4), np.array(joint["axis"])
        if joint["motion"] == "revolute":
            motion[:3, :3] = Rotation.from_rotvec(axis * value).as_matrix()
        else:
            motion[:3, 3] = axis * value
        poses.append(poses[joint["parent"]] @ np.reshape(joint["placement"], (4, 4)) @ motion)
    tip = next(link for link in robot["links"] if link["name"] == robot["tip"])
    ends = [(poses[joint["parent"]], pose) for joint, pose in zip(robot["joints"][1:], poses[1:], strict=True)]
    ends.append((poses[tip["joint"]], poses[tip["joint"]] @ np.reshape(tip["placement"], (4, 4))))
    shares = np.linspace(0.0, 1.0, 9)[:, None]
    return np.concatenate([a[:3, 3] + shares * (b - a)[:3, 3] for a, b in ends])


def inside(body: dict[str, Any], points: np.ndarray) -> bool:
    """Whether a point is in a box, a sphere or a cylinder; a face has no inside."""
    pose = np.reshape(body["pose"], (4, 4))
    local, size = (points - pose[:3, 3]) @ pose[:3, :3], np.array(body["size"])
    if body["kind"] == "face":
        return False
    if body["kind"] == "box":
        return bool(np.any(np.all(np.abs(local) < size / 2.0, axis=1)))
    if body["kind"] == "sphere":
        return bool(np.any(np.linalg.norm(local, axis=1) < size[0]))
    assert body["kind"] == "cylinder", body["kind"]
    return bool(np.any((np.hypot(*local.T[:2]) < size[0]) & (np.abs(local[:, 2]) < size[1] / 2.0)))


def moments_inside(page: dict[str, Any]) -> int:
    """Return at how many moments the centre line of an arm is in a body that the page draws beside it.

    A page draws no more than this function knows: lines, patches and paths of mechanisms have no inside.
    """
    for mechanism in page["mechanisms"]:
        assert set(mechanism) == {"type", "sentence", "shown", "hold", "lines", "patches", "way", "constraint"}
    count = 0
    for rollout in page["rollouts"]:
        times = unpacked(rollout["keyTimes"], "<f8")
        postures = unpacked(rollout["tracks"], "<f8").reshape(len(times), -1)
        for values in postures[:: max(1, len(postures) // 60)]:
            line = centre_line(page["robot"], values)
            count += any(inside(body, line) for body in rollout["around"])
    return count


def stated(robot: ml.Robot) -> ml.Scene:
    """Return two boxes and a post beside the arm, and a floor well below it."""
    boxes = [ml.Box((0.2, 0.2, 0.3), at, f"box {k}") for k, at in enumerate(AROUND)]
    return ml.Scene(floor=-1.0, boxes=boxes, cylinders=[ml.Cylinder(0.05, 0.6, (-0.6, 0.0, 0.3), "post")])


def pages_of(skill: ml.Skill, demos: ml.Demonstrations, folder: Path) -> Iterator[dict[str, Any]]:
    """Yield the data of a page of recordings, and of the task done again among boxes that were stated."""
    robot, constraints = skill.constraints[0].robot, skill.constraints
    assert robot is not None
    yield data_in(ml.replay(robot, {t.name: t for t in demos}, folder / "a.html", constraint=constraints).html)
    try:
        done = ml.repeat(skill, demos[0].q[0], scene=stated(robot))
    except NoPlanError:
        return
    yield data_in(ml.replay(robot, {"again": done.rollout}, folder / "b.html", open_browser=False).html)


@pytest.mark.parametrize("folder", SHIPPED)
def test_no_arm_is_inside_what_is_drawn(folder: str, tmp_path: Path):
    """The centre line of the arm is in no drawn body, at no moment of the recordings or of the task done again."""
    name, tip, n = SHIPPED[folder]
    robot = ml.load_robot(name, locked=FINGERS if name == "panda" else ())
    demos = ml.load_demonstrations(sorted(map(str, (DATA / folder).glob("*.csv")))[:n], robot)
    learner = ml.ConstraintLearner(ml.FrameJacobian(robot, tip, "pose"), phases="auto").fit(demos)
    pages = list(pages_of(learner.skill_, demos, tmp_path))
    assert [moments_inside(page) for page in pages] == [0] * len(pages)
    drawn = {body["name"] for page in pages[1:] for rollout in page["rollouts"] for body in rollout["around"]}
    assert drawn in (set(), {"floor", "box 0", "box 1", "post"})  # as stated, and all of it


@pytest.mark.slow
@pytest.mark.parametrize("number", range(21))
def test_no_arm_is_inside_what_is_drawn_of_generated_tasks(number: int, tmp_path: Path):
    """The same of drawers and doors at random places, firmly and loosely grasped, with seven arms."""
    name, firm = sorted(ARMS)[number % 7], number % 2 == 0
    file = str(Path(__file__).parent / name) if "/" in name else name
    robot, (tip, posture) = ml.load_robot(file, locked=FINGERS if name == "panda" else ()), ARMS[name]
    hand, demos = robot.position(posture, robot.frame(tip)), None
    for attempt in range(9):  # until the arm can do what was drawn
        rng = np.random.default_rng([66, number, attempt])
        axis, other = rng.normal(size=(2, 3))
        axis /= np.linalg.norm(axis)
        across = np.cross(axis, other)
        way = about(axis, hand + 0.35 * across / np.linalg.norm(across), 0.35, firm=firm)
        with suppress(RuntimeError):
            way = way if number % 3 else along(axis[None], 0.12, firm)
            demos = ml.Demonstrations(demonstrate(robot, tip, np.array(posture), way, rng, grip=0.1))
            break
    assert demos is not None
    learner = ml.ConstraintLearner(ml.FrameJacobian(robot, tip, "pose")).fit(demos)
    assert sum(map(moments_inside, pages_of(learner.skill_, demos, tmp_path))) == 0


def test_a_body_around_the_arm_is_found_and_an_assumed_floor_is_neither_drawn_nor_framed(robot_of, tmp_path: Path):
    """The check above sees a box that a user states around the base; what a plan assumes changes no picture."""
    robot, pose = robot_of("sawyer"), np.eye(4)
    box = {"name": "box", "kind": "box", "size": [0.3, 0.3, 0.6], "pose": pose.tolist(), "assumed": False}
    pose[2, 3] = -3.0
    floor = {"name": "floor", "kind": "face", "pose": pose.tolist(), "assumed": True, "nearest": 0.12, "link": "a"}
    motion = waving(robot)
    pages = {}
    for name, around in {"plain": (), "floor": (floor,), "box": (box,)}.items():
        shown = replace(motion, around=around)
        pages[name] = data_in(ml.replay(robot, {"a": shown}, tmp_path / "a.html", open_browser=False).html)
    assert moments_inside(pages["box"]) > 0 and moments_inside(pages["plain"]) == 0
    assert pages["floor"]["rollouts"][0]["around"] == []
    assert pages["floor"]["rollouts"][0]["clear"] == "floor (0.12 m from a) assumed: state what is there as a scene"
    for key in ("bounds", "outline", "floor"):
        assert pages["floor"][key] == pages["plain"][key]
    below = replace(motion, around=({**floor, "assumed": False},))
    page = data_in(ml.replay(robot, {"a": below}, tmp_path / "a.html", open_browser=False).html)
    assert page["floor"] < pages["plain"]["floor"]


def test_three_statuses_stand_for_all():
    """As asked, slower than asked, or standing: each status is one of them."""
    of = {effect: {s for s in Status if s.effect == effect} for effect in ("ok", "slowed", "stopped")}
    assert of["ok"] == {Status.OK, Status.NULL_SCALED, Status.REROUTED}
    standing = {Status.INVALID_INPUT, Status.STALE, Status.FOLLOWING_ERROR, Status.STOPPED, Status.STALLED}
    assert of["stopped"] == standing and of["slowed"] == {*Status} - of["ok"] - standing


def test_a_page_says_every_warning_of_the_terminal(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
):
    """In the same words: of learning, of a task done again, of a rollout, and of a replay of files."""
    page, task, run, short = (tmp_path / name for name in ("a.html", "task.json", "run.npz", "short.npz"))
    answers = list[Answer]()
    show = tables.show
    monkeypatch.setattr(
        tables, "show", lambda console, answer, *more: (answers.append(answer), show(console, answer, *more))
    )
    for words in (
        ["learn", "panda", str(DATA / "panda_drawer_whole"), "--out", str(task)],
        ["learn", "panda", str(DATA / "panda_drawer_mixed"), "--out", str(tmp_path / "mixed.json")],
        ["repeat", "panda", str(task), "--out", str(run)],
        ["control", "panda", str(task), "--along", "0.1", "--plan", "--out", str(short)],
        ["control", "panda", str(task), "--duration", "0.3"],
        ["replay", str(run), str(short)],
    ):
        assert main([*words, "--html", str(page)]) == 0, words
        printed, notes = (" ".join(t.split()) for t in (capsys.readouterr().out, " ".join(data_in(page)["notes"])))
        doubts = [
            " ".join(doubt.removeprefix("warning: ").split()) for doubt in (*answers[-1].warnings, *answers[-1].notes)
        ]
        assert doubts and all(doubt in printed and doubt in notes for doubt in doubts), words
    assert answers[1].warnings and answers[-2].warnings  # there is something to say


# ---- what a plan keeps clear of --------------------------------------------------------------------------------------

TRIANGLES = ([[0, 0, 0], [0.1, 0, 0], [0, 0.1, 0], [0, 0, 0.1]], [[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]])
READY = [0.0, -0.5, 0.0, 1.4, 0.0, 0.6, 0.0]


@pytest.fixture(scope="module")
def planned(robot_of) -> ml.Plan:
    """A way among one thing of each kind."""
    sawyer = robot_of("sawyer")
    drawer = ml.Constraint([[0, 1, 0], [0, 0, 1]], ml.FrameJacobian(sawyer, "right_gripper_tip"))
    scene = ml.Scene(
        floor=-0.9,
        boxes=[ml.Box((0.3, 0.2, 0.1), (0.3, 0.9, 0.2), "box")],
        spheres=[ml.Sphere(0.1, (0.3, -0.9, 0.2), "ball")],
        cylinders=[ml.Cylinder(0.05, 0.4, (-0.6, 0.5, 0.2), "post")],
        meshes=[ml.Mesh(TRIANGLES, (-0.6, -0.5, 0.2), "wedge")],
    )
    return ml.plan(drawer, ml.motion(drawer, along=-0.1), READY, candidates=48, scene=scene)


def test_a_rollout_carries_what_stands_around(planned: ml.Plan, robot_of, tmp_path: Path):
    """Names, kinds, sizes and places, in both formats that are read back and on its page; damaged ones are refused."""
    sawyer, around = robot_of("sawyer"), {thing["name"]: thing for thing in planned.rollout.around}
    kinds = {"floor": "face", "box": "box", "ball": "sphere", "post": "cylinder", "wedge": "mesh"}
    assert {name: thing["kind"] for name, thing in around.items()} == kinds
    assert around["box"]["size"] == pytest.approx([0.3, 0.2, 0.1])
    assert around["post"]["size"] == pytest.approx([0.05, 0.4])
    assert np.array(around["floor"]["pose"])[2, 3] == pytest.approx(-0.9)
    assert len(around["wedge"]["faces"]) == 4 and not any(thing["assumed"] for thing in around.values())
    for name in ("a.npz", "a.csv"):
        assert ml.Rollout.load(planned.save(tmp_path / name), sawyer).around == planned.rollout.around
    page = data_in(ml.replay(sawyer, {"plan": planned.rollout}, tmp_path / "a.html", open_browser=False).html)
    things = {thing["name"]: thing for thing in page["rollouts"][0]["around"]}
    assert things["box"]["size"] == [0.3, 0.2, 0.1] and things["post"]["size"] == [0.05, 0.4]
    places = {name: np.reshape(thing["pose"], (4, 4))[:3, 3].tolist() for name, thing in things.items()}
    assert places["box"] == [0.3, 0.9, 0.2] and places["ball"] == [0.3, -0.9, 0.2]
    assert [name for name, thing in things.items() if thing["mesh"]] == ["wedge"]
    file = tmp_path / "a.csv"
    file.write_text(file.read_text().replace('"kind": "sphere"', '"kind": "cloud"'))
    with pytest.raises(RecordingError):
        ml.Rollout.load(file, sawyer)


@pytest.mark.parametrize("kind", ["drawer", "door", "table"])
def test_furniture_stops_an_arm_that_is_drawn_through_it(robot_of, kind: str):
    """Pulled with a person's force to a place behind the furniture, the hand does not get there."""
    pytest.importorskip("mujoco")
    from manip_learn.teach.arm import TeachingArm
    from manip_learn.teach.scene import place_scene

    sawyer = robot_of("sawyer")
    scene = place_scene(kind, sawyer, "right_gripper_tip", np.random.default_rng(4))  # type: ignore[arg-type]
    handle, arm = scene.handle, TeachingArm(scene, np.random.default_rng(0), in_real_time=False)
    start = arm.place
    behind = -0.35 * handle.axis if kind == "table" else -0.6 * handle.pose[:3, 1]
    goal = handle.pose[:3, 3] + behind
    for k in range(400):
        arm.pull(None, None, start + (goal - start) * min(1.0, k / 300))
        arm.wait()
    assert np.linalg.norm(arm.place - goal) > 0.1
    assert np.max(np.abs(arm.data.qvel)) < 0.5
