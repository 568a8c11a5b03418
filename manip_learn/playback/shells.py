"""Shells of an arm without meshes, made from its kinematics: how its links run, and how its joints turn.

A shell is the surface on which a distance is zero: that of all bodies of a link, with fillets where they meet.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple, final

import numpy as np
from jaxtyping import Float, Int

from manip_learn.robot.visuals.meshes import Mesh

Points = Float[np.ndarray, "P 3"]
Distance = Callable[[Points], Float[np.ndarray, " P"]]  # [m], negative inside
CELLS = 4.0  # of the grid in the slimmest radius: rounds of 25 corners
FILLET = 0.6  # reach of the fillets where bodies meet, share of the slimmest radius
_ROUNDED = 0.35  # radius of the edges of barrels, share of their radius
MOST_CELLS = 240  # along the longest side, of links that are long and slim
_BLOCK = 6  # cells along the side of a block that is asked about as a whole
_STEPS = 3  # of Newton's method, from the middle of a cell, half a cell away, to the surface
SPREADS = 2  # further ones, before each of which the vertices are spread evenly


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
    edge = _ROUNDED * min(radius, half)
    reach = np.abs(pose[:3, :3]) @ np.array([radius, radius, half])

    def distance(points: Points) -> Float[np.ndarray, " P"]:
        x, y, z = ((points - pose[:3, 3]) @ pose[:3, :3]).T
        over = np.column_stack([np.hypot(x, y) - radius, np.abs(z) - half]) + edge
        return np.linalg.norm(np.maximum(over, 0.0), axis=1) + np.minimum(over.max(axis=1), 0.0) - edge

    return Body(distance, pose[:3, 3] - reach, pose[:3, 3] + reach, min(radius, half))


def blended(bodies: Sequence[Body], fillet: float) -> Distance:
    """Distance from all of them, rounded where two are equally near."""

    def distance(points: Points) -> Float[np.ndarray, " P"]:
        least = bodies[0].distance(points)
        for body in bodies[1:]:
            other = body.distance(points)
            near = np.maximum(fillet - np.abs(least - other), 0.0)
            least = np.minimum(least, other) - near**2 / (4.0 * fillet)
        return least

    return distance


def shell(bodies: Sequence[Body]) -> Mesh:
    """The surface around bodies: a vertex in each cell of a grid that the surface goes through (surface nets)."""
    radius = min(b.radius for b in bodies)
    distance = blended(bodies, FILLET * radius)
    low, high = np.min([b.low for b in bodies], axis=0), np.max([b.high for b in bodies], axis=0)
    cell = max(radius / CELLS, float((high - low).max()) / MOST_CELLS)
    low = low - FILLET * radius - cell
    inside = _inside(distance, low, cell, np.ceil((high + FILLET * radius + cell - low) / cell).astype(int))
    n = np.array(inside.shape) - 1
    corners = [inside[x : x + n[0], y : y + n[1], z : z + n[2]] for x, y, z in np.ndindex(2, 2, 2)]
    crossed = np.any(corners, axis=0) & ~np.all(corners, axis=0)
    number = np.full(crossed.shape, -1)
    number[crossed] = np.arange(crossed.sum())
    faces = []
    for axis in range(3):  # around each edge of the grid that goes through the surface are four cells
        here, there = (np.take(inside, range(k, n[axis] + k), axis) for k in (0, 1))
        edges, (e, f) = np.argwhere(here != there), np.eye(3, dtype=int)[[(axis + 1) % 3, (axis + 2) % 3]]
        a, b, c, d = (number[tuple((edges - back).T)] for back in (e + f, f, 0 * e, e))
        leaves = here[tuple(edges.T)][:, None]
        quads = np.where(leaves, np.column_stack([a, b, c, d]), np.column_stack([a, d, c, b]))
        faces += [quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]]
    triangles = np.concatenate(faces)
    vertices, aside = low + cell * (np.argwhere(crossed) + 0.5), 0.05 * cell * np.eye(3)
    for k in range(_STEPS + SPREADS):  # Newton's method takes them to the surface
        vertices = vertices if k < _STEPS else _spread(vertices, triangles)
        slope = np.column_stack([distance(vertices + d) - distance(vertices - d) for d in aside]) / (0.1 * cell)
        step = distance(vertices) / np.maximum(np.einsum("ij,ij->i", slope, slope), 0.25)  # 1, and less in an edge
        vertices = vertices - np.clip(step[:, None] * slope, -0.5 * cell, 0.5 * cell)
    return Mesh(vertices, triangles)


def _spread(vertices: Points, triangles: Int[np.ndarray, "F 3"]) -> Points:
    """Each vertex in the middle of its neighbours: light on evenly spaced ones shows no pattern."""
    start, end = triangles.reshape(-1), np.roll(triangles, -1, axis=1).reshape(-1)
    count = np.bincount(start, minlength=len(vertices))[:, None]
    return np.column_stack([np.bincount(start, vertices[end, k], len(vertices)) for k in range(3)]) / count


def _inside(distance: Distance, low: Float[np.ndarray, " 3"], cell: float, count: Int[np.ndarray, " 3"]) -> np.ndarray:
    """Which nodes of a grid are inside; where a whole block of them is far from the surface, all are as its middle."""
    blocks = -(-count // _BLOCK)
    middle = low + cell * (_BLOCK * np.argwhere(np.ones(blocks)) + (_BLOCK - 1) / 2.0)
    far = distance(middle)
    inside = (far < 0.0).reshape(blocks)
    for axis in range(3):
        inside = np.repeat(inside, _BLOCK, axis)
    near = np.argwhere((np.abs(far) < _BLOCK * cell).reshape(blocks))  # half a block's diagonal is 0.87 of its side
    nodes = (_BLOCK * near[:, None, :] + np.array(list(np.ndindex(_BLOCK, _BLOCK, _BLOCK)))).reshape(-1, 3)
    inside[tuple(nodes.T)] = distance(low + cell * nodes) < 0.0
    return inside
