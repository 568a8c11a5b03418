"""How well a sum is known: the tolerances of what is zero but for rounding, on any processor."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

EPS = float(np.finfo(np.float64).eps)


def rounding(terms: int, *sizes: ArrayLike) -> float:
    """n eps |A| |B| ...: the most by which two ways to add up so many products of such factors differ (Higham, Accuracy
    and Stability of Numerical Algorithms, section 3.1). Which way is taken differs between processors.

    Args:
        terms: Products that are added up, those of earlier steps with them; a factorisation of an (m, n) matrix, whose
            every entry goes through some 4 steps of n sums each, counts as 4 m n.
        sizes: Each factor, or its size; of an array the 2-norm of all its entries counts.
    """
    return terms * EPS * float(np.prod([np.linalg.norm(np.ravel(size)) for size in sizes]))
