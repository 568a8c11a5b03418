"""An arm under position control with its hand on the handle of a drawer, in MuJoCo's rigid-body dynamics.

Each joint has a position servo: a spring of stated stiffness to the commanded position, critically damped against its
rate, by the drive's own sensors. Commands and measurements travel for 1 ms each. The grip is a ball joint between hand
and handle (MuJoCo's equality `connect`); its constraint force is what the hand does to the drawer. No constraint matrix
takes part.
"""

# pyright: reportAttributeAccessIssue=false
# (the compiled parts of MuJoCo have no complete stubs)
from __future__ import annotations

import json
from collections import deque
from collections.abc import Mapping
from pathlib import Path
from typing import final

import matplotlib
import mujoco
import numpy as np
from jaxtyping import Float
from make_recordings.arms import load_arm
from make_recordings.guided_model import guided_model
from make_recordings.mechanisms import Slide
from matplotlib.figure import Figure

PERIOD, TIMESTEP = 0.001, 0.0005  # of the servo's commands, of the physics [s]
LATENCY = 0.002  # from a measurement to the command that it leads to [s], half of it on each way
ENCODER_NOISE = 1e-4  # [rad]
DRAWER_FRICTION = 1.0  # [N], beside 4 N s/m; the joints have 0.1 to 0.5 N m and 1 to 4 N m s/rad
GRIP = "grip_0"
THIN = 10  # periods per point of the plot


def true_axis(recordings: Path) -> Float[np.ndarray, " 3"]:
    """Where the recorded drawer slides, a unit vector in the base frame; the physics knows it, the learner does not."""
    truth = json.loads((recordings / "truth.json").read_text(encoding="utf-8"))
    return np.array(truth["mechanisms"][0]["axis"])


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
        drawer = Slide(handle, np.empty((0, 3)), np.array([0.3]), axis)
        self._model = guided_model(arm, [drawer], [handle], friction=1.0)
        self._model.opt.timestep = TIMESTEP
        self._grip = self._model.equality(GRIP).id
        self._model.eq_solref[self._grip, 0] = 2.0 * TIMESTEP
        self._model.dof_frictionloss[-1] = DRAWER_FRICTION
        self._data = mujoco.MjData(self._model)
        self._n, self._axis, self._rng = len(grasp), axis, rng
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

    def send(self, position: Float[np.ndarray, " nv"] | None) -> None:
        """Command the servos and let one period pass.

        Args:
            position: shape (nv,), commanded joint positions [rad]; they arrive late. None repeats the last ones.
        """
        data, n = self._data, self._n
        self._sent.append(self._sent[-1] if position is None else position)
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


def draw(signals: Mapping[str, Float[np.ndarray, "T 4"]], path: str) -> Path:
    """Plot way, side force and following error over time; returns the file.

    Args:
        signals: Name of a run -> way [m], side force [N], following error and its limit [rad], one row per period.
        path: SVG file to write.
    """
    with matplotlib.rc_context({"font.size": 9, "svg.hashsalt": "manip_learn", "axes.spines.right": False}):
        figure = Figure(figsize=(7.2, 5.4), layout="constrained")
        panels = figure.subplots(3, 1, sharex=True)
        for (name, rows), colour in zip(signals.items(), ("#0072b2", "#d55e00"), strict=False):
            time = PERIOD * np.arange(len(rows))[::THIN]
            rows = rows[::THIN]
            for axes, values in zip(panels, (1e3 * rows[:, 0], rows[:, 1], 1e3 * rows[:, 2]), strict=True):
                axes.plot(time, np.round(values, 3), color=colour, linewidth=1.2, label=name)
            tripped = np.flatnonzero(rows[:, 2] > rows[:, 3])
            panels[2].axhline(1e3 * rows[0, 3], color=colour, linestyle=":", linewidth=1.0)
            for axes in panels[: len(tripped) * 3]:
                axes.axvline(time[tripped[0]], color="black", linestyle="--", linewidth=0.8)
        labels = ("drawer open [mm]", "side force [N]", "following error [mrad]\n(dotted: limit)")
        for axes, label in zip(panels, labels, strict=True):
            axes.set_ylabel(label)
            axes.set_ylim(bottom=0.0)
        panels[0].legend(frameon=False, loc="center right")
        panels[2].set_xlabel("time [s]; dashed: the following error stops the arm")
        figure.savefig(path, metadata={"Date": None})
    return Path(path)
