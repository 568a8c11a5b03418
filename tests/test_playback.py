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
    quoted = escape(EVIL, {'"': "&quot;"})
    urdf = PLANAR3.read_text().replace("planar3", quoted).replace("link2", quoted)
    (folder / "evil.urdf").write_text(urdf.replace("joint2", escape("<b>joint</b>")), encoding="utf-8")
    return ml.load_robot(folder / "evil.urdf")


def data_in(path):
    """What the page's program reads."""
    text = path.read_text(encoding="utf-8")
    return json.loads(re.search(r'<script type="application/json" id="data">(.*?)</script>', text, re.DOTALL)[1])


def unpacked(text, dtype="<f8"):
    """An array as the page's program decodes it."""
    return np.frombuffer(base64.b64decode(text), dtype)


def test_pages_are_small_and_accurate(robot_of, tmp_path):
    """Ten minutes of a Panda at 100 Hz, meshes included, make one file below 5 MB, in a folder that did not exist. It
    is within 2 mrad of each sample between key frames.
    """
    rollout, path = waving(robot_of("panda"), 600.0), tmp_path / "new" / "a.html"
    result = ml.replay(robot_of("panda"), {"a": rollout}, path)
    assert result.html == path.resolve() and result.bytes == path.stat().st_size < 5_000_000
    assert [p.name for p in path.parent.iterdir()] == ["a.html"]
    drawn = data_in(path)["rollouts"][0]
    times, tracks = unpacked(drawn["keyTimes"]), unpacked(drawn["tracks"])
    for j, column in enumerate(tracks.reshape(len(times), -1)[:, :7].T):
        assert np.abs(np.interp(rollout.time, times, column) - rollout.q[:, j]).max() < 2e-3


def test_page_loads_nothing_and_contains_the_licences(robot_of, tmp_path):
    """The policy allows the page's two scripts by their hashes and no connection; nothing is loaded from outside. The
    licences of the viewer, three.js and their dependencies are in the page word for word.
    """
    text = ml.replay(robot_of("planar3"), waving(robot_of("planar3"), 0.1), tmp_path / "a.html").html.read_text("utf-8")
    policy = re.search(r'http-equiv="Content-Security-Policy" content="(.*?)"', text)[1]
    scripts = re.findall(r"<script>(.*?)</script>", text, re.DOTALL)
    hashes = [base64.b64encode(hashlib.sha256(script.encode()).digest()).decode() for script in scripts]
    assert len(scripts) == 2 and all(f"'sha256-{digest}'" in policy for digest in hashes)
    assert "default-src 'none'" in policy and "connect-src 'none'" in policy
    assert "unsafe-eval" not in policy and "script-src 'unsafe-inline'" not in policy
    assert not re.search(r"(src|href)\s*=", re.sub(r"<script>.*?</script>", "", text, flags=re.DOTALL))
    licences = unescape(re.search(r'<script type="text/plain" id="licences">(.*?)</script>', text, re.DOTALL)[1])
    assert licences == (PLANAR3.parents[1] / "LICENSES" / "third-party-pages.txt").read_text(encoding="utf-8")
    for name in ("meshcat", "three 0.132.2", "dat.gui", "msgpack-lite", "Copyright © 2010-2021 three.js authors"):
        assert name in licences


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
        *(
            (good, wrong, RecordingError, "align|side_by_side")
            for wrong in ({"align": "contact"}, {"side_by_side": True})
        ),
    ):
        with pytest.raises(error, match=words):
            ml.replay(robot, shown, **{"html": path} | more)
    assert not path.exists()


def test_demonstrations_have_no_curve(robot_of, tmp_path):
    """A trajectory plays without a manipulability curve, under its own name, columns matched by joint name."""
    robot, rollout = robot_of("planar3"), waving(robot_of("planar3"))
    shuffled = ml.Trajectory(rollout.time + 5.0, rollout.q[:, ::-1], None, robot.joint_names[::-1], "demo_01")
    page, other = (
        data_in(ml.replay(robot, shown, tmp_path / "a.html").html)["rollouts"][0] for shown in (shuffled, rollout)
    )
    assert (page["name"], page["curve"], page["status"]) == ("demo_01", "", [])
    assert page["tracks"] == other["tracks"] and unpacked(page["keyTimes"])[0] == 0.0


def test_browser_opens_without_a_file_name(robot_of, tmp_path, monkeypatch):
    """Without a file name a temporary page is written and shown, unless `open_browser` is False; with one, only if it
    is True.
    """
    opened: list[str] = []
    monkeypatch.setattr(webbrowser, "open", opened.append)
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    robot, motion = robot_of("planar3"), waving(robot_of("planar3"))
    page = ml.replay(robot, motion).html
    assert page.is_file() and tmp_path in page.parents
    ml.replay(robot, motion, tmp_path / "a.html")
    ml.replay(robot, motion, open_browser=False)
    assert opened == [page.as_uri()]
    ml.replay(robot, motion, tmp_path / "a.html", open_browser=True)
    assert opened[1:] == [(tmp_path / "a.html").as_uri()]


def test_meshcat_is_never_imported(tmp_path):
    """Writing a replay takes meshcat's script from its folder; importing meshcat would bring IPython."""
    code = (
        "import sys, numpy as np, manip_learn as ml\n"
        "robot = ml.load_robot('planar3')\n"
        "demo = ml.Trajectory(np.arange(3.0), np.zeros((3, 3)), None, robot.joint_names)\n"
        f"ml.replay(robot, demo, {str(tmp_path / 'a.html')!r})\n"
        "assert not {'meshcat', 'IPython', 'tornado', 'zmq', 'trimesh'} & {*sys.modules}\n"
    )
    subprocess.run([sys.executable, "-c", code], timeout=60, check=True)
