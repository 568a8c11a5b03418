"""Whole recordings are divided where a contact begins and ends, those that disagree are told apart, and free motion
explains itself.
"""

from __future__ import annotations

import dataclasses
import itertools
import tracemalloc
from typing import Any

import numpy as np
import pytest
from task_sets import learnt, true_rows
from task_sets import moving as recordings

import manip_learn as ml
from manip_learn.constraint.features import FrameJacobian
from manip_learn.learning.explanation import explain
from manip_learn.learning.explanation.evidence import (
    HeldScale,
    Stretch,
    evidence,
    gains_of,
    held_by,
    sharpened,
    states_of,
)
from manip_learn.learning.explanation.explain import distinct
from manip_learn.learning.explanation.findings import Findings, Part, agreeing, find
from manip_learn.learning.explanation.row_motion import RowMotion, broken_energy, views_of
from manip_learn.linalg import complement_rows, row_space_angle
from manip_learn.recordings.trajectory import Demonstrations, Trajectory
from manip_learn.recordings.velocities import derive_velocities

Recordings = tuple[FrameJacobian, list[Trajectory], dict[str, Any]]


def found(made: Recordings, **options: Any) -> Findings:
    features, trajectories, _ = made
    return find(Part.of_all(Demonstrations(trajectories), [features]), np.random.default_rng(0), **options)


def test_a_cut_recording_is_one_stretch():
    """Recordings that hold nothing but the contact: one part, every recording as a whole, none of them odd."""
    made = recordings("door", "xarm7", 2021, 8, whole=False)
    result = found(made)
    assert len(result.parts) == 1 and not result.odd and not result.free
    spans = [(s.trajectory, s.start, s.end) for s in result.parts[0].stretches]
    assert spans == [(i, t.time[0], t.time[-1]) for i, t in enumerate(made[1])]


@pytest.mark.parametrize(("kind", "seed"), [("drawer_other_direction", 2021), ("drawer_slip", 2022)])
def test_odd_ones_are_named_with_numbers_and_units(kind: str, seed: int):
    """Another drawer, or a grip that slips: exactly these recordings, with the reason, and both rows are kept."""
    made = recordings(kind, "panda", seed, 8, whole=False)
    result = found(made)
    told = {i for i, _ in result.odd} | {s.trajectory for part in result.parts[1:] for s in part.stretches}
    assert sorted(told) == made[2]["contaminated"]
    for i, reason in result.odd:
        assert made[1][i].name in reason
        assert " mm along " in reason
    assert np.degrees(row_space_angle(result.parts[0].found, true_rows(made[2], 0))) < 0.2


@pytest.mark.parametrize(("kind", "degrees"), [("table", 2.0), ("drawer", 20.0)])
def test_two_that_nearly_coincide_are_told_apart(kind: str, degrees: float):
    """Four recordings of one table or drawer and four of another, some degrees apart: each has its own rows."""
    features, first, truth = recordings(kind, "panda", 2023, 8, whole=False)
    _, second, other = recordings(kind, "panda", 2023, 8, whole=False, tilt=degrees)
    result = found((features, [*first[:4], *second[4:]], {}))
    members = [sorted(s.trajectory for s in part.stretches) for part in result.parts]
    assert sorted(members) == [[0, 1, 2, 3], [4, 5, 6, 7]]
    for part, numbers in zip(result.parts, members, strict=True):
        assert np.degrees(row_space_angle(part.found, true_rows(truth if 0 in numbers else other, 0))) < 0.1


def test_one_is_not_divided():
    """Sixteen recordings of one table with bad encoders are one constraint."""
    features, trajectories, _ = recordings("table", "ur5", 2024, 16, whole=False)
    rng = np.random.default_rng(1)
    noisy = [
        derive_velocities(
            Trajectory(t.time, t.q + rng.normal(0.0, 3e-3, t.q.shape), None, t.joint_names), features.robot
        )
        for t in trajectories
    ]
    assert len(found((features, noisy, {})).parts) == 1


@pytest.mark.slow
def test_memory_grows_with_the_samples_alone():
    """Three times as many whole recordings need at most three times as much: 4.7 times where each contact that one
    recording alone may show is weighed on the samples of all.
    """
    features, trajectories, _ = recordings("drawer", "panda", 2021, 24)
    peaks = []
    for n in (8, 24):
        tracemalloc.start()
        found((features, trajectories[:n], {}))
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert peaks[1] < 3.0 * peaks[0], peaks


