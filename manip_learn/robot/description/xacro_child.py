"""The task of a `LimitedChild` that expands xacro files: loaded by a process of its own, never imported."""

from __future__ import annotations

import os
import re
from collections.abc import Callable
from typing import Any
from xml.parsers.expat import ExpatError

DECLARED = re.compile(rb"<xacro:arg\b[^>]*\bname\s*=\s*[\"']([^\"']+)[\"']")
FORBIDDEN = (b"<!DOCTYPE", b"<!ENTITY")


def declared_in(content: bytes) -> set[str]:
    """Names of the arguments (`<xacro:arg>`) that a file declares."""
    return {name.decode(errors="replace") for name in DECLARED.findall(content)}


def prepared() -> Callable[[dict[str, Any]], dict[str, Any]]:
    """The function that expands a file.

    A job has the `path`, the `values` of arguments, the `packages` (name -> folder), and the `most` bytes of a file.
    The answer has the `text` and the names of arguments that included files have `declared`; or the `fault`, and the
    path of an included file with a `doctype`.
    """
    import xacro
    from xacro import XacroException
    from xacrodoc import XacroDoc, packages
    from xacrodoc.packages import PackageNotFoundError

    parse = xacro.parse

    def expand(job: dict[str, Any]) -> dict[str, Any]:
        declared: set[str] = set()

        def checked(inp: Any, filename: str | None = None) -> Any:
            """As xacro parses, but for files that are no plain ones: too large, or with a DOCTYPE."""
            place = os.path.join(xacro.root_dir, filename or "")
            if inp is None and os.path.isfile(place):  # otherwise xacro says what is missing
                with open(place, "rb") as file:
                    content = file.read(job["most"] + 1)
                if len(content) > job["most"]:
                    raise OSError(f"{place}: more than {job['most']} bytes")
                if any(word in content for word in FORBIDDEN):
                    raise _Doctype(place)
                declared.update(declared_in(content))
            return parse(inp, filename)

        xacro.parse, xacro.root_dir = checked, os.path.dirname(job["path"])
        packages.update_package_cache(job["packages"])
        try:
            text = XacroDoc.from_file(job["path"], subargs=job["values"]).to_urdf_string()
        except _Doctype as error:
            return {"fault": "", "doctype": str(error)}
        except (XacroException, PackageNotFoundError, ExpatError) as error:
            lacks_memory = isinstance(getattr(error, "exc", None), MemoryError)
            return {"fault": f"{'there is not enough memory ' if lacks_memory else ''}{error}"}
        if len(text) > job["most"]:
            return {"fault": f"the URDF has {len(text)} characters, at most {job['most']} are read"}
        return {"text": text, "declared": sorted(declared)}

    return expand


class _Doctype(Exception):
    pass
