"""Velocities derived from positions, on motions whose velocities are known; nothing else that is recorded can hurt."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
from case import case
from generated_motions import angle_deg, arm_features, guided_motions, oblique, planar_features

import manip_learn as ml
from manip_learn.errors import NotIdentifiableError, RecordingError
from manip_learn.recordings.given import recordings_given
from manip_learn.recordings.velocities import derive_velocities, jerk, noise_variance, with_velocities

FEATURES = arm_features()
ROBOT = FEATURES.robot
DT, SAMPLES = 0.01, 300  # [s]
NOISE = 1e-4  # [rad] of the encoders
SEED = 7

Velocity = Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]
Stamps = Callable[[np.ndarray], np.ndarray]


def recorded(seed: int, noise: float, dt: float = 0.01, n_points: int = 200):
    """True motions, and what an encoder with noise would record of them: positions only."""
    rng = np.random.default_rng(seed)
    true, _ = guided_motions(FEATURES, oblique(2, 3, rng), rng, 4, n_points, dt)
    noisy = (replace(t, q=t.q + noise * rng.standard_normal(t.q.shape), u=None, exact=False) for t in true)
    return true, ml.Demonstrations(noisy)


def error_of(true: ml.Trajectory, derived: ml.Trajectory) -> float:
    """Root mean square error of the velocities, relative to their size."""
    return float(np.sqrt(np.mean((derived.u - true.u) ** 2) / np.mean(true.u**2)))


RATES = [(0.05, 60, 1e-3, 0.04), (0.01, 200, 0.0, 1e-5), (0.01, 200, 1e-3, 0.025), (0.002, 2000, 1e-3, 0.01)]


@pytest.mark.parametrize(("dt", "n", "noise", "allowed"), RATES)
def test_derived_velocities_are_close_to_the_truth(dt: float, n: int, noise: float, allowed: float) -> None:
    """At any rate and noise the window suits the motion, and positions and times stay as they are, to the last one."""
    true, noisy = recorded(1, noise, dt, n)
    for a, b in zip(true, noisy, strict=True):
        derived = derive_velocities(b, ROBOT)
        assert error_of(a, derived) < allowed
        np.testing.assert_array_equal(derived.q, b.q)
        np.testing.assert_array_equal(derived.time, b.time)


def test_lost_samples_and_uneven_stamps() -> None:
    """Polynomials of degree 5 have their slope exactly, at the ends and beside what is lost; noise grows by what the
    samples that are lost took with them.
    """
    rng = np.random.default_rng(3)
    time = np.delete(np.cumsum(rng.uniform(0.005, 0.02, 120)), [30, 31, 32, 33, 80])
    shapes = [np.polynomial.Chebyshev(rng.standard_normal(6), domain=[0.0, time[-1]]) for _ in range(7)]
    derived = derive_velocities(ml.Trajectory(time, np.stack([p(time) for p in shapes], axis=1)), ROBOT)
    np.testing.assert_allclose(derived.u, np.stack([p.deriv()(time) for p in shapes], axis=1), rtol=0, atol=1e-6)
    true, noisy = recorded(5, 1e-4)
    kept = np.sort(rng.choice(200, 140, replace=False))
    some = derive_velocities(noisy[0].part(kept), ROBOT)
    assert error_of(true[0].part(kept), some) < 2.0 * error_of(true[0], derive_velocities(noisy[0], ROBOT))


def test_joints_that_turn_for_ever_and_floating_bases(robot_of, rng):
    """A continuous joint that passes pi moves on at its speed, and does not jump back by a turn; on a manifold without
    coordinates the velocities are those of the shortest way from posture to posture.
    """
    wrist, time, speed = robot_of("wrist"), 0.02 * np.arange(60), [0.7, 0.2, -0.9, -0.1]
    x = np.array([2.8, 0.1, -2.9, 0.3]) + np.outer(time, speed)
    wrapped = np.where([True, False, True, False], (x + np.pi) % (2 * np.pi) - np.pi, x)
    cases = [(wrist, wrapped, speed), (wrist, np.array([wrist.configuration(row) for row in x]), speed)]
    for base in map(robot_of, ("humanoid", "rover")):  # floating, and on a plane
        u, moved = rng.uniform(-0.5, 0.5, base.nv), [base.random_configuration(rng)]
        for _ in range(9):
            moved.append(base.integrate(moved[-1], 0.02 * u))
        cases.append((base, np.array(moved), u))
    for robot, q, true in cases:
        derived = derive_velocities(ml.Trajectory(time[: len(q)], q, None, robot.joint_names), robot)
        np.testing.assert_allclose(derived.u, np.tile(true, (len(q), 1)), atol=1e-9)


def test_recorded_velocities_are_used_as_asked() -> None:
    """`"recorded"` uses those there are as they are; by default all are derived. Too few samples, no robot and what is
    not a number are refused.
    """
    true, noisy = recorded(6, 1e-4)
    mixed = ml.Demonstrations([replace(true[0], u=2.0 * true[0].u, exact=False), noisy[1]], ["read from files"])
    kept, derived = with_velocities(mixed, ROBOT, "recorded"), with_velocities(mixed, ROBOT)
    assert kept[0] is mixed[0] and kept.notes == mixed.notes and kept.has_velocities
    assert error_of(true[0], derived[0]) < 1e-2
    assert with_velocities(derived, ROBOT)[0] is derived[0] and with_velocities(derived, None)[1] is derived[1]
    with pytest.raises(RecordingError, match="got 2"):
        derive_velocities(noisy[0].part(slice(0, 2)), ROBOT)
    with pytest.raises(RecordingError, match="give features of one"):
        with_velocities(noisy, None)
    with pytest.raises(RecordingError, match="is not a number"):
        with_velocities(ml.Demonstrations([replace(true[0], u=np.nan * true[0].u, exact=False)]), ROBOT, "recorded")


def moved(dt: float, noise: float, n: int = 1200) -> tuple[np.ndarray, np.ndarray]:
    """Three joints that swing, and white noise."""
    time = dt * np.arange(n)
    q = np.stack([np.sin(w * time + p) for w, p in ((1.0, 0.0), (2.3, 1.0), (3.1, 2.0))], axis=1)
    return time, q + noise * np.random.default_rng(5).standard_normal(q.shape)


def test_noise_and_jerk_of_known_motions() -> None:
    """The noise that is found, and the jerk: true are sqrt((1 + 2.3^6 + 3.1^6) / 2) = 22.8
    rms and at most 32 rad/s^3. Numbers of noise are those of the samples, within 4 % of its variance.
    """
    for dt, noise, rms, peak in (
        (0.002, 1e-7, 23.205177843311407, 36.89315496018989),
        (0.002, 1e-2, 52.44904955344167, 243.51918056342222),
        (0.01, 1e-6, 22.89961222071799, 32.65015846760345),
        (0.05, 1e-2, 21.259938033889707, 35.92724973641997),
    ):
        with case(dt, noise):
            time, q = moved(dt, noise)
            np.testing.assert_allclose(jerk(time, q), (rms, peak), rtol=1e-5)
            if dt < 0.01 or noise >= 1e-3:
                np.testing.assert_allclose(noise_variance(time, q) / noise**2, [0.925, 0.935, 1.028], rtol=0.04)
    time, q = moved(0.01, 1e-3, 6)
    assert np.all(np.isnan(jerk(time, q))) and np.all(np.isfinite(jerk(*moved(0.01, 1e-3, 7))))


# what is recorded in place of the velocity
VELOCITIES: dict[str, Velocity] = {
    "not a number": lambda u, q, t: np.nan * u,
    "of the opposite sign": lambda u, q, t: -u,
    "of one joint 5 percent too large": lambda u, q, t: u * np.where(np.arange(u.shape[1]) == 1, 1.05, 1.0),
}


def bunches(size: int, apart: float = 0.0) -> Stamps:
    """Samples that are stamped when the last of so many has arrived."""

    def changed(t: np.ndarray) -> np.ndarray:
        k = np.arange(len(t))
        return t[np.minimum((k // size + 1) * size - 1, len(t) - 1)] + apart * (k % size)

    return changed


def grains(size: float) -> Stamps:
    return lambda t: np.floor(t / size + 1e-9) * size


def some_late(t: np.ndarray) -> np.ndarray:
    out = t.copy()
    out[[40, 90, 91, 200]] += 0.6
    return out


TIMES: dict[str, Stamps] = {
    **{f"bunches of {n}": bunches(n) for n in (2, 100)},
    "bunches of 10, 0.1 ms apart": bunches(10, 1e-4),
    **{f"grains of {size:g} s": grains(size) for size in (0.001, 0.1, 1.0)},
    "milliseconds since 1970": lambda t: 1.7e12 + np.round(1e3 * t),
    "stalled once": lambda t: np.where((t >= t[120]) & (t < t[140]), t[140] - 1e-3, t),
    "single stamps late": some_late,
    "set back by 0.4 s": lambda t: t - 0.4 * (np.arange(len(t)) >= 130),
    "set back twice": lambda t: t - 0.5 * (np.arange(len(t)) >= 100) - 1.0 * (np.arange(len(t)) >= 220),
    "past midnight": lambda t: (86399.0 + t) % 86400.0,
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


def error(features: ml.FrameJacobian, truth: ml.Constraint, given: Any) -> float:
    """Angle between the rows that are learnt and the true ones [degrees]."""
    learner = ml.ConstraintLearner(features, n_constraints=truth.n_constraints, phases="off", mechanism="off")
    return angle_deg(learner.fit(given).constraint_, truth)


@pytest.mark.parametrize("fault", VELOCITIES)
def test_recorded_velocities_cannot_hurt(fault: str) -> None:
    """Whatever stands for velocities, the answer is that of the positions alone."""
    features, exact, truth = motions(("planar3", "sawyer")[len(fault) % 2])
    given = [replace(t, u=VELOCITIES[fault](np.asarray(t.u), t.q, t.time), exact=False) for t in exact]
    assert error(features, truth, given) == error(features, truth, [(t.time, t.q) for t in exact]) < 0.05


@pytest.mark.parametrize("fault", TIMES)
def test_times_that_contradict_the_positions_are_spread(fault: str) -> None:
    """Even steps as in truth, which leave the rows that are learnt as they are, and a note says what was done."""
    features, exact, _ = motions(("planar3", "sawyer")[len(fault) % 2])
    read = recordings_given([(TIMES[fault](t.time), t.q) for t in exact], features.robot, features.nv)
    assert isinstance(read, ml.Demonstrations) and len(read) == len(exact)
    told = ("spread", "spaced evenly", "read as m", "set back", "came late", "out of order")
    assert fault == "grains of 0.001 s" or all(any(word in note for word in told) for note in read.notes) and read.notes
    for one, true in zip(read, exact, strict=True):
        np.testing.assert_array_equal(one.q, true.q)
        steps = np.diff(one.time)
        assert np.ptp(steps) < 1e-3 * np.mean(steps)


def test_positions_that_are_noise_are_no_motion() -> None:
    """Where no joint moves farther than its encoder's noise nothing is learnt; one recording that moves is not that."""
    features, exact, _ = motions("planar3")
    rng = np.random.default_rng(SEED)
    still = [ml.Trajectory(t.time, t.q[:1] + 1e-4 * rng.normal(size=t.q.shape)) for t in exact]
    with pytest.raises(NotIdentifiableError, match="further than its encoder noise") as refused:
        ml.ConstraintLearner(features).fit(still)
    assert refused.value.code == "no-motion"


@pytest.mark.parametrize("noise", [0.0, NOISE])
def test_velocities_do_not_depend_on_when_the_clock_began(noise: float):
    """Recordings with stamps of a computer's clock, 1e5 s after its start, have the velocities of those from 0 on."""
    for demo in recorded(SEED, noise)[1]:
        later = derive_velocities(replace(demo, time=demo.time + 1e5), ROBOT)
        np.testing.assert_allclose(later.u, derive_velocities(demo, ROBOT).u, rtol=0, atol=1e-5)
