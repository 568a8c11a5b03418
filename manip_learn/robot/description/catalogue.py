"""Find the description file of a robot by its name."""

from __future__ import annotations

import contextlib
import csv
import functools
import importlib.metadata
import importlib.resources
import pkgutil
import re
import sys
from collections import Counter
from collections.abc import Mapping
from importlib.util import find_spec
from pathlib import Path, PurePosixPath

from manip_learn.atomic_write import write_atomically
from manip_learn.errors import MissingExtraError, RobotError, UnknownNameError, closest_names
from manip_learn.robot.description.xacro_expansion import expand_xacro

DATA_PACKAGE = "example-robot-data"
SHIPPED = ("planar3", "sawyer", "fr3", "ur5e", "ur10e")
FETCHING = "robot_descriptions"  # a package that clones a description from the internet at its first use
EXPANDED = ".manip_learn.urdf"  # ending of a URDF expanded from one of its xacro files, in the same folder
# arms that this package describes as a variant of another: name -> the other, and the arguments of its xacro file
VARIANTS: dict[str, tuple[str, Mapping[str, str]]] = {"lite6": ("xarm6", {"robot_type": "lite"})}

# names that differ from the stem of a file, or whose stem is ambiguous
SHORT_NAMES = {
    "anymal": "anymal_b_simple_description/robots/anymal.urdf",
    "anymal_c": "anymal_c_simple_description/urdf/anymal.urdf",
    "anymal_kinova": "anymal_b_simple_description/robots/anymal-kinova.urdf",
    "b1_z1": "b1_description/urdf/b1-z1.urdf",
    "g1": "g1_description/urdf/g1_29dof_rev_1_0.urdf",
    "hector": "hector_description/robots/quadrotor_base.urdf",
    "talos": "talos_data/robots/talos_reduced.urdf",
    "talos_arm": "talos_data/robots/talos_left_arm.urdf",
    "talos_full": "talos_data/robots/talos_full_v2.urdf",
}


def find_robot(name: str) -> Path:
    """Return the description file of a robot by its name.

    Robots are shipped with this package, from example-robot-data, or downloaded by robot_descriptions.

    Args:
        name: Name of the robot; capitals, hyphens and spaces are ignored, e.g. `SO-101` is `so101`.

    Raises:
        UnknownNameError: There is no such robot; lists near matches.
        MissingExtraError: The robot is in a package that is not installed.
        RobotError: The robot cannot be downloaded.
    """

    def letters(text: str) -> str:
        return re.sub(r"[\W_]", "", text.lower())

    names, fetched = robot_names(), fetched_names()
    if name not in names:
        name = next((other for other in names if letters(other) == letters(name)), name)
    if name in SHIPPED:
        return shipped_folder() / f"{name}.urdf"
    catalogue = example_robots()
    if name in catalogue:
        return catalogue[name]
    often_named = r"ur(3|5|10)(_gripper|_limited)?|panda|xarm7|kinova|z1|so100|so101|baxter"
    if not catalogue and (name in SHORT_NAMES or re.fullmatch(often_named, name)):
        raise MissingExtraError(f"the robot {name!r}", "robots")
    if name in fetched:
        return _fetch(name)
    if not fetched and letters(name) in ("xarm6", *VARIANTS):
        raise MissingExtraError(f"the robot {name!r}", "descriptions")
    # one more letter, or another number, is a different arm and not a typing error: ur and 5e in ur5e
    series, numbers = re.compile(r"^[^a-z]*([a-z]+)").findall, re.compile(r"\d+[a-z]?").findall
    near = closest_names(name, names) if numbers(name) else []
    others = [n for n in near if numbers(n) != numbers(name) and series(n) == series(name.lower())]
    raise UnknownNameError("robot", name, names, "the list of robots (or give the path of a .urdf file)", others=others)


def robot_names() -> tuple[str, ...]:
    """Return every name that `load_robot` knows in this installation, sorted."""
    return tuple(sorted({*SHIPPED, *example_robots(), *fetched_names()}))


