"""All arguments and options of the command line, each written once: parser, help and the commands read them here.

The second paragraph of a command's docstring is an example that works. Each field is an argument or an option of that
name, and its help is under `Attributes:`, here or in its class. A command has the options of the classes that it
inherits, under their headings. `--help` explains the options that are not keyword-only, for beginners, and `--help-all`
explains all of them. Only imports that a shell needs for `--help` are made.

Attributes:
    robot: Robot name (see `robots`) or URDF file.
    task: Task file from `learn --out`.
    start: Start joint positions [rad], e.g. 0.1,-0.5,0. Default: first demonstrated posture.
    out: Rollout file to write: .npz, .csv or .mcap (for ROS).
    html: HTML replay to write.
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

if TYPE_CHECKING:  # keeps `--help` fast
    from manip_learn.robot import Robot

Locks = Mapping[str, float | None]  # joint -> position at which it is locked; None for its neutral position
# name of a command -> file in `commands` and function, and the class of its options, whose docstring is the help
COMMANDS: dict[str, tuple[str, type[Any]]] = {}


def _explain_all(context: Context, asked: bool) -> None:
    """Print the help with all options, if it was requested."""
    if asked and not context.resilient_parsing:
        context.meta[HELP_ALL] = True
        echo(context.get_help())
        context.exit()


@dataclass_transform(frozen_default=True)
@dataclass(frozen=True, kw_only=True)
class Options:
    """Output.

    A class of options is a frozen dataclass. A class with a `work` function is a command with the name of the class.

    Attributes:
        as_json: Print one JSON document and nothing else.
        help_all: Show the help of all options.
    """

    as_json: Annotated[bool, Option("--json")] = False
    help_all: Annotated[bool, Option("--help-all", is_eager=True, callback=_explain_all)] = False

    def __init_subclass__(cls, work: str = "", kw_only: bool = False) -> None:
        """Make a class of options.

        Args:
            work: File in `commands` and function: options and progress -> an `Answer`; empty for a set of options.
            kw_only: True if `--help` does not explain them.
        """
        dataclass(frozen=True, kw_only=kw_only)(cls)
        if work:
            COMMANDS[cls.__name__.removesuffix("Options").lower()] = work, cls


class ExplainedOptions(Options, kw_only=True):
    """Output.

    Attributes:
        explain: Explain the terms used in the tables.
    """

    explain: bool = False


def robot_completions(incomplete: str) -> list[str]:
    """Return the names of robots that begin with a text; the shell offers files if there are none.

    Args:
        incomplete: Text typed so far.
    """
    from manip_learn.robot.description.catalogue import robot_names

    return [name for name in robot_names() if name.startswith(incomplete)]


def pairs(flag: str, form: str, pattern: str, texts: Sequence[str]) -> dict[str, str]:
    """Return the sides of the first equals sign of each text.

    Args:
        flag: Name of the option, for the error.
        form: Form of a valid text, in words.
        pattern: The same as a regular expression.
        texts: Values of the option.

    Returns:
        Left side -> right side.

    Raises:
        ManipLearnError: A text has another form.
    """
    for text in texts:
        if not re.fullmatch(pattern, text, re.DOTALL):
            raise ManipLearnError(f"{flag} must be {form}, got {text!r}", code="option")
    return {name: value for name, _, value in (text.partition("=") for text in texts)}


def vector(option: str, text: str | None) -> list[float] | None:
    """Return the numbers in the text of an option.

    Args:
        option: Name of the option, for the error.
        text: Numbers with commas or spaces between them; None if the option was not given.

    Returns:
        Numbers; None without a text.

    Raises:
        ManipLearnError: The text is not finite numbers.
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
        lock: Joint to lock at zero, or at the limit nearest to zero; repeatable.
        package_dir: Folder with mesh packages; repeatable.
        objects: Object whose pose is recorded (NAME.x ... NAME.rz); repeatable.
        xacro: Expand the robot's xacro file; this runs its code.
        xacro_arg: Argument NAME=VALUE of the xacro file; implies --xacro.
    """

    lock: list[str] | None = None
    package_dir: list[str] | None = None
    objects: Annotated[list[str] | None, Option("--object")] = None
    xacro: bool = False
    xacro_arg: list[str] | None = None

    @property
    def words(self) -> list[str]:
        """Words of the command line that repeat these options."""
        values_of = {"--lock": self.lock, "--package-dir": self.package_dir, "--object": self.objects}
        values_of["--xacro-arg"] = self.xacro_arg
        typed = [word for flag, values in values_of.items() for value in values or () for word in (flag, value)]
        return [*typed, *(["--xacro"] if self.xacro else [])]

    def load(self, name: str, locked: Locks | None = None, objects: Sequence[str] | None = None) -> Robot:
        """Load the robot of these options.

        Args:
            name: Name of the robot or its file.
            locked: Joints to lock, with their positions; None for `lock`.
            objects: Names of objects with recorded poses; None for `objects`.

        Returns:
            Robot of these options.
        """
        from manip_learn.robot import load_robot

        locks = dict.fromkeys(self.lock or ()) if locked is None else locked
        names = tuple(self.objects or ()) if objects is None else objects
        values = pairs("--xacro-arg", "NAME=VALUE", "[^=]+=.*", self.xacro_arg or ())
        return load_robot(name, tuple(self.package_dir or ()), locks, xacro=values or self.xacro, objects=names)


class NamedRobotOptions(RobotOptions):
    """Robot."""

    robot: Annotated[str, Argument(metavar="ROBOT", autocompletion=robot_completions)]


class ConstraintOptions(NamedRobotOptions):
    """Robot.

    Attributes:
        constraint: Constraint file from `learn --out`.
    """

    constraint: Annotated[str, Argument(metavar="CONSTRAINT.JSON")]


class ReadingOptions(Options, kw_only=True):
    """Reading recordings.

    Attributes:
        degrees: Recorded angles are in degrees.
        units: Unit of the recorded angles: radians, degrees or normalised.
        time_unit: Unit of the time stamps: s, ms, us or ns.
        ignore_columns: Column to ignore; repeatable.
        rename: NAME_IN_FILE=NAME_IN_ROBOT; for all joints, a pattern such as 'left_{joint}' or 'q{index}'.
        columns: Pattern of the columns, 'position.{joint}' or 'q[{index}]'. Repeat it for the velocities.
        joint_names: Joint names in column order, for files without names.
        topics: Topic of a bag; repeatable. Default: all topics with joints.
        rate: Sampling rate [Hz]; overrides time stamps.
        velocities: auto or derive: differentiate the positions; recorded: use recorded velocities.
        outside_limits: Samples far outside the joint limits: refuse or note.
        episodes: Episodes (LeRobot) or files to read, counted from 0, e.g. 0:50,60,75.
        feature: LeRobot feature with the joint positions.
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
        """Return the keywords of `load_demonstrations`, without options that were not given."""
        form = "NAME_IN_FILE=NAME_IN_ROBOT, or a pattern such as 'left_{joint}'"
        # a pattern alone names the joints as the robot does
        names = [text if "=" in text or "{" not in text else f"{text}={{joint}}" for text in self.rename or ()]
        values = {name: getattr(self, name) for name in inspect.get_annotations(ReadingOptions)} | {
            "degrees": self.degrees or None,
            "rename": pairs("--rename", form, "[^=]*=.+", names) or None,
            "joint_names": self.joint_names.replace(",", " ").split() if self.joint_names else None,
        }
        return {key: value for key, value in values.items() if value is not None and value != []}


