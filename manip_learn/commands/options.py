"""All arguments and options of the command line, each written once: parser, help and the commands read them here.

The second paragraph of a command's docstring is an example that works. Each field is an argument or an option of that
name, and its help stands under `Attributes:`, here or in its class. A command has the options of the classes that it
inherits, under their headings. `--help` explains the options that are not keywords only, which a beginner needs, and
`--help-all` all of them. Only what a shell needs for `--help` is imported.

Attributes:
    robot: A name (see `robots`) or a URDF file.
    task: Written by `learn --out`.
    start: Joint positions [rad], e.g. 0.1,-0.5,0; default: the first posture that was shown.
    out: Rollout file to write: .npz, .csv or .mcap (for ROS).
    html: Replay to write.
"""

from __future__ import annotations

import inspect
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import KW_ONLY, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, dataclass_transform

from typer import Argument, Context, Option, echo

from manip_learn.commands.command_line import HELP_ALL
from manip_learn.errors import ManipLearnError

if TYPE_CHECKING:  # so that `--help` stays quick
    from manip_learn.robot import Robot

Locks = Mapping[str, float | None]  # joint -> position at which it is held still; None for its neutral one
# as it is typed -> file in `commands` and function that does the work, and its options, whose docstring is the help
COMMANDS: dict[str, tuple[str, type[Any]]] = {}


def _explain_all(context: Context, asked: bool) -> None:
    """Print the help with all options, if it was asked for."""
    if asked and not context.resilient_parsing:
        context.meta[HELP_ALL] = True
        echo(context.get_help())
        context.exit()


@dataclass_transform(frozen_default=True)
@dataclass(frozen=True, kw_only=True)
class Options:
    """Output.

    A class of options is a frozen dataclass. One that names its work is a command, which is called as the class.

    Attributes:
        as_json: Print one JSON document and nothing else.
        help_all: Explain all options.
    """

    as_json: Annotated[bool, Option("--json")] = False
    help_all: Annotated[bool, Option("--help-all", is_eager=True, callback=_explain_all)] = False

    def __init_subclass__(cls, work: str = "", kw_only: bool = False) -> None:
        """Make a class of options.

        Args:
            work: File in `commands` and function: options and progress -> an `Answer`; empty for a set of options.
            kw_only: `--help` does not explain them.
        """
        dataclass(frozen=True, kw_only=kw_only)(cls)
        if work:
            COMMANDS[cls.__name__.removesuffix("Options").lower()] = work, cls


class ExplainedOptions(Options, kw_only=True):
    """Output.

    Attributes:
        explain: Say what the words in the tables mean.
    """

    explain: bool = False


def robot_completions(incomplete: str) -> list[str]:
    """Return names of robots; where none begins so, the shell offers files."""
    from manip_learn.robot.description.catalogue import robot_names

    return [name for name in robot_names() if name.startswith(incomplete)]


def pairs(flag: str, form: str, pattern: str, texts: Sequence[str]) -> dict[str, str]:
    """Return the sides of the first equals sign of each text.

    Args:
        flag: The option, for the sentence that refuses a text.
        form: What a text must be, in words.
        pattern: The same as a regular expression.
        texts: Values of the option.

    Raises:
        ManipLearnError: A text of another form.
    """
    for text in texts:
        if not re.fullmatch(pattern, text, re.DOTALL):
            raise ManipLearnError(f"{flag} must be {form}, got {text!r}", code="option")
    return {name: value for name, _, value in (text.partition("=") for text in texts)}


def vector(option: str, text: str | None) -> list[float] | None:
    """Return the numbers of an option's text; None if it was not given.

    Raises:
        ManipLearnError: Not finite numbers.
    """
    if text is None:
        return None
    try:
        numbers = [float(part) for part in text.strip("[]() ").replace(",", " ").split()]
    except ValueError:
        numbers = []
    if not numbers or not all(map(math.isfinite, numbers)):
        raise ManipLearnError(f"{option} must be finite numbers such as 0.1,-0.2,0.3, got {text!r}")
    return numbers


