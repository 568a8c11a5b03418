"""Patterns of names, `left_{joint}` and `q[{index}]`: what they stand for in a file, and which would help it."""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import final

from manip_learn.errors import RecordingError, advice, closest_names
from manip_learn.recordings.format_words import ENDS
from manip_learn.recordings.readers.recording import refusal

JOINT, INDEX = "{joint}", "{index}"
_SHOWN = 8  # names in a sentence
NUMBERED = re.compile(r"(?P<head>.*?)(?P<number>\d+)(?P<tail>\D*)")
SIDES = ({"left", "l", "lh", "larm"}, {"right", "r", "rh", "rarm"})  # words that say which of two arms is meant
UNTELLING = {*SIDES[0], *SIDES[1], "joint", "link", "motor", "k"}  # words that do not tell one joint from another
_ALIKE = 0.65  # of the letters of two names, below which they are not the same word misspelt
MOST_COMPARED = 300  # names of a file in which a joint is sought letter by letter; an arm has ten


@final
class PatternError(RecordingError):
    """Names or a pattern that do not say what is meant; the reader says where (`named_in`)."""

    def __init__(self, message: str, code: str = "columns"):
        super().__init__(message, code=code)


@contextmanager
def named_in(path: Path, line: int | None = None) -> Iterator[None]:
    """Within it, a `PatternError` is the refusal of a file."""
    try:
        yield
    except PatternError as error:
        raise refusal(path, error.code, str(error), line=line) from error


def pattern_columns(
    pattern: str, names: Sequence[str | None], moving: Sequence[str], still: Iterable[str], option: str
) -> dict[int, str]:
    """Column -> joint, of the names that a pattern stands for.

    Args:
        pattern: With `{joint}`, the name of a joint, or `{index}`, its number in the robot's order from 0 or 1.
        names: Of the columns; None for one that is not read.
        moving: Joints of the robot in its order.
        still: Joints that do not move, which may be recorded too.
        option: The option that holds the pattern, for the error.

    Raises:
        RecordingError: No such column, or numbers that are not those of the joints.
    """
    said = advice("{}: ", f"{option}={pattern!r}", f"--{option} '{pattern}'")
    regex = re.compile(re.escape(pattern).replace(re.escape(INDEX), r"(\d{1,6})"))
    numbered = {int(m.group(1)): i for i, n in enumerate(names) if n and INDEX in pattern and (m := regex.fullmatch(n))}
    found = {i: j for j in (*moving, *still) for i, n in enumerate(names) if n == pattern.replace(JOINT, j)}
    if not numbered and not found:
        wanted = pattern.replace(JOINT, moving[0]).replace(INDEX, "0")
        like = "such as " if INDEX in pattern else ""
        raise PatternError(f"{said}there is no column {like}{wanted!r}; there is {shown(names, wanted)}")
    if JOINT in pattern:
        return found
    first, n = min(numbered), len(numbered)
    if first > 1 or sorted(numbered) != list(range(first, first + n)):
        seen = f"the columns are numbered {', '.join(map(str, sorted(numbered)))}"
        raise PatternError(f"{said}{seen}; 0, 1, 2, ... or 1, 2, 3, ... without gaps is needed")
    if n > len(moving):
        seen = f"there are {n} such columns and {len(moving)} moving joints ({', '.join(moving)})"
        raise PatternError(f"{said}{seen}: lock fewer joints, or rename the columns to joints")
    return {numbered[first + k]: joint for k, joint in zip(range(n), moving, strict=False)}


def shown(names: Sequence[str | None], wanted: str = "") -> str:
    """The names that look like the wanted one, else the first of all."""
    all_names = [n for n in names if n]
    listed = closest_names(wanted, all_names) if wanted else []
    listed = listed or all_names[:_SHOWN]
    return ", ".join(map(repr, listed)) + (" ..." if len(all_names) > len(listed) else "")


def templates(names: Sequence[str | None], joints: Sequence[str]) -> dict[str, dict[int, str]]:
    """Pattern with `{joint}` -> column -> the name that it stands for.

    It is that of a joint, if it is a whole word of the column's name and occurs once; else the name without its end.
    """
    words = [(j, re.compile(rf"(?<![A-Za-z0-9]){re.escape(j)}(?![A-Za-z0-9])")) for j in sorted(joints, key=len)[::-1]]
    made: dict[str, dict[int, str]] = {}
    for i, name in ((i, n) for i, n in enumerate(names) if n):
        joint, places = next(((j, p) for j, word in words if (p := list(word.finditer(name)))), ("", []))
        if len(places) == 1:
            start, end = places[0].span()
            pattern = f"{name[:start]}{JOINT}{name[end:]}"
        else:
            joint, ending = split_end(name)
            pattern = JOINT + ending
        made.setdefault(pattern, {})[i] = joint
    return made


def split_end(name: str) -> tuple[str, str]:
    """A name without its end, as of columns about a joint (`joint1_velocity`), and the end; none where it has none."""
    end = next((end for end in ENDS if name.endswith(end) and name != end), "")
    return name.removesuffix(end), end


def numbered_families(names: Sequence[str | None]) -> dict[str, list[int]]:
    """Pattern with `{index}` -> columns in the order of their numbers: names that differ in their last number only."""
    families: dict[str, dict[int, int]] = {}
    for i, name in enumerate(names):
        match = NUMBERED.fullmatch(name or "")
        if match and len(match["number"]) <= 6:
            families.setdefault(f"{match['head']}{INDEX}{match['tail']}", {})[int(match["number"])] = i
    runs = {p: (min(numbers), [numbers[k] for k in sorted(numbers)]) for p, numbers in families.items()}
    return {
        p: columns
        for p, (first, columns) in runs.items()
        if first in (0, 1) and len(columns) > 1 and max(families[p]) == first + len(columns) - 1
    }


