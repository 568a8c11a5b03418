"""How two sets of golden numbers are compared, and which of them may differ by more than rounding."""

from __future__ import annotations

from typing import Any

import numpy as np

Cases = dict[str, dict[str, Any]]

TOLERANCE = 1e-12  # of the largest number in the array
SMALLEST_SCALE = 1e-3  # arrays of smaller numbers are compared as if they were of this size
NATURAL_SCALE = {"velocity": 1.0}  # [rad/s]; many commands are zero but for rounding
# (start of case name, key ending, tolerance) for another machine, whose sums are rounded otherwise: four times or more
# the differences between OpenBLAS's kernels SkylakeX, Haswell and Prescott
LOOSER: tuple[tuple[str, str, float], ...] = (
    # ratios of small eigenvalues, and angles over a bootstrap of them
    ("learn", "", 1e-8),
    ("manip-learn learn", "", 1e-8),
    ("manip-learn demo", "", 1e-8),
    # bootstraps over recordings whose contact ends at a threshold: rounding decides whether one more sample is in it
    # (2.4 % between SkylakeX and Haswell)
    ("learn drawer", "uncertainty_deg", 0.1),
    ("learn drawer", "mechanism.uncertainty.axis", 0.1),
    ("manip-learn learn drawer", "uncertainty_deg", 0.1),
    ("manip-learn learn drawer", "mechanism.uncertainty.axis", 0.1),
    ("manip-learn demo", "uncertainty_deg", 0.1),
    ("manip-learn demo", "mechanism.uncertainty.axis", 0.1),
    # noise-free motions: the gap's denominator is the rounding of the recordings' seventh decimal
    ("learn planar", "", 1e-6),
    # what is left where a descent stops of motions without noise: its order of magnitude counts
    ("learn planar 20 recordings, x y, world, rows None, joint", "gap", 0.1),
    ("learn planar 20 recordings, x y, world, rows None, joint", "gap_table.2", 0.1),
    ("manip-learn learn planar", "gap", 0.1),
    ("manip-learn learn planar", "gap_table.2", 0.1),
    # the joint estimator is settled where a step is a thousandth of the standard errors, which are 5 degrees here
    ("learn drawer 6 recordings, xyz, world, rows 2, joint", "", 1e-3),
    # iterations that stop at a tolerance of their own
    ("learn planar 20 recordings, planar, world, rows 2, separate", "", 1e-3),
    ("learn planar 20 recordings, planar, world, rows None, separate", "", 1e-3),
    # a thousandth of a radian from a singularity: velocities grow with the inverse of the distance
    ("command", "velocity", 1e-8),
    # exactly singular, and what is followed is at rest: 2.9e-8 between SkylakeX and Haswell
    ("command ur5 exact track zero", "velocity", 1.2e-7),
    # the share of a command that limits leave, of which some is a billionth of what it is taken from
    ("command", "scales", 2e-8),
)
# (start of case name, start of key, difference) likewise for counts: a command within rounding of two limits counts as
# one of them (one of 501 steps between SkylakeX and Zen)
COUNTS: tuple[tuple[str, str, int], ...] = (("manip-learn demo", "rollouts", 2),)


def tolerance_of(case: str, key: str) -> float:
    """The tolerance of one array on another machine, relative to its largest number."""
    fitting = [t for start, end, t in LOOSER if case.startswith(start) and key.endswith(end)]
    return max([TOLERANCE, *fitting])


def differences(golden: Cases, now: Cases, *, strict: bool = False) -> list[str]:
    """One sentence a difference, with the case and the key; keys that golden lacks are not looked at."""
    found = []
    for case, content in golden.items():
        if case not in now:
            found.append(f"{case}: no longer computed")
            continue
        for key, value in content.items():
            tolerance = TOLERANCE if strict else tolerance_of(case, key)
            floor = NATURAL_SCALE.get(key, SMALLEST_SCALE)
            what = "is missing" if key not in now[case] else _difference(value, now[case][key], tolerance, floor)
            if what and (strict or not _nearly_counted(case, key, value, now[case].get(key))):
                found.append(f"{case}: {key} {what}")
    return found


def _nearly_counted(case: str, key: str, golden: Any, now: Any) -> bool:
    """Whether two counts of a status differ by no more than another machine's rounding explains."""
    most = max((n for start, first, n in COUNTS if case.startswith(start) and key.startswith(first)), default=0)
    return ".status_counts." in key and isinstance(now, int) and abs(golden - now) <= most


def _difference(golden: Any, now: Any, tolerance: float, floor: float) -> str:
    if not isinstance(golden, np.ndarray) or not isinstance(now, np.ndarray):
        same = type(golden) is type(now) and golden == now
        return "" if same else f"was {_short(golden)}, is {_short(now)}"
    if golden.shape != now.shape:
        return f"had shape {golden.shape}, has {now.shape}"
    if not golden.size:
        return ""
    if not np.array_equal(np.isfinite(golden), np.isfinite(now)):
        return f"is finite elsewhere: {_short(golden)} before, {_short(now)} now"
    error = np.abs(np.nan_to_num(golden - now, nan=0.0))
    scale = max(float(np.max(np.abs(golden), initial=0.0, where=np.isfinite(golden))), floor)
    if error.max() <= tolerance * scale:
        return ""
    place = np.unravel_index(int(np.argmax(error)), error.shape)
    return (
        f"at {list(map(int, place))} was {golden[place]!r}, is {now[place]!r}: "
        f"{error[place] / scale:.1e} of the scale {scale:.3g}, allowed {tolerance:.0e}"
    )


def _short(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 200 else f"{text[:200]}..."


# wording, time and place, of files too, are no results; the cross-check's largest difference, and where it is, are
# rounding itself
NO_RESULT = (
    "seconds",
    "bytes",
    "html",
    "out",
    "source",
    "largest_difference",
    "sentence",
    "fingerprint",
    "notes",
    "link",
    "meshes_found",
    "evidence",
    "reason",
)
COUNTED = ("warnings",)  # their wording may improve
# rows of any sign and order, or any other basis of the same space
SPACES = ("selection", "free_directions")


def flat(value: Any, name: str = "") -> dict[str, Any]:
    """A JSON answer as key -> array, word or count: rows that span a space become its projector, see `SPACES`."""
    last = name.rpartition(".")[2]
    if last in NO_RESULT:
        return {}
    if last in COUNTED:
        codes = [w["code"] for w in value if isinstance(w, dict) and "code" in w]
        return {f"{name}.count": len(value), **({f"{name}.codes": codes} if codes else {})}
    if last in SPACES:
        return {f"{name}.projector": projector(value)}
    if isinstance(value, dict):
        return {k: v for key, inner in value.items() for k, v in flat(inner, f"{name}.{key}" if name else key).items()}
    if isinstance(value, list | tuple):
        if value and all(_number(v) for v in value):
            return {name: np.array(value, dtype=np.float64)}
        if all(isinstance(v, str) for v in value):
            return {name: list(value)}
        return {k: v for i, inner in enumerate(value) for k, v in flat(inner, f"{name}[{i}]").items()}
    return {name: np.array(value, dtype=np.float64) if isinstance(value, float) else value}


def projector(rows: Any) -> np.ndarray:
    """L^T L of orthonormal rows, shape (p, p): the same for every basis of their span."""
    L = np.array(rows, dtype=np.float64)
    return L.T @ L if L.size else np.zeros((0, 0))


def _number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)
