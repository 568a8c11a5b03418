"""The words of the formats that are read and written: what names of columns, topics and arrays mean.

They are of any robot: velocities, efforts and commands of joints, and the wrench of a force-torque sensor.

The rule for a wrench was made from the names in public code: `fx` ... `tz` and `wrench.force.x` of tables and messages,
`actual_TCP_force_0` of Universal Robots' RTDE, `O_F_ext_hat_K[0]` of libfranka, `robot0_ee_force` of robosuite,
`observation.wrench`, `observation.force_torque` and `observation.ft` of LeRobot data sets.
"""

from __future__ import annotations

import itertools
import re
from collections.abc import Iterable, Mapping, Sequence

from manip_learn.errors import listed

MARK = "# manip_learn "  # how a text file of this library begins; its header follows
DATASET_HEADER = "meta/manip_learn.json"  # of a LeRobot data set that this library wrote, beside its own metadata
VELOCITY_SUFFIX, EFFORT_SUFFIX = "_velocity", "_effort"  # of columns, after the name of a joint
WRENCH_NAMES = ("force_x", "force_y", "force_z", "torque_x", "torque_y", "torque_z")
JOINT_STATE = "sensor_msgs/msg/JointState"
WRENCH, STAMPED_WRENCH = "geometry_msgs/msg/Wrench", "geometry_msgs/msg/WrenchStamped"
# `d` as in libfranka's q_d and tau_J_d
COMMAND = {
    *("desired", "command", "commanded", "cmd", "target", "goal"),
    *("setpoint", "reference", "ref", "des", "action", "d"),
}
EFFORT = {"effort", "efforts", "torque", "torques", "tau", "moment"}
FORCES = 3  # the first of them
OTHERS = COMMAND | {"tactile", "finger"}  # not what a sensor between arm and hand measured
_NOT_IN_A_WORD = r"(?<![a-z0-9])"
_WHOLE = r"(wrench|f_?t|force_?torque|tcp_force|f_ext_hat_k)(_(sensor|wrench))?"
# `fx`, `ee_force_y [N]`, `wrench.torque.z`: one of six, after which a unit may stand
_AXIS = re.compile(
    rf"(?P<head>.*?){_NOT_IN_A_WORD}(?P<kind>forces?|f|torques?|moments?|tau|t|m)[._/ ]*\[?(?P<axis>[xyz])\]?"
    r"([ _]*[\[(_ ](n|nm|n[.*· ]m)[\])]?)?"
)
_NUMBERED = re.compile(rf"(?P<head>.*?{_NOT_IN_A_WORD}([a-z]+_)*{_WHOLE})[._ ]*\[?(?P<number>\d)\]?")
_FEATURE = re.compile(rf"(.*[^a-z])?([a-z0-9]+_)*{_WHOLE}")


def effort_joint(name: str, joints: Sequence[str]) -> str | None:
    """`joint1` for `joint1_effort`, `effort_joint1`, `tau.joint1`, where that is a joint; None for all other names."""
    for word, mark in itertools.product(EFFORT, "._/"):
        for joint in (name.removesuffix(mark + word), name.removeprefix(word + mark)):
            if name not in joints and joint in joints:
                return joint
    return None


def wrench_columns(names: Sequence[str | None]) -> tuple[tuple[int, ...], str]:
    """Columns of the three forces and the three torques, and a note; none where there is no wrench, or several.

    Args:
        names: Of the columns; None where one is known to be something else.
    """
    made: dict[str, dict[int, int]] = {}
    for i, name in enumerate(names):
        for head, place in _places((name or "").strip().lower()):
            made.setdefault(head, {})[place] = i
    # numbers count from 0 or from 1
    whole = [tuple(c[k] for k in sorted(c)) for c in made.values() if sorted(c) in ([*range(6)], [*range(1, 7)])]
    shown = [f"{names[columns[0]]} ... {names[columns[-1]]}" for columns in whole]
    if len(whole) > 1:
        return (), f"{several_wrenches(shown)}: leave out the columns of all but one"
    return (whole[0], f"the wrench is read from {shown[0]}") if whole else ((), "")


def wrench_sets(widths: Mapping[str, int]) -> list[tuple[str, ...]]:
    """Arrays that hold a wrench: one of six columns, e.g. `observation.ft`, or forces and torques of three each.

    Args:
        widths: Name of each array -> number of its columns.
    """
    own = {name: n for name, n in widths.items() if not _is_other(name.lower())}
    pairs = [(name, name.removesuffix("force") + "torque") for name in own if name.endswith("force")]
    whole = [(name,) for name, n in own.items() if n == 6 and _FEATURE.fullmatch(name.lower())]
    return whole + [pair for pair in pairs if [own.get(name) for name in pair] == [FORCES, FORCES]]


def several_wrenches(shown: Iterable[str]) -> str:
    """The note that one of them would have to be guessed."""
    return f"several wrenches are recorded ({listed(shown)}), so none is used"


def _places(name: str) -> list[tuple[str, int]]:
    """Whose wrench a column is part of, and its place in it; nothing for other columns."""
    if _is_other(name):
        return []
    if found := _AXIS.fullmatch(name):
        first = 0 if found["kind"].startswith("f") else FORCES
        return [(f"{found['head']} by axis", first + "xyz".index(found["axis"]))]
    found = _NUMBERED.fullmatch(name)
    return [(found["head"], int(found["number"]))] if found else []


def _is_other(name: str) -> bool:
    return bool(set(re.findall(r"[a-z]+", name)) & OTHERS)
