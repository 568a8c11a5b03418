"""Checked links and joints -> the URDF text that Pinocchio gets to see: kinematics and masses only."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from xml.sax.saxutils import quoteattr

from manip_learn.robot.description.urdf_elements import Pose, UrdfFile, UrdfInertial, UrdfJoint, UrdfLink
from manip_learn.robot.description.urdf_reader import INERTIA
from manip_learn.robot.description.validation import UNLIMITED

LARGE = 1e300  # what C++ reads as a number and no joint reaches


def kinematic_urdf(
    urdf: UrdfFile, visuals: Mapping[str, Sequence[str]] | None = None, *, with_mimics: bool = False
) -> str:
    """Plain URDF of links and joints.

    Args:
        urdf: A validated description.
        visuals: Link -> `<visual>` elements to put in; Pinocchio gets none.
        with_mimics: Whether to write `<mimic>`; for Pinocchio mimic joints are joints of their own.
    """
    parts = [f"<robot name={quoteattr(urdf.name)}>"]
    parts += [_link(link, (visuals or {}).get(link.name, ())) for link in urdf.links]
    parts += [_joint(joint, with_mimics) for joint in urdf.joints]
    parts.append("</robot>")
    return "\n".join(parts)


def _link(link: UrdfLink, visuals: Sequence[str]) -> str:
    inside = ("" if link.inertial is None else _inertial(link.inertial)) + "".join(visuals)
    return f"<link name={quoteattr(link.name)}>{inside}</link>"


def _inertial(inertial: UrdfInertial) -> str:
    entries = " ".join(f'{key}="{value!r}"' for key, value in zip(INERTIA, inertial.inertia, strict=True))
    return f'<inertial>{_origin(inertial.pose)}<mass value="{inertial.mass!r}"/><inertia {entries}/></inertial>'


def _joint(joint: UrdfJoint, with_mimics: bool) -> str:
    x, y, z = joint.axis
    mimic = ""
    if with_mimics and joint.mimic is not None:
        m = joint.mimic
        mimic = f'<mimic joint={quoteattr(m.leader)} multiplier="{m.multiplier!r}" offset="{m.offset!r}"/>'
    return (
        f'<joint name={quoteattr(joint.name)} type="{joint.type}">{_origin(joint.pose)}'
        f"<parent link={quoteattr(joint.parent)}/><child link={quoteattr(joint.child)}/>"
        f'<axis xyz="{x!r} {y!r} {z!r}"/>{_limit(joint)}{mimic}</joint>'
    )


def _origin(pose: Pose) -> str:
    xyz, rpy = (" ".join(repr(c) for c in v) for v in (pose.xyz, pose.rpy))
    return f'<origin xyz="{xyz}" rpy="{rpy}"/>'


def _limit(joint: UrdfJoint) -> str:
    if joint.type not in ("revolute", "prismatic", "continuous"):
        return ""
    limit = joint.limit
    lower, upper, velocity, effort = (
        (None,) * 4 if limit is None else (limit.lower, limit.upper, limit.velocity, limit.effort)
    )
    lower, upper = _bound(lower, -LARGE), _bound(upper, LARGE)
    if lower >= upper:  # of a locked joint, else validation would have refused it
        lower, upper = -LARGE, LARGE
    velocity = LARGE if velocity is None or velocity <= 0.0 else min(velocity, LARGE)
    effort = LARGE if effort is None or effort < 0.0 else effort
    return f'<limit lower="{lower!r}" upper="{upper!r}" velocity="{velocity!r}" effort="{effort!r}"/>'


def _bound(value: float | None, otherwise: float) -> float:
    return otherwise if value is None or abs(value) > UNLIMITED else value
