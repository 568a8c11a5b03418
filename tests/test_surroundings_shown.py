"""What a plan keeps clear of: in its rollout and its files, on the page; and furniture that stops an arm."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from test_playback import data_in

import manip_learn as ml
from manip_learn.errors import RecordingError
from manip_learn.robot.tips import default_tip

TRIANGLES = ([[0, 0, 0], [0.1, 0, 0], [0, 0.1, 0], [0, 0, 0.1]], [[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]])
READY = [0.0, -0.5, 0.0, 1.4, 0.0, 0.6, 0.0]


@pytest.fixture(scope="module")
def sawyer() -> ml.Robot:
    return ml.load_robot("sawyer")


@pytest.fixture(scope="module")
def planned(sawyer: ml.Robot) -> ml.Plan:
    """A way among one thing of each kind."""
    drawer = ml.Constraint([[0, 1, 0], [0, 0, 1]], ml.FrameJacobian(sawyer, "right_gripper_tip"))
    scene = ml.Scene(
        floor=-0.9,
        boxes=[ml.Box((0.3, 0.2, 0.1), (0.3, 0.9, 0.2), "box")],
        spheres=[ml.Sphere(0.1, (0.3, -0.9, 0.2), "ball")],
        cylinders=[ml.Cylinder(0.05, 0.4, (-0.6, 0.5, 0.2), "post")],
        meshes=[ml.Mesh(TRIANGLES, (-0.6, -0.5, 0.2), "wedge")],
    )
    return ml.plan(drawer, ml.motion(drawer, along=-0.1), READY, candidates=48, scene=scene)


def test_a_rollout_carries_what_stands_around(planned: ml.Plan, sawyer: ml.Robot, tmp_path: Path):
    """Names, kinds, sizes and places, in both formats that are read back and on its page; damaged ones are refused."""
    around = {thing["name"]: thing for thing in planned.rollout.around}
    kinds = {"floor": "face", "box": "box", "ball": "sphere", "post": "cylinder", "wedge": "mesh"}
    assert {name: thing["kind"] for name, thing in around.items()} == kinds
    assert around["box"]["size"] == pytest.approx([0.3, 0.2, 0.1])
    assert around["post"]["size"] == pytest.approx([0.05, 0.4])
    assert np.array(around["floor"]["pose"])[2, 3] == pytest.approx(-0.9)
    assert len(around["wedge"]["faces"]) == 4 and not any(thing["assumed"] for thing in around.values())
    for name in ("a.npz", "a.csv"):
        assert ml.Rollout.load(planned.save(tmp_path / name), sawyer).around == planned.rollout.around
    page = data_in(ml.replay(sawyer, {"plan": planned.rollout}, tmp_path / "a.html", open_browser=False).html)
    things = {thing["name"]: thing for thing in page["rollouts"][0]["around"]}
    assert things["box"]["size"] == [0.3, 0.2, 0.1] and things["post"]["size"] == [0.05, 0.4]
    places = {name: np.reshape(thing["pose"], (4, 4))[:3, 3].tolist() for name, thing in things.items()}
    assert places["box"] == [0.3, 0.9, 0.2] and places["ball"] == [0.3, -0.9, 0.2]
    assert [name for name, thing in things.items() if thing["mesh"]] == ["wedge"]
    file = tmp_path / "a.csv"
    file.write_text(file.read_text().replace('"kind": "sphere"', '"kind": "cloud"'))
    with pytest.raises(RecordingError):
        ml.Rollout.load(file, sawyer)


@pytest.mark.parametrize("kind", ["drawer", "door", "table"])
def test_furniture_stops_an_arm_that_is_drawn_through_it(sawyer: ml.Robot, kind: str):
    """Pulled with a person's force to a place behind the furniture, the hand does not get there."""
    pytest.importorskip("mujoco")
    from manip_learn.teach.arm import TeachingArm
    from manip_learn.teach.scene import place_scene

    scene = place_scene(kind, sawyer, default_tip(sawyer), np.random.default_rng(4))  # type: ignore[arg-type]
    handle, arm = scene.handle, TeachingArm(scene, np.random.default_rng(0), in_real_time=False)
    start = arm.place
    behind = -0.35 * handle.axis if kind == "table" else -0.6 * handle.pose[:3, 1]
    goal = handle.pose[:3, 3] + behind
    for k in range(400):
        arm.pull(None, None, start + (goal - start) * min(1.0, k / 300))
        arm.wait()
    assert np.linalg.norm(arm.place - goal) > 0.1
    assert np.max(np.abs(arm.data.qvel)) < 0.5
