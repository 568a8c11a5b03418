"""The replay page: what goes in, what is refused, and what the file holds."""

from __future__ import annotations

import base64
import hashlib
import json
import re
import subprocess
import sys
import webbrowser
from dataclasses import replace
from html import unescape
from xml.sax.saxutils import escape

import numpy as np
import pytest

import manip_learn as ml
from manip_learn.errors import ConfigurationError, OutputError, RecordingError, UnknownNameError
from manip_learn.robot.description.catalogue import find_robot

PLANAR3 = find_robot("planar3")
EVIL = '</script><script>window.hacked=1</script><img src=x onerror="window.hacked=2">'


def waving(robot, duration=2.0, dt=0.01, phase=0.0):
    """A rollout that waves around the robot's rest posture."""
    time = np.arange(round(duration / dt) + 1) * dt
    middle = robot.positions(robot.neutral())
    swing = np.sin(np.outer(time, 1.0 + 0.3 * np.arange(robot.nv)) + phase)
    mu = np.abs(np.cos(time + phase))
    status = tuple("damped" if m < 0.3 else "ok" for m in mu)
    q = middle + 0.4 * swing
    return ml.Rollout(time, q, 0.0 * q, mu, status, robot.joint_names, 0.0 * time)


def evil_robot(folder):
    """A planar arm whose own name and those of a link and a joint are markup."""
    urdf = PLANAR3.read_text().replace("planar3", escape(EVIL))
    urdf = urdf.replace("link2", escape(EVIL)).replace("joint2", escape("<b>joint</b>"))
    path = folder / "evil.urdf"
    path.write_text(urdf.replace(escape(EVIL), escape(EVIL, {'"': "&quot;"})), encoding="utf-8")
    return ml.load_robot(path)


def data_in(path):
    """What the page's program reads."""
    text = path.read_text(encoding="utf-8")
    return json.loads(re.search(r'<script type="application/json" id="data">(.*?)</script>', text, re.DOTALL)[1])


def unpacked(text, dtype="<f8"):
    """An array as the page's program decodes it."""
    return np.frombuffer(base64.b64decode(text), dtype)


def test_pages_are_small_and_true(robot_of, tmp_path):
    """Ten minutes of a panda at 100 Hz, meshes included, below 5 MB, and within 2 mrad of each sample between key
    frames; three short rollouts of a Sawyer in one file of 3 MB, viewer included, and nothing else.
    """
    rollout = waving(robot_of("panda"), 600.0)
    path = ml.replay(robot_of("panda"), {"a": rollout}, tmp_path / "a.html").html
    assert path.stat().st_size < 5_000_000
    drawn = data_in(path)["rollouts"][0]
    times, tracks = unpacked(drawn["keyTimes"]), unpacked(drawn["tracks"])
    for j, column in enumerate(tracks.reshape(len(times), -1)[:, :7].T):
        assert np.abs(np.interp(rollout.time, times, column) - rollout.q[:, j]).max() < 2e-3
    robot, path = robot_of("sawyer"), tmp_path / "new" / "replay.html"
    result = ml.replay(robot, {name: waving(robot, 10.0) for name in ("learnt", "zero", "attractor")}, path)
    assert (result.html, result.notes) == (path.resolve(), ())
    assert result.bytes == path.stat().st_size < 3_000_000
    assert [p.name for p in path.parent.iterdir()] == ["replay.html"]
    assert [r["name"] for r in data_in(path)["rollouts"]] == ["learnt", "zero", "attractor"]


def test_a_page_is_closed_off_and_brings_the_licences_of_others(robot_of, tmp_path):
    """The policy allows the page's two scripts by their hashes and no connection; nothing is loaded from outside. Who
    wrote the viewer, three.js and all that is bundled with them, and under which licence, is there word for word.
    """
    robot = robot_of("planar3")
    text = ml.replay(robot, waving(robot, 0.1), tmp_path / "a.html").html.read_text(encoding="utf-8")
    policy = re.search(r'http-equiv="Content-Security-Policy" content="(.*?)"', text)[1]
    scripts = re.findall(r"<script>(.*?)</script>", text, re.DOTALL)
    hashes = [base64.b64encode(hashlib.sha256(script.encode()).digest()).decode() for script in scripts]
    assert len(scripts) == 2 and all(f"'sha256-{digest}'" in policy for digest in hashes)
    assert "default-src 'none'" in policy and "connect-src 'none'" in policy
    assert "unsafe-eval" not in policy and "script-src 'unsafe-inline'" not in policy
    assert not re.search(r"(src|href)\s*=", re.sub(r"<script>.*?</script>", "", text, flags=re.DOTALL))
    embedded = unescape(re.search(r'<script type="text/plain" id="licences">(.*?)</script>', text, re.DOTALL)[1])
    assert embedded == (PLANAR3.parents[1] / "LICENSES" / "third-party-pages.txt").read_text(encoding="utf-8")
    for name in ("meshcat", "three 0.132.2", "dat.gui", "msgpack-lite", "Copyright © 2010-2021 three.js authors"):
        assert name in embedded
    assert embedded.count("Permission is hereby granted, free of charge") >= 7
    assert '"LICENSES/*.txt"' in (PLANAR3.parents[1] / "pyproject.toml").read_text()


def broken(rollout, **changes):
    """A rollout with some fields changed, past all checks."""
    copy = replace(rollout)
    for name, value in changes.items():
        object.__setattr__(copy, name, value)
    return copy


