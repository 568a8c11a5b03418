"""Links and joints must form one tree."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

from manip_learn.errors import closest_names
from manip_learn.robot.description.diagnostics import GateLog, quoted
from manip_learn.robot.description.urdf_elements import UrdfJoint, UrdfLink

MAX_LINKS = 1_000
MAX_DEPTH = 500
MAX_NV = 150


def root_of_tree(links: Sequence[UrdfLink], joints: Sequence[UrdfJoint], log: GateLog) -> str:
    """Name of the root link.

    Raises:
        RobotError: Codes `no-links`, `duplicate-link`, `duplicate-joint`, `unknown-link`, `self-loop`, `two-parents`,
            `no-root`, `many-roots`, `detached`, `too-many-links`, `too-deep`, `too-many-dof`.
    """
    _check_counts(links, joints, log)
    _check_names(links, joints, log)
    _check_ends(links, joints, log)
    children = {j.child for j in joints}
    roots = [link for link in links if link.name not in children]
    if not roots:
        raise log.refusal(
            "no-root",
            joints[0].line,
            "the joints",
            "every link is the child of a joint, so they run in a circle",
            "one link without a parent is wanted",
            f"remove the joint that closes the circle, e.g. {joints[-1].name!r}",
        )
    if len(roots) > 1:
        raise log.refusal(
            "many-roots",
            roots[1].line,
            "the links",
            f"{quoted([r.name for r in roots])} have no parent",
            "one such link is wanted",
            f"join {roots[1].name!r} to the rest by a joint, or delete it",
        )
    _check_reach(roots[0], links, joints, log)
    return roots[0].name


def _check_counts(links: Sequence[UrdfLink], joints: Sequence[UrdfJoint], log: GateLog) -> None:
    if not links:
        fix = "is it a xacro file, or cut off?"
        raise log.refusal("no-links", 1, "the robot", "it has no <link>", "at least one is wanted", fix)
    if len(links) > MAX_LINKS:
        seen = f"it has {len(links)} links"
        fix = "leave out what the arm does not need"
        raise log.refusal("too-many-links", links[MAX_LINKS].line, "the robot", seen, f"at most {MAX_LINKS} work", fix)
    nv = sum(j.nv for j in joints)
    if nv > MAX_NV:
        seen = f"it has {nv} degrees of freedom"
        fix = 'make unused joints type="fixed"'
        raise log.refusal("too-many-dof", None, "the robot", seen, f"at most {MAX_NV} work", fix)


def _check_names(links: Sequence[UrdfLink], joints: Sequence[UrdfJoint], log: GateLog) -> None:
    for kind, elements in (("link", links), ("joint", joints)):
        first: dict[str, int] = {}
        for e in elements:
            if e.name in first:
                seen = f"the name is already used on line {first[e.name]}"
                fix = "rename one of the two"
                raise log.refusal(f"duplicate-{kind}", e.line, f"{kind} {e.name!r}", seen, "names must be unique", fix)
            first[e.name] = e.line


def _check_ends(links: Sequence[UrdfLink], joints: Sequence[UrdfJoint], log: GateLog) -> None:
    names = {link.name for link in links}
    parent_joint: dict[str, str] = {}
    for j in joints:
        where = f"joint {j.name!r}"
        for role, link in (("parent", j.parent), ("child", j.child)):
            if link not in names:
                near = closest_names(link, names)
                fix = f"did you mean {quoted(near)}?" if near else "add the link or correct the name"
                seen = f"its {role} link {link!r} does not exist"
                raise log.refusal("unknown-link", j.line, where, seen, "a link of this file is wanted", fix)
        if j.parent == j.child:
            seen = f"its parent and its child are both {j.child!r}"
            raise log.refusal("self-loop", j.line, where, seen, "two links are wanted", "correct one of them")
        if j.child in parent_joint:
            seen = f"its child {j.child!r} already hangs on joint {parent_joint[j.child]!r}"
            fix = "closed chains are not supported: remove one of the two joints"
            raise log.refusal("two-parents", j.line, where, seen, "one parent a link is wanted", fix)
        parent_joint[j.child] = j.name


def _check_reach(root: UrdfLink, links: Sequence[UrdfLink], joints: Sequence[UrdfJoint], log: GateLog) -> None:
    below: dict[str, list[str]] = {}
    for j in joints:
        below.setdefault(j.parent, []).append(j.child)
    depth, level, reached = 0, [root.name], Counter([root.name])
    while level:
        level = [child for name in level for child in below.get(name, ())]
        reached.update(level)
        depth += bool(level)
        if depth > MAX_DEPTH:
            seen = "it is more than 500 joints deep"
            fix = "merge links that are fixed to each other"
            raise log.refusal("too-deep", None, "the tree of links", seen, f"at most {MAX_DEPTH} work", fix)
    lost = [link for link in links if link.name not in reached]
    if lost:
        seen = f"{quoted([link.name for link in lost])} run in a circle that hangs on nothing"
        fix = "remove the joint that closes the circle and join it to the rest"
        raise log.refusal("detached", lost[0].line, "the links", seen, "one tree is wanted", fix)
