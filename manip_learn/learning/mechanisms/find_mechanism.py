"""From recordings to the mechanism that holds the hand, and to the constraint that it makes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import final

import numpy as np
from jaxtyping import Float

from manip_learn.constraint.features.feature_map import FeatureMap
from manip_learn.constraint.features.frame_jacobian import FrameJacobian
from manip_learn.constraint.features.mechanism_rows import MechanismRows
from manip_learn.constraint.features.place_fields import across
from manip_learn.constraint.mechanism import Mechanism
from manip_learn.errors import NotIdentifiableError
from manip_learn.learning.mechanisms.choice import APART, REPEATED, Alternative, Choice, choose
from manip_learn.learning.mechanisms.consensus import agreeing
from manip_learn.learning.mechanisms.evidence import Scales, margins
from manip_learn.learning.mechanisms.fits import Fit
from manip_learn.learning.mechanisms.refined import refined
from manip_learn.learning.mechanisms.residuals import QUANTITIES
from manip_learn.learning.mechanisms.tip_paths import TipPaths, recombined, thinned
from manip_learn.recordings.trajectory import Trajectory
from manip_learn.robot.frame import Frame
from manip_learn.robot.robot import Robot

SAMPLES = 60  # of each trajectory in the comparison
BLIND = 1e-6  # rows of Phi below this are ones that the arm cannot move
SOFT = 0.03  # share of the motion left in the held rows: hardware stays below
POOR_RADIUS, POOR_AXIS = 0.2, 5.0  # relative, and [deg]: one standard deviation above which a fit is no answer
WIDE, WANTED = 0.015, 0.005  # relative: uncertainty of the radius that is worth a warning, and the one aimed at

Confirm = Callable[[FeatureMap, Float[np.ndarray, "s p"]], bool]


@final
@dataclass(frozen=True, eq=False)
class MechanismFit:
    """The answer of `find_mechanism`.

    Attributes:
        mechanism: What holds the hand; None if nothing was found that does.
        features: Phi, with the mechanism's place as its parameters; None without a mechanism.
        selection: Lambda, shape (s, p), for `Constraint(selection, features)`; None without a mechanism.
        held_out: Largest standard deviation of a held row on trajectories left out, by unit (`"m"`, `"rad"`).
        alternatives: All candidates, best first.
        reason: Why there is no mechanism; empty if there is one.
        warnings: What to know about the answer, in sentences.
        odd: Numbers (from 0) of trajectories that do not belong: the others agree on a mechanism that does not hold
            these, or they are too short.
    """

    mechanism: Mechanism | None
    features: FeatureMap | None
    selection: Float[np.ndarray, "s p"] | None
    held_out: dict[str, float]
    alternatives: tuple[Alternative, ...]
    reason: str = ""
    warnings: tuple[str, ...] = ()
    odd: tuple[int, ...] = ()


def find_mechanism(
    robot: Robot,
    frame: str,
    trajectories: Sequence[Trajectory],
    rng: np.random.Generator,
    *,
    confirm: Confirm | None = None,
    recorded: Sequence[Trajectory] | None = None,
) -> MechanismFit:
    """The mechanism that held a frame of the robot while the trajectories were recorded.

    Positions and orientations along the trajectories are fitted, no velocities are needed. Everything about the grip
    may differ between trajectories: where the hand holds, and how it is turned.

    Args:
        robot: The robot.
        frame: The frame that is held, e.g. the tool's tip. It matters: what holds the tip is a surface or a curve for
            no other frame.
        trajectories: Motion in contact only (phases cut); at least two, better five.
        rng: For the exchange of joints between trajectories, the test against repeated motions, and for draws of the
            error.
        confirm: A further test of the constraint that was found, e.g. on other rows of the same recordings; False
            refuses it.
        recorded: The same trajectories as they were recorded, if `trajectories` are smoothed: the place is fitted to
            these, since smoothing costs the ends of an arc, and its errors are those of neighbours, too.

    Raises:
        UnknownNameError: No such frame; lists near matches.
        NotIdentifiableError: No trajectory has ten samples, or nothing moves.
    """
    tip = robot.frame(frame)
    every = [_postures(robot, t) for t in trajectories]
    numbers = [i for i, q in enumerate(every) if len(q) >= 10]
    if not numbers:
        raise NotIdentifiableError("no trajectory has ten samples: there is no path to look at", code="too-short")
    choice, kept = _compared(robot, tip, [every[i] for i in numbers], rng)
    postures = [every[numbers[i]] for i in kept]
    odd = tuple(number for i, number in enumerate(numbers) if i not in kept)
    table = choice.table
    if choice.fit is None:
        return MechanismFit(None, None, None, {}, table, _why_none(table))
    last = postures if recorded is None else [_postures(robot, recorded[numbers[i]]) for i in kept]
    fit, mechanism = refined(robot, tip, last, choice.fit, choice.rival, rng)
    held_out = {
        unit: max(float(fit.held_out[n].max()) for n in fit.candidate.holds if QUANTITIES[n].unit == unit)
        for unit in {QUANTITIES[n].unit for n in fit.candidate.holds}
    }
    few = np.concatenate([thinned(q, 10) for q in postures])
    features, selection = _constraint(robot, frame, fit, few)
    poor = _poor(mechanism)
    if poor:
        return MechanismFit(None, None, None, held_out, table, poor, (poor,))
    if confirm is not None and not confirm(features, selection):
        reason = f"the recordings look like {mechanism.sentence}, but the test of its rows refuses it"
        return MechanismFit(None, None, None, held_out, table, reason)
    warnings = (*_warnings(choice, len(postures)), *_wide(mechanism))
    return MechanismFit(mechanism, features, selection, held_out, table, "", warnings, odd)


def _postures(robot: Robot, trajectory: Trajectory) -> Float[np.ndarray, "T nv"]:
    q = trajectory.q
    return np.stack([robot.positions(x) for x in q]) if q.shape[1] != robot.nv else q


def _compared(
    robot: Robot, tip: Frame, postures: Sequence[Float[np.ndarray, "_ nv"]], rng: np.random.Generator
) -> tuple[Choice, tuple[int, ...]]:
    """The chosen mechanism and the trajectories used: a subset, if it agrees on more rows than all share.

    Raises:
        NotIdentifiableError: Nothing moves.
    """
    paths, mixed = _paths(robot, tip, postures, rng)
    if max(np.ptp(paths.p, axis=0).max(), np.abs(paths.turns).max()) < 1e-3:
        raise NotIdentifiableError("the hand does not move in these trajectories", code="no-motion")
    choice, scales, everyone = choose(paths, mixed), Scales.of(paths, mixed), tuple(range(len(postures)))
    soft = choice.fit is not None and float(np.min(margins(choice.fit, scales))) < 1.0 / SOFT
    rows = 0 if choice.fit is None else choice.fit.candidate.n_rows - (soft or choice.unlike)
    together = agreeing(paths, rows, scales)
    if len(together) < len(everyone):
        stricter = choose(*_paths(robot, tip, [postures[i] for i in together], rng))
        if stricter.fit is not None and stricter.fit.candidate.n_rows > rows:
            return stricter, together
    return choice, everyone


def _paths(
    robot: Robot, tip: Frame, postures: Sequence[Float[np.ndarray, "_ nv"]], rng: np.random.Generator
) -> tuple[TipPaths, TipPaths | None]:
    """The hand's paths, and those with the joints exchanged; None for a single trajectory."""
    mixed = TipPaths.of(robot, tip, recombined(postures, rng)) if len(postures) > 1 else None
    return TipPaths.of(robot, tip, [thinned(q, SAMPLES) for q in postures]), mixed


