"""Read MJCF files as the links and joints that a URDF would have.

Pinocchio's own reader silently garbles some files, and MuJoCo's reader needs the meshes. This reader needs no meshes,
and its errors name the line at fault.
"""

from __future__ import annotations

import math
from collections.abc import Collection
from dataclasses import replace
from pathlib import PureWindowsPath
from typing import Any
from xml.sax.saxutils import quoteattr

import numpy as np
import pinocchio as pin
from jaxtyping import Float

from manip_learn.errors import RobotError
from manip_learn.robot.description import urdf
from manip_learn.robot.description.text import XmlNode, shorten
from manip_learn.robot.description.urdf import ZERO, Matrix4, UrdfJoint, UrdfLink, as_pose, near_vector, read_name
from manip_learn.robot.joints import Mimic

WORLD, MAIN = "world", "main"
ORIENTATIONS = {"quat": 4, "axisangle": 4, "euler": 3, "xyaxes": 6, "zaxis": 3}  # size of each
TYPES = {"hinge": "revolute", "slide": "prismatic"}
Attributes = dict[str, dict[str, str]]


def read_defaults(root: XmlNode) -> dict[str, Attributes]:
    """Read the default attributes of each class, with inherited ones.

    Args:
        root: Root element of the file.

    Returns:
        Nested dictionaries: class -> tag -> attributes. The outermost class is `main`.
    """
    classes: dict[str, Attributes] = {MAIN: {}}
    pending = [(top, top.attributes.get("class", MAIN), MAIN) for top in root.all("default")]
    for node, name, outer in pending:  # the list grows during the loop
        defaults = dict(classes[outer])
        for child in node.children:
            if child.tag in ("joint", "geom", "site", "mesh"):
                defaults[child.tag] = defaults.get(child.tag, {}) | child.attributes
        classes |= {name: defaults, MAIN: defaults} if node.parent is root else {name: defaults}
        pending += [(inner, inner.attributes.get("class", ""), name) for inner in node.all("default")]
    return classes


def turn_z_to(direction: Float[np.ndarray, " 3"]) -> Float[np.ndarray, "3 3"]:
    """Return the smallest rotation that turns the z axis into a direction.

    Args:
        direction: Vector (3,) of any length.

    Returns:
        Rotation matrix (3, 3).
    """
    return pin.Quaternion.FromTwoVectors(np.array([0.0, 0.0, 1.0]), direction).toRotationMatrix()


