"""Mechanisms from recordings: the right type, accurate places, honest uncertainty, no answer where there is none; two
setups, a thing that was moved, an arm that is off, other shapes; whole recordings, divided where a contact begins.
"""

from __future__ import annotations

import re

import numpy as np
import pytest
from mechanism_motions import T, about, along, ball, demonstrate, stroke, wave
from scipy.spatial.transform import Rotation
from task_sets import arm, learnt, moving

import manip_learn as ml
from manip_learn.constraint.mechanism import KIND_BY_NAME
from manip_learn.constraint.place import Place, across
from manip_learn.errors import NotIdentifiableError
from manip_learn.learning.place import Placement

AXIS = np.array([0.2, -0.3, 0.93]) / np.linalg.norm([0.2, -0.3, 0.93])
PITCH = 0.04
MIDDLE = {
    "panda": [0.2, -0.4, 0.1, -2.0, 0.1, 1.7, 0.8],
    "ur5": [0.3, -1.3, 1.7, -1.9, -1.4, 0.2],
    "planar3": [0.4, 0.9, 0.7],
}
TIP = {"panda": "panda_hand_tcp", "ur5": "tool0", "planar3": "tip"}


def place(robot, name, distance=0.3):
    """A point so far from the tip, straight across AXIS."""
    handle = robot.position(np.array(MIDDLE[name]), robot.frame(TIP[name]))
    return handle + distance * (0.6 * across(AXIS)[0] + 0.8 * across(AXIS)[1])


def paths(point):
    """Name -> (path, type, rows)."""
    return {
        "line": (along(AXIS[None], 0.2, False), "line", 2),
        "plane": (along(across(AXIS), 0.12, False), "plane", 1),
        "hinge": (about(AXIS, point, 0.7, firm=False), "hinge", 2),
        "hinge, firm": (about(AXIS, point, 0.7), "hinge", 5),
        "ball": (ball(point, 0.25, False), "ball", 1),
        "ball, firm": (ball(point, 0.25, True), "ball", 3),
        "screw": (about(AXIS, point, 1.2, pitch=PITCH, firm=False), "screw", 2),
        "screw, firm": (about(AXIS, point, 0.8, pitch=PITCH), "screw", 5),
        "sleeve": (about(AXIS, point, 0.8, slide=0.08), "other", 4),
    }


def record(robot_of, name, path, seed=0, **options):
    robot, rng = robot_of(name), np.random.default_rng(seed)
    return demonstrate(robot, TIP[name], np.array(MIDDLE[name]), path, rng, **options)


def fit(robot_of, name, demos, axes="pose") -> ml.ConstraintLearner:
    return ml.ConstraintLearner(ml.FrameJacobian(robot_of(name), TIP[name], axes), joint_offset_std=0.0).fit(demos)


def find(robot_of, name, demos) -> ml.Mechanism:
    m = fit(robot_of, name, demos).report_.mechanism
    assert m is not None
    return m


def degrees_between(a, b):
    return float(np.degrees(np.arcsin(min(1.0, np.linalg.norm(np.cross(a, b))))))


@pytest.mark.parametrize(
    ("name", "kind"), [("ur5" if k in ("plane", "screw, firm") else "panda", k) for k in paths(np.zeros(3))]
)
def test_type_and_place(robot_of, name, kind):
    """With encoder noise of 1e-4 rad and only 300 samples: the right type and rows, axis within 0.25 degrees, place and
    radius within 1 mm, pitch within 1 %, each within four or five of its standard deviations; and the constraint holds
    on the motion itself.
    """
    robot = robot_of(name)
    point = place(robot, name)
    path, kind_of, rows = paths(point)[kind]
    learner = fit(robot_of, name, record(robot_of, name, path))
    constraint, m = learner.constraint_, learner.report_.mechanism
    assert m is not None and (m.type, constraint.n_constraints) == (kind_of, rows)
    assert m.grip == ("firm" if "firm" in kind or kind == "sleeve" else "loose")
    if m.axis is not None:
        assert degrees_between(m.axis, AXIS) < min(0.25, 4.0 * m.uncertainty["axis"] + 1e-3)
        if isinstance(constraint.features, ml.MechanismRows):  # a turn of a task counts about the axis that is told
            assert float(constraint.features.geometry.axis @ m.axis) > 0.99
    if kind_of in ("hinge", "ball", "screw", "other"):
        off = m.point - point
        off = np.linalg.norm(off if m.axis is None else off - (off @ AXIS) * AXIS)
        assert off < min(1e-3, 5.0 * m.uncertainty["point"] + 1e-5)
        assert m.radius == pytest.approx(0.3, abs=min(1e-3, 5.0 * m.uncertainty["radius"] + 1e-5))
    assert (m.pitch is not None) == (kind_of == "screw")
    if m.pitch is not None:
        assert m.pitch == pytest.approx(PITCH, abs=min(4e-4, 4.0 * m.uncertainty["pitch"] + 1e-6))
    q = record(robot_of, name, path, n=1, noise=0.0)[0].q
    step, middle = np.diff(q, axis=0), 0.5 * (q[1:] + q[:-1])
    left = np.array([constraint(x) @ u for x, u in zip(middle, step, strict=True)])
    free = np.array([robot.jacobian(x, robot.frame(TIP[name])) @ u for x, u in zip(middle, step, strict=True)])
    assert np.sqrt(np.sum(left**2) / np.sum(free**2)) < 3e-3


