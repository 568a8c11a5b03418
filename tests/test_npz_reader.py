"""NumPy archives: what np.savez wrote comes back, whatever the byte order; our rollouts can be learnt from again."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.io
from recording_corpus import JOINTS, TIME, Q, U

from manip_learn.control.rollout import Rollout
from manip_learn.recordings import load_demonstrations
from manip_learn.robot import Robot


def saved(path: Path, **changes: Any) -> Path:
    arrays = {"time": TIME, "q": Q, "u": U, "joint_names": np.array(JOINTS), **changes}
    np.savez(path, **{k: v for k, v in arrays.items() if v is not None})
    return path


def test_round_trip(planar3: Robot, tmp_path: Path) -> None:
    """Bit for bit, in the robot's order, without a note, whatever the order in memory."""
    order = [2, 0, 1]
    q, u = np.asfortranarray(Q[:, order]), np.repeat(U[:, order], 2, axis=1)[:, ::2]
    demos = load_demonstrations(saved(tmp_path / "a.npz", q=q, u=u, joint_names=np.array(JOINTS)[order]), planar3)
    np.testing.assert_array_equal(demos[0].q, Q)
    np.testing.assert_array_equal(demos[0].u, U)
    np.testing.assert_array_equal(demos[0].time, TIME)
    assert demos.notes == ()


def test_other_number_types_are_converted_and_said(planar3: Robot, tmp_path: Path) -> None:
    """Big-endian, short and integer numbers are read for what they are, with a note each."""
    for dtype in (">f8", "<f4", ">f4", "<f2", "<i4", ">i8", "u1"):
        q = (Q * 3.0).astype(dtype)
        demos = load_demonstrations(saved(tmp_path / "a.npz", q=q, u=None), planar3)
        np.testing.assert_array_equal(demos[0].q, q.astype(np.float64))
        assert any(dtype.strip("<>|") in note for note in demos.notes), dtype


def test_a_rollout_can_be_learnt_from_again(planar3: Robot, tmp_path: Path) -> None:
    """Rollout.save -> load_demonstrations: the same motion; limits are not used to doubt our own units."""
    rollout = Rollout(TIME, Q * 10.0, U * 10.0, TIME, ("ok",) * 60, JOINTS, TIME)
    demos = load_demonstrations(rollout.save(tmp_path / "r.npz"), planar3)
    np.testing.assert_array_equal(demos[0].q, rollout.q)
    np.testing.assert_array_equal(demos[0].u, rollout.u)
    assert any("beyond their limits" in note for note in demos.notes)


def test_a_rollout_of_configurations_becomes_joint_positions(robot_of, tmp_path: Path) -> None:
    """Continuous joints as (cos, sin) in a rollout are read as angles, with their full turns."""
    robot = robot_of("wrist")
    positions = np.column_stack([3.0 + TIME, 0.1 * TIME, 6.0 * TIME, 0.2 * TIME])
    q = np.array([robot.configuration(p) for p in positions])
    u = np.gradient(positions, TIME, axis=0)
    rollout = Rollout(TIME, q, u, TIME, ("ok",) * 60, robot.joint_names, TIME)
    demos = load_demonstrations(rollout.save(tmp_path / "r.npz"), robot)
    np.testing.assert_allclose(demos[0].q, positions, rtol=0, atol=1e-9)
    assert "full turns added" in " ".join(demos.notes)


def cell(*values: Any) -> np.ndarray:
    out = np.empty((1, len(values)), dtype=object)
    out[0, :] = values
    return out


STACK, STAMPED = np.stack([Q, 2.0 * Q]), np.vstack([Q.T, TIME])
# name of the file -> what is in it, and the options that read it
LISTS: dict[str, tuple[Any, dict[str, Any]]] = {
    "stack.npy": (STACK, {"joint_names": JOINTS, "rate": 100.0}),
    "stack.npz": ({"demos": STACK}, {"joint_names": JOINTS, "rate": 100.0}),
    "cells.mat": ({"demos": cell(Q, 2.0 * Q)}, {"joint_names": JOINTS, "rate": 100.0}),
    "cells_with_time.mat": ({"demos": cell(Q, 2.0 * Q), "times": cell(TIME, TIME)}, {"joint_names": JOINTS}),
    "structs.mat": (
        {"data": cell(*({"arm": {"pose": STAMPED, "joint_states": x}, "times": [0.0, 3.0]} for x in (STAMPED,) * 2))},
        {"joint_names": (*JOINTS, "time")},
    ),
}


@pytest.mark.parametrize("name", LISTS)
def test_lists_of_recordings(name: str, planar3: Robot, tmp_path: Path) -> None:
    """Stacks, cells and structs are as many recordings as they have elements, without a name to be given.

    A pose is not taken for them, a time of something else not for theirs, and what is no joint is left out, aloud.
    """
    content, options = LISTS[name]
    path = tmp_path / name
    if path.suffix == ".mat":
        scipy.io.savemat(path, content)
    else:
        np.save(path, content) if path.suffix == ".npy" else np.savez(path, **content)
    demos = load_demonstrations(path, planar3, **options)
    factors = [1.0, 1.0] if "structs" in name else [1.0, 2.0]
    assert len(demos) == len(factors)
    for demo, factor in zip(demos, factors, strict=True):
        np.testing.assert_allclose(demo.q, factor * Q, rtol=0, atol=1e-12)
        np.testing.assert_allclose(np.diff(demo.time), 0.01 if "rate" in options else np.diff(TIME), rtol=1e-6)
