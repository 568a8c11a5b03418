"""The command line: argv in, exit code out; all work is done in `commands`."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated, Any

import typer

from manip_learn.commands import arguments as shared
from manip_learn.commands.output import answer, progress, refused_by_system, waiting
from manip_learn.commands.plan_options import PlanOptions
from manip_learn.commands.read_options import ReadOptions
from manip_learn.commands.refusal import nobody_reads, refuse
from manip_learn.commands.robot_options import RobotOptions
from manip_learn.commands.shared_options import GroupedCommand, flags_of, takes_shared_options
from manip_learn.commands.typed_command import typed
from manip_learn.commands.vectors import direction as direction_of
from manip_learn.commands.vectors import joined_vectors, vector
from manip_learn.errors import ManipLearnError, advice_for_command

COMPLETION = "_MANIP_LEARN_COMPLETE"  # set by the shell that asks for completions

app = typer.Typer(
    name="manip-learn",
    help="Learn which directions a demonstrated task constrains, and keep the arm away from its singularities.",
    epilog="Start with: manip-learn demo",
    add_completion=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)


@app.callback()
def front(version: shared.Version = False) -> None:
    """Learn which directions a demonstrated task constrains, and keep the arm away from its singularities."""


@app.command(cls=GroupedCommand)
def robots(as_json: shared.Json = False) -> None:
    """List the robots that can be named, with their joints."""
    from manip_learn.commands.robots import known_robots

    listed = known_robots()
    answer(as_json, listed.to_dict(), "print_robots", listed)


@app.command(cls=GroupedCommand)
def demo(
    robot: Annotated[str, typer.Option(help="sawyer or planar3.")] = "sawyer",
    out: Annotated[Path, typer.Option(help="Folder for the results.")] = Path("demo_out"),
    browser: Annotated[bool, typer.Option("--browser/--no-browser", help="Open the replay.")] = True,
    explain: shared.Explain = False,
    as_json: shared.Json = False,
) -> None:
    """Learn from shipped recordings, compare three policies, write the replay."""
    from manip_learn.commands.demo import demo as run

    with progress(as_json) as report:
        result = run(robot, out, browser and not as_json, report)
    answer(as_json, result.to_dict(), "print_demo", result, explain=explain)


@app.command(cls=GroupedCommand)
@takes_shared_options
def inspect(
    robot: shared.RobotName,
    *,
    robot_options: RobotOptions,
    as_json: shared.Json = False,
) -> None:
    """Show joints, frames, limits and warnings of a robot."""
    from manip_learn.commands.inspect import inspect as run
    from manip_learn.commands.inspect import summary_dict

    steps = run(robot, robot_options)
    summary = next(steps)
    if not as_json:  # at once: the library that checks it takes longer to load than the robot
        answer(False, {}, "print_robot", summary)
    summary = next(steps)
    answer(as_json, summary_dict(summary), "print_cross_check", summary)


@app.command(cls=GroupedCommand)
@takes_shared_options
def learn(
    robot: shared.RobotName,
    recordings: shared.Recordings,
    frame: shared.GuidedFrame = None,
    relative_to: shared.SeenFrom = None,
    axes: Annotated[str, typer.Option(help="xyz, pose, planar, rotation, or any of 'x y z rx ry rz'.")] = "xyz",
    reference: Annotated[str, typer.Option(help="world, local, or auto (the larger gap).")] = "auto",
    constraints: Annotated[int | None, typer.Option(help="Number of constraints; default: from the data.")] = None,
    estimator: Annotated[str, typer.Option(help="auto, null-space, joint or separate.")] = "auto",
    out: Annotated[Path | None, typer.Option(help="Constraint file to write (JSON).")] = None,
    html: Annotated[Path | None, typer.Option(help="Replay of the recordings to write, with their phases.")] = None,
    *,
    robot_options: RobotOptions,
    options: ReadOptions,
    phases: shared.Phases = "auto",
    mechanism: Annotated[str, typer.Option(help="auto: say what holds the hand (hinge, line, ...); off.")] = "auto",
    strength: Annotated[
        float | None, typer.Option(help="How much less than by chance a row must be used to be believed; default: 1.8.")
    ] = None,
    start: Annotated[float | None, typer.Option("--from", help="Leave out what was recorded before [s].")] = None,
    until: Annotated[float | None, typer.Option(help="Leave out what was recorded after [s].")] = None,
    points: Annotated[int | None, typer.Option(help="Use at most this many samples of each trajectory.")] = None,
    seed: Annotated[int, typer.Option(help="Seed of the bootstrap and of random starts.")] = 0,
    dask: shared.Dask = None,
    explain: shared.Explain = False,
    as_json: shared.Json = False,
) -> None:
    """Learn a constraint from recordings and report it."""
    from manip_learn.commands.learn import learn as run

    with progress(as_json) as report:
        learnt = run(
            robot, recordings, frame=frame, relative_to=relative_to, axes=axes, reference=reference,
            n_constraints=constraints, estimator=estimator, out=out, html=html, seed=seed, points=points,
            phases=phases, mechanism=mechanism, strength=strength, start=start, until=until,
            robot_options=robot_options, options=options, dask=dask, progress=report
        )  # fmt: skip
    answer(as_json, learnt.to_dict(), "print_learnt", learnt, explain=explain)


@app.command(cls=GroupedCommand)
@takes_shared_options
def audit(
    robot: shared.RobotName,
    constraint: shared.ConstraintFile,
    recordings: shared.Recordings,
    csv: Annotated[Path | None, typer.Option(help="Table to write, one line per episode (CSV).")] = None,
    *,
    robot_options: RobotOptions,
    options: ReadOptions,
    dask: shared.Dask = None,
    explain: shared.Explain = False,
    as_json: shared.Json = False,
) -> None:
    """Judge recorded episodes by a constraint: rank them, and name those to leave out."""
    from manip_learn.commands.audit import audit as run

    with progress(as_json) as report:
        audited = run(
            robot, constraint, recordings, csv=csv, robot_options=robot_options, options=options, dask=dask,
            progress=report
        )  # fmt: skip
    answer(as_json, audited.to_dict(), "print_audit", audited, explain=explain)


@app.command(cls=GroupedCommand)
@takes_shared_options
def control(
    robot: shared.RobotName,
    constraint: shared.ConstraintFile,
    start: shared.Start = None,
    along: Annotated[float | None, typer.Option(help="Way along a line or a plane [m].")] = None,
    turn: Annotated[float | None, typer.Option(help="Angle about a hinge, a screw or a ball [degrees].")] = None,
    direction: Annotated[str | None, typer.Option(help="Which way, where several are free: x,y,z.")] = None,
    speed: Annotated[float | None, typer.Option(help="Of the hand [m/s], or of a turn [degrees/s].")] = None,
    keep_orientation: Annotated[bool, typer.Option("--keep-orientation", help="The hand does not turn.")] = False,
    target: shared.Target = None,
    rows: Annotated[str, typer.Option(help="all: go to the target; held: its held rows only (the paper).")] = "all",
    policy: Annotated[str, typer.Option(help="manipulability, zero or attractor.")] = "manipulability",
    rest: Annotated[str | None, typer.Option(help="Rest posture of the attractor [rad].")] = None,
    gain: Annotated[float, typer.Option(help="Gain of the policy.")] = 3.0,
    task_gain: Annotated[float, typer.Option(help="Gain of the task [1/s].")] = 1.0,
    duration: Annotated[float | None, typer.Option(help="Duration [s]; default: of the way, else 5.")] = None,
    dt: Annotated[float, typer.Option(help="Time step [s].")] = 0.01,
    inverse: Annotated[str, typer.Option(help="damped, exact or truncated.")] = "damped",
    tolerance: Annotated[float, typer.Option(help="Distance to the target that counts as reached [m or rad].")] = 0.01,
    check: Annotated[bool, typer.Option("--check", help="Write nothing and refuse if it gets less far.")] = False,
    out: Annotated[Path | None, typer.Option(help="Rollout file to write: .npz, .csv, .jsonl or .mcap.")] = None,
    *,
    planned: PlanOptions | None,
    robot_options: RobotOptions,
    explain: shared.Explain = False,
    as_json: shared.Json = False,
) -> None:
    """Do the task that was learnt: along what is free, or to a point, clear of the task's singularities."""
    from manip_learn.commands.control import control as run

    with progress(as_json) as report:
        result = run(
            robot, constraint, start=vector("--start", start), target=vector("--target", target), along=along,
            turn=turn, direction=direction_of(direction), speed=speed, keep_orientation=keep_orientation, rows=rows,
            check=check, planned=planned, policy=policy, rest=vector("--rest", rest), gain=gain, task_gain=task_gain,
            duration=duration, dt=dt, inverse=inverse, tolerance=tolerance, out=out, robot_options=robot_options,
            progress=report
        )  # fmt: skip
    answer(as_json, result.to_dict(), "print_controlled", result, explain=explain)


