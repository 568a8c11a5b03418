"""Whole recordings are divided where a contact begins and ends, those that disagree are told apart, and free motion
explains itself.
"""

from __future__ import annotations

import dataclasses
import itertools
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from task_sets import learnt, true_rows
from task_sets import moving as recordings

import manip_learn as ml
from manip_learn.constraint.features import FrameJacobian
from manip_learn.constraint.features.mechanism_rows import PlaceRows
from manip_learn.errors import FeatureError
from manip_learn.learning.explanation import findings
from manip_learn.learning.explanation.evidence import (
    HeldScale,
    Stretch,
    covered,
    cut,
    evidence,
    gains_of,
    held_by,
    sharpened,
    states_of,
    stretches_of,
    uncovered,
    ways_to_choose,
)
from manip_learn.learning.explanation.explain import (
    SAME,
    Explanation,
    Hypothesis,
    _least_used,
    _recordings,
    _window_moments,
    distinct,
    explain,
    fitted_rows,
    proposed,
    supports_of,
)
from manip_learn.learning.explanation.findings import IN_ONE_ONLY, Findings, agreeing, find
from manip_learn.learning.explanation.row_motion import (
    SCAN_RATE,
    RowMotion,
    View,
    broken_energy,
    joints_at_once,
    mechanism_features,
    velocity_noise,
    views_of,
)
from manip_learn.linalg import complement_rows, row_space_angle
from manip_learn.recordings.demonstrations import Demonstrations
from manip_learn.recordings.trajectory import Trajectory
from manip_learn.recordings.velocities import derive_velocities

Recordings = tuple[FrameJacobian, list[Trajectory], dict[str, Any]]


def found(made: Recordings, **options: Any) -> Findings:
    features, trajectories, _ = made
    return find(Demonstrations(trajectories), [features], np.random.default_rng(0), **options)


def test_a_cut_recording_is_one_stretch():
    """Recordings that hold nothing but the contact: one part, every recording as a whole, none of them odd."""
    for kind in ("drawer", "table", "door"):
        made = recordings(kind, "xarm7", 2021, 8, whole=False)
        result = found(made)
        assert len(result.parts) == 1 and not result.odd and not result.free, kind
        spans = [(s.trajectory, s.start, s.end) for s in result.parts[0].stretches]
        assert spans == [(i, t.time[0], t.time[-1]) for i, t in enumerate(made[1])], kind


@pytest.mark.parametrize("kind", ["free", "free_repeated", "free_slow", "free_sticking", "free_one_joint"])
def test_free_motion_is_explained_by_nothing_else(kind: str):
    """Nothing is held, so nothing is found, in parts of the recordings or in all of them."""
    for options in ({}, {"switch": np.inf}):
        result = found(recordings(kind, "panda", 2012, 5), **options)
        assert not result.explained and result.parts[0].found is None, options


def test_a_contact_in_one_recording_only_is_named_and_not_learnt():
    """What no other recording supports is no constraint; where it is, is said."""
    features, held, truth = recordings("drawer", "panda", 2013, 4)
    _, free, _ = recordings("free", "panda", 2013, 4)
    result = found((features, [held[0], *free], {}))
    assert not result.explained
    assert [(s.trajectory, why) for s, why in result.unlearnt] == [(0, IN_ONE_ONLY)]
    (start, end, _), (stretch, _) = truth["windows"][0][0], result.unlearnt[0]
    assert min(end, stretch.end) - max(start, stretch.start) > 0.8 * (end - start)


@pytest.mark.parametrize("seed", [2021, 2022])
@pytest.mark.parametrize("kind", ["drawer_other_direction", "drawer_slip"])
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


@pytest.mark.parametrize(("kind", "degrees"), [("table", 2.0), ("table", 10.0), ("drawer", 2.0), ("drawer", 20.0)])
def test_two_that_nearly_coincide_are_told_apart(kind: str, degrees: float):
    """Four recordings of one table or drawer and four of another, some degrees apart: each has its own rows."""
    features, first, truth = recordings(kind, "panda", 2023, 8, whole=False)
    _, second, other = recordings(kind, "panda", 2023, 8, whole=False, tilt=degrees)
    result = found((features, [*first[:4], *second[4:]], {}))
    members = [sorted(s.trajectory for s in part.stretches) for part in result.parts]
    assert sorted(members) == [[0, 1, 2, 3], [4, 5, 6, 7]]
    for part, numbers in zip(result.parts, members, strict=True):
        assert np.degrees(row_space_angle(part.found, true_rows(truth if 0 in numbers else other, 0))) < 0.1


