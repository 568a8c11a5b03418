"""Files that the library writes: they know their robot, come back bit for bit, are what other programs' readers read
again, and are refused for any other robot.
"""

from __future__ import annotations

import json
import random
import re
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from case import case, rows_in
from recording_corpus import TIME, Q, U, refusal
from recording_formats import pq, table

import manip_learn as ml
from manip_learn.cli import main
from manip_learn.constraint.features.frame_jacobian import FrameJacobian
from manip_learn.constraint.features.mechanism_rows import MechanismRows
from manip_learn.constraint.features.other_features import CustomFeatures
from manip_learn.control.rollout import Rollout, written_constraint
from manip_learn.errors import ConstraintMismatchError, OutputError, RecordingError, advice_for_command
from manip_learn.recordings.saved_motion import motion_of_trajectory
from manip_learn.recordings.writers.lerobot_writer import samples_per_second
from manip_learn.recordings.writers.write_motion import joint_trajectory_bytes, nanoseconds
from manip_learn.robot import Robot, load_robot
from manip_learn.robot.identity import RobotIdentity

FORMATS = pytest.mark.parametrize("suffix", ["npz", "csv"])
ARRAYS = ("time", "q", "u", "manipulability", "task_error")
# a planar arm; its name, its lengths and the names of its joints are what a mistake would confuse
JOINT = """<joint name="{}" type="revolute"><parent link="{}"/><child link="{}"/>
<origin xyz="{} 0 0"/><axis xyz="0 0 1"/><limit lower="-3" upper="3" velocity="2" effort="1"/></joint>"""


def arm(path: Path, name: str = "arm", length: float = 1.0, joints: tuple[str, ...] = ("j1", "j2", "j3")) -> Path:
    ends = zip(joints, ("base", "a", "b"), ("a", "b", "tip"), (0.0, length, length), strict=True)
    links = "".join(f'<link name="{link}"/>' for link in ("base", "a", "b", "tip"))
    path.write_text(f'<robot name="{name}">{links}{"".join(JOINT.format(*end) for end in ends)}</robot>')
    return path


def rollout_of(robot: Robot) -> Rollout:
    """A motion that moves every joint for half a second."""
    law = ml.ResolvedRateController(ml.Constraint([[1.0, 0.0, 0.0]], FrameJacobian(robot, "tip")), ml.Hold())
    made = ml.simulate(robot, law, np.full(robot.nv, 0.4), 0.5, 0.01)
    phase = made.time[:, None] + np.arange(robot.nv)
    error = np.where(made.time < 0.1, np.inf, 1.0 / (3.0 + made.time))
    error[5:8] = np.nan, -np.inf, -0.0
    return replace(made, q=0.4 + 0.1 * np.sin(phase) / 3.0, u=0.1 * np.cos(phase) / 3.0, task_error=error)


@pytest.fixture(scope="module")
def arms(tmp_path_factory) -> Path:
    """Four arms, and a folder of two recordings on the first, at odd times."""
    folder = tmp_path_factory.mktemp("arms")
    arm(folder / "arm.urdf")
    arm(folder / "longer.urdf", length=1.1)
    arm(folder / "renamed.urdf", name="other")
    arm(folder / "joints.urdf", joints=("j1", "j2", "wrist"))
    (folder / "demos").mkdir()
    for k in range(2):
        t = 5.0 + 2.5 * k + np.arange(40) * 0.01 + 1e-9 * (np.arange(40) % 3)
        q = np.column_stack([np.sin(t + k), np.cos(t), 0.3 * t])
        u = np.column_stack([np.cos(t + k), -np.sin(t), 0.3 + 0.0 * t])
        names = ",".join(f"j{j}{of}" for of in ("", "_velocity", "_effort") for j in (1, 2, 3))
        table(f"time,{names}", t, q, u, q / 3.0, name=f"demo_{k}.csv")(folder / "demos")
    return folder


