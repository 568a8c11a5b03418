"""Modules of version 0.1 that have another home: importing one says where to look. This file serves one release.

`moved.txt` has a line a module: its name in 0.1, and the module of today if what it held is still there; both without
the package's name. Where a folder became a module (control.policies), Python's own error already names it.
"""

from __future__ import annotations

from collections.abc import Sequence
from importlib.machinery import ModuleSpec
from pathlib import Path
from types import ModuleType
from typing import final


@final
class MovedModules:
    """The last to be asked for a module: for an old name its answer is an error that names the new one."""

    def find_spec(
        self, fullname: str, path: Sequence[str] | None = None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        """None, so that Python goes on as it would.

        Raises:
            ModuleNotFoundError: The name is one of version 0.1, and the error names the module of today.
        """
        package, _, name = fullname.partition(".")
        if package != "manip_learn" or (home := homes().get(name)) is None:
            return None
        words = f"what it held is in manip_learn.{home}: import it from there" if home else "it is gone"
        raise ModuleNotFoundError(f"there is no module {fullname} since manip_learn 0.1; {words}", name=fullname)


def homes() -> dict[str, str]:
    """Module of 0.1 -> module of today, or nothing; both without the package's name."""
    lines = Path(__file__).with_suffix(".txt").read_text(encoding="utf-8").splitlines()
    return {old: new for old, _, new in (line.partition(" ") for line in lines)}
