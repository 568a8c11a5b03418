"""Names of joints in files, for every format: a refusal says at once what to type, and what it says is read."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.io
from case import case
from obeying import advised, obeyed, said
from recording_corpus import TABLE, refusal
from recording_formats import ENV_ARGS, START, write_bag

from manip_learn.recordings import load_demonstrations
from manip_learn.robot import load_robot

h5py, pa, pq = (pytest.importorskip(name) for name in ("h5py", "pyarrow", "pyarrow.parquet"))
JOINTS = ("joint1", "joint2", "joint3")
TIME, Q = TABLE[:, 0], TABLE[:, 1:]
OTHER = 0.5 * Q + 0.1  # of a second arm


def table_file(folder: Path, names: Sequence[str], q: np.ndarray) -> tuple[Path, list[str]]:
    path = folder / "demo.csv"
    rows = [",".join(f"{x:.17g}" for x in row) for row in np.column_stack([TIME, q])]
    path.write_text("\n".join([",".join(["time", *(f'"{n}"' for n in names)]), *rows, ""]))
    return path, []


def archive(folder: Path, names: Sequence[str], q: np.ndarray) -> tuple[Path, list[str]]:
    np.savez(folder / "demo.npz", time=TIME, q=q, joint_names=np.array(names))
    return folder / "demo.npz", []


def bag(kind: str) -> Callable[[Path, Sequence[str], np.ndarray], tuple[Path, list[str]]]:
    def write(folder: Path, names: Sequence[str], q: np.ndarray) -> tuple[Path, list[str]]:
        stamps = [START + round(1e9 * t) for t in TIME]
        messages: list[Any] = [("/joint_states", s, (s, names, row)) for s, row in zip(stamps, q, strict=True)]
        return write_bag(folder / "bag", kind, messages), []

    return write


def data_set(form: Callable[[Sequence[str]], object]) -> Callable[[Path, Sequence[str], np.ndarray], tuple]:
    def write(folder: Path, names: Sequence[str], q: np.ndarray) -> tuple[Path, list[str]]:
        (folder / "set" / "meta").mkdir(parents=True)
        state = {"dtype": "float32", "shape": [len(names)], "names": form(names)}
        info = {"codebase_version": "v2.1", "fps": 50, "features": {"observation.state": state}}
        (folder / "set" / "meta" / "info.json").write_text(json.dumps(info))
        columns = {"observation.state": pa.array(q.tolist()), "timestamp": TIME, "episode_index": np.zeros(len(q), int)}
        (folder / "set" / "data").mkdir()
        pq.write_table(pa.table(columns), folder / "set" / "data" / "episode_000000.parquet")
        return folder / "set", ["--units", "radians"]

    return write


def robomimic(folder: Path, names: Sequence[str], q: np.ndarray) -> tuple[Path, list[str]]:
    with h5py.File(folder / "demo.hdf5", "w") as file:
        file.create_group("data").attrs["env_args"] = ENV_ARGS
        file["data/demo_0/obs/robot0_joint_pos"] = q
    return folder / "demo.hdf5", ["--joint-names", ",".join(names)]


def archive_without_names(folder: Path, names: Sequence[str], q: np.ndarray) -> tuple[Path, list[str]]:
    np.savez(folder / "demo.npz", timestamps=TIME, joint_positions=q, tcp_pos=q)
    return folder / "demo.npz", ["--joint-names", ",".join(names)]


def bare(folder: Path, names: Sequence[str], q: np.ndarray) -> tuple[Path, list[str]]:
    np.save(folder / "demo.npy", np.column_stack([q, TIME, TIME]))
    return folder / "demo.npy", ["--joint-names", ",".join([*names, "time", "-"])]


def matlab(folder: Path, names: Sequence[str], q: np.ndarray) -> tuple[Path, list[str]]:
    content = {"t": TIME, "q": q.T, "joint_names": np.array(names, dtype=object), "x": q[:, :3]}
    scipy.io.savemat(folder / "demo.mat", {"demos": {"first": content}}, do_compression=True)
    return folder / "demo.mat", []


def matlab_73(folder: Path, names: Sequence[str], q: np.ndarray) -> tuple[Path, list[str]]:
    with h5py.File(folder / "demo.mat", "w", userblock_size=512) as file:
        for name, array in {"log/t": TIME[:, None], "log/q": q, "log/ee_pos": q}.items():
            file.create_dataset(name, data=array.T).attrs["MATLAB_class"] = np.bytes_("double")
    with (folder / "demo.mat").open("r+b") as file:
        file.write(b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(512, b" "))
    return folder / "demo.mat", ["--joint-names", ",".join(names)]


def aloha(folder: Path, names: Sequence[str], q: np.ndarray) -> tuple[Path, list[str]]:
    with h5py.File(folder / "episode_0.hdf5", "w") as file:
        file["observations/qpos"], file["observations/qvel"] = q, np.gradient(q, 0.02, axis=0)
        file["action"], file["observations/images"] = q + 0.1, np.zeros((60, 4, 4, 3), np.uint8)
    return folder / "episode_0.hdf5", ["--joint-names", ",".join(names), "--rate", "50"]


WRITERS = {
    "CSV": table_file,
    "NPZ": archive,
    "ROS 1 bag": bag("ros1"),
    "ROS 2 bag": bag("sqlite"),
    "MCAP": bag("mcap"),
    "LeRobot": data_set(list),
    "LeRobot, nested": data_set(lambda names: [list(names)]),
    "LeRobot, motors": data_set(lambda names: {"motors": [f"{n}.pos" for n in names]}),
    "robomimic": robomimic,
    "NPZ without names": archive_without_names,
    "a bare array": bare,
    "MATLAB 5": matlab,
    "MATLAB 7.3": matlab_73,
    "HDF5 as of ALOHA": aloha,
}
# how the joints are called in the file -> how many ways are offered
CALLED: dict[str, tuple[tuple[str, ...], int]] = {
    "a prefix": (tuple(f"left_{j}" for j in JOINTS), 1),
    "a name space": (tuple(f"robot1/{j}" for j in JOINTS), 1),
    "a suffix": (tuple(f"{j}_l" for j in JOINTS), 1),
    "both": (tuple(f"arm-{j}:0" for j in JOINTS), 1),
    "another word": (("fr3_joint1", "fr3_joint2", "fr3_joint3"), 1),
    "capitals": (("Joint1", "Joint2", "Joint3"), 1),
    "a letter for the word": (("J1", "J2", "J3"), 1),
    "counted from 0": (("q[0]", "q[1]", "q[2]"), 1),
    "one misspelt": (("joint1", "jiont2", "joint3"), 1),
    "all misspelt": (("jiont1", "joit2", "jont_3"), 1),
    "two arms": (tuple(f"{side}_{j}" for side in ("left", "right") for j in JOINTS), 2),
}


@pytest.mark.parametrize("name", WRITERS)
def test_what_is_offered_reads_the_file(name: str, capsys) -> None:
    """One refusal at most, and each way that it offers reads the joints of that arm: names of every kind in a table, a
    prefix and two arms in every format.
    """
    for called in CALLED if name == "CSV" else ("a prefix", "two arms"):
        names, ways = CALLED[called]
        for way in range(ways):
            with case(called, way) as folder:
                q = Q if ways == 1 else np.hstack([Q, OTHER])
                path, options = WRITERS[name](folder, names, q)
                words = obeyed(path, "planar3", folder / "out.csv", capsys, *options, way=way, most=1)
                read = load_demonstrations(folder / "out.csv", load_robot("planar3"))[0]
                np.testing.assert_allclose(read.q, OTHER if way else Q, atol=1e-6, err_msg=f"{words}")


def lines(header: str, *after: str, first: Callable[[int], str] = lambda i: "", end: str = "", rows: int = 60) -> str:
    """A table of stamps and positions with something before and after each row."""
    numbers = np.column_stack([TIME, Q])[:rows]
    body = [first(i) + ",".join(f"{x:.17g}" for x in row) + end for i, row in enumerate(numbers)]
    return "\n".join([header, *body, *after, ""])


HEAD = "time,joint1,joint2,joint3"
# how a table is written -> its text, and options
TABLES: dict[str, tuple[str, list[str]]] = {
    "a comma at each line's end": (lines(HEAD + ",", end=","), []),
    "a comma at each row's end": (lines(HEAD, end=","), []),
    "R, names of rows": (lines('"time","joint1","joint2","joint3"', first=lambda i: f'"{i + 1}",'), []),
    "R, names of rows without quotes": (lines(HEAD, first=lambda i: f"{i + 1},"), []),
    "R, a name of the names": (lines('"",' + HEAD, first=lambda i: f'"{i + 1}",'), []),
    "row numbers without a name": (lines("," + HEAD, first=lambda i: f"{i},"), []),
    "row numbers of a part": (lines("," + HEAD, first=lambda i: f"{i + 500},"), []),
    "names with commas": (lines('"time","a,joint1","a,joint2","a,joint3"'), []),
    "a name with a comma beside the joints": (lines(f'{HEAD},"x, y"', end=",1.5"), ["--columns", "{joint}"]),
    "text with commas": (lines(f"{HEAD},label", end=',"a, b"'), ["--columns", "{joint}"]),
    "no header": (lines(HEAD).split("\n", 1)[1], ["--joint-names", f"{HEAD}"]),
    "no header, a column too many": (lines("", end=",7").split("\n", 1)[1], ["--joint-names", f"{HEAD},-"]),
    "no header, no time": (
        "\n".join(" ".join(f"{x:.17g}" for x in row) for row in Q) + "\n",
        ["--joint-names", "joint1,joint2,joint3", "--rate", "50"],
    ),
    "no time": (
        "\n".join(["joint1 joint2 joint3", *(" ".join(f"{x:.17g}" for x in row) for row in Q), ""]),
        ["--rate", "50"],
    ),
}


@pytest.mark.parametrize("name", TABLES)
def test_tables_of_other_programs_are_read(name: str, tmp_path: Path, capsys) -> None:
    """Positions and stamps are those that were written; without the options a refusal says what to type."""
    text, options = TABLES[name]
    path = tmp_path / "demo.csv"
    path.write_text(text)
    words = ["export", "planar3", str(path), "--out", str(tmp_path / "out.csv")]
    if options:
        refused = said(words, capsys)
        assert refused and {w for way in advised(refused) for w in way} >= {o for o in options if o[:2] == "--"}, (
            refused
        )
    assert said([*words, *options], capsys) == ""
    read = load_demonstrations(tmp_path / "out.csv", load_robot("planar3"))[0]
    np.testing.assert_array_equal(read.q, Q)
    np.testing.assert_allclose(read.time, TIME, atol=1e-9)


def test_patterns_of_names_in_python() -> None:
    """A text, or a mapping of patterns; what is no pattern, or changes the number of joints, is refused."""
    robot = load_robot("planar3")
    with case() as folder:
        path, _ = archive(folder, [f"left_{j}" for j in JOINTS], Q)
        for rename in ("left_{joint}", {"left_{joint}": "{joint}"}, {"left_joint{joint}": "joint{joint}"}):
            np.testing.assert_array_equal(load_demonstrations(path, robot, rename=rename)[0].q, Q)
        for rename in ("left_", {"left_{joint}": "joint1"}, {"left_joint{index}": "joint1"}, {"left_{joint}": 3}):
            assert refusal(path, robot, rename=rename).code == "option"
        assert "left_{joint}" in str(refusal(path, robot))
        assert "no joint '{joint}_x'" in str(refusal(path, robot, rename={"left_{joint}": "{joint}_x"}))


def test_a_name_of_another_number_is_not_taken_for_a_joint() -> None:
    """Joint 12 is not joint 1 misspelt: only the robot's order is offered, as something that the user must know."""
    for called in (("joint11", "joint12", "joint13"), ("elbow", "a", "b")):
        with case(called) as folder:
            path, _ = bag("mcap")(folder, called, Q)
            heard = str(refusal(path, load_robot("planar3")))
            assert "reads" not in heard and "if it is this one and they are in its order" in heard, heard


POINTER = "version https://git-lfs.github.com/spec/v1\noid sha256:00\nsize 9\n"


@pytest.mark.parametrize("name", [n for n in WRITERS if n != "a bare array"])
def test_a_pointer_of_git_lfs_is_named_by_every_reader(name: str, tmp_path: Path) -> None:
    """Whichever file of a recording was not fetched."""
    good, _ = WRITERS[name](tmp_path, JOINTS, Q)
    for victim in [good] if good.is_file() else [p for p in good.rglob("*") if p.is_file()]:
        content = victim.read_bytes()
        victim.write_text(POINTER)
        assert refusal(good, load_robot("planar3"), units="radians").code == "git-lfs", victim.name
        victim.write_bytes(content)
