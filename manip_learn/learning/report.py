"""Report on a learnt constraint: evidence, phases of the recordings, warnings, and provenance."""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import importlib.metadata
import json
import math
import subprocess
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, NamedTuple, final

import numpy as np

from manip_learn.constraint.constraint import Constraint, describe, free_directions, rows_state_place
from manip_learn.constraint.mechanism import Mechanism, describe_uncertainty
from manip_learn.constraint.shown import demonstrated_motion, fit_intention
from manip_learn.errors import counted, error_in_words, few, listed, named, printable
from manip_learn.learning.answer import IN_ONE_ONLY, Answer, Answers
from manip_learn.learning.gate import RowSupport
from manip_learn.learning.repeats import IndependentRecordings
from manip_learn.learning.table import CLEAR_GAP, Table, excitation
from manip_learn.recordings.trajectory import Trajectory, distinct_names, evenly
from manip_learn.robot import html_card

NOISE, JOINT_ZEROS, POLICY = PARTS = ("noise", "joint zeros", "policy")
Uncertainty = dict[str, float | None]

# fields of the report that are saved in the constraint's file
PROVENANCE = set(
    "estimator kind gap uncertainty_deg uncertainty mu_uncertainty n_samples n_trajectories sentence warnings phases "
    "odd_trajectories mechanism evidence facts row_evidence held_out_residual n_constraints".split()
)


class _Phase(NamedTuple):
    """A stretch of a recording.

    Attributes:
        trajectory: Name of the recording.
        start, end: Times on the clock of the recording [s].
        constraint: Number of the constraint, counted from 0 in `constraints_`; None for free motion.
        reason: Reason not to learn from a stretch in which something seems to be constrained; else empty.
    """

    trajectory: str
    start: float
    end: float
    constraint: int | None
    reason: str = ""


class OddTrajectory(NamedTuple):
    """Recording that does not agree with the others.

    Attributes:
        trajectory: Name of the recording.
        reason: Difference from the others in words, with numbers and units.
    """

    trajectory: str
    reason: str


class RecordingOverview(NamedTuple):
    """Overview of the recordings, the same for every constraint.

    Attributes:
        phases: All stretches in which the arm moves, each with its constraint.
        odd_trajectories: Recordings that disagree with the others.
        warnings: Warnings about the recordings, in sentences.
    """

    phases: tuple[_Phase, ...] = ()
    odd_trajectories: tuple[OddTrajectory, ...] = ()
    warnings: Sequence[str] = ()

    def sentences(self) -> tuple[str, ...]:
        """Return one sentence per constraint about the stretches in which it acts."""
        numbers = sorted({p.constraint for p in self.phases if p.constraint is not None})
        free = sum(p.constraint is None and not p.reason for p in self.phases)
        unlearnt = [p for p in self.phases if p.reason]
        if not free and not unlearnt and len(numbers) < 2:
            return ()
        out = [f"constraint {k + 1} is held {_spans([p for p in self.phases if p.constraint == k])}" for k in numbers]
        out += [f"free motion in {counted(free, 'stretch')}"] if free else []
        out += [f"not learnt {_spans([p])}: {p.reason}" for p in unlearnt]
        return tuple(map(printable, out))


def _spans(phases: Sequence[_Phase]) -> str:
    """Return the first phases in words, and the number of the others."""
    most = 6  # number of stretches named in words
    return few([f"from {p.start:.2f} s to {p.end:.2f} s in {p.trajectory}" for p in phases], most)


