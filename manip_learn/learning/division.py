"""Which parts of the recordings belong to which constraint: stretches of whole recordings, and those that agree."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from typing import final

import numpy as np

from manip_learn.constraint.features.feature_map import FeatureMap
from manip_learn.constraint.features.frame_jacobian import FrameJacobian
from manip_learn.learning.agreement.agreement import Agreement, judge_agreement
from manip_learn.learning.agreement.edges import held_part, is_chance
from manip_learn.learning.agreement.interruption import interruptions
from manip_learn.learning.agreement.mixture import members_of_each
from manip_learn.learning.agreement.reason import reason
from manip_learn.learning.before_smoothing import BeforeSmoothing
from manip_learn.learning.phases.beside_tethers import with_contacts_beside
from manip_learn.learning.phases.decoding import TRIM
from manip_learn.learning.phases.find_phases import find_phases, maps_that_fit, one_constraint_fits, too_short
from manip_learn.learning.phases.find_tethers import find_tethers
from manip_learn.learning.phases.result import PhaseConstraint, PhaseResult, Stretch
from manip_learn.learning.phases.search import FIRM
from manip_learn.learning.place_rows import one_mechanism_fits
from manip_learn.recordings.demonstrations import Demonstrations
from manip_learn.recordings.trajectory import Trajectory
from manip_learn.robot.robot import Reference

# share of the trajectories that must show a constraint before one that does not show it is called odd
MOST = 0.6
PAIRS_BELOW = 6  # of fewer recordings two that agree are enough; else three: free motions share directions by chance
FEWEST_SAMPLES = 4  # of a stretch that is learnt from
IN_ONE_ONLY = "appears in one recording only"
DISAGREES = "does not agree with the other recordings"


@final
@dataclass(frozen=True, eq=False)
class Part:
    """What one constraint is learnt from.

    Attributes:
        demonstrations: Whole recordings, or stretches of them.
        stretches: Where each of them lies; trajectories are counted from 0 in what was given to the learner.
        feature_maps: The candidates for Phi.
        n_constraints: Number of rows that the phases show; None: from the data.
        is_held: Whether the division showed already that the world holds the rows (b = 0).
        source: All recordings before they were smoothed; None if they were not.
    """

    demonstrations: Demonstrations
    stretches: tuple[Stretch, ...]
    feature_maps: tuple[FeatureMap, ...]
    n_constraints: int | None = None
    is_held: bool = False
    source: BeforeSmoothing | None = None

    @property
    def recorded(self) -> list[Trajectory] | None:
        """The demonstrations as they were recorded; None if they are."""
        return None if self.source is None else self.source.of(self.stretches, self.demonstrations)


@final
@dataclass(frozen=True, eq=False)
class Division:
    """The recordings, divided.

    Attributes:
        parts: One per constraint, best supported first.
        free: Stretches of free motion.
        unlearnt: Stretches in which something seems to be held that is not learnt, and why.
        refused: Stretches of the constraint that comes nearest, where none is supported by enough.
        odd: Trajectories that do not agree with the others, and why.
        one_fits: Whether a single constraint fits nearly all samples.
        warnings: Doubts, in sentences.
    """

    parts: tuple[Part, ...]
    free: tuple[Stretch, ...] = ()
    odd: tuple[tuple[int, str], ...] = ()
    one_fits: bool = True
    warnings: tuple[str, ...] = ()
    unlearnt: tuple[tuple[Stretch, str], ...] = ()
    refused: tuple[Stretch, ...] = ()

    def phases(self) -> tuple[tuple[Stretch, int | None, str], ...]:
        """(stretch, number of the constraint or None, why nothing is learnt from it), in order of time."""
        held = [(s, k, "") for k, part in enumerate(self.parts) for s in part.stretches]
        free = [(s, None, "") for s in self.free]
        unlearnt = [(s, None, why) for s, why in self.unlearnt]
        return tuple(sorted([*held, *free, *unlearnt], key=lambda x: (x[0].trajectory, x[0].start)))


def undivided(demonstrations: Demonstrations, feature_maps: Sequence[FeatureMap]) -> Division:
    """No division: one constraint holds in everything."""
    return Division((_part(demonstrations, range(len(demonstrations)), feature_maps),))


def divide(
    demonstrations: Demonstrations,
    feature_maps: Sequence[FeatureMap],
    rng: np.random.Generator,
    *,
    phases: bool = True,
    mechanisms: bool = True,
) -> Division:
    """Find out which parts of the recordings one constraint can explain.

    Where a single constraint fits nearly all samples, what is left is whether all trajectories agree on all of its
    rows. Where none fits, the trajectories may be cut ones of several tasks, or a few odd ones among others: those that
    agree then fit without the rest. Otherwise the recordings are whole ones, and their phases are searched for.

    Args:
        demonstrations: With velocities.
        feature_maps: The candidates for Phi.
        rng: For the comparisons with chance.
        phases: Whether to look for phases.
        mechanisms: Whether the rows of a mechanism, e.g. of a tether, may explain what no constant rows do.
    """
    widths = {t.u.shape[1] for t in demonstrations if t.u is not None}
    if any(widths != {f.nv} for f in feature_maps):
        return undivided(demonstrations, feature_maps)  # refused where the samples are collected
    usable = tuple(f for f in feature_maps if _moves(f, demonstrations))
    if not usable:
        return undivided(demonstrations, feature_maps)
    fitting = maps_that_fit(usable, demonstrations)
    if len(demonstrations) < 2 or (not fitting and too_short(demonstrations)):
        return Division(undivided(demonstrations, feature_maps).parts, one_fits=bool(fitting))
    elsewhere = () if fitting else _held_elsewhere(demonstrations, usable)
    if elsewhere:
        return Division(undivided(demonstrations, feature_maps).parts, one_fits=False, warnings=elsewhere)
    if not fitting and mechanisms and one_mechanism_fits(usable, demonstrations, rng.spawn(1)[0]):
        (part,) = undivided(demonstrations, feature_maps).parts
        return Division((dataclasses.replace(part, is_held=True),))
    agreed = _by_agreement(demonstrations, fitting or usable, feature_maps, bool(fitting))
    if agreed is not None:
        return agreed
    if fitting:
        return undivided(demonstrations, feature_maps)
    if phases:
        found = find_phases(usable, demonstrations, rng)
        soft = all(c.softness > FIRM for c in found.constraints)
        tethers = find_tethers(usable, demonstrations, rng) if mechanisms and soft else None
        if tethers is not None and _support(tethers[1]) > _support(found):
            tied = with_contacts_beside(usable, demonstrations.trajectories, tethers[1], found, rng)
            return _by_phases(demonstrations, (tethers[0],), tied, usable)
        if found.constraints:
            return _by_phases(demonstrations, usable, found)
        lone = _of_one(found.unsupported)
        nearest = max(found.rejected, key=lambda c: c.support, default=None)
        refused = () if nearest is None else nearest.stretches
        parts = undivided(demonstrations, feature_maps).parts
        return Division(parts, one_fits=False, unlearnt=lone, refused=refused)
    return Division(undivided(demonstrations, feature_maps).parts, one_fits=False)


def _support(found: PhaseResult) -> float:
    """Evidence for all constraints [nats]; parts of a sphere pass for soft planes, with little of it."""
    return sum(c.support for c in found.constraints)


def _held_elsewhere(demonstrations: Demonstrations, feature_maps: Sequence[FeatureMap]) -> tuple[str, ...]:
    """A warning if one constraint holds in the other reference: what disagrees in this one is no other task then."""
    tried = {f.reference for f in feature_maps if isinstance(f, FrameJacobian)}
    for f in feature_maps:
        if isinstance(f, FrameJacobian) and len(tried) == 1:
            other: Reference = "local" if f.reference == "world" else "world"
            if one_constraint_fits(FrameJacobian(f.robot, f.frame.name, f.row_names, other), demonstrations):
                return (
                    f"in the {f.reference} reference no constraint fits all recordings, in the {other} one does: the "
                    f"rows are held there (reference {other!r})",
                )
    return ()


def _moves(features: FeatureMap, demonstrations: Demonstrations) -> bool:
    """Whether any row of the features is not zero throughout."""
    few = np.concatenate([t.q[:: max(1, len(t) // 5)] for t in demonstrations])
    return bool(np.any(np.abs(features.batch(few)) > 0.0))


def _part(demonstrations: Demonstrations, chosen: Sequence[int], feature_maps: Sequence[FeatureMap]) -> Part:
    stretches = tuple(
        Stretch(i, float(demonstrations[i].time[0]), float(demonstrations[i].time[-1])) for i in sorted(chosen)
    )
    members = Demonstrations([demonstrations[s.trajectory] for s in stretches], demonstrations.notes)
    return Part(members, stretches, tuple(feature_maps))


def _by_agreement(
    demonstrations: Demonstrations,
    judged_by: Sequence[FeatureMap],
    feature_maps: Sequence[FeatureMap],
    one_fits: bool,
) -> Division | None:
    """The division into those that agree and the others; None if all agree, or if that does not explain them."""
    best: tuple[FeatureMap, Agreement] | None = None
    for features in judged_by:
        agreement = judge_agreement(features, demonstrations)
        if agreement.unanimous:
            if one_fits:
                return None
            continue
        members = [demonstrations[i] for i in agreement.members]
        if len(members) < 2 or not one_constraint_fits(features, members):
            continue
        if best is None or len(members) > len(best[1].members):
            best = features, agreement
    if best is None:
        return None
    groups = members_of_each(best[0], demonstrations.trajectories, best[1])
    fewest = 2 if len(demonstrations) < PAIRS_BELOW else 3
    if 2 * sum(len(group) for group in groups if len(group) >= fewest) < len(demonstrations):
        return None
    parts = tuple(dataclasses.replace(_part(demonstrations, g, feature_maps), is_held=True) for g in groups)
    rest = tuple((_all_of(i, t), DISAGREES) for i, t in enumerate(demonstrations) if not any(i in g for g in groups))
    return Division(parts, odd=best[1].odd, unlearnt=rest)


def _all_of(number: int, trajectory: Trajectory) -> Stretch:
    return Stretch(number, float(trajectory.time[0]), float(trajectory.time[-1]))


def _by_phases(
    demonstrations: Demonstrations,
    feature_maps: Sequence[FeatureMap],
    found: PhaseResult,
    asked_for: tuple[FeatureMap, ...] | None = None,
) -> Division:
    """One part for each constraint that the phases show, without the stretches that do not agree.

    Args:
        demonstrations: Whole recordings.
        feature_maps: Those that the phases were found in.
        found: The phases.
        asked_for: Candidates for Phi where the phases were found in other rows, whose number says nothing of theirs.
    """
    parts, odd, apart, free = [], dict[int, str](), list[Stretch](), list(found.free)
    for number, constraint in enumerate(found.constraints, start=1):
        features = feature_maps[constraint.features]
        cut, others, loose = _agreeing(demonstrations, features, constraint)
        odd |= {s.trajectory: why for s, why in others}
        apart += [s for s, _ in others]
        free += loose
        odd |= _missing(demonstrations, features, constraint, number)
        elsewhere = [s for c in found.constraints if c is not constraint for s in c.stretches]
        odd = interruptions(features, demonstrations.trajectories, constraint, elsewhere) | odd
        members = Demonstrations([c for _, c in cut], demonstrations.notes)
        maps, rows = (asked_for, None) if asked_for else ((features,), constraint.n_rows)
        parts.append(Part(members, tuple(s for s, _ in cut), maps, rows, True))
    unlearnt = (*((s, DISAGREES) for s in apart), *_of_one(found.unsupported))
    free.sort(key=lambda s: (s.trajectory, s.start))
    return Division(tuple(parts), tuple(free), tuple(sorted(odd.items())), False, found.warnings, unlearnt)


def _agreeing(
    demonstrations: Demonstrations, features: FeatureMap, constraint: PhaseConstraint
) -> tuple[list[tuple[Stretch, Trajectory]], list[tuple[Stretch, str]], list[Stretch]]:
    """The stretches of a constraint that agree, those that do not and why, and those that are free motion after all."""
    cut = [(s, c) for s in constraint.stretches if (c := _trimmed(demonstrations[s.trajectory], s)) is not None]
    if len(cut) <= 2:
        return cut, [], []
    agreement = judge_agreement(features, [c for _, c in cut], constraint.n_rows)
    members, odd, free = [cut[i] for i in agreement.members], list[tuple[Stretch, str]](), list[Stretch]()
    for i, why in agreement.odd:
        stretch, motion = cut[i]
        held = held_part(features, motion, [cut[k][1] for k in agreement.members], agreement.selection)
        if is_chance(stretch, [s for s, _ in members]):
            free.append(stretch)
        elif held is not None and (c := _trimmed(motion, Stretch(stretch.trajectory, *held))) is not None:
            members.append((Stretch(stretch.trajectory, *held), c))
        else:
            odd.append((stretch, why))
    return sorted(members, key=lambda m: (m[0].trajectory, m[0].start)), odd, free


def _of_one(contacts: Sequence[Stretch]) -> tuple[tuple[Stretch, str], ...]:
    return tuple((s, IN_ONE_ONLY) for s in contacts)


def _missing(
    demonstrations: Demonstrations, features: FeatureMap, constraint: PhaseConstraint, number: int
) -> dict[int, str]:
    """The trajectories in which a constraint is not seen although nearly all others show it."""
    shown = constraint.trajectories
    if len(shown) < max(2, MOST * len(demonstrations)):
        return {}
    usual = [m for s in constraint.stretches if (m := _trimmed(demonstrations[s.trajectory], s)) is not None]
    out = {}
    for i, t in enumerate(demonstrations):
        if i not in shown:
            why = reason(features, [*usual, t], constraint.selection, len(usual), range(len(usual)))
            out[i] = f"constraint {number} is not seen in it, but in {len(shown)} of the others; {why}"
    return out


def _trimmed(trajectory: Trajectory, stretch: Stretch) -> Trajectory | None:
    """The inner samples of a stretch: the boundary is known to a tenth of a second only."""
    inside = np.flatnonzero((trajectory.time >= stretch.start + TRIM) & (trajectory.time <= stretch.end - TRIM))
    if len(inside) < FEWEST_SAMPLES:
        return None
    return trajectory.part(slice(int(inside[0]), int(inside[-1]) + 1))
