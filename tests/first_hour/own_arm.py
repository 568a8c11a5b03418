"""An arm that no library knows, as URDF with package meshes and as xacro with an argument, as vendors ship it."""

from __future__ import annotations

from pathlib import Path

import trimesh

# joint, axis, where it sits on the link before it, length of the link that it moves [m]
JOINTS = (
    ("base_yaw", "0 0 1", "0 0 0.12", 0.18),
    ("shoulder", "0 1 0", "0 0 0.18", 0.40),
    ("elbow", "0 1 0", "0 0 0.40", 0.36),
    ("wrist_roll", "0 0 1", "0 0 0.36", 0.10),
    ("wrist_pitch", "0 1 0", "0 0 0.10", 0.09),
    ("wrist_yaw", "0 0 1", "0 0 0.09", 0.07),
)
NAMES = [name for name, *_ in JOINTS]
PACKAGE = "my_arm_description"
XACRO = '<robot xmlns:xacro="http://www.ros.org/wiki/xacro" name="my_arm"><xacro:arg name="fastest" default="2.0"/>'


def write_package(folder: Path) -> Path:
    """A ROS package with one binary STL mesh a link; its URDF, beside which there is the same as xacro."""
    package = folder / PACKAGE
    for inner in ("urdf", "meshes"):
        (package / inner).mkdir(parents=True)
    (package / "package.xml").write_text(f"<package format='3'><name>{PACKAGE}</name></package>\n", encoding="utf-8")
    text, parent = '<robot name="my_arm"><link name="base_link"/>', "base_link"
    for name, axis, origin, length in JOINTS:
        box = trimesh.creation.box((0.05, 0.05, length))
        box.apply_translation((0.0, 0.0, length / 2)).export(package / "meshes" / f"{name}.stl")
        mesh = f"package://{PACKAGE}/meshes/{name}.stl"
        text += (
            f'<link name="{name}_link"><visual><geometry><mesh filename="{mesh}"/></geometry></visual></link>'
            f'<joint name="{name}" type="revolute"><parent link="{parent}"/><child link="{name}_link"/>'
            f'<origin xyz="{origin}"/><axis xyz="{axis}"/>'
            '<limit lower="-2.9" upper="2.9" velocity="2.0" effort="80"/></joint>'
        )
        parent = f"{name}_link"
    text += (
        f'<link name="tool0"/><joint name="flange" type="fixed"><parent link="{parent}"/><child link="tool0"/>'
        f'<origin xyz="0 0 {JOINTS[-1][3]}"/></joint></robot>\n'
    )
    urdf = package / "urdf" / "my_arm.urdf"
    urdf.write_text(text, encoding="utf-8")
    described = text.replace('<robot name="my_arm">', XACRO).replace('velocity="2.0"', 'velocity="$(arg fastest)"')
    urdf.with_suffix(".urdf.xacro").write_text(described, encoding="utf-8")
    return urdf
