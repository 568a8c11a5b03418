"""Feature maps Phi(q): matrices whose rows a constraint A(q) = Lambda Phi(q) selects and combines."""

from manip_learn.constraint.features.feature_map import FeatureMap
from manip_learn.constraint.features.frame_jacobian import FrameJacobian, RelativeFrameJacobian
from manip_learn.constraint.features.mechanism_rows import CurveRows, MechanismRows
from manip_learn.constraint.features.other_features import CentreOfMass, CustomFeatures, Stacked

__all__ = [
    "CentreOfMass",
    "CurveRows",
    "CustomFeatures",
    "FeatureMap",
    "FrameJacobian",
    "MechanismRows",
    "RelativeFrameJacobian",
    "Stacked",
]