class RobotOptions(Options, kw_only=True):
    """Robot.

    Attributes:
        lock: Joint to hold still; repeatable.
        package_dir: Folder that contains mesh packages.
        objects: Object whose pose is recorded (NAME.x ... NAME.rz); repeatable.
        xacro: Expand the robot's xacro file, which runs its code.
        xacro_arg: NAME=VALUE of an argument of the xacro file; implies --xacro.
    """

    lock: list[str] | None = None
    package_dir: list[str] | None = None
    objects: Annotated[list[str] | None, Option("--object")] = None
    xacro: bool = False
    xacro_arg: list[str] | None = None

    @property
    def words(self) -> list[str]:
        """The options that were given, as they are typed."""
        given = {"--lock": self.lock, "--package-dir": self.package_dir, "--object": self.objects}
        given["--xacro-arg"] = self.xacro_arg
        typed = [word for flag, values in given.items() for value in values or () for word in (flag, value)]
        return [*typed, *(["--xacro"] if self.xacro else [])]

    def load(self, name: str, locked: Locks | None = None, objects: Sequence[str] | None = None) -> Robot:
        """Load the robot, with other joints locked or other objects if they are named."""
        from manip_learn.robot import load_robot

        locks = dict.fromkeys(self.lock or ()) if locked is None else locked
        seen = tuple(self.objects or ()) if objects is None else objects
        values = pairs("--xacro-arg", "NAME=VALUE", "[^=]+=.*", self.xacro_arg or ())
        return load_robot(name, tuple(self.package_dir or ()), locks, xacro=values or self.xacro, objects=seen)


class NamedRobotOptions(RobotOptions):
    """Robot."""

    robot: Annotated[str, Argument(metavar="ROBOT", autocompletion=robot_completions)]


class ConstraintOptions(NamedRobotOptions):
    """Robot.

    Attributes:
        constraint: Written by `learn --out`.
    """

    constraint: Annotated[str, Argument(metavar="CONSTRAINT.JSON")]


class ReadingOptions(Options, kw_only=True):
    """Reading recordings.

    Attributes:
        degrees: The recordings are in degrees.
        units: Unit of the recorded angles: radians, degrees or normalised.
        time_unit: Unit of the time stamps: s, ms, us or ns.
        ignore_columns: Column to ignore; repeatable.
        rename: NAME_IN_FILE=NAME_IN_ROBOT; 'left_{joint}' or 'q{index}' of all joints.
        columns: Pattern of the columns, 'position.{joint}' or 'q[{index}]'; given twice: velocities.
        joint_names: Column names, in order, for files without names.
        topics: Topic of a bag; default: all with joints.
        rate: Samples per second; overrules time stamps.
        velocities: auto, derive: from the positions; recorded: recorded ones as they are.
        outside_limits: Samples far outside the limits: refuse or note.
        episodes: Episodes (LeRobot) or files in order to read, counted from 0, e.g. 0:50,60,75.
        feature: LeRobot feature that holds the joint positions.
    """

    degrees: bool = False
    units: str | None = None
    time_unit: str | None = None
    ignore_columns: Annotated[list[str] | None, Option("--ignore-column")] = None
    rename: list[str] | None = None
    columns: list[str] | None = None
    joint_names: str | None = None
    topics: Annotated[list[str] | None, Option("--topic")] = None
    rate: float | None = None
    velocities: str | None = None
    outside_limits: str | None = None
    episodes: str | None = None
    feature: str | None = None

    def keywords(self) -> dict[str, Any]:
        """Keywords of `load_demonstrations`; what was not given is left out."""
        form = "NAME_IN_FILE=NAME_IN_ROBOT, or a pattern such as 'left_{joint}'"
        # a pattern alone names the joints as the robot does
        names = [text if "=" in text or "{" not in text else f"{text}={{joint}}" for text in self.rename or ()]
        given = {name: getattr(self, name) for name in inspect.get_annotations(ReadingOptions)} | {
            "degrees": self.degrees or None,
            "rename": pairs("--rename", form, "[^=]*=.+", names) or None,
            "joint_names": self.joint_names.replace(",", " ").split() if self.joint_names else None,
        }
        return {key: value for key, value in given.items() if value is not None and value != []}


class RecordingsOptions(ReadingOptions):
    """Options.

    Attributes:
        recordings: Files, a folder of them, or shipped ones such as sawyer_drawer.
        dask: Scheduler address, or local: work on a dask cluster.
    """

    recordings: Annotated[list[str], Argument(metavar="RECORDING...")]
    _: KW_ONLY
    dask: str | None = None


class SearchOptions(Options, kw_only=True):
    """Plan.

    Attributes:
        scene: What stands around (JSON, URDF, MJCF); none: nothing. Else a floor is assumed.
        seed: Random seed of the search.
    """

    scene: Annotated[str | None, Option(metavar="FILE")] = None
    seed: int = 0


class PlanOptions(SearchOptions, kw_only=True):
    """Plan.

    Attributes:
        plan: Choose the posture in which to take hold, so that all of it can be done.
    """

    plan: bool = False


class RobotsOptions(Options, work="robots.known_robots"):
    """List the robots that can be named, with their joints.

    manip-learn robots
    """


class DemoOptions(ExplainedOptions, work="demo.demo"):
    """Learn from shipped recordings; open the drawer from one bad start without and with what was learnt, in a replay.

    manip-learn demo

    Attributes:
        robot: sawyer or planar3.
        out: Folder for the results.
        all_policies: Compare a plan and the policies manipulability, attractor and zero.
        browser: Open the replay.
    """

    robot: str = "sawyer"
    out: Path = Path("demo_out")
    all_policies: bool = False
    browser: Annotated[bool, Option("--browser/--no-browser")] = True


