"""What is written for other programs means there what it means here, whatever the names of links and joints."""

from __future__ import annotations

import math
import re
from functools import partial
from typing import Any
from xml.sax.saxutils import quoteattr

import numpy as np
import pytest
from case import case
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

import manip_learn as ml
from manip_learn.constraint.features.mechanism_rows import MechanismRows
from manip_learn.control.interop.force_control import force_mode, urscript
from manip_learn.recordings.saved_motion import motion_of_trajectory
from manip_learn.recordings.writers.write_motion import write_motion

# words that run, end a line, or turn into numbers where they are pasted into a program or a table
EVIL = "2e5 tip'\" : {no}] # \\ end"
JOINTS = ("no", "1e5", "~", "a 'b\"", "2e3: x", "off")


@pytest.fixture(scope="module")
def robot(tmp_path_factory) -> ml.Robot:
    """A UR5 apart from the root, and a hand apart from its flange; all names as nobody should choose."""
    ur5 = ml.load_robot("ur5")
    assert ur5.source is not None
    text = ur5.source.read_text(encoding="utf-8").replace('<robot name="ur5"', f"<robot name={quoteattr(EVIL)}")
    for name, hostile in zip(ur5.joint_names, JOINTS, strict=True):
        text = text.replace(f'"{name}"', quoteattr(hostile))
    placed = '<child link="base_link"/><origin xyz="0.1 -0.2 0.3" rpy="0 0 0.7"/>'
    text, number = re.subn(r'<child link="base_link"/>\s*<origin[^>]*/>', placed, text)
    assert number == 1
    hand = (
        f'<link name={quoteattr(EVIL)}/><joint name="hand" type="fixed"><parent link="tool0"/>'
        f'<child link={quoteattr(EVIL)}/><origin xyz="0.03 0.02 0.11" rpy="0.2 0.3 -0.4"/></joint></robot>'
    )
    path = tmp_path_factory.mktemp("hostile") / "arm.urdf"
    path.write_text(text.replace("</robot>", hand), encoding="utf-8")
    return ml.load_robot(path)


def postures(robot: ml.Robot, n: int) -> np.ndarray:
    rng = np.random.default_rng(11)
    return np.array([0.4 * robot.random_configuration(rng) + 0.3 for _ in range(n)])


def matrix(pose: ArrayLike) -> np.ndarray:
    """Position and rotation vector -> homogeneous matrix."""
    out, numbers = np.eye(4), np.asarray(pose, dtype=float)
    out[:3, :3], out[:3, 3] = Rotation.from_rotvec(numbers[3:]).as_matrix(), numbers[:3]
    return out


def pose(T: np.ndarray) -> list[float]:
    """The reverse."""
    return [*T[:3, 3], *Rotation.from_matrix(T[:3, :3]).as_rotvec()]


class Poses:
    """`p[x, y, z, rx, ry, rz]` of URScript."""

    def __getitem__(self, numbers: tuple[float, ...]) -> list[float]:
        return list(map(float, numbers))


class Program:
    """An evaluator of those lines of URScript that compute poses: assignments, functions that return, no arm."""

    def __init__(self, text: str):
        self.lines = [line.split("#")[0].strip() for line in text.splitlines()]
        self.tcp, self.flange = np.eye(4), np.eye(4)
        self.variables: dict[str, Any] = {
            "p": Poses(),
            "pose_trans": lambda a, b: pose(matrix(a) @ matrix(b)),
            "pose_inv": lambda a: pose(np.linalg.inv(matrix(a))),
            "atan2": math.atan2,
            "get_actual_tcp_pose": lambda: pose(self.flange @ self.tcp),
        }
        for i, line in enumerate(self.lines):
            if match := re.fullmatch(r"def (\w+)\((\w+(?:, \w+)*)\):", line):
                body = self.lines[i + 1 : self.lines.index("end", i)]
                self.variables[match[1]] = partial(self.call, body, match[2].split(", "))
            elif match := re.fullmatch(r"set_tcp\((.*)\)", line):
                self.tcp = matrix(self.value(match[1]))
            elif match := re.fullmatch(r"global (\w+) = ([p\[].*)", line):
                self.variables[match[1]] = self.value(match[2])

    def value(self, text: str, local: dict[str, Any] | None = None) -> Any:
        return eval(text, self.variables | (local or {}))

    def call(self, body: list[str], names: list[str], *arguments: Any) -> Any:
        local = dict(zip(names, arguments, strict=True))
        for line in body:
            name, _, text = line.partition(" = ")
            if line.startswith("return "):
                return self.value(line.removeprefix("return "), local)
            local[name] = self.value(text, local)
        raise AssertionError(f"no return in {body}")

    @property
    def force_frame(self) -> np.ndarray:
        (called,) = (line for line in self.lines if line.startswith("force_mode("))
        match = re.fullmatch(r"force_mode\((.*), selection, push, 2, limits\)", called)
        assert match is not None
        return matrix(self.value(match[1]))


