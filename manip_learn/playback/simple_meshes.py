"""Meshes made small enough for a page, and smooth where the surface is smooth."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int

from manip_learn.robot.visuals.meshes import Mesh, compact

CREASE = np.cos(np.deg2rad(38.0))  # edges that turn by more stay sharp: twelve-sided cylinders look round
MAX_STEPS = 18  # halvings at most; ten bring the range within 1 per cent


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
        # one cap for all, such that the sum fits
        low, high = 0.0, float(counts.max())
        for _ in range(60):
            cap = 0.5 * (low + high)
            low, high = (cap, high) if np.minimum(counts, cap).sum() <= triangles else (low, cap)
        shares = np.minimum(counts, max(low, 12.0))
        clean = [m if len(m.faces) <= s else _clustered(m, int(s)) for m, s in zip(clean, shares, strict=True)]
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
    for _ in range(MAX_STEPS):
        cells = float(np.sqrt(low * high))
        candidate = _joined(mesh, span / cells)
        if len(candidate.faces) <= target:
            low, best = cells, candidate
        else:
            high = cells
        if high / low < 1.01:
            break
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
    """A group for each corner of each triangle: corners at one vertex share it if smooth edges lead from one to the
    other.
    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    edges = vertices[triangles]
    normals = np.cross(edges[:, 1] - edges[:, 0], edges[:, 2] - edges[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)
    n = len(triangles)
    start, end = triangles.reshape(-1), np.roll(triangles, -1, axis=1).reshape(-1)
    face = np.repeat(np.arange(n), 3)
    here = np.arange(3 * n)  # corner where the edge starts
    there = here.reshape(-1, 3)[:, [1, 2, 0]].reshape(-1)  # corner where it ends
    order = np.lexsort((np.maximum(start, end), np.minimum(start, end)))
    low, high = np.minimum(start, end)[order], np.maximum(start, end)[order]
    same = np.flatnonzero((low[1:] == low[:-1]) & (high[1:] == high[:-1]))
    one, two = order[same], order[same + 1]
    smooth = np.einsum("ij,ij->i", normals[face[one]], normals[face[two]]) > CREASE
    one, two = one[smooth], two[smooth]
    opposite = start[one] == end[two]  # neighbours run along their edge in opposite directions, if both look outward
    joined = [
        (here[one], np.where(opposite, there[two], here[two])),
        (there[one], np.where(opposite, here[two], there[two])),
    ]
    rows, columns = np.concatenate([j[0] for j in joined]), np.concatenate([j[1] for j in joined])
    graph = coo_array((np.ones(len(rows), dtype=np.int8), (rows, columns)), shape=(3 * n, 3 * n))
    return connected_components(graph, directed=False)[1]
