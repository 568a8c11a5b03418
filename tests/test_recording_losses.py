"""Damaged recordings do not lose samples in silence, wherever their format stores how many there are."""

from __future__ import annotations

import os
import sqlite3
import struct
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from case import case
from recording_corpus import JOINTS, TIME, Q, U
from test_recording_fuzz import OPTIONS, bag_file, damaged

from manip_learn.errors import RecordingError
from manip_learn.recordings import load_demonstrations
from manip_learn.robot import Robot, load_robot

MUTANTS = 5000 if os.environ.get("HYPOTHESIS_PROFILE") == "fuzz" else 60


def hdf5_file(path: Path) -> None:
    """As robomimic writes it: the numbers of demonstrations and of samples are attributes."""
    h5py = pytest.importorskip("h5py", reason="the extra 'robomimic' is not installed")
    with h5py.File(path, "w") as file:
        for i in range(3):
            file[f"data/demo_{i}/obs/robot0_joint_pos"] = Q
            file[f"data/demo_{i}/obs/robot0_joint_vel"] = U
            file[f"data/demo_{i}"].attrs["num_samples"] = len(Q)
        file["data"].attrs["total"] = 3 * len(Q)


def parquet_file(path: Path) -> None:
    """Three parts, so that a damaged part can go missing by itself."""
    pa = pytest.importorskip("pyarrow", reason="the extra 'lerobot' is not installed")
    pq = pytest.importorskip("pyarrow.parquet")
    state = pa.FixedSizeListArray.from_arrays(pa.array(Q.ravel()), 3)
    columns = {"observation.state": state, "timestamp": TIME, "episode_index": np.repeat([0, 1], 30)}
    pq.write_table(pa.table(columns), path, row_group_size=20)


FILES: dict[str, Callable[[Path], None]] = {
    "mcap": bag_file("mcap"),
    "bag": bag_file("ros1"),
    "db3": bag_file("sqlite"),
    "hdf5": hdf5_file,
    "parquet": parquet_file,
}


@pytest.fixture(scope="module")
def planar3() -> Robot:
    return load_robot("planar3")


@pytest.mark.fuzz
@pytest.mark.parametrize("name", FILES)
def test_no_sample_is_lost_in_silence(name: str, planar3: Robot, tmp_path: Path, rng: np.random.Generator) -> None:
    """60 damages (5,000 with `make fuzz`): what is accepted without a further note has all of its samples."""
    path = tmp_path / "recording"
    FILES[name](path)
    content, options = path.read_bytes(), OPTIONS.get(name, {})
    whole = load_demonstrations(path, planar3, **options)
    lost, accepted = [], 0
    for number in range(MUTANTS):
        path.write_bytes(damaged(content, rng))
        try:
            demos = load_demonstrations(path, planar3, **options)
        except RecordingError:
            continue
        accepted += 1
        if demos.n_samples != whole.n_samples and demos.notes == whole.notes:
            lost.append((number, demos.n_samples))
    print(f"{name}: {MUTANTS} mutants, {accepted} accepted, {len(lost)} with samples lost in silence")
    assert lost == []


def ros2_bag(folder: Path, kind: str) -> tuple[Path, Path]:
    """A bag of 200 messages and its one file."""
    import test_rosbag_reader as bags

    bag = bags.write_bag(folder / "bag", kind, bags.all_in_one())
    return bag, next(p for p in bag.iterdir() if p.suffix in (".db3", ".mcap"))


def refusal(path: Path, robot: Robot) -> RecordingError:
    with pytest.raises(RecordingError) as caught:
        load_demonstrations(path, robot)
    return caught.value


