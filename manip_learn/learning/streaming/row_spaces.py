"""Row spaces of many constraint matrices at once, the samples along the last axis."""

from __future__ import annotations

from dataclasses import dataclass
from typing import final

import numpy as np
from jaxtyping import Bool, Float

# a constraint this much weaker in one direction than in another has lost rank at that sample
RANK_RATIO = 1e-9


@final
@dataclass(frozen=True, eq=False)
class RowSpaces:
    """A_n = L_n E_n for n samples: E_n has orthonormal rows, L_n is a lower triangle.

    Attributes:
        E: shape (s, nv, n); a row that adds nothing to those before it is zero.
        L: shape (s, s, n).
        usable: False where A loses rank, shape (n,).
    """

    E: Float[np.ndarray, "s nv n"]
    L: Float[np.ndarray, "s s n"]
    usable: Bool[np.ndarray, " n"]

    def along(self, w: Float[np.ndarray, "nv n"]) -> Float[np.ndarray, "s n"]:
        """Coordinates E w of a velocity in the row space; their squares sum to w^T A^+ A w."""
        return np.einsum("svn,vn->sn", self.E, w)

    def away(self, w: Float[np.ndarray, "nv n"], along: Float[np.ndarray, "s n"]) -> Float[np.ndarray, "nv n"]:
        """N w, the part of a velocity outside the row space; `along` is E w."""
        out = w.copy()
        for e, c in zip(self.E, along, strict=True):
            out -= e * c
        return out

    def dual(self, along: Float[np.ndarray, "s n"]) -> Float[np.ndarray, "s n"]:
        """A^{+T} w from E w; zero where A loses rank, so that such a sample has no say."""
        out = np.zeros_like(along)
        for i in reversed(range(len(along))):
            value = along[i].copy()
            for j in range(i + 1, len(along)):
                value -= self.L[j, i] * out[j]
            np.divide(value, self.L[i, i], out=out[i], where=self.usable)
        return out

    def inverse_gram(self) -> Float[np.ndarray, "s s n"]:
        """(A A^T)^-1; zero where A loses rank."""
        s, _, n = self.L.shape
        inverse = np.zeros((s, s, n))  # of L
        for j in range(s):
            np.divide(1.0, self.L[j, j], out=inverse[j, j], where=self.usable)
            for i in range(j + 1, s):
                value = -np.einsum("kn,kn->n", self.L[i, j:i], inverse[j:i, j])
                np.divide(value, self.L[i, i], out=inverse[i, j], where=self.usable)
        return np.einsum("kin,kjn->ijn", inverse, inverse)


def row_spaces(A: Float[np.ndarray, "s nv n"]) -> RowSpaces:
    """Gram-Schmidt, each row twice, which makes it as accurate as Householder's reflections."""
    s, nv, n = A.shape
    E, L = np.zeros((s, nv, n)), np.zeros((s, s, n))
    for i in range(s):
        v = A[i].copy()
        for j in [*range(i), *range(i)]:
            c = np.einsum("vn,vn->n", E[j], v)
            v -= E[j] * c
            L[i, j] += c
        size = np.sqrt(np.einsum("vn,vn->n", v, v))
        L[i, i] = size
        np.divide(v, size, out=E[i], where=size > 0.0)
    diagonal = np.einsum("iin->in", L)
    usable = diagonal.min(axis=0) > RANK_RATIO * diagonal.max(axis=0)
    return RowSpaces(E, L, usable)
