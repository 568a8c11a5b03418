"""The task of a `LimitedChild` that parses meshes: loaded by a process of its own, never imported."""

from __future__ import annotations

from collections.abc import Callable


def prepared() -> Callable[[dict[str, str]], dict[str, str]]:
    """The function that writes the vertices and faces of a mesh, job["input"], to a file, job["output"]."""
    import coal
    import numpy as np

    def parse(job: dict[str, str]) -> dict[str, str]:
        mesh = coal.MeshLoader().load(job["input"])
        vertices = np.asarray(mesh.vertices(), dtype=np.float32)
        faces = np.array([[t[0], t[1], t[2]] for t in map(mesh.tri_indices, range(mesh.num_tris))], dtype=np.uint32)
        with open(job["output"], "wb") as file:
            np.savez(file, vertices=vertices.reshape(-1, 3), faces=faces.reshape(-1, 3))
        return {}

    return parse
