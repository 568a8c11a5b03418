"""An output folder that keeps finished parts of a long run, so that an interrupted one goes on where it stopped."""

from __future__ import annotations

import hashlib
import json
from functools import cache
from pathlib import Path
from typing import Any, final

from manip_learn.atomic_write import write_atomically
from manip_learn.errors import OutputError

MARKER = "reproduction.json"
FORMAT = "manip_learn.reproduction"
PARTS = "parts"


@final
class PartStore:
    """Finished parts as JSON files, found again by everything that they depend on.

    Args:
        folder: Output folder; it is made, or must be empty, or one of ours.

    Raises:
        OutputError: The folder holds other files, is a file, or cannot be written.
    """

    def __init__(self, folder: str | Path):
        self.folder = Path(folder).expanduser().resolve()
        marker = self.folder / MARKER
        try:
            if self.folder.exists() and not self.folder.is_dir():
                raise OutputError(f"{self.folder} is a file; give a folder for the results")
            others = [] if not self.folder.exists() else sorted(p.name for p in self.folder.iterdir())
        except OSError as error:
            raise OutputError(f"cannot read {self.folder}: {error.strerror}; choose another folder") from error
        if others and not _is_ours(marker):
            shown = ", ".join(others[:3]) + (" ..." if len(others) > 3 else "")
            raise OutputError(
                f"{self.folder} holds other files ({shown}): give a new or empty folder, or that of an earlier run"
            )
        if not others:
            write_atomically(marker, json.dumps({"format": FORMAT}) + "\n")

    def load(self, key: dict[str, Any]) -> list[dict[str, Any]] | None:
        """What was kept under a key; None if nothing was, or if the file is damaged."""
        path = self._path(key)
        try:
            content = json.loads(path.read_text(encoding="utf-8"))
        except (OSError, ValueError):
            return None
        return content.get("value") if isinstance(content, dict) and content.get("key") == _plain(key) else None

    def keep(self, key: dict[str, Any], value: list[dict[str, Any]]) -> None:
        """Write a finished part, whole or not at all.

        Raises:
            OutputError: It cannot be written.
        """
        write_atomically(self._path(key), json.dumps({"key": _plain(key), "value": value}) + "\n")

    def _path(self, key: dict[str, Any]) -> Path:
        name = str(key.get("experiment", "part")).replace("/", "-")
        return self.folder / PARTS / f"{name}-{_digest(key)[:20]}.json"


@cache
def library_digest() -> str:
    """SHA-256 of the library's source: parts made by other code are not used."""
    digest = hashlib.sha256()
    package = Path(__file__).resolve().parents[1]
    for path in sorted(package.rglob("*.py")):
        digest.update(path.relative_to(package).as_posix().encode())
        digest.update(path.read_bytes())
    return digest.hexdigest()


def _digest(key: dict[str, Any]) -> str:
    return hashlib.sha256(json.dumps(_plain(key), sort_keys=True).encode()).hexdigest()


def _plain(key: dict[str, Any]) -> Any:
    return json.loads(json.dumps(key, sort_keys=True))


def _is_ours(marker: Path) -> bool:
    try:
        content = json.loads(marker.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return False
    return isinstance(content, dict) and content.get("format") == FORMAT
