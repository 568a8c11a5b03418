"""What every experiment hands back."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from manip_learn.control.rollout import Rollout
from manip_learn.robot.robot import Robot

if TYPE_CHECKING:
    from matplotlib.figure import Figure


class ExperimentResult(ABC):
    """Numbers beside the paper's, as a table, as figures and as replays; the children are frozen dataclasses."""

    @abstractmethod
    def to_dict(self) -> dict[str, Any]:
        """Plain numbers and strings for JSON, with `paper` and `ours`."""

    @abstractmethod
    def rows(self) -> list[dict[str, Any]]:
        """One dictionary a line of the CSV file, all with the same keys."""

    @abstractmethod
    def markdown(self) -> str:
        """Tables and findings for the documentation."""

    @abstractmethod
    def figures(self) -> dict[str, Figure]:
        """Name -> figure."""

    @abstractmethod
    def replays(self) -> dict[str, tuple[Robot, Mapping[str, Rollout]]]:
        """Name -> robot and named rollouts, for replay pages."""