@app.command(cls=GroupedCommand)
@takes_shared_options
def replay(
    robot: shared.RobotName,
    rollouts: shared.Rollouts,
    html: Annotated[Path, typer.Option(help="File to write.")] = Path("replay.html"),
    open_browser: Annotated[bool, typer.Option("--open", help="Open it in the browser.")] = False,
    tip: shared.Tip = None,
    constraint: shared.Shown = None,
    *,
    robot_options: RobotOptions,
    options: ReadOptions,
    as_json: shared.Json = False,
) -> None:
    """Write a browser replay with the manipulability plot: one file, no server, no network."""
    from manip_learn.commands.replay import replay as run

    with waiting(as_json, "writing the replay"):
        page = run(
            robot, rollouts, html=html, open_browser=open_browser, tip=tip, robot_options=robot_options,
            options=options, constraint_file=constraint
        )  # fmt: skip
    content = {"html": str(page.html), "bytes": page.bytes, "notes": list(page.notes)}
    answer(as_json, content, "print_replayed", page)


@app.command(cls=GroupedCommand)
@takes_shared_options
def export(
    robot: shared.RobotName,
    files: shared.Exported,
    out: shared.ExportOut,
    to: shared.ExportTo = None,
    *,
    robot_options: RobotOptions,
    options: ReadOptions,
    as_json: shared.Json = False,
) -> None:
    """Write recordings or rollouts as MCAP, CSV, LeRobot data, for Rerun, or as a JointTrajectory for a controller."""
    from manip_learn.commands.export import export as run

    with waiting(as_json, "writing"):
        result = run(robot, files, out, to, robot_options, options)
    answer(as_json, result.to_dict(), "print_exported", result)


