"""ROS bags, written by the rosbags library: what was published comes back, for any publisher."""

from __future__ import annotations

import bz2
import shutil
import sqlite3
import struct
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from case import case
from recording_corpus import refusal

from manip_learn.recordings import load_demonstrations
from manip_learn.robot import Robot

pytest.importorskip("rosbags", reason="the extra 'ros' is not installed")

from rosbags.rosbag1 import Writer as Writer1  # noqa: E402
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin  # noqa: E402
from rosbags.rosbag2 import Writer as Writer2  # noqa: E402
from rosbags.rosbag2.reader import zstd  # noqa: E402
from rosbags.typesys import Stores, get_typestore  # noqa: E402

ROS1, ROS2 = get_typestore(Stores.ROS1_NOETIC), get_typestore(Stores.ROS2_JAZZY)
JOINT_STATE = "sensor_msgs/msg/JointState"
JOINTS = ("joint1", "joint2", "joint3")
START = 1_700_000_000_123_456_789
STEPS = np.arange(200, dtype=np.int64) * 10_000_000
T = STEPS * 1e-9
Q = np.column_stack([np.sin(T), 1.0 + np.cos(T), 0.5 * T])
U = np.column_stack([np.cos(T), -np.sin(T), 0.5 + 0.0 * T])
KINDS = ("ros1", "sqlite", "mcap")


def joint_state(types, stamp: int, names, q, u=(), effort=(), frame: str = "base"):
    extra = {"seq": 7} if types is ROS1 else {}
    header = types.types["std_msgs/msg/Header"](
        stamp=types.types["builtin_interfaces/msg/Time"](sec=stamp // 10**9, nanosec=stamp % 10**9),
        frame_id=frame,
        **extra,
    )
    arrays = [np.asarray(x, dtype=np.float64) for x in (q, u, effort)]
    return types.types[JOINT_STATE](header, list(names), *arrays)


def write_bag(path: Path, kind: str, messages: list[tuple[str, int, object]], **options) -> Path:
    """A bag of (topic, recorder's stamp, JointState without its header's types); returns its path.

    `foreign` is the definition of a message on `/odd`.
    """
    types = ROS1 if kind == "ros1" else ROS2
    if kind == "ros1":
        path = path.with_suffix(".bag")
        writer = Writer1(path)
        if "compression" in options:
            writer.set_compression(options["compression"])
    else:
        plugin = StoragePlugin.SQLITE3 if kind == "sqlite" else StoragePlugin.MCAP
        writer = Writer2(path, version=9, storage_plugin=plugin)
        if "mode" in options:
            writer.set_compression(options["mode"], CompressionFormat.ZSTD)
    with writer:
        if "foreign" in options:
            digest = {"md5sum": "0" * 32} if kind == "ros1" else {"rihs01": "RIHS01_" + "0" * 64}
            writer.add_connection("/odd", "company_msgs/msg/Odd", msgdef=options["foreign"], **digest)
        connections = {}
        for topic, stamp, content in messages:
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, JOINT_STATE, typestore=types)
            message = joint_state(types, *content)
            raw = (
                types.serialize_ros1(message, JOINT_STATE)
                if kind == "ros1"
                else types.serialize_cdr(message, JOINT_STATE)
            )
            writer.write(connections[topic], stamp, raw)
    return path


def all_in_one(names=JOINTS, q=Q, u=U, topic="/joint_states", delay: int = 3_000_000):
    order = [JOINTS.index(n) for n in names]
    return [
        (topic, START + int(s) + delay, (START + int(s), names, a[order], b[order] if u is not None else ()))
        for s, a, b in zip(STEPS, q, U if u is None else u, strict=True)
    ]


def test_round_trip(planar3: Robot) -> None:
    """Positions and velocities come back bit for bit, matched by name; time is the header's, from 0."""
    for kind in KINDS:
        with case(kind) as tmp_path:
            demos = load_demonstrations(
                write_bag(tmp_path / "bag", kind, all_in_one(("joint3", "joint1", "joint2"))), planar3
            )
            assert len(demos) == 1 and demos.notes == ()
            np.testing.assert_array_equal(demos[0].q, Q)
            np.testing.assert_array_equal(demos[0].u, U)
            np.testing.assert_allclose(demos[0].time, T, rtol=0, atol=1e-12)


