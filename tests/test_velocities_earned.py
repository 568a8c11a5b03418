"""Velocities and times that contradict the positions: what is learnt is as good as from positions and even times."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from case import case
from generated_motions import angle_deg, arm_features, guided_motions, oblique, planar_features

import manip_learn as ml
from manip_learn.errors import NotIdentifiableError, RecordingError
from manip_learn.recordings.given import recordings_given

DT, SAMPLES = 0.01, 300  # [s]
NOISE = 1e-4  # [rad] of the encoders
JOINT = 1  # whose velocity is at fault where one is
SEED = 7

Velocity = Callable[[Any, np.ndarray, np.ndarray, np.random.Generator], np.ndarray]
Stamps = Callable[[np.ndarray, np.random.Generator], np.ndarray]


def of_one(change: Velocity) -> Velocity:
    """The fault at one joint only."""

    def changed(u: np.ndarray, q: np.ndarray, t: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        u = u.copy()
        u[:, JOINT] = change(u, q, t, rng)[:, JOINT]
        return u

    return changed


def late(seconds: float) -> Velocity:
    return lambda u, q, t, rng: np.column_stack([np.interp(t - seconds, t, column) for column in u.T])


def filtered(seconds: float) -> Velocity:
    def changed(u: np.ndarray, q: np.ndarray, t: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        out = u.copy()
        for k in range(1, len(u)):
            out[k] = out[k - 1] + (t[k] - t[k - 1]) / seconds * (u[k] - out[k - 1])
        return out

    return changed


def missing(share: float) -> Velocity:
    return lambda u, q, t, rng: np.where(rng.random(u.shape) < share, np.nan, u)


def rolled(u: np.ndarray, q: np.ndarray, t: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    return np.roll(u, 1, axis=1)


# what is recorded in place of the velocity, and whether one joint alone is at fault
VELOCITIES: dict[str, Velocity] = {
    "not a number": missing(2.0),
    "of one joint not a number": of_one(missing(2.0)),
    "zero": lambda u, q, t, rng: 0.0 * u,
    "of one joint zero": of_one(lambda u, q, t, rng: 0.0 * u),
    "copied from the position": lambda u, q, t, rng: q.copy(),
    "the step and not the rate": lambda u, q, t, rng: u * DT,
    "of one joint in degrees": of_one(lambda u, q, t, rng: np.degrees(u)),
    "in counts": of_one(lambda u, q, t, rng: np.round(u * 4096 / 2 / np.pi)),
    "5 percent too large": of_one(lambda u, q, t, rng: 1.05 * u),
    "of the neighbour": of_one(rolled),
    "clipped": lambda u, q, t, rng: np.clip(u, -0.3, 0.3),
    "of the opposite sign": lambda u, q, t, rng: -u,
    "of one joint of the opposite sign": of_one(lambda u, q, t, rng: -u),
    "of one joint filtered": of_one(filtered(0.1)),
    "late by 30 ms": late(0.03),
    "late by 150 ms": late(0.15),
    "of one joint late": of_one(late(0.08)),
    "0.01 rad/s off": of_one(lambda u, q, t, rng: u - 0.01),
    "drifting": of_one(lambda u, q, t, rng: u + 0.1 * ((t - t[0]) / (t[-1] - t[0]))[:, None]),
    "of one joint noisy": of_one(lambda u, q, t, rng: u + 0.1 * rng.standard_normal(u.shape)),
    "differences of the positions": lambda u, q, t, rng: np.gradient(q, t, axis=0),
    "coarse": lambda u, q, t, rng: np.round(u, 1),
    "held for ten samples": lambda u, q, t, rng: u[np.arange(len(u)) // 10 * 10],
    "one sample wild": lambda u, q, t, rng: u + 50.0 * (np.arange(len(u)) == 150)[:, None],
    "dropped to zero for a while": of_one(lambda u, q, t, rng: u * (np.abs(np.arange(len(u)) - 150) > 20)[:, None]),
}


def bunches(size: int, apart: float = 0.0) -> Stamps:
    """Samples that are stamped when the last of so many has arrived."""

    def changed(t: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        k = np.arange(len(t))
        return t[np.minimum((k // size + 1) * size - 1, len(t) - 1)] + apart * (k % size)

    return changed


def random_bunches(t: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    ends = np.append(np.sort(rng.choice(len(t), len(t) // 8, replace=False)), len(t) - 1)
    return t[ends[np.searchsorted(ends, np.arange(len(t)))]]


def grains(size: float) -> Stamps:
    return lambda t, rng: np.floor(t / size + 1e-9) * size


def stalled(t: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    return np.maximum.accumulate(np.where((np.arange(len(t)) >= 120) & (np.arange(len(t)) < 140), t[140] - 1e-3, t))


def some_late(t: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    out = t.copy()
    out[[40, 90, 91, 200]] += 0.6
    return out


TIMES: dict[str, Stamps] = {
    **{f"bunches of {n}": bunches(n) for n in (2, 5, 30, 100)},
    "bunches of 10, 0.1 ms apart": bunches(10, 1e-4),
    "bunches of many sizes": random_bunches,
    **{f"grains of {size:g} s": grains(size) for size in (0.001, 0.004, 0.1, 1.0)},
    "since 1970 in grains of 0.1 s": lambda t, rng: 1.7e9 + np.floor(t / 0.1 + 1e-9) * 0.1,
    "milliseconds since 1970": lambda t, rng: 1.7e12 + np.round(1e3 * t),
    "stalled once": stalled,
    "single stamps late": some_late,
    "set back by 0.4 s": lambda t, rng: t - 0.4 * (np.arange(len(t)) >= 130),
    "begun again at 0": lambda t, rng: t - t[150] * (np.arange(len(t)) >= 150),
    "set back twice": lambda t, rng: t - 0.5 * (np.arange(len(t)) >= 100) - 1.0 * (np.arange(len(t)) >= 220),
    "past midnight": lambda t, rng: (86399.0 + t) % 86400.0,
}


@cache
def motions(arm: str) -> tuple[ml.FrameJacobian, tuple[ml.Trajectory, ...], ml.Constraint]:
    """Six motions along what is held by one row of a planar arm, or by two of a spatial one, with encoder noise."""
    rng = np.random.default_rng(SEED)
    features = planar_features() if arm == "planar3" else arm_features()
    rows = np.eye(3)[:1] if arm == "planar3" else oblique(2, 3, rng)
    exact, truth = guided_motions(features, rows, rng, 6, SAMPLES, DT)
    noisy = (replace(t, q=t.q + NOISE * rng.standard_normal(t.q.shape)) for t in exact)
    return features, tuple(noisy), truth


def error(features: ml.FrameJacobian, truth: ml.Constraint, given: Any, **options: Any) -> float:
    """Angle between the rows that are learnt and the true ones [degrees]."""
    learner = ml.ConstraintLearner(
        features, n_constraints=truth.n_constraints, phases="off", mechanism="off", **options
    )
    return angle_deg(learner.fit(given).constraint_, truth)


def faulty(arm: str, fault: str) -> list[ml.Trajectory]:
    """Motions with something else for their velocities."""
    rng = np.random.default_rng(SEED + 1)
    return [replace(t, u=VELOCITIES[fault](t.u, t.q, t.time, rng)) for t in motions(arm)[1]]


@pytest.mark.parametrize("fault", VELOCITIES)
def test_velocities_that_contradict_the_positions_are_not_used(fault: str) -> None:
    """The positions alone are left, as they were, and a note names the joint at fault with the figures."""
    arm = ("planar3", "sawyer")[len(fault) % 2]
    features, exact, _ = motions(arm)
    given = recordings_given(faulty(arm, fault), features.robot, features.nv)
    assert isinstance(given, ml.Demonstrations) and 1 <= len(given.notes) <= len(given)
    for one, true in zip(given, exact, strict=True):
        assert one.u is None
        np.testing.assert_array_equal(one.q, true.q)
        np.testing.assert_array_equal(one.time, true.time)
    alone = VELOCITIES[fault].__qualname__.startswith("of_one")
    for note in given.notes:
        assert any(name in note for name in features.robot.joint_names) and "derived from the positions" in note
        assert not alone or f"velocity of {features.robot.joint_names[JOINT]} " in note
        assert " is not a number in " in note or (" apart after " in note and "rad/s off where" in note)


def test_one_recording_at_fault_is_named() -> None:
    """Those of all are derived, and the notes tell the recordings at fault from the others."""
    features, exact, _ = motions("sawyer")
    for fault in ("of one joint zero", "late by 150 ms", "of one joint in degrees", "drifting"):
        with case(fault):
            given = [replace(t, name=f"demo_{i}") for i, t in enumerate(exact)]
            given[4] = replace(faulty("sawyer", fault)[4], name="demo_4")
            read = recordings_given(given, features.robot, features.nv)
            assert isinstance(read, ml.Demonstrations) and all(t.u is None for t in read)
            (one,) = (note for note in read.notes if note.startswith("demo_4: "))
            (others,) = (note for note in read.notes if note != one)
            assert "does not integrate to its position" in one
            assert others.startswith("demo_0 and 4 more: ") and "1 other recording" in others


@pytest.mark.parametrize("fault", TIMES)
def test_times_that_contradict_the_positions_are_spread(fault: str) -> None:
    """Even steps as in truth, which leave the rows that are learnt as they are, and a note says what was done."""
    features, exact, _ = motions(("planar3", "sawyer")[len(fault) % 2])
    rng = np.random.default_rng(SEED)
    read = recordings_given([(TIMES[fault](t.time, rng), t.q) for t in exact], features.robot, features.nv)
    assert isinstance(read, ml.Demonstrations) and len(read) == len(exact)
    told = ("spread", "read as m", "set back", "came late", "out of order")
    assert fault == "grains of 0.001 s" or all(any(word in note for word in told) for note in read.notes) and read.notes
    for one, true in zip(read, exact, strict=True):
        np.testing.assert_array_equal(one.q, true.q)
        steps = np.diff(one.time)
        assert np.ptp(steps) < 1e-3 * np.mean(steps)


def test_where_recorded_velocities_are_better_they_are_used() -> None:
    """Exact ones beside coarse encoders, few digits, noise and few samples are kept, and the answer gains by it."""
    features, exact, truth = motions("sawyer")
    quantum = 2.0 * np.pi / 4096
    rng = np.random.default_rng(SEED)
    for name, (change, step) in {
        "12 bit": (lambda q: np.round(q / quantum) * quantum, 1),
        "noise of 1 mrad": (lambda q: q + 1e-3 * rng.standard_normal(q.shape), 1),
        "33 Hz and 12 bit": (lambda q: np.round(q / quantum) * quantum, 3),
        "12.5 Hz": (lambda q: q, 8),
    }.items():
        with case(name):
            given = [replace(t, q=change(t.q)).part(slice(None, None, step)) for t in exact]
            kept = recordings_given(given, features.robot, features.nv)
            assert isinstance(kept, ml.Demonstrations) and kept.has_velocities and kept.notes == ()
            derived = error(features, truth, given, velocities="derive")
            assert error(features, truth, given) < derived


def test_what_is_asked_for_is_done(tmp_path: Path) -> None:
    """`"derive"` and `"recorded"` overrule the judgement, in files and in memory; the learner keeps what was read."""
    features, exact, truth = motions("planar3")
    wrong = faulty("planar3", "of one joint of the opposite sign")
    for number, t in enumerate(wrong):
        np.savez(tmp_path / f"{number}.npz", time=t.time, q=t.q, u=np.asarray(t.u), joint_names=t.joint_names)
    robot = features.robot
    demos = {how: ml.load_demonstrations(tmp_path, robot, velocities=how) for how in ("auto", "derive", "recorded")}
    assert not demos["auto"].has_velocities and not demos["derive"].has_velocities
    assert "as asked" in demos["derive"].notes[0] and " and 5 more" in demos["auto"].notes[0]
    np.testing.assert_array_equal(demos["recorded"][0].u, wrong[0].u)
    good = error(features, truth, [(t.time, t.q) for t in exact])
    assert error(features, truth, demos["auto"]) == error(features, truth, wrong, velocities="derive") == good
    bad = error(features, truth, demos["recorded"])
    assert bad == error(features, truth, wrong, velocities="recorded") > 100.0 * good
    with pytest.raises(RecordingError, match="is not a number"):
        recordings_given(faulty("planar3", "not a number"), robot, 3, "recorded")


def test_a_pause_stays_a_gap_among_bunches() -> None:
    """Where the arm has moved on, or stood still for long, no count of samples makes up for the time."""
    features, exact, _ = motions("planar3")
    t = exact[0]
    for stamps in (t.time, bunches(5)(t.time, np.random.default_rng(0))):
        keep = np.r_[0:100, 160:300]
        read = recordings_given([(stamps[keep] + 3.0 * (keep >= 160), t.q[keep])], features.robot, 3)
        assert isinstance(read, ml.Demonstrations)
        assert [len(part) for part in read] == [100, 140]


def test_uneven_sampling_is_believed() -> None:
    """Dropped samples and random times are what they say: the positions follow them."""
    features, exact, _ = motions("sawyer")
    rng = np.random.default_rng(SEED)
    for t in exact:
        keep = np.sort(rng.choice(SAMPLES, 200, replace=False))
        when = np.sort(rng.uniform(0.0, t.time[-1], 250))
        there = np.column_stack([np.interp(when, t.time, column) for column in t.q.T])
        for time, q in ((t.time[keep], t.q[keep]), (when, there)):
            read = recordings_given([(time, q)], features.robot, 7)
            assert isinstance(read, ml.Demonstrations)
            np.testing.assert_array_equal(np.concatenate([part.time for part in read]), time)


def test_positions_that_are_noise_are_no_motion() -> None:
    """Where no joint moves farther than its encoder's noise nothing is learnt; one recording that moves is not that."""
    features, exact, _ = motions("planar3")
    rng = np.random.default_rng(SEED)
    still = [ml.Trajectory(t.time, t.q[:1] + 1e-4 * rng.normal(size=t.q.shape)) for t in exact]
    with pytest.raises(NotIdentifiableError, match="farther than the noise of its positions") as refused:
        ml.ConstraintLearner(features).fit(still)
    assert refused.value.code == "no-motion"
    with pytest.raises(NotIdentifiableError) as refused:
        ml.ConstraintLearner(features).fit([*still[1:], ml.Trajectory(exact[0].time, exact[0].q)])
    assert refused.value.code != "no-motion"
