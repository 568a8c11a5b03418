"""Damaged files are read whole or refused in one sentence: no internal error, no sample lost in silence."""

from __future__ import annotations

import bz2
import os
import re
import socket
import sqlite3
import struct
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from case import case
from recording_corpus import CASES, FULL, JOINTS, TIME, Q, U, npz, numbers, refusal
from recording_formats import KINDS, Build, all_in_one, bag, file_of, h5py, one, pa, pq, robomimic, version_2
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import CompressionMode
from rosbags.rosbag2.reader import zstd

import manip_learn as ml
from manip_learn.cli import main
from manip_learn.commands.command_line import flags_of
from manip_learn.commands.program import program
from manip_learn.errors import ConstraintMismatchError, ManipLearnError, RecordingError, SceneError, advice_for_command
from manip_learn.robot import Robot, load_robot
from manip_learn.robot.identity import RobotIdentity

FUZZ = os.environ.get("HYPOTHESIS_PROFILE") == "fuzz"
T = 12
# words of what is to be done, where no flag is advised
TO_DO = re.compile(
    r"needed|save (it|the|again)|not read|(more|larger) than|at most|not opened|given|unpack it|correct|again|write all"
    r"|no recorded motion|keep one|left|convert|leave|remove|of no known kind|check the path|cannot|name |git lfs pull"
    r"|download|is an|--[a-z]",
    re.IGNORECASE,
)


@pytest.mark.parametrize(("first", "command"), [*enumerate(("learn", "replay", "audit", "export"))])
def test_verdict(first: int, command: str, planar3: Robot, tmp_path: Path) -> None:
    """Each recording of the corpus is accepted, accepted with a note, or refused for the right reason, in one sentence
    that names the file and what to do: on the command line by flags alone, and only those that the command has.
    """
    flags = flags_of(program, [command])
    for one_of in CASES[first::4]:
        path = tmp_path / one_of.name
        one_of.write(path)
        try:
            with advice_for_command(flags):
                demos = ml.load_demonstrations(path, planar3, **one_of.options)
        except RecordingError as error:
            verdict, said = error.code, str(error)
            assert len(said) < 700 and "\n" not in said and (one_of.name in said or path.is_dir()), said
            assert TO_DO.search(said), said
            assert set(re.findall(r"(?<![\w-])--[a-z][a-z-]*", said)) <= flags, said
            assert not re.search(r"\w=\[|\w=\{|\w='|=True", said), said
        else:
            verdict, said = "note" if demos.notes else "accept", "\n".join(demos.notes)
        assert verdict == one_of.verdict, f"{one_of.name}: {said}"


# ---- any damage
def mutant(content: bytes, rng: np.random.Generator) -> bytes:
    """Cut off, bits flipped, bytes overwritten, a stretch repeated or left out; text gets huge numbers too."""
    at = int(rng.integers(len(content)))
    end = min(at + int(rng.integers(1, 40)), len(content))
    before, inside, after = content[:at], content[at:end], content[end:]
    put = (b"9" * 400, b"[" * 3000, b"nan", b"-1", b"{}", b"\xff\xff\xff\xff", b"\x00\x00\x00\x80")[rng.integers(7)]
    flipped = bytes([inside[0] ^ 1 << int(rng.integers(8))]) + inside[1:]
    changed = (flipped + after, rng.bytes(len(inside)) + after, after, inside + inside + after, put + after, b"")
    return before + changed[rng.integers(6)]


def parquet_file(path: Path) -> None:
    """Three parts, so that a damaged part can go missing by itself."""
    state = pa.FixedSizeListArray.from_arrays(pa.array(Q.ravel()), 3)
    columns = {"observation.state": state, "timestamp": TIME, "episode_index": np.repeat([0, 1], 30)}
    pq.write_table(pa.table(columns), path, row_group_size=20)


