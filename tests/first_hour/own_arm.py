"""An arm that no library knows, as URDF with package meshes, as xacro and as MJCF."""

from __future__ import annotations

import struct
from pathlib import Path

# joint, axis, where it sits on the link before it, length of the link that it moves [m]
JOINTS = (
    ("base_yaw", "0 0 1", "0 0 0.12", 0.18),
    ("shoulder", "0 1 0", "0 0 0.18", 0.40),
    ("elbow", "0 1 0", "0 0 0.40", 0.36),
    ("wrist_roll", "0 0 1", "0 0 0.36", 0.10),
    ("wrist_pitch", "0 1 0", "0 0 0.10", 0.09),
    ("wrist_yaw", "0 0 1", "0 0 0.09", 0.07),
)
NAMES = tuple(name for name, *_ in JOINTS)
PACKAGE = "my_arm_description"


def write_package(folder: Path) -> Path:
    """A ROS package with URDF, xacro and one binary STL mesh a link; its folder."""
    package = folder / PACKAGE
    for inner in ("urdf", "meshes", "mjcf"):
        (package / inner).mkdir(parents=True)
    (package / "package.xml").write_text(f"<package format='3'><name>{PACKAGE}</name></package>\n", encoding="utf-8")
    for name, _, _, length in JOINTS:
        (package / "meshes" / f"{name}.stl").write_bytes(_box_stl(0.05, 0.05, length))
    (package / "urdf" / "my_arm.urdf").write_text(_urdf(), encoding="utf-8")
    (package / "urdf" / "my_arm.urdf.xacro").write_text(_xacro(), encoding="utf-8")
    (package / "mjcf" / "my_arm.xml").write_text(_mjcf(), encoding="utf-8")
    return package


def _urdf() -> str:
    links = ['<link name="base_link"/>']
    parent = "base_link"
    for name, axis, origin, _ in JOINTS:
        mesh = f"package://{PACKAGE}/meshes/{name}.stl"
        links.append(
            f'<link name="{name}_link"><visual><geometry><mesh filename="{mesh}"/></geometry></visual></link>'
            f'<joint name="{name}" type="revolute"><parent link="{parent}"/><child link="{name}_link"/>'
            f'<origin xyz="{origin}"/><axis xyz="{axis}"/>'
            '<limit lower="-2.9" upper="2.9" velocity="2.0" effort="80"/></joint>'
        )
        parent = f"{name}_link"
    links.append(
        f'<link name="tool0"/><joint name="flange" type="fixed"><parent link="{parent}"/><child link="tool0"/>'
        f'<origin xyz="0 0 {JOINTS[-1][3]}"/></joint>'
    )
    return '<robot name="my_arm">\n' + "\n".join(links) + "\n</robot>\n"


def _xacro() -> str:
    """The same arm with an argument, as vendors ship it."""
    urdf = (
        _urdf()
        .replace('<robot name="my_arm">', "")
        .replace("</robot>", "")
        .replace('velocity="2.0"', 'velocity="$(arg fastest)"')
    )
    return (
        '<robot xmlns:xacro="http://www.ros.org/wiki/xacro" name="my_arm">\n'
        f'<xacro:arg name="fastest" default="2.0"/>\n{urdf}</robot>\n'
    )


def _mjcf() -> str:
    """The same kinematics for MuJoCo."""
    opened = closed = ""
    for name, axis, origin, length in JOINTS:
        opened += (
            f'<body name="{name}_link" pos="{origin}">'
            f'<joint name="{name}" type="hinge" axis="{axis}" limited="true" range="-2.9 2.9"/>'
            f'<geom type="capsule" size="0.03" fromto="0 0 0 0 0 {length}"/>'
        )
        closed += "</body>"
    site = f'<body name="tool0" pos="0 0 {JOINTS[-1][3]}"><geom type="sphere" size="0.01"/></body>'
    return (
        '<mujoco model="my_arm"><compiler angle="radian"/><worldbody><body name="base_link">'
        f"{opened}{site}{closed}</body></worldbody></mujoco>\n"
    )


def _box_stl(x: float, y: float, z: float) -> bytes:
    """A box from 0 to z with the z axis through its middle: 12 triangles, 684 bytes."""
    corner = [(i * x / 2, j * y / 2, k * z) for i in (-1, 1) for j in (-1, 1) for k in (0, 1)]
    squares = ((0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3))
    triangles = [t for a, b, c, d in squares for t in ((a, b, c), (a, c, d))]
    content = bytes(80) + struct.pack("<I", len(triangles))
    for triangle in triangles:
        content += struct.pack("<12fH", 0, 0, 0, *(value for i in triangle for value in corner[i]), 0)
    return content
