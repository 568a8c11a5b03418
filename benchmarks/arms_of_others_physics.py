"""What a person shows on arms that are not shipped, done again in physics: where the fingers close, how far it goes.

    python benchmarks/arms_of_others_physics.py --seed 1 xarm7 kinova:drawer ur5:door
    python benchmarks/arms_of_others_physics.py --seed 1 --folder urdf_files gen3 iiwa14 irb1600

An arm and one fixture in MuJoCo. A person guides the hand to the handle, along the fixture and away (tremor, a pause,
pushes at the elbow); five whole recordings at 100 Hz with 1e-4 rad of noise are learnt with default options. `repeat`
then goes from another start, in a `ServoLoop` on servos of 2000 N m/rad with 5e-5 rad of noise; the grip closes where
the hand is when the loop says so. One line a run: how far off the handle the hand closed, how far the fixture went over
the median shown, how much otherwise the hand turned than what it holds, the largest force in the grip, and the tip's
path over three times the straight one and 0.2 m. An arm that has arrived stays: `left` is its last half second. Nothing
of the library takes part in the recordings. The arms of `--folder` are files that others published:
https://github.com/Daniella1/urdf_files_dataset.
"""

# pyright: reportAttributeAccessIssue=false
# (the compiled parts of MuJoCo have no complete stubs)
from __future__ import annotations

import argparse
import re
import sys
import tempfile
import time
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, final

import mujoco
import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation as R

import manip_learn as ml

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "examples"))
from make_recordings.guided_arm import set_damping  # pyright: ignore[reportMissingImports]

TIMESTEP, RATE, NOISE = 0.001, 100.0, 1e-4  # [s], of recordings [Hz] and [rad]
STIFFNESS, SLIDE, SERVO_NOISE = 2000.0, 2e5, 5e-5  # [N m/rad], [N/m], [rad or m]
RECORDINGS = 5
FORWARD = R.from_matrix(np.column_stack([[0, 1, 0], [0, 0, 1], [1, 0, 0]]))  # the hand's z along x of the base
DOWN = R.from_matrix(np.diag([1.0, -1.0, -1.0]))
COMPILER = '<mujoco><compiler fusestatic="false" balanceinertia="true" boundinertia="1e-4" boundmass="0.05"/></mujoco>'
TOO_FAR, MOST_FORCE, WAY = 5e-3, 40.0, (0.95, 1.08)  # [m], [N], shares of what was shown: what counts as done


class OutOfReachError(Exception):
    """A fixture that stands where this arm cannot be guided along it."""


@final
@dataclass(frozen=True)
class Arm:
    """An arm: what `load_robot` is told, its hand, a posture in front of fixtures, their distance over a metre.

    And what is written otherwise in its file.
    """

    name: str
    tip: str
    home: tuple[float, ...]
    size: float = 0.8
    edit: tuple[str, str] = ("", "")

    def load(self, folder: Path) -> ml.Robot:
        """The robot."""
        robot = ml.load_robot(str(folder / self.name) if "/" in self.name else self.name)
        if not self.edit[0] or robot.source is None or robot.description is None:
            return robot
        file = Path(tempfile.mkdtemp()) / "edited.urdf"
        file.write_text(robot.description.decode().replace(*self.edit), encoding="utf-8")
        return ml.load_robot(str(file), package_dirs=list(robot.source.parents)[:5])