@pytest.fixture(scope="module")
def robot(arms: Path) -> Robot:
    return load_robot(arms / "arm.urdf")


# ---- rollouts
@FORMATS
def test_a_rollout_comes_back_bit_for_bit(suffix: str, arms: Path, tmp_path: Path) -> None:
    """Every array, NaN and infinity, word, name, frame and the robot, in each format; as a demonstration too."""
    robot = load_robot(arms / "arm.urdf", locked={"j2": 1.2})
    rollout = rollout_of(robot)
    path = shutil.copy(rollout.save(tmp_path / f"run.{suffix}"), tmp_path / "a b.txt")  # the content says the format
    for loaded in (Rollout.load(path), Rollout.load(path, robot)):
        for name in ARRAYS:
            assert getattr(loaded, name).tobytes() == getattr(rollout, name).tobytes()
        assert (loaded.status, loaded.joint_names, loaded.frame) == (rollout.status, rollout.joint_names, "tip")
        assert loaded.robot == RobotIdentity.of(robot) and loaded.robot.locked == {"j2": 1.2}
    demos = ml.load_demonstrations(path, robot)
    assert demos.notes == ()
    for name in ("time", "q", "u"):
        assert getattr(demos[0], name).tobytes() == getattr(rollout, name).tobytes()


def test_a_rollout_can_be_learnt_from_again(planar3: Robot, robot_of, tmp_path: Path) -> None:
    """The same motion, limits are not used to doubt our own units; continuous joints as (cos, sin) become angles."""
    rollout = Rollout(TIME, Q * 10.0, U * 10.0, TIME, ("ok",) * 60, planar3.joint_names, TIME)
    path = rollout.save(tmp_path / "r.npz")
    demos = ml.load_demonstrations(path, planar3)
    assert refusal(path, planar3, units="degrees").code == "units"
    assert any("beyond their limits" in note for note in demos.notes)
    wrist = robot_of("wrist")
    positions = np.column_stack([3.0 + TIME, 0.1 * TIME, 6.0 * TIME, 0.2 * TIME])
    q, u = np.array([wrist.configuration(p) for p in positions]), np.gradient(positions, TIME, axis=0)
    turning = Rollout(TIME, q, u, TIME, ("ok",) * 60, wrist.joint_names, TIME).save(tmp_path / "r.npz")
    demos = ml.load_demonstrations(turning, wrist)
    np.testing.assert_allclose(demos[0].q, positions, rtol=0, atol=1e-9)
    assert "full turns added" in " ".join(demos.notes)


# (made with, locked; used with, locked): mistakes, each of which the same names could hide
WRONG_ROBOTS: list[tuple[str, dict, str, dict]] = [
    ("arm", {}, "longer", {}),
    ("renamed", {"j1": 0.3}, "arm", {"j1": 0.3}),
    ("arm", {}, "joints", {}),
    ("arm", {}, "arm", {"j2": None}),
    ("arm", {"j2": 1.2}, "arm", {}),
]


@pytest.mark.parametrize("number", range(5))
def test_no_file_is_used_with_another_robot_in_silence(number: int, arms: Path, tmp_path: Path, capsys) -> None:
    """Files, each with a robot or locked joints that are not its own: Python refuses to load, learn from or replay
    them and names both robots; the command line restores the locked joints, and says so, or refuses too.
    """
    made_with, locked, used_with, used_locked = WRONG_ROBOTS[number]
    made_with, used_with = (str(arms / f"{name}.urdf") for name in (made_with, used_with))
    own, other = load_robot(made_with, locked=locked), load_robot(used_with, locked=used_locked)
    page, path = tmp_path / "page.html", rollout_of(own).save(tmp_path / ("run.npz", "run.csv")[number % 2])
    for use in (
        lambda: Rollout.load(path, other),
        lambda: ml.load_demonstrations(path, other),
        lambda: ml.replay(other, {"a": Rollout.load(path)}, page, open_browser=False),
    ):
        with pytest.raises(RecordingError, match=repr(own.name)) as caught:
            use()
        assert caught.value.code == "other-robot" and repr(other.name) in str(caught.value)
    locks = [x for joint in used_locked for x in ("--lock", joint)]
    silent = {name: at for name, at in locked.items() if name not in used_locked}  # what the file alone has locked
    for command in (
        ["replay", used_with, str(path), "--html", str(page), *locks],
        ["learn", used_with, str(path), "--frame", "tip", "--axes", "x", *locks],
    ):
        code, said = main(command), capsys.readouterr()
        if made_with == used_with and not set(used_locked) - set(locked):
            assert command[0] == "learn" or code == 0
            notes = [f"{name} = {at:.4g}" for name, at in silent.items()] if code == 0 else []
            assert all(note in " ".join(said.out.split()) for note in notes)
        else:
            assert code == 2 and repr(own.name) in said.err and "was made with robot" in said.err and not page.exists()


