"""Names of robots -> files."""

from __future__ import annotations

import csv
import functools
import importlib.metadata
import importlib.resources
import re
from pathlib import Path, PurePosixPath

from manip_learn.errors import MissingExtraError, UnknownNameError, closest_names

DATA_PACKAGE = "example-robot-data"
SHIPPED = ("planar3", "sawyer", "fr3", "ur5e", "ur10e")

SERIES, NUMBER = re.compile(r"[a-z]+"), re.compile(r"\d+[a-z]?")  # ur and 5e in ur5e

# Names that are not, or not only, the stem of a file.
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
    "ur3": "ur_description/urdf/ur3_robot.urdf",
    "ur3_gripper": "ur_description/urdf/ur3_gripper.urdf",
    "ur3_limited": "ur_description/urdf/ur3_joint_limited_robot.urdf",
    "ur5": "ur_description/urdf/ur5_robot.urdf",
    "ur5_gripper": "ur_description/urdf/ur5_gripper.urdf",
    "ur5_limited": "ur_description/urdf/ur5_joint_limited_robot.urdf",
    "ur10": "ur_description/urdf/ur10_robot.urdf",
    "ur10_limited": "ur_description/urdf/ur10_joint_limited_robot.urdf",
}


def find_robot(name: str) -> Path:
    """File of a robot by its name: one that is shipped, else one of example-robot-data.

    Raises:
        UnknownNameError: No such robot; lists near matches.
        MissingExtraError: The robot is not shipped and example-robot-data is not installed.
    """
    if name in SHIPPED:
        return shipped_folder() / f"{name}.urdf"
    catalogue = example_robots()
    if name in catalogue:
        return catalogue[name]
    if not catalogue and name in SHORT_NAMES.keys() | {"panda", "xarm7", "kinova", "z1", "so100", "so101", "baxter"}:
        raise MissingExtraError(f"the robot {name!r}", "robots")
    known = robot_names()
    # a letter more, or another number, is another arm and no typing error
    near = closest_names(name, known) if NUMBER.search(name) else []
    others = [
        n
        for n in near
        if NUMBER.findall(n) != NUMBER.findall(name) and SERIES.findall(n)[:1] == SERIES.findall(name)[:1]
    ]
    where = "the list of robots (or give the path of a .urdf file)"
    raise UnknownNameError("robot", name, known, where, others=others)


def robot_names() -> tuple[str, ...]:
    """Every name that `load_robot` knows here and now."""
    return tuple(sorted({*SHIPPED, *example_robots()}))


def known_as(source: Path | None) -> str | None:
    """The shortest name by which `load_robot` finds this file; None for a file of one's own."""
    if source is not None and source.parent == shipped_folder() and source.stem in SHIPPED:
        return source.stem
    return min((name for name, path in example_robots().items() if path == source), key=len, default=None)


def shipped_folder() -> Path:
    """Folder of the robots that come with this package, in an installed wheel or in a checkout."""
    installed = Path(str(importlib.resources.files("manip_learn"))) / "_robots"
    return installed if installed.is_dir() else Path(__file__).resolve().parents[3] / "robots"


@functools.cache
def example_robots() -> dict[str, Path]:
    """Names and URDF files of example-robot-data; empty if it is not installed."""
    try:
        package = importlib.metadata.distribution(DATA_PACKAGE)
    except importlib.metadata.PackageNotFoundError:
        return {}
    names = {name: PurePosixPath(name).parts for name in _urdf_files(package)}
    files = {"/".join(p[p.index("robots") + 1 :] if "robots" in p else p[-1:]): name for name, p in names.items()}
    stems: dict[str, list[str]] = {}
    for key in files:
        stems.setdefault(PurePosixPath(key).stem, []).append(key)
    chosen = {stem: keys[0] for stem, keys in stems.items() if len(keys) == 1}
    chosen |= {short: key for short, key in SHORT_NAMES.items() if key in files}
    return {name: Path(str(package.locate_file(files[key]))) for name, key in chosen.items()}


def _urdf_files(package: importlib.metadata.Distribution) -> list[str]:
    """Its .urdf files; read off the record, since `Distribution.files` makes paths of a thousand meshes first."""
    record = package.read_text("RECORD")
    if record is None:
        return [str(f) for f in package.files or [] if f.suffix == ".urdf"]
    return [
        row[0]
        for row in csv.reader(line for line in record.splitlines() if ".urdf" in line)
        if row[0].endswith(".urdf")
    ]


def example_package_dir() -> Path | None:
    """Folder that contains the package example-robot-data, for `package://example-robot-data/...`; None without it."""
    for path in example_robots().values():
        for folder in path.parents:
            if folder.name == DATA_PACKAGE:
                return folder.parent
    return None
