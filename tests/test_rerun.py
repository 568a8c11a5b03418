"""Rerun recordings: read back with Rerun's own reader, every value is that of the rollout."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest
from test_playback import waving

from manip_learn.cli import main
from manip_learn.errors import OutputError
from manip_learn.playback import write_rerun
from manip_learn.robot.loading import load_robot


@pytest.fixture(scope="module")
def chunks_of():
    """File -> entity path -> name of a component -> list of its values; the timeline among them [s]."""
    chunk = pytest.importorskip("rerun.chunk", reason="NO RERUN: ITS RECORDINGS ARE NOT TESTED")

    def read(path):
        found: dict[str, dict[str, list]] = {}
        for part in chunk.RrdReader(path).stream():
            batch = part.to_record_batch()
            for name, column in zip(batch.schema.names, batch.columns, strict=True):
                if name == "time":
                    column = column.cast("int64")
                values = found.setdefault(part.entity_path, {}).setdefault(name, [])
                values.extend(np.array(column.to_pylist()) / 1e9 if name == "time" else column.to_pylist())
        return found

    return read


def followed(robot, duration=2.0, phase=0.0):
    """A rollout with everything that a rollout can have, on a clock of its own."""
    rollout = waving(robot, duration, phase=phase)
    error = np.linspace(0.2, 0.0, len(rollout))
    error[7] = np.nan
    u = np.gradient(rollout.q, rollout.time, axis=0)[:, : robot.nv]
    return replace(rollout, time=rollout.time + 5.0, u=u, task_error=error, following_error=error / 9)


def scalars(entities, path, first=0.0):
    """Times and numbers of one curve."""
    entity = entities[path]
    return np.array(entity["time"]) - first, np.array([v[0] for v in entity["Scalars:scalars"]])


@pytest.mark.parametrize("robot_name", ["panda", "wrist", "planar3"])
def test_every_sample_comes_back(robot_of, tmp_path, chunks_of, robot_name):
    """Joints, velocities and curves are those of the rollout, at its times; what is NaN is not there."""
    robot = robot_of(robot_name)
    rollout = followed(robot)
    entities = chunks_of(write_rerun(robot, {"take 1": rollout}, tmp_path / "a.rrd"))
    positions = np.array([robot.positions(q) for q in rollout.q])
    known = np.isfinite(rollout.task_error)
    expected = {"manipulability": rollout.manipulability, "task_error": rollout.task_error[known]}
    expected["following_error"] = rollout.following_error[known]
    for j, joint in enumerate(robot.joint_names):
        expected |= {f"position/{joint}": positions[:, j], f"velocity/{joint}": rollout.u[:, j]}
    for name, values in expected.items():
        time, found = scalars(entities, f"/take\\ 1/{name}")
        np.testing.assert_array_equal(found, values)
        moments = rollout.time[known] if name.endswith("_error") else rollout.time
        np.testing.assert_allclose(time, moments, rtol=0, atol=1e-9)


def test_robot_tip_and_status(robot_of, tmp_path, chunks_of):
    """Joints and tip are where kinematics puts them, meshes are whole; the status is there."""
    robot = robot_of("panda")
    rollout = followed(robot)
    entities = chunks_of(write_rerun(robot, {"a": rollout}, tmp_path / "a.rrd", tip="panda_hand"))
    model = robot.pinocchio_model
    data, k = model.createData(), 57
    pin.forwardKinematics(model, data, robot.pinocchio_configuration(rollout.q[k]))
    for i in range(1, model.njoints):
        found = entities[f"/world/a/robot/{model.names[i]}"]
        place, turn = found["Transform3D:translation"][k][0], found["Transform3D:quaternion"][k][0]
        pose = pin.XYZQUATToSE3(np.array([*place, *turn], dtype=float))
        np.testing.assert_allclose(pose.homogeneous, data.oMi[i].homogeneous, atol=1e-6)  # single precision
    meshes = [e for path, e in entities.items() if "/shape_" in path and "Mesh3D:vertex_positions" in e]
    assert len(meshes) >= 8
    for mesh in meshes:
        triangles = np.array(mesh["Mesh3D:triangle_indices"][0])
        assert triangles.max() < len(mesh["Mesh3D:vertex_positions"][0]) and len(triangles) > 100
        lengths = np.linalg.norm(mesh["Mesh3D:vertex_normals"][0], axis=1)
        assert np.mean(np.abs(lengths - 1.0) < 1e-5) > 0.99
    tip = np.array([p[0] for p in entities["/world/a/tip"]["Points3D:positions"] if p])
    np.testing.assert_allclose(tip[k], robot.position(rollout.q[k], robot.frame("panda_hand")), atol=1e-6)
    path = np.array(entities["/world/a/tip/path"]["LineStrips3D:strips"][0][0])
    np.testing.assert_allclose(path, tip, atol=1e-7)
    words = [text[0] for text in entities["/a/status"]["TextLog:text"]]
    changes = [i for i in range(len(rollout)) if i == 0 or rollout.status[i] != rollout.status[i - 1]]
    assert words == [rollout.status[i] for i in changes] and len(words) > 2
    np.testing.assert_allclose(entities["/a/status"]["time"], rollout.time[changes], rtol=0, atol=1e-9)


def test_export_to_rrd(tmp_path, chunks_of, capsys):
    """`export --to rrd`, or an ending of .rrd, writes rollouts and recordings with all that they have into one file."""
    robot = load_robot("planar3")
    files = []
    for name, phase in (("learnt", 0.0), ("zero", 1.0)):
        files.append(str(replace(waving(robot, phase=phase)).save(tmp_path / f"{name}.npz")))
    out = tmp_path / "both.rrd"
    assert main(["export", "planar3", *files, "--out", str(out)]) == 0
    assert "both.rrd" in capsys.readouterr().out.replace("\n", "")
    entities = chunks_of(out)
    for name, phase in (("learnt", 0.0), ("zero", 1.0)):
        np.testing.assert_array_equal(
            scalars(entities, f"/{name}/manipulability")[1], waving(robot, phase=phase).manipulability
        )
    assert main(["export", "planar3", files[0], "--out", str(tmp_path / "folder"), "--to", "rrd"]) != 0
    assert "both.rrd" not in capsys.readouterr().err
    with pytest.raises(OutputError, match=r"\.rrd"):
        write_rerun(robot, waving(robot), tmp_path / "a.mcap")
    with pytest.raises(OutputError, match="write_rerun"):
        waving(robot).save(tmp_path / "a.rrd")
