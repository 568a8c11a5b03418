"""Expand xacro files to URDF, on request. Expressions of the file's author run in a separate process with limits.

That process runs this file as a script; therefore its functions import the parts of the package that they need.
"""

from __future__ import annotations

import contextlib
import json
import math
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Any

EXPANSION_SECONDS = 20  # [s] processor time for one file; the largest robots take 3
EXPANSION_MEMORY = 1_000_000_000  # [bytes] memory of the process; the libraries alone take 100 MB
Finder = Callable[[str], Path | None]  # name of a package -> its folder, None if it is not found


def expand_xacro(path: Path, asked: bool | Mapping[str, str], package_dirs: Sequence[Path], find: Finder) -> bytes:
    """Return the text of the URDF that a xacro file expands to.

    Args:
        path: The .xacro file.
        asked: True to allow the expansion, or a mapping with the values of the file's arguments (`<xacro:arg>`); False
            to refuse it.
        package_dirs: Folders that contain the packages of `$(find ...)`; the folders above the file are searched too.
        find: Function that takes the name of any other package and returns its folder, or None.

    Raises:
        RobotError: Codes `xacro` (`asked` is False), `xacro-arg` (no such argument), `xacro-failed` (expressions are
            wrong, or take more than 20 s or 1 GB), `no-links`, and the codes of `read_description`.
        MissingExtraError: xacrodoc is not installed.
    """
    from manip_learn.errors import MissingExtraError, RobotError, advice, closest_names
    from manip_learn.robot.description.text import MAX_BYTES, RULES, quoted, read_description

    def refusal(code: str, sentence: str) -> RobotError:
        return RobotError(f"{path}: {sentence}", code=code, path=path)

    read_description(path)
    if asked is False:
        how = advice("{}", "load_robot(..., xacro=True)", "--xacro") or "xacro robot.xacro > robot.urdf"
        reason = "a xacro file is expanded only on request, since it runs expressions and includes other files"
        raise refusal("xacro", f"{reason}; if you trust it: {how}")
    values = {} if asked is True else asked
    if not isinstance(values, Mapping) or not all(isinstance(name, str) for name in values):
        raise refusal("xacro-arg", f"xacro is {asked!r:.80}; True, or a mapping {{argument: value}}, is needed")
    if find_spec("xacro") is None or find_spec("xacrodoc") is None:
        raise MissingExtraError(f"the xacro file {path}", "xacro")
    packages = {p.name: str(p.absolute()) for d in package_dirs for p in d.iterdir() if p.is_dir()}
    job = {"path": str(path.absolute()), "packages": packages, "most": MAX_BYTES, "seconds": EXPANSION_SECONDS}
    job["values"] = {name: str(value) for name, value in values.items()}
    job["search"] = [p or os.getcwd() for p in sys.path]
    folder: Path | None = path
    while folder:  # run again with each package that was found
        command = [sys.executable, "-I", __file__, json.dumps(job)]
        where, most = path.absolute().parent, 10 * EXPANSION_SECONDS  # [s] wall clock, for slow disks and busy machines
        try:
            process = subprocess.run(command, capture_output=True, cwd=where, timeout=most)
            is_late = os.name == "posix" and process.returncode == -signal.SIGXCPU
            answer = json.loads(process.stdout) if process.returncode == 0 else None
        except subprocess.TimeoutExpired:
            is_late, answer = True, None
        if answer is None:
            reason = f"it took more than {EXPANSION_SECONDS} s" if is_late else "it crashed or ran out of memory"
            limits = f"its expressions may take {EXPANSION_SECONDS} s and {EXPANSION_MEMORY // 1_000_000_000} GB"
            raise refusal("xacro-failed", f"xacro could not be expanded: {reason}; {limits}")
        lacking = answer["lacking"]
        folder = None if lacking in packages else find(lacking)
        if folder:
            packages[lacking] = str(folder)
    declared, text, macros = answer["declared"], answer["text"], answer["macros"]
    give = advice(": give one with {}", "xacro={NAME: VALUE}", "--xacro-arg NAME=VALUE")
    arguments = f"; the file has the arguments {', '.join(declared)}{give}" if declared else ""
    if answer["fault"]:
        reason, fix = f"({' '.join(answer['fault'].split())[:300]})", f"correct it{arguments}"
        if lacking:
            reason = f"the package {lacking!r:.80} of $(find ...) was not found"
            fix = advice("name the folder that contains it with {}", "package_dirs=[...]", "--package-dir FOLDER")
        raise refusal("xacro-failed", f"xacro could not be expanded: {reason}; {fix or 'set ROS_PACKAGE_PATH'}")
    if unknown := sorted(set(values) - set(declared)):  # xacro itself would ignore it
        choices = ", ".join(map(repr, closest_names(unknown[0], declared) or declared)) or "none"
        raise refusal("xacro-arg", f"the xacro file has no argument {unknown[0]!r}; it has {choices}")
    if (declared or macros) and not re.search(r"<link\b", text):
        settings = ", ".join(f"{name}={value}" for name, value in values.items()) or "no arguments"
        other = f", or load the file that calls its macros {quoted(macros)}" if macros else ""
        reason = f"expanded with {settings} it has no <link>; at least one is expected{arguments}{other}"
        raise refusal("no-links", reason if declared else RULES["no-links.macros"].format(names=quoted(macros)))
    return text.encode()


