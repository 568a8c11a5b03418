"""Feature maps Phi(q), the rows out of which a constraint selects."""

from manip_learn.constraint.features.curve_rows import CurveRows
from manip_learn.constraint.features.feature_map import FeatureMap
from manip_learn.constraint.features.frame_jacobian import FrameJacobian
from manip_learn.constraint.features.mechanism_rows import MechanismRows
from manip_learn.constraint.features.other_features import CentreOfMass, CustomFeatures, Stacked
from manip_learn.constraint.features.relative_frame_jacobian import RelativeFrameJacobian

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
