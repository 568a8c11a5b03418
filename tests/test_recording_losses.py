"""Damaged recordings do not lose samples in silence, wherever their format stores how many there are."""

from __future__ import annotations

import json
import os
import re
import sqlite3
import struct
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import test_lerobot_reader as lerobot
import test_rosbag_reader as bags
import test_saved_files
from case import case
from recording_corpus import FULL, HEADER, JOINTS, TIME, VELOCITIES, Q, U, csv, npz, refusal
from test_damaged_files import mutant

from manip_learn.control.rollout import Rollout
from manip_learn.errors import RecordingError
from manip_learn.recordings import RecordingSource, load_demonstrations
from manip_learn.recordings.saved_motion import motion_of_trajectory
from manip_learn.recordings.trajectory import Trajectory
from manip_learn.recordings.writers.write_motion import mcap_bytes
from manip_learn.robot import Robot, load_robot

MUTANTS = 5000 if os.environ.get("HYPOTHESIS_PROFILE") == "fuzz" else 60
OPTIONS: dict[str, dict[str, Any]] = {
    "parquet": {"units": "radians", "joint_names": JOINTS},
    "hdf5": {"joint_names": JOINTS, "rate": 50.0},
}


def bag_file(kind: str, **options: Any) -> Callable[[Path], None]:
    def write(path: Path) -> None:
        bag = bags.write_bag(path.with_name("bag"), kind, bags.all_in_one()[:40], **options)
        file = bag if bag.is_file() else next(p for p in bag.iterdir() if p.suffix in (".db3", ".mcap"))
        path.write_bytes(file.read_bytes())

    return write


def hdf5_file(path: Path) -> None:
    """As robomimic writes it: the numbers of demonstrations and of samples are attributes."""
    with h5py.File(path, "w") as file:
        for i in range(3):
            file[f"data/demo_{i}/obs/robot0_joint_pos"] = Q
            file[f"data/demo_{i}/obs/robot0_joint_vel"] = U
            file[f"data/demo_{i}"].attrs["num_samples"] = len(Q)
        file["data"].attrs["total"] = 3 * len(Q)


def parquet_file(path: Path) -> None:
    """Three parts, so that a damaged part can go missing by itself."""
    state = pa.FixedSizeListArray.from_arrays(pa.array(Q.ravel()), 3)
    columns = {"observation.state": state, "timestamp": TIME, "episode_index": np.repeat([0, 1], 30)}
    pq.write_table(pa.table(columns), path, row_group_size=20)


FILES: dict[str, Callable[[Path], None]] = {
    "csv": lambda path: path.write_text(csv(FULL, HEADER + VELOCITIES)) and None,
    "npz": npz(time=TIME, q=Q, u=U, joint_names=np.array(JOINTS)),
    "npz_compressed": npz(True, time=TIME, q=Q, u=U, joint_names=np.array(JOINTS)),
    "mcap": bag_file("mcap"),
    "bag": bag_file("ros1"),
    "db3": bag_file("sqlite"),
    "hdf5": hdf5_file,
    "parquet": parquet_file,
}


@pytest.mark.fuzz
@pytest.mark.parametrize("name", FILES)
def test_damaged_files_are_whole_or_refused(
    name: str, planar3: Robot, tmp_path: Path, rng: np.random.Generator
) -> None:
    """60 damages (5,000 with `make fuzz`): demonstrations or a RecordingError in one line, and nothing else; what is
    accepted without a further note has all of its samples, where the format states how many there are.
    """
    path = tmp_path / "whole.npz"
    FILES[name](path)
    content, options = path.read_bytes(), OPTIONS.get(name, {})
    whole = load_demonstrations(path, planar3, **options)
    path = tmp_path / "damaged"
    lost, accepted = [], 0
    for number in range(MUTANTS):
        path.write_bytes(content[:16] + mutant(content[16:], rng))  # the beginning names the format
        try:
            demos = load_demonstrations(path, planar3, **options)
        except RecordingError as error:
            assert str(error).isprintable()
            continue
        accepted += 1
        if demos.n_samples != whole.n_samples and demos.notes == whole.notes:
            lost.append((number, demos.n_samples))
    assert accepted < MUTANTS and (lost == [] or name == "csv")  # which states no number


def ros2_bag(folder: Path, kind: str) -> tuple[Path, Path]:
    """A bag of 200 messages and its one file."""
    bag = bags.write_bag(folder / "bag", kind, bags.all_in_one())
    return bag, next(p for p in bag.iterdir() if p.suffix in (".db3", ".mcap"))


