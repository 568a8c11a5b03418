"""Driver of an arm in a MuJoCo simulation, for `run` and `record`."""

# pyright: reportAttributeAccessIssue=false
# (the compiled parts of MuJoCo have no complete stubs)
from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from typing import Any, final

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from manip_learn.control.contact import STIFFNESS
from manip_learn.errors import ConfigurationError, MissingExtraError, under_new_names

STICKS = (0.9999, 0.99999, 0.001, 0.5, 2.0)  # MuJoCo's solimp of dry friction; with its default, joints creep

_FORMER = {"play": "backlash", "delay": "latency", "step": "encoder_resolution"}  # names of arguments, until 0.4


@final
class MuJoCoDriver:
    """Driver of an arm in a MuJoCo simulation, with position servos; its time is the simulation's.

    Each joint has a spring to the commanded position, critically damped against the commanded velocity, and the drives
    compensate for the arm's weight, friction and inertia. Actuators that the model has on these joints are switched
    off. If the rotor inertia of a joint is too small for the servo at the model's time step, it is increased (0.07 kg
    m^2 for 2,000 N m/rad at 2 ms, as a common drive has). After `release` the joints move freely except for friction,
    and the forces of `hand` can guide them; after `hold` the servos hold the arm at its present position.

    By default the servos are ideal. `friction`, `backlash`, `latency`, `encoder_resolution`, `noise` and
    `feedforward=False` make them like the servos of real arms.

    Args:
        model: A `mujoco.MjModel`; the driver changes it in place.
        joint_names: Names of the arm's n joints in the model.
        q: shape (n,), initial joint positions [rad or m].
        period: Time between two commands [s]; None for one time step of the model.
        stiffness: shape (n,) or a number, stiffness of the servos [N m/rad or N/m].
        friction: shape (n,) or a number, dry friction that the drives do not compensate, in addition to the model's own
            [N m or N].
        backlash: shape (n,) or a number, free motion of a joint relative to its motor, during which the motor only
            carries the weight [rad or m].
        latency: Time from a command to the reading that shows it, a multiple of the period; half of it before the
            servos, half before the reading [s].
        encoder_resolution: shape (n,) or a number, resolution of the encoders [rad or m]; 0 for no quantisation.
        feedforward: True for drives that compensate inertia, dampers and the model's own friction.
        hand: Function that is called with model and data before each simulation step, to apply forces, e.g. of a
            person's hand, by adding to `data.qfrc_applied`; None for none.
        noise: Standard deviation of the encoder noise [rad or m].
        rng: Random generator of the noise; None for no noise.
        **renamed: Former names of arguments, valid until 0.4: `play`, `delay`, `step`.

    Attributes:
        model: The model.
        data: State of the simulation, `mujoco.MjData`.

    Raises:
        ConfigurationError: The model lacks a joint, a joint is not a hinge or a slide, the period is not a multiple of
            the time step, or the latency is not a multiple of the period.
        MissingExtraError: MuJoCo is not installed.
        TypeError: An unknown argument.
    """

    simulated = True

    def __init__(
        self,
        model: Any,
        joint_names: Sequence[str],
        q: ArrayLike,
        *,
        period: float | None = None,
        stiffness: ArrayLike = STIFFNESS,
        friction: ArrayLike = 0.0,
        backlash: ArrayLike = 0.0,
        latency: float = 0.0,
        encoder_resolution: ArrayLike = 0.0,
        feedforward: bool = True,
        hand: Callable[[Any, Any], object] | None = None,
        noise: float = 0.0,
        rng: np.random.Generator | None = None,
        **renamed: Any,
    ):
        now = {"backlash": backlash, "latency": latency, "encoder_resolution": encoder_resolution}
        now |= under_new_names("MuJoCoDriver()", _FORMER, renamed)
        try:
            import mujoco
        except ImportError as error:
            raise MissingExtraError("the MuJoCo driver", "physics") from error
        self._mujoco, self.model, self.data = mujoco, model, mujoco.MjData(model)
        self.joint_names, self.period = tuple(joint_names), model.opt.timestep if period is None else float(period)
        self._steps = _count_steps("period", self.period, "model's time step", model.opt.timestep, least=1)
        model_joints = [model.joint(i).name for i in range(model.njnt)]
        missing = [name for name in self.joint_names if name not in model_joints]
        if missing:
            raise ConfigurationError(f"the model has no joint {', '.join(missing)}; it has {', '.join(model_joints)}")
        joints = [model.joint(name) for name in self.joint_names]
        if any(model.jnt_type[joint.id] < int(mujoco.mjtJoint.mjJNT_SLIDE) for joint in joints):
            raise ConfigurationError("each joint of the arm must be a hinge or a slide")
        self._q, self._u = ([int(getattr(j, a)[0]) for j in joints] for a in ("qposadr", "dofadr"))
        on_joints = (model.actuator_trntype == int(mujoco.mjtTrn.mjTRN_JOINT)) & np.isin(
            model.actuator_trnid[:, 0], [joint.id for joint in joints]
        )
        model.actuator_gainprm[on_joints] = model.actuator_biasprm[on_joints] = 0.0
        self.data.qpos[self._q] = np.array(q, dtype=np.float64)
        n, periods = len(joints), _count_steps("latency", now["latency"], "period", self.period, least=0)
        numbers = (stiffness, friction, now["backlash"], now["encoder_resolution"])
        self._stiffness, self._friction, self._backlash, self._resolution = (
            np.array(np.broadcast_to(np.asarray(x, dtype=np.float64), (n,))) for x in numbers
        )
        # an explicit spring is stable with 1.5 time steps per radian of the servo's own oscillation; take 3
        least = self._stiffness * (3.0 * model.opt.timestep) ** 2
        model.dof_armature[self._u] = np.maximum(model.dof_armature[self._u], least)
        self._known_friction = model.dof_frictionloss[self._u].copy()
        model.dof_frictionloss[self._u] += self._friction
        model.dof_solimp[np.array(self._u)[self._friction > 0.0]] = STICKS
        mujoco.mj_forward(model, self.data)
        self._damping = 2.0 * np.sqrt(self._stiffness * self._inertia().diagonal())
        self._hand, self._noise, self._rng, self._feedforward = hand, float(noise), rng, feedforward
        self._holds, self._effort, back = True, np.zeros(n), periods - periods // 2
        self._sent: deque[np.ndarray] = deque(maxlen=periods // 2 + 1)  # commands on their way, oldest first
        self._reset_goal(self.data.qpos[self._q].copy())
        self._seen = deque([self._state() for _ in range(back + 1)], back + 1)

    def read(self) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
        """Return the measured state of the joints.

        Returns:
            Joint positions with encoder noise (n,) [rad or m], velocities (n,) [rad/s or m/s], and efforts of the
            servos (n,) [N m or N].
        """
        return self._seen[0]

    def _state(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the present positions of the encoders, velocities and efforts."""
        q = self.data.qpos[self._q]
        if self._rng is not None:
            q = q + self._rng.normal(0.0, self._noise, len(q))
        step = self._resolution
        q = np.where(step > 0.0, step * np.round(q / np.where(step > 0.0, step, 1.0)), q)
        return q, self.data.qvel[self._u].copy(), self._effort.copy()

    def command(self, q: Float[np.ndarray, " n"], u: Float[np.ndarray, " n"]) -> None:
        """Send joint positions to the servos, and simulate one period.

        Args:
            q: Joint positions (n,) to reach at the end of the period [rad or m].
            u: Joint velocities; not used.
        """
        self._sent.append(np.array(q, dtype=np.float64))
        start, self._goal = self._goal, self._sent[0]
        rate = (self._goal - start) / self.period
        self._ahead = self._inertia() @ ((rate - self._rate) / self.period) if self._feedforward else self._ahead
        self._rate = rate
        for k in range(self._steps):  # the goal at the beginning of each step, like the state
            self._step(start + (k / self._steps) * (self._goal - start), rate)
        self._seen.append(self._state())

    @property
    def goal(self) -> Float[np.ndarray, " n"]:
        """Present goal of the servos, joint positions (n,) [rad or m]."""
        return self._goal.copy()

    def wait(self) -> None:
        """Simulate one period without a command: the servos hold, or the arm can be guided after `release`."""
        self._reset_goal(self._goal)
        for _ in range(self._steps):
            self._step(self._goal, self._rate)
        self._seen.append(self._state())

    def release(self) -> None:
        """Let the joints move freely, so that `hand` can guide the arm; the drives only carry its weight."""
        self._holds = False

    def hold(self) -> None:
        """Switch the servos on to hold the arm at its present position."""
        self._holds = True
        self._reset_goal(self.data.qpos[self._q].copy())

    def _reset_goal(self, goal: np.ndarray) -> None:
        """Replace all goals by this one, at rest."""
        # goal, last commanded velocities, and efforts for accelerations
        self._goal, self._rate, self._ahead = goal, np.zeros(len(goal)), np.zeros(len(goal))
        self._sent.extend([goal] * (self._sent.maxlen or 1))

    def _inertia(self) -> Float[np.ndarray, "n n"]:
        """Return the inertia matrix of the arm's joints, rotors included [kg m^2 or kg]."""
        whole = np.zeros((self.model.nv, self.model.nv))
        self._mujoco.mj_fullM(self.model, self.data, whole)
        return whole[np.ix_(self._u, self._u)]

    def _step(self, goal: np.ndarray, rate: np.ndarray) -> None:
        """Run one step of the physics with the servos' efforts."""
        data, joints = self.data, self._u
        self._mujoco.mj_step1(self.model, data)
        self._effort = data.qfrc_bias[joints] - data.qfrc_gravcomp[joints]
        if self._holds:
            away = goal - data.qpos[self._q]
            travel = np.maximum(np.abs(away) - 0.5 * self._backlash, 0.0)
            spring = self._stiffness * np.copysign(travel, away) + self._damping * (rate - data.qvel[joints])
            self._effort = data.qfrc_bias[joints] + np.where((travel > 0.0) | (self._backlash == 0.0), spring, 0.0)
            if self._feedforward:
                self._effort += self._known_friction * np.sign(rate) - data.qfrc_passive[joints] + self._ahead
        data.qfrc_applied[:] = 0.0
        data.qfrc_applied[joints] = self._effort
        if self._hand is not None:
            self._hand(self.model, data)
        self._mujoco.mj_step2(self.model, data)


def _count_steps(what: str, time: float, whose: str, step: float, least: int) -> int:
    """Return the number of steps in a time [s]."""
    n = round(time / step)
    if n < least or abs(n * step - time) > 1e-9:
        raise ConfigurationError(
            f"the {what} must be a multiple of the {whose} of {1e3 * step:g} ms, got {1e3 * time:g} ms"
        )
    return n
