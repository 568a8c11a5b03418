"""Feature maps Phi(q), the rows out of which a constraint selects."""

from manip_learn.constraint.features.centre_of_mass import CentreOfMass
from manip_learn.constraint.features.custom_features import CustomFeatures
from manip_learn.constraint.features.feature_map import FeatureMap
from manip_learn.constraint.features.frame_jacobian import FrameJacobian
from manip_learn.constraint.features.mechanism_rows import MechanismRows
from manip_learn.constraint.features.relative_frame_jacobian import RelativeFrameJacobian
from manip_learn.constraint.features.stacked import Stacked

__all__ = [
    "CentreOfMass",
    "CustomFeatures",
    "FeatureMap",
    "FrameJacobian",
    "MechanismRows",
    "RelativeFrameJacobian",
    "Stacked",
]
