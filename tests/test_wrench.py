"""The wrench of a force-torque sensor: kept by trajectories and every cut, read wherever recorded, written exactly."""

from __future__ import annotations

import json
import pickle
from pathlib import Path

import numpy as np
import pytest
from case import case
from recording_corpus import refusal

from manip_learn.errors import OutputError, RecordingError
from manip_learn.learning.repeats import joined_pieces
from manip_learn.recordings import load_demonstrations
from manip_learn.recordings.demonstrations import Demonstrations
from manip_learn.recordings.format_words import WRENCH_NAMES, wrench_columns, wrench_sets
from manip_learn.recordings.preprocessing import resample, subsample, trim_standstill
from manip_learn.recordings.saved_motion import motion_of_trajectory
from manip_learn.recordings.trajectory import Trajectory
from manip_learn.recordings.velocities import derive_velocities
from manip_learn.recordings.writers.mcap_writer import mcap_bytes
from manip_learn.recordings.writers.write_motion import csv_bytes, npz_bytes
from manip_learn.robot import load_robot

T, ROBOT = 80, load_robot("planar3")
TIME = 0.01 * np.arange(T)
Q = np.column_stack([np.sin(TIME), np.cos(TIME), 0.3 * TIME])
U = np.column_stack([np.cos(TIME), -np.sin(TIME), 0.3 + 0.0 * TIME])
WRENCH = np.column_stack([np.exp(TIME), -3.0 * TIME, 1.0 / 3.0 + TIME, TIME**2, 0.1 - TIME, np.cos(9.0 * TIME)])
EFFORT = 10.0 * Q
NAMES = ROBOT.joint_names


def trajectory(u: np.ndarray | None = None, effort: np.ndarray | None = None) -> Trajectory:
    return Trajectory(TIME, Q, u, NAMES, "demo", effort=effort, wrench=WRENCH)


def test_it_is_checked_as_velocities_are():
    """Wrong shapes and NaN are refused; the array is frozen; a pickle keeps it."""
    with pytest.raises(RecordingError, match=r"wrench must have shape \(80, 6\), got \(80, 3\)"):
        Trajectory(TIME, Q, None, NAMES, wrench=WRENCH[:, :3])
    with pytest.raises(RecordingError, match="wrench of sample 1 is nan"):
        Trajectory(TIME, Q, None, NAMES, wrench=np.where(np.arange(T * 6).reshape(T, 6) == 10, np.nan, WRENCH))
    with pytest.raises(ValueError, match="read-only"):
        trajectory().wrench[0] = 1.0
    np.testing.assert_array_equal(pickle.loads(pickle.dumps(trajectory(U))).wrench, WRENCH)
    assert "a wrench" in repr(trajectory()) and Trajectory(TIME, Q).wrench is None


def test_cuts_keep_it():
    """A span of time, chosen samples, another grid, velocities derived, pieces joined: that of the samples left."""
    t = trajectory(U)
    np.testing.assert_array_equal(t[0.2:0.4].wrench, WRENCH[20:41])
    np.testing.assert_array_equal(t.with_joint_names(("a", "b", "c")).wrench, WRENCH)
    np.testing.assert_allclose(resample(t, 0.005).wrench[1], WRENCH[:2].mean(axis=0))
    for cut in (subsample(t, 9), trim_standstill(t), derive_velocities(trajectory(), ROBOT)):
        np.testing.assert_array_equal(cut.wrench, WRENCH[np.searchsorted(TIME, cut.time - 1e-6)])
    halfway = derive_velocities(trajectory(), ROBOT, "midpoint")
    np.testing.assert_allclose(halfway.wrench, 0.5 * (WRENCH[1:] + WRENCH[:-1]))
    pieces = [t.part(slice(0, 30)), t.part(slice(30, T))]
    np.testing.assert_array_equal(joined_pieces(pieces, [(0, 0.0), (1, 0.0)]).wrench, WRENCH)
    without = Trajectory(pieces[1].time, pieces[1].q, pieces[1].u, NAMES)
    assert joined_pieces([pieces[0], without], [(0, 0.0), (1, 0.0)]).wrench is None


