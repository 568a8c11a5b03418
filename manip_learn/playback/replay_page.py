"""Rollouts or recordings -> one page that plays them, with the evidence for what was learnt from them; live pages."""

from __future__ import annotations

import os
import re
import tempfile
import webbrowser
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, final

import numpy as np
from numpy.typing import ArrayLike

from manip_learn.atomic_write import write_atomically
from manip_learn.constraint.constraint import Constraint
from manip_learn.constraint.mechanism import Mechanism
from manip_learn.constraint.shown import Shown
from manip_learn.control.command import Status
from manip_learn.control.rollout import Rollout
from manip_learn.errors import OutputError, RecordingError
from manip_learn.linalg import finite
from manip_learn.playback.appearance import appearance
from manip_learn.playback.page_writer import LIVE, PageKind, in_cell, page
from manip_learn.playback.palette import WAY, Phase, phase_bands, phase_kinds, phases_from_json, rollout_colours
from manip_learn.playback.recorded_motion import GuidedMotion, RecordedMotion, guided_motion, recorded_motion
from manip_learn.playback.scene_data import MechanismDrawing, mechanism_drawing, scene_data
from manip_learn.recordings.trajectory import Trajectory
from manip_learn.robot.description.catalogue import known_as
from manip_learn.robot.joints import Frame
from manip_learn.robot.robot import Robot
from manip_learn.robot.tips import default_tip

if TYPE_CHECKING:
    from manip_learn.learning.report import LearningReport

Recording = Rollout | Trajectory
MAX_GHOSTS = 12  # as in page/scene.js
_CURVES = ("time", "q", "u", "manipulability", "task_error", "following_error")  # of a rollout, a value each sample


def evidence_of(report: LearningReport | Mapping[str, Any]) -> dict[str, Any]:
    """Return headline, the facts of `LearningReport.facts`, the evidence of each row, warnings and odd recordings.

    What the report lacks is left out: constraint files of earlier versions hold less.

    Args:
        report: `learner.report_`, or the dictionary of it that a constraint file keeps as its provenance.
    """
    content = report if isinstance(report, Mapping) else report.to_dict()
    odd, facts = _list(content.get("odd_trajectories")), content.get("facts")
    pairs = [(e.get("trajectory"), e.get("reason")) if isinstance(e, Mapping) else e for e in odd]
    rows = []  # verdict, strength and chance of each, most firmly held first
    for k, entry in enumerate(_list(content.get("row_evidence"))):
        if isinstance(entry, Mapping):
            state, strength = str(entry.get("state"))[:40], finite(entry.get("strength"))
            state = "not tried: nothing moved along it" if state == "untried" else state
            grown = "{:,.3g} times" if strength is None or strength < 1e6 else "over a million times"
            chance = _in_words("p = {:.2g}", entry.get("p_value"))
            rows.append([f"row {k + 1}", state, _in_words(grown, strength), chance])
    imposed = "the demonstrator moves the constrained directions (b is not 0)"
    return {
        "headline": _text(content.get("sentence")),
        "kind": imposed if content.get("kind") == "self-imposed" else "",
        "facts": [[_text(x) for x in fact] for fact in facts.items()] if isinstance(facts, Mapping) else [],
        "words": _text(content.get("evidence")),
        "rows": rows,
        "warnings": _texts(content.get("warnings")),
        "odd": [_texts(pair) for pair in pairs if isinstance(pair, list | tuple) and len(pair) == 2],
        "notes": _texts(content.get("notes")),
    }


def _list(value: object) -> list[Any]:
    return list(value)[:60] if isinstance(value, list | tuple) else []  # rows of a table in a card


def _texts(value: object) -> list[str]:
    return [_text(text) for text in _list(value)]


def _text(value: object) -> str:
    return "" if value is None else str(value)[:2000]  # characters that a card has room for


def _in_words(form: str, value: object, scale: float = 1.0) -> str:
    """Return a number in words; empty for what is not a finite number."""
    number = finite(value)
    return "" if number is None else form.format(scale * float(number))


