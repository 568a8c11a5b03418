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
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from manip_learn.errors import RecordingError
from manip_learn.recordings import load_demonstrations

JOINTS = ("joint1", "joint2", "joint3")
HEADER = "time,joint1,joint2,joint3"
VELOCITIES = ",joint1_velocity,joint2_velocity,joint3_velocity"
TIME = np.arange(60) * 0.02
Q = np.column_stack([np.sin(TIME), 1.0 + np.cos(TIME), 0.5 * TIME])
U = np.column_stack([np.cos(TIME), -np.sin(TIME), 0.5 + 0.0 * TIME])
TABLE, FULL = np.column_stack([TIME, Q]), np.column_stack([TIME, Q, U])


def refusal(*given: Any, match: str | None = None, **options: Any) -> RecordingError:
    """The error that refuses a recording."""
    with pytest.raises(RecordingError, match=match) as caught:
        load_demonstrations(*given, **options)
    return caught.value


@dataclass(frozen=True)
class Case:
    """One file of the corpus.

    Attributes:
        name: File name.
        verdict: `"accept"` (nothing to say), `"note"` (accepted, with a sentence) or the code of the refusal.
        write: Writes it.
        options: Keywords for `load_demonstrations`.
    """

    name: str
    verdict: str
    write: Callable[[Path], None]
    options: dict[str, Any] = field(default_factory=dict)


def csv(rows: np.ndarray, header: str = HEADER, delimiter: str = ",", mark: str = ".") -> str:
    """A text table."""
    lines = [header.replace(",", delimiter)]
    lines += [delimiter.join(f"{x:.9g}".replace(".", mark) for x in row) for row in rows]
    return "\n".join(lines) + "\n"


def text(content: str, encoding: str = "utf-8") -> Callable[[Path], None]:
    return lambda path: path.write_text(content, encoding=encoding, newline="") and None


def raw(content: bytes) -> Callable[[Path], None]:
    return lambda path: path.write_bytes(content) and None


def npz(compressed: bool = False, **arrays: Any) -> Callable[[Path], None]:
    save = np.savez_compressed if compressed else np.savez
    return lambda path: save(path, **arrays)


def changed(row: int, column: int, value: float, table: np.ndarray = TABLE) -> np.ndarray:
    table = table.copy()
    table[row, column] = value
    return table


GOOD = csv(TABLE)
LINES = GOOD.split("\n")


def with_line(number: int, line: str) -> str:
    """The good table with one line replaced; numbers as an editor shows them."""
    lines = list(LINES)
    lines[number - 1] = line
    return "\n".join(lines)


