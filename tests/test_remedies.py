"""A remedy works when it is obeyed: the flags that a refusal names are typed, and the recording is then read, or the
next sentence is another one.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from obeying import advised
from recording_corpus import GOOD, JOINTS, TABLE, TIME, VELOCITIES, Q, csv, npz, text
from recording_formats import (
    ROS2,
    START,
    STEPS,
    Writer2,
    all_in_one,
    dataset,
    frames,
    info,
    motion,
    version_2,
    write_bag,
)
from recording_formats import robomimic as write

from manip_learn.cli import main

Build = Callable[[Path], Path]
RADIANS = ("--units", "radians")
STATES = motion(0).tolist()
QPOS = {"dtype": "float32", "shape": [3], "names": list(JOINTS)}
HEADER = ",".join(("time", *JOINTS))


def one(name: str, write_it: Callable[[Path], Any]) -> Build:
    """A file of this name."""
    return lambda folder: (write_it(folder / name), folder / name)[1]


def columns(header: str, *parts: np.ndarray) -> Build:
    return one("a.csv", text(csv(np.column_stack(parts), header)))


def bag(*streams: list[Any]) -> Build:
    messages = sorted((m for stream in streams for m in stream), key=lambda m: m[1])
    return lambda folder: write_bag(folder / "bag", "mcap", messages)


def chatter(folder: Path) -> Path:
    with Writer2(folder / "bag", version=9) as writer:
        connection = writer.add_connection("/chatter", "std_msgs/msg/String", typestore=ROS2)
        message = ROS2.types["std_msgs/msg/String"]("hello")
        writer.write(connection, 1, ROS2.serialize_cdr(message, "std_msgs/msg/String"))
    return folder / "bag"


def some(positions: slice, later: int = 0) -> list[Any]:
    """Messages about some of the joints only, so many nanoseconds later."""
    stamps = [START + int(s) + later for s in STEPS]
    return [("/joint_states", s, (s, JOINTS[positions], Q[0][positions], ())) for s in stamps]


def shuffled(folder: Path) -> Path:
    """Stamps in no order at all, received in one."""
    order = np.random.default_rng(0).permutation(len(STEPS))
    parts: list[Any] = [(t, START + int(STEPS[k]), c) for k, (t, _, c) in zip(order, all_in_one(), strict=True)]
    return write_bag(folder / "bag", "mcap", parts)


def changing_names() -> list[Any]:
    return [(t, r, (s, (f"x{k}", *n[1:]), q)) for k, (t, r, (s, n, q, *_)) in enumerate(all_in_one() * 6)]


def lerobot(described: Any = None, drop: tuple[str, ...] = (), **more: Any) -> Build:
    """A data set of one episode, with more columns or fewer."""
    files = {"data/episode_000000.parquet": frames({0: motion(0)}, **more).drop_columns(list(drop))}
    return lambda folder: dataset(folder / "set", info(list(JOINTS)) if described is None else described, files)


def without_a_file(folder: Path) -> Path:
    root = version_2(folder / "set", list(JOINTS))
    (root / "data/chunk-000/episode_000010.parquet").unlink()
    described = root / "meta/info.json"
    described.write_text(json.dumps({**json.loads(described.read_text()), "total_episodes": 4}))
    return root


# what is wrong -> the code of its refusal, how it is written, what is typed beside the path
REFUSED: dict[str, tuple[str, Build, tuple[str, ...]]] = {
    "a table without a header": ("no-header", one("a.csv", text(csv(TABLE).partition("\n")[2])), ()),
    "a table without stamps": ("no-time", columns(",".join(JOINTS), Q), ()),
    "a stamp by an odd name": ("no-time", columns("zeit," + ",".join(JOINTS), TABLE), ()),
    "numbered columns": ("numbered-columns", columns("time,q_0,q_1,q_2", TABLE), ()),
    "several patterns": (
        "columns", columns("time,a.joint1,a.joint2,a.joint3,b.joint1,b.joint2,b.joint3", TIME, Q, Q), ()
    ),
    "a column of something else": ("unknown-column", columns(HEADER + ",force", TABLE, TIME), ()),
    "a misspelt joint": ("missing-joint", columns("time,joint1,joint2,joint_3", TABLE), ()),
    "a joint that stood still": ("missing-joint", columns("time,joint1,joint2", TABLE[:, :3]), ()),
    "one stamp for all": ("too-short", columns(HEADER, 0.0 * TIME, Q), ()),
    "degrees": ("degrees", columns(HEADER, TIME, np.degrees(Q)), ()),
    "far outside the limits": ("outside-limits", columns(HEADER, TIME, Q + [0.0, 900.0, 0.0]), ()),
    "an archive without stamps": ("no-time", one("a.npz", npz(q=Q, joint_names=np.array(JOINTS))), ()),
    "an archive without names": ("no-joint-names", one("a.npz", npz(time=TIME, q=Q)), ()),
    "an archive of another name": (
        "missing-array", one("a.npz", npz(time=TIME, measured=Q, other=Q, joint_names=np.array(JOINTS))), ()
    ),
    "too few names": ("shape", one("a.npz", npz(time=TIME, q=Q)), ("--joint-names", "joint1,joint2")),
    "several topics": ("ambiguous-topic", bag(all_in_one(topic="/real"), all_in_one(topic="/other")), ()),
    "names that change": ("unsteady-names", bag(changing_names(), all_in_one(topic="/real")), ()),
    "no order in a bag": ("time-order", shuffled, ()),
    "no units": ("units", lerobot(), ()),
    "no names of motors": ("no-joint-names", lerobot(info(None)), RADIANS),
    "another feature": (
        "no-state",
        lerobot({"codebase_version": "v2.1", "fps": 50, "features": {"qpos": QPOS}}, qpos=pa.array(STATES)),
        RADIANS,
    ),
    "stamps against fps": ("fps", lerobot(timestamp=pa.array(np.arange(80) / 30.0)), RADIANS),
    "no rate": ("no-time", lerobot({**info(list(JOINTS)), "fps": None}, drop=("timestamp",)), RADIANS),
    "a file is missing": ("lost-samples", without_a_file, RADIANS),
    "no names in HDF5": ("no-joint-names", one("a.hdf5", write), ()),
    "no rate in HDF5": (
        "no-time", one("a.hdf5", lambda path: write(path, env_args=None)), ("--joint-names", ",".join(JOINTS))
    ),
}  # fmt: skip
# what no flag mends -> the code, how it is written, what is typed, and what the sentence says instead
TO_DO: dict[str, tuple[str, Build, tuple[str, ...], str]] = {
    "velocities only": (
        "no-positions", columns("time" + VELOCITIES, TABLE), (), "record positions too"
    ),
    "no overlap": (
        "no-overlap", bag(some(slice(0, 2)), some(slice(2, 3), later=60_000_000_000)), (), "record them together"
    ),
    "no joint states": ("no-joint-states", chatter, (), "record /joint_states"),
    "radians called degrees": ("degrees", one("a.csv", text(GOOD)), ("--degrees",), "leave --degrees out"),
    "a link to itself": ("unreadable", one("a.csv", lambda path: path.symlink_to(path)), (), "cannot be opened"),
    "a pipe": ("not-a-file", one("a.csv", lambda path: os.mkfifo(path)), (), "write it to a file first"),
}  # fmt: skip


def refusal(path: Path, out: Path, words: list[str], capsys) -> dict[str, str]:
    """The error of `export`, or nothing."""
    code = main(["export", "planar3", str(path), "--to", "csv", "--out", str(out), *words, "--json"])
    assert code in (0, 2)
    return json.loads(capsys.readouterr().out).get("error", {})


@pytest.mark.parametrize("name", REFUSED)
def test_the_flags_in_a_sentence_mend_what_is_wrong(name: str, tmp_path: Path, capsys) -> None:
    """No sentence is heard twice, and after three at the most the recording is read."""
    code, build, given = REFUSED[name]
    path, words, heard = build(tmp_path), list(given), list[str]()
    while error := refusal(path, tmp_path / "out", words, capsys):
        assert error["message"] not in heard, f"{words}: heard again: {error['message']}"
        assert heard or error["code"] == code, error
        heard.append(error["message"])
        ways = advised(error["message"])
        assert ways and len(heard) < 4, heard
        words += ways[0]
    assert heard


@pytest.mark.parametrize("name", TO_DO)
def test_what_no_flag_mends_says_what_to_do(name: str, tmp_path: Path, capsys) -> None:
    """In the sentence that refuses it."""
    code, build, words, says = TO_DO[name]
    error = refusal(build(tmp_path), tmp_path / "out", list(words), capsys)
    assert error["code"] == code and says in error["message"], error
