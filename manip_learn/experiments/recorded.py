"""Uncut recordings and mechanisms: the shipped physics recordings, learnt from whole, compared with their truth.

Each trial leaves one recording out, another one each time.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, final

import numpy as np

from manip_learn.constraint.features.frame_jacobian import FrameJacobian
from manip_learn.errors import NotIdentifiableError
from manip_learn.experiments.charts import Panel, strips
from manip_learn.experiments.experiment_result import (
    TrialsResult,
    markdown_table,
    median_and_worst,
    number,
    percent,
    share,
    summary,
)
from manip_learn.experiments.sawyer import recordings_folder
from manip_learn.experiments.trial_runner import of_trials
from manip_learn.learning.learner import ConstraintLearner
from manip_learn.linalg import row_space_angle
from manip_learn.recordings.demonstrations import Demonstrations
from manip_learn.recordings.load_demonstrations import load_demonstrations
from manip_learn.robot.loading import load_robot

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# types of the truth files -> types of the learner
TYPES = {"slide": "line", "plane": "plane", "hinge": "hinge"}


@final
@dataclass(frozen=True)
class RecordedCase:
    """A folder of recordings.

    Attributes:
        said: What it is.
        folder: Under examples/data.
        robot: Name of the robot.
        frame: That was guided.
        locked: Joints that were not recorded.
    """

    said: str
    folder: str
    robot: str
    frame: str
    locked: tuple[str, ...] = ()


FINGERS = ("panda_finger_joint1", "panda_finger_joint2")
CASES = (
    RecordedCase("a drawer, uncut", "panda_drawer_whole", "panda", "panda_hand_tcp", FINGERS),
    RecordedCase("a drawer, then a table, uncut", "xarm7_drawer_then_table", "xarm7", "link_eef"),
    RecordedCase("a door, loosely held", "ur5_loose_door", "ur5", "tool0"),
    RecordedCase("a drawer, 2 of 8 of another", "panda_drawer_mixed", "panda", "panda_hand_tcp", FINGERS),
)


def recorded_trial(case: RecordedCase, rng: np.random.Generator) -> dict[str, Any]:
    """Learn from all recordings but one.

    Returns:
        `types_right`, whether every mechanism is found with its type; `axis_deg`, the largest angle of their axes or
        normals to the truth; `stated_deg` and `inside`, the stated 68 % angle of that axis and whether it holds the
        truth; `overlap`, true and answered time of contact together over either; `odd_right`, whether the odd
        recordings are named and no others; or `refused`.
    """
    folder = recordings_folder(case.folder)
    truth = json.loads((folder / "truth.json").read_text(encoding="utf-8"))
    robot = load_robot(case.robot, locked=case.locked)
    every = load_demonstrations(sorted(folder.glob("*.csv")), robot)
    left_out = int(rng.integers(len(every)))
    kept = [i for i in range(len(every)) if i != left_out]
    demos = Demonstrations(every[i] for i in kept)
    try:
        learner = ConstraintLearner(FrameJacobian(robot, case.frame, "xyz"), seed=int(rng.integers(2**31))).fit(demos)
    except NotIdentifiableError as error:
        return {"refused": error.code}
    odd = {every[i].name for i in kept if i in truth["contaminated"]}
    report = learner.report_
    windows = {every[i].name: truth["windows"][i] for i in kept if i not in truth["contaminated"]}
    spans = {
        name: [(p.start, p.end) for p in report.phases if p.trajectory == name and p.constraint is not None]
        for name in windows
    }
    return _axes_found(learner, truth) | {
        "overlap": overlap({name: [(a, b) for a, b, _ in w] for name, w in windows.items()}, spans),
        "odd_right": {o.trajectory for o in report.odd_trajectories} == odd,
    }


def _axes_found(learner: ConstraintLearner, truth: dict[str, Any]) -> dict[str, Any]:
    nearest = []
    wanted = truth["mechanisms"][: 1 if truth["contaminated"] else None]
    for mechanism in wanted:
        true = np.array([mechanism["axis"]])
        nearest += sorted(
            (float(np.degrees(row_space_angle(true, one.axis[None]))), one.uncertainty.get("axis"))
            for one in (report.mechanism for report in learner.reports_)
            if one is not None and one.type == TYPES[mechanism["type"]] and one.axis is not None
        )[:1]
    angle, stated = max(nearest, default=(None, None))
    return {
        "types_right": len(nearest) == len(wanted),
        "axis_deg": angle,
        "stated_deg": stated,
        "inside": None if stated is None else angle <= stated,
    }


def overlap(true: Mapping[str, list[tuple[float, float]]], found: Mapping[str, list[tuple[float, float]]]) -> float:
    """Time in both over time in either, of all recordings together; spans of one recording do not overlap."""
    both = either = 0.0
    for name, spans in true.items():
        shared = sum(max(0.0, min(b, d) - max(a, c)) for a, b in spans for c, d in found[name])
        both += shared
        either += sum(b - a for a, b in spans) + sum(d - c for c, d in found[name]) - shared
    return both / either


@final
class RecordedResult(TrialsResult):
    """Outcome of every trial, see `recorded_trial`."""

    def to_dict(self) -> dict[str, Any]:
        """Ours; the paper has cut recordings of one known task."""
        ours = {
            said: {what: summary(t.get(what) for t in trials) for what in ("axis_deg", "stated_deg", "overlap")}
            | {
                "inside": share(t["inside"] for t in trials if t.get("inside") is not None),
                **{what: share(t.get(what, False) for t in trials) for what in ("types_right", "odd_right")},
                "refused": share("refused" in t for t in trials),
                "trials": len(trials),
            }
            for said, trials in self.outcomes.items()
        }
        return {"paper": None, "ours": ours}

    def markdown(self) -> str:
        """One line a folder."""
        lines = []
        for said, block in self.to_dict()["ours"].items():
            inside = "-" if block["inside"] is None else f"{percent(block['inside'])} of {block['trials']}"
            lines.append([said, percent(block["types_right"]), median_and_worst(block["axis_deg"])])
            lines[-1] += [number(block["stated_deg"]["median"]), inside]
            lines[-1] += [number(block["overlap"]["median"]), percent(block["odd_right"])]
        header = ["recordings", "mechanisms found", "axis or normal [deg], median (worst)", "stated 68 % [deg]"]
        header += ["truth inside", "contact, overlap in time", "odd ones named, no others"]
        return markdown_table(header, lines)

    def figures(self) -> dict[str, Figure]:
        """Angles of all trials."""
        angles = {
            said: [t["axis_deg"] for t in trials if t.get("axis_deg") is not None]
            for said, trials in self.outcomes.items()
        }
        panel = Panel(angles, "angle of axis or normal [deg],\nlearnt as shipped")
        return {"recorded": strips([[panel]], "recordings; a dot is a trial, a bar the median", 7.0, 4.2)}


RECORDED = of_trials("recorded", recorded_trial, {case.said: case for case in CASES}, RecordedResult, 0.1)
