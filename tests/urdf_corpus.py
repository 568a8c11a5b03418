"""Hostile and odd robot descriptions in twelve categories, each with the verdict it must get.

`python tests/urdf_corpus.py FOLDER` writes them all out to look at.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path

from urdf_corpus_case import ARM, Case, cases_of, chain, edited, star
from urdf_corpus_joints import limit_cases, mimic_cases, number_cases, type_cases
from urdf_corpus_meshes import MESH_CASES
from urdf_corpus_text import encoding_cases, entity_cases, topology_cases, xml_cases


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


def main() -> None:
    """Write the corpus into a folder."""
    root = Path(sys.argv[1])
    for case in corpus():
        print(case.write(root / case.category / case.name.replace("/", "_")), case.verdict)


if __name__ == "__main__":
    main()
