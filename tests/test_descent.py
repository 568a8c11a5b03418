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


@pytest.mark.parametrize("start", [(-1.2, 1.0, 3.0), (4.0, -3.0, 0.0), (0.0, 0.0, 0.0)])
def test_it_ends_in_the_optimum(start):
    """From afar too, where a whole step would cost more; no cost is higher than the one before, and what no residual
    depends on stays where it is.
    """
    costs = []

    def moved(point: Valley, step: np.ndarray) -> Valley:
        costs.append(point.cost)
        return point.moved(step)

    end = descend(Valley(np.array(start)), moved, 200, settled=short)
    np.testing.assert_allclose(end.x, [1.0, 1.0, start[2]], atol=1e-10)
    assert np.all(np.diff(costs) <= 0.0) and len(costs) < 200


def test_it_stops_where_it_is_told_to():
    """After so many steps; where a step gains too little; at a point that ends it; before a step too short to be taken;
    and after one short enough to be the last.
    """
    start, steps = Valley(np.array([-1.2, 1.0, 0.0])), []

    def moved(point: Valley, step: np.ndarray) -> Valley:
        steps.append(step)
        return point.moved(step)

    def tried(most: int = 200, **stops) -> tuple[Valley, int]:
        steps.clear()
        return descend(start, moved, most, **{"settled": short, **stops}), len(steps)

    assert tried(0) == (start, 0)
    assert tried(3)[1] == 3
    end, usual = tried()
    assert tried(gain=1.0)[0].cost < start.cost and tried(gain=1.0)[1] < usual
    assert tried(stop=lambda point: point.cost < 4.0)[0].cost > 1e-3
    assert tried(settled=lambda *_: True) == (start, 0)
    last, fewer = tried(tolerance=1e-3, settled=lambda *_: False)
    np.testing.assert_allclose(last.x, [1.0, 1.0, 0.0], atol=1e-6)
    assert fewer <= usual and np.linalg.norm(steps[-1]) < 1e-3 <= np.linalg.norm(steps[-2])
