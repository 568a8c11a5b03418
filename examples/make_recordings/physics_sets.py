"""The recordings of `kinematic_sets`, made by rigid-body dynamics: slower, and as a person's hands make them.

    trajectories, truth = make_set("drawer", "panda", seed=7, n_demonstrations=6)

A person has a motion in mind and pulls the tip and the arm towards it with springs, off by a centimetre and with slow
pushes on the joints. Handles hold the tip by MuJoCo's equality constraints, drawers and doors have mass and friction.
Nothing of the truth takes part after the plan.
"""

from __future__ import annotations

from functools import partial
from typing import Any

from make_recordings.arms import Arm
from make_recordings.guided_motion import SETTLE, simulate
from make_recordings.kinematic_sets import ENCODER_NOISE, Drawn, Trajectories, draw_set, record_set

STUCK = 8.0  # how much more dry friction the joints have in `free_sticking`


def make_set(
    kind: str, robot: str, seed: int, n_demonstrations: int = 6, noise: float = ENCODER_NOISE, whole: bool = True
) -> tuple[Trajectories, dict[str, Any]]:
    """Demonstrations of one task and the truth about them; see `kinematic_sets.make_set`.

    Raises:
        ValueError: No such kind or robot, or no demonstration asked for.
        RuntimeError: Nothing within reach was drawn.
    """
    return record_set(_draw, kind, robot, seed, n_demonstrations, noise, whole)


def _draw(kind: str, arm: Arm, key: list[int], n: int, whole: bool) -> Drawn:
    if kind == "free_sticking":
        return draw_set("free", arm, key, n, whole, SETTLE, partial(simulate, friction=STUCK))
    return draw_set(kind, arm, key, n, whole, SETTLE, simulate)