class _Reader:
    """Reads bodies, joints and sites in file order; the world comes first.

    Attributes:
        links: Links read so far.
        joints: Joints read so far, in file order.
        visuals: Link -> `<visual>` and `<collision>` elements of a URDF.
        ref: Joint -> value in the pose that the file describes [rad or m].
        angle: Factor from the file's angles to rad.
        eulerseq: Axes of Euler angles; small letters rotate with the body, capitals do not.
    """

    def __init__(self, root: XmlNode, scene: bool = False):
        self.scene, self.settings, self.classes = scene, dict[str, str](), read_defaults(root)
        for node in root.all("compiler"):
            self.settings |= node.attributes
        angle, self.eulerseq = self.settings.get("angle", "degree"), self.settings.get("eulerseq", "xyz")
        coordinate = self.settings.get("coordinate", "local")
        is_known = angle in ("degree", "radian") and len(self.eulerseq) == 3 and not set(self.eulerseq) - set("xyzXYZ")
        if not is_known or coordinate != "local":
            finding = f"<compiler>: angle={angle!r}, eulerseq={self.eulerseq!r}, coordinate={coordinate!r}"
            fix = "degree or radian, three axes, and local are supported; correct them, or save the file with MuJoCo"
            raise root.log.refusal("mjcf-compiler", root.all("compiler")[0].line, f"{finding}; {fix}")
        self.angle = math.pi / 180.0 if angle == "degree" else 1.0
        assets = [self._full(mesh, MAIN) for asset in root.all("asset") for mesh in asset.all("mesh")]
        # a mesh without a name has the name of its file, with slashes or backslashes before it
        stems = [PureWindowsPath(mesh.attributes.get("file", "")).stem for mesh in assets]
        self.meshes = {mesh.attributes.get("name") or stem: mesh for mesh, stem in zip(assets, stems, strict=True)}
        self.links, self.joints = [UrdfLink(WORLD, root)], list[UrdfJoint]()
        self.visuals, self.ref = dict[str, list[str]](), dict[str, float]()
        for world in root.all("worldbody"):
            self._read_inside(world)
        self._couple(root)

    def _full(self, node: XmlNode, childclass: str) -> XmlNode:
        """Return the element with the attributes of its class; `childclass` is the class of the body around it."""
        name = node.attributes.get("class", childclass)
        node.require(name in self.classes, "mjcf-class", tag=node.tag, name=name)
        return replace(node, attributes=self.classes[name].get(node.tag, {}) | node.attributes)

    def _pose(self, node: XmlNode) -> Matrix4:
        """Return the pose of an element relative to the body around it [m].

        Raises:
            RobotError: Codes `number`, `not-finite`, `vector-size`, `far-away`, `mjcf-orientation`.
        """
        T = np.eye(4)
        T[:3, 3] = near_vector(node, "pos")
        kinds = [key for key in ORIENTATIONS if key in node.attributes]
        finding = f"its orientation is given by {' and '.join(kinds)}"
        node.require(len(kinds) <= 1, "mjcf-orientation", seen=finding, fix="delete the others")
        for kind in kinds:
            T[:3, :3] = self._rotation(kind, np.array(node.vector(kind, ORIENTATIONS[kind])), node)
        return T

    def _rotation(self, kind: str, numbers: np.ndarray, node: XmlNode) -> Float[np.ndarray, "3 3"]:
        """Return the rotation matrix of an orientation attribute."""
        if kind == "euler":
            R = np.eye(3)
            for letter, angle in zip(self.eulerseq, numbers * self.angle, strict=True):
                rotation = pin.exp3(angle * np.eye(3)["xyz".index(letter.lower())])
                R = R @ rotation if letter.islower() else rotation @ R
            return R
        direction = numbers[:3] if kind == "axisangle" else numbers
        if kind == "xyaxes":
            direction = np.cross(numbers[:3], numbers[3:])
        length = float(np.linalg.norm(direction))
        finding = f"{kind} {numbers.tolist()} gives no direction"
        node.require(length >= 1e-9, "mjcf-orientation", seen=finding, fix="correct it")
        if kind == "quat":
            w, x, y, z = numbers / length
            return pin.Quaternion(w, x, y, z).toRotationMatrix()
        if kind == "axisangle":
            return pin.exp3(numbers[3] * self.angle * direction / length)
        if kind == "zaxis":
            return turn_z_to(direction / length)
        x, z = numbers[:3] / np.linalg.norm(numbers[:3]), direction / length
        return np.column_stack([x, np.cross(z, x), z])

    def _read_inside(self, world: XmlNode) -> None:
        """Read the sites, shapes and bodies of the world, then those of each body."""
        pending = [(world, WORLD, MAIN)]
        for node, link, childclass in pending:  # the list grows during the loop
            for site in [self._full(s, childclass) for s in node.all("site")]:
                if site.attributes.get("name") and "fromto" not in site.attributes:
                    name = read_name(site)
                    frame = f"{name}_site" if name in {entry.name for entry in self.links} else name
                    self.links.append(UrdfLink(frame, site))
                    pose = as_pose(self._pose(site))
                    self.joints.append(UrdfJoint(f"{frame}__fixed", site, "fixed", link, frame, pose))
            geoms = node.all("geom") if link != WORLD or self.scene else []
            self.visuals.setdefault(link, []).extend(self._shapes([self._full(geom, childclass) for geom in geoms]))
            for body in node.all("body"):
                inner = body.attributes.get("childclass", childclass)
                name = read_name(body) if body.attributes.get("name") else f"body_{body.line}"
                self._body(body, name, link, inner)
                pending.append((body, name, inner))

    def _body(self, body: XmlNode, name: str, parent: str, childclass: str) -> None:
        """Read a body with its inertia and its joints."""
        T, link = self._pose(body), UrdfLink(name, body)
        nodes = [c for c in body.children if c.tag in ("joint", "freejoint")]
        if (inertial := body.first("inertial")) is not None:
            pose, mass = as_pose(self._pose(inertial)), inertial.number("mass", 0.0)
            inertial.require(mass >= 0.0, "mass", mass=mass)
            diagonal = inertial.vector("diaginertia", 3) or ZERO
            xx, yy, zz, xy, xz, yz = inertial.vector("fullinertia", 6) or (*diagonal, 0.0, 0.0, 0.0)
            link = UrdfLink(name, body, (xx, xy, xz, yy, yz, zz), mass, pose)
        if not nodes:
            self.joints.append(UrdfJoint(f"{name}_fixed", body, "fixed", parent, name, as_pose(T)))
        for i, node in enumerate(nodes):
            unnamed = f"{name}_joint" if len(nodes) == 1 else f"{name}_joint{i}"
            joint_name = read_name(node) if node.attributes.get("name") else unnamed
            full = self._full(node, childclass) if node.tag == "joint" else node
            full = replace(full, attributes=full.attributes | {"name": joint_name})
            anchor, is_last = full.vector("pos", 3) or ZERO, i == len(nodes) - 1
            child = name if is_last and not any(anchor) else f"{name}__after_{joint_name}"
            joint = UrdfJoint(joint_name, full, "floating", parent, child)
            if node.tag == "freejoint" or full.attributes.get("type") == "free":
                T = np.eye(4)  # its coordinates are the pose of the body in the world
            else:
                joint, T = self._complete_joint(joint, T, anchor)
            self.joints.append(joint)
            if child != name:
                self.links.append(UrdfLink(child, body))
            if child != name and is_last:
                after = f"{name}__from_{joint_name}"
                self.joints.append(UrdfJoint(after, body, "fixed", child, name, as_pose(T)))
            parent = child
        self.links.append(link)

    def _complete_joint(self, joint: UrdfJoint, T: Matrix4, anchor: tuple[float, ...]) -> tuple[UrdfJoint, Matrix4]:
        """Complete a joint at a pose in its parent; also return the pose of the next joint in its child."""
        node, kind = joint.node, joint.node.attributes.get("type", "hinge")
        if kind not in TYPES:
            fix = "replace it by three hinges" if kind == "ball" else "correct the type"
            finding = f"its type is {shorten(kind)!r}; hinge, slide or free is expected"
            raise node.refusal("joint-type", f"{finding}; {fix}")
        axis = urdf.unit_axis(node.vector("axis", 3) or (0.0, 0.0, 1.0), node)
        scale = self.angle if kind == "hinge" else 1.0
        self.ref[joint.name] = ref = node.number("ref", 0.0) * scale
        to_anchor, back, zero = np.eye(4), np.eye(4), urdf.motion_along(TYPES[kind], axis, -ref)
        to_anchor[:3, 3], back[:3, 3] = anchor, [-c for c in anchor]
        ends, limited = node.vector("range", 2), node.attributes.get("limited", "auto")
        if limited == "false" or (limited != "true" and self.settings.get("autolimits") == "false"):
            ends = None
        elif ends is not None and limited != "true" and ends[0] >= ends[1]:
            if any(ends):  # 0 0 cancels the range of a class
                node.warn(f"its range {ends[0]:g} ... {ends[1]:g} is ignored, as in MuJoCo; swap the two for a limit")
            ends = None
        lower, upper = (-math.inf, math.inf) if ends is None else (ends[0] * scale, ends[1] * scale)
        limit, pose = urdf.UrdfLimit(lower, upper, math.inf), as_pose(T @ to_anchor @ zero)
        return joint._replace(type=TYPES[kind], pose=pose, axis=axis, limit=limit), back

    def _shapes(self, geoms: list[XmlNode]) -> list[str]:
        """Return the shapes of a body as URDF text: drawn ones, and collision shapes, or else the drawn ones again.

        Planes, fields and unreadable shapes are left out. In a scene, only the shapes that can be touched count.
        """
        touched = [g for g in geoms if any(g.attributes.get(c) != "0" for c in ("contype", "conaffinity"))]
        drawn = [g for g in geoms if g.attributes.get("group", "0") not in ("3", "4", "5")]  # not of collision groups
        shapes = {"visual": touched} if self.scene else {"visual": drawn, "collision": touched or drawn}
        return [self._element(tag, geom) for tag, some in shapes.items() for geom in some]

    def _element(self, tag: str, geom: XmlNode) -> str:
        """Return a shape as an element of a URDF; in a robot, an empty text for an unreadable shape."""
        try:
            shape, T = self._shape(geom)
            colour = geom.vector("rgba", 4)
        except RobotError:
            if self.scene:
                raise
            return ""
        rgba = "" if colour is None else f'<material name=""><color rgba="{urdf.join_numbers(colour)}"/></material>'
        head = f"<{tag} name={quoteattr(geom.attributes.get('name', ''))}>{urdf.origin_text(as_pose(T))}"
        return f"{head}<geometry>{shape}</geometry>{rgba}</{tag}>"

    def _shape(self, geom: XmlNode) -> tuple[str, Matrix4]:
        """Return a shape as URDF text, and its pose in the body."""
        T = self._pose(geom)
        # a mesh with another type, to which MuJoCo would fit a primitive, stays a mesh
        kind = "mesh" if "mesh" in geom.attributes else geom.attributes.get("type", "sphere")
        if kind == "mesh":
            asset = self.meshes.get(geom.attributes.get("mesh", ""), geom)
            geom.require("file" in asset.attributes, "mjcf-element", kind=kind)
            folder = self.settings.get("meshdir", self.settings.get("assetdir", ""))
            file = f"{folder.rstrip('/')}/{asset.attributes['file']}" if folder else asset.attributes["file"]
            scale = urdf.join_numbers(asset.vector("scale", 3) or (1.0, 1.0, 1.0))
            return f'<mesh filename={quoteattr(file)} scale="{scale}"/>', T
        words = geom.attributes.get("size", "").split()
        a, b, c = (*(geom.vector("size", len(words)) or ()), *ZERO)[:3]
        half = b
        if "fromto" in geom.attributes:
            ends = np.array(geom.vector("fromto", 6))
            along = ends[3:] - ends[:3]
            half = c = 0.5 * float(np.linalg.norm(along))
            T[:3, :3], T[:3, 3] = turn_z_to(along), 0.5 * (ends[:3] + ends[3:])
        if kind == "plane" and self.scene:
            kind, a, b, c = "box", 10.0, 10.0, 10.0  # [m] half edges
            T = T @ urdf.as_matrix(urdf.Pose((0.0, 0.0, -c)))
        box = f'<box size="{2 * a!r} {2 * b!r} {2 * c!r}"/>'
        shapes = {"sphere": f'<sphere radius="{a!r}"/>', "box": box, "ellipsoid": box}
        shapes |= {tag: f'<{tag} radius="{a!r}" length="{2 * half!r}"/>' for tag in ("capsule", "cylinder")}
        geom.require(kind in shapes, "mjcf-element", kind=kind)
        return shapes[kind], T

    def _couple(self, root: XmlNode) -> None:
        """Make mimic joints from the linear `<equality><joint>`; offsets count from the reference pose.

        Raises:
            RobotError: Code `mjcf-coupling`.
        """
        follows: dict[str, dict[str, Any]] = {}
        for node in (e for group in root.all("equality") for e in group.children):
            first, second = node.attributes.get("joint1", ""), node.attributes.get("joint2", "")
            if node.attributes.get("active") == "false":
                continue
            if node.tag != "joint":
                finding = f"<equality><{shorten(node.tag)}> is ignored"
                root.log.warn(node.line, f"{finding}: closed chains are not supported")
                continue
            words = (node.attributes.get("polycoef", "0 1 0 0 0").split() + ["0"] * 5)[:5]
            node = replace(node, attributes={"polycoef": " ".join(words), "name": first})
            c = node.vector("polycoef", 5) or (0.0,) * 5
            is_usable = second != "" and not any(c[2:]) and first not in follows and first in self.ref
            node.require(is_usable, "mjcf-coupling", c=c, other=second)
            offset = self.ref[first] + c[0] - c[1] * self.ref.get(second, 0.0)
            follows[first] = {"mimic": Mimic(first, second, c[1], offset), "mimic_node": node}
        self.joints = [j._replace(**follows.get(j.name, {})) for j in self.joints]


