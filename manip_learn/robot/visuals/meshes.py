"""Mesh addresses -> files inside the robot's folders -> triangles.

Files are a user's own, and their parsers are trimesh's. Before they see a file it is examined: its size, its kind, what
it claims to hold. Materials and pictures that it names are not read.
"""

from __future__ import annotations

import errno
import io
import os
import re
import struct
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple, final
from urllib.parse import unquote

import numpy as np
from jaxtyping import Float, Int

from manip_learn.errors import RobotError, advice
from manip_learn.robot.description.catalogue import example_package_dir
from manip_learn.robot.description.text import read_regular_file

Colour = tuple[float, float, float, float]
Piece = tuple[np.ndarray, np.ndarray, Colour | None]  # corners, triangles

MESH_KINDS = (".stl", ".obj", ".dae")
MAX_MESH_BYTES = 50_000_000  # of a file: a million triangles of STL
MAX_FACES = 2_000_000  # of a mesh: 0.1 GB as triangles
MAX_NODES = 20_000  # of a COLLADA scene, each counted as often as it is used
HEAD = 4_096  # [bytes] in which a file says of which kind it is

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
        name, folders = _place(uri, roots)
        found = [(folder / name).resolve() for folder in folders if (folder / name).exists()]
        inside = (real for real in found if any(real.is_relative_to(folder.resolve()) for folder in folders))
        if (real := next(inside, None)) is not None:
            return real
        there = next((folder for folder in folders if folder.is_dir()), None)
    except (OSError, ValueError, RuntimeError) as error:  # names too long, NUL bytes, circular links
        raise RobotError(f"mesh {uri[:200]!r} cannot be looked up ({error})", code="mesh-missing") from error
    if found:
        fix = advice("; if that is meant, name its folder with {}", "package_dirs=[...]", "--package-dir FOLDER")
        sentence = f"leads to {found[-1]}, outside the robot's folders{fix}"
        raise RobotError(f"mesh {uri[:200]!r} {sentence}", code="mesh-outside")
    fix = advice("; name the folder that contains its package with {}", "package_dirs=[...]", "--package-dir FOLDER")
    if "$(" in uri:
        fix = "; it is xacro: name the file *.xacro" + advice(" and load it with {}", "xacro=True", "--xacro")
    elif there is not None:
        fix = "; correct its address" + ("" if Path(name).is_absolute() else f", or put it into {there}")
    raise RobotError(f"mesh {uri[:200]!r} was not found{fix}", code="mesh-missing")


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
    return inside, _package_folders(package, roots)


def find_package(package: str, urdf: Path, package_dirs: Sequence[Path]) -> Path | None:
    """Return the folder in which meshes of a package would be looked up; None without one."""
    is_name = re.fullmatch(r"\w[\w.-]{0,199}", package)
    folders = _package_folders(package, mesh_roots(urdf, package_dirs)) if is_name else []
    return next((folder for folder in folders if folder.is_dir()), None)


def _package_folders(package: str, roots: MeshRoots) -> list[Path]:
    folders = [roots.own[package]] if package in roots.own else []
    folders += [d / package for d in roots.above]
    for candidate in (d / package for d in roots.walked):
        if roots.beside[0].is_relative_to(candidate) or (candidate / PACKAGE_FILE).is_file():
            folders.append(candidate)
    if not folders[len(roots.above) :]:  # a package in a repository beside the robot's, or one whose folder was renamed
        for depth in ("*", "*/*"):
            files = roots.beside[-1].parent.glob(f"{depth}/{PACKAGE_FILE}")
            folders += [p.parent for p in files if package in (p.parent.name, _package_name(p.parent))]
    return folders


@final
class Mesh(NamedTuple):
    """A triangle mesh.

    Attributes:
        vertices: shape (n, 3) [m], of a file without the scale of the URDF.
        faces: shape (m, 3), counted from 0, counter-clockwise from outside.
        colour: Diffuse colour of most of its triangles, of a COLLADA file; None for other formats and textures.
    """

    vertices: Float[np.ndarray, "n 3"]
    faces: Int[np.ndarray, "m 3"]
    colour: Colour | None = None


