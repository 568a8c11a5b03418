"""What the recordings show: which stretches belong to which constraint, and which recordings do not agree.

Those are recordings that drift along rows that the others hold still, and those that slip.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from statistics import NormalDist
from typing import final

import numpy as np
from jaxtyping import Bool, Float, Int

from manip_learn.constraint.features.feature_map import FeatureMap, sum_in_words
from manip_learn.constraint.features.frame_jacobian import FrameJacobian
from manip_learn.learning.explanation.evidence import (
    FAR_FROM_HELD,
    SWITCH_NATS,
    Stretch,
    covered,
    pieces_of,
    sharpened,
    state_runs,
    stretches_of,
    uncovered,
    ways_to_choose,
)
from manip_learn.learning.explanation.explain import (
    LEAST_GAIN_NATS,
    Explanation,
    Hypothesis,
    Moments,
    candidates,
    explain,
    least_used,
)
from manip_learn.learning.explanation.row_motion import (
    OVER_NOISE,
    RowMotion,
    View,
    joints_at_once,
    kinds_tried,
    mechanism_features,
    views_of,
)
from manip_learn.learning.recombination import BELIEVED_STRENGTH, FEWEST_TRAJECTORIES, recombination_test
from manip_learn.learning.repeats import once_each
from manip_learn.learning.samples import Table
from manip_learn.recordings.trajectory import Demonstrations, Trajectory
from manip_learn.robot.robot import Reference

# [joints] a joint that moves alone goes where it must: only joints that move at the same time show what coordinates
# them. Joints that are moved one after the other give 1.00, contacts of twelve mechanisms with four arms 1.4 to 4
# (least 1.1)
JOINTS_AT_ONCE = 1.1
# ratio to the usual length of a stretch, below which one is chance: another motion that passes along the free
# directions. Set by hand
SHORT_STRETCH_RATIO = 0.25
# largest share of the free velocity along the rows of a firm contact. Set by hand
FIRM_SHARE = 0.05
# the same in a single recording, where only firmness tells a contact from free motion, which also runs straight or
# flat, but never to better than a few per cent
FIRM_ALONE_SHARE = 0.01
# ratio of the next level to those of the held rows, or to the noise, from which they are firm: free motion of people's
# hands reaches 11, a box that is pushed 26
FIRM_GAP = 40.0
# share of the way along the rows, before a contact, by which its place may differ between recordings. Set by hand
SAME_PLACE_SHARE = 0.02
_STEPS = 20  # of an integral along the joints' straight way
# [deg] rows closer together than this are nearly the same. Set by hand
NEARLY_SAME_DEG = 5.0
# [robust standard deviations of the logarithm] by which a drift must exceed the usual one to be odd. Set by hand
ODD_SPREAD = 6.0
# share of its motion by which a stretch must drift to be odd. Set by hand
ODD_SHARE = 0.005
# [s] longest interruption of a contact: who lets go for longer does so on purpose. Set by hand
LONGEST_SLIP_SECONDS = 1.5
# a slip goes this many times farther along the held rows than a whole contact, and at least this far [m or rad]. Set
# by hand
SLIP_FACTOR, LEAST_SLIP = 5.0, 2e-3
# share of the recordings that must show a constraint before one that does not is called odd: more than half
SHOWN_BY_SHARE = 0.6

MEDIAN_SQUARE = NormalDist().inv_cdf(0.75) ** 2  # of a standard normal variable
IN_ONE_ONLY = "appears in one recording only"
DISAGREES = "does not agree with the other recordings"


def agreeing(motion: RowMotion, rows: Float[np.ndarray, "s r"], stretches: Sequence[Stretch]) -> Bool[np.ndarray, " m"]:
    """Which stretches stay as still along the rows as most of them do.

    Velocities are summed up before they are judged: what noise adds averages out, a wrong direction does not.
    """
    lengths, ways, noise = np.array([_drift(motion, rows, s) for s in stretches]).reshape(-1, 3).T
    drift = lengths / np.maximum(ways, 1e-12)
    agrees = np.ones(len(stretches), dtype=bool)
    for _ in range(3):
        # in length and as a share: a short stretch drifts no less than a long one
        ratios = np.minimum(lengths / np.median(lengths[agrees]), drift / np.median(drift[agrees]))
        excess = np.log(np.maximum(ratios, 1e-12))
        # below the usual only: above it the odd ones spread as well
        spread = max(0.0, -float(np.quantile(excess[agrees], 0.16)))
        agrees = (excess <= max(np.log(FAR_FROM_HELD), ODD_SPREAD * spread)) | (drift <= ODD_SHARE)
        agrees |= lengths <= OVER_NOISE * noise
        if not np.any(agrees):
            return np.ones(len(stretches), dtype=bool)
    return agrees


def _drift(motion: RowMotion, rows: Float[np.ndarray, "s r"], stretch: Stretch) -> tuple[float, float, float]:
    """How far a stretch gets along the rows, how far it gets at all, and how far white noise on its velocities alone
    would take it along the rows: one standard deviation at its end [rad of a typical joint].
    """
    inside = covered(motion, [stretch])
    steps = motion.rates[inside] * motion.weight[inside, None]
    way = np.cumsum(steps, axis=0)
    # of neighbours, for what is common to them is motion; of most of them, for a slip is none
    squares = np.diff(steps @ rows.T, axis=0) ** 2
    noise = (
        float(np.sqrt(0.5 * len(squares) * np.sum(np.median(squares, axis=0)) / MEDIAN_SQUARE)) if len(squares) else 0.0
    )
    return max(_extent(way @ rows.T), 1e-12), _extent(way), noise


def _extent(way: Float[np.ndarray, "n k"]) -> float:
    return float(np.linalg.norm(np.ptp(way, axis=0))) if len(way) else 0.0


def disagreeing(
    view: View,
    rows: Float[np.ndarray, "s r"],
    table: Table,
    stretches: Sequence[Stretch],
    agrees: Bool[np.ndarray, " m"],
    elsewhere: Sequence[Stretch],
) -> dict[int, str]:
    """Number of each trajectory that does not agree about a constraint -> how it differs, in words.

    Motion along the rows interrupts a contact that most others show in one piece, as by a slip, unless another
    constraint holds in between (`elsewhere`); or nearly all others show the constraint; or it drifts along its rows.
    """
    motion, own, trajectories = view.motion, (view.features, view.motion.selection(rows)), table.recordings
    members = [s for s, good in zip(stretches, agrees, strict=True) if good]
    odd, out = [s for s in stretches if s not in members], dict[int, str]()
    spans = {i: [s for s in members if s.trajectory == i] for i in sorted({s.trajectory for s in members})}
    usual = np.median([len(s) for s in spans.values()])
    held = float(np.median([_drift(motion, rows, s)[0] for s in members]))
    for i, parts in spans.items():
        for a, b in pairwise(parts if len(parts) > usual else ()):
            gap, between = Stretch(i, a.end, b.start), trajectories[i][a.end : b.start]
            if gap.duration > LONGEST_SLIP_SECONDS or any(gap.shared(s) > 0.0 for s in elsewhere):
                continue
            if _drift(motion, rows, gap)[0] > SLIP_FACTOR * held and _extent(way_along(between, *own)) > LEAST_SLIP:
                why = how_it_differs(between, [trajectories[s.trajectory][s.start : s.end] for s in members], *own)
                out[i] = f"its contact is interrupted from {a.end:.2f} s to {b.start:.2f} s, as by a slip: {why}"
                break
    shown = {s.trajectory for s in stretches}
    if len(shown) >= max(2.0, SHOWN_BY_SHARE * len(trajectories)):
        whole = pieces_of(table, stretches)[1].recordings
        for i in sorted(set(range(len(trajectories))) - shown):
            why = how_it_differs(trajectories[i], whole, *own)
            out[i] = f"what {len(shown)} of the others hold still is not seen in it; {why}"
    whole = pieces_of(table, members)[1].recordings
    left, pieces = pieces_of(table, odd)
    for s, piece in zip(left, pieces.recordings, strict=True):
        time, way = piece.time, way_along(piece, *own)
        later = np.minimum(np.searchsorted(time, time + 0.1), len(time) - 1)  # a tenth of a second
        fastest = time[np.argmax(np.linalg.norm(way[later] - way, axis=1))]
        out[s.trajectory] = f"{how_it_differs(piece, whole, *own)}, fastest at {fastest:.2f} s"
    return out


def how_it_differs(
    t: Trajectory, members: Sequence[Trajectory], features: FeatureMap, selection: Float[np.ndarray, "s p"]
) -> str:
    """One sentence: how far it moves along the direction that the others hold still, and how far they do."""
    way = way_along(t, features, selection)
    centred = way - way.mean(axis=0)
    worst = np.linalg.svd(centred, full_matrices=False)[2][0]
    row = worst @ selection
    moved = float(np.ptp(way @ worst))
    usual = float(np.median([np.ptp(way_along(other, features, selection) @ worst) for other in members]))
    turns = np.array([unit.startswith("rad") for unit in features.row_units])
    rotation = float(np.sum(row[turns] ** 2)) > 0.5
    others = f"the other {len(members)} hold" if len(members) > 1 else "the other one holds"
    words = sum_in_words(row * np.sign(row[np.argmax(np.abs(row))]), features.row_names, "+.2f", 0.05)
    how = "turns {:.2g} deg about" if rotation else "moves {:.3g} mm along"
    factor = np.degrees(1.0) if rotation else 1e3
    return (
        f"{t.name} {how.format(factor * moved)} a direction ({words}) that {others} still "
        f"(median {factor * usual:.2g} {'deg' if rotation else 'mm'})"
    )


def way_along(t: Trajectory, features: FeatureMap, selection: Float[np.ndarray, "s p"]) -> Float[np.ndarray, "T s"]:
    """Way along each row [m or rad], trapezoid rule."""
    rates = np.matmul(features.batch(t.q), np.asarray(t.u)[:, :, None])[:, :, 0] @ selection.T
    steps = 0.5 * (rates[1:] + rates[:-1]) * np.diff(t.time)[:, None]
    return np.concatenate([np.zeros((1, len(selection))), np.cumsum(steps, axis=0)])


@final
@dataclass(frozen=True, eq=False)
class Part:
    """What one constraint is learnt from.

    Attributes:
        demonstrations: Whole recordings, or stretches of them.
        table: Their samples.
        stretches: Where each of them lies; trajectories are counted from 0 in what was given to the learner.
        feature_maps: The candidates for Phi; the one in which the rows were found, if they were.
        found: Rows that explain these stretches, orthonormal; None if nothing does.
        asked: The feature maps that were asked for.
        firm: How many rows are held so firmly, and at one place, that this is evidence (see `RowEvidence`).
        choices: Among how many they were chosen: feature maps, numbers of rows, and `ways_to_choose` as much motion.
        source: All recordings, whole.
    """

    demonstrations: Demonstrations
    table: Table
    stretches: tuple[Stretch, ...]
    feature_maps: tuple[FeatureMap, ...]
    found: Float[np.ndarray, "s p"] | None = None
    asked: tuple[FeatureMap, ...] = ()
    firm: int = 0
    choices: float = 1.0
    source: Demonstrations | None = None

    def of(self, stretches: Sequence[Stretch]) -> Part:
        """Other stretches of the recordings, in which as many rows are held, but others perhaps."""
        held, pieces = pieces_of(self.table.whole, stretches)
        motion = Demonstrations(pieces.recordings, self.demonstrations.notes)
        return dataclasses.replace(self, demonstrations=motion, table=pieces, stretches=tuple(held))

    @staticmethod
    def of_all(demonstrations: Demonstrations, feature_maps: Sequence[FeatureMap]) -> Part:
        """Everything in one part.

        Raises:
            RecordingError: A trajectory lacks velocities, or has postures of another size.
        """
        stretches = tuple(Stretch(i, float(t.time[0]), float(t.time[-1])) for i, t in enumerate(demonstrations))
        maps = tuple(feature_maps)
        return Part(demonstrations, Table.of(demonstrations), stretches, maps, asked=maps, source=demonstrations)


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
    def held(self) -> list[Stretch]:
        """Stretches in which rows are held."""
        return [s for part in self.parts for s in part.stretches] if self.explained else []


def find(
    everything: Part,
    rng: np.random.Generator,
    *,
    switch: float = SWITCH_NATS,
    mechanisms: bool = True,
    strength: float = BELIEVED_STRENGTH,
) -> Findings:
    """Explain the recordings by a few constraints and free motion.

    Args:
        everything: The recordings with velocities, and the candidates for Phi.
        rng: For the comparisons with chance.
        switch: What a change between two states costs [nats]; infinite: no constraint holds in a part of a recording.
        mechanisms: Whether rows in which mechanisms are constant may explain what those asked for do not.
        strength: From which on a row is believed, see `recombination_test`.
    """
    table, feature_maps, nothing = everything.table, everything.asked, Findings((everything,))
    if any(table.u.shape[1] != f.nv for f in feature_maps):
        return nothing  # refused where the samples are collected
    more = mechanism_features(feature_maps, table.recordings) if mechanisms else ()
    views = views_of([*feature_maps, *more], table)
    if not views:
        return nothing  # no row moves, or a single one: nothing to compare it with
    believed = _Recombination(table, kinds_tried(views), int(rng.integers(2**32)), strength)
    explanation = explain(views, believed, switch)
    frames = [f for f in feature_maps if isinstance(f, FrameJacobian)]
    asked, hypotheses = {f.reference for f in frames}, enumerate(explanation.hypotheses, start=1)
    firm = any(h.scale.share <= FIRM_SHARE and np.all(explanation.states == k) for k, h in hypotheses)
    if len(asked) == 1 and not firm:
        # do rows in the other reference, which was not asked for, explain all recordings better?
        other: Reference = "local" if "world" in asked else "world"
        there = held_throughout([FrameJacobian(f.robot, f.frame.name, f.row_names, other) for f in frames], table)
        if there is not None and there.explained.sum() >= explanation.explained.sum() + LEAST_GAIN_NATS:
            said = (
                f"in the {asked.pop()} reference no constraint fits all recordings, in the {other} one does: the rows "
                f"are held there (reference {other!r})"
            )  # what disagrees in this reference is no other task
            return dataclasses.replace(nothing, warnings=(said,), elsewhere=True)
    contacts = _lone_contacts(explanation, believed) if switch < np.inf and len(table.recordings) > 1 else []
    if not explanation.hypotheses:
        alone = tuple((s, IN_ONE_ONLY) for s in contacts)
        nearest = Explanation(explanation.views, explanation.refused[:1], explanation.switch)
        return dataclasses.replace(nothing, unlearnt=alone, refused=stretches_of(nearest.thin, nearest.states, 1))
    return _findings(everything, explanation, contacts)


def held_throughout(feature_maps: Sequence[FeatureMap], table: Table) -> Explanation | None:
    """The rows of these features that stay still in every recording as a whole, be they held or never tried; None if
    one recording has no such rows.
    """
    views = views_of(feature_maps, table)
    if not views:
        return None
    found = explain(views, lambda *_: True, np.inf)
    return found if set(found.thin.trajectory[found.states > 0]) == set(range(len(table.recordings))) else None


@final
@dataclass(frozen=True)
class _Recombination:
    """The test of a hypothesis, the best of so many tried: whether exchanging joints between its stretches breaks its
    rows. The seed is that of the exchanges.
    """

    table: Table
    tried: int
    seed: int
    strength: float

    def __call__(self, view: View, h: Hypothesis, held: Bool[np.ndarray, " n"]) -> bool:
        """Whether several recordings confirm the hypothesis, or the only one does."""
        shown = stretches_of(view.thin, held.astype(np.int64), 1)
        # a slip of some millimetres is a few samples of evidence; exchanged joints break no more of a short contact
        still = agreeing(view.thin, h.rows, shown)
        stretches, pieces = pieces_of(self.table, [s for s, good in zip(shown, still, strict=True) if good])
        recordings = {s.trajectory for s in stretches}
        enough = len(recordings) >= min(2, len(self.table.recordings))
        chosen = once_each(stretches, pieces.recordings) if enough else []
        stretches, shown = [stretches[k] for k in chosen], [pieces.recordings[k] for k in chosen]
        return enough and (
            self._confirmed(view, h, stretches, shown, len(recordings)) or is_firm(self.table, view, h, stretches)
        )

    def of_one(self, view: View, h: Hypothesis, stretch: Stretch) -> bool:
        """Whether the parts of a single stretch confirm the hypothesis beyond doubt, each as a recording would."""
        stretches, pieces = pieces_of(self.table, [stretch])
        parts = [p[a:b] for p in pieces.recordings for a, b in pairwise(_parts_of(float(p.time[0]), float(p.time[-1])))]
        return self._confirmed(view, h, stretches, parts, 1)

    def _confirmed(
        self, view: View, h: Hypothesis, stretches: Sequence[Stretch], pieces: Sequence[Trajectory], recordings: int
    ) -> bool:
        """By pieces of these stretches; beyond doubt if they are of few recordings, for two can be alike by chance."""
        noise = [view.motion.noise[view.motion.first[s.trajectory]] for s in stretches]
        at_once = [joints_at_once(np.asarray(p.u), float(np.mean(noise))) for p in pieces]
        shown = pieces if pieces and np.median(at_once) >= JOINTS_AT_ONCE else []
        choices = self.tried * ways_to_choose(view.thin, stretches)
        for some in [shown] if h.scale.share <= FIRM_SHARE else [shown, self._alike(stretches, shown)]:
            rng = np.random.default_rng(self.seed)
            evidence = recombination_test(view.features, some, rng, choices, self.strength)
            sure = recordings >= FEWEST_TRAJECTORIES or evidence.clear
            if not some or evidence.n_rows < h.n_rows or not sure:
                return False
        return True

    def _alike(self, stretches: Sequence[Stretch], pieces: Sequence[Trajectory]) -> list[Trajectory]:
        """The parts of the recordings that begin and end where the longest piece does, in their joints.

        Rows that give way are chosen with the parts of a motion in which they do so least. Joints that are exchanged
        between parts of one path that begin at different postures no longer meet, be anything held or not.
        """
        if not pieces:
            return []
        ends, out = max(pieces, key=len).q[[0, -1]], []
        for s in stretches:
            whole = self.table.recordings[s.trajectory]
            middle = int(np.searchsorted(whole.time, 0.5 * (s.start + s.end)))
            first = int(np.argmin(np.linalg.norm(whole.q[: middle + 1] - ends[0], axis=1)))
            last = middle + int(np.argmin(np.linalg.norm(whole.q[middle:] - ends[1], axis=1)))
            out.append(whole.part(slice(first, last + 1)))
        return out


def is_firm(table: Table, view: View, h: Hypothesis, stretches: Sequence[Stretch]) -> bool:
    """Whether rows do not move beyond the noise, far less than what is free, and stand at one place in at least three
    recordings, to which the hand came from elsewhere each time.

    A joint that rests because a contact holds it has no motion that could be exchanged. Nobody brings a free hand back
    to the same place to a hundredth of its way; but an arm rests at its home, where nothing came before.
    """
    motion, s = view.motion, h.n_rows
    few = len({x.trajectory for x in stretches}) < FEWEST_TRAJECTORIES
    if few or h.scale.share > FIRM_ALONE_SHARE or table.q.shape != table.u.shape:
        return False
    inside = covered(motion, stretches)
    weight = motion.weight * inside
    M, S = (motion.rates.T * weight) @ motion.rates, np.tensordot(weight, motion.gram, axes=1)
    sizes, _ = least_used(Moments(M[None], S[None], motion.noise[inside].mean()[None], np.zeros(1, dtype=np.int64)))
    if sizes[0, s] < FIRM_GAP * sizes[0, s - 1]:
        return False
    middles, came = [], []
    for x in stretches:
        before = (motion.trajectory == x.trajectory) & (motion.time < x.start)
        way = np.cumsum(motion.rates[before] * motion.weight[before, None], axis=0) @ h.rows.T
        came.append(_extent(way))
        recording = table.recordings[x.trajectory]
        middles.append(recording.q[np.searchsorted(recording.time, 0.5 * (x.start + x.end))])
    shares = (np.arange(_STEPS) + 0.5) / _STEPS
    off = []
    for q in middles[1:]:  # along the rows, on the straight way between the joints' positions
        between = view.features.batch(middles[0] + shares[:, None] * (q - middles[0]))
        off.append(np.linalg.norm(h.rows @ motion.whitening @ between.mean(axis=0) @ (q - middles[0])))
    return max(off) <= SAME_PLACE_SHARE * float(np.median(came))


def _lone_contacts(explanation: Explanation, believed: _Recombination) -> list[Stretch]:
    """Stretches beside those explained in which rows hold firmly, in one recording each: they are named, so that they
    can be recorded again, and not learnt. What one recording alone shows is weighed on its own samples.
    """
    out = list[Stretch]()
    for i in range(explanation.thin.n_trajectories):
        views = [v.of_recordings(i, i + 1) for v in explanation.views]
        rest = Explanation(views, explanation.hypotheses, explanation.switch)
        found = [] if np.all(rest.states > 0) else candidates(rest)
        firm = [h for h in found if h.scale.share <= FIRM_ALONE_SHARE and h.support > LEAST_GAIN_NATS]
        if not firm:
            continue
        h = max(firm, key=lambda h: h.support)
        alone = Explanation(views, (*explanation.hypotheses, h), explanation.switch)
        stretches = stretches_of(views[0].motion, alone.fine_states(), len(alone.hypotheses))
        values = alone.values[:, -1] - alone.others(len(alone.hypotheses) - 1)
        for s in stretches:
            # without the part of it that gains most, less its price and that of the change into it and out of it
            inside, edges = covered(alone.thin, [s]), _parts_of(s.start, s.end)[1:-1]
            gains = np.bincount(np.searchsorted(edges, alone.thin.time[inside]), values[inside])
            worth = dataclasses.replace(h, gains=gains).worth(s.duration) - alone.switch
            there = dataclasses.replace(s, trajectory=i)
            if worth > LEAST_GAIN_NATS and believed.of_one(explanation.views[h.view], h, there):
                out.append(there)
    return out


def _parts_of(start: float, end: float) -> Float[np.ndarray, " k"]:
    """Edges of the parts of a stretch that stand for recordings: one more than the fewest can be spared [s]."""
    return np.linspace(start, end, FEWEST_TRAJECTORIES + 2)


def _without_passages(explanation: Explanation, states: Int[np.ndarray, " n"]) -> Int[np.ndarray, " n"]:
    """States in which a short passage counts to the contact beside it that leaves free what the passage does.

    A wipe that begins straight looks like a drawer for as long as that lasts; nobody has let go of anything there.
    """
    motion, out = explanation.views[0].motion, states.copy()
    length = np.linalg.norm(motion.rates, axis=1) * motion.weight
    spans = state_runs(states, motion.first)
    for (k, a, b), (j, c, d) in [*pairwise(spans), *pairwise(spans[::-1])]:
        beside = motion.trajectory[a] == motion.trajectory[c] and k > 0 and j > 0
        if beside and np.sum(length[a:b]) < SHORT_STRETCH_RATIO * np.sum(length[c:d]):
            one, other = explanation.hypotheses[k - 1], explanation.hypotheses[j - 1]
            if one.view == other.view and len(one.rows) > len(other.rows):
                rows = explanation.views[one.view].motion
                more, fewer = rows.selection(one.rows), rows.selection(other.rows)
                left = fewer - fewer @ more.T @ more
                if np.linalg.norm(left, 2) < math.sin(math.radians(NEARLY_SAME_DEG)):
                    out[a:b] = j
    return out


def _findings(everything: Part, explanation: Explanation, contacts: Sequence[Stretch]) -> Findings:
    table, states = everything.table, _without_passages(explanation, explanation.fine_states())
    tried = kinds_tried(explanation.views)
    order = np.argsort(-explanation.supports).tolist()
    parts, odd, apart = list[Part](), dict[int, str](), list[Stretch]()
    views = [explanation.views[explanation.hypotheses[k].view] for k in order]
    found = []
    for k, view in zip(order, views, strict=True):
        h = explanation.hypotheses[k]
        spans = sharpened(view.motion, h.rows, stretches_of(view.motion, states, k + 1))
        usual = np.median([s.duration for s in spans]) if spans else 0.0
        found.append(tuple(pieces_of(table, [s for s in spans if s.duration >= SHORT_STRETCH_RATIO * usual])[0]))
    for k, view, stretches in zip(order, views, found, strict=True):
        rows = explanation.hypotheses[k].rows
        if not stretches:
            continue
        agrees = agreeing(view.motion, rows, stretches)
        members = tuple(s for s, good in zip(stretches, agrees, strict=True) if good)
        apart += [s for s in stretches if s not in members]
        elsewhere = [s for other in found if other is not stretches for s in other]
        odd |= disagreeing(view, rows, table, stretches, agrees, elsewhere)
        parts.append(
            dataclasses.replace(
                everything.of(members),
                feature_maps=(view.features,),
                found=view.motion.selection(rows),
                firm=len(rows) if is_firm(table, view, explanation.hypotheses[k], members) else 0,
                choices=tried * ways_to_choose(view.motion, members),
            )
        )
    if not parts:
        return Findings((everything,))
    taken = [s for part in parts for s in part.stretches] + apart
    lone = [s for s in contacts if not any(s.shared(other) > 0.0 for other in taken)]
    free = tuple(uncovered(explanation.views[0].motion, [*taken, *lone]))
    unlearnt = (*((s, DISAGREES) for s in apart), *((s, IN_ONE_ONLY) for s in lone))
    return Findings(tuple(parts), free, tuple(sorted(odd.items())), True, (), unlearnt)
