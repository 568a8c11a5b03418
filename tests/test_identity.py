"""Which robot a file was made with: kept in JSON word for word, and another robot is refused with what differs."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from case import case
from urdf_corpus import edited

from manip_learn.errors import RecordingError, advice_for_command
from manip_learn.robot.identity import RobotIdentity
from manip_learn.robot.loading import load_robot

PATH = Path("some/run.npz")


@pytest.fixture
def arm(tmp_path):
    """Load the two-joint arm, with a change."""

    def load(*change: tuple[str, str], **options):
        path = tmp_path / "arm.urdf"
        path.write_bytes(edited(*change))
        return load_robot(path, **options)

    return load


def test_an_identity_is_kept_in_json(arm):
    """There and back; what is no identity is refused with what is wrong."""
    identity = RobotIdentity.of(arm(locked={"elbow": 0.1}, objects=("box",)))
    words = json.loads(json.dumps(identity.to_dict()))
    assert RobotIdentity.from_dict(words) == identity
    assert (words["name"], words["nq"], words["locked"], words["objects"]) == ("arm", 8, {"elbow": 0.1}, ["box"])
    assert RobotIdentity.from_dict({k: v for k, v in words.items() if k not in ("locked", "objects")}).locked == {}
    wrong = {
        "nq must be a number": {"nq": True},
        "nq must be a number, it is -1": {"nq": -1},
        "nq must be a number, it is 100000": {"nq": 100_000},
        "name must be text": {"name": 3},
        "fingerprint must be text": {"fingerprint": None},
        "joint_names must be a list of names": {"joint_names": ["a", 1]},
        "locked joints must be an object": {"locked": []},
        "'elbow' is locked at True": {"locked": {"elbow": True}},
        "'elbow' is locked at nan": {"locked": {"elbow": float("nan")}},
        "objects must be a list": {"objects": "box"},
    }
    for sentence, change in wrong.items():
        with case(sentence), pytest.raises(ValueError, match=sentence):
            RobotIdentity.from_dict(words | change)
    with pytest.raises(ValueError, match="it is list"):
        RobotIdentity.from_dict([])


def test_what_differs_is_said(arm):
    """Joints, locks, objects; else that the description has changed, as where all links are 1.3 times as long."""
    plain = RobotIdentity.of(arm())
    assert plain.differences(arm()) == ()
    plain.refuse_another(arm(), "run.npz")
    longer = arm(("0 0 0.3", "0 0 0.39"), ("0.4 0 0", "0.52 0 0"))
    hashes = f"hash {plain.fingerprint[:12]!r}, not {longer.fingerprint[:12]!r}"
    assert plain.differences(longer) == (f"the description has changed (kinematics or masses; {hashes})",)
    assert plain.differences(arm(locked={"elbow": 1.2})) == (
        "its joints are shoulder, elbow, not shoulder",
        "'elbow' is free to move, not locked at 1.2",
    )
    held = RobotIdentity.of(arm(locked={"elbow": 0.5}))
    assert held.differences(arm(locked={"elbow": 1.2})) == ("'elbow' is locked at 0.5, not locked at 1.2",)
    with pytest.raises(RecordingError) as caught:
        held.refuse_another(arm(), "run.npz", PATH)
    assert (caught.value.code, caught.value.path) == ("other-robot", PATH)
    assert str(caught.value) == (
        "run.npz was made with robot 'arm', the robot loaded is 'arm': its joints are shoulder, not shoulder, elbow; "
        "'elbow' is locked at 0.5, not free to move. Load the robot that it was made with, "
        "load_robot(..., locked={'elbow': 0.5})"
    )
    with advice_for_command(["--lock"]), pytest.raises(RecordingError, match="are locked without --lock"):
        held.refuse_another(arm(), "run.npz")
    assert "its objects are none, not box" in plain.differences(arm(objects="box"))
    many = RobotIdentity.of(load_robot("panda", locked=load_robot("panda").joint_names))
    assert many.differences(load_robot("panda"))[1].count("locked at") == 8
    assert many.differences(load_robot("panda"))[1].endswith(" and 1 more")
