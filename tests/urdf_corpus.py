"""Hostile and odd robot descriptions in twelve categories, each with the verdict it must get."""

from __future__ import annotations

import math
import os
import struct
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

ARM = """<?xml version="1.0"?>
<robot name="arm">
  <link name="base"/>
  <link name="upper">
    <inertial><origin xyz="0.1 0 0"/><mass value="2"/>
      <inertia ixx="0.1" ixy="0" ixz="0" iyy="0.1" iyz="0" izz="0.1"/></inertial>
  </link>
  <link name="tip"/>
  <joint name="shoulder" type="revolute">
    <origin xyz="0 0 0.3" rpy="0 0 0.1"/><parent link="base"/><child link="upper"/>
    <axis xyz="0 0 1"/><limit lower="-2" upper="2.5" velocity="1" effort="10"/>
  </joint>
  <joint name="elbow" type="revolute">
    <origin xyz="0.4 0 0"/><parent link="upper"/><child link="tip"/>
    <axis xyz="0 1 0"/><limit lower="-1" upper="1.5" velocity="3" effort="20"/>
  </joint>
</robot>
"""
LIMIT = '<limit lower="-2" upper="2.5" velocity="1" effort="10"/>'
ORIGIN = '<origin xyz="0 0 0.3" rpy="0 0 0.1"/>'
AXIS = '<axis xyz="0 0 1"/>'
SHOULDER = '<joint name="shoulder" type="revolute">'
PARENT, CHILD = '<parent link="base"/>', '<child link="upper"/>'


@dataclass(frozen=True)
class Case:
    """One description.

    Attributes:
        category: One of the twelve.
        name: What is odd.
        verdict: `"accept"`, `"warn"`, `"refuse:CODE"`, or for meshes `"stand-in:CODE"`.
        content: The URDF.
        files: Other files, path relative to the case's folder -> content.
        file: Where the URDF is, relative to the case's folder.
        special: Makes something other than a file with that content; gets the path.
        options: Keyword arguments of `load_robot`.
    """

    category: str
    name: str
    verdict: str
    content: bytes = field(default=b"", repr=False)
    files: dict[str, bytes] = field(default_factory=dict, repr=False)
    file: str = "robot.urdf"
    special: Callable[[Path], None] | None = None
    options: dict[str, object] = field(default_factory=dict)

    def write(self, folder: Path) -> Path:
        """Write the case below a folder; the path to load."""
        path = folder / self.file
        path.parent.mkdir(parents=True, exist_ok=True)
        for name, content in self.files.items():
            target = folder / name
            target.parent.mkdir(parents=True, exist_ok=True)
            target.write_bytes(content)
        if self.special is None:
            path.write_bytes(self.content)
        else:
            self.special(path)
        return path


def edited(*changes: tuple[str, str]) -> bytes:
    """The arm with texts replaced; each must occur."""
    text = ARM
    for old, new in changes:
        if old not in text:
            raise ValueError(f"{old!r} is not in the arm")
        text = text.replace(old, new, 1)
    return text.encode()


def chain(n: int, kind: str = "fixed", limit: str = "") -> bytes:
    """A chain of n joints."""
    axis = "" if kind == "fixed" else '<axis xyz="0 0 1"/>'
    links = "".join(f'<link name="l{i}"/>' for i in range(n + 1))
    joints = "".join(
        f'<joint name="j{i}" type="{kind}"><parent link="l{i}"/><child link="l{i + 1}"/>'
        f'<origin xyz="0.1 0 0"/>{axis}{limit}</joint>'
        for i in range(n)
    )
    return f'<robot name="chain">{links}{joints}</robot>'.encode()


def star(n: int) -> bytes:
    """n links fixed to one."""
    links = "".join(f'<link name="l{i}"/>' for i in range(n + 1))
    joints = "".join(
        f'<joint name="j{i}" type="fixed"><parent link="l0"/><child link="l{i + 1}"/></joint>' for i in range(n)
    )
    return f'<robot name="star">{links}{joints}</robot>'.encode()


def tree(joints: list[tuple[str, str, str]], links: str = "abcde", extra: str = "") -> bytes:
    """Links named by letters, fixed joints (name, parent, child)."""
    body = "".join(f'<link name="{name}"/>' for name in links)
    body += "".join(
        f'<joint name="{n}" type="fixed"><parent link="{p}"/><child link="{c}"/></joint>' for n, p, c in joints
    )
    return f'<robot name="tree">{body}{extra}</robot>'.encode()


