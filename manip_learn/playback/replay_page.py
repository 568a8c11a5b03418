"""Build HTML pages that play rollouts or recordings, with the evidence for the learnt constraint, and live pages."""

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
from manip_learn.playback.page_writer import LIVE, PageKind, notebook_output, render_page
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


def evidence_of(report: LearningReport | Mapping[str, Any]) -> dict[str, Any]:
    """Return the evidence for a constraint as texts: headline, facts, evidence of each row, warnings, odd recordings.

    Entries that the report lacks are left out, because constraint files of earlier versions contain fewer entries.

    Args:
        report: `learner.report_`, or its dictionary, which a constraint file stores as provenance.

    Returns:
        Dictionary of texts for the page.
    """
    content = report if isinstance(report, Mapping) else report.to_dict()
    odd, facts = _list(content.get("odd_trajectories")), content.get("facts")
    pairs = [(e.get("trajectory"), e.get("reason")) if isinstance(e, Mapping) else e for e in odd]
    rows = []  # verdict, strength and chance of each, the most strongly held first
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
    """Return at most as many entries as a table in a card has rows; empty if the value is not a list."""
    return list(value)[:60] if isinstance(value, list | tuple) else []


def _texts(value: object) -> list[str]:
    """Return the entries of a list as texts."""
    return [_text(text) for text in _list(value)]


def _text(value: object) -> str:
    """Return a value as text, empty for None."""
    return "" if value is None else str(value)[:2000]  # a card has room for 2000 characters


def _in_words(form: str, value: object, scale: float = 1.0) -> str:
    """Return a number as text; empty if the value is not a finite number."""
    number = finite(value)
    return "" if number is None else form.format(scale * float(number))