def bag_file(kind: str) -> Callable[[Path], Any]:
    return lambda path: path.write_bytes(file_of(bag(kind, all_in_one()[:40])(path.parent)).read_bytes())


GIVEN: dict[str, Any] = {"joint_names": JOINTS, "rate": 50.0}
FILES: dict[str, tuple[Callable[[Path], Any], dict[str, Any]]] = {
    "csv": (numbers(FULL), {}),
    "npz": (npz(time=TIME, q=Q, u=U, joint_names=np.array(JOINTS)), {}),
    "mcap": (bag_file("mcap"), {}),
    "bag": (bag_file("ros1"), {}),
    "db3": (bag_file("sqlite"), {}),
    "hdf5": (lambda path: robomimic(path, (0, 1, 2), None), GIVEN),
    "parquet": (parquet_file, {"units": "radians", "joint_names": JOINTS}),
}


@pytest.mark.fuzz
@pytest.mark.parametrize("name", FILES)
def test_damaged_files_are_whole_or_refused(name: str, planar3: Robot, tmp_path: Path, rng) -> None:
    """60 damages (5,000 with `make fuzz`): demonstrations or a RecordingError in one line, and nothing else; what is
    accepted without a further note has all of its samples, where the format states how many there are.
    """
    path, (write, options) = tmp_path / "whole.npz", FILES[name]
    write(path)
    content, whole = path.read_bytes(), ml.load_demonstrations(path, planar3, **options)
    path = tmp_path / "damaged"
    lost, accepted, trials = [], 0, 5000 if FUZZ else 60
    for number in range(trials):
        path.write_bytes(content[:16] + mutant(content[16:], rng))  # the beginning names the format
        try:
            demos = ml.load_demonstrations(path, planar3, **options)
        except RecordingError as error:
            assert str(error).isprintable()
            continue
        accepted += 1
        if demos.n_samples != whole.n_samples and demos.notes == whole.notes:
            lost.append((number, demos.n_samples))
    assert accepted < trials and (lost == [] or name == "csv")  # which states no number


@pytest.fixture
def rollout(planar3: Robot) -> ml.Rollout:
    time, status = TIME[:T], (*("ok",) * (T - 1), "damped")
    return ml.Rollout(time, Q[:T], U[:T], time, status, planar3.joint_names, time, "", RobotIdentity.of(planar3))


# values that a damaged or forged JSON file may hold
VALUES = ["null", "true", "-1", "1" + "0" * 400, "1e308", '""', '"x"', "[]", "[1]", "{}", '{"a": 1}', "[[1, 2], [3]]"]
VALUES += ['"\\ud800"', "Infinity"]


def forged(text: str, rng: np.random.Generator) -> str:
    """JSON with one value, anywhere, replaced."""
    spans = [found.span() for found in re.finditer(r'"[^"]*"(?!:)|-?\d[\d.e+-]*', text)]
    start, end = spans[rng.integers(len(spans))]
    return text[:start] + VALUES[rng.integers(len(VALUES))] + text[end:]


@pytest.mark.filterwarnings("ignore:overflow:RuntimeWarning")  # of forged numbers such as 1e308
def test_damaged_constraints(planar3: Robot, rollout: ml.Rollout, tmp_path: Path, rng, capsys) -> None:
    """Values changed in a constraint file, from its robot to its mechanism: one sentence, code 2."""
    learnt: dict[str, Any] = {"mechanism": {"type": "hinge", "axis": [0, 0, 1], "point": [0, 0, 0], "radius": 1.0}}
    learnt["phases"] = [["run", 0.0, 0.5, 0], ["run", 0.5, 1.0, None]]
    features = ml.FrameJacobian(planar3, "tip", "planar")
    path = ml.Constraint([[1.0, 0.0, 0.0]], features, learnt).save(tmp_path / "c.json")
    content, run = path.read_text(), rollout.save(tmp_path / "run.npz")
    replay = ["replay", "planar3", str(run), "--constraint", str(path), "--html", str(tmp_path / "p.html")]
    codes = [main(replay)]
    for _ in range(2000 if FUZZ else 8):
        path.write_text(forged(content, rng))
        codes.append(main(replay))
        said = capsys.readouterr().err
        assert "internal error" not in said and "Traceback" not in said, said
    assert codes[0] == 0 and {*codes} == {0, 2}


