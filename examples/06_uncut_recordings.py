# /// script
# requires-python = ">=3.11"
# dependencies = ["manip-learn[robots]"]
# ///
"""Learn from uncut recordings: two tasks in one recording, loose grasps, and outliers.

Nothing is cut, sorted or labelled by hand. The learner finds when a constraint is active, which mechanism constrains
the hand, and which recordings do not agree with the others. Each replay shows the recordings with their phases.
"""

import argparse
from pathlib import Path

import manip_learn as ml

RECORDINGS = Path(__file__).parent / "data"
FINGERS = ("panda_finger_joint1", "panda_finger_joint2")
TASKS = [
    # title, folder, robot, joints without recordings, guided frame
    ("whole recordings of a drawer", "panda_drawer_whole", "panda", FINGERS, "panda_hand_tcp"),
    ("a drawer, then a table, in each recording", "xarm7_drawer_then_table", "xarm7", (), "link_eef"),
    ("a door whose handle turns in the hand", "ur5_loose_door", "ur5", (), "tool0"),
    ("a drawer, with two recordings of another one", "panda_drawer_mixed", "panda", FINGERS, "panda_hand_tcp"),
]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--headless", action="store_true", help="write the replays, but do not open them")
    arguments = parser.parse_args()

    for what, folder, robot_name, locked, frame in TASKS:
        robot = ml.load_robot(robot_name, locked=locked)
        recordings = ml.load_demonstrations(RECORDINGS / folder, robot)
        features = ml.FrameJacobian(robot, frame=frame, axes="xyz", reference="world")
        learner = ml.ConstraintLearner(features).fit(recordings)
        report = learner.report_

        print(f"\n{folder}: {what}")
        for number, constraint in enumerate(learner.constraints_, start=1):
            print(f"constraint {number}: {constraint.n_constraints} of {constraint.features.n_rows} rows held")
        print("mechanism:", "none" if report.mechanism is None else report.mechanism.sentence)
        print_phases(report.phases, recordings.trajectories[0].name)
        for trajectory, reason in report.odd_trajectories:
            print(f"odd: {trajectory}: {reason}")

        page = ml.replay(
            robot,
            {trajectory.name: trajectory for trajectory in recordings},
            html=f"{folder}.html",
            phases=report.phases,
            mechanism=report.mechanism,
            open_browser=not arguments.headless,
        )
        print(f"replay: {page.html}")


def print_phases(phases: tuple[tuple[str, float, float, int | None, str], ...], name: str) -> None:
    """Return the phases of one recording in words: times and active constraint."""
    for trajectory, start, end, constraint, reason in phases:
        if trajectory == name:
            nothing = f"not learnt ({reason})" if reason else "free motion"
            held = nothing if constraint is None else f"constraint {constraint + 1}"
            print(f"{name}: {held} from {start:.2f} s to {end:.2f} s")


if __name__ == "__main__":
    main()