@pytest.mark.parametrize("kind", ["table", "drawer"])
def test_one_is_not_divided(kind: str):
    """Sixteen recordings of one table or drawer with bad encoders are one constraint."""
    features, trajectories, _ = recordings(kind, "ur5", 2024, 16, whole=False)
    rng = np.random.default_rng(1)
    noisy = [
        derive_velocities(
            Trajectory(t.time, t.q + rng.normal(0.0, 3e-3, t.q.shape), None, t.joint_names), features.robot
        )
        for t in trajectories
    ]
    assert len(found((features, noisy, {})).parts) == 1


def test_noise_that_differs_among_recordings_is_not_odd():
    """A recording from a noisier encoder obeys the constraint as well as its noise allows."""
    features, trajectories, _ = recordings("drawer", "panda", 2023, 4, whole=False)
    rng = np.random.default_rng(3)
    noisy = [
        Trajectory(t.time, t.q, np.asarray(t.u) + sigma * rng.normal(size=t.q.shape), t.joint_names, t.name)
        for t, sigma in zip(trajectories, (0.0, 0.003, 0.01, 0.001), strict=True)
    ]
    assert not found((features, noisy, {})).odd


@pytest.mark.parametrize("share", [0.5, 0.9])
def test_a_stretch_that_slips_is_odd(share: float):
    """It has left the rows that the others hold still, wherever in it."""
    features = ml.CustomFeatures(lambda q: np.eye(2), ("x", "y"), 2)
    time = np.linspace(0.0, 2.0, 201)

    def moved(height: np.ndarray) -> Trajectory:
        q = np.column_stack([0.01 * np.sin(time), height])
        return Trajectory(time, q, np.gradient(q, time, axis=0))

    members = [moved(1e-5 * np.sin(9.0 * time + k)) for k in range(4)]
    slipping = moved(0.02 / (1.0 + np.exp(-(time - 2.0 * share) / 0.01)))
    motion = RowMotion.collect(features, [*members, slipping])
    rows = np.linalg.qr(motion.whitening @ np.array([[0.0], [1.0]]))[0].T
    agrees = agreeing(motion, rows, [Stretch(i, 0.0, 2.0) for i in range(5)])
    assert agrees.tolist() == [True] * 4 + [False]


@pytest.mark.parametrize(("robot", "seed", "n"), [("ur5", 2102, 4), ("xarm7", 3005, 8)])
def test_a_tether_is_learnt_from_whole_recordings(robot: str, seed: int, n: int):
    """Type, centre and radius within 0.5 mm, one row; the second one's sphere is so large that parts of it pass for a
    soft plane.
    """
    _, made, truth = recordings("tether", robot, seed, n)
    learner = learnt(robot, truth["tip"], made)
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


def test_two_recordings_together_propose_the_centre_of_a_sphere():
    """The best pair puts the centre within 2 cm, although one window alone fits many spheres."""
    features, made, truth = recordings("tether", "panda", 2101, 6)
    rows = PlaceRows(features.robot, truth["tip"], "point", np.array([0.4, 0.1, 0.4]))
    motion = RowMotion.collect(rows, made).thinned()
    offered = proposed(motion, np.zeros(len(motion), dtype=np.int64), 1)[1]
    selections = [motion.selection(r)[0] for r in offered]
    centres = np.array([rows.middle - x[:3] / x[3] for x in selections])
    apart = np.linalg.norm(centres - np.array(truth["mechanisms"][0]["point"]), axis=1)
    assert np.min(apart) < 0.02


@pytest.mark.parametrize("form", ["point", "point and rotation", "twist", "surface"])
def test_place_rows_have_exact_derivatives(robot_of, form: str):
    """dPhi/dq is that of central differences, in bulk as one by one, at a singular posture too."""
    arm, h = robot_of("panda"), 1e-6
    rows = PlaceRows(arm, "panda_hand_tcp", form, [0.3, -0.1, 0.4])
    for q in (np.zeros(arm.nq), np.random.default_rng(1).uniform(-1.0, 1.0, arm.nq)):
        steps = [(rows(q + h * e) - rows(q - h * e)) / (2.0 * h) for e in np.eye(arm.nv)]
        np.testing.assert_allclose(rows.derivative(q), np.stack(steps, axis=2), atol=1e-8)
        Phi, dPhi = rows.batch_with_derivative(q[None])
        np.testing.assert_allclose(Phi[0], rows(q), atol=1e-12)
        np.testing.assert_allclose(dPhi[0], rows.derivative(q), atol=1e-10)


