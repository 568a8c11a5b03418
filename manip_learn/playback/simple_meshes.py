"""Meshes made small enough for a page, and smooth where the surface is smooth."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int

from manip_learn.robot.visuals.meshes import Mesh, compact

CREASE = np.cos(np.deg2rad(38.0))  # edges that turn by more stay sharp: twelve-sided cylinders look round


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
    # vertices split along sharp edges, so that normals averaged at vertices are right on both sides
    for i, mesh in enumerate(clean):
        pairs = np.column_stack([mesh.faces.reshape(-1), _smooth_groups(mesh.vertices, mesh.faces)])
        unique, index = np.unique(pairs, axis=0, return_inverse=True)
        clean[i] = Mesh(mesh.vertices[unique[:, 0]], index.reshape(-1, 3))
    return clean, before, after


def _clustered(mesh: Mesh, target: int) -> Mesh:
    """Vertices in one cell of a grid become one; the finest grid that meets the target."""
    span = float(np.ptp(mesh.vertices, axis=0).max())
    low, high = 2.0, 4096.0  # cells along the longest side, coarse enough and too fine
    best = _joined(mesh, span / low)
    while high / low > 1.01:
        cells = float(np.sqrt(low * high))
        candidate = _joined(mesh, span / cells)
        if len(candidate.faces) > target:
            high = cells
        else:
            low, best = cells, candidate
    return best


def _joined(mesh: Mesh, cell: float) -> Mesh:
    """Return a mesh whose vertices in one cell of a grid are one; what has no area or occurs twice is left out."""
    steps = np.rint((mesh.vertices - mesh.vertices.min(axis=0)) / cell).astype(np.int64)
    _, index, count = np.unique(steps, axis=0, return_inverse=True, return_counts=True)
    index = index.reshape(-1)
    middle = np.column_stack([np.bincount(index, mesh.vertices[:, k], len(count)) / count for k in range(3)])
    faces = index[mesh.faces]
    corners = np.sort(faces, axis=1)
    kept = np.flatnonzero((np.diff(corners, axis=1) > 0).all(axis=1))
    kept = kept[np.sort(np.unique(corners[kept], axis=0, return_index=True)[1])]
    return compact(Mesh(middle, faces[kept]))


def _smooth_groups(vertices: Float[np.ndarray, "V 3"], triangles: Int[np.ndarray, "F 3"]) -> Int[np.ndarray, " C"]:
    """Return a group for each corner of each triangle: corners at one vertex share it if smooth edges lead from one to
    the other.
    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    sides = vertices[triangles]
    normals = np.cross(sides[:, 1] - sides[:, 0], sides[:, 2] - sides[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)
    vertex, corners = triangles.reshape(-1), np.arange(triangles.size)
    ends = [corners, np.roll(corners.reshape(-1, 3), -1, axis=1).reshape(-1)]  # corners of each edge
    edges = np.sort(vertex[np.array(ends)], axis=0)
    order = np.lexsort(edges)
    one, two = order[:-1], order[1:]
    same = (edges[:, one] == edges[:, two]).all(axis=0)
    smooth = same & (np.einsum("ij,ij->i", normals[one // 3], normals[two // 3]) > CREASE)
    pairs = np.concatenate([[a[one[smooth]], b[two[smooth]]] for a in ends for b in ends], axis=1)
    pairs = pairs[:, vertex[pairs[0]] == vertex[pairs[1]]]
    graph = coo_array((np.ones(pairs.shape[1], dtype=np.int8), tuple(pairs)), shape=(triangles.size, triangles.size))
    return connected_components(graph, directed=False)[1]
