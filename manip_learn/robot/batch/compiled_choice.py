"""Whether the compiled kernels are used: only where numba (the extra `fast`) is installed and it pays."""

from __future__ import annotations

from importlib.util import find_spec
from types import ModuleType

from manip_learn.errors import MissingExtraError

COMPILED_FROM = 50_000  # postures: fewer are done in NumPy before numba is even imported


def kernels(compiled: bool | None, n: int) -> ModuleType | None:
    """The module of compiled kernels, or None for NumPy.

    Args:
        compiled: True: always; False: never; None: for large numbers of postures, if numba is installed. That depends
            on n only, so that a call gives the same last bits whatever ran before it.
        n: Number of postures.

    Raises:
        MissingExtraError: True, and numba is not installed.
    """
    if compiled is False or (compiled is None and n < COMPILED_FROM):
        return None
    if find_spec("numba") is None:
        if compiled:
            raise MissingExtraError("compiled kinematics", "fast")
        return None
    from manip_learn.robot.batch import compiled_kinematics

    return compiled_kinematics
