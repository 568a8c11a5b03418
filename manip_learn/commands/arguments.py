"""Arguments and options of the command line that several commands share."""

from __future__ import annotations

from typing import Annotated

import typer

Json = Annotated[bool, typer.Option("--json", help="Print one JSON document and nothing else.")]
RobotName = Annotated[str, typer.Argument(metavar="ROBOT", help="A name (sawyer, planar3, panda, ...) or a URDF file.")]
Lock = Annotated[list[str] | None, typer.Option("--lock", help="Joint to hold still; may be given several times.")]
Packages = Annotated[list[str] | None, typer.Option("--package-dir", help="Folder that contains mesh packages.")]
Recordings = Annotated[list[str], typer.Argument(metavar="RECORDING...", help="Files, or a folder of them.")]
ConstraintFile = Annotated[str, typer.Argument(metavar="CONSTRAINT.JSON", help="Written by `learn --out`.")]
Dask = Annotated[str | None, typer.Option(help="Scheduler address, or local: work on a dask cluster.")]