# ---- samples that are stated, and are not there
def replaced(name: str, old: str, new: str) -> Callable[[Path], Any]:
    return lambda path: (path / name).write_text((path / name).read_text().replace(old, new))


def attribute(where: str, name: str) -> Callable[[Path], Any]:
    def edit(path: Path) -> None:
        with h5py.File(path, "r+") as file:
            file[where].attrs[name] = 999

    return edit


def queried(*queries: str) -> Callable[[Path], Any]:
    def edit(path: Path) -> None:
        for query in queries:
            with sqlite3.connect(file_of(path)) as database:
                database.executescript(query)

    return edit


def mcap(folder: Path) -> Path:
    return file_of(bag("mcap", all_in_one())(folder))


def logged(end: str, whole: bool) -> Build:
    """A bag, or the database in it, beside which lies an empty log."""

    def write(folder: Path) -> Path:
        path = bag("sqlite", all_in_one())(folder)
        (database := file_of(path)).with_name(database.name + end).touch()
        return path if whole else database

    return write


def bytes_of(change: Callable[[bytes], bytes]) -> Callable[[Path], Any]:
    return lambda path: path.write_bytes(change(path.read_bytes()))


def bomb_in_a_block(path: Path) -> None:
    """A block of 100 bytes that unpacks to 64 MB."""
    content = path.read_bytes()
    start = content.index(b"BZh")
    (size,) = struct.unpack_from("<I", content, start - 4)
    bomb = bz2.compress(bytes(64_000_000))
    path.write_bytes(content[:start] + bomb + bytes(size - len(bomb)) + content[start + size :])


def claimed_terabyte(path: Path) -> None:
    """In the index, which is believed."""
    content = bytearray(path.read_bytes())
    struct.pack_into("<Q", content, content.rindex(b"zstd") + 12, 10**12)
    path.write_bytes(content)


BOMB = zstd.compress(bytes(60_000_000))


def bomb_in_a_message(path: Path) -> None:
    with sqlite3.connect(path) as database:
        database.execute("UPDATE messages SET data = ? WHERE id = 20", (BOMB,))


def in_bag(spoil: Callable[[Path], Any]) -> Callable[[Path], Any]:
    return lambda path: spoil(next(path.glob("*.*[34pd]")) if path.is_dir() else path)


