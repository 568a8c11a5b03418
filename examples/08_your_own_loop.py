# /// script
# requires-python = ">=3.11"
# dependencies = ["manip-learn"]
# ///
"""Run your own arm at 500 Hz: write a driver with three members and call `ml.run`.

`Arm` stands for your arm's library: put its calls into `read` and `command` and keep the rest.
"""

import argparse
from collections import deque
from pathlib import Path

import numpy as np

import manip_learn as ml

RECORDINGS = Path(__file__).parent / "data" / "sawyer_drawer"


LATE, FRICTION, STEP, NOISE = 10, 5e-4, 1e-4, 1e-5  # [periods], [rad] by which a servo gives way to it, [rad], [rad]


class Arm:
    """Simulated position-controlled arm with latency, friction, encoder steps and noise."""

    period = 0.002  # [s]

    def __init__(self, q: dict[str, float]) -> None:
        self.joint_names = tuple(q)  # in the driver's own order: `run` maps from and to it
        self._q, self._rng = np.array(list(q.values())), np.random.default_rng(0)
        self._sent = deque([self._q], LATE)

    def read(self) -> tuple[np.ndarray, None, None]:
        """Joint positions [rad], velocities and efforts; None for what there is not."""
        return STEP * np.round((self._q + NOISE * self._rng.standard_normal(self._q.size)) / STEP), None, None

    def command(self, q: np.ndarray, u: np.ndarray) -> None:
        """Go to joint positions [rad]; a driver that takes velocities has them in u [rad/s]."""
        self._sent.append(q.copy())
        self._q = np.clip(self._q, self._sent[0] - FRICTION, self._sent[0] + FRICTION)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--headless", action="store_true", help="accepted for all examples; nothing is opened here")
    parser.add_argument("--duration", type=float, default=3.0, help="until the arm brakes [s]")
    arguments = parser.parse_args()

    robot = ml.load_robot("sawyer")
    features = ml.FrameJacobian(robot, frame="right_gripper_tip", axes="xyz", reference="world")
    constraint = ml.ConstraintLearner(features).fit(ml.load_demonstrations(RECORDINGS, robot)).constraint_
    task, climb = ml.PointAttractor([0.6, 0.27, 0.35]), ml.ManipulabilityAscent(constraint)
    controller = ml.ResolvedRateController(constraint, task=task, null_policy=climb)

    start = {f"right_j{i}": q for i, q in zip((6, 5, 4, 3, 2, 1, 0), (0.0, 0.8, 0.0, 0.4, 0.0, -1.2, 1.2), strict=True)}
    arm = Arm(start)
    record = ml.run(ml.ServoLoop(controller, arm.period), arm, arguments.duration)  # or until Ctrl-C
    mu = record.rollout.manipulability
    print(f"{record.cycles} cycles of {1e3 * arm.period:g} ms, {record.overruns} of them late; {record.ended}")
    print(f"manipulability from {mu[0]:.3g} to {mu[-1]:.3g}")
    print("statuses:", ", ".join(f"{word} {count}" for word, count in record.rollout.status_counts.items()))


if __name__ == "__main__":
    main()