def test_urscript_computes_the_task_frame(robot):
    """Evaluated line by line: the TCP that is set is the hand, and where the hand goes the force frame is the task's,
    in the controller's base; each state of an axis stands in its place.
    """
    hinge = MechanismRows(robot, EVIL, "radial axial", axis=(0.1, 0.0, 1.0), point=(0.5, 0.2, 0.1))
    constraints = {
        "no": ml.Constraint([[0.2, 0.1, 0.9]], ml.FrameJacobian(robot, EVIL, "xyz")),
        "hand": ml.Constraint(np.eye(6)[[2, 3, 4]], ml.FrameJacobian(robot, EVIL, "pose", "local")),
        "axis": ml.Constraint(np.eye(2), hinge),
    }
    ways = postures(robot, 4)
    for turns, constraint in constraints.items():
        program = Program(urscript(constraint, ways[0]))
        for q in ways:
            base, frame = np.linalg.inv(robot.pose(q, "base")), constraint.task_frame(q)
            program.flange = base @ robot.pose(q, "tool0")
            with case(turns, q.tolist()):
                hand = matrix(program.variables["get_actual_tcp_pose"]())
                np.testing.assert_allclose(hand, base @ robot.pose(q, EVIL), atol=1e-7)
                now, wanted = program.force_frame, base @ frame.pose
                np.testing.assert_allclose(now[:3, :3], wanted[:3, :3], atol=1e-6)
                if turns == "axis":  # the origin may be anywhere on the axis
                    assert np.linalg.norm(np.cross(now[:3, 3] - wanted[:3, 3], wanted[:3, 2])) < 1e-6
                else:
                    np.testing.assert_allclose(now[:3, 3], wanted[:3, 3], atol=1e-6)
                expected = force_mode(constraint, q)
                np.testing.assert_allclose(matrix(expected["task_frame"]), wanted, atol=1e-7)
                assert (
                    program.variables["selection"]
                    == expected["selection_vector"]
                    == [int(h) for h in frame.along("held")]
                )
                for held, limit in zip(program.variables["selection"], program.variables["limits"], strict=True):
                    assert limit == (0.25 if held else 0.01)
    turns_only = ml.Constraint(np.eye(6)[:5], ml.FrameJacobian(robot, EVIL, "pose"))
    assert "p[0, 0, 0, 0, 0, 0.174533]" in urscript(turns_only, ways[0])  # a first move to try, by ten degrees
    text = urscript(constraints["no"], ways[0])
    code = [line for line in text.splitlines() if not line.strip().startswith("#")]
    assert "tip" not in "".join(code).replace("manip_learn_2e5_tip_no_end", ""), "a name of the robot in the program"
    opened = len(re.findall(r"^ *(?:def|thread|while) .*:$", text, re.MULTILINE))
    assert opened == len(re.findall(r"^ *end$", text, re.MULTILINE)) == 5


def test_a_bag_read_by_another_reader(robot, tmp_path):
    """The MCAP library gives joint names, positions, velocities, efforts and stamps of each message as they were."""
    reader = pytest.importorskip("mcap_ros2.reader", reason="mcap-ros2-support is not installed")
    rng = np.random.default_rng(5)
    time = np.cumsum(rng.uniform(0.005, 0.02, 40)) + 3.0
    q, u, effort = rng.normal(size=(3, 40, 6))
    trajectory = ml.Trajectory(time, q, u, robot.joint_names, effort=effort)
    path = write_motion(tmp_path / "run.mcap", motion_of_trajectory(trajectory, robot))
    messages = list(reader.read_ros2_messages(str(path)))
    assert len(messages) == 40 and {m.channel.topic for m in messages} == {"/joint_states"}
    assert all(tuple(m.ros_msg.name) == robot.joint_names == JOINTS for m in messages)
    for name, numbers in {"position": q, "velocity": u, "effort": effort}.items():
        np.testing.assert_array_equal([getattr(m.ros_msg, name) for m in messages], numbers)
    stamps = [m.ros_msg.header.stamp.sec + 1e-9 * m.ros_msg.header.stamp.nanosec for m in messages]
    np.testing.assert_allclose(stamps, time, atol=1e-9)
    assert [m.log_time_ns for m in messages] == [round(1e9 * stamp) for stamp in stamps]
