# /// script
# requires-python = ">=3.11"
# dependencies = ["manip-learn"]
# ///
"""Learn which directions a task constrains, from demonstrations, and inspect the evidence.

The shipped recordings show a person guiding the hand of the arm on a drawer. The learner is not told how many
directions the drawer constrains, or which.
"""

import argparse
from pathlib import Path

import manip_learn as ml

RECORDINGS = Path(__file__).parent / "data"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--headless", action="store_true", help="no window is opened in any case")
    parser.parse_args()

    robot = ml.load_robot("sawyer")
    demos = ml.load_demonstrations(RECORDINGS / "sawyer_drawer", robot)
    features = ml.FrameJacobian(robot, frame="right_gripper_tip", axes="xyz", reference="world")
    learner = ml.ConstraintLearner(features).fit(demos)
    print(learner.report_)
    print("rows of Lambda:")
    print(learner.constraint_.selection.round(4))
    print("gap for each number of rows:", {s: round(g, 2) for s, g in learner.report_.gap_table.items()})

    # a door constrains the hand in the frame of the hand: of two references, the one with clearer evidence is selected
    demos = ml.load_demonstrations(RECORDINGS / "sawyer_door", robot)
    candidates = [ml.FrameJacobian(robot, "right_gripper_tip", "xyz", reference=r) for r in ("world", "local")]
    learner = ml.ConstraintLearner(candidates).fit(demos)
    print("door:", learner.report_)

    # reaching: the demonstrator moves along the constrained directions on purpose, which the learner detects
    robot = ml.load_robot("planar3")
    demos = ml.load_demonstrations(RECORDINGS / "planar3_reach", robot, velocities="recorded")  # Euler steps
    learner = ml.ConstraintLearner(ml.FrameJacobian(robot, "tip", "planar")).fit(demos)
    print("reaching:", learner.report_, f"({learner.report_.estimator} estimator)")


if __name__ == "__main__":
    main()
