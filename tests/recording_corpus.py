"""A corpus of malformed and unusual recordings, each with its expected verdict.

All of them pretend to be recordings of `planar3` (joint1, joint2, joint3).
"""

from __future__ import annotations

import gzip
import importlib
import io
import json
import pickle
import warnings
import zipfile
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from case import rows_in

from manip_learn.errors import RecordingError
from manip_learn.recordings import load_demonstrations

JOINTS = ("joint1", "joint2", "joint3")
HEADER = "time,joint1,joint2,joint3"
VELOCITIES = ",joint1_velocity,joint2_velocity,joint3_velocity"
TIME = np.arange(60) * 0.02
Q = np.column_stack([np.sin(TIME), 1.0 + np.cos(TIME), 0.5 * TIME])
U = np.column_stack([np.cos(TIME), -np.sin(TIME), 0.5 + 0.0 * TIME])
TABLE, FULL = np.column_stack([TIME, Q]), np.column_stack([TIME, Q, U])
Write = Callable[[Path], Any]


class Case(NamedTuple):
    """One file of the corpus: its name, `"accept"` (nothing to say), `"note"` (accepted, with a sentence) or the code
    of its refusal, how it is written, and options of `load_demonstrations`.
    """

    name: str
    verdict: str
    write: Write
    options: dict[str, Any] = {}  # noqa: RUF012


def refusal(*given: Any, match: str | None = None, **options: Any) -> RecordingError:
    """The error that refuses a recording."""
    with pytest.raises(RecordingError, match=match) as caught:
        load_demonstrations(*given, **options)
    return caught.value


def csv(rows: np.ndarray, header: str = HEADER) -> str:
    """A text table."""
    return "\n".join([header, *(",".join(f"{x:.9g}" for x in row) for row in rows), ""])


def text(content: str, encoding: str = "utf-8") -> Write:
    return lambda path: path.write_text(content, encoding=encoding, newline="")


def raw(content: bytes) -> Write:
    return lambda path: path.write_bytes(content)


def npz(compressed: bool = False, **arrays: Any) -> Write:
    save = np.savez_compressed if compressed else np.savez
    return lambda path: save(path, **arrays)


def columns(header: str, *parts: np.ndarray) -> Write:
    return text(csv(np.column_stack(parts), header))


def numbers(rows: np.ndarray, header: str = HEADER) -> Write:
    return text(csv(rows, header if rows.shape[1] < 5 else header + VELOCITIES))


GOOD = csv(TABLE)


def edited(*texts: str) -> Write:
    """The good table with texts replaced wherever they occur: one by the next, as they stand in a JSON string."""
    content, texts = GOOD, json.loads('["' + '","'.join(texts) + '"]')
    for old, new in zip(texts[::2], texts[1::2], strict=True):
        assert old in content, old
        content = content.replace(old, new) if old else content
    return text(content)


def npy(array: np.ndarray) -> bytes:
    stream = io.BytesIO()
    np.save(stream, array)
    return stream.getvalue()


def archive_of(members: list[tuple[str, bytes]], method: int = zipfile.ZIP_STORED) -> Write:
    def write(path: Path) -> None:
        with warnings.catch_warnings(), zipfile.ZipFile(path, "w", method) as archive:
            warnings.simplefilter("ignore", UserWarning)  # a name that comes twice is the point of one case
            for name, content in members:
                archive.writestr(name, content)

    return write


def arrays_of(method: int = zipfile.ZIP_STORED, **members: bytes) -> Write:
    return archive_of([(f"{name}.npy", content) for name, content in members.items()], method)


def spoilt(write: Write, spoil: Callable[[bytes], bytes]) -> Write:
    return lambda path: (write(path), path.write_bytes(spoil(path.read_bytes())))


def flipped(content: bytes) -> bytes:
    at = content.find(Q.tobytes()[:64]) + 20
    return content[:at] + bytes([content[at] ^ 0xFF]) + content[at + 1 :]


def folder(files: dict[str, str | bytes]) -> Write:
    def write(path: Path) -> None:
        path.mkdir()
        for name, content in files.items():
            (path / name).parent.mkdir(parents=True, exist_ok=True)
            (path / name).write_bytes(content if isinstance(content, bytes) else content.encode())

    return write


def hdf5(path: Path, shape: tuple[int, int]) -> None:
    """Positions of which only the first chunk is stored, packed."""
    with importlib.import_module("h5py").File(path, "w") as file:
        chunks = (min(shape[0], 1000), shape[1])
        data = file.create_dataset("data/demo_0/obs/robot0_joint_pos", shape, "f8", chunks=chunks, compression="gzip")
        data[: chunks[0]] = 0.0


def parquet_bomb(path: Path) -> None:
    """Eight million samples of one value, run-length encoded."""
    pa, pq = importlib.import_module("pyarrow"), importlib.import_module("pyarrow.parquet")
    n = 8_000_000
    state = pa.FixedSizeListArray.from_arrays(pa.array(np.zeros(3 * n, np.float32)), 3)
    index = pa.array(np.zeros(n, dtype=np.int8))
    pq.write_table(pa.table({"observation.state": state, "timestamp": index, "episode_index": index}), path)


