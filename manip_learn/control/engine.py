"""The law compiled: `manip_learn_fast`, built from `fast/`, in the place of `law.Law` where it is installed.

It is never needed: the law in Python is the text, the compiled one follows it section by section and gives the same
numbers. What it does not know (rows, tasks and policies of users, ways) is computed in Python and handed in.
"""

from __future__ import annotations

import logging
import os
from functools import cache
from importlib import import_module
from typing import Any

from manip_learn.control.law import Law
from manip_learn.control.limits import Limits

_LOGGER = logging.getLogger("manip_learn")
LAW_VERSION = 3  # of the numbers that the law gives: fast/src/law.hpp has the same


@cache
def _compiled() -> Any:
    """The compiled module, or None; says once what is wrong with one that is there."""
    try:
        module = import_module("manip_learn_fast")
        version = module.LAW_VERSION
    except (ImportError, AttributeError, OSError) as error:  # the law in Python does the work
        if isinstance(error, ModuleNotFoundError) and error.name == "manip_learn_fast":
            return None
        wrong = f"manip_learn_fast cannot be loaded ({error!r})"
    else:
        wrong = f"manip_learn_fast has version {version!r} of the law, this library needs {LAW_VERSION}"
        if version == LAW_VERSION:
            return module
    _LOGGER.warning("%s: build it again with pip install ./fast; until then the law runs in Python", wrong)
    return None


def native_law(law: Law, limits: Limits | None) -> Any:
    """The compiled law (`manip_learn_fast.NativeLaw`); None where the law in Python has to do the work."""
    module = None if os.environ.get("MANIP_LEARN_ENGINE") == "python" else _compiled()
    try:
        return None if module is None else module.NativeLaw(law, limits)
    except LookupError as reason:
        _LOGGER.debug("the law runs in Python: %s", reason)
        return None
