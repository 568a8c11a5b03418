"""The control law of manip_learn, compiled: found by import, never needed (see `control.controller.native_law`)."""

from manip_learn_fast._engine import LAW_VERSION  # pyright: ignore[reportMissingImports]
from manip_learn_fast.native_law import NativeLaw

__all__ = ["LAW_VERSION", "NativeLaw"]
