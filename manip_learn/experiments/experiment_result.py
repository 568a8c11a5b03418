"""What every experiment returns: statistics, tables in Markdown and charts in one style, made with matplotlib."""

from __future__ import annotations

import io
import json
from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, final

import numpy as np

from manip_learn.atomic_write import write_atomically
from manip_learn.errors import MissingExtraError
from manip_learn.playback.palette import COLOURS

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

INK, GRID = "#2b2f36", "#d9dde3"
STYLE: dict[Any, Any] = {
    "font.size": 9.0,
    "axes.edgecolor": INK,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.color": GRID,
    "grid.linewidth": 0.6,
    "axes.axisbelow": True,
    "svg.hashsalt": "manip_learn",  # the same bytes every time
    "figure.constrained_layout.use": True,
}


class ExperimentResult(ABC):
    """Numbers beside the paper's, as a table and as figures; the children are frozen dataclasses."""

    @abstractmethod
    def to_dict(self) -> dict[str, Any]:
        """Plain numbers and strings for JSON, with `paper` and `ours`."""

    @abstractmethod
    def rows(self) -> list[dict[str, Any]]:
        """One dictionary per line of the CSV file, all with the same keys."""

    @abstractmethod
    def markdown(self) -> str:
        """Tables and findings for the documentation."""

    @abstractmethod
    def figures(self) -> dict[str, Figure]:
        """Name -> figure."""