def test_own_formats_keep_it_exactly():
    """Written and read again, bit for bit, with velocities and efforts beside it and without."""
    content = {".npz": npz_bytes, ".csv": csv_bytes, ".mcap": mcap_bytes}
    for ending in [*content, ""]:
        for u in [U, None]:
            for effort in [EFFORT, None]:
                with case(ending, u is None, effort is None) as tmp_path:
                    pytest.importorskip({".mcap": "rosbags", "": "pyarrow"}.get(ending, "numpy"))
                    motion, path = motion_of_trajectory(trajectory(u, effort), ROBOT), tmp_path / f"out{ending}"
                    if ending == "":
                        from manip_learn.recordings.writers.lerobot_writer import write_lerobot

                        write_lerobot(path, [motion])
                    else:
                        path.write_bytes(content[ending](motion))
                    (again,) = load_demonstrations(path, ROBOT)
                    assert again.wrench is not None and again.wrench.tobytes() == WRENCH.tobytes()
                    assert (again.u is None, again.effort is None) == (u is None, effort is None)


def test_a_data_set_has_it_throughout_or_not_at_all(tmp_path: Path):
    """Episodes with and without one are not mixed in one data set."""
    pytest.importorskip("pyarrow")
    from manip_learn.recordings.writers.lerobot_writer import write_lerobot

    motions = [motion_of_trajectory(t, ROBOT) for t in (trajectory(), Trajectory(TIME, Q, None, NAMES))]
    with pytest.raises(OutputError, match="some trajectories have a wrench and others not"):
        write_lerobot(tmp_path / "out", motions)


def test_tables_say_it_in_many_ways():
    """By the names that people and programs write, in any order, with units and whatever stands before them."""
    axes = [("f{}", "t{}"), ("F{}", "M{}"), ("force_{}", "torque_{}"), ("ee_force.{}", "ee_torque.{}")]
    axes += [("/ft/wrench/force/{}", "/ft/wrench/torque/{}"), ("field.wrench.force.{}", "field.wrench.torque.{}")]
    axes += [("F{} [N]", "T{} [Nm]"), ("Fx_N".replace("x", "{}"), "Tx_Nm".replace("x", "{}"))]
    families = [[f.format(a) for a in "xyz"] + [t.format(a) for a in "xyz"] for f, t in axes]
    numbered = ["actual_TCP_force_{}", "O_F_ext_hat_K[{}]", "wrench_{}", "ft_sensor_{}", "force_torque[{}]"]
    families += [[pattern.format(i) for i in range(6)] for pattern in numbered]
    families += [[f"tcp_wrench.{i}" for i in range(1, 7)]]
    for names in families:
        with case(names[0]) as tmp_path:
            write_table(tmp_path / "demo.csv", [*names[::-1], *NAMES], np.hstack([WRENCH[:, ::-1], Q]))
            demos = load_demonstrations(tmp_path / "demo.csv", ROBOT)
            np.testing.assert_array_equal(demos[0].wrench, WRENCH)
            assert any(f"the wrench is read from {names[0]} ... {names[-1]}" in note for note in demos.notes)


def test_other_columns_are_no_wrench():
    """Commands, fingertips, forces without torques, joint torques, words that end alike."""
    six = [f"wrench_{i}" for i in range(6)]
    assert wrench_columns(six)[0] == (0, 1, 2, 3, 4, 5)
    for names in [
        [f"desired_{n}" for n in six],
        [f"tactile_{n}" for n in six],
        six[:5],
        ["fx", "fy", "fz"],
        [f"tau_ext_hat_filtered[{i}]" for i in range(7)],
        [f"shift_{i}" for i in range(6)],
        ["x", "y", "z", "tx", "ty", "tz"],
    ]:
        assert wrench_columns(names) == ((), "")
    assert wrench_sets({"action.wrench": 6, "observation.shift": 6, "observation.wrench": 14, "a.force": 3}) == []


def test_of_several_in_a_table_none_is_guessed(tmp_path: Path):
    """A note names them; without the columns of one the other is read."""
    both = [f"{frame}_F_ext_hat_K[{i}]" for frame in "OK" for i in range(6)]
    write_table(tmp_path / "a.csv", [*NAMES, *both], np.hstack([Q, 0.0 * WRENCH, WRENCH]))
    said = load_demonstrations(tmp_path / "a.csv", ROBOT, columns="{joint}")
    assert said[0].wrench is None and any("several wrenches are recorded (O_F_ext" in n for n in said.notes)
    one = load_demonstrations(tmp_path / "a.csv", ROBOT, columns="{joint}", ignore_columns=both[:6])
    np.testing.assert_array_equal(one[0].wrench, WRENCH)


