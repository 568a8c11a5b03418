"""Which feature of a LeRobot data set holds the joint positions, and which their velocities."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, final

from manip_learn.errors import RecordingError, advice, closest_names

STATE, VELOCITY, EFFORT = "observation.state", "observation.velocity", "observation.effort"
# names that data sets give to joint positions: joint_position (DROID), joint_pos, joint_positions, qpos
POSITIONS = re.compile(r"(joint_?pos(ition)?s?|qpos)$", re.IGNORECASE)
VELOCITY_WORDS = (("position", "velocity"), ("pos", "vel"))
EFFORT_WORDS = tuple(
    (p, e) for p in ("positions", "position", "pos") for e in ("effort", "torque", "torques", "efforts")
)
NUMBERS = ("float", "int", "uint")  # how the types of features that hold numbers begin


@final
@dataclass(frozen=True)
class StateFeature:
    """The feature that is read.

    Attributes:
        position: Its name, which is that of a column too.
        velocity: Name that the velocities of the same joints would have.
        names: Names of its entries, or None.
        effort: Name that the efforts of the same joints would have.
        others: Other features that look like joint positions.
    """

    position: str
    velocity: str
    names: tuple[str, ...] | None
    others: tuple[str, ...] = ()
    effort: str = EFFORT


def state_feature(path: Path, features: Mapping[str, Any] | None, asked: str | None) -> StateFeature:
    """The feature to read: the one that was asked for, otherwise `observation.state`.

    Args:
        path: The data set, for messages.
        features: What `meta/info.json` says of each feature; None of a single file without it.
        asked: Name of the feature, or None.

    Raises:
        RecordingError: There is no such feature, or it holds no vector of numbers.
    """
    wanted = STATE if asked is None else asked
    if features is None:
        return StateFeature(wanted, _velocity_of(wanted, ()), None, effort=_effort_of(wanted, ()))
    vectors = [name for name, feature in features.items() if _is_vector(feature)]
    likely = tuple(name for name in vectors if POSITIONS.search(name) and not name.startswith("action"))
    if wanted not in features:
        raise RecordingError(f"{path}: {_missing(wanted, asked, vectors, likely)}", code="no-state", path=path)
    if wanted not in vectors:
        kind = features[wanted].get("dtype") if isinstance(features[wanted], dict) else features[wanted]
        raise RecordingError(
            f"{path}: the feature {wanted!r} holds {kind}, joint positions are a vector of numbers; such are "
            f"{_shown(vectors)}",
            code="no-state",
            path=path,
        )
    others = tuple(name for name in likely if name != wanted)
    names, effort = entry_names(features[wanted].get("names")), _effort_of(wanted, vectors)
    return StateFeature(wanted, _velocity_of(wanted, vectors), names, others, effort)


def _missing(wanted: str, asked: str | None, vectors: Sequence[str], likely: Sequence[str]) -> str:
    text = f"there is no feature {wanted!r}"
    if asked is not None:
        return f"{text}; {_near(asked, vectors)}"
    if likely:
        flag = advice(": read it with {}", f"feature={likely[0]!r}", f"--feature {likely[0]}")
        return f"{text}, joint positions seem to be in {_shown(likely)}{flag}"
    hint = advice("; if one of them holds joint positions, pass {}", "feature=NAME", "--feature NAME")
    return f"{text} (joint positions), there is {_shown(vectors)}{hint}"


def _near(asked: str, vectors: Sequence[str]) -> str:
    near = closest_names(asked, vectors)
    return f"did you mean {_shown(near)}?" if near else f"vectors of numbers are {_shown(vectors)}"


def _shown(names: Sequence[str]) -> str:
    return (", ".join(map(repr, names[:12])) or "none") + (" ..." if len(names) > 12 else "")


def _is_vector(feature: Any) -> bool:
    if not isinstance(feature, dict):
        return False
    shape, dtype = feature.get("shape"), feature.get("dtype")
    # old data sets leave the type of the state out
    return isinstance(shape, list) and len(shape) == 1 and (dtype is None or str(dtype).startswith(NUMBERS))


def _velocity_of(position: str, vectors: Sequence[str]) -> str:
    """`observation.velocity` of the usual state; of another feature the one with the word exchanged."""
    return VELOCITY if position == STATE else _exchanged(position, VELOCITY_WORDS, vectors, VELOCITY)


def _effort_of(position: str, vectors: Sequence[str]) -> str:
    """`observation.effort`, likewise."""
    return EFFORT if position == STATE else _exchanged(position, EFFORT_WORDS, vectors, EFFORT)


def _exchanged(position: str, words: Sequence[tuple[str, str]], vectors: Sequence[str], usual: str) -> str:
    head, dot, last = position.rpartition(".")
    exchanged = [head + dot + last.replace(p, v) for p, v in words if p in last]
    return next((name for name in exchanged if name in vectors), exchanged[0] if exchanged else usual)


def entry_names(names: Any) -> tuple[str, ...] | None:
    """Names of a vector's entries: from a list, `{"motors": [...]}` or `{"shoulder": 0, ...}`; null is None."""
    if isinstance(names, dict) and names:
        values = list(names.values())
        if all(isinstance(v, int) and not isinstance(v, bool) for v in values):
            if sorted(values) != list(range(len(values))):
                return None
            return tuple(sorted(names, key=lambda n: names[n]))
        names = [n for v in values for n in v] if all(isinstance(v, list) for v in values) else None
    if isinstance(names, list) and names and all(isinstance(n, str) for n in names):
        return tuple(names)
    return None
