"""Robots that the tests share, and how hard Hypothesis tries."""

from __future__ import annotations

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

from manip_learn.robot.loading import load_robot  # noqa: E402
from manip_learn.robot.robot import Robot  # noqa: E402

BROWSER_FLAGS = ["--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-background-networking"]
BROWSERS = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
ROBOTS = Path(__file__).resolve().parents[1] / "robots"


def chain_urdf(name: str, joints: list[tuple[str, str, str, str]], extra: str = "") -> str:
    """URDF of links one after the other; each joint is (type, axis, origin xyz, origin rpy), inertias everywhere."""
    links = [_link("base")]
    for i, (kind, axis, xyz, rpy) in enumerate(joints):
        parent = "base" if i == 0 else f"link{i - 1}"
        limit = "" if kind == "continuous" else '<limit lower="-2" upper="2" velocity="2" effort="10"/>'
        links.append(_link(f"link{i}"))
        links.append(
            f'<joint name="joint{i}" type="{kind}"><parent link="{parent}"/><child link="link{i}"/>'
            f'<origin xyz="{xyz}" rpy="{rpy}"/><axis xyz="{axis}"/>{limit}</joint>'
        )
    return f'<robot name="{name}">{"".join(links)}{extra}{_tip(len(joints) - 1)}</robot>'


def chain_with(folder: Path, joints: list[tuple[str, str, str, str]], shapes: dict[str, str], most: float = 2) -> Robot:
    """A robot of `chain_urdf` in a folder, with limits of +-`most`, and with elements in links: link -> element."""
    text = chain_urdf("chain", joints).replace('lower="-2" upper="2"', f'lower="-{most}" upper="{most}"')
    for link, element in shapes.items():
        text = text.replace(f'<link name="{link}">', f'<link name="{link}">{element}')
    (folder / "chain.urdf").write_text(text, encoding="utf-8")
    return load_robot(folder / "chain.urdf")


def _link(name: str) -> str:
    return (
        f'<link name="{name}"><inertial><origin xyz="0.1 0.02 -0.05"/><mass value="1.5"/>'
        '<inertia ixx="0.01" ixy="0" ixz="0" iyy="0.02" iyz="0" izz="0.03"/></inertial></link>'
    )


def _tip(last: int) -> str:
    return (
        f'<link name="tip"/><joint name="tip_fixed" type="fixed"><parent link="link{last}"/><child link="tip"/>'
        '<origin xyz="0.3 -0.1 0.2" rpy="0.4 0.3 -0.2"/></joint>'
    )


ONE = [("revolute", "0 0.6 0.8", "0.1 0.2 0.3", "0.1 0 0.3")]
GANTRY = [
    ("prismatic", "1 0 0", "0 0 0.4", "0 0 0"),
    ("prismatic", "0 1 0", "0.1 0 0.2", "0 0 0.5"),
    ("revolute", "0 0 1", "0 0.3 0", "0.2 0 0"),
    ("revolute", "0.6 0 0.8", "0.2 0 0.4", "0 0.7 0"),
    ("prismatic", "0 0.8 0.6", "0 0.1 0.2", "0 0 0"),
]
WRIST = [
    ("continuous", "0 0 1", "0 0 0.3", "0 0 0"),
    ("revolute", "0 1 0", "0.4 0 0", "0 0 0.2"),
    ("continuous", "1 0 0", "0.3 0 0.1", "0.3 0 0"),
    ("revolute", "0 1 0", "0.2 0 0", "0 0 0"),
]
BRANCH = (
    _link("arm_a")
    + _link("arm_b")
    + '<joint name="a_side" type="revolute"><parent link="link1"/><child link="arm_a"/><origin xyz="0 0.3 0"/>'
    '<axis xyz="1 0 0"/><limit lower="-2" upper="2" velocity="1" effort="1"/></joint>'
    '<joint name="z_side" type="prismatic"><parent link="arm_a"/><child link="arm_b"/><origin xyz="0 0.1 0.2"/>'
    '<axis xyz="0 1 0"/><limit lower="-1" upper="1" velocity="1" effort="1"/></joint>'
)

URDFS = {
    "one": chain_urdf("one", ONE),
    "gantry": chain_urdf("gantry", GANTRY),
    "wrist": chain_urdf("wrist", WRIST),
    "humanoid": chain_urdf("humanoid", [*WRIST[1:3], GANTRY[4]]),
    "rover": chain_urdf("rover", [*GANTRY[2:4], WRIST[0]]),
    "tree": chain_urdf("tree", [*GANTRY[1:4], ("revolute", "0 1 0", "0.1 0 0.1", "0 0 0")], BRANCH),
    "mimic": chain_urdf("mimic", [*GANTRY[2:4], ("revolute", "0 1 0", "0.2 0 0.1", "0 0 0"), *GANTRY[4:]]).replace(
        '<axis xyz="0 1 0"/>', '<axis xyz="0 1 0"/><mimic joint="joint0" multiplier="-0.7" offset="0.2"/>', 1
    ),
}
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
def named_robot(name: str, folder: Path) -> Robot:
    """A robot of `URDFS`, of the project's `robots` folder, or of example-robot-data."""
    if name in URDFS:
        path = folder / f"{name}.urdf"
        path.write_text(URDFS[name], encoding="utf-8")
        return load_robot(path, base=BASES.get(name, "fixed"))
    return load_robot(name, locked=LOCKED.get(name, ()))


def table(name: str) -> list[list[str]]:
    """The rows of a table of `tests/data`: cells with `|` between, the last of which may have some; a header first."""
    header, *lines = (Path(__file__).parent / "data" / name).read_text(encoding="utf-8").splitlines()
    return [[cell.strip() for cell in line.split("|", header.count("|"))] for line in lines]


def tip_of(robot_name: str) -> str:
    """The frame that the tests look at."""
    return TIPS.get(robot_name, "tip")


@pytest.fixture(scope="session")
def robot_of(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Robot]:
    """Name -> robot, each built once."""
    folder = tmp_path_factory.mktemp("robots")
    return lambda name: named_robot(name, folder)


@pytest.fixture(scope="session")
def sawyer(robot_of: Callable[[str], Robot]) -> Robot:
    """The shipped seven-joint arm."""
    return robot_of("sawyer")


@pytest.fixture(scope="session")
def panda(robot_of: Callable[[str], Robot]) -> Robot:
    """A Panda whose fingers are locked."""
    return robot_of("panda")


@pytest.fixture(scope="session")
def planar3() -> Robot:
    """The shipped three-joint arm."""
    return load_robot("planar3")


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