@dataclass(frozen=True, eq=False)
class TrialsResult(ExperimentResult):
    """Outcome of every trial of some cases.

    Attributes:
        outcomes: Name of a case -> one dictionary of plain values per trial.
    """

    outcomes: dict[str, list[dict[str, Any]]]

    def rows(self) -> list[dict[str, Any]]:
        """One line per trial: its case, and every number under its key; nested keys are joined by dots."""

        def flat(values: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
            for key, value in values.items():
                if isinstance(value, dict):
                    yield from flat(value, f"{prefix}{key}.")
                else:
                    yield prefix + key, json.dumps(value) if isinstance(value, list) else value

        named = [(case, i, trial) for case, trials in self.outcomes.items() for i, trial in enumerate(trials)]
        lines = [{"case": case, "trial": i} | dict(flat(trial)) for case, i, trial in named]
        names = dict.fromkeys(name for line in lines for name in line)
        return [{name: line.get(name, "") for name in names} for line in lines]


def summary(values: Iterable[float | None]) -> dict[str, Any]:
    """Statistics of some numbers; None stands for an answer that was refused, and is left out.

    Returns:
        `mean`, `sd` (of the sample; 0 for a single number), `median`, `worst` (largest) and `n`; None without numbers.
    """
    array = np.array([v for v in values if v is not None], dtype=np.float64)
    if array.size == 0:
        return {"mean": None, "sd": None, "median": None, "worst": None, "n": 0}
    return {
        "mean": float(np.mean(array)),
        "sd": float(np.std(array, ddof=1)) if array.size > 1 else 0.0,
        "median": float(np.median(array)),
        "worst": float(np.max(array)),
        "n": int(array.size),
    }


def share(flags: Iterable[bool]) -> float | None:
    """Share of the flags that are true; None without any."""
    found = list(flags)
    return sum(found) / len(found) if found else None


def number(value: float | None, digits: int = 2) -> str:
    """A number for a table: 1.2e-07, 0.31, 12, or a dash where there is none."""
    if value is None:
        return "-"
    if value == 0.0:
        return "0"
    if 0.01 <= abs(value) < 1000.0:
        return f"{value:.{max(digits, 1)}g}" if abs(value) < 10 else f"{value:.0f}"
    return f"{value:.{digits - 1}e}"


def mean_and_sd(statistics: dict[str, Any]) -> str:
    """`mean +- s.d.` of a summary."""
    return f"{number(statistics['mean'])} +- {number(statistics['sd'])}"


def percent(share: float) -> str:
    """A share for a table: 98 %."""
    return f"{100.0 * share:.0f} %"


def said_rows(rows: str) -> str:
    """Constrained rows in words: `x, theta` of `"x rz"`."""
    return rows.replace("rz", "theta").replace(" ", ", ")


def median_and_worst(statistics: dict[str, Any]) -> str:
    """`median (worst)` of a summary."""
    return f"{number(statistics['median'])} ({number(statistics['worst'])})"


def markdown_table(header: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """A table in Markdown."""
    lines = ["| " + " | ".join(header) + " |", "|" + "---|" * len(header)]
    lines += ["| " + " | ".join(str(cell) for cell in row) + " |" for row in rows]
    return "\n".join(lines)


def new_figure(width: float, height: float, rows: int = 1, columns: int = 1, **options: object):
    """A figure of a size [inch] with a grid of axes, without a display.

    Raises:
        MissingExtraError: matplotlib is not installed.
    """
    try:
        import matplotlib
        from matplotlib.figure import Figure
    except ImportError as error:
        raise MissingExtraError("drawing figures", "experiments") from error
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(width, height))
        axes = figure.subplots(rows, columns, squeeze=False, **options)  # type: ignore[arg-type]
    return figure, axes


def save_figure(figure: Figure, folder: Path, name: str) -> list[Path]:
    """Write PNG and SVG, whole or not at all (OutputError); the same figure gives the same bytes."""
    import matplotlib

    # no dates or versions, so that the bytes are the same
    kinds: dict[str, Any] = {"png": {"dpi": 110, "metadata": {"Software": None}}, "svg": {"metadata": {"Date": None}}}
    paths = []
    for kind, options in kinds.items():
        stream = io.BytesIO()
        with matplotlib.rc_context(STYLE):
            figure.savefig(stream, format=kind, **options)
        paths.append(write_atomically(folder / f"{name}.{kind}", stream.getvalue()))
    return paths


@final
@dataclass(frozen=True)
class Panel:
    """One part of a chart.

    Attributes:
        values: Words below a column -> its values.
        says: Words of the vertical axis, with its unit.
        title: Above the panel.
        paper: The paper's mean, drawn as a line across.
    """

    values: Mapping[str, Sequence[float]]
    says: str
    title: str = ""
    paper: float | None = None


def strips(panels: Sequence[Sequence[Panel]], across: str, width: float = 11.0, height: float = 4.8) -> Figure:
    """Every value as a dot on a logarithmic axis, with the median of each column as a bar.

    Nothing is left out or moved: values of exactly zero, which this axis does not have, are triangles on its edge.

    Args:
        panels: Lines of panels, all as long; those of a line share their axis.
        across: Words of the horizontal axis: the meaning of a column and of a dot.
        width: Of the figure [inch].
        height: Of the figure [inch].
    """
    same = all(len({tuple(panel.values) for panel in column}) == 1 for column in zip(*panels, strict=True))
    figure, axes = new_figure(width, height, len(panels), len(panels[0]), sharex="col" if same else False, sharey="row")
    for i, line in enumerate(panels):
        for ax, panel in zip(axes[i], line, strict=True):
            _strip(ax, panel.values, panel.paper)
            ax.set_title(panel.title)
        axes[i, 0].set_ylabel(line[0].says)
    figure.supxlabel(across, fontsize=9)
    return figure


def _strip(axes: Axes, values: Mapping[str, Sequence[float]], paper: float | None) -> None:
    for i, ys in enumerate(values.values()):
        dots = np.array(ys, dtype=np.float64)
        if not dots.size:
            continue
        # spread sideways in a fixed pattern: overlapping dots stay countable
        x = i + 0.28 * (((np.arange(dots.size) * 0.618034) % 1.0) - 0.5) * 2.0
        some = dots > 0.0
        axes.plot(x[some], dots[some], ".", color=COLOURS["blue"], alpha=0.45, markersize=4.5, markeredgewidth=0)
        edge = axes.get_xaxis_transform()
        axes.plot(x[~some], np.zeros(int(np.sum(~some))), "v", color=COLOURS["blue"], markersize=4, transform=edge)
        if np.median(dots) > 0.0:
            axes.plot([i - 0.36, i + 0.36], [np.median(dots)] * 2, color=COLOURS["vermilion"], linewidth=2)
    if paper is not None:
        axes.axhline(paper, color=INK, linestyle="--", linewidth=1)
        place = axes.get_yaxis_transform()
        axes.text(0.99, paper * 1.6, "paper's mean", ha="right", va="bottom", fontsize=7.5, color=INK, transform=place)
    axes.set_yscale("log")
    axes.set_xlim(-0.6, len(values) - 0.4)
    axes.set_xticks(range(len(values)), list(values), rotation=40, ha="right")
    axes.grid(False, axis="x")