@final
@dataclass(frozen=True)
class ReplayResult:
    """What `replay` wrote.

    Attributes:
        html: The page.
        bytes: Its size.
        notes: What could not be shown as it is, in sentences; they also stand in the page.
    """

    html: Path
    bytes: int
    notes: tuple[str, ...]

    def to_dict(self) -> dict[str, Any]:
        """The JSON answer of `manip-learn replay`."""
        return vars(self) | {"html": str(self.html), "notes": list(self.notes)}

    def _repr_html_(self) -> str:
        """Return the page in a frame; as text, because notebooks do not serve every file."""
        return in_cell(self.html.read_text(encoding="utf-8"))


def replay(
    robot: Robot,
    rollouts: Mapping[str, Recording] | Recording,
    html: str | os.PathLike[str] | None = None,
    *,
    tip: str | None = None,
    title: str = "",
    colours: Mapping[str, str] | None = None,
    open_browser: bool | None = None,
    phases: Sequence[Phase] = (),
    mechanism: Mechanism | Mapping[str, Any] | None = None,
    notes: Sequence[str] = (),
    constraint: Constraint | Sequence[Constraint] | None = None,
    report: LearningReport | Mapping[str, Any] | None = None,
    target: ArrayLike | None = None,
    side_by_side: bool = False,
    align: Literal["start", "grasp"] = "start",
) -> ReplayResult:
    """Write one HTML file that plays rollouts of a robot, without a server and without a network.

    The first rollout is drawn solid, the others as ghosts; all start at time zero, and the shorter ones hold their last
    posture. The page has the manipulability curves with a cursor, the controller's status, and the path of the tip.
    With phases, colours are those of the constraints, and only the first recording is drawn as a robot, the others as
    the path of the tip. Phases that a rollout itself has, as that of a plan, are bands below the curves instead, and
    its path is thin and dashed until its way begins.

    Args:
        robot: The robot that the rollouts were made with.
        rollouts: Name -> rollout or demonstration (which has no manipulability curve); or a single one.
        html: File to write; None for a temporary file.
        tip: Frame whose path is drawn; None for the frame that the rollouts were made with, else `default_tip`.
        title: Shown next to the name of the robot.
        colours: Rollout name -> a name in `palette.COLOURS`, for those whose colour matters.
        open_browser: Show the page now; None: only if it is a temporary file.
        phases: (recording, start [s], end [s], constraint or None for free motion), as in `report_.phases`, on the
            recordings' own clocks: drawn as bands in time and along the path of the tip.
        mechanism: `report_.mechanism`, that of the first constraint, or its dictionary; drawn in the scene.
        notes: Sentences that the page shows beside its own.
        constraint: What is shown at the tip and measured over time; with phases, `constraints_`: one for each of their
            numbers. Rollouts that `simulate` made keep their own; one that is given here is shown for all.
        report: `report_` of the learner, or what a constraint keeps of it (`constraint.provenance`): the evidence in
            words; phases and mechanism are taken from it where they are not given.
        target: Where the task was to arrive, as `PointAttractor` takes it; rollouts that `simulate` made keep theirs.
        side_by_side: Draw each rollout in a pane of its own, in the robot's own colours, seen by one camera, with what
            became of it below; for two to four rollouts.
        align: Where the common clock is zero: at the `"start"` of each rollout, or where the hand takes hold, its
            `"grasp"`; a rollout that grasps earlier then waits at its start.

    Raises:
        ConstraintMismatchError: A constraint of another robot.
        TargetError: A target that is not finite numbers.
        RecordingError: Nothing to replay, a rollout with NaN, with joints of another robot or with bad times, phases of
            none of the recordings or with bad times, or a mechanism with numbers that are not finite.
        ConfigurationError: A posture of the wrong size.
        UnknownNameError: No such tip frame or colour.
        OutputError: The file cannot be written.

    Example:
        >>> import manip_learn as ml
        >>> robot = ml.load_robot("planar3")
        >>> constraint = ml.Constraint([[0, 1]], ml.FrameJacobian(robot, "tip", axes="x y"))
        >>> controller = ml.ResolvedRateController(constraint, ml.PointAttractor([1.0, 1.5]))
        >>> rollout = ml.simulate(robot, controller, [0.3, 0.8, 0.4])
        >>> ml.replay(robot, {"to the line": rollout}, "replay.html").html.name  # open it in a browser
        'replay.html'
    """
    named, zero = _on_one_clock(named_recordings(rollouts), align)
    if side_by_side and not 2 <= len(named) <= 4:
        raise RecordingError(f"side_by_side needs two to four rollouts, got {len(named)}", code="side-by-side")
    guided = [guided_motion(robot, name, recording, constraint, target) for name, recording in named.items()]
    kept = [m.constraint.provenance for m in guided if m.constraint is not None]
    learnt = next(filter(None, kept), {}) if report is None else report
    learnt = learnt if isinstance(learnt, Mapping) else learnt.to_dict()
    if not phases:
        own = phases_from_json(learnt.get("phases") or ())
        phases = tuple(p for p in own if isinstance(named.get(p[0]), Trajectory))
    first = learnt.get("mechanism") if mechanism is None else mechanism
    first = first.to_dict() if isinstance(first, Mechanism) else first
    if not isinstance(first, Mapping | None):  # as in a damaged file
        sentence = f"the mechanism must be a dictionary, got {first!r:.60}: learn it again"
        raise RecordingError(sentence, code="mechanism")
    frame, bands, looks = _shown_tip(robot, tip, guided), phase_bands(phases, list(named)), appearance(robot)
    painted = zip(guided, rollout_colours(list(named), colours or {}, neutral=bool(phases)), strict=True)
    motions = [recorded_motion(robot, frame, m, colour, bands[m.name], first) for m, (_, colour) in painted]
    drawings, evidence = _drawings(first, motions), evidence_of(learnt)
    all_notes = tuple(dict.fromkeys((*notes, *_notes(evidence, 0 if phases else len(motions)), *looks.notes)))
    # each constraint is named by its mechanism, else by how many directions it holds
    rows = [f"holds {c.n_constraints} of {len(c.features.row_names)}" for c in guided[0].constraints]
    words = zip(drawings, rows or [""] * len(drawings), strict=False)
    kinds = phase_kinds(phases, [(drawn and drawn.type) or row for drawn, row in words]) if phases else ()
    data = scene_data(robot, looks, frame.name, motions, all_notes, kinds, drawings) | {
        "evidence": evidence if learnt else None,
        "zero": zero,
        "made": next((made for provenance in kept if (made := provenance.get("made"))), None),
        "done": [row for motion in motions for row in _done(motion, len(named) > 1)],
        "panes": [_outcome(m) for m in guided] if side_by_side else [],
        "odd": {name: why for name, why in evidence["odd"] if name in named},
    }
    content = page(data, robot=known_as(robot.source) or robot.name or "robot", subtitle=title).encode("utf-8")
    path = write_atomically(_temporary_file(robot) if html is None else html, content)
    if open_browser or (open_browser is None and html is None):
        webbrowser.open(path.as_uri())
    return ReplayResult(path, len(content), all_notes)


