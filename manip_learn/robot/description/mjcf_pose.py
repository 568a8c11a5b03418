"""Positions and orientations in the many ways that MJCF has for them."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import final

import numpy as np
import pinocchio as pin
from jaxtyping import Float

from manip_learn.robot.description.diagnostics import GateLog
from manip_learn.robot.description.pose_matrix import Matrix
from manip_learn.robot.description.urdf_numbers import vector
from manip_learn.robot.description.xml_node import XmlNode

ORIENTATIONS = {"quat": 4, "axisangle": 4, "euler": 3, "xyaxes": 6, "zaxis": 3}
FARTHEST = 1e6  # [m]


@final
@dataclass(frozen=True)
class MjcfUnits:
    """What the `<compiler>` says.

    Attributes:
        angle: Factor from the file's angles to rad.
        eulerseq: Axes of Euler angles; small letters turn with the body, capitals do not.
        autolimits: Whether a range alone makes a limit.
        meshdir: Folder of mesh files, relative to the file.
    """

    angle: float
    eulerseq: str
    autolimits: bool
    meshdir: str


def read_units(root: XmlNode, log: GateLog) -> MjcfUnits:
    """The `<compiler>` settings that matter for kinematics.

    Raises:
        RobotError: Code `mjcf-compiler`.
    """
    settings: dict[str, str] = {}
    for node in root.all("compiler"):
        settings |= node.attributes
    angle, eulerseq = settings.get("angle", "degree"), settings.get("eulerseq", "xyz")
    line = root.all("compiler")[0].line if settings else None
    if angle not in ("degree", "radian") or len(eulerseq) != 3 or set(eulerseq) - set("xyzXYZ"):
        seen = f"angle={angle!r}, eulerseq={eulerseq!r}"
        fix = "correct the compiler settings"
        raise log.refusal("mjcf-compiler", line, "<compiler>", seen, "degree or radian, and three axes", fix)
    if settings.get("coordinate", "local") != "local":
        seen = "coordinate is global"
        raise log.refusal("mjcf-compiler", line, "<compiler>", seen, "local is read", "save the file by MuJoCo")
    meshdir = settings.get("meshdir", settings.get("assetdir", ""))
    factor = math.pi / 180.0 if angle == "degree" else 1.0
    return MjcfUnits(factor, eulerseq, settings.get("autolimits", "true") != "false", meshdir)


def pose_of(node: XmlNode, units: MjcfUnits, where: str, log: GateLog) -> Matrix:
    """Pose of an element relative to the body around it [m].

    Raises:
        RobotError: Codes `number`, `not-finite`, `vector-size`, `far-away`, `mjcf-orientation`.
    """
    T = np.eye(4)
    position = vector(node, "pos", 3, where, log) or (0.0, 0.0, 0.0)
    if max(map(abs, position)) > FARTHEST:
        seen = f"its position is {position} m"
        raise log.refusal("far-away", node.line, where, seen, f"at most {FARTHEST:g} m is wanted", "check the unit")
    T[:3, 3] = position
    given = [key for key in ORIENTATIONS if key in node.attributes]
    if len(given) > 1:
        seen = f"its orientation is given by {' and '.join(given)}"
        raise log.refusal("mjcf-orientation", node.line, where, seen, "one way is wanted", "delete the others")
    if given:
        numbers = np.array(vector(node, given[0], ORIENTATIONS[given[0]], where, log))
        T[:3, :3] = _rotation(given[0], numbers, units, node, where, log)
    return T


def _rotation(
    kind: str, numbers: np.ndarray, units: MjcfUnits, node: XmlNode, where: str, log: GateLog
) -> Float[np.ndarray, "3 3"]:
    if kind == "euler":
        R = np.eye(3)
        for letter, angle in zip(units.eulerseq, numbers * units.angle, strict=True):
            turn = pin.exp3(angle * np.eye(3)["xyz".index(letter.lower())])
            R = R @ turn if letter.islower() else turn @ R
        return R
    direction = numbers[:3] if kind == "axisangle" else numbers
    if kind == "xyaxes":
        direction = np.cross(numbers[:3], numbers[3:])
    if np.linalg.norm(direction) < 1e-9:
        seen = f"{kind} {numbers.tolist()} gives no direction"
        raise log.refusal("mjcf-orientation", node.line, where, seen, "a direction is wanted", "correct it")
    if kind == "quat":
        w, x, y, z = numbers / np.linalg.norm(numbers)
        return pin.Quaternion(w, x, y, z).toRotationMatrix()
    if kind == "axisangle":
        return pin.exp3(numbers[3] * units.angle * numbers[:3] / np.linalg.norm(numbers[:3]))
    if kind == "zaxis":
        z = numbers / np.linalg.norm(numbers)
        return pin.Quaternion.FromTwoVectors(np.array([0.0, 0.0, 1.0]), z).toRotationMatrix()
    x = numbers[:3] / np.linalg.norm(numbers[:3])
    y = numbers[3:] - x.dot(numbers[3:]) * x
    y /= np.linalg.norm(y)
    return np.column_stack([x, y, np.cross(x, y)])
