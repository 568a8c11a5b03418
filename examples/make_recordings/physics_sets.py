"""The recordings of `kinematic_sets`, made by rigid-body dynamics: slower, and as a person's hands make them.

    trajectories, truth = make_set("drawer", "panda", seed=7, n_demonstrations=6)

A person has a motion in mind and pulls the tip and the arm towards it with springs, off by a centimetre and with slow
pushes on the joints. Handles hold the tip by MuJoCo's equality constraints, drawers and doors have mass and friction.
Nothing of the truth takes part after the plan.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from make_recordings.arms import Arm
from make_recordings.guided_motion import SETTLE, simulate
from make_recordings.hand_motion import RATE
from make_recordings.kinds import KINDS
from make_recordings.kinematic_sets import ENCODER_NOISE, Drawn, Trajectories, draw_set, record_set
from make_recordings.mechanism_motion import UnreachableError

STUCK = 8.0  # how much more dry friction the joints have in `free_sticking`


def make_set(
    kind: str, robot: str, seed: int, n_demonstrations: int = 6, noise: float = ENCODER_NOISE, whole: bool = True
) -> tuple[Trajectories, dict[str, Any]]:
    """Demonstrations of one task and the truth about them; see `kinematic_sets.make_set`.

    Raises:
        ValueError: No such kind or robot, or no demonstration asked for.
        RuntimeError: Nothing within reach was drawn.
    """
    if kind not in KINDS:
        raise ValueError(f"no kind {kind!r}; there are {', '.join(KINDS)}")
    if n_demonstrations < 1:
        raise ValueError(f"{n_demonstrations} demonstrations: at least 1 is needed")
    return record_set(_draw, kind, robot, seed, n_demonstrations, noise, whole)


def _draw(kind: str, arm: Arm, key: list[int], n: int, whole: bool) -> Drawn:
    plans, mechanisms, other = draw_set("free" if kind == "free_sticking" else kind, arm, key, n, whole, SETTLE)
    friction = STUCK if kind == "free_sticking" else 1.0
    tapes = []
    for number, plan in enumerate(plans):
        tape = simulate(arm, plan, mechanisms, friction, np.random.default_rng([*key, number, 1]))
        if not (arm.stays_inside(tape.motion, RATE) and arm.keeps_clear(tape.motion[::20])):
            raise UnreachableError(f"demonstration {number} came close to a limit")
        tapes.append(tape)
    return tapes, mechanisms, other