def renamed(
    names: Sequence[str], rename: Mapping[str, str], moving: Sequence[str], still: Sequence[str]
) -> dict[str, tuple[str, str]]:
    """Name in a file -> its new name, and the entry of `rename` that says so; a name of its own goes before a pattern.

    Args:
        names: In the file.
        rename: Names or patterns -> names, or a pattern with `{joint}`.
        moving: Joints of the robot in its order, which `{index}` counts.
        still: Further names that `{joint}` may stand for.
    """
    new: dict[str, tuple[str, str]] = {}
    for old, wanted in rename.items():
        if INDEX in old:
            regex = re.compile(re.escape(old).replace(re.escape(INDEX), r"\d+"))
            numbered = pattern_columns(old, names, moving, (), "rename") if any(map(regex.fullmatch, names)) else {}
            new |= {names[i]: (joint, old) for i, joint in numbered.items()}
        elif JOINT in old:
            head, tail = wanted.split(JOINT)
            inner = {j: j.removeprefix(head).removesuffix(tail) for j in (*moving, *still) if f"{head}{tail}" != j}
            fitting = {old.replace(JOINT, part): j for j, part in inner.items() if head + part + tail == j}
            new |= {name: (fitting[name], old) for name in names if name in fitting}
    new |= {old: (wanted, old) for old, wanted in rename.items() if old in names}
    for name in (n for n in names if n not in new):
        base, end = split_end(name)  # which follows the joint
        about = renamed((base,), {k: v for k, v in rename.items() if INDEX not in k}, moving, still) if end else {}
        if base in about and about[base][0] in moving:
            new[name] = (about[base][0] + end, about[base][1])
    return new


def helpful_renaming(
    recorded: Sequence[str], missing: Sequence[str], moving: Sequence[str]
) -> list[tuple[dict[str, str], dict[str, str]]]:
    """What `rename` could be, each with the names that it reads and their joints; empty if nothing is near.

    One pattern for all joints goes first: a common prefix or suffix of the file's names, of the robot's, or of both.
    Then names one by one, each once and of the same arm and number; then numbers in the robot's order.

    Args:
        recorded: Names in the file that are no joints.
        missing: Joints without a name in the file.
        moving: Joints of the robot in its order.
    """
    affixes: dict[tuple[str, str], dict[str, str]] = {}
    for joint in missing:
        for name in recorded[:MOST_COMPARED]:
            i, k, n = difflib.SequenceMatcher(None, name, joint, autojunk=False).find_longest_match()
            if not same_arm(name, joint) or not re.search("[A-Za-z]", name[i : i + n]):
                continue
            old, new = (s[:at] + JOINT + s[at + n :] for s, at in ((name, i), (joint, k)))
            affixes.setdefault((old, new), {})[name] = joint
    pairs = _nearest_pairs(recorded[:MOST_COMPARED], missing)
    most = max(map(len, affixes.values()), default=0)
    alike = [p for p, found in affixes.items() if len(found) == most > 1]
    if alike and most >= len(pairs):
        letters = min(len(new) for _, new in alike)  # around the joint's name: none is best
        return [({old: new}, affixes[old, new]) for old, new in alike if len(new) == letters]
    if pairs:
        return [(pairs, pairs)]
    n = len(moving) if len(missing) == len(moving) else 0  # a few numbered names, as of one wrist, are not an arm's
    families = {p: c for p, c in numbered_families(recorded).items() if n < 2 * len(c) <= 2 * n}
    return [({p: JOINT}, {recorded[i]: j for i, j in zip(c, moving, strict=False)}) for p, c in families.items()]


def _nearest_pairs(recorded: Sequence[str], missing: Sequence[str]) -> dict[str, str]:
    """Name -> joint, where each is nearest to the other: a wrist is not proposed for a hip because it is left over."""

    def likeness(name: str, joint: str) -> float:
        if not same_arm(name, joint) or not same_number(name, joint):
            return 0.0
        ratios = []
        for left_out in (SIDES[0] | SIDES[1], UNTELLING):
            one, other = (" ".join(w for w in _words(n) if w not in left_out) for n in (name, joint))
            ratios.append(difflib.SequenceMatcher(None, one, other, autojunk=False).ratio() if one and other else 0.0)
        return max(ratios)

    like = {(n, j): value for n in recorded for j in missing if (value := likeness(n, j)) >= _ALIKE}
    best = {key: max(v for k, v in like.items() if k[at] == key) for at in (0, 1) for key in {k[at] for k in like}}
    found = [k for k, value in like.items() if value == best[k[0]] == best[k[1]]]
    once = [k for k in found if sum(k[0] == o[0] or k[1] == o[1] for o in found) == 1]
    return dict(once)


def _words(name: str) -> list[str]:
    return re.findall(r"\d+|[a-z]+", re.sub(r"([a-z])([A-Z])", r"\1 \2", name).lower())


def same_arm(name: str, joint: str) -> bool:
    """False if one name is of a left arm and the other of a right one."""
    one, other = ({k for k, side in enumerate(SIDES) if side & set(_words(n))} for n in (name, joint))
    return not one or not other or one == other


def same_number(name: str, joint: str) -> bool:
    """False if two names end with different numbers: `joint1` is not meant by `joint11`."""
    one, other = ([w.lstrip("0") for w in _words(n) if w.isdecimal()][-1:] for n in (name, joint))
    return not one or not other or one == other
