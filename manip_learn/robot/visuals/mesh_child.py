"""The child process that parses meshes; run as a script, never imported.

It limits its own memory and time and answers `{"ok": true}` once the parser is loaded. Then it reads jobs from stdin,
one JSON object per line (`{"input": file, "output": file}`), writes vertices and faces to the output, and answers with
one JSON object per line.
"""

from __future__ import annotations

import json
import os
import sys

MEMORY = 512_000_000  # [bytes] of address space; the libraries alone take 150 MB
SECONDS = 60


def main() -> None:
    """Serve jobs until stdin closes."""
    limit_self()
    import coal
    import numpy as np

    # what the parser prints must not get between the answers
    answers = os.fdopen(os.dup(sys.stdout.fileno()), "w")
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    print(json.dumps({"ok": True}), file=answers, flush=True)
    for line in sys.stdin:
        job = json.loads(line)
        try:
            mesh = coal.MeshLoader().load(job["input"])
            vertices = np.asarray(mesh.vertices(), dtype=np.float32)
            faces = np.array([[t[0], t[1], t[2]] for t in map(mesh.tri_indices, range(mesh.num_tris))], dtype=np.uint32)
            with open(job["output"], "wb") as file:
                np.savez(file, vertices=vertices.reshape(-1, 3), faces=faces.reshape(-1, 3))
            answer = {"ok": True}
        except (ValueError, RuntimeError, MemoryError, OSError, IndexError, TypeError) as error:
            answer = {"ok": False, "reason": f"{type(error).__name__}: {error}"[:300]}
        print(json.dumps(answer), file=answers, flush=True)


def limit_self() -> None:
    """Memory, processor time, no core dump, no large files; nothing on systems without such limits."""
    try:
        import resource
    except ImportError:
        return
    for kind, value in (
        (resource.RLIMIT_AS, MEMORY),
        (resource.RLIMIT_CPU, SECONDS),
        (resource.RLIMIT_CORE, 0),
        (resource.RLIMIT_FSIZE, 500_000_000),
    ):
        _, hard = resource.getrlimit(kind)
        if hard != resource.RLIM_INFINITY:
            value = min(value, hard)
        try:
            resource.setrlimit(kind, (value, hard))
        except (ValueError, OSError):
            continue


if __name__ == "__main__":
    main()