LIFT = (  # a column below the arm
    '"world_joint" type="fixed">',
    '"lift" type="prismatic"><axis xyz="0 0 1"/><limit lower="-0.2" upper="0.3" velocity="0.5" effort="500"/>',
)
GEN3, IIWA, IRB = (
    "matlab/kortex_description/urdf/kinovaGen3.urdf",
    "drake/iiwa_description/urdf/iiwa14_primitive_collision.urdf",
    "matlab/abb_irb1600_support/urdf/abbIrb1600.urdf",
)
ARMS = {
    "xarm7": Arm("xarm7", "link_eef", (0.0, -0.2, 0.0, 1.4, 0.0, 0.1, 0.0), 0.75),
    "kinova": Arm("kinova", "j2s6s200_end_effector", (3.1, 3.4, 1.9, 1.5, 2.0, 1.6), 0.75),  # joints without ends
    "lost_mesh": Arm("xarm7", "link_eef", (0.0, -0.2, 0.0, 1.4, 0.0, 0.1, 0.0), 0.75, ("link7.stl", "no.stl")),
    "column": Arm("ur5", "tool0", (0.2, 0.0, -1.6, 1.9, -0.3, 1.57, 0.0), 0.85, LIFT),
    "gen3": Arm(GEN3, "EndEffector_Link", (0.0, 0.3, 3.1, -2.2, 0.0, 0.9, 1.5), 0.8),
    "iiwa14": Arm(IIWA, "iiwa_link_7", (-0.5, 1.0, 1.2, -1.5, 0.3, -0.9, -1.2), 1.1),
    "irb1600": Arm(IRB, "tool0", (0.2, 0.4, 0.1, 0.35, -0.55, -3.4), 1.5),
    "ur5": Arm("ur5", "tool0", (0.0, -1.6, 1.9, -0.3, 1.57, 0.0), 0.85),
}


@final
@dataclass(frozen=True)
class Task:
    """A fixture: its joints (kind, axis, point from the handle), the handle with its bar, how it is held and moved.

    The way is the share of `ways` that the joints go out and back, of a table two of them in loops.
    """

    joints: tuple[tuple[str, Sequence[float], Sequence[float]], ...]
    handle: tuple[float, ...]
    bar: tuple[Sequence[float], float]
    ways: tuple[float, ...]
    friction: float
    firm: bool = False
    down: bool = False
    kept: float = 0.0  # [N m/rad] of a wrist that is held straight


OUT, BESIDE, NONE = (-np.cos(0.6), -np.sin(0.6), 0.0), (-np.sin(0.6), np.cos(0.6), 0.0), (0.0, 0.0, 0.0)
X, Y, Z = np.eye(3).tolist()
DRAWER = Task((("slide", OUT, NONE),), (0.62, 0.15, 0.35), (BESIDE, 0.06), (0.22,), 3.0)
LID = Task((("hinge", (0, -1, 0), (0.28, 0, 0)),), (0.4, 0.1, 0.25), (Y, 0.08), (1.1,), 0.4, down=True)
SLOPE = ("slide", (np.cos(0.12), 0, -np.sin(0.12)), NONE), ("slide", Y, NONE)
TASKS = {
    "drawer": DRAWER,
    "skew": replace(DRAWER, bar=(Y, 0.06)),
    "drawer_kept": replace(DRAWER, kept=25.0),
    "door": Task((("hinge", Z, (0.02, -0.35, 0)),), (0.6, 0.1, 0.45), (Z, 0.06), (1.0,), 0.6, True),
    "valve": Task((("hinge", X, (0, -0.12, 0)),), (0.6, 0.12, 0.4), (X, 0.0), (1.4,), 0.6, True),
    "sliding_door": Task((("slide", Y, NONE),), (0.55, -0.2, 0.45), (Z, 0.1), (0.42,), 5.0, True),
    "knob": Task((("hinge", X, NONE),), (0.6, 0.05, 0.4), (X, 0.01), (1.2,), 0.1, True),
    "lid": LID,
    "lid_kept": replace(LID, handle=(0.45, 0.1, 0.25), ways=(0.6,), kept=25.0),
    "oven": Task((("hinge", (0, -1, 0), (0.03, 0, -0.32)),), (0.62, 0.0, 0.5), (Y, 0.1), (1.0,), 1.0),
    "table": Task(SLOPE, (0.5, 0.0, 0.2), (Y, 0.08), (0.1, 0.14), 1.0, down=True),
    "peg": Task((("slide", Z, NONE),), (0.5, 0.1, 0.3), (Z, 0.01), (0.12,), 0.5, True, True),
}


def _unit(x: Any) -> np.ndarray:
    return np.asarray(x, dtype=np.float64) / np.linalg.norm(x)


def _way(task: Task, phase: np.ndarray, share: float) -> Float[np.ndarray, " k"]:
    """Where the fixture's joints are at a share of the time of the contact."""
    ways = np.array(task.ways)
    if len(ways) == 1:
        return ways * np.sin(np.pi * share) ** 2
    return ways * (np.sin(2.0 * np.pi * share * np.array([1.3, 0.9]) + phase[:2]) - np.sin(phase[:2]))


