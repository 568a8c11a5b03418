"""What the recordings show: which stretches belong to which constraint, and which recordings do not agree."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import final

import numpy as np
from jaxtyping import Bool, Float

from manip_learn.constraint.features.feature_map import FeatureMap
from manip_learn.constraint.features.frame_jacobian import FrameJacobian
from manip_learn.errors import counted, listed
from manip_learn.learning.before_smoothing import BeforeSmoothing
from manip_learn.learning.evidence.recombination import recombination_test
from manip_learn.learning.explanation.evidence import SWITCH
from manip_learn.learning.explanation.explain import LEAST_GAIN, Explanation, Hypothesis, explain
from manip_learn.learning.explanation.lone import lone_contacts
from manip_learn.learning.explanation.odd import agreeing, drifting, missing, slipping
from manip_learn.learning.explanation.row_motion import joints_at_once
from manip_learn.learning.explanation.stretch import Stretch, pieces_of, sharpened, stretches_of, uncovered
from manip_learn.learning.explanation.views import View, mechanism_features, views_of
from manip_learn.recordings.demonstrations import Demonstrations
from manip_learn.recordings.trajectory import Trajectory
from manip_learn.robot.robot import Reference

RECOMBINATIONS = 99
# a joint that moves alone goes where it must: only joints that move at the same time show what coordinates them. Joints
# that are moved one after the other give 1.00, contacts of twelve mechanisms with four arms 1.4 to 4 (least 1.1)
AT_ONCE = 1.1
# a stretch shorter than this share of the usual one is chance: another motion that passes along the free directions
CHANCE = 0.25
# largest share of the free velocity along the rows of a firm contact
FIRM = 0.05
# directions in which the joints must move for a contact that one recording alone shows
EXCITED = 5
# rows of two constraints closer together than this may be one constraint, or two [deg]
NEARLY_THE_SAME = 5.0
IN_ONE_ONLY = "appears in one recording only"
DISAGREES = "does not agree with the other recordings"


@final
@dataclass(frozen=True, eq=False)
class Part:
    """What one constraint is learnt from.

    Attributes:
        demonstrations: Whole recordings, or stretches of them.
        stretches: Where each of them lies; trajectories are counted from 0 in what was given to the learner.
        feature_maps: The candidates for Phi; the one in which the rows were found, if they were.
        found: Rows that explain these stretches, orthonormal; None if nothing does.
        asked: The feature maps that were asked for.
        choices: In how many ways as many recordings can be chosen from all.
        source: All recordings before they were smoothed; None if they were not.
    """

    demonstrations: Demonstrations
    stretches: tuple[Stretch, ...]
    feature_maps: tuple[FeatureMap, ...]
    found: Float[np.ndarray, "s p"] | None = None
    asked: tuple[FeatureMap, ...] = ()
    choices: int = 1
    source: BeforeSmoothing | None = None

    @property
    def n_constraints(self) -> int | None:
        """Number of rows that explain these stretches; None: from the data."""
        return None if self.found is None else len(self.found)

    @property
    def recorded(self) -> list[Trajectory] | None:
        """The demonstrations as they were recorded; None if they are."""
        return None if self.source is None else self.source.of(self.stretches, self.demonstrations)


@final
@dataclass(frozen=True, eq=False)
class Findings:
    """The recordings, explained.

    Attributes:
        parts: One per constraint, best supported first.
        free: Stretches of free motion.
        unlearnt: Stretches in which something seems to be held that is not learnt, and why.
        refused: Stretches of the hypothesis that comes nearest, where none is believed.
        elsewhere: Whether rows in the other reference are held instead.
        odd: Trajectories that do not agree with the others, and why.
        explained: Whether the parts are what explains the recordings; if not, nothing does, and there is one part.
        warnings: Doubts, in sentences.
    """

    parts: tuple[Part, ...]
    free: tuple[Stretch, ...] = ()
    odd: tuple[tuple[int, str], ...] = ()
    explained: bool = False
    warnings: tuple[str, ...] = ()
    unlearnt: tuple[tuple[Stretch, str], ...] = ()
    refused: tuple[Stretch, ...] = ()
    elsewhere: bool = False

    @property
    def divided(self) -> bool:
        """Whether several constraints, or one in parts of the recordings, explain them."""
        return self.explained and (len(self.parts) > 1 or bool(self.free) or bool(self.unlearnt))

    def phases(self) -> tuple[tuple[Stretch, int | None, str], ...]:
        """(stretch, number of the constraint or None, why nothing is learnt from it), in order of time."""
        held = [(s, k, "") for k, part in enumerate(self.parts) for s in part.stretches]
        free = [(s, None, "") for s in self.free]
        unlearnt = [(s, None, why) for s, why in self.unlearnt]
        return tuple(sorted([*held, *free, *unlearnt], key=lambda x: (x[0].trajectory, x[0].start)))


def unexplained(demonstrations: Demonstrations, feature_maps: Sequence[FeatureMap]) -> Findings:
    """One part: everything."""
    stretches = tuple(Stretch(i, float(t.time[0]), float(t.time[-1])) for i, t in enumerate(demonstrations))
    return Findings((Part(demonstrations, stretches, tuple(feature_maps), None, tuple(feature_maps)),))


def find(
    demonstrations: Demonstrations,
    feature_maps: Sequence[FeatureMap],
    rng: np.random.Generator,
    *,
    phases: bool = True,
    mechanisms: bool = True,
) -> Findings:
    """Explain the recordings by a few constraints and free motion.

    Args:
        demonstrations: With velocities.
        feature_maps: The candidates for Phi.
        rng: For the comparisons with chance.
        phases: Whether a constraint may hold in a part of a recording.
        mechanisms: Whether rows in which mechanisms are constant may explain what those asked for do not.
    """
    trajectories = demonstrations.trajectories
    usable = [f for f in feature_maps if _moves(f, trajectories)]
    widths = {t.u.shape[1] for t in trajectories if t.u is not None}
    if not usable or any(widths != {f.nv} for f in feature_maps):
        return unexplained(demonstrations, feature_maps)  # refused where the samples are collected
    shown = partial(views_of, [*usable, *(mechanism_features(usable, trajectories) if mechanisms else ())])
    views = shown(trajectories)
    if not views:
        return unexplained(demonstrations, feature_maps)  # a single row: nothing to compare it with
    believed = partial(_believed, trajectories, int(rng.integers(2**32)))
    explanation = explain(views, believed, SWITCH if phases else np.inf)
    elsewhere = _elsewhere(usable, trajectories, explanation)
    if elsewhere:  # what disagrees in this reference is no other task
        return dataclasses.replace(unexplained(demonstrations, feature_maps), warnings=elsewhere, elsewhere=True)
    contacts = list[Stretch]()
    if phases and len(trajectories) > 1 and all(t.q.shape[1] == usable[0].nv for t in trajectories):
        contacts = lone_contacts(explanation, trajectories, shown, rng, min(EXCITED, usable[0].nv))
    if not explanation.hypotheses:
        alone = tuple((s, IN_ONE_ONLY) for s in contacts)
        nearest = Explanation(explanation.views, explanation.refused[:1], explanation.switch)
        refused = stretches_of(nearest.thin, nearest.states, 1)
        nothing = unexplained(demonstrations, feature_maps)
        return dataclasses.replace(nothing, unlearnt=alone, refused=refused)
    return _findings(demonstrations, feature_maps, explanation, contacts)


def _elsewhere(
    feature_maps: Sequence[FeatureMap], trajectories: Sequence[Trajectory], explanation: Explanation
) -> tuple[str, ...]:
    """A warning if rows in the other reference, which was not asked for, explain all recordings better."""
    tried = {f.reference for f in feature_maps if isinstance(f, FrameJacobian)}
    whole = [np.all(explanation.gains[:, k] > 0.0) for k in range(len(explanation.hypotheses))]
    firm = any(w and h.scale.share <= FIRM for w, h in zip(whole, explanation.hypotheses, strict=True))
    if len(tried) != 1 or firm:
        return ()
    other: Reference = "local" if "world" in tried else "world"
    maps = [
        FrameJacobian(f.robot, f.frame.name, f.row_names, other) for f in feature_maps if isinstance(f, FrameJacobian)
    ]
    there = explain(views_of(maps, trajectories), lambda *_: True, np.inf)
    throughout = len(np.unique(there.thin.trajectory[there.states > 0])) == len(trajectories)
    if not throughout or there.explained.sum() < explanation.explained.sum() + LEAST_GAIN:
        return ()
    return (
        f"in the {tried.pop()} reference no constraint fits all recordings, in the {other} one does: the rows are held "
        f"there (reference {other!r})",
    )


def held_throughout(feature_maps: Sequence[FeatureMap], demonstrations: Demonstrations) -> bool:
    """Whether some rows of these features stay still in every recording as a whole, be they held or never tried."""
    usable = [f for f in feature_maps if _moves(f, demonstrations.trajectories)]
    if not usable:
        return False
    views = views_of(usable, demonstrations.trajectories)
    if not views:
        return False
    found = explain(views, lambda *_: True, np.inf)
    return bool(found.hypotheses) and len(np.unique(found.thin.trajectory[found.states > 0])) == len(demonstrations)


def _moves(features: FeatureMap, trajectories: Sequence[Trajectory]) -> bool:
    """Whether any row of the features is not zero throughout."""
    few = np.concatenate([t.q[:: max(1, len(t) // 5)] for t in trajectories])
    return bool(np.any(np.abs(features.batch(few)) > 0.0))


def _believed(
    trajectories: Sequence[Trajectory], seed: int, view: View, h: Hypothesis, held: Bool[np.ndarray, " n"]
) -> bool:
    """Whether exchanging joints between the stretches breaks the rows, and the joints move enough to show it."""
    shown = stretches_of(view.thin, held.astype(np.int64), 1)
    # a slip of some millimetres is a few samples of evidence, and as much as exchanged joints break of a short contact
    still = agreeing(view.thin, h.rows, shown)
    stretches, pieces = pieces_of(trajectories, [s for s, good in zip(shown, still, strict=True) if good])
    recordings = sorted({s.trajectory for s in stretches})
    if not pieces or (len(trajectories) > 1 and len(recordings) < 2):
        return False
    noise = view.motion.noise[view.motion.first[:-1]]
    moved = [joints_at_once(np.asarray(c.u), noise[s.trajectory]) for s, c in zip(stretches, pieces, strict=True)]
    if np.median(moved) < AT_ONCE:
        return False
    choices = math.comb(len(trajectories), len(recordings))
    evidence = recombination_test(view.features, pieces, np.random.default_rng(seed), RECOMBINATIONS, choices)
    return evidence.n_rows >= h.n_rows


def _findings(
    demonstrations: Demonstrations,
    feature_maps: Sequence[FeatureMap],
    explanation: Explanation,
    contacts: Sequence[Stretch],
) -> Findings:
    trajectories, states = demonstrations.trajectories, explanation.fine_states()
    order = np.argsort(-explanation.supports).tolist()
    parts, odd, apart = list[Part](), dict[int, str](), list[Stretch]()
    views = [explanation.views[explanation.hypotheses[k].view] for k in order]
    found = []
    for k, view in zip(order, views, strict=True):
        h = explanation.hypotheses[k]
        spans = sharpened(view.motion, h.rows, stretches_of(view.motion, states, k + 1))
        usual = np.median([s.duration for s in spans]) if spans else 0.0
        found.append(tuple(pieces_of(trajectories, [s for s in spans if s.duration >= CHANCE * usual])[0]))
    for number, (k, view, stretches) in enumerate(zip(order, views, found, strict=True), start=1):
        rows = explanation.hypotheses[k].rows
        if not stretches:
            continue
        selection = view.motion.selection(rows)
        agrees = agreeing(view.motion, rows, stretches)
        members = tuple(s for s, good in zip(stretches, agrees, strict=True) if good)
        apart += [s for s in stretches if s not in members]
        elsewhere = [s for other in found if other is not stretches for s in other]
        own = (view.features, trajectories, selection)
        odd |= slipping(view.motion, rows, *own, members, elsewhere)
        odd |= missing(*own, stretches, number)
        odd |= drifting(*own, stretches, agrees)
        shown = len({s.trajectory for s in members})
        parts.append(
            Part(
                Demonstrations(pieces_of(trajectories, members)[1], demonstrations.notes),
                members,
                (view.features,),
                selection,
                tuple(feature_maps),
                math.comb(len(trajectories), shown),
            )
        )
    if not parts:
        return unexplained(demonstrations, feature_maps)
    taken = [s for part in parts for s in part.stretches] + apart
    lone = [s for s in contacts if not any(s.shared(other) > 0.0 for other in taken)]
    tasks = [{s.trajectory for s in part.stretches} for part in parts]
    warnings = _doubts(explanation, order)
    if len(tasks) > 1 and not set.intersection(*tasks):
        shown = listed(counted(len(task), "recording") for task in tasks)
        warnings.append(f"the recordings are of {len(tasks)} tasks, {shown}: each constraint is learnt from its own")
    free = tuple(uncovered(explanation.views[0].motion, [*taken, *lone]))
    unlearnt = (*((s, DISAGREES) for s in apart), *((s, IN_ONE_ONLY) for s in lone))
    return Findings(tuple(parts), free, tuple(sorted(odd.items())), True, tuple(warnings), unlearnt)


def _doubts(explanation: Explanation, order: Sequence[int]) -> list[str]:
    out, found = [], [explanation.hypotheses[k] for k in order]
    for j, b in enumerate(found):
        for i, a in enumerate(found[:j]):
            if a.view != b.view or a.n_rows != b.n_rows:
                continue
            one, other = (explanation.views[h.view].motion.selection(h.rows) for h in (a, b))
            angle = _angle(one, other)
            if angle < NEARLY_THE_SAME:
                out.append(
                    f"constraints {i + 1} and {j + 1} differ by {angle:.1f} deg only: two contacts that nearly "
                    "coincide, or one that is not quite constant; they are kept apart, not averaged"
                )
    return out


def _angle(one: Float[np.ndarray, "s p"], other: Float[np.ndarray, "s p"]) -> float:
    """Largest angle between two row spaces [deg]."""
    return float(np.degrees(np.arccos(np.clip(np.linalg.svd(one @ other.T)[1][-1], -1.0, 1.0))))
