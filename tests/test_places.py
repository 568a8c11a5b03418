"""Where a mechanism is, told from positions: two setups, a thing that was moved, an arm that is off, other shapes."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
from mechanism_motions import along, demonstrate, stroke, wave
from scipy.spatial.transform import Rotation
from task_sets import arm

import manip_learn as ml

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "benchmarks"))

MIDDLE = {
    "panda": ("panda_hand_tcp", (0.0, -0.3, 0.0, -1.9, 0.0, 1.7, 0.6)),
    "xarm7": ("link_eef", (0.0, -0.2, 0.0, 1.2, 0.0, 1.4, 0.0)),
}
AXES = {"drawer": np.array([[0.8, 0.6, 0.0]]), "table": np.array([[1.0, 0.0, 0.1], [0.0, 1.0, 0.0]])}


def recordings(name: str, paths: list, seed: int, noise: float = 1e-4) -> list[ml.Trajectory]:
    """One recording of each path."""
    robot, (frame, middle), rng = arm(name), MIDDLE[name], np.random.default_rng(seed)
    made = [demonstrate(robot, frame, np.array(middle), path, rng, n=1, noise=noise)[0] for path in paths]
    return [ml.Trajectory(t.time, t.q, None, t.joint_names, f"demo_{i}") for i, t in enumerate(made)]


def learner(name: str, demos: list[ml.Trajectory]) -> ml.ConstraintLearner:
    """What is learnt of the hand's place."""
    return ml.ConstraintLearner(ml.FrameJacobian(arm(name), MIDDLE[name][0], "xyz")).fit(demos)


def turned(degrees: float, about: tuple[float, float, float] = (0.0, 0.0, 1.0)) -> Rotation:
    """A rotation."""
    return Rotation.from_rotvec(np.radians(degrees) * np.array(about))


def angle(constraint: ml.Constraint, free: np.ndarray) -> float:
    """Largest angle by which directions that are free leave what is held [deg]."""
    held = np.linalg.qr(constraint.selection.T)[0]
    along_it = np.linalg.qr(free.T)[0]
    return float(np.degrees(np.arcsin(min(1.0, np.linalg.norm(held.T @ along_it, 2)))))


@pytest.mark.parametrize(("kind", "name"), [("drawer", "xarm7"), ("table", "panda")])
def test_two_setups_a_degree_apart_are_learnt_apart(kind: str, name: str) -> None:
    """Half of the recordings each; averaged they would be half a degree off both, without a word."""
    other = turned(1.0, (0.0, 0.7, 0.7)).apply(AXES[kind])
    paths = [along(other if i % 2 else AXES[kind], 0.25, firm=False) for i in range(8)]
    found = learner(name, recordings(name, paths, 3))
    assert len(found.constraints_) == 2
    best = [min(angle(c, free) for c in found.constraints_) for free in (AXES[kind], other)]
    assert max(best) < 0.25
    assert any("differ by" in w for w in found.report_.warnings)
    assert any("2 tasks" in w for w in found.report_.warnings)


@pytest.mark.parametrize("name", ["panda", pytest.param("xarm7", marks=pytest.mark.slow)])
def test_what_was_moved_between_recordings_is_learnt_as_it_stood_last(name: str) -> None:
    """A drawer that stood elsewhere in each recording; all recordings count as contacts with it."""
    stood = [turned(a).apply(AXES["drawer"]) for a in (-4.0, 3.0, -1.5, 5.0, 1.0, -2.5)]
    found = learner(name, recordings(name, [along(free, 0.25, firm=False) for free in stood], 5))
    assert len(found.constraints_) == 1 and found.constraint_.n_constraints == 2
    assert angle(found.constraint_, stood[-1]) < 0.3
    assert any("moved between recordings" in w and "demo_5" in w for w in found.report_.warnings)
    assert {p.trajectory for p in found.report_.phases if p.constraint == 0} == {f"demo_{i}" for i in range(6)}
    assert not found.report_.odd_trajectories


@pytest.mark.parametrize("name", ["xarm7", pytest.param("panda", marks=pytest.mark.slow)])
def test_an_arm_whose_zeros_are_off_sees_one_drawer(name: str) -> None:
    """By a degree, with encoders so fine that every posture shows another direction clearly."""
    demos = recordings(name, [along(AXES["drawer"], 0.2, firm=False)] * 8, 7, noise=2e-5)
    zeros = np.radians(np.random.default_rng(1).normal(0.0, 1.0, demos[0].q.shape[1]))
    off = [ml.Trajectory(t.time, t.q + zeros, None, t.joint_names, t.name) for t in demos]
    found = learner(name, off)
    assert len(found.constraints_) == 1 and found.constraint_.n_constraints == 2
    assert not any("moved" in w or "tasks" in w for w in found.report_.warnings)


@pytest.mark.parametrize("name", ["panda", pytest.param("xarm7", marks=pytest.mark.slow)])
def test_a_bent_rail_is_a_curve_and_no_ball(name: str) -> None:
    """Two rows at each place, and the length that was shown."""

    def rail(pose: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, None]:
        s = stroke(rng, 0.3)[:, None]
        return pose[:3, 3] + np.hstack([0.3 * s, s, 0.05 * np.sin(s / 0.08)]), None

    demos = recordings(name, [rail] * 6, 9)
    found = learner(name, demos)
    assert found.constraint_.n_constraints == 2
    assert found.report_.mechanism is not None and found.report_.mechanism.name == "curve"
    assert "curve of" in found.report_.sentence and "rail" in found.report_.sentence
    for t in demos:
        off = np.array([found.constraint_.features.coordinates(q) for q in t.q[::10]])
        assert np.abs(off).max() < 5e-4
    assert found.constraint_.shown is not None and found.constraint_.shown.unit == "m"


@pytest.mark.parametrize("name", ["xarm7", pytest.param("panda", marks=pytest.mark.slow)])
def test_a_wide_cylinder_is_no_plane(name: str) -> None:
    """Of a metre's radius: a plane would be left by millimetres."""

    def side(pose: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, None]:
        way = wave(rng, np.array([0.14, 0.14]))
        phi = way[:, 0] / 1.0
        return pose[:3, 3] + np.column_stack([np.sin(phi), way[:, 1], np.cos(phi) - 1.0]), None

    found = learner(name, recordings(name, [side] * 6, 11))
    mechanism = found.report_.mechanism
    assert found.constraint_.n_constraints == 1
    assert mechanism is not None and mechanism.name == "cylinder"
    assert mechanism.radius == pytest.approx(1.0, rel=0.05)
    assert abs(mechanism.axis[1]) > 0.999


# of benchmarks/fits_end.py: three for which a part was divided by its places, joined and divided again for ever (6, 79,
# 84), and others of each kind, whole and cut
SETS = (84, 2, 3, 4, 8, 9, 10, 12, 14, 16, 18, 22, 24, 26, 28, 30, 32, 34)


@pytest.mark.parametrize("number", [*SETS, *(pytest.param(n, marks=pytest.mark.slow) for n in (6, 79, 1, 5, 7, 11))])
def test_a_fit_ends(number: int) -> None:
    """With an answer or a refusal."""
    from fits_end import drawn, fitted

    given = drawn(number)
    assert given is None or fitted(*given[1:])  # None: the arm cannot do what was drawn
