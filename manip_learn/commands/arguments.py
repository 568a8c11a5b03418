"""Arguments and options of the command line that several commands share."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

Json = Annotated[bool, typer.Option("--json", help="Print one JSON document and nothing else.")]
RobotName = Annotated[str, typer.Argument(metavar="ROBOT", help="A name (sawyer, planar3, panda, ...) or a URDF file.")]
Recordings = Annotated[list[str], typer.Argument(metavar="RECORDING...", help="Files, or a folder of them.")]
ConstraintFile = Annotated[str, typer.Argument(metavar="CONSTRAINT.JSON", help="Written by `learn --out`.")]
Dask = Annotated[str | None, typer.Option(help="Scheduler address, or local: work on a dask cluster.")]
Exported = Annotated[list[str], typer.Argument(metavar="FILE...", help="Recordings or rollouts, or a folder of them.")]
ExportOut = Annotated[
    Path,
    typer.Option(help="A file (.mcap, .csv, .yaml: a JointTrajectory), or a folder: LeRobot, or what --to says."),
]
ExportTo = Annotated[
    str | None, typer.Option(help="mcap, csv, lerobot or trajectory: format of the files in a folder.")
]
Rollouts = Annotated[list[str], typer.Argument(metavar="ROLLOUT...", help="Written by `control --out`; or recordings.")]
Start = Annotated[str | None, typer.Option(help="Joint positions [rad], e.g. 0.1,-0.5,0; default: the rest posture.")]
Target = Annotated[str | None, typer.Option(help="Target position, one value per axis (default: hold still).")]
Phases = Annotated[
    str, typer.Option(help="auto: find the stretches in which a constraint holds; off: take recordings as a whole.")
]
Shown = Annotated[
    Path | None, typer.Option(help="Constraint file: show the phases and the mechanism that were learnt with it.")
]
