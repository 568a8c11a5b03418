"""Why no constraint was found, from what the data show, and what to try next."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from manip_learn.constraint.features.feature_map import FeatureMap
from manip_learn.constraint.features.frame_jacobian import FrameJacobian
from manip_learn.errors import NotIdentifiableError, advice, counted, listed, named, number_if_known
from manip_learn.learning.deciding import FEWEST_TRAJECTORIES, REST_SPEED, STILL_ENERGY
from manip_learn.learning.explanation.findings import Findings, held_throughout
from manip_learn.learning.explanation.stretch import Stretch
from manip_learn.learning.overview import lone_contacts
from manip_learn.learning.repeats import IndependentRecordings
from manip_learn.recordings.demonstrations import Demonstrations, distinct_names

ADVICES_SAID = 2  # in the sentence, the likeliest ones; more would hide them
ADVISED = ("weak-gap", "no-evidence", "no-freedom")


def advise(
    refusal: NotIdentifiableError,
    demonstrations: Demonstrations,
    feature_maps: Sequence[FeatureMap],
    findings: Findings,
    *,
    recordings: IndependentRecordings,
    phases: str,
) -> NotIdentifiableError:
    """The refusal with its likely causes and the next thing to try for each; others than those of the evidence pass.

    Args:
        refusal: Why nothing was learnt.
        demonstrations: With velocities.
        feature_maps: The candidates for Phi.
        findings: What was found out about the recordings.
        recordings: Which of those that were given are learnt from.
        phases: Whether phases were looked for (`"auto"`, `"off"`).
    """
    if refusal.code not in ADVISED:
        return _advised(refusal, (), recordings.warnings) if recordings.warnings else refusal
    causes = [
        *_too_few(recordings),
        *lone_contacts(findings, recordings),
        *_several_phases(findings, demonstrations, phases),
        *_other_rows(demonstrations, feature_maps),
        *_still_joints(demonstrations),
        *_too_slow(demonstrations),
    ]
    facts = [*recordings.warnings, *_places(findings, recordings)]
    return _advised(refusal, causes, facts) if causes else advise_in_general(refusal)


def advise_in_general(refusal: NotIdentifiableError) -> NotIdentifiableError:
    """The refusal with what usually helps, where nothing of the data is known."""
    if refusal.code != "weak-gap":
        return _advised(refusal, ())
    usual = "record more varied motions, try other axes or the other reference" + number_if_known(2)
    return _advised(refusal, (usual,))


def _advised(refusal: NotIdentifiableError, causes: Sequence[str], facts: Sequence[str] = ()) -> NotIdentifiableError:
    """What to do, then why and the facts, in two sentences; the first advices are said, all are kept."""
    everything = (*refusal.advice, *causes)
    why = "; ".join([str(refusal), *facts])
    said = f"{'; or '.join(everything[:ADVICES_SAID])}. {why[0].upper()}{why[1:]}" if everything else why
    return NotIdentifiableError(said, code=refusal.code, gaps=refusal.gaps, advice=(*everything, *facts))


def _too_few(recordings: IndependentRecordings) -> list[str]:
    n = len(recordings.demonstrations)
    if n >= FEWEST_TRAJECTORIES:
        return []
    wanted = f"record at least {FEWEST_TRAJECTORIES}, better 5, that differ in way and posture"
    return [f"{wanted}, not {counted(n, 'recording')}"]


def _several_phases(findings: Findings, demonstrations: Demonstrations, phases: str) -> list[str]:
    if phases == "off":
        return [
            "cut the recordings to the contact, since no single constraint fits them as a whole"
            + advice(", or allow {}", "phases='auto'", "--phases auto")
        ]
    if findings.unlearnt or _throughout(findings.refused, demonstrations):
        return []
    if _held(findings):
        return ["cut the recordings more closely to what seems held, each stretch in a file of its own"]
    if len(demonstrations) < 2:
        return [
            "cut the recording to the contact"
            + advice(" with {}", "trajectory[start:until]", "--from and --until")
            + ", since no single constraint fits it as a whole"
        ]
    return [
        "cut the recordings to the contact"
        + advice(" ({})", "trajectory[start:until]", "--from and --until")
        + ", for no stretch of them obeys a constraint that several confirm, as in free motion"
    ]


def _held(findings: Findings) -> list[Stretch]:
    """Stretches in which rows are held."""
    return [s for part in findings.parts for s in part.stretches] if findings.explained else []


def _throughout(stretches: Sequence[Stretch], demonstrations: Demonstrations) -> bool:
    """Whether these stretches are all of the recordings, each as a whole."""
    spans = {(s.trajectory, s.start, s.end) for s in stretches}
    return all((i, float(t.time[0]), float(t.time[-1])) in spans for i, t in enumerate(demonstrations))


def _places(findings: Findings, recordings: IndependentRecordings) -> list[str]:
    """Where something seems held, or nearly so: each recording with its times."""
    held = _held(findings)
    names, times = distinct_names(recordings.given), dict[str, list[str]]()
    for place in (p for s in held or findings.refused for p in recordings.places(s)):
        times.setdefault(names[place.trajectory], []).append(f"{place.start:.1f} to {place.end:.1f} s")
    spans = ", ".join(f"{name} {listed(of_one)}" for name, of_one in times.items())
    what = "what seems held" if held else "the likeliest contact, if anything was touched"
    return [f"{what}: {spans}"] if spans else []


def _other_rows(demonstrations: Demonstrations, feature_maps: Sequence[FeatureMap]) -> list[str]:
    """Whether rows that were not asked for are held."""
    first = feature_maps[0]
    if not isinstance(first, FrameJacobian) or len(demonstrations) < 2:
        return []
    tried = {(f.row_names, f.reference) for f in feature_maps if isinstance(f, FrameJacobian)}
    for axes in ("xyz", "rotation", "pose"):
        for reference in ("world", "local"):
            other = FrameJacobian(first.robot, first.frame.name, axes, reference)
            if (other.row_names, reference) not in tried and held_throughout([other], demonstrations):
                python, flags = f"axes={axes!r}, reference={reference!r}", f"--axes {axes} --reference {reference}"
                return [f"try other rows{advice(', {}', python, flags)}, with which one constraint does fit"]
    return []


def _still_joints(demonstrations: Demonstrations) -> list[str]:
    energy = sum(np.einsum("nv,nv->v", t.u, t.u) for t in demonstrations if t.u is not None)
    total = float(np.sum(energy))
    if total <= 0.0:
        return []
    still = [
        n for n, e in zip(demonstrations.joint_names, np.atleast_1d(energy), strict=True) if e < STILL_ENERGY * total
    ]
    if not still:
        return []
    python, flags = f"load_robot(..., locked={still})", " ".join(f"--lock {name}" for name in still)
    return [f"move {named('joint', still)} too, or lock what shall hardly move{advice(' ({})', python, flags)}"]


def _too_slow(demonstrations: Demonstrations) -> list[str]:
    speed = max((float(np.max(np.abs(t.u))) for t in demonstrations if t.u is not None), default=0.0)
    return (
        [f"move faster, noise hides a motion in which no joint exceeds {speed:.2g} rad/s"] if speed < REST_SPEED else []
    )
