"""Export of a learnt task for force and impedance controllers: URScript, Cartesian impedance, MoveIt.

These controllers need axes, and for each axis whether the environment holds the hand along it (a held axis). A stiff
controller would press along a held axis with a force that grows with every error of the frame, so held axes are
compliant. Along free axes the controller moves the hand, and is stiff. Axes of which nothing was learnt are stiff, too.
"""

from __future__ import annotations

import json
import math
import re
import textwrap
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, cast

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike
from scipy.linalg import sqrtm
from scipy.spatial.transform import Rotation

from manip_learn.constraint.constraint import Constraint
from manip_learn.constraint.place import AXES
from manip_learn.constraint.task_frame import TaskFrame
from manip_learn.errors import ConstraintError, printable
from manip_learn.recordings.writers.write_motion import yaml_text
from manip_learn.robot.robot import Robot
from manip_learn.robot.rotations import pose_coordinates, rotation_matrix

# elsewhere: along free axes, which the controller moves, and along unknown axes
REASON = "compliant where the environment holds, so that no error of the frame turns into force; stiff elsewhere"

# [m] and [rad] largest deviation of a planner along a held axis: a gripper's fingers yield by half a centimetre, and
# samplers need some room. Three uncertainties at the end of the task count if they are larger
TOLERANCE = (0.005, math.radians(2.0))


def force_mode(constraint: Constraint, q: ArrayLike) -> dict[str, Any]:
    """Return the arguments of URScript's `force_mode` at a posture, for programs that call it themselves.

    Args:
        constraint: The task.
        q: Configuration (nq,) or joint positions (nv,) [rad or m].

    Returns:
        `task_frame`: position [m] and rotation vector [rad] in the base frame of the UR controller (the robot's frame
        `base` if it has one, as in the descriptions by Universal Robots; otherwise the robot's base frame);
        `selection_vector`: 1 for each held axis, along which the arm is compliant, and 0 for the other axes; `wrench`:
        six zeros [N, N m], so that the arm gives way; `type`: 2, the task frame is used without a transformation;
        `limits`: largest speed along compliant axes [m/s, rad/s], largest deviation along the other axes [m, rad].

    Raises:
        ConstraintError: The constraint has no task frame, or its task frame is relative to another moving frame.
        ConfigurationError: q has the wrong size or is not finite.
    """
    frame, robot = _frame_and_robot(constraint, q, "force_mode takes")
    selection = [int(is_held) for is_held in frame.along("held")]
    # from the base of the robot's description to the base of a UR controller
    base = np.linalg.inv(robot.pose(q, "base")) if "base" in robot.frame_names else np.eye(4)
    pose = pose_coordinates(base @ frame.pose).tolist()
    # of compliant axes [m/s and rad/s] the reduced speed of ISO 10218-1, and a turn that moves a tip at 1 m as fast; of
    # the others [m and rad] the default of ur_msgs/SetForceMode, as the program's damping and gain are
    limits = [0.25 if compliant else 0.01 for compliant in selection]
    return {"task_frame": pose, "selection_vector": selection, "wrench": [0.0] * 6, "type": 2, "limits": limits}


def urscript(constraint: Constraint, q: ArrayLike) -> str:
    """Return a URScript program that sets a UR arm to force mode, compliant along the held axes.

    A comment in the program marks where to insert your moves along the free axes, with an example. The task frame
    follows the hand; where the task requires it, it also turns with the hand, or about the axis of a hinge. Written
    from the script manual, not tested on a controller.

    Args:
        constraint: The task.
        q: Configuration (nq,) or joint positions (nv,) [rad or m].

    Raises:
        ConstraintError: The constraint has no task frame, or its task frame is relative to another moving frame.
        ConfigurationError: q has the wrong size or is not finite.
    """
    arguments, (frame, robot) = force_mode(constraint, q), _frame_and_robot(constraint, q)
    tcp = np.linalg.inv(robot.pose(q, "tool0")) @ frame.hand if "tool0" in robot.frame_names else None
    at = pose_coordinates(np.linalg.inv(frame.hand) @ frame.pose) if frame.turns == "hand" else arguments["task_frame"]
    follows = {"no": "position_of", "hand": "pose_trans", "axis": "turned_to"}  # functions of URScript
    moves = np.diag([0.05] * 3 + [math.radians(10.0)] * 3)[frame.along("free")]  # 5 cm or 10 degrees along each
    program = Path(__file__).with_name("force_mode.script").read_text(encoding="utf-8")
    return _comments(frame, *textwrap.wrap(REASON, 100)) + program.format(
        name="manip_learn_" + re.sub(r"[^A-Za-z0-9]+", "_", frame.frame),
        frame=frame.frame,
        tcp="" if tcp is None else f"  set_tcp({_vector(pose_coordinates(tcp))})\n",
        at=_vector(at),
        given=arguments,
        follows=follows[frame.turns],
        step=_vector(next(iter(moves), np.zeros(6)), ".6g"),
    )