class InspectOptions(NamedRobotOptions, work="robots.inspect"):
    """Show joints, frames, limits and warnings of a robot.

    manip-learn inspect ur5e
    """


class RecordOptions(RobotOptions, work="record.record_motions"):
    """Record motions that are shown by hand, a file each, and say what can be learnt from them.

    manip-learn record my_arm.py:driver --robot ur5e --frame tool0

    Attributes:
        driver: FILE.py:NAME or package.module:NAME: a driver, or what makes one.
        out: Folder of the recordings.
        name: Name of the recordings: NAME_01.csv and so on.
        robot: Robot to show and to learn for.
        frame: The frame that is guided, e.g. the tool's tip.
        motions: Number of motions to record; default: until Ctrl-C.
        by: motion: from motion to rest; key: Enter begins and ends, q leaves.
        duration: Longest time to wait for all of them [s].
        no_release: Leave the arm's torque on.
        no_browser: Do not open the live picture.
    """

    driver: Annotated[str, Argument(metavar="DRIVER")]
    out: Path = Path("demos")
    name: str = "demo"
    robot: Annotated[str | None, Option(autocompletion=robot_completions)] = None
    frame: str | None = None
    motions: int | None = None
    _: KW_ONLY
    by: str = "motion"
    duration: float | None = None
    no_release: bool = False
    no_browser: bool = False


class TeachOptions(RobotOptions, work="teach.teach"):
    """Teach a simulated arm in the browser: take it by the hand, show it a task, watch it do it.

    manip-learn teach

    Attributes:
        robot: Which robot to teach.
        frame: The frame that takes hold, e.g. the tool's tip.
        scene: First scene: drawer, door, loose-door or table.
        out: Folder for recordings and what is learnt.
        seed: Random seed for the scene; by default the first scenes are always the same.
        no_browser: Print the page's address, and do not open it.
    """

    robot: Annotated[str, Argument(metavar="ROBOT", autocompletion=robot_completions)] = "sawyer"
    frame: str | None = None
    scene: str = "drawer"
    out: Path = Path("taught")
    seed: int | None = None
    no_browser: bool = False


class LearnOptions(RecordingsOptions, NamedRobotOptions, ExplainedOptions, work="learn.learn_task"):
    """Learn a constraint from recordings and report it.

    manip-learn learn sawyer sawyer_drawer --frame right_gripper_tip --out task.json

    Attributes:
        frame: The frame that was guided, e.g. the tool's tip.
        axes: xyz, pose, planar, rotation, or any of 'x y z rx ry rz'.
        out: Constraint file to write (JSON).
        html: Replay of the recordings to write, with their phases.
        relative_to: Frame, e.g. an object, from which it is seen.
        reference: world, local, or auto (the larger gap).
        n_constraints: Number of constraints; default: from the data.
        estimator: auto, null-space, joint or separate.
        phases: auto: find the stretches in which a constraint holds; off: take recordings as a whole.
        mechanism: auto: say what holds the hand (hinge, line, ...); off.
        strength: Minimum strength of evidence for a row; default: 1.8.
        keep_habits: Also learn rows that may be kept by the way of moving only.
        joint_offset_std: How far the joints' zeros may be off [deg, 68 %]; 1 for arms of hobby servos.
        link_error_std: How far the links may be off their description [mm and mrad, 68 %].
        start: Leave out what was recorded before [s].
        until: Leave out what was recorded after [s].
        seed: Seed of the bootstrap and of random starts.
    """

    frame: str | None = None
    axes: str = "xyz"
    out: Path | None = None
    html: Path | None = None
    _: KW_ONLY
    relative_to: str | None = None
    reference: str = "auto"
    n_constraints: Annotated[int | None, Option("--constraints")] = None
    estimator: str = "auto"
    phases: str = "auto"
    mechanism: str = "auto"
    strength: float | None = None
    keep_habits: Annotated[bool, Option("--habits")] = False
    joint_offset_std: Annotated[float, Option("--zeros")] = 0.1
    link_error_std: Annotated[float, Option("--links")] = 0.5
    start: Annotated[float | None, Option("--from")] = None
    until: float | None = None
    seed: int = 0


class AuditOptions(RecordingsOptions, ConstraintOptions, ExplainedOptions, work="audit.audit"):
    """Judge recorded episodes by a constraint: rank them, and name those to leave out.

    manip-learn audit sawyer task.json sawyer_drawer

    Attributes:
        csv: Table to write, one line per episode (CSV).
    """

    csv: Path | None = None


