"""Why no constraint was found, from what the data show, and what to try next."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from manip_learn.constraint.features.feature_map import FeatureMap
from manip_learn.constraint.features.frame_jacobian import FrameJacobian
from manip_learn.errors import NotIdentifiableError, advice
from manip_learn.learning.division import Division
from manip_learn.learning.overview import distinct_names, lone_contacts
from manip_learn.learning.phases.find_phases import one_constraint_fits
from manip_learn.recordings.demonstrations import Demonstrations

# share of the motion's energy below which a joint counts as still
STILL = 1e-6
# speed of the fastest joint below which encoder noise of 1e-4 rad at 100 Hz hides the motion [rad/s]
SLOW = 0.02
FEWEST = 3
ADVISED = ("weak-gap", "no-evidence", "no-freedom")


def advise(
    refusal: NotIdentifiableError,
    demonstrations: Demonstrations,
    feature_maps: Sequence[FeatureMap],
    division: Division,
    *,
    phases: str,
) -> NotIdentifiableError:
    """The refusal with its likely causes and the next thing to try for each; others than those of the evidence pass.

    Args:
        refusal: Why nothing was learnt.
        demonstrations: With velocities.
        feature_maps: The candidates for Phi.
        division: What was found out about the recordings.
        phases: Whether phases were looked for (`"auto"`, `"off"`).
    """
    if refusal.code not in ADVISED:
        return refusal
    causes = [
        *_too_few(demonstrations),
        *lone_contacts(division, distinct_names(demonstrations)),
        *_several_phases(division, phases, len(demonstrations)),
        *_other_rows(demonstrations, feature_maps),
        *_still_joints(demonstrations),
        *_too_slow(demonstrations),
    ]
    if not causes:
        return advise_in_general(refusal)
    said = f"{refusal}; what the data show: {'; '.join(causes)}"
    return NotIdentifiableError(said, code=refusal.code, gaps=refusal.gaps, advice=(*refusal.advice, *causes))


def advise_in_general(refusal: NotIdentifiableError) -> NotIdentifiableError:
    """The refusal with what usually helps, where nothing of the data is known."""
    if refusal.code != "weak-gap":
        return refusal
    usual = (
        "record more varied motions, try other axes or the other reference, or give the number of rows if you know it"
        + advice(" ({})", "n_constraints=2", "--constraints 2")
    )
    said = f"{refusal}; {usual}"
    return NotIdentifiableError(said, code=refusal.code, gaps=refusal.gaps, advice=(*refusal.advice, usual))


def _too_few(demonstrations: Demonstrations) -> list[str]:
    if len(demonstrations) >= FEWEST:
        return []
    return [
        f"{len(demonstrations)} recording(s) only: record at least {FEWEST}, better 5, that differ in way and posture"
    ]


def _several_phases(division: Division, phases: str, n: int) -> list[str]:
    if division.one_fits or division.unlearnt:
        return []
    if phases == "off":
        return [
            "no single constraint fits the recordings as a whole: cut them"
            + advice(", or allow {}", "phases='auto'", "--phases auto")
        ]
    if n < 2:
        return [
            "no single constraint fits the recording as a whole: cut it"
            + advice(" with {}", "trajectory[start:until]", "--from and --until")
        ]
    return [
        "no stretch of the recordings obeys a constraint that several of them confirm: this looks like free motion. A "
        "contact without any constant direction, other than with a tether, is learnt from recordings that are cut to "
        + advice("it ({})", "trajectory[start:until]", "--from and --until")
    ]


def _other_rows(demonstrations: Demonstrations, feature_maps: Sequence[FeatureMap]) -> list[str]:
    """Whether rows that were not asked for are held."""
    first = feature_maps[0]
    if not isinstance(first, FrameJacobian) or len(demonstrations) < 2:
        return []
    tried = {(f.row_names, f.reference) for f in feature_maps if isinstance(f, FrameJacobian)}
    for axes in ("xyz", "rotation", "pose"):
        for reference in ("world", "local"):
            other = FrameJacobian(first.robot, first.frame.name, axes, reference)
            if (other.row_names, reference) not in tried and one_constraint_fits(other, demonstrations):
                python, flags = f"axes={axes!r}, reference={reference!r}", f"--axes {axes} --reference {reference}"
                return [f"with other rows one constraint does fit{advice(': try {}', python, flags)}"]
    return []


def _still_joints(demonstrations: Demonstrations) -> list[str]:
    energy = sum(np.einsum("nv,nv->v", t.u, t.u) for t in demonstrations if t.u is not None)
    total = float(np.sum(energy))
    if total <= 0.0:
        return []
    still = [n for n, e in zip(demonstrations.joint_names, np.atleast_1d(energy), strict=True) if e < STILL * total]
    if not still:
        return []
    python, flags = f"load_robot(..., locked={still})", " ".join(f"--lock {name}" for name in still)
    return [f"joint(s) {', '.join(still)} hardly move: move them too, or lock them{advice(': {}', python, flags)}"]


def _too_slow(demonstrations: Demonstrations) -> list[str]:
    speed = max((float(np.max(np.abs(t.u))) for t in demonstrations if t.u is not None), default=0.0)
    return (
        [f"the fastest joint moves at {speed:.2g} rad/s: move faster, noise hides such motion"] if speed < SLOW else []
    )
