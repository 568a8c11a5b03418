"""How close the mechanisms come to the Cramer-Rao bound, and how often what is stated holds the truth.

    python benchmarks/mechanism_bound.py                                  # doors, 64 sets, 1e-4, 1e-3 and 3e-3 rad
    python benchmarks/mechanism_bound.py --kinds screw tether --sets 20   # coverage only: the bound is that of a door

Cut recordings of `recording_cases`, learnt by `ConstraintLearner` as the command line does. Bound of a door held
loosely: recorded q_n = q*_n + errors of standard deviation sigma in each joint, each q*_n unknown but for the door's
radius rho(q*_n) = c and height z(q*_n) = h_i of trajectory i. With G_n the rows of d(rho, z)/dq and M_n = d(rho - c,
z - h_i) / d(axis, point, c, h),

    cov >= sigma^2 (sum_n M_n^T (G_n G_n^T)^-1 M_n)^-1

at the true place, all samples, nothing smoothed. A figure is the root of the mean square of error over bound.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "examples"))

from make_recordings.arms import ROBOTS, Arm
from recording_cases import FIRM, Case
from recording_scores import INSIDE, mechanism_figures

import manip_learn as ml
from manip_learn.errors import NotIdentifiableError
from manip_learn.linalg import null_basis

ERRORS = {"axis deg": 180.0 / np.pi, "place mm": 1e3, "radius mm": 1e3}


def door_bound(arm: Arm, postures: list[np.ndarray], door: dict[str, Any]) -> dict[str, float]:
    """Least root of the mean squared error of axis, place and radius for sigma = 1 rad."""
    axis, point = np.array(door["axis"]), np.array(door["point"])
    across, q = null_basis(axis[None]).T, np.concatenate(postures)
    p = np.array([arm.pose(row)[:3, 3] for row in q])
    d = p - point - float((p.mean(axis=0) - point) @ axis) * axis
    z = d @ axis
    radial = d - np.outer(z, axis)
    radial /= np.linalg.norm(radial, axis=1)[:, None]
    number = np.repeat(np.arange(len(postures)), [len(x) for x in postures])
    M = np.zeros((len(q), 2, 5 + len(postures)))
    M[:, 0, :2], M[:, 1, :2] = -z[:, None] * (radial @ across.T), d @ across.T
    M[:, 0, 2:4], M[:, 0, 4] = -radial @ across.T, -1.0
    M[np.arange(len(q)), 1, 5 + number] = -1.0
    J = np.array([arm.robot.jacobian(row, arm.tip)[:3] for row in q])
    G = np.stack([radial, np.tile(axis, (len(q), 1))], axis=1) @ J
    C = np.linalg.inv(np.einsum("nij,nik,nkl->jl", M, np.linalg.inv(G @ G.transpose(0, 2, 1)), M, optimize=True))
    sizes = np.sqrt([np.trace(C[:2, :2]), np.trace(C[2:4, 2:4]), C[4, 4]])
    return {name: factor * size for (name, factor), size in zip(ERRORS.items(), sizes, strict=True)}


def learnt(cases: list[Case]) -> Iterator[tuple[Case, dict[str, float]]]:
    """Errors, whether they are within what is stated, and error over bound; nothing but `type right` if refused."""
    for case in cases:
        arm, demos, truth = case.make()
        maps = [ml.FrameJacobian(arm.robot, truth["tip"], case.axes, reference) for reference in ("world", "local")]
        try:
            found = ml.ConstraintLearner(maps).fit(demos).report_.mechanism
        except NotIdentifiableError:
            yield case, {"type right": 0.0}
            continue
        figures = mechanism_figures(found, truth["mechanisms"][0])
        if case.kind == "door":
            bound = door_bound(arm, [t.q for t in demos], truth["mechanisms"][0])
            figures |= {
                f"{name} / bound": figures[name] / (case.noise * bound[name]) for name in ERRORS if name in figures
            }
            figures |= {f"{name} bound": case.noise * bound[name] for name in ERRORS}
        yield case, figures


def cells(found: list[dict[str, float]]) -> Iterator[str]:
    """Parameter by parameter: median and worst error, median and worst bound, error over bound, share inside."""
    for name in (*ERRORS, "pitch %"):
        values, inside = ([f[key] for f in found if key in f] for key in (name, INSIDE[name]))
        if not values:
            continue
        words = f"{name} {np.median(values):.3g} ({max(values):.3g})"
        ratios = [f[f"{name} / bound"] for f in found if f"{name} / bound" in f]
        if ratios:
            bounds = [f[f"{name} bound"] for f in found if f"{name} bound" in f]
            words += (
                f", bound {np.median(bounds):.3g} ({max(bounds):.3g}), ratio {np.sqrt(np.mean(np.square(ratios))):.2f}"
            )
        yield words + (f", inside {100.0 * np.mean(inside):.0f} %" if inside else "")


def main() -> None:
    """Print a line for each kind and noise."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kinds", nargs="+", default=["door"])
    parser.add_argument("--noise", nargs="+", type=float, default=[1e-4, 1e-3, 3e-3], help="of the encoders [rad]")
    parser.add_argument("--sets", type=int, default=64)
    parser.add_argument("--first-seed", type=int, default=5000)
    parser.add_argument("--demonstrations", type=int, default=5)
    given = parser.parse_args()
    for kind in given.kinds:
        for noise in given.noise:
            axes = "pose" if kind in FIRM else "xyz"
            cases = [
                Case(kind, ROBOTS[i % 4], given.first_seed + i, given.demonstrations, noise, whole=False, axes=axes)
                for i in range(given.sets)
            ]
            found = [figures for _, figures in learnt(cases)]
            right = sum(f["type right"] for f in found)
            print(f"| {kind} | {noise:g} rad | {right:.0f} of {len(found)} | " + " | ".join(cells(found)), flush=True)


if __name__ == "__main__":
    main()
