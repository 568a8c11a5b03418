"""Numbers as printed in Manavalan and Howard, "Learning Singularity Avoidance"."""

from __future__ import annotations

# NMIE of the learnt manipulability, mean and s.d. of 50 trials, as printed (which leaves a factor of 1e-3 open)
TABLE: dict[str, dict[str, float]] = {
    "x y": {"mean": 1e-6, "sd": 7e-6},
    "x rz": {"mean": 7e-6, "sd": 4e-5},
    "y rz": {"mean": 2e-8, "sd": 3e-8},
}
# RMSE of pi_mu against its learnt version, 20 rollouts of 100 points
RMSE: dict[str, float] = {"mean": 2.069e-4, "sd": 1.001e-4}
# a real Sawyer that opens a drawer; its data were not published
SAWYER_MIE = 0.002
SAWYER_RMSE: dict[str, float] = {"mean": 0.220, "sd": 0.094}
