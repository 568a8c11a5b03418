"""A learnt task in other people's controllers and solvers: they are given what Lambda holds, and nothing else."""

from __future__ import annotations

import json

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import manip_learn as ml
from manip_learn.cli import main
from manip_learn.control.interop.force_control import TOLERANCE, force_mode, impedance, moveit_constraints, urscript
from manip_learn.errors import ConfigurationError, ConstraintError, UnknownNameError

# ---- controllers of force and stiffness ----

AXIS, POINT = (0.0, 0.0, 1.0), (0.5, 0.2, 0.1)
FIRM = "turn-1 turn-2 slide-1 slide-2 slide"


@pytest.fixture(scope="module")
def ur5():
    return ml.load_robot("ur5")


def posture(robot) -> np.ndarray:
    return robot.random_configuration(np.random.default_rng(3))


def hinge(robot, rows: str) -> ml.Constraint:
    features = ml.MechanismRows(robot, "tool0", rows, axis=AXIS, point=POINT)
    return ml.Constraint(np.eye(features.n_rows), features)


@pytest.mark.parametrize("rows", ["radial axial", FIRM])
def test_stiffness_is_compliant_where_the_environment_holds(ur5, rows):
    """A displacement along a free row meets the stiff value, one along a held row the compliant one, and both matrices
    are symmetric and positive; of a firm hinge the displacement of the hand that turns with it is free.
    """
    q = posture(ur5)
    made, M = impedance(hinge(ur5, rows), q), ur5.hand_inertia(q, "tool0")
    K, D = np.array(made["stiffness"]), np.array(made["damping"])
    for matrix in (K, D):
        assert np.allclose(matrix, matrix.T) and np.all(np.linalg.eigvalsh(matrix) > 0.0)
    around = np.cross(AXIS, ur5.position(q, "tool0") - POINT)
    if rows == FIRM:
        twist = np.concatenate([around, AXIS])
        assert twist @ K @ twist == pytest.approx(50.0)
    else:
        along = around / np.linalg.norm(around)
        assert along @ K[:3, :3] @ along == pytest.approx(1000.0) and K[2, 2] == pytest.approx(100.0)
    # D damps every mode of M x'' + D x' + K x critically: (M^-1/2 D M^-1/2 / 2)^2 = M^-1/2 K M^-1/2
    values, V = np.linalg.eigh(M)
    back = V / np.sqrt(values) @ V.T
    assert np.allclose((0.5 * back @ D @ back) @ (0.5 * back @ D @ back), back @ K @ back, rtol=1e-6)


def test_hand_inertia_is_that_of_the_dynamics(ur5):
    """A force on the hand of an arm at rest accelerates the hand by its inverse inertia."""
    q = posture(ur5)
    J = ur5.jacobian(q, "tool0")
    M = np.column_stack([ur5.inertial_effort(q, e) for e in np.eye(6)])
    wrench = np.array([3.0, -2.0, 1.0, 0.2, 0.1, -0.3])
    acceleration = J @ np.linalg.solve(M, J.T @ wrench)
    inertia = ur5.hand_inertia(q, "tool0")
    assert inertia is not None  # its least share, 1e-3 1/kg for each of 4 N, is added to the acceleration
    assert np.allclose(np.linalg.solve(inertia, wrench), acceleration, atol=4e-3)


def test_moveit_keeps_the_point_of_a_firm_hinge(ur5):
    """The point on the axis is kept, and the link turns freely about the axis only."""
    q, c = posture(ur5), np.array(POINT)
    firm = moveit_constraints(hinge(ur5, FIRM), q)
    made = json.loads("\n".join(line for line in firm.splitlines() if not line.startswith("#")))
    offset = made["position_constraints"][0]["target_point_offset"]
    point = ur5.pose(q, "tool0") @ [*(offset[k] for k in "xyz"), 1.0]
    assert np.allclose(point[:2], c[:2], atol=1e-9)
    axis = ur5.pose(q, "tool0")[:3, :3].T @ AXIS
    kept = made["orientation_constraints"][0]
    wide = np.array([kept[f"absolute_{name}_axis_tolerance"] for name in "xyz"])
    assert np.allclose(wide, np.minimum(np.pi, TOLERANCE[1] + np.pi * np.abs(axis)))


