"""Charts of results in one style; matplotlib is loaded when the first figure is made."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
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


def new_figure(width: float, height: float, rows: int = 1, columns: int = 1, **options: object):
    """A figure of a size [inch] with a grid of axes, without a display; MissingExtraError without matplotlib."""
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
