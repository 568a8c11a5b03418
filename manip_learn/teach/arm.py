"""Driver for `record` and `run`, in real time, of a simulated arm in a teaching scene that a person's hand pulls."""

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
SOFT = 0.12  # [s] settling time of a grip at first
STRONGEST = 60.0  # [N] force that a standing person can sustain


@final
class Pull(NamedTuple):
    """Pull of a person's hand at a point of the arm towards a target.

    Attributes:
        body: Index of the MuJoCo body that the hand pulls.
        at: shape (3,), the pulled point, in the frame of that body [m].
        to: shape (3,), target of that point, in the base frame [m].
        turn: shape (3,), rotation vector of the requested rotation of the body since the pull began [rad]; None for no
            moment.
        heard: Time of the last message on this pull [s].
    """

    body: int
    at: Float[np.ndarray, " 3"]
    to: Float[np.ndarray, " 3"]
    turn: Float[np.ndarray, " 3"] | None
    heard: float

    def held_at(self, data: Any) -> tuple[np.ndarray, np.ndarray]:
        """Return the present position of the pulled point in the base frame (3,) [m], and the body's rotation (3, 3).

        Args:
            data: State of the physics, `mujoco.MjData`.
        """
        rotation = data.xmat[self.body].reshape(3, 3).copy()
        return data.xpos[self.body] + rotation @ self.at, rotation


@final
class _Hand:
    """The force of a hand on the arm: a spring to its target, with the limited force of a person.

    Attributes:
        force: shape (3,), force of the last step in the base frame [N].
        limited: True if the spring would have pulled harder.
    """

    def __init__(self, model: Any):
        self._mujoco: Any = physics()
        self._linear, self._angular = np.zeros((3, model.nv)), np.zeros((3, model.nv))
        self.pull: Pull | None = None
        self._goal, self._first = np.zeros(3), np.eye(3)  # present target, and first rotation of the body
        self.force, self.limited, self.at = np.zeros(3), False, np.zeros(3)

    def take(self, pull: Pull | None, data: Any) -> None:
        """Start or change a pull.

        Args:
            pull: The pulled point and its target; None ends the pull.
            data: State of the physics, `mujoco.MjData`.
        """
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
        # the goal follows the target in 0.02 s, without jumps between two pictures of 60 Hz; 1 cm off is 9 N
        self._goal = self._goal + (pull.to - self._goal) * (TIMESTEP / 0.02)
        spring = 900.0 * (self._goal - self.at)
        size = float(np.linalg.norm(spring))
        self.limited = size > STRONGEST
        spring *= min(1.0, STRONGEST / max(size, 1e-9))
        self.force = spring - 30.0 * (self._linear @ data.qvel)  # [N s/m]
        data.qfrc_applied += self._linear.T @ self.force
        if pull.turn is not None:
            aim = rotation_matrix(pull.turn) @ self._first
            moment = 15.0 * rotation_vector(aim @ rotation.T)  # [N m/rad]
            moment *= min(1.0, 6.0 / max(float(np.linalg.norm(moment)), 1e-9))  # [N m] largest moment of a wrist
            data.qfrc_applied += self._angular.T @ (moment - 0.5 * (self._angular @ data.qvel))  # [N m s/rad]


