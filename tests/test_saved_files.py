"""Files that the library writes: they know their robot, come back bit for bit, and are refused for any other robot."""

from __future__ import annotations

import dataclasses
import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from case import case
from recording_corpus import refusal

from manip_learn.cli import main
from manip_learn.constraint.constraint import Constraint
from manip_learn.constraint.features import CustomFeatures, FrameJacobian, MechanismRows
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
    parts = [
        JOINT.format(name=n, parent=links[i], child=links[i + 1], length=length if i else 0.0)
        for i, n in enumerate(joints)
    ]
    path.write_text(URDF.format(name=name, joints="".join(parts)), encoding="utf-8")
    return path


def rollout_of(robot: Robot, seconds: float = 0.5) -> Rollout:
    """A motion that moves every joint."""
    constraint = Constraint([[1.0, 0.0, 0.0]], FrameJacobian(robot, "tip"))
    controller = ResolvedRateController(constraint, Hold())
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


def wrong_robots(arms: Path) -> list[tuple[str, dict, str, dict]]:
    """(made with, locked; used with, locked): ten mistakes, each of which the same names could hide."""
    a, longer, renamed, joints = (str(arms / f"{n}.urdf") for n in ("arm", "longer", "renamed", "joints"))
    return [
        (a, {}, longer, {}),
        (longer, {}, a, {}),
        (a, {"j3": 1.2}, longer, {"j3": 1.2}),
        (a, {}, renamed, {}),
        (renamed, {"j1": 0.3}, a, {"j1": 0.3}),
        (a, {}, joints, {}),
        (a, {}, a, {"j2": None}),
        (a, {"j2": 1.2}, a, {}),
        (a, {"j2": 1.2}, a, {"j2": None}),
        (a, {"j2": 1.2}, a, {"j3": None}),
    ]


@pytest.mark.parametrize("case", range(10))
def test_no_file_is_used_with_another_robot_in_silence(
    case: int, arms: Path, tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    """Ten files, each with a robot or locked joints that are not its own: Python refuses to load, learn from or replay
    them and names both robots; the command line restores the locked joints, or refuses too.
    """
    made_with, locked, used_with, used_locked = wrong_robots(arms)[case]
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
    rollout = rollout_of(load_robot(arms / "arm.urdf"))
    with pytest.raises(OutputError, match=r"\.npz, \.csv, \.mcap"):
        rollout.save(tmp_path / "run.xyz")
    with pytest.raises(OutputError, match=r"JSON lines are not written any more; \.npz and \.csv"):
        rollout.save(tmp_path / "run.jsonl")
    motion = motion_of_trajectory(
        Trajectory(rollout.time, rollout.q, None, rollout.joint_names), load_robot(arms / "arm.urdf")
    )
    for name, content in {
        "run.mcap": rollout.save(tmp_path / "run.mcap").read_bytes(),
        "old.jsonl": b'{"format": "manip_learn.rollout", "schema": 2}\n',
        "run.yaml": joint_trajectory_bytes(motion),
    }.items():
        (tmp_path / name).write_bytes(content)
        with pytest.raises(RecordingError, match=r"\.npz and \.csv|\.npz or \.csv") as caught:
            Rollout.load(tmp_path / name)
        assert caught.value.code == "not-a-rollout"


def test_a_rollout_keeps_what_guided_it(robot_of) -> None:
    """Target, constraint and following error come back from every format; the constraint can be built again."""
    for suffix in FORMATS:
        with case(suffix) as tmp_path:
            robot = robot_of("sawyer")
            features = FrameJacobian(robot, "right_hand", "xyz")
            constraint = Constraint(
                [[0, 1, 0], [0, 0, 1]], features, {"kind": "motion-constrained", "phases": [["a", 0, 1, 0]]}
            )
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
            with pytest.raises(ConstraintMismatchError, match="the constraint was made for"):
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
