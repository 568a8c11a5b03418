"""Robots that the tests share, and how hard Hypothesis tries."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path
from typing import Any

import hypothesis
import pytest
from shape_checker import install_shape_checks

hypothesis.settings.register_profile("default", max_examples=25, deadline=None, derandomize=True)
hypothesis.settings.register_profile(
    "fuzz", max_examples=int(os.environ.get("HYPOTHESIS_EXAMPLES", "2000")), deadline=None, print_blob=True
)
hypothesis.settings.load_profile(os.environ.get("HYPOTHESIS_PROFILE", "default"))

if os.environ.get("CHECK_SHAPES", "0") != "0":
    install_shape_checks()

import numpy as np  # noqa: E402

from manip_learn.cli import main  # noqa: E402
from manip_learn.constraint.features.frame_jacobian import FrameJacobian  # noqa: E402
from manip_learn.robot.loading import load_robot  # noqa: E402
from manip_learn.robot.robot import Robot  # noqa: E402

BROWSER_FLAGS = ["--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-background-networking"]
BROWSERS = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
ARMS = Path(__file__).with_name("arms")


URDFS = {
    name: (ARMS / f"{name}.urdf").read_text(encoding="utf-8")
    for name in ("one", "gantry", "wrist", "humanoid", "rover", "tree", "mimic")
}


def chain_with(folder: Path, joints: list[tuple[str, str, str, str]], shapes: dict[str, str], most: float = 2) -> Robot:
    """A robot of links one after the other, with limits of +-`most`, and with elements in links: link -> element; each
    joint is (type, axis, origin xyz, origin rpy), inertias everywhere.
    """
    inertia = '<inertia ixx="0.01" ixy="0" ixz="0" iyy="0.02" iyz="0" izz="0.03"/>'
    inertial = f'<inertial><origin xyz="0.1 0.02 -0.05"/><mass value="1.5"/>{inertia}</inertial>'
    links = ["base", *(f"link{i}" for i in range(len(joints)))]
    text = "".join(f'<link name="{link}">{shapes.get(link, "")}{inertial}</link>' for link in links)
    tip = ("fixed", "1 0 0", "0.3 -0.1 0.2", "0.4 0.3 -0.2")
    for i, (child, (kind, axis, xyz, rpy)) in enumerate(zip([*links[1:], "tip"], [*joints, tip], strict=True)):
        text += (
            f'<joint name="joint{i}" type="{kind}"><parent link="{links[i]}"/><child link="{child}"/>'
            f'<origin xyz="{xyz}" rpy="{rpy}"/><axis xyz="{axis}"/>'
            f'<limit lower="-{most}" upper="{most}" velocity="2" effort="10"/></joint>'
        )
    (folder / "chain.urdf").write_text(f'<robot name="chain">{text}<link name="tip"/></robot>', encoding="utf-8")
    return load_robot(folder / "chain.urdf")


TIPS = {
    "planar3": "tip",
    "sawyer": "right_hand",
    "panda": "panda_hand_tcp",
    "ur5": "tool0",
    "kinova": "j2s6s200_end_effector",
}
BASES = {"humanoid": "floating", "rover": "planar"}
LOCKED = {"panda": ("panda_finger_joint1",)}


@cache
def named_robot(name: str) -> Robot:
    """A robot of `URDFS`, of the project's `robots` folder, or of example-robot-data."""
    if name in URDFS:
        return load_robot(ARMS / f"{name}.urdf", base=BASES.get(name, "fixed"))
    return load_robot(name, locked=LOCKED.get(name, ()))


def tip_of(robot_name: str) -> str:
    """The frame that the tests look at."""
    return TIPS.get(robot_name, "tip")


@pytest.fixture(scope="session")
def robot_of() -> Callable[[str], Robot]:
    """Name -> robot, each built once."""
    return named_robot


@pytest.fixture(scope="session")
def sawyer(robot_of: Callable[[str], Robot]) -> Robot:
    """The shipped seven-joint arm."""
    return robot_of("sawyer")


@pytest.fixture(scope="session")
def features(sawyer: Robot) -> FrameJacobian:
    """Where the gripper of the shipped seven-joint arm goes."""
    return FrameJacobian(sawyer, "right_gripper_tip", "xyz")


@pytest.fixture(scope="session")
def panda(robot_of: Callable[[str], Robot]) -> Robot:
    """A Panda whose fingers are locked."""
    return robot_of("panda")


@pytest.fixture(scope="session")
def planar3() -> Robot:
    """The shipped three-joint arm."""
    return load_robot("planar3")


@pytest.fixture
def run(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Callable[..., Any]:
    """Runs one command line in an empty folder: exit code, standard output, standard error."""
    monkeypatch.chdir(tmp_path)
    return lambda *words: (main([str(word) for word in words]), *capsys.readouterr())


@pytest.fixture
def answer(run: Callable[..., Any]) -> Callable[..., Any]:
    """Runs one command line that succeeds: its JSON document, with nothing on standard error."""

    def call(*words: object) -> Any:
        code, out, err = run(*words, "--json")
        assert (code, err) == (0, "")
        return json.loads(out)

    return call


@pytest.fixture(scope="module")
def chromium() -> Iterator[Any]:
    """One browser for all tests of a file."""
    found = next((path for name in BROWSERS if (path := shutil.which(name))), None)
    if found is None:
        pytest.skip(f"NO CHROMIUM ({', '.join(BROWSERS)}): THE REPLAY PAGE IS NOT TESTED IN A BROWSER")
    playwright = pytest.importorskip("playwright.sync_api", reason="NO PLAYWRIGHT: THE REPLAY PAGE IS NOT TESTED")
    with playwright.sync_playwright() as p:
        browser = p.chromium.launch(executable_path=found, args=[*BROWSER_FLAGS, "--enable-unsafe-swiftshader"])
        yield browser
        browser.close()


@pytest.fixture
def rng() -> np.random.Generator:
    """The same random numbers in every test."""
    return np.random.default_rng(20191103)