def validate_mjcf(root: XmlNode, locked: Collection[str] = (), *, scene: bool = False) -> tuple[urdf.UrdfFile, bytes]:
    """Read and check an MJCF file.

    Joints coupled by a linear `<equality><joint>` become mimic joints; sites become frames.

    Args:
        root: Root element of the file.
        locked: Names of joints that will be locked.
        scene: True to read obstacles instead of a robot: only shapes with contact are returned, also the shapes of the
            world body; a plane becomes a box.

    Returns:
        The validated description, and the text of an equivalent URDF with the shapes.

    Raises:
        RobotError: The description is invalid, see `validate_urdf`; also codes `mjcf-element`, `mjcf-class`,
            `mjcf-compiler`, `mjcf-orientation`, `mjcf-coupling`.
    """
    pending = [root]
    for node in pending:  # the list grows during the loop
        if node.tag in ("include", "attach", "replicate", "composite", "flexcomp", "frame"):
            fix = "plain bodies are expected; let MuJoCo write the expanded file: mj_saveLastXML"
            raise node.refusal("mjcf-element", f"<{node.tag}> is not supported; {fix}")
        pending += node.children
    reader = _Reader(root, scene)
    if any(j.nv == 1 for j in reader.joints):
        root.log.warn(None, "an MJCF file has no velocity limits; velocities are unlimited")
    if all(link.inertia is None for link in reader.links):
        sentence = "no body states its mass; masses of shapes are not computed, so there is no centre of mass"
        root.log.warn(None, sentence)
    validated = urdf.validate_parts(urdf.robot_name(root, "model"), reader.links, reader.joints, locked, root.log)
    return validated, urdf.kinematic_urdf(validated, reader.visuals).encode()
