"""Simulate a person who guides an arm along a plan, badly: springs to where hand and elbow are meant to be."""

# pyright: reportAttributeAccessIssue=false
# (the compiled parts of MuJoCo have no complete stubs)
from __future__ import annotations

from dataclasses import dataclass
from typing import final

import mujoco
import numpy as np
from jaxtyping import Float

from make_recordings.arms import Arm
from make_recordings.guided_model import STIFF, TIMESTEP, TIP, guided_model, joints_of, joints_turn_the_hand
from make_recordings.hand_motion import RATE
from make_recordings.mechanism_motion import UnreachableError
from make_recordings.mechanisms import Mechanism, Upright
from make_recordings.operator import slow_noise
from make_recordings.whole_recording import Tape

SPRING, DASHPOT = 900.0, 30.0  # the hand at the tip [N/m], [N s/m]
ELBOW = 40.0  # the other hand on the arm [N m/rad], a third of it at the wrist
ASTRAY = 0.008  # of the hand from where it is meant to go, standard deviation [m]
PUSH = 1.5  # on the joints, standard deviation [N m], a fifth of it at the wrist
LEVEL = 60.0  # how stiffly a full glass is kept upright [N m/rad]
SETTLE = 0.5  # time to take hold [s]
SOFT = 0.12  # settling time of a grip at first [s]
SNAP = 0.06  # after a slip: time until the new grip is firm [s]
SUBSTEPS = round(1.0 / (RATE * TIMESTEP))


@final
@dataclass(frozen=True)
class Grip:
    """When a mechanism is held.

    Attributes:
        index: Of the mechanism.
        close: Sample at which the hand begins to close.
        start: Sample from which it holds for certain.
        end: Sample at which it lets go.
        anywhere: Whether it takes hold where it happens to be, as after a slip, or at the handle's place.
    """

    index: int
    close: int
    start: int
    end: int
    anywhere: bool


def simulate(
    arm: Arm, plan: Tape, mechanisms: list[Mechanism], rng: np.random.Generator, friction: float = 1.0
) -> Tape:
    """What the physics makes of a plan: the same windows, other motion.

    Args:
        arm: The arm.
        plan: What the person has in mind.
        mechanisms: What the indices of the plan's windows mean.
        rng: Source of the person's errors.
        friction: Factor on the dry friction of the arm's joints.

    Raises:
        UnreachableError: The arm did not come to the handle, or was thrown off.
    """
    wanted = plan.motion
    grips = grips_of(plan)
    places = [mechanism.handle for mechanism in mechanisms]
    for grip in reversed([grip for grip in grips if not grip.anywhere]):
        places[grip.index] = arm.pose(wanted[grip.start])[:3, 3]
    model = guided_model(arm, mechanisms, places, friction)
    motion = _run(model, arm, wanted, grips, mechanisms, rng)
    windows = [(round(g.start / RATE, 2), round(g.end / RATE, 2), g.index) for g in grips]
    return Tape([motion], windows, arm.offset)


def grips_of(plan: Tape) -> list[Grip]:
    """The grips of a plan whose person waits for `SETTLE` before each first contact."""
    grips: list[Grip] = []
    for start, end, index in plan.windows:
        first, last = round(start * RATE), round(end * RATE)
        again = bool(grips) and grips[-1].index == index
        close = first if again else max(first - round(SETTLE * RATE), 0)
        grips.append(Grip(index, close, first + round(SNAP * RATE) * again, last, again))
    return grips


