"""Velocities derived from positions, on motions whose velocities are known."""

from __future__ import annotations

import numpy as np
import pytest
from case import case
from generated_motions import arm_features, guided_motions, oblique

from manip_learn.errors import RecordingError
from manip_learn.recordings.local_fit import HALF_WIDTHS, best_windows, half_widths_of, local_fit
from manip_learn.recordings.trajectory import Demonstrations, Trajectory
from manip_learn.recordings.velocities import derive_velocities, is_clean, jerk, noise_variance, with_velocities
from manip_learn.robot import load_robot

FEATURES = arm_features()
ROBOT = FEATURES.robot


def recorded(seed: int, noise: float, dt: float = 0.01, n_points: int = 200, n_trajectories: int = 4):
    """True motions, and what an encoder with noise would record of them: positions only."""
    rng = np.random.default_rng(seed)
    true, truth = guided_motions(FEATURES, oblique(2, 3, rng), rng, n_trajectories, n_points, dt)
    noisy = [
        Trajectory(t.time, t.q + noise * rng.standard_normal(t.q.shape), None, t.joint_names, t.name) for t in true
    ]
    return true, Demonstrations(noisy), truth


def error_of(true: Trajectory, derived: Trajectory) -> float:
    """Root mean square error of the velocities, relative to their size."""
    i = np.abs(true.time[:, None] - derived.time).argmin(axis=0)
    u = true.u[i]
    return float(np.sqrt(np.mean((derived.u - u) ** 2) / np.mean(u**2)))


def test_smooth_velocities_are_close_to_the_truth():
    """From clean positions and from noisy ones: degree and width of the window are chosen well for each."""
    for noise, allowed in [(0.0, 1e-5), (1e-7, 1e-5), (1e-5, 5e-4), (1e-4, 2e-3), (1e-3, 1e-2)]:
        with case(noise, allowed):
            true, noisy, _ = recorded(1, noise)
            errors = [error_of(a, derive_velocities(b, ROBOT)) for a, b in zip(true, noisy, strict=True)]
            assert max(errors) < allowed


def test_midpoints():
    """Midpoint velocities belong to the postures between the samples, exactly so at constant speed."""
    time = np.array([0.0, 0.1, 0.3, 0.35])
    speed = np.linspace(-0.5, 0.5, 7)
    t = Trajectory(time, np.outer(time, speed), None, ROBOT.joint_names)
    derived = derive_velocities(t, ROBOT, "midpoint")
    np.testing.assert_allclose(derived.u, np.tile(speed, (3, 1)), atol=1e-14)
    np.testing.assert_allclose(derived.q, np.outer(derived.time, speed), atol=1e-15)
    np.testing.assert_allclose(derived.time, [0.05, 0.2, 0.325])


def test_polynomials_on_uneven_stamps_are_exact():
    """A window's polynomial has its own degree's value and slope exactly, with the true time stamps; so where there are
    so many samples that each window's equations are solved by themselves.
    """
    rng = np.random.default_rng(3)
    for n, half_width, atol in ((60, 6, 1e-8), (4000, 40, 1e-6)):
        time = np.cumsum(rng.uniform(0.005, 0.02, n))
        inner = slice(half_width, n - half_width)
        for degree in (2, 3, 5):
            shapes = rng.standard_normal((2, degree + 1))
            polynomials = [np.polynomial.Chebyshev(shape, domain=[0.0, time[-1]]) for shape in shapes]
            x = np.stack([p(time) for p in polynomials], axis=1)
            slope = np.stack([p.deriv()(time) for p in polynomials], axis=1)
            value, found = local_fit(time, x, half_width, degree)
            np.testing.assert_allclose(value, x[inner], rtol=0, atol=1e-10)
            np.testing.assert_allclose(found, slope[inner], rtol=0, atol=atol)


