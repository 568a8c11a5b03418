"""An arm in a teaching scene that a person's hand pulls: the driver of `record` and `run`, in real time."""

# pyright: reportAttributeAccessIssue=false
# (the compiled parts of MuJoCo have no complete stubs)
from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any, Literal, NamedTuple, final

import numpy as np
from jaxtyping import Float

from manip_learn.drivers.mujoco import MuJoCoDriver
from manip_learn.robot.rotations import rotation_matrix, rotation_vector
from manip_learn.teach.scene import REACHES, STIFF, TIMESTEP, TeachingScene, physics, scene_model

PERIOD = 0.01  # [s] between two readings, as cobots report at 100 Hz and more
SOFT = 0.12  # [s] in which a grip settles at first
STRONGEST = 60.0  # [N] that a person pulls with for a while, standing


@final
class Pull(NamedTuple):
    """Where a person holds the arm and where the hand wants it.

    Attributes:
        body: Number of the MuJoCo body.
        at: shape (3,), point of that body held, in its own frame [m].
        to: shape (3,), where that point is to be, in the base [m].
        turn: shape (3,), rotation vector by which the body is to be turned since the hand took it [rad], or None.
        heard: When this was last said [s].
    """

    body: int
    at: Float[np.ndarray, " 3"]
    to: Float[np.ndarray, " 3"]
    turn: Float[np.ndarray, " 3"] | None
    heard: float

    def held_at(self, data: Any) -> tuple[np.ndarray, np.ndarray]:
        """Return where that point is now, in the base [m], and how the body is turned."""
        rotation = data.xmat[self.body].reshape(3, 3).copy()
        return data.xpos[self.body] + rotation @ self.at, rotation


@final
class _Hand:
    """The force of a hand on the arm: a spring to where it is meant to be, no stronger than a person.

    Attributes:
        force: shape (3,), of the last step [N].
        limited: Whether it would have been stronger.
    """

    def __init__(self, model: Any):
        self._mujoco: Any = physics()
        self._linear, self._angular = np.zeros((3, model.nv)), np.zeros((3, model.nv))
        self.pull: Pull | None = None
        self._goal, self._first = np.zeros(3), np.eye(3)  # where it pulls to now, and how the body was turned at first
        self.force, self.limited, self.at = np.zeros(3), False, np.zeros(3)

    def take(self, pull: Pull | None, data: Any) -> None:
        """Pull there from now on; None lets go."""
        if pull is None:
            self.force, self.limited = np.zeros(3), False
        elif self.pull is None or pull.body != self.pull.body:
            self._goal, self._first = pull.held_at(data)
        self.pull = pull

    def __call__(self, model: Any, data: Any) -> None:
        """Add the hand's force to `data.qfrc_applied`."""
        if (pull := self.pull) is None:
            return
        self.at, rotation = pull.held_at(data)
        self._mujoco.mj_jac(model, data, self._linear, self._angular, self.at, pull.body)
        # it comes there in 0.02 s: between two pictures of 60 Hz it does not jump; 1 cm off is 9 N
        self._goal = self._goal + (pull.to - self._goal) * (TIMESTEP / 0.02)
        wanted = 900.0 * (self._goal - self.at)
        size = float(np.linalg.norm(wanted))
        self.limited = size > STRONGEST
        wanted *= min(1.0, STRONGEST / max(size, 1e-9))
        self.force = wanted - 30.0 * (self._linear @ data.qvel)  # [N s/m]
        data.qfrc_applied += self._linear.T @ self.force
        if pull.turn is not None:
            aim = rotation_matrix(pull.turn) @ self._first
            moment = 15.0 * rotation_vector(aim @ rotation.T)  # [N m/rad]
            moment *= min(1.0, 6.0 / max(float(np.linalg.norm(moment)), 1e-9))  # [N m] that a wrist turns with
            data.qfrc_applied += self._angular.T @ (moment - 0.5 * (self._angular @ data.qvel))  # [N m s/rad]


