"""States that flatter no controller: exactly singular starts at three periods, noise, and a million steps.

    python benchmarks/closed_loops.py [--starts 8] [--steps 1000000] [--out FILE.md]

Singular starts are found by least squares: A(q)^T w = 0 with |w| = 1, inside the joint limits, for random oblique rows.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from controller_cases import ROBOTS, inside
from scipy.optimize import least_squares

import manip_learn as ml
from manip_learn.robot.tips import default_tip

PERIOD = 0.001  # [s]
PERIODS = (0.001, 0.01, 0.02)  # [s] at which singular starts are left
ARMS = {
    **ROBOTS,
    "planar3": ("tip", ()),
    "ur3": ("tool0", ()),
    "ur10": ("tool0", ()),
    "kinova": ("j2s6s200_end_effector", ()),
    "so100": (None, ()),
    "z1": (None, ()),
}
LEFT = 0.01  # smallest singular value from which a singularity counts as left [m]
REST = 1e-3  # [rad/s]
NOISE = 1e-4  # [rad]


def robots() -> dict[str, tuple[ml.Robot, str]]:
    """Robots and their tips."""
    return {name: (ml.load_robot(name, locked=locked), tip) for name, (tip, locked) in ROBOTS.items()}


def smallest(constraint: ml.Constraint, q: np.ndarray) -> float:
    """The smallest singular value of A."""
    return float(np.linalg.svd(constraint(q), compute_uv=False)[-1])


def singular_start(constraint: ml.Constraint, robot: ml.Robot, rng: np.random.Generator) -> np.ndarray | None:
    """A posture where A loses a direction to rounding; None if none is found from here."""
    low, high = np.maximum(robot.position_lower, -np.pi), np.minimum(robot.position_upper, np.pi)
    w = rng.normal(size=constraint.n_constraints)
    unknowns = np.concatenate([inside(robot, rng).clip(low + 1e-3, high - 1e-3), w / np.linalg.norm(w)])
    reach = np.full(w.shape, np.inf)

    def residual(x: np.ndarray) -> np.ndarray:
        q, w = x[: robot.nv], x[robot.nv :]
        return np.append(constraint(q).T @ w, w @ w - 1.0)

    bounds = (np.concatenate([low, -reach]), np.concatenate([high, reach]))
    found = least_squares(residual, unknowns, bounds=bounds, xtol=1e-15, ftol=1e-15, gtol=1e-15).x[: robot.nv]
    room = float(np.min(np.minimum(found - robot.position_lower, robot.position_upper - found)))
    return found if smallest(constraint, found) < 1e-12 and room > 0.01 else None


def leaves(constraint: ml.Constraint, q: np.ndarray) -> bool:
    """Whether some small motion in the null space leads out of a singularity: without it, `Hold` forbids to leave."""
    _, sigma, Vt = np.linalg.svd(constraint(q))
    free = Vt[np.count_nonzero(sigma > 1e-9) :]
    return max(smallest(constraint, q + 1e-4 * z) for z in free) > 1e-5


def starts_of(
    robot: ml.Robot, tip: str, number: int, rng: np.random.Generator
) -> list[tuple[ml.Constraint, np.ndarray]]:
    """Singular postures of two or three oblique rows of x, y, z, and of as many again of a pose's rows."""
    found = []
    for axes in ("planar",) if robot.nv == 3 else ("xyz", "pose"):
        features = ml.FrameJacobian(robot, tip, axes)
        p = 2 if robot.nv == 3 else features.n_rows
        for _ in range(60 * number):
            rows = np.linalg.qr(rng.normal(size=(features.n_rows,) * 2))[0][: int(rng.integers(2, min(p, 4) + 1))]
            constraint = ml.Constraint(rows, features)
            start = singular_start(constraint, robot, rng)
            if start is not None and leaves(constraint, start):
                found.append((constraint, start))
            if len(found) == (number // 2 if axes == "xyz" else number):
                break
    return found


def singular_starts(number: int) -> list[list[str]]:
    """How many exactly singular starts are left within a second at each period, holding still and reaching.

    Targets, for rows of x, y, z: a random reachable place, and 0.2 m straight along the lost direction, to the base.
    """
    lines = []
    for name, (tip, locked) in ARMS.items():
        robot = ml.load_robot(name, locked=locked)
        left: dict[str, list[int]] = {kind: [0, 0, 0, 0] for kind in ("hold", "reach", "along")}
        rng = np.random.default_rng([17, sorted(ARMS).index(name)])
        for constraint, start in starts_of(robot, tip or default_tip(robot), number, rng):
            features = constraint.features
            tasks: dict[str, ml.Task | None] = {"hold": None}
            if features.n_rows == 3 and robot.nv > 3:
                here = features.coordinates(start)
                lost = constraint.selection.T @ np.linalg.svd(constraint(start))[0][:, -1]
                tasks["reach"] = ml.PointAttractor(features.coordinates(inside(robot, rng)))
                tasks["along"] = ml.PointAttractor(here - 0.2 * np.sign(here @ lost) * lost)
            for kind, task in tasks.items():
                controller = ml.ResolvedRateController(constraint, task, ml.ManipulabilityAscent(constraint))
                for i, dt in enumerate(PERIODS):
                    rollout = ml.simulate(robot, controller, start, 1.0, dt)
                    left[kind][i] += (
                        max(smallest(constraint, q) for q in rollout.q[:: max(1, round(0.01 / dt))]) >= LEFT
                    )
                left[kind][3] += 1
        lines.append([name, *("{}, {}, {} of {}".format(*counts) for counts in left.values())])
    return lines


def noisy(seconds: float = 10.0) -> list[list[str]]:
    """Sign changes of the command while the arm holds a target that it has reached, with noise on the encoders."""
    lines = []
    for name, (robot, tip) in robots().items():
        features, rng = ml.FrameJacobian(robot, tip), np.random.default_rng([18, sorted(ROBOTS).index(name)])
        constraint = ml.Constraint(np.eye(3)[:2], features)
        q, goal = inside(robot, rng), features.coordinates(inside(robot, rng))
        controller = ml.ResolvedRateController(constraint, ml.PointAttractor(goal), ml.ManipulabilityAscent(constraint))
        cells = [name]
        for noise in (NOISE, 0.0):
            loop, posture, u = ml.ServoLoop(controller, PERIOD), q, np.empty((round(seconds / PERIOD), robot.nv))
            for i in range(len(u)):
                measured = posture + rng.normal(scale=noise, size=robot.nv)
                u[i] = loop.update(measured, i * PERIOD).velocity
                posture = robot.integrate(posture, PERIOD * u[i])
            flips = (np.sign(u[1:]) != np.sign(u[:-1])) & (np.abs(u[1:]) > REST) & (np.abs(u[:-1]) > REST)
            cells += [str(int(flips.sum())), f"{np.max(np.abs(np.diff(u[-1000:], axis=0))):.1e}"]
        lines.append(cells)
    return lines


def million(steps: int) -> list[list[str]]:
    """Largest acceleration over its limit, and excess over position and velocity limits, towards random targets."""
    lines, each = [], 4000
    for name, (robot, tip) in robots().items():
        features, rng = ml.FrameJacobian(robot, tip), np.random.default_rng([19, sorted(ROBOTS).index(name)])
        worst, excess, done = 0.0, -np.inf, 0
        while done < steps // len(ROBOTS):
            constraint = ml.Constraint(np.linalg.qr(rng.normal(size=(3, 3)))[0][: int(rng.integers(1, 4))], features)
            goal = features.coordinates(inside(robot, rng)) * rng.choice([1.0, 3.0])
            task = ml.PointAttractor(goal, gain=rng.choice([0.3, 1.0, 3.0]))
            controller = ml.ResolvedRateController(constraint, task, ml.ManipulabilityAscent(constraint))
            rollout = ml.simulate(robot, controller, inside(robot, rng), each * PERIOD, PERIOD)
            limits, u = controller.limits, rollout.u
            assert limits is not None
            worst = max(worst, float(np.max(np.abs(np.diff(u, axis=0)) / (PERIOD * limits.acceleration))))
            beyond = np.maximum(rollout.q - limits.upper, limits.lower - rollout.q)
            excess = max(excess, float(np.max(beyond)), float(np.max(np.abs(u) - limits.velocity)))
            done += each
        lines.append([name, f"{done}", f"{worst:.12f}", f"{max(excess, 0.0):.1e}"])
    return lines


def table(title: str, head: list[str], lines: list[list[str]]) -> str:
    """A Markdown table."""
    rows = ["| " + " | ".join(cells) + " |" for cells in (head, ["---"] * len(head), *lines)]
    return f"{title}\n\n" + "\n".join(rows) + "\n"


def main() -> None:
    """Print the tables, and write them."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--starts", type=int, default=8, help="singular starts per robot")
    parser.add_argument("--steps", type=int, default=1_000_000, help="steps over all robots; 0: none")
    parser.add_argument("--out", type=Path)
    arguments = parser.parse_args()
    parts = [
        table(
            f"Exactly singular starts (sigma below 1e-12), left (above {LEFT} m) within 1 s, at 1, 10 and 20 ms:",
            ["robot", "holding", "reaching", "straight along the lost direction"],
            singular_starts(arguments.starts),
        ),
        table(
            f"Encoder noise of {NOISE} rad, 10 s, sign changes from one step to the next above {REST} rad/s:",
            ["robot", "sign changes", "largest change in the last second [rad/s]", "without noise", "change"],
            noisy(),
        ),
    ]
    if arguments.steps:
        head = ["robot", "steps", "largest acceleration / limit", "largest excess over other limits"]
        parts.append(table("Random tasks at 1 kHz, half of the targets tripled:", head, million(arguments.steps)))
    text = "\n".join(parts)
    print(text)
    if arguments.out is not None:
        arguments.out.write_text(text)


if __name__ == "__main__":
    main()
