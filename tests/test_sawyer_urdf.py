"""The shipped robots/sawyer.urdf against the numbers of its source."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest

URDF = Path(__file__).resolve().parents[1] / "robots" / "sawyer.urdf"

# joint: lower [rad], upper [rad], velocity [rad/s], effort [N m]
LIMITS = {
    "right_j0": (-3.0503, 3.0503, 1.74, 80.0),
    "right_j1": (-3.8095, 2.2736, 1.328, 80.0),
    "right_j2": (-3.0426, 3.0426, 1.957, 40.0),
    "right_j3": (-3.0439, 3.0439, 1.957, 40.0),
    "right_j4": (-2.9761, 2.9761, 3.485, 9.0),
    "right_j5": (-2.9761, 2.9761, 3.485, 9.0),
    "right_j6": (-4.7124, 4.7124, 4.545, 9.0),
}
# link: mass [kg], centre of mass [m]
INERTIAS = {
    "right_l0": (5.3213, (0.024366, 0.010969, 0.14363)),
    "right_l1": (4.505, (-0.0030849, -0.026811, 0.092521)),
    "right_l2": (1.745, (-0.00016044, -0.014967, 0.13582)),
    "right_l3": (2.5097, (-0.0048135, -0.0281, -0.084154)),
    "right_l4": (1.1136, (-0.0018844, 0.0069001, 0.1341)),
    "right_l5": (1.5625, (0.0061133, -0.023697, 0.076416)),
    "right_l6": (0.3292, (-8.0726e-06, 0.0085838, -0.0049566)),
}
DEFAULT_POSE = np.deg2rad([-100.0, 30.0, -100.0, 40.0, -60.0, -70.0, 250.0])


@pytest.fixture(scope="module")
def model():
    return pin.buildModelFromUrdf(str(URDF))


def position(model: pin.Model, frame: str, q: np.ndarray) -> np.ndarray:
    data = model.createData()
    pin.framesForwardKinematics(model, data, q)
    assert model.existFrame(frame), frame
    return data.oMf[model.getFrameId(frame, pin.FrameType.BODY)].translation.copy()


def test_joints_and_frames_are_those_of_the_source(model):
    """The head is locked, seven joints move; the wrist at zero is at (0.991, 0.1603, 0.317) m.

    right_hand is 24.5 mm beyond right_l6, right_gripper_tip 100 mm beyond right_hand, on one straight line.
    """
    assert model.nq == model.nv == 7 and list(model.names)[1:] == list(LIMITS) and model.frames[1].name == "base"
    np.testing.assert_allclose(position(model, "right_l6", np.zeros(7)), (0.991, 0.1603, 0.317), atol=1e-10)
    q = np.linspace(-1.0, 1.5, 7)
    flange, hand, tip = (position(model, name, q) for name in ("right_l6", "right_hand", "right_gripper_tip"))
    np.testing.assert_allclose(np.linalg.norm(hand - flange), 0.0245, atol=1e-12)
    np.testing.assert_allclose(tip - hand, (hand - flange) * 0.1 / 0.0245, atol=1e-12)
    for name in ("right_hand_camera", "right_wrist", "head", *INERTIAS):
        assert model.existFrame(name), name
    np.testing.assert_allclose(position(model, "right_arm_base_link", q), np.zeros(3), atol=0.0)


def test_limits_are_those_of_the_source(model):
    """Positions, velocities and efforts equal the table; the paper's default pose violates none."""
    table = np.array(list(LIMITS.values())).T
    seen = (model.lowerPositionLimit, model.upperPositionLimit, model.velocityLimit, model.effortLimit)
    np.testing.assert_array_equal(np.array(seen), table)
    np.testing.assert_array_equal(model.damping, np.full(7, 5.0))
    np.testing.assert_array_equal(model.friction, np.full(7, 5.0))
    assert np.all(model.lowerPositionLimit < DEFAULT_POSE) and np.all(model.upperPositionLimit > DEFAULT_POSE)


def test_masses_are_those_of_the_source_and_physical():
    """Masses and centres of mass equal the table; every inertia is physically possible."""
    links = {link.get("name"): link.find("inertial") for link in ElementTree.parse(URDF).getroot().iter("link")}
    for name, (mass, centre) in INERTIAS.items():
        assert float(links[name].find("mass").get("value")) == mass
        assert tuple(float(x) for x in links[name].find("origin").get("xyz").split()) == centre
    for inertial in (i for i in links.values() if i is not None):
        xx, xy, xz, yy, yz, zz = (float(inertial.find("inertia").get(k)) for k in "ixx ixy ixz iyy iyz izz".split())
        moments = np.linalg.eigvalsh(np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]))
        assert moments[0] > 0.0 and moments[0] + moments[1] > moments[2]