@final
@dataclass(frozen=True, repr=False)
class LearningReport:
    """Constraint in words and numbers, with the evidence for it.

    Attributes:
        sentence: The result in words.
        estimator: `"null-space"`, `"joint"` or `"separate"`, see `ConstraintLearner`.
        kind: `"motion-constrained"` (b = 0: the world constrains the rows) or `"self-imposed"` (the demonstrator drives
            them).
        n_constraints: Number of rows s.
        row_names: Names of the feature rows.
        reference: Axes of the feature rows, `"world"` or `"local"`; None for features without a frame.
        free_directions: Unit vectors (in the feature rows) of the directions that the constraint leaves free.
        gap: Ratio of the motion along the next direction to the motion along the constrained ones. It supports
            `n_constraints`: 10 and above is clear, below 3 is refused (joint estimator: below about 1.5).
        gap_table: Number of rows -> gap.
        levels: Root mean square of the motion along each whitened direction, smallest first, relative to a motion that
            is equally strong in all joints. Empty for the joint estimator.
        energy_fraction: Share of the motion energy, the sum of |u|^2, that violates A u = 0.
        held_out_residual: Square root of the unexplained share of the motion energy on held-out trajectories.
        uncertainty_deg: Angle between the learnt and the true row space that is not exceeded in 68 % of cases [deg]:
            the root of the sum of squares of the parts in `uncertainty`; for rows about an axis or a centre, the angle
            error of the rows at the recorded positions of the hand. None with a single trajectory, or if only one row
            space is possible. An error of the base's orientation is not included, because it is the same in all
            recordings.
        excitation: Joint name -> share of the energy of the motion.
        policy_model: Model of the null-space policy: terms that the data determine, or the requested model. None except
            for the joint estimator.
        policy_residuals: Policy model -> share of the motion energy that it leaves unexplained on held-out recordings;
            empty except for the joint estimator.
        n_samples, n_trajectories: Numbers of samples and recordings from which the constraint was learnt.
        seconds: Computing time of the fit [s].
        notes: Changes made to the recordings, in sentences.
        warnings: Warnings about the result, in sentences.
        row_evidence: Evidence for each row, most firmly constrained first; empty if the demonstrator drives the rows.
        evidence: Evidence in words.
        phases: Stretches of the recordings, each with its constraint, or free.
        odd_trajectories: Recordings that do not agree with the others, with the difference.
        mechanism: Mechanism that constrains the hand; None if it is not known.
        uncertainty: Cause -> part of `uncertainty_deg` [deg]: `"noise"` for encoder noise and the scatter between
            recordings; `"joint zeros"` for constant errors of the arm (null-space estimator); `"policy"` for the part
            of the policy that the data do not determine (joint estimator). None for a part that does not apply.
        mu_uncertainty: Relative error of the manipulability at the demonstrated configurations that is not exceeded in
            68 % of cases; None with a single trajectory.
    """

    sentence: str
    estimator: str
    kind: str
    n_constraints: int
    row_names: tuple[str, ...]
    reference: str | None
    free_directions: tuple[tuple[float, ...], ...]
    gap: float
    gap_table: dict[int, float]
    levels: tuple[float, ...]
    energy_fraction: float
    held_out_residual: float
    uncertainty_deg: float | None
    excitation: dict[str, float]
    policy_model: str | None
    policy_residuals: dict[str, float]
    n_samples: int
    n_trajectories: int
    seconds: float
    notes: tuple[str, ...]
    warnings: tuple[str, ...]
    row_evidence: tuple[RowSupport, ...] = ()
    evidence: str = ""
    phases: tuple[_Phase, ...] = ()
    odd_trajectories: tuple[OddTrajectory, ...] = ()
    mechanism: Mechanism | None = None
    uncertainty: Uncertainty = field(default_factory=lambda: dict.fromkeys(PARTS))
    mu_uncertainty: float | None = None

    def to_dict(self) -> dict[str, Any]:
        """Return all attributes as a dictionary of JSON values; NaN becomes None."""
        content = {field.name: getattr(self, field.name) for field in dataclasses.fields(self)}
        return _plain(content | {"mechanism": self.mechanism and self.mechanism.to_dict(), "facts": self.facts()})

    def __str__(self) -> str:
        return "\n".join([self.sentence, *(f"warning: {w}" for w in self.warnings)])

    def __repr__(self) -> str:
        warned = f", {counted(len(self.warnings), 'warning')}" if self.warnings else ""
        return f"LearningReport({self.sentence} Gap {self.gap:.3g}, {counted(self.n_samples, 'sample')}{warned})"

    def _repr_html_(self) -> str:
        odd = self.odd_trajectories
        levels = [(f"{'held' if i < self.n_constraints else 'free'}, {x:.2g}", x) for i, x in enumerate(self.levels)]
        phases = [
            (p.trajectory, f"{p.start:.2f}", f"{p.end:.2f}", "free" if p.constraint is None else p.constraint + 1)
            for p in self.phases
        ]
        folded = {
            "Gap for each number of rows": html_card.table(("rows", "gap"), tuple(self.gap_table.items())),
            f"Phases ({len(phases)})": html_card.table(("recording", "from [s]", "until [s]", "constraint"), phases),
            f"Recordings that do not agree ({len(odd)})": html_card.table(("recording", "why"), odd),
            "Notes": "".join(map(html_card.sentence, self.notes)),
        }
        return html_card.card(
            "What was learnt",
            html_card.sentence(self.sentence),
            html_card.warnings(self.warnings),
            html_card.facts(list(self.facts().items())),
            html_card.bars(levels, "how much the recordings move along each direction, by powers of ten"),
            *(html_card.folded(title, inner) for title, inner in folded.items()),
        )

    def facts(self) -> dict[str, str]:
        """Return the evidence in words; each number is printed with its scale, e.g. which values are clear.

        Returns:
            Dictionary from the name of a fact to its text.
        """
        rank = f"{CLEAR_GAP:g} is clear" if self.gap >= CLEAR_GAP else f"weak: {CLEAR_GAP:g} is clear"
        residual, constrained = self.held_out_residual, [row for row in self.row_evidence if row.state == "held"]
        share = f"{100 * residual:.2g} %" if residual >= 1e-5 else "less than 0.001 %"
        strengths = listed(f"{row.strength:.3g}" for row in constrained) if constrained else "none"
        p_value = f", p = {max(row.p_value for row in constrained):.2g}" if constrained else ""
        source = f"{counted(self.n_samples, 'sample')} of {counted(self.n_trajectories, 'recording')}"
        facts = {
            "estimator": f"{self.estimator} ({self.kind})",
            "reference": self.reference,
            "policy model": self.policy_model,
            "number of rows": f"{self.n_constraints} of {len(self.row_names)} ({' '.join(self.row_names)})",
            "gap": f"{self.gap:,.0f} ({rank})" if self.gap >= 10 else f"{self.gap:.2g} ({rank})",
            "left out": f"{share} of the motion unexplained" if math.isfinite(residual) else None,
            "uncertainty": self.known_to(),
            "strength": f"{strengths}{p_value} (recombination test)" if self.row_evidence else None,
            "mechanism": self.mechanism_in_words(),
            "learnt from": source,
        }
        return {name: words for name, words in facts.items() if words}

    def known_to(self) -> str:
        """Return the uncertainty of each quantity as text, as in `sentence`; empty if none is known."""
        text = describe_uncertainty(self.uncertainty_deg, self.mechanism, self._is_told)
        mu = "" if self.mu_uncertainty is None else f", mu to {error_in_words(100.0 * self.mu_uncertainty, '%')}"
        return f"{text}{mu} (68 %, {parts_in_words(self.uncertainty, self.reference)})" if text else ""

    def mechanism_in_words(self) -> str:
        """Return the mechanism in words, without axis and point if `sentence` has them; empty if there is none."""
        m = self.mechanism
        return "" if m is None else f"{m.noun}; {m.turns}" if self._is_told else m.sentence

    @property
    def _is_told(self) -> bool:
        free = np.reshape(self.free_directions, (-1, len(self.row_names)))
        return rows_state_place(self.mechanism, self.row_names, self.reference, free)