class World:
    """The arm and its fixture; the arm carries its own weight."""

    def __init__(self, arm: Arm, robot: ml.Robot, task: Task, rng: np.random.Generator):
        self.task, self.arm, self.rng, self.n = task, arm, rng, robot.nv
        text = (robot.description or b"").decode()
        for tag in ("visual", "collision", "transmission", "gazebo"):
            text = re.sub(rf"<{tag}\b[^>]*/>|<{tag}\b.*?</{tag}>", "", text, flags=re.DOTALL)
        moving = "|".join(map(re.escape, robot.joint_names))
        text = re.sub(rf'(<joint\s+name="(?!(?:{moving})")[^"]*"\s+type=)"[a-z]+"', r'\1"fixed"', text)
        text = re.sub(r"(<robot\b[^>]*>)", r"\1" + COMPILER, text, count=1)
        spec = mujoco.MjSpec.from_string(text)
        spec.option.timestep, spec.option.gravity = TIMESTEP, [0.0, 0.0, 0.0]
        spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
        self.handle = arm.size * np.array(task.handle)
        parent = spec.worldbody
        for k, (kind, axis, point) in enumerate(task.joints):
            parent = parent.add_body(name=f"fixture {k}", pos=np.zeros(3) if k else self.handle)
            joint = parent.add_joint(name=f"fixture joint {k}", axis=_unit(axis), pos=arm.size * np.array(point))
            joint.type = getattr(mujoco.mjtJoint, f"mjJNT_{kind.upper()}")
            set_damping(joint, 0.5 if kind == "hinge" else 3.0)
            joint.frictionloss, joint.armature = task.friction, 0.01
            parent.mass, parent.inertia, parent.explicitinertial = 0.3, [0.01] * 3, True
        hold = spec.add_equality(name="grip", name1=arm.tip, name2=parent.name, objtype=mujoco.mjtObj.mjOBJ_BODY)
        hold.type = mujoco.mjtEq.mjEQ_WELD if task.firm else mujoco.mjtEq.mjEQ_CONNECT
        hold.active, hold.solref = False, [0.004, 1.0]
        self.m = m = spec.compile()
        self.d, self.sensed = mujoco.MjData(m), mujoco.MjData(m)
        own = [m.joint(name) for name in robot.joint_names]
        of_it = [m.joint(f"fixture joint {k}") for k in range(len(task.joints))]
        self.q, self.fq = (np.array([j.qposadr[0] for j in some]) for some in (own, of_it))
        self.v, self.fv = (np.array([j.dofadr[0] for j in some]) for some in (own, of_it))
        self.tip, self.body = m.body(arm.tip).id, m.body(parent.name).id
        m.dof_armature[self.v], m.dof_damping[self.v], m.dof_frictionloss[self.v] = 0.15, 1.5, 0.25
        self.low, self.high = robot.position_lower + 0.02, robot.position_upper - 0.02

    def kinematics(self, q: np.ndarray) -> tuple[np.ndarray, R, np.ndarray]:
        """Place, orientation and Jacobian (6, n) of the hand."""
        d = self.sensed
        d.qpos[self.q] = q
        mujoco.mj_kinematics(self.m, d)
        mujoco.mj_comPos(self.m, d)
        J = np.zeros((6, self.m.nv))
        mujoco.mj_jacBody(self.m, d, J[:3], J[3:], self.tip)
        return d.xpos[self.tip].copy(), R.from_matrix(d.xmat[self.tip].reshape(3, 3)), J[:, self.v]

    def posture(self, place: np.ndarray, turn: R, q: np.ndarray) -> tuple[np.ndarray, float]:
        """A posture with the hand there, from another, and how far off it is."""
        error = np.ones(6)
        for _ in range(200):
            x, r, J = self.kinematics(q)
            error = np.append(place - x, (turn * r.inv()).as_rotvec())
            if np.linalg.norm(error) < 1e-6:
                break
            step = J.T @ np.linalg.solve(J @ J.T + 1e-4 * np.eye(6), error)
            q = np.clip(q + np.clip(step, -0.2, 0.2), self.low, self.high)
        return q, float(np.linalg.norm(error))

    def grasp(self) -> tuple[np.ndarray, np.ndarray, R]:
        """Where on the bar the hand takes hold, in which posture, how turned."""
        axis, half = self.task.bar
        for _ in range(120):
            place = self.handle + self.arm.size * _unit(axis) * self.rng.uniform(-half, half)
            turn = R.from_rotvec(self.rng.normal(0.0, 0.12, 3)) * (DOWN if self.task.down else FORWARD)
            if not self.task.firm:
                turn = turn * R.from_rotvec([0.0, 0.0, self.rng.choice([0.0, np.pi / 2, -np.pi / 2])])
            q, off = self.posture(place, turn, np.array(self.arm.home) + self.rng.normal(0.0, 0.35, self.n))
            if off < 1e-4:
                return place, q, turn
        raise OutOfReachError("this arm cannot hold that")

    def hold(self, on: bool) -> None:
        """Close the grip where the hand is, or open it."""
        m, d = self.m, self.d
        if on:
            mujoco.mj_forward(m, d)
            fixture, hand = d.xmat[self.body].reshape(3, 3), d.xmat[self.tip].reshape(3, 3)
            apart = d.xpos[self.body] - d.xpos[self.tip]
            m.eq_data[0, :6] = np.append(np.zeros(3), hand.T @ apart if self.task.firm else -fixture.T @ apart)
            turn = np.zeros(4)
            mujoco.mju_mat2Quat(turn, (hand.T @ fixture).ravel())
            m.eq_data[0, 6:11] = np.append(turn, 1.0)
        d.eq_active[0] = on

    @property
    def force(self) -> float:
        """In the grip [N]."""
        held = self.d.efc_type[: self.d.nefc] == mujoco.mjtConstraint.mjCNSTR_EQUALITY
        return float(np.linalg.norm(self.d.efc_force[: self.d.nefc][held][:3])) if self.d.eq_active[0] else 0.0