def text_cases() -> list[Case]:
    """Tables that are written in an odd or wrong way."""
    return [
        Case("good.csv", "accept", text(GOOD)),
        Case("good_velocities.csv", "accept", text(csv(FULL, HEADER + VELOCITIES))),
        Case("semicolon.csv", "accept", text(csv(TABLE, delimiter=";"))),
        Case("semicolon_decimal_comma.csv", "accept", text(csv(TABLE, delimiter=";", mark=","))),
        Case("tab.tsv", "accept", text(csv(TABLE, delimiter="\t"))),
        Case("spaces.txt", "accept", text(csv(TABLE, delimiter="   "))),
        Case("byte_order_mark.csv", "accept", text("\ufeff" + GOOD)),
        Case("utf16.csv", "encoding", text(GOOD, "utf-16")),
        Case("windows_lines.csv", "accept", text(GOOD.replace("\n", "\r\n"))),
        Case("old_mac_lines.csv", "accept", text(GOOD.replace("\n", "\r"))),
        Case("comments.csv", "accept", text("# made by hand\n% and so\n\n" + GOOD)),
        Case("no_extension", "accept", text(GOOD)),
        Case("wrong_extension.bag", "accept", text(GOOD)),
        Case("other_order.csv", "accept", text(csv(TABLE[:, [3, 0, 2, 1]], "joint3,time,joint2,joint1"))),
        Case("quoted_header.csv", "accept", text('"time","joint1","joint2","joint3"\n' + "\n".join(LINES[1:]))),
        Case("no_last_line_end.csv", "note", text(GOOD.rstrip("\n"))),
        Case("commented_header.csv", "note", text("# " + GOOD)),
        Case("effort.csv", "note", text(csv(np.column_stack([TABLE, TIME]), HEADER + ",joint1_effort"))),
        Case("empty.csv", "empty", text("")),
        Case("blank.csv", "empty", text("\n\n  \n")),
        Case("header_only.csv", "too-short", text(HEADER + "\n")),
        Case("one_row.csv", "too-short", text(csv(TABLE[:1]))),
        Case("no_header.csv", "no-header", text("\n".join(LINES[1:]))),
        Case("stamp.csv", "note", text(csv(TABLE, "stamp,joint1,joint2,joint3"))),
        Case("no_time.csv", "no-time", text(csv(TABLE, "zeit,joint1,joint2,joint3"))),
        Case("capital_time.csv", "note", text(csv(TABLE, "Time,joint1,joint2,joint3"))),
        Case("unnamed_column.csv", "note", text(csv(np.column_stack([TABLE, TIME]), HEADER + ","))),
        Case("column_twice.csv", "duplicate-column", text(csv(TABLE, "time,joint1,joint1,joint3"))),
        Case("missing_joint.csv", "missing-joint", text(csv(TABLE[:, :3], "time,joint1,joint2"))),
        Case("misspelt_joint.csv", "missing-joint", text(csv(TABLE, "time,joint1,joint2,joint_3"))),
        Case("extra_column.csv", "unknown-column", text(csv(np.column_stack([TABLE, TIME]), HEADER + ",force"))),
        Case(
            "extra_velocity.csv",
            "unknown-column",
            text(csv(np.column_stack([FULL, TIME]), HEADER + VELOCITIES + ",joint9_velocity")),
        ),
        Case("some_velocities.csv", "accept", text(csv(FULL[:, :6], HEADER + VELOCITIES[:32]))),
        Case("text_in_number.csv", "not-a-number", text(with_line(9, "0.14,0.1,x,0.07"))),
        Case("empty_field.csv", "not-a-number", text(with_line(9, "0.14,,1.9,0.07"))),
        Case("trailing_comment.csv", "not-a-number", text(with_line(9, "0.14,0.1,1.9,0.07 # here"))),
        Case("arabic_digits.csv", "not-a-number", text(with_line(9, "0.14,\u0661,1.9,0.07"))),
        Case("short_row.csv", "ragged", text(with_line(9, "0.14,0.1,1.9"))),
        Case("long_row.csv", "ragged", text(with_line(9, "0.14,0.1,1.9,0.07,5"))),
        Case("decimal_comma_in_commas.csv", "ragged", text(csv(TABLE, mark=","))),
        Case("trailing_delimiter.csv", "note", text(GOOD.replace("\n", ",\n").replace(",\n", "\n", 1))),
        Case("mixed_marks.csv", "decimal-mark", text(csv(TABLE, delimiter=";") + "1,3;1;2;3\n")),
        Case("thousands.csv", "decimal-mark", text(csv(TABLE, delimiter=";") + "1.000,5;1;2;3\n")),
        Case("cut_off.csv", "note", text(GOOD[:-14])),
        Case("cut_inside_last_number.csv", "note", text(GOOD[:-4])),
        Case("latin1.csv", "encoding", raw(GOOD.encode() + "0.5,\u00e9,1,1\n".encode("latin-1"))),
        Case("long_line.csv", "line-too-long", text("time," + "x" * 1_100_000)),
    ]


