"""Files that the library writes: they know their robot, come back bit for bit, and are refused for any other robot."""

from __future__ import annotations

import dataclasses
import json
import random
import re
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from case import case
from recording_corpus import refusal

from manip_learn.cli import main
from manip_learn.constraint.constraint import Constraint
from manip_learn.constraint.features import CustomFeatures, FrameJacobian, MechanismRows
from manip_learn.constraint.skill import Skill, Step
from manip_learn.control.controller import ResolvedRateController
from manip_learn.control.rollout import Rollout, written_constraint
from manip_learn.control.servo_loop import ServoLoop
from manip_learn.control.simulation import simulate
from manip_learn.control.tasks import FreeDirection, Hold, PointAttractor
from manip_learn.errors import ConstraintMismatchError, OutputError, RecordingError
from manip_learn.playback import replay
from manip_learn.recordings import load_demonstrations
from manip_learn.recordings.saved_motion import motion_of_trajectory
from manip_learn.recordings.trajectory import Trajectory
from manip_learn.recordings.writers.write_motion import joint_trajectory_bytes
from manip_learn.robot import Robot, load_robot
from manip_learn.robot.identity import RobotIdentity

FORMATS = ("npz", "csv")
ARRAYS = ("time", "q", "u", "manipulability", "task_error")
# a robot in a URDF of three joints, one of which may be locked
URDF = """<robot name="{name}"><link name="base"/><link name="a"/><link name="b"/><link name="tip"/>
{joints}</robot>"""
JOINT = """<joint name="{name}" type="revolute"><parent link="{parent}"/><child link="{child}"/>
<origin xyz="{length} 0 0"/><axis xyz="0 0 1"/><limit lower="-3" upper="3" velocity="2" effort="1"/></joint>"""


def arm(path: Path, name: str = "arm", length: float = 1.0, joints: tuple[str, ...] = ("j1", "j2", "j3")) -> Path:
    """A planar arm; its name, its lengths and the names of its joints are what a mistake would confuse."""
    links = ("base", "a", "b", "tip")
    ends = zip(joints, links[:-1], links[1:], (0.0, length, length), strict=True)
    parts = "".join(JOINT.format(name=n, parent=p, child=c, length=x) for n, p, c, x in ends)
    path.write_text(URDF.format(name=name, joints=parts), encoding="utf-8")
    return path


def rollout_of(robot: Robot, seconds: float = 0.5) -> Rollout:
    """A motion that moves every joint."""
    controller = ResolvedRateController(Constraint([[1.0, 0.0, 0.0]], FrameJacobian(robot, "tip")), Hold())
    made = simulate(robot, controller, np.full(robot.nv, 0.4), seconds, 0.01)
    q = 0.4 + 0.1 * np.sin(made.time[:, None] + np.arange(robot.nv)) / 3.0
    u = 0.1 * np.cos(made.time[:, None] + np.arange(robot.nv)) / 3.0
    error = np.where(made.time < 0.1, np.inf, 1.0 / (3.0 + made.time))
    error[5:8] = np.nan, -np.inf, -0.0
    return dataclasses.replace(made, q=q, u=u, task_error=error)