def test_efforts_come_back(planar3: Robot, tmp_path: Path) -> None:
    """Matched by name, also where the joints come in messages of their own; none where some messages have none."""
    order, names = [2, 0, 1], ("joint3", "joint1", "joint2")
    whole = [
        ("/joint_states", START + int(s), (START + int(s), names, q[order], (), 7.0 * q[order]))
        for s, q in zip(STEPS, Q, strict=True)
    ]
    (t,) = load_demonstrations(write_bag(tmp_path / "whole", "ros1", whole), planar3)
    np.testing.assert_array_equal(t.effort, 7.0 * Q)
    apart = [
        (topic, START + int(s), (START + int(s), [JOINTS[i] for i in part], q[part], (), 7.0 * q[part]))
        for s, q in zip(STEPS, Q, strict=True)
        for topic, part in (("/arm", [0, 1]), ("/wrist", [2]))
    ]
    (t,) = load_demonstrations(write_bag(tmp_path / "apart", "sqlite", apart), planar3)
    np.testing.assert_allclose(t.effort, 7.0 * t.q, rtol=0, atol=1e-12)
    some = [(topic, at, content[:4] if i == 20 else content) for i, (topic, at, content) in enumerate(whole)]
    assert load_demonstrations(write_bag(tmp_path / "some", "mcap", some), planar3)[0].effort is None


def test_a_bag_is_recognised_by_content(planar3: Robot) -> None:
    """A single bag file with a misleading name, and unusual characters in its path, is read."""
    for kind in KINDS:
        with case(kind) as tmp_path:
            bag = write_bag(tmp_path / "bag", kind, all_in_one())
            file = bag if bag.is_file() else next(p for p in bag.iterdir() if p.suffix in (".db3", ".mcap"))
            odd = tmp_path / "a b?#%20&x.csv"
            shutil.copy(file, odd)
            np.testing.assert_array_equal(load_demonstrations(odd, planar3)[0].q, Q)


def test_compressed_bags(planar3: Robot) -> None:
    """Both compressions of ROS 1; messages, files and MCAP blocks of ROS 2."""
    for kind, options in [
        ("ros1", {"compression": Writer1.CompressionFormat.BZ2}),
        ("ros1", {"compression": Writer1.CompressionFormat.LZ4}),
        ("sqlite", {"mode": CompressionMode.MESSAGE}),
        ("sqlite", {"mode": CompressionMode.FILE}),
        ("mcap", {"mode": CompressionMode.STORAGE}),
    ]:
        with case(kind, options) as tmp_path:
            bag = write_bag(tmp_path / "bag", kind, all_in_one(), **options)
            np.testing.assert_array_equal(load_demonstrations(bag, planar3)[0].q, Q)


def test_velocities_without_positions_are_named(planar3: Robot, tmp_path: Path) -> None:
    """A publisher that leaves the positions empty: not "no message", but what was recorded, and how often."""
    messages = [(t, r, (s, names, (), u)) for t, r, (s, names, _, u) in all_in_one()]
    said = "velocities of 3 joints are recorded in 200 samples and no positions"
    assert refusal(write_bag(tmp_path / "bag", "ros1", messages), planar3, match=said).code == "no-positions"
    of_others = [(t, r, (s, ("a", "b", "c"), q, u)) for t, r, (s, _, q, u) in messages]
    said = "200 messages of /joint_states have no positions"
    assert refusal(write_bag(tmp_path / "others", "mcap", of_others), planar3, match=said).code == "empty"


def test_several_publishers_are_merged_by_name(planar3: Robot, tmp_path: Path) -> None:
    """Joints from two topics, one at half the rate and half a step late, are put on common stamps, and it is said."""
    arm = [
        ("/arm", START + int(s), (START + int(s), ("joint2", "joint1"), q[[1, 0]]))
        for s, q in zip(STEPS, Q, strict=True)
    ]
    late = STEPS[::2] + 5_000_000
    slide = [("/slide", START + int(s), (START + int(s), ("joint3", "finger"), (0.5 * s * 1e-9, 0.01))) for s in late]
    messages = sorted([*arm, *slide], key=lambda m: m[1])
    demos = load_demonstrations(write_bag(tmp_path / "bag", "mcap", messages), planar3)
    np.testing.assert_allclose(demos[0].q, Q[1:-1], rtol=0, atol=1e-9)
    said = " ".join(demos.notes)
    assert "joint3 come from /slide: interpolated" in said and "finger" in said and "2 samples left out" in said


def test_two_kinds_of_messages_on_one_topic_are_merged(planar3: Robot, tmp_path: Path) -> None:
    """Arm and gripper that share /joint_states, in messages of their own, are one recording."""
    messages = []
    for s, q in zip(STEPS, Q, strict=True):
        stamp = START + int(s)
        messages.append(("/joint_states", stamp, (stamp, ("joint1", "joint2"), q[:2], U[0, :2])))
        messages.append(("/joint_states", stamp, (stamp, ("joint3",), q[2:])))
    demos = load_demonstrations(write_bag(tmp_path / "bag", "sqlite", messages), planar3)
    np.testing.assert_allclose(demos[0].q, Q, rtol=0, atol=1e-12)
    assert demos[0].u is None and "velocities are not used" in " ".join(demos.notes)


