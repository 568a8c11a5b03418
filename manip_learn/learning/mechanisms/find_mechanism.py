"""From recordings to the mechanism that holds the hand, and to the constraint that it makes."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from typing import final

import numpy as np
from jaxtyping import Bool, Float

from manip_learn.constraint.features.curve_rows import CurveRows
from manip_learn.constraint.features.feature_map import FeatureMap
from manip_learn.constraint.features.frame_jacobian import FrameJacobian
from manip_learn.constraint.features.mechanism_rows import PlaceForm, PlaceRows
from manip_learn.constraint.mechanism import (
    CURVE,
    KIND_BY_NAME,
    MECHANISM_KINDS,
    Mechanism,
    Read,
    read_kind,
    rows_of,
)
from manip_learn.errors import NotIdentifiableError
from manip_learn.learning.arm_errors import AS_DESCRIBED, ArmErrors
from manip_learn.learning.explanation.evidence import stretches_of, ways_to_choose
from manip_learn.learning.explanation.explain import LEAST_GAIN_NATS, Hypothesis, explain
from manip_learn.learning.explanation.row_motion import View, kinds_tried, views_of
from manip_learn.learning.mechanisms.fit_curve import fit_curve, gain_in_nats, variance_across
from manip_learn.learning.mechanisms.one_place import groups_of, how_far_apart, likelier, misfit
from manip_learn.learning.mechanisms.place_fit import LEAST_RESIDUAL, PlaceErrors, PlaceFit, fit_place
from manip_learn.learning.mechanisms.quantities import QUANTITIES, Place, TipPaths, angles_about, thinned, turn_about
from manip_learn.learning.recombination import BELIEVED_STRENGTH, recombination_test
from manip_learn.learning.samples import BEYOND_CHANCE, STANDARD_ERRORS
from manip_learn.linalg import null_basis
from manip_learn.recordings.trajectory import Demonstrations, Trajectory
from manip_learn.recordings.velocities import with_velocities
from manip_learn.robot.batch.batch_kinematics import link_twists
from manip_learn.robot.joints import Frame
from manip_learn.robot.robot import Robot

# [m] beyond this an axis or a centre is not told from a line or a plane. Set by hand
FARTHEST_M = 3.0
# [m] by which a path must leave a simpler mechanism: rails wobble. Set by hand
LEAST_BEND_M = 5e-5
# one standard deviation above which a fit of a place is no answer: relative to the radius, and [deg]. Set by hand
POOR_RADIUS, POOR_AXIS_DEG = 0.2, 5.0
# uncertainty of the radius, relative, that is worth a warning; a third of it is aimed at. Set by hand
WIDE_RADIUS = 0.015
# [m] by which a hand must leave a mechanism in the same way each time before it is said. Set by hand
LEAST_SAID_M = 1e-3
# a quantity is the same for all trajectories if its residual grows by less than this ratio. Set by hand
SHARED_LOSS = 1.15

_SAMPLES = 60  # of each trajectory in the first fit of a place
_MOST, _LEAST = 4000, 60  # of all trajectories in the last fit, and of each
ONTO = 3  # steps onto a mechanism: each squares what is left, 1 mm of half a metre
BLIND = 1e-6  # rows of Phi below this are ones that the arm cannot move
FORMS: tuple[PlaceForm, ...] = ("point and rotation", "twist", "surface")

# what each mechanism becomes when it bends
BENT_FORMS = {
    "line": "hinge",
    "line, not turning": "hinge, not turning",
    "plane": "ball",
    "hinge": "screw",
    "hinge, firm": "screw, firm",
}

Held = tuple[FeatureMap, Float[np.ndarray, "s p"]]


@final
@dataclass(frozen=True, eq=False)
class MechanismFit:
    """The answer of `find_mechanism`.

    Attributes:
        mechanism: What holds the hand; None if nothing was found that does.
        features: Phi, with the mechanism's place as its parameters; None without a mechanism.
        selection: Lambda, shape (s, p), for `Constraint(selection, features)`; None without a mechanism.
        held_out: Largest standard deviation of a held row on trajectories left out, by unit (`"m"`, `"rad"`).
        reason: Why there is no mechanism; empty if there is one.
        warnings: What to know about the answer, in sentences.
        rival: Another form that the positions cannot exclude, in words; empty if there is none.
        odd: Numbers (from 0) of trajectories that do not belong: the others agree on a mechanism that does not hold
            these, or they are too short.
        errors: Draws of what its place is off by; None without a mechanism.
        variance: Mean square of what the mechanism, or one that is none, leaves of the hand's places in each direction
            that it holds [m^2]; 0 where it holds none.
        fit: Of the place to some samples of each trajectory; None without one.
        places: Numbers (from 0) of the trajectories that share a place, where there are several; else empty.
    """

    mechanism: Mechanism | None
    features: FeatureMap | None
    selection: Float[np.ndarray, "s p"] | None
    held_out: dict[str, float]
    reason: str = ""
    warnings: tuple[str, ...] = ()
    odd: tuple[int, ...] = ()
    rival: str = ""
    errors: PlaceErrors | None = None
    variance: float = 0.0
    fit: PlaceFit | None = None
    places: tuple[tuple[int, ...], ...] = ()


def find_mechanism(
    robot: Robot,
    frame: str,
    trajectories: Sequence[Trajectory],
    rng: np.random.Generator,
    *,
    held: Held | None = None,
    strength: float = BELIEVED_STRENGTH,
    arm: ArmErrors = AS_DESCRIBED,
) -> MechanismFit:
    """The mechanism that held a frame of the robot while the trajectories were recorded.

    Every mechanism is a constant Lambda in rows that are known in advance (`PlaceRows`). The rows that explain most of
    the trajectories say which mechanism it is and about where; its place is then fitted to positions and orientations.
    The grip may differ between trajectories: where the hand holds, and how it is turned.

    Args:
        robot: The robot.
        frame: The frame that is held, e.g. the tool's tip. It matters: what holds the tip is a surface or a curve for
            no other frame.
        trajectories: Motion in contact only (phases cut); at least two, better five. Missing velocities are derived.
        rng: For the exchange of joints between trajectories, the test against repeated motions, and for draws of the
            error.
        held: Phi and Lambda of rows that are known to be held. Where they are those of a mechanism, no other rows are
            looked for; if they do not speak of rotations, what holds the hand's orientation is tested beside them.
        strength: How much less than by chance a row must be used, with 99 % confidence, to be believed.
        arm: What is thought of its errors beforehand. They widen what is stated; whether a place is known well enough
            to be used, and how much more motion would help, is judged without them.

    Raises:
        UnknownNameError: No such frame; lists near matches.
        NotIdentifiableError: No trajectory has ten samples, or nothing moves.
    """
    tip = robot.frame(frame)
    numbers = [i for i, t in enumerate(trajectories) if len(t) >= 10]
    if not numbers:
        raise NotIdentifiableError("no trajectory has ten samples: there is no path to look at", code="too-short")
    chosen = [trajectories[i] for i in numbers]
    paths = TipPaths.of(robot, tip, [thinned(_postures(robot, t), _SAMPLES) for t in chosen])
    if max(np.ptp(paths.p, axis=0).max(), np.abs(paths.turns).max()) < 1e-3:
        raise NotIdentifiableError("the hand does not move in these trajectories", code="no-motion")
    moved = list(with_velocities(Demonstrations(chosen, ()), robot))
    read, members = _kind(robot, tip, moved, paths, rng, held, strength)
    if isinstance(read, str):
        return MechanismFit(None, None, None, {}, read)
    start, rival = _straight_or_bent(fit_place(paths.chosen(members), *read))
    groups = groups_of(start.paths, start.kind, start.place)
    shared = [len(group.members) for group in groups if len(group.members) > 1]
    # beside one place that most share, single trajectories are no places of their own: their ends may have left it
    if len(groups) > 1 and not (len(shared) == 1 and 2 * shared[0] > len(members)):
        places = tuple(tuple(numbers[members[i]] for i in group.members) for group in groups)
        distance = how_far_apart(groups)
        why = f"a {start.kind.type} holds the hand in each recording, but not the same: they are {distance} apart"
        return MechanismFit(None, None, None, {}, why, (why,), places=places)
    gain, left = misfit(start)
    if gain > LEAST_GAIN_NATS:
        # of another kind that holds as many directions
        kind, other = start.kind, start
        for k in MECHANISM_KINDS:
            if k.orientation == kind.orientation == "free" and k.n_rows == kind.n_rows and k is not kind:
                other = min(other, *_other_forms(start, k.name), key=_rest)
        if other is not start and likelier(other, start) > LEAST_GAIN_NATS:
            start, rival, (gain, left) = other, "", misfit(other)
    place = sum(QUANTITIES[name].rank for name in start.kind.holds if QUANTITIES[name].unit == "m")
    variance, bent = left * _rest(start) / max(place, 1), ""
    last = [chosen[k] for k in members]
    if gain > LEAST_GAIN_NATS:
        curve = find_curve(robot, tip.name, last, variance)
        if curve is not None:
            return curve
        if variance > LEAST_SAID_M**2:
            bent = (
                f"the hand leaves the {start.kind.type} that fits best by {1e3 * np.sqrt(variance):.2g} mm in the same "
                "way in all recordings: what holds it has another shape, and is near to this one only there"
            )
    odd = tuple(i for i in range(len(trajectories)) if i not in {numbers[k] for k in members})
    postures = [thinned(_postures(robot, t), max(_LEAST, _MOST // len(last))) for t in last]
    found = dataclasses.replace(_placed(robot, tip, postures, start, rng, arm), odd=odd, variance=variance)
    if found.reason:
        return found
    lone = "one trajectory only: a repeated motion cannot be told from a contact" if len(last) == 1 else ""
    warnings = (*filter(None, (lone, bent, rival)), *found.warnings)
    return dataclasses.replace(found, warnings=warnings, rival=rival, fit=start)


def _kind(
    robot: Robot,
    tip: Frame,
    moved: Sequence[Trajectory],
    paths: TipPaths,
    rng: np.random.Generator,
    held: Held | None,
    strength: float,
) -> tuple[Read | str, tuple[int, ...]]:
    """The mechanism whose rows are held, or those that explain most, and which trajectories they explain; or why it is
    none, in words.
    """
    if held is not None:
        immovable = views_of([held[0]], moved, scan_only=True)[0].immovable
        known = read_kind(*held, immovable, paths.p)
        if known is not None and not any(unit.startswith("rad") for unit in held[0].row_units):
            bent, _ = _straight_or_bent(fit_place(paths, *known))
            known = known if bent.kind is known[0] else (bent.kind, bent.place)
            known = _gripped(known, robot, tip, moved, paths, rng, strength)
        if known is not None:
            return known, tuple(range(len(moved)))
    middle = paths.p.mean(axis=0)
    maps = [FrameJacobian(robot, tip.name, "pose"), *(PlaceRows(robot, tip.name, form, middle) for form in FORMS)]
    views, seed, repeated = views_of(maps, moved, scan_only=True), int(rng.integers(2**32)), list[str]()

    def believed(view: View, h: Hypothesis, shown: Bool[np.ndarray, " n"]) -> bool:
        read = read_kind(view.features, view.motion.selection(h.rows), view.immovable, paths.p)
        if read is None or len(moved) == 1:
            return read is not None
        choices = kinds_tried(views) * ways_to_choose(view.thin, stretches_of(view.thin, shown.astype(int), 1))
        pieces, draws = [moved[i] for i in np.unique(view.thin.trajectory[shown])], np.random.default_rng(seed)
        if recombination_test(view.features, pieces, draws, choices, strength).n_rows >= h.n_rows:
            return True
        repeated.append(read[0].name)
        return False

    found = explain(views, believed, np.inf)
    read, members = None, tuple[int, ...]()
    if found.hypotheses:
        k = int(np.argmax(found.supports))
        h, view = found.hypotheses[k], found.views[found.hypotheses[k].view]
        read = read_kind(view.features, view.motion.selection(h.rows), view.immovable, paths.p)
        members = tuple(np.unique(found.thin.trajectory[found.states == k + 1]).tolist())
    if read is None and repeated:
        return (
            f"the path looks like a {repeated[0]}, but exchanging the joints between the trajectories hardly "
            "changes that: nothing shows a contact that all of them share. Learn from them one by one, or "
            "record from other postures and with other grips"
        ), ()
    if read is None:
        return "no line, plane, hinge, ball, screw, cylinder or orientation holds the hand", ()
    if held is not None and 2 * len(members) <= len(moved):
        # where rows are known to be held in all of them, what holds in so few is not what holds them
        return f"a {read[0].name} holds the hand in {len(members)} of {len(moved)} recordings only", ()
    return read, members


def _placed(
    robot: Robot,
    tip: Frame,
    postures: Sequence[Float[np.ndarray, "_ nv"]],
    start: PlaceFit,
    rng: np.random.Generator,
    arm: ArmErrors,
) -> MechanismFit:
    """The mechanism at its place, fitted to these postures, with the errors of that; or why it is known too badly."""
    fit = fit_place(TipPaths.of(robot, tip, postures), start.kind, start.place)
    # with as many quantities as the data allow the same for all trajectories: better determined
    names = tuple(n for n in fit.kind.holds if n in ("radius", "height", "distance", "across-line"))
    for shared in (names, *((n,) for n in names if len(names) > 1)) if names else ():
        tied, is_lost = fit_place(fit.paths, fit.kind, fit.place, shared, fit.weights), False
        for name in fit.kind.holds:
            after, before = (np.hypot(f.held_out[name], LEAST_RESIDUAL[QUANTITIES[name].unit]) for f in (tied, fit))
            is_lost |= bool(np.any(after > SHARED_LOSS * before))
        if not is_lost:
            fit = tied
            break
    errors = fit.errors(rng)
    mechanism = _described(fit, errors)
    units = {n: QUANTITIES[n].unit for n in fit.kind.holds}
    held_out = {u: max(float(fit.held_out[n].max()) for n in units if units[n] == u) for u in set(units.values())}
    features, selection = _constraint(robot, tip.name, fit, mechanism.radius, postures)
    poor, wide = doubts_of_place(mechanism)
    if poor:
        return MechanismFit(None, None, None, held_out, poor, (poor,))
    if arm.zeros:
        # at the nearest postures on the mechanism: at those that were recorded, errors of the arm that no motion shows
        # would look like the residual (links that are all longer by a share make all distances longer by it)
        q, on, edges = np.concatenate(postures), fit, np.cumsum([len(one) for one in postures])[:-1]
        for _ in range(ONTO):
            q = q - np.einsum("ndv,nd->nv", on.weights.noise, on.residuals)
            on = PlaceFit.at(TipPaths.of(robot, tip, np.split(q, edges)), fit.kind, fit.place, fit.shared)
        errors = fit.errors(rng, arm, on, link_twists(robot, tip, q) if arm.ratio else None)
        mechanism = _described(fit, errors)
    warnings = (wide,) if wide else ()
    return MechanismFit(mechanism, features, selection, held_out, "", warnings, errors=errors)


def find_curve(
    robot: Robot, frame: str, trajectories: Sequence[Trajectory], variance: float, share: float = 1.0
) -> MechanismFit | None:
    """The curve that a hand keeps to, where it is much nearer to that than to mechanisms that leave that variance in
    each direction that they hold [m^2], in that share of the time; else nothing holds.
    """
    paths = TipPaths.of(robot, robot.frame(frame), [thinned(_postures(robot, t), _SAMPLES) for t in trajectories])
    found = fit_curve(paths)
    if found is None:
        return None
    free = float(np.linalg.eigvalsh(np.cov(paths.p.T))[:2].mean())  # beside a straight line
    gains = [gain_in_nats(v, found[1], paths) for v in (variance, free)]
    if share * gains[0] + (1.0 - share) * gains[1] < LEAST_GAIN_NATS:
        return None
    curve, off = found
    features = CurveRows(robot, frame, curve, ("across-1", "across-2"))
    size = float(np.sqrt(variance_across(off)))
    mechanism = Mechanism("other", name=CURVE, uncertainty={"point": size})
    return MechanismFit(mechanism, features, np.eye(2), {"m": size}, variance=variance)


def _postures(robot: Robot, trajectory: Trajectory) -> Float[np.ndarray, "T nv"]:
    q = trajectory.q
    return np.stack([robot.positions(x) for x in q]) if q.shape[1] != robot.nv else q


def _gripped(
    read: Read,
    robot: Robot,
    tip: Frame,
    moved: Sequence[Trajectory],
    paths: TipPaths,
    rng: np.random.Generator,
    least: float,
) -> Read:
    """A mechanism that holds the hand's place, with all that exchanging joints shows it to hold of its orientation."""
    name = read[0].name
    firmer = [k for k in MECHANISM_KINDS if k.name.startswith(f"{name}, ") or k.orientation == "carried"]
    postures, seed = [_postures(robot, t) for t in moved], int(rng.integers(2**32))
    about = np.linalg.svd(paths.turns, full_matrices=False)[2][0]  # what turns the hand with it turns it about its axis
    for kind in sorted(firmer, key=lambda k: (-k.n_rows, not k.name.startswith(name))):
        fit = fit_place(paths, kind, Place(about, read[1].point) if kind.orientation == "carried" else read[1])
        radius = None if fit.radius is None else max(fit.radius.value, LEAST_BEND_M)
        features, selection = _constraint(robot, tip.name, fit, radius, postures)
        evidence = recombination_test(features, moved, np.random.default_rng(seed), len(firmer), least)
        if evidence.n_rows >= len(selection) > 0:
            return kind, fit.place
    return read


