"""How well the axis of a softly held orientation can be known at all: Cramer-Rao bounds beside the learner's error.

    python benchmarks/sway_bound.py --sets 24 --first-seed 3000

A glass that is carried upright sways. With the true axis a = up + (eps, 0), the grip's error d in the hand, and the
hand turned by psi(t) about up, the axis that seems to be held leans by

    y(t) = eps - R(psi(t)) d + n(t),    n: the sway, Gaussian, covariance sway^2 k(s, t)

which is linear in eps and d, so that the bound of eps is a Schur complement of X^T K^-1 X, summed over the recordings.
The sway's law k decides: smooth, below 0.8 Hz and with an offset, is all that a learner may assume of a person; the
generator's own law (no power below 0.2 Hz, exactly upright at the first sample) is what no recording tells.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np
from jaxtyping import Float

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "examples"))

from make_recordings.arms import ROBOTS
from make_recordings.hand_motion import RAMP, RATE, minimum_jerk
from recording_cases import Case

import manip_learn as ml
from manip_learn.robot.batch.batch_kinematics import batch_kinematics

BAND = np.linspace(0.2, 0.8, 200)  # of the generator's sway [Hz]
SMOOTH = 0.32  # correlation time of a smooth sway up to about 0.8 Hz [s]
ENCODERS = 3e-4  # noise of an orientation [rad]
SAMPLES = 80  # of each recording
MEDIAN = np.sqrt(2.0 * np.log(2.0))  # median length of a vector with two unit normal components
LAWS = ("smooth, any offset", "the generator's own")


def covariance(law: str, n: int, chosen: np.ndarray) -> Float[np.ndarray, "k k"]:
    """k(s, t) of the sway at the chosen of n samples, for unit sway."""
    if law == LAWS[0]:
        t = chosen / RATE
        return np.exp(-0.5 * ((t[:, None] - t) / SMOOTH) ** 2) + 1.0
    t = np.arange(n) / RATE
    ramp = min(RAMP, 0.4 * t[-1])
    speed = minimum_jerk(t / ramp) * minimum_jerk((t[-1] - t) / ramp)
    clock = np.concatenate([[0.0], np.cumsum(0.5 * (speed[1:] + speed[:-1]))])[chosen] / RATE
    k = np.cos(2.0 * np.pi * (clock[:, None] - clock)[:, :, None] * BAND).mean(axis=2)
    start = np.cos(2.0 * np.pi * clock[:, None] * BAND).mean(axis=1)
    return k + 1.0 - start[:, None] - start


def information(R: Float[np.ndarray, "n 3 3"], sway: float, law: str) -> Float[np.ndarray, "2 2"]:
    """Of eps, from one recording of the hand's orientation; the grip is unknown."""
    turned = R @ R[0].T
    psi = np.unwrap(np.arctan2(turned[:, 1, 0] - turned[:, 0, 1], turned[:, 0, 0] + turned[:, 1, 1]))
    chosen = np.linspace(0, len(R) - 1, SAMPLES).round().astype(int)
    c, s = np.cos(psi[chosen]), np.sin(psi[chosen])
    X = np.zeros((SAMPLES, 2, 4))
    X[:, :, :2], X[:, :, 2:] = np.eye(2), -np.stack([np.stack([c, -s], 1), np.stack([s, c], 1)], 1)
    K = sway**2 * covariance(law, len(R), chosen) + ENCODERS**2 * np.eye(SAMPLES)
    F = np.einsum("aci,ab,bcj->ij", X, np.linalg.inv(K), X)
    return F[:2, :2] - F[:2, 2:] @ np.linalg.solve(F[2:, 2:], F[2:, :2])


def main() -> None:
    """One line a set, and the medians."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sets", type=int, default=24)
    parser.add_argument("--first-seed", type=int, default=3000)
    given = parser.parse_args()
    table = []
    for i in range(given.sets):
        arm, demos, truth = Case("glass", ROBOTS[i % 4], given.first_seed + i, whole=False, axes="rotation").make()
        kinematics, sway = batch_kinematics(arm.robot, arm.robot.frame(truth["tip"])), truth["mechanisms"][0]["sway"]
        motions = [kinematics.pose(t.q)[:, :3, :3] for t in demos]
        totals = [sum(information(R, sway, law) for R in motions) for law in LAWS]
        bounds = [MEDIAN * np.degrees(np.sqrt(0.5 * np.trace(np.linalg.inv(F)))) for F in totals]
        found = ml.find_mechanism(arm.robot, truth["tip"], demos, np.random.default_rng(0)).mechanism
        axis = np.full(3, np.nan) if found is None or found.axis is None else found.axis
        table.append([np.degrees(np.arccos(min(1.0, abs(float(axis[2]))))), *bounds])
        print(f"{arm.robot.name} {given.first_seed + i}: sway {np.degrees(sway):.2f} deg,", np.round(table[-1], 2))
    middle = np.nanmedian(np.array(table), axis=0)
    print(f"axis error {middle[0]:.2f} deg; median to be expected at the Cramer-Rao bound:")
    print("\n".join(f"  sway {law}: {value:.2f} deg" for law, value in zip(LAWS, middle[1:], strict=True)))


if __name__ == "__main__":
    main()