def _run(
    model: mujoco.MjModel,
    arm: Arm,
    wanted: np.ndarray,
    grips: list[Grip],
    mechanisms: list[Mechanism],
    rng: np.random.Generator,
) -> np.ndarray:
    """Joint angles at 100 Hz [rad]."""
    data, n = mujoco.MjData(model), wanted.shape[1]
    data.qpos[:n] = wanted[0]
    stiffness = np.where(np.arange(n) < n - 3, ELBOW, ELBOW / 3.0)
    aim = _aims(arm, wanted, stiffness, rng)
    tip, jacobian, turning = model.site(TIP).id, np.zeros((3, model.nv)), np.zeros((3, model.nv))
    closing = [grip for grip in grips if joints_of(mechanisms[grip.index])]
    level = [grip for grip in grips if isinstance(mechanisms[grip.index], Upright)]
    upwards = [arm.pose(wanted[grip.start])[2, :3] for grip in level]
    motion = np.empty_like(wanted)
    for k in range(len(wanted)):
        motion[k] = data.qpos[:n]
        for grip in closing:
            _work(model, data, grip, k, joints_turn_the_hand(mechanisms[grip.index]))
        carried = [up for grip, up in zip(level, upwards, strict=True) if grip.close <= k < grip.end]
        ahead = aim[min(k + 1, len(aim) - 1)] - aim[k]
        for step in range(SUBSTEPS):
            mujoco.mj_step1(model, data)
            mujoco.mj_jacSite(model, data, jacobian, turning, tip)
            goal = aim[k] + (step / SUBSTEPS) * ahead
            force = SPRING * (goal[:3] - data.site_xpos[tip]) - DASHPOT * (jacobian @ data.qvel)
            data.qfrc_applied[:n] = jacobian[:, :n].T @ force + goal[3:] - stiffness * data.qpos[:n]
            for up in carried:
                top = data.site_xmat[tip].reshape(3, 3) @ up
                upright = LEVEL * np.array([top[1], -top[0], 0.0])  # top x (0, 0, 1)
                data.qfrc_applied[:n] += turning[:, :n].T @ upright
            mujoco.mj_step2(model, data)
    if not np.all(np.isfinite(motion)) or data.warning[mujoco.mjtWarning.mjWARN_BADQACC].number:
        raise UnreachableError("the simulation broke down")
    return motion


def _aims(arm: Arm, wanted: np.ndarray, stiffness: np.ndarray, rng: np.random.Generator) -> Float[np.ndarray, "T m"]:
    """Where the tip is meant to be [m], and torque of the hands at joint angle zero [N m]; both with human error.

    Error comes with motion: it fades where the plan rests.
    """
    n = len(stiffness)
    places = np.array([arm.pose(row)[:3, 3] for row in wanted])
    astray = slow_noise(np.full(3, ASTRAY), 0.3, 1.2, rng)
    push = slow_noise(np.where(np.arange(n) < n - 3, PUSH, PUSH / 5.0), 0.15, 0.7, rng)
    moving = np.any(np.diff(wanted, axis=0, append=wanted[-1:]) != 0.0, axis=1).astype(float)
    window = np.hanning(43)[1:-1]
    fade = np.convolve(np.pad(moving, 20, mode="edge"), window / window.sum(), mode="valid")
    noise = np.array([np.concatenate([astray(k / RATE), push(k / RATE)]) for k in range(len(wanted))])
    return np.hstack([places, wanted * stiffness]) + fade[:, None] * noise


def _work(model: mujoco.MjModel, data: mujoco.MjData, grip: Grip, k: int, firm: bool) -> None:
    """Close, stiffen or open a grip at sample k."""
    hold = model.equality(f"grip_{grip.index}").id
    if k == grip.close:
        _place_handle(model, data, grip, firm)
        data.eq_active[hold] = 1
    if grip.close <= k <= grip.start:
        share = 1.0 if grip.anywhere or grip.close == grip.start else (k - grip.close) / (grip.start - grip.close)
        model.eq_solref[hold, 0] = STIFF if share > 0.7 else SOFT * (STIFF / SOFT) ** (share / 0.7)
    if k == grip.end:
        data.eq_active[hold] = 0


def _place_handle(model: mujoco.MjModel, data: mujoco.MjData, grip: Grip, firm: bool) -> None:
    """Give the handle the hand's place (after a slip), and turn it as the hand is turned."""
    handle, body = model.site(f"handle_{grip.index}").id, model.body(f"handle_{grip.index}").id
    mujoco.mj_kinematics(model, data)
    tip = model.site(TIP).id
    model.site_sameframe[handle] = 0  # else MuJoCo takes the body's frame for the site's without a look
    back, place, turn = np.zeros(4), np.zeros(3), np.zeros(4)
    mujoco.mju_negQuat(back, data.xquat[body])
    if grip.anywhere:
        mujoco.mju_rotVecQuat(place, data.site_xpos[tip] - data.xpos[body], back)
        model.site_pos[handle] = place
    if firm:
        mujoco.mju_mat2Quat(turn, data.site_xmat[tip])
        mujoco.mju_mulQuat(model.site_quat[handle], back, turn)
