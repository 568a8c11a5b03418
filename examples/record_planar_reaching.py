"""Write the demonstrations of examples/data/planar3_reach: a planar arm reaches for points with a known control law.

    python examples/record_planar_reaching.py examples/data/planar3_reach

These recordings are not from a physics simulation: they are generated directly by the control law u = A^+ b + N pi with
A the rows x, y of the tip's Jacobian, b = target - tip, and pi = (10, -10, 10) degrees - q, all gains 1.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from jaxtyping import Float
from make_recordings.csv_file import write_csv

from manip_learn.robot import Robot, load_robot

SEED = 20242
DEMONSTRATIONS, SAMPLES, STEP = 20, 40, 0.02  # STEP in [s]
POSTURE = np.deg2rad([10.0, -10.0, 10.0])  # where the null-space policy leads [rad]


def draw_target(rng: np.random.Generator) -> Float[np.ndarray, " 2"]:
    """A point [m] that the tip can reach with some heading drawn with it: the wrist is within 2 m."""
    while True:
        target = np.array([rng.uniform(-1.0, 1.0), rng.uniform(0.0, 2.0)])
        heading = rng.uniform(0.0, np.pi)
        if np.linalg.norm(target - [np.cos(heading), np.sin(heading)]) <= 2.0:
            return target


def reach(number: int, robot: Robot) -> tuple[Float[np.ndarray, "T 3"], Float[np.ndarray, "T 3"]]:
    """Postures [rad] and velocities [rad/s] of demonstration `number`, by explicit Euler steps."""
    rng = np.random.default_rng([SEED, number])
    tip = robot.frame("tip")
    q = np.deg2rad(rng.uniform([0.0, 90.0, 0.0], [10.0, 100.0, 10.0]))
    target = draw_target(rng)
    postures, velocities = [], []
    for _ in range(SAMPLES):
        A = robot.jacobian(q, tip)[:2]
        inverse = np.linalg.pinv(A)
        b = target - robot.pose(q, tip)[:2, 3]
        u = inverse @ b + (np.eye(3) - inverse @ A) @ (POSTURE - q)
        postures.append(q)
        velocities.append(u)
        q = q + STEP * u
    return np.array(postures), np.array(velocities)


def main(arguments: list[str] | None = None) -> None:
    """Write all demonstrations."""
    parser = argparse.ArgumentParser(description="Write the reaching demonstrations of the planar arm.")
    parser.add_argument("folder", type=Path, help="folder for demo_01.csv ...")
    options = parser.parse_args(arguments)
    robot = load_robot("planar3")
    for number in range(1, DEMONSTRATIONS + 1):
        q, u = reach(number, robot)
        columns = dict(zip(robot.joint_names, q.T, strict=True))
        columns |= {f"{name}_velocity": column for name, column in zip(robot.joint_names, u.T, strict=True)}
        write_csv(options.folder / f"demo_{number:02d}.csv", STEP * np.arange(SAMPLES), columns, decimals=7)


if __name__ == "__main__":
    main()