def _straight_or_bent(read: PlaceFit) -> tuple[PlaceFit, str]:
    """The form of a mechanism that the positions show, and its rival in words; empty if they exclude it.

    Velocities show neither the curvature of a short arc nor that a long one is none as well as positions do. The bent
    form is the answer if its radius or pitch is known to a fifth and the path leaves the straight form measurably.
    """
    straight_forms = {bent: straight for straight, bent in BENT_FORMS.items()}
    name = read.kind.name
    if name in straight_forms and not bends(read, straight := _other_form(read, straight_forms[name])):
        return straight, rival_of(read, straight)
    if name in BENT_FORMS:
        bent = _other_form(read, BENT_FORMS[name])
        leaves = bends(bent, read) and bends(bent, _other_form(read, name))  # wherever the straight form is
        return (bent, "") if leaves else (read, rival_of(bent, read))
    return read, ""


def _other_form(read: PlaceFit, name: str) -> PlaceFit:
    """The best fit of another kind."""
    return min(_other_forms(read, name), key=lambda fit: fit.cost)


def _other_forms(read: PlaceFit, name: str) -> list[PlaceFit]:
    """Fitted from the same axis, or from the direction, the normal and the circle of the path."""
    kind, paths, place = KIND_BY_NAME[name], read.paths, read.place
    x = paths.centred(paths.p)
    spread, middle = np.linalg.eigh(x.T @ x)[1].T, paths.p.mean(axis=0)
    starts = [Place(place.axis, place.point)]
    if kind.type == "line":
        starts = [Place(spread[2], middle)]
    elif kind.type == "plane":
        starts = [Place(spread[0], middle)]
    elif kind.type == "ball":
        starts = [Place(place.axis, _centre(paths, np.eye(3)))]
    elif kind.name == "cylinder":
        axes = [spread[1], spread[2], spread[1] + spread[2], spread[1] - spread[2]]
        starts = [Place(a / np.linalg.norm(a), _centre(paths, null_basis(a[None]).T)) for a in axes]
    elif kind.type == "hinge" and place.pitch == 0.0 and kind.orientation != "carried":
        starts = [Place(spread[0], _centre(paths, spread[1:]))]  # a circle seen along the normal of the path
    return [fit_place(paths, kind, start) for start in starts]


