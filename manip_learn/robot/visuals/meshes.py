"""Find the mesh files of a robot, inside its folders, and read their triangles.

Files come from users and are parsed by trimesh. Before that, a file is checked: size, type, and the content that it
declares. Materials and pictures to which it refers are not read.
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
Piece = tuple[np.ndarray, np.ndarray, Colour | None]  # vertices and triangles of one colour

MESH_KINDS = (".stl", ".obj", ".dae")
GREY: Colour = (0.7, 0.7, 0.72, 1.0)  # red, green, blue and opacity of shapes without a colour

PACKAGE_FILE = "package.xml"
# a URDF is often in <package>/urdf next to <package>/meshes, with or without a package.xml
URDF_FOLDERS = ("urdf", "urdfs", "robots", "robot", "xacro", "description")


@final
@dataclass(frozen=True)
class MeshRoots:
    """Folders in which the meshes of a robot may be found, searched in this order.

    Attributes:
        relative: Folders for relative addresses, the URDF's folder first.
        parents: Folders that may contain any package.
        ancestors: Folders above the URDF. A package in them must contain the URDF or a package.xml, so that an address
            such as `package://etc/...` cannot read system files.
        packages: Name in a package.xml -> folder, for package folders that were renamed.
    """

    relative: tuple[Path, ...]
    parents: tuple[Path, ...]
    ancestors: tuple[Path, ...]
    packages: dict[str, Path]


def mesh_roots(urdf: Path, package_dirs: Sequence[Path]) -> MeshRoots:
    """Return the folders in which the meshes of a robot may be found.

    They are the folder of its description, the package folders, the folders above, the folders of ROS_PACKAGE_PATH and
    AMENT_PREFIX_PATH, and example-robot-data.

    Args:
        urdf: File of the description.
        package_dirs: Folders of mesh packages.
    """
    folder, n_levels = urdf.resolve().parent, 6  # number of folders above that may hold the package
    roots = [Path(d).resolve() for d in package_dirs]
    ancestors = [p for p in (folder, *folder.parents[:n_levels]) if p != p.parent]
    home = folder.parent if folder.name.lower() in URDF_FOLDERS else folder
    home = next((p for p in ancestors if (p / PACKAGE_FILE).is_file()), home)
    ros, prefixes = _folders_of("ROS_PACKAGE_PATH"), _folders_of("AMENT_PREFIX_PATH")
    # a package folder may be the package itself
    packages = {p.name: p for p in (*roots, *ros)}
    packages |= {name: p for p in [*ancestors, *roots, *ros] if (name := _package_name(p))}
    parents = [*roots, folder, *ros, *(p / "share" for p in prefixes), *filter(None, [example_package_dir()])]
    relative = tuple(dict.fromkeys([folder, *roots, home]))
    return MeshRoots(relative, tuple(dict.fromkeys(parents)), tuple(ancestors), packages)


def _folders_of(variable: str) -> list[Path]:
    """Return the folders in an environment variable."""
    return [Path(d) for d in os.environ.get(variable, "").split(os.pathsep) if d]


def _package_name(folder: Path) -> str:
    """Return the name in the package.xml of a folder; empty without one."""
    file = folder / PACKAGE_FILE
    if not file.is_file():
        return ""
    with file.open("rb") as opened:
        match = re.search(rb"<name>\s*([\w.-]+)\s*</name>", opened.read(20_000))
    return match.group(1).decode() if match else ""


def find_mesh(uri: str, roots: MeshRoots) -> Path:
    """Return the file of a mesh address, with symbolic links resolved.

    Args:
        uri: Path, file://, package:// or model:// address.
        roots: Folders of the robot.

    Raises:
        RobotError: The file does not exist or may not be read; codes `mesh-scheme`, `mesh-missing`, `mesh-outside`.
    """
    try:
        name, folders = _split_address(uri, roots)
        files = [(folder / name).resolve() for folder in folders if (folder / name).exists()]
        inside = (real for real in files if any(real.is_relative_to(folder.resolve()) for folder in folders))
        if (real := next(inside, None)) is not None:
            return real
        existing = next((folder for folder in folders if folder.is_dir()), None)
    except (OSError, ValueError, RuntimeError) as error:  # names too long, NUL bytes, circular links
        raise RobotError(f"mesh {uri[:200]!r} cannot be looked up ({error})", code="mesh-missing") from error
    reason, fix = "was not found", "; name the folder that contains its package with {}"
    if files:
        reason, fix = f"leads to {files[-1]}, outside the robot's folders", "; if intended, name its folder with {}"
    elif "$(" in uri:
        fix = "; it is xacro: name the file *.xacro" + advice(" and load it with {}", "xacro=True", "--xacro")
    elif existing is not None:
        fix = "; correct its address" + ("" if Path(name).is_absolute() else f", or put it into {existing}")
    reason += advice(fix, "package_dirs=[...]", "--package-dir FOLDER") if "{}" in fix else fix
    raise RobotError(f"mesh {uri[:200]!r} {reason}", code="mesh-outside" if files else "mesh-missing")


def _split_address(uri: str, roots: MeshRoots) -> tuple[str, Sequence[Path]]:
    """Return the name of a mesh, and the folders to search."""
    scheme, separator, rest = uri.partition("://")
    if not separator or scheme == "file":
        return unquote(rest) if separator else uri.replace("\\", "/"), roots.relative
    if scheme not in ("package", "model"):
        sentence = f"addresses of the kind {scheme[:20]!r} are not supported; use package:// or a path"
        raise RobotError(f"mesh {uri[:200]!r}: {sentence}", code="mesh-scheme")
    package, _, inside = unquote(rest).partition("/")
    if package in ("", ".", "..") or not inside:
        raise RobotError(f"mesh {uri[:200]!r} names no package and file", code="mesh-missing")
    return inside, _package_folders(package, roots)


def find_package(package: str, urdf: Path, package_dirs: Sequence[Path]) -> Path | None:
    """Return the folder of a package, as it is found for meshes; None if there is none.

    Args:
        package: Name of the package.
        urdf: File of the description.
        package_dirs: Folders of mesh packages.
    """
    is_name = re.fullmatch(r"\w[\w.-]{0,199}", package)
    folders = _package_folders(package, mesh_roots(urdf, package_dirs)) if is_name else []
    return next((folder for folder in folders if folder.is_dir()), None)


def _package_folders(package: str, roots: MeshRoots) -> list[Path]:
    """Return the folders that may be the package, in order."""
    folders = [roots.packages[package]] if package in roots.packages else []
    folders += [d / package for d in roots.parents]
    above = (d / package for d in roots.ancestors)
    folders += [p for p in above if roots.relative[0].is_relative_to(p) or (p / PACKAGE_FILE).is_file()]
    if not folders[len(roots.parents) :]:  # a package in a neighbouring repository, or one whose folder was renamed
        for depth in ("*", "*/*"):
            files = roots.relative[-1].parent.glob(f"{depth}/{PACKAGE_FILE}")
            folders += [p.parent for p in files if package in (p.parent.name, _package_name(p.parent))]
    return folders


@final
class Mesh(NamedTuple):
    """Triangle mesh.

    Attributes:
        vertices: Vertices (n, 3) [m]; of a mesh from a file, without the scale in the URDF.
        faces: Indices (m, 3) of the vertices of each triangle, counter-clockwise as seen from outside.
        colours: Red, green, blue and opacity of each triangle, 0 to 1, shape (m, 4); None if not known.
        normals: Outward unit normals at the vertices (n, 3); None to compute them from the faces.
    """

    vertices: Float[np.ndarray, "n 3"]
    faces: Int[np.ndarray, "m 3"]
    colours: Float[np.ndarray, "m 4"] | None = None
    normals: Float[np.ndarray, "n 3"] | None = None


def compact(mesh: Mesh) -> Mesh:
    """Return a mesh without its unused vertices and without colours.

    Args:
        mesh: The mesh.
    """
    used, index = np.unique(mesh.faces, return_inverse=True)
    return Mesh(mesh.vertices[used], index.reshape(-1, 3))


def by_colour(mesh: Mesh) -> list[tuple[Colour | None, Mesh]]:
    """Split a mesh by colour.

    Args:
        mesh: The mesh.

    Returns:
        Pairs of a colour and the mesh of its triangles; the single pair (None, `mesh`) if the mesh has no colours.
    """
    if mesh.colours is None:
        return [(None, mesh)]
    colours, which = np.unique(mesh.colours, axis=0, return_inverse=True)
    parts = (compact(Mesh(mesh.vertices, mesh.faces[which.reshape(-1) == k])) for k in range(len(colours)))
    return list(zip(map(tuple, colours.tolist()), parts, strict=True))


def open_edges(mesh: Mesh) -> int:
    """Return the number of edges that do not lie between exactly two triangles; 0 if the mesh is closed.

    Args:
        mesh: The mesh; vertices at the same position are treated as one.
    """
    corners = np.unique(mesh.vertices, axis=0, return_inverse=True)[1].reshape(-1)[mesh.faces]
    edges = np.sort(corners[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    return int(np.sum(np.unique(edges, axis=0, return_counts=True)[1] != 2))


def read_meshes(paths: Sequence[Path]) -> dict[Path, Mesh | RobotError]:
    """Read mesh files; errors are returned, not raised.

    Args:
        paths: Files inside the robot's folders.

    Returns:
        Dictionary from each file to its mesh, or to the error with which it is refused (codes `mesh-*`).
    """
    out: dict[Path, Mesh | RobotError] = {}
    for path in dict.fromkeys(paths):
        try:
            out[path] = _read(path)
        except RobotError as error:
            out[path] = RobotError(f"mesh {path}: {error}", code=error.code, path=path)
    return out


def _read(path: Path) -> Mesh:
    """Read and check one mesh.

    Raises:
        RobotError: Codes `mesh-kind`, `mesh-size`, `mesh-missing`, `mesh-content`, `mesh-parser`.
    """
    # largest size of a file (a million triangles of STL), largest number of triangles (0.1 GB), and of colours (each is
    # drawn by itself; a mesh with more is grey)
    most_bytes, most_faces, most_colours = 50_000_000, 2_000_000, 64
    kind = path.suffix.lower()
    if kind not in MESH_KINDS:
        raise RobotError(f"{kind or 'no extension'!r} is not one of {', '.join(MESH_KINDS)}", code="mesh-kind")
    try:
        content = read_regular_file(path, most_bytes)
    except (OSError, ValueError) as error:
        code = {errno.EFBIG: "mesh-size", errno.ENXIO: "mesh-kind"}.get(getattr(error, "errno", 0), "mesh-missing")
        raise RobotError(str(error), code=code) from error
    _check_content(kind, content)
    try:
        pieces = _collada_pieces(content) if kind == ".dae" else _pieces(content, kind)
        vertices, faces, colours, n = list[np.ndarray](), list[np.ndarray](), list[Colour | None](), 0
        for corners, triangles, colour in pieces:
            if sum(map(len, faces)) + len(triangles) > most_faces:
                raise RobotError(f"it has more than {most_faces} triangles", code="mesh-content")
            part = compact(Mesh(np.asarray(corners), triangles))
            vertices.append(part.vertices.astype(np.float32))  # single precision, as in the formats
            faces.append(part.faces + n)
            colours.append(colour)
            n += len(part.vertices)
    except RobotError:
        raise
    except Exception as error:  # parsers of others may raise anything for a broken file
        raise RobotError(f"{type(error).__name__}: {error}"[:300], code="mesh-parser") from error
    if not n or not all(np.isfinite(v).all() for v in vertices):
        raise RobotError("it has no triangles, or has vertices that are not finite", code="mesh-content")
    painted = None
    if 0 < len({*colours} - {None}) <= most_colours:
        painted = np.repeat([colour or GREY for colour in colours], [len(f) for f in faces], axis=0)
    return Mesh(np.concatenate(vertices).astype(np.float64), np.concatenate(faces), painted)


def _pieces(content: bytes, kind: str) -> Iterator[Piece]:
    """Yield the pieces of an STL or OBJ file."""
    import trimesh

    scene = trimesh.load_scene(io.BytesIO(content), file_type=kind[1:], resolver={}, process=False, skip_materials=True)
    for node in scene.graph.nodes_geometry:
        T, name = scene.graph[node]
        if isinstance(piece := scene.geometry[name], trimesh.Trimesh):
            colour, paint = None, cast(Any, piece.visual)
            if paint.kind in ("vertex", "face"):  # e.g. OBJ files whose vertices have colours
                red, green, blue, _ = (paint.main_color / 255.0).tolist()
                colour = (red, green, blue, 1.0)
            yield trimesh.transform_points(piece.vertices, T), piece.faces, colour


def _collada_pieces(content: bytes) -> Iterator[Piece]:
    """Yield the pieces of a COLLADA file.

    It uses trimesh's parser directly; trimesh itself would walk forty levels of doubled nodes without an end.
    """
    import collada

    content = re.sub(rb"(</?)convex_mesh\b", rb"\1mesh", content)  # that parser does not know convex_mesh
    file = collada.Collada(io.BytesIO(content), ignore=[collada.common.DaeError])
    if any(isinstance(error, collada.common.DaeBrokenRefError) for error in file.errors):
        # the parser also drops a mesh with a broken material: read again without materials
        first, *others = content.split(b"<bind_material")
        content = first + b"".join(part.partition(b"</bind_material>")[2] for part in others)
        file = collada.Collada(io.BytesIO(content), ignore=[collada.common.DaeError])
    unit = float(file.assetInfo.unitmeter or 1.0)  # [m] the file's unit; the parser does not convert
    pending = [(node, np.diag([unit, unit, unit, 1.0])) for node in file.scene.nodes]
    most_nodes = 20_000  # nodes, each counted at every use
    for _ in range(most_nodes):
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
    raise ValueError(f"more than {most_nodes} nodes")


def _diffuse(effect: Any) -> Colour | None:
    """Return the diffuse colour of a COLLADA effect; None for a texture, and for an invalid colour."""
    # the parser would return black for a missing texture
    node = effect.xmlnode.find(".//{*}diffuse/{*}color")
    rgba = [] if node is None else [min(max(float(word), 0.0), 1.0) for word in (node.text or "").split()]
    if len(rgba) not in (3, 4) or not np.isfinite(rgba).all():
        return None
    # exporters disagree on the meaning of the fourth number, so it is not used as opacity
    return (rgba[0], rgba[1], rgba[2], 1.0)


def _check_content(kind: str, content: bytes) -> None:
    """Refuse a file that claims more content than it has, or content that does not match its ending."""
    head, reason = content[:4_096], ""  # [bytes] in which a file declares its kind
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
    # the parser would unpack any ZIP file, whatever its first bytes; every ZIP file contains zeros
    elif not content.lstrip(b"\xef\xbb\xbf \t\r\n").startswith(b"<") or b"<COLLADA" not in head or b"\0" in content:
        reason = "it is not a COLLADA document"
    elif b"<!DOCTYPE" in content or b"<!ENTITY" in content:
        reason = "it has a <!DOCTYPE>"
    if reason:
        raise RobotError(reason, code="mesh-content")
