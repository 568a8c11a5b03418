"""Feature maps Phi(q), the rows out of which a constraint selects."""

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
