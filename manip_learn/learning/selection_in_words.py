"""A learnt selection matrix in words: what moves freely, what is held, how sure it is."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float

from manip_learn.constraint.features.feature_map import FeatureMap
from manip_learn.linalg import null_basis

# entries of a unit vector that are printed as 0: half of the last of two digits
NEGLIGIBLE = 5e-3


def free_directions(selection: Float[np.ndarray, "s p"], used: Bool[np.ndarray, " p"]) -> Float[np.ndarray, "k p"]:
    """Orthonormal rows that the constraint leaves free, among the feature rows that can move at all.

    Each points so that its largest entry is positive; several are turned so that they share as few rows as possible.
    """
    out = np.zeros((0, selection.shape[1]))
    inner = null_basis(selection[:, used]).T
    if inner.shape[0]:
        out = np.zeros((inner.shape[0], selection.shape[1]))
        out[:, used] = _echelon(inner)
    return out


def describe(
    kind: str,
    selection: Float[np.ndarray, "s p"],
    free: Float[np.ndarray, "k p"],
    features: FeatureMap,
    used: Bool[np.ndarray, " p"],
    uncertainty_deg: float | None,
) -> str:
    """One sentence: what moves freely, what is held or commanded, how sure it is."""
    verb = "held" if kind == "motion-constrained" else "commanded by the task"
    angle = uncertainty_deg or 0.0
    digits = f"{angle:.2f}" if angle >= 0.095 else f"{angle:.1g}"
    spread = "" if uncertainty_deg is None else f" +- {digits} degrees"
    names = [n for n, u in zip(features.row_names, used, strict=True) if u]
    where = getattr(features, "reference", None)
    place = f" in the {where} frame" if where else ""
    rows = "; ".join(_row(row[used], names) for row in _echelon(selection))
    if free.shape[0] == 0:
        return f"{verb}{place}: all of {' '.join(names)}; nothing of it is free"
    freedom = " and ".join(_row(row[used], names) for row in free)
    return f"moves freely along {freedom}{spread} in ({', '.join(names)}){place}; {verb}: {rows}"


def _echelon(rows: Float[np.ndarray, "k p"]) -> Float[np.ndarray, "k p"]:
    """Orthonormal rows of the same space, turned towards single axes one after the other, largest first."""
    remaining, out = rows.copy(), []
    while remaining.shape[0]:
        # the unit axis that lies deepest in what remains
        share = np.sum(remaining**2, axis=0)
        axis = int(np.argmax(share))
        direction = remaining[:, axis] / np.linalg.norm(remaining[:, axis])
        row = direction @ remaining
        out.append(row if row[np.argmax(np.abs(row))] > 0 else -row)
        remaining = null_basis(direction[None, :]).T @ remaining if remaining.shape[0] > 1 else remaining[:0]
    # in the order of the axes that they point along most
    return np.array(sorted(out, key=lambda row: int(np.argmax(np.abs(row)))))


def _row(row: np.ndarray, names: list[str]) -> str:
    large = [i for i in range(len(row)) if abs(row[i]) >= NEGLIGIBLE]
    if len(large) == 1:
        return names[large[0]]
    return "(" + ", ".join(f"{c + 0.0:.2f}" for c in np.where(np.abs(row) < NEGLIGIBLE, 0.0, row)) + ")"