def _plain(value: Any) -> Any:
    """Return a value as JSON represents it; None in place of NaN."""
    value = value._asdict() if isinstance(value, _Phase | OddTrajectory | RowSupport) else value
    value = value.item() if isinstance(value, np.generic) else value
    if isinstance(value, dict):
        return {str(key): _plain(inner) for key, inner in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(inner) for inner in value]
    if value is None or isinstance(value, float) and not math.isfinite(value):
        return None
    return value if isinstance(value, str | int | float) else str(value)


class Context(NamedTuple):
    """Data that all reports of a fit share.

    Attributes:
        table, recordings: Samples of all recordings, and the recordings.
        settings: Arguments of the learner, by name.
        started: Reading of `time.perf_counter` when the fit began [s].
    """

    table: Table
    recordings: IndependentRecordings
    settings: Mapping[str, Any]
    started: float


def parts_in_words(parts: Uncertainty, reference: str | None) -> str:
    """Return the parts of an uncertainty as text, e.g. `"noise 0.002 degrees; not included: ..."`.

    An error of the base's orientation is listed as not included, except for rows along the axes of the tool.

    Args:
        parts: Cause -> error [deg]; None for parts that are not known.
        reference: Axes of the rows: `"world"`, `"local"` (the tool) or None.
    """
    included = [f"{name} {error_in_words(part, 'degrees')}" for name, part in parts.items() if part is not None]
    missing = ["joint zeros that are off"] if included and parts[JOINT_ZEROS] is None else []
    missing += [] if reference == "local" else ["a rotated robot base, which no recording can show"]
    text = ", ".join(included) or "scatter of the samples"
    return f"{text}; not included: {listed(missing)}" if missing else text