def number_cases() -> list[Case]:
    """Tables whose numbers are wrong."""
    gap = TABLE + np.array([1.0, 0.0, 0.0, 0.0]) * (np.arange(60) >= 30)[:, None] * 5.0
    return [
        Case("nan.csv", "not-finite", text(csv(changed(7, 2, np.nan)))),
        Case("infinite.csv", "not-finite", text(csv(changed(7, 2, np.inf)))),
        Case("too_large_for_float.csv", "not-finite", text(with_line(9, "0.14,1e999,1.9,0.07"))),
        Case("nan_velocity.csv", "accept", text(csv(changed(7, 5, np.nan, FULL), HEADER + VELOCITIES))),
        Case("backward_time.csv", "time-order", text(csv(TABLE[::-1]))),
        Case("two_recordings.csv", "note", text(csv(np.vstack([TABLE, TABLE])))),
        Case("same_stamp.csv", "note", text(csv(changed(8, 0, TABLE[7, 0])))),
        Case("constant_time.csv", "too-short", text(csv(TABLE * [0.0, 1.0, 1.0, 1.0]))),
        Case("repeated_rows.csv", "note", text(csv(np.repeat(TABLE, 2, axis=0)))),
        Case("all_rows_the_same.csv", "too-short", text(csv(np.repeat(TABLE[:1], 5, axis=0)))),
        Case("gap.csv", "note", text(csv(gap))),
        Case("milliseconds.csv", "note", text(csv(TABLE * [1e3, 1, 1, 1]))),
        Case("milliseconds_stated.csv", "accept", text(csv(TABLE * [1e3, 1, 1, 1])), {"time_unit": "ms"}),
        Case("milliseconds_velocities.csv", "note", text(csv(FULL * [1e3, 1, 1, 1, 1, 1, 1], HEADER + VELOCITIES))),
        Case("nanoseconds_1970.csv", "too-short", text(csv(TABLE * [1e9, 1, 1, 1] + [1.7e18, 0, 0, 0]))),
        Case("milliseconds_1970.csv", "too-short", text(csv(TABLE * [1e3, 1, 1, 1] + [1.7e12, 0, 0, 0]))),
        Case("degrees.csv", "degrees", text(csv(TABLE * [1, 57.29578, 57.29578, 57.29578]))),
        Case("degrees_stated.csv", "note", text(csv(TABLE * [1, 57.29578, 57.29578, 57.29578])), {"degrees": True}),
        Case(
            "radians_as_degrees.csv", "outside-limits", text(csv(TABLE * [1, 57.3, 57.3, 57.3])), {"units": "radians"}
        ),
        Case(
            "small_degrees.csv", "degrees", text(csv(FULL * [1, 5.73, 5.73, 5.73, 0.1, 0.1, 0.1], HEADER + VELOCITIES))
        ),
        Case("velocity_degrees.csv", "accept", text(csv(FULL * [1, 1, 1, 1, 57.3, 57.3, 57.3], HEADER + VELOCITIES))),
        Case("outlier.csv", "outside-limits", text(csv(changed(30, 2, 1e8)))),
        Case("spike.csv", "jump", text(csv(changed(30, 2, 9.0)))),
        Case("full_turn.csv", "jump", text(csv(TABLE + (np.arange(60) >= 30)[:, None] * [0, 6.2832, 0, 0]))),
    ]


def other_kind_cases() -> list[Case]:
    """Files that are no recordings at all."""
    workbook = io.BytesIO()
    with zipfile.ZipFile(workbook, "w") as archive:
        archive.writestr("xl/workbook.xml", "<workbook/>")
    plain_zip = io.BytesIO()
    with zipfile.ZipFile(plain_zip, "w") as archive:
        archive.writestr("demo.csv", GOOD)
    array = io.BytesIO()
    np.save(array, Q)
    return [
        Case("pickle.pkl", "pickle", raw(pickle.dumps({"q": Q}))),
        Case("bare_array.npy", "no-joint-names", raw(array.getvalue())),
        Case("compressed.csv.gz", "compressed", raw(gzip.compress(GOOD.encode()))),
        Case("zipped.zip", "compressed", raw(plain_zip.getvalue())),
        Case("workbook.xlsx", "excel", raw(workbook.getvalue())),
        Case("lfs_pointer.bag", "git-lfs", text("version https://git-lfs.github.com/spec/v1\noid sha256:00\nsize 9\n")),
        Case("robot.urdf", "not-a-recording", text('<?xml version="1.0"?><robot name="r"/>')),
        Case("settings.json", "not-a-recording", text('{"time": [0, 1]}')),
        Case("matlab.mat", "damaged", raw(b"MATLAB 5.0 MAT-file, Platform: GLNXA64" + bytes(100))),
        Case("random.bin", "unknown-format", raw(np.random.default_rng(0).bytes(3000))),
        Case("prose.txt", "no-time", text("Dear reader,\nthis is a letter.\n")),
    ]


