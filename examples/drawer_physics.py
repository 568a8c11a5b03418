"""An arm under position control with its hand on a drawer or a door, in MuJoCo's rigid-body dynamics: a driver.

Each joint has a position servo: a spring of stated stiffness to the commanded position, critically damped against its
rate, by the drive's own sensors. Commands and measurements travel for 1 ms each. The grip is a ball joint between hand
and handle (MuJoCo's equality `connect`); its constraint force is what the hand does to the drawer. No constraint matrix
takes part.
"""

# pyright: reportAttributeAccessIssue=false
# (the compiled parts of MuJoCo have no complete stubs)
from __future__ import annotations

import json
import math
from collections import deque
from collections.abc import Mapping
from pathlib import Path
from typing import final

import matplotlib
import mujoco
import numpy as np
from jaxtyping import Float
from make_recordings.arms import load_arm
from make_recordings.guided_model import STIFF_SOLIMP, guided_model
from make_recordings.mechanisms import Mechanism, Slide
from matplotlib.figure import Figure

PERIOD, TIMESTEP = 0.001, 0.0005  # of the servo's commands, of the physics [s]
LATENCY = 0.002  # from a measurement to the command that it leads to [s], half of it on each way
ENCODER_NOISE = 1e-4  # [rad]
DRAWER_FRICTION = 1.0  # [N], beside 4 N s/m; the joints have 0.1 to 0.5 N m and 1 to 4 N m s/rad
GRIP = "grip_0"
CLOSING = 0.4  # [s] in which a gripper that closes on a handle grows firm
THIN = 10  # periods per point of the plot


def true_axis(recordings: Path) -> Float[np.ndarray, " 3"]:
    """Where the recorded drawer slides, a unit vector in the base frame; the physics knows it, the learner does not."""
    truth = json.loads((recordings / "truth.json").read_text(encoding="utf-8"))
    return np.array(truth["mechanisms"][0]["axis"])