def open_edges(mesh: Mesh) -> int:
    """How many edges do not lie between two triangles; 0 if the mesh is closed."""
    corners = np.unique(mesh.vertices, axis=0, return_inverse=True)[1].reshape(-1)[mesh.faces]
    edges = np.sort(corners[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    return int(np.sum(np.unique(edges, axis=0, return_counts=True)[1] != 2))


def read_meshes(paths: Sequence[Path]) -> dict[Path, Mesh | RobotError]:
    """Each mesh, or why there is none: codes `mesh-*`. No error is raised.

    Args:
        paths: Files inside the robot's folders.
    """
    out: dict[Path, Mesh | RobotError] = {}
    for path in dict.fromkeys(paths):
        try:
            out[path] = _read(path)
        except RobotError as error:
            out[path] = error
    return out


def _read(path: Path) -> Mesh:
    kind = path.suffix.lower()
    if kind not in MESH_KINDS:
        raise _refusal(path, "mesh-kind", f"{kind or 'no extension'!r} is not one of {', '.join(MESH_KINDS)}")
    try:
        content = read_regular_file(path, MAX_MESH_BYTES)
    except (OSError, ValueError) as error:
        code = {errno.EFBIG: "mesh-size", errno.ENXIO: "mesh-kind"}.get(getattr(error, "errno", 0), "mesh-missing")
        raise _refusal(path, code, str(error)) from error
    _check(kind, content, path)
    try:
        pieces = _collada_pieces(content) if kind == ".dae" else _pieces(content, kind)
        vertices, faces, painted, n = [], [], Counter[Colour](), 0
        for corners, triangles, colour in pieces:
            if sum(map(len, faces)) + len(triangles) > MAX_FACES:
                raise _refusal(path, "mesh-content", f"it has more than {MAX_FACES} triangles")
            used, indices = np.unique(triangles, return_inverse=True)
            # single precision, as the formats have it
            vertices.append(np.asarray(corners)[used].astype(np.float32))
            faces.append(indices.reshape(-1, 3) + n)
            n += len(used)
            if colour is not None:
                painted[colour] += len(triangles)
    except RobotError:
        raise
    except Exception as error:  # whatever foreign parsers raise about a broken file
        raise _refusal(path, "mesh-parser", f"{type(error).__name__}: {error}"[:300]) from error
    if not n or not all(np.isfinite(v).all() for v in vertices):
        raise _refusal(path, "mesh-content", "it has no triangles, or vertices that are not finite")
    colour = painted.most_common(1)[0][0] if painted else None
    return Mesh(np.concatenate(vertices).astype(np.float64), np.concatenate(faces), colour)


def _pieces(content: bytes, kind: str) -> Iterator[Piece]:
    import trimesh

    scene = trimesh.load_scene(io.BytesIO(content), file_type=kind[1:], resolver={}, process=False, skip_materials=True)
    for node in scene.graph.nodes_geometry:
        T, name = scene.graph[node]
        if isinstance(piece := scene.geometry[name], trimesh.Trimesh):
            yield trimesh.transform_points(piece.vertices, T), piece.faces, None


def _collada_pieces(content: bytes) -> Iterator[Piece]:
    """By the parser that trimesh uses; trimesh itself would walk nodes that double forty times without an end."""
    import collada

    file = collada.Collada(io.BytesIO(content), ignore=[collada.common.DaeError])
    if any(isinstance(error, collada.common.DaeBrokenRefError) for error in file.errors):
        # a mesh with a broken material is left out, too: read once more without materials
        first, *others = content.split(b"<bind_material")
        content = first + b"".join(part.partition(b"</bind_material>")[2] for part in others)
        file = collada.Collada(io.BytesIO(content), ignore=[collada.common.DaeError])
    unit = float(file.assetInfo.unitmeter or 1.0)  # what the file's numbers count [m]; the parser hands them out as is
    pending = [(node, np.diag([unit, unit, unit, 1.0])) for node in file.scene.nodes]
    for _ in range(MAX_NODES):
        if not pending:
            return
        node, T = pending.pop()
        if isinstance(node, collada.scene.Node):
            pending += [(child, T @ node.matrix) for child in node.children]
        if not isinstance(node, collada.scene.GeometryNode):
            continue
        colours = {m.symbol: _diffuse(m.target.effect) for m in node.materials}
        for piece in node.geometry.primitives:
            if isinstance(piece, collada.polylist.Polylist):
                piece = piece.triangleset()
            if isinstance(piece, collada.triangleset.TriangleSet) and len(piece):
                yield piece.vertex @ T[:3, :3].T + T[:3, 3], piece.vertex_index, colours.get(piece.material)
    raise ValueError(f"more than {MAX_NODES} nodes")


def _diffuse(effect: Any) -> Colour | None:
    """Of a COLLADA effect; None for a texture, and for what is no colour."""
    # the parser says black where a texture is missing
    node = effect.xmlnode.find(".//{*}diffuse/{*}color")
    rgba = [] if node is None else [min(max(float(word), 0.0), 1.0) for word in (node.text or "").split()]
    if len(rgba) not in (3, 4) or not np.isfinite(rgba).all():
        return None
    # exporters disagree on what the fourth number means: a mesh is not transparent by it
    return (rgba[0], rgba[1], rgba[2], 1.0)


def _check(kind: str, content: bytes, path: Path) -> None:
    """Refuse what claims to hold more than it does, or something else than its ending says."""
    head, reason = content[:HEAD], ""
    if not content:
        reason = "it is empty"
    elif kind == ".stl":
        size = 84 + 50 * struct.unpack_from("<I", content, 80)[0] if len(content) >= 84 else 0
        is_text = head.lstrip().startswith(b"solid") and b"facet" in head and b"\0" not in head
        if not is_text and (len(content) != size or size == 84):
            reason = "its size does not fit the number of triangles it states"
    elif kind == ".obj":
        if b"\0" in content or not re.search(rb"^[ \t]*v[ \t]", content, re.MULTILINE):
            reason = "it has no OBJ vertices"
    # the parser would unpack a ZIP file, whatever it begins with; none is without zeros
    elif not content.lstrip(b"\xef\xbb\xbf \t\r\n").startswith(b"<") or b"<COLLADA" not in head or b"\0" in content:
        reason = "it is no COLLADA document"
    elif b"<!DOCTYPE" in content or b"<!ENTITY" in content:
        reason = "it has a <!DOCTYPE>"
    if reason:
        raise _refusal(path, "mesh-content", reason)


def _refusal(path: Path, code: str, reason: str) -> RobotError:
    return RobotError(f"mesh {path}: {reason}", code=code, path=path)