def test_a_stretch_that_slips_is_odd():
    """It has left the rows that the others hold still, wherever in it."""
    features = ml.CustomFeatures(lambda q: np.eye(2), ("x", "y"), 2)
    time = np.linspace(0.0, 2.0, 201)

    def moved(height: np.ndarray) -> Trajectory:
        q = np.column_stack([0.01 * np.sin(time), height])
        return Trajectory(time, q, np.gradient(q, time, axis=0))

    members = [moved(1e-5 * np.sin(9.0 * time + k)) for k in range(4)]
    slipping = moved(0.02 / (1.0 + np.exp(-(time - 1.8) / 0.01)))
    motion = RowMotion.collect(features, [*members, slipping])
    rows = np.linalg.qr(motion.whitening @ np.array([[0.0], [1.0]]))[0].T
    agrees = agreeing(motion, rows, [Stretch(i, 0.0, 2.0) for i in range(5)])
    assert agrees.tolist() == [True] * 4 + [False]


def test_a_tether_is_learnt_from_whole_recordings():
    """Type, centre and radius within 0.5 mm, one row; the sphere is so large that parts of it pass for a soft plane."""
    _, made, truth = recordings("tether", "xarm7", 3005, 8)
    learner = learnt("xarm7", truth["tip"], made)
    report, true = learner.report_, truth["mechanisms"][0]
    assert report.mechanism is not None
    assert report.mechanism.type == "ball"
    assert report.mechanism.point == pytest.approx(np.array(true["point"]), abs=5e-4)
    assert report.mechanism.radius == pytest.approx(true["radius"], abs=5e-4)
    assert learner.constraint_.n_constraints == 1


def test_an_orientation_that_is_held_softly_is_learnt_with_its_axis():
    """A glass that sways by a degree: its two rows, about the vertical within three stated standard deviations."""
    features, made, truth = recordings("glass", "sawyer", 33003, 6, whole=False)
    arm = features.robot
    learner = learnt("sawyer", truth["tip"], made, axes="rotation")
    mechanism = learner.report_.mechanism
    assert mechanism is not None
    assert mechanism.type == "held-orientation"
    assert mechanism.axis is not None
    tilt = np.degrees(np.arccos(min(1.0, abs(mechanism.axis[2]))))
    assert tilt < min(3.0 * mechanism.uncertainty["axis"], 6.0)
    A = learner.constraint_(made[0].q[100])
    assert A.shape == (2, arm.nv)
    turning = np.linalg.pinv(FrameJacobian(arm, truth["tip"], "rotation")(made[0].q[100])) @ mechanism.axis
    np.testing.assert_allclose(A @ turning, 0.0, atol=1e-9)


def flat_motion(*heights, seconds: float = 4.0, pause: tuple[float, float] = (9.0, 9.0)) -> RowMotion:
    """Recordings at 100 Hz that move at 1 m/s along x, but for a pause, and are at a height of time along y."""
    time = np.arange(0.0, seconds + 0.005, 0.01)
    features, out = ml.CustomFeatures(lambda q: np.eye(2), ("x", "y"), 2), []
    for height in heights:
        u = np.column_stack([(time < pause[0]) | (time > pause[1]), np.gradient(height(time), time)])
        out.append(Trajectory(time, np.cumsum(0.01 * u, axis=0), u))
    return RowMotion.collect(features, out)


def still(time: np.ndarray) -> np.ndarray:
    return 1e-4 * np.sin(9.0 * time)


def test_ends_that_have_left_the_rows_are_cut_off():
    """A hand that leaves a surface at a flat angle: the contact ends where the way does, not at a recording's end."""

    def leaving(at: float):
        return lambda time: still(time) + 0.05 * np.maximum(time - at, 0.0)

    def entering(time: np.ndarray) -> np.ndarray:
        return still(time) + 0.05 * np.maximum(1.15 - time, 0.0)

    motion, row = flat_motion(leaving(2.85), leaving(3.85), entering, leaving(1.85)), np.eye(2)[1:]
    given = [Stretch(0, 1.0, 3.0), Stretch(1, 1.0, 4.0), Stretch(2, 1.0, 3.0), Stretch(3, 1.0, 2.0)]
    found = sharpened(motion, row, given)
    assert found[0].start == 1.0 and 2.83 < found[0].end < 2.89
    assert found[1] == given[1] and found[3] == given[3]  # a recording's end; too short to tell
    assert 1.11 < found[2].start < 1.17 and found[2].end == 3.0


def test_evidence_is_the_ratio_of_two_normal_densities():
    """Of each sample, s rows of variance (steady sigma)^2 + share^2 f against rows of variance f, two in a hundred far
    off, a tenth of a second counting as one; at most the density that a standstill has.
    """
    motion = flat_motion(still, still)
    energy = np.abs(np.random.default_rng(1).standard_normal((len(motion), 2))) * 1e-4
    motion = dataclasses.replace(motion, noise=np.full(len(motion), 1e-6))
    scales = [HeldScale(3.0, 0.01), HeldScale(1.0, 0.1)]
    found = evidence(motion, energy, 2, scales)
    for (i, h, k), value in np.ndenumerate(found[::97]):
        i, f = 97 * i, motion.free[97 * i]
        held = scales[k].steady ** 2 * 1e-6 + scales[k].share ** 2 * f
        ratio = (f / held) ** (2 / 2) * np.exp(-0.5 * energy[i, h] * (1.0 / held - 1.0 / f))
        assert value == pytest.approx(np.log(0.02 + 0.98 * ratio) * motion.weight[i] / 0.1, rel=1e-9)