def test_the_metadata_of_a_bag_is_believed(planar3: Robot) -> None:
    """A folder with fewer messages than its metadata.yaml states is refused, with both numbers and the way out."""
    for kind in ["sqlite", "mcap"]:
        with case(kind) as tmp_path:
            bag, _ = ros2_bag(tmp_path, kind)
            metadata = bag / "metadata.yaml"
            metadata.write_text(metadata.read_text().replace("message_count: 200", "message_count: 225"))
            error = refusal(bag, planar3)
            assert error.code == "lost-messages"
            assert all(word in str(error) for word in ("200 messages", "states 225", "ros2 bag reindex"))


def test_a_killed_recorder_is_noticed(planar3: Robot) -> None:
    """A log beside the database holds messages that are not in it: refused with the command; empty, it is fine."""
    for end in ["-wal", "-journal"]:
        with case(end) as tmp_path:
            bag, file = ros2_bag(tmp_path, "sqlite")
            side = file.with_name(file.name + end)
            for path in (bag, file):
                side.write_bytes(b"")
                assert load_demonstrations(path, planar3).n_samples == 200
                side.write_bytes(b"x" * 32)
                error = refusal(path, planar3)
                assert error.code == "unfinished" and "PRAGMA wal_checkpoint(TRUNCATE)" in str(error)


def test_a_bag_of_many_chunks_and_topics_is_whole(planar3: Robot) -> None:
    """Long messages fill several chunks, and another topic lies in between: nothing is missed, nothing suspected."""
    for kind in ["mcap", "sqlite", "ros1"]:
        with case(kind) as tmp_path:
            others = tuple(f"finger_{i}" for i in range(300))
            messages = [
                (t, r, (s, (*n, *others), (*q, *np.zeros(300)))) for t, r, (s, n, q, _) in bags.all_in_one(u=None)
            ]
            messages += [("/other", r + 1, (s, ("x",), (0.5,))) for _, r, (s, *_) in bags.all_in_one(u=None)]
            bag = bags.write_bag(tmp_path / "bag", kind, sorted(messages, key=lambda m: m[1]))
            file = bag if bag.is_file() else next(p for p in bag.iterdir() if p.suffix in (".db3", ".mcap"))
            for path in (bag, file):
                assert load_demonstrations(path, planar3).n_samples == 200


def test_the_attributes_of_robomimic_are_believed(planar3: Robot) -> None:
    """A file with fewer samples or demonstrations than its attributes state is refused."""
    for where, attribute in [("data", "total"), ("data/demo_1", "num_samples"), ("data", "num_demos")]:
        with case(where, attribute) as tmp_path:
            path = tmp_path / "demo.hdf5"
            hdf5_file(path)
            assert load_demonstrations(path, planar3, joint_names=JOINTS, rate=50.0).n_samples == 180
            with h5py.File(path, "r+") as file:
                file[where].attrs[attribute] = 999
            assert (
                refusal(path, planar3, match=f"{attribute!r}.*999", joint_names=JOINTS, rate=50.0).code
                == "lost-samples"
            )


def test_the_totals_of_a_lerobot_data_set_are_believed(planar3: Robot, tmp_path: Path) -> None:
    """A data set with a file missing is refused with both numbers, in memory and in a stream; what is there can be
    selected, and a single file is read for itself.
    """
    for version, gone in (("v2.1", "episode_000002"), ("v3.0", "file-001")):
        with case(version):
            root = (lerobot.version_2 if version == "v2.1" else lerobot.version_3)(tmp_path / version)
            info = root / "meta" / "info.json"
            totals = {"total_frames": 320 if version == "v2.1" else 240, "total_episodes": 4}
            info.write_text(json.dumps(json.loads(info.read_text()) | totals))
            load = partial(load_demonstrations, robot=planar3, units="radians")
            frames = sum(len(t) for t in load(root))
            assert frames == totals["total_frames"] == sum(map(len, streamed(root, planar3)))
            (lost,) = root.glob(f"data/**/{gone}.parquet")
            lost.unlink()
            for read in (load, partial(streamed, robot=planar3)):
                with pytest.raises(RecordingError, match="meta/info.json states total_") as caught:
                    read(root)
                assert caught.value.code == "lost-samples" and "episodes='0:'" in str(caught.value)
            assert len(load(root, episodes=[0, 1])) == 2
            assert load(next(root.glob("data/**/*.parquet"))).n_samples > 0
            info.write_text(json.dumps(json.loads(info.read_text()) | {"total_frames": True, "total_episodes": None}))
            assert load(root).n_samples == totals["total_frames"] - 80


