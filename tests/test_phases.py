"""Whole recordings are divided where the contact begins and ends, and free motion yields no constraint."""

from __future__ import annotations

import importlib
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from manip_learn.constraint.features import FrameJacobian
from manip_learn.learning.phases.find_phases import find_phases, one_constraint_fits
from manip_learn.learning.phases.motion import PhaseMotion, broken_energy
from manip_learn.learning.phases.result import PhaseResult, Stretch
from manip_learn.learning.phases.segmentation import HeldScale, best_states, evidence
from manip_learn.linalg import complement_rows, row_space_angle
from manip_learn.recordings.trajectory import Trajectory
from manip_learn.recordings.velocities import derive_velocities
from manip_learn.robot.loading import load_robot

EXAMPLES = Path(__file__).resolve().parents[1] / "examples"
LOCKED = {"panda": ("panda_finger_joint1", "panda_finger_joint2")}
MOVES = 0.01  # tip slower than this is at rest [m/s]
Recordings = tuple[FrameJacobian, list[Trajectory], dict[str, Any]]


@cache
def recordings(kind: str, robot: str, seed: int, n: int, whole: bool = True) -> Recordings:
    """Generated recordings, with velocities, and their truth."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(EXAMPLES))
        make_set = importlib.import_module("make_recordings.kinematic_sets").make_set
        motions, truth = make_set(kind, robot, seed, n, whole=whole)
    arm = load_robot(robot, locked=LOCKED.get(robot, ()))
    made = [
        derive_velocities(Trajectory(t, q, None, arm.joint_names, f"demo_{i + 1:02d}"), arm)
        for i, (t, q) in enumerate(motions)
    ]
    return FrameJacobian(arm, truth["tip"], "xyz"), made, truth


def true_rows(truth: dict[str, Any], mechanism: int) -> np.ndarray:
    """Translational rows that a mechanism holds."""
    rows = np.array(truth["mechanisms"][mechanism]["rows"])[:, :3]
    return rows[np.linalg.norm(rows, axis=1) > 0.5]


def shares(made: Recordings, mechanism: int, stretches: tuple[Stretch, ...]) -> tuple[float, float, float]:
    """Share of a contact's motion that was found, share of the found motion outside it, median boundary error [s]."""
    features, trajectories, truth = made
    inside = outside = total = 0
    errors = []
    for i, t in enumerate(trajectories):
        speed = np.linalg.norm(np.einsum("npv,nv->np", features.batch(t.q), t.u), axis=1)
        contact, found = np.zeros(len(t), dtype=bool), np.zeros(len(t), dtype=bool)
        for start, end, number in truth["windows"][i]:
            contact |= (t.time >= start) & (t.time <= end) & (number == mechanism)
        for s in stretches:
            found |= (t.time >= s.start) & (t.time <= s.end) & (s.trajectory == i)
        contact, found = contact & (speed > MOVES), found & (speed > MOVES)
        inside, outside = inside + np.sum(contact & found), outside + np.sum(found & ~contact)
        total += np.sum(contact)
        if np.any(found):
            ends = t.time[contact][[0, -1]], t.time[found][[0, -1]]
            errors += list(np.abs(ends[0] - ends[1]))
    return inside / total, outside / max(inside + outside, 1), float(np.median(errors))


def searched(made: Recordings) -> PhaseResult:
    return find_phases(made[0], made[1], np.random.default_rng(0))


@pytest.mark.parametrize(("kind", "robot"), [("drawer", "panda"), ("table", "ur5"), ("drawer_then_table", "xarm7")])
def test_contacts_are_found_with_their_rows_and_boundaries(kind: str, robot: str):
    """Every contact of a recording: its rows within 0.1 degrees, 95 % of its motion, at most 3 % of other motion."""
    made = recordings(kind, robot, 2011, 5)
    result = searched(made)
    assert len(result.constraints) == len(made[2]["mechanisms"])
    for mechanism in range(len(made[2]["mechanisms"])):
        angles = [np.degrees(row_space_angle(c.selection, true_rows(made[2], mechanism))) for c in result.constraints]
        best = result.constraints[int(np.argmin(angles))]
        assert min(angles) < 0.1
        found, outside, boundary = shares(made, mechanism, best.stretches)
        assert found > 0.95
        assert outside < 0.03
        assert boundary <= 0.1
        assert best.trajectories == tuple(range(5))


@pytest.mark.parametrize("kind", ["free", "free_repeated", "free_slow", "free_sticking"])
def test_free_motion_yields_no_constraint(kind: str):
    """Nothing is held, so nothing is found; all that moves is free motion."""
    result = searched(recordings(kind, "panda", 2012, 5))
    assert result.constraints == ()
    assert {s.trajectory for s in result.free} == set(range(5))


