"""robomimic HDF5, written by h5py: demonstrations come back; nothing outside the file is opened."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import recording_corpus
from case import case

from manip_learn.errors import RecordingError
from manip_learn.recordings import load_demonstrations
from manip_learn.robot import Robot

h5py = pytest.importorskip("h5py", reason="the extra 'robomimic' is not installed")

JOINTS = ("joint1", "joint2", "joint3")
RATE = 20.0
T = np.arange(60) / RATE
Q = np.column_stack([np.sin(T), 1.0 + np.cos(T), 0.5 * T])
U = np.column_stack([np.cos(T), -np.sin(T), 0.5 + 0.0 * T])
ENV_ARGS = json.dumps({"env_name": "Lift", "env_kwargs": {"control_freq": RATE}})


def write(
    path: Path, demos: tuple[int, ...] = (0, 1, 2, 10), env_args: Any = ENV_ARGS, velocities: bool = True
) -> Path:
    with h5py.File(path, "w") as file:
        data = file.create_group("data")
        if env_args is not None:
            data.attrs["env_args"] = env_args
        for i in demos:
            obs = data.create_group(f"demo_{i}/obs")
            obs["robot0_joint_pos"] = Q + 0.01 * i
            if velocities:
                obs["robot0_joint_vel"] = U
            data[f"demo_{i}/actions"] = np.zeros((len(T), 7))
    return path


def refusal(path: Path, robot: Robot, **options: Any) -> RecordingError:
    error = recording_corpus.refusal(path, robot, **{"joint_names": JOINTS, **options})
    assert path.name in str(error)
    return error


def test_round_trip(planar3: Robot, tmp_path: Path) -> None:
    """All demonstrations in natural order, bit for bit; stamps from control_freq, which is said."""
    demos = load_demonstrations(write(tmp_path / "low_dim.hdf5"), planar3, joint_names=JOINTS)
    assert [t.name for t in demos] == [f"low_dim.hdf5 demo_{i}" for i in (0, 1, 2, 10)]
    np.testing.assert_array_equal(demos[3].q, Q + 0.1)
    np.testing.assert_array_equal(demos[3].u, U)
    np.testing.assert_allclose(demos[3].time, T)
    assert "control_freq" in demos.notes[0] and "3 more" in demos.notes[0]
    (other,) = load_demonstrations(
        write(tmp_path / "a.hdf5", (0,), velocities=False), planar3, joint_names=JOINTS[::-1]
    )
    np.testing.assert_array_equal(other.q, Q[:, ::-1])
    assert other.u is None


def test_what_else_is_in_a_demonstration(planar3: Robot, tmp_path: Path) -> None:
    """The next observations are no recording; stamps go before a rate; of two arms the caller says which is read."""
    path = write(tmp_path / "a.hdf5", (0,))
    with h5py.File(path, "a") as file:
        file["data/demo_0/next_obs/robot0_joint_pos"] = Q
        file["data/demo_0/obs/robot0_gripper_qpos"] = Q[:, :2]
        file["data/demo_0/obs/timestamps"] = 2.0 * T
    (demo,) = load_demonstrations(path, planar3, joint_names=JOINTS)
    np.testing.assert_allclose(demo.time, 2.0 * T)
    np.testing.assert_array_equal(demo.q, Q)
    with h5py.File(path, "a") as file:
        file["data/demo_0/obs/robot1_joint_pos"] = Q + 0.1
    assert "rename={'robot1_joint_pos': 'q'}" in str(refusal(path, planar3))
    (demo,) = load_demonstrations(path, planar3, joint_names=JOINTS, rename={"robot1_joint_pos": "q"})
    np.testing.assert_array_equal(demo.q, Q + 0.1)


def test_the_rate_must_be_known(planar3: Robot) -> None:
    """Without a usable control_freq the rate must be given."""
    for env_args in [None, "{}", "not json", json.dumps({"env_kwargs": {"control_freq": 0}}), "[" * 5000]:
        with case(env_args) as tmp_path:
            path = write(tmp_path / "a.hdf5", env_args=env_args)
            assert refusal(path, planar3).code == "no-time"
            demos = load_demonstrations(path, planar3, joint_names=JOINTS, rate=RATE)
            np.testing.assert_allclose(demos[0].time, T)


def outside_link(file: Any, folder: Path) -> None:
    write(folder / "secret.hdf5")
    file["data/demo_0/obs/robot0_joint_pos"] = h5py.ExternalLink("secret.hdf5", "data/demo_0/obs/robot0_joint_pos")


def outside_group(file: Any, folder: Path) -> None:
    write(folder / "secret.hdf5")
    del file["data"]
    file["data"] = h5py.ExternalLink("secret.hdf5", "data")


def soft_link(file: Any, folder: Path) -> None:
    file["data/demo_0/obs/robot0_joint_pos"] = h5py.SoftLink("/data/demo_1/obs/robot0_joint_pos")


def outside_storage(file: Any, folder: Path) -> None:
    (folder / "secret.bin").write_bytes(Q.tobytes())
    file["data/demo_0/obs"].create_dataset(
        "robot0_joint_pos", Q.shape, "f8", external=[(str(folder / "secret.bin"), 0, Q.nbytes)]
    )


def virtual(file: Any, folder: Path) -> None:
    write(folder / "secret.hdf5")
    layout = h5py.VirtualLayout(Q.shape, "f8")
    layout[:] = h5py.VirtualSource(str(folder / "secret.hdf5"), "data/demo_0/obs/robot0_joint_pos", Q.shape)
    file["data/demo_0/obs"].create_virtual_dataset("robot0_joint_pos", layout)


def test_nothing_outside_is_opened(planar3: Robot) -> None:
    """Links, external storage and virtual data sets are refused, though they would deliver good numbers."""
    for make in [outside_link, outside_group, soft_link, outside_storage, virtual]:
        with case(make) as tmp_path:
            path = write(tmp_path / "a.hdf5")
            with h5py.File(path, "a") as file:
                del file["data/demo_0/obs/robot0_joint_pos"]
                make(file, tmp_path)
            assert refusal(path, planar3).code == "link"


def replaced(value: Any, **options: Any) -> Callable[[Any], None]:
    def change(obs: Any) -> None:
        obs.create_dataset("robot0_joint_pos", data=value, **options)

    return change


def test_data_that_do_not_fit_are_refused(planar3: Robot) -> None:
    """Missing, ragged, not numbers, absurd sizes: refused before the numbers are read, where that is possible."""
    for change, code in [
        (lambda obs: None, "no-state"),
        (lambda obs: obs.create_group("robot0_joint_pos"), "no-state"),
        (replaced(Q[:, 0]), "shape"),
        (replaced(Q[:, :2]), "shape"),
        (replaced(Q[:-1]), "shape"),
        (replaced(Q.astype("S8")), "no-state"),
        (replaced(np.where(Q == Q[5, 1], np.nan, Q)), "not-finite"),
        (replaced(np.zeros((5_000_000, 3)), compression="gzip"), "bomb"),
        (lambda obs: obs.create_dataset("robot0_joint_pos", (60, 3), "f8"), "damaged"),
        (lambda obs: obs.create_dataset("robot0_joint_pos", (10**12, 3), "f8", chunks=(1000, 3)), "damaged"),
        (replaced(np.degrees(Q)), "degrees"),
        (replaced(np.stack([Q, Q])), "no-state"),
    ]:
        with case(change, code) as tmp_path:
            path = write(tmp_path / "a.hdf5")
            with h5py.File(path, "a") as file:
                obs = file["data/demo_0/obs"]
                del obs["robot0_joint_pos"]
                if code == "degrees":
                    del obs["robot0_joint_vel"]
                change(obs)
            assert refusal(path, planar3).code == code