@final
@dataclass(frozen=True)
class ReplayResult:
    """Result of `replay`.

    Attributes:
        html: Path of the page.
        bytes: Size of the page in bytes.
        notes: Sentences about data that the page shows differently or not at all; they are also in the page.
    """

    html: Path
    bytes: int
    notes: tuple[str, ...]

    def to_dict(self) -> dict[str, Any]:
        """Return the attributes as a dictionary of JSON values, the output of `manip-learn replay`."""
        return vars(self) | {"html": str(self.html), "notes": list(self.notes)}

    def _repr_html_(self) -> str:
        """Return the page in a frame, as text, because notebooks do not serve every file."""
        return notebook_output(self.html.read_text(encoding="utf-8"))


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
    """Write one HTML file that plays rollouts or recordings of a robot, without a server and without a network.

    The first rollout is drawn solid, the others transparent. All start at time zero; shorter ones keep their last
    configuration at the end. The page has the manipulability curves with a cursor, the controller's status, and the
    path of the tip. With `phases`, colours show the constraints, and only the first recording is drawn as a robot, the
    others as tip paths. Phases that a rollout itself contains, e.g. from a plan, are bands below the curves; its tip
    path is thin and dashed until the motion along the constraint begins.

    Args:
        robot: The robot of the rollouts.
        rollouts: Rollout or demonstration; or a mapping from names to several. Demonstrations have no manipulability
            curve unless `constraint` is given.
        html: File to write; None for a temporary file.
        tip: Name of the frame whose path is drawn; None for the frame of the rollouts, or else the most likely tip
            (`likely_tips`).
        title: Text next to the name of the robot.
        colours: Mapping from names of rollouts to `"blue"`, `"vermilion"`, `"green"`, `"purple"`, `"amber"`, `"sky"`,
            `"brown"` or `"grey"`; other rollouts get the unused colours. None to choose all of them.
        open_browser: True to open the page; None to open it only if it is a temporary file.
        phases: Phases of the recordings, as in `report_.phases`: tuples (name of the recording, start [s], end [s],
            index of the constraint or None for free motion), with times on the recording's own time axis. They are
            drawn as bands over time and along the path of the tip.
        mechanism: Mechanism of the first constraint (`report_.mechanism`), or its dictionary; drawn in the scene. None
            to use the mechanism in `report`.
        notes: Further sentences for the page.
        constraint: Constraint whose directions are drawn at the tip and whose manipulability is plotted; with phases,
            all constraints (`constraints_`) by index. None to use the constraints that rollouts from `simulate`
            contain.
        report: `report_` of the learner, or its stored form (`constraint.provenance`), for the evidence in words.
            Phases and mechanism are taken from it if they are not passed. None to use the provenance of the
            constraints.
        target: Target of the task, in a form that `PointAttractor` accepts; None to use the targets that rollouts from
            `simulate` contain.
        side_by_side: True to draw each rollout in its own pane, in the robot's own colours, with one common camera and
            its outcome below; for two to four rollouts.
        align: Event of each rollout that is time zero: `"start"` or `"grasp"`. With `"grasp"`, a rollout with an
            earlier grasp waits at its start.

    Returns:
        Path, size and notes of the page.

    Raises:
        ConstraintMismatchError: The constraint belongs to another robot.
        TargetError: The target is not finite numbers.
        RecordingError: There is nothing to replay; a rollout has NaN, joints of another robot or bad times; phases have
            bad times or belong to none of the recordings; a mechanism has numbers that are not finite; `align` is
            another text; or `side_by_side` is set for another number of rollouts.
        ConfigurationError: A configuration has the wrong size.
        UnknownNameError: The tip frame or a colour does not exist, or `colours` has an unknown name of a rollout.
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
    recordings, zero = _align(recordings_by_name(rollouts), align)
    if side_by_side and not 2 <= len(recordings) <= 4:
        raise RecordingError(f"side_by_side needs two to four rollouts, got {len(recordings)}", code="side-by-side")
    guided = [guided_motion(robot, name, recording, constraint, target) for name, recording in recordings.items()]
    provenances = [m.constraint.provenance for m in guided if m.constraint is not None]
    content = next(filter(None, provenances), {}) if report is None else report
    content = content if isinstance(content, Mapping) else content.to_dict()
    if not phases:
        stored = phases_from_json(content.get("phases") or ())
        phases = tuple(p for p in stored if isinstance(recordings.get(p[0]), Trajectory))
    first = content.get("mechanism") if mechanism is None else mechanism
    first = first.to_dict() if isinstance(first, Mechanism) else first
    if not isinstance(first, Mapping | None):  # e.g. from a damaged file
        sentence = f"the mechanism must be a dictionary, got {first!r:.60}: learn it again"
        raise RecordingError(sentence, code="mechanism")
    frame, bands, looks = _tip_frame(robot, tip, guided), phase_bands(phases, list(recordings)), appearance(robot)
    pairs = zip(guided, rollout_colours(list(recordings), colours or {}, neutral=bool(phases)), strict=True)
    motions = [recorded_motion(robot, frame, m, colour, bands[m.name], first) for m, (_, colour) in pairs]
    drawings, evidence = _drawings(first, motions), evidence_of(content)
    all_notes = tuple(dict.fromkeys((*notes, *_notes(evidence, 0 if phases else len(motions)), *looks.notes)))
    # each constraint is named by its mechanism, else by its number of held directions
    rows = [f"holds {c.n_constraints} of {len(c.features.row_names)}" for c in guided[0].constraints]
    words = zip(drawings, rows or [""] * len(drawings), strict=False)
    kinds = phase_kinds(phases, [(drawn and drawn.type) or row for drawn, row in words]) if phases else ()
    data = scene_data(robot, looks, frame.name, motions, all_notes, kinds, drawings) | {
        "evidence": evidence if content else None,
        "zero": zero,
        "made": next((origin for provenance in provenances if (origin := provenance.get("made"))), None),
        "done": [row for motion in motions for row in _way_rows(motion, len(recordings) > 1)],
        "panes": [_outcome(m) for m in guided] if side_by_side else [],
        "odd": {name: why for name, why in evidence["odd"] if name in recordings},
    }
    text = render_page(data, robot=known_as(robot.source) or robot.name or "robot", subtitle=title).encode("utf-8")
    path = write_atomically(_temporary_file(robot) if html is None else html, text)
    if open_browser or (open_browser is None and html is None):
        webbrowser.open(path.as_uri())
    return ReplayResult(path, len(text), all_notes)


def live_page(
    robot: Robot,
    name: str,
    token: str,
    kind: PageKind = LIVE,
    constraint: Constraint | None = None,
    target: ArrayLike | None = None,
) -> str:
    """Return the HTML of a page that shows a robot live.

    Args:
        robot: The robot.
        name: Headline.
        token: Secret part of the address of the page.
        kind: Source files and network access of the page.
        constraint: Constraint whose mechanism and directions are drawn; None for none.
        target: Target of the task, as returned by `Task.goal`; None for none.

    Returns:
        Text of the page, which receives the robot's configurations as events from its server.

    Raises:
        OutputError: Meshcat's viewer is missing.
        ConstraintMismatchError: The constraint belongs to another robot.
        TargetError: The target is not finite numbers.
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
    data["events"], data["floor"] = f"/{token}/events", 0.0  # random postures reach below the base, real arms do not
    return render_page(data, robot=name, subtitle="", kind=kind)


