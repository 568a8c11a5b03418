"""ROS bags: the joint states of their topics -> one table of the robot's joints."""

from __future__ import annotations

from array import array as growing
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, final

import numpy as np
from jaxtyping import Float, Int

from manip_learn.errors import RecordingError, advice, closest_names, counted
from manip_learn.recordings.clock import GAP_FACTOR, senders_in_order
from manip_learn.recordings.format_words import JOINT_STATE
from manip_learn.recordings.readers.bag_file import BagFile, open_bag
from manip_learn.recordings.readers.read_request import RATE, ReadRequest, first_names
from manip_learn.recordings.readers.recording import MOST_NAME_LISTS, Recording, check_columns, refusal

USUAL_TOPIC = "/joint_states"
_ARRAYS = {"q": "position", "u": "velocity", "effort": "effort"}  # of messages, and how they call them
PLURAL = {"position": "positions", "velocity": "velocities", "effort": "efforts"}
OTHER_CLOCK = 1_000_000_000  # [ns] by which the clocks of two hosts differ; no message is under way for so long


def read(path: Path, request: ReadRequest) -> Iterator[Recording]:
    """The one recording of a bag; time counts from the first sample."""
    with open_bag(path) as bag:
        topics = _topics(bag, request)
        streams, speeds, notes = _streams(bag, topics)
        others = [t for t in bag.topics if t not in topics]
    notes += [f"other topics, not read: {first_names(others, 6)}"] if others else []
    streams = [replace(s, names=request.renamed(*s.names)) for s in streams]
    joints = request.robot.joint_names
    if not streams:
        for names, n in speeds.items():  # velocities alone are refused where joints are matched, by what they are of
            called = request.renamed(*names)
            if set(called) & set(joints):
                only = (np.empty(n), (), np.empty((n, 0)), called, np.empty((n, len(names))))
                yield Recording(path, path.name, *only, strict_columns=False)
        why = f"; {'; '.join(notes)}" if notes else ""
        text = f"no message of joint states can be used{why}: mend the program that publishes them and record again"
        raise refusal(path, "empty", text)
    if request.rate is not None:  # their order is that of their arrival
        streams = [replace(s, stamps=s.received) for s in streams]
    of_senders, said = _of_senders(streams)
    notes += said
    continuous = frozenset(b.name for b in request.robot.blocks if b.kind == "continuous")
    for number, of_one in enumerate(of_senders, 1):
        recorded = tuple(dict.fromkeys(n for s in of_one for n in s.names))
        try:
            chosen, said = topics_of_joints(of_one, joints)
            if len(chosen) < len(joints):  # the names only, for the message about those that are missing
                yield Recording(
                    path, path.name, np.empty(0), recorded, np.empty((0, len(recorded))), strict_columns=False
                )
                return
            groups, also = joint_groups(of_one, chosen)
            merged, more = merge(groups, continuous)
        except RecordingError as error:
            raise refusal(path, error.code, f"{error}") from error
        own = [*notes, *said, *also, *more]
        if surplus := sorted(set(recorded) - set(joints)):
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
        text = f"there is no {JOINT_STATE} in this bag, it has {there}: record /joint_states"
        raise refusal(bag.path, "no-joint-states", text)
    for topic in request.topics or ():
        if topic not in possible:
            near = ", ".join(closest_names(topic, possible) or possible)
            raise refusal(bag.path, "unknown-topic", f"there is no {JOINT_STATE} topic {topic!r}; there is {near}")
        request.uses.use("topics")
    return possible if request.topics is None else request.topics


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

    def of(self, names: tuple[str, ...]) -> JointStates:
        """Some of its joints."""
        columns = [self.names.index(name) for name in names]
        return replace(self, names=names, **self.each(lambda x: x[:, columns]))

    def each(self, change: Callable[[np.ndarray], np.ndarray]) -> dict[str, Any]:
        """Its arrays, each changed where it is there."""
        return {name: None if (x := getattr(self, name)) is None else change(x) for name in _ARRAYS}

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
        runs, said = senders_in_order(time, self.q[by_arrival], arrival)
        if not runs:
            text = f"the stamps of {self.topic} are in no order" + advice("; pass {}", *RATE)
            raise RecordingError(text, code="time-order")
        notes += [f"{self.topic}: {sentence}" for sentence in said]
        parts = []
        for run in runs:
            k, own = by_arrival[run.samples], first + np.round(run.time * 1e9).astype(np.int64)
            parts.append(replace(self, stamps=own, received=self.received[k], **self.each(lambda x, k=k: x[k])))
        return parts, notes


