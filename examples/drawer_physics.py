"""An arm under position control with its hand on the handle of a drawer, in MuJoCo's rigid-body dynamics.

Each joint has a position servo: a spring of stated stiffness to the commanded position, critically damped against its
rate. Commands and measurements travel for 1 ms each. The grip is a ball joint between hand and handle (MuJoCo's equality
`connect`); its constraint force is what the hand does to the drawer. No constraint matrix takes part.
"""

# pyright: reportAttributeAccessIssue=false
# (the compiled parts of MuJoCo have no complete stubs)
from __future__ import annotations

from collections import deque
from typing import final

import mujoco
import numpy as np
from jaxtyping import Float
from make_recordings.arms import load_arm
from make_recordings.guided_model import guided_model
from make_recordings.mechanisms import Slide

PERIOD, TIMESTEP = 0.001, 0.0005  # of the servo's commands, of the physics [s]
LATENCY = 0.002  # from a measurement to the command that it leads to [s], half of it on each way
ENCODER_NOISE = 1e-4  # [rad]
DRAWER_FRICTION = 3.0  # [N]; beside 4 N s/m. Joints: 0.5 to 0.1 N m, and 4 to 1 N m s/rad
GRIP = "grip_0"


@final
class DrawerPhysics:
    """The arm, its servos and the drawer.

    Args:
        robot_name: One of `make_recordings.arms.ROBOTS`.
        grasp: shape (nv,), posture with the hand on the handle [rad].
        axis: shape (3,), unit vector out of the chest, base frame.
        stiffness: Of every joint's servo [N m/rad].
        rng: Source of the encoder noise.
    """

    def __init__(
        self,
        robot_name: str,
        grasp: Float[np.ndarray, " nv"],
        axis: Float[np.ndarray, " 3"],
        stiffness: float,
        rng: np.random.Generator,
    ):
        arm = load_arm(robot_name)
        handle = arm.pose(grasp)[:3, 3]
        drawer = Slide(handle, np.empty((0, 3)), np.array([0.3]), np.asarray(axis))
        self._model = guided_model(arm, [drawer], [handle], friction=1.0)
        self._model.opt.timestep = TIMESTEP
        self._grip = self._model.equality(GRIP).id
        self._model.eq_solref[self._grip, 0] = 2.0 * TIMESTEP
        self._model.dof_frictionloss[-1] = DRAWER_FRICTION
        self._data = mujoco.MjData(self._model)
        self._n, self._axis, self._rng = len(grasp), np.asarray(axis), rng
        self._data.qpos[: self._n] = grasp
        self._data.eq_active[self._grip] = 1
        mujoco.mj_forward(self._model, self._data)
        inertia = np.zeros((self._model.nv, self._model.nv))
        mujoco.mj_fullM(self._model, self._data, inertia)
        self._stiffness = stiffness
        self._damping = 2.0 * np.sqrt(stiffness * np.diag(inertia)[: self._n])
        late = round(0.5 * LATENCY / PERIOD)
        self._measured = deque([(self._encoders(), -k * PERIOD) for k in range(late, -1, -1)], late + 1)
        self._sent = deque([grasp.copy() for _ in range(late + 2)], late + 2)
        

    @property
    def time(self) -> float:
        """Simulated time [s]."""
        return self._data.time

    @property
    def way(self) -> float:
        """How far the drawer is open [m]."""
        return float(self._data.qpos[-1])

    @property
    def force(self) -> Float[np.ndarray, " 3"]:
        """Force of the grip on the drawer [N], base frame."""
        data = self._data
        rows = (data.efc_type == mujoco.mjtConstraint.mjCNSTR_EQUALITY) & (data.efc_id == self._grip)
        return -data.efc_force[rows]

    @property
    def side_force(self) -> float:
        """Its part across the slide [N]."""
        force = self.force
        return float(np.linalg.norm(force - (force @ self._axis) * self._axis))

    def measured(self) -> tuple[Float[np.ndarray, " nv"], float]:
        """Newest state that has arrived: joint positions [rad] with encoder noise, and when they were measured [s]."""
        return self._measured[0]

    def send(self, position: Float[np.ndarray, " nv"]) -> None:
        """Command the servos and let one period pass.

        Args:
            position: shape (nv,), commanded joint positions [rad]; they arrive late.
        """
        data, n = self._data, self._n
        self._sent.append(position)
        start, end = self._sent[0], self._sent[1]
        rate, steps = (end - start) / PERIOD, round(PERIOD / TIMESTEP)
        for k in range(steps):
            goal = start + (k / steps) * (end - start)  # drives interpolate between commands
            q, u = data.qpos[:n], data.qvel[:n]
            data.qfrc_applied[:n] = self._stiffness * (goal - q) + self._damping * (rate - u)
            mujoco.mj_step(self._model, data)
        self._measured.append((self._encoders(), data.time))

    def _encoders(self) -> Float[np.ndarray, " nv"]:
        return self._data.qpos[: self._n] + self._rng.normal(0.0, ENCODER_NOISE, self._n)
