# /// script
# requires-python = ">=3.11"
# dependencies = ["manip-learn"]
# ///
"""From recordings to a replay in the browser in a few lines.

The replay is one HTML file that needs no server and no network.
"""

import argparse
from pathlib import Path

import manip_learn as ml

RECORDINGS = Path(__file__).parent / "data"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--headless", action="store_true", help="write the file, but do not open it")
    arguments = parser.parse_args()

    robot = ml.load_robot("sawyer")
    demos = ml.load_demonstrations(RECORDINGS / "sawyer_drawer", robot)
    features = ml.FrameJacobian(robot, frame="right_gripper_tip", axes="xyz", reference="world")
    learner = ml.ConstraintLearner(features).fit(demos)
    print(learner.report_)
    constraint = learner.constraint_
    constraint.save("drawer.json")

    start = [1.2, -1.57, 0, 0, 0, 0, 0]
    task = ml.motion(constraint, along=0.3, direction=[-1, -0.5, 0])  # the hand goes to the drawer and opens it
    controller = ml.ResolvedRateController(constraint, task=task, null_policy=task.ascent())
    rollout = ml.simulate(robot, controller, start, duration=task.duration_from(start), dt=0.01)
    plain = ml.ResolvedRateController(constraint, task=task)
    without = ml.simulate(robot, plain, start, duration=task.duration_from(start), dt=0.01)

    climbing = rollout

    plan = ml.plan(constraint, task, start, seed=0)
    print(plan)  # what limits it; plan.others says why other postures are worse
    rollout = ml.simulate(robot, plan.controller, start, duration=plan.rollout.time[-1], dt=0.01)

    shown = {"plan": plan.rollout, "climbing": climbing, "plain": without}
    page = ml.replay(robot, shown, html="replay.html", open_browser=not arguments.headless)
    print(f"plan: {rollout.status_counts}")
    print(f"{page.html}: {page.bytes / 1e6:.1f} MB")


if __name__ == "__main__":
    main()
