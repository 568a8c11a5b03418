"""ROS bags: the joint states of their topics -> one table of the robot's joints."""

from __future__ import annotations

from array import array as growing
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, final

import numpy as np
from jaxtyping import Float, Int

from manip_learn.errors import RecordingError, advice, closest_names, counted
from manip_learn.recordings.clock import GAP_FACTOR, in_order
from manip_learn.recordings.format_words import JOINT_STATE, RATE
from manip_learn.recordings.readers.bag_file import BagFile, open_bag
from manip_learn.recordings.readers.limits import MOST_NAME_LISTS, check_columns
from manip_learn.recordings.readers.read_request import ReadRequest, first_names
from manip_learn.recordings.readers.recording import Recording, refusal

USUAL_TOPIC = "/joint_states"
PLURAL = {"position": "positions", "velocity": "velocities", "effort": "efforts"}
OTHER_CLOCK = 1_000_000_000  # [ns] by which the clocks of two hosts differ; no message is under way for so long


def read(path: Path, request: ReadRequest) -> Iterator[Recording]:
    """The one recording of a bag; time counts from the first sample."""
    with open_bag(path) as bag:
        topics = _topics(bag, request)
        streams, notes = _streams(bag, topics)
        others = [t for t in bag.topics if t not in topics]
    notes += [f"other topics, not read: {first_names(others, 6)}"] if others else []
    streams = [replace(s, names=request.renamed(*s.names)) for s in streams]
    joints = request.robot.joint_names
    if not streams:
        why = f"; {'; '.join(notes)}" if notes else ""
        text = f"no message of joint states can be used{why}: mend the program that publishes them and record again"
        raise refusal(path, "empty", text)
    if request.rate is not None:  # their order is that of their arrival
        streams = [replace(s, stamps=s.received) for s in streams]
    of_senders, said = _of_senders(streams)
    notes += said
    continuous = frozenset(b.name for b in request.robot.blocks if b.kind == "continuous")
    for number, of_one in enumerate(of_senders, 1):
        try:
            chosen, said = topics_of_joints(of_one, joints)
            if len(chosen) == len(joints):
                groups, also = joint_groups(of_one, chosen)
                merged, more = merge(groups, continuous)
        except RecordingError as error:
            raise refusal(path, error.code, f"{error}") from error
        if len(chosen) < len(joints):  # the names only, for the message about those that are missing
            names = tuple(dict.fromkeys(n for s in of_one for n in s.names))
            yield Recording(path, path.name, np.empty(0), names, np.empty((0, len(names))), strict_columns=False)
            return
        own = [*notes, *said, *also, *more]
        surplus = sorted({n for s in of_one for n in s.names} - set(joints))
        if surplus:
            own.append(f"also recorded, not moved by the robot as loaded, not used: {', '.join(surplus)}")
        time = (merged.stamps - merged.stamps[0]).astype(np.float64) * 1e-9
        known = {"strict_columns": False, "in_seconds": True, "notes": tuple(own)}
        name = f"{path.name} sender {number}" if len(of_senders) > 1 else path.name
        yield Recording.of(path, name, time, merged.names, merged.q, merged.u, merged.effort, **known)


def _of_senders(streams: list[JointStates]) -> tuple[list[list[JointStates]], list[str]]:
    """The streams of each of several senders, whose clocks differ, each in the order of its time; and notes."""
    parts: list[list[JointStates]] = []
    notes: list[str] = []
    for stream in streams:
        runs, said = stream.in_order()
        parts.append(runs)
        notes += [sentence for sentence in said if sentence not in notes]
    clock = parts[0][0].clock
    for runs in parts:
        for k, one in enumerate(runs):
            if abs(ahead := one.clock - clock) > OTHER_CLOCK:
                runs[k] = replace(one, stamps=one.stamps - ahead)
                note = f"{one.topic}: a clock {ahead * 1e-9:.3g} s ahead was set to the first by when messages came"
                notes += [note] if note not in notes else []
    most = max(map(len, parts))
    return [[runs[min(k, len(runs) - 1)] for runs in parts] for k in range(most)], notes