class RecordingsOptions(ReadingOptions):
    """Options.

    Attributes:
        recordings: Files, a folder, or shipped recordings such as sawyer_drawer.
        dask: Use a dask cluster: scheduler address, or local.
    """

    recordings: Annotated[list[str], Argument(metavar="RECORDING...")]
    _: KW_ONLY
    dask: str | None = None


class SearchOptions(Options, kw_only=True):
    """Plan.

    Attributes:
        scene: Obstacle scene (JSON, URDF or MJCF), or none. Default: an assumed floor.
        seed: Random seed of the search.
    """

    scene: Annotated[str | None, Option(metavar="FILE")] = None
    seed: int = 0


class PlanOptions(SearchOptions, kw_only=True):
    """Plan.

    Attributes:
        plan: Plan the grasp configuration so that the whole motion is feasible.
    """

    plan: bool = False


class RobotsOptions(Options, work="robots.known_robots"):
    """List the available robots, with their joints.

    manip-learn robots
    """


class DemoOptions(ExplainedOptions, work="demo.demo"):
    """Learn from shipped recordings; open a drawer without and with singularity avoidance, from one difficult start.

    manip-learn demo

    Attributes:
        robot: Robot: sawyer or planar3.
        out: Folder for the results.
        all_policies: Compare a plan and the policies manipulability, attractor and zero.
        browser: Open the replay in the browser.
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
    """Record hand-guided demonstrations, one file each, and report what can be learnt from them.

    manip-learn record my_arm.py:driver --robot ur5e --frame tool0

    Attributes:
        driver: Driver, or a function that makes one: FILE.py:NAME or package.module:NAME.
        out: Folder for the recordings.
        name: Name of the recordings: NAME_01.csv and so on.
        robot: Robot to display, and to learn for.
        frame: Guided frame, e.g. the tool tip.
        motions: Number of motions to record. Default: until Ctrl-C.
        by: Start and end of a recording: motion (from motion to rest) or key (Enter; q quits).
        duration: Maximum total recording time [s].
        no_release: Leave the arm's torque on.
        no_browser: Do not open the live view.
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
    """Teach a simulated arm in the browser: guide it by hand, learn the task, and watch it reproduce the task.

    manip-learn teach

    Attributes:
        robot: Robot to teach.
        frame: Grasping frame, e.g. the tool tip.
        scene: First scene: drawer, door, loose-door or table.
        out: Folder for recordings and learnt tasks.
        seed: Random seed of the scenes. Default: always the same first scenes.
        no_browser: Print the address of the page, and do not open it.
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
        frame: Guided frame, e.g. the tool tip.
        axes: Axes of the features: xyz, pose, planar, rotation, or any of 'x y z rx ry rz'.
        out: Constraint file to write (JSON).
        html: HTML replay of the recordings to write, with their phases.
        relative_to: Reference frame of the Jacobian, e.g. an object. Default: the base.
        reference: Axes of the rows: world, local, or auto (the larger gap).
        n_constraints: Number of constraints. Default: from the data.
        estimator: Estimator: auto, null-space, joint or separate.
        phases: auto: find the stretches in which a constraint acts; off: use whole recordings.
        mechanism: auto: identify the mechanism (hinge, line, ...); off: do not.
        strength: Minimum strength of the evidence for a row. Default: 1.8.
        keep_habits: Also keep constraints that may only be habits of the demonstrator.
        joint_offset_std: Standard deviation of the joint offsets [deg]; use 1 for hobby servos.
        link_error_std: Standard deviation of the errors of the links [mm and mrad].
        start: Ignore samples before this time [s].
        until: Ignore samples after this time [s].
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
    """Judge recorded episodes by a constraint: rank them, and list the ones to leave out.

    manip-learn audit sawyer task.json sawyer_drawer

    Attributes:
        csv: CSV table to write, one line per episode.
    """

    csv: Path | None = None


class ControlOptions(ConstraintOptions, PlanOptions, ExplainedOptions, work="control.control"):
    """Run one motion of a learnt task: along its free direction or to a target, avoiding task singularities.

    manip-learn control sawyer task.json --along 0.2 --out run.npz

    Attributes:
        along: Distance along the line or plane [m]; positive in the demonstrated direction. Default: as demonstrated.
        turn: Angle about a hinge, a screw or a ball [degrees]; positive in the demonstrated direction.
        target: Target point, one value per axis [m or rad].
        direction: Direction of the motion, if several are free: x,y,z; or shown, or back.
        beyond_shown: Allow a motion beyond the demonstrated range.
        speed: Speed of the hand [m/s], or of a rotation [degrees/s].
        keep_orientation: Keep the orientation of the hand.
        rows: Rows that move to the target: all, or held (as in the paper).
        policy: Null-space policy: manipulability, zero or attractor.
        rest: Rest posture of the attractor [rad].
        gain: Gain of the null-space policy.
        task_gain: Gain of the task [1/s].
        duration: Duration [s]. Default: the planned duration of a motion; 5 s or more to a target.
        dt: Time step [s].
        inverse: Pseudoinverse: damped, exact or truncated.
        tolerance: Distance to the target that counts as reached [m or rad].
        check: Refuse, and write no files, if the target is not reached.
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
    """Reproduce the demonstrated task: grasp, move, release, for every step, then retreat.

    manip-learn repeat sawyer task.json --html run.html

    Attributes:
        moved: Motion of the fixtures since the demonstrations: x,y,z[,rx,ry,rz] (m, degrees about the base axes).
        tip_speed: Maximum tip speed [m/s]; shown: the demonstrated speed; none: no limit.
        prefer: shown: follow a recording; room: search for the configuration with the largest margin.
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
    """Write a browser replay with a manipulability plot: one file, no server, no network.

    manip-learn replay run.npz --open

    Attributes:
        files: Rollouts from `control --out`, which contain their robot; or a robot and recordings.
        html: HTML file to write.
        open_browser: Open it in the browser.
        constraint: Constraint file whose phases and mechanism are shown.
        tip: Frame whose path is drawn.
    """

    files: Annotated[list[str], Argument(metavar="[ROBOT] FILE...", autocompletion=robot_completions)]
    html: Path = Path("replay.html")
    open_browser: Annotated[bool, Option("--open")] = False
    constraint: Path | None = None
    _: KW_ONLY
    tip: str | None = None


class ExportOptions(ReadingOptions, NamedRobotOptions, work="export.export"):
    """Convert recordings or rollouts to other formats, or export a learnt task for a force or impedance controller.

    manip-learn export sawyer run.npz --out run.csv

    Attributes:
        files: Recordings or rollouts, a folder of them, or a constraint file.
        out: File (.mcap, .csv, or .yaml with a JointTrajectory) or folder (LeRobot, or the format of --to) to write.
        to: Format of the files in a folder: mcap, csv, lerobot or trajectory. For a constraint: urscript (force mode),
            stiffness (impedance control), moveit (path constraints) or json (task frame).
        at: Posture of the task frame [rad]. Default: the middle demonstrated posture, else the neutral one.
    """

    files: Annotated[list[str], Argument(metavar="FILE...")]
    out: Path
    to: str | None = None
    at: str | None = None


class ReproduceOptions(Options, work="reproduce.reproduce_paper"):
    """Run the experiments of "Learning Singularity Avoidance", and compare with the published numbers.

    manip-learn reproduce table --trials 2

    Attributes:
        experiment: Experiment: table, rmse, singular-start, near-singular-start, sawyer or all.
        trials: Number of repetitions; the paper has 50.
        seed: Random seed; the same seed gives the same numbers.
        out: Folder for numbers and figures.
        workers: Number of processes. Default: all cores.
    """

    experiment: Annotated[str, Argument()]
    trials: int = 50
    seed: int = 0
    out: Path | None = None
    workers: int | None = None
