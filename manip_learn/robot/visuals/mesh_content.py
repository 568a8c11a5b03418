"""Content of mesh files, examined without parsing: kind, references to other files, main colour."""

from __future__ import annotations

import errno
import json
import os
import re
import struct
from collections import Counter
from pathlib import Path

from manip_learn.errors import RobotError, counted
from manip_learn.robot.description.description_file import read_regular_file
from manip_learn.robot.visuals.visual_elements import Colour

MAX_MESH_BYTES = 50_000_000
HEAD = 4_096
MAX_SIDE_FILES = 500
MAX_BUFFERS = 10
WINDOWS_PATH = re.compile(r"(file:/*)?[A-Za-z]:[\\/]")
# each pattern stops at the next "<", so that the time is linear in the size of the file, whatever is in it
PIECE = re.compile(rb"<(?:triangles|polylist|polygons)\b([^<>]*)>")
BOUND = re.compile(rb"<instance_material\b([^<>]*)>")
MATERIAL = re.compile(rb"<material\b([^<>]*)>\s*<instance_effect\b([^<>]*)>")
DIFFUSE = re.compile(rb"<diffuse>\s*<color[^<>]*>([^<]*)<")


def checked_mesh(path: Path) -> bytes:
    """Content of a mesh file whose kind is known and which stands alone.

    Args:
        path: A file inside the robot's folders.

    Raises:
        RobotError: Codes `mesh-kind`, `mesh-size`, `mesh-content`, `mesh-side-file`, `mesh-missing`.
    """
    kind = path.suffix.lower()
    if kind not in CHECKS:
        raise _refusal(path, "mesh-kind", f"{kind or 'no extension'!r} is not one of {', '.join(CHECKS)}")
    content = _read(path)
    CHECKS[kind](content, path)
    return content


def _read(path: Path) -> bytes:
    try:
        content = read_regular_file(path, MAX_MESH_BYTES)
    except (OSError, ValueError) as error:
        code = {errno.EFBIG: "mesh-size", errno.ENXIO: "mesh-kind"}.get(getattr(error, "errno", 0), "mesh-missing")
        raise _refusal(path, code, str(error)) from error
    if not content:
        raise _refusal(path, "mesh-content", "it is empty")
    return content


def _check_stl(content: bytes, path: Path) -> None:
    if len(content) >= 84:
        triangles = struct.unpack_from("<I", content, 80)[0]
        if len(content) == 84 + 50 * triangles and triangles > 0:
            return
    if content[:HEAD].lstrip().startswith(b"solid") and b"facet" in content[:HEAD] and b"\0" not in content[:HEAD]:
        return
    raise _refusal(path, "mesh-content", "its size does not fit the number of triangles it states")


def _check_obj(content: bytes, path: Path) -> None:
    if b"\0" in content or not re.search(rb"^[ \t]*v[ \t]", content, re.MULTILINE):
        raise _refusal(path, "mesh-content", "it has no OBJ vertices")
    # materials are not read, but the parser would open the file that is named
    _check_names(re.findall(rb"^[ \t]*(?:mtllib|maplib|call|csh)[ \t]+(.+)$", content, re.MULTILINE), path)


def _check_dae(content: bytes, path: Path) -> None:
    text = content.lstrip(b"\xef\xbb\xbf \t\r\n")
    if not text.startswith(b"<") or b"<COLLADA" not in content[:HEAD] or b"\0" in content:
        raise _refusal(path, "mesh-content", "it is no COLLADA document")
    if b"<!DOCTYPE" in content or b"<!ENTITY" in content:
        raise _refusal(path, "mesh-content", "it has a <!DOCTYPE>")
    names = re.findall(rb"<init_from>([^<]*)<", content)
    for attributes in re.findall(rb"<instance_(?:geometry|node|controller)\b([^<>]*)", content):
        found = re.search(rb"\burl\s?=\s?[\"']([^\"'#]*)", attributes[:2000])
        names += [found.group(1)] if found and found.group(1) else []
    _check_names(names, path)


def _check_ply(content: bytes, path: Path) -> None:
    if not content.startswith(b"ply") or b"end_header" not in content[: 16 * HEAD]:
        raise _refusal(path, "mesh-content", "it has no PLY header")


def _check_glb(content: bytes, path: Path) -> None:
    if len(content) < 20 or content[:4] != b"glTF":
        raise _refusal(path, "mesh-content", "it has no glTF header")
    size, kind = struct.unpack_from("<I4s", content, 12)
    if kind != b"JSON" or size > len(content) - 20:
        raise _refusal(path, "mesh-content", "its first chunk is no JSON")
    _check_gltf(content[20 : 20 + size], path)


