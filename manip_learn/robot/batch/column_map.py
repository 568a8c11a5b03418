"""Between the public columns of a robot and the joints of one chain: selection, order, and mimic joints."""

from __future__ import annotations

from typing import final

import numpy as np
from jaxtyping import Float

from manip_learn.robot.batch.chain import Chain
from manip_learn.robot.batch.postures import positions_of
from manip_learn.robot.robot import Robot


@final
class ChainColumns:
    """Which public joint moves which joint of the chain.

    Attributes:
        full: True if every public joint moves the chain, so that no column of a Jacobian is zero by construction.
        public: Public column of each joint of the chain, shape (j,); None with mimic joints.
    """

    def __init__(self, robot: Robot, chain: Chain):
        self._robot = robot
        self._lift: np.ndarray | None = None
        self.public: np.ndarray | None = None
        self._select: slice | np.ndarray = slice(0, 0)
        coupling = robot.coupling
        if coupling is not None:
            # mimic joints: the chain's joints are an affine map of the public ones
            self._lift = np.ascontiguousarray(coupling.lift[chain.columns])
            self._offset = coupling.offset[chain.columns][:, None]
            self.full = False
            return
        public = {block.pin_v.start: block.v.start for block in robot.blocks}
        columns = np.array([public[int(c)] for c in chain.columns], dtype=np.int64)
        self.public = columns
        self.full = len(columns) == robot.nv
        contiguous = np.array_equal(columns, np.arange(columns[0], columns[0] + len(columns)))
        self._select = slice(int(columns[0]), int(columns[0]) + len(columns)) if contiguous else columns

    def positions(self, postures: Float[np.ndarray, "n width"]) -> Float[np.ndarray, "j n"]:
        """Positions of the chain's joints [rad or m], base first."""
        public = positions_of(self._robot, postures).T
        if self._lift is not None:
            return self._lift @ public + self._offset
        return np.ascontiguousarray(public[self._select])

    def view(self, out: Float[np.ndarray, "... nv n"]) -> Float[np.ndarray, "... j n"] | None:
        """The part of a public array that belongs to the chain's joints, or None where that is no view."""
        return out[..., self._select, :] if isinstance(self._select, slice) and self._lift is None else None

    def scatter(self, values: Float[np.ndarray, "... j n"], out: Float[np.ndarray, "... nv n"]) -> None:
        """Columns of the chain's joints into public columns; the others are left alone (or 0 with mimic joints)."""
        if self._lift is not None:
            np.matmul(self._lift.T, values, out=out)
        else:
            out[..., self._select, :] = values

    def scatter_pairs(self, values: Float[np.ndarray, "p j j n"], out: Float[np.ndarray, "p nv nv n"]) -> None:
        """Derivatives by the chain's joints into public columns, in both joint axes."""
        if self._lift is not None:
            out[...] = np.einsum("pabn,aj,bk->pjkn", values, self._lift, self._lift, optimize=True)
        elif isinstance(self._select, slice):
            out[:, self._select, self._select] = values
        else:
            out[:, self._select[:, None], self._select[None, :]] = values

    def gather(self, weights: Float[np.ndarray, "p nv n"]) -> Float[np.ndarray, "p j n"]:
        """The transpose of `scatter`: weights of public columns as weights of the chain's."""
        if self._lift is not None:
            return np.matmul(self._lift, weights)
        return weights[:, self._select]
