"""Meshes made small enough for a page, and smooth where the surface is smooth."""

from __future__ import annotations

from bisect import bisect_right

import numpy as np

from manip_learn.robot.visuals.meshes import Mesh, compact

CREASE = np.deg2rad(38.0)  # edges that turn by more stay sharp: twelve-sided cylinders look round


def decimated(meshes: list[Mesh], triangles: int) -> tuple[list[Mesh], int, int]:
    """Simplify meshes until all of them together have at most so many triangles.

    Large meshes give up more than small ones, and no mesh becomes so coarse that it cannot be recognised as long as
    the budget allows it.

    Returns:
        The meshes, their triangles before and after.
    """
    # vertices in one place become one: STL files repeat each of them six times
    clean = [_joined(m, max(1e-6 * float(np.ptp(m.vertices, axis=0).max()), 1e-12)) for m in meshes]
    counts = np.array([len(m.faces) for m in clean], dtype=np.float64)
    before = int(counts.sum())
    if before > triangles:
        # one cap for all, such that the sum fits: small ones stay, the others share what these leave
        ranked = np.sort(counts)
        shares = (triangles - np.cumsum(ranked) + ranked) / np.arange(len(ranked), 0, -1)
        cap = int(max(shares[np.argmax(shares <= ranked)], 12.0))
        clean = [m if len(m.faces) <= cap else _clustered(m, cap) for m in clean]
    after = sum(len(m.faces) for m in clean)
    return [_split_at_edges(m) for m in clean], before, after


def _clustered(mesh: Mesh, target: int) -> Mesh:
    """Vertices in one cell of a grid become one; the finest grid that meets the target."""
    cells = float(np.ptp(mesh.vertices, axis=0).max()) / np.geomspace(2.0, 4096.0, 767)  # [m] each 1 % finer
    finer = bisect_right(cells, target, key=lambda cell: len(_joined(mesh, cell).faces))
    return _joined(mesh, cells[max(finer - 1, 0)])


def _joined(mesh: Mesh, cell: float) -> Mesh:
    """Return a mesh whose vertices in one cell of a grid are one; what has no area or occurs twice is left out."""
    steps = np.rint((mesh.vertices - mesh.vertices.min(axis=0)) / cell).astype(np.int64)
    _, index, count = np.unique(steps, axis=0, return_inverse=True, return_counts=True)
    index = index.reshape(-1)
    middle = np.column_stack([np.bincount(index, mesh.vertices[:, k], len(count)) / count for k in range(3)])
    faces = index[mesh.faces]
    corners, first = np.unique(np.sort(faces, axis=1), axis=0, return_index=True)
    has_area = (np.diff(corners, axis=1) > 0).all(axis=1)
    return compact(Mesh(middle, faces[np.sort(first[has_area])]))


def _split_at_edges(mesh: Mesh) -> Mesh:
    """Return a mesh with vertices split along sharp edges: normals averaged at vertices are right on both sides.

    Corners of triangles at one vertex share it if smooth edges lead from one to the other.
    """
    from trimesh import Trimesh
    from trimesh.graph import connected_component_labels

    solid = Trimesh(mesh.vertices, mesh.faces, process=False)
    smooth = solid.face_adjacency_angles < CREASE
    pairs, ends = solid.face_adjacency[smooth], solid.face_adjacency_edges[smooth]
    # each end of an edge, as a corner of both its triangles
    corners = 3 * pairs[:, None] + np.argmax(mesh.faces[pairs][:, None] == ends[:, :, None, None], axis=-1)
    groups = connected_component_labels(corners.reshape(-1, 2), node_count=mesh.faces.size)
    _, first, index = np.unique(groups, return_index=True, return_inverse=True)
    return Mesh(mesh.vertices[mesh.faces.reshape(-1)[first]], index.reshape(-1, 3))
