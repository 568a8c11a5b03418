"""A robot, a constraint and what was shown of it in the user's own meshcat viewer."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pinocchio as pin
from jaxtyping import Float
from numpy.typing import ArrayLike

from manip_learn.constraint.constraint import Constraint
from manip_learn.errors import ConfigurationError
from manip_learn.playback.appearance import appearance
from manip_learn.playback.kinematic_tree import kinematic_tree
from manip_learn.playback.mechanism_drawing import mechanism_drawing
from manip_learn.playback.palette import COLOURS, rgb_of
from manip_learn.robot.robot import Robot
from manip_learn.robot.tips import default_tip

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
            f"the viewer is {type(viewer).__name__}; a meshcat.Visualizer, or Pinocchio's MeshcatVisualizer after "
            "initViewer(), is needed"
        )
    model, posture = robot.pinocchio_model, robot.neutral() if q is None else q
    if own is not viewer and viewer.model.nq != model.nq:
        raise ConfigurationError(
            f"the viewer shows a model with {viewer.model.nq} numbers, robot {robot.name!r} has {model.nq}: build it "
            "with robot.pinocchio_model"
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
    import meshcat.geometry as g  # here: importing it brings IPython

    looks = appearance(robot, kinematic_tree(robot))
    for k, shape in enumerate(looks.shapes):
        pose, size = shape.pose, shape.size
        if shape.mesh is not None:
            mesh = looks.meshes[shape.mesh]
            geometry = g.TriangularMeshGeometry(mesh.vertices, mesh.faces)
        elif shape.kind == "box":
            geometry = g.Box(list(size))
        elif shape.kind == "sphere":
            geometry = g.Sphere(size[0])
        else:
            geometry, upright = g.Cylinder(size[1], size[0]), np.eye(4)
            upright[:3, :3] = [[1, 0, 0], [0, 0, -1], [0, 1, 0]]  # meshcat's stand along y, ours along z
            pose = pose @ upright
        node = arm[str(shape.joint)][str(k)]
        node.set_object(geometry, _ink(shape.colour[:3], shape.colour[3]))
        node.set_transform(pose)


def _draw_constraint(scene: Any, robot: Robot, constraint: Constraint, q: ArrayLike) -> None:
    """Draw the mechanism of a constraint, the path that was shown along it, where hands began, and its end."""
    import meshcat.geometry as g

    shown, twist = constraint.shown, constraint.features.twist
    path = (
        robot.position(q, default_tip(robot) if twist is None else twist.frame)[None] if shown is None else shown.points
    )
    blue, vermilion = (np.array(rgb_of(COLOURS[name])) / 255.0 for name in ("blue", "vermilion"))
    drawing = mechanism_drawing(constraint.mechanism, path) if constraint.mechanism is not None else None
    for k, line in enumerate(drawing.lines if drawing is not None else ()):
        scene["mechanism"][f"line{k}"].set_object(_tube(line), _ink(blue))
    for k, corners in enumerate(drawing.patches if drawing is not None else ()):
        surface = g.TriangularMeshGeometry(corners, np.array([[0, 1, 2], [0, 2, 3]]))
        scene["mechanism"][f"patch{k}"].set_object(surface, _ink(blue, 0.2))
    if shown is None:
        return
    scene["path"].set_object(_tube(path, 2.0 * TUBE), _ink(vermilion))
    for name, places in (("grasps", shown.grasps[:, :3, 3]), ("target", path[-1:])):
        for k, place in enumerate(places):
            pose, is_target = np.eye(4), name == "target"
            pose[:3, 3] = place
            scene[name][str(k)].set_object(g.Sphere((4.0 if is_target else 2.0) * TUBE), _ink(vermilion, 0.8))
            scene[name][str(k)].set_transform(pose)


def _ink(colour: ArrayLike, opacity: float = 1.0) -> Any:
    import meshcat.geometry as g

    r, g_, b = np.rint(255.0 * np.clip(np.asarray(colour, dtype=np.float64), 0.0, 1.0)).astype(int).tolist()
    return g.MeshPhongMaterial(color=(r << 16) | (g_ << 8) | b, opacity=opacity, transparent=opacity < 1.0)


def _tube(points: Float[np.ndarray, "n 3"], radius: float = TUBE, sides: int = 8) -> Any:
    """A round tube along a polyline."""
    import meshcat.geometry as g

    along = np.gradient(points, axis=0) if len(points) > 1 else np.array([[0.0, 0.0, 1.0]])
    along = along / np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-12)
    first = np.cross(along, np.eye(3)[np.argmin(np.abs(along).max(axis=0))])
    first = first / np.maximum(np.linalg.norm(first, axis=1, keepdims=True), 1e-12)
    angles = np.linspace(0.0, 2.0 * np.pi, sides, endpoint=False)[:, None, None]
    rings = points + radius * (np.cos(angles) * first + np.sin(angles) * np.cross(along, first))
    n = len(points)
    a = (np.arange(sides)[:, None] * n + np.arange(n - 1)).reshape(-1)
    b = (np.roll(np.arange(sides), -1)[:, None] * n + np.arange(n - 1)).reshape(-1)
    faces = np.concatenate([np.stack([a, b, a + 1], axis=1), np.stack([b, b + 1, a + 1], axis=1)])
    return g.TriangularMeshGeometry(rings.reshape(-1, 3), faces)