def is_in_region(text, point):
    """True if a point of the base frame lies in one of the boxes of a `moveit_msgs/Constraints` [m]."""
    made = json.loads("\n".join(line for line in text.splitlines() if not line.startswith("#")))
    region = made["position_constraints"][0]["constraint_region"]
    for shape, pose in zip(region["primitives"], region["primitive_poses"], strict=True):
        turn = Rotation.from_quat([pose["orientation"][k] for k in "xyzw"])
        local = turn.inv().apply(point - np.array([pose["position"][k] for k in "xyz"]))
        if np.all(np.abs(local) <= 0.5 * np.array(shape["dimensions"]) + 1e-9):
            return True
    return False


def test_moveit_regions_are_the_mechanism(ur5):
    """The boxes of a loose hinge contain its whole circle and no point 3 cm off it; those of a level, its plane."""
    q = posture(ur5)
    hand, about = ur5.position(q, "tool0"), Rotation.from_rotvec
    text = moveit_constraints(hinge(ur5, "radial axial"), q)
    for angle in np.linspace(-np.pi, np.pi, 60):
        on_circle = POINT + about(angle * np.array(AXIS)).apply(hand - POINT)
        assert is_in_region(text, on_circle) and not is_in_region(text, on_circle + [0.0, 0.0, 0.03])
        assert not is_in_region(text, POINT + 0.9 * (on_circle - POINT))
    level = moveit_constraints(ml.Constraint([[0, 0, 1]], ml.FrameJacobian(ur5, "tool0", "xyz")), q)
    assert is_in_region(level, hand + [0.5, -0.5, 0.0]) and not is_in_region(level, hand + [0.0, 0.0, 0.03])


def test_command_writes_each_of_them(tmp_path, capsys):
    """`export --to` writes each format of a constraint file and says what the frame holds; what cannot be is one
    sentence and exit code 2, and the constraint file is never overwritten.
    """
    robot, file = ml.load_robot("sawyer"), tmp_path / "task.json"
    ml.Constraint([[0, 0, 1]], ml.FrameJacobian(robot, "right_gripper_tip", "xyz")).save(file)

    def export(to, out, *more):
        code = main(["export", "sawyer", str(file), "--to", to, "--out", str(out), *more])
        return code, capsys.readouterr()

    for to in ("urscript", "stiffness", "moveit", "json"):
        out = tmp_path / f"out.{to}"
        code, said = export(to, out, "--json")
        answer = json.loads(said.out)
        assert (code, answer["format"], answer["files"]) == (0, to, [str(out)])
        assert "held z; free x y; unknown rx ry rz" in answer["notes"][0]
        assert out.read_text(encoding="utf-8").strip()
    frame = json.loads((tmp_path / "out.json").read_text(encoding="utf-8"))
    assert frame["axes"]["z"] == "held" and np.abs(frame["rows"]).tolist() == [[0.0, 0.0, 1.0, 0.0, 0.0, 0.0]]
    x = tmp_path / "x"
    for refused in (("stiffness", file), ("urscript", file), ("json", x, "--at", "0,1"), ("krl", x)):
        code, said = export(*refused)
        assert code == 2 and said.err.count("\n") <= 3
    assert export("json", file)[0] == 0  # which adds to it
    for written in (file, tmp_path / "out.json"):
        assert ml.Constraint.load(written, robot).n_constraints == 1