def test_place_rows_hold_what_they_say(robot_of):
    """[-(c - m), 1] Phi u = (p - c).v for any centre c, and a twist's rows are the velocity of the point at m."""
    arm, rng = robot_of("ur5"), np.random.default_rng(2)
    m, c, q, u = rng.normal(size=3), rng.normal(size=3), rng.uniform(-1.0, 1.0, 6), rng.normal(size=6)
    J, p = arm.jacobian(q, arm.frame("tool0")) @ u, arm.position(q, arm.frame("tool0"))
    point, twist = (PlaceRows(arm, "tool0", form, m)(q) @ u for form in ("point", "twist"))
    assert np.append(m - c, 1.0) @ point == pytest.approx((p - c) @ J[:3])
    np.testing.assert_allclose(twist, [*(J[:3] + np.cross(p - m, J[3:])), *J[3:]], atol=1e-12)


def test_place_rows_refuse_what_is_none(robot_of):
    """Another form, and a middle that is no place."""
    with pytest.raises(FeatureError, match="form"):
        PlaceRows(robot_of("ur5"), "tool0", "sphere")  # type: ignore[arg-type]
    with pytest.raises(FeatureError, match="middle"):
        PlaceRows(robot_of("ur5"), "tool0", "point", [0.0, np.nan, 1.0])


def test_energy_that_breaks_a_hypothesis():
    """It equals |A^+ A u|^2 by singular value decomposition, for one row and for several."""
    features, trajectories, _ = recordings("drawer", "panda", 2011, 5)
    motion = RowMotion.collect(features, trajectories[:1])
    rng = np.random.default_rng(5)
    for s in (1, 2):
        rows = np.linalg.qr(rng.normal(size=(3, s)))[0].T
        energy = broken_energy(motion, rows[None])[:, 0]
        for i in (50, 200, 400):
            A = rows @ motion.whitening @ features(trajectories[0].q[i])
            broken = np.linalg.pinv(A) @ A @ trajectories[0].u[i]
            assert energy[i] == pytest.approx(broken @ broken, rel=1e-8)


def test_what_is_free_is_the_mean_over_the_signs_of_the_joints():
    """u^T P u averaged over all signs of the joint velocities, for each of the rows."""
    features, trajectories, _ = recordings("drawer", "panda", 2011, 5)
    motion, rng = RowMotion.collect(features, trajectories[:1]), np.random.default_rng(6)
    for i in (60, 300):
        Phi, u = features(trajectories[0].q[i]), trajectories[0].u[i]
        P = np.linalg.pinv(Phi) @ Phi
        signed = u * rng.choice([-1.0, 1.0], (20_000, len(u)))
        assert motion.free[i] == pytest.approx(np.mean(np.einsum("ni,ij,nj->n", signed, P, signed)) / 3.0, rel=0.03)


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


def test_what_several_recordings_support_counts_without_the_best_of_them():
    """The gain of all recordings but the one that gains most, less half of ln n for each parameter of Lambda."""
    gains = np.array([[50.0, 10.0], [60.0, 0.0], [5.0, 0.0]])
    np.testing.assert_allclose(supports_of(gains), [55.0, 0.0])
    np.testing.assert_allclose(supports_of(gains[:1]), [50.0, 10.0])
    h = Hypothesis(0, np.eye(2, 6), HeldScale(1.0, 0.01), gains[:, 0])
    assert h.support == 55.0 and h.price(20.0) == pytest.approx(0.5 * 2 * 4 * np.log(200.0))
    assert h.price(0.1) == pytest.approx(4.0 * np.log(2.0))
    assert h.worth(20.0) == pytest.approx(55.0 - 4.0 * np.log(200.0))


def test_stretches_are_as_long_as_what_moves_in_them():
    """From the first to the last sample that moves; a contact of less than 0.3 s is chance; one that fills a recording
    is all of it; what lies beside them is free motion.
    """
    motion = flat_motion(*[lambda time: 0.0 * time] * 2, pause=(1.0, 1.2))
    states = ((motion.time > 0.395) & (motion.time < 0.605) | (motion.time > 1.095) & (motion.time < 2.005)).astype(int)
    states[motion.trajectory == 1] = 1
    held = stretches_of(motion, states, 1)
    assert [s.trajectory for s in held] == [0, 1] and held[1] == Stretch(1, 0.0, 4.0)
    assert (held[0].start, held[0].end) == pytest.approx((1.21, 2.0))
    free = [(s.start, s.end) for s in stretches_of(motion, states, 0)]
    np.testing.assert_allclose(free, [(0.0, 0.39), (0.61, 0.99), (2.01, 4.0)], atol=0.011)
    beside = [(s.trajectory, s.start, s.end) for s in uncovered(motion, held)]
    np.testing.assert_allclose(beside, [(0, 0.0, 0.99), (0, 2.01, 4.0)], atol=0.011)
    (after,) = uncovered(motion, [Stretch(0, 0.0, 1.05), held[1]])
    assert (after.start, after.end) == pytest.approx((1.21, 4.0))
    assert np.count_nonzero(covered(motion, held)) == 80 + 401
    assert held[0].shared(Stretch(0, 1.0, 1.5)) == pytest.approx(0.29)
    assert held[0].shared(Stretch(0, 2.5, 3.0)) == held[0].shared(Stretch(1, 1.0, 1.5)) == 0.0
    rests = flat_motion(lambda time: 0.0 * time, lambda time: 0.0 * time, pause=(3.5, 9.0))
    assert stretches_of(rests, np.ones(len(rests), dtype=int), 1) == (Stretch(0, 0.0, 4.0), Stretch(1, 0.0, 4.0))
    t = Trajectory(motion.time[:401], np.zeros((401, 2)), np.zeros((401, 2)))
    span, whole = cut(t, Stretch(0, 0.995, 2.005)), cut(t, Stretch(0, 0.0, 4.0))
    assert whole == slice(0, 401) and span is not None
    assert (span.start, span.stop) == (110, 191)  # a tenth of a second belongs to the change
    assert cut(t, Stretch(0, 1.0, 1.21)) is None


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


