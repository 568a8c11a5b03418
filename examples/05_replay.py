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

    climb = ml.ManipulabilityAscent(constraint)
    controller = ml.ResolvedRateController(constraint, task=ml.PointAttractor([0.6, 0.27, 0.35]), null_policy=climb)
    rollout = ml.simulate(robot, controller, [1.2, -1.57, 0, 0, 0, 0, 0], duration=5.0, dt=0.01)
    plain = ml.ResolvedRateController(constraint, task=ml.PointAttractor([0.6, 0.27, 0.35]))
    without = ml.simulate(robot, plain, [1.2, -1.57, 0, 0, 0, 0, 0], duration=5.0, dt=0.01)

    page = ml.replay(
        robot, {"climbing": rollout, "plain": without}, html="replay.html", open_browser=not arguments.headless
    )
    print(f"{page.html}: {page.bytes / 1e6:.1f} MB")


if __name__ == "__main__":
    main()
