"""The recombination test: rows that the world holds are found, and nothing else is called certain."""

from __future__ import annotations

import numpy as np
import pytest
from generated_motions import arm_features, guided_motions, oblique, random_posture, smooth_drive

from manip_learn.constraint.features import CustomFeatures, FrameJacobian
from manip_learn.learning.gate import Evidence, recombined
from manip_learn.recordings.trajectory import Trajectory
from manip_learn.robot.robot import Robot

FREE = ("reaches", "wandering", "repeated reach", "one joint at a time", "slow reaches")


def states(found: Evidence) -> list[str]:
    return [row.state for row in found.rows]


def verdict(found: Evidence) -> str:
    return found.verdict(found.n_rows)


def reach(robot: Robot, start: np.ndarray, way: np.ndarray, seconds: float, name: str = "reach") -> Trajectory:
    """A straight reach in the joints, smooth from rest to rest."""
    time = np.linspace(0.0, seconds, max(int(60 * seconds), 5))
    s = (time / seconds)[:, None]
    q = start + way * (10 * s**3 - 15 * s**4 + 6 * s**5)
    return Trajectory(time, q, way * 30 * s**2 * (1 - s) ** 2 / seconds, robot.joint_names, name)


def free_motions(kind: str, robot: Robot, rng: np.random.Generator, n: int = 5) -> list[Trajectory]:
    """Motions of an arm that nothing holds."""
    centre, usual = random_posture(robot, rng, 0.2), 0.4 * rng.standard_normal(robot.nv)
    out = []
    for _ in range(n):
        seconds, start = rng.uniform(1.5, 3.0), centre + 0.2 * rng.standard_normal(robot.nv)
        if kind == "reaches":
            out.append(reach(robot, start, 0.5 * rng.standard_normal(robot.nv), seconds))
        elif kind == "slow reaches":
            out.append(reach(robot, start, 0.1 * rng.standard_normal(robot.nv), 4 * seconds))
        elif kind == "repeated reach":
            way = usual + 0.02 * rng.standard_normal(robot.nv)
            out.append(reach(robot, centre + 0.01 * rng.standard_normal(robot.nv), way, seconds))
        elif kind == "wandering":
            time, drive = np.arange(0.0, seconds, 0.02), smooth_drive(robot.nv, rng)
            u = np.array([drive(t) for t in time])
            out.append(Trajectory(time, start + 0.02 * np.cumsum(u, axis=0), u, robot.joint_names))
        else:
            legs = [np.eye(robot.nv)[rng.integers(robot.nv)] * rng.normal(0.0, 0.6) for _ in range(6)]
            parts = [reach(robot, start + sum(legs[:i], np.zeros(robot.nv)), legs[i], 0.6) for i in range(6)]
            time = np.concatenate([p.time + 0.7 * i for i, p in enumerate(parts)])
            q, u = (np.vstack([getattr(p, name) for p in parts]) for name in ("q", "u"))
            out.append(Trajectory(time, q, u, robot.joint_names))
    return out


def held_motions(s: int, seed: int, n: int = 5, noise: float = 0.02) -> tuple[FrameJacobian, list[Trajectory]]:
    features, rng = arm_features(), np.random.default_rng(seed)
    demos, _ = guided_motions(features, oblique(s, 3, rng), rng, n, 100, noise=noise)
    return features, list(demos)


@pytest.mark.parametrize("kind", FREE)
def test_free_motion_is_never_called_held_for_certain(kind):
    """Nothing holds the arm, however it is moved: no set of five demonstrations may give a clear answer."""
    for axes, seed in (("xyz", 0), ("pose", 1), ("pose", 2)):
        features = arm_features(axes)
        found = recombined(features, free_motions(kind, features.robot, np.random.default_rng(seed)), seed)
        assert verdict(found) != "clear", (axes, seed, found)


def test_chance_finds_a_row_as_rarely_as_its_p_value_says():
    """Joints that move independently are the null hypothesis itself: p <= 0.2 in about a fifth of the cases."""
    features = arm_features()
    p = [
        recombined(features, free_motions("wandering", features.robot, np.random.default_rng(seed)), seed).chances[0]
        for seed in range(40)
    ]
    assert np.count_nonzero(np.array(p) <= 0.2) <= 16  # of 40, 8 expected: chance of more 0.2 %
    assert np.median(p) > 0.2


@pytest.mark.parametrize("s", [1, 2])
def test_held_rows_are_counted_and_clear(s):
    """Five noisy demonstrations of a contact give the right number of rows."""
    features, rng = arm_features(), np.random.default_rng(0)
    selection = oblique(s, 3, rng)
    found = recombined(features, list(guided_motions(features, selection, rng, 5, 100, noise=0.02)[0]))
    assert (found.n_rows, verdict(found)) == (s, "clear"), found
    assert states(found) == ["held"] * s + ["free"] * (3 - s)