Learnt = tuple[Constraint, Constraint, LearningReport]


def make_reports(result: Answers, context: Context) -> list[Learnt]:
    """Build the constraints and the report of each learnt answer.

    Args:
        result: Answers of the learner.
        context: Data that all reports share.

    Returns:
        For each answer: the constraint with all rows of the hand, the constraint in the requested rows, and the report
            on
        the latter.
    """
    recordings = context.recordings
    names, given_names = distinct_names(recordings.demonstrations), distinct_names(recordings.given)
    stretches = [(s, k, "") for k, answer in enumerate(result.answers) for s in answer.stretches]
    stretches += [(s, None, "") for s in result.free] + [(s, None, why) for s, why in result.unlearnt]
    phases = list[_Phase]()  # on the clocks of the original recordings
    for s, k, why in sorted(stretches, key=lambda x: (x[0].recording, x[0].start)):
        pieces = recordings.origins[s.recording]
        for number, added in pieces:
            time = recordings.given[number].time
            start, end = max(s.start - added, float(time[0])), min(s.end - added, float(time[-1]))
            if start < end or len(pieces) == 1:
                phases.append(_Phase(given_names[number], start, end, k, why))
    odd = tuple(OddTrajectory(names[i], printable(why)) for i, why in sorted(result.odd.items()))
    warnings = [*recordings.warnings, *result.warnings]
    if alone := [p for p in phases if p.reason == IN_ONE_ONLY]:
        contacts = f"{counted(len(alone), 'contact')} that one recording alone shows"
        warnings.append(f"record again, at least twice, {contacts}: {_spans(alone)}")
    if odd:
        reasons = "; ".join(f"{o.trajectory}: {o.reason}" for o in odd)
        out = "they were left out of the first constraint"
        warnings.append(f"{len(odd)} of {len(names)} recordings do not agree with the others; {out}: {reasons}")
    hashed = [{"name": n, "sha256": checksum(t)} for n, t in zip(given_names, recordings.given, strict=True)]
    origin = {"version": version(), "date": datetime.now(UTC).isoformat(timespec="seconds"), "recordings": hashed}
    origin["settings"] = _plain(context.settings)
    overview = RecordingOverview(tuple(phases), odd, warnings)
    return [_report(answer, overview, context, origin) for answer in result.answers]


