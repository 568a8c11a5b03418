"""`manip-learn robots` and `inspect`: list the available robots, and describe one of them."""

from __future__ import annotations

import dataclasses
import math
import shlex
from typing import Any

from manip_learn.commands.options import InspectOptions, RobotsOptions
from manip_learn.commands.output import Answer, Progress, cells
from manip_learn.errors import ManipLearnError, few, install_hint
from manip_learn.robot.description.catalogue import SHIPPED, example_robots, fetched_names, find_robot
from manip_learn.robot.description.text import parse_xml, read_description
from manip_learn.robot.description.urdf import validate_urdf
from manip_learn.robot.robot_summary import inspect_robot

# origin of a robot -> title, the extra that adds more of them, examples of these
_ORIGINS = {
    "package": ("with the package (and their number of joints)", "", ""),
    "extra": ("with the extra robots, offline", "robots", "panda, xarm7, so101, ur5 and 60 more"),
    "net": ("with the extra descriptions, fetched when first named", "descriptions", "xarm6 and more"),
}


def known_robots(options: RobotsOptions, progress: Progress) -> Answer:
    """List every available robot, with its joints.

    In the JSON document, `origin` is `package`, `extra` (from the extra `robots`) or `net` (from the extra
    `descriptions`, downloaded when needed); `joints` are the robot's degrees of freedom. The list of joints is empty if
    a description cannot be used, or would have to be downloaded.

    Args:
        options: Options of the command.
        progress: Function that is called with the name of a stage and its completed fraction, 0 to 1.

    Returns:
        Answer with the robots of each origin.
    """
    packaged, robots, sentences = example_robots(), [], []
    names_of = {"package": SHIPPED, "extra": packaged, "net": fetched_names().difference(SHIPPED, packaged)}
    for origin, (title, extra, examples) in _ORIGINS.items():
        described = [_robot_facts(name, origin) for name in sorted(names_of[origin])]
        robots += described
        sizes = ("" if origin == "net" else f" ({'refused' if r['refused'] else len(r['joints'])})" for r in described)
        names = ", ".join(robot["name"] + size for robot, size in zip(described, sizes, strict=True))
        sentences.append(f"{title}: {names}" if names else f"more ({examples}): {install_hint(extra)}")
    return Answer({"robots": robots, "extra_installed": bool(packaged)}, sentences=sentences)


def _robot_facts(name: str, origin: str) -> dict[str, Any]:
    moving, refused = list[str](), None
    try:
        if origin != "net":  # not fetched only for the list
            path = find_robot(name)
            checked = validate_urdf(parse_xml(read_description(path), path))
            followers = {m.joint for m in checked.followers}
            moving = [j.name for j in checked.joints if j.type != "fixed" and j.name not in followers]
    except ManipLearnError as error:
        refused = str(error)
    return {"name": name, "origin": origin, "joints": moving, "refused": refused}


_JOINT = "kind: {kind}; lower: {lower:.4g}; upper: {upper:.4g}; velocity: {velocity:.4g}; unit: {unit}"


def inspect(options: InspectOptions, progress: Progress) -> Answer:
    """Load a robot, check its forward kinematics against another library, and show the facts needed before recording.

    Args:
        options: Options of the command.
        progress: Function that is called with the name of a stage and its completed fraction, 0 to 1.

    Returns:
        Answer with a row for each joint.
    """
    summary = inspect_robot(options.load(options.robot))
    joints, check, tip = summary.joints, summary.cross_check, summary.tips[0] if summary.tips else "NAME"
    flag = f"--frame {shlex.quote(tip)}"
    still = [j.name for j in joints if summary.moving_tip and j.name not in summary.moving_tip]
    facts = {
        "likely tips": f"{few(summary.tips)} ({flag})",
        f"moving {tip}": f"{few(summary.moving_tip)}; not: {few(still)}" if still else "",
        "no position limits": few([j.name for j in joints if not math.isfinite(j.upper - j.lower)]),
        "mimic": few([f"{m.joint} = {m.multiplier:g} {m.leader} + {m.offset:g}" for m in summary.mimics], 3),
        "locked": few([f"{name} at {position:g}" for name, position in summary.locked.items()]),
        "last frames": f"{few(summary.frames[::-1])} (all: --json)",
        "kinematics": f"agrees with yourdfpy to {check.largest_difference:.1e}" if check and check.agrees else "",
        "shapes": summary.shapes,
    }
    return Answer(
        dataclasses.asdict(summary),  # missing limits are infinite, null in JSON
        title=f"{summary.name}: nq {summary.nq}, nv {summary.nv}",
        facts={name: fact for name, fact in facts.items() if fact not in ("", "none")},
        rows=[{"joint": j.name} | cells(vars(j), _JOINT) for j in joints],
        warnings=[f"warning: {warning}" for warning in summary.warnings],
        written=["" if summary.source is None else f"file: {summary.source}"],
        following=f"manip-learn learn {shlex.join([options.robot, *options.words])} RECORDINGS {flag}",
    )
