"""What is learnt from the shipped recordings, by every estimator that applies to them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from comparison import Cases, flat, projector

import manip_learn as ml

RECORDINGS = Path(__file__).resolve().parents[2] / "examples" / "data"
SCENES = {
    "planar": ("planar3", "tip"),
    "drawer": ("sawyer", "right_gripper_tip"),
    "door": ("sawyer", "right_gripper_tip"),
}
FOLDERS = {"planar": "planar3_reach", "drawer": "sawyer_drawer", "door": "sawyer_door"}
# scene, how many recordings, axes, references, number of rows, estimator
LEARNT: tuple[tuple[str, int, str, tuple[str, ...], int | None, str], ...] = (
    ("planar", 20, "planar", ("world",), None, "auto"),
    ("planar", 20, "planar", ("world", "local"), None, "auto"),
    ("planar", 20, "planar", ("world",), 2, "joint"),
    ("planar", 20, "x y", ("world",), None, "joint"),
    ("planar", 20, "planar", ("world",), 2, "separate"),
    ("planar", 20, "planar", ("world",), None, "separate"),
    ("planar", 20, "planar", ("local",), 2, "joint"),
    ("planar", 20, "planar", ("world",), 1, "null-space"),
    ("drawer", 50, "xyz", ("world",), None, "auto"),
    ("drawer", 12, "xyz", ("world", "local"), None, "auto"),
    ("drawer", 12, "xyz", ("world",), None, "null-space"),
    ("drawer", 12, "xyz", ("local",), 2, "null-space"),
    ("drawer", 12, "pose", ("world",), 2, "null-space"),
    ("drawer", 6, "xyz", ("world",), 2, "joint"),
    ("door", 8, "xyz", ("world", "local"), None, "auto"),
    ("door", 8, "xyz", ("local",), 2, "null-space"),
    ("door", 8, "pose", ("local",), None, "null-space"),
    ("door", 8, "pose", ("local",), 5, "auto"),
    ("door", 8, "xyz", ("world",), None, "null-space"),
)


def learning_cases() -> Cases:
    """Case -> everything that the report holds, with the projector on the learnt rows."""
    return {
        f"learn {scene} {count} recordings, {axes}, {'+'.join(references)}, rows {s}, {estimator}": learnt(
            SCENES[scene], recordings(FOLDERS[scene], count), axes, references, s, estimator
        )
        for scene, count, axes, references, s, estimator in LEARNT
    }


def recordings(folder: str, count: int) -> list[str]:
    """The first `count` recordings of a shipped folder."""
    return [str(file) for file in sorted((RECORDINGS / folder).glob("*.csv"))[:count]]


def learnt(
    scene: tuple[str, str], files: list[str], axes: str, references: tuple[str, ...], s: int | None, estimator: Any
) -> dict[str, Any]:
    """One fit; what is refused is named by the class of the error."""
    robot = ml.load_robot(scene[0])
    features = [ml.FrameJacobian(robot, frame=scene[1], axes=axes, reference=r) for r in references]
    try:
        learner = ml.ConstraintLearner(features if len(features) > 1 else features[0], s, estimator)
        how = "recorded" if scene[0] == "planar3" else "auto"  # Euler steps
        learner.fit(ml.load_demonstrations(files, robot, velocities=how))
    except ml.ManipLearnError as error:
        return {"refused": type(error).__name__}
    selection = learner.constraint_.selection
    return {"rows": len(selection), "projector": projector(selection), **flat(learner.report_.to_dict())}