def test_fast_sampling_has_windows_as_long_as_slow_sampling():
    """At 500 Hz and 1e-3 rad the window is longer than 61 samples, with a degree that follows the motion.

    The error is less than half that of the best window of 61 samples. Up to 100 Hz no longer ones are among the choice.
    """
    for jitter in [0.0, 2e-4]:
        with case(jitter):
            rng = np.random.default_rng(11)
            time = 0.002 * np.arange(2500) + rng.uniform(-jitter, jitter, 2500)
            phase, rate = rng.uniform(0.0, 6.0, 7), rng.uniform(2.0, 5.0, 7)
            q = 0.3 * np.sin(np.outer(time, rate) + phase) + 1e-3 * rng.standard_normal((2500, 7))
            true = Trajectory(time, q, 0.3 * rate * np.cos(np.outer(time, rate) + phase), ROBOT.joint_names)
            noisy = Trajectory(time, q, None, ROBOT.joint_names)
            m, degree = best_windows(time, q[None])[0]
            assert 75 <= m <= 150 and degree >= 3
            fits = [(time[30:-30], *local_fit(time, q, 30, d), ROBOT.joint_names) for d in (2, 3, 5)]
            best = min(error_of(true, Trajectory(*fit)) for fit in fits)
            assert error_of(true, derive_velocities(noisy, ROBOT)) < 0.5 * best
            for step in (0.01, 0.1):
                assert half_widths_of(step * np.arange(2500)) == HALF_WIDTHS


def test_uneven_stamps_do_not_spoil_the_choice():
    """Neither jitter of the time stamps nor Unix time degrades the result."""
    true, noisy, _ = recorded(4, 1e-4)
    even = error_of(true[0], derive_velocities(noisy[0], ROBOT))
    later = derive_velocities(Trajectory(noisy[0].time + 1.7e9, noisy[0].q, None, ROBOT.joint_names), ROBOT)
    shifted = Trajectory(later.time - 1.7e9, later.q, later.u, later.joint_names)
    assert error_of(true[0], shifted) < 1.5 * even + 1e-4


def test_continuous_joints_may_wrap(robot_of):
    """A continuous joint that passes pi moves on at its speed, and does not jump back by a turn."""
    robot = robot_of("wrist")
    time = 0.02 * np.arange(60)
    x = np.array([2.8, 0.1, -2.9, 0.3]) + np.outer(time, [0.7, 0.2, -0.9, -0.1])
    wrapped = np.where([True, False, True, False], (x + np.pi) % (2 * np.pi) - np.pi, x)
    for q in (wrapped, np.array([robot.configuration(row) for row in x])):
        for method in ("midpoint", "smooth"):
            derived = derive_velocities(Trajectory(time, q, None, robot.joint_names), robot, method)
            np.testing.assert_allclose(derived.u, np.tile([0.7, 0.2, -0.9, -0.1], (len(derived), 1)), atol=1e-9)


def test_floating_base(robot_of, rng):
    """On a manifold without coordinates the velocities are those of the shortest way from posture to posture."""
    robot = robot_of("humanoid")
    u = rng.uniform(-0.5, 0.5, robot.nv)
    q = [robot.random_configuration(rng)]
    for _ in range(9):
        q.append(robot.integrate(q[-1], 0.02 * u))
    derived = derive_velocities(Trajectory(0.02 * np.arange(10), q, None, robot.joint_names), robot)
    np.testing.assert_allclose(derived.u, np.tile(u, (9, 1)), atol=1e-9)
    np.testing.assert_allclose(robot.difference(derived.q[3], robot.integrate(q[3], 0.01 * u)), 0.0, atol=1e-12)


def test_recorded_velocities_are_kept_and_lost_ends_are_said():
    """Only missing velocities are derived; the report says how many samples that cost."""
    true, noisy, _ = recorded(6, 1e-4)
    mixed = Demonstrations([true[0], noisy[1]], ["read from files"])
    done = with_velocities(mixed, ROBOT)
    assert done[0] is true[0]
    lost = len(noisy[1]) - len(done[1])
    assert lost > 0
    assert done.notes[0] == "read from files"
    assert f"velocities of 1 recording derived from the positions; {lost} of 400 samples" in done.notes[1]
    assert with_velocities(Demonstrations([true[0]]), None)[0] is true[0]


def test_refusals():
    """Too few samples, an unknown method, a window that does not fit, and no robot: refused with the numbers."""
    _, noisy, _ = recorded(7, 1e-4, n_points=30, n_trajectories=1)
    t = noisy[0]
    with pytest.raises(RecordingError, match="got 2"):
        derive_velocities(t.part(slice(0, 2)), ROBOT)
    with pytest.raises(RecordingError, match="'forward'"):
        derive_velocities(t, ROBOT, "forward")  # type: ignore[arg-type]
    with pytest.raises(RecordingError, match="4 samples"):
        derive_velocities(t.part(slice(0, 4)), ROBOT, "smooth")
    with pytest.raises(RecordingError, match="give features of one"):
        with_velocities(noisy, None)