def of_numbers(strengths, lower=None, p_values=None, levels=(0.01, 0.1, 1.0), **options) -> Evidence:
    """Evidence of five recordings, with numbers of one's own."""
    p, lower = p_values or (0.005,) * 3, lower or strengths
    return Evidence(*map(np.array, (strengths, lower, p, levels)), 5, **options)


def test_the_verdict_is_that_of_its_numbers():
    """A row counts by what its strength exceeds with 99 % confidence: clear from 4, weak from 1.8; no row does with
    more chance than 1 %, none behind one that is hardly stronger than chance unless it was never tried, and one that is
    so itself does not count last.
    """
    found = of_numbers((10.0, 6.0, 0.9))
    assert (found.n_rows, verdict(found), states(found)) == (2, "clear", ["held", "held", "free"])
    assert [row.p_value for row in found.rows] == [0.005] * 3
    for strengths, lower, options, n_rows in (
        ((10.0, 2.0, 0.9), (9.0, 1.58, 0.8), {}, 1),
        ((1.4, 3.0, 0.9), None, {}, 2),  # the first has the least of what noise there is
        ((1.2, 9.0, 0.9), None, {}, 2),  # never tried: the least used, and as little when joints are exchanged
        ((9.0, 1.2, 9.0), None, {}, 1),
        ((9.0, 9.0, 0.9), None, {"p_values": (0.005, 0.011, 0.5)}, 1),
        ((9.0, 8.0, 0.9), None, {"believed": 8.5}, 1),
        ((1.0, 0.9, 0.8), None, {"firm": 2}, 2),
    ):
        assert of_numbers(strengths, lower, **options).n_rows == n_rows
    assert verdict(of_numbers((3.0, 2.5, 0.9))) == "weak"
    assert states(of_numbers((9.0, 1.2, 2.0))) == ["held", "untried", "free"]
    assert states(of_numbers((9.0, 1.0, 0.9), levels=(0.01, 0.2, 1.0))) == ["held", "free", "free"]


def test_the_choice_is_paid_for():
    """The best of a hundred hypotheses: 3.719 standard deviations of log strength instead of 2.326."""
    features, trajectories = held_motions(2, 7)
    spread = []
    for choices, z in ((1.0, 2.32635), (100.0, 3.7190)):
        found = recombined(features, trajectories, choices=choices)
        spread.append(np.log(found.strengths / found.lower) / z)
    np.testing.assert_allclose(*spread, rtol=0.2)  # of so many draws


def test_a_repeated_reach_is_untried_not_held():
    """What a repeated reach leaves out was never tried: it is neither held nor free."""
    features = arm_features("pose")
    found = recombined(features, free_motions("repeated reach", features.robot, np.random.default_rng(1)))
    assert found.n_rows == 0
    assert "untried" in states(found)


def test_how_it_is_written_down_does_not_matter():
    """Rows in millimetres and mixed; joints and trajectories in another order; a drawer that is closed instead of
    opened, or at another speed: the same levels, and strengths but for the draw of the recombinations.
    """
    features, trajectories = held_motions(2, 7)
    mix = np.array([[1000.0, 2.0, 0.0], [0.0, 0.3, 1.0], [5.0, 0.0, 0.01]])
    order = np.random.default_rng(0).permutation(features.nv)
    back, names = np.argsort(order), tuple(features.robot.joint_names[j] for j in order)
    plain = recombined(features, trajectories)
    for changed, given, levels, strengths in (
        (CustomFeatures(lambda q: mix @ features(q), ("a", "b", "c"), features.nv), trajectories, 1e-6, 1e-6),
        (
            CustomFeatures(lambda q: features(q[back])[:, order], features.row_names, features.nv),
            [Trajectory(t.time, t.q[:, order], np.asarray(t.u)[:, order], names) for t in trajectories[::-1]],
            1e-9,
            0.25,
        ),
        (
            features,
            [
                Trajectory(3.0 * t.time, t.q[::-1], -np.asarray(t.u)[::-1] / 3.0, t.joint_names) if i % 2 else t
                for i, t in enumerate(trajectories)
            ],
            0.05,
            0.5,
        ),
    ):
        other = recombined(changed, given)
        np.testing.assert_allclose(other.levels, plain.levels, rtol=levels)
        np.testing.assert_allclose(other.strengths, plain.strengths, rtol=strengths)
        assert (other.n_rows, verdict(other)) == (2, "clear")


def joined(parts: list[Trajectory], pause: float = 0.05) -> Trajectory:
    """Motions one after the other, each from where the last one ended."""
    times, ends = [], 0.0
    for part in parts:
        times.append(ends + part.time)
        ends = times[-1][-1] + pause
    q, u = (np.vstack([getattr(part, name) for part in parts]) for name in ("q", "u"))
    return Trajectory(np.concatenate(times), q, u, parts[0].joint_names)