def _centre(paths: TipPaths, base: Float[np.ndarray, "k 3"]) -> Float[np.ndarray, " 3"]:
    """|y|^2 - 2 c.y is constant along a circle or on a sphere about c (I. Kasa, 1976), y in an orthonormal base."""
    middle = paths.p.mean(axis=0)
    y = (paths.p - middle) @ base.T
    square = paths.centred(np.sum(y * y, axis=1, keepdims=True))[:, 0]
    return middle + 0.5 * np.linalg.lstsq(paths.centred(y), square, rcond=1e-9)[0] @ base


def bends(bent: PlaceFit, straight: PlaceFit) -> bool:
    """Whether the data show what the straight form lacks: measurable, and more than rails wobble."""
    if bent.size is None or ("pitch" not in bent.kind.unknowns and bent.size[0] > FARTHEST_M):
        return False
    size, sigma = bent.size
    return size > BEYOND_CHANCE * sigma and _rest(straight) - _rest(bent) > LEAST_BEND_M**2


def _rest(fit: PlaceFit) -> float:
    """Mean square of what the form leaves of the positions [m^2]."""
    return sum(float(np.sum(fit.held_out[n] ** 2)) for n in fit.kind.holds if QUANTITIES[n].unit == "m")


def rival_of(bent: PlaceFit, straight: PlaceFit) -> str:
    """A bent form near enough to matter, if the motion cannot exclude it."""
    if bent.size is None or "pitch" in bent.kind.unknowns:
        return ""
    radius, sigma = bent.size
    curvature = 1.0 / radius + STANDARD_ERRORS * sigma / radius**2
    if not np.isfinite(curvature) or curvature < 1.0 / FARTHEST_M:
        return ""
    return (
        f"a {bent.kind.name} would fit as well, with more than {1.0 / curvature:.2g} m of radius: the motion is "
        f"too short to tell it from a {straight.kind.name}; move it farther"
    )


