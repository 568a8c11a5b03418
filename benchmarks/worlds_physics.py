"""A plan in MuJoCo among what stands around: the arm's meshes, the world's boxes, contacts, position servos."""

# pyright: reportAttributeAccessIssue=false
# (the compiled parts of MuJoCo have no complete stubs)
from __future__ import annotations

import sys
from collections import deque
from pathlib import Path
from typing import Any, final

import coal
import mujoco
import numpy as np
from planned_worlds import TIPS, TURN, WAY, Solid, World, leaf_at, meshes_of
from scipy.spatial.transform import Rotation

import manip_learn as ml

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "examples"))
from make_recordings.guided_arm import set_damping
from make_recordings.guided_model import AXES, FORE, LEAST_INERTIA, LEAST_MASS, STIFF_SOLIMP, UPPER, WRIST

# [N m/rad] of position servos, and [N] at which the loop stops: a UR10's shoulder carries 6 kg m^2, a Panda's 1
SERVOS = {"ur5": (10_000.0, 150.0), "ur10": (20_000.0, 250.0)}
SERVO = 2000.0, 60.0
PERIOD, TIMESTEP = 0.001, 0.0005  # of the servo's commands, of the physics [s]
LATENCY = 0.002  # [s] from a measurement to the command that it leads to
ENCODER_NOISE = 1e-4  # [rad]
EVERY = 5  # periods between looks at the contacts
# what each body is, and what it collides with: the hand not with a door's leaf, the foot not with the floor
LINK, BOX, HAND, LEAF_BOX, FOOT, FLOOR = 1, 2, 4, 8, 16, 32
MEETS = {LINK: BOX | LEAF_BOX | FLOOR, HAND: BOX | FLOOR, FOOT: BOX | LEAF_BOX, BOX: 0, LEAF_BOX: 0, FLOOR: 0}


def _quaternion(rotation: np.ndarray) -> np.ndarray:
    return Rotation.from_matrix(rotation).as_quat()[[3, 0, 1, 2]]