def test_the_log_of_libfranka(tmp_path: Path):
    """Measured torques beside numbered positions; neither commands (`_d`) nor the estimate of what the world exerts."""
    heads = ["state.q", "state.q_d", "state.dq", "state.tau_J", "state.tau_ext_hat_filtered", "cmd.tau_J_d"]
    values = [Q, 0.0 * Q, U, EFFORT, 0.0 * Q, 0.0 * Q]
    names = [f"{head}[{i}]" for head in heads for i in range(3)] + [f"O_F_ext_hat_K[{i}]" for i in range(6)]
    write_table(tmp_path / "log.csv", names, np.hstack([*values, WRENCH]))
    patterns = ["state.q[{index}]", "state.dq[{index}]"]
    (t,) = load_demonstrations(tmp_path / "log.csv", ROBOT, columns=patterns)
    for read, meant in [(t.u, U), (t.effort, EFFORT), (t.wrench, WRENCH)]:
        np.testing.assert_array_equal(read, meant)


def test_currents_are_no_efforts(tmp_path: Path):
    """Amperes are not newton metres, and the moments that a controller asks for were not measured."""
    heads = ["actual_q", "actual_qd", "actual_current", "target_moment"]
    names = [f"{head}_{i}" for head in heads for i in range(3)]
    write_table(tmp_path / "log.csv", names, np.hstack([Q, U, EFFORT, EFFORT]))
    (t,) = load_demonstrations(tmp_path / "log.csv", ROBOT, columns=["actual_q_{index}", "actual_qd_{index}"])
    assert t.effort is None and t.u is not None


def test_archives_and_frames(tmp_path: Path):
    """An array `wrench`; a table of pandas, there and back; a width other than six is refused; NaN is a note."""
    np.savez(tmp_path / "demo.npz", time=TIME, q=Q, wrench=WRENCH, joint_names=NAMES)
    np.testing.assert_array_equal(load_demonstrations(tmp_path / "demo.npz", ROBOT)[0].wrench, WRENCH)
    np.savez(tmp_path / "half.npz", time=TIME, q=Q, wrench=WRENCH[:, :3], joint_names=NAMES)
    refusal(tmp_path / "half.npz", ROBOT, match="three forces and torques are needed")
    np.savez(tmp_path / "nan.npz", time=TIME, q=Q, wrench=np.where(WRENCH > 2.0, np.nan, WRENCH), joint_names=NAMES)
    broken = load_demonstrations(tmp_path / "nan.npz", ROBOT)
    assert broken[0].wrench is None and any("the wrench is not finite in" in n for n in broken.notes)
    pytest.importorskip("pandas")
    frame = Demonstrations([trajectory(), Trajectory(TIME, Q, None, NAMES, "bare")]).to_frame()
    assert list(frame.columns)[-6:] == list(WRENCH_NAMES)
    again = load_demonstrations(frame, ROBOT)
    np.testing.assert_array_equal(again[0].wrench, WRENCH)
    assert again[1].wrench is None


def test_samples_that_are_left_out_take_theirs_along(tmp_path: Path):
    """A row that is there twice is dropped with its wrench, and parts between gaps keep their own."""
    time = TIME + np.where(np.arange(T) >= 40, 5.0, 0.0)
    rows = [*range(10), 9, *range(10, T)]
    write_table(tmp_path / "demo.csv", [*NAMES, *WRENCH_NAMES], np.hstack([Q, WRENCH])[rows], time[rows])
    parts = load_demonstrations(tmp_path / "demo.csv", ROBOT)
    np.testing.assert_array_equal(np.concatenate([part.wrench for part in parts]), WRENCH)
    assert len(parts) == 2


def test_bags_carry_it_on_a_topic_of_its_own():
    """ROS 1 and 2, with a header and without: interpolated linearly at the stamps of the joint states."""
    bags = pytest.importorskip("test_rosbag_reader", exc_type=ImportError)
    for kind in bags.KINDS:
        for stamped in [True, False]:
            with case(kind, stamped) as tmp_path:
                path = write_bag(bags, tmp_path / "bag", kind, {"/ft": bags.STEPS + 5_000_000}, stamped)
                demos = load_demonstrations(path, ROBOT)
                t = demos[0]
                np.testing.assert_allclose(t.wrench[1:], linear(t.time)[1:], atol=1e-6)
                assert any("the wrench is that of /ft, interpolated" in n for n in demos.notes)
                assert any("1 of 200 samples have no message of /ft nearby" in n for n in demos.notes)


