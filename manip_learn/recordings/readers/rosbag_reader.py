"""ROS bags (ROS 1, ROS 2 SQLite and MCAP): the JointState messages of one robot, merged into one table."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from manip_learn.errors import RecordingError, closest_names
from manip_learn.recordings.readers.bag_file import JOINT_STATE, BagFile, open_bag
from manip_learn.recordings.readers.joint_state_merge import MergeError, joint_groups, merge, topics_of_joints
from manip_learn.recordings.readers.joint_state_streams import JointStateStream, joint_state_streams
from manip_learn.recordings.readers.parser_request import ParserRequest
from manip_learn.recordings.readers.recording import Recording


def read(path: Path, request: ParserRequest) -> Iterator[Recording]:
    """The one recording of a bag; time counts from the first sample.

    Raises:
        RecordingError: Damaged, no joint states, topics that contradict each other, joints that no topic has.
    """
    with open_bag(path) as bag:
        topics = _topics(bag, request)
        streams, notes = joint_state_streams(bag, topics)
        notes = [*bag.notes, *notes]
    streams = [_renamed(s, request) for s in streams]
    joints = request.robot.joint_names
    try:
        chosen, said = topics_of_joints(streams, joints)
        notes += said
        if len(chosen) < len(joints):
            yield _without_samples(path, streams)
            return
        groups, said = joint_groups(streams, chosen)
        notes += said
        merged = merge(groups, frozenset(request.robot.continuous))
    except MergeError as error:
        raise RecordingError(f"{path.name}: {error}", code=error.code, path=path) from error
    notes += merged.notes
    surplus = sorted({n for s in streams for n in s.names} - set(joints))
    if surplus:
        notes.append(f"also recorded, not moved by the robot as loaded, not used: {', '.join(surplus)}")
    yield Recording(
        path=path,
        name=path.name,
        time=(merged.stamps - merged.stamps[0]).astype(np.float64) * 1e-9,
        position_names=merged.names,
        positions=merged.q,
        velocity_names=merged.names if merged.u is not None else (),
        velocities=merged.u,
        effort_names=merged.names if merged.effort is not None else (),
        efforts=merged.effort,
        strict_columns=False,
        in_seconds=True,
        notes=tuple(notes),
    )


def _topics(bag: BagFile, request: ParserRequest) -> tuple[str, ...]:
    if not bag.joint_topics:
        there = ", ".join(f"{t} ({k})" for t, k in list(bag.topics.items())[:8]) or "no topics"
        raise RecordingError(
            f"{bag.path.name}: there is no {JOINT_STATE} in this bag, it has {there}: record /joint_states",
            code="no-joint-states",
            path=bag.path,
        )
    if request.topics is None:
        return bag.joint_topics
    for topic in request.topics:
        if topic not in bag.joint_topics:
            near = closest_names(topic, bag.joint_topics) or list(bag.joint_topics)
            raise RecordingError(
                f"{bag.path.name}: there is no {JOINT_STATE} topic {topic!r}; there is {', '.join(near)}",
                code="unknown-topic",
                path=bag.path,
            )
    request.uses.use("topics")
    return request.topics


def _renamed(stream: JointStateStream, request: ParserRequest) -> JointStateStream:
    return replace(stream, names=tuple(request.renamed(n) for n in stream.names))


def _without_samples(path: Path, streams: list[JointStateStream]) -> Recording:
    """The names only, for the message about those that are missing."""
    if not any(len(s.stamps) for s in streams):
        raise RecordingError(f"{path.name}: the joint-state topics of the bag have no message", code="empty", path=path)
    names = tuple(dict.fromkeys(n for s in streams for n in s.names))
    return Recording(path, path.name, np.empty(0), names, np.empty((0, len(names))), strict_columns=False)