def recorded(arm: Arm, robot: ml.Robot, task: Task, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Time and joint positions of a recording, and how far the fixture's joints went from where they began."""
    rng = np.random.default_rng(seed)
    w = World(arm, robot, task, rng)
    m, d = w.m, w.d
    place, held, turn = w.grasp()
    phase, back = rng.uniform(0.0, 2.0 * np.pi, 2), turn.apply([0.0, 0.0, -1.0])
    before = place + 0.12 * back + rng.normal(0.0, 0.03, 3), R.from_rotvec(rng.normal(0.0, 0.2, 3)) * turn
    start, _ = w.posture(*before, held)
    spans = [rng.uniform(*x) for x in ((0.2, 0.5), (1.5, 2.5), (0.2, 0.6), (4.0, 7.0), (0.2, 0.5), (1.0, 1.6))]
    edge, pause, size = np.cumsum(spans), rng.uniform(0.2, 0.8), rng.uniform(0.8, 1.0)
    slides = np.array([kind == "slide" for kind, *_ in task.joints])
    stiff, damp = np.where(slides, 2700.0, 180.0), np.where(slides, 60.0, 4.0)
    gains = np.where(np.array(robot.joint_units) == "rad", 1.0, SLIDE / STIFFNESS)
    tremor, push, out, far, end = np.zeros(3), np.zeros(w.n), list[np.ndarray](), list[np.ndarray](), (held, held)
    d.qpos[w.q] = start
    J = np.zeros((6, m.nv))

    def smooth(x: float) -> float:
        x = min(max(x, 0.0), 1.0)
        return x * x * (3.0 - 2.0 * x)

    for i in range(int(edge[-1] / TIMESTEP)):
        t = i * TIMESTEP
        tremor += -20.0 * TIMESTEP * tremor + np.sqrt(TIMESTEP) * rng.normal(0.0, 8.0, 3)  # [N]
        push += -0.8 * TIMESTEP * push + np.sqrt(TIMESTEP) * rng.normal(0.0, 1.2, w.n)  # [N m]
        d.qfrc_applied[:] = 0.0
        if t < edge[1] or t >= edge[4]:
            if t >= edge[4] and d.eq_active[0]:
                w.hold(False)
                here = d.qpos[w.q].copy()
                x, r, _ = w.kinematics(here)
                end = here, w.posture(x + r.apply([0.0, 0.0, -0.1]) + rng.normal(0.0, 0.02, 3), r, here)[0]
            a, b, share = (start, held, (t - edge[0]) / spans[1]) if t < edge[1] else (*end, (t - edge[4]) / spans[5])
            goal = a + smooth(share) * (b - a)
            d.qfrc_applied[w.v] = gains * (300.0 * (goal - d.qpos[w.q]) - 20.0 * d.qvel[w.v]) + 0.3 * push
        else:
            if not d.eq_active[0]:
                w.hold(True)
            share = float(np.clip((t - edge[2]) / spans[3], 0.0, 1.0))  # which rests in the middle
            share = np.interp(share, [0.0, pause - 0.06, pause + 0.06, 1.0], [0.0, pause - 0.06, pause - 0.06, 1.0])
            mujoco.mj_jacBody(m, d, J[:3], J[3:], w.tip)
            d.qfrc_applied[w.v] = 0.5 * push
            d.qfrc_applied += J[:3].T @ tremor
            if task.kept:
                turned = (R.from_matrix(d.xmat[w.tip].reshape(3, 3)) * turn.inv()).as_rotvec()
                d.qfrc_applied += J[3:].T @ (-task.kept * turned - 1.5 * J[3:] @ d.qvel)
            goal = size * (_way(task, phase, share) - _way(task, phase, 0.0))
            d.qfrc_applied[w.fv] += stiff * (goal - d.qpos[w.fq]) - damp * d.qvel[w.fv]
        mujoco.mj_step(m, d)
        if i % round(1.0 / RATE / TIMESTEP) == 0:
            out.append(np.append(t, d.qpos[w.q] + rng.normal(0.0, NOISE, w.n)))
            far.append(d.qpos[w.fq].copy())
    return np.array(out), np.array(far)


@final
@dataclass(frozen=True)
class Outcome:
    """What became of a run; lengths in m, angles in degrees."""

    off: float
    way: float
    turned: float
    force: float
    path: float
    left: float
    seconds: float
    said_done: bool
    notes: str = ""

    @property
    def done(self) -> bool:
        """Whether the fixture did what was shown."""
        return self.off <= TOO_FAR and WAY[0] <= self.way <= WAY[1] and self.force <= MOST_FORCE and self.path <= 1.0


def run(arm: Arm, task: Task, seed: int, folder: Path) -> Outcome:
    """Record, learn, repeat, and look at the fixture."""
    robot = arm.load(folder)
    made = list[tuple[np.ndarray, np.ndarray]]()
    for k in range(4 * RECORDINGS):
        one = recorded(arm, robot, task, 1000 * seed + k)
        q = one[0][:, 1:]
        if np.all((q > robot.position_lower) & (q < robot.position_upper)):  # a person's arm does not pass its stops
            made.append(one)
        if len(made) == RECORDINGS + 1:
            break
    if len(made) <= RECORDINGS:
        raise OutOfReachError("no recordings within the limits")
    names = [f"recording {k + 1}" for k in range(len(made))]
    demos = [
        ml.Trajectory(x[:, 0], x[:, 1:], None, robot.joint_names, n) for n, (x, _) in zip(names, made, strict=True)
    ]
    extents = np.array([np.max(np.linalg.norm(far - far[0], axis=1)) for _, far in made[:RECORDINGS]])
    shown = float(np.median(extents))
    skill = ml.ConstraintLearner(ml.FrameJacobian(robot, arm.tip)).fit(demos[:RECORDINGS]).skill_
    start, began = demos[RECORDINGS].q[0], time.process_time()
    again = ml.repeat(skill, start)
    seconds = time.process_time() - began
    w = World(arm, robot, task, np.random.default_rng(seed))
    m, d = w.m, w.d
    d.qpos[w.q] = start
    mujoco.mj_forward(m, d)
    inertia = np.zeros((m.nv, m.nv))
    mujoco.mj_fullM(m, d, inertia)
    stiffness = np.where(np.array(robot.joint_units) == "rad", STIFFNESS, SLIDE)
    damping = 2.0 * np.sqrt(stiffness * inertia.diagonal()[w.v])
    loop = ml.ServoLoop(again.controller, dt=TIMESTEP)
    loop.reset(start)
    most, force, off, turned, path = 0.0, 0.0, np.nan, 0.0, [w.kinematics(start)[0]]
    ways = [k for k, law in enumerate(again.controller.laws) if isinstance(law.task, ml.FreeDirection)]
    grip = (np.eye(3), np.eye(3))
    axis, half = _unit(task.bar[0]), arm.size * task.bar[1]
    for i in range(int((again.rollout.time[-1] + 3.0) / TIMESTEP)):  # servos come later than the plan
        command = loop.update(d.qpos[w.q] + w.rng.normal(0.0, SERVO_NOISE, w.n), i * TIMESTEP)
        number = loop.controller.number
        if number == ways[0] and np.isnan(off):
            out = d.xpos[w.tip] - w.handle
            off = float(np.linalg.norm(out - axis * np.clip(out @ axis, -half, half)))
            w.hold(True)
            grip = d.xmat[w.tip].reshape(3, 3).copy(), d.xmat[w.body].reshape(3, 3).copy()
        elif number > ways[-1] and d.eq_active[0]:
            w.hold(False)
        d.qfrc_applied[w.v] = stiffness * (loop.position - d.qpos[w.q]) - damping * (d.qvel[w.v] - command.velocity)
        mujoco.mj_step(m, d)
        if d.eq_active[0]:
            force, most = max(force, w.force), max(most, float(np.linalg.norm(d.qpos[w.fq])))
            hand, body = d.xmat[w.tip].reshape(3, 3) @ grip[0].T, d.xmat[w.body].reshape(3, 3) @ grip[1].T
            turned = max(turned, float(np.degrees(R.from_matrix(hand @ body.T).magnitude()))) if task.firm else 0.0
        if i % 20 == 0:
            path.append(d.xpos[w.tip].copy())
    if len(task.joints) > 1:  # one of the recordings is done again
        shown = float(extents[np.argmin(np.abs(extents - most))])
    walked = float(np.linalg.norm(np.diff(path, axis=0), axis=1).sum())
    hold = next(step.place for step in again.steps if step.grasp is not None)
    lever = arm.size * np.linalg.norm(task.joints[0][2])
    wiped = (
        next(s.shown.points for s in skill.steps if s.shown is not None) if len(task.joints) > 1 else np.zeros((1, 3))
    )
    extent = np.linalg.norm(np.diff(wiped, axis=0), axis=1).sum() or shown * (lever or 1.0)
    straight = np.linalg.norm(hold - path[0]) + extent + (np.linalg.norm(again.steps[-1].place - path[-1]) + 0.12)
    ratio, left = walked / (3.0 * straight + 0.2), float(np.linalg.norm(path[-1] - path[-25]))
    notes = "; ".join([loop.stopped_by or "", *again.notes])
    return Outcome(off, most / shown, turned, force, float(ratio), left, seconds, again.is_done, notes)


def main() -> None:
    """Run what is named, and count."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", nargs="*", help="ARM or ARM:TASK; by default all of arms not shipped")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--folder", type=Path, default=Path(), help="of the files that others published")
    options, good, total = parser.parse_args(), 0, 0
    warnings.simplefilter("ignore")
    for word in options.runs or ARMS:
        name, _, which = word.partition(":")
        for task in [which] if which else TASKS:
            total += 1
            try:
                one = run(ARMS[name], TASKS[task], options.seed, options.folder)
            except (OutOfReachError, ml.ManipLearnError) as error:
                print(f"{name}:{task} {options.seed}: {type(error).__name__}: {str(error)[:200]}", flush=True)
                continue
            good += one.done
            fails = "" if one.done else f"  <--- said {'' if one.said_done else 'not '}done; {one.notes[:300]}"
            print(
                f"{name}:{task} {options.seed}: closed {1e3 * one.off:.1f} mm off, way {one.way:.3f}, hand turned "
                f"{one.turned:.2f} deg beside it, {one.force:.0f} N, path {one.path:.2f}, {one.seconds:.1f} s{fails}",
                flush=True,
            )
    print(f"{good} of {total}")


if __name__ == "__main__":
    main()
