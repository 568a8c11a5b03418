"""Mesh addresses -> files inside the robot's folders -> triangles.

A file is examined without parsing (kind, references to other files), then parsed in a child process that may crash,
hang or run out of memory.
"""

from __future__ import annotations

import errno
import json
import os
import re
import shutil
import struct
import tempfile
import time
import zipfile
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import final
from urllib.parse import unquote

import numpy as np
from jaxtyping import Float, Int

from manip_learn.errors import RobotError, advice, counted
from manip_learn.robot.description.catalogue import example_package_dir
from manip_learn.robot.description.text import read_regular_file
from manip_learn.robot.limited_child import LimitedChild

LEVELS_UP = 6  # folders above the URDF that may hold its package
PACKAGE_FILE = "package.xml"
# A URDF often lives in <package>/urdf next to <package>/meshes, with or without a package.xml.
URDF_FOLDERS = ("urdf", "urdfs", "robots", "robot", "xacro", "description")


@final
@dataclass(frozen=True)
class MeshRoots:
    """Folders in which the meshes of one robot may be looked up, in this order.

    Attributes:
        beside: Folders for relative addresses, that of the URDF first.
        above: Folders that may contain any package.
        walked: Folders above the URDF; a package in them must contain the URDF or a package.xml, so that
            `package://etc/...` does not lead out of /.
        own: Packages by the name in their package.xml, for folders that were renamed.
    """

    beside: tuple[Path, ...]
    above: tuple[Path, ...]
    walked: tuple[Path, ...]
    own: dict[str, Path]


def mesh_roots(urdf: Path, package_dirs: Sequence[Path]) -> MeshRoots:
    """Folders of a robot: its own, given ones, those above, of ROS_PACKAGE_PATH and AMENT_PREFIX_PATH, example data."""
    folder = urdf.resolve().parent
    given = [Path(d).resolve() for d in package_dirs]
    ancestors = [p for p in (folder, *folder.parents[:LEVELS_UP]) if p != p.parent]
    beside = [folder, *given]
    package = next((p for p in ancestors if (p / PACKAGE_FILE).is_file()), None)
    if package is not None:
        beside.append(package)
    elif folder.name.lower() in URDF_FOLDERS:
        beside.append(folder.parent)
    named = [*given, *_folders_of("ROS_PACKAGE_PATH")]
    own = {name: p for p in [*ancestors, *named] if (name := _package_name(p))}
    above = [*given, folder, *_folders_of("ROS_PACKAGE_PATH"), *(p / "share" for p in _folders_of("AMENT_PREFIX_PATH"))]
    # a given folder may be the package itself
    own |= {p.name: p for p in named if p.name not in own}
    data = example_package_dir()
    above += [data] if data is not None else []
    return MeshRoots(tuple(dict.fromkeys(beside)), tuple(dict.fromkeys(above)), tuple(ancestors), own)


def _folders_of(variable: str) -> list[Path]:
    return [Path(d) for d in os.environ.get(variable, "").split(os.pathsep) if d]


def _package_name(folder: Path) -> str:
    file = folder / PACKAGE_FILE
    if not file.is_file():
        return ""
    with file.open("rb") as opened:
        found = re.search(rb"<name>\s*([\w.-]+)\s*</name>", opened.read(20_000))
    return found.group(1).decode() if found else ""


def find_mesh(uri: str, roots: MeshRoots) -> Path:
    """The file that a mesh address means, symbolic links resolved.

    Raises:
        RobotError: Codes `mesh-scheme`, `mesh-missing`, `mesh-outside`.
    """
    try:
        return _first_inside(uri, *_place(uri, roots))
    except (OSError, ValueError, RuntimeError) as error:  # names too long, NUL bytes, circular links
        raise RobotError(f"mesh {uri[:200]!r} cannot be looked up ({error})", code="mesh-missing") from error


def _place(uri: str, roots: MeshRoots) -> tuple[str, Sequence[Path]]:
    """The name of a mesh, and the folders that it can be in."""
    scheme, separator, rest = uri.partition("://")
    if not separator:
        return uri.replace("\\", "/"), roots.beside
    if scheme == "file":
        return unquote(rest), roots.beside
    if scheme not in ("package", "model"):
        sentence = f"addresses of the kind {scheme[:20]!r} are not read; use package:// or a path"
        raise RobotError(f"mesh {uri[:200]!r}: {sentence}", code="mesh-scheme")
    package, _, inside = unquote(rest).partition("/")
    if package in ("", ".", "..") or not inside:
        raise RobotError(f"mesh {uri[:200]!r} names no package and file", code="mesh-missing")
    folders = [roots.own[package]] if package in roots.own else []
    folders += [d / package for d in roots.above]
    for candidate in (d / package for d in roots.walked):
        if roots.beside[0].is_relative_to(candidate) or (candidate / PACKAGE_FILE).is_file():
            folders.append(candidate)
    return inside, folders


def _first_inside(uri: str, name: str, folders: Sequence[Path]) -> Path:
    found = [(folder / name).resolve() for folder in folders if (folder / name).exists()]
    for real in found:
        if any(real.is_relative_to(folder.resolve()) for folder in folders):
            return real
    if found:
        sentence = f"leads to {found[-1]}, outside the robot's folders"
        fix = advice("; if that is meant, name its folder with {}", "package_dirs=[...]", "--package-dir FOLDER")
        raise RobotError(f"mesh {uri[:200]!r} {sentence}{fix}", code="mesh-outside")
    fix = advice("; name the folder that contains its package with {}", "package_dirs=[...]", "--package-dir FOLDER")
    raise RobotError(f"mesh {uri[:200]!r} was not found{fix}", code="mesh-missing")