def live_page(
    robot: Robot,
    name: str,
    token: str,
    kind: PageKind = LIVE,
    constraint: Constraint | None = None,
    target: ArrayLike | None = None,
) -> str:
    """Return the HTML of a page that follows a robot.

    Args:
        robot: The robot.
        name: Headline.
        token: Of the address under which it is served.
        kind: What the page is made of.
        constraint: What is drawn of a task; None for nothing.
        target: Where the task is to arrive, as `Task.goal` gives it.

    Raises:
        OutputError: Meshcat's viewer is missing.
        ConstraintMismatchError: A constraint of another robot.
        TargetError: A target that is not finite numbers.
    """
    rng, rest = np.random.default_rng(0), Trajectory(np.zeros(1), robot.neutral()[None])
    postures = np.array([*rest.q, *(robot.random_configuration(rng) for _ in range(119))])  # for the camera
    motion, twist = guided_motion(robot, name, rest, constraint, target), constraint and constraint.features.twist
    tip = robot.frame(default_tip(robot)) if twist is None else twist.frame
    ((_, colour),) = rollout_colours([name], {})
    still = recorded_motion(robot, tip, motion, colour)._replace(postures=postures, measures=())
    drawings = []
    if constraint is not None and (constraint.mechanism is not None or constraint.shown is not None):
        path = still.path if constraint.shown is None else constraint.shown.points
        drawings.append(mechanism_drawing(constraint.mechanism, path, constraint.shown))
    looks = appearance(robot)
    data = scene_data(robot, looks, tip.name, [still], looks.notes, mechanisms=drawings)
    data["events"], data["floor"] = f"/{token}/events", 0.0  # random postures reach below the base, arms do not
    return page(data, robot=name, subtitle="", kind=kind)


