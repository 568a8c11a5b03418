"""`manip-learn export`: what is written is what our own readers, and other programs', read again."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from case import case
from recording_corpus import refusal
from task_sets import DATA as EXAMPLES
from task_sets import LOCKED
from test_saved_files import arm, rollout_of

from manip_learn.cli import main
from manip_learn.constraint.constraint import Constraint
from manip_learn.constraint.features import FrameJacobian
from manip_learn.control.controller import ResolvedRateController
from manip_learn.control.rollout import Rollout
from manip_learn.control.simulation import simulate
from manip_learn.control.tasks import PointAttractor
from manip_learn.errors import OutputError
from manip_learn.recordings import load_demonstrations
from manip_learn.recordings.saved_motion import motion_of_trajectory
from manip_learn.recordings.trajectory import Trajectory
from manip_learn.recordings.writers.write_motion import joint_trajectory_bytes, nanoseconds, write_motion
from manip_learn.robot import Robot, load_robot

RECORDING = "time,j1,j2,j3,j1_velocity,j2_velocity,j3_velocity\n"


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """An arm, another arm, and a folder of two recordings on it, at odd times."""
    folder = tmp_path_factory.mktemp("export")
    arm(folder / "arm.urdf")
    arm(folder / "longer.urdf", length=1.1)
    (folder / "demos").mkdir()
    for k in range(2):
        t = 5.0 + 2.5 * k + np.arange(40) * 0.01 + 1e-9 * (np.arange(40) % 3)
        q = np.column_stack([np.sin(t + k), np.cos(t), 0.3 * t])
        u = np.column_stack([np.cos(t + k), -np.sin(t), 0.3 + 0.0 * t])
        rows = [",".join(map(repr, row)) for row in np.column_stack([t, q, u]).tolist()]
        (folder / "demos" / f"demo_{k}.csv").write_text(RECORDING + "\n".join(rows) + "\n", encoding="utf-8")
    return folder


@pytest.fixture(scope="module")
def robot(folder: Path) -> Robot:
    return load_robot(folder / "arm.urdf")


def test_recordings_come_back(folder: Path, robot: Robot, capsys) -> None:
    """Positions and velocities bit for bit in each format; times too, or to the nanosecond where the format has those.
    Another robot is refused.
    """
    for to in ["mcap", "csv", "lerobot"]:
        with case(to) as tmp_path:
            pytest.importorskip({"mcap": "rosbags", "lerobot": "pyarrow"}.get(to, "numpy"))
            out = tmp_path / "out"
            words = ["export", str(folder / "arm.urdf"), str(folder / "demos"), "--out", str(out), "--to", to, "--json"]
            assert main(words) == 0
            answer = json.loads(capsys.readouterr().out)
            assert (answer["format"], answer["trajectories"], answer["samples"]) == (to, 2, 80)
            names = ["out"] if to == "lerobot" else [f"0_demo_0.{to}", f"1_demo_1.{to}"]
            assert [Path(file).name for file in answer["files"]] == names
            before, after = load_demonstrations(folder / "demos", robot), load_demonstrations(out, robot)
            assert len(after) == 2
            for a, b in zip(before, after, strict=True):
                assert a.q.tobytes() == b.q.tobytes()
                assert a.u is not None and b.u is not None and a.u.tobytes() == b.u.tobytes()
                start = 0.0 if to == "csv" else a.time[0]  # the others count from the first sample
                if to in ("csv", "lerobot"):
                    assert (a.time - start).tobytes() == b.time.tobytes()
                np.testing.assert_array_equal(np.rint(1e9 * (a.time - start)), np.rint(1e9 * b.time))
            if to == "mcap":  # read as the bag of any robot with these joints
                continue
            assert refusal(out, load_robot(folder / "longer.urdf"), match="'arm'").code == "other-robot"


def test_a_rollout_with_a_locked_joint(folder: Path, tmp_path: Path, capsys) -> None:
    """The joint is locked again by the command, and by the file that it writes."""
    robot = load_robot(folder / "arm.urdf", locked={"j2": 1.2})
    rollout = rollout_of(robot)
    run, out = rollout.save(tmp_path / "run.npz"), tmp_path / "run.csv"
    assert main(["export", str(folder / "arm.urdf"), str(run), "--out", str(out)]) == 0
    assert "51 samples" in capsys.readouterr().out
    demonstration = load_demonstrations(out, robot)[0]
    assert demonstration.q.tobytes() == rollout.q.tobytes()
    refusal(out, load_robot(folder / "arm.urdf"), match="'j2' is locked at 1.2, not free to move")


@pytest.fixture(scope="module")
def sawyer_run(robot_of) -> Rollout:
    """A rollout of an arm with limits."""
    robot = robot_of("sawyer")
    constraint = Constraint([[0.0, 0.0, 1.0]], FrameJacobian(robot, "right_hand", "xyz"))
    law = ResolvedRateController(constraint, PointAttractor([0.5, 0.3, 0.3]))
    return simulate(robot, law, [0.1, -0.8, 0.2, 1.4, 0.1, 0.9, 0.3], 3.0, 0.01)


def changed(run: Rollout, sample: int, joint: int, by: float) -> Rollout:
    q = run.q.copy()
    q[sample, joint] += by
    return replace(run, q=q)


# what happens to a rollout -> what the command says: joint, moment, and both figures
NO_ARM_DID: dict[str, tuple[Callable[[Rollout], Rollout], str]] = {
    "a posture of 1e9 rad": (
        lambda r: changed(r, 10, 2, 1e9),
        r"sample 10, column 'right_j2': 1e\+09 .*limits \[-3.04",
    ),
    "so at first": (lambda r: changed(r, 0, 2, 1e9), "column 'right_j2': the joint jumps from 1e"),
    "so at last": (lambda r: changed(r, -1, 2, 1e9), r"sample 300, column 'right_j2': 1e\+09 is outside the limits"),
    "all postures": (lambda r: replace(r, q=r.q + 1e9), "is outside the limits"),
    "a jump": (lambda r: changed(r, 20, 1, 0.5), "sample 20, column 'right_j1': the joint jumps .* its limit is 1.33"),
    "two joints exchanged": (lambda r: replace(r, q=r.q[:, [2, 1, 0, 3, 4, 5, 6]]), "has moved by .* velocities say"),
    "velocities negated": (lambda r: replace(r, u=-r.u), "has moved by .* rad, its velocities say -?0"),
    "velocities in degrees": (lambda r: replace(r, u=np.degrees(r.u)), "has moved by .* its velocities say"),
    "velocities of a tenth": (lambda r: replace(r, u=0.1 * r.u), "has moved by .* its velocities say"),
}


@pytest.mark.parametrize("what", NO_ARM_DID)
def test_what_no_arm_can_have_done_is_not_written(what: str, sawyer_run: Rollout, tmp_path: Path, capsys) -> None:
    """A damaged rollout is refused with joint, moment and both figures, and nothing is written for the arm."""
    change, words = NO_ARM_DID[what]
    run, out = change(sawyer_run).save(tmp_path / "run.npz"), tmp_path / "out.yaml"
    assert main(["export", "sawyer", str(run), "--out", str(out)]) == 2
    assert re.search(words, capsys.readouterr().err) and not out.exists()


def test_what_an_arm_did_is_written(sawyer_run: Rollout, robot_of, tmp_path: Path) -> None:
    """From outside the limits, along them, in long steps, by another method; measured far behind its commands, stopped
    by a jam, and led by hand while nothing was commanded.
    """
    robot, run = robot_of("sawyer"), sawyer_run
    constraint = Constraint([[0.0, 0.0, 1.0]], FrameJacobian(robot, "right_hand", "xyz"))
    law, top = ResolvedRateController(constraint), robot.position_upper[0]
    outside, at = ([x, *run.q[0, 1:]] for x in (top + 0.6, top))
    late, stuck = (np.minimum(np.arange(301), n) for n in (301, 150))
    behind = run.q[np.maximum(late - 30, 0)]
    lag = np.abs(run.q - behind).max(axis=1)
    jammed = run.q[stuck]
    by_hand = np.vstack([run.q, run.q[-1] + np.linspace(0.0, 0.5, 301)[:, None] * np.eye(7)[1]])
    still = {name: np.concatenate([getattr(run, name)] * 2) for name in ("manipulability", "task_error")}
    still |= {"time": np.arange(602) * 0.01, "u": np.vstack([run.u, 0.0 * run.u]), "status": run.status * 2}
    for name, done in {
        "outside": simulate(robot, law, outside, 1.0, 0.01),
        "shortly outside": simulate(robot, law, outside, 0.05, 0.01),
        "at a limit": simulate(robot, law, at, 1.0, 0.01),
        "long steps": simulate(robot, law, run.q[0], 3.0, 0.25),
        "behind": replace(run, q=behind, following_error=lag),
        "jammed": replace(run, q=jammed, following_error=np.abs(run.q - jammed).max(axis=1)),
        "by hand": replace(run, q=by_hand, **still),
    }.items():
        with case(name):
            path = done.save(tmp_path / "run.npz")
            assert main(["export", "sawyer", str(path), "--out", str(tmp_path / "out.csv")]) == 0


def test_each_shipped_recording_is_written_and_read_again(tmp_path: Path) -> None:
    """What the library wrote of a true recording is no damage when it is read again."""
    for folder in sorted(path for path in EXAMPLES.iterdir() if path.is_dir()):
        truth = folder / "truth.json"
        name = json.loads(truth.read_text())["robot"] if truth.exists() else folder.name.split("_")[0]
        robot = load_robot(name, locked=LOCKED.get(name, ()))
        for i, trajectory in enumerate(load_demonstrations(folder, robot)[:3]):
            with case(f"{folder.name} {i}"):
                path = write_motion(tmp_path / "demo.csv", motion_of_trajectory(trajectory, robot))
                assert load_demonstrations(path, robot)[0].q.tobytes() == trajectory.q.tobytes()


def test_a_trajectory_is_yaml_for_ros(robot: Robot) -> None:
    """As `ros2 topic pub` reads it: the fields of JointTrajectory, every number one in YAML 1.1, increasing times."""
    yaml = pytest.importorskip("ruamel.yaml", reason="the extra 'ros' is not installed").YAML(typ="safe", pure=True)
    yaml.version = (1, 1)
    time = np.array([3.0, 3.1, 3.25])
    q = np.array([[1e-5, 1e22, -0.0], [1.0, 2.5e-300, 0.1], [0.2, 0.3, 1.0 / 3.0]])
    text = joint_trajectory_bytes(motion_of_trajectory(Trajectory(time, q, -q, robot.joint_names), robot)).decode()
    message = yaml.load(text)
    assert set(message) == {"header", "joint_names", "points"}
    assert message["joint_names"] == list(robot.joint_names)
    assert np.array([p["positions"] for p in message["points"]], dtype=float).tobytes() == q.tobytes()
    assert all(isinstance(x, float) for p in message["points"] for x in p["positions"] + p["velocities"])
    starts = [(p["time_from_start"]["sec"], p["time_from_start"]["nanosec"]) for p in message["points"]]
    assert starts == [(0, 0), (0, 100_000_000), (0, 250_000_000)]


def test_lerobot_metadata(folder: Path, tmp_path: Path) -> None:
    """The files of a v3.0 data set, and numbers in them that agree with the samples."""
    pq = pytest.importorskip("pyarrow.parquet", reason="the extra 'lerobot' is not installed")
    from manip_learn.recordings.writers.lerobot_writer import samples_per_second

    out = tmp_path / "set"
    assert main(["export", str(folder / "arm.urdf"), str(folder / "demos"), "--out", str(out)]) == 0
    info = json.loads((out / "meta" / "info.json").read_text())
    assert (info["codebase_version"], info["fps"], info["total_episodes"], info["total_frames"]) == ("v3.0", 100, 2, 80)
    table = pq.read_table(out / info["data_path"].format(chunk_index=0, file_index=0))
    assert set(table.column_names) == set(info["features"])
    episodes = pq.read_table(out / "meta/episodes/chunk-000/file-000.parquet").to_pylist()
    ends = [(e["dataset_from_index"], e["dataset_to_index"], e["length"]) for e in episodes]
    assert ends == [(0, 40, 40), (40, 80, 40)]
    stats = json.loads((out / "meta" / "stats.json").read_text())
    states = np.array(table.column("observation.state").to_pylist())
    parts = {"mean": states.mean(0), "std": states.std(0), "min": states.min(0), "max": states.max(0), "count": [80]}
    assert set(stats) == set(table.column_names) and set(stats["observation.state"]) == set(parts)
    for name, part in parts.items():
        np.testing.assert_allclose(stats["observation.state"][name], part, rtol=1e-12)
    for name, numbers in (
        ("index", np.arange(80)),
        ("episode_index", np.repeat([0, 1], 40)),
        ("task_index", np.zeros(80)),
    ):
        np.testing.assert_array_equal(table.column(name).to_numpy(), numbers)
    assert info["features"]["observation.velocity"] == {"dtype": "float64", "shape": [3], "names": ["j1", "j2", "j3"]}
    assert info["splits"] == {"train": "0:2"} and info["robot_type"] == "arm"
    demos = load_demonstrations(folder / "demos", load_robot(folder / "arm.urdf"))
    for rate, said in ((30.0, 30), (30.02, 30), (30.05, 30.05), (0.7, 0.7), (1.0, 1), (0.9999, 0.9999)):
        slower = [np.cumsum(np.full(40, 1.0 / rate)) for _ in demos]
        slower[0][20:] += 5.0  # a pause does not count
        found = samples_per_second(slower)
        assert found == pytest.approx(said, rel=1e-9) and isinstance(found, type(said))
    assert pq.read_table(out / "meta/tasks.parquet").num_rows == info["total_tasks"] == 1


def test_wrong_outputs_are_refused(folder: Path, monkeypatch, capsys):
    """Unknown formats, contradictions, and several trajectories for one file: one sentence, exit code 2, no file."""
    for arguments, words in [
        (["--out", "a.xyz"], "ending says the format"),
        (["--out", "a.mcap", "--to", "csv"], "ending says the format"),
        (["--out", "a", "--to", "hdf5"], "--to must be one of"),
        (["--out", "a.csv"], "name a folder"),
    ]:
        with case(arguments, words) as tmp_path:
            monkeypatch.chdir(tmp_path)
            assert main(["export", str(folder / "arm.urdf"), str(folder / "demos"), *arguments]) == 2
            assert words in capsys.readouterr().err
            assert not list(tmp_path.iterdir())


def test_stamps_are_whole_nanoseconds() -> None:
    """From zero, or from the first sample where a stamp could not hold that; what cannot be told apart is refused."""
    for time, from_first, expected in (
        ([0.0, 0.5], False, [0, 500_000_000]),
        ([3.0, 3.5], False, [3_000_000_000, 3_500_000_000]),
        ([3.0, 3.5], True, [0, 500_000_000]),
        ([-1.0, 0.5], False, [0, 1_500_000_000]),
        ([2.0**31 - 1.0, 2.0**31 - 0.5], False, [2_147_483_647_000_000_000, 2_147_483_647_500_000_000]),
        ([2.0**31, 2.0**31 + 0.5], False, [0, 500_000_000]),
        ([0.0, 0.6e-9], False, [0, 1]),
    ):
        assert nanoseconds(np.array(time), from_first=from_first).tolist() == expected
    for time in ([0.0, 0.4e-9], [0.0, np.nan], [0.0, 2.0**31], [1.0, 0.5]):
        with case(time), pytest.raises(OutputError):
            nanoseconds(np.array(time), from_first=False)
