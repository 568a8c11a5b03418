"""Hostile and odd robot descriptions in ten categories, each with the verdict it must get."""

from __future__ import annotations

import struct
from typing import Any, NamedTuple

from case import DATA, rows_in

ARM = (DATA / "arm.urdf").read_text(encoding="utf-8")
AXIS = '<axis xyz="0 0 1"/>'


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


# texts of the arm that are replaced
CASES = [
    Case(
        category,
        name,
        verdict,
        edited(*zip(texts[::2], texts[1::2], strict=True)),
        {"locked": (locked,)} if locked else {},
    )
    for category, name, verdict, locked, *texts in rows_in("odd_descriptions.txt")
]


def add(category: str, *rows: tuple) -> None:
    """Cases of a category: what is odd, the verdict, the description, and how it is loaded."""
    CASES.extend(Case(category, *row) for row in rows)


arm, bare = ARM.encode(), ARM.partition("?>\n")[2]
laughs = "".join(f'<!ENTITY l{i} "{f"&l{i - 1};" * 10}">' for i in range(1, 10))
add(
    "xml",
    ("single quotes", "accept", arm.replace(b'"', b"'")),
    ("empty file", "empty", b""),
    ("cut in the middle", "not-xml", arm[: len(arm) // 2]),
    ("sdf", "not-urdf", b'<sdf version="1.6"><model name="m"/></sdf>'),
    (
        "billion laughs",
        "doctype",
        f'<!DOCTYPE robot [<!ENTITY l0 "ha">{laughs}]>{bare}'.replace("elbow", "&l9;").encode(),
    ),
)


# Encodings as declared, as meant, and as neither.
text = bare.replace("elbow", "Ellenbögen")


def declared(encoding: str, codec: str = "") -> bytes:
    return (f'<?xml version="1.0" encoding="{encoding}"?>\n' + text).encode(codec or encoding)


add(
    "encoding",
    ("utf-8", "accept", declared("utf-8")),
    ("utf-8 with mark", "accept", b"\xef\xbb\xbf" + declared("utf-8")),
    ("utf-16 with mark", "accept", declared("utf-16")),
    ("latin-1", "accept", declared("iso-8859-1")),
    ("latin-1 undeclared", "not-xml", text.encode("latin-1")),
    ("codec that is no text encoding", "encoding", declared("rot13", "utf-8")),
)


# Trees, and what is no tree.
line = [("1", "a", "b"), ("2", "b", "c"), ("3", "c", "d"), ("4", "d", "e")]
add(
    "topology",
    ("one link", "warn", b'<robot name="r"><link name="a"/></robot>'),
    ("branches", "warn", tree([("1", "a", "b"), ("2", "a", "c"), ("3", "a", "d"), ("4", "d", "e")])),
    ("no links", "no-links", b'<robot name="r"/>'),
    ("two roots", "many-roots", tree(line[:3])),
    ("circle of five", "no-root", tree([*line, ("5", "e", "a")])),
    ("root and a circle", "detached", tree([("1", "a", "b"), ("2", "c", "d"), ("3", "d", "c")], "abcd")),
    ("closed chain", "two-parents", tree([*line, ("5", "a", "e")])),
    ("link joined to itself", "self-loop", tree([*line, ("5", "e", "e")])),
    ("unknown parent", "unknown-link", tree([*line[:3], ("4", "x", "e")])),
)
add(
    "mimic",
    ("a huge factor in two steps", "mimic-multiplier", mimic_chain((0, 1, 2)).replace(b"-0.5", b"1e5")),
    ("mimic of mimic of fixed", "warn", mimic_chain((0, 1, 2)).replace(b"revolute", b"fixed", 1)),
)


def stl(n: int = 1, stated: int | None = None, value: float = 1.0) -> bytes:
    """A binary STL with n triangles, stating another number if asked."""
    triangle = struct.pack("<12fH", 0, 0, 1, 0, 0, 0, value, 0, 0, 0, value, 0, 0)
    return bytes(80) + struct.pack("<I", n if stated is None else stated) + triangle * n


DAE = (DATA / "triangle.dae").read_bytes()
OBJ = b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"


# Too many, too deep, too long.
limit = '<limit lower="-1" upper="1" velocity="1" effort="1"/>'
add(
    "size",
    ("a name of 200 letters", "accept", edited(("elbow", "e" * 200))),
    ("a name of 201 letters", "name-long", edited(("elbow", "e" * 201))),
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
)
