"""Whether a driver reads the joints, the units and the senses that it commands, by what the arm does."""

from __future__ import annotations

import math
from typing import Any, final

import numpy as np
from jaxtyping import Float
from scipy.optimize import linear_sum_assignment

from manip_learn.linalg import finite
from manip_learn.recordings.validation.motion_checks import far_outside
from manip_learn.robot.robot import Robot

# [rad or m] by which no arm goes off that is sent to where it is: brakes that open, a payload and a push of 20 N give a
# few hundredths at most
_AWAY = 0.05
_STILL, _AHEAD = (
    0.02,
    4.0,
)  # [rad or m] by which it is sent then, and times as far as that for it to have gone by itself
_KEPT = 512  # readings of a run: of a longer one every second, fourth, ...
_EXPLAINED = 0.1  # share of what is left of a motion as it stands that is left of it where it is explained
_TIE = 1e-3  # share of that by which an explanation that exchanges joints must be better than one that does not
_SCALES = {1.0: "", math.degrees(1.0): "degrees", math.radians(1.0): "degrees", 1e3: "mm", 1e-3: "mm"}


@final
class Witness:
    """The path that was read beside the path that was sent.

    The arm of a driver that reads joints in another order than it commands them, or in another unit or sense, goes off
    as soon as it is sent to where it was read, or a joint moves as another one is sent.
    """

    def __init__(self, robot: Robot):
        self._robot, self._every, self._cycles = robot, 1, 0
        self._rows: list[tuple[np.ndarray, np.ndarray]] = []  # readings, and the postures that were sent before them
        self._sent: np.ndarray | None = None
        self._off = 0  # readings in turn that have gone away

    def refuses(self, q: Any, tripped: bool) -> str:
        """Why the first reading is none of this arm, or why a later one says that the driver is wrong; or nothing.

        `tripped` says whether the arm is too far from where it was sent.
        """
        x = finite(q, self._robot.nv)
        if x is None:
            return ""
        if not self._rows or self._sent is None:
            return far_outside(self._robot, x)
        first, start = self._rows[0]
        away, went = np.abs(x - first), float(np.abs(self._sent - start).max())
        j = int(away.argmax())
        goes = went < _STILL and away[j] > max(0.0 if tripped else _AWAY, _AHEAD * went)
        self._off = self._off + 1 if goes else 0
        if not goes or (self._off < 2 and not tripped):  # one reading may be wrong
            return ""
        name, unit = self._robot.joint_names[j], self._robot.joint_units[j]
        return (
            f"joint {name} has gone from {first[j]:.3g} to {x[j]:.3g} {unit} while it was sent by {went:.1g} {unit} at "
            "most: it was in motion or is pushed, or the driver reads other joints, units or senses than it commands"
        )

    def note(self, q: Any, sent: Float[np.ndarray, " n"] | None) -> None:
        """Take note of a reading and of the posture that was sent after it [rad or m]."""
        n = self._robot.nv
        x = finite(q, n) if self._cycles % self._every == 0 else None
        self._cycles += 1
        before, self._sent = sent if self._sent is None else self._sent, sent
        if x is None or before is None or len(before) != n:
            return
        self._rows.append((x, before))
        if len(self._rows) > _KEPT:
            self._rows, self._every = self._rows[::2], 2 * self._every

    def words(self) -> str:
        """Which other order, unit or sense of the joints explains the motion that was read; or nothing."""
        if len(self._rows) < 3:
            return ""
        read, sent = (np.array(part) - np.mean(part, axis=0) for part in zip(*self._rows, strict=True))
        own, found = np.sum(read**2, axis=0), ""
        best = _EXPLAINED**2 * float(np.sum((read - sent) ** 2))
        names, apart = self._robot.joint_names, _TIE * best * (1.0 - np.eye(len(own)))
        for scale, unit in _SCALES.items():
            # what each joint leaves of each path that was sent, in either sense
            both, theirs = scale * read.T @ sent, np.sum((scale * sent) ** 2, axis=0)
            left = np.maximum(own[:, None] + theirs - 2.0 * np.abs(both), 0.0)
            rows, columns = linear_sum_assignment(left + apart)
            if float(left[rows, columns].sum()) >= best:
                continue
            best = float(left[rows, columns].sum())
            pairs = [(i, j) for i, j in zip(rows, columns, strict=True) if own[i] > best]  # the joints that moved
            said = [f"{names[i]} moves as {names[j]} is sent" for i, j in pairs if i != j]
            said += [f"{names[i]} moves the other way round" for i, j in pairs if both[i, j] < 0.0]
            said += [f"{scale:.3g} times as far as it is sent, as if in {unit} on one way"] if unit else []
            found = "; ".join(said)
        look = "look how the driver orders its joints, and in which units and senses"
        return f"the arm moves otherwise than it is sent ({found}): {look}" if found else ""
