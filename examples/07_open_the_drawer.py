# /// script
# requires-python = ">=3.11"
# dependencies = ["manip-learn[robots,physics,experiments]"]
# ///
"""Open the learnt drawer with a simulated worn arm: friction, backlash, encoder steps and noise, latency.

First with the learnt axis, then with an axis that is 5 degrees off: the drawer does not move, the position error grows,
and the loop stops the arm before the lateral force is large. The physics is in drawer_physics.py (MuJoCo).
"""

import argparse
from pathlib import Path

import numpy as np
from drawer_physics import PERIOD, USED, ArmPhysics, draw, drawer, true_axis
from scipy.spatial.transform import Rotation

import manip_learn as ml

RECORDINGS = Path(__file__).parent / "data" / "panda_drawer_whole"
FRAME, FINGERS = "panda_hand_tcp", ("panda_finger_joint1", "panda_finger_joint2")
WAY, SPEED = 0.18, 0.06  # [m], [m/s]


def open_drawer(constraint: ml.Constraint, grasp: np.ndarray, stiffness: float) -> tuple[ml.RunRecord, np.ndarray]:
    """Return the run's record and, per period: opening [m], lateral force [N], following error [rad], stopped."""
    task, climb = ml.FreeDirection(constraint, WAY, SPEED), ml.ManipulabilityAscent(constraint, gain=1.0)
    controller = ml.ResolvedRateController(constraint, task=task, null_policy=climb)
    robot = constraint.robot
    assert robot is not None  # rows of a frame have one
    loop = ml.ServoLoop(controller, PERIOD, contact=ml.Contact(stiffness=stiffness))
    loop.reset(grasp)  # the commanded position, not the noisy reading
    chest = drawer(robot.position(grasp, FRAME), true_axis(RECORDINGS))
    physics = ArmPhysics("panda", grasp, chest, stiffness, np.random.default_rng(7), **USED)
    record = ml.run(loop, physics, task.duration + 0.5)
    stopped = [status is ml.Status.FOLLOWING_ERROR for status in record.rollout.status]
    signals = np.column_stack([physics.history, np.asarray(record.rollout.following_error), stopped])
    return record, signals


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--headless", action="store_true", help="write the replay, but do not open it")
    parser.add_argument("--stiffness", type=float, default=2000.0, help="of the servos [N m/rad]")
    arguments = parser.parse_args()

    robot = ml.load_robot("panda", locked=FINGERS)
    recordings = ml.load_demonstrations(RECORDINGS, robot)
    features = ml.FrameJacobian(robot, frame=FRAME, axes="xyz", reference="world")
    learner = ml.ConstraintLearner(features).fit(recordings)
    contact = next(phase for phase in learner.report_.phases if phase.constraint == 0)
    demo = next(demo for demo in recordings if demo.name == contact.trajectory)
    grasp = demo[contact.start : contact.end].q[0]  # as it was shown
    learnt = learner.constraint_
    turn = Rotation.from_rotvec(np.deg2rad(5.0) * learnt.selection[1])
    wrong = ml.Constraint(learnt.selection @ turn.as_matrix().T, features)
    opened = {}
    for name, constraint in {"learnt axis": learnt, "axis 5 degrees off": wrong}.items():
        opened[name] = record, signals = open_drawer(constraint, grasp, arguments.stiffness)
        way, force, error, stopped = signals.T
        tripped = "".join(f", {f:.1f} N where the loop stopped the arm" for f in force[stopped > 0.0][:1])
        print(f"{name}: {1e3 * way[-1]:.1f} of {1e3 * WAY:.0f} mm opened; {record.ended}")
        print(f"  following error up to {1e3 * error.max():.2f} mrad")
        print(f"  side force up to {force.max():.1f} N{tripped}, {force[-1]:.1f} N at the end")
    rollouts = {name: record.rollout for name, (record, _) in opened.items()}
    page = ml.replay(robot, rollouts, html="open_the_drawer.html", open_browser=not arguments.headless)
    print(f"replay: {page.html}, plot: {draw({name: s for name, (_, s) in opened.items()}, 'open_the_drawer.svg')}")


if __name__ == "__main__":
    main()
