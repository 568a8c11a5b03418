"""A scripted first hour: someone with an arm, its description and recordings, from installation to a replay.

    python tests/first_hour/hour.py FOLDER          (in an environment in which the wheel and its extras are installed)

Each step is what a user would type. A refusal is no dead end if it names the flags that help: they are taken from its
text and typed. Everything else that does not lead on is counted, printed, and fails the run.
"""

from __future__ import annotations

import json
import re
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import nbformat
import numpy as np
from nbclient import NotebookClient
from own_arm import NAMES, write_package
from recordings import FREE, motions, write_bag

import manip_learn as ml

MANIP_LEARN = str(Path(sys.executable).with_name("manip-learn"))
CLOSE = 1.0  # largest angle between the learnt and the true free direction [deg]
ADVICE = re.compile(r"(--[a-z][a-z-]+(?: (?!--)'[^']+'| (?!--)[^\s;,)'`]+)?)")
FRAME = ("--frame", "tool0")
START, TARGET = "0.3,0.5,1.2,0.2,0.8,0", "0.4,0.3,0.5"


@dataclass
class Hour:
    """What happened, step by step."""

    folder: Path
    dead_ends: list[str] = field(default_factory=list)

    def type(self, title: str, *arguments: str, check: Callable[[str], str] = lambda out: "") -> str:
        """One command, once more with the advice of its refusal; `check` says what is wrong with its output."""
        done, advised = self._run(arguments), ""
        if done.returncode == 2:
            flags = [part for found in ADVICE.findall(done.stderr) for part in found.replace("'", "").split(" ", 1)]
            advised = f" (refused; its advice: {' '.join(flags)})" if flags else ""
            done = self._run((*arguments, *flags)) if flags else done
        said = done.stdout + done.stderr
        wrong = said.strip()[-600:] if done.returncode else check(done.stdout)
        if "Traceback" in said:
            wrong = said[-600:]
        self.note(title + advised, wrong)
        return done.stdout

    def note(self, title: str, wrong: str) -> None:
        print(f"{'DEAD END' if wrong else 'ok':9s}{title}", flush=True)
        if wrong:
            print("         " + wrong.replace("\n", "\n         "), flush=True)
            self.dead_ends.append(title)

    def _run(self, arguments: tuple[str, ...]) -> subprocess.CompletedProcess[str]:
        command = [MANIP_LEARN, *arguments]
        return subprocess.run(command, cwd=self.folder, capture_output=True, text=True, timeout=300, check=False)


def learns_the_line(out: str) -> str:
    """Empty if the free direction is the true one, within a degree."""
    free = json.loads(out)["free_directions"]
    if len(free) != 1:
        return f"{len(free)} free directions were found, there is 1"
    angle = np.degrees(np.arccos(min(1.0, abs(float(np.dot(free[0][:3], FREE))))))
    return "" if angle < CLOSE else f"the free direction is {angle:.2g} degrees off"


def six_joints(out: str) -> str:
    """Empty if the six joints are those of the arm."""
    names = [joint["name"] for joint in json.loads(out)["joints"]]
    return "" if names == NAMES else f"the joints are {names}"


def describe_the_arm(hour: Hour, urdf: str) -> None:
    found = hour.type("own URDF with package meshes", "inspect", urdf, "--json", check=six_joints)
    warnings = json.loads(found)["warnings"] if found else []
    hour.note("its meshes are found", "\n".join(warnings))
    hour.type("the same as xacro", "inspect", f"{urdf}.xacro", "--json", check=six_joints)
    slower = ("--xacro", "--xacro-arg", "fastest=1.0")
    hour.type("xacro with an argument", "inspect", f"{urdf}.xacro", *slower, "--json", check=six_joints)


