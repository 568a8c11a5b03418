"""Files -> demonstrations of one robot."""

from __future__ import annotations

import itertools
import os
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Literal, TypedDict, Unpack

from manip_learn.errors import RecordingError, advice, an, closest_names, printable
from manip_learn.recordings.data_frame import DataFrame, frames_as_files
from manip_learn.recordings.demonstrations import Demonstrations
from manip_learn.recordings.earned_velocities import Velocities, judged_in_turn
from manip_learn.recordings.format_words import ENDS
from manip_learn.recordings.readers.name_patterns import JOINT
from manip_learn.recordings.readers.read_request import (
    EpisodeSelection,
    OptionUses,
    ReadRequest,
    TimeUnit,
    Units,
    refuse_unmatched,
    rename_words,
    unmoved_joint_names,
)
from manip_learn.recordings.readers.recording import Recording
from manip_learn.recordings.readers.recording_files import (
    RecordingFile,
    recording_files,
    select_episodes,
)
from manip_learn.recordings.trajectory import Trajectory
from manip_learn.recordings.validation.joint_matching import QUATERNION, ROTATION_VECTOR
from manip_learn.recordings.validation.validate import validate
from manip_learn.robot import Robot

# of an NPZ archive; `time` is a column of any recording
_ARRAYS = ("time", "q", "u", "effort", "joint_names", "format")
POSE_SUFFIXES = (".x", ".y", ".z", *ROTATION_VECTOR, *QUATERNION)

_NUMBER = re.compile(r"\d[\d.,]*(e[-+]?\d+)?")

Paths = str | os.PathLike[str] | Iterable[str | os.PathLike[str]]
Tables = DataFrame | Sequence[DataFrame]


class ReadOptions(TypedDict, total=False):
    """Keywords of `load_demonstrations`.

    Attributes:
        degrees: The same as `units="degrees"`, but what looks like radians is refused.
        units: Unit of angles in the files: `"radians"`, `"degrees"` or `"normalised"` (-100 .. 100 between the joint
            limits). Not given: radians; what looks like degrees is refused. Prismatic joints are metres in any case.
        time_unit: `"s"`, `"ms"`, `"us"` or `"ns"`. Not given: seconds; what looks like another unit is refused.
        ignore_columns: Columns that are not read.
        rename: Name in the file -> `"time"` or the robot's name of the joint; of all joints at once a pattern:
            `"left_{joint}"`, `{"left_{joint}": "{joint}_l"}`, or `"q{index}"` for numbers in the robot's order.
        columns: Pattern of the columns of positions in a text table, e.g. `"position.{joint}"` or `"q[{index}]"`, where
            an index counts the robot's joints from 0 or 1; or two, the second of velocities. All other columns are
            left out, with a note. Not given: columns are called as the joints, or contain their names in one way only.
        joint_names: Names of the columns, in order, for files that have none (robomimic, some LeRobot data).
        topics: Topics of a bag; not given: all JointState topics that carry joints of the robot.
        rate: Samples per second [Hz], for files that have no time stamps; where there are some it overrules them.
        outside_limits: `"refuse"` (the default) or `"note"` positions far outside the joint limits.
        episodes: Which episodes to read: text such as `"0:50,60,75"` (counted from 0; 0:50 is 0 to 49) or numbers. Of a
            LeRobot data set they are numbers of episodes; else places of files in natural order.
        feature: Feature of a LeRobot data set that holds the joint positions, e.g.
            `"observation.state.joint_position"`; not given: `observation.state`.
        velocities: `"auto"` (the default): recorded velocities are used where they integrate to the positions at least
            as closely as derived ones; else those of all joints are derived when something is learnt, and a note says
            why. `"derive"`: always; `"recorded"`: never.
    """

    degrees: bool
    units: Units | None
    time_unit: TimeUnit | None
    ignore_columns: Sequence[str]
    rename: Mapping[str, str] | str
    columns: str | Sequence[str]
    joint_names: Sequence[str] | None
    topics: Sequence[str] | None
    rate: float | None
    outside_limits: Literal["refuse", "note"]
    episodes: str | int | Iterable[int] | None
    feature: str | None
    velocities: Velocities


def load_demonstrations(paths: Paths | Tables, robot: Robot, **options: Unpack[ReadOptions]) -> Demonstrations:
    """All demonstrations in some files, in the robot's joints, in rad (or m) and s.

    The format is recognised by content: CSV, NPZ, ROS 1 and ROS 2 bags, LeRobot, robomimic. Columns are matched to
    joints by name. Nothing is changed silently: `.notes` of the result reports what was left out, split or converted.

    Args:
        paths: A file, a folder of recordings of one format, or several of them; the name of recordings that come with
            this package, e.g. `"sawyer_drawer"`; or a data frame of pandas with the columns of a CSV file, or several
            (a column `trajectory` divides a frame).
        robot: The robot whose joints are read; joints that the recordings lack must be locked in it.
        **options: See `ReadOptions`.

    Raises:
        RecordingError: A recording that cannot be trusted: says where, what was seen and what to do.
        MissingExtraError: The format needs a library that is not installed.

    Example:
        >>> import manip_learn as ml
        >>> robot = ml.load_robot("planar3")
        >>> demos = ml.load_demonstrations("planar3_reach", robot)  # or a folder of your own
        >>> len(demos), demos[0].q.shape  # recordings; samples and joints of the first
        (20, (40, 3))
    """
    found: list[str] = []
    with frames_as_files(paths) as given:
        files, request, notes = open_recordings(given, robot, options)
        trajectories = tuple(read_recordings(files, request, found, together=True))
    return Demonstrations(trajectories, notes + refuse_unmatched(found))


