"""Record demonstrations of a task with a hand-guided arm: `python examples/record_tasks_physics.py KIND --out FOLDER`.

    python examples/record_tasks_physics.py drawer_then_table --robot xarm7 --seed 7 --demos 6 --out recordings

writes demo_01.csv ... and truth.json. A recording begins and ends at rest: a free approach, the task, a free retreat.
The motion comes from MuJoCo (extra `physics`); with `--kinematic` it is made on the mechanism exactly, without forces,
which needs no MuJoCo and a quarter of the time. Everything depends on kind, robot and seed only.
"""

from __future__ import annotations

import argparse
import importlib
import json
from pathlib import Path
from typing import Any

from make_recordings.arms import ROBOTS, load_arm
from make_recordings.csv_file import write_csv
from make_recordings.kinds import KINDS


def write_set(folder: Path, trajectories: list, truth: dict[str, Any], thin: int = 1) -> None:
    """One CSV a demonstration with every `thin`-th sample, and truth.json."""
    names = load_arm(truth["robot"]).robot.joint_names
    for number, (time, q) in enumerate(trajectories, start=1):
        columns = dict(zip(names, q[::thin].T, strict=True))
        write_csv(folder / f"demo_{number:02d}.csv", time[::thin], columns)
    text = json.dumps(truth | {"rate": truth["rate"] / thin}, indent=1)
    (folder / "truth.json").write_text(text + "\n", encoding="utf-8", newline="\n")


def main(arguments: list[str] | None = None) -> None:
    """Write all demonstrations and the truth."""
    parser = argparse.ArgumentParser(description="Record demonstrations of a task with a hand-guided arm.")
    parser.add_argument("kind", choices=KINDS, help="what is done")
    parser.add_argument("--robot", choices=ROBOTS, default="panda")
    parser.add_argument("--seed", type=int, default=1, help="below 1000 for development, from 1000 on for tests")
    parser.add_argument("--demos", type=int, default=6, help="number of demonstrations")
    parser.add_argument("--out", type=Path, required=True, help="folder for demo_01.csv ... and truth.json")
    parser.add_argument("--cut", action="store_true", help="record the contacts only")
    parser.add_argument("--thin", type=int, default=1, help="write every n-th of the 100 samples a second")
    parser.add_argument("--kinematic", action="store_true", help="without forces, and without MuJoCo")
    options = parser.parse_args(arguments)
    maker = importlib.import_module(f"make_recordings.{'kinematic' if options.kinematic else 'physics'}_sets")
    trajectories, truth = maker.make_set(
        options.kind, options.robot, options.seed, options.demos, whole=not options.cut
    )
    write_set(options.out, trajectories, truth, options.thin)


if __name__ == "__main__":
    main()