def archive_cases() -> list[Case]:
    """NumPy archives."""
    names = np.array(JOINTS)
    good = {"time": TIME, "q": Q, "u": U, "joint_names": names}
    return [
        Case("good.npz", "accept", npz(**good)),
        Case("good_compressed.npz", "accept", npz(compressed=True, **good)),
        Case("byte_names.npz", "accept", npz(**{**good, "joint_names": names.astype("S")})),
        Case("names_given.npz", "accept", npz(time=TIME, q=Q), {"joint_names": JOINTS}),
        Case("more_arrays.npz", "note", npz(**good, camera=np.zeros((4, 4)))),
        Case("no_names.npz", "no-joint-names", npz(time=TIME, q=Q)),
        Case("no_time.npz", "no-time", npz(q=Q, joint_names=names)),
        Case("objects.npz", "pickle", npz(**{**good, "q": Q.astype(object)})),
        Case("complex.npz", "not-a-number", npz(**{**good, "q": Q.astype(complex)})),
        Case("booleans.npz", "not-a-number", npz(**{**good, "q": Q > 0})),
        Case("text_array.npz", "not-a-number", npz(**{**good, "q": Q.astype(str)})),
        Case("transposed.npz", "note", npz(**{**good, "q": Q.T})),
        Case("flat.npz", "shape", npz(**{**good, "q": Q[:, 0]})),
        Case("fewer_names.npz", "shape", npz(**{**good, "joint_names": names[:2]})),
        Case("longer_u.npz", "shape", npz(**{**good, "u": U[:-1]})),
        Case("empty_arrays.npz", "too-short", npz(time=TIME[:0], q=Q[:0], joint_names=names)),
        Case("other_joints.npz", "missing-joint", npz(**{**good, "joint_names": np.array(["a", "b", "c"])})),
        Case("bomb.npz", "bomb", bomb_archive),
        Case("header_asks_for_more.npz", "damaged", lying_archive),
        Case("header_is_code.npz", "damaged", code_archive),
        Case("same_array_twice.npz", "duplicate-column", doubled_archive),
        Case("cut_off.npz", "damaged", lambda path: cut(path, npz(**good), 0.5)),
        Case("flipped_bits.npz", "damaged", flipped_archive),
    ]


def npy(array: np.ndarray) -> bytes:
    stream = io.BytesIO()
    np.save(stream, array)
    return stream.getvalue()


def archive_of(path: Path, members: list[tuple[str, bytes]], method: int = zipfile.ZIP_STORED) -> None:
    with warnings.catch_warnings(), zipfile.ZipFile(path, "w", method) as archive:
        warnings.simplefilter("ignore", UserWarning)  # a name that comes twice is the point of one case
        for name, content in members:
            archive.writestr(name, content)


def bomb_archive(path: Path) -> None:
    """100 kB that unpack to 96 MB."""
    rows = 4_000_000
    zeros = npy(np.zeros(rows)), npy(np.zeros((rows, 3)))
    members = [("time.npy", zeros[0]), ("q.npy", zeros[1]), ("joint_names.npy", npy(np.array(JOINTS)))]
    archive_of(path, members, zipfile.ZIP_DEFLATED)


def lying_archive(path: Path) -> None:
    """The header of q asks for 7 GB, the data are not there."""
    header = npy(np.zeros((60, 3))).replace(b"(60, 3), }" + b" " * 12, b"(300000000, 3), }" + b" " * 5)
    archive_of(path, [("time.npy", npy(TIME)), ("q.npy", header), ("joint_names.npy", npy(np.array(JOINTS)))])


def code_archive(path: Path) -> None:
    """The header of q is an expression."""
    header = npy(Q).replace(b"'shape': (60, 3)", b"'shape': exit(9)")
    archive_of(path, [("time.npy", npy(TIME)), ("q.npy", header), ("joint_names.npy", npy(np.array(JOINTS)))])


def doubled_archive(path: Path) -> None:
    archive_of(path, [("time.npy", npy(TIME)), ("q.npy", npy(Q)), ("q.npy", npy(Q))])


def cut(path: Path, write: Callable[[Path], None], share: float) -> None:
    write(path)
    content = path.read_bytes()
    path.write_bytes(content[: int(len(content) * share)])


def flipped_archive(path: Path) -> None:
    npz(time=TIME, q=Q, joint_names=np.array(JOINTS))(path)
    content = bytearray(path.read_bytes())
    at = content.find(Q.tobytes()[:64])
    content[at + 20] ^= 0xFF
    path.write_bytes(bytes(content))


