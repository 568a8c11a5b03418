"""Rollouts and recordings -> one .rrd file for the Rerun viewer."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path

from manip_learn.atomic_write import write_atomically
from manip_learn.errors import OutputError
from manip_learn.playback.appearance import appearance
from manip_learn.playback.guided_motion import guidance_of, motion_samples
from manip_learn.playback.kinematic_tree import kinematic_tree
from manip_learn.playback.palette import rollout_colours
from manip_learn.playback.replay_page import Recording, named_recordings, shown_tip
from manip_learn.robot.robot import Robot


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
    in the robot's base with its shapes, `world/NAME/tip` the tip and its path, `world/NAME/target` the target where
    it is a place. The timeline `time` is the recording's own clock [s].

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
    from manip_learn.playback.rerun_stream import RerunStream

    if Path(path).suffix.lower() != ".rrd":
        raise OutputError(f"cannot write {os.fspath(path)!r} for Rerun: its ending must be .rrd")
    named = named_recordings(rollouts)
    guided = {name: guidance_of(robot, name, recording, None, None) for name, recording in named.items()}
    frame = robot.frame(shown_tip(robot, tip, named, guided))
    samples = {name: motion_samples(robot, name, recording) for name, recording in named.items()}
    colours = rollout_colours(list(named), {})
    stream = RerunStream(robot, appearance(robot, kinematic_tree(robot)), list(named))
    for (name, recording), (_, colour) in zip(named.items(), colours, strict=True):
        stream.add(name, recording, samples[name], frame, colour)
        stream.add_target(name, guided[name], samples[name].q[0])
    return write_atomically(path, stream.finished())