def _notes(evidence: Mapping[str, Any], n_arms: int) -> list[str]:
    """Return what is not drawn, warnings, the recordings that disagree as far as no warning names them, and notes."""
    ghosts = f"Of {n_arms} rollouts the first {MAX_GHOSTS} are drawn as robots, the others as tip path and curve; "
    hidden = [f"{ghosts}click a name to draw that one."] if n_arms > MAX_GHOSTS else []
    warned = " ".join(evidence["warnings"])
    odd = [f"{name} does not agree with the others: {why}" for name, why in evidence["odd"] if name not in warned]
    return [*hidden, *evidence["warnings"], *odd, *evidence["notes"]]


def _temporary_file(robot: Robot) -> Path:
    try:
        folder = tempfile.mkdtemp(prefix="manip_learn_")
    except OSError as error:
        raise OutputError(f"no temporary folder for the replay: {error}; name a file with html=...") from error
    safe = re.sub(r"[^A-Za-z0-9_-]+", "_", robot.name)[:40] or "robot"
    return Path(folder) / f"{safe}_replay.html"


def _on_one_clock(named: dict[str, Recording], align: str) -> tuple[dict[str, Recording], float]:
    """Return the recordings, each waiting at its start where its hand takes hold earlier than others, and when all do.

    Raises:
        RecordingError: Another `align`.
    """
    if align not in ("start", "grasp"):
        raise RecordingError(f"align is {align!r}; 'start' or 'grasp' is needed", code="align")
    rollouts = {name: r for name, r in named.items() if align == "grasp" and isinstance(r, Rollout) and len(r)}
    grasps = dict[str, float]()  # [s] from the start
    for name, r in rollouts.items():
        grasps[name] = next((w["begins"] for w in r.ways if w["begins"] is not None), r.time[0]) - float(r.time[0])
    latest, out = max(grasps.values(), default=0.0), dict(named)
    for name, r in rollouts.items():
        if (wait := latest - grasps[name]) > 0.0:  # its first sample, that much earlier
            curves = {field: getattr(r, field) for field in _CURVES if getattr(r, field) is not None}
            longer: dict[str, Any] = {field: np.concatenate([x[:1], x]) for field, x in curves.items()}
            longer["time"][0] -= wait
            out[name] = replace(r, status=(Status.OK, *r.status) if r.status else (), **longer)
    return out, latest


def _outcome(motion: GuidedMotion) -> dict[str, str]:
    """Return the caption of a pane: name, how far each way went, and what stopped it."""
    ways = [_way_in_words(way) for way in getattr(motion.recording, "ways", ())]
    return {"name": motion.name, "said": "; ".join(far for far, _ in ways), "why": "; ".join(why for _, why in ways)}


def _way_in_words(way: Mapping[str, Any]) -> tuple[str, str]:
    done, wanted, stopped = finite(way.get("done")), finite(way.get("wanted")), _text(way.get("stopped_by"))
    unit = "m" if way.get("unit") == "m" else "degrees"
    far = "" if done is None or wanted is None else f"{abs(done):.3g} of {abs(wanted):.3g} {unit}"
    return far, f", stopped by {stopped}" if stopped else ""