def test_of_several_topics_the_caller_chooses(tmp_path: Path):
    """None is used, with a note that says what to type; an unknown topic is refused with those that exist."""
    bags = pytest.importorskip("test_rosbag_reader", exc_type=ImportError)
    path = write_bag(bags, tmp_path / "bag", "mcap", {"/ft_raw": bags.STEPS, "/ft": bags.STEPS}, True)
    demos = load_demonstrations(path, ROBOT)
    assert demos[0].wrench is None
    assert any("(/ft_raw and /ft), so none is used: say which one with topics=['/ft_raw']" in n for n in demos.notes)
    chosen = load_demonstrations(path, ROBOT, topics=["/ft"])[0]
    np.testing.assert_allclose(chosen.wrench, linear(chosen.time), atol=1e-12)
    refusal(path, ROBOT, match="there is no .* topic '/fft'; there is /ft", topics=["/fft"])


def test_a_sensor_that_was_off_for_most_of_the_time_is_not_used(tmp_path: Path):
    """The motion is kept whole, and a note tells why there is no wrench."""
    bags = pytest.importorskip("test_rosbag_reader", exc_type=ImportError)
    path = write_bag(bags, tmp_path / "bag", "mcap", {"/ft": bags.STEPS[:50]}, True)
    demos = load_demonstrations(path, ROBOT)
    assert demos[0].wrench is None and len(demos[0]) == 200
    assert any("150 of 200 samples have no message of /ft nearby, so that wrench is not used" in n for n in demos.notes)


def test_data_sets_of_lerobot(tmp_path: Path):
    """A feature of six under the names in use, by its entries' names; forces beside torques; entries of the state."""
    made = pytest.importorskip("test_lerobot_reader", exc_type=ImportError)
    W, order = WRENCH.astype(np.float32), [3, 4, 5, 0, 1, 2]
    torques_first = ["Tx", "Ty", "Tz", "Fx", "Fy", "Fz"]
    cases = [({name: W}, {}) for name in ("observation.wrench", "observation.force_torque", "observation.ft")]
    cases += [({"observation.state.sensor_ft": W[:, order]}, {"observation.state.sensor_ft": torques_first})]
    cases += [({"observation.force": W[:, :3], "observation.torque": W[:, 3:]}, {})]
    cases += [({"observation.wrench": W, "observation.ft": 0.0 * W}, {}), ({"observation.tactile_wrench": 0.0 * W}, {})]
    for i, (arrays, names) in enumerate(cases):
        root = lerobot(made, tmp_path / str(i), arrays, names)
        (t,) = load_demonstrations(root, ROBOT, units="radians")
        meant = W if i < len(cases) - 1 else None
        np.testing.assert_array_equal(t.wrench, meant)
    root = lerobot(made, tmp_path / "two", {"observation.ft": W, "observation.wrist_wrench": W}, {})
    several = load_demonstrations(root, ROBOT, units="radians")
    assert several[0].wrench is None and any("several wrenches" in n for n in several.notes)
    one = load_demonstrations(root, ROBOT, units="radians", ignore_columns=["observation.ft"])
    np.testing.assert_array_equal(one[0].wrench, W)


def test_motors_of_lerobot_that_measure_torques(tmp_path: Path):
    """`.pos`, `.vel` and `.torque` of each motor and the axes of a sensor, all in the state; or a feature."""
    made = pytest.importorskip("test_lerobot_reader", exc_type=ImportError)
    ends = {".pos": Q, ".vel": 0.5 * U, ".torque": EFFORT}  # 50 samples per second there
    state = np.hstack([*ends.values(), WRENCH]).astype(np.float32)
    entries = [f"{j}{end}" for end in ends for j in NAMES] + [f"ft.{axis}" for axis in WRENCH_NAMES]
    root = lerobot(made, tmp_path / "a", {"observation.state": state}, {"observation.state": entries})
    (t,) = load_demonstrations(root, ROBOT, units="radians")
    for read, columns in [(t.q, slice(0, 3)), (t.u, slice(3, 6)), (t.effort, slice(6, 9)), (t.wrench, slice(9, 15))]:
        np.testing.assert_array_equal(read, state[:, columns])
    root = lerobot(made, tmp_path / "b", {"observation.torque": EFFORT.astype(np.float32)}, {})
    (t,) = load_demonstrations(root, ROBOT, units="radians")
    np.testing.assert_array_equal(t.effort, EFFORT.astype(np.float32))


