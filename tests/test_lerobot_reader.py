"""LeRobot data, written by pyarrow in the layouts of v2.1 and v3.0: episodes come back, units must be stated."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from case import case
from recording_corpus import refusal

from manip_learn.recordings import load_demonstrations
from manip_learn.robot import Robot, load_robot

pa = pytest.importorskip("pyarrow", reason="the extra 'lerobot' is not installed")
import pyarrow.parquet as pq  # noqa: E402

from manip_learn.recordings.readers.lerobot import entry_names  # noqa: E402

JOINTS = ["joint1", "joint2", "joint3"]
FPS = 50


def motion(episode: int, n: int = 80) -> np.ndarray:
    t = np.arange(n) / FPS
    return np.column_stack([np.sin(t) + 0.01 * episode, 1.0 + np.cos(t), 0.5 * t])


def table(episodes: dict[int, np.ndarray], kind: str = "fixed", **more: Any):
    """Frames of some episodes as LeRobot stores them, with a column that is not needed."""
    state = np.concatenate(list(episodes.values())).astype(np.float32)
    frames = np.concatenate([np.arange(len(q)) for q in episodes.values()])
    flat = pa.array(state.ravel())
    lists = {
        "fixed": lambda: pa.FixedSizeListArray.from_arrays(flat, state.shape[1]),
        "list": lambda: pa.array(state.tolist(), type=pa.list_(pa.float32())),
        "large": lambda: pa.array(state.astype(float).tolist(), type=pa.large_list(pa.float64())),
    }
    columns = {
        "observation.state": lists[kind](),
        "action": lists[kind](),
        "timestamp": pa.array((frames / FPS).astype(np.float32)),
        "frame_index": pa.array(frames),
        "episode_index": pa.array(np.repeat(list(episodes), [len(q) for q in episodes.values()])),
        "note": pa.array(["x"] * len(frames)),
    }
    return pa.table({**columns, **more})


def info(names: Any, version: str = "v2.1", **more: Any) -> dict[str, Any]:
    state = {"dtype": "float32", "shape": [3], "names": names}
    return {"codebase_version": version, "fps": FPS, "features": {"observation.state": state, "action": state}, **more}


def dataset(root: Path, description: dict[str, Any], files: dict[str, Any]) -> Path:
    (root / "meta").mkdir(parents=True)
    (root / "meta" / "info.json").write_text(json.dumps(description))
    for name, content in files.items():
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        pq.write_table(content, root / name)
    return root


def version_2(root: Path, names: Any = JOINTS, scale: float = 1.0, kind: str = "fixed") -> Path:
    files = {f"data/chunk-000/episode_{i:06d}.parquet": table({i: scale * motion(i)}, kind) for i in (0, 1, 2, 10)}
    return dataset(root, info(names), files)


def version_3(root: Path, names: Any = JOINTS) -> Path:
    files = {
        "data/chunk-000/file-000.parquet": table({0: motion(0), 1: motion(1, 50), 2: motion(2)[:30]}),
        "data/chunk-000/file-001.parquet": table({3: motion(3)}),
        "meta/episodes/chunk-000/file-000.parquet": pa.table({"episode_index": [0, 1, 2, 3]}),
    }
    return dataset(root, info({"motors": names}, "v3.0"), files)


def test_version_2_round_trip(planar3: Robot) -> None:
    """One trajectory per file, in natural order, float32 as stored."""
    for kind in ["fixed", "list", "large"]:
        with case(kind) as tmp_path:
            demos = load_demonstrations(version_2(tmp_path / "set", kind=kind), planar3, units="radians")
            assert [t.name for t in demos] == [f"set episode {i}" for i in (0, 1, 2, 10)]
            for t, i in zip(demos, (0, 1, 2, 10), strict=True):
                np.testing.assert_array_equal(t.q, motion(i).astype(np.float32))
                np.testing.assert_allclose(t.time, np.arange(80) / FPS, rtol=0, atol=1e-6)
                assert t.u is None


def test_an_episode_may_go_on_in_the_next_file(planar3: Robot, tmp_path: Path) -> None:
    """Cut between files in the middle of an episode: still one trajectory; tables of metadata are no episodes."""
    whole = table({0: motion(0), 1: motion(1)})
    files = {
        "data/chunk-000/file-000.parquet": whole.slice(0, 100),
        "data/chunk-000/file-001.parquet": whole.slice(100),
        "meta/episodes/chunk-000/file-000.parquet": pa.table({"episode_index": [0, 1, 2, 3]}),
    }
    demos = load_demonstrations(dataset(tmp_path / "set", info(JOINTS, "v3.0"), files), planar3, units="radians")
    assert [len(t) for t in demos] == [80, 80]
    np.testing.assert_array_equal(demos[1].q, motion(1).astype(np.float32))


def test_a_single_file_finds_its_data_set(planar3: Robot, tmp_path: Path) -> None:
    """Names come from the meta folder above; without one they must be given."""
    root = version_2(tmp_path / "set")
    file = root / "data/chunk-000/episode_000001.parquet"
    np.testing.assert_array_equal(
        load_demonstrations(file, planar3, units="radians")[0].q, motion(1).astype(np.float32)
    )
    alone = tmp_path / "alone.parquet"
    alone.write_bytes(file.read_bytes())
    assert refusal(alone, planar3, match="joint_names", units="radians").code == "no-joint-names"
    demos = load_demonstrations(alone, planar3, units="radians", joint_names=["joint3", "joint2", "joint1"])
    np.testing.assert_array_equal(demos[0].q, motion(1).astype(np.float32)[:, ::-1])


def test_units_are_never_guessed(planar3: Robot) -> None:
    """Not stated: refused, with what the values look like. Stated: converted, with a note unless they are radians."""
    for scale, units, guess in [
        (1.0, "radians", "'radians'"),
        (57.29578, "degrees", "'degrees'"),
        (30.0, "normalised", "'normalised'"),
    ]:
        with case(scale, units, guess) as tmp_path:
            root = version_2(tmp_path / "set", scale=scale)
            assert refusal(root, planar3, match=guess).code == "units"
            demos = load_demonstrations(root, planar3, units=units)
            factor = {"radians": 1.0, "degrees": np.pi / 180, "normalised": 12.5 / 100}[units]
            np.testing.assert_allclose(demos[2].q, motion(2) * scale * factor, rtol=1e-6, atol=1e-6)
            assert bool(demos.notes) == (units != "radians")


def test_grippers_are_in_percent(robot_of) -> None:
    """LeRobot keeps the gripper in 0 .. 100 whatever the unit of the arm; '.pos' is taken off the names; both said."""
    for units in ["degrees", "normalised"]:
        with case(units) as tmp_path:
            robot = load_robot("so101")
            n = 40
            names = [f"{j}.pos" for j in robot.joint_names]
            state = np.tile(np.linspace(-20.0, 20.0, n)[:, None], (1, robot.nv))
            g = robot.joint_names.index("gripper")
            state[:, g] = np.linspace(0.0, 100.0, n)
            description = info(names)
            root = dataset(tmp_path / "set", description, {"data/chunk-000/episode_000000.parquet": table({0: state})})
            demos = load_demonstrations(root, robot, units=units)
            np.testing.assert_allclose(
                demos[0].q[[0, -1], g], [robot.position_lower[g], robot.position_upper[g]], rtol=0, atol=1e-6
            )
            if units == "degrees":
                np.testing.assert_allclose(demos[0].q[:, g - 1], np.radians(state[:, g - 1]), rtol=0, atol=1e-6)
            said = " ".join(demos.notes)
            assert "gripper" in said and ".pos" in said


def test_velocities_in_the_state_or_beside_it(planar3: Robot, tmp_path: Path) -> None:
    """'.vel' entries and observation.velocity are the recorded velocities."""
    q = motion(0)
    u = np.gradient(q, 1 / FPS, axis=0)
    names = [f"{j}.pos" for j in JOINTS] + [f"{j}.vel" for j in JOINTS]
    files = {"data/a.parquet": table({0: np.hstack([q, u])})}
    demos = load_demonstrations(dataset(tmp_path / "one", info(names), files), planar3, units="radians")
    np.testing.assert_array_equal(demos[0].u, u.astype(np.float32))
    beside = {"observation.velocity": pa.array(u.tolist())}
    files = {"data/a.parquet": table({0: q}, **beside)}
    demos = load_demonstrations(dataset(tmp_path / "two", info(JOINTS), files), planar3, units="radians")
    np.testing.assert_array_equal(demos[0].u, u)
    names = [*JOINTS, *(f"{j}_velocity" for j in JOINTS), *(f"{j}_acceleration" for j in JOINTS)]
    files = {"data/a.parquet": table({0: np.hstack([q, u, u])})}
    demos = load_demonstrations(dataset(tmp_path / "three", info(names), files), planar3, units="radians")
    np.testing.assert_array_equal(demos[0].q, q.astype(np.float32))
    np.testing.assert_array_equal(demos[0].u, u.astype(np.float32))


def test_names_come_in_many_forms() -> None:
    """Lists, groups and index tables are understood, everything else is no name."""
    for names in (["a", "b"], {"motors": ["a", "b"]}, {"arm": ["a"], "hand": ["b"]}, {"b": 1, "a": 0}):
        assert entry_names(names) == ("a", "b"), names
    for names in ({"b": 5, "a": 0}, None, [], {}, [1, 2], "ab", {"motors": "ab"}):
        assert entry_names(names) is None, names


STATES = motion(0).tolist()
GOOD = info(JOINTS)
# what a data set says of itself, its samples, and the code of the refusal
UNFIT: dict[str, tuple[Any, Any, str]] = {
    "an early version": ({"codebase_version": "v1.6"}, None, "version"),
    "no features": ({"codebase_version": "v2.1"}, None, "no-state"),
    "no state": ({"codebase_version": "v2.1", "features": {}}, None, "no-state"),
    "no object": ([], None, "damaged"),
    "too few names": (info(["a"]), None, "shape"),
    "no names": (info(None), None, "no-joint-names"),
    "names of others": (info(["a", "b", "c"]), None, "missing-joint"),
    "a sample is missing": (GOOD, pa.array([*STATES[:-1], None], type=pa.list_(pa.float64())), "not-finite"),
    "a short sample": (GOOD, pa.array([*STATES[:-1], [1.0]]), "ragged"),
    "text": (GOOD, pa.array([[str(x) for x in row] for row in STATES]), "not-a-number"),
}


def test_what_does_not_fit_is_refused(planar3: Robot) -> None:
    """Nothing is filled in, and nothing is guessed."""
    for name, (description, states, code) in UNFIT.items():
        with case(name) as tmp_path:
            frames = table({0: motion(0)})
            frames = frames if states is None else frames.set_column(0, "observation.state", states)
            root = dataset(tmp_path / "set", description, {"data/a.parquet": frames})
            assert refusal(root, planar3, units="radians").code == code


KEY = "observation.state.joint_position"
NAMED = {"joint_names": JOINTS, "units": "radians", "feature": KEY}


def droid(root: Path) -> Path:
    """A data set in the layout of DROID: joints under a key of their own."""
    q = {i: motion(i) for i in (0, 1, 2)}
    joints = np.concatenate(list(q.values()))
    velocity = np.concatenate([np.gradient(x, 1 / FPS, axis=0) for x in q.values()])
    arrays = {KEY: joints, "observation.state.joint_velocity": velocity}
    arrays["observation.state.cartesian_position"] = np.zeros((len(joints), 6))
    frames = table(q).drop_columns(["observation.state", "action"])
    for name, values in arrays.items():
        frames = frames.append_column(name, pa.array(values.tolist(), type=pa.list_(pa.float32())))
    features = {name: {"dtype": "float32", "shape": [a.shape[1]], "names": None} for name, a in arrays.items()}
    features["observation.images.wrist"] = {"dtype": "video", "shape": [180, 320, 3], "names": None}
    features["language_instruction"] = {"dtype": "string", "shape": [1], "names": None}
    description = {**info(None, "v3.0"), "features": features}
    return dataset(root, description, {"data/chunk-000/file-000.parquet": frames})


def test_joints_under_another_key_are_read(planar3: Robot, tmp_path: Path) -> None:
    """`feature` names the key, its velocities come along, and episodes are selected as ever."""
    demos = load_demonstrations(droid(tmp_path / "set"), planar3, **NAMED, episodes="1:3")
    assert [t.name for t in demos] == ["set episode 1", "set episode 2"]
    for t, i in zip(demos, (1, 2), strict=True):
        np.testing.assert_array_equal(t.q, motion(i).astype(np.float32))
        np.testing.assert_array_equal(t.u, np.gradient(motion(i), 1 / FPS, axis=0).astype(np.float32))


def test_a_wrong_key_is_an_error_with_near_matches(planar3: Robot) -> None:
    """Left out where there is no usual state, misspelt, or no vector of numbers: what to pass is said."""
    for feature, said in [
        (None, f"there is no feature 'observation.state', joint positions seem to be in '{KEY}'.*feature='{KEY}'"),
        ("observation.state.joint_positon", f"did you mean '{KEY}'"),
        ("observation.images.wrist", "holds video, joint positions are a vector of numbers"),
        ("language_instruction", "holds string"),
    ]:
        with case(feature, said) as tmp_path:
            path = droid(tmp_path / "set")
            assert refusal(path, planar3, match=said, **{**NAMED, "feature": feature}).code == "no-state"


def test_times_are_stamps_or_frames_over_fps(planar3: Robot) -> None:
    """Stamps that do not run are frame_index / fps, with a note; those that contradict fps are refused with both."""
    frames = np.arange(80)
    for name, stamps, options, note in [
        ("zero", 0.0 * frames, {}, "the stamps do not increase: frame_index / 50 is the time"),
        ("in pairs", frames // 2 / 25.0, {}, "the stamps do not increase"),
        ("overruled", frames / 30.0, {"rate": 50.0}, "stamps are overruled"),
        ("as they are", frames / 50.0 + 3.0, {}, ""),
    ]:
        with case(name) as tmp_path:
            files = {"data/chunk-000/episode_000000.parquet": table({0: motion(0)}, timestamp=pa.array(stamps))}
            demos = load_demonstrations(
                dataset(tmp_path / "set", info(JOINTS), files), planar3, units="radians", **options
            )
            np.testing.assert_allclose(demos[0].time - demos[0].time[0], frames / 50.0, atol=1e-9)
            assert note in "".join(demos.notes) and bool(note) == bool(demos.notes)
    with case("contradicted") as tmp_path:
        files = {"data/chunk-000/episode_000000.parquet": table({0: motion(0)}, timestamp=pa.array(frames / 30.0))}
        error = refusal(dataset(tmp_path / "set", info(JOINTS), files), planar3, units="radians")
        assert error.code == "fps" and "say 30 frames per second, fps says 50" in str(error)