def _described(fit: PlaceFit, errors: PlaceErrors) -> Mechanism:
    """The mechanism of a fit, with the uncertainty of each parameter."""
    kind, place, known, uncertainty = fit.kind, fit.place.as_told(), set(fit.kind.unknowns), fit.stated(errors)
    # how far the hand goes about the axis or the centre [rad]
    arc, paths = None, fit.paths
    carried = kind.orientation == "carried" and "axis" in known
    if carried or "point-across" in known:
        angle = turn_about(paths, place.axis) if carried else angles_about(paths, place)
        arc = float(max(np.ptp(angle[part]) for part in paths.parts))
    elif "point" in known:
        d = paths.p - place.point
        d /= np.linalg.norm(d, axis=1, keepdims=True)
        mean = d.mean(axis=0) / np.linalg.norm(d.mean(axis=0))
        arc = float(2.0 * np.arccos(np.clip(d @ mean, -1.0, 1.0)).max())
    if "axis" in known:
        uncertainty["axis"] = float(np.degrees(uncertainty["axis"]))
    return Mechanism(
        kind.type,
        place.axis if "axis" in known else None,
        None if kind.type == "held-orientation" else place.point,
        None if fit.radius is None else fit.radius.value,
        place.pitch if "pitch" in known else None,
        "loose" if kind.orientation == "free" else "firm",
        kind.orientation,
        uncertainty,
        arc,
        kind.name,
    )


