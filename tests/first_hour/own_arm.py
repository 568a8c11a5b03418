"""An arm that no library knows, as URDF with package meshes and as xacro with an argument, as vendors ship it."""

from __future__ import annotations

import re
from pathlib import Path

import trimesh

URDF = Path(__file__).with_name("my_arm.urdf").read_text(encoding="utf-8")
NAMES = re.findall(r'<joint name="(\w+)" type="revolute">', URDF)
PACKAGE = "my_arm_description"
XACRO = '<robot xmlns:xacro="http://www.ros.org/wiki/xacro" name="my_arm"><xacro:arg name="fastest" default="2.0"/>'


def write_package(folder: Path) -> Path:
    """A ROS package with one binary STL mesh a link; its URDF, beside which there is the same as xacro."""
    package = folder / PACKAGE
    for inner in ("urdf", "meshes"):
        (package / inner).mkdir(parents=True)
    (package / "package.xml").write_text(f"<package format='3'><name>{PACKAGE}</name></package>\n", encoding="utf-8")
    for name in NAMES:
        trimesh.creation.box((0.05, 0.05, 0.2)).export(package / "meshes" / f"{name}.stl")
    urdf = package / "urdf" / "my_arm.urdf"
    urdf.write_text(URDF, encoding="utf-8")
    described = URDF.replace('<robot name="my_arm">', XACRO).replace('velocity="2.0"', 'velocity="$(arg fastest)"')
    urdf.with_suffix(".urdf.xacro").write_text(described, encoding="utf-8")
    return urdf