@functools.cache
def fetched_names() -> frozenset[str]:
    """Return the names of the robots that robot_descriptions can download; empty if it is not installed."""
    package = find_spec(FETCHING)
    modules = pkgutil.iter_modules((package and package.submodule_search_locations) or ())
    matches = (re.fullmatch(r"([^_].*)(?<!_mj)_description", module.name) for module in modules)
    names = {match[1] for match in matches if match}
    return frozenset(names | {name for name, (other, _) in VARIANTS.items() if other in names})


def _fetch(name: str) -> Path:
    """Return the file of a fetched robot; later calls find it in the package's cache, without the internet.

    Raises:
        RobotError: It cannot be fetched.
        MissingExtraError: It has to be expanded, and xacrodoc is not installed.
    """
    from git.exc import GitError  # type: ignore[import-not-found]  # GitPython, which robot_descriptions needs

    other, arguments = VARIANTS.get(name, (name, {}))
    try:
        with contextlib.redirect_stdout(sys.stderr):  # it prints the repositories that it clones
            content = vars(importlib.import_module(f"{FETCHING}.{other}_description"))
    except (ImportError, OSError, GitError) as error:
        reason = f"{name} is downloaded at its first use, and the download failed: {type(error).__name__}"
        fix = "connect this machine once, or give the path of a URDF file"
        raise RobotError(f"{reason}; {fix}", code="missing") from error
    if "URDF_PATH" in content:
        return Path(content["URDF_PATH"])
    source = Path(content["XACRO_PATH"])
    file = source.with_name(name + EXPANDED)
    if not file.exists():
        values = {**content.get("XACRO_ARGS", {}), **arguments}
        write_atomically(file, expand_xacro(source, values, [Path(content["REPOSITORY_PATH"])], lambda package: None))
    return file


def known_as(source: Path | None) -> str | None:
    """Return the shortest name with which `load_robot` finds a description file.

    Args:
        source: The file; None if the robot has none.

    Returns:
        The name; None for a user's own file, or without a file.
    """
    if source is not None and source.parent == shipped_folder() and source.stem in SHIPPED:
        return source.stem
    if source is not None and source.name.endswith(EXPANDED):
        return source.name.removesuffix(EXPANDED)
    return min((name for name, path in example_robots().items() if path == source), key=len, default=None)


def shipped_folder() -> Path:
    """Return the folder of the robots that come with this package, in an installed wheel or in a checkout."""
    installed = Path(str(importlib.resources.files("manip_learn"))) / "_robots"
    return installed if installed.is_dir() else Path(__file__).resolve().parents[3] / "robots"


@functools.cache
def example_robots() -> dict[str, Path]:
    """Return the names and URDF files of example-robot-data; empty if it is not installed."""
    try:
        package = importlib.metadata.distribution(DATA_PACKAGE)
    except importlib.metadata.PackageNotFoundError:
        return {}
    # read the RECORD file directly: `Distribution.files` would create paths of a thousand meshes
    rows = csv.reader(line for line in (package.read_text("RECORD") or "").splitlines() if ".urdf" in line)
    names = {row[0]: PurePosixPath(row[0]).parts for row in rows if row[0].endswith(".urdf")}
    files = {"/".join(p[p.index("robots") + 1 :] if "robots" in p else p[-1:]): name for name, p in names.items()}
    stems = {key: PurePosixPath(key).stem for key in files}
    number = Counter(stems.values())
    key_of_name = {stem: key for key, stem in stems.items() if number[stem] == 1}
    # ur5_robot is also called ur5, and ur5_joint_limited_robot is also called ur5_limited
    shorter = {stem: stem.replace("_joint_limited", "_limited").removesuffix("_robot") for stem in key_of_name}
    key_of_name |= {shorter[stem]: key for stem, key in key_of_name.items()}
    key_of_name |= {short: key for short, key in SHORT_NAMES.items() if key in files}
    return {name: Path(str(package.locate_file(files[key]))) for name, key in key_of_name.items()}


def example_package_dir() -> Path | None:
    """Return the folder that contains the package example-robot-data, for `package://example-robot-data/...`.

    Returns:
        The folder; None if the package is not installed.
    """
    folders = (folder for path in example_robots().values() for folder in path.parents)
    return next((folder.parent for folder in folders if folder.name == DATA_PACKAGE), None)
