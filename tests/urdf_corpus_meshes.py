"""Mesh addresses and mesh files for the corpus."""

from __future__ import annotations

import json
import struct
from pathlib import Path

from urdf_corpus_case import edited


def stl(n: int = 1, stated: int | None = None, value: float = 1.0) -> bytes:
    """A binary STL with n triangles, stating another number if asked."""
    triangle = struct.pack("<12fH", 0, 0, 1, 0, 0, 0, value, 0, 0, 0, value, 0, 0)
    return bytes(80) + struct.pack("<I", n if stated is None else stated) + triangle * n


FACET = b"facet normal 0 0 1\nouter loop\nvertex 0 0 0\nvertex 1 0 0\nvertex 0 1 0\nendloop\nendfacet\n"
ASCII_STL = b"solid s\n" + FACET + b"endsolid s\n"
OBJ = b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"
PLY = (
    b"ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n"
    b"element face 1\nproperty list uchar int vertex_indices\nend_header\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n"
)


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


def gltf(buffer_uri: str | None = None, image_uri: str | None = None) -> dict:
    """A glTF document with one triangle; without an address the buffer is that of a .glb."""
    document = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1}]}],
        "accessors": [
            {"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3", "min": [0, 0, 0], "max": [1, 1, 0]},
            {"bufferView": 1, "componentType": 5125, "count": 3, "type": "SCALAR"},
        ],
        "bufferViews": [{"buffer": 0, "byteLength": 36}, {"buffer": 0, "byteOffset": 36, "byteLength": 12}],
        "buffers": [{"byteLength": 48} | ({"uri": buffer_uri} if buffer_uri else {})],
    }
    return document | ({"images": [{"uri": image_uri}]} if image_uri else {})


def glb(document: dict) -> bytes:
    """A binary glTF."""
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    data = struct.pack("<9f3I", 0, 0, 0, 1, 0, 0, 0, 1, 0, 0, 1, 2)
    body = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(data), b"BIN\0") + data
    return b"glTF" + struct.pack("<II", 2, 12 + len(body)) + body


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
    _content("ply", "accept", "a.ply", PLY),
    _content("collada", "accept", "a.dae", dae()),
    _content("collada with image", "accept", "a.dae", dae("skin.png")),
    _content("glb", "accept", "a.glb", glb(gltf())),
    _content("empty", "stand-in:mesh-content", "a.stl", b""),
    _content("stl cut", "stand-in:mesh-content", "a.stl", stl()[:-3]),
    _content("stl that states 4 billion", "stand-in:mesh-content", "a.stl", stl(1, 0xFFFFFFFF)),
    _content("stl without triangles", "stand-in:mesh-content", "a.stl", stl(0)),
    _content("stl of nan", "stand-in:mesh-content", "a.stl", stl(value=float("nan"))),
    _content("obj that is a program", "stand-in:mesh-content", "a.obj", b"\x7fELF" + bytes(500)),
    _content("obj naming a password file", "stand-in:mesh-side-file", "a.obj", b"mtllib /etc/passwd\n" + OBJ),
    _content("collada with doctype", "stand-in:mesh-content", "a.dae", dae(head='<!DOCTYPE x SYSTEM "file:///x">')),
    _content("collada with a texture of its package", "accept", "x/a.dae", dae("../../materials/textures/skin.png")),
    _content("collada with its author's disk", "accept", "a.dae", dae("file:///C:/Users/me/skin.png")),
    _content("collada naming a neighbour", "stand-in:mesh-side-file", "a.dae", dae("../../other/skin.png")),
    _content("collada without positions", "stand-in:mesh-content", "a.dae", dae(positions="")),
    _content("collada cut", "stand-in:mesh-parser", "a.dae", dae()[:700]),
    _content("gltf reading a file", "stand-in:mesh-side-file", "a.gltf", json.dumps(gltf("/etc/passwd")).encode()),
    _content(
        "gltf with its buffer beside",
        "accept",
        "a.gltf",
        json.dumps(gltf("a.bin")).encode(),
        **{"pkg/meshes/a.bin": glb(gltf())[-48:]},
    ),
    _content("gltf with its buffer missing", "stand-in:mesh-missing", "a.gltf", json.dumps(gltf("a.bin")).encode()),
    _content("gltf reading a text", "stand-in:mesh-side-file", "a.gltf", json.dumps(gltf("a.txt")).encode()),
    _content(
        "gltf with odd buffers", "stand-in:mesh-side-file", "a.gltf", b'{"asset": {}, "buffers": [1, {"uri": 3}]}'
    ),
    _content("gltf with a number of buffers", "stand-in:mesh-parser", "a.gltf", b'{"asset": {}, "buffers": 5}'),
    _content("glb naming an image", "stand-in:mesh-side-file", "a.glb", glb(gltf(image_uri="/etc/passwd"))),
    _content("gltf of deep json", "stand-in:mesh-content", "a.gltf", b"[" * 100_000),
    _content("ply without header", "stand-in:mesh-content", "a.ply", b"plymouth"),
    _content("collada of open tags", "stand-in:mesh-parser", "a.dae", dae() + b"<instance_node " * 500_000),
    _content(
        "collada of many images",
        "stand-in:mesh-side-file",
        "a.dae",
        dae() + b"".join(b"<init_from>%d.png</init_from>" % i for i in range(50_000)),
    ),
    _content("program", "stand-in:mesh-kind", "a.exe", b"MZ"),
    _content("no extension", "stand-in:mesh-kind", "a", stl()),
]
MESH_CASES = PATHS + CONTENTS