def _notes(evidence: Mapping[str, Any], n_arms: int) -> list[str]:
    """Return notes on hidden rollouts, warnings, disagreeing recordings that no warning names, and further notes."""
    max_ghosts = 12  # as in page/scene.js
    ghosts = f"Of {n_arms} rollouts the first {max_ghosts} are drawn as robots, the others as tip path and curve; "
    hidden = [f"{ghosts}click a name to draw that one."] if n_arms > max_ghosts else []
    warned = " ".join(evidence["warnings"])
    odd = [f"{name} does not agree with the others: {why}" for name, why in evidence["odd"] if name not in warned]
    return [*hidden, *evidence["warnings"], *odd, *evidence["notes"]]


def _temporary_file(robot: Robot) -> Path:
    """Return a path in a new temporary folder.

    Raises:
        OutputError: The folder cannot be created.
    """
    try:
        folder = tempfile.mkdtemp(prefix="manip_learn_")
    except OSError as error:
        raise OutputError(f"no temporary folder for the replay: {error}; pass a file with html=...") from error
    safe = re.sub(r"[^A-Za-z0-9_-]+", "_", robot.name)[:40] or "robot"
    return Path(folder) / f"{safe}_replay.html"


def _align(recordings: dict[str, Recording], align: str) -> tuple[dict[str, Recording], float]:
    """Return the recordings, delayed to a common grasp time if `align` is "grasp", and this time from the start [s].

    Raises:
        RecordingError: Another `align`.
    """
    if align not in ("start", "grasp"):
        raise RecordingError(f"align must be 'start' or 'grasp', got {align!r}", code="align")
    rollouts = {name: r for name, r in recordings.items() if align == "grasp" and isinstance(r, Rollout) and len(r)}
    fields = ("time", "q", "u", "manipulability", "task_error", "following_error")  # with one value per sample
    grasps = dict[str, float]()  # [s] from the start
    for name, r in rollouts.items():
        grasps[name] = next((w["begins"] for w in r.ways if w["begins"] is not None), r.time[0]) - float(r.time[0])
    latest, out = max(grasps.values(), default=0.0), dict(recordings)
    for name, r in rollouts.items():
        if (wait := latest - grasps[name]) > 0.0:  # repeat its first sample, earlier by this time
            curves = {field: getattr(r, field) for field in fields if getattr(r, field) is not None}
            longer: dict[str, Any] = {field: np.concatenate([x[:1], x]) for field, x in curves.items()}
            longer["time"][0] -= wait
            out[name] = replace(r, status=(Status.OK, *r.status) if r.status else (), **longer)
    return out, latest


def _outcome(motion: GuidedMotion) -> dict[str, str]:
    """Return the caption of a pane: name, distance of each way, and the reason for a stop."""
    ways = [_way_in_words(way) for way in getattr(motion.recording, "ways", ())]
    return {"name": motion.name, "said": "; ".join(far for far, _ in ways), "why": "; ".join(why for _, why in ways)}


def _way_in_words(way: Mapping[str, Any]) -> tuple[str, str]:
    """Return the distance of a way and the reason for its stop, as text."""
    distance, goal, stopped = finite(way.get("done")), finite(way.get("wanted")), _text(way.get("stopped_by"))
    unit = "m" if way.get("unit") == "m" else "degrees"
    text = "" if distance is None or goal is None else f"{abs(distance):.3g} of {abs(goal):.3g} {unit}"
    return text, f", stopped by {stopped}" if stopped else ""