def along_y(*ways: float, seconds: float = 2.0, rotating: bool = False) -> tuple[ml.CustomFeatures, list[Trajectory]]:
    """Recordings that go a metre along x and so far along y, from 0 to pi of a cosine."""
    time = np.arange(0.0, seconds + 0.005, 0.01)
    unit = "rad/s" if rotating else "m/s"
    features, out = ml.CustomFeatures(lambda q: np.eye(2), ("x", "y"), 2, row_units=(unit, unit)), []
    for i, way in enumerate(ways):
        rise = np.pi / seconds * np.sin(np.pi * time / seconds)
        u = np.column_stack([0.5 * rise, 0.5 * way * rise])
        out.append(Trajectory(time, np.zeros((len(time), 2)), u, name=f"demo_{i}"))
    return features, out


def test_reasons_are_numbers_with_units():
    """How far the odd one goes along the direction that the others hold, how far they do, and when fastest; a
    constraint that most recordings show is missed in the others.
    """
    features, made = along_y(1e-4, 3e-4, 2e-4, 0.02)
    row, whole = np.eye(2)[1:], [Stretch(i, 0.0, 2.0) for i in range(4)]
    said = "demo_3 moves 20 mm along a direction (+1.00 y) that the other 3 hold still (median 0.2 mm)"
    assert findings.reason(features, made[3], made[:3], row) == said
    np.testing.assert_allclose(findings.way_along(features, made[3], row)[-1], [0.02], rtol=1e-4)
    turning, turned = along_y(1e-3, 0.1, rotating=True)
    said = "demo_1 turns 5.7 deg about a direction (+1.00 y) that the other one holds still (median 0.057 deg)"
    assert findings.reason(turning, turned[1], turned[:1], row) == said
    odd = findings.drifting(features, made, row, whole, np.array([True, True, True, False]))
    assert list(odd) == [3] and odd[3].startswith("demo_3 moves 20 mm along")
    assert float(odd[3].removesuffix(" s").rpartition(", fastest at ")[2]) == pytest.approx(1.0, abs=0.1)
    missed = findings.missing(features, made, row, whole[:3], 1)
    assert list(missed) == [3]
    assert missed[3].startswith("constraint 1 is not seen in it, but in 3 of the others; demo_3 moves 20 mm")
    assert findings.missing(features, [*made, *made[:2]], row, whole[:3], 1) == {}  # half of six are no majority
    assert findings.missing(features, [*made, made[0]], row, whole[:3], 1).keys() == {3, 4}


def test_a_slip_interrupts_what_others_show_in_one_piece():
    """Between two stretches of one contact the hand goes at least five times as far along the held rows as in a whole
    one, and 2 mm; a longer pause, a smaller way, or another constraint in between is none.
    """

    def slip(way: float, start: float = 1.9, end: float = 2.1):
        return lambda time: still(time) + way * np.clip((time - start) / (end - start), 0.0, 1.0)

    def told(height, gap: tuple[float, float] = (1.8, 2.2), others: tuple[Stretch, ...] = ()) -> dict[int, str]:
        motion = flat_motion(still, still, height)
        time, features = motion.time[:401], ml.CustomFeatures(lambda q: np.eye(2), ("x", "y"), 2)
        made = [
            Trajectory(time, np.zeros((401, 2)), motion.rates[401 * i : 401 * (i + 1)], name=f"d{i}") for i in range(3)
        ]
        held = [Stretch(0, 0.0, 4.0), Stretch(1, 0.0, 4.0), Stretch(2, 0.0, gap[0]), Stretch(2, gap[1], 4.0)]
        return findings.slipping(motion, np.eye(2)[1:], features, made, np.eye(2)[1:], held, others)

    found = told(slip(5e-3))
    assert list(found) == [2]
    assert found[2].startswith("its contact is interrupted from 1.80 s to 2.20 s, as by a slip: d2 moves")
    assert told(slip(1.5e-3)) == {} and told(slip(2.5e-3)).keys() == {2}
    assert told(slip(5e-3), (1.2, 2.75)) == {} and told(slip(5e-3), (1.3, 2.75)).keys() == {2}
    assert told(slip(5e-3), others=(Stretch(2, 1.9, 2.0),)) == {}