LATE = (np.arange(60) >= 30)[:, None]
NAMES = np.array(JOINTS)
ARRAYS = {"time": TIME, "q": Q, "u": U, "joint_names": NAMES}
members = partial(arrays_of, joint_names=npy(NAMES))
# 7 GB that are not there
LARGER = npy(np.zeros((60, 3))).replace(b"(60, 3), }" + b" " * 12, b"(300000000, 3), }" + b" " * 5)
OLD = json.dumps({"codebase_version": "v1.6", "features": {}})
WIDE, DEEP = np.zeros((2, 10_001)), "[" * 200 + "]" * 200
RATE, RADIANS = {"joint_names": JOINTS, "rate": 50.0}, {"joint_names": JOINTS, "units": "radians"}


def but(**arrays: Any) -> Write:
    return npz(**{**ARRAYS, **arrays})


def lerobot(info: str) -> Write:
    return folder({"meta/info.json": info, "data/file-000.parquet": "PAR1"})


def noise(seed: int, before: bytes, after: bytes = b"") -> Write:
    return raw(before + np.random.default_rng(seed).bytes(5000) + after)


ROWS: list[tuple] = [
    # tables that are written in an odd or wrong way
    *((name, verdict, edited(*replaced)) for name, verdict, *replaced in rows_in("odd_tables.txt")),
    ("utf16.csv", "encoding", text(GOOD, "utf-16")),
    ("one_row.csv", "too-short", numbers(TABLE[:1])),
    ("unnamed_column.csv", "note", columns(HEADER + ",", TABLE, TIME)),
    ("extra_velocity.csv", "unknown-column", columns(HEADER + VELOCITIES + ",joint9_velocity", FULL, TIME)),
    ("some_velocities.csv", "accept", columns(HEADER + VELOCITIES[:32], FULL[:, :6])),
    ("latin1.csv", "encoding", raw(GOOD.encode() + "0.5,\u00e9,1,1\n".encode("latin-1"))),
    ("long_line.csv", "line-too-long", text("time," + "x" * 1_100_000)),
    *((name, verdict, text(json.loads(f'"{content}"'))) for name, verdict, content in rows_in("odd_files.txt")),
    # tables whose numbers are wrong
    ("nan_velocity.csv", "accept", numbers(np.where(FULL == FULL[7, 5], np.nan, FULL))),
    ("backward_time.csv", "time-order", numbers(TABLE[::-1])),
    ("two_recordings.csv", "note", numbers(np.vstack([TABLE, TABLE]))),
    ("constant_time.csv", "too-short", numbers(TABLE * [0.0, 1.0, 1.0, 1.0])),
    ("repeated_rows.csv", "note", numbers(np.repeat(TABLE, 2, axis=0))),
    ("all_rows_the_same.csv", "too-short", numbers(np.repeat(TABLE[:1], 5, axis=0))),
    ("lone_sample.csv", "note", numbers(TABLE[[*range(30), 55]])),
    ("gap.csv", "note", numbers(TABLE + np.array([1.0, 0.0, 0.0, 0.0]) * LATE * 5.0)),
    ("milliseconds_stated.csv", "accept", numbers(TABLE * [1e3, 1, 1, 1]), {"time_unit": "ms"}),
    ("milliseconds_velocities.csv", "note", numbers(FULL * [1e3, 1, 1, 1, 1, 1, 1])),
    ("nanoseconds_1970.csv", "too-short", numbers(TABLE * [1e9, 1, 1, 1] + [1.7e18, 0, 0, 0])),
    ("milliseconds_1970.csv", "too-short", numbers(TABLE * [1e3, 1, 1, 1] + [1.7e12, 0, 0, 0])),
    ("degrees_stated.csv", "note", numbers(TABLE * [1, 57.3, 57.3, 57.3]), {"degrees": True}),
    ("radians_as_degrees.csv", "outside-limits", numbers(TABLE * [1, 57.3, 57.3, 57.3]), {"units": "radians"}),
    ("small_degrees.csv", "degrees", numbers(FULL * [1, 5.73, 5.73, 5.73, 0.1, 0.1, 0.1])),
    ("full_turn.csv", "jump", numbers(TABLE + LATE * [0, 6.2832, 0, 0])),
    # files that are no recordings at all
    ("pickle.pkl", "pickle", raw(pickle.dumps({"q": Q}))),
    ("bare_array.npy", "no-joint-names", raw(npy(Q))),
    ("compressed.csv.gz", "compressed", raw(gzip.compress(GOOD.encode()))),
    ("zipped.zip", "compressed", archive_of([("demo.csv", GOOD.encode())])),
    ("workbook.xlsx", "excel", archive_of([("xl/workbook.xml", b"<workbook/>")])),
    ("matlab.mat", "damaged", raw(b"MATLAB 5.0 MAT-file, Platform: GLNXA64" + bytes(100))),
    ("random.bin", "unknown-format", raw(np.random.default_rng(0).bytes(3000))),
    # NumPy archives
    ("good.npz", "accept", npz(**ARRAYS)),
    ("names_given.npz", "accept", npz(time=TIME, q=Q), {"joint_names": JOINTS}),
    ("more_arrays.npz", "note", but(camera=np.zeros((4, 4)))),
    ("objects.npz", "pickle", but(q=Q.astype(object))),
    ("complex.npz", "not-a-number", but(q=Q.astype(complex))),
    ("booleans.npz", "not-a-number", but(q=Q > 0)),
    ("text_array.npz", "not-a-number", but(q=Q.astype(str))),
    ("transposed.npz", "note", but(q=Q.T)),
    ("flat.npz", "shape", but(q=Q[:, 0])),
    ("two_positions.npz", "missing-array", npz(time=TIME, measured_q=Q, other_q=Q, joint_names=NAMES)),
    ("longer_u.npz", "shape", but(u=U[:-1])),
    ("empty_arrays.npz", "too-short", npz(time=TIME[:0], q=Q[:0], joint_names=NAMES)),
    (
        "bomb.npz",
        "bomb",
        members(method=zipfile.ZIP_DEFLATED, time=npy(np.zeros(4_000_000)), q=npy(np.zeros((4_000_000, 3)))),
    ),
    ("header_asks_for_more.npz", "damaged", members(time=npy(TIME), q=LARGER)),
    ("header_is_code.npz", "damaged", members(time=npy(TIME), q=npy(Q).replace(b": (60, 3)", b": exit(9)"))),
    ("same_array_twice.npz", "duplicate-column", archive_of([("time.npy", npy(TIME)), *[("q.npy", npy(Q))] * 2])),
    ("cut_off.npz", "damaged", spoilt(npz(**ARRAYS), lambda b: b[: len(b) // 2])),
    ("flipped_bits.npz", "damaged", spoilt(npz(time=TIME, q=Q, joint_names=NAMES), flipped)),
    # beginnings of heavy formats with nothing sensible behind
    ("stub.bag", "damaged", raw(b"#ROSBAG V2.0\n" + bytes(200))),
    ("old.bag", "old-bag", raw(b"#ROSBAG V1.2\n" + bytes(200))),
    ("random.bag", "damaged", noise(1, b"#ROSBAG V2.0\n")),
    ("random.mcap", "damaged", noise(2, b"\x89MCAP0\r\n")),
    ("random.db3", "damaged", noise(3, b"SQLite format 3\x00")),
    ("random.parquet", "damaged", noise(4, b"PAR1", b"PAR1")),
    ("random.hdf5", "damaged", noise(5, b"\x89HDF\r\n\x1a\n")),
    ("stub.csv.zst", "compressed", raw(b"\x28\xb5\x2f\xfd" + bytes(50))),
    ("lerobot_v1", "version", folder({"meta/info.json": OLD, "data/episode_000000.parquet": b"PAR1"})),
    ("lerobot_no_data", "empty", folder({"meta/info.json": "{}"})),
    ("ros2_no_storage", "damaged", folder({"metadata.yaml": "a: [1"})),
    ("empty_folder", "no-recordings", folder({})),
    ("folder_of_notes", "no-recordings", folder({"README.md": "hello there", "x.json": "{}"})),
    ("one_bad_in_folder", "ragged", folder({"a.csv": GOOD, "b.csv": GOOD[:-14] + "\n"})),
    (
        "folder_with_readme",
        "note",
        folder({"a.csv": GOOD, "README.md": "hello there", "b.yaml": "position: [1]\n"}),
    ),
    ("not_there.csv", "missing-file", lambda path: None),
    # files of each format that claim to hold more than any recording: refused before it is read
    ("wide.csv", "too-large", text(csv(np.ones((1, 10_004)), HEADER + "".join(f",c{i}" for i in range(10_000))))),
    ("wide.npz", "too-large", npz(True, time=TIME[:2], q=WIDE, joint_names=NAMES)),
    ("deep_lerobot", "damaged", lerobot(DEEP)),
    ("large_lerobot", "too-large", lerobot(" " * 10_000_001)),
    ("deep_bag", "damaged", folder({"metadata.yaml": DEEP})),
    ("large_bag", "too-large", folder({"metadata.yaml": " " * 10_000_001})),
    ("wide.hdf5", "too-large", partial(hdf5, shape=WIDE.shape), RATE),
    ("bomb.hdf5", "bomb", partial(hdf5, shape=(4_000_000, 3)), RATE),
    ("huge.hdf5", "too-large", partial(hdf5, shape=(10**9, 3)), RATE),
    ("bomb.parquet", "bomb", parquet_bomb, RADIANS),
    ("bomb_episode.parquet", "bomb", parquet_bomb, {**RADIANS, "episodes": 0}),
]
CASES = [Case(*row) for row in ROWS]