def test_files_without_a_robot(robot: Robot, arms: Path, tmp_path: Path) -> None:
    """A rollout that was made without one loads with a warning; an archive of an early version is refused."""
    unknown = replace(rollout_of(robot), robot=None).save(tmp_path / "unknown.npz")
    with pytest.warns(UserWarning, match="which robot"):
        assert Rollout.load(unknown, robot).robot is None
    with pytest.raises(RecordingError, match="wrist"):
        Rollout.load(unknown, load_robot(arms / "joints.urdf"))
    np.savez(tmp_path / "old.npz", format="manip_learn.rollout", joint_names=robot.joint_names, time=TIME, q=Q, u=U)
    for read in (Rollout.load, ml.load_demonstrations):
        with pytest.raises(RecordingError, match="early version wrote this file") as caught:
            read(tmp_path / "old.npz", robot)
        assert caught.value.code == "not-a-rollout"


def test_another_ending_is_refused(robot: Robot, tmp_path: Path) -> None:
    """An unknown ending, or that of a removed format, is refused with a list of the formats; a bag, which is written,
    is not read as a rollout.
    """
    rollout = rollout_of(robot)
    for name, words in (("run.xyz", r"\.npz, \.csv, \.mcap"), ("run.jsonl", "JSON lines are not written any more")):
        with pytest.raises(OutputError, match=words):
            rollout.save(tmp_path / name)
    with pytest.raises(RecordingError, match=r"\.npz and \.csv|\.npz or \.csv"):
        Rollout.load(rollout.save(tmp_path / "run.mcap"))


@FORMATS
def test_a_rollout_keeps_what_guided_it(suffix: str, robot_of, tmp_path: Path) -> None:
    """Target, constraint and following error come back from every format; the constraint can be built again."""
    robot = robot_of("sawyer")
    constraint = ml.Constraint(np.eye(3)[1:], FrameJacobian(robot, "right_hand", "xyz"), {"kind": "motion-constrained"})
    law = ml.ResolvedRateController(constraint, ml.PointAttractor([0.6, 0.2, 0.4]))
    rollout = ml.simulate(robot, ml.ServoLoop(law, 0.01), robot.neutral(), 0.05, 0.01)
    slipping = replace(rollout, following_error=np.linspace(0.0, 0.1, len(rollout)))
    loaded = Rollout.load(slipping.save(tmp_path / f"run.{suffix}"), robot)
    assert loaded.target is not None and loaded.target.tolist() == [0.6, 0.2, 0.4] and loaded.constraint is not None
    np.testing.assert_array_equal(loaded.following_error, slipping.following_error)
    np.testing.assert_array_equal(ml.Constraint.from_dict(loaded.constraint, robot).selection, constraint.selection)
    with pytest.raises(ConstraintMismatchError, match="the constraint: it was made with"):
        ml.Constraint.from_dict(loaded.constraint, robot_of("planar3"))


