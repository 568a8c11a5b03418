"""Feature maps Phi(q), the rows out of which a constraint selects."""

from manip_learn.features.centre_of_mass import CentreOfMass
from manip_learn.features.custom_features import CustomFeatures
from manip_learn.features.feature_map import FeatureMap
from manip_learn.features.frame_jacobian import FrameJacobian
from manip_learn.features.stacked import Stacked

__all__ = ["CentreOfMass", "CustomFeatures", "FeatureMap", "FrameJacobian", "Stacked"]
