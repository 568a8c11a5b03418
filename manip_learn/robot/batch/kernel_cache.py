"""numba's compiler with a cache on disk that knows all kernels of this library (the optional extra `fast`).

numba's own cache sees changes of the file of a function only, not of the functions that it calls from other files:
after an upgrade it would go on with the old ones in silence. Here the folder of the cache is named after the content of
all kernel files. Without numba the kernels are plain Python functions: slow, and good for comparison only.
"""

from __future__ import annotations

import hashlib
import logging
import threading
from collections.abc import Callable
from pathlib import Path
from types import FunctionType
from typing import Any

try:
    import numba
except ImportError:
    numba = None

# numba fills its settings in while it runs: no type checker can know them
_SETTINGS: Any = None if numba is None else numba.config  # pyright: ignore[reportPrivateImportUsage]

FIRST_COMPILE = "compiling the controller, once per machine and version of the library: about a minute"
_LOGGER = logging.getLogger("manip_learn")

PACKAGE = Path(__file__).resolve().parents[2]  # two folders up: manip_learn
KERNEL_FILES = (
    "robot/batch/compiled_kinematics.py",
    "constraint/compiled_rows.py",
    "control/compiled/step_table.py",
    "control/compiled/constrained_rows.py",
    "control/compiled/limits.py",
    "control/compiled/near_singularity.py",
    "control/compiled/within_limits.py",
    "control/compiled/control_step.py",
)
# the constants that the kernels take from elsewhere
CONSTANT_FILES = (
    "robot/rotations.py",
    "linalg.py",
    "constraint/features/weighed_velocity.py",
    "constraint/small_matrices.py",
    "control/command.py",
    "control/limits.py",
    "control/singularity.py",
    "control/resolved_rate_law.py",
    "control/bounded_velocity.py",
    "constraint/manipulability.py",
)

_lock = threading.Lock()


def content_stamp(package: Path = PACKAGE) -> str:
    """Short name of the content of all kernel files."""
    digest = hashlib.sha256()
    for name in (*KERNEL_FILES, *CONSTANT_FILES):
        digest.update((package / name).read_bytes())
    return digest.hexdigest()[:16]


def _cache_folder() -> Path:
    name = f"kernels-{content_stamp()}"
    if _SETTINGS.CACHE_DIR:  # the user has chosen a place
        return Path(_SETTINGS.CACHE_DIR) / name
    here = PACKAGE / "__pycache__" / name
    try:
        here.mkdir(parents=True, exist_ok=True)
    except OSError:  # an installation that may not be written to
        return Path.home() / ".cache" / "manip_learn" / name
    return here


_FOLDER = None if numba is None else _cache_folder()


def compiled(function: Callable[..., Any], **options: Any) -> Callable[..., Any]:
    """The function, compiled at its first call or read from the cache; runs without the interpreter's lock.

    Without numba it is the function itself.
    """
    if numba is None:
        return function
    with _lock:
        before = _SETTINGS.CACHE_DIR
        _SETTINGS.CACHE_DIR = str(_FOLDER)
        try:
            return numba.njit(cache=True, nogil=True, error_model="numpy", **options)(function)
        finally:
            _SETTINGS.CACHE_DIR = before


def compiled_inside(function: Callable[..., Any]) -> Callable[..., Any]:
    """As `compiled`, for a function that only compiled ones call: there is nothing of it to call from Python."""
    return compiled(function, no_cpython_wrapper=True, no_cfunc_wrapper=True)


def announce_compilation(function: Callable[..., Any], report: Callable[[str], object] | None = None) -> None:
    """Say that a function has to be compiled first, where it has not been on this machine."""
    if not is_on_disk(function):
        (report or _LOGGER.warning)(FIRST_COMPILE)


def entry_point(function: Callable[..., Any], *arguments: object) -> Callable[..., Any]:
    """The machine code of a compiled function for arguments of the types of these, with which it is called once.

    Types of later arguments are not looked at, which takes longer than a short function: whoever calls it must be sure
    of them. Without numba it is the function itself.
    """
    function(*arguments)
    if numba is None or isinstance(function, FunctionType):
        return function
    compiler: Any = function
    return compiler.get_overload(tuple(numba.typeof(argument) for argument in arguments))


def is_on_disk(function: Callable[..., Any]) -> bool:
    """Whether a function has been compiled on this machine before; True without numba, where nothing is compiled."""
    return _FOLDER is None or any(_FOLDER.rglob(f"*.{function.__name__}-*.nbi"))
