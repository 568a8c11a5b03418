"""The tasks of `beside_peers.py`: rows of the tip, points within reach, half of the starts near singularities."""

from __future__ import annotations

import json
import xml.etree.ElementTree as ET
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from control_states import inside

import manip_learn as ml

ARMS: dict[str, tuple[str, tuple[str, ...], int]] = {  # tip, locked joints, seed: of 5, 6, 7, 7 and 14 joints
    "so101": ("gripper_frame_link", ("gripper",), 4),
    "ur5": ("tool0", (), 2),
    "sawyer": ("right_l6", (), 1),
    "panda": ("panda_hand", ("panda_finger_joint1",), 0),
    "baxter": ("left_gripper", ("head_pan", "l_gripper_l_finger_joint", "r_gripper_l_finger_joint"), 5),
}
NEAR = 0.02  # mu of a near-singular start, relative to the median over random postures
INERTIAL = '<inertial><mass value="1"/><inertia ixx="0.01" ixy="0" ixz="0" iyy="0.01" iyz="0" izz="0.01"/></inertial>'


class Tasks(NamedTuple):
    """Cases of one robot; rows (s, 3), start (nv,) and target (3,) each."""

    robot: ml.Robot
    tip: str
    rows: list[np.ndarray]
    starts: list[np.ndarray]
    targets: list[np.ndarray]


def plain_urdf(robot: ml.Robot, folder: Path) -> Path:
    """The robot without shapes, with exactly its movable joints: all peers can read that."""
    assert robot.description is not None
    tree = ET.fromstring(robot.description)
    for element in list(tree):
        if element.tag not in ("link", "joint"):
            tree.remove(element)
    for link in tree.findall("link"):
        for child in list(link):
            link.remove(child)
        link.append(ET.fromstring(INERTIAL))
    for joint in tree.findall("joint"):
        if joint.get("name") not in robot.joint_names:
            joint.set("type", "fixed")
            joint.set("name", f"{joint.get('name')} fixed")  # some peers want no name twice, that of a link neither
        for child in list(joint):
            if child.tag not in ("parent", "child", "origin", "axis", "limit"):
                joint.remove(child)
    # MuJoCo would merge links that are fixed to each other, the tip among them
    tree.append(ET.fromstring('<mujoco><compiler fusestatic="false" discardvisual="true"/></mujoco>'))
    path = folder / f"{robot.name}.urdf"
    path.write_bytes(ET.tostring(tree))
    return path


def plain_robot(name: str, folder: Path) -> ml.Robot:
    """The robot as all peers can read it."""
    return ml.load_robot(plain_urdf(ml.load_robot(name, locked=ARMS[name][1]), folder))


def tasks_of(name: str, folder: Path, number: int, s: int) -> Tasks:
    """Random tasks with s oblique rows; every second one starts near a singularity."""
    (tip, _, seed), robot = ARMS[name], plain_robot(name, folder)
    features = ml.FrameJacobian(robot, tip, "xyz")
    rows, starts, targets = [], [], []
    for i in range(number):
        rng = np.random.default_rng([seed, i, 1])
        constraint = ml.Constraint(np.linalg.qr(rng.normal(size=(3, 3)))[0][:s], features)
        starts.append(near_singular(constraint, rng) if i % 2 else inside(robot, rng))
        targets.append(robot.position(inside(robot, rng), tip))
        rows.append(constraint.selection)
    return Tasks(robot, tip, rows, starts, targets)


def near_singular(constraint: ml.Constraint, rng: np.random.Generator) -> np.ndarray:
    """A posture at which mu is NEAR times its median, found by descending from the best of 300."""
    robot = constraint.robot
    assert robot is not None
    postures = np.array([inside(robot, rng) for _ in range(300)])
    mu = ml.manipulability_batch(constraint, postures).mu
    wanted, q = NEAR * float(np.median(mu)), postures[np.argmin(mu)]
    for _ in range(200):
        here, gradient = ml.manipulability(constraint, q), ml.manipulability_gradient(constraint, q)
        if here <= wanted:
            break
        step = (wanted - here) * gradient / max(float(gradient @ gradient), 1e-12)
        step *= min(1.0, 0.05 / max(float(np.linalg.norm(step)), 1e-12))
        q = np.clip(q + step, robot.position_lower, robot.position_upper)
    return q


def write(tasks: Tasks, path: Path, gain: float, dt: float, duration: float, task_gain: float) -> None:
    """What the children read."""
    robot = tasks.robot
    arm: dict[str, Any] = {
        "urdf": str(robot.source),
        "base": robot.frame_names[0],
        "tip": tasks.tip,
        "names": list(robot.joint_names),
        "lower": robot.position_lower.tolist(),
        "upper": robot.position_upper.tolist(),
        "velocity": robot.velocity_limit.tolist(),
        "dt": dt,
        "duration": duration,
        "task_gain": task_gain,
    }
    cases = [
        {"rows": rows.tolist(), "start": start.tolist(), "target": target.tolist(), "gain": gain}
        for rows, start, target in zip(tasks.rows, tasks.starts, tasks.targets, strict=True)
    ]
    path.write_text(json.dumps({"arm": arm, "cases": cases}), encoding="utf-8")
