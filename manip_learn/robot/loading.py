"""Names and files -> Robot."""

from __future__ import annotations

import hashlib
import importlib.metadata
from collections.abc import Sequence
from pathlib import Path

import pinocchio as pin

from manip_learn.errors import RobotError
from manip_learn.robot.robot import Robot


def load_robot(name: str | Path, package_dirs: Sequence[str | Path] = (), locked: Sequence[str] = ()) -> Robot:
    """First version: the gate, mimic joints and mesh folders are still to come."""
    path = Path(name)
    if not path.suffix:
        here = Path(__file__).resolve().parents[2] / "robots" / f"{name}.urdf"
        files = [Path(str(f.locate())) for f in importlib.metadata.files("example-robot-data") or []]
        path = here if here.exists() else next((f for f in files if f.name == f"{name}.urdf"), path)
    if not path.is_file():
        raise RobotError(f"no robot {name}", code="missing")
    model = pin.buildModelFromUrdf(str(path))
    if locked:
        model = pin.buildReducedModel(model, [model.getJointId(j) for j in locked], pin.neutral(model))
    digest = hashlib.sha256(path.read_bytes() + repr(sorted(locked)).encode()).hexdigest()
    return Robot(model, name=model.name, source=path, fingerprint=digest)