@final
class WorldPhysics:
    """The arm, its servos, what it holds and what stands around.

    Args:
        one: The world.
        with_boxes: Whether the random boxes stand there.
        with_leaf: Whether a door has a leaf that is touched.
        rng: Source of the encoder noise.
    """

    def __init__(self, one: World, with_boxes: bool, with_leaf: bool, rng: np.random.Generator):
        spec = mujoco.MjSpec()
        spec.option.timestep, spec.option.gravity = TIMESTEP, [0.0, 0.0, 0.0]
        spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
        bodies = self._arm(spec, one)
        self._shapes(spec, one, bodies)
        for solid in (one.cabinet, *(one.boxes if with_boxes else ())):
            self._box(spec.worldbody, solid.name, solid, BOX)
        floor = spec.worldbody.add_geom(name="floor", type=mujoco.mjtGeom.mjGEOM_PLANE, size=[5.0, 5.0, 0.1])
        floor.contype, floor.conaffinity = FLOOR, MEETS[FLOOR]
        self._handle(spec, one, bodies, with_leaf)
        self.model = model = spec.compile()
        self.data, self._rng, self._n = mujoco.MjData(model), rng, one.robot.nv
        mujoco.mj_setConst(model, self.data)
        self.data.qpos[: self._n] = one.robot.positions(one.start)
        mujoco.mj_forward(model, self.data)
        inertia = np.zeros((model.nv, model.nv))
        mujoco.mj_fullM(model, self.data, inertia)
        self._stiffness = SERVOS.get(one.arm, SERVO)[0]
        self._damping = 2.0 * np.sqrt(self._stiffness * np.diag(inertia)[: self._n])
        late, first = round(0.5 * LATENCY / PERIOD), self.data.qpos[: self._n].copy()
        self._measured = deque([self._encoders() for _ in range(late + 1)], late + 1)
        self._sent = deque([first.copy() for _ in range(late + 2)], late + 2)
        self.touched: dict[tuple[str, str], float] = {}  # names -> greatest depth [m]

    def _arm(self, spec: Any, one: World) -> list[Any]:
        model, bodies = one.robot.pinocchio_model, [spec.worldbody]
        drives = [UPPER, UPPER, *[FORE] * (model.njoints - 6), WRIST, WRIST, WRIST]
        for i in range(1, model.njoints):
            placement, inertia, kind = model.jointPlacements[i], model.inertias[i], model.joints[i]
            body = bodies[model.parents[i]].add_body(name=model.names[i], pos=placement.translation)
            body.quat = _quaternion(placement.rotation)
            body.mass, body.ipos, body.explicitinertial = max(inertia.mass, LEAST_MASS), inertia.lever, True
            moments, axes = np.linalg.eigh(inertia.inertia)
            body.inertia = np.maximum(moments, LEAST_INERTIA)
            body.iquat = _quaternion(axes * np.linalg.det(axes))
            axis = AXES.get(kind.shortname()) or kind.extract().axis
            joint = body.add_joint(name=f"joint_{i}", type=mujoco.mjtJoint.mjJNT_HINGE, axis=axis)
            damping, joint.frictionloss, joint.armature = drives[i - 1]
            set_damping(joint, damping)
            bodies.append(body)
        return bodies

    def _shapes(self, spec: Any, one: World, bodies: list[Any]) -> None:
        meshes, model = meshes_of(one.arm), one.robot.pinocchio_model
        for k, thing in enumerate(meshes.things):
            frame = model.frames[one.robot.frame(meshes.links[k]).index]
            if frame.parentJoint == 0:
                continue
            own = meshes.model.frames[thing.parentFrame].placement.inverse() * thing.placement
            place, shape = frame.placement * own, thing.geometry
            geom = bodies[frame.parentJoint].add_geom(name=f"{meshes.links[k]} {k}", pos=place.translation)
            geom.quat, geom.mass = _quaternion(place.rotation), 0.0
            match shape:
                case coal.Box():
                    geom.type, geom.size = mujoco.mjtGeom.mjGEOM_BOX, np.asarray(shape.halfSide)
                case coal.Sphere():
                    geom.type, geom.size = mujoco.mjtGeom.mjGEOM_SPHERE, [shape.radius, 0.0, 0.0]
                case coal.Cylinder():
                    geom.type, geom.size = mujoco.mjtGeom.mjGEOM_CYLINDER, [shape.radius, shape.halfLength, 0.0]
                case _:
                    mesh = spec.add_mesh(name=f"mesh {k}", inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_CONVEX)
                    mesh.uservert = np.array(shape.vertices(), dtype=np.float32).ravel()
                    geom.type, geom.meshname = mujoco.mjtGeom.mjGEOM_MESH, mesh.name
            what = HAND if meshes.is_hand[k] else FOOT if frame.parentJoint == 1 else LINK
            geom.contype, geom.conaffinity = what, MEETS[what]

    @staticmethod
    def _box(body: Any, name: str, solid: Solid, what: int, origin: np.ndarray | None = None) -> None:
        place = solid.pose[:3, 3] - (0.0 if origin is None else origin)
        geom = body.add_geom(name=name, type=mujoco.mjtGeom.mjGEOM_BOX, pos=place, size=0.5 * solid.size, mass=0.0)
        geom.quat, geom.contype, geom.conaffinity = _quaternion(solid.pose[:3, :3]), what, MEETS[what]

    def _handle(self, spec: Any, one: World, bodies: list[Any], with_leaf: bool) -> None:
        grip, n = one.robot.position(one.start, TIPS[one.arm]), one.cabinet.pose[:3, 0]
        frame = one.robot.pinocchio_model.frames[one.robot.frame(TIPS[one.arm]).index]
        tip = bodies[frame.parentJoint].add_site(name="tip", pos=frame.placement.translation)
        tip.quat = _quaternion(frame.placement.rotation)
        body = spec.worldbody.add_body(name="handle", pos=grip)
        body.mass, body.inertia, body.explicitinertial = 1.0, np.full(3, 0.01), True
        slide, turn = mujoco.mjtJoint.mjJNT_SLIDE, mujoco.mjtJoint.mjJNT_HINGE
        across = np.cross([0.0, 0.0, 1.0], n)
        joints = {"drawer": [(slide, n, grip)], "wipe": [(slide, n, grip), (slide, across, grip)]}
        joints["door"] = [(turn, np.array([0.0, 0.0, 1.0]), one.hinge)]
        for number, (kind, axis, point) in enumerate(joints[one.kind]):
            joint = body.add_joint(name=f"handle_{number}", type=kind, axis=axis, pos=point - grip)
            set_damping(joint, 4.0 if kind == slide else 0.2)
            joint.frictionloss = 1.0 if one.kind == "drawer" else 0.2
        if one.hinge is not None and with_leaf:
            self._box(body, "leaf", leaf_at(one, grip), LEAF_BOX, grip)
        body.add_site(name="handle")
        hold = spec.add_equality(name="grip", type=mujoco.mjtEq.mjEQ_CONNECT)
        hold.objtype, hold.name1, hold.name2, hold.active = mujoco.mjtObj.mjOBJ_SITE, "tip", "handle", False
        hold.solref, hold.solimp = (2.0 * TIMESTEP, 1.0), STIFF_SOLIMP

    @property
    def way(self) -> np.ndarray:
        """How far what is held has moved [m or rad]."""
        return self.data.qpos[self._n :]

    def take_hold(self) -> None:
        """Close the grip."""
        self.data.eq_active[0] = 1

    def read(self) -> np.ndarray:
        """The newest positions that have arrived [rad]."""
        return self._measured[0]

    def command(self, q: np.ndarray) -> None:
        """Command the servos, and let one period pass."""
        data, n, steps = self.data, self._n, round(PERIOD / TIMESTEP)
        self._sent.append(q)
        start, end = self._sent[0], self._sent[1]
        for k in range(steps):
            goal = start + (k / steps) * (end - start)
            error, rate = goal - data.qpos[:n], (end - start) / PERIOD - data.qvel[:n]
            data.qfrc_applied[:n] = self._stiffness * error + self._damping * rate
            mujoco.mj_step(self.model, data)
        self._measured.append(self._encoders())

    def look(self) -> None:
        """Remember what touches."""
        for contact in self.data.contact[: self.data.ncon]:
            names = sorted(self.model.geom(int(g)).name for g in contact.geom)
            pair = names[0], names[1]
            self.touched[pair] = max(self.touched.get(pair, 0.0), -float(contact.dist))

    def _encoders(self) -> np.ndarray:
        return self.data.qpos[: self._n] + self._rng.normal(0.0, ENCODER_NOISE, self._n)


