# /// script
# requires-python = ">=3.11"
# dependencies = ["manip-learn"]
# ///
"""Learn during the demonstration: samples come from a driver, and `fit` learns from all motions so far.

The driver calls `Recorder.sample` for every message; a button on the wrist marks the beginning and end of a motion.
Recording stops as soon as the uncertainty is small enough.
"""

import argparse
from collections.abc import Iterator
from pathlib import Path

import numpy as np

import manip_learn as ml
from manip_learn.errors import NotIdentifiableError

RECORDINGS = Path(__file__).parent / "data" / "sawyer_drawer"
ENOUGH = 0.002  # [deg] noise of the row space: more motions reduce it, unlike calibration errors of the arm


class Recorder:
    """Samples of the current motion, until the button is released."""

    def __init__(self, robot: ml.Robot) -> None:
        self._robot, self._number = robot, 0
        self._rows: list[tuple[float, np.ndarray]] = []

    def sample(self, stamp: float, positions: dict[str, float], pressed: bool) -> ml.Trajectory | None:
        """One message of the driver: joint name -> position [rad]. The whole motion when the button is released."""
        if pressed:  # by name: drivers and URDFs often differ in joint order
            self._rows.append((stamp, np.array([positions[name] for name in self._robot.joint_names])))
            return None
        if len(self._rows) < 2:
            return None
        time, q = zip(*self._rows, strict=True)
        self._rows, self._number = [], self._number + 1
        return ml.Trajectory(np.array(time), np.array(q), name=f"motion {self._number}")


def driver(robot: ml.Robot) -> Iterator[tuple[float, dict[str, float], bool]]:
    """Stands for your driver: stamp, joint positions in any order, and whether the button is pressed."""
    clock = 0.0
    for demo in ml.load_demonstrations(RECORDINGS, robot):
        for t, q in zip(demo.time, demo.q, strict=True):
            yield clock + t, dict(zip(reversed(robot.joint_names), reversed(q.tolist()), strict=True)), True
        clock += demo.duration + 1.0
        yield clock, {}, False


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--headless", action="store_true", help="accepted for all examples; nothing is opened here")
    parser.parse_args()

    robot = ml.load_robot("sawyer")
    features = ml.FrameJacobian(robot, frame="right_gripper_tip", axes="xyz", reference="world")
    learner, recorder, shown = ml.ConstraintLearner(features), Recorder(robot), list[ml.Trajectory]()
    for stamp, positions, pressed in driver(robot):
        motion = recorder.sample(stamp, positions, pressed)
        if motion is None:
            continue
        shown.append(motion)
        try:
            report = learner.fit(shown).report_
        except NotIdentifiableError as refusal:  # the motion helps with the next one
            print(f"{motion.name}: not enough yet ({refusal.args[0].partition(':')[0]})")
            continue
        spread = report.uncertainty["noise"]
        known = "uncertainty not known yet" if spread is None else f"+- {spread:.2g} degrees"
        held = f"{report.n_constraints} of {len(report.row_names)} rows held"
        print(f"{motion.name}: {held}, {known}, gap {report.gap:.3g} (10 is clear)")
        if spread is not None and spread < ENOUGH and report.gap > 10:
            print(f"enough: {report.sentence}")
            learner.constraint_.save("drawer.json")
            break


if __name__ == "__main__":
    main()
