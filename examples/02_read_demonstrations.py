# /// script
# requires-python = ">=3.11"
# dependencies = ["manip-learn"]
# ///
"""Read recordings, derive velocities, and list what was changed.

A recording is a CSV file with a column `time` [s] and one column per joint [rad], a ROS bag, or a file in one of the
other formats described in the documentation.
"""

import argparse
from pathlib import Path

import numpy as np

import manip_learn as ml

RECORDINGS = Path(__file__).parent / "data" / "sawyer_drawer"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("recordings", nargs="*", default=[RECORDINGS], help="files, or a folder of them")
    parser.add_argument("--robot", default="sawyer")
    parser.add_argument("--headless", action="store_true", help="no window is opened in any case")
    arguments = parser.parse_args()

    robot = ml.load_robot(arguments.robot)
    demos = ml.load_demonstrations(arguments.recordings, robot)
    print(f"{len(demos)} demonstrations, {demos.n_samples} samples, velocities recorded: {demos.has_velocities}")
    for note in demos.notes:
        print("note:", note)

    # positions alone: velocities come from a local fit on the true time stamps
    smooth = ml.derive_velocities(demos[0], robot)
    print(f"{demos[0].name}: {len(demos[0])} samples -> {len(smooth)} with velocities")
    print("fastest joints [rad/s]:", np.round(np.abs(np.asarray(smooth.u)).max(axis=0), 2))


if __name__ == "__main__":
    main()