@app.command(cls=GroupedCommand)
def reproduce(
    experiment: Annotated[
        str, typer.Argument(help="table, rmse, singular-start, near-singular-start, sawyer, beyond or all.")
    ],
    trials: Annotated[int, typer.Option(help="Repetitions; 50 in the paper.")] = 50,
    seed: Annotated[int, typer.Option(help="Random seed; the same seed gives the same numbers.")] = 0,
    out: Annotated[Path | None, typer.Option(help="Folder for numbers, figures and replays.")] = None,
    workers: Annotated[int | None, typer.Option(help="Processes; default: all cores.")] = None,
    backend: Annotated[str, typer.Option(help="loky, threading or dask.")] = "loky",
    as_json: shared.Json = False,
) -> None:
    """Run the experiments of "Learning Singularity Avoidance", and compare with the printed numbers."""
    from manip_learn.commands.reproduce import reproduce as run

    with progress(as_json) as report:
        result = run(experiment, trials=trials, seed=seed, out=out, workers=workers, backend=backend, progress=report)
    answer(as_json, result.to_dict(), "print_reproduction", result)


@app.command("warm-up", cls=GroupedCommand)
def warm_up(as_json: shared.Json = False) -> None:
    """Compile once what control loops compile, so that the first one on this machine starts at once."""
    from manip_learn.commands.warm_up import warm_up as run

    with progress(as_json) as report:
        warmed = run(report)
    answer(as_json, warmed.to_dict(), "print_warm_up", warmed)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; returns 0, 2 for bad input, 1 for an internal error, 130 for Ctrl-C. No traceback."""
    from typer.main import get_command

    # before NumPy is loaded: threads on matrices this small cost more than they gain
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    arguments = joined_vectors(list(sys.argv[1:] if argv is None else argv))
    if not arguments and COMPLETION not in os.environ:
        return refuse(
            "no command given: try `manip-learn demo`, or `manip-learn --help` for all commands", False, "usage"
        )
    command = get_command(app)
    with advice_for_command(flags_of(command, arguments)), typed(arguments):
        code = _run(
            lambda: command.main(arguments, prog_name="manip-learn", standalone_mode=False), "--json" in arguments
        )
    if argv is None:
        sys.exit(code)
    return code


def _run(command: Callable[[], Any], as_json: bool) -> int:
    # depending on its version, typer bundles click or uses the public one: either way this is click's UsageError
    usage_error: Any = typer.BadParameter.__mro__[1]
    try:
        outcome = command()
        sys.stdout.flush()
    except ManipLearnError as error:
        return refuse(str(error), as_json, error.code, error.facts())
    except usage_error as error:
        context = getattr(error, "ctx", None)
        where = f"manip-learn {context.info_name}" if context and context.parent else "manip-learn"
        return refuse(f"{error.format_message().rstrip('.')}: see `{where} --help`", as_json, "usage")
    except (typer.Abort, KeyboardInterrupt):
        print("interrupted", file=sys.stderr)
        return 130
    except BrokenPipeError:
        return nobody_reads()
    except SystemExit as end:  # of rich and typer, for a pipe that nobody reads; or of a completion
        return end.code if COMPLETION in os.environ and isinstance(end.code, int) else nobody_reads()
    except OSError as error:
        return refuse(refused_by_system(error), as_json, "system")
    except Exception as error:  # last resort: a sentence, not a traceback
        sentence = f"internal error ({type(error).__name__}: {error}); please report it"
        return refuse(sentence, as_json, "internal", exit_code=1)
    return outcome if isinstance(outcome, int) else 0


if __name__ == "__main__":
    main()
