# /// script
# requires-python = ">=3.11"
# dependencies = ["manip-learn"]
# ///
"""Show a learnt task in your own meshcat viewer: the arm, the line of the drawer, and the recorded grasps.

Your own objects stay in the viewer: `show` draws below the path `manip_learn` only.
"""

import argparse
import time

import meshcat

import manip_learn as ml


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--headless", action="store_true", help="move without waiting, and do not open the browser")
    arguments = parser.parse_args()

    robot = ml.load_robot("sawyer")  # or your URDF
    demos = ml.load_demonstrations("sawyer_drawer", robot)
    learner = ml.ConstraintLearner(ml.FrameJacobian(robot, frame="right_gripper_tip")).fit(demos)
    repetition = ml.repeat(learner.skill_, [1.2, -1.57, 0, 0, 0, 0, 0])

    viewer = meshcat.Visualizer()  # or Pinocchio's MeshcatVisualizer of robot.pinocchio_model
    print(f"look at {viewer.url()}")
    if not arguments.headless:
        viewer.open()
    show = ml.show(robot, viewer, learner.constraint_, repetition.rollout.q[0])
    for q, step in zip(repetition.rollout.q, repetition.rollout.time[1:] - repetition.rollout.time[:-1], strict=False):
        show(q)
        if not arguments.headless:
            time.sleep(step)
    if not arguments.headless:
        input("Enter closes the viewer. ")


if __name__ == "__main__":
    main()