def test_measured_and_commanded_states_are_not_mixed(planar3: Robot, tmp_path: Path) -> None:
    """Two topics with the same joints: a question, unless one is of commands; topics=[...] answers it; /joint_states is
    preferred, said aloud.
    """
    messages = sorted([*all_in_one(topic="/real"), *all_in_one(q=Q + 0.1, topic="/other")], key=lambda m: m[1])
    bag = write_bag(tmp_path / "two", "mcap", messages)
    assert refusal(bag, planar3, match=r"topics=\['/real'\]").code == "ambiguous-topic"
    messages = sorted([*all_in_one(topic="/real"), *all_in_one(q=Q + 0.1, topic="/command")], key=lambda m: m[1])
    bag = write_bag(tmp_path / "bag", "mcap", messages)
    demos = load_demonstrations(bag, planar3)
    assert np.array_equal(demos[0].q, Q) and "/command" in " ".join(demos.notes)
    np.testing.assert_array_equal(load_demonstrations(bag, planar3, topics=["/command"])[0].q, Q + 0.1)
    refusal(bag, planar3, match="/command", topics=["/wnted"])
    messages = sorted([*all_in_one(), *all_in_one(q=Q + 0.1, topic="/command")], key=lambda m: m[1])
    demos = load_demonstrations(write_bag(tmp_path / "usual", "mcap", messages), planar3)
    np.testing.assert_array_equal(demos[0].q, Q)
    assert "/command" in " ".join(demos.notes)


def test_a_forgotten_gui_is_noticed(planar3: Robot, tmp_path: Path) -> None:
    """Two publishers that take turns on one topic are refused by the samples alone, with the joint and the cause."""
    gui = [(t, r + 4_000_000, (s + 4_000_000, n, Q[0] + 0.4, ())) for t, r, (s, n, *_) in all_in_one(u=None)]
    bag = write_bag(tmp_path / "bag", "sqlite", sorted([*all_in_one(u=None), *gui], key=lambda m: m[1]))
    error = refusal(bag, planar3, match="Two programs published on one topic")
    assert error.code == "two-publishers" and error.column in JOINTS


def test_a_joint_named_twice_in_a_message_is_refused(planar3: Robot, tmp_path: Path) -> None:
    """Also in a single message of many; a name that the robot does not have does not matter."""
    messages = all_in_one(u=None)
    topic, received, (stamp, _, q, _) = messages[70]
    messages[70] = (topic, received, (stamp, ("joint1", "joint2", "joint3", "joint2"), (*q, 0.5)))
    bag = write_bag(tmp_path / "bag", "mcap", messages)
    assert refusal(bag, planar3, match="name the joint 'joint2' 2 times").code == "duplicate-column"
    messages = [(t, r, (s, (*n, "x", "x"), (*q, 0, 0))) for t, r, (s, n, q, _) in all_in_one(u=None)]
    (demo,) = load_demonstrations(write_bag(tmp_path / "other", "ros1", messages), planar3)
    assert len(demo) == len(Q) and demo.u is None


def test_messages_that_differ_are_named(planar3: Robot, tmp_path: Path) -> None:
    """One message with another list of joints, without velocities, or short of a position: nothing goes in silence."""
    messages = all_in_one()
    topic, received, (stamp, _, q, u) = messages[70]
    messages[70] = (topic, received, (stamp, ("joint1", "joint2", "jointX"), q, u))
    demos = load_demonstrations(write_bag(tmp_path / "names", "mcap", messages), planar3)
    assert "1 message of /joint_states with another list of joints are not used" in " ".join(demos.notes)
    messages[70] = (topic, received, (stamp, JOINTS, q))
    demos = load_demonstrations(write_bag(tmp_path / "velocities", "mcap", messages), planar3)
    assert demos[0].u is None and "1 of 200 messages of /joint_states have no velocities" in " ".join(demos.notes)
    messages[70] = (topic, received, (stamp, JOINTS, q[:2]))
    notes = load_demonstrations(write_bag(tmp_path / "short", "mcap", messages), planar3).notes
    assert "1 message of /joint_states name 3 joints and have 2 positions, not used" in " ".join(notes)


def test_stamps_that_are_not_set(planar3: Robot, tmp_path: Path) -> None:
    """Without header stamps those of the recorder are used, and it is said."""
    for every in (1, 50):  # of all messages, and of some
        zero = [(t, r, (0 if i % every == 0 else c[0], *c[1:])) for i, (t, r, c) in enumerate(all_in_one())]
        demos = load_demonstrations(write_bag(tmp_path / f"zero_{every}", "mcap", zero), planar3)
        np.testing.assert_allclose(demos[0].time, T, rtol=0, atol=1e-12)
        assert "not set" in " ".join(demos.notes)