def stub_cases() -> list[Case]:
    """Beginnings of heavy formats with nothing sensible behind."""
    info = json.dumps({"codebase_version": "v1.6", "features": {}})
    return [
        Case("stub.bag", "damaged", raw(b"#ROSBAG V2.0\n" + bytes(200))),
        Case("old.bag", "old-bag", raw(b"#ROSBAG V1.2\n" + bytes(200))),
        Case("random.bag", "damaged", raw(b"#ROSBAG V2.0\n" + np.random.default_rng(1).bytes(5000))),
        Case("random.mcap", "damaged", raw(b"\x89MCAP0\r\n" + np.random.default_rng(2).bytes(5000))),
        Case("random.db3", "damaged", raw(b"SQLite format 3\x00" + np.random.default_rng(3).bytes(5000))),
        Case("random.parquet", "damaged", raw(b"PAR1" + np.random.default_rng(4).bytes(5000) + b"PAR1")),
        Case("random.hdf5", "damaged", raw(b"\x89HDF\r\n\x1a\n" + np.random.default_rng(5).bytes(5000))),
        Case("stub.csv.zst", "compressed", raw(b"\x28\xb5\x2f\xfd" + bytes(50))),
        Case("lerobot_v1", "version", lambda path: folder(path, {"meta/info.json": info})),
        Case("lerobot_no_data", "empty", lambda path: folder(path, {"meta/info.json": "{}"})),
        Case("ros2_no_storage", "damaged", lambda path: folder(path, {"metadata.yaml": "a: [1"})),
        Case("empty_folder", "no-recordings", lambda path: folder(path, {})),
        Case(
            "folder_of_notes", "no-recordings", lambda path: folder(path, {"README.md": "hello there", "x.json": "{}"})
        ),
        Case("two_kinds", "mixed-folder", two_kinds),
        Case("one_bad_in_folder", "ragged", lambda path: folder(path, {"a.csv": GOOD, "b.csv": GOOD[:-14] + "\n"})),
        Case("folder_with_readme", "note", lambda path: folder(path, {"a.csv": GOOD, "README.md": "hello there"})),
        Case(
            "folder", "accept", lambda path: folder(path, {"demo_1.csv": GOOD, "demo_10.csv": GOOD, "demo_2.csv": GOOD})
        ),
        Case("not_there.csv", "missing-file", lambda path: None),
    ]


def folder(path: Path, files: dict[str, str]) -> None:
    path.mkdir()
    for name, content in files.items():
        (path / name).parent.mkdir(parents=True, exist_ok=True)
        (path / name).write_text(content, encoding="utf-8")
    if path.name == "lerobot_v1":
        (path / "data").mkdir()
        (path / "data" / "episode_000000.parquet").write_bytes(b"PAR1")


def two_kinds(path: Path) -> None:
    folder(path, {"a.csv": GOOD})
    npz(time=TIME, q=Q, joint_names=np.array(JOINTS))(path / "b.npz")


def claim_cases() -> list[Case]:
    """Files of each format that claim to hold more than any recording: refused before it is read."""
    wide = HEADER + "".join(f",c{i}" for i in range(10_000))
    deep = "[" * 200 + "]" * 200
    names = np.array(JOINTS)
    cases = [
        Case("wide.csv", "too-large", text(wide + "\n" + ",".join(["1"] * 10_004) + "\n")),
        Case("wide.npz", "too-large", npz(True, time=TIME[:2], q=np.zeros((2, 10_001)), joint_names=names)),
        Case("deep_lerobot", "damaged", lambda path: lerobot_folder(path, deep)),
        Case("large_lerobot", "too-large", lambda path: lerobot_folder(path, " " * 10_000_001)),
        Case("deep_bag", "damaged", lambda path: folder(path, {"metadata.yaml": deep})),
        Case("large_bag", "too-large", lambda path: folder(path, {"metadata.yaml": " " * 10_000_001})),
    ]
    given = {"joint_names": JOINTS, "rate": 50.0}
    shapes = {"wide": ((2, 10_001), "too-large"), "bomb": ((4_000_000, 3), "bomb"), "huge": ((10**9, 3), "too-large")}
    for name, (shape, verdict) in shapes.items():
        cases.append(Case(f"{name}.hdf5", verdict, partial(hdf5, shape=shape), given))
    given = {"joint_names": JOINTS, "units": "radians"}
    cases.append(Case("bomb.parquet", "bomb", parquet_bomb, given))
    cases.append(Case("bomb_episode.parquet", "bomb", parquet_bomb, {**given, "episodes": 0}))
    return cases


def lerobot_folder(path: Path, info: str) -> None:
    folder(path, {"meta/info.json": info, "data/file-000.parquet": "PAR1"})


def hdf5(path: Path, shape: tuple[int, int]) -> None:
    """Positions of which only the first chunk is stored, packed."""
    h5py = importlib.import_module("h5py")
    with h5py.File(path, "w") as file:
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


CHAPTERS = (text_cases, number_cases, other_kind_cases, archive_cases, stub_cases, claim_cases)
CASES = [case for chapter in CHAPTERS for case in chapter()]
