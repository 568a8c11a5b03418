"""Replays and live views in the browser."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from manip_learn.playback.live_viewer import LiveViewer
    from manip_learn.playback.meshcat_scene import show
    from manip_learn.playback.replay_page import ReplayResult, replay

__all__ = ["LiveViewer", "ReplayResult", "replay", "show"]

# the file is not called replay.py: importing it would put the module where the function belongs
_HOMES = dict.fromkeys(("ReplayResult", "replay"), "replay_page") | {
    "LiveViewer": "live_viewer",
    "show": "meshcat_scene",
}


def __getattr__(name: str) -> Any:
    if name in _HOMES:
        return getattr(importlib.import_module(f"manip_learn.playback.{_HOMES[name]}"), name)
    raise AttributeError(f"module 'manip_learn.playback' has no attribute {name!r}")