def test_a_planar_arm(robot_of):
    """Rows that a planar arm cannot move anyway are left out: a hinge leaves it one row, and mu is not zero."""
    robot, up, q = robot_of("planar3"), np.array([0.0, 0.0, 1.0]), np.array(MIDDLE["planar3"])
    centre = robot.position(q, robot.frame("tip")) + np.array([0.5, -0.4, 0.0])
    learner = fit(robot_of, "planar3", record(robot_of, "planar3", about(up, centre, 0.6, firm=False)), "xyz")
    m, constraint = learner.report_.mechanism, learner.constraint_
    assert m is not None and m.type == "hinge"
    np.testing.assert_allclose(m.point[:2], centre[:2], atol=4e-3)
    assert constraint.n_constraints == 1 and constraint.manipulability(q) > 0.1


def test_a_short_arc_is_known_badly_and_says_so(robot_of):
    """Five degrees of a door: the radius is off by far more than on forty, and its standard deviation says
    so.
    """
    point, sigmas = place(robot_of("panda"), "panda"), {}
    for arc in (5.0, 40.0):
        path = about(AXIS, point, np.radians(arc), firm=False)
        m = find(robot_of, "panda", record(robot_of, "panda", path))
        sigmas[arc] = m.uncertainty["radius"]
        assert m.type == "hinge" and abs(m.radius - 0.3) < 4.0 * sigmas[arc]
    assert sigmas[5.0] > 20.0 * sigmas[40.0]


def test_too_short_an_arc_is_not_called_straight_without_a_word(robot_of):
    """Three degrees of a door with bad encoders: a line, or a hinge whose place is known badly and is warned of."""
    point = place(robot_of("panda"), "panda")
    path = about(AXIS, point, np.radians(3.0), firm=False)
    demos = record(robot_of, "panda", path, n=3, noise=5e-4)
    features = ml.FrameJacobian(robot_of("panda"), TIP["panda"], "pose")
    report = ml.ConstraintLearner(features, joint_offset_std=0.0).fit(demos).report_
    if report.mechanism is not None and report.mechanism.type == "line":
        assert any("would fit as well" in w for w in report.warnings)
    elif report.mechanism is not None:
        assert report.mechanism.uncertainty["radius"] > 0.005


def test_a_hand_that_turns_alike_each_time_is_no_screw(robot_of):
    """A drawer drawn three times along one path, the hand turning with the way: a line, not a helix near it."""

    def path(pose, rng):
        p, _ = along(AXIS[None], 0.25, False)(pose, rng)
        turn = Rotation.from_rotvec(0.8 * np.outer((p - pose[:3, 3]) @ AXIS, across(AXIS)[0]))  # 11 degrees
        return p, turn.as_matrix() @ pose[:3, :3]

    m = find(robot_of, "panda", record(robot_of, "panda", path, n=3, grip=0.02))
    assert m.type == "line" and degrees_between(m.axis, AXIS) < 0.25