def learn_from_files(hour: Hour, urdf: str) -> None:
    (hour.folder / "bags").mkdir()
    for i, demo in enumerate(motions(ml.load_robot(urdf))):
        write_bag(hour.folder / "bags" / f"demo_{i}", demo)
    hour.type("learn from bags", "learn", urdf, "bags", *FRAME, "--json", check=learns_the_line)
    hour.type("bags to LeRobot data", "export", urdf, "bags", "--to", "lerobot", "--out", "lerobot")
    hour.type("learn from LeRobot data", "learn", urdf, "lerobot", *FRAME, "--json", check=learns_the_line)
    out = ("--out", "line.json", "--html", "recordings.html")
    words = " ".join(hour.type("learn in words", "learn", urdf, "bags", *FRAME, *out).split())
    hour.note("it says what is free", "" if "The tip can move along (0.80, 0.60, 0.00)" in words else words)


def does_the_way(out: str) -> str:
    """Empty if the whole way was done, to a millimetre, and within 2 mm of the line."""
    answer = json.loads(out)
    wrong = abs(answer["done"] - answer["wanted"]) > 1e-3 or answer["deviation"] > 2e-3
    return f"{answer['sentence']}, {answer['stopped_by']}, {answer['deviation']} m off" if wrong else ""


def control_and_replay(hour: Hour, urdf: str) -> None:
    motion = ("--start", START, "--target", TARGET, "--duration", "3", "--out", "run.npz")
    hour.type("control", "control", urdf, "line.json", *motion)
    there = ("control", urdf, "line.json", "--along", "0.1", "--json")
    way = hour.type("open what was learnt", *there, "--out", "run.npz", check=does_the_way)
    hour.note("it says how far", "" if way and " 0.100 of 0.100 m" in way else way)
    hour.type("the same from elsewhere", *there, "--start", START, check=does_the_way)
    hour.type("replay", "replay", urdf, "run.npz", "--html", "run.html")
    hour.type("replay of the bags", "replay", urdf, "bags", "--constraint", "line.json", "--html", "bags.html")
    for page in ("recordings.html", "run.html", "bags.html"):
        hour.note(f"{page} is there", "" if (hour.folder / page).is_file() else "it was not written")
    hour.type("audit", "audit", urdf, "line.json", "bags")


def work_in_a_notebook(hour: Hour, urdf: str) -> None:
    cells = [
        f"import manip_learn as ml\nrobot = ml.load_robot({urdf!r})\nrobot",
        "demos = ml.load_demonstrations('bags', robot)\ndemos",
        "learner = ml.ConstraintLearner(ml.FrameJacobian(robot, 'tool0', 'xyz'))\n"
        "learner.fit([(demo.time, demo.q) for demo in demos])\nlearner.report_",
        f"task = ml.PointAttractor([{TARGET}])\n"
        "controller = ml.ResolvedRateController(learner.constraint_, task=task)\n"
        f"rollout = ml.simulate(robot, controller, [{START}], duration=2.0, dt=0.01)\nrollout",
        "ml.replay(robot, rollout, html='notebook.html', open_browser=False)",
    ]
    notebook = nbformat.v4.new_notebook(cells=[nbformat.v4.new_code_cell(cell) for cell in cells])
    wrong = ""
    try:
        NotebookClient(notebook, timeout=120, resources={"metadata": {"path": hour.folder}}).execute()
        shown: list[Any] = [out for cell in notebook.cells for out in cell.outputs if "data" in out]
        wrong = "" if sum("text/html" in out.data for out in shown) == len(cells) else "a cell shows nothing"
    except RuntimeError as error:  # what a cell raised
        wrong = str(error)
    hour.note("a notebook", wrong)


def main() -> int:
    """The hour; 1 if it has dead ends."""
    hour = Hour(Path(sys.argv[1]).resolve())
    hour.folder.mkdir(parents=True, exist_ok=True)
    urdf = str(write_package(hour.folder))
    for part in (describe_the_arm, learn_from_files, control_and_replay, work_in_a_notebook):
        part(hour, urdf)
    print(f"{len(hour.dead_ends)} dead ends")
    return int(bool(hour.dead_ends))


if __name__ == "__main__":
    sys.exit(main())
