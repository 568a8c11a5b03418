"""Charts of the experiments in one style, made with matplotlib (extra `experiments`)."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from manip_learn.atomic_write import write_atomically
from manip_learn.errors import MissingExtraError
from manip_learn.playback.palette import COLOURS

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

INK = "#2b2f36"
# sizes in points
STYLE: dict[Any, Any] = {"font.size": 9.0, "axes.edgecolor": INK, "figure.constrained_layout.use": True}
STYLE |= {"grid.color": "#d9dde3", "grid.linewidth": 0.6, "svg.hashsalt": "manip_learn"}  # salt: same bytes every time
STYLE |= {"axes.spines.top": False, "axes.spines.right": False, "axes.grid": True, "axes.axisbelow": True}


Figures = dict[str, "Figure"]  # name -> figure


def new_figure(width: float, height: float, rows: int = 1, columns: int = 1, **options: object):
    """Create a figure with a grid of axes, without opening a window.

    Args:
        width: Width [inch].
        height: Height [inch].
        rows: Number of rows of axes.
        columns: Number of columns of axes.
        **options: Keywords of `Figure.subplots`.

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
        return figure, figure.subplots(rows, columns, squeeze=False, **options)  # type: ignore[arg-type]


def save_figure(figure: Figure, folder: Path, name: str) -> list[Path]:
    """Write a figure as PNG and SVG; the same figure gives the same bytes.

    After an error, no incomplete file is left.

    Args:
        figure: Figure from `new_figure`.
        folder: Folder for the files.
        name: Name of the files without extension.

    Returns:
        Paths of the PNG and the SVG file.

    Raises:
        OutputError: A file cannot be written.
    """
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


class Panel(NamedTuple):
    """Panel of a chart, with one column of dots per label.

    Attributes:
        values: Label of a column -> its values.
        label: Label of the vertical axis, with its unit.
        title: Title above the panel.
        paper: The paper's mean, drawn as a line; None for no line.
    """

    values: Mapping[str, Sequence[float]]
    label: str
    title: str = ""
    paper: float | None = None


def strips(panels: Sequence[Sequence[Panel]], label: str, width: float = 11.0, height: float = 4.8) -> Figure:
    """Draw every value as a dot on a logarithmic axis, with the median of each column as a bar.

    Values of exactly zero are triangles on the edge of the axis.

    Args:
        panels: Rows of panels, all of the same length and with the same columns; the panels of a row share the vertical
            axis.
        label: Label of the horizontal axis, which explains the columns and the dots.
        width: Width of the figure [inch].
        height: Height of the figure [inch].

    Returns:
        The figure, not yet saved.
    """
    figure, axes = new_figure(width, height, len(panels), len(panels[0]), sharex="col", sharey="row")
    for line, row in zip(axes, panels, strict=True):
        for ax, panel in zip(line, row, strict=True):
            _draw_strip(ax, panel)
        line[0].set_ylabel(row[0].label)
    figure.supxlabel(label, fontsize=9)
    return figure


def _draw_strip(axes: Axes, panel: Panel) -> None:
    for i, values in enumerate(panel.values.values()):
        y = np.array(values, dtype=np.float64)
        # spread sideways in a fixed pattern: overlapping dots stay countable
        x, positive = i + 0.56 * ((np.arange(y.size) * 0.618034) % 1.0 - 0.5), y > 0.0
        blue: dict[str, Any] = {"color": COLOURS["blue"], "alpha": 0.45, "markersize": 4.5, "markeredgewidth": 0}
        axes.plot(x[positive], y[positive], ".", **blue)
        axes.plot(x[~positive], y[~positive], "v", transform=axes.get_xaxis_transform(), **blue)
        if np.any(positive):
            axes.plot([i - 0.36, i + 0.36], [np.median(y)] * 2, color=COLOURS["vermilion"], linewidth=2)
    if panel.paper is not None:
        axes.axhline(panel.paper, color=INK, linestyle="--", linewidth=1)
        edge, style = axes.get_yaxis_transform(), {"ha": "right", "va": "bottom", "fontsize": 7.5, "color": INK}
        axes.text(0.99, panel.paper * 1.6, "paper's mean", transform=edge, **style)
    axes.set(title=panel.title, yscale="log", xlim=(-0.6, len(panel.values) - 0.4))
    axes.set_xticks(range(len(panel.values)), list(panel.values), rotation=40, ha="right")
    axes.grid(False, axis="x")