def streamed(root: Path, robot: Robot) -> list[Trajectory]:
    source = RecordingSource(root, robot, units="radians")
    return [t for i in range(source.n_parts) for t in source.part(i)]


def test_an_unsound_database_is_refused(planar3: Robot, tmp_path: Path) -> None:
    """All messages are there, but SQLite finds a page that belongs to nothing; or the topic of a message is gone."""
    _, file = ros2_bag(tmp_path, "sqlite")
    with sqlite3.connect(file) as database:
        database.execute("UPDATE messages SET topic_id = 9 WHERE id = 20")
    assert "of 200 messages that the bag states 199 are of its topics" in str(refusal(file, planar3))
    with sqlite3.connect(file) as database:
        database.execute("CREATE TABLE spare (x)")
    with sqlite3.connect(file) as database:
        database.execute("PRAGMA writable_schema = ON")
        database.execute("DELETE FROM sqlite_master WHERE name = 'spare'")
    error = refusal(file, planar3)
    assert error.code == "damaged" and "SQLite finds" in str(error)


def test_every_fault_of_an_mcap_file_is_refused(planar3: Robot, tmp_path: Path) -> None:
    """What is cut, added, renamed or miscounted in a file that has statistics."""
    good, path = mcap_bytes(motion_of_trajectory(Trajectory(TIME, Q, U, JOINTS, "demo"), planar3)), tmp_path / "d.mcap"
    path.write_bytes(good)
    assert load_demonstrations(path, planar3).n_samples == 60
    counted = struct.pack("<HQ", 1, 60)  # messages of a channel, in the statistics
    faults = {
        "File end magic is invalid": good[: len(good) // 2] + b"xxxxxxxx",
        "the bag cannot be read": good + b"xyz",
        "of 60 messages that the bag states 59 are of its topics": good.replace(counted, struct.pack("<HQ", 1, 59)),
        "of 60 messages that the bag states 0 are of its topics": good.replace(counted, struct.pack("<HQ", 7, 60)),
    }
    for words, content in faults.items():
        with case(words):
            path.write_bytes(content)
            assert re.search(words, str(refusal(path, planar3)))


def test_a_saved_rollout_that_lost_a_sample_is_refused(tmp_path: Path) -> None:
    """In every format: it states how many there were."""
    robot = load_robot(test_saved_files.arm(tmp_path / "arm.urdf"))
    rollout = test_saved_files.rollout_of(robot)
    n = len(rollout.time)
    for ending in test_saved_files.FORMATS:
        with case(ending):
            path = rollout.save(tmp_path / f"run.{ending}")
            if ending == "npz":
                with np.load(path) as archive:
                    arrays = {k: a[:-1] if a.shape[:1] == (n,) else a for k, a in archive.items()}
                np.savez(path, **arrays)
            else:
                path.write_text("".join(path.read_text(encoding="utf-8").splitlines(keepends=True)[:-1]))
            with pytest.raises(RecordingError, match=f"written with {n} samples and holds {n - 1}") as caught:
                Rollout.load(path)
            assert caught.value.code == "damaged"
            assert len(Rollout.load(rollout.save(path)).time) == n


def test_no_control_character_of_a_file_is_printed(planar3: Robot, tmp_path: Path) -> None:
    """Neither of its name nor of its header: in notes, errors and names of trajectories they are written out."""
    path = tmp_path / "demo\x1b[31m.csv"
    header = "time,joint1,joint2,joint3,force\x1b[32m\n"
    (tmp_path / "\x9b2J.txt").write_text("no table")
    rows = np.column_stack([TIME, Q, TIME]).tolist()
    path.write_text(header + "".join(",".join(map(repr, row)) + "\n" for row in rows))
    assert str(refusal(path, planar3)).isprintable()
    for given in (path, tmp_path):
        demos = load_demonstrations(given, planar3, columns="{joint}")
        said: list[str] = []
        (streamed_one,) = RecordingSource(given, planar3, columns="{joint}").part(0, said)
        assert demos.notes and all(note.isprintable() for note in (*demos.notes, *said))
        assert demos[0].name == streamed_one.name == "demo\\x1b[31m.csv"