def _streams(bag: BagFile, topics: tuple[str, ...]) -> tuple[list[JointStates], Counter[tuple[str, ...]], list[str]]:
    """All streams of some topics; joints -> messages with their velocities alone; and what was left out."""
    # header stamps, recorder's stamps, positions, velocities and efforts, as they grow
    tables: dict[tuple[str, tuple[str, ...]], tuple[growing, ...]] = {}
    left_out, speeds = Counter[tuple[str, str]](), Counter[tuple[str, ...]]()
    for topic, received, message in bag.messages(topics):
        names = tuple(message.name)
        if not names or len(message.position) != len(names):
            left_out[topic, _misfit(len(names), len(message.position), "position")] += 1
            speeds.update([names] if 0 < len(names) == len(message.velocity) else [])
            continue
        if (topic, names) not in tables:
            check_columns(bag.path, f"a message of {topic}", len(names))
            if (lists := sum(key[0] == topic for key in tables)) >= MOST_NAME_LISTS:
                text = f"the joints named in {topic} change all the time ({lists} lists)"
                others = [t for t in topics if t != topic] or ["NAME"]
                flags = " ".join(f"--topic {t}" for t in others)
                text += advice(": choose another topic with {}", f"topics={others}", flags)
                raise refusal(bag.path, "unsteady-names", text)
            tables[topic, names] = tuple(map(growing, "qqddd"))
        sent, arrived, *columns = tables[topic, names]
        sent.append(message.header.stamp.sec * 1_000_000_000 + message.header.stamp.nanosec)
        arrived.append(received)
        for values, what in zip(columns, _ARRAYS.values(), strict=True):
            numbers = getattr(message, what)
            if len(numbers) == len(names):
                values.frombytes(np.ascontiguousarray(numbers, dtype=np.float64).tobytes())
            elif len(numbers):
                left_out[topic, f"{_misfit(len(names), len(numbers), what)}: their {PLURAL[what]}"] += 1
    notes = [f"{counted(n, 'message')} of {topic} {why}, not used" for (topic, why), n in left_out.items()]
    streams = []
    for (topic, names), (sent, arrived, *columns) in tables.items():
        T, n = len(sent), len(names)
        for what, values in zip(_ARRAYS.values(), columns, strict=True):
            if 0 < len(values) < T * n:
                some = f"{T - len(values) // n} of {T} messages of {topic} have no {PLURAL[what]}"
                notes.append(f"{some}, so those of the others are not used")
        stamps, received = (np.array(x, dtype=np.int64) for x in (sent, arrived))
        full = (np.array(x).reshape(T, n) if len(x) == T * n else None for x in columns)
        known: dict[str, Any] = dict(zip(_ARRAYS, full, strict=True))
        streams.append(JointStates(topic, names, stamps, **known, received=received))
    return streams, speeds, notes


def _misfit(names: int, numbers: int, what: str) -> str:
    """Why numbers of a message cannot be used."""
    if names and not numbers:
        return f"have no {PLURAL[what]}"
    return f"name {counted(names, 'joint')} and have {counted(numbers, what)}"


def topics_of_joints(streams: list[JointStates], joints: tuple[str, ...]) -> tuple[dict[str, str], list[str]]:
    """Joint -> the topic to read it from, and notes. Joints that no topic has are left out.

    One topic that has all joints is preferred; of several, `/joint_states`.

    Raises:
        RecordingError: Several other topics have a joint.
    """
    carried: dict[str, set[str]] = {}
    for stream in streams:
        carried.setdefault(stream.topic, set()).update(set(stream.names) & set(joints))
    whole = [t for t, names in carried.items() if names == set(joints)]
    chosen: dict[str, str] = {}
    for joint in joints:
        topics = [t for t in whole or carried if joint in carried[t]]
        if len(topics) > 1 and USUAL_TOPIC not in topics:
            text = f"several topics have joint {joint!r}: {', '.join(topics)}; measured and commanded states must not"
            text += " be mixed" + advice(", so say which one: {}", f"topics=[{topics[0]!r}]", f"--topic {topics[0]}")
            raise RecordingError(text, code="ambiguous-topic")
        chosen |= {joint: USUAL_TOPIC if len(topics) > 1 else topics[0]} if topics else {}
    used = list(dict.fromkeys(chosen.values()))
    notes = [f"joint states read from {', '.join(used)}"] if len(carried) > len(used) else []
    if others := [t for t, names in carried.items() if names and t not in used]:
        how = advice(" (choose with {})", "topics=[...]", "--topic NAME")
        notes.append(f"also about these joints, not used: {', '.join(others)}{how}")
    return chosen, notes


