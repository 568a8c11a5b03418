"""Options of a plan: the posture in which to take hold, chosen so that the whole way can be done."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, final

import typer

from manip_learn.errors import TargetError


@final
@dataclass(frozen=True)
class PlanOptions:
    """How a way is planned.

    Attributes:
        seed: Of the random postures.
        grasp_angle: By how much the hand's z axis may tilt [degrees]; None for not at all.
        grasp_turns: Turns about that axis that grip alike; 0 for all of them, None for that at the start.
        base_within: Where there is no plan, base placements up to this distance are tried [m].
        beyond_shown: Ways longer than what was shown are planned too.
    """

    seed: int = 0
    grasp_angle: float | None = None
    grasp_turns: int | None = None
    base_within: float = 0.0
    beyond_shown: bool = False


def plan_options(
    plan: Annotated[
        bool, typer.Option("--plan", help="Choose the posture in which to take hold, so that all of it can be done.")
    ] = False,
    seed: Annotated[int, typer.Option(help="Of its random postures.")] = 0,
    grasp_angle: Annotated[float | None, typer.Option(help="By how much the hand's z axis may tilt [degrees].")] = None,
    grasp_turns: Annotated[
        int | None, typer.Option(help="Turns about that axis that grip alike; 2: a gripper, 0: a knob.")
    ] = None,
    base_within: Annotated[float, typer.Option(help="If there is no plan: try the base elsewhere, so far [m].")] = 0.0,
    beyond_shown: Annotated[bool, typer.Option("--beyond-shown", help="Farther than was shown.")] = False,
) -> PlanOptions | None:
    """How a way is planned; None without `--plan`.

    Raises:
        TargetError: Options of a plan without one.
    """
    given = PlanOptions(seed, grasp_angle, grasp_turns, base_within, beyond_shown)
    if not plan and given != PlanOptions():
        raise TargetError("--seed, --grasp-angle, --grasp-turns, --base-within and --beyond-shown go with --plan")
    return given if plan else None