@final
class ArmPhysics:
    """The arm, its servos and what it holds: a driver for `manip_learn.run`, whose clock is that of the simulation.

    Args:
        robot_name: One of `make_recordings.arms.ROBOTS`.
        grasp: shape (nv,), posture with the hand on the handle [rad].
        mechanism: What the hand holds (see `make_recordings.mechanisms`), e.g. what `drawer` gives; None for nothing.
        stiffness: Of every joint's servo [N m/rad].
        rng: Source of the encoder noise.
        latency: From a measurement to the command that it leads to, a multiple of two periods [s]; half on each way.
        jammed_at: Way at which a drawer is stuck [m]; None for nowhere.
        payload: Mass that hangs from the hand, and that the drives know nothing of [kg].
        start: shape (nv,), posture before the hand takes hold [rad]; None for `grasp`, the hand on the handle.
    """

    period = PERIOD
    simulated = True  # one period passes in `command`

    def __init__(
        self,
        robot_name: str,
        grasp: Float[np.ndarray, " nv"],
        mechanism: Mechanism | None,
        stiffness: float,
        rng: np.random.Generator,
        *,
        latency: float = LATENCY,
        jammed_at: float | None = None,
        payload: float = 0.0,
        start: Float[np.ndarray, " nv"] | None = None,
    ):
        arm = load_arm(robot_name)
        handle = arm.pose(grasp)[:3, 3]
        held = [] if mechanism is None else [mechanism]
        self._model = model = guided_model(arm, held, [handle] * len(held), friction=1.0)
        model.opt.timestep = TIMESTEP
        self._n, self._rng, self._stiffness = len(grasp), rng, stiffness
        self._mechanism, self._tip = mechanism, model.site("tip").id
        self._grip = model.equality(GRIP).id if held else -1
        if held:
            model.eq_solref[self._grip, 0] = 2.0 * TIMESTEP
            model.body_ipos[-1] = 0.0  # the handle's mass is at the handle
        if isinstance(mechanism, Slide):
            model.dof_frictionloss[-1] = DRAWER_FRICTION
        if jammed_at is not None:
            model.jnt_limited[-1], model.jnt_range[-1] = True, (-1.0, jammed_at)
            model.jnt_solref[-1], model.jnt_solimp[-1] = (0.02, 1.0), STIFF_SOLIMP  # wood gives way a little
        self._weight = np.array([0.0, 0.0, -9.81 * payload])
        self._data = mujoco.MjData(model)
        mujoco.mj_setConst(model, self._data)
        self._closed = -math.inf  # when the gripper began to close [s]
        first = grasp if start is None else start
        self._data.qpos[: self._n] = first
        if start is None:
            self.take_hold()
        mujoco.mj_forward(model, self._data)
        inertia = np.zeros((model.nv, model.nv))
        mujoco.mj_fullM(model, self._data, inertia)
        self._damping = 2.0 * np.sqrt(stiffness * np.diag(inertia)[: self._n])
        late = round(0.5 * latency / PERIOD)
        self._measured = deque([self._encoders() for _ in range(late + 1)], late + 1)
        self.history: list[tuple[float, float]] = []  # way [m or rad] and side force [N] after each period
        self._sent = deque([first.copy() for _ in range(late + 2)], late + 2)

    def take_hold(self) -> None:
        """Close the grip on the handle, where the hand is there."""
        if self._grip >= 0:
            self._data.eq_active[self._grip] = 1

    def gripper(self, word: str) -> None:
        """Close the grip on the handle, by and by, or open it."""
        if word == "close":
            self._closed = self.time
            self.take_hold()
        elif self._grip >= 0:
            self._data.eq_active[self._grip] = 0

    @property
    def time(self) -> float:
        """Simulated time [s]."""
        return self._data.time

    @property
    def way(self) -> float:
        """How far the mechanism's last joint has moved: a drawer's opening [m], a door's angle [rad]."""
        return float(self._data.qpos[-1])

    @property
    def force(self) -> Float[np.ndarray, " 3"]:
        """Force of the hand on what it holds [N], base frame."""
        data = self._data
        rows = (data.efc_type == mujoco.mjtConstraint.mjCNSTR_EQUALITY) & (data.efc_id == self._grip)
        return -data.efc_force[rows][:3] if rows.any() else np.zeros(3)

    @property
    def side_force(self) -> float:
        """Its part across the axis of a drawer [N]; of other mechanisms the whole."""
        force = self.force
        if isinstance(self._mechanism, Slide):
            force = force - (force @ self._mechanism.axis) * self._mechanism.axis
        return float(np.linalg.norm(force))

    def read(self) -> tuple[Float[np.ndarray, " nv"], None, None]:
        """Newest state that has arrived: joint positions [rad] with encoder noise; no rates, no efforts."""
        return self._measured[0], None, None

    def command(self, q: Float[np.ndarray, " nv"], u: Float[np.ndarray, " nv"] | None = None) -> None:
        """Command the servos and let one period pass.

        Args:
            q: shape (nv,), commanded joint positions [rad]; they arrive late.
            u: Not used: these are position servos.
        """
        data, n = self._data, self._n
        self._sent.append(q)
        start, end = self._sent[0], self._sent[1]
        rate, steps = (end - start) / PERIOD, round(PERIOD / TIMESTEP)
        if self._grip >= 0:
            left = max(0.0, 1.0 - (self.time - self._closed) / CLOSING)
            self._model.eq_solref[self._grip, 0] = 2.0 * TIMESTEP + 0.5 * CLOSING * left
        pull = np.zeros((3, self._model.nv))
        for k in range(steps):
            goal = start + (k / steps) * (end - start)  # drives interpolate between commands
            at, moving = data.qpos[:n], data.qvel[:n]
            mujoco.mj_jacSite(self._model, data, pull, None, self._tip)
            data.qfrc_applied[:n] = (
                self._stiffness * (goal - at) + self._damping * (rate - moving) + (self._weight @ pull)[:n]
            )
            mujoco.mj_step(self._model, data)
        self._measured.append(self._encoders())
        self.history.append((self.way, self.side_force))

    def _encoders(self) -> Float[np.ndarray, " nv"]:
        return self._data.qpos[: self._n] + self._rng.normal(0.0, ENCODER_NOISE, self._n)


def drawer(handle: Float[np.ndarray, " 3"], axis: Float[np.ndarray, " 3"]) -> Slide:
    """A drawer whose handle is at a point [m] and that slides along a unit vector, base frame."""
    return Slide(handle, np.empty((0, 3)), np.array([0.3]), axis)


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