def _done(shown: RecordedMotion, several: bool) -> list[list[str]]:
    """Return a row for each way of a rollout: its name, where the hand took hold, and its numbers, in words."""
    rows, motion = [], shown.motion
    for way in getattr(motion.recording, "ways", ()):
        whose = ": ".join(filter(None, (motion.name if several else "", _text(way.get("name"))))) or motion.name
        begins, place = way["begins"], "not reached"
        if begins is not None:
            at = [np.interp(begins - motion.recording.time[0], shown.path_times, axis) for axis in shown.path.T]
            place = ", ".join(f"{x:.3f}" for x in at) + " m"
        joint = way.get("fastest_joint")
        joint = joint if isinstance(joint, Mapping) else {}
        fastest = _in_words("{:.0f} % of its limit", joint.get("share_of_limit"), 100.0)
        fastest = fastest and f"{fastest} ({_text(joint.get('name'))})"
        off, margin = _in_words("{:.1f} mm", way.get("deviation"), 1e3), _in_words("{:.0f} %", way.get("margin"), 1e2)
        rows.append([whose, place, "".join(_way_in_words(way)), off, fastest, margin])
    return rows


def _drawings(
    first: Mapping[str, Any] | None, motions: Sequence[RecordedMotion]
) -> tuple[MechanismDrawing | None, ...]:
    """Return what is drawn of each constraint's mechanism; without phases of constraints, the first one's alone."""
    guide, drawn = motions[0].motion, list[MechanismDrawing | None]()
    phases = [(m, band) for m in motions for band in m.motion.phases if band.constraint is not None]
    for k in range(max(len(guide.constraints), 1) if phases else 1):
        described = first if k == 0 else guide.mechanism(k)
        known = guide.constraints[k] if k < len(guide.constraints) else None
        shown = None if known is None else known.shown or known.intention
        if described is None and shown is None:
            drawn.append(None)
            continue
        # the tip where constraint k holds; everywhere if that is nowhere
        held = [m.path[b.covers(m.path_times)] for m, b in phases if b.constraint == k and b.part in ("", WAY)]
        places = np.concatenate(held if any(map(len, held)) else [m.path for m in motions])
        if described is not None and described.get("type") == "line":
            # a line is drawn where hands took hold, or where that of a rollout does: its direction alone was learnt
            holding = [(m, m.content["handles"][0][0][0]) for m in motions if m.content["handles"]]
            if isinstance(shown, Shown) and shown.hold is not None:
                described, places = {**described, "point": shown.hold}, np.vstack([shown.points, places])
            elif k == 0 and holding:
                m, begin = holding[0]
                described = {**described, "point": m.path[np.searchsorted(m.path_times, begin)]}
        drawn.append(mechanism_drawing(described, places, shown))
    return tuple(drawn)


def _shown_tip(robot: Robot, tip: str | None, motions: Sequence[GuidedMotion]) -> Frame:
    """Return the frame whose path is drawn: the given one, that of a rollout or of a constraint, or the default."""
    frames = [m.recording.frame for m in motions if isinstance(m.recording, Rollout)]
    features = (m.constraint.features for m in motions if m.constraint is not None)
    frames += [frame.name for f in features if isinstance(frame := getattr(f, "frame", None), Frame)]
    known = (name for name in frames if name in robot.frame_names)
    return robot.frame(next(known, None) or default_tip(robot) if tip is None else tip)


def named_recordings(rollouts: Mapping[str, Recording] | Recording) -> dict[str, Recording]:
    """Return the rollouts or recordings by their names, given one or many.

    Raises:
        RecordingError: None at all, or something else.
    """
    if not isinstance(rollouts, Mapping):
        rollouts = {getattr(rollouts, "name", "rollout"): rollouts}
    if not rollouts:
        raise RecordingError("there is nothing to replay: give at least one rollout", code="empty")
    for name, rollout in rollouts.items():
        if not isinstance(name, str) or not isinstance(rollout, Rollout | Trajectory):
            wanted = "must be a Rollout or a Trajectory; of several, give a dictionary from names to rollouts"
            raise RecordingError(f"rollout {name!r} {wanted}, got {rollout!r:.80}", code="type")
    return dict(rollouts)