def _way_rows(recorded: RecordedMotion, several: bool) -> list[list[str]]:
    """Return a table row for each way of a rollout: its name, the grasp point, and its numbers, as text."""
    rows, motion = [], recorded.motion
    for way in getattr(motion.recording, "ways", ()):
        name = ": ".join(filter(None, (motion.name if several else "", _text(way.get("name"))))) or motion.name
        begins, place = way["begins"], "not reached"
        if begins is not None:
            at = [np.interp(begins - motion.recording.time[0], recorded.path_times, axis) for axis in recorded.path.T]
            place = ", ".join(f"{x:.3f}" for x in at) + " m"
        joint = way.get("fastest_joint")
        joint = joint if isinstance(joint, Mapping) else {}
        fastest = _in_words("{:.0f} % of its limit", joint.get("share_of_limit"), 100.0)
        fastest = fastest and f"{fastest} ({_text(joint.get('name'))})"
        error, margin = _in_words("{:.1f} mm", way.get("deviation"), 1e3), _in_words("{:.0f} %", way.get("margin"), 1e2)
        rows.append([name, place, "".join(_way_in_words(way)), error, fastest, margin])
    return rows


def _drawings(
    first: Mapping[str, Any] | None, motions: Sequence[RecordedMotion]
) -> tuple[MechanismDrawing | None, ...]:
    """Return the drawing of each constraint's mechanism; without phases of constraints, only the first."""
    guide, drawn = motions[0].motion, list[MechanismDrawing | None]()
    phases = [(m, band) for m in motions for band in m.motion.phases if band.constraint is not None]
    for k in range(max(len(guide.constraints), 1) if phases else 1):
        described = first if k == 0 else guide.mechanism(k)
        constraint = guide.constraints[k] if k < len(guide.constraints) else None
        motion = None if constraint is None else constraint.shown or constraint.intention
        if described is None and motion is None:
            drawn.append(None)
            continue
        # tip path within the phases of constraint k; the whole path if there are none
        parts = [m.path[b.covers(m.path_times)] for m, b in phases if b.constraint == k and b.part in ("", WAY)]
        places = np.concatenate(parts if any(map(len, parts)) else [m.path for m in motions])
        if described is not None and described.get("type") == "line":
            # only the direction of a line was learnt: draw it through the grasp point of the recordings or of a rollout
            grasps = [(m, m.content["handles"][0][0][0]) for m in motions if m.content["handles"]]
            if isinstance(motion, Shown) and motion.hold is not None:
                described, places = {**described, "point": motion.hold}, np.vstack([motion.points, places])
            elif k == 0 and grasps:
                m, begin = grasps[0]
                described = {**described, "point": m.path[np.searchsorted(m.path_times, begin)]}
        drawn.append(mechanism_drawing(described, places, motion))
    return tuple(drawn)


def _tip_frame(robot: Robot, tip: str | None, motions: Sequence[GuidedMotion]) -> Frame:
    """Return the frame whose path is drawn: the given one, a rollout's or a constraint's frame, or the default."""
    frames = [m.recording.frame for m in motions if isinstance(m.recording, Rollout)]
    features = (m.constraint.features for m in motions if m.constraint is not None)
    frames += [frame.name for f in features if isinstance(frame := getattr(f, "frame", None), Frame)]
    candidates = (name for name in frames if name in robot.frame_names)
    return robot.frame(next(candidates, None) or default_tip(robot) if tip is None else tip)


def recordings_by_name(rollouts: Mapping[str, Recording] | Recording) -> dict[str, Recording]:
    """Return the argument `rollouts` of `replay` as a dictionary.

    Args:
        rollouts: Rollout or recording; or a mapping from names to several.

    Returns:
        Dictionary from name to rollout or recording.

    Raises:
        RecordingError: There is no rollout, or a value is neither a rollout nor a recording.
    """
    if not isinstance(rollouts, Mapping):
        rollouts = {getattr(rollouts, "name", "rollout"): rollouts}
    if not rollouts:
        raise RecordingError("there is nothing to replay: pass at least one rollout", code="empty")
    for name, rollout in rollouts.items():
        if not isinstance(name, str) or not isinstance(rollout, Rollout | Trajectory):
            rule = "must be a Rollout or a Trajectory; for several, pass a dictionary from names to rollouts"
            raise RecordingError(f"rollout {name!r} {rule}, got {rollout!r:.80}", code="type")
    return dict(rollouts)
