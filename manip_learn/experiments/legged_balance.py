"""A standing quadruped with a free base: its feet hold still, and its centre of mass stays over one place.

Phi has the rows of the centre of mass (x, y, z) and of the four feet (x, y, z each); Lambda selects from them.
"""

from __future__ import annotations

import tempfile
from functools import cache
from pathlib import Path

import numpy as np
from jaxtyping import Float

from manip_learn.constraint.features.centre_of_mass import CentreOfMass
from manip_learn.constraint.features.frame_jacobian import FrameJacobian
from manip_learn.constraint.features.stacked import Stacked
from manip_learn.experiments.curve_constraint import with_noise
from manip_learn.linalg import null_basis
from manip_learn.recordings.demonstrations import Demonstrations
from manip_learn.recordings.trajectory import Trajectory
from manip_learn.robot.loading import load_robot
from manip_learn.robot.robot import Robot

LEGS = {"fl": (0.25, 0.15), "fr": (0.25, -0.15), "hl": (-0.25, 0.15), "hr": (-0.25, -0.15)}  # hips [m]
THIGH, SHANK = 0.25, 0.25  # [m]
STANCE = (0.1, 0.7, -1.4)  # abduction, hip, knee [rad]
# name -> rows of the centre of mass that are held besides the feet, as a matrix over x, y, z
BALANCE = {
    "stand, mass over one place": np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]),
    "stand, mass in a slanted plane": np.array([[0.6, 0.0, 0.8]]),
}
DEMONSTRATIONS, SAMPLES, STEP = 10, 40, 0.02


def quadruped_urdf() -> str:
    """URDF of a trunk with four legs of three joints each, with inertias."""
    parts = [_link("trunk", 6.0, "0 0 0", 0.08)]
    for name, (x, y) in LEGS.items():
        parts += [_link(f"{name}_hip", 0.6, "0 0 0", 0.001), _link(f"{name}_thigh", 0.8, f"0 0 {-THIGH / 2}", 0.005)]
        parts += [_link(f"{name}_shank", 0.3, f"0 0 {-SHANK / 2}", 0.002), f'<link name="{name}_foot"/>']
        parts.append(_joint(f"{name}_abduction", "trunk", f"{name}_hip", f"{x} {y} 0", "1 0 0"))
        parts.append(_joint(f"{name}_swing", f"{name}_hip", f"{name}_thigh", "0 0 0", "0 1 0"))
        parts.append(_joint(f"{name}_knee", f"{name}_thigh", f"{name}_shank", f"0 0 {-THIGH}", "0 1 0"))
        parts.append(
            f'<joint name="{name}_sole" type="fixed"><parent link="{name}_shank"/><child link="{name}_foot"/>'
            f'<origin xyz="0 0 {-SHANK}"/></joint>'
        )
    return f'<robot name="quadruped">{"".join(parts)}</robot>'


@cache
def quadruped() -> Robot:
    """The generated robot with a floating base, nv = 18."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "quadruped.urdf"
        path.write_text(quadruped_urdf(), encoding="utf-8")
        return load_robot(path, base="floating")


@cache
def standing_features() -> Stacked:
    """Rows of the centre of mass and of the four feet, p = 15."""
    robot = quadruped()
    return Stacked([CentreOfMass(robot), *(FrameJacobian(robot, f"{leg}_foot", "xyz") for leg in LEGS)])


def standing_demonstrations(
    task: str, noise: float, rng: np.random.Generator
) -> tuple[Demonstrations, Float[np.ndarray, "s 15"]]:
    """The trunk is pushed about while feet and balance hold (b = 0); and the true Lambda."""
    robot, features = quadruped(), standing_features()
    held = BALANCE[task]
    Lambda = np.zeros((len(held) + 12, 15))
    Lambda[: len(held), :3] = held
    Lambda[len(held) :, 3:] = np.eye(12)
    trajectories = []
    for i in range(DEMONSTRATIONS):
        q = robot.neutral()
        start = np.concatenate([np.zeros(6), np.tile(STANCE, 4)]) + 0.1 * rng.standard_normal(robot.nv)
        q, push = robot.integrate(q, start), rng.standard_normal(robot.nv)
        postures, actions = [], []
        for _ in range(SAMPLES):
            Z = null_basis(Lambda @ features(q))
            u = Z @ (Z.T @ push)
            postures.append(q)
            actions.append(u)
            q = robot.integrate(q, STEP * u)
            push = 0.95 * push + 0.4 * rng.standard_normal(robot.nv)
        u = with_noise(np.array(actions), noise, rng)
        time = STEP * np.arange(SAMPLES)
        trajectories.append(Trajectory(time, np.array(postures), u, robot.joint_names, f"stand {i}"))
    return Demonstrations(trajectories), Lambda


def _link(name: str, mass: float, centre: str, inertia: float) -> str:
    return (
        f'<link name="{name}"><inertial><origin xyz="{centre}"/><mass value="{mass}"/><inertia ixx="{inertia}" ixy="0" '
        f'ixz="0" iyy="{inertia}" iyz="0" izz="{inertia}"/></inertial></link>'
    )


def _joint(name: str, parent: str, child: str, xyz: str, axis: str) -> str:
    return (
        f'<joint name="{name}" type="revolute"><parent link="{parent}"/><child link="{child}"/><origin xyz="{xyz}"/>'
        f'<axis xyz="{axis}"/><limit lower="-2.6" upper="2.6" velocity="10" effort="30"/></joint>'
    )