@final
class TeachingArm:
    """Driver of the simulated arm in a teaching scene, in real time.

    Args:
        scene: The scene.
        rng: Random generator of the encoder noise.
        in_real_time: False to run without waiting, e.g. in tests.
        shown: Function without arguments that is called after each period.

    Attributes:
        scene: The scene.
        hand: Forces of the person's hand.
        period: Time between two readings [s].
        joint_names: Names of the joints in the robot's order.
        held: True while the gripper is closed on the handle.
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
        noise = {"noise": 1e-4, "rng": rng}  # [rad or m] noise of the encoders: 16 bits per turn
        self._arm = MuJoCoDriver(model, self.joint_names, scene.start, period=PERIOD, hand=self.hand, **noise)
        self.model, self.data = model, self._arm.data
        self.release, self.hold = self._arm.release, self._arm.hold  # as for `MuJoCoDriver`
        self._tip = model.site("tip").id
        self._handle = model.body("handle")
        self.held, self._closed, self._opened = False, 0.0, False  # closing time [s]; True after opening at the handle
        self._due = time.perf_counter()
        self.release()

    # ---- as a driver ----------------------------------------------------------------------------------------------

    def read(self) -> tuple[Float[np.ndarray, " n"], None, Float[np.ndarray, " n"]]:
        """Read the encoders and the drives.

        Returns:
            Joint positions with encoder noise (n,) [rad or m], None for velocities, and efforts of the drives (n,)
            [N m or N].
        """
        q, _, effort = self._arm.read()
        return q, None, effort

    def command(self, q: Float[np.ndarray, " n"], u: Float[np.ndarray, " n"]) -> None:
        """Send joint positions to the servos, and simulate one period.

        Args:
            q: Joint positions (n,) [rad or m].
            u: Joint velocities; not used.
        """
        self._arm.command(q, u)
        self._pass()

    def wait(self) -> None:
        """Simulate one period without a command."""
        self._arm.wait()
        self._pass()

    def gripper(self, word: Literal["close", "open"]) -> None:
        """Close or open the gripper, as `run` calls it for a controller's motion.

        Args:
            word: `"close"` or `"open"`.
        """
        self.grip(word == "close")

    def _pass(self) -> None:
        """Update the gripper, the picture and the clock after a period of physics."""
        # pages repeat a pull every 0.2 s: a pull that is not repeated for 0.6 s is over
        if self.hand.pull is not None and time.perf_counter() - self.hand.pull.heard > 0.6:
            self.hand.take(None, self.data)
        if self.held:  # a grip becomes firm in 0.4 s while the gripper closes
            share = min(1.0, (self.time - self._closed) / 0.4)
            self.model.equality("grip").solref[0] = SOFT * (STIFF / SOFT) ** share
        self._shown()
        if not self._waits:
            return
        self._due += self.period
        if (pause := self._due - time.perf_counter()) > 0.0:
            time.sleep(pause)
        elif pause < -0.25:  # [s] late: after the computer has slept, do not catch up
            self._due = time.perf_counter()

    # ---- the person's hand ----------------------------------------------------------------------------------------

    @property
    def time(self) -> float:
        """Simulated time [s]."""
        return float(self.data.time)

    @property
    def q(self) -> Float[np.ndarray, " nv"]:
        """Joint positions of the simulation, without encoder noise (nv,) [rad or m]."""
        return self.data.qpos[self._arm._q].copy()

    @property
    def q_held(self) -> Float[np.ndarray, " nv"]:
        """Goal of the servos, joint positions (nv,) [rad or m]."""
        return self._arm.goal

    @property
    def place(self) -> Float[np.ndarray, " 3"]:
        """Position of the tip in the base frame (3,) [m]."""
        return self.data.site_xpos[self._tip].copy()

    @property
    def handle_place(self) -> Float[np.ndarray, " 3"]:
        """Position of the handle in the base frame (3,) [m]."""
        return self.data.xpos[self._handle.id].copy()

    @property
    def opening(self) -> float:
        """Displacement of the handle [m or rad]; on a plane along its first direction."""
        return float(self.data.joint("handle_x").qpos[0])

    @property
    def is_near(self) -> bool:
        """True if the handle is within reach of the gripper."""
        return bool(np.linalg.norm(self.handle_place - self.place) < REACHES)

    def pull(
        self, link: str | None, at: Any, to: Float[np.ndarray, " 3"], turn: Float[np.ndarray, " 3"] | None = None
    ) -> None:
        """Pull a link of the arm, or the tip, towards a target.

        Args:
            link: Name of the joint whose link is pulled; None for the tip.
            at: shape (3,), the pulled point of the link, in its joint's frame [m]; None for the tip.
            to: shape (3,), target of that point in the base frame [m].
            turn: shape (3,), rotation vector by which the hand turns the link [rad]; None for no rotation.
        """
        if link is None:
            body, at = int(self.model.site_bodyid[self._tip]), self.model.site_pos[self._tip].copy()
        else:
            body = self.model.body(link).id
        self.hand.take(Pull(body, at, to, turn, time.perf_counter()), self.data)

    def let_go(self) -> None:
        """End the pull of the hand; the gripper does not change."""
        self.hand.take(None, self.data)
        self._opened = self._opened and self.is_near

    def grip(self, closed: bool) -> bool:
        """Close the gripper on a handle within reach, or open it.

        Args:
            closed: True to close the gripper, False to open it.

        Returns:
            True if the gripper is closed on a handle now.
        """
        if closed and not self.held and self.is_near:
            if self.scene.handle.firm:  # align its site with the hand, so that closing turns neither
                site, back, turn = self.model.site("handle"), np.zeros(4), np.zeros(4)
                self.model.site_sameframe[site.id] = 0  # otherwise MuJoCo would use the body's frame
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
        """Close the gripper if the hand has come to a handle.

        A gripper that was opened at the handle stays open until the person has let go of the arm elsewhere, or starts
        another recording, because the hand passes the handle again after it has pushed a drawer shut.

        Returns:
            True if the gripper has closed on a handle in this call.
        """
        return not self.held and self.is_near and not self._opened and self.grip(True)

    def shut(self) -> None:
        """Open the gripper, and move the furniture back to its initial position."""
        self.grip(False)
        self._opened = False
        joints = self._handle.jntadr[0] + np.arange(self._handle.jntnum[0])
        self.data.qpos[self.model.jnt_qposadr[joints]] = self.data.qvel[self.model.jnt_dofadr[joints]] = 0.0
