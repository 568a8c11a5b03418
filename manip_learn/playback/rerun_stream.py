"""A Rerun recording as it grows: robot, tip, target and curves of one rollout after the other."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any, final

import numpy as np
import pinocchio as pin
from jaxtyping import Float

from manip_learn.control.rollout import Rollout
from manip_learn.errors import MissingExtraError
from manip_learn.playback.appearance import Appearance, Shape, TriangleMesh
from manip_learn.playback.constraint_marks import target_place
from manip_learn.playback.guided_motion import Guidance, MotionSamples
from manip_learn.recordings.trajectory import Trajectory
from manip_learn.robot.frame import Frame
from manip_learn.robot.robot import Robot

try:
    import rerun as rr
    import rerun.blueprint as rrb
except ImportError as error:
    raise MissingExtraError("writing Rerun recordings (.rrd)", "rerun") from error

TIMELINE, WORLD = "time", "world"
CURVES = ("manipulability", "task_error", "following_error")
VIEWS = ("manipulability", "position", "velocity")
TIP_RADIUS, PATH_RADIUS, AXES = 0.008, 0.002, 0.1  # [m]


@final
class RerunStream:
    """A recording for Rerun.

    Args:
        robot: Its robot.
        looks: What the robot looks like.
        names: Of all rollouts that will be added.
    """

    def __init__(self, robot: Robot, looks: Appearance, names: list[str]):
        self._robot, self._looks = robot, looks
        self._tinted = len(names) > 1
        self._folder = tempfile.TemporaryDirectory(prefix="manip_learn_")
        self._file = Path(self._folder.name) / "recording.rrd"
        # without properties: they hold the time of writing, and files of the same rollouts should be alike
        self._stream = rr.RecordingStream(f"manip_learn: {robot.name}", send_properties=False)
        self._stream.save(self._file, default_blueprint=_layout(names))
        self._stream.send_recording_name(robot.name or "robot")
        self._still(WORLD, rr.ViewCoordinates.RIGHT_HAND_Z_UP)

    def add(self, name: str, recording: Rollout | Trajectory, samples: MotionSamples, tip: Frame, colour: str) -> None:
        """One rollout, all its samples; `colour` is hexadecimal."""
        rgb = [int(colour[i : i + 2], 16) for i in (1, 3, 5)]
        self._add_robot(name, samples, rgb)
        self._add_tip(name, samples, tip, rgb)
        self._add_joints(name, samples)
        if isinstance(recording, Rollout):
            self._add_rollout(name, recording, samples.time + samples.first_time)

    def add_target(self, name: str, guidance: Guidance, q: Float[np.ndarray, " n"]) -> None:
        """Where the task was to arrive, in the base, if that is a place; q is the first posture."""
        target, path = guidance.target, entity(WORLD, name, "target")
        if target is not None and target.shape == (4, 4):
            pose = rr.Transform3D(translation=target[:3, 3], mat3x3=target[:3, :3])
            self._still(path, pose, rr.TransformAxes3D(AXES))
        elif guidance.constraint is not None:
            place = target_place(self._robot, guidance.constraint, target, q)
            if place is not None and place["carrier"] is None:
                self._still(path, rr.Points3D([place["point"]], radii=[TIP_RADIUS]))

    def finished(self) -> bytes:
        """The whole file; nothing can be added after it."""
        self._stream.flush()
        self._stream.disconnect()
        content = self._file.read_bytes()
        self._folder.cleanup()
        return content

    def _still(self, path: str, *parts: Any) -> None:
        self._stream.log(path, *parts, static=True, strict=True)

    def _moving(self, path: str, time: Float[np.ndarray, " T"], columns: Any) -> None:
        index = rr.TimeColumn(TIMELINE, duration=time)
        self._stream.send_columns(path, indexes=[index], columns=columns, strict=True)

    def _add_robot(self, name: str, samples: MotionSamples, rgb: list[int]) -> None:
        """Poses of the joints in the base over time, and what each joint carries."""
        model = self._robot.pinocchio_model
        data, n = model.createData(), model.njoints
        poses = np.empty((len(samples.time), n, 7))
        for k, q in enumerate(samples.q):
            pin.forwardKinematics(model, data, self._robot.pinocchio_configuration(q))
            poses[k] = [pin.SE3ToXYZQUAT(data.oMi[i]) for i in range(n)]
        for i, joint in enumerate(model.names):
            path = entity(WORLD, name, "robot", str(joint))
            if i:
                columns = rr.Transform3D.columns(translation=poses[:, i, :3], quaternion=poses[:, i, 3:])
                self._moving(path, samples.time + samples.first_time, columns)
            for k, shape in enumerate(s for s in self._looks.shapes if s.joint == i):
                own = [round(255 * c) for c in shape.colour]
                colour = [*rgb, own[3]] if shape.accent or (self._tinted and i) else own
                placement = pin.SE3ToXYZQUAT(pin.SE3(shape.pose))
                pose = rr.Transform3D(translation=placement[:3], quaternion=placement[3:])
                self._still(f"{path}/shape_{k}", pose, _body(shape, self._looks, colour))

    def _add_tip(self, name: str, samples: MotionSamples, tip: Frame, rgb: list[int]) -> None:
        places = np.array([self._robot.position(q, tip) for q in samples.q])
        path = entity(WORLD, name, "tip")
        self._still(path, rr.Points3D.from_fields(colors=[rgb], radii=[TIP_RADIUS]))
        self._moving(path, samples.time + samples.first_time, rr.Points3D.columns(positions=places))
        self._still(f"{path}/path", rr.LineStrips3D([places], colors=[rgb], radii=[PATH_RADIUS]))

    def _add_joints(self, name: str, samples: MotionSamples) -> None:
        positions = np.array([self._robot.positions(q) for q in samples.q])
        for j, joint in enumerate(self._robot.joint_names):
            path, time = entity(name, "position", joint), samples.time + samples.first_time
            self._moving(path, time, rr.Scalars.columns(scalars=positions[:, j]))
            if len(samples.u):
                path, time = entity(name, "velocity", joint), samples.velocity_time + samples.first_time
                self._moving(path, time, rr.Scalars.columns(scalars=samples.u[:, j]))

    def _add_rollout(self, name: str, rollout: Rollout, time: Float[np.ndarray, " T"]) -> None:
        """What only rollouts have; numbers that are not known (NaN) are left out."""
        for curve in CURVES:
            values = getattr(rollout, curve)
            if values is None:
                continue
            known = np.isfinite(values)
            if known.any():
                self._moving(entity(name, curve), time[known], rr.Scalars.columns(scalars=values[known]))
        words = [str(word) for word in rollout.status]
        changes = [k for k in range(len(words)) if k == 0 or words[k] != words[k - 1]]
        if changes:
            columns = rr.TextLog.columns(text=[words[k] for k in changes])
            self._moving(entity(name, "status"), time[changes], columns)


def entity(*parts: str) -> str:
    """Path of an entity; names may hold any sign."""
    return rr.new_entity_path(list(parts))


def _layout(names: list[str]) -> Any:
    """The robots on the left, the curves on the right."""
    curves = [rrb.TimeSeriesView(name=view, contents=[f"{entity(name, view)}/**" for name in names]) for view in VIEWS]
    robots = rrb.Spatial3DView(origin=WORLD, name="robot")
    return rrb.Blueprint(rrb.Horizontal(robots, rrb.Vertical(*curves)))


def _body(shape: Shape, looks: Appearance, colour: list[int]) -> Any:
    size = shape.size
    if shape.mesh is not None:
        mesh = looks.meshes[shape.mesh]
        return rr.Mesh3D(
            vertex_positions=mesh.vertices,
            triangle_indices=mesh.triangles,
            vertex_normals=_normals(mesh),
            albedo_factor=colour,
        )
    if shape.kind == "box":
        return rr.Boxes3D(half_sizes=[np.array(size) / 2.0], colors=[colour], fill_mode="solid")
    if shape.kind == "sphere":
        return rr.Ellipsoids3D(half_sizes=[[size[0]] * 3], colors=[colour], fill_mode="solid")
    # Rerun has no cones: a cylinder as thick as the middle of one
    radius = float(np.mean(size[:-1]))
    return rr.Cylinders3D(lengths=[size[-1]], radii=[radius], colors=[colour], fill_mode="solid")


def _normals(mesh: TriangleMesh) -> Float[np.ndarray, "V 3"]:
    """Unit normals at the vertices, each triangle by its area; without them Rerun shades nothing."""
    corners = mesh.vertices[mesh.triangles]
    areas = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    at = mesh.triangles.reshape(-1)
    sums = np.column_stack([np.bincount(at, np.repeat(areas[:, k], 3), len(mesh.vertices)) for k in range(3)])
    return sums / np.maximum(np.linalg.norm(sums, axis=1, keepdims=True), 1e-300)