def _expand(job: dict[str, Any]) -> dict[str, Any]:
    """Expand the file of a job; return the text, a fault, a lacking package, and declared arguments and macros."""
    import xacro
    from xacrodoc import XacroDoc, packages

    parse, sources = xacro.parse, dict[Path, bytes]()
    # arguments may be used without a declaration: xacro accepts both
    patterns = {
        "declared": rb"<xacro:arg\b[^>]*\bname\s*=\s*[\"']([\w-]+)[\"']|\$\(arg\s+([\w-]+)\s*\)",
        "macros": rb"<(?:xacro:)?macro\b[^>]*\bname\s*=\s*[\"']([\w-]+)[\"']",
    }

    def parse_and_note(inp: Any, filename: str | None = None) -> Any:
        place = Path(xacro.root_dir, filename or job["path"])
        if place.is_file():  # otherwise xacro reports the missing file
            sources[place] = place.read_bytes()
        return parse(inp, filename)

    xacro.parse, xacro.root_dir = parse_and_note, os.path.dirname(job["path"])
    packages.update_package_cache(job["packages"])
    text = fault = lacking = ""
    try:
        text = XacroDoc.from_file(job["path"], subargs=job["values"]).to_urdf_string()
    except Exception as error:  # expressions of the author may raise anything
        cause = getattr(error, "exc", None) or error
        lacking = str(cause.args[0]) if isinstance(cause, packages.PackageNotFoundError) else ""
        lacks_memory = isinstance(cause, MemoryError)
        fault = f"{'there is not enough memory ' if lacks_memory else ''}{error}" or type(error).__name__
    if len(text) > job["most"]:
        text, fault = "", f"the URDF has {len(text)} characters, at most {job['most']} are read"
    answer = {"text": text, "fault": fault, "lacking": lacking}
    for key, pattern in patterns.items():
        matches = re.finditer(pattern, b"\n".join(sources.values()))
        answer[key] = sorted({match[match.lastindex or 0].decode(errors="replace") for match in matches})
    return answer


def _limit_self(seconds: float) -> None:
    """Limit this process's memory, processor time and core files, if the operating system supports limits."""
    with contextlib.suppress(ImportError):
        import resource

        cpu = math.ceil(time.process_time() + seconds)
        limits = {resource.RLIMIT_AS: EXPANSION_MEMORY, resource.RLIMIT_CPU: cpu, resource.RLIMIT_CORE: 0}
        for kind, value in limits.items():
            hard = resource.getrlimit(kind)[1]
            with contextlib.suppress(ValueError, OSError):
                resource.setrlimit(kind, (value if hard == resource.RLIM_INFINITY else min(value, hard), hard))


if __name__ == "__main__":
    job = json.loads(sys.argv[1])
    sys.path[:] = job["search"]
    _limit_self(job["seconds"])
    with contextlib.redirect_stdout(None):  # keep the output of libraries out of the answer
        answer = _expand(job)
    print(json.dumps(answer))