def test_a_contact_in_one_recording_only_is_not_learnt():
    """What no other recording supports is no constraint."""
    features, held, _ = recordings("drawer", "panda", 2013, 4)
    _, free, _ = recordings("free", "panda", 2013, 4)
    result = find_phases(features, [held[0], *free], np.random.default_rng(0))
    assert result.constraints == ()


def test_times_are_those_of_each_recordings_own_clock():
    """A recording whose clock starts later has its stretches as much later, and nothing else changes."""
    features, trajectories, _ = recordings("drawer", "panda", 2011, 5)
    late = Trajectory(trajectories[1].time + 1000.0, trajectories[1].q, trajectories[1].u, trajectories[1].joint_names)
    before = searched((features, trajectories, {})).constraints[0]
    after = searched((features, [trajectories[0], late, *trajectories[2:]], {})).constraints[0]
    # a clock that is a thousand seconds on has three digits less for the steps between the samples
    assert row_space_angle(before.selection, after.selection) < 1e-5
    for a, b in zip(before.stretches, after.stretches, strict=True):
        shift = 1000.0 if a.trajectory == 1 else 0.0
        assert (b.trajectory, b.start, b.end) == pytest.approx((a.trajectory, a.start + shift, a.end + shift))


def test_phases_of_a_recording_do_not_overlap():
    """Held, free and still stretches follow one another."""
    result = searched(recordings("drawer_then_table", "xarm7", 2011, 5))
    held = [s for c in result.constraints for s in c.stretches]
    spans = [(s.trajectory, s.start, s.end) for s in (*held, *result.free, *result.unsupported, *result.still)]
    for (i, _, end), (j, start, _) in zip(sorted(spans)[:-1], sorted(spans)[1:], strict=True):
        assert i != j or start >= end - 1e-9


@pytest.mark.parametrize("kind", ["drawer", "table"])
def test_the_search_is_asked_for_by_whole_recordings_only(kind: str):
    """Cut recordings that one constraint fits need no search; those with approach and retreat do."""
    features, cut, _ = recordings(kind, "panda", 2011, 5, whole=False)
    assert one_constraint_fits(features, cut)
    features, whole, _ = recordings(kind, "panda", 2011, 5)
    assert not one_constraint_fits(features, whole)


def test_energy_that_breaks_a_hypothesis():
    """It equals |A^+ A u|^2 by singular value decomposition, for one row and for several."""
    features, trajectories, _ = recordings("drawer", "panda", 2011, 5)
    motion = PhaseMotion.collect(features, trajectories[:1])
    rng = np.random.default_rng(5)
    for s in (1, 2):
        rows = np.linalg.qr(rng.normal(size=(3, s)))[0].T
        energy = broken_energy(motion, rows[None])[:, 0]
        for i in (50, 200, 400):
            A = rows @ motion.whitening @ features(trajectories[0].q[i])
            broken = np.linalg.pinv(A) @ A @ trajectories[0].u[i]
            assert energy[i] == pytest.approx(broken @ broken, rel=1e-8)


def test_standstill_says_nothing():
    """Without motion the evidence for and against a constraint is zero."""
    features, trajectories, _ = recordings("drawer", "panda", 2011, 5)
    motion = PhaseMotion.collect(features, trajectories)
    still = motion.chosen(motion.free < motion.noise)
    rows = complement_rows(np.array([[1.0, 0.0, 0.0]]))
    values = evidence(still, broken_energy(still, rows[None]), 2, [HeldScale(2.0, 0.01)])
    assert len(still) > 20
    assert np.max(np.abs(values)) < 1e-9


def test_the_best_sequence_ignores_what_is_shorter_than_a_change_is_worth():
    """Viterbi's algorithm: boundaries to the sample, a brief lapse bridged, a brief coincidence left out."""
    values = np.full((200, 2), -1.0)
    values[40:100, 0] = 1.0
    values[60:63, 0] = -1.0  # lapse
    values[100:160, 1] = 1.0
    values[180:184, 1] = 1.0  # coincidence
    states = best_states(values, np.array([0, 200]), switch=10.0)
    expected = np.zeros(200, dtype=int)
    expected[40:100], expected[100:160] = 1, 2
    assert np.array_equal(states, expected)
    alone = best_states(values[:, :1], np.array([0, 200]), switch=10.0)
    assert np.array_equal(alone, np.where(expected == 1, 1, 0))
