"""Recordings that are refused, one for each reason, and how each is mended by what its refusal says."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pyarrow as pa
from recording_corpus import GOOD, JOINTS, TABLE, TIME, VELOCITIES, Q, U, csv, npz, text
from test_lerobot_reader import dataset, info, motion, version_2
from test_lerobot_reader import table as frames
from test_robomimic_reader import write
from test_rosbag_reader import ROS2 as TYPES
from test_rosbag_reader import START, STEPS, Writer2, all_in_one, write_bag

Build = Callable[[Path], Path]


@dataclass(frozen=True)
class Refused:
    """A recording that is refused.

    Attributes:
        code: Of its refusal.
        bad: Writes it into a folder.
        says: Part of the sentence: what is to be done.
        good: Writes it as mended by what the sentence says; None: the flags in the sentence are typed instead.
        words: Typed beside the path.
        undone: Of these, what is not typed any more.
    """

    code: str
    bad: Build
    says: str = ""
    good: Build | None = None
    words: tuple[str, ...] = ()
    undone: tuple[str, ...] = ()


RADIANS = ("--units", "radians")
NAMED = ("--joint-names", ",".join(JOINTS))
OBJECT = ("--object", "box")
BOX = ("box.x", "box.y", "box.z", "box.qx", "box.qy", "box.qz", "box.qw")
POSE = np.tile([0.1, 0.2, 0.3, 0.0, 0.0, 0.0, 1.0], (60, 1))


def one(name: str, write_it: Callable[[Path], Any]) -> Build:
    """A file of this name."""

    def build(folder: Path) -> Path:
        write_it(folder / name)
        return folder / name

    return build


def columns(header: str, *parts: np.ndarray) -> Build:
    return one("a.csv", text(csv(np.column_stack(parts), header)))


def bag(*streams: list[Any], kind: str = "mcap") -> Build:
    messages = sorted((m for stream in streams for m in stream), key=lambda m: m[1])
    return lambda folder: write_bag(folder / "bag", kind, messages)


def chatter(folder: Path) -> Path:
    with Writer2(folder / "bag", version=9) as writer:
        connection = writer.add_connection("/chatter", "std_msgs/msg/String", typestore=TYPES)
        message = TYPES.types["std_msgs/msg/String"]("hello")
        writer.write(connection, 1, TYPES.serialize_cdr(message, "std_msgs/msg/String"))
    return folder / "bag"


def some(positions: slice, *, later: int = 0, topic: str = "/joint_states") -> list[Any]:
    """Messages about some of the joints only, so many nanoseconds later."""
    return [
        (topic, START + int(s) + later, (START + int(s) + later, JOINTS[positions], q[positions], ()))
        for s, q in zip(STEPS, np.vstack([Q] * 4)[: len(STEPS)], strict=True)
    ]


def shuffled(folder: Path) -> Path:
    """Stamps in no order at all, received in one."""
    order = np.random.default_rng(0).permutation(len(STEPS))
    parts: list[Any] = [(t, START + int(STEPS[k]), c) for k, (t, _, c) in zip(order, all_in_one(), strict=True)]
    return write_bag(folder / "bag", "mcap", parts)


def changing_names() -> list[Any]:
    return [(t, r, (s, (f"x{k}", *n[1:]), q)) for k, (t, r, (s, n, q, *_)) in enumerate(all_in_one() * 2)]


def unfinished(folder: Path) -> Path:
    path = bag(all_in_one(), kind="sqlite")(folder)
    database = next(path.glob("*.db3"))
    database.with_name(database.name + "-wal").write_bytes(b"not written back")
    return path


def with_lost_messages(folder: Path) -> Path:
    path = bag(all_in_one())(folder)
    described = path / "metadata.yaml"
    described.write_text(described.read_text().replace("message_count: 200", "message_count: 201"))
    return path


def hdf5(change: Callable[[Any], None] = lambda file: None, **options: Any) -> Build:
    def build(folder: Path) -> Path:
        path = write(folder / "a.hdf5", (0, 1), **options)
        with h5py.File(path, "a") as file:
            change(file)
        return path

    return build


def replaced(name: str, value: Any) -> Callable[[Any], None]:
    def change(file: Any) -> None:
        del file[name]
        if value is not None:
            file[name] = value

    return change


def stated(name: str, value: Any, where: str = "data") -> Callable[[Any], None]:
    return lambda file: file[where].attrs.__setitem__(name, value)


def lerobot(described: Any = None, **more: Any) -> Build:
    """A data set of one episode; arrays beside its own by their names."""
    content = frames({0: motion(0)}, **{k: v for k, v in more.items() if k not in ("observation.state", "drop")})
    if "observation.state" in more:
        content = content.set_column(0, "observation.state", more["observation.state"])
    content = content.drop_columns(more.get("drop", []))
    return lambda folder: dataset(
        folder / "set", info(list(JOINTS)) if described is None else described, {"data/episode_000000.parquet": content}
    )


def without_a_file(folder: Path) -> Path:
    root = version_2(folder / "set", list(JOINTS))
    (root / "data/chunk-000/episode_000010.parquet").unlink()
    described = root / "meta/info.json"
    described.write_text(json.dumps({**json.loads(described.read_text()), "total_episodes": 4}))
    return root


def folder_of(**files: Callable[[Path], Any]) -> Build:
    def build(folder: Path) -> Path:
        (folder / "demos").mkdir()
        for name, write_it in files.items():
            write_it(folder / "demos" / name.replace("_", "."))
        return folder / "demos"

    return build


def of_the_first(build: Build, name: str) -> Build:
    """One file of a folder that was built."""
    return lambda folder: build(folder) / name


def instead(build: Build) -> Build:
    """In place of what is there."""

    def built(folder: Path) -> Path:
        for path in folder.iterdir():
            path.unlink()
        return build(folder)

    return built


STATES = motion(0).tolist()
SWAYING = Q + 0.8 * (np.arange(60) % 2)[:, None]
GOOD_BAG, GOOD_HDF5, GOOD_SET = bag(all_in_one()), hdf5(), lerobot()
PLAIN = one("a.csv", text(GOOD))
HEADER = ",".join(("time", *JOINTS))

CASES: dict[str, Refused] = {
    # ---- text tables
    "a table without a header": Refused("no-header", one("a.csv", text(csv(TABLE).partition("\n")[2]))),
    "a table without stamps": Refused("no-time", columns(",".join(JOINTS), Q)),
    "a stamp by an odd name": Refused("no-time", columns("zeit," + ",".join(JOINTS), TABLE)),
    "numbered columns": Refused("numbered-columns", columns("time,q_0,q_1,q_2", TABLE)),
    "a pattern of no column": Refused(
        "columns", PLAIN, "there is", PLAIN, ("--columns", "position.{joint}"), ("--columns", "position.{joint}")
    ),
    "several patterns": Refused(
        "columns", columns("time,a.joint1,a.joint2,a.joint3,b.joint1,b.joint2,b.joint3", TIME, Q, Q)
    ),
    "a column of something else": Refused("unknown-column", columns(HEADER + ",force", TABLE, TIME)),
    "a misspelt joint": Refused("missing-joint", columns("time,joint1,joint2,joint_3", TABLE)),
    "a joint that stood still": Refused("missing-joint", columns("time,joint1,joint2", TABLE[:, :3])),
    "a column twice": Refused(
        "duplicate-column", columns("time,joint1,joint1,joint2,joint3", TIME, Q[:, :1], Q), "keep one", PLAIN
    ),
    "velocities only": Refused("no-positions", columns("time" + VELOCITIES, TIME, U), "record positions too", PLAIN),
    "messages of a bag as a table": Refused(
        "messages", columns("%time,field.name0,field.position0", TIME, TIME, TIME), "give the bag itself", GOOD_BAG
    ),
    # ---- the motion
    "rows in reverse": Refused("time-order", columns(HEADER, TABLE[::-1]), "sort the rows", PLAIN),
    "one stamp for all": Refused("too-short", columns(HEADER, 0.0 * TIME, Q)),
    "degrees": Refused("degrees", columns(HEADER, TIME, np.degrees(Q))),
    "degrees that were radians": Refused(
        "degrees", PLAIN, "leave --degrees out", PLAIN, ("--degrees",), ("--degrees",)
    ),
    "normalised values that are not": Refused(
        "units",
        columns(HEADER, TIME, 200.0 * Q),
        "state other units",
        PLAIN,
        ("--units", "normalised"),
        ("--units", "normalised"),
    ),
    "far outside the limits": Refused("outside-limits", columns(HEADER, TIME, Q + [0.0, 900.0, 0.0])),
    "a jump": Refused(
        "jump", columns(HEADER, TIME, Q + 2.5 * (TIME == TIME[30])[:, None] * [0, 1, 0]), "Correct the file", PLAIN
    ),
    "two motions in turn": Refused("two-publishers", columns(HEADER, TIME, SWAYING), "end one of them", PLAIN),
    "an array that is not finite": Refused(
        "not-finite", columns(HEADER, TIME, np.where(Q == Q[9], np.nan, Q)), "remove them", PLAIN
    ),
    # ---- arrays
    "an archive without stamps": Refused("no-time", one("a.npz", npz(q=Q, joint_names=np.array(JOINTS)))),
    "an archive without names": Refused("no-joint-names", one("a.npz", npz(time=TIME, q=Q))),
    "an archive of another name": Refused(
        "missing-array", one("a.npz", npz(time=TIME, measured=Q, joint_names=np.array(JOINTS)))
    ),
    "objects": Refused(
        "pickle",
        one("a.npz", npz(time=TIME, q=Q.astype(object))),
        "save numbers",
        one("a.npz", npz(time=TIME, q=Q)),
        NAMED,
    ),
    "too few names": Refused("shape", one("a.npz", npz(time=TIME, q=Q)), words=("--joint-names", "joint1,joint2")),
    # ---- bags
    "another topic": Refused(
        "unknown-topic",
        GOOD_BAG,
        "there is /joint_states",
        GOOD_BAG,
        ("--topic", "/joint_sates"),
        ("--topic", "/joint_sates"),
    ),
    "several topics": Refused("ambiguous-topic", bag(all_in_one(topic="/real"), all_in_one(topic="/command"))),
    "names that change": Refused("unsteady-names", bag(changing_names(), all_in_one(topic="/real"))),
    "no overlap": Refused(
        "no-overlap", bag(some(slice(0, 2)), some(slice(2, 3), later=60_000_000_000)), "record them together", GOOD_BAG
    ),
    "no joint states": Refused("no-joint-states", chatter, "record /joint_states", GOOD_BAG),
    "no usable message": Refused(
        "empty", bag([(t, r, (s, (), ())) for t, r, (s, *_) in all_in_one()]), "record again", GOOD_BAG
    ),
    "a joint twice in a message": Refused(
        "duplicate-column",
        bag([(t, r, (s, (*n, "joint2"), (*q, 0.0))) for t, r, (s, n, q, _) in all_in_one()]),
        "correct the publisher",
        GOOD_BAG,
    ),
    "a log that was not written back": Refused(
        "unfinished", unfinished, "PRAGMA wal_checkpoint", bag(all_in_one(), kind="sqlite")
    ),
    "lost messages": Refused("lost-messages", with_lost_messages, "copy it again", GOOD_BAG),
    "no order in a bag": Refused("time-order", shuffled),
    "a part of a bag": Refused(
        "damaged", one("a.mcap", lambda p: p.write_bytes(b"\x89MCAP0\r\n" + bytes(99))), "record it again", GOOD_BAG
    ),
    # ---- LeRobot
    "no units": Refused("units", GOOD_SET),
    "no names of motors": Refused("no-joint-names", lerobot(info(None)), words=RADIANS),
    "no such feature": Refused(
        "no-state",
        GOOD_SET,
        "vectors of numbers are",
        GOOD_SET,
        (*RADIANS, "--feature", "joints"),
        ("--feature", "joints"),
    ),
    "another feature": Refused(
        "no-state",
        lerobot(
            {
                "codebase_version": "v2.1",
                "fps": 50,
                "features": {"qpos": {"dtype": "float32", "shape": [3], "names": list(JOINTS)}},
            },
            qpos=pa.array(STATES),
        ),
        words=RADIANS,
    ),
    "stamps against fps": Refused("fps", lerobot(timestamp=pa.array(np.arange(80) / 30.0)), words=RADIANS),
    "no rate": Refused("no-time", lerobot({**info(list(JOINTS)), "fps": None}, drop=["timestamp"]), words=RADIANS),
    "an old version": Refused(
        "version", lerobot({"codebase_version": "v1.6"}), "convert the data set", GOOD_SET, RADIANS
    ),
    "a file is missing": Refused("lost-samples", without_a_file, words=RADIANS),
    "ragged samples": Refused(
        "ragged", lerobot(**{"observation.state": pa.array([*STATES[:-1], [1.0]])}), "", GOOD_SET, RADIANS
    ),
    "no such episode": Refused(
        "no-episode", GOOD_SET, "the nearest: 0", GOOD_SET, (*RADIANS, "--episodes", "7"), ("--episodes", "7")
    ),
    # ---- HDF5
    "no names in HDF5": Refused("no-joint-names", GOOD_HDF5),
    "no rate in HDF5": Refused("no-time", hdf5(env_args=None), words=NAMED),
    "no observations": Refused(
        "no-state", hdf5(replaced("data/demo_0/obs", None)), "dataset_states_to_obs.py", GOOD_HDF5, NAMED
    ),
    "a link": Refused(
        "link",
        hdf5(replaced("data/demo_0/obs/robot0_joint_pos", h5py.SoftLink("/data/demo_1/obs/robot0_joint_pos"))),
        "copy the data",
        GOOD_HDF5,
        NAMED,
    ),
    "another number than stated": Refused(
        "lost-samples", hdf5(stated("total", 7)), "download it again", GOOD_HDF5, NAMED
    ),
    "no positions in HDF5": Refused(
        "no-state",
        hdf5(replaced("data/demo_0/obs/robot0_joint_pos", None)),
        "no array of joint positions",
        GOOD_HDF5,
        NAMED,
    ),
    # ---- objects
    "no pose of the box": Refused(
        "missing-object", PLAIN, "record box.x", columns(f"{HEADER},{','.join(BOX)}", TABLE, POSE), words=OBJECT
    ),
    "part of a quaternion": Refused(
        "partial-quaternion",
        columns(f"{HEADER},{','.join(BOX[:-1])}", TABLE, POSE[:, :-1]),
        "record all of",
        columns(f"{HEADER},{','.join(BOX)}", TABLE, POSE),
        words=OBJECT,
    ),
    "no quaternion": Refused(
        "quaternion",
        columns(f"{HEADER},{','.join(BOX)}", TABLE, 0.9 * POSE),
        "1 is needed",
        columns(f"{HEADER},{','.join(BOX)}", TABLE, POSE),
        words=OBJECT,
    ),
    # ---- folders and options
    "two kinds in a folder": Refused(
        "mixed-folder",
        folder_of(a_csv=text(GOOD), b_npz=npz(time=TIME, q=Q)),
        "name the files",
        of_the_first(folder_of(a_csv=text(GOOD)), "a.csv"),
    ),
    "an empty folder": Refused("no-recordings", folder_of(), "name the recordings", folder_of(a_csv=text(GOOD))),
    "a folder without the file": Refused("missing-file", one("a.csv", lambda path: None), "check the path", PLAIN),
    "a link to itself": Refused(
        "unreadable", one("a.csv", lambda path: path.symlink_to(path)), "cannot be opened", instead(PLAIN)
    ),
    "a pipe": Refused("not-a-file", one("a.csv", lambda path: os.mkfifo(path)), "give a rollout", instead(PLAIN)),
    "an option that is used by nothing": Refused(
        "option", PLAIN, "leave it out", PLAIN, ("--topic", "/joint_states"), ("--topic", "/joint_states")
    ),
    "a rate that is none": Refused("option", PLAIN, "positive number", PLAIN, ("--rate", "-5"), ("--rate", "-5")),
}
