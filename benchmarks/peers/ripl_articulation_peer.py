"""ripl_articulation: one twist xi with B = A exp(xi theta) for all pairs of poses (A, B), as a factor graph.

`articulation CASES ANSWER`: twists about the base for the recordings of `articulated_objects.py`. Settings:

- `README`: A is the first pose, no prior: the call that its README shows
- `own test`: A is the first pose, and the prior comes from the farthest pose, as in its own test
- `far pairs`: A and B are both taken from the motion, half of it apart, so that no error of a single pose is in
  every pair; the prior from the farthest pair
- `60 samples`: the same with so many samples of each recording
- `places only`: the same with the orientation of the first pose everywhere, for a hand that turns in the grip

Recordings with grips of their own share the twist of their displacements B A^-1, seen from one place at the hand; its
documentation knows one motion only, and so do the first two settings.
"""

import json
import time

import gtsam
import numpy as np
from driving import main
from ripl_articulation import solve_articulation_from_poses

FEW = 60  # samples of each recording
# samples of a recording (None: all), far pairs, prior, without orientations
SETTINGS = {
    "README": (None, False, False, False),
    "own test": (None, False, True, False),
    "far pairs": (None, True, True, False),
    "60 samples": (FEW, True, True, False),
    "places only": (FEW, True, True, True),
}


def pose(matrix):
    """As GTSAM has it."""
    return gtsam.Pose3(np.require(matrix, requirements="F"))


def pairs(recordings, samples, far, places):
    """Displacements (N, 4, 4) as poses B, all from the same pose A."""
    A, B = recordings[0][0], []
    for poses in recordings:
        n = len(poses)
        poses = poses[np.linspace(0, n - 1, min(samples or n, n)).round().astype(int)]
        if places:
            poses[:, :3, :3] = A[:3, :3]
        if far:
            order = np.argsort(np.linalg.norm(poses[:, :3, 3] - poses[0, :3, 3], axis=1))
            half = len(poses) // 2
            starts, ends = poses[order[:half]], poses[order[-half:]]
        else:
            starts, ends = np.repeat(poses[:1], len(poses), axis=0), poses
        B.append(ends @ np.linalg.inv(starts) @ A)
    B = np.concatenate(B)
    return np.repeat(A[None], len(B), axis=0), B


def twist(recordings, samples, far, prior, places):
    """Twist about the base (angular part first), largest part of it that a pair shows, and seconds."""
    A, B = pairs(recordings, samples, far, places)
    options = {}
    if prior:
        farthest = np.argmax(np.linalg.norm(B[:, :3, 3] - A[:, :3, 3], axis=1))
        options["prior_xi"] = pose(A[0]).logmap(pose(B[farthest]))
    began = time.process_time()
    xi, theta = solve_articulation_from_poses(A, B, **options)
    seconds = time.process_time() - began
    return {"twist": (pose(A[0]).AdjointMap() @ xi).tolist(), "most": float(np.ptp(theta)), "seconds": seconds}


def articulation(cases, answer):
    """All settings on all cases; those of one motion only on sets of one recording."""
    out = []
    with np.load(cases) as content:
        sets = [[content[f"{i}|{j}"] for j in range(n)] for i, n in enumerate(content["recordings"])]
    for recordings in sets:
        known = {name: s for name, s in SETTINGS.items() if s[1] or len(recordings) == 1}
        out.append({name: twist(recordings, *setting) for name, setting in known.items()})
    with open(answer, "w", encoding="utf-8") as stream:
        json.dump(out, stream)


if __name__ == "__main__":
    main(articulation=articulation)
