"""Public names and the modules that they are loaded from at first use."""

from .live_viewer import LiveViewer as LiveViewer
from .live_viewer import show as show
from .replay_page import ReplayResult as ReplayResult
from .replay_page import replay as replay
