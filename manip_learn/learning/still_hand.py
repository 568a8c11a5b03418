"""Recordings in which another hand moved than the one that is asked about: of two arms one stands still."""

from __future__ import annotations

import numpy as np

from manip_learn.constraint.features.feature_map import FeatureMap
from manip_learn.constraint.features.frame_jacobian import FrameJacobian
from manip_learn.errors import NotIdentifiableError, advice, named
from manip_learn.recordings.demonstrations import Demonstrations
from manip_learn.robot.tips import likely_tips

MOVED = 0.02  # [rad or m] within a recording: more than encoders, belts and a held pose leave of a joint at rest


def refuse_still_hand(features: FeatureMap, demonstrations: Demonstrations) -> None:
    """Refuse motions of joints none of which moves the frame.

    Raises:
        NotIdentifiableError: Code `still-hand`; says which hand moved.
    """
    if not isinstance(features, FrameJacobian) or any(t.q.shape[1] != features.nv for t in demonstrations):
        return
    robot, frame = features.robot, features.frame.name
    span = np.max([np.ptp(t.q, axis=0) for t in demonstrations], axis=0)
    moved = [joint for joint, s in zip(robot.joint_names, span, strict=True) if s > MOVED]
    own = np.array([robot.moves(joint, frame) for joint in robot.joint_names])
    if not moved or not own.any() or np.any(span[own] > MOVED):
        return
    hands = [tip for tip in likely_tips(robot) if any(robot.moves(joint, tip) for joint in moved)]
    which = f", which move {hands[0]!r}{advice(': name it with {}', f'frame={hands[0]!r}', f'--frame {hands[0]}')}"
    raise NotIdentifiableError(
        f"{frame!r} stood still: its joints changed by {np.max(span[own]):.2g} (rad or m) at most in a recording, "
        f"{MOVED:g} is a motion; what moved is {named('joint', moved)}{which if hands else ''}",
        code="still-hand",
    )
