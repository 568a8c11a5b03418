"""Hostile and odd robot descriptions in ten categories, each with the verdict it must get."""

from __future__ import annotations

import math
import struct
from typing import Any, NamedTuple

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
PARENT = '<parent link="base"/>'


class Case(NamedTuple):
    """A description: its category, what is odd, `"accept"`, `"warn"` or the code of its refusal, how it is loaded."""

    category: str
    name: str
    verdict: str
    content: bytes
    options: dict[str, Any] = {}  # noqa: RUF012  # of `robot_from_text`


def edited(*changes: tuple[str, str]) -> bytes:
    """The arm with texts replaced; each must occur."""
    text = ARM
    for old, new in changes:
        if old not in text:
            raise ValueError(f"{old!r} is not in the arm")
        text = text.replace(old, new, 1)
    return text.encode()


def linked(links, joints, kind="fixed", inside="", extra="") -> bytes:
    """Links, and joints (name, parent, child) of one kind 0.1 m apart."""
    body = "".join(f'<link name="{name}"/>' for name in links)
    for name, parent, child in joints:
        ends = f'<parent link="{parent}"/><child link="{child}"/><origin xyz="0.1 0 0"/>'
        body += f'<joint name="{name}" type="{kind}">{ends}{inside}</joint>'
    return f'<robot name="linked">{body}{extra}</robot>'.encode()


def chain(n: int, kind: str = "fixed", limit: str = "") -> bytes:
    """A chain of n joints."""
    links = [f"l{i}" for i in range(n + 1)]
    joints = [(f"j{i}", links[i], links[i + 1]) for i in range(n)]
    return linked(links, joints, kind, limit if kind == "fixed" else AXIS + limit)


def star(n: int) -> bytes:
    """n links fixed to one."""
    return linked([f"l{i}" for i in range(n + 1)], [(f"j{i}", "l0", f"l{i + 1}") for i in range(n)])


def tree(joints: list[tuple[str, str, str]], links: str = "abcde", extra: str = "") -> bytes:
    """Links named by letters, and what joins them."""
    return linked(links, joints, extra=extra)


def mimic_chain(order: tuple[int, ...]) -> bytes:
    """Three joints, each following the one before, written in some order."""
    limit, joints = '<limit lower="-1" upper="1" velocity="1" effort="1"/>', []
    for i in order:
        follows = f'<mimic joint="j{i - 1}" multiplier="-0.5"/>' if i else ""
        ends = f'<parent link="l{i}"/><child link="l{i + 1}"/><origin xyz="0.2 0 0"/>{AXIS}'
        joints.append(f'<joint name="j{i}" type="revolute">{ends}{limit}{follows}</joint>')
    return linked([f"l{i}" for i in range(4)], [], extra="".join(joints))


TABLES: dict[str, list[Any]] = {}  # category -> rows of a `Case`