def test_whoever_looks_for_what_is_still_pays_for_the_choice():
    """Recordings, and places for stretches of these lengths in them, by their motion."""
    motion = flat_motion(still, still, still)
    one_each = [Stretch(0, 0.5, 1.5), Stretch(2, 1.0, 3.0)]
    assert ways_to_choose(motion, one_each) == pytest.approx(3.0 * 4.0 * 2.0, rel=0.03)
    two_in_one = [Stretch(0, 0.5, 1.5), Stretch(0, 2.0, 3.0)]
    assert ways_to_choose(motion, two_in_one) == pytest.approx(3.0 * 4.0 * 4.0 / 2.0, rel=0.03)
    assert ways_to_choose(motion, [Stretch(i, 0.0, 4.0) for i in range(3)]) == pytest.approx(1.0)


def test_a_hypothesis_needs_support_a_test_and_a_difference():
    """Forty nats beside the best supporter, after its price; the test of chance; and rows that differ from others' by
    more than they give way themselves.
    """
    asked: list[float] = []

    def explained(seconds: float, believed: bool = True) -> Explanation:
        motion = flat_motion(still, still, still, seconds=seconds)
        view = View(ml.CustomFeatures(lambda q: np.eye(2), ("x", "y"), 2), motion, motion.thinned(), 1)

        def test(_: View, h: Hypothesis, held: np.ndarray) -> bool:
            asked.append(h.support)
            assert np.all(held)
            return believed

        asked.clear()
        return explain([view], test)

    found = explained(4.0)
    (h,), thin = found.hypotheses, found.thin
    np.testing.assert_allclose(np.abs(h.rows), [[0.0, 1.0]], atol=1e-3)
    assert (h.n_rows, h.scale.share) == (1, 0.003) and np.all(found.states == 1) and not found.refused
    np.testing.assert_allclose(found.supports, found.gains.sum(axis=0) - found.gains.max(axis=0))
    assert found.explained.sum() == pytest.approx(found.gains.sum())
    refused = explained(4.0, believed=False)
    assert refused.hypotheses == () and len(refused.refused) >= 1 and np.all(refused.states == 0)
    assert explained(0.3).hypotheses == () and not asked
    assert len(explained(0.5).hypotheses) == 1 and 40.0 < asked[0] < 80.0
    for degrees, twins in ((1.0, True), (1.3, False)):  # 0.02 rad are 1.15 degrees
        turned = np.array([[np.sin(np.radians(degrees)), np.cos(np.radians(degrees))]])
        pair = [Hypothesis(0, rows, HeldScale(1.0, 0.01), np.zeros(3)) for rows in (np.eye(2)[1:], turned)]
        both = Explanation(found.views, pair)
        assert both.has_twins == twins and both.angle(0, 1) == pytest.approx(np.radians(degrees))
    assert both.angle(0, 1) < Explanation([*found.views] * 2, [pair[0], dataclasses.replace(pair[1], view=1)]).angle(
        0, 1
    )
    assert len(both.without_idle().hypotheses) == 1 and len(thin) < len(found.views[0].motion)
    assert thin.weight.sum() == pytest.approx(found.views[0].motion.weight.sum(), rel=0.03)


