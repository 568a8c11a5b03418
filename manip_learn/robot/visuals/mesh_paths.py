"""Mesh addresses -> files, never outside the folders that belong to the robot."""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import final
from urllib.parse import unquote

from manip_learn.errors import RobotError, advice
from manip_learn.robot.description.catalogue import example_package_dir

LEVELS_UP = 6
PACKAGE_FILE = "package.xml"
# A URDF often lives in <package>/urdf next to <package>/meshes, with or without a package.xml.
URDF_FOLDERS = ("urdf", "urdfs", "robots", "robot", "xacro", "description")


@final
@dataclass(frozen=True)
class MeshRoots:
    """Where meshes of one robot may be looked up, in this order.

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
        return _found(uri, roots)
    except (OSError, ValueError, RuntimeError) as error:  # names too long, NUL bytes, circular links
        raise RobotError(f"mesh {uri[:200]!r} cannot be looked up ({error})", code="mesh-missing") from error


def _found(uri: str, roots: MeshRoots) -> Path:
    scheme, separator, rest = uri.partition("://")
    if not separator:
        return _first_inside(uri, uri.replace("\\", "/"), roots.beside, roots.beside)
    if scheme in ("package", "model"):
        package, _, inside = unquote(rest).partition("/")
        if package in ("", ".", "..") or not inside:
            raise RobotError(f"mesh {uri[:200]!r} names no package and file", code="mesh-missing")
        folders = _package_folders(package, roots)
        return _first_inside(uri, inside, folders, folders)
    if scheme == "file":
        return _first_inside(uri, unquote(rest), roots.beside, roots.beside)
    raise RobotError(
        f"mesh {uri[:200]!r}: addresses of the kind {scheme[:20]!r} are not read; use package:// or a path",
        code="mesh-scheme",
    )


def _package_folders(package: str, roots: MeshRoots) -> tuple[Path, ...]:
    folders = [roots.own[package]] if package in roots.own else []
    folders += [d / package for d in roots.above]
    urdf_folder = roots.beside[0]
    for d in roots.walked:
        candidate = d / package
        if urdf_folder.is_relative_to(candidate) or (candidate / PACKAGE_FILE).is_file():
            folders.append(candidate)
    return tuple(folders)


def _first_inside(uri: str, name: str, folders: tuple[Path, ...], allowed: tuple[Path, ...]) -> Path:
    outside = None
    for folder in folders:
        candidate = folder / name
        if not candidate.exists():
            continue
        real = candidate.resolve()
        if any(real.is_relative_to(a.resolve()) for a in allowed):
            return real
        outside = real
    if outside is not None:
        raise RobotError(
            f"mesh {uri[:200]!r} leads to {outside}, outside the robot's folders"
            + advice("; if that is meant, name its folder with {}", "package_dirs=[...]", "--package-dir FOLDER"),
            code="mesh-outside",
        )
    raise RobotError(
        f"mesh {uri[:200]!r} was not found"
        + advice("; name the folder that contains its package with {}", "package_dirs=[...]", "--package-dir FOLDER"),
        code="mesh-missing",
    )
