"""The picture of a comparison of policies: postures above, the manipulability below."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from manip_learn.control.rollout import Rollout
from manip_learn.experiments import charts

if TYPE_CHECKING:
    from matplotlib.figure import Figure

SHOWN = (0, 1, 2, 3, 6, 12, 25, 37, 50, 100, 250)  # the samples of 251 that are drawn as postures, dt 0.02 s
REACH = 3.15  # of the axes [m]; the arm is 3 m long
STEP = 0.02  # [s]


def draw_starts(columns: Mapping[str, Rollout], fine: Sequence[Rollout], target: tuple[float, float]) -> Figure:
    """One column a law: the arm at the moments `SHOWN`, and the manipulability of every sample.

    Args:
        columns: Title -> rollout at 0.02 s.
        fine: The same laws at 0.01 s, of the first columns.
        target: r* [m].
    """
    n = len(columns)
    highest = max(float(np.max(r.manipulability)) for r in (*columns.values(), *fine))
    figure, axes = charts.new_figure(12.0, 6.6, 2, n, sharey="row", height_ratios=[1.5, 1.0])
    for i, (title, rollout) in enumerate(columns.items()):
        _draw_postures(axes[0, i], rollout, target)
        axes[0, i].set_title(title, fontsize=9)
        _draw_manipulability(axes[1, i], rollout, fine[i] if i < len(fine) else None)
        axes[1, i].set_ylim(0.0, 1.3 * highest)  # room for the key
    axes[0, 0].set_ylabel("y of the links [m]")
    axes[1, 0].set_ylabel("manipulability of x, y [m$^2$]")
    charts.time_key(figure, axes[0], [STEP * i for i in SHOWN])
    axes[0, 0].legend(loc="lower left", fontsize=7)
    return figure


def _draw_postures(ax: Any, rollout: Rollout, target: tuple[float, float]) -> None:
    shown = [i for i in SHOWN if i < len(rollout)]
    for shade, i in zip(charts.shades(len(SHOWN)), shown, strict=False):
        angles = np.cumsum(rollout.q[i])
        joints = np.concatenate([[[0.0, 0.0]], np.cumsum(np.column_stack([np.cos(angles), np.sin(angles)]), axis=0)])
        charts.draw_arm(ax, joints, shade)
    ax.plot(*target, "x", color=charts.INK, markersize=7, markeredgewidth=1.6, linestyle="none", label="target r*")
    ax.set_aspect("equal")
    ax.set_xlim(-REACH, REACH)
    ax.set_ylim(-REACH, REACH)
    ax.set_xlabel("x of the links [m]")


def _draw_manipulability(ax: Any, rollout: Rollout, fine: Rollout | None) -> None:
    ax.plot(rollout.time, rollout.manipulability, color=charts.colour("blue"), label="step 0.02 s (50 Hz)")
    if fine is not None:
        ax.plot(fine.time, fine.manipulability, ":", color=charts.INK, label="step 0.01 s (100 Hz)")
    ax.legend(loc="upper right", fontsize=7)
    ax.set_xlabel("time [s]")
    steps = ax.secondary_xaxis("top", functions=(lambda t: t / STEP, lambda k: k * STEP))
    steps.set_xlabel("step of 0.02 s", fontsize=8)
    steps.tick_params(labelsize=7)
