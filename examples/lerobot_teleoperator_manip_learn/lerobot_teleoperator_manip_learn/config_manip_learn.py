"""What `lerobot-record --teleop.NAME=VALUE` can set."""

from dataclasses import dataclass, field

from lerobot.teleoperators.config import TeleoperatorConfig

import manip_learn as ml


@TeleoperatorConfig.register_subclass("manip_learn")
@dataclass
class ManipLearnConfig(TeleoperatorConfig):
    """A motion that keeps a learnt constraint.

    Attributes:
        robot: Name or path of the robot's description.
        constraint: File of the constraint, as `manip-learn learn --out` writes it.
        start: Motor -> where the arm is when the motion begins, as LeRobot shows it; all motors, a gripper too.
        along: Go so far along what the constraint leaves free [m], or
        turn: so far about it [rad], or
        target: to this point, or pose, with the held rows.
        locked: Joints that the motion does not use.
        motors: Motor -> joint, sign, zero and span, where they are not as in LeRobot's and the description's defaults.
        others: Motors that move no joint, as a gripper's: they stay at their start.
        units: Of motor positions: degrees, normalised (-100 .. 100) or radians.
        fps: Actions per second: that of the recording.
    """

    robot: str
    constraint: str
    start: dict[str, float]
    along: float | None = None
    turn: float | None = None
    target: list[float] | None = None
    locked: list[str] = field(default_factory=list)
    motors: dict[str, ml.LeRobotMotor] = field(default_factory=dict)
    others: list[str] = field(default_factory=list)
    units: str = "degrees"
    fps: float = 30.0