def test_together_as_one_by_one() -> None:
    """Recordings with the same times get the velocities that each gets by itself, in their order."""
    for method in ["auto", "midpoint"]:
        with case(method):
            _, many, _ = recorded(3, 1e-4, n_points=90, n_trajectories=6)
            _, long, _ = recorded(4, 1e-3, n_points=120, n_trajectories=2)
            _, short, _ = recorded(5, 1e-4, n_points=9, n_trajectories=2)
            mixed = [many[0], long[0], many[1], short[0], *many.trajectories[2:], long[1], short[1]]
            for t, got in zip(mixed, derive_together(mixed, ROBOT, method), strict=True):  # type: ignore[arg-type]
                one = derive_velocities(t, ROBOT, method)  # type: ignore[arg-type]
                assert got.name == t.name
                np.testing.assert_array_equal(got.time, one.time)
                np.testing.assert_allclose(got.q, one.q, rtol=0, atol=1e-13)
                assert got.u is not None and one.u is not None
                np.testing.assert_allclose(got.u, one.u, rtol=0, atol=1e-11)


def moved(dt: float, noise: float, n: int = 1200) -> tuple[np.ndarray, np.ndarray]:
    """Three joints that swing, and white noise."""
    time = dt * np.arange(n)
    q = np.stack([np.sin(w * time + p) for w, p in ((1.0, 0.0), (2.3, 1.0), (3.1, 2.0))], axis=1)
    return time, q + noise * np.random.default_rng(5).standard_normal(q.shape)


def test_windows_noise_and_jerk_of_known_motions() -> None:
    """The windows that are chosen, the noise that is found, and the jerk: true are sqrt((1 + 2.3^6 + 3.1^6) / 2) = 22.8
    rms and at most 32 rad/s^3. Numbers of noise are those of the samples, within 4 % of its variance.
    """
    for dt, noise, window, rms, peak in (
        (0.002, 1e-7, (30, 5), 23.205177843311407, 36.89315496018989),
        (0.002, 1e-5, (125, 5), 23.127103515271294, 36.31397097417037),
        (0.002, 1e-3, (150, 5), 23.42809656849463, 44.35626587290434),
        (0.002, 1e-2, (150, 3), 52.44904955344167, 243.51918056342222),
        (0.01, 1e-7, (15, 5), 22.89893515988076, 32.195139669454065),
        (0.01, 1e-6, (20, 5), 22.89961222071799, 32.65015846760345),
        (0.01, 1e-3, (30, 5), 22.73898243615183, 36.431384837926274),
        (0.05, 1e-5, (7, 5), 22.471713609277145, 31.791218807638533),
        (0.05, 1e-3, (10, 5), 22.261687416037095, 33.63054076695662),
        (0.05, 1e-2, (15, 5), 21.259938033889707, 35.92724973641997),
    ):
        with case(dt, noise):
            time, q = moved(dt, noise)
            assert best_windows(time, q[None])[0] == window
            np.testing.assert_allclose(jerk(time, q), (rms, peak), rtol=1e-5)
            if dt < 0.01 or noise >= 1e-3:
                np.testing.assert_allclose(noise_variance(time, q) / noise**2, [0.925, 0.935, 1.028], rtol=0.04)
    time, q = moved(0.01, 1e-3, 6)
    assert np.all(np.isnan(jerk(time, q))) and np.all(np.isfinite(jerk(*moved(0.01, 1e-3, 7))))


def test_short_trajectories_are_differenced() -> None:
    """Fewer than 8 samples, or fewer than 24 clean ones, whose noise is under 1e-3 of a step, have no windows."""
    for n, noise, is_differenced in (
        (3, 0.0, True),
        (7, 1e-2, True),
        (8, 1e-2, False),
        (23, 0.0, True),
        (24, 0.0, False),
    ):
        with case(n, noise):
            time, q = moved(0.01, noise, n)
            derived = derive_velocities(Trajectory(time, q), load_robot("planar3"))
            assert (len(derived) == n - 1) == is_differenced
            if is_differenced:
                np.testing.assert_allclose(derived.time, time[:-1] + 0.005)
            else:
                places = np.searchsorted(time, derived.time)
                np.testing.assert_array_equal(time[places], derived.time)
                assert places[0] == n - 1 - places[-1] > 0
    time, noisy = 0.01 * np.arange(400), np.random.default_rng(2).standard_normal((400, 3))
    line = np.outer(time, [1.0, -2.0, 0.5])
    least = np.sqrt(np.sum(noise_variance(time, noisy)) / np.sum(np.mean(np.diff(line, axis=0) ** 2, axis=0)))
    for share, clean in ((0.98e-3, True), (1.02e-3, False)):
        assert is_clean(time, line + share / least * noisy) is clean
