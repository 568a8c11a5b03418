# /// script
# requires-python = ">=3.11"
# dependencies = ["manip-learn"]
# ///
"""Learn a task from recordings, reproduce it, and write a replay for the browser.

The replay is one HTML file that needs no server and no network.
"""

import argparse

import manip_learn as ml


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--headless", action="store_true", help="write the file, but do not open it")
    arguments = parser.parse_args()

    robot = ml.load_robot("sawyer")  # or your URDF
    demos = ml.load_demonstrations("sawyer_drawer", robot)  # or CSV files, ROS bags, LeRobot data
    features = ml.FrameJacobian(robot, frame="right_gripper_tip")
    learner = ml.ConstraintLearner(features).fit(demos)
    print(learner.report_)

    start = [1.2, -1.57, 0, 0, 0, 0, 0]
    repetition = ml.repeat(learner.skill_, start)  # plans and simulates
    print(repetition)

    # the same motion without a plan: the hand moves straight to the handle, in any configuration
    task = ml.motion(learner.constraint_)
    controller = ml.ResolvedRateController(learner.constraint_, task, task.ascent())
    climbing = ml.simulate(robot, controller, start, duration=task.duration_from(start), dt=0.01)

    shown = {"repeat": repetition.rollout, "climbing": climbing}
    page = ml.replay(robot, shown, html="replay.html", open_browser=not arguments.headless)
    print(f"{page.html}: {page.bytes / 1e6:.1f} MB")


if __name__ == "__main__":
    main()