@pytest.fixture(scope="module")
def arms(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("arms")
    arm(folder / "arm.urdf")
    arm(folder / "longer.urdf", length=1.1)
    arm(folder / "renamed.urdf", name="other")
    arm(folder / "joints.urdf", joints=("j1", "j2", "wrist"))
    return folder


def test_a_rollout_comes_back_bit_for_bit(arms: Path) -> None:
    """Every array, NaN and infinity, word, name, frame and the robot, in each format; as a demonstration too."""
    for suffix in FORMATS:
        with case(suffix) as tmp_path:
            robot = load_robot(arms / "arm.urdf", locked={"j2": 1.2})
            rollout = rollout_of(robot)
            path = rollout.save(tmp_path / f"run.{suffix}")
            for loaded in (Rollout.load(path), Rollout.load(path, robot)):
                for name in ARRAYS:
                    assert getattr(loaded, name).tobytes() == getattr(rollout, name).tobytes()
                assert (loaded.status, loaded.joint_names, loaded.frame) == (rollout.status, rollout.joint_names, "tip")
                assert loaded.robot == RobotIdentity.of(robot) and loaded.robot.locked == {"j2": 1.2}
            demonstration = load_demonstrations(path, robot)[0]
            for name in ("time", "q", "u"):
                assert getattr(demonstration, name).tobytes() == getattr(rollout, name).tobytes()
            odd = shutil.copy(path, tmp_path / "a b.txt")  # the content says the format
            assert Rollout.load(odd, robot).q.tobytes() == rollout.q.tobytes()
            refusal(odd, load_robot(arms / "longer.urdf"), match="'arm'")
            assert load_demonstrations(path, robot).notes == ()


# (made with, locked; used with, locked): ten mistakes, each of which the same names could hide
WRONG_ROBOTS: list[tuple[str, dict, str, dict]] = [
    ("arm", {}, "longer", {}),
    ("longer", {}, "arm", {}),
    ("arm", {"j3": 1.2}, "longer", {"j3": 1.2}),
    ("arm", {}, "renamed", {}),
    ("renamed", {"j1": 0.3}, "arm", {"j1": 0.3}),
    ("arm", {}, "joints", {}),
    ("arm", {}, "arm", {"j2": None}),
    ("arm", {"j2": 1.2}, "arm", {}),
    ("arm", {"j2": 1.2}, "arm", {"j2": None}),
    ("arm", {"j2": 1.2}, "arm", {"j3": None}),
]


@pytest.mark.parametrize("case", range(10))
def test_no_file_is_used_with_another_robot_in_silence(case: int, arms: Path, tmp_path: Path, capsys) -> None:
    """Ten files, each with a robot or locked joints that are not its own: Python refuses to load, learn from or replay
    them and names both robots; the command line restores the locked joints, or refuses too.
    """
    made_with, locked, used_with, used_locked = WRONG_ROBOTS[case]
    made_with, used_with = (str(arms / f"{name}.urdf") for name in (made_with, used_with))
    own, other = load_robot(made_with, locked=locked), load_robot(used_with, locked=used_locked)
    rollout = rollout_of(own)
    path = rollout.save(tmp_path / ("run.npz", "run.csv")[case % 2])
    page = tmp_path / "page.html"
    for use in (
        lambda: Rollout.load(path, other),
        lambda: load_demonstrations(path, other),
        lambda: replay(other, {"a": Rollout.load(path)}, page, open_browser=False),
    ):
        with pytest.raises(RecordingError, match=repr(own.name)) as caught:
            use()
        assert caught.value.code == "other-robot" and repr(other.name) in str(caught.value)
    locks = [x for joint in used_locked for x in ("--lock", joint)]
    same_description = made_with == used_with and not set(used_locked) - set(locked)
    learnt = tmp_path / "c.json"
    commands = (
        ["replay", used_with, str(path), "--html", str(page), *locks],
        ["learn", used_with, str(path), "--frame", "tip", "--axes", "x", "--out", str(learnt), *locks],
    )
    for command in commands:
        code, said = main(command), capsys.readouterr()
        assert "internal error" not in said.err
        if code == 0 and command[0] == "replay":  # what the file alone has locked is said, with its position
            silent = {name: at for name, at in locked.items() if name not in used_locked}
            notes = ["as when it was made: " + ", ".join(f"{n} = {x:.4g}" for n, x in silent.items()) + " locked"]
            assert all(" ".join(note.split()) in " ".join(said.out.split()) for note in notes if silent)
        if not same_description:
            assert code == 2 and repr(own.name) in said.err and "was made with robot" in said.err
            assert not page.exists() and not learnt.exists()
    if same_description:
        replay(own, {"run": rollout}, tmp_path / "direct.html", open_browser=False, notes=notes if silent else ())
        assert page.read_bytes() == (tmp_path / "direct.html").read_bytes()  # of the joints as they were locked
        if learnt.exists():  # there may be too little motion to learn from
            assert json.loads(learnt.read_text())["robot"]["locked"] == locked


def test_files_without_a_robot(arms: Path, tmp_path: Path) -> None:
    """A rollout that was made without one loads with a warning; an archive of an early version is refused."""
    robot = load_robot(arms / "arm.urdf")
    unknown = replace(rollout_of(robot), robot=None).save(tmp_path / "unknown.npz")
    with pytest.warns(UserWarning, match="which robot"):
        assert Rollout.load(unknown, robot).robot is None
    with pytest.raises(RecordingError, match="wrist"):
        Rollout.load(unknown, load_robot(arms / "joints.urdf"))
    arrays = {name: getattr(rollout_of(robot), name) for name in ARRAYS}
    np.savez(tmp_path / "old.npz", format="manip_learn.rollout", joint_names=robot.joint_names, frame="tip", **arrays)
    for read in (Rollout.load, load_demonstrations):
        with pytest.raises(RecordingError, match="early version wrote this file") as caught:
            read(tmp_path / "old.npz", robot)
        assert caught.value.code == "not-a-rollout"


def test_another_ending_is_refused(arms: Path, tmp_path: Path) -> None:
    """The ending says the format; one that says nothing is an error that lists the formats, as is one that went."""
    robot = load_robot(arms / "arm.urdf")
    rollout = rollout_of(robot)
    gone = r"JSON lines are not written any more; \.npz and \.csv"
    for name, said in (("run.xyz", r"\.npz, \.csv, \.mcap"), ("run.jsonl", gone)):
        with pytest.raises(OutputError, match=said):
            rollout.save(tmp_path / name)
    motion = motion_of_trajectory(Trajectory(rollout.time, rollout.q, None, rollout.joint_names), robot)
    rollout.save(tmp_path / "run.mcap")
    (tmp_path / "old.jsonl").write_bytes(b'{"format": "manip_learn.rollout", "schema": 2}\n')
    (tmp_path / "run.yaml").write_bytes(joint_trajectory_bytes(motion))
    for name in ("run.mcap", "old.jsonl", "run.yaml"):
        with pytest.raises(RecordingError, match=r"\.npz and \.csv|\.npz or \.csv") as caught:
            Rollout.load(tmp_path / name)
        assert caught.value.code == "not-a-rollout"


def test_a_rollout_keeps_what_guided_it(robot_of) -> None:
    """Target, constraint and following error come back from every format; the constraint can be built again."""
    for suffix in FORMATS:
        with case(suffix) as tmp_path:
            robot = robot_of("sawyer")
            features = FrameJacobian(robot, "right_hand", "xyz")
            provenance = {"kind": "motion-constrained", "phases": [["a", 0, 1, 0]]}
            constraint = Constraint([[0, 1, 0], [0, 0, 1]], features, provenance)
            controller = ResolvedRateController(constraint, PointAttractor([0.6, 0.2, 0.4]))
            rollout = simulate(robot, ServoLoop(controller, 0.01), robot.neutral(), 0.05, 0.01)
            assert rollout.following_error is not None and rollout.following_error.shape == rollout.time.shape
            slipping = replace(rollout, following_error=np.linspace(0.0, 0.1, len(rollout)))
            loaded = Rollout.load(slipping.save(tmp_path / f"run.{suffix}"), robot)
            assert loaded.target is not None and loaded.target.tolist() == [0.6, 0.2, 0.4]
            assert loaded.following_error is not None
            assert loaded.following_error.tobytes() == slipping.following_error.tobytes()  # type: ignore[union-attr]
            assert loaded.constraint is not None
            again = Constraint.from_dict(loaded.constraint, robot)
            np.testing.assert_array_equal(again.selection, constraint.selection)
            assert again.provenance == {"kind": "motion-constrained"}  # the phases are of other recordings
            with pytest.raises(ConstraintMismatchError, match="the constraint: it was made with"):
                Constraint.from_dict(loaded.constraint, robot_of("planar3"))


def test_a_task_says_where_it_ends(robot_of) -> None:
    """A drawer's motion ends at its start plus the way; features that cannot be written leave the rollout without."""
    robot = robot_of("sawyer")
    features = FrameJacobian(robot, "right_hand", "xyz")
    constraint = Constraint([[0, 1, 0], [0, 0, 1]], features)
    task = FreeDirection(constraint, 0.05, 0.1)
    assert task.goal() is None
    start = np.array([0.1, -0.8, 0.2, 1.5, 0.1, 0.6, 0.3])
    rollout = simulate(robot, ResolvedRateController(constraint, task), start, 1.0, 0.01)
    expected = robot.position(start, robot.frame("right_hand")) + [0.05, 0.0, 0.0]
    np.testing.assert_allclose(rollout.target, expected, atol=1e-12)
    hinge = MechanismRows(robot, "right_hand", "radial axial", axis=(0, 0, 1), point=(0.2, 0.0, 0.0))
    door = Constraint(np.eye(2), hinge)
    turned = simulate(robot, ResolvedRateController(door, FreeDirection(door, 0.3, 0.5)), start, 3.0, 0.01)
    end = robot.position(turned.q[-1], robot.frame("right_hand"))
    np.testing.assert_allclose(np.asarray(turned.target)[:3, 3], end, atol=2e-3)
    python = Constraint([[1.0]], CustomFeatures(lambda q: q[None, :], ("a",), 1))
    assert written_constraint(python) is None


OF_02 = Path(__file__).parent / "data" / "constraint_of_02.json"  # schema 1, as 0.2 wrote it: a skill on planar3
# posture -> A(q) of that file, by the version that wrote it
ROWS_OF_02 = {
    (0.3, 0.8, 0.4): [[0.32847378654766984, -0.803410653365245, -0.7212260045251858]],
    (-1.0, 0.2, 2.0): [[-0.5583179243138446, -0.9469386042794726, -1.1110070587637821]],
}


def rewritten(value: Any) -> Any:
    """JSON as another program writes it again: whole numbers without a point, -0 for 0, keys in another order."""
    if isinstance(value, dict):
        keys = random.Random(0).sample(sorted(value), len(value))
        return {key: rewritten(value[key]) for key in keys}
    if isinstance(value, list):
        return [rewritten(inner) for inner in value]
    whole = isinstance(value, float) and value.is_integer()
    return value if not whole else int(value) if value else -0.0


@pytest.fixture
def door(planar3: Robot, tmp_path: Path) -> Path:
    """Write a constraint file of format 2, with the steps of a skill, whole numbers and keys that are not sorted."""
    provenance = json.loads(OF_02.read_text())["provenance"] | {"kept": {"z": -0.0, "a": [1.0, 1e-7]}}
    rows = MechanismRows(planar3, "tip", "radial axial", axis=(0, 0, 1), point=(0.4, 0.3, 0.0), radius=1.25)
    constraint = Constraint([[0.6, 0.8]], rows, provenance)
    way = Step("way", constraint, constraint.shown, "close")
    return Skill((constraint,), (Step("reach", constraint), way)).save(tmp_path / "c.json")


def test_a_constraint_file_comes_back_if_another_program_wrote_it(planar3: Robot, door: Path, tmp_path: Path) -> None:
    """The same A to the last bit and the same steps, as it was written and as another program writes it again: 1 for
    1.0, -0.0, keys in another order, no indentation. Files of format 2 and 1 alike; neither is called changed.
    """
    for path, schema in ((door, 2), (OF_02, 1)):
        content = json.loads(path.read_text())
        assert content["schema"] == schema and len(content["sha256"]) == 64
        again = tmp_path / "again.json"
        for text in (json.dumps(rewritten(content)), json.dumps(content, indent=7, sort_keys=True)):
            again.write_text(text)
            first, other = Constraint.load(path, planar3), Constraint.load(again, planar3)
            assert first.notes == other.notes == ()
            for q in ROWS_OF_02:
                np.testing.assert_array_equal(other(q), first(q))
            steps = Skill.load(again, planar3).steps
            assert [(step.kind, step.gripper) for step in steps] == [("reach", None), ("way", "close")]


def test_a_changed_number_of_a_constraint_file_is_noticed(planar3: Robot, door: Path, tmp_path: Path) -> None:
    """In features, what was shown and the steps of a skill, in either format; not in what is only reported."""
    for path in (door, OF_02):
        for keys, value in (
            (("features", "radius"), 1.2500001),
            (("features", "point"), [0.4, 0.3, 1e-6]),
            (("provenance", "shown", "extent"), 0.5),
            (("skill", "steps"), []),
        ):
            content = inner = json.loads(path.read_text())
            for key in keys[:-1]:
                inner = inner[key]
            inner[keys[-1]] = value
            changed = tmp_path / "changed.json"
            changed.write_text(json.dumps(content))
            said = 'changed.json was changed after .* delete the entry "sha256"'
            with case(path.name, keys), pytest.raises(ConstraintMismatchError, match=said):
                Constraint.load(changed, planar3)
        told = json.loads(path.read_text())
        told["provenance"]["sentence"] = "another one"
        changed.write_text(json.dumps(told))
        assert Constraint.load(changed, planar3).provenance["sentence"] == "another one"


def test_a_constraint_file_of_02_means_the_same(planar3: Robot, tmp_path: Path) -> None:
    """Its A(q) is what the version that wrote it computed, and saved again it is a file of format 2 with the same A."""
    old = Constraint.load(OF_02, planar3, same_urdf=False)
    new = Constraint.load(old.save(tmp_path / "new.json"), planar3)
    for q, rows in ROWS_OF_02.items():
        np.testing.assert_allclose(old(q), rows, rtol=0, atol=1e-14)
        np.testing.assert_array_equal(new(q), old(q))
    assert json.loads((tmp_path / "new.json").read_text())["schema"] == 2
    assert new.provenance == old.provenance and new.shown is not None and new.shown.n == 3


def test_a_constraint_file_of_a_newer_version_says_what_to_do(planar3: Robot, door: Path) -> None:
    """An unknown number of the format is refused by its number, with a way out."""
    content = json.loads(door.read_text())
    for number in (3, 0, "2", None, [2]):
        door.write_text(json.dumps(content | {"schema": number}))
        said = re.escape(f"c.json has schema {number!r}, this version reads 1 and 2: load it with a newer")
        with case(number), pytest.raises(ConstraintMismatchError, match=said):
            Constraint.load(door, planar3)


def test_a_constraint_file_holds_finite_numbers(planar3: Robot, door: Path, tmp_path: Path) -> None:
    """NaN and infinity are refused wherever they stand, also where no signature looks; and they are not written."""
    content, constraint = json.loads(door.read_text()), Constraint.load(door, planar3)
    for value in ("NaN", "Infinity", "-Infinity", "1e999"):
        for key in ("gap", "shown"):
            text = json.dumps(content | {"provenance": content["provenance"] | {key: ["HERE"]}})
            door.write_text(text.replace('"HERE"', value))
            with case(value, key), pytest.raises(ConstraintMismatchError, match="c.json is damaged: .* finite number"):
                Constraint.load(door, planar3)
    for key in ("gap", "shown"):
        with pytest.raises(ValueError, match="float values|finite number"):
            Constraint(constraint.selection, constraint.features, {key: np.inf}).save(tmp_path / "none.json")
    assert not (tmp_path / "none.json").exists()
