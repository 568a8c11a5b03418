"""All arguments and options of the command line, each written once: parser, help and the commands read them here.

A command is a frozen dataclass. The second paragraph of its docstring is an example that works. Each field is an
argument or an option of that name, unless it is a set of options that several commands share: then the fields of the
set stand in its place. `--help` explains the options before the first set, which a beginner needs, and `--help-all`
all of them. Only what a shell needs for `--help` is imported.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, final

from typer import Argument, Option

from manip_learn.errors import ManipLearnError, TargetError

if TYPE_CHECKING:  # so that `--help` stays quick
    from manip_learn.robot import Robot


def robot_completions(incomplete: str) -> list[str]:
    """Names of robots; where none begins so, the shell offers files."""
    from manip_learn.robot.description.catalogue import robot_names

    return [name for name in robot_names() if name.startswith(incomplete)]


def pair(flag: str, form: str, text: str, *, may_be_empty: bool = False, unnamed: bool = False) -> tuple[str, str]:
    """Both sides of the first equals sign.

    Raises:
        ManipLearnError: There is none, nothing before it, or nothing behind it where there must be something.
    """
    name, equals, value = text.partition("=")
    if not (name or unnamed) or not equals or not (value or may_be_empty):
        raise ManipLearnError(f"{flag} must be {form}, got {text!r}", code="option")
    return name, value


def vector(option: str, text: str | None) -> list[float] | None:
    """The numbers of an option's text; None if it was not given.

    Raises:
        ManipLearnError: Not finite numbers.
    """
    if text is None:
        return None
    try:
        numbers = [float(part) for part in text.strip("[]() ").replace(",", " ").split()]
    except ValueError as error:
        raise ManipLearnError(f"{option} must be numbers such as 0.1,-0.2,0.3, got {text!r}") from error
    if not numbers or not all(map(math.isfinite, numbers)):
        raise ManipLearnError(f"{option} must be finite numbers such as 0.1,-0.2,0.3, got {text!r}")
    return numbers


RobotName = Annotated[
    str, Argument(metavar="ROBOT", help="A name (see `robots`) or a URDF file.", autocompletion=robot_completions)
]
Recordings = Annotated[
    list[str], Argument(metavar="RECORDING...", help="Files, a folder of them, or shipped ones such as sawyer_drawer.")
]
ConstraintFile = Annotated[str, Argument(metavar="CONSTRAINT.JSON", help="Written by `learn --out`.")]
Start = Annotated[
    str | None, Option(help="Joint positions [rad], e.g. 0.1,-0.5,0; default: the first posture that was shown.")
]
Dask = Annotated[str | None, Option(help="Scheduler address, or local: work on a dask cluster.")]
Explain = Annotated[bool, Option("--explain", help="Say what the words in the tables mean.")]
Json = Annotated[bool, Option("--json", help="Print one JSON document and nothing else.")]


@final
@dataclass(frozen=True)
class RobotOptions:
    """How a robot is loaded, beside its name."""

    HEADING: ClassVar[str] = "Robot"

    lock: Annotated[list[str] | None, Option(help="Joint to hold still; repeatable.")] = None
    package_dir: Annotated[list[str] | None, Option(help="Folder that contains mesh packages.")] = None
    objects: Annotated[
        list[str] | None, Option("--object", help="Object whose pose is recorded (NAME.x ... NAME.rz); repeatable.")
    ] = None
    xacro: Annotated[bool, Option("--xacro", help="Expand the robot's xacro file, which runs its code.")] = False
    xacro_arg: Annotated[
        list[str] | None, Option(help="NAME=VALUE of an argument of the xacro file; implies --xacro.")
    ] = None

    def __post_init__(self) -> None:
        """Refuse an argument of the xacro file that is not NAME=VALUE."""
        self._xacro_values()

    def _xacro_values(self) -> dict[str, str]:
        return dict(pair("--xacro-arg", "NAME=VALUE", text, may_be_empty=True) for text in self.xacro_arg or ())

    @property
    def words(self) -> list[str]:
        """The options that were given, as they are typed."""
        given = {
            "lock": self.lock,
            "package-dir": self.package_dir,
            "object": self.objects,
            "xacro-arg": self.xacro_arg,
        }
        typed = [word for name, values in given.items() for value in values or () for word in (f"--{name}", value)]
        return [*typed, *(["--xacro"] if self.xacro else [])]

    def load(
        self,
        name: str,
        locked: Sequence[str] | Mapping[str, float | None] | None = None,
        objects: Sequence[str] | None = None,
    ) -> Robot:
        """The robot, with other joints locked or other objects if they are named."""
        from manip_learn.robot import load_robot

        return load_robot(
            name,
            tuple(self.package_dir or ()),
            tuple(self.lock or ()) if locked is None else locked,
            xacro=self._xacro_values() or self.xacro,
            objects=tuple(self.objects or ()) if objects is None else objects,
        )


@final
@dataclass(frozen=True)
class ReadingOptions:
    """How recordings are read."""

    HEADING: ClassVar[str] = "Reading recordings"

    degrees: Annotated[bool, Option("--degrees", help="The recordings are in degrees.")] = False
    units: Annotated[str | None, Option(help="Unit of the recorded angles: radians, degrees or normalised.")] = None
    time_unit: Annotated[str | None, Option(help="Unit of the time stamps: s, ms, us or ns.")] = None
    ignore_column: Annotated[list[str] | None, Option(help="Column to ignore; repeatable.")] = None
    rename: Annotated[
        list[str] | None, Option(help="NAME_IN_FILE=NAME_IN_ROBOT; 'left_{joint}' or 'q{index}' of all joints.")
    ] = None
    columns: Annotated[
        list[str] | None,
        Option(help="Pattern of the columns, 'position.{joint}' or 'q[{index}]'; given twice: velocities."),
    ] = None
    joint_names: Annotated[str | None, Option(help="Column names, in order, for files without names.")] = None
    topic: Annotated[list[str] | None, Option(help="Topic of a bag; default: all with joints.")] = None
    rate: Annotated[float | None, Option(help="Samples per second; overrules time stamps.")] = None
    velocities: Annotated[
        str | None, Option(help="auto, derive: from the positions; recorded: recorded ones as they are.")
    ] = None
    outside_limits: Annotated[str | None, Option(help="Samples far outside the limits: refuse or note.")] = None
    episodes: Annotated[
        str | None, Option(help="Episodes (LeRobot) or files in order to read, counted from 0, e.g. 0:50,60,75.")
    ] = None
    feature: Annotated[str | None, Option(help="LeRobot feature that holds the joint positions.")] = None

    def __post_init__(self) -> None:
        """Refuse a renaming that is not FILE_NAME=ROBOT_NAME; the reader checks all other values."""
        self.keywords()

    def keywords(self) -> dict[str, Any]:
        """Keywords of `load_demonstrations`; what was not given is left out."""
        form = "NAME_IN_FILE=NAME_IN_ROBOT, or a pattern such as 'left_{joint}'"
        pairs = [
            (text, "{joint}") if "{" in text and "=" not in text else pair("--rename", form, text, unnamed=True)
            for text in self.rename or ()
        ]
        own = {"ignore_column": "ignore_columns", "topic": "topics"}  # what the flags are called there
        given = {own.get(name, name): value for name, value in vars(self).items()} | {
            "degrees": self.degrees or None,
            "rename": dict(pairs) or None,
            "joint_names": self.joint_names.replace(",", " ").split() if self.joint_names else None,
        }
        return {key: value for key, value in given.items() if value is not None and value != []}


SceneFile = Annotated[
    str | None,
    Option(metavar="FILE", help="What stands around (JSON, URDF, MJCF); none: nothing. Else a floor is assumed."),
]


@final
@dataclass(frozen=True)
class PlanOptions:
    """How a way is planned: the posture in which to take hold is chosen so that the whole way can be done."""

    HEADING: ClassVar[str] = "Plan"

    plan: Annotated[
        bool, Option("--plan", help="Choose the posture in which to take hold, so that all of it can be done.")
    ] = False
    seed: Annotated[int, Option(help="Random seed of the search.")] = 0
    scene: SceneFile = None

    def __post_init__(self) -> None:
        """Refuse options of a plan without `--plan`."""
        if not self.plan and (self.seed, self.scene) != (0, None):
            raise TargetError("--seed and --scene go with --plan")


@final
@dataclass(frozen=True)
class RobotsOptions:
    """List the robots that can be named, with their joints.

    manip-learn robots
    """

    as_json: Json = False


@final
@dataclass(frozen=True)
class DemoOptions:
    """Learn from shipped recordings; open the drawer from one bad start without and with what was learnt, in a replay.

    manip-learn demo
    """

    robot: Annotated[str, Option(help="sawyer or planar3.")] = "sawyer"
    out: Annotated[Path, Option(help="Folder for the results.")] = Path("demo_out")
    all_policies: Annotated[
        bool, Option("--all-policies", help="Compare a plan and the policies manipulability, attractor and zero.")
    ] = False
    browser: Annotated[bool, Option("--browser/--no-browser", help="Open the replay.")] = True
    explain: Explain = False
    as_json: Json = False


@final
@dataclass(frozen=True)
class InspectOptions:
    """Show joints, frames, limits and warnings of a robot.

    manip-learn inspect ur5e
    """

    robot: RobotName
    loading: RobotOptions = RobotOptions()
    as_json: Json = False


@final
@dataclass(frozen=True)
class LearnOptions:
    """Learn a constraint from recordings and report it.

    manip-learn learn sawyer sawyer_drawer --frame right_gripper_tip --out task.json
    """

    robot: RobotName
    recordings: Recordings
    frame: Annotated[str | None, Option(help="The frame that was guided, e.g. the tool's tip.")] = None
    axes: Annotated[str, Option(help="xyz, pose, planar, rotation, or any of 'x y z rx ry rz'.")] = "xyz"
    out: Annotated[Path | None, Option(help="Constraint file to write (JSON).")] = None
    html: Annotated[Path | None, Option(help="Replay of the recordings to write, with their phases.")] = None
    loading: RobotOptions = RobotOptions()
    reading: ReadingOptions = ReadingOptions()
    relative_to: Annotated[str | None, Option(help="Frame, e.g. an object, from which it is seen.")] = None
    reference: Annotated[str, Option(help="world, local, or auto (the larger gap).")] = "auto"
    constraints: Annotated[int | None, Option(help="Number of constraints; default: from the data.")] = None
    estimator: Annotated[str, Option(help="auto, null-space, joint or separate.")] = "auto"
    phases: Annotated[
        str, Option(help="auto: find the stretches in which a constraint holds; off: take recordings as a whole.")
    ] = "auto"
    mechanism: Annotated[str, Option(help="auto: say what holds the hand (hinge, line, ...); off.")] = "auto"
    strength: Annotated[float | None, Option(help="Minimum strength of evidence for a row; default: 1.8.")] = None
    habits: Annotated[bool, Option("--habits", help="Also learn rows that may be kept by the way of moving only.")] = (
        False
    )
    zeros: Annotated[
        float, Option(help="How far the joints' zeros may be off [deg, 68 %]; 1 for arms of hobby servos.")
    ] = 0.1
    links: Annotated[float, Option(help="How far the links may be off their description [mm and mrad, 68 %].")] = 0.5
    start: Annotated[float | None, Option("--from", help="Leave out what was recorded before [s].")] = None
    until: Annotated[float | None, Option(help="Leave out what was recorded after [s].")] = None
    seed: Annotated[int, Option(help="Seed of the bootstrap and of random starts.")] = 0
    dask: Dask = None
    explain: Explain = False
    as_json: Json = False


@final
@dataclass(frozen=True)
class AuditOptions:
    """Judge recorded episodes by a constraint: rank them, and name those to leave out.

    manip-learn audit sawyer task.json sawyer_drawer
    """

    robot: RobotName
    constraint: ConstraintFile
    recordings: Recordings
    csv: Annotated[Path | None, Option(help="Table to write, one line per episode (CSV).")] = None
    loading: RobotOptions = RobotOptions()
    reading: ReadingOptions = ReadingOptions()
    dask: Dask = None
    explain: Explain = False
    as_json: Json = False


@final
@dataclass(frozen=True)
class ControlOptions:
    """Do the task that was learnt: along what is free, or to a point, clear of the task's singularities.

    manip-learn control sawyer task.json --along 0.2 --out run.npz
    """

    robot: RobotName
    constraint: ConstraintFile
    start: Start = None
    along: Annotated[
        float | None, Option(help="Way along a line or a plane [m], positive as it was shown; default: all as shown.")
    ] = None
    turn: Annotated[
        float | None, Option(help="Angle about a hinge, a screw or a ball [degrees], positive as it was shown.")
    ] = None
    target: Annotated[str | None, Option(help="Point to go to, one value per axis [m or rad].")] = None
    out: Annotated[Path | None, Option(help="Rollout file to write: .npz, .csv or .mcap (for ROS).")] = None
    html: Annotated[Path | None, Option(help="Replay to write.")] = None
    planned: PlanOptions = PlanOptions()
    loading: RobotOptions = RobotOptions()
    direction: Annotated[
        str | None, Option(help="Direction of the way, where several are free: x,y,z; or shown, or back.")
    ] = None
    beyond_shown: Annotated[bool, Option("--beyond-shown", help="Allow a way farther than was shown.")] = False
    speed: Annotated[float | None, Option(help="Speed of the hand [m/s], or of a turn [degrees/s].")] = None
    keep_orientation: Annotated[bool, Option("--keep-orientation", help="Keep the orientation of the hand.")] = False
    rows: Annotated[str, Option(help="all: go to the target; held: its held rows only (the paper).")] = "all"
    policy: Annotated[str, Option(help="manipulability, zero or attractor.")] = "manipulability"
    rest: Annotated[str | None, Option(help="Rest posture of the attractor [rad].")] = None
    gain: Annotated[float, Option(help="Gain of the policy.")] = 3.0
    task_gain: Annotated[float, Option(help="Gain of the task [1/s].")] = 1.0
    duration: Annotated[float | None, Option(help="Duration [s]; default: of the way, else 5.")] = None
    dt: Annotated[float, Option(help="Time step [s].")] = 0.01
    inverse: Annotated[str, Option(help="damped, exact or truncated.")] = "damped"
    tolerance: Annotated[float, Option(help="Distance to the target that counts as reached [m or rad].")] = 0.01
    check: Annotated[bool, Option("--check", help="Write nothing and refuse if it gets less far.")] = False
    explain: Explain = False
    as_json: Json = False


@final
@dataclass(frozen=True)
class RepeatOptions:
    """Do again all that the recordings show: take hold, go the way, let go, the next one, and retreat.

    manip-learn repeat sawyer task.json --html run.html
    """

    robot: RobotName
    task: Annotated[str, Argument(metavar="TASK", help="Written by `learn --out`.")]
    start: Start = None
    moved: Annotated[
        str | None, Option(help="The fixtures stand elsewhere: x,y,z[,rx,ry,rz] (m, degrees about the base's axes).")
    ] = None
    tip_speed: Annotated[
        str, Option(help="Largest speed of the tip [m/s]; shown: as it was shown, however fast; none: no limit.")
    ] = "0.25"
    prefer: Annotated[
        str, Option(help="shown: as in a recording; room: in the posture that leaves most room for the way.")
    ] = "shown"
    out: Annotated[Path | None, Option(help="Rollout file to write: .npz, .csv or .mcap (for ROS).")] = None
    html: Annotated[Path | None, Option(help="Replay to write.")] = None
    loading: RobotOptions = RobotOptions()
    scene: SceneFile = None
    seed: Annotated[int, Option(help="Random seed of the plans.")] = 0
    as_json: Json = False


@final
@dataclass(frozen=True)
class ReplayOptions:
    """Write a browser replay with the manipulability plot: one file, no server, no network.

    manip-learn replay run.npz --open
    """

    files: Annotated[
        list[str],
        Argument(
            metavar="[ROBOT] FILE...",
            help="Rollouts of `control --out`, which know their robot; or a robot and recordings.",
            autocompletion=robot_completions,
        ),
    ]
    html: Annotated[Path, Option(help="File to write.")] = Path("replay.html")
    open_browser: Annotated[bool, Option("--open", help="Open it in the browser.")] = False
    constraint: Annotated[
        Path | None, Option(help="Constraint file: show the phases and the mechanism that were learnt with it.")
    ] = None
    loading: RobotOptions = RobotOptions()
    reading: ReadingOptions = ReadingOptions()
    tip: Annotated[str | None, Option(help="Frame whose path is drawn.")] = None
    as_json: Json = False


@final
@dataclass(frozen=True)
class ExportOptions:
    """Write recordings or rollouts in other formats, or a learnt task for a controller of force or stiffness.

    manip-learn export sawyer run.npz --out run.csv
    """

    robot: RobotName
    files: Annotated[
        list[str], Argument(metavar="FILE...", help="Recordings or rollouts, a folder of them, or a constraint file.")
    ]
    out: Annotated[
        Path,
        Option(help="A file (.mcap, .csv, .yaml: a JointTrajectory), or a folder: LeRobot, or what --to says."),
    ]
    to: Annotated[
        str | None,
        Option(
            help="mcap, csv, lerobot or trajectory: format of the files in a folder; urscript, stiffness, moveit "
            "or json: a constraint for force mode, for impedance control, as path constraints, or its task frame."
        ),
    ] = None
    at: Annotated[
        str | None,
        Option(help="Posture of the task frame [rad]; default: the middle one of those shown, else the neutral one."),
    ] = None
    loading: RobotOptions = RobotOptions()
    reading: ReadingOptions = ReadingOptions()
    as_json: Json = False


@final
@dataclass(frozen=True)
class RecordOptions:
    """Record motions that are shown by hand, a file each, and say what can be learnt from them.

    manip-learn record my_arm.py:driver --robot ur5e --frame tool0
    """

    driver: Annotated[
        str, Argument(metavar="DRIVER", help="FILE.py:NAME or package.module:NAME: a driver, or what makes one.")
    ]
    out: Annotated[Path, Option(help="Folder of the recordings.")] = Path("demos")
    name: Annotated[str, Option(help="Name of the recordings: NAME_01.csv and so on.")] = "demo"
    robot: Annotated[str | None, Option(help="Robot to show and to learn for.", autocompletion=robot_completions)] = (
        None
    )
    frame: Annotated[str | None, Option(help="The frame that is guided, e.g. the tool's tip.")] = None
    motions: Annotated[int | None, Option(help="Number of motions to record; default: until Ctrl-C.")] = None
    loading: RobotOptions = RobotOptions()
    by: Annotated[str, Option(help="motion: from motion to rest; key: Enter begins and ends, q leaves.")] = "motion"
    duration: Annotated[float | None, Option(help="Longest time to wait for all of them [s].")] = None
    no_release: Annotated[bool, Option("--no-release", help="Leave the arm's torque on.")] = False
    no_browser: Annotated[bool, Option("--no-browser", help="Do not open the live picture.")] = False
    as_json: Json = False


@final
@dataclass(frozen=True)
class TeachOptions:
    """Teach a simulated arm in the browser: take it by the hand, show it a task, watch it do it.

    manip-learn teach
    """

    robot: Annotated[str, Argument(metavar="ROBOT", help="Which robot to teach.", autocompletion=robot_completions)] = (
        "sawyer"
    )
    frame: Annotated[str | None, Option(help="The frame that takes hold, e.g. the tool's tip.")] = None
    scene: Annotated[str, Option(help="First scene: drawer, door, loose-door, table or free.")] = "drawer"
    out: Annotated[Path, Option(help="Folder for recordings and what is learnt.")] = Path("taught")
    seed: Annotated[
        int | None, Option(help="Random seed for the scene; by default the first scenes are always the same.")
    ] = None
    no_browser: Annotated[bool, Option("--no-browser", help="Print the page's address, and do not open it.")] = False
    loading: RobotOptions = RobotOptions()
    as_json: Json = False


@final
@dataclass(frozen=True)
class ReproduceOptions:
    """Run the experiments of "Learning Singularity Avoidance", and compare with the printed numbers.

    manip-learn reproduce table --trials 2
    """

    experiment: Annotated[str, Argument(help="table, rmse, singular-start, near-singular-start, sawyer or all.")]
    trials: Annotated[int, Option(help="Number of repetitions; the paper has 50.")] = 50
    seed: Annotated[int, Option(help="Random seed; the same seed gives the same numbers.")] = 0
    out: Annotated[Path | None, Option(help="Folder for numbers and figures.")] = None
    workers: Annotated[int | None, Option(help="Number of processes; default: all cores.")] = None
    as_json: Json = False
