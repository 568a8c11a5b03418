"""Damaged recordings of every format: read, or refused in one line; never another exception, never a signal."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from recording_corpus import GOOD, JOINTS, TIME, Q, U, npz

from manip_learn.errors import RecordingError
from manip_learn.recordings import load_demonstrations
from manip_learn.robot import Robot, load_robot

TRIALS = 2000 if os.environ.get("HYPOTHESIS_PROFILE") == "fuzz" else 40
WORDS = (b"\xff\xff\xff\xff", b"\x00\x00\x00\x00", b"\xff\xff\xff\x7f", b"\x00\x00\x00\x80", b"\x01\x00\x00\x00")
OPTIONS: dict[str, dict[str, Any]] = {
    "parquet": {"units": "radians", "joint_names": JOINTS},
    "hdf5": {"joint_names": JOINTS, "rate": 50.0},
}


def table_file(path: Path) -> None:
    path.write_text(GOOD)


def parquet_file(path: Path) -> None:
    pa = pytest.importorskip("pyarrow", reason="the extra 'lerobot' is not installed")
    pq = pytest.importorskip("pyarrow.parquet")
    state = pa.FixedSizeListArray.from_arrays(pa.array(Q.ravel()), 3)
    columns = {"observation.state": state, "timestamp": TIME, "episode_index": np.repeat([0, 1], 30)}
    pq.write_table(pa.table(columns), path)


def hdf5_file(path: Path) -> None:
    h5py = pytest.importorskip("h5py", reason="the extra 'robomimic' is not installed")
    with h5py.File(path, "w") as file:
        for i in range(2):
            file[f"data/demo_{i}/obs/robot0_joint_pos"] = Q
            file[f"data/demo_{i}/obs/robot0_joint_vel"] = U


def bag_file(kind: str, **options: Any) -> Callable[[Path], None]:
    def write(path: Path) -> None:
        pytest.importorskip("rosbags", reason="the extra 'ros' is not installed")
        import test_rosbag_reader as bags

        bag = bags.write_bag(path.with_name("bag"), kind, bags.all_in_one()[:40], **options)
        file = bag if bag.is_file() else next(p for p in bag.iterdir() if p.suffix in (".db3", ".mcap"))
        path.write_bytes(file.read_bytes())

    return write


FILES: dict[str, Callable[[Path], None]] = {
    "csv": table_file,
    "npz": npz(time=TIME, q=Q, u=U, joint_names=np.array(JOINTS)),
    "npz_compressed": npz(True, time=TIME, q=Q, u=U, joint_names=np.array(JOINTS)),
    "parquet": parquet_file,
    "hdf5": hdf5_file,
    "ros1": bag_file("ros1"),
    "sqlite": bag_file("sqlite"),
    "mcap": bag_file("mcap"),
}


def damaged(content: bytes, rng: np.random.Generator) -> bytes:
    """Cut off, bits flipped, bytes or counts overwritten; the first 16 bytes, which name the format, stay."""
    broken = bytearray(content)
    kind, at = rng.integers(4), int(rng.integers(16, len(content) - 8))
    if kind == 0:
        return bytes(broken[:at])
    if kind == 1:
        broken[at] ^= 1 << int(rng.integers(8))
    elif kind == 2:
        broken[at : at + 8] = rng.bytes(8)
    else:
        broken[at : at + 4] = WORDS[rng.integers(len(WORDS))]
    return bytes(broken)


@pytest.mark.fuzz
@pytest.mark.parametrize("name", FILES)
def test_damaged_files_are_read_or_refused(name: str, tmp_path: Path, rng: np.random.Generator) -> None:
    """40 damages (2,000 with `make fuzz`): nothing but demonstrations or a RecordingError comes out."""
    robot: Robot = load_robot("planar3")
    whole = tmp_path / "whole.npz"
    FILES[name](whole)
    content = whole.read_bytes()
    assert len(load_demonstrations(whole, robot, **OPTIONS.get(name, {}))) >= 1
    path = tmp_path / "damaged"
    refused = 0
    for _ in range(TRIALS):
        path.write_bytes(damaged(content, rng))
        try:
            load_demonstrations(path, robot, **OPTIONS.get(name, {}))
        except RecordingError as error:
            refused += 1
            assert "\n" not in str(error)
    assert refused > 0