def test_a_task_says_where_it_ends(robot_of) -> None:
    """A door's motion ends at its start turned by the way; features that cannot be written leave none."""
    robot, start = robot_of("sawyer"), np.array([0.1, -0.8, 0.2, 1.5, 0.1, 0.6, 0.3])
    hinge = MechanismRows(robot, "right_hand", "radial axial", axis=(0, 0, 1), point=(0.2, 0.0, 0.0))
    door = ml.Constraint(np.eye(2), hinge)
    law = ml.ResolvedRateController(door, ml.FreeDirection(door, 0.3, 0.5))
    turned = ml.simulate(robot, law, start, 3.0, 0.01)
    end = robot.position(turned.q[-1], "right_hand")
    np.testing.assert_allclose(np.asarray(turned.target)[:3, 3], end, atol=2e-3)
    assert written_constraint(ml.Constraint([[1.0]], CustomFeatures(lambda q: q[None, :], ("a",), 1))) is None


# ---- constraints
OF_02 = Path(__file__).parent / "data" / "constraint_of_02.json"  # schema 1, as 0.2 wrote it: a skill on planar3
# posture -> A(q) of that file, by the version that wrote it
ROWS_OF_02 = {
    (0.3, 0.8, 0.4): [[0.32847378654766984, -0.803410653365245, -0.7212260045251858]],
    (-1.0, 0.2, 2.0): [[-0.5583179243138446, -0.9469386042794726, -1.1110070587637821]],
}


def rewritten(value: Any) -> Any:
    """JSON as another program writes it again: whole numbers without a point, -0 for 0, keys in another order."""
    if isinstance(value, dict):
        return {key: rewritten(value[key]) for key in random.Random(0).sample(sorted(value), len(value))}
    if isinstance(value, list):
        return [rewritten(inner) for inner in value]
    whole = isinstance(value, float) and value.is_integer()
    return value if not whole else int(value) if value else -0.0


@pytest.fixture
def door(planar3: Robot, tmp_path: Path) -> Path:
    """Write a constraint file of format 2, with the steps of a skill, whole numbers and keys that are not sorted."""
    provenance = json.loads(OF_02.read_text())["provenance"] | {"kept": {"z": -0.0, "a": [1.0, 1e-7]}}
    rows = MechanismRows(planar3, "tip", "radial axial", axis=(0, 0, 1), point=(0.4, 0.3, 0.0), radius=1.25)
    constraint = ml.Constraint([[0.6, 0.8]], rows, provenance)
    way = ml.Step("way", constraint, constraint.shown, "close")
    return ml.Skill((constraint,), (ml.Step("reach", constraint), way)).save(tmp_path / "c.json")


def test_a_constraint_file_comes_back_if_another_program_wrote_it(planar3: Robot, door: Path, tmp_path: Path) -> None:
    """The same A to the last bit and the same steps, as it was written and as another program writes it again: 1 for
    1.0, -0.0, keys in another order. Files of format 2 and 1 alike; neither is called changed. A(q) of format 1 is what
    the version that wrote it computed; saved again it is a file of format 2 with the same A.
    """
    again = tmp_path / "again.json"
    for path, schema in ((door, 2), (OF_02, 1)):
        content = json.loads(path.read_text())
        assert content["schema"] == schema and len(content["sha256"]) == 64
        again.write_text(json.dumps(rewritten(content), indent=7))
        first, other = ml.Constraint.load(path, planar3), ml.Constraint.load(again, planar3)
        assert first.notes == other.notes == ()
        for q in ROWS_OF_02:
            np.testing.assert_array_equal(other(q), first(q))
        steps = ml.Skill.load(again, planar3).steps
        assert [(step.kind, step.gripper) for step in steps] == [("reach", None), ("way", "close")]
    old = ml.Constraint.load(OF_02, planar3, same_urdf=False)
    new = ml.Constraint.load(old.save(again), planar3)
    for q, rows in ROWS_OF_02.items():
        np.testing.assert_allclose(old(q), rows, rtol=0, atol=1e-14)
        np.testing.assert_array_equal(new(q), old(q))
    assert json.loads(again.read_text())["schema"] == 2 and new.provenance == old.provenance


