"""Replays and live views in the browser."""

from __future__ import annotations

import lazy_loader

# the file is not called replay.py: importing it would put the module where the function belongs
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
