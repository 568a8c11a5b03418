"""MJCF shapes -> `<visual>` elements of a URDF."""

from __future__ import annotations

from xml.sax.saxutils import quoteattr

import numpy as np
import pinocchio as pin

from manip_learn.errors import RobotError
from manip_learn.robot.description.diagnostics import GateLog
from manip_learn.robot.description.mjcf_pose import MjcfUnits, pose_of
from manip_learn.robot.description.pose_matrix import Matrix, as_pose
from manip_learn.robot.description.urdf_numbers import vector
from manip_learn.robot.description.xml_node import XmlNode

COLLISION_GROUPS = ("3", "4", "5")


def mesh_files(root: XmlNode) -> dict[str, XmlNode]:
    """Mesh assets by name; without a name a mesh has that of its file."""
    meshes: dict[str, XmlNode] = {}
    for node in (m for asset in root.all("asset") for m in asset.all("mesh")):
        file = node.attributes.get("file", "")
        name = node.attributes.get("name") or file.replace("\\", "/").rpartition("/")[2].rpartition(".")[0]
        meshes[name] = node
    return meshes


def geom_visual(geom: XmlNode, units: MjcfUnits, meshes: dict[str, XmlNode], log: GateLog) -> str:
    """The shape as URDF text; empty for what is not drawn (planes, fields, collision groups) or not readable."""
    if geom.attributes.get("group", "0") in COLLISION_GROUPS:
        return ""
    try:
        shape, T = _shape(geom, units, meshes, log)
        colour = vector(geom, "rgba", 4, "geom", log)
    except RobotError:
        return ""
    if not shape:
        return ""
    pose = as_pose(T)
    xyz, rpy = (" ".join(repr(c) for c in v) for v in (pose.xyz, pose.rpy))
    rgba = "" if colour is None else f'<material name=""><color rgba="{" ".join(map(repr, colour))}"/></material>'
    return f'<visual><origin xyz="{xyz}" rpy="{rpy}"/><geometry>{shape}</geometry>{rgba}</visual>'


def _shape(geom: XmlNode, units: MjcfUnits, meshes: dict[str, XmlNode], log: GateLog) -> tuple[str, Matrix]:
    kind = geom.attributes.get("type", "mesh" if "mesh" in geom.attributes else "sphere")
    if kind == "mesh":
        return _mesh(geom, units, meshes, log)
    words = geom.attributes.get("size", "").split()
    size = list(vector(geom, "size", len(words), "geom", log) or ()) + [0.0] * 3
    T = pose_of(geom, units, "geom", log)
    half = size[1]
    if "fromto" in geom.attributes:
        ends = np.array(vector(geom, "fromto", 6, "geom", log))
        along = ends[3:] - ends[:3]
        T, half = np.eye(4), 0.5 * float(np.linalg.norm(along))
        T[:3, :3] = pin.Quaternion.FromTwoVectors(np.array([0.0, 0.0, 1.0]), along).toRotationMatrix()
        T[:3, 3] = 0.5 * (ends[:3] + ends[3:])
        size[2] = half
    shapes = {
        "sphere": f'<sphere radius="{size[0]!r}"/>',
        "capsule": f'<capsule radius="{size[0]!r}" length="{2 * half!r}"/>',
        "cylinder": f'<cylinder radius="{size[0]!r}" length="{2 * half!r}"/>',
        "box": f'<box size="{2 * size[0]!r} {2 * size[1]!r} {2 * size[2]!r}"/>',
        "ellipsoid": f'<box size="{2 * size[0]!r} {2 * size[1]!r} {2 * size[2]!r}"/>',
    }
    return shapes.get(kind, ""), T


def _mesh(geom: XmlNode, units: MjcfUnits, meshes: dict[str, XmlNode], log: GateLog) -> tuple[str, Matrix]:
    asset = meshes.get(geom.attributes.get("mesh", ""))
    if asset is None or "file" not in asset.attributes:
        return "", np.eye(4)
    scale = vector(asset, "scale", 3, "mesh", log) or (1.0, 1.0, 1.0)
    folder = f"{units.meshdir.rstrip('/')}/" if units.meshdir else ""
    file = quoteattr(folder + asset.attributes["file"])
    T = pose_of(geom, units, "geom", log)
    return f'<mesh filename={file} scale="{" ".join(map(repr, scale))}"/>', T