def test_samples_stand_for_their_time(rng):
    """Each for half a step on either side, a gap of more than 0.2 s for no more than that; of evenly chosen ones, 25 a
    second, for those between them. White noise is told from a smooth motion.
    """
    features, time = ml.CustomFeatures(lambda q: np.eye(2), ("x", "y"), 2), np.array([0.0, 0.1, 0.3, 0.9])
    uneven = RowMotion.collect(features, [Trajectory(time, np.zeros((4, 2)), np.ones((4, 2)))] * 2)
    np.testing.assert_allclose(uneven.weight, [0.1, 0.15, 0.2, 0.2] * 2)
    assert uneven.first.tolist() == [0, 4, 8] and uneven.n_trajectories == 2
    motion = flat_motion(still, still)
    thin = motion.thinned()
    assert thin.first.tolist() == [0, 100, 200] and np.allclose(thin.weight, 0.04)
    np.testing.assert_allclose(thin.time[[0, 1, 100, -1]], [0.02, 0.06, 0.02, 3.98])
    (view,) = views_of([features], [Trajectory(motion.time[:401], motion.rates[:401], motion.rates[:401])])
    assert view.largest == 1 and view.immovable.shape == (0, 2)
    time = np.arange(0.0, 8.0, 0.01)
    for nv, least in ((2, 0.85), (7, 0.4)):
        smooth = np.sin(time[:, None] * rng.uniform(0.5, 2.0, nv))
        noisy = Trajectory(time, smooth, smooth + 0.03 * rng.standard_normal(smooth.shape))
        assert least < velocity_noise(noisy) / 0.03**2 < 1.15, nv
        still_one = Trajectory(time, smooth, 0.0 * smooth + 2.0)
        assert velocity_noise(still_one) == pytest.approx(4e-10)


def test_windows_are_sums_over_what_moves_in_them():
    """Every half length one, of r r^T and Phi Phi^T by the time, if more than half of it moves."""
    motion = flat_motion(*[lambda time: 0.0 * time] * 2, pause=(2.0, 3.5))
    found = _window_moments(motion, (0.6,))
    # 12 begin in a recording; those from 1.8 to 3.0 s hardly move
    assert np.bincount(found.trajectory).tolist() == [7, 7]
    np.testing.assert_allclose(found.M[0, 0, 0], 0.6, rtol=0.03)
    np.testing.assert_allclose(found.S[0], 0.6 * np.eye(2), atol=0.02)
    np.testing.assert_allclose(found.noise, motion.noise[0])
    sizes, rows = _least_used(found)
    np.testing.assert_allclose(np.abs(rows[:, 0]), [[0.0, 1.0 / np.sqrt(0.6)]] * 14, atol=0.03)
    assert np.all(sizes[:, 0] < 2e-3) and sizes[0, 1] == pytest.approx(1.0, rel=0.03)
    whole = _recordings(motion, motion.time < 1.0)
    assert [len(part.M) for part in whole] == [2, 1, 1] and whole[1].M[0, 0, 0] == pytest.approx(2.0, rel=0.03)
    np.testing.assert_allclose(whole[2].M, whole[0].M.sum(axis=0)[None])


def test_mechanisms_are_looked_for_where_the_frame_is_whole(robot_of):
    """Rows about a place where all of a frame's translation is asked for, with its rotation where that is, too."""
    made = [Trajectory(np.arange(3.0), np.tile(np.linspace(0.1, 0.7, 7), (3, 1)), np.ones((3, 7)))]
    for axes, forms in (("xyz", ["point"]), ("pose", ["point and rotation", "twist"]), ("x y", []), ("rotation", [])):
        maps = [FrameJacobian(robot_of("panda"), "panda_hand_tcp", axes)]
        found = mechanism_features(maps, made)
        assert [f.form for f in found] == forms, axes
    assert mechanism_features([ml.CustomFeatures(lambda q: np.eye(3), ("x", "y", "z"), 3)], made) == []


def test_a_stretch_that_is_short_beside_the_others_is_chance():
    """Less than a quarter of the usual length: another motion that passes along the free directions. It is free motion,
    as is all that is not held; the part with the most support comes first.
    """
    motion = flat_motion(*[still] * 4, seconds=6.0)
    features = ml.CustomFeatures(lambda q: np.eye(2), ("x", "y"), 2)
    time, rates = motion.time[:601], np.split(motion.rates, 4)
    made = Demonstrations([Trajectory(time, np.zeros((601, 2)), u, name=f"d{i}") for i, u in enumerate(rates)])
    view = View(features, motion, motion.thinned(), 1)
    rows = (np.eye(2)[1:], np.array([[0.6, 0.8]]))
    pair = [Hypothesis(0, row, HeldScale(1.0, 0.003), np.zeros(4)) for row in rows]
    for until, kept in ((5.0, False), (5.5, True)):
        states = 2 * ((motion.time > 0.495) & (motion.time < 3.505)).astype(int)
        states[(motion.trajectory == 3) & (motion.time > 4.495) & (motion.time < until + 0.005)] = 2
        states[(motion.trajectory != 3) & (motion.time > 4.495) & (motion.time < 5.405)] = 1
        told = SimpleNamespace(views=[view], hypotheses=pair[::-1], supports=np.array([90.0, 100.0]))
        told.fine_states, told.angle = lambda s=states: s, lambda i, j: np.radians(5.1)
        result = findings._findings(made, [features], told, [])
        first, second = result.parts
        assert [(s.trajectory, round(s.start, 2), round(s.end, 2)) for s in first.stretches] == [
            *((i, 0.5, 3.5) for i in range(4)),
            *([(3, 4.5, until)] if kept else []),
        ]
        assert {s.trajectory for s in second.stretches} == {0, 1, 2} and len(first.demonstrations) == 4 + kept
        np.testing.assert_allclose(np.abs(first.found), np.abs(rows[0]), atol=1e-9)
        assert first.choices == pytest.approx(ways_to_choose(motion, first.stretches))
        beside = [x for s in result.free if s.trajectory == 3 for x in (s.start, s.end)]
        np.testing.assert_allclose(beside, [0.0, 0.49, 3.51, *([4.49, 5.51] if kept else []), 6.0], atol=0.011)
        assert result.warnings == () and [i for i, _ in result.odd] == [3]  # which shows the second one nowhere
    told.angle = lambda i, j: np.radians(4.9)
    assert (
        findings._findings(made, [features], told, []).warnings[0].startswith("constraints 1 and 2 differ by 4.9 deg")
    )


