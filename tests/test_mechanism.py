"""Mechanisms from recordings: the right type, accurate places, honest uncertainty, no answer where there is none."""

from __future__ import annotations

import re

import numpy as np
import pytest
from mechanism_motions import T, about, along, ball, demonstrate, wave
from scipy.spatial.transform import Rotation

import manip_learn as ml
from manip_learn.constraint.features.mechanism_rows import MechanismRows
from manip_learn.constraint.mechanism import KIND_BY_NAME, Mechanism
from manip_learn.constraint.place import Place, across
from manip_learn.errors import NotIdentifiableError
from manip_learn.learning.place import Placed

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
        "line, firm": (along(AXIS[None], 0.15, True), "line", 5),
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


def learnt(robot_of, name, demos, axes="pose") -> ml.ConstraintLearner:
    return ml.ConstraintLearner(ml.FrameJacobian(robot_of(name), TIP[name], axes), joint_offset_std=0.0).fit(demos)


def find(robot_of, name, demos) -> Mechanism:
    m = learnt(robot_of, name, demos).report_.mechanism
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
    demos = record(robot_of, name, path)
    learner = learnt(robot_of, name, demos)
    constraint, m = learner.constraint_, learner.report_.mechanism
    assert m is not None
    assert (m.type, constraint.n_constraints) == (kind_of, rows)
    assert m.grip == ("firm" if "firm" in kind or kind == "sleeve" else "loose")
    if m.axis is not None:
        error = degrees_between(m.axis, AXIS)
        assert error < min(0.25, 4.0 * m.uncertainty["axis"] + 1e-3)
        if isinstance(constraint.features, MechanismRows):  # a turn of a task counts about the axis that is told
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


def test_the_grip_may_be_elsewhere_each_time(robot_of):
    """One hinge held firmly at another place each time is still one hinge; the order of the trajectories does not
    matter, and the same generator gives the same to the last bit.
    """
    robot = robot_of("panda")
    point, demos = place(robot, "panda"), []
    for i, shift in enumerate((-0.04, 0.05)):
        q = np.array(MIDDLE["panda"]) + shift * np.array([1.0, 1.0, -1.0, 1.0, 1.0, 0.5, 1.0])
        demos += demonstrate(robot, TIP["panda"], q, about(AXIS, point, 0.6), np.random.default_rng(2 * i), n=2)
    m, other, again = (find(robot_of, "panda", d) for d in (demos, demos[::-1], demos))
    assert m is not None and m.name == "hinge, firm" and degrees_between(m.axis, AXIS) < 0.25
    np.testing.assert_allclose(other.axis, m.axis, atol=1e-6)
    assert other.radius == pytest.approx(m.radius, abs=1e-6)
    np.testing.assert_array_equal(again.axis, m.axis)


def test_a_planar_arm(robot_of):
    """Rows that a planar arm cannot move anyway are left out: a hinge leaves it one row, and mu is not zero."""
    robot = robot_of("planar3")
    up = np.array([0.0, 0.0, 1.0])
    q = np.array(MIDDLE["planar3"])
    centre = robot.position(q, robot.frame("tip")) + np.array([0.5, -0.4, 0.0])
    learner = learnt(robot_of, "planar3", record(robot_of, "planar3", about(up, centre, 0.6, firm=False)), "xyz")
    m = learner.report_.mechanism
    assert m is not None and m.type == "hinge"
    np.testing.assert_allclose(m.point[:2], centre[:2], atol=4e-3)
    assert learner.constraint_.n_constraints == 1
    assert learner.constraint_.manipulability(q) > 0.1


def test_uncertainty_tells_a_short_arc_from_a_long_one(robot_of):
    """Five degrees of a door: the radius is off by far more than on forty, and its standard deviation says so."""
    point = place(robot_of("panda"), "panda")
    sigmas = {}
    for arc in (5.0, 40.0):
        path = about(AXIS, point, np.radians(arc), firm=False)
        m = find(robot_of, "panda", record(robot_of, "panda", path))
        assert m.type == "hinge"
        sigmas[arc] = m.uncertainty["radius"]
        assert abs(m.radius - 0.3) < 4.0 * sigmas[arc]
    assert sigmas[5.0] > 20.0 * sigmas[40.0]


