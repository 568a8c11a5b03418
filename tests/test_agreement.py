"""Trajectories that do not belong are named, and those that do are not."""

from __future__ import annotations

import numpy as np
import pytest
from test_phases import recordings, true_rows

from manip_learn.learning.agreement.agreement import judge_agreement
from manip_learn.linalg import row_space_angle
from manip_learn.recordings.trajectory import Trajectory


@pytest.mark.parametrize("kind", ["drawer", "table", "door"])
def test_trajectories_of_one_task_agree(kind: str):
    """No false alarm where all hold the same rows."""
    features, trajectories, truth = recordings(kind, "xarm7", 2021, 8, whole=False)
    agreement = judge_agreement(features, trajectories)
    assert agreement.unanimous
    assert agreement.members == tuple(range(8))
    assert np.degrees(row_space_angle(agreement.selection, true_rows(truth, 0))) < 0.2


@pytest.mark.parametrize("seed", [2021, 2022])
@pytest.mark.parametrize("kind", ["drawer_other_direction", "drawer_slip"])
def test_odd_ones_are_named_with_numbers_and_units(kind: str, seed: int):
    """Another drawer, or a grip that slips: exactly these trajectories, with the reason, and both rows are kept."""
    features, trajectories, truth = recordings(kind, "panda", seed, 8, whole=False)
    agreement = judge_agreement(features, trajectories)
    assert [i for i, _ in agreement.odd] == truth["contaminated"]
    for i, reason in agreement.odd:
        assert trajectories[i].name in reason
        assert " mm along " in reason
    assert np.degrees(row_space_angle(agreement.selection, true_rows(truth, 0))) < 0.2


def test_two_tasks_are_two_constraints():
    """Four of one drawer and four of another: a pooled fit would keep the one row that both share."""
    features, first, truth = recordings("drawer", "panda", 2023, 4, whole=False)
    _, second, other = recordings("drawer", "panda", 2024, 4, whole=False)
    agreement = judge_agreement(features, [*first, *second])
    assert len(agreement.odd) == 4
    (rows, members) = agreement.others[0]
    found = {agreement.members: agreement.selection, members: rows}
    for expected, t in (((0, 1, 2, 3), truth), ((4, 5, 6, 7), other)):
        assert np.degrees(row_space_angle(found[expected], true_rows(t, 0))) < 0.2


def test_noise_that_differs_among_recordings_is_not_odd():
    """A recording from a noisier encoder obeys the constraint as well as its noise allows."""
    features, trajectories, _ = recordings("drawer", "panda", 2023, 4, whole=False)
    rng = np.random.default_rng(3)
    noisy = [
        Trajectory(t.time, t.q, np.asarray(t.u) + sigma * rng.normal(size=t.q.shape), t.joint_names, t.name)
        for t, sigma in zip(trajectories, (0.0, 0.003, 0.01, 0.001), strict=True)
    ]
    assert judge_agreement(features, noisy).unanimous