def open_recordings(
    paths: Paths, robot: Robot, options: ReadOptions
) -> tuple[list[RecordingFile], ReadRequest, list[str]]:
    """Files to read, how they are read, and what was noticed.

    Raises:
        RecordingError: No robot, an option that is none, a joint to rename to that the robot does not have, no files.
    """
    if not isinstance(robot, Robot):
        raise RecordingError(f"call load_demonstrations(paths, robot): got {an(robot)} as the robot", code="type")
    fields = dict(options)
    degrees = fields.pop("degrees", False)
    unknown = sorted(set(fields) - set(ReadOptions.__annotations__))
    if unknown:
        text = f"there is no option {unknown[0]!r}; there are {', '.join(sorted(ReadOptions.__annotations__))}"
        raise RecordingError(text, code="option")
    fields["units_insisted"] = fields.get("units") is not None
    if degrees:
        if fields.get("units") not in (None, "degrees"):
            python, flags = f"degrees=True and units={fields['units']!r}", f"--degrees and --units {fields['units']}"
            raise RecordingError(advice("{} contradict each other: give one", python, flags), code="option")
        fields["units"] = "degrees"
    if fields.get("episodes") is not None:
        fields["episodes"] = EpisodeSelection.of(fields["episodes"])  # type: ignore[arg-type]
    request = ReadRequest(robot=robot, **fields)  # type: ignore[arg-type]
    robot = request.robot
    joints = [*robot.joint_names, *unmoved_joint_names(robot)]
    poses = [name + suffix for name in robot.objects for suffix in POSE_SUFFIXES]
    for old, new in request.new_names.items():
        ends = () if new in joints else ENDS  # a column such as `joint1_velocity` is about its joint
        base = next((new.removesuffix(s) for s in ends if new.endswith(s)), new)
        head, pattern, tail = new.partition(JOINT)
        fits = any(j.startswith(head) and j.endswith(tail) for j in joints) if pattern else False
        if not fits and base not in (*joints, *poses, *_ARRAYS):
            near = closest_names(base, joints) or joints
            which = f"{'did you mean' if near != joints else 'it has'} {', '.join(map(repr, near[:12]))}, or 'time'"
            text = f"robot {robot.name!r} has no joint {new!r}; {which}"
            raise RecordingError(advice("{}: ", *rename_words({old: new})) + text, code="option")
    files, said = recording_files(paths)
    files, request, note = select_episodes(files, request)
    return files, request, [printable(sentence) for sentence in (*said, note) if sentence]


def read_recordings(
    files: list[RecordingFile], request: ReadRequest, notes: list[str], *, together: bool = False
) -> Iterator[Trajectory]:
    """The trajectories in files, one after the other; sentences are added to `notes` at the end.

    Among them is an `UnmatchedOption` for each option that these files had no use for. Velocities are judged
    `together`, or those of each recording alone.

    Raises:
        RecordingError: As soon as a recording is found that cannot be trusted.
        MissingExtraError: The format needs a library that is not installed.
    """
    said: list[tuple[str, str]] = []
    request = replace(request, uses=OptionUses())
    recordings = (recording for file in files for recording in file.recordings(request))
    trajectories = validated(recordings, request, said)
    first = next(trajectories, None)
    if first is None:
        raise RecordingError(f"there is no demonstration in {', '.join(str(f.path) for f in files)}", code="empty")
    every = itertools.chain([first], trajectories)
    yield from judged_in_turn(every, request.robot, request.velocities, said, together=together)
    notes += folded_notes(said, request.robot)
    notes += request.unmatched()


def validated(
    recordings: Iterable[Recording], request: ReadRequest, said: list[tuple[str, str]]
) -> Iterator[Trajectory]:
    """The trajectories of recordings of any origin; notes are added to `said`, each with the name of its recording."""
    for recording in recordings:
        checked = validate(recording, request)
        said += [(recording.name, note) for note in checked.notes]
        yield from checked


def folded_notes(said: Iterable[tuple[str, str]], robot: Robot | None) -> list[str]:
    """Notes with the names of their recordings: the same finding in fifty of them is reported once, with the figures of
    the first.
    """
    names = "|".join(map(re.escape, sorted(robot.joint_names if robot else (), key=len, reverse=True)))
    by_text: dict[str, list[tuple[str, str]]] = {}
    for name, note in said:
        text = note
        if note.startswith("velocity of "):  # in which joints and numbers may differ
            text = _NUMBER.sub("#", re.sub(rf"(?<!\w)({names})(?!\w)", "#", note))
            text = re.sub(r"#((, | and )#)+| \(# likewise\)", "#", text)
        by_text.setdefault(text, []).append((name, note))
    out = []
    for found in by_text.values():
        name, text = found[0]
        alike = "" if all(other == text for _, other in found) else " with other figures"
        out.append(printable(f"{name}{f' and {len(found) - 1} more{alike}' if len(found) > 1 else ''}: {text}"))
    return out