def _topics(bag: BagFile, request: ReadRequest) -> tuple[str, ...]:
    """Topics of joint states: those that were asked for, else all."""
    possible = tuple(topic for topic, kind in bag.topics.items() if kind == JOINT_STATE)
    if not possible:
        there = ", ".join(f"{t} ({k})" for t, k in list(bag.topics.items())[:8]) or "no topics"
        raise refusal(
            bag.path, "no-joint-states", f"there is no {JOINT_STATE} in this bag, it has {there}: record /joint_states"
        )
    if request.topics is None:
        return possible
    for topic in request.topics:
        if topic not in possible:
            near = closest_names(topic, possible) or list(possible)
            raise refusal(
                bag.path, "unknown-topic", f"there is no {JOINT_STATE} topic {topic!r}; there is {', '.join(near)}"
            )
    request.uses.use("topics")
    return request.topics


@final
@dataclass(frozen=True, eq=False)
class JointStates:
    """The messages of one topic about one list of joints, or what was made of several of these.

    Attributes:
        topic: Topic.
        names: Joints.
        stamps: shape (T,), header stamps [ns].
        q: shape (T, n).
        u: shape (T, n), or None if any message has none.
        effort: shape (T, n), likewise.
        received: shape (T,), stamps of the recorder [ns]; of messages as they were read.
    """

    topic: str
    names: tuple[str, ...]
    stamps: Int[np.ndarray, " T"]
    q: Float[np.ndarray, "T n"]
    u: Float[np.ndarray, "T n"] | None
    effort: Float[np.ndarray, "T n"] | None = None
    received: Int[np.ndarray, " T"] = field(default_factory=lambda: np.empty(0, dtype=np.int64))

    def part(self, samples: Int[np.ndarray, " k"], stamps: Int[np.ndarray, " k"]) -> JointStates:
        """Some messages, with these stamps."""
        u, effort = (None if x is None else x[samples] for x in (self.u, self.effort))
        return replace(self, stamps=stamps, q=self.q[samples], u=u, effort=effort, received=self.received[samples])

    @property
    def clock(self) -> int:
        """How far its stamps are ahead of the recorder's [ns]."""
        return int(np.median(self.stamps - self.received))

    def in_order(self) -> tuple[list[JointStates], list[str]]:
        """The messages of each sender in the order of their times, and notes.

        Raises:
            RecordingError: They are in no order.
        """
        stamps, notes = self.stamps, []
        if np.any(stamps == 0) or (len(stamps) > 1 and np.ptp(stamps) == 0):
            stamps = self.received
            notes.append(f"{self.topic}: header stamps are not set, the recorder's stamps are used")
        by_arrival = np.argsort(self.received, kind="stable")
        first = int(stamps.min())
        # differences first: nanoseconds since 1970 do not fit into float64
        time = (stamps - first)[by_arrival].astype(np.float64) * 1e-9
        arrival = (self.received - self.received.min())[by_arrival].astype(np.float64) * 1e-9
        runs, said = in_order(time, self.q[by_arrival], arrival)
        if not runs:
            raise RecordingError(
                f"the stamps of {self.topic} are in no order" + advice("; pass {}", *RATE),
                code="time-order",
            )
        notes += [f"{self.topic}: {sentence}" for sentence in said]
        parts = [(by_arrival[run.samples], first + np.round(run.time * 1e9).astype(np.int64)) for run in runs]
        return [self.part(*part) for part in parts], notes


