"""A written description -> the feature map that it describes."""

from __future__ import annotations

from typing import Any

from manip_learn.constraint.features.centre_of_mass import CentreOfMass
from manip_learn.constraint.features.feature_map import FeatureMap
from manip_learn.constraint.features.frame_jacobian import FrameJacobian
from manip_learn.constraint.features.mechanism_rows import MechanismRows
from manip_learn.constraint.features.place_rows import PlaceRows
from manip_learn.constraint.features.relative_frame_jacobian import RelativeFrameJacobian
from manip_learn.constraint.features.stacked import Stacked
from manip_learn.errors import ConstraintMismatchError
from manip_learn.robot.robot import Robot


def described_features(described: dict[str, Any], robot: Robot) -> FeatureMap:
    """The feature map that `describe` wrote down, for the robot that it belongs to.

    Raises:
        ConstraintMismatchError: A kind of features that this version does not know.
        FeatureError: Settings that this robot does not have, or out of range.
    """
    kind = described["kind"]
    if kind == "frame-jacobian":
        return FrameJacobian(robot, described["frame"], described["axes"], described["reference"])
    if kind == "relative-frame-jacobian":
        return RelativeFrameJacobian(robot, described["frame"], described["relative_to"], described["axes"])
    if kind == "centre-of-mass":
        return CentreOfMass(robot, " ".join(described["axes"]))
    if kind == "mechanism-rows":
        return MechanismRows.from_description(robot, described)
    if kind == "place-rows":
        return PlaceRows(robot, described["frame"], described["form"], described["middle"])
    if kind == "stacked":
        return Stacked([described_features(part, robot) for part in described["parts"]])
    raise ConstraintMismatchError(f"unknown kind of features {kind!r}: this file comes from a newer version")