def cases_of(category: str, rows: list[tuple]) -> list[Case]:
    """Rows (name, verdict, content[, keyword arguments of Case])."""
    return [Case(category, row[0], row[1], row[2], **(row[3] if len(row) > 3 else {})) for row in rows]


def xml_cases() -> list[Case]:
    """Broken, cut, foreign and unusual XML."""
    arm = ARM.encode()
    rows = [
        ("plain", "accept", arm),
        ("no declaration", "accept", arm.partition(b"?>\n")[2]),
        ("single quotes", "accept", arm.replace(b'"', b"'")),
        ("empty file", "refuse:empty", b""),
        ("only spaces", "refuse:empty", b"  \n\t "),
        ("cut in the middle", "refuse:not-xml", arm[: len(arm) // 2]),
        ("two roots", "refuse:not-xml", arm + b"<robot/>"),
        ("mismatched tags", "refuse:not-xml", arm.replace(b"</joint>", b"</jiont>")),
        ("attribute twice", "refuse:not-xml", arm.replace(b'<link name="base"', b'<link name="base" name="b"')),
        ("plain text", "refuse:not-xml", b"this is not a robot"),
        ("zero byte inside", "refuse:not-xml", arm.replace(b"elbow", b"el\0ow")),
        ("control character", "refuse:not-xml", arm.replace(b"elbow", b"el\x01ow")),
        ("sdf", "refuse:not-urdf", b'<sdf version="1.6"><model name="m"/></sdf>'),
        ("xacro macro", "refuse:xacro", edited(('<link name="base"/>', '<link name="base"/><xacro:arm/>'))),
        ("xacro include", "refuse:xacro", edited(('<link name="base"/>', '<include filename="x"/>'))),
        ("xacro expression", "refuse:xacro-expression", edited(("0 0 0.3", "0 0 ${pi/2}"))),
        ("version 1.1", "refuse:urdf-version", edited(('name="arm"', 'name="arm" version="1.1"'))),
        ("unknown element", "warn", edited(('<link name="base"/>', '<link name="base"/><wheel/>'))),
        ("element in wrong case", "warn", edited(("<axis", "<Axis"), ("</robot>", "</robot>"))),
        ("misspelt origin", "warn", edited(("<origin xyz", "<orgin xyz"))),
        ("element twice", "refuse:element-twice", edited((ORIGIN, ORIGIN + ORIGIN))),
        ("quaternion origin", "refuse:origin-attribute", edited(('rpy="0 0 0.1"', 'quat_xyzw="0 0 0 1"'))),
        ("unknown attribute", "warn", edited(('rpy="0 0 0.1"', 'rqy="0 0 0.1"'))),
    ]
    return cases_of("xml", rows)


def entity_cases() -> list[Case]:
    """Everything that needs a DTD is refused; character references are plain XML."""
    arm = ARM.partition("?>\n")[2]

    def with_dtd(dtd: str, use: str = "elbow") -> bytes:
        return f"<!DOCTYPE robot {dtd}>\n{arm}".replace("elbow", use).encode()

    laughs = "".join(f'<!ENTITY l{i} "{f"&l{i - 1};" * 10}">' for i in range(1, 10))
    rows = [
        ("billion laughs", "refuse:doctype", with_dtd(f'[<!ENTITY l0 "ha">{laughs}]', "&l9;")),
        ("external entity", "refuse:doctype", with_dtd('[<!ENTITY f SYSTEM "file:///etc/passwd">]', "&f;")),
        ("parameter entity", "refuse:doctype", with_dtd('[<!ENTITY % p SYSTEM "file:///dev/random"> %p;]')),
        ("external subset", "refuse:doctype", with_dtd('SYSTEM "file:///dev/zero"')),
        ("default attributes", "refuse:doctype", with_dtd('[<!ATTLIST link name CDATA "x">]')),
        ("undefined entity", "refuse:entity", arm.replace("elbow", "&elbow;").encode()),
        ("built-in entities", "accept", arm.replace("elbow", "a&amp;b&lt;c&gt;").encode()),
        ("character reference", "accept", arm.replace("elbow", "el&#98;ow").encode()),
        ("reference to zero", "refuse:not-xml", arm.replace("elbow", "&#0;").encode()),
    ]
    return cases_of("entities", rows)


def encoding_cases() -> list[Case]:
    """Encodings as declared, as meant, and as neither."""
    text = ARM.partition("?>\n")[2].replace("elbow", "Ellenbögen")

    def declared(encoding: str, codec: str = "") -> bytes:
        return (f'<?xml version="1.0" encoding="{encoding}"?>\n' + text).encode(codec or encoding)

    rows = [
        ("utf-8", "accept", declared("utf-8")),
        ("utf-8 with mark", "accept", b"\xef\xbb\xbf" + declared("utf-8")),
        ("utf-16 with mark", "accept", declared("utf-16")),
        ("latin-1", "accept", declared("iso-8859-1")),
        ("ascii with references", "accept", declared("ascii", "utf-8").replace("ö".encode(), b"&#246;")),
        ("latin-1 undeclared", "refuse:not-xml", text.encode("latin-1")),
        ("utf-8 declared as utf-16", "refuse:encoding", declared("utf-16", "utf-8")),
        ("unknown encoding", "refuse:encoding", declared("klingon", "utf-8")),
        ("codec that is no text encoding", "refuse:encoding", declared("rot13", "utf-8")),
        ("overlong utf-8", "refuse:not-xml", ARM.encode().replace(b"elbow", b"el\xc0\xafow")),
    ]
    return cases_of("encoding", rows)


def topology_cases() -> list[Case]:
    """Trees, and what is no tree."""
    line = [("1", "a", "b"), ("2", "b", "c"), ("3", "c", "d"), ("4", "d", "e")]
    rows = [
        ("one link", "warn", b'<robot name="r"><link name="a"/></robot>'),
        ("fixed line", "warn", tree(line)),
        ("branches", "warn", tree([("1", "a", "b"), ("2", "a", "c"), ("3", "a", "d"), ("4", "d", "e")])),
        ("joints before links", "warn", tree(line, "", "".join(f'<link name="{c}"/>' for c in "abcde"))),
        ("no links", "refuse:no-links", b'<robot name="r"/>'),
        ("joints only", "refuse:no-links", tree(line, "")),
        ("two roots", "refuse:many-roots", tree(line[:3])),
        ("circle of five", "refuse:no-root", tree([*line, ("5", "e", "a")])),
        ("root and a circle", "refuse:detached", tree([("1", "a", "b"), ("2", "c", "d"), ("3", "d", "c")], "abcd")),
        ("closed chain", "refuse:two-parents", tree([*line, ("5", "a", "e")])),
        ("link joined to itself", "refuse:self-loop", tree([*line, ("5", "e", "e")])),
        ("unknown parent", "refuse:unknown-link", tree([*line[:3], ("4", "x", "e")])),
        ("unknown child", "refuse:unknown-link", tree([*line, ("5", "e", "f")])),
        ("no parent element", "refuse:joint-link", edited((PARENT, ""))),
        ("no child element", "refuse:joint-link", edited((CHILD, ""))),
        ("parent without attribute", "refuse:joint-link", edited((PARENT, "<parent>base</parent>"))),
        ("two parents in a joint", "refuse:element-twice", edited((PARENT, PARENT + '<parent link="tip"/>'))),
    ]
    return cases_of("topology", rows)


def number_cases() -> list[Case]:
    """Numbers that are none, not finite, or in the wrong number."""
    xyz = "0 0 0.3"
    rows = [
        ("exponents and signs", "accept", edited((xyz, "+1e-1 -.5E0 3."))),
        ("spaces and line breaks", "accept", edited((xyz, "  0\n 0\t0.3  "))),
        ("tiny number", "accept", edited((xyz, "0 0 1e-320"))),
        ("nan position", "refuse:not-finite", edited((xyz, "0 0 nan"))),
        ("inf position", "refuse:not-finite", edited((xyz, "inf 0 0"))),
        ("overflow to inf", "refuse:not-finite", edited((xyz, "1e999 0 0"))),
        ("a light second away", "refuse:far-away", edited((xyz, "3e8 0 0"))),
        ("decimal comma", "refuse:number", edited((xyz, "0 0 0,3"))),
        ("commas between", "refuse:vector-size", edited((xyz, "0,0,0.3"))),
        ("two numbers", "refuse:vector-size", edited((xyz, "0 0.3"))),
        ("empty vector", "refuse:vector-size", edited((xyz, ""))),
        ("text", "refuse:number", edited((xyz, "0 0 high"))),
        ("Arabic digits", "refuse:number", edited((xyz, "0 0 \u0663"))),
        ("minus sign of typesetters", "refuse:number", edited((xyz, "0 0 \u22120.3"))),
        ("rotation in degrees", "warn", edited(("0 0 0.1", "0 0 90"))),
        ("zero axis", "refuse:axis-zero", edited((AXIS, '<axis xyz="0 0 0"/>'))),
        ("tiny axis", "refuse:axis-norm", edited((AXIS, '<axis xyz="0 0 1e-9"/>'))),
        ("axis of length 2", "warn", edited((AXIS, '<axis xyz="0 0 2"/>'))),
        ("rounded axis", "accept", edited((AXIS, '<axis xyz="0.7071 0 0.7071"/>'))),
        ("no axis", "warn", edited((AXIS, ""))),
        ("negative mass", "refuse:mass", edited(('<mass value="2"/>', '<mass value="-2"/>'))),
        ("no mass", "warn", edited(('<mass value="2"/>', ""))),
        ("negative inertia", "warn", edited(('ixx="0.1"', 'ixx="-0.1"'))),
        ("empty velocity", "refuse:number", edited(('velocity="1"', 'velocity=""'))),
    ]
    return cases_of("numbers", rows)


def limit_cases() -> list[Case]:
    """Limits that a controller cannot live with."""

    def limited(lower: str, upper: str, velocity: str = "1") -> bytes:
        return edited((LIMIT, f'<limit lower="{lower}" upper="{upper}" velocity="{velocity}" effort="1"/>'))

    prismatic = SHOULDER.replace("revolute", "prismatic")
    continuous = SHOULDER.replace("revolute", "continuous")
    rows = [
        ("two full turns each way", "accept", limited(str(-4 * math.pi), str(4 * math.pi))),
        ("above zero only", "accept", limited("1", "2")),
        ("inverted", "refuse:limit-order", limited("1", "-1")),
        ("equal", "refuse:limit-order", limited("0", "0")),
        ("degrees", "refuse:limit-degrees", limited("-180", "180")),
        ("unlimited by a large number", "warn", limited("-1e16", "1e16")),
        ("infinite", "refuse:not-finite", limited("-inf", "inf")),
        ("no lower", "warn", edited(('lower="-2" ', ""))),
        ("no upper", "warn", edited(('upper="2.5" ', ""))),
        ("no limit", "warn", edited((LIMIT, ""))),
        ("limit twice", "refuse:element-twice", edited((LIMIT, LIMIT + LIMIT))),
        ("velocity zero", "warn", limited("-1", "1", "0")),
        ("velocity negative", "warn", limited("-1", "1", "-3")),
        ("no velocity", "warn", edited(('velocity="1" ', ""))),
        ("slide without limits", "warn", edited((SHOULDER, prismatic), (LIMIT, ""))),
        ("continuous with limits", "accept", edited((SHOULDER, continuous))),
        ("continuous without", "accept", edited((SHOULDER, continuous), (LIMIT, ""))),
        ("continuous, inverted", "accept", edited((SHOULDER, continuous), ("-2", "3"))),
        ("inverted but locked", "accept", limited("1", "-1"), {"options": {"locked": ("shoulder",)}}),
        ("degrees but locked", "accept", limited("-180", "180"), {"options": {"locked": ("shoulder",)}}),
    ]
    return cases_of("limits", rows)


def type_cases() -> list[Case]:
    """Joint types, known and unknown."""

    def typed(kind: str, *more: tuple[str, str]) -> bytes:
        return edited((SHOULDER, f'<joint name="shoulder" type="{kind}">'), *more)

    rows = [
        ("prismatic", "accept", typed("prismatic")),
        ("continuous", "accept", typed("continuous")),
        ("fixed", "accept", typed("fixed")),
        ("planar", "accept", typed("planar")),
        ("planar about x", "refuse:planar-axis", typed("planar", (AXIS, '<axis xyz="1 0 0"/>'))),
        ("planar without axis", "refuse:planar-axis", typed("planar", (AXIS, ""))),
        ("floating with zero axis", "accept", typed("floating", (AXIS, '<axis xyz="0 0 0"/>'))),
        ("fixed with limits of nonsense", "accept", typed("fixed", ("-2", "9"))),
        ("fixed with nan limit", "refuse:not-finite", typed("fixed", ("-2", "nan"))),
        ("ball", "refuse:joint-type", typed("ball")),
        ("misspelt", "refuse:joint-type", typed("revolut")),
        ("space after", "refuse:joint-type", typed("revolute ")),
        ("no type", "refuse:joint-type", edited((SHOULDER, '<joint name="shoulder">'))),
        ("floating base", "accept", ARM.encode(), {"options": {"base": "floating"}}),
        ("planar base", "accept", ARM.encode(), {"options": {"base": "planar"}}),
        (
            "floating base, joint of its name",
            "refuse:name-reserved",
            edited(("elbow", "root_joint")),
            {"options": {"base": "floating"}},
        ),
        ("joint of that name, fixed base", "accept", edited(("elbow", "root_joint"))),
    ]
    return cases_of("joint types", rows)


def mimic_cases() -> list[Case]:
    """Joints that follow others."""
    fixed = SHOULDER.replace("revolute", "fixed")

    def following(elbow: str, shoulder: str = "", *more: tuple[str, str]) -> bytes:
        return edited(*more, (LIMIT, LIMIT + shoulder), ('velocity="3" effort="20"/>', f'velocity="3"/>{elbow}'))

    plain = '<mimic joint="shoulder"/>'
    rows = [
        ("plain", "warn", following(plain)),  # the follower's narrower limits bind its leader
        ("parent that comes later", "warn", following("", '<mimic joint="elbow" multiplier="2"/>')),
        ("factor and offset", "accept", following('<mimic joint="shoulder" multiplier="-0.3" offset="0.2"/>')),
        ("never within the limits", "warn", following('<mimic joint="shoulder" multiplier="0.1" offset="9"/>')),
        ("factor zero", "warn", following('<mimic joint="shoulder" multiplier="0"/>')),
        ("huge factor", "refuse:mimic-multiplier", following('<mimic joint="shoulder" multiplier="1e9"/>')),
        ("itself", "refuse:mimic-cycle", following('<mimic joint="elbow"/>')),
        ("each other", "refuse:mimic-cycle", following(plain, '<mimic joint="elbow"/>')),
        ("unknown joint", "refuse:mimic-unknown", following('<mimic joint="sholder"/>')),
        ("no joint named", "refuse:mimic-leader", following("<mimic/>")),
        ("two mimics", "refuse:element-twice", following(plain + plain)),
        ("fixed leader", "warn", following(plain, "", (SHOULDER, fixed))),
        ("fixed follower", "warn", following("", '<mimic joint="elbow"/>', (SHOULDER, fixed))),
        ("floating leader", "refuse:mimic-type", following(plain, "", (SHOULDER, fixed.replace("fixed", "floating")))),
        ("planar follower", "refuse:mimic-type", following("", plain.replace("shoulder", "elbow"), _planar())),
        (
            "continuous leader, half speed",
            "warn",
            following(plain.replace("/>", ' multiplier="0.5"/>'), "", _turning()),
        ),
        ("leader locked", "accept", following(plain), {"options": {"locked": ("shoulder",)}}),
        ("follower locked", "refuse:locked-follower", following(plain), {"options": {"locked": ("elbow",)}}),
        (
            "unknown leader, follower locked",
            "accept",
            following('<mimic joint="gone"/>'),
            {"options": {"locked": ("elbow",)}},
        ),
        ("mimic of mimic, backwards", "accept", mimic_chain((2, 1, 0))),
        ("mimic of mimic of fixed", "warn", mimic_chain((0, 1, 2)).replace(b"revolute", b"fixed", 1)),
    ]
    return cases_of("mimic", rows)


def mimic_chain(order: tuple[int, ...]) -> bytes:
    """Three joints, each following the one before, written in some order."""
    limit = '<limit lower="-1" upper="1" velocity="1" effort="1"/>'
    joints = [
        f'<joint name="j{i}" type="revolute"><parent link="l{i}"/><child link="l{i + 1}"/><origin xyz="0.2 0 0"/>'
        f'<axis xyz="0 0 1"/>{limit}' + (f'<mimic joint="j{i - 1}" multiplier="-0.5"/>' if i else "") + "</joint>"
        for i in range(3)
    ]
    links = "".join(f'<link name="l{i}"/>' for i in range(4))
    return f'<robot name="chain">{links}{"".join(joints[i] for i in order)}</robot>'.encode()


def _planar() -> tuple[str, str]:
    return (SHOULDER, SHOULDER.replace("revolute", "planar"))


def _turning() -> tuple[str, str]:
    return (SHOULDER, SHOULDER.replace("revolute", "continuous"))


def stl(n: int = 1, stated: int | None = None, value: float = 1.0) -> bytes:
    """A binary STL with n triangles, stating another number if asked."""
    triangle = struct.pack("<12fH", 0, 0, 1, 0, 0, 0, value, 0, 0, 0, value, 0, 0)
    return bytes(80) + struct.pack("<I", n if stated is None else stated) + triangle * n


FACET = b"facet normal 0 0 1\nouter loop\nvertex 0 0 0\nvertex 1 0 0\nvertex 0 1 0\nendloop\nendfacet\n"
ASCII_STL = b"solid s\n" + FACET + b"endsolid s\n"
OBJ = b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"


def dae(image: str = "", head: str = "", positions: str = "0 0 0 1 0 0 0 1 0") -> bytes:
    """A COLLADA document with one triangle."""
    images = f"<library_images><image id='i'><init_from>{image}</init_from></image></library_images>" if image else ""
    count = len(positions.split())
    return f"""<?xml version="1.0"?>{head}
<COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1"><asset><unit meter="1"/></asset>{images}
<library_geometries><geometry id="g"><mesh><source id="p"><float_array id="pa" count="{count}">{positions}</float_array>
<technique_common><accessor source="#pa" count="{count // 3}" stride="3"><param name="X" type="float"/>
<param name="Y" type="float"/><param name="Z" type="float"/></accessor></technique_common></source>
<vertices id="v"><input semantic="POSITION" source="#p"/></vertices>
<triangles count="1"><input semantic="VERTEX" source="#v" offset="0"/><p>0 1 2</p></triangles></mesh></geometry>
</library_geometries>
<library_visual_scenes><visual_scene id="s"><node><instance_geometry url="#g"/></node></visual_scene>
</library_visual_scenes><scene><instance_visual_scene url="#s"/></scene></COLLADA>""".encode()


def linked(target: str):
    """A case whose mesh folder holds a symbolic link besides the URDF."""

    def make(path: Path) -> None:
        visual = '<visual><geometry><mesh filename="../meshes/link.stl"/></geometry></visual>'
        path.write_bytes(edited(('<link name="tip"/>', f'<link name="tip">{visual}</link>')))
        (path.parents[1] / "meshes").mkdir(exist_ok=True)
        (path.parents[1] / "meshes" / "link.stl").symlink_to(target)

    return {"special": make}


def _row(category: str, name: str, verdict: str, address: str, files: dict[str, bytes], **options) -> tuple:
    return (category, name, verdict, address, files, options)


def _path(name: str, verdict: str, address: str, files: dict[str, bytes] | None = None, **options) -> tuple:
    return _row("mesh paths", name, verdict, address, {} if files is None else files, **options)


def _content(name: str, verdict: str, file: str, content: bytes, **more: bytes) -> tuple:
    return _row("mesh contents", name, verdict, f"../meshes/{file}", {f"pkg/meshes/{file}": content, **more})


HERE = {"pkg/meshes/a.stl": stl()}
BESIDE = {"other/meshes/a.stl": stl(), "other/package.xml": b"<package><name>other</name></package>"}
PACKAGE = {"pkg/package.xml": b"<package><name>renamed</name></package>"}
SECRET = {"secret/a.stl": stl()}

PATHS = [
    _path("beside the urdf", "accept", "a.stl", {"pkg/urdf/a.stl": stl()}),
    _path("up and over", "accept", "../meshes/a.stl", HERE),
    _path("backslashes", "accept", "..\\meshes\\a.stl", HERE),
    _path("own package", "accept", "package://pkg/meshes/a.stl", HERE),
    _path("own package by its name", "accept", "package://renamed/meshes/a.stl", {**HERE, **PACKAGE}),
    _path("package beside", "accept", "package://other/meshes/a.stl", BESIDE),
    _path("escaped characters", "accept", "package://pkg/meshes/a%2Estl", HERE),
    _path("beside, but no package", "stand-in:mesh-missing", "package://secret/a.stl", SECRET),
    _path("missing", "stand-in:mesh-missing", "../meshes/b.stl", HERE),
    _path("no package", "stand-in:mesh-missing", "package:///a.stl"),
    _path("relative way out", "stand-in:mesh-outside", "../../secret/a.stl", SECRET),
    _path("absolute", "stand-in:mesh-outside", "/etc/passwd"),
    _path("file address", "stand-in:mesh-outside", "file:///etc/passwd"),
    _path("network", "stand-in:mesh-scheme", "http://localhost/a.stl"),
    _path("link out", "stand-in:mesh-outside", "", {}, **linked("/etc/passwd")),
    _path("link to itself", "stand-in:mesh-missing", "", {}, **linked("link.stl")),
    _path("link to a device", "stand-in:mesh-outside", "", {}, **linked("/dev/zero")),
    _path("folder", "stand-in:mesh-kind", "../meshes", HERE),
    _path("very long", "stand-in:mesh-missing", "a" * 5000 + ".stl"),
    _path("empty", "stand-in:visual", ""),
    _path("no geometry", "stand-in:visual", "<visual/>"),
    _path("unknown shape", "stand-in:visual", "<visual><geometry><cone/></geometry></visual>"),
    _path("box of nan", "stand-in:not-finite", '<visual><geometry><box size="nan 1 1"/></geometry></visual>'),
    _path("plain sphere", "accept", '<visual><geometry><sphere radius="0.1"/></geometry></visual>'),
]
CONTENTS = [
    _content("binary stl", "accept", "a.stl", stl()),
    _content("ascii stl", "accept", "a.stl", ASCII_STL),
    _content("obj", "accept", "a.obj", OBJ),
    _content("obj with materials beside", "accept", "a.obj", b"mtllib a.mtl\n" + OBJ),
    _content("collada", "accept", "a.dae", dae()),
    _content("collada with image", "accept", "a.dae", dae("skin.png")),
    _content("empty", "stand-in:mesh-content", "a.stl", b""),
    _content("stl cut", "stand-in:mesh-content", "a.stl", stl()[:-3]),
    _content("stl that states 4 billion", "stand-in:mesh-content", "a.stl", stl(1, 0xFFFFFFFF)),
    _content("stl without triangles", "stand-in:mesh-content", "a.stl", stl(0)),
    _content("stl of nan", "stand-in:mesh-content", "a.stl", stl(value=float("nan"))),
    _content("obj that is a program", "stand-in:mesh-content", "a.obj", b"\x7fELF" + bytes(500)),
    _content("obj naming a password file", "accept", "a.obj", b"mtllib /etc/passwd\n" + OBJ),
    _content("collada with doctype", "stand-in:mesh-content", "a.dae", dae(head='<!DOCTYPE x SYSTEM "file:///x">')),
    _content("collada with a texture of its package", "accept", "x/a.dae", dae("../../materials/textures/skin.png")),
    _content("collada with its author's disk", "accept", "a.dae", dae("file:///C:/Users/me/skin.png")),
    _content("collada naming a neighbour", "accept", "a.dae", dae("../../other/skin.png")),
    _content("collada without positions", "stand-in:mesh-content", "a.dae", dae(positions="")),
    _content("collada cut", "stand-in:mesh-parser", "a.dae", dae()[:700]),
    _content("glb", "stand-in:mesh-kind", "a.glb", b"glTF" + bytes(16)),
    _content("collada of open tags", "stand-in:mesh-parser", "a.dae", dae() + b"<instance_node " * 500_000),
    _content(
        "collada of many images",
        "stand-in:mesh-parser",
        "a.dae",
        dae() + b"".join(b"<init_from>%d.png</init_from>" % i for i in range(50_000)),
    ),
    _content("program", "stand-in:mesh-kind", "a.exe", b"MZ"),
    _content("no extension", "stand-in:mesh-kind", "a", stl()),
]
MESH_CASES = PATHS + CONTENTS


def name_cases() -> list[Case]:
    """Names: missing, twice, odd, hostile."""
    rows = [
        (
            "duplicate link",
            "refuse:duplicate-link",
            edited(('<link name="tip"/>', '<link name="tip"/><link name="tip"/>')),
        ),
        ("duplicate joint", "refuse:duplicate-joint", edited(("elbow", "shoulder"))),
        ("link and joint share a name", "accept", edited(("elbow", "tip"))),
        ("link without name", "refuse:name-missing", edited(('<link name="tip"/>', "<link/>"))),
        ("spaces around", "warn", edited(("elbow", " elbow "))),
        ("space inside", "accept", edited(("elbow", "the elbow"))),
        ("line break", "refuse:name-unprintable", edited(("elbow", "el&#10;bow"))),
        ("right-to-left override", "refuse:name-unprintable", edited(("elbow", "el\u202ebow"))),
        ("emoji", "accept", edited(("elbow", "\U0001f9be"))),
        ("script", "accept", edited(("elbow", "&lt;script&gt;alert(1)&lt;/script&gt;"))),
        ("universe as joint", "refuse:name-reserved", edited(("elbow", "universe"))),
        ("world as link", "accept", edited(('<link name="base"/>', '<link name="world"/>'), ('"base"', '"world"'))),
        ("200 letters", "accept", edited(("elbow", "e" * 200))),
        ("201 letters", "refuse:name-long", edited(("elbow", "e" * 201))),
        ("robot without name", "warn", edited((' name="arm"', ""))),
        ("robot with line break", "warn", edited(('name="arm"', 'name="a&#10;b"'))),
        ("locked joint unknown", "refuse:unknown-joint", ARM.encode(), {"options": {"locked": ("elbwo",)}}),
    ]
    return cases_of("names", rows)


def size_cases() -> list[Case]:
    """Too many, too deep, too long, and things that are no files."""
    limit = '<limit lower="-1" upper="1" velocity="1" effort="1"/>'
    filler = f"<!--{'x' * 1000}-->".encode()
    rows = [
        ("500 deep", "warn", chain(500)),
        ("501 deep", "refuse:too-deep", chain(501)),
        ("999 links in a star", "warn", star(998)),
        ("1001 links in a star", "refuse:too-many-links", star(1000)),
        ("150 degrees of freedom", "accept", chain(150, "revolute", limit)),
        ("151 degrees of freedom", "refuse:too-many-dof", chain(151, "revolute", limit)),
        ("26 floating joints", "refuse:too-many-dof", chain(26, "floating")),
        ("9.9 MB of comments", "accept", ARM.encode().replace(b"</robot>", filler * 9_800 + b"</robot>")),
        ("10.1 MB", "refuse:file-too-large", ARM.encode().replace(b"</robot>", filler * 10_050 + b"</robot>")),
        ("many elements", "refuse:xml-too-large", b'<robot name="r">' + b"<a/>" * 300_000 + b"</robot>"),
        ("deep nesting", "refuse:xml-too-deep", b'<robot name="r">' + b"<a>" * 100_000),
        ("long attribute", "refuse:xml-too-large", edited(("0 0 0.3", "0 " * 200_000))),
        ("long number", "accept", edited(("0 0 0.3", "0 0 0." + "3" * 40_000))),
        ("long number with a slip", "refuse:number", edited(("0 0 0.3", f"0 0 {'3' * 90_000}x"))),
        ("100,000 attributes", "accept", edited(("<robot ", "<robot " + "".join(f'a{i}="" ' for i in range(100_000))))),
        ("folder", "refuse:not-a-file", b"", {"special": Path.mkdir}),
        ("missing", "refuse:missing", b"", {"special": lambda path: None}),
        ("pipe", "refuse:not-a-file", b"", {"special": lambda path: os.mkfifo(path)}),
        ("endless device", "refuse:not-a-file", b"", {"special": lambda path: path.symlink_to("/dev/zero")}),
        ("circular link", "refuse:unreadable", b"", {"special": lambda path: path.symlink_to(path)}),
        ("sparse 10 GB", "refuse:file-too-large", b"", {"special": _sparse}),
        ("file as folder", "refuse:missing", ARM.encode(), {"file": "robot.urdf/x.urdf", "special": _below_a_file}),
        ("xacro not asked for", "refuse:xacro", ARM.encode(), {"file": "robot.xacro"}),
    ]
    return cases_of("size", rows)


def _sparse(path: Path) -> None:
    with path.open("wb") as file:
        file.truncate(10_000_000_000)


def _below_a_file(path: Path) -> None:
    path.parent.rmdir()
    path.parent.write_bytes(ARM.encode())


def mesh_cases() -> list[Case]:
    """Robots whose meshes are somewhere else, or are something else."""
    out = []
    for category, name, verdict, address, files, options in MESH_CASES:
        visual = f'<visual><geometry><mesh filename="{address}"/></geometry></visual>'
        if address.startswith("<"):
            visual = address
        content = edited(('<link name="tip"/>', f'<link name="tip">{visual}</link>'))
        out.append(Case(category, name, verdict, content, files=files, file="pkg/urdf/robot.urdf", **options))
    return out


def corpus() -> list[Case]:
    """All cases."""
    groups = (
        xml_cases,
        entity_cases,
        encoding_cases,
        topology_cases,
        number_cases,
        limit_cases,
        type_cases,
        mimic_cases,
        name_cases,
        size_cases,
        mesh_cases,
    )
    return [case for group in groups for case in group()]
