"""A remedy works when it is obeyed: the flags that a refusal names are typed, and the recording is then read, or the
next sentence is another one; for what is wrong, and for names of joints in files of every format.
"""

from __future__ import annotations

import json
import re
import shlex
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.io
from case import case, rows_in
from recording_corpus import GOOD, JOINTS, TABLE, TIME, VELOCITIES, Q, csv, npz, refusal, text
from recording_formats import (
    START,
    STEPS,
    Build,
    all_in_one,
    archive,
    bag,
    dataset,
    frames,
    h5py,
    info,
    lerobot,
    motion,
    one,
    pa,
    robomimic,
    some,
    table,
    version_2,
    write_bag,
)

import manip_learn as ml
from manip_learn.cli import main

RADIANS = ("--units", "radians")
NAMED = ("--joint-names", ",".join(JOINTS))
FRAMES = frames({0: motion(0)})
QPOS = {**info(None), "features": {"qpos": {"dtype": "float32", "shape": [3], "names": JOINTS}}}
HEAD = "time,joint1,joint2,joint3"
OTHER = 0.5 * Q + 0.1  # of a second arm
STAMPS = [START + int(step) for step in STEPS]  # [ns]
# a flag, and its value: a word, or what stands in quotes
FLAG = r"--[a-z][a-z-]*(?: (?:'[^']*'|[^\s'-][^\s;]*(?<![:.,;])))?"
RUN = re.compile(rf"(?<![\w-]){FLAG}(?: {FLAG})*")
WITHOUT_VALUE = re.compile(r"(--degrees|--xacro)\b.*")


def advised(sentence: str) -> list[list[str]]:
    """Words to type, one list for each way that the sentence offers."""
    sentence = sentence.replace("<samples per second>", "50")
    return [shlex.split(WITHOUT_VALUE.sub(r"\1", run)) for run in RUN.findall(sentence)]


def said(path: Path, out: Path, words: Sequence[str], capsys: Any) -> dict[str, str]:
    """The error of `export`, or nothing."""
    code = main(["export", "planar3", str(path), "--to", "csv", "--out", str(out), *words, "--json"])
    assert code in (0, 2)
    return json.loads(capsys.readouterr().out).get("error", {})


def obeyed(path: Path, out: Path, capsys: Any, given: Sequence[str], way: int = 0, most: int = 3) -> list[str]:
    """The codes of the refusals that are obeyed until the recording is read; each must be another one."""
    heard: dict[str, str] = {}
    words = list(given)
    while error := said(path, out, words, capsys):
        assert error["message"] not in heard, f"obeyed {words}, and heard again: {error['message']}"
        ways = advised(error["message"])
        assert ways and len(heard) < most, f"{words}: {error['message']}"
        words += ways[0 if heard else min(way, len(ways) - 1)]
        heard[error["message"]] = error["code"]
    return list(heard.values())


def shuffled(folder: Path) -> Path:
    """Stamps in no order at all, received in one."""
    received = np.random.default_rng(0).permutation(STAMPS)
    parts: list[Any] = [(t, int(at), c) for at, (t, _, c) in zip(received, all_in_one(), strict=True)]
    return write_bag(folder / "bag", "mcap", parts)


CHANGING = [(t, r, (s, (f"x{k}", *n[1:]), q)) for k, (t, r, (s, n, q, *_)) in enumerate(all_in_one() * 6)]


def without_a_file(folder: Path) -> Path:
    root = version_2(folder / "set")
    (root / "data/chunk-000/episode_000010.parquet").unlink()
    return root