def test_robosuite_observes_forces_and_torques(tmp_path: Path):
    """Two arrays of the arm's hand, in the spellings that are seen; not those of another arm; of several none."""
    h5py = pytest.importorskip("h5py")
    halves = {"force": WRENCH[:, :3], "torque": WRENCH[:, 3:]}
    for i, (stem, meant) in enumerate([("robot0_ee_", WRENCH), ("robot0_eef_", WRENCH), ("robot1_ee_", None)]):
        obs = {stem + half: values for half, values in halves.items()}
        path = robomimic(h5py, tmp_path / f"{i}.hdf5", obs)
        np.testing.assert_array_equal(load_demonstrations(path, ROBOT, joint_names=NAMES, rate=20.0)[0].wrench, meant)
    both = robomimic(h5py, tmp_path / "both.hdf5", {**obs, "robot0_ft": WRENCH, "robot0_eef_wrench": WRENCH})
    demos = load_demonstrations(both, ROBOT, joint_names=NAMES, rate=20.0)
    assert demos[0].wrench is None and any("several wrenches" in n for n in demos.notes)


def linear(seconds: np.ndarray) -> np.ndarray:
    """A wrench that grows with time, so that it can be told between messages, too."""
    return np.outer(seconds, [1.0, -2.0, 3.0, 0.1, 0.2, -0.3]) + 1.0


def write_bag(bags, path: Path, kind: str, topics: dict[str, np.ndarray], stamped: bool) -> Path:
    """Joint states, and on each of the topics a wrench at some times [ns] after the first of them."""
    types = bags.ROS1 if kind == "ros1" else bags.ROS2
    serialised = types.serialize_ros1 if kind == "ros1" else types.serialize_cdr
    name = "geometry_msgs/msg/WrenchStamped" if stamped else "geometry_msgs/msg/Wrench"
    vector, plain = (types.types[f"geometry_msgs/msg/{n}"] for n in ("Vector3", "Wrench"))
    if kind == "ros1":
        path, writer = path.with_suffix(".bag"), bags.Writer1(path.with_suffix(".bag"))
    else:
        plugin = bags.StoragePlugin.SQLITE3 if kind == "sqlite" else bags.StoragePlugin.MCAP
        writer = bags.Writer2(path, version=9, storage_plugin=plugin)
    with writer:
        joints = writer.add_connection("/joint_states", bags.JOINT_STATE, typestore=types)
        for topic, received, content in bags.all_in_one(delay=0):
            assert topic == "/joint_states"
            writer.write(joints, received, serialised(bags.joint_state(types, *content), bags.JOINT_STATE))
        for topic, times in topics.items():
            connection = writer.add_connection(topic, name, typestore=types)
            for nanoseconds in times.tolist():
                values, stamp = linear(np.array([nanoseconds * 1e-9]))[0], bags.START + nanoseconds
                message = plain(vector(*values[:3]), vector(*values[3:]))
                if stamped:
                    header = bags.joint_state(types, stamp, (), (), frame="ft_frame"[: 3 + nanoseconds % 5]).header
                    message = types.types[name](header, message)
                writer.write(connection, stamp, serialised(message, name))
    return path


def lerobot(made, root: Path, arrays: dict[str, np.ndarray], names: dict[str, list[str]]) -> Path:
    """A data set of one episode with some features beside the state, or in place of it."""
    arrays = {"observation.state": Q.astype(np.float32)} | arrays
    lists = {k: made.pa.array(a.tolist(), type=made.pa.list_(made.pa.float32())) for k, a in arrays.items()}
    described = made.info(list(NAMES))
    described["features"] |= {
        k: {
            "dtype": "float32",
            "shape": [a.shape[1]],
            "names": names.get(k, described["features"].get(k, {}).get("names")),
        }
        for k, a in arrays.items()
    }
    return made.dataset(root, described, {"data/chunk-000/episode_000000.parquet": made.table({0: Q}, **lists)})


def robomimic(h5py, path: Path, obs: dict[str, np.ndarray]) -> Path:
    with h5py.File(path, "w") as file:
        group = file.create_group("data/demo_0/obs")
        for name, values in {"robot0_joint_pos": Q, **obs}.items():
            group[name] = values
        file["data"].attrs["env_args"] = json.dumps({})
    return path


def write_table(path: Path, names: list[str], values: np.ndarray, time: np.ndarray = TIME) -> None:
    rows = [",".join(map(repr, row)) for row in np.column_stack([time, values]).tolist()]
    path.write_text(",".join(["time", *names]) + "\n" + "\n".join(rows) + "\n", encoding="utf-8")