def _warnings(choice: Choice, n_trajectories: int) -> tuple[str, ...]:
    chosen = next(a for a in choice.table if a.verdict == "chosen")
    warnings = []
    if n_trajectories == 1:
        warnings.append("one trajectory only: a repeated motion cannot be told from a contact")
    if chosen.held_out > SOFT:
        warnings.append(
            f"softly held: the motion left in the held rows is {100.0 * chosen.held_out:.0f} % of what it would be "
            "without them"
        )
    if choice.rival is not None:
        warnings.append(
            f"a {choice.rival.candidate.name} would fit as well: the motion is too short to tell it from a "
            f"{chosen.name}; move it farther"
        )
    return tuple(warnings)


def _poor(mechanism: Mechanism) -> str:
    """A sentence if the parameters are too uncertain to be used, which says how much more motion is needed."""
    u, radius, arc = mechanism.uncertainty, mechanism.radius, mechanism.arc
    if radius is None or arc is None:
        return ""
    # the curvature of an arc, and with it the radius, is known to its residual over the square of the arc
    worst = max(u.get("axis", 0.0) / POOR_AXIS, u.get("point", 0.0) / (POOR_RADIUS * max(radius, 0.02)))
    if worst <= 1.0:
        return ""
    needed = min(np.degrees(arc) * np.sqrt(4.0 * worst), 90.0)
    return (
        f"move it by at least {needed:.0f} degrees, not {np.degrees(arc):.0f}: it looks like {mechanism.sentence}, but "
        f"the axis is known to {u.get('axis', 0.0):.1f} degrees only and its place to {1e3 * u['point']:.0f} mm"
    )


