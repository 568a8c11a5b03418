"""Damaged files of the library: each is read or refused in one sentence, never an internal error, never a traceback."""

from __future__ import annotations

import json
import os
import socket
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from case import case

from manip_learn.cli import main
from manip_learn.constraint.constraint import Constraint
from manip_learn.constraint.features import FrameJacobian
from manip_learn.constraint.skill import Skill
from manip_learn.control.rollout import Rollout
from manip_learn.errors import ConstraintMismatchError, ManipLearnError, RecordingError, SceneError
from manip_learn.planning.scene import Scene
from manip_learn.recordings import load_demonstrations
from manip_learn.robot import Robot, load_robot
from manip_learn.robot.identity import RobotIdentity

TRIALS = 2000 if os.environ.get("HYPOTHESIS_PROFILE") == "fuzz" else 8
T = 12
# values that a damaged or forged JSON file may hold
VALUES = (None, True, -1, 10**400, 1e308, "", "x", [], [1], {}, {"a": 1}, [[1, 2], [3]], "\ud800", float("inf"))


@pytest.fixture
def rollout(planar3: Robot) -> Rollout:
    time = 0.1 * np.arange(T)
    q = np.column_stack([np.sin(time), 1.0 + np.cos(time), 0.5 * time])
    u = np.gradient(q, time, axis=0)
    return Rollout(time, q, u, time, ("ok",) * T, planar3.joint_names, time, "", RobotIdentity.of(planar3))


def mutant(content: bytes, rng: np.random.Generator) -> bytes:
    """Cut off, bits flipped, bytes overwritten, a stretch repeated or left out; text gets huge numbers too."""
    broken, at = bytearray(content), int(rng.integers(len(content)))
    end = min(at + int(rng.integers(1, 40)), len(content))
    kind = rng.integers(7)
    if kind == 0:
        return bytes(broken[:at])
    if kind == 1:
        broken[at] ^= 1 << int(rng.integers(8))
    elif kind == 2:
        broken[at:end] = rng.bytes(end - at)
    elif kind == 3:
        del broken[at:end]
    elif kind == 4:
        broken[at:at] = broken[at:end]
    elif kind == 5:
        broken[at:end] = (b"9" * 400, b"9" * 5000, b"[" * 3000, b"nan", b"\xff\xfe", b"-1", b"{}")[rng.integers(7)]
    else:
        broken[at : at + 4] = (b"\xff\xff\xff\xff", b"\x00\x00\x00\x80", b"\xff\xff\xff\x7f")[rng.integers(3)]
    return bytes(broken)


def forged(content: object, rng: np.random.Generator) -> object:
    """JSON content with one value, anywhere, replaced or left out."""
    places: list[tuple] = []

    def walk(node: object) -> None:
        for key in node if isinstance(node, dict) else range(len(node)) if isinstance(node, list) else ():
            places.append((node, key))
            walk(node[key])

    walk(content)
    node, key = places[rng.integers(len(places))]
    if isinstance(node, dict) and rng.integers(4) == 0:
        del node[key]
    else:
        node[key] = VALUES[rng.integers(len(VALUES))]
    return content


