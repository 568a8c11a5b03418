"""Drawing in one style; matplotlib is loaded when the first figure is made."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float

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
    """A figure of a size [inch] with a grid of axes, without a display.

    Raises:
        MissingExtraError: matplotlib is not installed.
    """
    try:
        import matplotlib
        from matplotlib.figure import Figure
    except ImportError as error:
        raise MissingExtraError("drawing figures", "experiments") from error
    with matplotlib.rc_context(STYLE):  # type: ignore[arg-type]
        figure = Figure(figsize=(width, height))
        axes = figure.subplots(rows, columns, squeeze=False, **options)  # type: ignore[arg-type]
    return figure, axes


def save_figure(figure: Figure, folder: Path, name: str, dpi: int = 110) -> list[Path]:
    """Write PNG and SVG, whole or not at all.

    Raises:
        OutputError: They cannot be written.
    """
    import matplotlib

    paths = []
    for kind, options in (("png", {"dpi": dpi, "metadata": {"Software": None}}), ("svg", {"metadata": {"Date": None}})):
        stream = io.BytesIO()
        with matplotlib.rc_context(STYLE):  # type: ignore[arg-type]
            figure.savefig(stream, format=kind, **options)  # type: ignore[arg-type]
        paths.append(write_atomically(folder / f"{name}.{kind}", stream.getvalue()))
    return paths


def colour(name: str) -> str:
    """Hexadecimal value of a colour of the palette."""
    return COLOURS[name]


def strip(axes: Axes, values: Mapping[str, Sequence[float]], paper: float | None = None, floor: float = 1e-32) -> None:
    """Every trial as a dot on a logarithmic axis, with the median as a bar, and the paper's mean as a line across."""
    for i, (_, ys) in enumerate(values.items()):
        dots = np.maximum(np.array(ys, dtype=np.float64), floor)
        if not dots.size:
            continue
        # spread sideways in a fixed pattern: overlapping dots stay countable
        x = i + 0.28 * (((np.arange(dots.size) * 0.618034) % 1.0) - 0.5) * 2.0
        axes.plot(x, dots, ".", color=colour("blue"), alpha=0.45, markersize=4.5, markeredgewidth=0)
        axes.plot([i - 0.36, i + 0.36], [np.median(dots)] * 2, color=colour("vermilion"), linewidth=2)
    if paper is not None:
        axes.axhline(paper, color=INK, linestyle="--", linewidth=1)
        place = axes.get_yaxis_transform()
        axes.text(0.99, paper * 1.6, "paper", ha="right", va="bottom", fontsize=7.5, color=INK, transform=place)
    axes.set_yscale("log")
    axes.set_xlim(-0.6, len(values) - 0.4)
    axes.set_xticks(range(len(values)), list(values), rotation=40, ha="right")
    axes.grid(False, axis="x")


def draw_arm(axes: Axes, joints: Float[np.ndarray, "k 2"], shade: float, name: str) -> None:
    """One posture of a planar arm; shade 0 (pale, early) to 1 (strong, late)."""
    axes.plot(
        joints[:, 0],
        joints[:, 1],
        "-o",
        color=colour(name),
        alpha=0.12 + 0.88 * shade,
        linewidth=1.0 + 1.0 * (shade == 1.0),
        markersize=2.5,
        solid_capstyle="round",
    )