def executed(one: World, plan: ml.Plan, with_boxes: bool, with_leaf: bool) -> dict[str, Any]:
    """How far from its end what is held stays [mm], and what touched how deep [mm]."""
    physics = WorldPhysics(one, with_boxes, with_leaf, np.random.default_rng(0))
    stiffness, force = SERVOS.get(one.arm, SERVO)
    contact = ml.Contact(max_lateral_force=force, max_axial_force=force, latency=0.003, stiffness=stiffness)
    loop = ml.ServoLoop(plan.controller, PERIOD, contact=contact)
    loop.reset(one.start)
    held, sequence, status = False, loop.controller, ""
    for k in range(round((plan.rollout.time[-1] + 1.0) / PERIOD)):
        command = loop.update(physics.read(), physics.data.time)
        if sequence.number > 0 and not held:
            physics.take_hold()
            held = True
        physics.command(loop.position)
        if k % EVERY == 0:
            physics.look()
        status = str(command.status)
    if one.kind == "door":
        assert one.hinge is not None
        radius = np.linalg.norm((one.robot.position(one.start, TIPS[one.arm]) - one.hinge)[:2])
        short = radius * (TURN - abs(float(physics.way[0])))
    else:
        short = WAY - float(np.linalg.norm(physics.way))
    touched = {f"{a} / {b}": round(1e3 * depth, 2) for (a, b), depth in physics.touched.items()}
    return {"short": float(1e3 * short), "touched": touched, "status": status}