class ControlOptions(ConstraintOptions, PlanOptions, ExplainedOptions, work="control.control"):
    """Do the task that was learnt: along what is free, or to a point, clear of the task's singularities.

    manip-learn control sawyer task.json --along 0.2 --out run.npz

    Attributes:
        along: Way along a line or a plane [m], positive as it was shown; default: all as shown.
        turn: Angle about a hinge, a screw or a ball [degrees], positive as it was shown.
        target: Point to go to, one value per axis [m or rad].
        direction: Direction of the way, where several are free: x,y,z; or shown, or back.
        beyond_shown: Allow a way farther than was shown.
        speed: Speed of the hand [m/s], or of a turn [degrees/s].
        keep_orientation: Keep the orientation of the hand.
        rows: all: go to the target; held: its held rows only (the paper).
        policy: manipulability, zero or attractor.
        rest: Rest posture of the attractor [rad].
        gain: Gain of the policy.
        task_gain: Gain of the task [1/s].
        duration: Duration [s]; default: of the way, else 5.
        dt: Time step [s].
        inverse: damped, exact or truncated.
        tolerance: Distance to the target that counts as reached [m or rad].
        check: Write nothing and refuse if it gets less far.
    """

    start: str | None = None
    along: float | None = None
    turn: float | None = None
    target: str | None = None
    out: Path | None = None
    html: Path | None = None
    _: KW_ONLY
    direction: str | None = None
    beyond_shown: bool = False
    speed: float | None = None
    keep_orientation: bool = False
    rows: str = "all"
    policy: str = "manipulability"
    rest: str | None = None
    gain: float = 3.0
    task_gain: float = 1.0
    duration: float | None = None
    dt: float = 0.01
    inverse: str = "damped"
    tolerance: float = 0.01
    check: bool = False


class RepeatOptions(NamedRobotOptions, SearchOptions, work="repeat.repeat_skill"):
    """Do again all that the recordings show: take hold, go the way, let go, the next one, and retreat.

    manip-learn repeat sawyer task.json --html run.html

    Attributes:
        moved: The fixtures stand elsewhere: x,y,z[,rx,ry,rz] (m, degrees about the base's axes).
        tip_speed: Largest speed of the tip [m/s]; shown: as it was shown, however fast; none: no limit.
        prefer: shown: as in a recording; room: in the posture that leaves most room for the way.
        seed: Random seed of the plans.
    """

    task: Annotated[str, Argument(metavar="TASK")]
    start: str | None = None
    moved: str | None = None
    tip_speed: str = "0.25"
    prefer: str = "shown"
    out: Path | None = None
    html: Path | None = None


class ReplayOptions(ReadingOptions, RobotOptions, work="replay.replay_files"):
    """Write a browser replay with the manipulability plot: one file, no server, no network.

    manip-learn replay run.npz --open

    Attributes:
        files: Rollouts of `control --out`, which know their robot; or a robot and recordings.
        html: File to write.
        open_browser: Open it in the browser.
        constraint: Constraint file: show the phases and the mechanism that were learnt with it.
        tip: Frame whose path is drawn.
    """

    files: Annotated[list[str], Argument(metavar="[ROBOT] FILE...", autocompletion=robot_completions)]
    html: Path = Path("replay.html")
    open_browser: Annotated[bool, Option("--open")] = False
    constraint: Path | None = None
    _: KW_ONLY
    tip: str | None = None


class ExportOptions(ReadingOptions, NamedRobotOptions, work="export.export"):
    """Write recordings or rollouts in other formats, or a learnt task for a controller of force or stiffness.

    manip-learn export sawyer run.npz --out run.csv

    Attributes:
        files: Recordings or rollouts, a folder of them, or a constraint file.
        out: A file (.mcap, .csv, .yaml: a JointTrajectory), or a folder: LeRobot, or what --to says.
        to: mcap, csv, lerobot or trajectory: format of the files in a folder; urscript, stiffness, moveit or json: a
            constraint for force mode, for impedance control, as path constraints, or its task frame.
        at: Posture of the task frame [rad]; default: the middle one of those shown, else the neutral one.
    """

    files: Annotated[list[str], Argument(metavar="FILE...")]
    out: Path
    to: str | None = None
    at: str | None = None


class ReproduceOptions(Options, work="reproduce.reproduce_paper"):
    """Run the experiments of "Learning Singularity Avoidance", and compare with the printed numbers.

    manip-learn reproduce table --trials 2

    Attributes:
        experiment: table, rmse, singular-start, near-singular-start, sawyer or all.
        trials: Number of repetitions; the paper has 50.
        seed: Random seed; the same seed gives the same numbers.
        out: Folder for numbers and figures.
        workers: Number of processes; default: all cores.
    """

    experiment: Annotated[str, Argument()]
    trials: int = 50
    seed: int = 0
    out: Path | None = None
    workers: int | None = None
