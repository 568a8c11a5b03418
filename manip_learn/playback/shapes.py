"""What is drawn: plain shapes and triangle meshes, each riding on one joint."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, final

import numpy as np
from jaxtyping import Float, Int

ShapeKind = Literal["box", "sphere", "cylinder", "cone", "disc", "mesh"]
Colour = tuple[float, float, float, float]

PLAIN: Colour = (0.80, 0.83, 0.86, 1.0)


@final
@dataclass(frozen=True, eq=False)
class Shape:
    """One drawn body.

    Attributes:
        joint: Index in the kinematic tree of the joint that carries it; 0 is the world.
        kind: What it is.
        size: [m]: box (x, y, z); sphere (radius); cylinder and disc (radius, length); cone (radius at the bottom,
            radius at the top, length); mesh: none. All are centred at their origin, round ones stand along z.
        pose: shape (4, 4), from the shape to the joint's frame [m].
        colour: Red, green, blue, opacity, 0 to 1.
        accent: True if it takes the colour of its rollout.
        mesh: Index in `Appearance.meshes`, or None.
    """

    joint: int
    kind: ShapeKind
    size: tuple[float, ...]
    pose: Float[np.ndarray, "4 4"]
    colour: Colour = PLAIN
    accent: bool = False
    mesh: int | None = None

    def half_extent(self) -> Float[np.ndarray, " 3"]:
        """Half the sides of a box around the shape, in its own frame [m]; zero for meshes, which bring their own."""
        s = self.size
        if self.kind == "box":
            return np.array(s) / 2.0
        if self.kind == "sphere":
            return np.full(3, s[0])
        if self.kind == "mesh":
            return np.zeros(3)
        radius = max(s[:-1])
        return np.array([radius, radius, s[-1] / 2.0])


@final
@dataclass(frozen=True, eq=False)
class TriangleMesh:
    """A triangle mesh in the frame of its shape.

    Attributes:
        vertices: shape (V, 3) [m].
        triangles: shape (F, 3), indices of vertices, counter-clockwise from outside.
    """

    vertices: Float[np.ndarray, "V 3"]
    triangles: Int[np.ndarray, "F 3"]


@final
@dataclass(frozen=True, eq=False)
class Appearance:
    """How a robot looks.

    Attributes:
        shapes: All that is drawn.
        meshes: The triangle meshes that shapes refer to.
        notes: What could not be drawn as the URDF says, in sentences.
    """

    shapes: tuple[Shape, ...]
    meshes: tuple[TriangleMesh, ...] = ()
    notes: tuple[str, ...] = ()
