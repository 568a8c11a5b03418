"""IPOPT, through CasADi, on a problem whose functions and derivatives are NumPy's."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple, final

import numpy as np
from jaxtyping import Float

from manip_learn.control.paths.path_problem import PathProblem, Triplets
from manip_learn.errors import MissingExtraError

try:
    import casadi
except ImportError as error:
    raise MissingExtraError("optimising a path", "path") from error


@final
class Solution(NamedTuple):
    """Where the solver stopped.

    Attributes:
        x: The variables.
        converged: Whether the solver's conditions of optimality hold.
        iterations: How many it took.
    """

    x: Float[np.ndarray, " size"]
    converged: bool
    iterations: int


@final
class _Places:
    """Sparse entries in CasADi's order, by columns."""

    def __init__(self, places: Triplets, shape: tuple[int, int]):
        order = np.lexsort((places.rows, places.columns))
        self._order = order
        rows, columns = places.rows[order].tolist(), places.columns[order].tolist()
        self.sparsity = casadi.Sparsity.triplet(*shape, rows, columns)

    def matrix(self, entries: Float[np.ndarray, " z"]) -> casadi.DM:
        return casadi.DM(self.sparsity, entries[self._order])


class _Evaluation(casadi.Callback):
    """A function of NumPy vectors that CasADi can call."""

    def __init__(self, name: str, inputs: dict[str, Any], outputs: dict[str, Any], function: Callable[..., list[Any]]):
        casadi.Callback.__init__(self)
        self._names_in, self._names_out = tuple(inputs), tuple(outputs)
        self._in, self._out, self._function = tuple(inputs.values()), tuple(outputs.values()), function
        self.construct(name, {})

    def get_n_in(self) -> int:
        return len(self._in)

    def get_n_out(self) -> int:
        return len(self._out)

    def get_name_in(self, i: int) -> str:
        return self._names_in[i]

    def get_name_out(self, i: int) -> str:
        return self._names_out[i]

    def get_sparsity_in(self, i: int):
        return self._in[i]

    def get_sparsity_out(self, i: int):
        return self._out[i]

    def eval(self, arg):
        return self._function(*[np.asarray(a.nonzeros()) for a in arg])


def solve(problem: PathProblem, start: Float[np.ndarray, " size"], iterations: int, tolerance: float) -> Solution:
    """A local minimum of the problem near a start.

    Args:
        problem: Objective, constraints and their derivatives.
        start: First values of the variables; they need not be feasible.
        iterations: Most iterations.
        tolerance: Of the optimality conditions.
    """
    low, high = problem.constraint_bounds()
    size, rows = problem.size, low.shape[0]
    dense = casadi.Sparsity.dense
    x, g, one, none = dense(size, 1), dense(rows, 1), dense(1, 1), dense(0, 1)
    J = _Places(problem.jacobian_places, (rows, size))
    H = _Places(problem.hessian_places, (size, size))
    p = problem
    here, there = {"x": x, "p": none}, {"f": one, "g": g}
    options = {
        "grad_f": _Evaluation(
            "nlp_grad_f", here, {"f": one, "grad_f_x": x}, lambda v, _: [p.objective(v), p.gradient(v)]
        ),
        "jac_g": _Evaluation(
            "nlp_jac_g", here, {"g": g, "jac_g_x": J.sparsity}, lambda v, _: [p.constraints(v), J.matrix(p.jacobian(v))]
        ),
        "hess_lag": _Evaluation(
            "nlp_hess_l",
            {**here, "lam_f": one, "lam_g": g},
            {"triu_hess_gamma_x_x": H.sparsity},
            lambda v, _, f, m: [H.matrix(p.hessian(v, float(f[0]), m))],
        ),
        "print_time": False,
        "no_nlp_grad": True,
        "ipopt": {"print_level": 0, "sb": "yes", "max_iter": iterations, "tol": tolerance, "mu_strategy": "adaptive"},
    }
    oracle = _Evaluation("nlp", here, there, lambda v, _: [p.objective(v), p.constraints(v)])
    solver = casadi.nlpsol("path", "ipopt", oracle, options)
    lower, upper = problem.variable_bounds()
    answer = solver(x0=start, lbx=lower, ubx=upper, lbg=low, ubg=high)
    statistics = solver.stats()
    return Solution(
        np.asarray(answer["x"]).reshape(-1), bool(statistics["success"]), int(statistics.get("iter_count", -1))
    )
