"""Wrong settings of an engineer: each is refused, told, without effect, or documented as one that none can tell."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from task_sets import arm, generated, true_rows

from manip_learn.cli import main

DOCUMENTED = (Path(__file__).resolve().parents[1] / "docs" / "troubleshooting.md").read_text(encoding="utf-8")
ROBOT, TIP, SEED = "ur5e", "tool0", 901  # no seed or set on which anything was tuned
Change = Callable[[np.ndarray, int], np.ndarray]  # positions of a recording and its number -> what the file says


def ordered(*order: int, until: int = 6) -> Change:
    return lambda q, i: q[:, list(order)] if i < until else q


def mirrored(joint: int) -> Change:
    return lambda q, i: q * np.where(np.arange(6) == joint, -1.0, 1.0)


def moved(joint: int, by: float, since: int = 0) -> Change:
    return lambda q, i: q + np.where(np.arange(6) == joint, by, 0.0) * (i >= since)


class Setting(NamedTuple):
    """What is wrong, and what becomes of it: a code, `right` (no effect), `told` (a warning, fewer rows, or a larger
    stated angle than 0.5 degrees), or the words of the documented list.
    """

    name: str
    wanted: str
    change: Change = ordered(*range(6))
    options: tuple[str, ...] = ()
    robot: str = ROBOT
    frame: str = TIP
    clock: float = 1.0  # seconds that the file has for each


SETTINGS = [
    Setting("degrees in the file", "degrees", lambda q, i: np.degrees(q)),
    Setting("--degrees for radians", "degrees", options=("--degrees",)),
    Setting("one joint in degrees", "degrees", lambda q, i: q * [1, 1, 1, 1, 1, 57.29578]),
    Setting("the base as the frame", "zero-features", frame="base_link"),
    Setting("another arm", "missing-joint", robot="sawyer", frame="right_hand"),
    Setting("nothing", "right"),
    Setting("a clock ten times too slow", "stamps in another unit", clock=10.0),
    Setting("order, joints 1 and 3", "told", ordered(2, 1, 0, 3, 4, 5)),
    Setting("order, joints 2 and 3", "told", ordered(0, 2, 1, 3, 4, 5)),
    Setting("order, the last two", "weak-gap", ordered(0, 1, 2, 3, 5, 4)),
    Setting("order, reversed", "weak-gap", ordered(5, 4, 3, 2, 1, 0)),
    Setting("order, in half of the files", "told", ordered(0, 1, 2, 3, 5, 4, until=3)),
    Setting("a link of the wrist as the frame", "weak-gap", frame="wrist_1_link"),
    Setting("the flange as the frame, held firmly", "right", frame="wrist_3_link"),
    Setting("a UR5 for a UR5e", "told", robot="ur5"),
    Setting("a UR10e for a UR5e", "told", robot="ur10e"),
    Setting("joint 1 mirrored", "told", mirrored(0)),
    Setting("joint 2 mirrored", "weak-gap", mirrored(1)),
    Setting("the last joint mirrored", "right", mirrored(5)),
    Setting("zero of joint 1 off by 90 degrees", "the first joint's zero", moved(0, np.pi / 2)),
    Setting("zero of joint 2 off by 90 degrees", "told", moved(1, np.pi / 2)),
    Setting("zero of joint 4 off by 5 degrees", "told", moved(3, np.radians(5.0))),
    Setting("the base turned between two days", "told", moved(0, 0.5, 3)),
]


def outcome(setting: Setting, folder: Path, capsys: Any) -> tuple[str, str]:
    """The code of a refusal, or `right`, `told` or `silent`; and what the command said."""
    truth, demos = generated("drawer", ROBOT, SEED, 6)
    header = ",".join(["time", *arm(ROBOT).joint_names])
    for i, demo in enumerate(demos):
        table = np.column_stack([setting.clock * demo.time, setting.change(np.array(demo.q), i)])
        np.savetxt(folder / f"demo_{i}.csv", table, delimiter=",", header=header, comments="")
    code = main(["learn", setting.robot, str(folder), "--frame", setting.frame, *setting.options, "--json"])
    answer = json.loads(capsys.readouterr().out)
    if code:
        assert code == 2
        return answer["error"]["code"], answer["error"]["message"]
    true, found = true_rows(truth), np.array(answer["selection"])
    same = found.shape == true.shape
    off = np.degrees(np.arccos(np.clip(np.linalg.svd(found @ true.T)[1].min(), 0.0, 1.0))) if same else np.inf
    if off < 0.2 and len(answer["constraints"]) == 1 and not answer["warnings"]:
        return "right", str(answer)
    told = answer["warnings"] or answer["odd_trajectories"] or (answer["uncertainty_deg"] or 90.0) > 0.5
    return "told" if told else "silent", str(answer)


@pytest.mark.parametrize(
    "setting", [pytest.param(s, marks=[pytest.mark.slow] * (k > 4), id=s.name) for k, s in enumerate(SETTINGS)]
)
def test_a_wrong_setting(setting, tmp_path, capsys):
    """Units, frame and arm are refused before anything is learnt; order, variant of the arm, mirrored joints, zeros,
    two set-ups: the answer says so, or the documentation does.
    """
    seen, said = outcome(setting, tmp_path, capsys)
    if " " in setting.wanted:
        assert setting.wanted in DOCUMENTED and seen in ("right", "silent"), f"{setting.name}: {seen}: {said}"
    else:
        assert seen == setting.wanted, f"{setting.name}: {said}"
