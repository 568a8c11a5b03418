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
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple, cast, final
from urllib.parse import unquote

import numpy as np
from jaxtyping import Float, Int

from manip_learn.errors import RobotError, advice
from manip_learn.robot.description.catalogue import example_package_dir
from manip_learn.robot.description.text import read_regular_file

Colour = tuple[float, float, float, float]
Piece = tuple[np.ndarray, np.ndarray, Colour | None]  # corners, triangles, of one colour

MESH_KINDS = (".stl", ".obj", ".dae")
MAX_MESH_BYTES = 50_000_000  # of a file: a million triangles of STL
MAX_FACES = 2_000_000  # of a mesh: 0.1 GB as triangles
MAX_NODES = 20_000  # of a COLLADA scene, each counted as often as it is used
MOST_COLOURS = 64  # of a mesh, each of which is drawn by itself; one of more is grey
HEAD = 4_096  # [bytes] in which a file says of which kind it is
GREY: Colour = (0.7, 0.7, 0.72, 1.0)  # red, green, blue and opacity: shapes without a colour

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
    home = folder.parent if folder.name.lower() in URDF_FOLDERS else folder
    home = next((p for p in ancestors if (p / PACKAGE_FILE).is_file()), home)
    ros, prefixes = _folders_of("ROS_PACKAGE_PATH"), _folders_of("AMENT_PREFIX_PATH")
    # a given folder may be the package itself
    own = {p.name: p for p in (*given, *ros)}
    own |= {name: p for p in [*ancestors, *given, *ros] if (name := _package_name(p))}
    above = [*given, folder, *ros, *(p / "share" for p in prefixes), *filter(None, [example_package_dir()])]
    return MeshRoots(tuple(dict.fromkeys([folder, *given, home])), tuple(dict.fromkeys(above)), tuple(ancestors), own)


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
    seen, fix = "was not found", "; name the folder that contains its package with {}"
    if found:
        seen, fix = f"leads to {found[-1]}, outside the robot's folders", "; if that is meant, name its folder with {}"
    elif "$(" in uri:
        fix = "; it is xacro: name the file *.xacro" + advice(" and load it with {}", "xacro=True", "--xacro")
    elif there is not None:
        fix = "; correct its address" + ("" if Path(name).is_absolute() else f", or put it into {there}")
    seen += advice(fix, "package_dirs=[...]", "--package-dir FOLDER") if "{}" in fix else fix
    raise RobotError(f"mesh {uri[:200]!r} {seen}", code="mesh-outside" if found else "mesh-missing")


def _place(uri: str, roots: MeshRoots) -> tuple[str, Sequence[Path]]:
    """The name of a mesh, and the folders that it can be in."""
    scheme, separator, rest = uri.partition("://")
    if not separator or scheme == "file":
        return unquote(rest) if separator else uri.replace("\\", "/"), roots.beside
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
    walked = (d / package for d in roots.walked)
    folders += [p for p in walked if roots.beside[0].is_relative_to(p) or (p / PACKAGE_FILE).is_file()]
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
        colours: shape (m, 4), red, green, blue and opacity of each triangle, 0 to 1; None where nobody says.
        normals: shape (n, 3), unit vectors out of the surface at the vertices; None where they follow from the faces.
    """

    vertices: Float[np.ndarray, "n 3"]
    faces: Int[np.ndarray, "m 3"]
    colours: Float[np.ndarray, "m 4"] | None = None
    normals: Float[np.ndarray, "n 3"] | None = None


def compact(mesh: Mesh) -> Mesh:
    """Return a mesh without the vertices that none of its triangles uses, and without colours."""
    used, index = np.unique(mesh.faces, return_inverse=True)
    return Mesh(mesh.vertices[used], index.reshape(-1, 3))


def by_colour(mesh: Mesh) -> list[tuple[Colour | None, Mesh]]:
    """Return the triangles of each colour as a mesh of their own."""
    if mesh.colours is None:
        return [(None, mesh)]
    colours, which = np.unique(mesh.colours, axis=0, return_inverse=True)
    parts = (compact(Mesh(mesh.vertices, mesh.faces[which.reshape(-1) == k])) for k in range(len(colours)))
    return list(zip(map(tuple, colours.tolist()), parts, strict=True))


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
            out[path] = RobotError(f"mesh {path}: {error}", code=error.code, path=path)
    return out


def _read(path: Path) -> Mesh:
    kind = path.suffix.lower()
    if kind not in MESH_KINDS:
        raise RobotError(f"{kind or 'no extension'!r} is not one of {', '.join(MESH_KINDS)}", code="mesh-kind")
    try:
        content = read_regular_file(path, MAX_MESH_BYTES)
    except (OSError, ValueError) as error:
        code = {errno.EFBIG: "mesh-size", errno.ENXIO: "mesh-kind"}.get(getattr(error, "errno", 0), "mesh-missing")
        raise RobotError(str(error), code=code) from error
    _check(kind, content)
    try:
        pieces = _collada_pieces(content) if kind == ".dae" else _pieces(content, kind)
        vertices, faces, colours, n = list[np.ndarray](), list[np.ndarray](), list[Colour | None](), 0
        for corners, triangles, colour in pieces:
            if sum(map(len, faces)) + len(triangles) > MAX_FACES:
                raise RobotError(f"it has more than {MAX_FACES} triangles", code="mesh-content")
            part = compact(Mesh(np.asarray(corners), triangles))
            vertices.append(part.vertices.astype(np.float32))  # single precision, as the formats have it
            faces.append(part.faces + n)
            colours.append(colour)
            n += len(part.vertices)
    except RobotError:
        raise
    except Exception as error:  # whatever foreign parsers raise about a broken file
        raise RobotError(f"{type(error).__name__}: {error}"[:300], code="mesh-parser") from error
    if not n or not all(np.isfinite(v).all() for v in vertices):
        raise RobotError("it shows no triangles, or has vertices that are not finite", code="mesh-content")
    painted = None
    if 0 < len({*colours} - {None}) <= MOST_COLOURS:
        painted = np.repeat([colour or GREY for colour in colours], [len(f) for f in faces], axis=0)
    return Mesh(np.concatenate(vertices).astype(np.float64), np.concatenate(faces), painted)


def _pieces(content: bytes, kind: str) -> Iterator[Piece]:
    import trimesh

    scene = trimesh.load_scene(io.BytesIO(content), file_type=kind[1:], resolver={}, process=False, skip_materials=True)
    for node in scene.graph.nodes_geometry:
        T, name = scene.graph[node]
        if isinstance(piece := scene.geometry[name], trimesh.Trimesh):
            colour, paint = None, cast(Any, piece.visual)
            if paint.kind in ("vertex", "face"):  # as in OBJ files whose vertices have colours
                red, green, blue, _ = (paint.main_color / 255.0).tolist()
                colour = (red, green, blue, 1.0)
            yield trimesh.transform_points(piece.vertices, T), piece.faces, colour


def _collada_pieces(content: bytes) -> Iterator[Piece]:
    """By the parser that trimesh uses; trimesh itself would walk nodes that double forty times without an end."""
    import collada

    content = re.sub(rb"(</?)convex_mesh\b", rb"\1mesh", content)  # which that parser does not know
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


def _check(kind: str, content: bytes) -> None:
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
        raise RobotError(reason, code="mesh-content")