Colour = tuple[float, float, float, float]
MAX_MESH_BYTES = 50_000_000  # of a file: a million triangles of STL
HEAD = 4_096  # [bytes] in which a file says of which kind it is
MAX_SIDE_FILES = 500  # each is looked up on the disk
MAX_BUFFERS = 10  # of a glTF, each up to MAX_MESH_BYTES
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
    size = 84 + 50 * struct.unpack_from("<I", content, 80)[0] if len(content) >= 84 else 0
    head = content[:HEAD]
    is_text = head.lstrip().startswith(b"solid") and b"facet" in head and b"\0" not in head
    if not is_text and (len(content) != size or size == 84):
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
    parts = re.findall(rb"<instance_(?:geometry|node|controller)\b([^<>]*)", content)
    urls = [_value(attributes, b"url").partition(b"#")[0] for attributes in parts]
    _check_names([*re.findall(rb"<init_from>([^<]*)<", content), *filter(None, urls)], path)


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
    buffers = _addresses(document, "buffers")
    _check_names([uri.encode("utf-8", "replace") for uri in (*buffers, *_addresses(document, "images"))], path)
    read = next((uri for uri in buffers if "/" in uri or not uri.lower().endswith(".bin")), None)
    if read is not None:
        reason = f"it reads the file {read[:80]!r}; only a .bin file beside it is read"
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
    """Files that a mesh names must lie in its package; they are not read, but another program might."""
    different = {name.strip() for name in names}
    if len(different) > MAX_SIDE_FILES:
        raise _refusal(path, "mesh-side-file", f"it names {counted(len(different), 'other file')}")
    folder = path.parent.resolve()
    package = next((p.parent for p in (folder, *folder.parents) if p.name.lower() == "meshes"), folder.parent)
    for name in sorted(raw.decode("utf-8", "replace") for raw in different):
        if WINDOWS_PATH.match(name) and os.name != "nt":
            continue  # where the texture was on its author's machine: leads nowhere
        inside = name.removeprefix("file://").replace("\\", "/")
        try:
            is_inside = "://" not in inside and (folder / inside).resolve().is_relative_to(package)
        except (OSError, ValueError, RuntimeError):  # names too long, NUL bytes, circular links
            is_inside = False
        if not is_inside:
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


CHILD = Path(__file__).with_name("mesh_child.py")
MEMORY = 512_000_000  # [bytes] of the parsing process; the libraries alone take 150 MB
SECONDS = 5.0  # of processor time for one mesh
ALL_SECONDS = 60  # for all meshes of one robot
MAX_FACES = 2_000_000  # of a mesh: 0.1 GB as triangles

Mesh = tuple[Float[np.ndarray, "n 3"], Int[np.ndarray, "m 3"]]


def read_meshes(paths: Sequence[Path], seconds: float = SECONDS) -> dict[Path, Mesh | RobotError]:
    """Vertices [m, unscaled] and faces of each mesh, or why there are none. No error is raised.

    Args:
        paths: Files inside the robot's folders.
        seconds: Processor time for one mesh [s].
    """
    out: dict[Path, Mesh | RobotError] = {}
    end = time.monotonic() + ALL_SECONDS
    child: LimitedChild | None = None
    with tempfile.TemporaryDirectory(prefix="manip_learn_") as folder:
        for i, path in enumerate(dict.fromkeys(paths)):
            # the parser sees a copy that is alone in its folder, so that it finds no side files
            alone = Path(folder) / str(i)
            alone.mkdir()
            try:
                copy = alone / f"mesh{path.suffix.lower()}"
                content = checked_mesh(path)
                copy.write_bytes(content)
                for name, side in buffer_files(content, path).items():
                    (alone / name).write_bytes(side)
                child = child or LimitedChild(CHILD, memory=MEMORY, seconds=ALL_SECONDS, folder=Path(folder))
                out[path] = _parsed(child, copy, path, min(seconds, end - time.monotonic()))
            except RobotError as error:
                out[path] = error
                if child is not None and child.is_lost:
                    child.close()
                    child = None
            finally:
                shutil.rmtree(alone)
        if child is not None:
            child.close()
    return out


def _parsed(child: LimitedChild, copy: Path, path: Path, seconds: float) -> Mesh:
    output = copy.with_name("out.npz")
    try:
        answer = child.ask({"input": str(copy), "output": str(output)}, seconds)
    except TimeoutError as error:
        raise _refusal(path, "mesh-time", f"parsing: {error}") from error
    except ChildProcessError as error:
        raise _refusal(path, "mesh-parser", f"parsing: {error}") from error
    if "fault" in answer:
        raise _refusal(path, "mesh-parser", str(answer["fault"]))
    try:
        with np.load(output, allow_pickle=False) as data:
            vertices, faces = data["vertices"], data["faces"]
    except (OSError, ValueError, KeyError, zipfile.BadZipFile) as error:
        raise _refusal(path, "mesh-parser", "its triangles could not be read back") from error
    is_usable = (
        vertices.ndim == faces.ndim == 2
        and vertices.shape[1:] == faces.shape[1:] == (3,)
        and 0 < len(faces) <= MAX_FACES
        and len(vertices) > 0
        and int(faces.max()) < len(vertices)
        and bool(np.isfinite(vertices).all())
    )
    if not is_usable:
        raise _refusal(path, "mesh-content", "it has no triangles, too many, or vertices that are not finite")
    return vertices.astype(np.float64), faces.astype(np.int64)