@pytest.mark.parametrize("old", [False, True])
def test_what_was_changed_in_a_constraint_file_is_refused(old: bool, planar3: Robot, door: Path) -> None:
    """In features, what was shown and the steps of a skill, in either format; not in what is only reported. A number of
    the format that is not known has a way out; NaN and infinity are refused wherever they stand, and are not written.
    """
    text, constraint = (OF_02 if old else door).read_text(), ml.Constraint.load(OF_02 if old else door, planar3)

    def change(key: str, value: str) -> None:
        content = inner = json.loads(text)
        *keys, last = key.split(".")
        for step in keys:
            inner = inner[step]
        inner[last] = "VALUE"
        door.write_text(json.dumps(content).replace('"VALUE"', value))

    for key, value, words in rows_in("changed_constraints.txt"):
        change(key, value)
        with case(key, value), pytest.raises(ConstraintMismatchError, match=words):
            ml.Constraint.load(door, planar3)
    change("provenance.sentence", '"another one"')
    assert ml.Constraint.load(door, planar3).provenance["sentence"] == "another one"
    with pytest.raises(ValueError, match="float values|finite number"):
        ml.Constraint(constraint.selection, constraint.features, {"gap": np.inf}).save(door)


# ---- which robot
def test_an_identity_is_kept_in_json(arms: Path) -> None:
    """An identity comes back from JSON; a damaged one is refused with what is wrong."""
    identity = RobotIdentity.of(load_robot(arms / "arm.urdf", locked={"j2": 0.1}, objects=("box",)))
    words = json.loads(json.dumps(identity.to_dict()))
    assert RobotIdentity.from_dict(words) == identity
    assert RobotIdentity.from_dict({k: v for k, v in words.items() if k not in ("locked", "objects")}).locked == {}
    for sentence, change in rows_in("damaged_identities.txt"):
        with case(sentence), pytest.raises(ValueError, match=sentence):
            RobotIdentity.from_dict(words | json.loads(change))


def test_what_differs_is_said(arms: Path, robot: Robot) -> None:
    """Locks and objects are named; otherwise the description has changed."""
    arm = arms / "arm.urdf"
    plain, held = RobotIdentity.of(robot), RobotIdentity.of(load_robot(arm, locked={"j2": 0.5}))
    plain.refuse_another(robot, "run.npz")
    assert plain.differences(load_robot(arms / "longer.urdf"))[0].startswith("the description has changed")
    assert held.differences(load_robot(arm, locked={"j2": 1.2})) == ("'j2' is locked at 0.5, not locked at 1.2",)
    with pytest.raises(RecordingError, match="'j2' is locked at 0.5, not free.*locked={'j2': 0.5}") as caught:
        held.refuse_another(robot, "run.npz", Path("some/run.npz"))
    assert (caught.value.code, caught.value.path) == ("other-robot", Path("some/run.npz"))
    with advice_for_command(["--lock"]), pytest.raises(RecordingError, match="are locked without --lock"):
        held.refuse_another(robot, "run.npz")
    assert "its objects are none, not box" in plain.differences(load_robot(arm, objects="box"))


# ---- exports
@pytest.mark.parametrize("to", ["mcap", "csv", "lerobot"])
def test_recordings_come_back(to: str, arms: Path, robot: Robot, tmp_path: Path, capsys) -> None:
    """Positions, velocities and efforts bit for bit in each format; times too, or to the nanosecond where the format
    has those. Another robot is refused.
    """
    out = tmp_path / "out"
    words = ["export", str(arms / "arm.urdf"), str(arms / "demos"), "--out", str(out), "--to", to, "--json"]
    assert main(words) == 0
    answer = json.loads(capsys.readouterr().out)
    assert (answer["format"], answer["trajectories"], answer["samples"]) == (to, 2, 80)
    before, after = ml.load_demonstrations(arms / "demos", robot), ml.load_demonstrations(out, robot)
    for a, b in zip(before, after, strict=True):
        for name in ("q", "u", "effort"):
            assert getattr(a, name).tobytes() == getattr(b, name).tobytes()
        start = 0.0 if to == "csv" else a.time[0]  # the others count from the first sample
        assert to == "mcap" or (a.time - start).tobytes() == b.time.tobytes()
        np.testing.assert_array_equal(np.rint(1e9 * (a.time - start)), np.rint(1e9 * b.time))
    if to != "mcap":  # which is read as the bag of any robot with these joints
        assert refusal(out, load_robot(arms / "longer.urdf"), match="'arm'").code == "other-robot"