def doubts_of_place(mechanism: Mechanism) -> tuple[str, str]:
    """A sentence if the parameters are too uncertain to be used, and one if the motion determines the place badly; each
    says how much more motion is needed. Empty where there is no doubt.
    """
    u, radius, arc = mechanism.uncertainty, mechanism.radius, mechanism.arc
    if radius is None or arc is None:
        return "", ""
    # the curvature of an arc, and with it the radius, is known to its residual over the square of the arc
    far, axis, place = np.degrees(arc), u.get("axis", 0.0), u.get("point", 0.0)
    by_axis, by_place = axis / POOR_AXIS_DEG, place / (POOR_RADIUS * max(radius, 0.02))
    worst = max(by_axis, by_place)
    if worst > 1.0:
        what = (
            f"the axis is known to {axis:.1f} degrees"
            if by_axis == worst
            else f"its place is known to {1e3 * place:.0f} mm"
        )
        how = _farther(far, far * np.sqrt(4.0 * worst))
        return f"{how}: it looks like {mechanism.sentence}, but {what} only", ""
    if place <= WIDE_RADIUS * radius or mechanism.grip == "firm":
        return "", ""
    needed = far * np.sqrt(place / (WIDE_RADIUS / 3.0 * radius))
    return "", (
        f"{_farther(far, needed)}: the place of the axis or the centre, about which the hand goes, is known to "
        f"+- {1e3 * place:.0f} mm"
    )


def _farther(far: float, needed: float) -> str:
    """What would make a place better known: a longer arc, or, where it is long already, more of them [deg]."""
    if far < min(needed, 90.0):
        return f"move it by at least {min(needed, 90.0):.0f} degrees, not {far:.0f}"
    return "record it more often, with a hand that is steadier"


def _constraint(
    robot: Robot, frame: str, fit: PlaceFit, radius: float | None, postures: Sequence[Float[np.ndarray, "_ nv"]]
) -> tuple[FeatureMap, Float[np.ndarray, "s p"]]:
    """Phi and Lambda, without the rows that the arm cannot move; a turn counts about the axis that is told."""
    features, selection = rows_of(fit.kind, fit.place.as_told(), radius, robot, frame)
    A = np.einsum("sp,npj->nsj", selection, features.batch(np.concatenate([thinned(q, 10) for q in postures])))
    movable = np.sqrt(np.mean(np.sum(A * A, axis=2), axis=0)) > BLIND
    return features, selection[movable]