def test_what_is_no_mechanism(robot_of):
    """Arms that wander freely, or that go the same curved way again and again, are held by nothing; of doors in
    different places no common place is invented.
    """
    s = np.linspace(0.0, 1.0, T)
    shape, given = 10 * s**3 - 15 * s**4 + 6 * s**5, []
    for repeats in (False, True):
        robot, rng, demos = robot_of("panda"), np.random.default_rng(0), []
        goal = repeats * rng.normal(0.0, 0.5, robot.nv)
        for _ in range(6):
            q = MIDDLE["panda"] + wave(rng, np.full(robot.nv, 0.004 if repeats else 0.4))
            q = q + np.outer(shape, goal + repeats * rng.normal(0.0, 0.01, robot.nv)) + rng.normal(0.0, 1e-4, q.shape)
            demos.append(ml.Trajectory(np.arange(T) * 0.02, q, None, robot.joint_names))
        given.append(demos)
    doors = []
    for i, distance in enumerate((0.25, 0.33, 0.42, 0.5)):
        axis = AXIS + 0.15 * np.array([np.cos(2.0 * i), np.sin(2.0 * i), 0.0])
        path = about(axis / np.linalg.norm(axis), place(robot_of("panda"), "panda", distance), 0.6)
        doors += record(robot_of, "panda", path, seed=i, n=1)
    for demos in [*given, doors]:
        with pytest.raises(NotIdentifiableError):
            fit(robot_of, "panda", demos)


@pytest.mark.parametrize(
    ("off", "point", "doubted"), [(None, 5e-3, False), (0.9, 5e-3, False), (1.1, 5e-3, True), (0.0, 6e-3, True)]
)
def test_a_place_that_is_known_badly_is_doubted(off, point, doubted):
    """From a degree of the direction on, or of the place seen from the hand; it says how far the motion went."""
    m = ml.Mechanism("hinge", AXIS, np.zeros(3), 0.3, uncertainty={"axis": 0.1, "point": point}, arc=0.5)
    doubt = Placement(m, KIND_BY_NAME["hinge"], Place(AXIS, np.zeros(3)), off).doubt
    assert (f"known badly, to {1e3 * point:.2g} mm" in doubt) == doubted
    assert not doubted or re.match(r"move it by at least \d+ degrees, not 29: ", doubt)
    line = ml.Mechanism("line", AXIS, uncertainty={"axis": 60.0})
    assert Placement(line, KIND_BY_NAME["line"], Place(AXIS, np.zeros(3)), 60.0).doubt == ""


# ---- setups, places and shapes ------------------------------------------------------------------------------------

HANDS = {
    "panda": ("panda_hand_tcp", (0.0, -0.3, 0.0, -1.9, 0.0, 1.7, 0.6)),
    "xarm7": ("link_eef", (0.0, -0.2, 0.0, 1.2, 0.0, 1.4, 0.0)),
}
DRAWER = np.array([[0.8, 0.6, 0.0]])


def recordings(name: str, given: list, seed: int, noise: float = 1e-4, zeros: float = 0.0) -> list[ml.Trajectory]:
    """One recording of each path, the joints' zeros off by some degrees."""
    robot, (frame, middle), rng = arm(name), HANDS[name], np.random.default_rng(seed)
    made = [demonstrate(robot, frame, np.array(middle), path, rng, n=1, noise=noise)[0] for path in given]
    off = np.radians(np.random.default_rng(1).normal(0.0, zeros, robot.nv))
    return [ml.Trajectory(t.time, t.q + off, None, t.joint_names, f"demo_{i}") for i, t in enumerate(made)]


def learner_of(name: str, demos: list[ml.Trajectory]) -> ml.ConstraintLearner:
    """What is learnt of the hand's place."""
    return ml.ConstraintLearner(ml.FrameJacobian(arm(name), HANDS[name][0], "xyz")).fit(demos)


def turned(degrees: float, axis: tuple[float, float, float] = (0.0, 0.0, 1.0)) -> Rotation:
    """A rotation."""
    return Rotation.from_rotvec(np.radians(degrees) * np.array(axis))


def angle(constraint: ml.Constraint, free: np.ndarray) -> float:
    """Largest angle by which directions that are free leave what is held [deg]."""
    inside = constraint.selection @ np.linalg.qr(free.T)[0]
    return float(np.degrees(np.arcsin(min(1.0, np.linalg.norm(inside, 2)))))


def test_two_setups_a_degree_apart_are_learnt_apart() -> None:
    """Half of the recordings each; averaged they would be half a degree off both, without a word."""
    other = turned(1.0, (0.0, 0.7, 0.7)).apply(DRAWER)
    given = [along(other if i % 2 else DRAWER, 0.25, firm=False) for i in range(8)]
    found = learner_of("xarm7", recordings("xarm7", given, 3))
    assert len(found.constraints_) == 2
    assert max(min(angle(c, free) for c in found.constraints_) for free in (DRAWER, other)) < 0.25
    assert all(any(words in w for w in found.report_.warnings) for words in ("differ by", "2 tasks"))


