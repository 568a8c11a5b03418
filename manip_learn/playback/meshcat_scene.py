"""A robot, a constraint and what was shown of it in the user's own meshcat viewer."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pinocchio as pin
from jaxtyping import Float, Int
from numpy.typing import ArrayLike

from manip_learn.constraint.constraint import Constraint
from manip_learn.errors import ConfigurationError
from manip_learn.playback.appearance import appearance
from manip_learn.playback.constraint_marks import mechanism_drawing
from manip_learn.playback.palette import COLOURS, rgb_of
from manip_learn.robot.robot import Robot
from manip_learn.robot.tips import default_tip

MESH = "TriangularMeshGeometry"
TUBE = 0.004  # [m] radius of lines: those of WebGL are one pixel wide


def show(
    robot: Robot, viewer: Any, constraint: Constraint | None = None, q: ArrayLike | None = None
) -> Callable[[ArrayLike], None]:
    """Draw a robot, a constraint and what was shown of it into a meshcat viewer.

    Everything lies below the path `manip_learn` of the viewer and replaces what an earlier call has drawn there: `arm`,
    `mechanism` (the line, circle, plane or curve), `path` (of the most typical recording along it), `grasps` (where
    hands began) and `target` (the end of that path).

    Args:
        robot: The robot.
        viewer: A `meshcat.Visualizer`, or Pinocchio's `MeshcatVisualizer` of the same robot, which then draws the arm
            with its own meshes.
        constraint: A learnt constraint, whose mechanism is drawn in the robot's base frame; None for the arm alone.
        q: Configuration (nq) or joint positions (nv) to show first; None for `robot.neutral()`.

    Returns:
        The function `show(q)`, which moves the arm to a configuration or joint positions.

    Raises:
        ConfigurationError: A viewer of another kind or of another robot, or a posture of the wrong size.

    Example:
        >>> import meshcat  # doctest: +SKIP
        >>> move = ml.show(robot, meshcat.Visualizer(), constraint)  # doctest: +SKIP
        >>> for posture in rollout.q:  # doctest: +SKIP
        ...     move(posture)
    """
    own = getattr(viewer, "viewer", viewer)  # of Pinocchio's, meshcat's own
    if getattr(own, "set_object", None) is None:
        raise ConfigurationError(
            f"got {type(viewer).__name__}: pass a meshcat.Visualizer, or a MeshcatVisualizer after initViewer()"
        )
    model, posture = robot.pinocchio_model, robot.neutral() if q is None else q
    if own is not viewer and viewer.model.nq != model.nq:
        raise ConfigurationError(
            f"the viewer has nq {viewer.model.nq}, {robot.name!r} has {model.nq}: build it with robot.pinocchio_model"
        )
    scene, data = own["manip_learn"], model.createData()
    scene.delete()
    if own is viewer:
        _draw_arm(scene["arm"], robot)
    if constraint is not None:
        _draw_constraint(scene, robot, constraint, posture)

    def move(q: ArrayLike) -> None:
        full = robot.pinocchio_configuration(q)
        if own is not viewer:
            viewer.display(full)
            return
        pin.forwardKinematics(model, data, full)
        for joint, pose in enumerate(data.oMi):
            scene["arm"][str(joint)].set_transform(pose.homogeneous)

    move(posture)
    return move


def _draw_arm(arm: Any, robot: Robot) -> None:
    """Draw the shapes of each link below the joint that carries it."""
    looks = appearance(robot)
    for k, shape in enumerate(looks.shapes):
        kind, size, pose = shape.kind.title(), shape.size, shape.pose
        if shape.mesh is not None:
            kind, size = MESH, looks.meshes[shape.mesh][:2]
        elif kind == "Box":
            size = (size,)
        elif kind != "Sphere":  # meshcat's stand along y, ours along z
            kind, size, pose = "Cylinder", size[::-1], pose[:, [0, 2, 1, 3]] * [1.0, 1.0, -1.0, 1.0]
        _put(arm[str(shape.joint)][str(k)], kind, size, shape.colour, pose)


def _draw_constraint(scene: Any, robot: Robot, constraint: Constraint, q: ArrayLike) -> None:
    """Draw the mechanism of a constraint, the path that was shown along it, where hands began, and its end."""
    shown, twist, mechanism = constraint.shown, constraint.features.twist, scene["mechanism"]
    tip = default_tip(robot) if twist is None else twist.frame
    path = robot.position(q, tip)[None] if shown is None else shown.points
    blue, vermilion = (tuple(x / 255.0 for x in rgb_of(COLOURS[name])) for name in ("blue", "vermilion"))
    if constraint.mechanism is not None:
        drawing = mechanism_drawing(constraint.mechanism, path)
        for k, line in enumerate(drawing.lines):
            _put(mechanism[f"line{k}"], MESH, _tube(line, TUBE), (*blue, 1.0))
        for k, corners in enumerate(drawing.patches):
            _put(mechanism[f"patch{k}"], MESH, (corners, np.array([[0, 1, 2], [0, 2, 3]])), (*blue, 0.2))
    if shown is not None:
        _put(scene["path"], MESH, _tube(path, 2.0 * TUBE), (*vermilion, 1.0))
        for name, places, radius in (("grasps", shown.grasps[:, :3, 3], 2.0), ("target", path[-1:], 4.0)):
            for k, place in enumerate(places):
                pose = pin.SE3(np.eye(3), place).homogeneous
                _put(scene[name][str(k)], "Sphere", (radius * TUBE,), (*vermilion, 0.8), pose)


def _put(
    node: Any, kind: str, size: tuple[Any, ...], colour: tuple[float, ...], pose: Float[np.ndarray, "4 4"] | None = None
) -> None:
    """Draw a geometry of meshcat, made from its arguments, in red, green, blue and opacity."""
    import meshcat.geometry as g  # here: importing it brings IPython

    number, opacity = int(np.rint(255.0 * np.array(colour[:3])) @ (1 << 16, 1 << 8, 1)), colour[3]
    material = g.MeshPhongMaterial(color=number, opacity=opacity, transparent=opacity < 1.0)
    node.set_object(getattr(g, kind)(*size), material)
    if pose is not None:
        node.set_transform(pose)


def _tube(points: Float[np.ndarray, "n 3"], radius: float) -> tuple[Float[np.ndarray, "v 3"], Int[np.ndarray, "f 3"]]:
    """Return vertices and faces of a round tube along a polyline."""
    along = np.gradient(points, axis=0)
    aside = np.cross(along, np.eye(3)[np.argmin(np.ptp(points, axis=0))])
    across = np.array([aside, np.cross(along, aside)])
    across *= radius / np.maximum(np.linalg.norm(across, axis=2, keepdims=True), 1e-300)
    angles = np.linspace(0.0, 2.0 * np.pi, 8, endpoint=False)[:, None, None]  # its sides
    rings = points + np.cos(angles) * across[0] + np.sin(angles) * across[1]
    a = np.arange(8 * len(points)).reshape(8, -1)
    b = np.roll(a, -1, axis=0)
    corners = np.array([[a[:, :-1], b[:, :-1], a[:, 1:]], [b[:, :-1], b[:, 1:], a[:, 1:]]])
    return rings.reshape(-1, 3), np.moveaxis(corners, 1, -1).reshape(-1, 3)
