"""The descent that all estimators share: it ends in the optimum, and never accepts what costs more."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
from jaxtyping import Float

from manip_learn.learning.descent import descend


@dataclass(frozen=True, eq=False)
class Valley:
    """The residuals (10 (y - x^2), 1 - x) of H. H. Rosenbrock's curved valley, and 0 z: nothing depends on z."""

    x: Float[np.ndarray, " 3"]

    @property
    def cost(self) -> float:
        return float(100.0 * (self.x[1] - self.x[0] ** 2) ** 2 + (1.0 - self.x[0]) ** 2)

    def equations(self) -> tuple[np.ndarray, np.ndarray]:
        J = np.array([[-20.0 * self.x[0], 10.0, 0.0], [-1.0, 0.0, 0.0]])
        return J.T @ J, J.T @ np.array([10.0 * (self.x[1] - self.x[0] ** 2), 1.0 - self.x[0]])

    def moved(self, step: np.ndarray) -> Valley:
        return Valley(self.x + step)


def short(_: Valley, step: np.ndarray, H: np.ndarray) -> bool:
    return float(step @ H @ step) < 1e-24


def descent(start: tuple[float, ...], most: int = 200, **stops) -> tuple[Valley, list[float], list[float]]:
    """Where it ends, the costs of the points from which steps were tried, and the lengths of these."""
    costs, lengths = [], []

    def moved(point: Valley, step: np.ndarray) -> Valley:
        costs.append(point.cost)
        lengths.append(float(np.linalg.norm(step)))
        return point.moved(step)

    return descend(Valley(np.array(start)), moved, most, **{"settled": short, **stops}), costs, lengths


@pytest.mark.parametrize("start", [(-1.2, 1.0, 3.0), (4.0, -3.0, 0.0), (0.0, 0.0, 0.0)])
def test_it_ends_in_the_optimum(start):
    """From afar too, where a whole step would cost more; no cost is higher than the one before, and what no residual
    depends on stays where it is.
    """
    end, costs, _ = descent(start)
    np.testing.assert_allclose(end.x, [1.0, 1.0, start[2]], atol=1e-10)
    assert np.all(np.diff(costs) <= 0.0) and len(costs) < 200


def test_it_stops_where_it_is_told_to():
    """After so many steps; where a step gains too little; at a point that ends it; before a step too short to be taken;
    and after one short enough to be the last.
    """
    start = (-1.2, 1.0, 0.0)
    first, usual = Valley(np.array(start)).cost, len(descent(start)[1])
    assert descent(start, 0)[0].cost == first and len(descent(start, 3)[1]) == 3
    soon, tried, _ = descent(start, gain=1.0)
    assert soon.cost < first and len(tried) < usual
    assert descent(start, stop=lambda point: point.cost < 4.0)[0].cost > 1e-3
    assert descent(start, settled=lambda *_: True)[0].cost == first
    last, tried, lengths = descent(start, tolerance=1e-3, settled=lambda *_: False)
    np.testing.assert_allclose(last.x, [1.0, 1.0, 0.0], atol=1e-6)
    assert len(tried) <= usual and lengths[-1] < 1e-3 <= lengths[-2]
