"""How often the joint estimator finds the number of rows that were commanded, or says that it is in doubt.

    python benchmarks/joint_rows.py                       # every line, 4 sets each, seeds from 20000
    python benchmarks/joint_rows.py --arm planar3 --sets 12 --noise 0

Reaches of `efficiency.motion_of` along one row or more, drawn at random, with b unknown and policies of the posture;
`apart` is the ratio of the largest to the least standard deviation of the noise over directions of joint space. Wrong
and silent is the failure. `angle` is the median over the sets with the right number, `inside` how many of those have
an error within the stated 68 % angle. Sets whose curved policy runs away (no finite posture or speed) are only counted.
"""

from __future__ import annotations

import argparse
import itertools
import time
import warnings
from collections import Counter
from typing import Any

import numpy as np
from efficiency import ARMS, features_of, motion_of, noisy

from manip_learn.errors import ConfigurationError, NotIdentifiableError, RecordingError
from manip_learn.learning import ConstraintLearner
from manip_learn.linalg import orthonormal_rows, row_space_angle

POLICIES = ("affine", "quadratic", "sinusoidal")
NOISES = (0.0, 0.01, 0.02, 0.05)
# trajectories x points
SIZES = ((5, 100), (20, 20), (100, 10))
MOST_ROWS = {"planar3": 2, "sawyer": 3}
RAN_AWAY = "ran away"
OUTCOMES = ("right", "right, warned", "wrong, warned", "refused", "wrong, silent", RAN_AWAY)


def outcome(
    arm: str, s: int, policy: str, noise: float, size: tuple[int, int], apart: float, seed: int, estimator: str
) -> tuple[str, dict[str, Any]]:
    """One of `OUTCOMES`, and figures of the answer."""
    rng = np.random.default_rng([seed, ARMS.index(arm), s, POLICIES.index(policy), *size])
    selection = orthonormal_rows(rng.standard_normal((s, features_of(arm).n_rows)))
    try:
        motion = motion_of(arm, policy, *size, rng, selection)
    except ConfigurationError:
        return RAN_AWAY, {"seconds": 0.0}
    demos, _ = noisy(motion, noise, apart, rng)
    started = time.process_time()
    try:
        learner = ConstraintLearner(motion.features, estimator="auto" if estimator == "auto" else "joint").fit(demos)
    except RecordingError:  # a velocity of 1e9 rad/s is an outlier
        return RAN_AWAY, {"seconds": time.process_time() - started}
    except NotIdentifiableError as refusal:
        return "refused", {"seconds": time.process_time() - started, "code": refusal.code}
    report, found = learner.report_, learner.constraint_.selection
    figures = {"seconds": time.process_time() - started, "rows": len(found), "gap": report.gap}
    figures["warnings"] = [w[:70] for w in report.warnings]
    if len(found) != s:
        return "wrong, warned" if report.warnings else "wrong, silent", figures
    figures["angle"] = float(np.degrees(row_space_angle(selection, found)))
    if report.uncertainty_deg is not None:
        figures["inside"] = figures["angle"] <= max(report.uncertainty_deg, 1e-6)
    return "right, warned" if report.warnings else "right", figures


def main() -> None:
    """Print a line for each arm, number of rows and noise."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--arm", choices=ARMS, nargs="*", default=ARMS)
    parser.add_argument("--rows", type=int, nargs="*", default=[1, 2, 3])
    parser.add_argument("--policy", choices=POLICIES, nargs="*", default=POLICIES)
    parser.add_argument("--noise", type=float, nargs="*", default=NOISES)
    parser.add_argument("--size", nargs="*", default=[f"{k}x{n}" for k, n in SIZES])
    parser.add_argument("--apart", type=float, default=1.0)
    parser.add_argument("--sets", type=int, default=4, help="of each policy and size")
    parser.add_argument("--first-seed", type=int, default=20000)
    parser.add_argument("--estimator", choices=("joint", "auto"), default="joint")
    parser.add_argument("--verbose", action="store_true", help="say what came of each set that is not plainly right")
    given = parser.parse_args()
    warnings.simplefilter("ignore")
    print("| arm | rows | noise | " + " | ".join(OUTCOMES) + " | angle [deg] | inside | s a fit |")
    print("|---" * (len(OUTCOMES) + 6) + "|")
    total: Counter[str] = Counter()
    for arm, s, noise in itertools.product(given.arm, given.rows, given.noise):
        if s > MOST_ROWS[arm]:
            continue
        found = []
        cases = itertools.product(given.policy, given.size, range(given.sets))
        for policy, size, k in cases:
            n_trajectories, n_points = map(int, size.split("x"))
            one = outcome(
                arm, s, policy, noise, (n_trajectories, n_points), given.apart, given.first_seed + k, given.estimator
            )
            if given.verbose and one[0] != "right":
                print(f"    {arm} {s} {policy} {noise:g} {size} {given.first_seed + k}: {one}", flush=True)
            found.append(one)
        counts = Counter(name for name, _ in found)
        total += counts
        angles, inside = ([f[key] for _, f in found if key in f] for key in ("angle", "inside"))
        cells = [str(counts[name]) for name in OUTCOMES] + [f"{np.median(angles):.2g}" if angles else ""]
        cells += [
            f"{sum(inside)} of {len(inside)}" if inside else "",
            f"{np.median([f['seconds'] for _, f in found]):.2f}",
        ]
        print(f"| {arm} | {s} | {100 * noise:g} % | " + " | ".join(cells) + " |", flush=True)
    print("all: " + ", ".join(f"{name} {total[name]}" for name in OUTCOMES))


if __name__ == "__main__":
    main()