def _streams(bag: BagFile, topics: tuple[str, ...]) -> tuple[list[JointStates], list[str]]:
    """All streams of some topics, and what was left out."""
    # header stamps, recorder's stamps, positions, velocities and efforts, as they grow
    joints: dict[tuple[str, tuple[str, ...]], tuple[growing, ...]] = {}
    left_out: Counter[tuple[str, str]] = Counter()
    for topic, received, message in bag.messages(topics):
        names = tuple(message.name)
        if not names or len(message.position) != len(names):
            left_out[topic, _misfit(len(names), len(message.position), "position")] += 1
            continue
        stream = joints.get((topic, names))
        if stream is None:
            check_columns(bag.path, f"a message of {topic}", len(names))
            if (known := sum(key[0] == topic for key in joints)) >= MOST_NAME_LISTS:
                text = f"the joints named in {topic} change all the time ({known} lists)"
                others = [t for t in topics if t != topic] or ["NAME"]
                flags = " ".join(f"--topic {t}" for t in others)
                text += advice(": choose another topic with {}", f"topics={others}", flags)
                raise refusal(bag.path, "unsteady-names", text)
            stream = joints[topic, names] = tuple(map(growing, "qqddd"))
        stream[0].append(message.header.stamp.sec * 1_000_000_000 + message.header.stamp.nanosec)
        stream[1].append(received)
        for values, what in zip(stream[2:], ("position", "velocity", "effort"), strict=True):
            numbers = getattr(message, what)
            if len(numbers) == len(names):
                values.frombytes(np.ascontiguousarray(numbers, dtype=np.float64).tobytes())
            elif len(numbers):
                left_out[topic, f"{_misfit(len(names), len(numbers), what)}: their {PLURAL[what]}"] += 1
    notes = [f"{counted(n, 'message')} of {topic} {why}, not used" for (topic, why), n in left_out.items()]
    streams = []
    for (topic, names), (stamps, received, *columns) in joints.items():
        T, n = len(stamps), len(names)
        q, u, effort = (np.array(x).reshape(T, n) if len(x) == T * n else None for x in columns)
        for what, values, array in (("velocities", columns[1], u), ("efforts", columns[2], effort)):
            if array is None and len(values):
                without = T - len(values) // n
                notes.append(
                    f"{without} of {T} messages of {topic} have no {what}, so those of the others are not used"
                )
        sent, arrived = (np.array(x, dtype=np.int64) for x in (stamps, received))
        streams.append(JointStates(topic, names, sent, q, u, effort, arrived))  # type: ignore[arg-type]
    return streams, notes


def _misfit(names: int, numbers: int, what: str) -> str:
    """Why numbers of a message cannot be used."""
    if names and not numbers:
        return f"have no {PLURAL[what]}"
    return f"name {counted(names, 'joint')} and have {counted(numbers, what)}"


def topics_of_joints(streams: list[JointStates], joints: tuple[str, ...]) -> tuple[dict[str, str], list[str]]:
    """Joint -> the topic to read it from, and notes. Joints that no topic has are left out.

    One topic that has all joints is preferred; of several, `/joint_states`.
    """
    carried: dict[str, set[str]] = {}
    for stream in streams:
        carried.setdefault(stream.topic, set()).update(set(stream.names) & set(joints))
    whole = [t for t, names in carried.items() if names == set(joints)]
    if whole:
        topic = _preferred(whole, "all joints")
        others = [t for t, names in carried.items() if names and t != topic]
        notes = [f"joint states read from {topic}"] if len(carried) > 1 else []
        if others:
            notes.append(
                f"also about these joints, not used: {', '.join(others)}"
                + advice(" (choose with {})", "topics=[...]", "--topic NAME")
            )
        return dict.fromkeys(joints, topic), notes
    chosen = {}
    for joint in joints:
        topics = [t for t, names in carried.items() if joint in names]
        if topics:
            chosen[joint] = _preferred(topics, f"joint {joint!r}")
    return chosen, []


def _preferred(topics: list[str], what: str) -> str:
    if len(topics) == 1:
        return topics[0]
    if USUAL_TOPIC in topics:
        return USUAL_TOPIC
    raise RecordingError(
        f"several topics have {what}: {', '.join(topics)}; measured and commanded states must not be mixed"
        + advice(", so say which one: {}", f"topics=[{topics[0]!r}]", f"--topic {topics[0]}"),
        code="ambiguous-topic",
    )


def joint_groups(streams: list[JointStates], chosen: dict[str, str]) -> tuple[list[JointStates], list[str]]:
    """Groups of joints with common stamps; every chosen joint is in one group.

    Raises:
        RecordingError: A joint named twice in a message.
    """
    for stream in streams:
        for name, count in Counter(stream.names).items():
            if count > 1 and chosen.get(name) == stream.topic:
                raise RecordingError(
                    f"messages of {stream.topic} name the joint {name!r} {count} times, so it is "
                    "not known which position is its own: correct the publisher (or the renaming)",
                    code="duplicate-column",
                )
    sets: dict[tuple[str, tuple[str, ...]], list[JointStates]] = {}
    for stream in streams:
        mine = tuple(j for j, topic in chosen.items() if topic == stream.topic and j in stream.names)
        if mine:
            sets.setdefault((stream.topic, mine), []).append(stream)
    order = sorted(sets, key=lambda key: -sum(len(s.stamps) for s in sets[key]) * len(key[1]))
    groups: list[JointStates] = []
    notes: list[str] = []
    taken: set[str] = set()
    for topic, mine in order:
        free = tuple(j for j in mine if j not in taken)
        if free:
            taken.update(free)
            group, said = _group(topic, free, sets[topic, mine])
            groups.append(group)
            notes += said
        if len(free) < len(mine):
            n = sum(len(s.stamps) for s in sets[topic, mine])
            lost = ", ".join(j for j in mine if j not in free)
            notes.append(f"{counted(n, 'message')} of {topic} with another list of joints are not used for {lost}")
    return groups, notes