@pytest.fixture(scope="module")
def sawyer_run(robot_of) -> Rollout:
    """A rollout of an arm with limits."""
    robot = robot_of("sawyer")
    constraint = ml.Constraint([[0.0, 0.0, 1.0]], FrameJacobian(robot, "right_hand", "xyz"))
    law = ml.ResolvedRateController(constraint, ml.PointAttractor([0.5, 0.3, 0.3]))
    return ml.simulate(robot, law, [0.1, -0.8, 0.2, 1.4, 0.1, 0.9, 0.3], 3.0, 0.01)


def moved(sample: int, joint: int, by: float) -> Callable[[Rollout], Rollout]:
    def change(run: Rollout) -> Rollout:
        q = run.q.copy()
        q[sample, joint] += by
        return replace(run, q=q)

    return change


# what happens to a rollout -> what the command says: joint, moment, and both figures
NO_ARM_DID: dict[str, tuple[Callable[[Rollout], Rollout], str]] = {
    "a posture of 1e9 rad": (moved(10, 2, 1e9), r"sample 10, column 'right_j2': 1e\+09 .*limits \[-3.04"),
    "a jump": (moved(20, 1, 0.5), "sample 20, column 'right_j1': the joint jumps .* its limit is 1.33"),
    "two joints exchanged": (lambda r: replace(r, q=r.q[:, [2, 1, 0, 3, 4, 5, 6]]), "has moved by .* velocities give"),
    "velocities of a tenth": (lambda r: replace(r, u=0.1 * r.u), "has moved by .* its velocities give"),
}


@pytest.mark.parametrize("what", NO_ARM_DID)
def test_what_no_arm_can_have_done_is_not_written(what: str, sawyer_run: Rollout, tmp_path: Path, capsys) -> None:
    """A damaged rollout is refused with joint, moment and both figures, and nothing is written for the arm."""
    change, words = NO_ARM_DID[what]
    run, out = change(sawyer_run).save(tmp_path / "run.npz"), tmp_path / "out.yaml"
    assert main(["export", "sawyer", str(run), "--out", str(out)]) == 2
    assert re.search(words, capsys.readouterr().err) and not out.exists()


def test_what_an_arm_did_is_written(sawyer_run: Rollout, robot_of, tmp_path: Path) -> None:
    """From outside the limits, in long steps; measured far behind its commands, and led by hand while nothing was
    commanded.
    """
    robot, run = robot_of("sawyer"), sawyer_run
    law = ml.ResolvedRateController(ml.Constraint([[0.0, 0.0, 1.0]], FrameJacobian(robot, "right_hand", "xyz")))
    behind = run.q[np.maximum(np.arange(301) - 30, 0)]
    by_hand = run.q[-1] + np.linspace(0.0, 0.5, 301)[:, None] * np.eye(7)[1]
    for done in (
        ml.simulate(robot, law, [robot.position_upper[0] + 0.6, *run.q[0, 1:]], 1.0, 0.01),
        ml.simulate(robot, law, run.q[0], 3.0, 0.25),
        replace(run, q=behind, following_error=np.abs(run.q - behind).max(axis=1)),
        replace(run, q=by_hand, u=0.0 * run.u),
    ):
        path = done.save(tmp_path / "run.npz")
        assert main(["export", "sawyer", str(path), "--out", str(tmp_path / "out.csv")]) == 0


