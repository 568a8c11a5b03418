"""Where an answer comes from can be read off everything that is made of it."""

from __future__ import annotations

import hashlib
import re
from datetime import UTC, datetime, timedelta

import numpy as np
import pytest
from task_sets import DATA
from test_playback import data_in

import manip_learn as ml
from manip_learn.learning.report import version

FILES = sorted((DATA / "sawyer_drawer").glob("*.csv"))[:3]


@pytest.fixture(scope="module")
def learner() -> ml.ConstraintLearner:
    """The drawer, learnt from three files with settings of its own."""
    features = ml.FrameJacobian(ml.load_robot("sawyer"), "right_gripper_tip")
    learner = ml.ConstraintLearner(features, joint_offset_std=0.2, seed=np.int64(4))  # type: ignore[arg-type]
    return learner.fit(ml.load_demonstrations(FILES, features.robot))


def test_a_constraint_says_what_made_it(learner, tmp_path):
    """A constraint file keeps the version, the date, the SHA-256 of each recording and the settings."""
    loaded = ml.Constraint.load(learner.skill_.save(tmp_path / "task.json"), learner.constraint_.robot)
    made = loaded.provenance["made"]
    digests = {file.name: hashlib.sha256(file.read_bytes()).hexdigest() for file in FILES}
    assert {entry["name"]: entry["sha256"] for entry in made["recordings"]} == digests
    assert timedelta(0) <= datetime.now(UTC) - datetime.fromisoformat(made["date"]) < timedelta(hours=1)
    assert made["version"].startswith(version()) and re.match(r"\d+\.\d+\.\d+", made["version"])
    assert made["settings"]["joint_offset_std"] == 0.2 and made["settings"]["seed"] == 4
    assert made["settings"]["estimator"] == "auto" and "features" not in made["settings"]


def test_what_is_made_of_it_carries_it(learner, tmp_path):
    """A rollout, a plan and a replay page carry the provenance of their constraint."""
    constraint = learner.constraint_
    made, start = constraint.provenance["made"], constraint.provenance["postures"][0]
    task = ml.motion(constraint)
    run = ml.simulate(constraint.robot, ml.ResolvedRateController(constraint, task), start, duration=0.05)
    kept = ml.Rollout.load(run.save(tmp_path / "run.npz"))
    for rollout in (kept, ml.plan(constraint, task, start, seed=0).rollout):
        assert rollout.constraint is not None and rollout.constraint["provenance"]["made"] == made
    ml.replay(constraint.robot, {"run": kept}, tmp_path / "run.html", open_browser=False)
    assert data_in(tmp_path / "run.html")["made"] == made
