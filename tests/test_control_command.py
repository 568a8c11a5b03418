"""`manip-learn control`: the task that was learnt is done, and the words say how far it came."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from case import rows_in
from test_motion import LEARNT, learnt, screw
from test_playback import data_in

import manip_learn as ml
from manip_learn.commands.demo import shipped_recordings


@pytest.fixture(autouse=True)
def wide(monkeypatch):
    """A terminal on which no line is broken."""
    monkeypatch.setenv("COLUMNS", "200")


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    """Name of what was learnt -> robot, and its constraint file."""
    folder = tmp_path_factory.mktemp("learnt")
    made = {name: learnt(name)[0].save(folder / f"{name}.json") for name in LEARNT}
    made["screw"] = screw().save(folder / "screw.json")
    return lambda name: (LEARNT.get(name, ("", "panda"))[1], made[name])


def test_a_way_is_done_as_far_as_was_asked(answer, file):
    """Within 1 mm or 0.2 degrees of the way and 2 mm of the mechanism, within all limits; the file is there."""
    for name, options in rows_in("ways_along.txt"):
        way = options.split()
        said = answer("control", *file(name), *way, "--out", f"{name}.npz")
        assert (said["stopped_by"], said["reached"]) == (None, True), name
        assert said["wanted"] == float(way[1]) and said["unit"] == ("m" if way[0] == "--along" else "deg")
        assert abs(said["done"] - said["wanted"]) < (1e-3 if said["unit"] == "m" else 0.2), name
        assert 0.0 <= said["deviation"] < 2e-3 and said["fastest_joint"]["share_of_limit"] <= 1.0, name
        r = ml.Rollout.load(said["out"])
        assert (said["min_manipulability"], said["duration"]) == (r.manipulability.min(), r.time[-1]), name


def typed(**places):
    """Options with numbers."""
    return [f"--{name}={','.join(map(str, numbers))}" for name, numbers in places.items()]


def test_a_target_is_the_point(run, answer, file):
    """The tip goes to the point, across what is held too, and with --rows held to the line through it; words say so. A
    point beside a hinge is an angle: the handle comes as near to it as its circle allows.
    """
    constraint, _ = learnt("drawer")
    q0 = np.array(constraint.provenance["postures"][0])
    here, free = constraint.robot.position(q0, constraint.features.frame), np.linalg.svd(constraint.selection)[2][2]
    along, rows = typed(start=q0, target=here + 0.1 * free), ("--rows", "held", "--policy", "zero")
    said = answer("control", *file("drawer"), *along)
    assert said["reached"] is True and said["tip_to_target"] < 0.01 and said["ignored_target_axes"] == []
    said = answer("control", *file("drawer"), *along, *rows)
    assert said["reached"] is False and said["final_error"] < 0.01 < said["tip_to_target"]
    across = typed(start=q0, target=here + 0.05 * constraint.selection[0])
    for options, begins, says in (
        (along, "at the target", ""),
        ([*along, *rows], "on the line, 0.1 m from the point", "--rows held leaves"),
        (across, "", "the hand moved 0.05 along directions that the recordings show to be blocked"),
    ):
        _code, out, _err = run("control", *file("drawer"), *options)
        assert out.startswith(begins) and says in out and ("blocked" in out) == (options is across)
    constraint, _ = learnt("door")
    start, *_, near = constraint.provenance["postures"][:21]
    point = constraint.robot.position(np.array(near), constraint.features.frame)
    said = answer("control", *file("door"), *typed(start=start, target=point))
    assert said["stopped_by"] is None and said["unit"] == "deg"


def test_by_default_the_hand_moves_as_far_as_demonstrated(run, file, tmp_path):
    """The grasp position and the margin are printed; the replay is written beside the rollout."""
    page = tmp_path / "run.html"
    code, out, _err = run("control", *file("drawer"), "--start", "0,-0.3,0,-2,0,1.8,0.7", "--html", str(page))
    assert code == 0 and out.startswith("opened 0.182 of 0.182 m") and "grasp at (" in out and "margin" in out
    assert "note: as when the constraint was made: panda_finger_joint1 = 0, panda_finger_joint2 = 0 locked" in out
    assert data_in(page)["rollouts"] and str(page.name) in out


@pytest.mark.parametrize(
    ("robot", "recordings", "options"),
    [
        # on purpose, to different targets
        ("planar3", "planar3_reach", ("--frame", "tip", "--axes", "planar", "--velocities", "recorded")),
        ("sawyer", "sawyer_door", ("--frame", "right_gripper_tip")),
    ],
)
def test_the_printed_next_command_works(run, robot, recordings, options):
    """The command that `learn` prints last runs as it is printed."""
    _code, out, _err = run("learn", robot, shipped_recordings() / recordings, *options, "--out", "task.json")
    code, out, err = run(*out.split("next: manip-learn ")[1].split())
    completed = ("at the target", "completed as demonstrated", "opened 10.0 of")
    assert code == 0 and any(words in out for words in completed), (out, err)


def test_the_demo_shows_the_difference(run, answer):
    """From one start the learnt task goes as far as demonstrated, and at most a third as far without it, on one clock;
    other robots and all policies that the help names can be asked for.
    """
    said = answer("demo", "--no-browser")
    plain, learnt_ = (said["rollouts"][name] for name in ("without", "with"))
    assert abs(learnt_["wanted"] - 0.232) < 1e-3  # the median that was shown
    assert learnt_["done"] >= 0.97 * learnt_["wanted"] and plain["done"] <= plain["wanted"] / 3.0
    assert plain["stopped_by"] and learnt_["stopped_by"] is None and learnt_["deviation"] < 1e-3
    page = data_in(Path(said["html"]))
    grasps = [r["phases"][-1][0] if r["phases"] else page["zero"] for r in page["rollouts"]]
    assert grasps == pytest.approx([page["zero"]] * 2, abs=0.02)  # one clock from the grasp
    for more, names in (
        (["--all-policies"], ["plan", "manipulability", "attractor", "zero"]),
        (["--robot", "planar3"], ["without", "with"]),
    ):
        assert run("demo", "--no-browser", "--out", "here", *more)[0] == 0
        assert [rollout["name"] for rollout in data_in(Path("here/replay.html"))["rollouts"]] == names