def test_a_trajectory_is_yaml_for_ros(robot: Robot) -> None:
    """As `ros2 topic pub` reads it: the fields of JointTrajectory, every number one in YAML 1.1, increasing times."""
    yaml = pytest.importorskip("ruamel.yaml", reason="the extra 'ros' is not installed").YAML(typ="safe", pure=True)
    yaml.version = (1, 1)
    time = np.array([3.0, 3.1, 3.25])
    q = np.array([[1e-5, 1e22, -0.0], [1.0, 2.5e-300, 0.1], [0.2, 0.3, 1.0 / 3.0]])
    motion = motion_of_trajectory(ml.Trajectory(time, q, -q, robot.joint_names, effort=q), robot)
    assert b"effort" not in joint_trajectory_bytes(motion)  # what was measured in contact is no command
    message = yaml.load(joint_trajectory_bytes(motion).decode())
    assert set(message) == {"header", "joint_names", "points"}
    assert message["joint_names"] == list(robot.joint_names)
    assert np.array([p["positions"] for p in message["points"]], dtype=float).tobytes() == q.tobytes()
    assert all(isinstance(x, float) for p in message["points"] for x in p["positions"] + p["velocities"])
    starts = [(p["time_from_start"]["sec"], p["time_from_start"]["nanosec"]) for p in message["points"]]
    assert starts == [(0, 0), (0, 100_000_000), (0, 250_000_000)]


def test_lerobot_metadata(arms: Path, tmp_path: Path) -> None:
    """The files of a v3.0 data set, and numbers in them that agree with the samples."""
    out = tmp_path / "set"
    assert main(["export", str(arms / "arm.urdf"), str(arms / "demos"), "--out", str(out)]) == 0
    info, stats = (json.loads((out / "meta" / f"{name}.json").read_text()) for name in ("info", "stats"))
    assert (info["codebase_version"], info["fps"], info["total_episodes"], info["total_frames"]) == ("v3.0", 100, 2, 80)
    written = pq.read_table(out / info["data_path"].format(chunk_index=0, file_index=0))
    assert set(written.column_names) == set(info["features"]) == set(stats)
    episodes = pq.read_table(out / "meta/episodes/chunk-000/file-000.parquet").to_pydict()
    assert (episodes["dataset_from_index"], episodes["dataset_to_index"]) == ([0, 40], [40, 80])
    states = np.array(written.column("observation.state").to_pylist())
    for name in ("mean", "std", "min", "max"):
        np.testing.assert_allclose(stats["observation.state"][name], getattr(states, name)(axis=0), rtol=1e-12)
    np.testing.assert_array_equal(written.column("episode_index").to_numpy(), np.repeat([0, 1], 40))
    for rate, said in ((30.02, 30), (30.05, 30.05)):
        slower = np.cumsum(np.full((2, 40), 1.0 / rate), axis=1)
        slower[0][20:] += 5.0  # a pause does not count
        assert samples_per_second([*slower]) == pytest.approx(said, rel=1e-9)


def test_stamps_are_whole_nanoseconds() -> None:
    """From zero, or from the first sample where a stamp could not hold that; what cannot be told apart is refused."""
    assert nanoseconds(np.array([3.0, 3.5]), from_first=True).tolist() == [0, 500_000_000]
    for time, expected in (
        ([3.0, 3.5], [3_000_000_000, 3_500_000_000]),
        ([-1.0, 0.5], [0, 1_500_000_000]),
        ([2.0**31, 2.0**31 + 0.5], [0, 500_000_000]),
        ([0.0, 0.6e-9], [0, 1]),
    ):
        assert nanoseconds(np.array(time), from_first=False).tolist() == expected
    for time in ([0.0, 0.4e-9], [0.0, np.nan], [0.0, 2.0**31], [1.0, 0.5]):
        with case(time), pytest.raises(OutputError):
            nanoseconds(np.array(time), from_first=False)
