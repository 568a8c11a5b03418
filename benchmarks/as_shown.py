"""What an arm does that repeats what was shown, from any home: where it takes hold, how far and how straight it goes.

    PYTHONPATH=tests python benchmarks/as_shown.py --seed 60000 --homes 4
    PYTHONPATH=tests python benchmarks/as_shown.py --pairs --seed 61000          # two tasks in one recording
    PYTHONPATH=tests python benchmarks/as_shown.py --moved --seed 62000          # the furniture stands elsewhere

One line a repetition: how far the hand took hold from the true handle [mm], the way over the median one shown, how far
the hand strayed [mm]; of tables, how far the path is from the one shown, both ways [mm].
"""

from __future__ import annotations

import argparse

import numpy as np
from scipy.spatial.transform import Rotation
from shown_motions import KINDS, recordings

import manip_learn as ml

ARMS = ("panda", "sawyer", "xarm7", "ur5")
READY = {  # [rad] about which home postures are drawn
    "panda": (0.0, -0.5, 0.0, -2.0, 0.0, 1.7, 0.8),
    "xarm7": (0.0, -0.2, 0.0, 1.3, 0.0, 1.4, 0.0),
    "ur5": (0.0, -1.3, 1.7, -1.9, -1.4, 0.0),
    "sawyer": (0.0, -0.9, 0.0, 1.7, 0.0, 0.8, 3.3161),
}


def homes(robot: ml.Robot, name: str, rng: np.random.Generator, n: int) -> list[np.ndarray]:
    """Postures about the arm's ready one, within the limits."""
    spread = np.clip(np.array(READY[name]) + rng.normal(0.0, 0.4, (n, robot.nv)), robot.position_lower + 0.15, 9.0)
    return [np.minimum(q, robot.position_upper - 0.15) for q in spread]


def measured(again: ml.Repetition, robot: ml.Robot, tip: str, way: int, constraint: ml.Constraint, thing, far) -> dict:
    """What the hand did in one of the ways of a repetition."""
    name = [step for step in again.steps if step.kind == "way"][way]
    begin, end = next((a, b) for label, a, b in again.rollout.phases if label == f"{name.name}: way")
    time = again.rollout.time
    inside = (time >= begin - 1e-9) & (time <= end + 1e-9)
    places = np.array([robot.position(q, tip) for q in again.rollout.q[inside]])
    said = {"off": 1e3 * name.deviation, "unit": name.unit, "stopped": name.stopped_by}
    shown = constraint.shown
    if shown is not None and not shown.is_way:
        points, apart = shown.points, lambda a, b: max(np.min(np.linalg.norm(b - p, axis=1)) for p in a)
        hold = shown.begin if thing is None else thing
        return said | {
            "hold": 1e3 * np.linalg.norm(places[0] - hold),
            "way": 1.0,
            "path": 1e3 * max(apart(places, points), apart(points, places)),
        }
    return said | {"hold": 1e3 * np.linalg.norm(places[0] - thing), "way": name.done / np.median(far), "path": 0.0}


def main() -> None:
    """Make, learn, repeat, measure."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seed", type=int, default=60000)
    parser.add_argument("--sets", type=int, default=1, help="per kind and arm")
    parser.add_argument("--homes", type=int, default=4, help="per set")
    parser.add_argument("--pairs", action="store_true")
    parser.add_argument("--moved", action="store_true")
    parser.add_argument("--arms", default=",".join(ARMS))
    options = parser.parse_args()
    kinds = [("drawer", "table"), ("door", "drawer"), ("table", "lid")] if options.pairs else [(k,) for k in KINDS]
    good = total = 0
    for kind in kinds:
        for arm in options.arms.split(","):
            for seed in range(options.seed, options.seed + options.sets):
                rng = np.random.default_rng([seed, len(arm), KINDS.index(kind[0])])
                try:
                    robot, tip, demos, things, ways = recordings(kind, arm, seed)
                    maps = [ml.FrameJacobian(robot, tip, "xyz", r) for r in ("world", "local")]
                    learner = ml.ConstraintLearner(maps).fit(demos)
                except (RuntimeError, ml.ManipLearnError) as error:
                    print(f"{'+'.join(kind)} {arm} {seed}: NOT LEARNT {error}"[:160], flush=True)
                    total += options.homes
                    continue
                for home in homes(robot, arm, rng, options.homes):
                    total += 1
                    T = np.eye(4)
                    if options.moved:
                        T[:3, :3] = Rotation.from_rotvec([0, 0, np.radians(rng.uniform(-20, 20))]).as_matrix()
                        T[:3, 3] = things[0].hold - T[:3, :3] @ things[0].hold
                        T[:3, 3] += rng.uniform(-0.1, 0.1, 3)
                    try:
                        again = ml.repeat(learner.skill_, home, T if options.moved else None)
                    except ml.ManipLearnError as error:
                        print(f"{'+'.join(kind)} {arm} {seed}: REFUSED {error}"[:260], flush=True)
                        continue
                    steps = [s for s in again.skill.steps if s.kind == "way"]
                    fine = len(steps) == len(kind)
                    for i, step in enumerate(steps[: len(kind)]):
                        hold = T[:3, :3] @ things[i].hold + T[:3, 3]
                        m = measured(again, robot, tip, i, step.constraint, hold, ways[i])
                        limit = 1.0
                        ok = m["hold"] <= 2 and abs(m["way"] - 1) <= 0.03 and m["off"] <= limit and m["path"] <= 5
                        fine &= bool(ok and m["stopped"] is None)
                        print(
                            f"{kind[i]} {arm} {seed}: hold {m['hold']:.2f} mm, way {m['way']:.3f}, off {m['off']:.2f}, "
                            f"path {m['path']:.1f} mm{'' if ok else '  <---'}",
                            flush=True,
                        )
                    good += fine
    print(f"{good} of {total}")


if __name__ == "__main__":
    main()