def test_the_metadata_of_a_bag_is_believed(planar3: Robot, tmp_path_factory: pytest.TempPathFactory) -> None:
    """A folder with fewer messages than its metadata.yaml states is refused, with both numbers and the way out."""
    for kind in ["sqlite", "mcap"]:
        with case(kind):
            tmp_path = tmp_path_factory.mktemp("case")
            pytest.importorskip("rosbags", reason="the extra 'ros' is not installed")
            bag, _ = ros2_bag(tmp_path, kind)
            metadata = bag / "metadata.yaml"
            metadata.write_text(metadata.read_text().replace("message_count: 200", "message_count: 225"))
            error = refusal(bag, planar3)
            assert error.code == "lost-messages"
            assert all(word in str(error) for word in ("200 messages", "states 225", "ros2 bag reindex"))


def test_rows_that_are_gone_are_missed(planar3: Robot, tmp_path: Path) -> None:
    """A database from which messages were deleted: its own copy of the metadata tells, without metadata.yaml."""
    pytest.importorskip("rosbags", reason="the extra 'ros' is not installed")
    _, file = ros2_bag(tmp_path, "sqlite")
    with sqlite3.connect(file) as database:
        database.execute("DELETE FROM messages WHERE id > 175")
    assert refusal(file, planar3).code == "lost-messages"
    with sqlite3.connect(file) as database:
        database.execute("UPDATE messages SET topic_id = 9 WHERE id = 20")
    assert "belong to no topic" in str(refusal(file, planar3))


def test_a_killed_recorder_is_noticed(planar3: Robot, tmp_path_factory: pytest.TempPathFactory) -> None:
    """A log beside the database holds messages that are not in it: refused with the command; empty, it is fine."""
    for end in ["-wal", "-journal"]:
        with case(end):
            tmp_path = tmp_path_factory.mktemp("case")
            pytest.importorskip("rosbags", reason="the extra 'ros' is not installed")
            bag, file = ros2_bag(tmp_path, "sqlite")
            side = file.with_name(file.name + end)
            for path in (bag, file):
                side.write_bytes(b"")
                assert load_demonstrations(path, planar3).n_samples == 200
                side.write_bytes(b"x" * 32)
                error = refusal(path, planar3)
                assert error.code == "unfinished" and "PRAGMA wal_checkpoint(TRUNCATE)" in str(error)


KILLED = """
import os, sqlite3, sys
database = sqlite3.connect(sys.argv[1])
database.execute("PRAGMA journal_mode = WAL")
database.execute("PRAGMA wal_autocheckpoint = 0")
rows = database.execute("SELECT topic_id, timestamp, data FROM messages WHERE id > 100").fetchall()
database.execute("DELETE FROM messages WHERE id > 100")
database.commit()
database.execute("PRAGMA wal_checkpoint(TRUNCATE)")
database.executemany("INSERT INTO messages (topic_id, timestamp, data) VALUES (?, ?, ?)", rows)
database.commit()
os._exit(9)
"""


def test_the_way_out_of_a_killed_recording_works(planar3: Robot, tmp_path: Path) -> None:
    """100 of 200 messages are in the log of a recorder that was killed; after the command that the error names, all."""
    pytest.importorskip("rosbags", reason="the extra 'ros' is not installed")
    bag, file = ros2_bag(tmp_path, "sqlite")
    subprocess.run([sys.executable, "-c", KILLED, str(file)], check=False)
    assert file.with_name(file.name + "-wal").stat().st_size > 0
    assert refusal(bag, planar3).code == "unfinished"
    database = sqlite3.connect(file)
    database.executescript("PRAGMA wal_checkpoint(TRUNCATE); SELECT count(*) FROM messages;")
    database.close()
    assert load_demonstrations(bag, planar3).n_samples == 200


def test_the_statistics_of_an_mcap_file_are_believed(planar3: Robot, tmp_path: Path) -> None:
    """A file whose statistics state more messages than it has is refused, in a folder and alone."""
    pytest.importorskip("rosbags", reason="the extra 'ros' is not installed")
    bag, file = ros2_bag(tmp_path, "mcap")
    content = bytearray(file.read_bytes())
    at = content.rindex(struct.pack("<IHQ", 10, 1, 200))
    struct.pack_into("<Q", content, at + 6, 225)
    struct.pack_into("<Q", content, content.rindex(struct.pack("<QHI", 200, 1, 1), 0, at), 225)
    file.write_bytes(bytes(content))
    for path in (bag, file):
        error = refusal(path, planar3)
        assert "200 messages" in str(error) and "state 225" in str(error)


