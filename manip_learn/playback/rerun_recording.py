"""Rollouts and recordings -> one .rrd file for the Rerun viewer."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pinocchio as pin

from manip_learn.atomic_write import write_atomically
from manip_learn.errors import MissingExtraError, OutputError
from manip_learn.playback.appearance import appearance
from manip_learn.playback.guided_motion import MotionSamples, guidance_of, motion_samples
from manip_learn.playback.kinematic_tree import kinematic_tree
from manip_learn.playback.palette import rgb_of, rollout_colours
from manip_learn.playback.recorded_motion import status_changes
from manip_learn.playback.replay_page import Recording, named_recordings, shown_tip
from manip_learn.robot.robot import Robot

if TYPE_CHECKING:
    import rerun as rr

CURVES = ("manipulability", "task_error", "following_error")
VIEWS = ("manipulability", "position", "velocity")
TIP_RADIUS, PATH_RADIUS = 0.008, 0.002  # [m]


def write_rerun(
    robot: Robot,
    rollouts: Mapping[str, Recording] | Recording,
    path: str | os.PathLike[str],
    *,
    tip: str | None = None,
) -> Path:
    """Write one file that the Rerun viewer opens, with every sample of the rollouts.

    Below the name of each rollout are `position/JOINT` and `velocity/JOINT` (numbers of the joints), `manipulability`,
    `task_error`, `following_error` and `status` where they are known. `world/NAME/robot/JOINT` is the pose of a joint
    in the robot's base with its shapes, `world/NAME/tip` the tip and its path. The timeline `time` is the recording's
    own clock [s].

    Args:
        robot: The robot that the rollouts were made with.
        rollouts: Name -> rollout or demonstration; or a single one.
        path: File to write; its ending is `.rrd`.
        tip: Frame whose path is drawn; None for the frame that the rollouts were made with, else `default_tip`.

    Returns:
        The absolute path that was written.

    Raises:
        MissingExtraError: `rerun-sdk` is not installed.
        RecordingError: Nothing to write, a rollout with NaN, with joints of another robot or with bad times.
        UnknownNameError: No such tip frame.
        OutputError: Another ending, or the file cannot be written.
    """
    try:
        import rerun as rr
        import rerun.blueprint as rrb
    except ImportError as error:
        raise MissingExtraError("writing Rerun recordings (.rrd)", "rerun") from error
    if Path(path).suffix.lower() != ".rrd":
        raise OutputError(f"cannot write {os.fspath(path)!r} for Rerun: its ending must be .rrd")
    named = named_recordings(rollouts)
    guided = {name: guidance_of(robot, name, recording, None, None) for name, recording in named.items()}
    frame = robot.frame(shown_tip(robot, tip, named, guided))
    samples = {name: motion_samples(robot, name, recording) for name, recording in named.items()}
    views = [rrb.TimeSeriesView(name=v, contents=[f"{rr.new_entity_path([n, v])}/**" for n in named]) for v in VIEWS]
    layout = rrb.Horizontal(rrb.Spatial3DView(origin="world", name="robot"), rrb.Vertical(*views))
    # without properties: they hold the time of writing, and files of the same rollouts should be alike
    with rr.RecordingStream(f"manip_learn: {robot.name}", send_properties=False) as stream:
        # in memory: a stream that cannot write to a disk that is full says nothing
        content = rr.memory_recording(recording=stream)
        stream.send_blueprint(rrb.Blueprint(layout), make_active=False)
        stream.send_recording_name(robot.name or "robot")
        _add(stream, ["world"], rr.ViewCoordinates.RIGHT_HAND_Z_UP)
        for (name, recording), (_, colour) in zip(named.items(), rollout_colours(list(named), {}), strict=True):
            rgb, clock = rgb_of(colour), samples[name].time + samples[name].first_time
            _add_robot(stream, robot, name, samples[name], rgb, tinted=len(named) > 1)
            places = np.array([robot.position(q, frame) for q in samples[name].q])
            tip_path = ["world", name, "tip"]
            _add(stream, tip_path, rr.Points3D.from_fields(colors=[rgb], radii=[TIP_RADIUS]))
            _add(stream, tip_path, rr.Points3D.columns(positions=places), time=clock)
            _add(stream, [*tip_path, "path"], rr.LineStrips3D([places], colors=[rgb], radii=[PATH_RADIUS]))
            _add_curves(stream, robot, name, recording, samples[name])
        return write_atomically(path, content.drain_as_bytes())


def _add(stream: rr.RecordingStream, path: list[str], *parts: Any, time: np.ndarray | None = None) -> None:
    """What does not move, or columns over time; names in a path may hold any sign."""
    import rerun as rr

    entity = rr.new_entity_path(path)
    if time is None:
        stream.log(entity, *parts, static=True, strict=True)
    else:
        stream.send_columns(entity, indexes=[rr.TimeColumn("time", duration=time)], columns=parts[0], strict=True)


def _add_robot(
    stream: rr.RecordingStream, robot: Robot, name: str, samples: MotionSamples, rgb: list[int], tinted: bool
) -> None:
    """Poses of the joints in the base over time, and what each joint carries; all of it in one colour if tinted."""
    import rerun as rr
    import trimesh

    model, looks = robot.pinocchio_model, appearance(robot, kinematic_tree(robot))
    data = model.createData()
    poses = np.empty((len(samples.time), model.njoints, 7))
    for k, q in enumerate(samples.q):
        pin.forwardKinematics(model, data, robot.pinocchio_configuration(q))
        poses[k] = [pin.SE3ToXYZQUAT(pose) for pose in data.oMi]
    paths = [["world", name, "robot", str(joint)] for joint in model.names]
    for i in range(1, model.njoints):
        columns = rr.Transform3D.columns(translation=poses[:, i, :3], quaternion=poses[:, i, 3:])
        _add(stream, paths[i], columns, time=samples.time + samples.first_time)
    for k, shape in enumerate(looks.shapes):
        own = [round(255 * c) for c in shape.colour]
        colour = [*rgb, own[3]] if shape.accent or (tinted and shape.joint) else own
        placement = pin.SE3ToXYZQUAT(pin.SE3(shape.pose))
        pose = rr.Transform3D(translation=placement[:3], quaternion=placement[3:])
        mesh = None if shape.mesh is None else looks.meshes[shape.mesh]
        solid: dict[str, Any] = {"colors": [colour], "fill_mode": "solid"}
        if mesh is not None:  # without normals Rerun shades nothing
            normals = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False).vertex_normals
            placed = {"vertex_positions": mesh.vertices, "triangle_indices": mesh.faces, "vertex_normals": normals}
            body = rr.Mesh3D(**placed, albedo_factor=colour)
        elif shape.kind in ("box", "sphere"):
            kind = rr.Boxes3D if shape.kind == "box" else rr.Ellipsoids3D
            body = kind(half_sizes=[shape.half_extent()], **solid)
        else:
            body = rr.Cylinders3D(lengths=[shape.size[1]], radii=[shape.size[0]], **solid)
        _add(stream, [*paths[shape.joint], f"shape_{k}"], pose, body)


def _add_curves(
    stream: rr.RecordingStream, robot: Robot, name: str, recording: Recording, samples: MotionSamples
) -> None:
    """Joints, and what only rollouts have; numbers that are not known (NaN) are left out."""
    import rerun as rr

    clock, joints = samples.time + samples.first_time, robot.joint_names
    curves: dict[tuple[str, ...], tuple[np.ndarray, np.ndarray]] = {}
    for joint, x in zip(joints, np.array([robot.positions(q) for q in samples.q]).T, strict=True):
        curves["position", joint] = clock, x
    for joint, x in zip(joints, samples.u.T, strict=True):
        curves["velocity", joint] = samples.velocity_time + samples.first_time, x
    for kind in CURVES:
        values = getattr(recording, kind, None)
        if values is not None:
            curves[(kind,)] = clock, values
    for path, (time, values) in curves.items():
        known = np.isfinite(values)
        if known.any():
            _add(stream, [name, *path], rr.Scalars.columns(scalars=values[known]), time=time[known])
    changes = status_changes(name, clock, getattr(recording, "status", ()))
    if changes:
        columns = rr.TextLog.columns(text=[word for _, word in changes])
        _add(stream, [name, "status"], columns, time=np.array([time for time, _ in changes]))