SPARE = "CREATE TABLE spare (x)", "PRAGMA writable_schema = ON; DELETE FROM sqlite_master WHERE name = 'spare'"
COUNTED = struct.pack("<HQ", 1, 60)  # messages of a channel, in the statistics
HDF5 = one("demo.hdf5", lambda path: robomimic(path, (0, 1, 2), None))
SHORT = "of 60 messages that the bag states {} are of its topics"
# what is done to which recording -> code and words of its refusal, options
LOST: dict[str, tuple[Any, Callable[[Path], Any], str, str, dict[str, Any]]] = {
    "metadata": (
        bag("sqlite", all_in_one()), replaced("metadata.yaml", "message_count: 60", "message_count: 85"),
        "lost-messages", "60 messages.* states 85.*ros2 bag reindex", {},
    ),
    **{
        f"the attribute {name}": (HDF5, attribute(where, name), "lost-samples", f"{name!r}.*999", GIVEN)
        for where, name in (("data", "total"), ("data/demo_1", "num_samples"), ("data", "num_demos"))
    },
    **{
        f"a bomb in {what}": (bag(kind, all_in_one(), **options), in_bag(spoil), "bomb", "unpack", {})
        for what, kind, options, spoil in (
            ("a block", "ros1", {"compression": Writer1.CompressionFormat.BZ2}, bomb_in_a_block),
            ("the index", "mcap", {"mode": CompressionMode.STORAGE}, claimed_terabyte),
            ("the database", "sqlite", {"mode": CompressionMode.FILE}, lambda path: path.write_bytes(BOMB)),
            ("a message", "sqlite", {"mode": CompressionMode.MESSAGE}, bomb_in_a_message),
        )
    },
    "a message of no topic": (
        lambda folder: file_of(bag("sqlite", all_in_one())(folder)),
        queried("UPDATE messages SET topic_id = 9 WHERE id = 20"), "lost-messages", SHORT.format(59), {},
    ),
    "a page of nothing": (bag("sqlite", all_in_one()), queried(*SPARE), "damaged", "SQLite finds", {}),
    "an end that is none": (
        mcap, bytes_of(lambda b: b[: len(b) // 2] + b"xxxxxxxx"), "damaged", "File end magic is invalid", {}
    ),
    "statistics": (
        mcap, bytes_of(lambda b: b.replace(COUNTED, struct.pack("<HQ", 1, 59))), "lost-messages", SHORT.format(59), {}
    ),
    "a file of a LeRobot data set": (
        lambda folder: version_2(folder / "set"), lambda path: next(path.rglob("*10.parquet")).unlink(),
        "lost-samples", "meta/info.json states total_.*episodes='0:'", {"units": "radians"},
    ),
    **{
        f"a log {end} of a recorder that was killed, {'the folder' if whole else 'the file'}": (
            logged(end, whole), lambda path: next(file_of(path).parent.glob("*-*")).write_bytes(b"x" * 32),
            "unfinished", r"PRAGMA wal_checkpoint\(TRUNCATE\)", {},
        )
        for end in ("-wal", "-journal")
        for whole in (True, False)
    },
}  # fmt: skip


@pytest.mark.parametrize("what", LOST)
def test_what_a_file_states_is_believed(what: str, planar3: Robot, tmp_path: Path) -> None:
    """Fewer messages, samples or demonstrations than are stated, or a file that is not sound: refused with both
    numbers and the way out, in memory and in a stream; the same recording is read before.
    """
    build, edit, code, words, options = LOST[what]
    path = build(tmp_path)
    assert ml.load_demonstrations(path, planar3, **options).n_samples in (60, 180, 320)
    edit(path)
    assert refusal(path, planar3, match=words, **options).code == code
    with pytest.raises(RecordingError, match=words):
        list(ml.RecordingSource(path, planar3, **options))


@pytest.mark.parametrize("kind", KINDS)
def test_a_bag_of_many_chunks_and_topics_is_whole(kind: str, planar3: Robot, tmp_path: Path) -> None:
    """Long messages fill several chunks, and another topic lies in between: nothing is missed, nothing suspected."""
    others = tuple(f"finger_{i}" for i in range(1000))
    long = [(t, r, (s, (*n, *others), (*q, *np.zeros(1000)))) for t, r, (s, n, q, _) in all_in_one(u=None)]
    between = [("/other", r + 1, (s, ("x",), (0.5,))) for _, r, (s, *_) in long]
    assert ml.load_demonstrations(bag(kind, long, between)(tmp_path), planar3).n_samples == 60


# ---- what is no rollout
def saved_with(n: int = T, **changes: Any) -> Callable[[Path, ml.Rollout], Any]:
    def write(path: Path, rollout: ml.Rollout) -> None:
        with np.load(rollout.save(path)) as archive:
            arrays = {**archive, **changes}
        np.savez(path, **{name: a[:n] if a.shape[:1] == (T,) else a for name, a in arrays.items()})

    return write


def tabled(change: Callable[[str], str]) -> Callable[[Path, ml.Rollout], Any]:
    return lambda path, r: path.write_text(change(r.save(path.with_suffix(".csv")).read_text(encoding="utf-8")))


NO_ROLLOUT: dict[str, tuple[Callable[[Path, ml.Rollout], Any], str]] = {
    "a folder": (lambda path, _: path.mkdir(), r"r\.npz"),
    "text": (lambda path, _: path.write_text("time,q\n0,1\n", encoding="utf-8"), r"r\.npz"),
    "another archive": (lambda path, _: np.savez(path, q=np.zeros(3)), r"r\.npz"),
    "a pickle": (lambda path, _: np.savez(path, format=np.array([{}], dtype=object)), r"r\.npz"),
    "complex postures": (saved_with(q=np.zeros((T, 3), complex)), "'q' holds complex128"),
    "postures of text": (saved_with(q=np.full((T, 3), "x")), "'q' holds <U"),
    "another width": (saved_with(q=np.zeros((T, 2))), r"q has shape \(12, 2\), \(12, 3\)"),
    "an unknown status": (saved_with(status=np.array(["fine"] * T)), "sample 0: the status is 'fine'"),
    "other joints": (saved_with(joint_names=np.array(["a", "b", "c"])), "joint_names"),
    "a status in a table": (tabled(lambda text: text.replace("damped", "fine")), "'fine'"),
    "a sample less": (saved_with(T - 1), "written with 12 samples and holds 11"),
    "a row less": (tabled(lambda text: text.rpartition("0.22,")[0]), "written with 12 samples and holds 11"),
}  # fmt: skip


@pytest.mark.parametrize("what", NO_ROLLOUT)
def test_what_is_no_rollout_is_refused_by_name(what: str, planar3: Robot, rollout: ml.Rollout, tmp_path: Path) -> None:
    """No file, another kind of file, arrays of another kind, width, status or names: the message says which. What lost
    a sample is damaged.
    """
    write, words = NO_ROLLOUT[what]
    write(tmp_path / "r.npz", rollout)
    with pytest.raises(RecordingError, match=words) as seen:
        ml.Rollout.load(tmp_path / "r.npz", planar3)
    if "less" in what:
        assert seen.value.code == "damaged"


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="there is no /dev/full here")
def test_an_answer_that_cannot_be_printed() -> None:
    """On a full disk a command says so in one sentence and ends with code 2."""
    command = [sys.executable, "-m", "manip_learn", "inspect", "planar3", "--json"]
    with open("/dev/full", "w") as full:
        done = subprocess.run(command, stdout=full, stderr=subprocess.PIPE, text=True, timeout=110)
    assert done.returncode == 2 and done.stderr.count("\n") == 1 and "cannot be printed" in done.stderr


# ---- every door of the library
def _socket(path: Path) -> None:
    with socket.socket(socket.AF_UNIX) as end:
        end.bind(str(path))


# what can lie where a file is expected -> what the sentence says
IN_PLACE = {
    "a pipe": (lambda path: os.mkfifo(path), "write it to a file first"),
    "an endless device": (lambda path: path.symlink_to("/dev/zero"), "write it to a file first"),
    "a socket": (_socket, "write it to a file first"),
    "a link to itself": (lambda path: path.symlink_to(path), "link leads to itself"),
    "nothing": (lambda path: None, "no such file"),
}
DOORS = {
    **dict.fromkeys(("arm.urdf", "arm.xml"), lambda path, robot: load_robot(path)),
    "arm.xacro": lambda path, robot: load_robot(path, xacro=True),
    "constraint.json": ml.Constraint.load,
    "skill.json": ml.Skill.load,
    **dict.fromkeys(("scene.json", "scene.urdf"), ml.Scene.load),
    **dict.fromkeys(("run.npz", "run.csv"), ml.Rollout.load),
    **dict.fromkeys(("demo.csv", "demo.npz"), ml.load_demonstrations),
}


@pytest.mark.parametrize("what", IN_PLACE)
def test_what_is_no_file_is_refused_at_each_door(what: str, planar3: Robot, tmp_path: Path, monkeypatch) -> None:
    """At once, by the same words, without a byte of it being read; so is what may not be read."""
    monkeypatch.chdir(tmp_path)  # the address of a socket is short
    make, words = IN_PLACE[what]
    for name, load in DOORS.items():
        make(Path(name))
        with case(name), pytest.raises(ManipLearnError, match=words) as refused:
            load(Path(name), planar3)
        assert name in str(refused.value) and "\n" not in str(refused.value) and "damaged" not in str(refused.value)


def test_what_may_not_be_read_is_not_called_damaged(planar3: Robot, tmp_path: Path, monkeypatch) -> None:
    """Each loader says that the file may not be read; a folder is called a folder."""
    for load in (ml.Constraint.load, ml.Skill.load, ml.Scene.load):
        with pytest.raises(ManipLearnError, match="is a folder"):
            load(tmp_path, planar3)

    def protected(path, *flags, **more):
        raise PermissionError(13, "Permission denied")

    for name, load in DOORS.items():
        (tmp_path / name).write_text("{}")
        with case(name), monkeypatch.context() as patch, pytest.raises(ManipLearnError, match="permission denied"):
            patch.setattr(os, "open", protected)
            load(tmp_path / name, planar3)


# JSON that parsers take badly -> what is said of a constraint and of a scene
BAD_JSON = {
    "an integer of 400 digits": (b'{"floor": 1%s}' % (b"0" * 400), "format", "floor is inf"),
    "not a number": (b'{"floor": NaN}', "format", "floor is nan"),
    "lists 10,000 deep": (b"[" * 10_000 + b"]" * 10_000, "100 brackets", "100 brackets"),
    "a key that stands twice": (b'{"boxes": [], "boxes": []}', "'boxes' stands twice", "'boxes' stands twice"),
    "no UTF-8": (b'{"floor": "\xff\xfe\x80"}', "utf-8", "utf-8"),
    "nothing": (b"", "not JSON", "empty"),
}


@pytest.mark.parametrize("what", BAD_JSON)
def test_json_that_parsers_take_badly(what: str, planar3: Robot, tmp_path: Path, capsys) -> None:
    """One sentence with the reason, from Python and with exit code 2 from commands; never an internal error."""
    content, of_constraint, of_scene = BAD_JSON[what]
    path = tmp_path / "file.json"
    path.write_bytes(content)
    for load in (ml.Constraint.load, ml.Skill.load):
        with pytest.raises(ConstraintMismatchError, match=of_constraint):
            load(path, planar3)
    with pytest.raises(SceneError, match=of_scene):
        ml.Scene.load(path, planar3)
    assert main(["control", "planar3", str(path)]) == 2
    said = capsys.readouterr().err
    assert "internal error" not in said and of_constraint in said and said.count("\n") == 1 and len(said) < 500


def test_too_little_memory_is_said(planar3: Robot, rollout: ml.Rollout, tmp_path: Path, monkeypatch, capsys) -> None:
    """How much was asked for and what asks for less: of a rollout, and of a file, which is not called damaged."""
    path = ml.Constraint([[0.0, 1.0]], ml.FrameJacobian(planar3, "tip", "x y")).save(tmp_path / "c.json")
    command = ["control", "planar3", str(path), "--target", "1,1.5"]
    assert main([*command, "--duration", "1e8", "--dt", "1e-6"]) == 2
    said = capsys.readouterr().err
    assert "1e+14 steps take 4.8e+06 GB" in said and "shorter --duration or a larger --dt" in said
    run = rollout.save(tmp_path / "run.npz")

    def full(*_: object) -> None:
        raise MemoryError("Unable to allocate 3.2 GiB")

    monkeypatch.setattr(np.lib.format, "read_magic", full)
    with pytest.raises(RecordingError, match="too little memory .*3.2 GiB.*split the recording") as refused:
        ml.Rollout.load(run)
    assert refused.value.code == "too-large"
