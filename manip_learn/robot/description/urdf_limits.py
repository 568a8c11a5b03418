"""Joint limits that a controller can rely on."""

from __future__ import annotations

import math

from manip_learn.robot.description.diagnostics import GateLog
from manip_learn.robot.description.urdf_elements import UrdfJoint

LARGEST_ANGLE = 4.0 * math.pi  # [rad]
UNLIMITED = 1_000.0  # [rad or m] what reaches beyond stands for "no limit" in practice


def check_limits(joint: UrdfJoint, log: GateLog) -> None:
    """Refuse limits that cannot be meant, warn about those that say nothing.

    Raises:
        RobotError: Codes `limit-missing`, `limit-order`, `limit-degrees`, `velocity-limit`.
    """
    if joint.type in ("revolute", "prismatic"):
        _check_range(joint, log)
    if joint.type in ("revolute", "prismatic", "continuous"):
        _check_velocity(joint, log)


def _check_range(joint: UrdfJoint, log: GateLog) -> None:
    where, unit = f"joint {joint.name!r}", "m" if joint.type == "prismatic" else "rad"
    otherwise = ', or type="continuous"' if joint.type == "revolute" else ""
    limit = joint.limit
    if limit is None or limit.lower is None or limit.upper is None:
        missing = "no <limit>" if limit is None else f"no {'lower' if limit.lower is None else 'upper'} limit"
        fix = f'write <limit lower="..." upper="..."/>{otherwise}, or lock the joint'
        line = joint.line if limit is None else limit.line
        raise log.refusal("limit-missing", line, where, f"it has {missing}", f"a {joint.type} joint needs both", fix)
    if limit.lower >= limit.upper:
        seen = f"its limits are {limit.lower:g} ... {limit.upper:g} {unit}"
        fix = f'swap or correct them{otherwise}, or type="fixed", or lock the joint'
        raise log.refusal("limit-order", limit.line, where, seen, "lower below upper is wanted", fix)
    largest = max(abs(limit.lower), abs(limit.upper))
    if largest == math.inf:  # said by the format, not by a number
        return
    if largest > UNLIMITED:
        log.warn(limit.line, f"{where}: its limit of {largest:.3g} {unit} is taken for no limit")
    elif joint.type == "revolute" and largest > LARGEST_ANGLE:
        raise log.refusal(
            "limit-degrees",
            limit.line,
            where,
            f"its limits are {limit.lower:g} ... {limit.upper:g} rad, more than two turns: they look like degrees",
            "radians are wanted",
            f"write {math.radians(limit.lower):.4f} ... {math.radians(limit.upper):.4f}{otherwise} for many turns",
        )


def _check_velocity(joint: UrdfJoint, log: GateLog) -> None:
    where, limit = f"joint {joint.name!r}", joint.limit
    if limit is None or limit.velocity is None:
        if joint.type != "continuous" or limit is not None:
            log.warn(
                joint.line if limit is None else limit.line, f"{where}: no velocity limit; it is taken as unlimited"
            )
        return
    if limit.velocity <= 0.0:
        unit = "m/s" if joint.type == "prismatic" else "rad/s"
        raise log.refusal(
            "velocity-limit",
            limit.line,
            where,
            f"its velocity limit is {limit.velocity:g} {unit}",
            "a positive number is wanted",
            "write the true limit, or leave velocity out for none, or lock the joint",
        )