def joint_groups(streams: list[JointStates], chosen: dict[str, str]) -> tuple[list[JointStates], list[str]]:
    """Groups of joints with common stamps; every chosen joint is in one group.

    Raises:
        RecordingError: A joint named twice in a message.
    """
    for stream in streams:
        for name, count in Counter(stream.names).items():
            if count > 1 and chosen.get(name) == stream.topic:
                text = f"messages of {stream.topic} name the joint {name!r} {count} times, so it is not known which "
                text += "position is its own: correct the publisher (or the renaming)"
                raise RecordingError(text, code="duplicate-column")
    sets: dict[tuple[str, tuple[str, ...]], list[JointStates]] = {}
    for stream in streams:
        mine = tuple(j for j, topic in chosen.items() if topic == stream.topic and j in stream.names)
        if mine:
            sets.setdefault((stream.topic, mine), []).append(stream)
    sizes = {key: sum(len(s.stamps) for s in some) for key, some in sets.items()}
    groups: list[JointStates] = []
    notes: list[str] = []
    for topic, mine in sorted(sets, key=lambda key: -sizes[key] * len(key[1])):
        taken = {j for group in groups for j in group.names}
        free, lost = tuple(j for j in mine if j not in taken), [j for j in mine if j in taken]
        if lost:
            n = counted(sizes[topic, mine], "message")
            notes.append(f"{n} of {topic} with another list of joints are not used for {', '.join(lost)}")
        if not free:
            continue
        some = [s.of(free) for s in sets[topic, mine]]
        stamps = np.concatenate([s.stamps for s in some])
        order = np.argsort(stamps, kind="stable")
        keep = np.append(np.diff(stamps[order]) != 0, True)
        if len(some) > 1 and not np.all(keep):
            n = counted(np.count_nonzero(~keep), "message")
            notes.append(f"{topic}: {n} left out for a repeated stamp, the last is kept")
            order = order[keep]
        arrays = _combined(some, np.concatenate, order)
        groups.append(JointStates(topic, free, stamps[order], **arrays))
    return groups, notes


def _combined(streams: list[JointStates], combine: Callable[[Any], np.ndarray], samples: np.ndarray) -> dict[str, Any]:
    """Some samples of the arrays of several streams as one each, of which all of them have it."""
    arrays = {name: [getattr(s, name) for s in streams] for name in _ARRAYS}
    return {name: None if any(x is None for x in some) else combine(some)[samples] for name, some in arrays.items()}


def merge(groups: list[JointStates], angles_that_wrap: frozenset[str]) -> tuple[JointStates, list[str]]:
    """All joints at the stamps of the group with the most joints, and notes; the others are interpolated linearly.

    Samples are left out where another group has nothing nearby: before its first and after its last message, and in
    its gaps.

    Raises:
        RecordingError: The publishers do not overlap in time.
    """
    base = max(groups, key=lambda g: (len(g.names), len(g.stamps)))
    others = [g for g in groups if g is not base]
    inside, notes = np.ones(len(base.stamps), dtype=bool), []
    for group in others:  # a message before and after, both close
        known, n = group.stamps, len(group.stamps)
        after = np.clip(np.searchsorted(known, base.stamps), 1, n - 1)
        inside &= (base.stamps >= known[0]) & (base.stamps <= known[-1]) & (n > 1)
        if n > 1:
            inside &= known[after] - known[after - 1] <= GAP_FACTOR * np.median(np.diff(known))
        source = group.topic if group.topic != base.topic else "other messages of the same topic"
        notes.append(f"{', '.join(group.names)} come from {source}: interpolated at the stamps of {base.topic}")
    if not np.any(inside):
        text = "the publishers of the joints do not overlap in time: record them together"
        raise RecordingError(text, code="no-overlap")
    if not np.all(inside):
        notes.append(f"{counted(np.count_nonzero(~inside), 'sample')} left out, where not all publishers have data")
    without = dict.fromkeys(g.topic for g in groups if g.u is None)
    if without and any(g.u is not None for g in groups):
        notes.append(f"velocities are not used, for {', '.join(without)} has none")
    arrays = _combined([base, *(_at(base.stamps, group, angles_that_wrap) for group in others)], np.hstack, inside)
    names = tuple(name for group in (base, *others) for name in group.names)
    return JointStates(base.topic, names, base.stamps[inside], **arrays), notes


def _at(stamps: Int[np.ndarray, " T"], group: JointStates, angles_that_wrap: frozenset[str]) -> JointStates:
    """A group at other stamps."""
    # differences first: nanoseconds since 1970 do not fit into float64
    t, known = ((x - group.stamps[0]).astype(np.float64) for x in (stamps, group.stamps))
    q, wrap = group.q.copy(), [i for i, n in enumerate(group.names) if n in angles_that_wrap]
    q[:, wrap] = np.unwrap(q[:, wrap], axis=0)
    turned = replace(group, q=q)
    return replace(turned, **turned.each(lambda x: np.column_stack([np.interp(t, known, column) for column in x.T])))
