"""Arguments and options of the command line that several commands share."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from manip_learn.commands.completion import (
    constraint_completions,
    frame_completions,
    print_version,
    robot_completions,
)

Version = Annotated[
    bool,
    typer.Option("--version", help="Show the version and exit.", callback=print_version, is_eager=True),
]
Explain = Annotated[bool, typer.Option("--explain", help="Explain the terms under the tables at length.")]
Json = Annotated[bool, typer.Option("--json", help="Print one JSON document and nothing else.")]
RobotName = Annotated[
    str,
    typer.Argument(metavar="ROBOT", help="A name (see `robots`) or a URDF file.", autocompletion=robot_completions),
]
GuidedFrame = Annotated[
    str | None,
    typer.Option(help="The frame that was guided, e.g. the tool's tip.", autocompletion=frame_completions),
]
SeenFrom = Annotated[
    str | None,
    typer.Option(help="Frame, e.g. an object, from which it is seen.", autocompletion=frame_completions),
]
Tip = Annotated[str | None, typer.Option(help="Frame whose path is drawn.", autocompletion=frame_completions)]
Recordings = Annotated[list[str], typer.Argument(metavar="RECORDING...", help="Files, or a folder of them.")]
ConstraintFile = Annotated[
    str,
    typer.Argument(metavar="CONSTRAINT.JSON", help="Written by `learn --out`.", autocompletion=constraint_completions),
]
Dask = Annotated[str | None, typer.Option(help="Scheduler address, or local: work on a dask cluster.")]
Exported = Annotated[list[str], typer.Argument(metavar="FILE...", help="Recordings or rollouts, or a folder of them.")]
ExportOut = Annotated[
    Path,
    typer.Option(help="A file (.mcap, .csv, .rrd, .yaml: a JointTrajectory), or a folder: LeRobot, or what --to says."),
]
ExportTo = Annotated[
    str | None, typer.Option(help="mcap, csv, lerobot, rrd or trajectory: format of the files in a folder.")
]
Rollouts = Annotated[list[str], typer.Argument(metavar="ROLLOUT...", help="Written by `control --out`; or recordings.")]
Start = Annotated[
    str | None,
    typer.Option(help="Joint positions [rad], e.g. 0.1,-0.5,0; default: the first posture that was shown."),
]
Target = Annotated[str | None, typer.Option(help="Point to go to, one value per axis [m or rad].")]
Phases = Annotated[
    str, typer.Option(help="auto: find the stretches in which a constraint holds; off: take recordings as a whole.")
]
Shown = Annotated[
    Path | None,
    typer.Option(
        help="Constraint file: show the phases and the mechanism that were learnt with it.",
        autocompletion=constraint_completions,
    ),
]