def test_bad_rollouts_and_choices_are_refused(robot_of, tmp_path):
    """NaN anywhere, bad times, missing rows, other robots and nothing at all are errors, and no file is written; an
    unknown tip, colour or rollout names what there is; an unwritable place is one sentence.
    """
    robot = robot_of("planar3")
    good, path = waving(robot), tmp_path / "a.html"
    nan = np.where(np.arange(good.q.size).reshape(good.q.shape) == 7, np.nan, good.q)
    mu = "manipulability of its 201 times must be as many finite"
    bad = [
        (broken(good, q=nan), "q of sample 2, joint 'joint2' is nan"),
        (broken(good, manipulability=good.manipulability * np.inf), mu),
        (broken(good, manipulability=good.manipulability[:-1]), mu),
        (broken(good, time=good.time * 0.0), "time must increase"),
        (broken(good, time=np.where(good.time == 0.5, np.nan, good.time)), "time of sample 50 is nan"),
        (broken(good, q=good.q[:-1]), r"q must have shape \(201, 3\)"),
        (broken(good, status=good.status[:-1]), "200 status words"),
        (broken(good, time=good.time[:0], q=good.q[:0]), "there are no samples"),
        (broken(good, joint_names=("joint1", "joint2", "elbow")), "missing joint3; not its own elbow"),
        (waving(robot_of("sawyer")), "not made with robot 'planar3'"),
        ("rollout.npz", "must be a Rollout or a Trajectory"),
    ]
    wide = broken(good, q=np.hstack([good.q, good.q]))
    for shown, more, error, words in (
        *(({"one": good, "bad": rollout}, {}, RecordingError, words) for rollout, words in bad),
        *((nothing, {}, RecordingError, None) for nothing in ({}, [good], None)),
        (wide, {}, ConfigurationError, "has 3 numbers"),
        (good, {"tip": "tipp"}, UnknownNameError, "unknown frame 'tipp'.*'tip'"),
        ({"a": good}, {"colours": {"a": "gren"}}, UnknownNameError, "unknown colour 'gren'.*'green'"),
        ({"a": good}, {"colours": {"b": "green"}}, UnknownNameError, "unknown rollout 'b'"),
        (good, {"html": tmp_path}, OutputError, "is a folder"),
    ):
        with pytest.raises(error, match=words):
            ml.replay(robot, shown, **{"html": path} | more)
    assert not path.exists()


def test_demonstrations_have_no_curve(robot_of, tmp_path):
    """A trajectory plays without a manipulability curve, under its own name, columns matched by joint name."""
    robot = robot_of("planar3")
    rollout = waving(robot)
    shuffled = ml.Trajectory(rollout.time + 5.0, rollout.q[:, ::-1], None, robot.joint_names[::-1], "demo_01")
    ml.replay(robot, shuffled, tmp_path / "a.html")
    ml.replay(robot, rollout, tmp_path / "b.html")
    one, other = (data_in(tmp_path / f"{n}.html")["rollouts"][0] for n in "ab")
    assert one["name"] == "demo_01"
    assert one["curve"] == "" and one["status"] == []
    assert one["tracks"] == other["tracks"]
    assert unpacked(one["keyTimes"])[0] == 0.0


def test_replay_draws_the_frame_of_the_rollout(robot_of, tmp_path):
    """A rollout knows the frame of its constraint, in its file too; `tip` overrules it."""
    robot = robot_of("planar3")
    controller = ml.ResolvedRateController(ml.Constraint(np.eye(3)[:2], ml.FrameJacobian(robot, "link2", "planar")))
    rollout = ml.Rollout.load(ml.simulate(robot, controller, [0.1, 0.2, 0.3], 0.1).save(tmp_path / "r.npz"))
    assert rollout.frame == "link2"
    for more, tip in (({}, "link2"), ({"tip": "tip"}, "tip")):
        assert data_in(ml.replay(robot, rollout, tmp_path / "a.html", **more).html)["robot"]["tip"] == tip


def test_without_a_file_the_browser_opens(robot_of, tmp_path, monkeypatch):
    """Without a file name a temporary page is written and shown; with one, only on request."""
    opened: list[str] = []
    monkeypatch.setattr(webbrowser, "open", lambda url: opened.append(url))
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    monkeypatch.setattr("tempfile.tempdir", None)
    robot = robot_of("planar3")
    result = ml.replay(robot, waving(robot))
    assert result.html.is_file()
    assert opened == [result.html.as_uri()]
    ml.replay(robot, waving(robot), tmp_path / "a.html")
    ml.replay(robot, waving(robot), open_browser=False)
    assert len(opened) == 1
    ml.replay(robot, waving(robot), tmp_path / "a.html", open_browser=True)
    assert len(opened) == 2


def test_meshcat_is_never_imported(tmp_path):
    """Writing a replay takes meshcat's script from its folder; importing meshcat would bring IPython."""
    code = (
        "import sys, numpy as np, manip_learn as ml\n"
        "robot = ml.load_robot('planar3')\n"
        "t = np.arange(3.0)\n"
        "demo = ml.Trajectory(t, np.zeros((3, 3)), None, robot.joint_names)\n"
        f"ml.replay(robot, demo, {str(tmp_path / 'a.html')!r})\n"
        "print([m for m in ('meshcat', 'IPython', 'tornado', 'zmq', 'trimesh') if m in sys.modules])\n"
    )
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=True)
    assert out.stdout.strip() == "[]"
