# /// script
# requires-python = ">=3.11"
# dependencies = ["manip-learn"]
# ///
"""Load a robot, list its joints, and compute how close a posture is to a singularity of a task.

Any URDF works: pass a path instead of a name.
"""

import argparse

import numpy as np

import manip_learn as ml


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("robot", nargs="?", default="sawyer", help="a name, or a URDF file")
    parser.add_argument("--frame", default="right_gripper_tip", help="the tool's frame")
    parser.add_argument("--headless", action="store_true", help="no window is opened in any case")
    arguments = parser.parse_args()

    robot = ml.load_robot(arguments.robot)
    print(robot)
    for name, low, high in zip(robot.joint_names, robot.position_lower, robot.position_upper, strict=True):
        print(f"  {name:12} {low:7.3f} .. {high:7.3f}")

    # the tip's velocity along x, y, z of the base; the task holds y and z, so that x is free
    features = ml.FrameJacobian(robot, frame=arguments.frame, axes="xyz", reference="world")
    constraint = ml.Constraint([[0, 1, 0], [0, 0, 1]], features)

    upright = np.zeros(robot.nv)
    upright[1] = -np.pi / 2
    for posture, q in {"bent": robot.neutral() + 0.5, "upright": upright}.items():
        mu = ml.manipulability(constraint, q)
        gradient = ml.manipulability_gradient(constraint, q)
        print(f"{posture:8} mu = {mu:.4f}, climbs fastest along {np.round(gradient, 3)}")


if __name__ == "__main__":
    main()