def test_a_contact_has_to_pass_every_gate(monkeypatch):
    """Rows that recombination supports, in at least two recordings, by joints that move at the same time, and beyond
    doubt where fewer than three show it; chance is told what it was chosen from.
    """
    features, trajectories, truth = recordings("drawer", "panda", 2011, 5)
    (view,), seen = views_of([features], trajectories), []
    rows = np.linalg.svd(true_rows(truth) @ np.linalg.pinv(view.motion.whitening))[2][:2]
    h, thin = Hypothesis(0, rows, HeldScale(1.0, 0.01), np.zeros(5)), view.thin
    inside = np.any([(thin.trajectory == i) & (thin.time > w[0][0] + 0.1) & (thin.time < w[0][1] - 0.1)
                     for i, w in enumerate(truth["windows"])], axis=0)  # fmt: skip

    def told(n_rows: int, clear: bool, recordings: range = range(5), joints: float = 1.0) -> bool:
        def answer(maps, pieces, rng, choices, believed):
            seen.append((len(pieces), choices, believed))
            return SimpleNamespace(n_rows=n_rows if len(pieces) else 0, clear=clear)

        monkeypatch.setattr(findings, "recombination_test", answer)
        monkeypatch.setattr(findings, "joints_at_once", lambda u, noise: joints_at_once(u, noise) * joints)
        test = findings._Recombination(trajectories, 7, 0, 2.5)
        return test(view, h, inside & np.isin(thin.trajectory, recordings))

    assert told(2, False)
    assert seen[-1][0] == 5 and seen[-1][2] == 2.5
    assert seen[-1][1] == pytest.approx(7.0 * ways_to_choose(thin, stretches_of(thin, inside.astype(int), 1)), rel=0.05)
    assert not told(1, True)
    assert told(3, False)
    assert not told(2, False, range(2)) and told(2, True, range(2)) and told(2, False, range(3))
    assert not told(2, True, range(1))
    assert not told(2, True, joints=0.3)


def test_proposals_that_say_the_same_are_one():
    """Of rows closer together than 3 degrees, the squared sines of all principal angles added, the first is kept."""
    rng = np.random.default_rng(7)
    for s, r in ((1, 3), (2, 6), (5, 7)):
        bases = [np.linalg.qr(rng.normal(size=(r, s)))[0].T for _ in range(6)]
        near = [np.linalg.qr((b + 0.2 * SAME / np.sqrt(s * r) * rng.normal(size=b.shape)).T)[0].T for b in bases]
        rows = np.stack([row for both in zip(bases, near, strict=True) for row in both])
        kept = distinct(rows)
        angles = [row_space_angle(rows[i], rows[j]) for i, j in itertools.combinations(kept, 2)]
        assert kept == list(range(0, 12, 2))
        assert min(angles) > SAME / np.sqrt(s)
        assert distinct(rows, 2) == [0, 2]


def test_rows_are_fitted_to_the_samples_that_weigh():
    """Several fits at once are those one by one, each the least of its weighted samples."""
    features, trajectories, truth = recordings("drawer", "panda", 2011, 5)
    motion = RowMotion.collect(features, trajectories)
    a, b, _ = truth["windows"][0][0]
    inside = (motion.trajectory == 0) & (motion.time > a + 0.1) & (motion.time < b - 0.1)
    weights = np.stack([inside, np.ones(len(motion))], axis=1) * motion.weight[:, None]
    both = fitted_rows(motion, weights, 2)
    held = motion.selection(both[0])
    for k in (0, 1):
        assert row_space_angle(both[k], fitted_rows(motion, weights[:, k : k + 1], 2)[0]) < 1e-7
    assert row_space_angle(held, complement_rows(np.atleast_2d(truth["mechanisms"][0]["axis"]))) < np.radians(0.2)


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