def test_a_bag_of_many_chunks_and_topics_is_whole(planar3: Robot, tmp_path_factory: pytest.TempPathFactory) -> None:
    """Long messages fill several chunks, and another topic lies in between: nothing is missed, nothing suspected."""
    for kind in ["mcap", "sqlite", "ros1"]:
        with case(kind):
            tmp_path = tmp_path_factory.mktemp("case")
            pytest.importorskip("rosbags", reason="the extra 'ros' is not installed")
            import test_rosbag_reader as bags

            others = tuple(f"finger_{i}" for i in range(300))
            messages = [
                (t, r, (s, (*n, *others), (*q, *np.zeros(300)))) for t, r, (s, n, q, _) in bags.all_in_one(u=None)
            ]
            messages += [("/other", r + 1, (s, ("x",), (0.5,))) for _, r, (s, *_) in bags.all_in_one(u=None)]
            bag = bags.write_bag(tmp_path / "bag", kind, sorted(messages, key=lambda m: m[1]))
            file = bag if bag.is_file() else next(p for p in bag.iterdir() if p.suffix in (".db3", ".mcap"))
            for path in (bag, file):
                assert load_demonstrations(path, planar3).n_samples == 200
            if kind == "mcap":
                assert file.stat().st_size > 2**20 and "of 1 chunks" not in " ".join(
                    load_demonstrations(file, planar3).notes
                )


def test_chunks_without_a_checksum_are_said_once(planar3: Robot, tmp_path: Path) -> None:
    """The library's writer stores no checksum of chunks; with one, nothing is said, and a flipped bit is refused."""
    pytest.importorskip("rosbags", reason="the extra 'ros' is not installed")
    import zlib

    _, file = ros2_bag(tmp_path, "mcap")
    assert "1 of 1 chunks have no checksum" in " ".join(load_demonstrations(file, planar3).notes)
    content = bytearray(file.read_bytes())
    start = next(i for i in range(8, len(content)) if content[i] == 6 and is_chunk(content, i))
    (size,) = struct.unpack_from("<Q", content, start + 9 + 16)
    first = start + 9 + 40
    struct.pack_into("<I", content, start + 9 + 24, zlib.crc32(content[first : first + size]))
    file.write_bytes(bytes(content))
    assert load_demonstrations(file, planar3).notes == ()
    content[first + size // 2] ^= 1
    file.write_bytes(bytes(content))
    assert "checksum" in str(refusal(file, planar3))


def is_chunk(content: bytearray, at: int) -> bool:
    """True if an uncompressed chunk record begins here."""
    if at + 49 > len(content):
        return False
    length, size, compression, packed = (*struct.unpack_from("<Q16xQ4xIQ", content, at + 1),)
    return compression == 0 and size == packed and length == size + 40


def test_the_attributes_of_robomimic_are_believed(planar3: Robot, tmp_path_factory: pytest.TempPathFactory) -> None:
    """A file with fewer samples or demonstrations than its attributes state is refused."""
    for where, attribute in [("data", "total"), ("data/demo_1", "num_samples"), ("data", "num_demos")]:
        with case(where, attribute):
            tmp_path = tmp_path_factory.mktemp("case")
            h5py = pytest.importorskip("h5py", reason="the extra 'robomimic' is not installed")
            path = tmp_path / "demo.hdf5"
            hdf5_file(path)
            assert load_demonstrations(path, planar3, joint_names=JOINTS, rate=50.0).n_samples == 180
            with h5py.File(path, "r+") as file:
                file[where].attrs[attribute] = 999
            with pytest.raises(RecordingError, match=f"{attribute!r}.*999") as caught:
                load_demonstrations(path, planar3, joint_names=JOINTS, rate=50.0)
            assert caught.value.code == "lost-samples"