@pytest.mark.fuzz
@pytest.mark.filterwarnings("ignore:overflow:RuntimeWarning")  # of forged numbers such as 1e308
def test_damaged_constraints(planar3: Robot, rollout: Rollout, tmp_path: Path, rng, capsys) -> None:
    """Bytes and values changed in a constraint file, from its robot to its mechanism: one sentence, code 2."""
    features = FrameJacobian(planar3, planar3.frame_names[-1], "planar")
    run = rollout.save(tmp_path / "run.npz")
    learnt = {
        "phases": [["run", 0.0, 0.5, 0], ["run", 0.5, 1.0, None]],
        "mechanism": {"type": "hinge", "axis": [0, 0, 1], "point": [0, 0, 0], "radius": 1.0},
    }
    path = Constraint([[1.0, 0.0, 0.0]], features, learnt).save(tmp_path / "c.json")
    content = path.read_bytes()
    replay = ["replay", "planar3", str(run), "--constraint", str(path), "--html", str(tmp_path / "p.html")]
    assert main(replay) == 0
    codes = set()
    for i in range(TRIALS):
        if i % 2:
            path.write_bytes(mutant(content, rng))
        else:
            path.write_text(json.dumps(forged(json.loads(content), rng)))
        code, said = main(replay), capsys.readouterr().err
        assert code in (0, 2) and "internal error" not in said and "Traceback" not in said, said
        codes.add(code)
        try:
            Constraint.load(path, planar3)
        except ManipLearnError as error:
            assert "\n" not in str(error)
    assert 2 in codes


def test_wrong_arrays_are_refused_by_name(planar3: Robot, rollout: Rollout, tmp_path: Path) -> None:
    """Complex or text postures, another width, an unknown status, other joint names: the message says which."""
    path = rollout.save(tmp_path / "run.npz")
    with np.load(path) as archive:
        arrays = dict(archive)
    for name, value, words in (
        ("q", rollout.q.astype(complex), "'q' holds complex128"),
        ("q", rollout.q.astype(str), "'q' holds <U"),
        ("q", rollout.q[:, :2], r"q has shape \(12, 2\), \(12, 3\)"),
        ("status", np.array(["fine"] * T), "sample 0: the status is 'fine'"),
        ("joint_names", np.array(["a", "b", "c"]), "joint_names"),
    ):
        np.savez(path, **{**arrays, name: value})
        with case(words), pytest.raises(RecordingError, match=words):
            Rollout.load(path, planar3)


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="there is no /dev/full here")
def test_an_answer_that_cannot_be_printed(rollout: Rollout, tmp_path: Path) -> None:
    """On a full disk a command says so in one sentence and ends with code 2; so for an output file that is a device."""
    command = [sys.executable, "-m", "manip_learn", "inspect", "planar3", "--json"]
    with open("/dev/full", "w") as full:
        done = subprocess.run(command, stdout=full, stderr=subprocess.PIPE, text=True, timeout=110)
    assert done.returncode == 2 and done.stderr.count("\n") == 1 and "cannot be printed" in done.stderr
    assert main(["replay", "planar3", str(rollout.save(tmp_path / "r.npz")), "--html", "/dev/full"]) == 2


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
    "constraint.json": Constraint.load,
    "skill.json": Skill.load,
    "scene.json": Scene.load,
    "scene.urdf": Scene.load,
    "run.npz": Rollout.load,
    "run.csv": Rollout.load,
    "demo.csv": load_demonstrations,
    "demo.npz": load_demonstrations,
    "arm.urdf": lambda path, robot: load_robot(path),
    "arm.xml": lambda path, robot: load_robot(path),
    "arm.xacro": lambda path, robot: load_robot(path, xacro=True),
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
    """At each door; a folder is called one."""
    opened = os.open

    def protected(path, *flags, **more):
        if Path(path).parent == tmp_path:
            raise PermissionError(13, "Permission denied")
        return opened(path, *flags, **more)

    for name, load in DOORS.items():
        (tmp_path / name).write_text("{}")
        with case(name), monkeypatch.context() as patch, pytest.raises(ManipLearnError, match="may not be read"):
            patch.setattr(os, "open", protected)
            load(tmp_path / name, planar3)
    (tmp_path / "folder").mkdir()
    for load in (Constraint.load, Skill.load, Scene.load):
        with pytest.raises(ManipLearnError, match="is a folder"):
            load(tmp_path / "folder", planar3)