# what is wrong -> the code of its refusal, how it is written, what is typed beside the path
REFUSED: dict[str, tuple[str, Build, tuple[str, ...]]] = {
    "a table without a header": ("no-header", one("a.csv", text(csv(TABLE).partition("\n")[2])), ()),
    "a table without stamps": ("no-time", table(",".join(JOINTS), Q), ()),
    "a misspelt stamp": ("no-time", table("tmie," + ",".join(JOINTS), TABLE), ()),
    "numbered columns": ("numbered-columns", table("time,q_0,q_1,q_2", TABLE), ()),
    "a column of something else": ("unknown-column", table(HEAD + ",force", TABLE, TIME), ()),
    "a misspelt joint": ("missing-joint", table("time,joint1,joint2,joint_3", TABLE), ()),
    "a joint that stood still": ("missing-joint", table("time,joint1,joint2", TABLE[:, :3]), ()),
    "one stamp for all": ("too-short", table(HEAD, 0.0 * TIME, Q), ()),
    "degrees": ("degrees", table(HEAD, TIME, np.degrees(Q)), ()),
    "far outside the limits": ("outside-limits", table(HEAD, TIME, Q + [0.0, 900.0, 0.0]), ()),
    "an archive without stamps": ("no-time", archive(time=None, u=None), ()),
    "an archive without names": ("no-joint-names", archive(joint_names=None, u=None), ()),
    "another name": ("missing-array", one("a.npz", npz(time=TIME, measured=Q, other=Q, joint_names=JOINTS)), ()),
    "too few names": ("shape", archive(joint_names=None, u=None), ("--joint-names", "joint1,joint2")),
    "several topics": ("ambiguous-topic", bag("mcap", all_in_one(topic="/real"), all_in_one(topic="/other")), ()),
    "names that change": ("unsteady-names", bag("mcap", CHANGING, all_in_one(topic="/real")), ()),
    "no order in a bag": ("time-order", shuffled, ()),
    "no units": ("units", lerobot(FRAMES), ()),
    "no names of motors": ("no-joint-names", lerobot(FRAMES, names=None), RADIANS),
    "another feature": (
        "no-state",
        lerobot(FRAMES.append_column("qpos", FRAMES["action"]), described=QPOS),
        RADIANS,
    ),
    "stamps against fps": ("fps", lerobot(frames({0: motion(0)}, timestamp=pa.array(np.arange(80) / 30.0))), RADIANS),
    "no rate": (
        "no-time",
        lerobot(FRAMES.drop_columns("timestamp"), described={**info(JOINTS), "fps": None}),
        RADIANS,
    ),
    "a file is missing": ("lost-samples", without_a_file, RADIANS),
    "no names in HDF5": ("no-joint-names", one("a.hdf5", robomimic), ()),
    "no rate in HDF5": ("no-time", one("a.hdf5", lambda path: robomimic(path, env_args=None)), NAMED),
}
# what no flag mends -> the code, how it is written, what is typed, and what the sentence says instead
TO_DO: dict[str, tuple[str, Build, tuple[str, ...], str]] = {
    "velocities only": ("no-positions", table("time" + VELOCITIES, TABLE), (), "record positions too"),
    "no overlap": (
        "no-overlap",
        bag("mcap", some("/a", (0, 1)), some("/b", (2,), late=6 * 10**10)),
        (),
        "record them together",
    ),
    "no joint states": ("no-joint-states", bag("mcap", foreign="uint8 x\n"), (), "record /joint_states"),
    "radians called degrees": ("degrees", one("a.csv", text(GOOD)), ("--degrees",), "leave --degrees out"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_the_flags_in_a_sentence_mend_what_is_wrong(name: str, tmp_path: Path, capsys) -> None:
    """No sentence is heard twice, and after three at the most the recording is read."""
    code, build, given = REFUSED[name]
    assert obeyed(build(tmp_path), tmp_path / "out", capsys, given)[0] == code


@pytest.mark.parametrize("name", TO_DO)
def test_what_no_flag_mends_says_what_to_do(name: str, tmp_path: Path, capsys) -> None:
    """In the sentence that refuses it."""
    code, build, words, says = TO_DO[name]
    error = said(build(tmp_path), tmp_path / "out", words, capsys)
    assert error["code"] == code and says in error["message"], error


# ---- names of joints in every format ---------------------------------------------------------------------------------

Write = Callable[[Path, Sequence[str], np.ndarray], tuple[Path, list[str]]]


def in_bag(kind: str) -> Write:
    def write(folder: Path, names: Sequence[str], q: np.ndarray) -> tuple[Path, list[str]]:
        messages: list[Any] = [("/joint_states", s, (s, names, x)) for s, x in zip(STAMPS, q, strict=True)]
        return write_bag(folder / "bag", kind, messages), []

    return write


def data_set(form: Callable[[Sequence[str]], object]) -> Write:
    def write(folder: Path, names: Sequence[str], q: np.ndarray) -> tuple[Path, list[str]]:
        described = info(form(names))
        described["features"]["observation.state"]["shape"] = [len(names)]
        columns = {"observation.state": pa.array(q.tolist()), "timestamp": TIME, "episode_index": np.zeros(len(q), int)}
        return dataset(folder / "set", described, {"data/episode_000000.parquet": pa.table(columns)}), list(RADIANS)

    return write


def in_file(name: str, write: Callable[[Path, Sequence[str], np.ndarray], object], *options: str) -> Write:
    """A file of this name; in its options, {} stands for the joints."""

    def built(folder: Path, names: Sequence[str], q: np.ndarray) -> tuple[Path, list[str]]:
        write(folder / name, names, q)
        return folder / name, [word.format(",".join(names)) for word in options]

    return built


def csv_file(path: Path, names: Sequence[str], q: np.ndarray) -> None:
    table(",".join(["time", *(f'"{n}"' for n in names)]), TIME, q, name=path.name)(path.parent)


def of_matlab_5(path: Path, names: Sequence[str], q: np.ndarray) -> None:
    content = {"t": TIME, "q": q.T, "joint_names": np.array(names, dtype=object), "x": q[:, :3]}
    scipy.io.savemat(path, {"demos": {"first": content}}, do_compression=True)


def of_matlab_7(path: Path, names: Sequence[str], q: np.ndarray) -> None:
    with h5py.File(path, "w", userblock_size=512) as file:
        for name, array in {"log/t": TIME[None, :], "log/q": q.T, "log/ee_pos": q.T}.items():
            file.create_dataset(name, data=array).attrs["MATLAB_class"] = np.bytes_("double")
    with path.open("r+b") as file:
        file.write(b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(512, b" "))


def of_aloha(path: Path, names: Sequence[str], q: np.ndarray) -> None:
    with h5py.File(path, "w") as file:
        file["observations/qpos"], file["observations/qvel"] = q, np.gradient(q, 0.02, axis=0)
        file["action"], file["observations/images"] = q + 0.1, np.zeros((60, 4, 4, 3), np.uint8)


WRITERS: dict[str, Write] = {
    "CSV": in_file("demo.csv", csv_file),
    "NPZ": in_file("demo.npz", lambda path, names, q: np.savez(path, time=TIME, q=q, joint_names=np.array(names))),
    **{kind: in_bag(kind) for kind in ("ros1", "sqlite", "mcap")},
    "LeRobot, nested": data_set(lambda names: [list(names)]),
    "LeRobot, motors": data_set(lambda names: {"motors": [f"{n}.pos" for n in names]}),
    "a bare array": in_file(
        "demo.npy", lambda path, _, q: np.save(path, np.column_stack([q, TIME, TIME])), "--joint-names", "{},time,-"
    ),
    "MATLAB 5": in_file("demo.mat", of_matlab_5),
    "MATLAB 7.3": in_file("demo.mat", of_matlab_7, "--joint-names", "{}"),
    "HDF5 as of ALOHA": in_file("episode_0.hdf5", of_aloha, "--joint-names", "{}", "--rate", "50"),
}
# how the joints are called in the file
CALLED = {what: tuple(names.split()) for what, names in rows_in("names_of_joints.txt")}


@pytest.mark.parametrize("name", WRITERS)
def test_what_is_offered_reads_the_file(name: str, planar3: ml.Robot, capsys) -> None:
    """One refusal at most, and each way that it offers reads the joints of that arm: names of every kind in a table, a
    prefix and two arms in every format. A pointer of Git LFS is named, whichever file was not fetched.
    """
    for called in CALLED if name == "CSV" else ("a prefix", "two arms"):
        for way, q in enumerate([Q, OTHER] if called == "two arms" else [Q]):
            with case(called, way) as folder:
                whole = np.hstack([Q, OTHER]) if called == "two arms" else Q
                path, options = WRITERS[name](folder, CALLED[called], whole)
                obeyed(path, folder / "out.csv", capsys, options, way, most=1)
                np.testing.assert_allclose(ml.load_demonstrations(folder / "out.csv", planar3)[0].q, q, atol=1e-6)
    if name == "a bare array":
        return
    with case(name) as folder:
        good, _ = WRITERS[name](folder, JOINTS, Q)
        for victim in [good] if good.is_file() else [p for p in good.rglob("*") if p.is_file()]:
            content = victim.read_bytes()
            victim.write_text("version https://git-lfs.github.com/spec/v1\noid sha256:00\nsize 9\n")
            assert refusal(good, planar3, units="radians").code == "git-lfs", victim.name
            victim.write_bytes(content)


def lines(header: str, before: str, after: str) -> str:
    """Return a table of stamps and positions with something before and after each row."""
    rows = (",".join(f"{x:.17g}" for x in row) for row in np.column_stack([TIME, Q]))
    return "\n".join([header, *(before.format(i) + row + after for i, row in enumerate(rows, 1)), ""]).lstrip("\n")


BARE = "\n".join(" ".join(f"{x:.17g}" for x in row) for row in Q) + "\n"
# how a table is written -> its text, and options
TABLES: dict[str, tuple[str, list[str]]] = {
    what: (lines(*written), options.split()) for what, *written, options in rows_in("tables_of_other_programs.txt")
}
TABLES["no header, no time"] = BARE, [*NAMED, "--rate", "50"]
TABLES["no time"] = "joint1 joint2 joint3\n" + BARE, ["--rate", "50"]


@pytest.mark.parametrize("name", TABLES)
def test_tables_of_other_programs_are_read(name: str, planar3: ml.Robot, tmp_path: Path, capsys) -> None:
    """Positions and stamps are those that were written; without the options a refusal says what to type."""
    content, options = TABLES[name]
    (path := tmp_path / "demo.csv").write_text(content)
    if options:
        offered = {word for way in advised(said(path, tmp_path / "out.csv", [], capsys)["message"]) for word in way}
        assert offered >= {word for word in options if word.startswith("--")}
    assert not said(path, tmp_path / "out.csv", options, capsys)
    read = ml.load_demonstrations(tmp_path / "out.csv", planar3)[0]
    np.testing.assert_array_equal(read.q, Q)
    np.testing.assert_allclose(read.time, TIME, atol=1e-9)


def test_patterns_of_names_in_python(planar3: ml.Robot, tmp_path: Path) -> None:
    """`rename` takes a text or a mapping of patterns; anything else, or another number of joints, is refused. Joint 12
    is not joint 1 misspelt: only the robot's order is offered, which the user must confirm.
    """
    path, _ = WRITERS["NPZ"](tmp_path, CALLED["a prefix"], Q)
    for rename in ("left_{joint}", "left_joint{index}", {"left_joint{joint}": "joint{joint}"}):
        np.testing.assert_array_equal(ml.load_demonstrations(path, planar3, rename=rename)[0].q, Q)
    for rename in ("left_", {"left_{joint}": "joint1"}, {"left_joint{index}": "joint1"}, {"left_{joint}": 3}):
        assert refusal(path, planar3, rename=rename).code == "option"
    assert "no joint '{joint}_x'" in str(refusal(path, planar3, rename={"left_{joint}": "{joint}_x"}))
    heard = str(refusal(in_bag("mcap")(tmp_path, ("joint11", "joint12", "joint13"), Q)[0], planar3))
    assert "reads" not in heard and "if it is this one and they are in its order" in heard, heard
