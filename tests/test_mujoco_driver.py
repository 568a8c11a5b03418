"""An arm in MuJoCo behind the driver's protocol: guided, recorded, learnt from, and doing what it was shown."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

import manip_learn as ml
from manip_learn.drivers.record import record
from manip_learn.errors import ConfigurationError

mujoco = pytest.importorskip("mujoco")
from manip_learn.drivers.mujoco import MuJoCoDriver  # noqa: E402

EXAMPLES = Path(__file__).resolve().parents[1] / "examples"
FRAME, FINGERS = "panda_hand_tcp", ("panda_finger_joint1", "panda_finger_joint2")
GRASP = np.array([0.56, -0.27, 0.40, -2.14, 0.14, 1.68, 0.62])
AXIS = np.array([-0.8, 0.6, 0.0])
PENDULUM = """
<mujoco><option timestep="0.002" integrator="implicitfast"/><worldbody>
<body><joint name="a" axis="0 1 0"/><geom type="capsule" fromto="0 0 0 0.4 0 0" size="0.02" mass="2"/>
<body pos="0.4 0 0"><joint name="b" axis="0 1 0"/><geom type="capsule" fromto="0 0 0 0.3 0 0" size="0.02" mass="1"/>
</body></body></worldbody>
<actuator><position joint="a" kp="10"/></actuator></mujoco>
"""


@pytest.fixture
def scene(monkeypatch):
    """A Panda in hand-guiding mode with its hand on a drawer that slides along `AXIS`."""
    monkeypatch.syspath_prepend(str(EXAMPLES))
    from make_recordings.arms import load_arm
    from make_recordings.guided_model import guided_model
    from make_recordings.mechanisms import Slide

    arm = load_arm("panda")
    handle = arm.pose(GRASP)[:3, 3]
    drawer = Slide(handle, np.empty((0, 3)), np.array([0.3]), AXIS)
    yield guided_model(arm, [drawer], [handle], friction=1.0)
    for name in [name for name in sys.modules if name.startswith("make_recordings")]:
        del sys.modules[name]


class Person:
    """A hand that pulls the tip along the drawer's axis and back, again and again, and lets the elbow sway."""

    def __init__(self, model, seed: int):
        self.tip, self.rng = model.site("tip").id, np.random.default_rng(seed)
        self.start: np.ndarray | None = None
        self.jacobian = np.zeros((3, model.nv))
        self.sway, self.pulls = self.rng.uniform(0.0, 6.0, 7), True

    def __call__(self, model, data) -> None:
        if self.start is None:
            self.start, self.rest = data.site_xpos[self.tip].copy(), data.qpos[:7].copy()
        if not self.pulls:
            return
        once = data.time % 6.0  # [s]: 3 s of motion, 3 s of rest
        share = 0.5 * (1.0 - np.cos(2.0 * np.pi * min(once, 3.0) / 3.0))
        goal = self.start + 0.2 * share * AXIS
        mujoco.mj_jacSite(model, data, self.jacobian, None, self.tip)
        force = 900.0 * (goal - data.site_xpos[self.tip]) - 30.0 * (self.jacobian @ data.qvel)
        sway = 4.0 * share * np.sin(2.0 * once + self.sway + int(data.time // 6.0))
        data.qfrc_applied[:7] += (self.jacobian.T @ force)[:7] + sway + 2.0 * (self.rest - data.qpos[:7])


def test_shown_by_hand_recorded_learnt_and_done(scene, tmp_path):
    """A person opens the drawer five times by hand; the recordings, read again, give the drawer's axis to 0.5 degrees,
    and the arm then opens it by 15 cm by itself, without a following error, with friction, play, encoder steps and a
    delay in its joints.
    """
    names = [scene.joint(i).name for i in range(7)]
    person, rng = Person(scene, 3), np.random.default_rng(4)
    driver = MuJoCoDriver(
        scene, names, GRASP, period=0.01, hand=person, noise=1e-4, rng=rng, friction=0.5, backlash=1e-3, latency=0.02,
        encoder_resolution=1e-4, feedforward=False,
    )  # fmt: skip
    driver.data.eq_active[0] = 1
    robot = ml.load_robot("panda", locked=FINGERS)
    driver.joint_names = robot.joint_names  # the scene numbers its joints
    done = record(driver, tmp_path / "demos", "drawer", motions=5, duration=60.0)
    assert len(done.files) == 5 and done.lost == 0 and done.ended == "5 motions recorded"

    demos = ml.load_demonstrations([str(file) for file in done.files], robot)
    assert all(demo.effort is not None for demo in demos)
    learner = ml.ConstraintLearner(ml.FrameJacobian(robot, FRAME, "xyz")).fit(demos)
    constraint = learner.constraint_
    assert constraint.mechanism is not None and constraint.mechanism.type == "line"
    assert abs(constraint.task_frame(GRASP).pose[:3, 2] @ AXIS) > np.cos(np.radians(0.5))

    person.pulls = False
    task = ml.motion(constraint, along=0.15 * float(np.sign(constraint.mechanism.axis @ AXIS)), speed=0.08)
    controller = ml.ResolvedRateController(constraint, task=task, null_policy=task.ascent(1.0))
    loop = ml.ServoLoop(controller, dt=driver.period, acceleration_limit=3.0)
    start = driver.data.qpos[7]
    record_of_run = ml.run(loop, driver, duration=4.0)
    assert record_of_run.ended == "the 4 s were over" and "following-error" not in record_of_run.rollout.status
    assert abs(driver.data.qpos[7] - start) > 0.145


def test_servos_follow_and_carry_the_weight():
    """Of an arm under gravity with an actuator of its own, the servos follow a slow motion to a milliradian, rest where
    they were sent, and what they exert is the weight; a joint that is not there or a wrong period is refused.
    """
    model = mujoco.MjModel.from_xml_string(PENDULUM)
    driver = MuJoCoDriver(model, ("b", "a"), [0.3, -0.5], period=0.01)
    for k in range(200):
        t = 0.01 * (k + 1)
        goal = np.array([0.3 + 0.2 * np.sin(t), -0.5 + 0.2 * np.cos(t) - 0.2])
        driver.command(goal, np.zeros(2))
        if k > 20:
            q, _, _ = driver.read()
            assert np.max(np.abs(q - goal)) < 2e-3
    for _ in range(100):
        driver.command(goal, np.zeros(2))
    q, u, effort = driver.read()
    assert np.allclose(q, goal, atol=1e-4) and np.allclose(u, 0.0, atol=1e-6)
    lever = [0.4 * np.cos(q[1]), 0.15 * np.cos(q[0] + q[1])]
    assert effort[0] == pytest.approx(-9.81 * lever[1], abs=0.05)
    assert effort[1] == pytest.approx(-9.81 * (lever[0] + lever[0] + lever[1]), abs=0.1)
    with pytest.raises(ConfigurationError, match="no joint elbow; it has a, b"):
        MuJoCoDriver(model, ("a", "elbow"), [0.0, 0.0])
    with pytest.raises(ConfigurationError, match="multiple of the model's time step of 2 ms, got 3 ms"):
        MuJoCoDriver(model, ("a", "b"), [0.0, 0.0], period=0.003)
    with pytest.raises(ConfigurationError, match="latency must be a multiple .* got 3 ms"):
        MuJoCoDriver(model, ("a", "b"), [0.0, 0.0], delay=0.003)  # a former name, until 0.4


def test_released_joints_yield_and_held_ones_stay():
    """After release a small push moves the arm, which floats otherwise; after hold the push moves it hardly at all."""
    pushing = [False]

    def hand(model, data) -> None:
        data.qfrc_applied[1] += 1.0 * pushing[0]

    model = mujoco.MjModel.from_xml_string(PENDULUM)
    driver = MuJoCoDriver(model, ("a", "b"), [0.2, 0.4], hand=hand)
    moved = []
    for act in (driver.release, driver.hold):
        act()
        before = driver.read()[0]
        for push in (False, True):
            pushing[0] = push
            for _ in range(100):
                driver.wait()
            moved.append(float(np.max(np.abs(driver.read()[0] - before))))
    floating, pushed, _, held = moved
    assert floating < 1e-3 and pushed > 0.1 and held < 5e-2