def impedance(
    constraint: Constraint,
    q: ArrayLike,
    *,
    stiff: Sequence[float] = (1000.0, 50.0),
    compliant: Sequence[float] = (100.0, 5.0),
    damping_ratio: float = 1.0,
) -> dict[str, Any]:
    r"""Return the parameters of a Cartesian impedance controller: compliant along held axes, stiff along all others.

    The controller applies the wrench :math:`K\,dx - D\,(v, w)` at the hand's origin along the axes of the robot's base,
    with the displacement and rotation vector dx to the goal [m, rad] and the hand's linear and angular velocity (v, w).
    With the inertia M of the hand at this posture, every mode has the damping ratio z:

    .. math::

        D = 2 z M^{1/2} (M^{-1/2} K M^{-1/2})^{1/2} M^{1/2}

    Args:
        constraint: The task.
        q: Configuration (nq,) or joint positions (nv,) [rad or m].
        stiff: Stiffness along free and unknown axes: linear [N/m] and rotational [N m/rad]. At 15 N, the force at which
            `ServoLoop` stops by default, 1,000 N/m yields by 15 mm; 50 N m/rad match 1,000 N/m at a lever of 0.22 m.
        compliant: Stiffness along held axes, linear [N/m] and rotational [N m/rad]; the default is a tenth of `stiff`.
            A drawer with an axis error of 5 degrees caused a force of 1.8 N at 100 N/m, and 30 N at 2,000 N/m
            (measured).
        damping_ratio: Damping ratio z; 1 for critical damping.

    Returns:
        `stiffness` K and `damping` D, each (6, 6) as nested lists [N/m, N m/rad, and these times s]; `base` and
        `frame`, the names of the base frame and of the hand's frame; `task_frame` and `stiffness_along_axes`, the task
        frame and the stiffness along each of its axes; and `reason`, a text that explains the choice.

    Raises:
        ConstraintError: The constraint has no task frame.
        ConfigurationError: q has the wrong size or is not finite.
    """
    frame, robot = _frame_and_robot(constraint, q)
    values = np.where(frame.along("held"), np.repeat(compliant, 3), np.repeat(stiff, 3))
    X = frame.from_hand
    K = X.T @ np.diag(values) @ X
    inertia = robot.hand_inertia(q, frame.frame)
    # without masses in the description, 1 kg and 1 kg m2: damping 2 sqrt(stiffness), as often used
    root = np.real(sqrtm(np.eye(6) if inertia is None else inertia))
    back = np.linalg.inv(root)
    D = 2.0 * damping_ratio * root @ np.real(sqrtm(back @ K @ back)) @ root
    about = {"reason": REASON, "base": robot.frame_names[0], "frame": frame.frame}
    stiffness, damping = ((0.5 * (matrix + matrix.T)).tolist() for matrix in (K, D))
    along = {"stiffness_along_axes": dict(zip(AXES, values.tolist(), strict=True)), "task_frame": frame.to_dict()}
    return about | {"stiffness": stiffness, "damping": damping} | along


def moveit_constraints(constraint: Constraint, q: ArrayLike) -> str:
    """Return the path constraints of a MoveIt plan for the task: a `moveit_msgs/Constraints` message as YAML.

    The constrained point stays in a box that is thin along held axes, or in one of several boxes along the circle or
    the helix about an axis; for a point on a sphere there is no position constraint. The rotation of the link about
    held axes is limited to a tolerance. MoveIt measures rotations about the link's own axes: if the free axis of
    rotation lies between these, the constraint allows more than the task. Written from the message definitions, not
    tested in MoveIt.

    Args:
        constraint: The task.
        q: Configuration (nq,) or joint positions (nv,) [rad or m].

    Raises:
        ConstraintError: The constraint has no task frame, or its task frame is relative to another moving frame.
        ConfigurationError: q has the wrong size or is not finite.
    """
    frame, robot = _frame_and_robot(constraint, q, "path constraints are in")
    of_link = np.linalg.inv(frame.hand)
    about = {"header": {"frame_id": robot.frame_names[0]}, "link_name": frame.frame, "weight": 1.0}
    content: dict[str, Any] = {"name": "manip_learn", "position_constraints": [], "orientation_constraints": []}
    poses, size = _boxes(frame)
    if poses:
        # type 1: shape_msgs/SolidPrimitive.BOX
        region = {"primitives": [{"type": 1, "dimensions": size}] * len(poses), "primitive_poses": poses}
        offset = _xyzw(of_link[:3, :3] @ frame.point + of_link[:3, 3])
        content["position_constraints"].append(about | {"target_point_offset": offset, "constraint_region": region})
    if any(frame.along("held")[3:]):
        free = of_link[:3, :3] @ frame.pose[:3, :3][:, np.array(frame.along("free"))[3:]]
        wide = np.minimum(TOLERANCE[1] + math.pi * np.linalg.norm(free, axis=1), math.pi)
        tolerances = {f"absolute_{n}_axis_tolerance": w for n, w in zip("xyz", wide.tolist(), strict=True)}
        orientation = _xyzw(Rotation.from_matrix(frame.hand[:3, :3]).as_quat())
        # parameterization 1: moveit_msgs/OrientationConstraint.ROTATION_VECTOR
        turns = {"orientation": orientation, "parameterization": 1}
        content["orientation_constraints"].append(about | turns | tolerances)
    return _comments(frame) + yaml_text(content, indent=1) + "\n"