def test_big_endian_messages(planar3: Robot, tmp_path: Path, monkeypatch) -> None:
    """CDR of the other byte order is read as well."""
    monkeypatch.setattr(ROS2, "serialize_cdr", partial(ROS2.serialize_cdr, little_endian=False))
    demos = load_demonstrations(write_bag(tmp_path / "bag", "mcap", all_in_one()), planar3)
    np.testing.assert_array_equal(demos[0].q, Q)
    np.testing.assert_array_equal(demos[0].u, U)


def test_a_foreign_message_without_a_definition_does_not_matter(planar3: Robot) -> None:
    """A message whose definition refers to one that is missing: the joint states are read all the same."""
    for kind in KINDS:
        with case(kind) as tmp_path:
            bag = write_bag(tmp_path / "bag", kind, all_in_one(), foreign="uint8 x\ncompany_msgs/Missing y\n")
            np.testing.assert_array_equal(load_demonstrations(bag, planar3)[0].q, Q)


def test_a_bomb_in_a_ros1_bag_is_refused(planar3: Robot, tmp_path: Path) -> None:
    """A block of 100 bytes that unpacks to 64 MB is refused before it is unpacked."""
    bag = write_bag(tmp_path / "bag", "ros1", all_in_one(), compression=Writer1.CompressionFormat.BZ2)
    content = bag.read_bytes()
    start = content.index(b"BZh")
    (size,) = struct.unpack_from("<I", content, start - 4)
    bomb = bz2.compress(bytes(64_000_000))
    bomb += bytes(size - len(bomb))
    bag.write_bytes(content[:start] + bomb + content[start + size :])
    assert refusal(bag, planar3).code == "bomb"


def test_a_bomb_in_an_mcap_is_refused(planar3: Robot, tmp_path: Path) -> None:
    """Blocks that claim a terabyte are refused before they are unpacked."""
    bag = write_bag(tmp_path / "bag", "mcap", all_in_one(), mode=CompressionMode.STORAGE)
    file = next(bag.glob("*.mcap"))
    content = bytearray(file.read_bytes())
    struct.pack_into("<Q", content, content.rindex(b"zstd") + 12, 10**12)  # of the index, which is believed
    file.write_bytes(bytes(content))
    for path in (bag, file):
        assert refusal(path, planar3).code == "bomb"


def test_a_packed_file_or_message_that_claims_too_much_is_refused(planar3: Robot) -> None:
    """A frame of zstd that states 60 MB, though it is short."""
    for mode in (CompressionMode.FILE, CompressionMode.MESSAGE):
        with case(mode) as tmp_path:
            bag = write_bag(tmp_path / "bag", "sqlite", all_in_one(), mode=mode)
            bomb = zstd.compress(bytes(60_000_000))
            if mode == CompressionMode.FILE:
                next(bag.glob("*.zstd")).write_bytes(bomb)
            else:
                with sqlite3.connect(next(bag.glob("*.db3"))) as database:
                    database.execute("UPDATE messages SET data = ? WHERE id = 20", (bomb,))
            assert refusal(bag, planar3).code == "bomb"


def test_clocks_of_two_hosts(planar3: Robot) -> None:
    """On one topic they are two recordings; with some joints each they are put on one clock by the receive times."""
    ahead = 51_000_000_000
    both = [
        ("/joint_states", START + int(s) + 1000 * k, (START + int(s) + k * ahead, JOINTS, q, ()))
        for s, q in zip(STEPS, Q, strict=True)
        for k in (0, 1)
    ]
    parts = [
        (topic, START + int(s) + k, (START + int(s) + k * ahead, names, q[columns], ()))
        for s, q in zip(STEPS, Q, strict=True)
        for k, (topic, names, columns) in enumerate([("/arm", JOINTS[:2], [0, 1]), ("/wrist", JOINTS[2:], [2])])
    ]
    with case("one topic") as tmp_path:
        demos = load_demonstrations(write_bag(tmp_path / "bag", "mcap", both), planar3)
        assert [t.name for t in demos] == ["bag sender 1", "bag sender 2"] and "51 s apart" in demos.notes[0]
        for t in demos:
            np.testing.assert_array_equal(t.q, Q)
    with case("joints of two hosts") as tmp_path:
        demos = load_demonstrations(write_bag(tmp_path / "bag", "mcap", parts), planar3)
        np.testing.assert_allclose(demos[0].q, Q[-len(demos[0]) :], atol=1e-6)
        assert len(demos) == 1 and len(demos[0]) >= len(Q) - 1 and "a clock 51 s ahead" in demos.notes[0]