def test_too_short_an_arc_is_not_called_straight_without_a_word(robot_of):
    """Three degrees of a door with bad encoders: a line, or a hinge whose place is known badly and is warned of."""
    point = place(robot_of("panda"), "panda")
    path = about(AXIS, point, np.radians(3.0), firm=False)
    report = learnt(robot_of, "panda", record(robot_of, "panda", path, n=3, noise=5e-4)).report_
    if report.mechanism is not None and report.mechanism.type == "line":
        assert any("hinge would fit as well" in w for w in report.warnings)
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


def test_free_motion_is_no_mechanism(robot_of):
    """Arms that wander freely, or that go the same curved way again and again, are held by nothing."""
    s = np.linspace(0.0, 1.0, T)
    shape = 10 * s**3 - 15 * s**4 + 6 * s**5
    for name, repeats in (("panda", False), ("ur5", False), ("planar3", False), ("panda", True)):
        robot, rng, demos = robot_of(name), np.random.default_rng(0), []
        goal = rng.normal(0.0, 0.5, robot.nv)
        for _ in range(6):
            q = MIDDLE[name] + wave(rng, np.full(robot.nv, 0.004 if repeats else 0.4))
            if repeats:
                q = q + np.outer(shape, goal + rng.normal(0.0, 0.01, robot.nv)) + rng.normal(0.0, 1e-4, q.shape)
            demos.append(ml.Trajectory(np.arange(T) * 0.02, q, None, robot.joint_names))
        with pytest.raises(NotIdentifiableError):
            learnt(robot_of, name, demos)


def test_doors_in_different_places_are_not_one_hinge(robot_of):
    """Each trajectory with a door of its own: no common place is invented."""
    robot = robot_of("panda")
    demos = []
    for i, distance in enumerate((0.25, 0.33, 0.42, 0.5)):
        axis = AXIS + 0.15 * np.array([np.cos(2.0 * i), np.sin(2.0 * i), 0.0])
        axis /= np.linalg.norm(axis)
        path = about(axis, place(robot, "panda", distance), 0.6)
        demos += record(robot_of, "panda", path, seed=i, n=1)
    with pytest.raises(NotIdentifiableError):
        learnt(robot_of, "panda", demos)


@pytest.mark.parametrize(
    ("off", "point", "doubted"), [(None, 5e-3, False), (0.9, 5e-3, False), (1.1, 5e-3, True), (0.0, 6e-3, True)]
)
def test_a_place_that_is_known_badly_is_doubted(off, point, doubted):
    """From a degree of the direction on, or of the place seen from the hand; it says how far the motion went."""
    m = Mechanism("hinge", AXIS, np.zeros(3), 0.3, uncertainty={"axis": 0.1, "point": point}, arc=0.5)
    doubt = Placed(m, KIND_BY_NAME["hinge"], Place(AXIS, np.zeros(3)), off).doubt
    assert (f"known badly, to {1e3 * point:.2g} mm" in doubt) == doubted
    assert not doubted or re.match(r"move it by at least \d+ degrees, not 29: ", doubt)
    line = Mechanism("line", AXIS, uncertainty={"axis": 60.0})
    assert Placed(line, KIND_BY_NAME["line"], Place(AXIS, np.zeros(3)), 60.0).doubt == ""


def test_one_trajectory_is_an_answer_with_a_warning(robot_of):
    """One opening of a door gives its axis, and says that repetition cannot be excluded."""
    point = place(robot_of("panda"), "panda")
    report = learnt(robot_of, "panda", record(robot_of, "panda", about(AXIS, point, 0.7), n=1), "xyz").report_
    assert report.mechanism is not None and report.mechanism.name == "hinge, firm"
    assert degrees_between(report.mechanism.axis, AXIS) < 0.1
    assert any("one trajectory" in w for w in report.warnings)
