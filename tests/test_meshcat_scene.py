"""`ml.show` draws into the user's own meshcat viewer: what its page holds is what the library computes."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from task_sets import learnt_from, shipped

import manip_learn as ml
from manip_learn.errors import ConfigurationError

# meshcat imports a module of pyzmq that says so
pytestmark = pytest.mark.filterwarnings("ignore:zmq.eventloop.ioloop:DeprecationWarning")


class Notebook:
    """A viewer without a server, which keeps what it is sent."""

    def __init__(self, path: tuple[str, ...] = (), kept: dict[tuple[str, ...], Any] | None = None):
        self.path, self.kept = path, {} if kept is None else kept
        self.set_object = lambda geometry, material: self.kept.update({self.path: geometry})
        self.set_transform = lambda pose: self.kept.update({(*self.path, "pose"): pose})

    def __getitem__(self, name: str) -> Notebook:
        return Notebook((*self.path, name), self.kept)

    def delete(self) -> None:
        for path in [p for p in self.kept if p[: len(self.path)] == self.path]:
            del self.kept[path]


@pytest.fixture(scope="module")
def door() -> tuple[ml.Robot, ml.Demonstrations, ml.Constraint]:
    """A UR5, a door and what was learnt of it."""
    constraint = learnt_from("ur5_loose_door").constraint_
    return constraint.features.robot, shipped("ur5_loose_door")[1], constraint


def test_the_scene_is_the_arm_and_what_was_learnt(door):
    """Links are where forward kinematics puts them; the tube of the path leads from the grasps to the target. A new
    call replaces the drawing; anything but a viewer is refused.
    """
    robot, demos, constraint = door
    viewer, q = Notebook(), demos[0].q[-1]
    ml.show(robot, viewer, constraint, demos[0].q[0])(q)
    kept = {path[1:]: value for path, value in viewer.kept.items()}
    model, data = robot.pinocchio_model, robot.pinocchio_model.createData()
    pin.forwardKinematics(model, data, robot.pinocchio_configuration(q))
    for joint in range(model.njoints):
        np.testing.assert_allclose(kept["arm", str(joint), "pose"], data.oMi[joint].homogeneous, atol=1e-12)
    assert {path[0] for path in kept} == {"arm", "mechanism", "path", "grasps", "target"}
    assert sum(path[0] == "grasps" and path[-1] != "pose" for path in kept) == len(constraint.shown.grasps)
    np.testing.assert_allclose(kept["target", "0", "pose"][:3, 3], constraint.shown.points[-1], atol=1e-12)
    tube = kept["path",].vertices
    tube = tube.T if tube.shape[0] == 3 else tube
    distance = np.linalg.norm(tube[:, None] - constraint.shown.points[None], axis=2).min(axis=1)
    np.testing.assert_allclose(distance[distance > 1e-6], 0.008, atol=1e-3)  # the others are the centres of the ends
    # the hand turns where it is, as at a knob
    ml.show(robot, viewer, constraint.showing(replace(constraint.shown, path=0.0 * constraint.shown.path)))
    assert np.all(np.isfinite(viewer.kept["manip_learn", "path"].vertices))
    ml.show(robot, viewer)
    assert {path[1] for path in viewer.kept} == {"arm"}
    with pytest.raises(ConfigurationError, match=r"meshcat\.Visualizer"):
        ml.show(robot, object())


def test_pinocchios_viewer_draws_the_arm_itself(door):
    """The viewer gets full configurations and the learnt constraint; one of another robot is refused."""
    robot, demos, constraint = door
    shown = list[np.ndarray]()
    viewer = SimpleNamespace(viewer=Notebook(), model=robot.pinocchio_model, display=shown.append)
    ml.show(robot, viewer, constraint, demos[0].q[0])(demos[0].q[-1])
    np.testing.assert_array_equal(shown, [robot.pinocchio_configuration(q) for q in demos[0].q[[0, -1]]])
    assert {path[1] for path in viewer.viewer.kept} == {"mechanism", "path", "grasps", "target"}
    with pytest.raises(ConfigurationError, match="build it with robot.pinocchio_model"):
        ml.show(ml.load_robot("planar3"), viewer)