# Broken, cut, foreign and unusual XML.
arm = ARM.encode()
TABLES["xml"] = [
    ("plain", "accept", arm),
    ("single quotes", "accept", arm.replace(b'"', b"'")),
    ("empty file", "empty", b""),
    ("cut in the middle", "not-xml", arm[: len(arm) // 2]),
    ("sdf", "not-urdf", b'<sdf version="1.6"><model name="m"/></sdf>'),
    ("xacro macro", "xacro", edited(('<link name="base"/>', '<link name="base"/><xacro:arm/>'))),
    ("xacro expression", "xacro-expression", edited(("0 0 0.3", "0 0 ${pi/2}"))),
    ("version 1.1", "urdf-version", edited(('name="arm"', 'name="arm" version="1.1"'))),
    ("unknown element", "warn", edited(('<link name="base"/>', '<link name="base"/><wheel/>'))),
    ("element twice", "element-twice", edited((ORIGIN, ORIGIN + ORIGIN))),
    ("unknown attribute", "warn", edited(('rpy="0 0 0.1"', 'rqy="0 0 0.1"'))),
    ("quaternion origin", "origin-attribute", edited(('rpy="0 0 0.1"', 'quat_xyzw="0 0 0 1"'))),
]


# Everything that needs a DTD is refused; character references are plain XML.
arm = ARM.partition("?>\n")[2]


def with_dtd(dtd: str, use: str = "elbow") -> bytes:
    return f"<!DOCTYPE robot {dtd}>\n{arm}".replace("elbow", use).encode()


laughs = "".join(f'<!ENTITY l{i} "{f"&l{i - 1};" * 10}">' for i in range(1, 10))
TABLES["entities"] = [
    ("billion laughs", "doctype", with_dtd(f'[<!ENTITY l0 "ha">{laughs}]', "&l9;")),
    ("external entity", "doctype", with_dtd('[<!ENTITY f SYSTEM "file:///etc/passwd">]', "&f;")),
    ("undefined entity", "entity", arm.replace("elbow", "&elbow;").encode()),
    ("character reference", "accept", arm.replace("elbow", "el&#98;ow").encode()),
]


# Encodings as declared, as meant, and as neither.
text = ARM.partition("?>\n")[2].replace("elbow", "Ellenbögen")


def declared(encoding: str, codec: str = "") -> bytes:
    return (f'<?xml version="1.0" encoding="{encoding}"?>\n' + text).encode(codec or encoding)


TABLES["encoding"] = [
    ("utf-8", "accept", declared("utf-8")),
    ("utf-8 with mark", "accept", b"\xef\xbb\xbf" + declared("utf-8")),
    ("utf-16 with mark", "accept", declared("utf-16")),
    ("latin-1", "accept", declared("iso-8859-1")),
    ("latin-1 undeclared", "not-xml", text.encode("latin-1")),
    ("codec that is no text encoding", "encoding", declared("rot13", "utf-8")),
]


# Trees, and what is no tree.
line = [("1", "a", "b"), ("2", "b", "c"), ("3", "c", "d"), ("4", "d", "e")]
TABLES["topology"] = [
    ("one link", "warn", b'<robot name="r"><link name="a"/></robot>'),
    ("branches", "warn", tree([("1", "a", "b"), ("2", "a", "c"), ("3", "a", "d"), ("4", "d", "e")])),
    ("no links", "no-links", b'<robot name="r"/>'),
    ("two roots", "many-roots", tree(line[:3])),
    ("circle of five", "no-root", tree([*line, ("5", "e", "a")])),
    ("root and a circle", "detached", tree([("1", "a", "b"), ("2", "c", "d"), ("3", "d", "c")], "abcd")),
    ("closed chain", "two-parents", tree([*line, ("5", "a", "e")])),
    ("link joined to itself", "self-loop", tree([*line, ("5", "e", "e")])),
    ("unknown parent", "unknown-link", tree([*line[:3], ("4", "x", "e")])),
    ("no parent element", "joint-link", edited((PARENT, ""))),
]


# Numbers that are none, not finite, or in the wrong number.
xyz = "0 0 0.3"


def with_axis(length: float) -> bytes:
    return edited((AXIS, f'<axis xyz="0 0 {length}"/>'))


TABLES["numbers"] = [
    ("exponents and signs", "accept", edited((xyz, "+1e-1 -.5E0 3."))),
    ("nan position", "not-finite", edited((xyz, "0 0 nan"))),
    ("1000 km below", "accept", edited((xyz, "0 0 -1e6"))),
    *((f"{x} away", "far-away", edited((xyz, x))) for x in ("3e8 0 0", "0 0 -1000001", "0 -1000001 0", "-1000001 0 0")),
    ("overflow to inf", "not-finite", edited((xyz, "1e999 0 0"))),
    ("decimal comma", "number", edited((xyz, "0 0 0,3"))),
    ("commas between", "vector-size", edited((xyz, "0,0,0.3"))),
    ("Arabic digits", "number", edited((xyz, "0 0 \u0663"))),
    ("rotation in degrees", "warn", edited(("0 0 0.1", "0 0 90"))),
    ("zero axis", "axis-zero", edited((AXIS, '<axis xyz="0 0 0"/>'))),
    *((f"axis of length {x}", "warn", with_axis(x)) for x in (2, 0.0011, 999)),
    *((f"axis of length {x}", "axis-norm", with_axis(x)) for x in (0.0009, 1001)),
    ("no axis", "warn", edited((AXIS, ""))),
    ("negative mass", "mass", edited(('<mass value="2"/>', '<mass value="-2"/>'))),
    ("no mass", "warn", edited(('<mass value="2"/>', ""))),
    ("no inertia", "accept", edited(*((f'{i}="0.1"', f'{i}="0"') for i in ("ixx", "iyy", "izz")))),
    ("negative inertia", "warn", edited(('ixx="0.1"', 'ixx="-0.1"'))),
]


# Limits that a controller cannot live with.
def limited(lower: str, upper: str, velocity: str = "1") -> bytes:
    return edited((LIMIT, f'<limit lower="{lower}" upper="{upper}" velocity="{velocity}" effort="1"/>'))


prismatic = SHOULDER.replace("revolute", "prismatic")
continuous = SHOULDER.replace("revolute", "continuous")
TABLES["limits"] = [
    ("two full turns each way", "accept", limited(str(-4 * math.pi), str(4 * math.pi))),
    ("inverted", "limit-order", limited("1", "-1")),
    *(("degrees", "limit-degrees", limited(*ends)) for ends in (("-180", "180"), (str(-4 * math.pi), "12.567"))),
    ("no limit by numbers", "warn", limited("-999", "1000.1")),
    ("unlimited by a large number", "warn", limited("-1e16", "1e16")),
    ("infinite", "not-finite", limited("-inf", "inf")),
    ("no lower", "warn", edited(('lower="-2" ', ""))),
    ("no limit", "warn", edited((LIMIT, ""))),
    ("velocity zero", "warn", limited("-1", "1", "0")),
    ("no velocity", "warn", edited(('velocity="1" ', ""))),
    ("continuous without", "accept", edited((SHOULDER, continuous), (LIMIT, ""))),
    ("inverted but locked", "accept", limited("1", "-1"), {"locked": ("shoulder",)}),
]


# Joint types, known and unknown.
def typed(kind: str, *more: tuple[str, str]) -> bytes:
    return edited((SHOULDER, f'<joint name="shoulder" type="{kind}">'), *more)


TABLES["joint types"] = [
    ("fixed", "accept", typed("fixed")),
    ("planar", "accept", typed("planar")),
    ("planar without axis", "planar-axis", typed("planar", (AXIS, ""))),
    ("floating with zero axis", "accept", typed("floating", (AXIS, '<axis xyz="0 0 0"/>'))),
    ("fixed with nan limit", "not-finite", typed("fixed", ("-2", "nan"))),
    ("ball", "joint-type", typed("ball")),
    ("no type", "joint-type", edited((SHOULDER, '<joint name="shoulder">'))),
    ("joint of that name, fixed base", "accept", edited(("elbow", "root_joint"))),
]


# Joints that follow others.
fixed = SHOULDER.replace("revolute", "fixed")
planar, turning = ((SHOULDER, SHOULDER.replace("revolute", kind)) for kind in ("planar", "continuous"))


def following(elbow: str, shoulder: str = "", *more: tuple[str, str]) -> bytes:
    return edited(*more, (LIMIT, LIMIT + shoulder), ('velocity="3" effort="20"/>', f'velocity="3"/>{elbow}'))


plain = '<mimic joint="shoulder"/>'
TABLES["mimic"] = [
    ("plain", "warn", following(plain)),  # the follower's narrower limits bind its leader
    ("factor and offset", "accept", following('<mimic joint="shoulder" multiplier="-0.3" offset="0.2"/>')),
    ("never within the limits", "warn", following('<mimic joint="shoulder" multiplier="0.1" offset="9"/>')),
    ("factor zero", "warn", following('<mimic joint="shoulder" multiplier="0"/>')),
    ("huge factor", "mimic-multiplier", following('<mimic joint="shoulder" multiplier="1e9"/>')),
    ("each other", "mimic-cycle", following(plain, '<mimic joint="elbow"/>')),
    ("a huge factor in two steps", "mimic-multiplier", mimic_chain((0, 1, 2)).replace(b"-0.5", b"1e5")),
    ("unknown joint", "mimic-unknown", following('<mimic joint="sholder"/>')),
    ("no joint named", "mimic-leader", following("<mimic/>")),
    ("fixed leader", "warn", following(plain, "", (SHOULDER, fixed))),
    ("fixed follower", "warn", following("", '<mimic joint="elbow"/>', (SHOULDER, fixed))),
    ("floating leader", "mimic-type", following(plain, "", (SHOULDER, fixed.replace("fixed", "floating")))),
    ("planar follower", "mimic-type", following("", plain.replace("shoulder", "elbow"), planar)),
    ("continuous leader", "warn", following(plain.replace("/>", ' multiplier="0.5"/>'), "", turning)),
    ("leader locked", "accept", following(plain), {"locked": ("shoulder",)}),
    ("follower locked", "locked-follower", following(plain), {"locked": ("elbow",)}),
    ("mimic of mimic of fixed", "warn", mimic_chain((0, 1, 2)).replace(b"revolute", b"fixed", 1)),
]


def stl(n: int = 1, stated: int | None = None, value: float = 1.0) -> bytes:
    """A binary STL with n triangles, stating another number if asked."""
    triangle = struct.pack("<12fH", 0, 0, 1, 0, 0, 0, value, 0, 0, 0, value, 0, 0)
    return bytes(80) + struct.pack("<I", n if stated is None else stated) + triangle * n


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


# Names: missing, twice, odd, hostile.
TABLES["names"] = [
    ("duplicate link", "duplicate-link", edited(('<link name="tip"/>', '<link name="tip"/><link name="tip"/>'))),
    ("duplicate joint", "duplicate-joint", edited(("elbow", "shoulder"))),
    ("link and joint share a name", "accept", edited(("elbow", "tip"))),
    ("link without name", "name-missing", edited(('<link name="tip"/>', "<link/>"))),
    ("spaces around", "warn", edited(("elbow", " elbow "))),
    ("right-to-left override", "name-unprintable", edited(("elbow", "el\u202ebow"))),
    ("universe as joint", "name-reserved", edited(("elbow", "universe"))),
    ("world as link", "accept", edited(('<link name="base"/>', '<link name="world"/>'), ('"base"', '"world"'))),
    ("200 letters", "accept", edited(("elbow", "e" * 200))),
    ("201 letters", "name-long", edited(("elbow", "e" * 201))),
    ("robot without name", "warn", edited((' name="arm"', ""))),
    ("locked joint unknown", "unknown-joint", ARM.encode(), {"locked": ("elbwo",)}),
]


# Too many, too deep, too long.
limit = '<limit lower="-1" upper="1" velocity="1" effort="1"/>'
TABLES["size"] = [
    ("500 deep", "warn", chain(500)),
    ("501 deep", "too-deep", chain(501)),
    ("1001 links in a star", "too-many-links", star(1000)),
    ("150 degrees of freedom", "accept", chain(150, "revolute", limit)),
    ("151 degrees of freedom", "too-many-dof", chain(151, "revolute", limit)),
    ("200000 elements", "no-links", b"<robot>" + b"<a/>" * 199_999 + b"</robot>"),
    ("200001 elements", "xml-too-large", b"<robot>" + b"<a/>" * 200_000 + b"</robot>"),
    ("60 levels", "not-urdf", b"<a>" * 60 + b"</a>" * 60),
    ("61 levels", "xml-too-deep", b"<a>" * 61 + b"</a>" * 61),
    ("deep nesting", "xml-too-deep", b'<robot name="r">' + b"<a>" * 100_000),
    ("100000 letters", "no-links", f'<robot name="{"r" * 100_000}"/>'.encode()),
    ("100001 letters", "xml-too-large", f'<robot name="{"r" * 100_001}"/>'.encode()),
    ("long attribute", "xml-too-large", edited(("0 0 0.3", "0 " * 200_000))),
    ("long number with a slip", "number", edited(("0 0 0.3", f"0 0 {'3' * 90_000}x"))),
]


CASES = [Case(category, *row) for category, rows in TABLES.items() for row in rows]
