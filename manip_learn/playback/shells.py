"""Shells of an arm without meshes, made from its kinematics: how its links run, and how its joints turn.

A shell is the surface on which a distance is zero: that of all bodies of a link, with fillets where they meet.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple, final

import numpy as np
from jaxtyping import Float, Int
from numpy.lib.stride_tricks import sliding_window_view

from manip_learn.robot.visuals.meshes import Mesh

Points = Float[np.ndarray, "P 3"]
Distance = Callable[[Points], Float[np.ndarray, " P"]]  # [m], negative inside


@final
class Body(NamedTuple):
    """Something round that a shell encloses.

    Attributes:
        distance: Of points from it.
        low: shape (3,), and `high`: corners of a box around it [m].
        radius: Where it is slimmest [m].
    """

    distance: Distance
    low: Float[np.ndarray, " 3"]
    high: Float[np.ndarray, " 3"]
    radius: float


def rod(ends: Float[np.ndarray, "2 3"], radii: tuple[float, float]) -> Body:
    """A tapered rod with round ends, from one radius to the other [m]."""
    (start, end), (first, last) = ends, radii
    along, thick = end - start, np.array([[first], [last]])

    def distance(points: Points) -> Float[np.ndarray, " P"]:
        share = np.clip((points - start) @ along / max(float(along @ along), 1e-18), 0.0, 1.0)  # a ball has no length
        return np.linalg.norm(points - start - share[:, None] * along, axis=1) - (first + share * (last - first))

    return Body(distance, (ends - thick).min(axis=0), (ends + thick).max(axis=0), min(radii))


def barrel(pose: Float[np.ndarray, "4 4"], radius: float, half: float) -> Body:
    """A cylinder along the z axis of its pose with rounded edges, of this radius and half length [m]."""
    edge = 0.35 * min(radius, half)
    reach = np.abs(pose[:3, :3]) @ np.array([radius, radius, half])

    def distance(points: Points) -> Float[np.ndarray, " P"]:
        x, y, z = ((points - pose[:3, 3]) @ pose[:3, :3]).T
        over = np.column_stack([np.hypot(x, y) - radius, np.abs(z) - half]) + edge
        return np.linalg.norm(np.maximum(over, 0.0), axis=1) + np.minimum(over.max(axis=1), 0.0) - edge

    return Body(distance, pose[:3, 3] - reach, pose[:3, 3] + reach, min(radius, half))


def shell(bodies: Sequence[Body]) -> Mesh:
    """Return the surface around bodies: a vertex in each cell of a grid that the surface goes through (surface nets).

    Its normals are those of the surface itself, so that few triangles look round.
    """
    radius = min(b.radius for b in bodies)
    fillet = 0.6 * radius  # [m] reach of the fillets where bodies meet

    def distance(points: Points) -> Float[np.ndarray, " P"]:
        """Return how far points are from all bodies, rounded where two are equally near."""
        least = bodies[0].distance(points)
        for body in bodies[1:]:
            other = body.distance(points)
            near = np.maximum(fillet - np.abs(least - other), 0.0)
            least = np.minimum(least, other) - near**2 / (4.0 * fillet)
        return least

    low, high = np.min([b.low for b in bodies], axis=0), np.max([b.high for b in bodies], axis=0)
    # [m] rounds of 18 corners, whose light is that of the round itself; links that are long and slim have 130 cells
    cell = max(radius / 2.8, float((high - low).max()) / 130.0)
    low, high = low - fillet - cell, high + fillet + cell
    nodes = np.moveaxis(np.indices(np.ceil((high - low) / cell).astype(int)), 0, -1)
    inside = distance((low + cell * nodes).reshape(-1, 3)).reshape(nodes.shape[:3]) < 0.0
    corners = sliding_window_view(inside, (2, 2, 2)).reshape(*np.subtract(inside.shape, 1), 8)
    crossed = corners.any(axis=-1) & ~corners.all(axis=-1)
    number = np.cumsum(crossed).reshape(crossed.shape) - 1
    faces = []
    for axis, (e, f) in enumerate(np.eye(3, dtype=int)[[[1, 2], [2, 0], [0, 1]]]):
        # around each edge of the grid that goes through the surface are four cells
        here = np.take(inside, range(inside.shape[axis] - 1), axis)
        edges = np.argwhere(np.diff(inside, axis=axis))
        leaves = here[tuple(edges.T)][:, None]
        a, b, c, d = (number[tuple((edges - back).T)] for back in (e + f, f, 0 * e, e))
        quads = np.where(leaves, np.column_stack([a, b, c, d]), np.column_stack([a, d, c, b]))
        faces += [quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]]
    triangles = np.concatenate(faces)
    vertices = low + cell * (np.argwhere(crossed) + 0.5)
    for k in range(5):  # Newton's method takes them to the surface; before its last two steps they are spread evenly
        vertices = vertices if k < 3 else _spread(vertices, triangles)
        slope = _slope(distance, vertices, 0.05 * cell)
        step = distance(vertices) / np.maximum(np.einsum("ij,ij->i", slope, slope), 0.25)  # 1, and less in an edge
        vertices = vertices - np.clip(step[:, None] * slope, -0.5 * cell, 0.5 * cell)
    normals = _slope(distance, vertices, 0.05 * cell)
    return Mesh(vertices, triangles, normals=normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-9))


def _slope(distance: Distance, points: Points, step: float) -> Points:
    """Return the gradient of a distance by central differences."""
    aside = step * np.eye(3)
    return np.column_stack([distance(points + d) - distance(points - d) for d in aside]) / (2.0 * step)


def _spread(vertices: Points, triangles: Int[np.ndarray, "F 3"]) -> Points:
    """Return each vertex moved to the middle of its neighbours: light on evenly spaced ones shows no pattern."""
    start, end = triangles.reshape(-1), np.roll(triangles, -1, axis=1).reshape(-1)
    count = np.bincount(start, minlength=len(vertices))[:, None]
    return np.column_stack([np.bincount(start, vertices[end, k], len(vertices)) for k in range(3)]) / count
