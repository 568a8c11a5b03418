"""Damaged files of the library: each is read or refused in one sentence, never an internal error, never a traceback."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from case import case

from manip_learn.cli import main
from manip_learn.constraint.constraint import Constraint
from manip_learn.constraint.features import FrameJacobian
from manip_learn.control.rollout import Rollout
from manip_learn.errors import ManipLearnError, RecordingError
from manip_learn.robot import Robot, load_robot
from manip_learn.robot.identity import RobotIdentity

TRIALS = 2000 if os.environ.get("HYPOTHESIS_PROFILE") == "fuzz" else 8
T = 12
# values that a damaged or forged JSON file may hold
VALUES = (None, True, -1, 10**400, 1e308, "", "x", [], [1], {}, {"a": 1}, [[1, 2], [3]], "\ud800", float("inf"))


@pytest.fixture(scope="module")
def robot() -> Robot:
    return load_robot("planar3")


@pytest.fixture(scope="module")
def rollout(robot: Robot) -> Rollout:
    time = 0.1 * np.arange(T)
    q = np.column_stack([np.sin(time), 1.0 + np.cos(time), 0.5 * time])
    u = np.gradient(q, time, axis=0)
    return Rollout(time, q, u, time, ("ok",) * T, robot.joint_names, time, "", RobotIdentity.of(robot))


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
def test_damaged_constraints(robot: Robot, rollout: Rollout, tmp_path: Path, rng, capsys) -> None:
    """Bytes and values changed in a constraint file, from its robot to its mechanism: one sentence, code 2."""
    features = FrameJacobian(robot, robot.frame_names[-1], "planar")
    run = rollout.save(tmp_path / "run.npz")
    learnt = {
        "phases": [["run", 0.0, 0.5, 0], ["run", 0.5, 1.0, None]],
        "mechanism": {"type": "hinge", "axis": [0, 0, 1], "point": [0, 0, 0], "radius": 1.0},
    }
    constraint = Constraint([[1.0, 0.0, 0.0]], features, learnt)
    path = constraint.save(tmp_path / "c.json")
    content = path.read_bytes()
    assert main(["replay", "planar3", str(run), "--constraint", str(path), "--html", str(tmp_path / "p.html")]) == 0
    codes = set()
    for i in range(TRIALS):
        if i % 2:
            path.write_bytes(mutant(content, rng))
        else:
            path.write_text(json.dumps(forged(json.loads(content), rng)))
        code = main(["replay", "planar3", str(run), "--constraint", str(path), "--html", str(tmp_path / "p.html")])
        said = capsys.readouterr().err
        assert code in (0, 2), said
        assert "internal error" not in said and "Traceback" not in said
        codes.add(code)
        try:
            Constraint.load(path, robot)
        except ManipLearnError as error:
            assert "\n" not in str(error)
    assert 2 in codes


def test_wrong_arrays_are_refused_by_name(robot: Robot, rollout: Rollout) -> None:
    """Complex or text postures, another width, an unknown status, other joint names: the message says which."""
    for kind in ["complex", "text", "width", "status", "names"]:
        with case(kind) as tmp_path:
            path = rollout.save(tmp_path / "run.npz")
            with np.load(path) as archive:
                arrays = dict(archive)
            changes = {
                "complex": ("q", arrays["q"].astype(complex), "'q' holds complex128"),
                "text": ("q", arrays["q"].astype(str), "'q' holds <U"),
                "width": ("q", arrays["q"][:, :2], r"q has shape \(12, 2\), \(12, 3\)"),
                "status": ("status", np.array(["fine"] * T), "sample 0: the status is 'fine'"),
                "names": ("joint_names", np.array(["a", "b", "c"]), "joint_names"),
            }
            name, value, words = changes[kind]
            np.savez(path, **{**arrays, name: value})
            with pytest.raises(RecordingError, match=words):
                Rollout.load(path, robot)


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="there is no /dev/full here")
def test_an_answer_that_cannot_be_printed(rollout: Rollout, tmp_path: Path) -> None:
    """On a full disk a command says so in one sentence and ends with code 2; so for an output file that is a device."""
    command = [sys.executable, "-m", "manip_learn", "inspect", "planar3", "--json"]
    with open("/dev/full", "w") as full:
        done = subprocess.run(command, stdout=full, stderr=subprocess.PIPE, text=True, timeout=110)
    assert done.returncode == 2 and done.stderr.count("\n") == 1
    assert "cannot be printed" in done.stderr
    assert main(["replay", "planar3", str(rollout.save(tmp_path / "r.npz")), "--html", "/dev/full"]) == 2
