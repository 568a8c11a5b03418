"""Objects whose pose is recorded: floating joints of a robot, their twists, and constraints relative to them."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from case import case
from numpy.testing import assert_allclose, assert_array_equal
from scipy.spatial.transform import Rotation

import manip_learn as ml
from manip_learn.cli import main
from manip_learn.constraint.place import across
from manip_learn.errors import ConstraintMismatchError, RecordingError, RobotError
from manip_learn.robot.tips import default_tip

BOX = ("box.x", "box.y", "box.z", "box.rx", "box.ry", "box.rz")
QUATERNION = ["box.qx", "box.qy", "box.qz", "box.qw"]
TIP = "right_gripper_tip"


@pytest.fixture(scope="module")
def robot() -> ml.Robot:
    return ml.load_robot("sawyer", objects=("box",))


def columns_of(robot: ml.Robot, names=BOX) -> list[int]:
    """Where joints are."""
    return [robot.joint_names.index(n) for n in names]


def smooth(rng: np.random.Generator, time: np.ndarray, n: int, size: float) -> np.ndarray:
    """Sums of three sinusoids, shape (T, n)."""
    w, phase = rng.uniform(0.5, 3.0, (3, n)), rng.uniform(0, 2 * np.pi, (3, n))
    return size * np.sum(np.sin(w * time[:, None, None] + phase), axis=1) / 3.0


def test_an_object_is_a_floating_joint_on_the_root_link(robot: ml.Robot) -> None:
    """Six more coordinates without limits, no tip; the pose of its frame is what the six numbers say. Empty, taken,
    repeated or reserved names are refused.
    """
    plain, columns = ml.load_robot("sawyer"), columns_of(robot)
    assert robot.objects == ("box",) and plain.objects == ()
    assert robot.nv == plain.nv + 6 and set(robot.joint_names) == {*plain.joint_names, *BOX}
    for limit in (robot.position_lower, robot.position_upper, robot.velocity_limit):
        assert np.all(np.isinf(limit[columns]))
    assert ml.likely_tips(robot) == ml.likely_tips(plain) and default_tip(robot) == default_tip(plain)
    x = np.zeros(robot.nv)
    x[columns] = 0.4, -0.2, 0.3, 0.1, 0.7, -0.5
    pose = robot.pose(x, "box")
    assert_allclose(pose[:3, 3], x[columns][:3], atol=1e-12)
    assert_allclose(pose[:3, :3], Rotation.from_rotvec(x[columns][3:]).as_matrix(), atol=1e-12)
    for names in [("",), ("right_l6",), ("right_j0",), ("a", "a"), (" a",), ("universe",), (3,)]:
        with case(names), pytest.raises(RobotError) as caught:
            ml.load_robot("sawyer", objects=names)
        assert caught.value.code == "object-name"


def test_a_constraint_knows_its_objects(robot: ml.Robot, tmp_path: Path) -> None:
    """Saved and loaded with the same objects; refused without them, or with others."""
    features, plain = ml.RelativeFrameJacobian(robot, TIP, "box"), ml.load_robot("sawyer")
    file = ml.Constraint(np.eye(6)[:5], features).save(tmp_path / "c.json")
    assert json.loads(file.read_text())["robot"]["objects"] == ["box"]
    q, same = robot.random_configuration(np.random.default_rng(0)), ml.load_robot("sawyer", objects=["box"])
    assert_array_equal(ml.Constraint.load(file, same)(q), features(q)[:5])
    assert same.fingerprint == robot.fingerprint != plain.fingerprint
    for objects in ((), ("cup",), ("box", "cup")):
        with pytest.raises(ConstraintMismatchError):
            ml.Constraint.load(file, ml.load_robot("sawyer", objects=objects))


def write(path: Path, names: list[str], columns: np.ndarray, time: np.ndarray) -> Path:
    np.savetxt(path, np.column_stack([time, columns]), delimiter=",", header=",".join(["time", *names]), comments="")
    return path


def test_poses_are_read_as_rotation_vectors_or_quaternions(robot: ml.Robot, tmp_path: Path) -> None:
    """Both spellings give the same poses; a quaternion that changes its sign, and half a turn, leave no jump. A pose is
    in metres and radians whatever the joints are in. An arm records velocities, a camera does not: all are derived
    alike, and it is said.
    """
    time, columns, names = np.arange(200) * 0.01, columns_of(robot), list(robot.joint_names)
    x = smooth(np.random.default_rng(2), time, robot.nv, 0.3)
    x[:, columns[3:]] = np.linspace(0.5, 5.0, 200)[:, None] * [0.0, 0.6, 0.8]
    rotations = Rotation.from_rotvec(x[:, columns[3:]])
    wrapped = x.copy()
    wrapped[:, columns[3:]] = rotations.as_rotvec()
    quaternions = rotations.as_quat(canonical=True)
    others = [i for i in range(robot.nv) if i not in columns[3:]]
    arm = [i for i in range(robot.nv) if i not in columns]
    spelt = [*(names[i] for i in others), *QUATERNION]
    in_degrees = np.hstack([x[:, others[:3]], np.degrees(x[:, others[3:]]), quaternions])  # the first three are lengths
    said = {}
    for name, headed, table, options in (
        ("vectors", names, wrapped, {}),
        ("quaternions", spelt, np.hstack([x[:, others], quaternions]), {}),
        ("degrees", spelt, in_degrees, {"degrees": True}),
    ):
        demos = ml.load_demonstrations(write(tmp_path / f"{name}.csv", headed, table, time), robot, **options)
        assert np.max(np.abs(np.diff(demos[0].q, axis=0))) < 0.1
        ours = Rotation.from_rotvec(demos[0].q[:, columns[3:]])
        assert np.max((ours.inv() * rotations).magnitude()) < 1e-9
        assert_allclose(demos[0].q[:, others], x[:, others], atol=1e-12)
        said[name] = demos.notes
    assert any("quaternions" in note for note in said["quaternions"])
    headed = [*names, *(f"{names[i]}_velocity" for i in arm)]
    file = write(tmp_path / "v.csv", headed, np.hstack([wrapped, 0.1 * wrapped[:, arm]]), time)
    demos = ml.load_demonstrations(file, robot)
    assert demos[0].u is None and any("recorded velocities are not used" in note for note in demos.notes)


def test_poses_that_cannot_be_read(robot: ml.Robot, tmp_path: Path) -> None:
    """No pose, part of a quaternion, one that is not of length 1: each says what is needed."""
    time, joints = np.arange(50) * 0.01, [n for n in robot.joint_names if n not in BOX]
    arm, pose = smooth(np.random.default_rng(3), time, len(joints), 0.3), np.array([0.1, 0.2, 0.3, 0.0, 0.0, 0.0, 1.0])
    spelt = [*joints, *BOX[:3], *QUATERNION]

    def read(names: list[str], w: float) -> ml.Demonstrations:
        table = np.hstack([arm, np.tile(pose * [1, 1, 1, 1, 1, 1, w], (50, 1))])[:, : len(names)]
        return ml.load_demonstrations(write(tmp_path / "a.csv", names, table, time), robot)

    assert len(read(spelt, 0.96)) == 1
    for code, names, w, words in (
        ("missing-object", joints, 1.0, "box"),
        ("partial-quaternion", spelt[:-1], 1.0, "without 'box.qw'"),
        ("quaternion", spelt, 0.94, "box"),
    ):
        with pytest.raises(RecordingError, match=words) as caught:
            read(names, w)
        assert caught.value.code == code and "box" in str(caught.value)


AXIS = np.array([0.3, -0.2, 0.9]) / np.linalg.norm([0.3, -0.2, 0.9])


def on_mechanism(features: ml.MechanismRows, rng: np.random.Generator, n: int = 6) -> list[ml.Trajectory]:
    """Recordings with 0.1 mrad of noise in which loosely held rows stay as they are; all else moves as it likes."""
    robot, out, kept, time = features.robot, [], None, np.arange(250) * 0.02
    for k in range(n):
        push, path = smooth(rng, time, robot.nv, 0.5), []
        q = robot.configuration(0.5 * robot.positions(robot.random_configuration(rng)))
        kept = features.coordinates(q) if kept is None else kept
        for i in range(-60, len(time)):  # at first it goes to the mechanism
            for _ in range(2):
                q = robot.integrate(q, np.linalg.pinv(features(q)) @ (kept - features.coordinates(q)))
            if i >= 0:
                path.append(robot.positions(robot.integrate(q, 1e-4 * rng.standard_normal(robot.nv))))
                A = features(robot.integrate(q, 0.01 * push[i]))
                q = robot.integrate(q, 0.02 * (push[i] - np.linalg.pinv(A) @ (A @ push[i])))
        out.append(ml.Trajectory(time, np.array(path), None, robot.joint_names, f"motion {k}"))
    return out


@pytest.mark.parametrize(("rows", "kind"), [("radial axial", "hinge"), ("spherical", "ball")])
def test_a_mechanism_is_found_where_its_frame_sees_it(robot: ml.Robot, rows: str, kind: str, tmp_path: Path) -> None:
    """A door or a tether that is carried about: its kind, axis and place in the other frame, whatever the axes.

    What is learnt can be saved, driven, and says in which frame it is.
    """
    seen, rng = ml.RelativeFrameJacobian(robot, TIP, "box", "xyz"), np.random.default_rng(3)
    q = robot.configuration(0.3 * robot.positions(robot.random_configuration(rng)))
    beside = np.cross(AXIS, [1.0, 0.0, 0.0])
    point = seen.pose(q)[:3, 3] - 0.25 * beside / np.linalg.norm(beside)
    truth = ml.MechanismRows(robot, TIP, rows, axis=AXIS, point=point, relative_to="box")
    demos = on_mechanism(truth, rng)
    found = ml.ConstraintLearner(seen).fit(demos).constraint_
    mechanism = found.mechanism
    assert mechanism is not None and (mechanism.type, mechanism.relative_to) == (kind, "box")
    assert mechanism.point is not None and "in 'box'" in mechanism.sentence
    off = mechanism.point - point
    if mechanism.axis is not None:
        assert np.degrees(np.arccos(min(1.0, abs(mechanism.axis @ AXIS)))) < 0.05
        off = off - (off @ AXIS) * AXIS
    assert np.linalg.norm(off) < 5e-4
    assert found.moved(np.diag([-1.0, -1.0, 1.0, 1.0])) is found  # the fixture is where the other frame is
    if kind != "hinge":
        return
    again = ml.Constraint.load(found.save(tmp_path / "door.json"), robot)
    task = ml.motion(again, turn=0.3)
    law, start = ml.ResolvedRateController(again, task), robot.configuration(demos[0].q[0])
    done = ml.simulate(robot, law, start, task.duration + 1.0, 0.01)
    (x, y), places = across(AXIS), [seen.pose(at)[:3, 3] - point for at in done.q[[0, -1]]]
    angles = [np.arctan2(y @ d, x @ d) for d in places]
    assert abs((angles[1] - angles[0] + np.pi) % (2.0 * np.pi) - np.pi) == pytest.approx(0.3, abs=2e-3)
    assert_allclose(truth.coordinates(done.q[-1]), truth.coordinates(done.q[0]), atol=1e-4)


def test_command_line(robot: ml.Robot, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Learn relative to a recorded object, audit by it, inspect; the file names its objects, another one is refused."""
    folder = tmp_path / "recordings"
    folder.mkdir()
    tether = ml.MechanismRows(robot, TIP, "spherical", point=(0.3, 0.1, 0.2), relative_to="box")
    for i, t in enumerate(on_mechanism(tether, np.random.default_rng(7), 4)):
        write(folder / f"demo_{i}.csv", list(t.joint_names), t.q, t.time)
    file, box = str(tmp_path / "held.json"), ("--object", "box")
    learn = ("learn", str(folder), *box, "--frame", TIP, "--relative-to", "box", "--axes", "xyz")
    for (name, *words), key, value in (
        ((*learn, "--estimator", "null-space", "--out", file), "n_constraints", 1),
        (("audit", file, str(folder)), "n_episodes", 4),
        (("inspect", *box), "nv", robot.nv),
        (("replay", str(folder / "demo_0.csv"), *box, "--html", str(tmp_path / "r.html")), None, None),
    ):
        assert main([name, "sawyer", *words, "--json"]) == 0
        answer = json.loads(capsys.readouterr().out)
        assert key is None or answer[key] == value
    assert main(["audit", "sawyer", file, str(folder), "--object", "cup"]) == 2
    assert "'cup'" in capsys.readouterr().err
