"""An arm under position control with its hand on a drawer or a door, in MuJoCo's rigid-body dynamics: a driver.

The arm is a `MuJoCoDriver` with the faults that it is given, such as those of a `USED` arm: dry friction, play, encoder
steps and noise, a delay, and drives that know of none of it. The grip is a ball joint between hand and handle
(MuJoCo's equality `connect`); its constraint force is what the hand does to the drawer. No constraint matrix takes
part.
"""

# pyright: reportAttributeAccessIssue=false
# (the compiled parts of MuJoCo have no complete stubs)
from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, final

import matplotlib
import mujoco
import numpy as np
from jaxtyping import Float
from make_recordings.arms import load_arm
from make_recordings.guided_model import STIFF_SOLIMP, guided_model
from make_recordings.mechanisms import Mechanism, Slide
from matplotlib.figure import Figure
from numpy.typing import ArrayLike

from manip_learn.drivers.mujoco import STICKS, MuJoCoDriver

PERIOD, TIMESTEP = 0.001, 0.0005  # of the servo's commands, of the physics [s]
LATENCY = 0.002  # from a measurement to the command that it leads to [s], half of it on each way
ENCODER_NOISE = 1e-4  # [rad]
DRAWER_FRICTION = 1.0  # [N], beside 4 N s/m; the joints have 0.1 to 0.5 N m and 1 to 4 N m s/rad
SLIDES = 0.005  # [m/s or rad/s] from which on a drawer or a door no longer sticks
GRIP = "grip_0"
# of a used arm in good order, beside the noise: friction [N m] and play [rad] of its joints, steps of its encoders
# [rad], and from a command to the measurement that shows it [s]
USED: dict[str, Any] = {"friction": 1.0, "play": 1e-3, "step": 1e-4, "latency": 0.010}
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
        stiffness: shape (nv,) or a number, of the servos [N m/rad].
        rng: Source of the encoder noise.
        latency: From a command to the measurement that shows it, a multiple of the period [s]; half on each way.
        friction: shape (nv,) or a number, of the joints, beside what they have [N m].
        play: shape (nv,) or a number, of the gears [rad].
        step: shape (nv,) or a number, of the encoders [rad].
        noise: Standard deviation of the encoders [rad].
        sticks: Force or torque at which a drawer or a door begins to move [N or N m]; None: as it slides.
        jammed_at: Way at which a drawer is stuck [m]; None for nowhere.
        payload: Mass that hangs from the hand, and that the drives know nothing of [kg].
        push: Force on the tip and on the body of a joint at a time [s]: `(force (3,), joint number or -1 for the tip)`.
        start: shape (nv,), posture before the hand takes hold [rad]; None for `grasp`, the hand on the handle.
    """

    period = PERIOD
    simulated = True  # one period passes in `command`

    def __init__(
        self,
        robot_name: str,
        grasp: Float[np.ndarray, " nv"],
        mechanism: Mechanism | None,
        stiffness: ArrayLike,
        rng: np.random.Generator,
        *,
        latency: float = LATENCY,
        friction: ArrayLike = 0.0,
        play: ArrayLike = 0.0,
        step: ArrayLike = 0.0,
        noise: float = ENCODER_NOISE,
        sticks: float | None = None,
        jammed_at: float | None = None,
        payload: float = 0.0,
        push: Callable[[float], tuple[np.ndarray, int]] | None = None,
        start: Float[np.ndarray, " nv"] | None = None,
    ):
        arm = load_arm(robot_name)
        handle = arm.pose(grasp)[:3, 3]
        held = [] if mechanism is None else [mechanism]
        self._model = model = guided_model(arm, held, [handle] * len(held), friction=1.0)
        model.opt.timestep = TIMESTEP
        self._mechanism, self._tip = mechanism, model.site("tip").id
        self._grip = model.equality(GRIP).id if held else -1
        if held:
            model.eq_solref[self._grip, 0] = 2.0 * TIMESTEP
            model.body_ipos[-1] = 0.0  # the handle's mass is at the handle
        if isinstance(mechanism, Slide):
            model.dof_frictionloss[-1] = DRAWER_FRICTION
        self._slides, self._sticks = float(model.dof_frictionloss[-1]), sticks
        if sticks is not None:
            model.dof_solimp[-1], model.dof_frictionloss[-1] = STICKS, sticks
        if jammed_at is not None:
            model.jnt_limited[-1], model.jnt_range[-1] = True, (-1.0, jammed_at)
            model.jnt_solref[-1], model.jnt_solimp[-1] = (0.02, 1.0), STIFF_SOLIMP  # wood gives way a little
        self._weight, self._push = np.array([0.0, 0.0, -9.81 * payload]), push
        self._closed = -math.inf  # when the gripper began to close [s]
        first, names = grasp if start is None else start, [model.joint(i).name for i in range(len(grasp))]
        self._driver = MuJoCoDriver(
            model, names, first, period=PERIOD, stiffness=stiffness, friction=friction, backlash=play, latency=latency,
            encoder_resolution=step, feedforward=False, hand=self._pulled, noise=noise, rng=rng,
        )  # fmt: skip
        self._data = self._driver.data
        mujoco.mj_setConst(model, self._data)
        self._data.qpos[: len(grasp)] = first
        if start is None:
            self.take_hold()
        mujoco.mj_forward(model, self._data)
        self.history: list[tuple[float, float]] = []  # way [m or rad] and side force [N] after each period

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
    def place(self) -> Float[np.ndarray, " 3"]:
        """Where the hand is [m], base frame."""
        return self._data.site_xpos[self._tip]

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
        return self._driver.read()[0], None, None

    def command(self, q: Float[np.ndarray, " nv"], u: Float[np.ndarray, " nv"] | None = None) -> None:
        """Command the servos and let one period pass.

        Args:
            q: Where the arm should be at the end of the period [rad].
            u: Not used; position servos take q.
        """
        if self._grip >= 0:
            left = max(0.0, 1.0 - (self.time - self._closed) / CLOSING)
            self._model.eq_solref[self._grip, 0] = 2.0 * TIMESTEP + 0.5 * CLOSING * left
        self._driver.command(q, np.zeros_like(q))
        self.history.append((self.way, self.side_force))

    def _pulled(self, model: Any, data: Any) -> None:
        """What else acts on the arm and on what it holds: the payload, a push, and friction that is larger at rest."""
        pull, force = np.zeros((3, model.nv)), self._weight
        mujoco.mj_jacSite(model, data, pull, None, self._tip)
        if self._push is not None:
            pushed, joint = self._push(data.time)
            if joint < 0:
                force = force + pushed
            else:
                at = np.zeros((3, model.nv))
                mujoco.mj_jacBody(model, data, at, None, model.joint(joint).bodyid[0])
                data.qfrc_applied[:] += pushed @ at
        data.qfrc_applied[:] += force @ pull
        if self._sticks is not None:
            model.dof_frictionloss[-1] = self._slides if abs(data.qvel[-1]) > SLIDES else self._sticks


def drawer(handle: Float[np.ndarray, " 3"], axis: Float[np.ndarray, " 3"]) -> Slide:
    """A drawer whose handle is at a point [m] and that slides along a unit vector, base frame."""
    return Slide(handle, np.empty((0, 3)), np.array([0.3]), axis)


def draw(signals: Mapping[str, Float[np.ndarray, "T 4"]], path: str) -> Path:
    """Plot way, side force and following error over time; returns the file.

    Args:
        signals: Name of a run -> way [m], side force [N], following error [rad] and whether the loop has stopped the
            arm, one row per period.
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
            tripped = np.flatnonzero(rows[:, 3])
            for axes in panels[: len(tripped) * 3]:
                axes.axvline(time[tripped[0]], color="black", linestyle="--", linewidth=0.8)
        labels = ("drawer open [mm]", "side force [N]", "following error [mrad]")
        for axes, label in zip(panels, labels, strict=True):
            axes.set_ylabel(label)
            axes.set_ylim(bottom=0.0)
        panels[0].legend(frameon=False, loc="center right")
        panels[2].set_xlabel("time [s]; dashed: the loop stops the arm")
        figure.savefig(path, metadata={"Date": None})
    return Path(path)