def _check_gltf(content: bytes, path: Path) -> None:
    try:
        document = json.loads(content)
    except (ValueError, RecursionError) as error:
        raise _refusal(path, "mesh-content", f"it is no JSON ({str(error)[:80]})") from error
    if not isinstance(document, dict) or "asset" not in document:
        raise _refusal(path, "mesh-content", "it is no glTF document")
    for group in ("buffers", "images"):
        for uri in _addresses(document, group):
            _check_name(uri, path)
            if group == "buffers" and ("/" in uri or not uri.lower().endswith(".bin")):
                reason = f"it reads the file {uri[:80]!r}; only a .bin file beside it is read"
                raise _refusal(path, "mesh-side-file", reason)


def _addresses(document: dict[str, object], group: str) -> list[str]:
    """Files that a glTF document names; data in place of a file is none."""
    items = document.get(group)
    uris = {str(i["uri"]) for i in items if isinstance(i, dict) and "uri" in i} if isinstance(items, list) else set()
    return sorted(uri for uri in uris if not uri.startswith("data:"))


def buffer_files(content: bytes, path: Path) -> dict[str, bytes]:
    """The .bin files that a checked .gltf reads: name -> content. Other formats have none.

    Raises:
        RobotError: Codes `mesh-missing`, `mesh-size`, `mesh-kind`, `mesh-side-file`.
    """
    if path.suffix.lower() != ".gltf":
        return {}
    names = _addresses(json.loads(content), "buffers")
    if len(names) > MAX_BUFFERS:
        raise _refusal(path, "mesh-side-file", f"it reads {len(names)} files, at most {MAX_BUFFERS} are read")
    return {name: _read(path.parent / name) for name in names}


def _check_names(names: list[bytes], path: Path) -> None:
    different = {name.strip() for name in names}
    if len(different) > MAX_SIDE_FILES:
        raise _refusal(path, "mesh-side-file", f"it names {counted(len(different), 'other file')}")
    for name in sorted(different):
        _check_name(name.decode("utf-8", "replace"), path)


def _check_name(name: str, path: Path) -> None:
    """A file that a mesh names must lie in its package; it is not read, but another program might."""
    if WINDOWS_PATH.match(name) and os.name != "nt":
        return  # where the texture was on its author's machine: leads nowhere
    name = name.removeprefix("file://").replace("\\", "/")
    folder = path.parent.resolve()
    package = next((p.parent for p in (folder, *folder.parents) if p.name.lower() == "meshes"), folder.parent)
    try:
        is_inside = (folder / name).resolve().is_relative_to(package)
    except (OSError, ValueError, RuntimeError):
        is_inside = False
    if "://" in name or "\0" in name or not is_inside:
        raise _refusal(path, "mesh-side-file", f"it names the file {name[:80]!r}, outside its own folder")


def _refusal(path: Path, code: str, reason: str) -> RobotError:
    return RobotError(f"mesh {path}: {reason}", code=code, path=path)


CHECKS = {
    ".stl": _check_stl,
    ".obj": _check_obj,
    ".dae": _check_dae,
    ".ply": _check_ply,
    ".glb": _check_glb,
    ".gltf": _check_gltf,
}


def mesh_colour(path: Path) -> Colour | None:
    """Diffuse colour of the material with the most polygons; None for other formats, textures, and what is unclear."""
    if path.suffix.lower() != ".dae":
        return None
    try:
        content = read_regular_file(path, MAX_MESH_BYTES)
    except OSError:
        return None
    effects = {}
    for effect in content.split(b"<effect")[1:]:
        found = DIFFUSE.search(effect)
        colour = _rgba(found.group(1)) if found else None
        if colour is not None:
            effects[_value(effect.partition(b">")[0], b"id")] = colour
    materials = {_value(a, b"id"): _value(b, b"url").removeprefix(b"#") for a, b in MATERIAL.findall(content)}
    targets = {_value(a, b"symbol"): _value(a, b"target").removeprefix(b"#") for a in BOUND.findall(content)}
    polygons: Counter[Colour] = Counter()
    for attributes in PIECE.findall(content):
        symbol, count = _value(attributes, b"material"), _value(attributes, b"count")
        colour = effects.get(materials.get(targets.get(symbol, symbol), b""))
        if colour is not None and count.isdigit():
            polygons[colour] += int(count[:9])
    return polygons.most_common(1)[0][0] if polygons else None


def _value(attributes: bytes, name: bytes) -> bytes:
    found = re.search(rb"\b" + name + rb"\s?=\s?[\"']([^\"']*)", attributes[:2000])
    return found.group(1) if found else b""


def _rgba(text: bytes) -> Colour | None:
    try:
        numbers = [min(max(float(word), 0.0), 1.0) for word in text.split()]
    except ValueError:
        return None
    if len(numbers) not in (3, 4) or any(x != x for x in numbers):
        return None
    # exporters disagree on what the fourth number means: a mesh is not transparent by it
    return (numbers[0], numbers[1], numbers[2], 1.0)
