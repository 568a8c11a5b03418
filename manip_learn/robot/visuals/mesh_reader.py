"""Mesh files -> triangles, parsed in a child process that may crash, hang or run out of memory."""

from __future__ import annotations

import json
import os
import selectors
import subprocess
import sys
import tempfile
import time
import zipfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from manip_learn.errors import RobotError
from manip_learn.robot.visuals.mesh_content import buffer_files, checked_mesh

CHILD = Path(__file__).with_name("mesh_child.py")
START_SECONDS = 30.0  # for the parser to be loaded, from a cold disk on a busy machine
SECONDS = 5.0  # for one mesh
ALL_SECONDS = 60.0  # for all meshes of one robot
MAX_FACES = 2_000_000

Mesh = tuple[Float[np.ndarray, "n 3"], Int[np.ndarray, "m 3"]]


def read_meshes(paths: Sequence[Path], seconds: float = SECONDS) -> dict[Path, Mesh | RobotError]:
    """Vertices [m, unscaled] and faces of each mesh, or why there are none. No error is raised.

    Args:
        paths: Files inside the robot's folders.
        seconds: Time for one mesh [s].
    """
    out: dict[Path, Mesh | RobotError] = {}
    end = time.monotonic() + ALL_SECONDS
    with tempfile.TemporaryDirectory(prefix="manip_learn_") as folder:
        child: _Child | None = None
        for i, path in enumerate(dict.fromkeys(paths)):
            # the parser sees a copy that is alone in its folder, so that it finds no side files
            alone = Path(folder) / str(i)
            alone.mkdir()
            try:
                copy = alone / f"mesh{path.suffix.lower()}"
                content = checked_mesh(path)
                copy.write_bytes(content)
                for name, side in buffer_files(content, path).items():
                    (alone / name).write_bytes(side)
                child = child or _Child(Path(folder))
                child.wait_until_ready(path)
                child.parse(copy, alone / "out.npz", path, min(seconds, end - time.monotonic()))
                out[path] = _loaded(alone / "out.npz", path)
            except RobotError as error:
                out[path] = error
                if child is not None and child.is_lost:
                    child.close()
                    child = None
            finally:
                for file in alone.iterdir():
                    file.unlink()
        if child is not None:
            child.close()
    return out


class _Child:
    """One parsing process; serves many meshes until one of them kills it."""

    def __init__(self, folder: Path):
        environment = {k: v for k, v in os.environ.items() if k in ("PATH", "SYSTEMROOT", "LD_LIBRARY_PATH", "TMPDIR")}
        self.is_lost = self._is_ready = False
        self._process = subprocess.Popen(
            [sys.executable, "-I", str(CHILD)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            cwd=folder,
            env={**environment, "OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"},
        )
        if self._process.stdin is None or self._process.stdout is None:
            raise RobotError("the process that parses meshes has no pipes", code="mesh-parser")
        self._stdin, self._stdout = self._process.stdin, self._process.stdout

    def wait_until_ready(self, original: Path) -> None:
        """Wait for the parser to be loaded; what that takes does not count as the time of a mesh.

        Raises:
            RobotError: Codes `mesh-parser`, `mesh-time`.
        """
        if not self._is_ready:
            self._answer(original, START_SECONDS, "starting the parser")
            self._is_ready = True

    def parse(self, copy: Path, output: Path, original: Path, seconds: float) -> None:
        """Have one mesh parsed.

        Raises:
            RobotError: Codes `mesh-parser`, `mesh-time`.
        """
        try:
            self._stdin.write(json.dumps({"input": str(copy), "output": str(output)}).encode() + b"\n")
            self._stdin.flush()
        except OSError as error:
            self.is_lost = True
            raise _failed(original, "mesh-parser", "the parsing process is gone") from error
        self._answer(original, seconds, "parsing")

    def _answer(self, original: Path, seconds: float, activity: str) -> None:
        with selectors.DefaultSelector() as selector:
            selector.register(self._stdout, selectors.EVENT_READ)
            if seconds <= 0.0 or not selector.select(seconds):
                self.is_lost = True
                raise _failed(original, "mesh-time", f"{activity} took more than {max(seconds, 0.0):.3g} s")
        line = self._stdout.readline()
        if not line.endswith(b"\n"):
            self.is_lost = True
            raise _failed(original, "mesh-parser", "the parser crashed or ran out of memory")
        answer = json.loads(line)
        if not answer.get("ok"):
            self.is_lost = True  # its memory is not reused
            raise _failed(original, "mesh-parser", str(answer.get("reason", "it cannot be parsed")))

    def close(self) -> None:
        """End the process."""
        self._process.kill()
        self._process.communicate()


def _loaded(file: Path, original: Path) -> Mesh:
    try:
        with np.load(file, allow_pickle=False) as data:
            vertices, faces = data["vertices"], data["faces"]
    except (OSError, ValueError, KeyError, zipfile.BadZipFile) as error:
        raise _failed(original, "mesh-parser", "its triangles could not be read back") from error
    is_usable = (
        vertices.ndim == faces.ndim == 2
        and vertices.shape[1:] == faces.shape[1:] == (3,)
        and 0 < len(faces) <= MAX_FACES
        and len(vertices) > 0
        and int(faces.max()) < len(vertices)
        and bool(np.isfinite(vertices).all())
    )
    if not is_usable:
        raise _failed(original, "mesh-content", "it has no triangles, too many, or vertices that are not finite")
    return vertices.astype(np.float64), faces.astype(np.int64)


def _failed(path: Path, code: str, reason: str) -> RobotError:
    return RobotError(f"mesh {path}: {reason}", code=code, path=path)
