"""Every fit ends, with an answer or a refusal, whatever was recorded."""

from __future__ import annotations

import numpy as np
import pytest
from mechanism_motions import about, along, demonstrate
from scipy.spatial.transform import Rotation
from task_sets import arm

import manip_learn as ml

HANDS = {
    "panda": ("panda_hand_tcp", np.array([0.0, -0.3, 0.0, -1.9, 0.0, 1.7, 0.6])),
    "xarm7": ("link_eef", np.array([0.0, -0.2, 0.0, 1.2, 0.0, 1.4, 0.0])),
}


# three sets for which the learner divided a part by its places, joined and divided it again for ever
@pytest.mark.parametrize(
    ("seed", "name", "kind", "moved"),
    [
        (84, "panda", "plane", 0.08),
        pytest.param(6, "panda", "plane", 0.08, marks=pytest.mark.slow),
        pytest.param(79, "xarm7", "screw", 0.0, marks=pytest.mark.slow),
    ],
)
def test_a_fit_ends(seed: int, name: str, kind: str, moved: float) -> None:
    """Six to twelve recordings of a hand on a plane that is moved each time, or on a screw: an answer or a refusal."""
    rng, robot, (frame, middle), demos = np.random.default_rng([seed, 1]), arm(name), HANDS[name], []
    for choices in (2, 8, 4, 4):  # these sets were once drawn with their robot, kind, radius and number of places
        rng.choice(choices)
    first = Rotation.from_rotvec(rng.normal(0.0, 0.3, 3))
    rng.choice(3)
    for _ in range(int(rng.choice([6, 8, 12]))):
        angle = moved * rng.normal()
        turn = Rotation.from_rotvec([0.0, 0.6 * angle, 0.8 * angle]) * first
        path = along(turn.apply([[1.0, 0.0, 0.1], [0.0, 1.0, 0.0]]), 0.2, firm=False)
        if kind == "screw":
            point = robot.position(middle, frame) + turn.apply([0.3, 0.0, 0.0])
            path = about(turn.apply([0.0, 0.0, 1.0]), point, 0.6, pitch=0.03, firm=False)
        noise = float(rng.choice([2e-5, 1e-4, 5e-4]))
        demos += demonstrate(robot, frame, middle, path, rng, n=1, noise=noise)
    maps = [ml.FrameJacobian(robot, frame, "xyz", reference) for reference in ("world", "local")]
    try:
        assert ml.ConstraintLearner(maps).fit(demos).reports_
    except ml.ManipLearnError as refusal:
        assert refusal.code