def test_out_and_back_with_other_turning_points_is_not_held():
    """A reach there and part of the way back, turned at another time each time, must not look like a contact."""
    features, rng = arm_features("pose"), np.random.default_rng(8)
    start, way, trajectories = random_posture(features.robot, rng, 0.2), 0.5 * rng.standard_normal(features.nv), []
    for turn, share in zip((0.6, 0.9, 1.3, 1.7, 2.0), (1.0, 0.8, 0.6, 0.4, 0.2), strict=True):
        there = reach(features.robot, start, way + 0.01 * rng.standard_normal(features.nv), turn)
        trajectories.append(joined([there, reach(features.robot, there.q[-1], -share * way, 2.6 - turn)]))
    found = recombined(features, trajectories)
    assert verdict(found) != "clear"
    assert max(found.strengths) < 4.0


def test_the_same_way_taken_in_both_directions_is_not_held():
    """A repeated reach round a corner, half of the time from its end to its start, is still a repeated reach."""
    features, rng = arm_features("pose"), np.random.default_rng(4)
    start, (one, two), trajectories = random_posture(features.robot, rng, 0.2), 0.4 * rng.standard_normal((2, 7)), []
    two = two if one @ two > 0.0 else -two
    for i in range(6):
        legs = [one, two] + 0.01 * rng.standard_normal((2, 7))
        first = reach(features.robot, start, legs[0], 1.0)
        there = joined([first, reach(features.robot, first.q[-1], legs[1], 1.5)])
        back = Trajectory(there.time[-1] - there.time[::-1], there.q[::-1], -there.u[::-1], there.joint_names)  # type: ignore[index]
        trajectories.append(back if i % 2 else there)
    assert recombined(features, trajectories).n_rows == 0


def test_a_held_row_does_not_make_the_next_one_look_held():
    """Once its joints are exchanged a held row is used much; a free row that is used little stays as it was."""
    rng, trajectories = np.random.default_rng(0), []
    plain = CustomFeatures(lambda q: np.eye(3), ("a", "b", "c"), 3)
    for _ in range(6):
        time, drive = np.arange(0.0, 3.0, 0.02), smooth_drive(3, rng)
        u = np.array([drive(t) for t in time]) * [1.0, 1.0, 0.25]
        u[:, 1] = -u[:, 0]  # a + b is held, c is hardly used
        trajectories.append(Trajectory(time, np.cumsum(0.02 * u, axis=0), u, ("1", "2", "3")))
    found = recombined(plain, trajectories)
    assert found.n_rows == 1
    assert found.strengths[0] > 100.0
    assert found.strengths[1] < 1.3


def test_what_few_strokes_leave_out_by_chance_is_no_evidence():
    """Five straight strokes use five of six directions; the sixth is not theirs in common: another stroke uses it."""
    features = arm_features("pose")
    first = [
        recombined(features, free_motions("slow reaches", features.robot, np.random.default_rng(seed)), seed).strengths[
            0
        ]
        for seed in range(3)
    ]
    assert max(first) < 0.8


@pytest.mark.parametrize("n", [1, 2])
def test_fewer_than_three_trajectories_are_never_certain(n):
    """However firmly it is held, one or two demonstrations give a weak answer and say why."""
    features, trajectories = held_motions(2, 10, n, noise=0.0)
    found = recombined(features, trajectories)
    assert found.n_rows == 2
    assert verdict(found) == "weak"
    assert "too few to be sure" in found.sentence()


def test_one_point_to_point_motion_shows_nothing():
    """A single straight reach uses one direction of six; none of the five others may be called held."""
    features = arm_features("pose")
    for seed in range(2):
        rng = np.random.default_rng(seed)
        single = reach(features.robot, random_posture(features.robot, rng, 0.2), rng.standard_normal(7) * 0.3, 2.0)
        found = recombined(features, [single], seed)
        assert verdict(found) == "none", found


def test_trajectories_that_say_nothing_are_left_out():
    """Rest, single samples and different lengths are no errors; nothing at all gives no rows and says so."""
    features, trajectories = held_motions(2, 11, 6)
    joints, q = features.robot.joint_names, trajectories[0].q
    still = Trajectory(np.arange(50.0), q[:50], np.zeros((50, 7)), joints)
    single = Trajectory(np.zeros(1), q[:1], np.ones((1, 7)), joints)
    uneven = [t.part(slice(0, 30 + 14 * i)) for i, t in enumerate(trajectories)]
    found = recombined(features, [still, *uneven, single])
    assert (found.n_rows, found.n_pieces) == (2, 6)
    for nothing in ([], [still, still, still]):
        empty = recombined(features, nothing)
        assert (empty.n_rows, verdict(empty)) == (0, "none")
        assert "do not move" in empty.sentence()
