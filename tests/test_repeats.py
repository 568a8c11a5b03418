"""Copies, replays, rounds and pieces of one recording are evidence once; recordings of their own count each."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from generated_motions import arm_features, random_posture, smooth_drive
from scipy.interpolate import CubicSpline
from task_sets import arm, generated

import manip_learn as ml
from manip_learn.errors import NotIdentifiableError
from manip_learn.learning.repeats import IndependentRecordings
from manip_learn.recordings.trajectory import Demonstrations

Motion = tuple[np.ndarray, np.ndarray]


@pytest.fixture(scope="module")
def drawers() -> tuple[ml.FrameJacobian, list[Motion]]:
    """Phi of a drawer, and three motions with it."""
    truth, made = generated("drawer", "panda", 30001, 3, False)
    return ml.FrameJacobian(arm("panda"), truth["tip"], "xyz"), [(t.time, t.q) for t in made]


def named(motions: list[Motion]) -> list[ml.Trajectory]:
    return [ml.Trajectory(t, q, name=f"demo_{i}") for i, (t, q) in enumerate(motions)]


def at_rate(motion: Motion, rate: float, slower: float = 1.0, late: float = 0.0) -> Motion:
    """Chords between the samples at another rate, in another time."""
    t, q = motion
    at = np.arange(t[0], t[-1], 1.0 / rate / slower)
    return slower * at + late, np.column_stack([np.interp(at, t, column) for column in q.T])


def replayed(motion: Motion) -> Motion:
    """The path run faster, with noise of its own."""
    t, q = motion
    at = np.linspace(t[0], t[-1], int(0.8 * len(t)))
    return 0.8 * at, CubicSpline(t, q)(at) + np.random.default_rng(0).normal(0.0, 1e-4, (len(at), q.shape[1]))


def pieces(motion: Motion, *, clock: bool = False, shared: bool = False) -> list[Motion]:
    """Eight even parts, whose clocks start at 0 s unless they keep theirs."""
    cut = np.array_split(np.arange(len(motion[0])), 8)
    spans = [slice(part[0], part[-1] + 1 + (shared and k < 7)) for k, part in enumerate(cut)]
    return [(motion[0][s] - (0.0 if clock else motion[0][s.start]), motion[1][s]) for s in spans]


WAYS: dict[str, Callable[[Motion], list[Motion]]] = {
    "reversed": lambda m: [(m[0][-1] - m[0][::-1], m[1][::-1])],
    "at 15 Hz on a late clock": lambda m: [at_rate(m, 15.0, late=7.3)],
    "slower at 130 Hz": lambda m: [at_rate(m, 130.0, slower=1.7)],
    "replayed": lambda m: [replayed(m)],
    "a piece": lambda m: [(m[0][50:150], m[1][50:150])],
    "eight pieces": pieces,
}


@pytest.mark.parametrize("way", WAYS)
def test_what_repeats_is_left_out(way: str, drawers):
    """The three recordings are left as they are, and the warning names what repeats which."""
    given = named([*drawers[1], *WAYS[way](drawers[1][1])])
    found = IndependentRecordings.of(Demonstrations(given))
    assert [t.name for t in found.demonstrations] == ["demo_0", "demo_1", "demo_2"]
    assert all(t.q is one.q for t, one in zip(found.demonstrations, given, strict=False))
    assert any("demo_3" in w and "repeat" in w and "demo_1" in w and "they count once" in w for w in found.warnings)


def test_what_repeats_adds_nothing_but_a_warning(drawers):
    """Gap, uncertainty, counts, evidence and warnings are those without the repeats, which one more warning names."""
    features, motions = drawers
    alone = ml.ConstraintLearner(features).fit(named(motions)).report_
    report = ml.ConstraintLearner(features).fit(named([*motions, replayed(motions[1])])).report_
    assert report.n_trajectories == 3
    for what in ("gap", "uncertainty_deg", "row_evidence", "n_samples", "held_out_residual", "free_directions"):
        assert getattr(report, what) == getattr(alone, what), what
    (more,) = [w for w in report.warnings if w not in alone.warnings]
    assert set(alone.warnings) < set(report.warnings) and more.startswith("demo_3 repeats demo_1")


@pytest.mark.parametrize(("clock", "shared"), [(False, True), (True, False)])
def test_pieces_of_one_recording_are_the_uncut_recording(clock: bool, shared: bool, drawers):
    """Cut in eight, with or without its clock and the sample at each cut: the answer of the uncut one, said of the
    pieces on their own clocks.
    """
    features, motions = drawers
    whole = ml.ConstraintLearner(features).fit(named(motions)).report_
    given = named([*motions[:2], *pieces(motions[2], clock=clock, shared=shared)])
    report = ml.ConstraintLearner(features).fit(given).report_
    assert (report.n_trajectories, report.n_samples) == (3, whole.n_samples)
    assert report.uncertainty_deg == pytest.approx(whole.uncertainty_deg, rel=1e-3)
    assert [w for w in report.warnings if w not in whole.warnings] == [
        "demo_2 to demo_9 are pieces of one recording, each goes on where another ends; they count once"
    ]
    names = [t.name for t in given]
    assert [p.trajectory for p in report.phases] == names
    for phase, t in zip(report.phases, given, strict=True):
        assert t.time[0] <= phase.start < phase.end <= t.time[-1]


@pytest.mark.parametrize("noise", [0.0, 1e-2])
def test_demonstrations_of_their_own_count_each(noise: float):
    """Nothing repeats in what was demonstrated anew each time, be it a reach in nearly the same way."""
    for whole in (True, False):
        given = Demonstrations(generated("free_repeated", "xarm7", 20000, 6, whole, noise=noise)[1])
        found = IndependentRecordings.of(given)
        assert found.demonstrations is given and not found.warnings


def excitation(periods: float, noise: float = 1e-4) -> ml.Trajectory:
    """A programmed motion in the air, of some periods of 12 s, with noise."""
    robot, rng = arm("panda"), np.random.default_rng(3)
    t, n = np.arange(0.0, 12.0 * periods, 0.01), len(robot.joint_names)
    phases = [np.outer(2.0 * np.pi * k / 12.0 * t, np.ones(n)) for k in range(1, 6)]
    q = sum(rng.normal(size=n) / k * np.sin(x) + rng.normal(size=n) / k * np.cos(x) for k, x in enumerate(phases, 1))
    reach = 0.38 * (robot.position_upper - robot.position_lower) / np.abs(q).max(axis=0)
    q = q * reach + 0.5 * (robot.position_lower + robot.position_upper)
    return ml.Trajectory(t, q + rng.normal(0.0, noise, q.shape), None, robot.joint_names, "calibration")


@pytest.mark.parametrize(("periods", "noise"), [(1.3, 1e-3), (3.0, 0.0)])
def test_what_goes_round_in_one_file_counts_once(periods: float, noise: float):
    """Its first period is kept, whatever the noise; one period and what is not quite one are kept whole."""
    found = IndependentRecordings.of(Demonstrations([excitation(periods, noise)]))
    assert found.demonstrations[0].duration == pytest.approx(12.0, abs=0.5)
    assert [w.partition(" from 1")[0] for w in found.warnings] == ["calibration repeats itself"]
    for once in (0.9, 1.0):
        given = Demonstrations([excitation(once, noise)])
        assert IndependentRecordings.of(given).demonstrations is given


def refused(n: int, **settings) -> NotIdentifiableError:
    """Said of n slow recordings of free motion in which the second joint stays where it is."""
    features, rng, t, made = arm_features(), np.random.default_rng(0), np.arange(200) * 0.02, []
    for _ in range(n):
        drive = smooth_drive(7, rng, 0.005)
        u = np.array([drive(x) for x in t]) * [1.0, 0.0, 1.0, 1.0, 1.0, 1.0, 1.0]
        q = random_posture(features.robot, rng, 0.2) + np.cumsum(0.02 * u, axis=0)
        made.append(ml.Trajectory(t, q, u, features.robot.joint_names, exact=True))
    with pytest.raises(NotIdentifiableError) as said:
        ml.ConstraintLearner(features, **settings).fit(made)
    return said.value


def test_advice_names_each_likely_cause():
    """Too few recordings, phases, joints that stay, slow motion: each has its advice, the likeliest two are said."""
    joint = arm_features().robot.joint_names[1]
    few = "record at least 3, better 5, with different paths and postures, not 2 recordings"
    lock = f"move joint {joint} too, or lock joints that should not move (load_robot(..., locked=['{joint}']))"
    slow = "move faster: encoder noise hides a motion in which no joint exceeds 0.01"
    cut = "cut the recordings to the contact"
    said = refused(2)
    assert said.advice[0] == few and str(said).startswith(f"{few}; or {said.advice[1]}. ")
    assert lock in said.advice and any(one.startswith(slow) for one in said.advice)
    assert any(one.startswith(cut) for one in refused(3, phases="off").advice)