def _boxes(frame: TaskFrame) -> tuple[list[dict[str, dict[str, float]]], list[float]]:
    """Return poses and size of boxes for the held point; none if no translation is held, or on a sphere."""
    R, origin, is_held = frame.pose[:3, :3], frame.pose[:3, 3], np.array(frame.along("held"))[:3]
    lever, mechanism = float(np.linalg.norm(frame.point - origin)), frame.mechanism
    if not is_held.any() or (lever > 0.0 and (mechanism is None or mechanism.axis is None)):
        return [], []
    # 1 m to either side of the hand along free axes: more than a table-top arm moves in one task
    half = np.where(is_held, np.maximum(TOLERANCE[0], 3.0 * frame.uncertainty[:3]), 1.0)
    poses, angles, pitch = [], np.zeros(1), (mechanism and mechanism.pitch) or 0.0
    if lever > 0.0:
        # the smallest number of boxes that contain the whole circle: the arc in one deviates by half a thickness
        n = math.ceil(math.pi / (2.0 * math.acos(max(0.0, 1.0 - half[0] / lever))))
        half[1], angles = lever * math.sin(0.5 * math.pi / n), math.pi / n * np.arange(-n, n)
    for angle in angles:
        turned = R @ rotation_matrix(np.array([0.0, 0.0, angle]))
        middle = origin + turned @ [lever, 0.0, pitch * angle]
        poses.append({"position": _xyzw(middle), "orientation": _xyzw(Rotation.from_matrix(turned).as_quat())})
    return poses, (2.0 * half).tolist()


# name on the command line -> function that returns the text of a file, for a constraint and a posture
WRITERS: Mapping[str, Callable[[Constraint, ArrayLike], str]] = {
    "urscript": urscript,
    "stiffness": lambda constraint, q: as_json(impedance(constraint, q)),
    "moveit": moveit_constraints,
    # still a constraint file, with the keys of the task frame added
    "json": lambda constraint, q: as_json(constraint.to_dict() | constraint.task_frame(q).to_dict()),
}


def as_json(described: Mapping[str, Any]) -> str:
    """Return the content of a JSON file as text.

    Args:
        described: Content: a mapping of numbers, texts, lists and mappings.
    """
    return json.dumps(described, indent=2, allow_nan=False) + "\n"


def _frame_and_robot(constraint: Constraint, q: ArrayLike, taker: str = "") -> tuple[TaskFrame, Robot]:
    """Return the task frame at a posture and its robot; refuse a moving frame if `taker` needs a fixed one."""
    frame = constraint.task_frame(q)
    if taker and frame.turns == "other frame":
        raise ConstraintError(f"{taker} a frame of the robot's base: these rows are seen from another moving frame")
    return frame, cast("Robot", constraint.robot)  # there is one where there is a task frame


def _comments(frame: TaskFrame, *more: str) -> str:
    """Return comments for the reader of the file: the task, and more lines."""
    states = ", ".join(
        f"{name} {state}" + (f" (to {math.degrees(off):.2g} deg)" if state != "unknown" and off > 1e-9 else "")
        for name, state, off in zip(AXES, frame.axes, frame.uncertainty.tolist(), strict=True)
    )
    holds = [] if frame.mechanism is None else [printable(frame.mechanism.sentence)]
    lines = [f"written by manip_learn for frame {frame.frame!r}", *holds, f"axes of the task frame: {states}", *more]
    return "".join(f"# {line}\n" for line in lines)


def _vector(pose: Iterable[float], digits: str = ".9f") -> str:
    """Return a pose of URScript: position [m] and rotation vector [rad]."""
    return f"p[{', '.join(format(x, digits) for x in pose)}]"


def _xyzw(values: Float[np.ndarray, " n"]) -> dict[str, float]:
    """Return a message of ROS: a point of three numbers, or a quaternion of four."""
    return dict(zip("xyzw", values.tolist(), strict=False))
