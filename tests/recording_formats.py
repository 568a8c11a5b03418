"""Recordings of `planar3` in each format, as other programs write them: tables, archives, LeRobot, robomimic, bags."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from recording_corpus import JOINTS, TIME, Q, U

for _module in ("h5py", "pyarrow", "rosbags"):
    pytest.importorskip(_module, reason=f"NO {_module.upper()}: THE FORMATS OF RECORDINGS ARE NOT TESTED")
import h5py  # noqa: E402
import pyarrow as pa  # noqa: E402
import pyarrow.parquet as pq  # noqa: E402
from rosbags.rosbag1 import Writer as Writer1  # noqa: E402
from rosbags.rosbag2 import CompressionFormat, StoragePlugin  # noqa: E402
from rosbags.rosbag2 import Writer as Writer2  # noqa: E402
from rosbags.typesys import Stores, get_typestore  # noqa: E402

Build = Callable[[Path], Path]  # writes something in a folder, and says where
Message = tuple[str, int, tuple]  # topic, when it was received [ns], fields of a JointState


def one(name: str, write: Callable[[Path], Any]) -> Build:
    """A file of this name."""
    return lambda folder: (write(folder / name), folder / name)[1]


def rows_of(*parts: Any, mark: str = ",") -> str:
    """Return text with all digits; a part is one column or, of shape (T, n), n of them."""
    each = [c for x in parts for c in (x.T if isinstance(x, np.ndarray) and x.ndim == 2 else [x])]
    lines = zip(*(c.tolist() if isinstance(c, np.ndarray) else c for c in each), strict=True)
    return "".join(mark.join(map(str, line)) + "\n" for line in lines)


def table(header: str, *parts: Any, name: str = "a.csv") -> Build:
    content = f"{header}\n{rows_of(*parts)}"
    return one(name, lambda path: path.write_text(content, encoding="utf-8", newline=""))


def archive(**arrays: Any) -> Build:
    """Write an archive of the good arrays, with these added or replaced; None leaves one out."""
    full = {"time": TIME, "q": Q, "u": U, "joint_names": np.array(JOINTS), **arrays}
    return one("a.npz", lambda path: np.savez(path, **{k: v for k, v in full.items() if v is not None}))


# ---- LeRobot ---------------------------------------------------------------------------------------------------------
FPS = 50


def motion(episode: int, n: int = 80) -> np.ndarray:
    t = np.arange(n) / FPS
    return np.column_stack([np.sin(t) + 0.01 * episode, 1.0 + np.cos(t), 0.5 * t])


def frames(episodes: dict[int, np.ndarray], kind: str = "fixed", **more: Any) -> pa.Table:
    """Frames of some episodes as LeRobot stores them, with a column that is not needed."""
    state = np.concatenate(list(episodes.values())).astype(np.float32)
    number = np.concatenate([np.arange(len(q)) for q in episodes.values()])
    lists = {
        "fixed": lambda: pa.FixedSizeListArray.from_arrays(pa.array(state.ravel()), state.shape[1]),
        "list": lambda: pa.array(state.tolist(), type=pa.list_(pa.float32())),
        "large": lambda: pa.array(state.astype(float).tolist(), type=pa.large_list(pa.float64())),
    }
    columns = {
        "observation.state": lists[kind](),
        "action": lists[kind](),
        "timestamp": pa.array((number / FPS).astype(np.float32)),
        "frame_index": pa.array(number),
        "episode_index": pa.array(np.repeat(list(episodes), [len(q) for q in episodes.values()])),
        "note": pa.array(["x"] * len(number)),
    }
    return pa.table({**columns, **more})


def info(names: Any, version: str = "v2.1", **more: Any) -> dict[str, Any]:
    state = {"dtype": "float32", "shape": [3], "names": names}
    return {"codebase_version": version, "fps": FPS, "features": {"observation.state": state, "action": state}, **more}


def dataset(root: Path, description: Any, files: dict[str, pa.Table]) -> Path:
    (root / "meta").mkdir(parents=True)
    (root / "meta" / "info.json").write_text(json.dumps(description))
    for name, content in files.items():
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        pq.write_table(content, root / name)
    return root


def lerobot(*tables: pa.Table, names: Any = JOINTS, described: Any = None) -> Build:
    """A data set of these files, in the layout of v3.0."""
    files = {f"data/chunk-000/file-{k:03d}.parquet": table for k, table in enumerate(tables)}
    files["meta/episodes/chunk-000/file-000.parquet"] = pa.table({"episode_index": [0, 1, 2, 3]})
    return lambda folder: dataset(folder / "set", info(names, "v3.0") if described is None else described, files)


def version_2(root: Path, scale: float = 1.0, kind: str = "fixed") -> Path:
    files = {f"data/chunk-000/episode_{i:06d}.parquet": frames({i: scale * motion(i)}, kind) for i in (0, 1, 2, 10)}
    return dataset(root, info(JOINTS, total_episodes=4, total_frames=320), files)


def version_3(root: Path) -> Path:
    tables = frames({0: motion(0), 1: motion(1, 50), 2: motion(2)[:30]}), frames({3: motion(3)})
    return lerobot(*tables, names={"motors": JOINTS})(root.parent).rename(root)


# ---- robomimic -------------------------------------------------------------------------------------------------------
ENV_ARGS = json.dumps({"env_name": "Lift", "env_kwargs": {"control_freq": FPS}})


def robomimic(path: Path, demos: Sequence[int] = (0, 1, 2, 10), env_args: Any = ENV_ARGS, **obs: Any) -> Path:
    """Demonstrations that begin 0.01 rad apart; `obs` are arrays beside or in place of theirs, None for none."""
    with h5py.File(path, "w") as file:
        data = file.create_group("data")
        if env_args is not None:
            data.attrs["env_args"] = env_args
        for i in demos:
            for name, array in ({"robot0_joint_pos": Q + 0.01 * i, "robot0_joint_vel": U} | obs).items():
                if array is not None:
                    data[f"demo_{i}/obs/{name}"] = array
            data[f"demo_{i}/actions"] = np.zeros((len(TIME), 7))
            data[f"demo_{i}"].attrs["num_samples"] = len(TIME)
        data.attrs["total"] = len(demos) * len(TIME)
    return path


# ---- bags ------------------------------------------------------------------------------------------------------------
ROS1, ROS2 = get_typestore(Stores.ROS1_NOETIC), get_typestore(Stores.ROS2_JAZZY)
JOINT_STATE = "sensor_msgs/msg/JointState"
KINDS = ("ros1", "sqlite", "mcap")
START = 1_700_000_000_123_456_789  # [ns] an integer that float64 cannot hold
STEPS = np.arange(60, dtype=np.int64) * 20_000_000


def joint_state(types: Any, stamp: int, names: Sequence[str], *arrays: Any) -> Any:
    time = types.types["builtin_interfaces/msg/Time"](sec=stamp // 10**9, nanosec=stamp % 10**9)
    extra = {"seq": 7} if types is ROS1 else {}
    header = types.types["std_msgs/msg/Header"](stamp=time, frame_id="base", **extra)
    full = [np.asarray(x, dtype=np.float64) for x in (*arrays, (), ())][:3]
    return types.types[JOINT_STATE](header, list(names), *full)


def write_bag(path: Path, kind: str, messages: Sequence[Message], **options: Any) -> Path:
    """A bag of (topic, recorder's stamp, JointState without its header's types); returns its path.

    `foreign` is the definition of a message on `/odd`; `big_endian` turns the bytes of each number around.
    """
    types = ROS1 if kind == "ros1" else ROS2
    if kind == "ros1":
        path = path.with_suffix(".bag")
        writer: Any = Writer1(path)
        if "compression" in options:
            writer.set_compression(options["compression"])
    else:
        plugin = StoragePlugin.SQLITE3 if kind == "sqlite" else StoragePlugin.MCAP
        writer = Writer2(path, version=9, storage_plugin=plugin)
        if "mode" in options:
            writer.set_compression(options["mode"], CompressionFormat.ZSTD)
    little = {} if kind == "ros1" else {"little_endian": not options.get("big_endian")}
    serialize: Any = types.serialize_ros1 if kind == "ros1" else types.serialize_cdr
    with writer:
        if "foreign" in options:
            digest = {"md5sum": "0" * 32} if kind == "ros1" else {"rihs01": "RIHS01_" + "0" * 64}
            writer.add_connection("/odd", "company_msgs/msg/Odd", msgdef=options["foreign"], **digest)
        connections: dict[str, Any] = {}
        for topic, stamp, content in messages:
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, JOINT_STATE, typestore=types)
            writer.write(connections[topic], stamp, serialize(joint_state(types, *content), JOINT_STATE, **little))
    return path


def all_in_one(names: Sequence[str] = JOINTS, q: Any = Q, u: Any = U, topic: str = "/joint_states") -> list[Message]:
    """Messages with all joints in some order, received 3 ms after they were stamped."""
    order = [JOINTS.index(n) for n in names]
    rows = zip((START + int(s) for s in STEPS), q, U, strict=True)
    return [(topic, at + 3_000_000, (at, names, a[order], () if u is None else b[order])) for at, a, b in rows]


def some(topic: str, joints: Sequence[int], q: Any = Q, late: int = 0, ahead: int = 0) -> list:
    """Messages with some of the joints, so many nanoseconds late, of a host whose clock is ahead; efforts are 7 q."""
    names = [JOINTS[j] for j in joints]
    rows = zip((START + int(s) + late for s in STEPS), q, strict=True)
    return [(topic, at, (at + ahead, names, row[[*joints]], (), 7.0 * row[[*joints]])) for at, row in rows]


def bag(kind: str, *streams: Sequence[Message], **options: Any) -> Build:
    """A bag of all messages, as they came."""
    messages = sorted((m for stream in streams for m in stream), key=lambda m: m[1])
    return lambda folder: write_bag(folder / "bag", kind, messages, **options)


def file_of(path: Path) -> Path:
    """The one file of a bag."""
    return path if path.is_file() else next(p for p in path.iterdir() if p.suffix in (".db3", ".mcap"))