# JSON that parsers take badly -> what is said of a constraint and of a scene
BAD_JSON = {
    "an integer of 400 digits": ('{"floor": %s}' % ("1" + "0" * 400), "format", "floor is inf"),
    "an integer of 5000 digits": ('{"floor": %s}' % ("1" + "0" * 5000), "format", "floor is inf"),
    "a float beyond all": ('{"floor": 1e999}', "format", "floor is inf"),
    "not a number": ('{"floor": NaN}', "format", "floor is nan"),
    "lists 10,000 deep": ("[" * 10_000 + "]" * 10_000, "100 brackets", "100 brackets"),
    "lists 200 deep": ('{"boxes": ' + "[" * 200 + "]" * 200 + "}", "100 brackets", "100 brackets"),
    "objects 10,000 deep": ('{"floor": ' * 10_000 + "0" + "}" * 10_000, "100 brackets", "100 brackets"),
    "a key that stands twice": ('{"boxes": [], "boxes": []}', "'boxes' stands twice", "'boxes' stands twice"),
    "no UTF-8": (b'{"floor": "\xff\xfe\x80"}', "utf-8", "utf-8"),
    "nothing": ("", "not JSON", "empty"),
}


@pytest.mark.parametrize("what", BAD_JSON)
def test_json_that_parsers_take_badly(what: str, planar3: Robot, tmp_path: Path, capsys) -> None:
    """One sentence with the reason, from Python and with exit code 2 from commands; never an internal error."""
    content, of_constraint, of_scene = BAD_JSON[what]
    path = tmp_path / "file.json"
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    for load in (Constraint.load, Skill.load):
        with pytest.raises(ConstraintMismatchError, match=of_constraint):
            load(path, planar3)
    with pytest.raises(SceneError, match=of_scene):
        Scene.load(path, planar3)
    for command in ("control", "repeat"):
        assert main([command, "planar3", str(path)]) == 2
        said = capsys.readouterr().err
        assert "internal error" not in said and of_constraint in said and said.count("\n") == 1 and len(said) < 500


def test_huge_numbers_in_a_constraint_are_refused(planar3: Robot, tmp_path: Path) -> None:
    """In each entry that decides anything; a byte-order mark, which some editors write, is not."""
    path = Constraint([[1.0, 0.0, 0.0]], FrameJacobian(planar3, "tip", "planar")).save(tmp_path / "c.json")
    text, huge = path.read_text(), "1" + "0" * 400
    path.write_bytes(b"\xef\xbb\xbf" + text.encode())
    assert Constraint.load(path, planar3).n_constraints == 1
    for key, old, end in (('"n_constraints": ', "1", ""), ("", "1.0", ","), ('"schema": ', "2", "")):
        path.write_text(text.replace(key + old + end, key + huge + end, 1))
        with case(key, old), pytest.raises(ConstraintMismatchError, match="c.json"):
            Constraint.load(path, planar3)


def test_too_little_memory_is_said(planar3: Robot, rollout: Rollout, tmp_path: Path, monkeypatch, capsys) -> None:
    """How much was asked for and what asks for less: of a rollout, and of a file, which is not called damaged."""
    path = Constraint([[0.0, 1.0]], FrameJacobian(planar3, "tip", "x y")).save(tmp_path / "c.json")
    command = ["control", "planar3", str(path), "--target", "1,1.5"]
    for t, dt, words in (("1e8", "1e-6", "1e+14 steps take 4.8e+06 GB"), ("1e300", "1e-300", "inf steps take inf GB")):
        assert main([*command, "--duration", t, "--dt", dt]) == 2
        said = capsys.readouterr().err
        assert words in said and "shorter --duration or a larger --dt" in said
    run = rollout.save(tmp_path / "run.npz")

    def full(*_: object) -> None:
        raise MemoryError("Unable to allocate 3.2 GiB")

    monkeypatch.setattr(np.lib.format, "read_magic", full)
    with pytest.raises(RecordingError, match="too little memory .*3.2 GiB.*divide the recording") as refused:
        Rollout.load(run)
    assert refused.value.code == "too-large"