def test_standstill_says_nothing():
    """Without motion the evidence for and against a constraint is zero."""
    features, trajectories, _ = recordings("drawer", "panda", 2011, 5)
    motion = RowMotion.collect(features, trajectories)
    still = motion.chosen(motion.free < motion.noise)
    rows = complement_rows(np.array([[1.0, 0.0, 0.0]]))
    values = evidence(still, broken_energy(still, rows[None]), 2, [HeldScale(2.0, 0.01)])[:, :, 0]
    assert len(still) > 20
    assert np.max(np.abs(values)) < 1e-9


def test_noise_of_the_velocities_is_no_drift():
    """A recording whose velocities are noisier goes as far along the held rows as their noise takes it, and no farther:
    it agrees; one that goes as far without noise does not.
    """
    rng = np.random.default_rng(0)
    noisy = 0.02 * np.cumsum(rng.standard_normal(401)) * 0.01
    motion, row = flat_motion(still, still, still, still, lambda time: noisy), np.eye(2)[1:]
    spans = [Stretch(i, 0.0, 4.0) for i in range(5)]
    short = dataclasses.replace(motion, rates=motion.rates * [0.02, 1.0])  # beside a short way
    assert agreeing(short, row, spans).tolist() == [True] * 5
    smooth = np.interp(np.arange(401), [0, 400], [0.0, np.ptp(noisy)])
    drift = flat_motion(still, still, still, still, lambda time: smooth)
    drift = dataclasses.replace(drift, rates=drift.rates * [0.02, 1.0])
    assert agreeing(drift, row, spans).tolist() == [True] * 4 + [False]


def test_no_sequence_of_states_is_better(rng: np.random.Generator) -> None:
    """Against all sequences of seven samples: the gains are those of the best one, and the states give them. Into or
    out of a contact costs half a change, also at the ends; a single state throughout costs nothing.
    """
    n, switch = 7, 1.6
    first = np.array([0, n])

    def worth(sequence: tuple[int, ...], values: np.ndarray) -> float:
        gain = sum(values[i, state - 1] for i, state in enumerate(sequence) if state)
        if len(set(sequence)) == 1:
            return float(gain)
        borders = sum((a > 0) + (b > 0) for a, b in itertools.pairwise((0, *sequence, 0)) if a != b)
        return float(gain - 0.5 * switch * borders)

    for k, seed in itertools.product((1, 2), range(4)):
        values = np.random.default_rng(seed).normal(0.0, 1.0, (n, k))
        best = max(worth(each, values) for each in itertools.product(range(k + 1), repeat=n))
        assert worth(tuple(states_of(values, first, switch).tolist()), values) == pytest.approx(best)
        for i in range(k):
            alone = values[:, [i]]
            top = max(worth(each, alone) for each in itertools.product((0, 1), repeat=n))
            assert gains_of(alone, first, switch)[0, 0] == pytest.approx(top)
            assert worth(tuple(held_by(alone, first, switch)[:, 0].astype(int).tolist()), alone) == pytest.approx(top)
    two = np.concatenate([rng.normal(size=(5, 1)), rng.normal(size=(7, 1))])  # of two lengths: each as if alone
    apart = [held_by(part, np.array([0, len(part)]), switch) for part in (two[:5], two[5:])]
    np.testing.assert_array_equal(held_by(two, np.array([0, 5, 12]), switch), np.concatenate(apart))


def test_alike_rows_are_told_apart_in_as_many_steps_as_there_are_rows():
    """Rows of no length, which are apart from themselves, as well."""
    assert distinct(np.zeros((4, 1, 3))) == [0, 1, 2, 3]
    assert distinct(np.eye(3)[[0, 1, 0, 2, 1]][:, None, :]) == [0, 1, 3]


def test_hypotheses_that_replace_each_other_come_to_an_end(monkeypatch):
    """Where each new one leaves the old ones idle and none counts as refused, the search gives up in the end."""
    turns = []
    monkeypatch.setattr(explain, "_similar", lambda *_: False)
    monkeypatch.setattr(explain.Explanation, "supports", property(lambda now: np.full(len(now.hypotheses), 1e3)))

    def replaced(now, hypothesis):
        turns.append(hypothesis)
        return explain.Explanation(now.views, (hypothesis,), now.switch)

    monkeypatch.setattr(explain.Explanation, "with_one_more", replaced)
    features, trajectories, _ = recordings("drawer", "panda", 2021, 3, whole=False)
    views = views_of([features], trajectories)
    now = explain.explain(views, lambda *_: True)
    assert len(now.hypotheses) == 1 and len(turns) <= explain.MOST_CONSTRAINTS * explain.MOST_TESTED
