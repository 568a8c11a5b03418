"""The kinds of recordings there are."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Literal, final

from make_recordings import free_motions
from make_recordings.free_motions import Free
from make_recordings.furniture import Maker, door, drawer, glass, hinge, screw, sleeve, table, tether


@final
@dataclass(frozen=True)
class Kind:
    """One kind of task.

    Attributes:
        makers: Furniture, in the order of its use.
        grip: How differently the hand takes hold each time: standard deviation of the joints [rad].
        contaminates: `"mechanism"`: some demonstrations are with the second mechanism instead of the first;
            `"slip"`: in some demonstrations the grip slips halfway; None: all belong together.
        offset: How far from the tip's origin things are held, each time elsewhere: standard deviation [m].
        moved: Whether the furniture stands elsewhere each time, with the same grip.
    """

    makers: tuple[Maker, ...]
    grip: float = 0.3
    contaminates: Literal["mechanism", "slip"] | None = None
    offset: float = 0.0
    moved: bool = False


TASKS: dict[str, Kind] = {
    "drawer": Kind((drawer,)),
    "drawer_firm": Kind((partial(drawer, firm=True),)),
    "table": Kind((table,)),
    "table_flat": Kind((partial(table, flat=True),)),
    "door": Kind((door,)),
    "door_firm": Kind((partial(door, firm=True),)),
    "drawer_offset": Kind((drawer,), offset=0.03),
    "door_offset": Kind((door,), offset=0.03),
    "drawer_moved": Kind((partial(drawer, firm=True),), moved=True),
    "door_moved": Kind((partial(door, firm=True),), moved=True),
    "hinge": Kind((hinge,)),
    "screw": Kind((screw,)),
    "sleeve": Kind((sleeve,)),
    "tether": Kind((tether,)),
    "joystick": Kind((partial(tether, firm=True),)),
    "glass": Kind((glass,)),
    "drawer_then_table": Kind((drawer, table)),
    "door_then_drawer": Kind((door, drawer)),
    "drawer_other_direction": Kind((drawer, drawer), contaminates="mechanism"),
    "door_other_place": Kind((door, door), contaminates="mechanism"),
    "drawer_slip": Kind((drawer,), contaminates="slip"),
    "door_slip": Kind((door,), contaminates="slip"),
}
FREE: dict[str, Free] = {
    "free": free_motions.reaches,
    "free_slow": free_motions.slow_reaches,
    "free_repeated": free_motions.repeated_reach,
    "free_one_joint": free_motions.one_joint_at_a_time,
    "free_sticking": free_motions.sticking_joints,
    "free_few_joints": free_motions.few_joints,
}
KINDS = (*TASKS, *FREE)
