# /// script
# requires-python = ">=3.11"
# dependencies = ["manip-learn"]
# ///
"""Open the drawer while keeping the arm away from the singularities of this task.

The arm starts upright, where the tip can move neither up nor down. It grasps the handle and pulls, with each of three
null-space policies: none, an attractor to a rest posture, and the ascent of the task's manipulability.
"""

import argparse
from pathlib import Path

import numpy as np

import manip_learn as ml

RECORDINGS = Path(__file__).parent / "data" / "sawyer_drawer"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--headless", action="store_true", help="no window is opened in any case")
    parser.parse_args()

    robot = ml.load_robot("sawyer")
    demos = ml.load_demonstrations(RECORDINGS, robot)
    features = ml.FrameJacobian(robot, frame="right_gripper_tip", axes="xyz", reference="world")
    constraint = ml.ConstraintLearner(features).fit(demos).constraint_

    start = np.array([1.2, -1.57, 0, 0, 0, 0, 0])
    task = ml.motion(constraint, distance=0.3, direction=[-1, -0.5, 0], pause=0.5)  # towards the robot
    policies = {
        "zero": ml.ZeroPolicy(robot.nv),
        "attractor": ml.JointAttractor(robot.neutral()),
        "manipulability": ml.ManipulabilityAscent(task.constraint),
    }
    for name, policy in policies.items():
        controller = ml.ResolvedRateController(constraint, task=task, null_policy=policy)
        rollout = ml.simulate(robot, controller, start, duration=task.duration_from(start) + 0.5, dt=0.01)
        way = rollout.manipulability[rollout.time >= task.way_begins]
        print(
            f"{name:15} at the handle after {task.way_begins:.1f} s, opened {task.progress(rollout.q[-1]):.3f} m, "
            f"least mu on the way {way.min():.3f}, {rollout.status_counts}"
        )


if __name__ == "__main__":
    main()