def test_what_was_moved_between_recordings_is_learnt_as_it_stood_last() -> None:
    """A drawer that stood elsewhere in each recording; all recordings count as contacts with it."""
    stood = [turned(a).apply(DRAWER) for a in (-4.0, 3.0, -1.5, 5.0, 1.0, -2.5)]
    found = learner_of("panda", recordings("panda", [along(free, 0.25, firm=False) for free in stood], 5))
    assert len(found.constraints_) == 1 and found.constraint_.n_constraints == 2
    assert angle(found.constraint_, stood[-1]) < 0.3
    assert any("moved between recordings" in w and "demo_5" in w for w in found.report_.warnings)
    assert {p.trajectory for p in found.report_.phases if p.constraint == 0} == {f"demo_{i}" for i in range(6)}
    assert not found.report_.odd_trajectories


def test_an_arm_whose_zeros_are_off_sees_one_drawer() -> None:
    """By a degree, with encoders so fine that every posture shows another direction clearly."""
    found = learner_of("xarm7", recordings("xarm7", [along(DRAWER, 0.2, firm=False)] * 8, 7, 2e-5, zeros=1.0))
    assert len(found.constraints_) == 1 and found.constraint_.n_constraints == 2
    assert not any("moved" in w or "tasks" in w for w in found.report_.warnings)


def test_a_bent_rail_is_a_curve_and_no_ball() -> None:
    """Two rows at each place, and the length that was shown."""

    def rail(pose: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, None]:
        s = stroke(rng, 0.3)[:, None]
        return pose[:3, 3] + np.hstack([0.3 * s, s, 0.05 * np.sin(s / 0.08)]), None

    demos = recordings("panda", [rail] * 6, 9)
    found = learner_of("panda", demos)
    constraint, mechanism = found.constraint_, found.report_.mechanism
    assert constraint.n_constraints == 2 and mechanism is not None and mechanism.name == "curve"
    assert "curve of" in found.report_.sentence and "rail" in found.report_.sentence
    off = np.array([constraint.features.coordinates(q) for t in demos for q in t.q[::10]])
    assert np.abs(off).max() < 5e-4
    assert constraint.shown is not None and constraint.shown.unit == "m"


def test_a_wide_cylinder_is_no_plane() -> None:
    """Of a metre's radius: a plane would be left by millimetres."""

    def side(pose: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, None]:
        phi, up = wave(rng, np.array([0.14, 0.14])).T
        return pose[:3, 3] + np.column_stack([np.sin(phi), up, np.cos(phi) - 1.0]), None

    found = learner_of("xarm7", recordings("xarm7", [side] * 6, 11))
    mechanism = found.report_.mechanism
    assert found.constraint_.n_constraints == 1 and mechanism is not None and mechanism.name == "cylinder"
    assert mechanism.radius == pytest.approx(1.0, rel=0.05) and abs(mechanism.axis[1]) > 0.999


# ---- whole recordings ---------------------------------------------------------------------------------------------


def test_a_cut_recording_is_one_stretch():
    """Recordings that hold nothing but the contact: one constraint, every recording as a whole, none of them odd."""
    features, made, _ = moving("door", "xarm7", 2021, 8, whole=False)
    learner = ml.ConstraintLearner(features).fit(made)
    assert len(learner.constraints_) == 1 and not learner.report_.odd_trajectories
    spans = [(p.trajectory, p.start, p.end, p.constraint) for p in learner.report_.phases]
    assert spans == [(t.name, t.time[0], t.time[-1], 0) for t in made]


def test_an_orientation_that_is_held_softly_is_learnt_with_its_axis():
    """A glass that sways by a degree: its two rows, about the vertical within three stated standard deviations."""
    features, made, truth = moving("glass", "sawyer", 33003, 6, whole=False)
    learner, q = learnt("sawyer", truth["tip"], made, axes="rotation"), made[0].q[100]
    mechanism = learner.report_.mechanism
    assert mechanism is not None and mechanism.type == "held-orientation" and mechanism.axis is not None
    tilt = np.degrees(np.arccos(min(1.0, abs(mechanism.axis[2]))))
    assert tilt < min(3.0 * mechanism.uncertainty["axis"], 6.0)
    A, turns = learner.constraint_(q), ml.FrameJacobian(features.robot, truth["tip"], "rotation")(q)
    assert A.shape == (2, features.nv)
    np.testing.assert_allclose(A @ np.linalg.pinv(turns) @ mechanism.axis, 0.0, atol=1e-9)