def _wide(mechanism: Mechanism) -> tuple[str, ...]:
    """A warning if the motion determines the place of an axis or a centre badly."""
    radius, arc, place = mechanism.radius, mechanism.arc, mechanism.uncertainty.get("point", 0.0)
    if radius is None or arc is None or place <= WIDE * radius or mechanism.grip == "firm":
        return ()
    needed = min(np.degrees(arc) * np.sqrt(place / (WANTED * radius)), 90.0)
    return (
        f"the hand goes {np.degrees(arc):.0f} degrees about the axis or the centre only, whose place is known to "
        f"+- {1e3 * place:.0f} mm: move it by at least {needed:.0f} degrees",
    )


def _why_none(table: Sequence[Alternative]) -> str:
    repeated = [a for a in table if a.verdict == REPEATED]
    if repeated:
        return (
            f"the path looks like {repeated[0].name}, but so it does with the joints of different trajectories: one "
            "motion was repeated, nothing shows a contact; record it from other postures and with other grips"
        )
    apart = [a for a in table if a.verdict == APART]
    if apart:
        return (
            f"the trajectories do not agree: each by itself fits {apart[0].name}, but in a place of its own; learn "
            "them one by one, or in the axes of the tool"
        )
    return "no line, plane, hinge, ball, screw, cylinder or orientation holds the hand"


def _constraint(
    robot: Robot, frame: str, fit: Fit, postures: Float[np.ndarray, "n nv"]
) -> tuple[FeatureMap, Float[np.ndarray, "s p"]]:
    """Phi and Lambda: constant rows where they do, rows about an axis or a centre else."""
    c, place = fit.candidate, fit.place
    if c.constant:
        base = np.concatenate([across(place.axis), place.axis[None]])
        linear = {"slide-1": 0, "slide-2": 1, "axial": 2}
        angular = {"turn-1": 0, "turn-2": 1, "turn": 2}
        rows = np.zeros((len(c.rows), 6))
        for row, name in zip(rows, c.rows, strict=True):
            start, k = (0, linear[name]) if name in linear else (3, angular[name])
            row[start : start + 3] = base[k]
        used = [bool(np.any(rows[:, :3])), bool(np.any(rows[:, 3:]))]
        axes = "pose" if all(used) else "xyz" if used[0] else "rotation"
        features: FeatureMap = FrameJacobian(robot, frame, axes)
        selection = rows if all(used) else rows[:, :3] if used[0] else rows[:, 3:]
    else:
        features = MechanismRows(robot, frame, c.rows, axis=place.axis, point=place.point, pitch=place.pitch)
        selection = np.eye(len(c.rows))
    A = np.einsum("sp,npj->nsj", selection, features.batch(postures))
    movable = np.sqrt(np.mean(np.sum(A * A, axis=2), axis=0)) > BLIND
    return features, selection[movable]
