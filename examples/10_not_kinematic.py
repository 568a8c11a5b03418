# /// script
# requires-python = ">=3.11"
# dependencies = ["manip-learn"]
# ///
"""Learn a constraint that is not built from Jacobian rows: A(q) = Lambda Phi(q) with your own features.

A puck in a groove is pushed at random. The groove is a conic, a x + b y + c x^2 + d x y + e y^2 = const. Its gradient
is Lambda Phi(q), where Phi contains the gradients of the five monomials: the rows of A change with the state and Lambda
is constant. The learner knows neither the shape nor the number of rows.
"""

import argparse

import numpy as np

import manip_learn as ml

MONOMIALS = ("x", "y", "x^2", "x y", "y^2")
GROOVE = np.array([[-0.3, -0.2, 1.0, 0.6, 2.5]])  # coefficients of the monomials: an ellipse [1/m, 1/m^2]
PUSHES, SAMPLES, DT = 20, 40, 0.02  # recordings, samples of each, time between two [s]


def gradients(q: np.ndarray) -> np.ndarray:
    """Phi(q), shape (5, 2): the gradients of the monomials."""
    x, y = q
    return np.array([[1.0, 0.0], [0.0, 1.0], [2.0 * x, 0.0], [y, x], [0.0, 2.0 * y]])


def recorded_pushes(noise: float, rng: np.random.Generator) -> ml.Demonstrations:
    """The puck moves along the groove only; noise is a share of the root mean square velocity."""
    out = []
    for number in range(PUSHES):
        q, push, places, velocities = rng.uniform(-1.0, 1.0, 2), 2.0 * rng.standard_normal(2), [], []
        for _ in range(SAMPLES):
            across = (GROOVE @ gradients(q))[0] / np.linalg.norm(GROOVE @ gradients(q))
            u = (push - 0.5 * q) - across * (across @ (push - 0.5 * q))
            places.append(q)
            velocities.append(u)
            q, push = q + DT * u, push + 0.5 * rng.standard_normal(2)
        u = np.array(velocities)
        u += noise * np.sqrt(np.mean(u**2, axis=0)) * rng.standard_normal(u.shape)
        out.append(ml.Trajectory(DT * np.arange(SAMPLES), np.array(places), u, ("x", "y"), f"push {number}"))
    return ml.Demonstrations(out)


def angle_to_the_groove(constraint: ml.Constraint) -> float:
    """Angle between the learnt row of Lambda and the true one [deg]."""
    cosine = abs((constraint.selection @ GROOVE.T).item()) / np.linalg.norm(GROOVE)
    return float(np.degrees(np.arccos(min(1.0, cosine))))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--headless", action="store_true", help="accepted for all examples; nothing is opened here")
    parser.parse_args()

    features = ml.CustomFeatures(gradients, MONOMIALS, nv=2)
    for noise in (0.0, 0.01):
        learner = ml.ConstraintLearner(features).fit(recorded_pushes(noise, np.random.default_rng(0)))
        constraint, report = learner.constraint_, learner.report_
        print(f"noise {noise:.0%}: {report.n_constraints} of {len(MONOMIALS)} rows held ({report.kind})")
        scaled = constraint.selection[0] / constraint.selection[0, 2]
        terms = (f"{c:+.3f} {name}" for c, name in zip(scaled, MONOMIALS, strict=True))
        print(f"  the groove: {' '.join(terms)} = const, {angle_to_the_groove(constraint):.1e} degrees off")


if __name__ == "__main__":
    main()
