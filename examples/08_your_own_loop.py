# /// script
# requires-python = ">=3.11"
# dependencies = ["manip-learn"]
# ///
"""A control loop of your own at 500 Hz: read the arm, ask the ServoLoop, send the command, keep the period.

`Driver` stands for the library of your arm: put its calls into `read`, `send` and `running`; the rest stays as it is.
"""

import argparse
import time
from pathlib import Path

import numpy as np

import manip_learn as ml

RECORDINGS = Path(__file__).parent / "data" / "sawyer_drawer"
PERIOD = 0.002  # [s]
LATE = 0.5 * PERIOD  # a cycle that begins later than this is counted [s]


class Driver:
    """An arm that goes to the positions it is sent, as position servos do, with a little noise of its encoders."""

    def __init__(self, q: np.ndarray, duration: float) -> None:
        self._q, self._rng = q.copy(), np.random.default_rng(0)
        self._until = time.perf_counter() + duration

    def read(self) -> np.ndarray:
        """Joint positions [rad], in the order of `robot.joint_names`: sort by name if your driver has another one."""
        return self._q + 1e-6 * self._rng.standard_normal(self._q.size)

    def send(self, q: np.ndarray | None) -> None:
        """Joint positions to go to [rad], None before the first measurement; or give it `command.velocity`."""
        if q is not None:
            self._q = q.copy()

    @property
    def running(self) -> bool:
        """False when the operator has released the enabling switch, or here when the time is over."""
        return time.perf_counter() < self._until


def wait_until(moment: float) -> float:
    """Sleep, then spin for the last 0.2 ms: sleeping alone may wake up late. Returns how late it is [s]."""
    while (left := moment - time.perf_counter()) > 0.0:
        if left > 2e-4:
            time.sleep(left - 2e-4)
    return -left


def control(loop: ml.ServoLoop, driver: Driver) -> tuple[list[ml.Command], list[float]]:
    """Every command, and how late each cycle began [s]. However it ends, the arm brakes to a stop."""
    commands, delays = [], []
    start = time.perf_counter()
    loop.reset(driver.read())
    try:
        for k in range(1_000_000):
            delays.append(wait_until(start + k * PERIOD))
            if not driver.running:
                loop.stop()
            command = loop.update(driver.read(), time.perf_counter() - start)
            driver.send(loop.position)
            commands.append(command)
            if not driver.running and not command.velocity.any():
                break
    except KeyboardInterrupt:  # the arm must not be left with its last command
        loop.stop()
        while loop.update(driver.read(), time.perf_counter() - start).velocity.any():
            driver.send(loop.position)
            time.sleep(PERIOD)
    return commands, delays


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--headless", action="store_true", help="accepted for all examples; nothing is opened here")
    parser.add_argument("--duration", type=float, default=3.0, help="until the switch is released [s]")
    arguments = parser.parse_args()

    robot = ml.load_robot("sawyer")
    features = ml.FrameJacobian(robot, frame="right_gripper_tip", axes="xyz", reference="world")
    constraint = ml.ConstraintLearner(features).fit(ml.load_demonstrations(RECORDINGS, robot)).constraint_
    task, climb = ml.PointAttractor([0.6, 0.27, 0.35]), ml.ManipulabilityAscent(constraint)
    loop = ml.ServoLoop(ml.ResolvedRateController(constraint, task=task, null_policy=climb), PERIOD)

    driver = Driver(np.array([1.2, -1.2, 0.0, 0.4, 0.0, 0.8, 0.0]), arguments.duration)
    commands, delays = control(loop, driver)
    statuses = [str(command.status) for command in commands]
    late = sum(delay > LATE for delay in delays)
    print(f"{len(commands)} cycles of {1e3 * PERIOD:g} ms, {late} of them late by more than {1e3 * LATE:g} ms")
    print(f"manipulability from {commands[0].manipulability:.3g} to {commands[-1].manipulability:.3g}")
    print("statuses:", ", ".join(f"{word} {statuses.count(word)}" for word in dict.fromkeys(statuses)))


if __name__ == "__main__":
    main()
