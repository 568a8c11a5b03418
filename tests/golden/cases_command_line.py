"""Every number in the JSON answers of the commands."""

from __future__ import annotations

import contextlib
import io
import json
import runpy
import sys
import tempfile
from pathlib import Path
from unittest import mock

from cases_learning import recordings
from comparison import Cases, flat

# case -> arguments of `manip-learn`; {out} is a temporary folder
LEARN = {
    "learn drawer": (
        "sawyer",
        *recordings("sawyer_drawer", 12),
        "--frame",
        "right_gripper_tip",
        "--out",
        "{out}/drawer.json",
    ),
    "learn door": ("sawyer", *recordings("sawyer_door", 8), "--frame", "right_gripper_tip", "--axes", "pose"),
    "learn planar": (
        "planar3",
        *recordings("planar3_reach", 20),
        "--frame",
        "tip",
        "--axes",
        "x y",
        "--constraints",
        "2",
    )
    + ("--velocities", "recorded", "--estimator", "joint", "--reference", "world", "--out", "{out}/planar.json"),
}
CONTROL = {
    "control drawer": ("sawyer", "{out}/drawer.json", "--start", "0.3,-0.6,0.2,1.2,0.1,0.9,0.4")
    + ("--target", "0.6,0.27,0.35", "--rows", "held", "--duration", "2"),
    "control drawer, all rows": ("sawyer", "{out}/drawer.json", "--start", "0.3,-0.6,0.2,1.2,0.1,0.9,0.4")
    + ("--target", "0.6,0.27,0.35", "--duration", "2"),
    "control drawer, along": ("sawyer", "{out}/drawer.json", "--along", "0.2", "--direction", "0.91,0.42,0"),
    "control drawer, from elsewhere": ("sawyer", "{out}/drawer.json", "--start", "1.2,-1.57,0,0,0,0,0")
    + ("--along", "0.2", "--direction", "0.91,0.42,0", "--keep-orientation"),
    "control planar": ("planar3", "{out}/planar.json", "--start", "0.3,1.2,-0.4", "--target", "0.5,1.5")
    + ("--policy", "attractor", "--rest", "0.2,0.5,0.1", "--duration", "2"),
    "control planar zero": ("planar3", "{out}/planar.json", "--start", "0.3,1.2,-0.4", "--target", "0.5,1.5")
    + ("--policy", "zero", "--inverse", "exact", "--duration", "1"),
}


def command_line_cases() -> Cases:
    """Case -> the flattened answer."""
    with tempfile.TemporaryDirectory() as out:
        asked = {name: ("learn", *rest) for name, rest in LEARN.items()}
        asked |= {name: ("control", *rest) for name, rest in CONTROL.items()}
        asked |= {f"inspect {robot}": ("inspect", robot) for robot in ("planar3", "sawyer", "panda")}
        asked |= {
            f"demo {robot}": ("demo", "--no-browser", "--robot", robot, "--out", f"{{out}}/{robot}")
            for robot in ("sawyer", "planar3")
        }
        return {
            f"manip-learn {name}": flat(answer([a.replace("{out}", out) for a in arguments]))
            for name, arguments in asked.items()
        }


def answer(arguments: list[str]) -> dict:
    """What `python -m manip_learn ... --json` prints, without the start of another Python."""
    printed = io.StringIO()
    argv = [str(Path(sys.executable)), *arguments, "--json"]
    with mock.patch.object(sys, "argv", argv), contextlib.redirect_stdout(printed):
        try:
            runpy.run_module("manip_learn", run_name="__main__", alter_sys=False)
        except SystemExit as ended:
            if ended.code not in (0, None):
                raise RuntimeError(f"manip-learn {' '.join(arguments)} ended with {ended.code}") from ended
    return json.loads(printed.getvalue())
