# /// script
# requires-python = ">=3.11"
# dependencies = ["manip-learn"]
# ///
"""Perform the learnt task while staying away from its singularities.

Three null-space policies from the same nearly singular start: none, a rest posture, and the ascent of the
manipulability of the learnt constraint.
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

    start = np.array([1.2, -1.57, 0, 0, 0, 0, 0])  # upright: the tip cannot move up or down
    target = [0.6, 0.27, 0.35]  # a point on the drawer's rail; only the constrained directions count
    policies = {
        "zero": ml.ZeroPolicy(robot.nv),
        "attractor": ml.JointAttractor(robot.neutral()),
        "manipulability": ml.ManipulabilityAscent(constraint),
    }
    for name, policy in policies.items():
        controller = ml.ResolvedRateController(constraint, task=ml.PointAttractor(target), null_policy=policy)
        rollout = ml.simulate(robot, controller, start, duration=5.0, dt=0.01)
        print(
            f"{name:15} error left {rollout.task_error[-1]:.4f} m, mean mu {rollout.manipulability.mean():.3f}, "
            f"peak speed {np.abs(rollout.u).max():.2f} rad/s, {rollout.status_counts}"
        )


if __name__ == "__main__":
    main()