def _report(answer: Answer, overview: RecordingOverview, context: Context, origin: dict[str, Any]) -> Learnt:
    # postures in a constraint's file: they show the place and the reach of a drawer to 1 or 2 cm, in 10 kB
    most_postures = 144
    # number of recordings without a warning: five hardly agree by chance; largest number of notes, one screen
    enough, most_notes = 5, 20
    table, features, selection = context.table, answer.asked.features, answer.asked.selection
    recorded = context.recordings.demonstrations
    warnings, notes = list(answer.warnings), list(dict.fromkeys(map(printable, recorded.notes)))
    used = np.linalg.norm(features.batch(table.q[evenly(len(table.q), 200)]), axis=2).max(axis=0) > 1e-9
    if unused := [n for n, u in zip(features.row_names, used, strict=True) if not u]:
        warnings.append(f"always zero for this robot and frame, so left out: {listed(unused)}")
    if (n := len({s.recording for s in answer.stretches})) < enough:
        count = "one trajectory" if n == 1 else f"{n} trajectories"
        warnings.append(f"only {count}: evidence from so few is thin; record {enough} or more")
    if len(notes) > most_notes:  # thousands of files may have thousands of notes
        notes[most_notes:] = [f"and {len(notes) - most_notes} more notes of this kind"]
    inside = table.inside(answer.stretches)
    shares, still = excitation(table.joint_names, table.u[inside])
    if still:
        unknown = "a direction that was never exercised looks like a constrained one"
        warnings.append(f"{named('joint', still)} hardly moved: {unknown}")
    kind = "motion-constrained" if answer.estimator == "null-space" else "self-imposed"
    free = free_directions(selection, used)
    same = "estimator mechanism policy_model policy_residuals uncertainty_deg mu_uncertainty".split()
    report = LearningReport(
        sentence=printable(describe(kind, free, features, used, answer.uncertainty_deg, answer.mechanism)),
        kind=kind,
        n_constraints=len(selection),
        row_names=features.row_names,
        reference=getattr(features, "reference", None),
        free_directions=tuple(tuple(map(float, row)) for row in free),
        gap=answer.asked.gaps.get(len(selection), 0.0),
        gap_table=answer.asked.gaps,
        levels=tuple(map(float, answer.asked.levels)),
        energy_fraction=answer.unexplained,
        held_out_residual=math.sqrt(answer.held_out),
        excitation=shares,
        n_samples=int(inside.sum()),
        n_trajectories=len(answer.stretches),
        seconds=time.perf_counter() - context.started,
        notes=tuple(notes),
        warnings=tuple(map(printable, dict.fromkeys((*warnings, *overview.warnings)))),
        row_evidence=() if answer.evidence is None else answer.evidence.rows,
        evidence="" if answer.evidence is None else answer.evidence.sentence(),
        phases=overview.phases,
        odd_trajectories=overview.odd_trajectories,
        uncertainty={part: answer.uncertainty.get(part) for part in PARTS},
        **{name: getattr(answer, name) for name in same},
    )
    indices = np.flatnonzero(inside)[evenly(report.n_samples, most_postures)]
    provenance = {key: value for key, value in report.to_dict().items() if key in PROVENANCE}
    provenance["made"] = dict(origin)
    provenance["postures"] = np.round(table.q[indices], 5).tolist()
    provenance["posture_trajectories"] = table.recording[indices].tolist()
    whole = answer.whole
    if kind == "motion-constrained":
        contacts = [table.moved[s.recording][s.start : s.end] for s in answer.stretches]
        name, motion = "shown", demonstrated_motion(whole.features, whole.selection, answer.mechanism, contacts)
    else:
        name, motion = "intention", fit_intention(features, selection, [(t.q, np.asarray(t.u)) for t in table.moved])
    provenance[name] = None if motion is None else motion.to_dict()
    everything = Constraint(whole.selection, whole.features, provenance)
    if whole is answer.asked:
        return everything, everything, report
    return everything, Constraint(selection, features, provenance | {"whole": len(whole.selection)}), report


def checksum(trajectory: Trajectory) -> str:
    """Return the SHA-256 of the file of a trajectory, or of its numbers if it was not read from a file.

    Args:
        trajectory: The recording.

    Returns:
        64 hexadecimal digits.
    """
    numbers = (trajectory.time, trajectory.q, *trajectory.arrays.values())
    return trajectory.sha256 or hashlib.sha256(b"".join(a.astype("<f8").tobytes() for a in numbers)).hexdigest()


@functools.cache
def version() -> str:
    """Return the version of the library, with the git commit if known, e.g. `"0.1.0+d8918b7f"`.

    `-dirty` is appended if the working tree has uncommitted changes.
    """
    package = next(iter(importlib.metadata.distributions(name="manip-learn")), None)  # None: a folder on the path
    number, source = ("unknown", None) if package is None else (package.version, package.read_text("direct_url.json"))
    commit = json.loads(source or "{}").get("vcs_info", {}).get("commit_id", "")[:8]
    root = Path(__file__).resolve().parents[2]
    if (root / ".git").exists():
        command = "git --no-optional-locks describe --always --abbrev=8 --exclude=* --dirty".split()
        with suppress(OSError, subprocess.SubprocessError):  # no git here, or another user's checkout
            result = subprocess.run(command, cwd=root, capture_output=True, text=True, timeout=5.0, check=True)
            commit = result.stdout.strip()
    return f"{number}+{commit}" if commit else number