def _group(topic: str, names: tuple[str, ...], streams: list[JointStates]) -> tuple[JointStates, list[str]]:
    def joined(what: str) -> Any:
        """An array of all streams, if all of them have it."""
        arrays = [(getattr(s, what), [s.names.index(n) for n in names]) for s in streams]
        return None if any(a is None for a, _ in arrays) else np.concatenate([a[:, k] for a, k in arrays])

    stamps = np.concatenate([s.stamps for s in streams])
    notes, order = [], np.argsort(stamps, kind="stable")
    keep = np.append(np.diff(stamps[order]) != 0, True)
    if len(streams) > 1 and not np.all(keep):
        notes.append(
            f"{topic}: {counted(np.count_nonzero(~keep), 'message')} left out for a repeated stamp, the last is kept"
        )
        order = order[keep]
    arrays: list[Any] = [x if x is None else x[order] for x in map(joined, ("q", "u", "effort"))]
    return JointStates(topic, names, stamps[order], *arrays), notes


def merge(groups: list[JointStates], angles_that_wrap: frozenset[str]) -> tuple[JointStates, list[str]]:
    """All joints at the stamps of the group with the most joints, and notes; the others are interpolated linearly.

    Samples are left out where another group has nothing nearby: before its first and after its last message, and in
    its gaps.

    Raises:
        RecordingError: The publishers do not overlap in time.
    """
    base = max(groups, key=lambda g: (len(g.names), len(g.stamps)))
    inside = np.ones(len(base.stamps), dtype=bool)
    q, u, effort, names, notes = [base.q], [base.u], [base.effort], list(base.names), []
    for group in groups:
        if group is base:
            continue
        own, wrap = group.q.copy(), [i for i, n in enumerate(group.names) if n in angles_that_wrap]
        own[:, wrap] = np.unwrap(own[:, wrap], axis=0)
        q.append(_at(base.stamps, group.stamps, own))
        u.append(None if group.u is None else _at(base.stamps, group.stamps, group.u))
        effort.append(None if group.effort is None else _at(base.stamps, group.stamps, group.effort))
        names += group.names
        # a message of the other group before and after, both close
        own, known = base.stamps, group.stamps
        after = np.clip(np.searchsorted(known, own), 1, len(known) - 1)
        inside &= (own >= known[0]) & (own <= known[-1]) & (len(known) > 1)
        if len(known) > 1:
            inside &= known[after] - known[after - 1] <= GAP_FACTOR * np.median(np.diff(known))
        source = f"{group.topic}" if group.topic != base.topic else "other messages of the same topic"
        notes.append(f"{', '.join(group.names)} come from {source}: interpolated at the stamps of {base.topic}")
    if not np.any(inside):
        raise RecordingError(
            "the publishers of the joints do not overlap in time: record them together", code="no-overlap"
        )
    if not np.all(inside):
        notes.append(f"{counted(np.count_nonzero(~inside), 'sample')} left out, where not all publishers have data")
    without = [g.topic for g in groups if g.u is None]
    some_u = [x for x in u if x is not None]
    all_u = np.hstack(some_u)[inside] if not without else None
    if without and some_u:
        notes.append(f"velocities are not used, for {', '.join(dict.fromkeys(without))} has none")
    some = [x for x in effort if x is not None]
    efforts = np.hstack(some)[inside] if len(some) == len(groups) else None
    return JointStates(base.topic, tuple(names), base.stamps[inside], np.hstack(q)[inside], all_u, efforts), notes


def _at(
    stamps: Int[np.ndarray, " T"], known: Int[np.ndarray, " S"], values: Float[np.ndarray, "S n"]
) -> Float[np.ndarray, "T n"]:
    # differences first: nanoseconds since 1970 do not fit into float64
    t, own = (stamps - known[0]).astype(np.float64), (known - known[0]).astype(np.float64)
    return np.column_stack([np.interp(t, own, values[:, i]) for i in range(values.shape[1])])