def test_rows_of_two_moving_frames_are_refused():
    """A frame that itself moves is no frame of a force controller or a planner: a sentence says so."""
    robot = ml.load_robot("panda", locked=("panda_finger_joint1", "panda_finger_joint2"))
    constraint = ml.Constraint([[0, 0, 1]], ml.RelativeFrameJacobian(robot, "panda_hand_tcp", "panda_link3", "xyz"))
    for write in (force_mode, urscript, moveit_constraints):
        with pytest.raises(ConstraintError, match="another moving frame"):
            write(constraint, robot.neutral())


# ---- Pink ----

DT = 0.01


def oblique(robot, rng, tip="right_hand"):
    """Two oblique rows, a target nearby, a policy, and a posture."""
    constraint = ml.Constraint(np.linalg.qr(rng.normal(size=(3, 2)))[0].T, ml.FrameJacobian(robot, tip))
    q = 0.8 * robot.positions(robot.random_configuration(rng))
    task = ml.PointAttractor(robot.position(q, tip) + 0.1 * rng.normal(size=3))
    return constraint, task, ml.ManipulabilityAscent(constraint, 0.5), q


@pytest.fixture
def pink():
    """Pink itself, in our environment, and our tasks for it."""
    pink = pytest.importorskip("pink", reason="Pink tasks need the extra 'pink'")
    from manip_learn.control.interop import pink_tasks

    pink.ours = pink_tasks
    return pink


def placed(pink, model, q):
    return pink.Configuration(model, model.createData(), q)


def velocity(pink, model, q, tasks, constraints=None):
    options = {"solver": "daqp", "damping": 0.0, "limits": [], "constraints": constraints}
    return pink.solve_ik(placed(pink, model, q), tasks, DT, **options)


def test_same_velocity_as_ours(pink, robot_of):
    """A hard constraint and a policy give u = A^+ b + N pi to 1e-9."""
    robot, rng = robot_of("sawyer"), np.random.default_rng(0)
    for _ in range(20):
        constraint, task, policy, q = oblique(robot, rng)
        rows = pink.ours.PinkConstraintTask(constraint, task, DT)
        climb = pink.ours.PinkPolicyTask(policy, robot, DT)
        theirs = velocity(pink, robot.pinocchio_model, q, [climb], [rows])
        law = ml.ResolvedRateController(constraint, task, policy, "exact", limits=False)
        assert np.allclose(theirs, law(q).velocity, rtol=0.0, atol=1e-9)


def test_joints_are_found_by_name(pink, robot_of):
    """Pink's model may have more joints than ours, which has some locked: the others get nothing from the task."""
    locked = ml.load_robot("sawyer", locked={"right_j2": 0.3})
    constraint, task, policy, q = oblique(locked, np.random.default_rng(2))
    rows = pink.ours.PinkConstraintTask(constraint, task, DT)
    configuration = placed(pink, robot_of("sawyer").pinocchio_model, np.insert(q, 2, 0.3))
    J = rows.compute_jacobian(configuration)
    assert np.allclose(np.delete(J, 2, axis=1), constraint(q)) and not np.any(J[:, 2])
    assert np.allclose(rows.compute_error(configuration), -DT * task.velocity(constraint, q, 0.0))
    assert pink.ours.PinkPolicyTask(policy, locked, DT).compute_jacobian(configuration).shape == (6, 7)


def test_what_pink_cannot_have_is_refused(pink, robot_of):
    """Mimic joints, unknown joints, and steps that are not positive."""
    constraint, task, _, _ = oblique(robot_of("sawyer"), np.random.default_rng(4))
    with pytest.raises(ConstraintError, match="mimic joints"):
        pink.ours.PinkPolicyTask(ml.ZeroPolicy(robot_of("mimic").nv), robot_of("mimic"), DT)
    with pytest.raises(ConfigurationError, match="dt must be a positive"):
        pink.ours.PinkConstraintTask(constraint, task, 0.0)
    with pytest.raises(UnknownNameError, match="Pink's model"):
        rows = pink.ours.PinkConstraintTask(constraint, task, DT)
        velocity(pink, robot_of("planar3").pinocchio_model, np.zeros(3), [rows])