def test_the_best_sequence_ignores_what_is_shorter_than_a_change_is_worth():
    """Viterbi's algorithm: boundaries to the sample, a brief lapse bridged, a brief coincidence left out; a recording
    that is in one state throughout pays for no change.
    """
    values, first = np.full((200, 2), -1.0), np.array([0, 200])
    values[40:100, 0] = 1.0
    values[60:63, 0] = -1.0  # lapse
    values[100:160, 1] = 1.0
    values[180:184, 1] = 1.0  # coincidence
    expected = np.zeros(200, dtype=int)
    expected[40:100], expected[100:160] = 1, 2
    assert np.array_equal(states_of(values, first, switch=10.0), expected)
    assert np.array_equal(states_of(values[:, :1], first, switch=10.0), np.where(expected == 1, 1, 0))
    assert np.array_equal(held_by(values, first, switch=10.0)[:, 0], expected == 1)
    assert gains_of(values, first, switch=10.0)[0, 0] == pytest.approx(57.0 - 3.0 - 10.0)
    late = np.where(np.arange(200) < 40, -1.0, 1.0)[:, None]
    assert gains_of(late, first, switch=10.0)[0, 0] == gains_of(late[::-1], first, switch=10.0)[0, 0] == 160.0 - 10.0
    assert gains_of(late, np.array([0, 50, 200]), switch=10.0)[:, 0].tolist() == [0.0, 150.0]
    brief = np.full((5, 1), 1.0)
    assert gains_of(brief, np.array([0, 5]), switch=10.0)[0, 0] == 5.0
    assert np.all(states_of(brief, np.array([0, 5]), switch=10.0) == 1)
    assert np.all(states_of(values, first, switch=np.inf) == 0)


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

    for k, seed in itertools.product((1, 2), range(12)):
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


def test_thinned_motion_stands_for_all_of_it() -> None:
    """About SCAN_RATE samples a second, one at least of each recording, from its middle; their weights are the time."""
    features, demos, _ = recordings("drawer", "panda", 2013, 3)
    motion = RowMotion.collect(features, [*demos, dataclasses.replace(demos[0], **_brief(demos[0]))])
    thin = motion.thinned()
    step = round(len(motion) / motion.weight.sum() / SCAN_RATE)
    assert step > 2 and thin.n_trajectories == 4
    for a, b, c, d in zip(motion.first, motion.first[1:], thin.first, thin.first[1:], strict=False):
        expected = motion.time[a:b][min(step, b - a) // 2 :: step]
        np.testing.assert_array_equal(thin.time[c:d], expected)
    assert thin.weight.sum() == pytest.approx(motion.weight.sum(), rel=0.05)


def _brief(t: Trajectory) -> dict[str, Any]:
    assert t.u is not None
    return {"time": t.time[:4], "q": t.q[:4], "u": t.u[:4], "name": "brief"}


def test_how_far_a_stretch_gets() -> None:
    """Along the rows, at all, and by white noise alone: from rates times the time of each sample, in numbers."""
    features, demos, _ = recordings("drawer", "panda", 2013, 1)
    motion = RowMotion.collect(features, demos)
    n, rng = len(motion), np.random.default_rng(3)
    weight = rng.uniform(0.5, 1.5, n) / 100.0
    noise, speed = 0.02, 0.3
    rates = np.column_stack([np.full(n, speed), noise * rng.normal(size=n), np.zeros(n)])
    made = dataclasses.replace(motion, rates=rates, weight=weight)
    whole = Stretch(0, float(motion.time[0]), float(motion.time[-1]))
    across = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
    far, total, by_noise = findings._drift(made, across, whole)
    sideways = np.cumsum(rates[:, 1] * weight)
    assert far == pytest.approx(np.ptp(sideways), rel=0.2)
    assert total == pytest.approx(speed * weight.sum(), rel=0.02)
    assert by_noise == pytest.approx(noise * np.sqrt(np.sum(weight**2)), rel=0.25)


def test_joints_that_move_at_once():
    """One for a joint alone, as many as there are for equal ones, whatever the pace."""
    pace = np.linspace(1.0, 2.0, 50)[:, None]
    assert joints_at_once(pace * [1.0, 0.0, 0.0], 1e-8) == pytest.approx(1.0)
    assert joints_at_once(pace * [1.0, -1.0, 1.0], 1e-8) == pytest.approx(3.0)
    assert joints_at_once(np.full((50, 3), 1e-5), 1e-8) == 0.0
