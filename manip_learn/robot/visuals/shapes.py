"""Shapes to draw: plain data for any viewer."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import final

import numpy as np
from jaxtyping import Float, Int

Colour = tuple[float, float, float, float]


@final
@dataclass(frozen=True)
class Box:
    """A box around its origin; edge lengths x, y, z [m]."""

    size: tuple[float, float, float]


@final
@dataclass(frozen=True)
class Sphere:
    """A sphere around its origin [m]."""

    radius: float


@final
@dataclass(frozen=True)
class Cylinder:
    """A cylinder along z, its middle at the origin [m]."""

    radius: float
    length: float


@final
@dataclass(frozen=True)
class Capsule:
    """A cylinder along z with half spheres on both ends; `length` is that of the cylinder [m]."""

    radius: float
    length: float


@final
@dataclass(frozen=True, eq=False)
class Triangles:
    """A checked mesh: finite vertices, indices in range, scale applied.

    Attributes:
        vertices: shape (n, 3) [m].
        faces: shape (m, 3), counted from 0.
        source: File it was read from.
    """

    vertices: Float[np.ndarray, "n 3"]
    faces: Int[np.ndarray, "m 3"]
    source: Path

    def __post_init__(self) -> None:
        self.vertices.setflags(write=False)
        self.faces.setflags(write=False)


Shape = Box | Sphere | Cylinder | Capsule | Triangles


@final
@dataclass(frozen=True, eq=False)
class Visual:
    """One shape on one link.

    Attributes:
        link: Name of the link.
        joint: Pinocchio id of the moving joint that carries it; 0 is the fixed world.
        placement: shape (4, 4), from the shape to that joint [m].
        shape: What to draw.
        colour: Red, green, blue, opacity in 0 ... 1.
        stand_in: Empty, or why a plain shape is drawn in place of what the file asks for.
    """

    link: str
    joint: int
    placement: Float[np.ndarray, "4 4"]
    shape: Shape
    colour: Colour
    stand_in: str = ""

    def __post_init__(self) -> None:
        self.placement.setflags(write=False)
