"""One CSV file per demonstration."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from jaxtyping import Float

DECIMALS = 5  # 1e-5 rad: a tenth of the encoder noise


def write_csv(
    path: Path,
    time: Float[np.ndarray, " T"],
    columns: Mapping[str, Float[np.ndarray, " T"]],
    decimals: int = DECIMALS,
) -> None:
    """One row per sample: time [s] with 2 decimals, then the columns with a fixed number of decimals."""
    lines = [",".join(["time", *columns])]
    rows = np.column_stack(list(columns.values()))
    lines += [f"{t:.2f}," + ",".join(f"{x:.{decimals}f}" for x in row) for t, row in zip(time, rows, strict=True)]
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("\n".join(lines) + "\n", encoding="utf-8", newline="\n")