@final
class TeachingArm:
    """A driver whose clock is the wall's: each period of physics is waited for, and shown.

    Args:
        scene: The scene.
        rng: Source of the encoders' noise.
        in_real_time: Whether periods are waited for; tests go faster.
        shown: Called after each period.

    Attributes:
        scene: The scene.
        hand: The person's hand.
        period: Between two readings [s].
        joint_names: In the robot's order.
        held: True while the gripper holds the handle.
    """

    simulated = True

    def __init__(
        self,
        scene: TeachingScene,
        rng: np.random.Generator,
        in_real_time: bool = True,
        shown: Callable[[], object] = bool,
    ):
        self._mujoco: Any = physics()
        self.scene, self.period, self.joint_names = scene, PERIOD, scene.robot.joint_names
        self._shown, self._waits = shown, in_real_time
        model: Any = scene_model(scene)
        self.hand = _Hand(model)
        noise = {"noise": 1e-4, "rng": rng}  # [rad or m] of the encoders: 16 bits a turn
        self._arm = MuJoCoDriver(model, self.joint_names, scene.start, period=PERIOD, hand=self.hand, **noise)
        self.model, self.data = model, self._arm.data
        self.release, self.hold = self._arm.release, self._arm.hold  # let the arm be guided, or hold it where it is
        self._tip = model.site("tip").id
        self._handle = model.body("handle")
        self.held, self._closed, self._opened = False, 0.0, False  # when it closed [s]; True where it was opened last
        self._due = time.perf_counter()
        self.release()

    # ---- as a driver ----------------------------------------------------------------------------------------------

    def read(self) -> tuple[Float[np.ndarray, " n"], None, Float[np.ndarray, " n"]]:
        """Joint positions as encoders tell them, no velocities, and what the drives exert."""
        q, _, effort = self._arm.read()
        return q, None, effort

    def command(self, q: Float[np.ndarray, " n"], u: Float[np.ndarray, " n"]) -> None:
        """Send the servos to positions, and let one period pass."""
        self._arm.command(q, u)
        self._pass()

    def wait(self) -> None:
        """Let one period pass without a command."""
        self._arm.wait()
        self._pass()

    def gripper(self, word: Literal["close", "open"]) -> None:
        """Close or open the gripper, as a motion says."""
        self.grip(word == "close")

    def _pass(self) -> None:
        """After a period of physics: the gripper, the picture, the clock."""
        # pages repeat a pull every 0.2 s: one that nobody has repeated for 0.6 s is over
        if self.hand.pull is not None and time.perf_counter() - self.hand.pull.heard > 0.6:
            self.hand.take(None, self.data)
        if self.held:  # a grip grows firm in the 0.4 s in which the gripper closes
            share = min(1.0, (self.time - self._closed) / 0.4)
            self.model.equality("grip").solref[0] = SOFT * (STIFF / SOFT) ** share
        self._shown()
        if not self._waits:
            return
        self._due += self.period
        if (left := self._due - time.perf_counter()) > 0.0:
            time.sleep(left)
        elif left < -0.25:  # [s] late: a computer that slept does not catch up
            self._due = time.perf_counter()

    # ---- what a hand does -----------------------------------------------------------------------------------------

    @property
    def time(self) -> float:
        """Of the physics [s]."""
        return float(self.data.time)

    @property
    def q(self) -> Float[np.ndarray, " nv"]:
        """True joint positions [rad or m]."""
        return self.data.qpos[self._arm._q].copy()

    @property
    def q_held(self) -> Float[np.ndarray, " nv"]:
        """Where the servos hold the arm [rad or m]."""
        return self._arm.goal

    @property
    def place(self) -> Float[np.ndarray, " 3"]:
        """Where the tip is, in the base [m]."""
        return self.data.site_xpos[self._tip].copy()

    @property
    def handle_place(self) -> Float[np.ndarray, " 3"]:
        """Where the handle is [m]."""
        return self.data.xpos[self._handle.id].copy()

    @property
    def opening(self) -> float:
        """How far the handle has been moved [m or rad]; of a plane along its first direction."""
        return float(self.data.joint("handle_x").qpos[0])

    @property
    def is_near(self) -> bool:
        """True if the handle is within reach of the gripper."""
        return bool(np.linalg.norm(self.handle_place - self.place) < REACHES)

    def pull(
        self, link: str | None, at: Any, to: Float[np.ndarray, " 3"], turn: Float[np.ndarray, " 3"] | None = None
    ) -> None:
        """Take a link of the arm, or the tip, and pull it.

        Args:
            link: Name of the joint whose link is held; None for the tip.
            at: shape (3,), point of the link held, in its joint's frame [m]; None for the tip.
            to: shape (3,), where it is to be, in the base [m].
            turn: shape (3,), rotation vector by which the hand turns it [rad], or None.
        """
        if link is None:
            body, at = int(self.model.site_bodyid[self._tip]), self.model.site_pos[self._tip].copy()
        else:
            body = self.model.body(link).id
        self.hand.take(Pull(body, at, to, turn, time.perf_counter()), self.data)

    def let_go(self) -> None:
        """Let the arm go; the gripper stays as it is."""
        self.hand.take(None, self.data)
        self._opened = self._opened and self.is_near

    def grip(self, closed: bool) -> bool:
        """Close the gripper on the handle within reach, or open it; whether it holds one now."""
        if closed and not self.held and self.is_near:
            if self.scene.handle.firm:  # its site is turned as the hand is, so that closing turns neither
                site, back, turn = self.model.site("handle"), np.zeros(4), np.zeros(4)
                self.model.site_sameframe[site.id] = 0  # else MuJoCo takes the body's frame for it without a look
                self._mujoco.mju_negQuat(back, self.data.xquat[self._handle.id])
                self._mujoco.mju_mat2Quat(turn, self.data.site_xmat[self._tip])
                self._mujoco.mju_mulQuat(self.model.site_quat[site.id], back, turn)
            self.held, self._closed = True, self.time
            self.model.equality("grip").solref[0] = SOFT
        elif not closed and self.held:
            self._opened, self.held = True, False
        self.data.eq_active[self.model.equality("grip").id] = self.held
        return self.held

    def close_when_near(self) -> bool:
        """Close the gripper on a handle that the hand has come to.

        Where it was opened it stays open until the person has let the arm go elsewhere, or records again: a hand that
        had pushed a drawer shut comes back by its handle.
        """
        return not self.held and self.is_near and not self._opened and self.grip(True)

    def shut(self) -> None:
        """Open the gripper, and put what it moved back to where it was at first."""
        self.grip(False)
        self._opened = False
        joints = self._handle.jntadr[0] + np.arange(self._handle.jntnum[0])
        self.data.qpos[self.model.jnt_qposadr[joints]] = self.data.qvel[self.model.jnt_dofadr[joints]] = 0.0
