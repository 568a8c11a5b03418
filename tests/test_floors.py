"""The structure of the library: imports only go down, third parties stay in their rooms."""

from __future__ import annotations

import ast
import re
import tomllib
from collections.abc import Iterator
from graphlib import TopologicalSorter

from library_source import PACKAGE, Source, library, listed

# Floors of the library; "4" and "4'" never import each other: they meet in constraint/.
FLOORS = {
    "errors": "0",
    "linalg": "0",
    "atomic_write": "0",
    "robot": "1",
    "recordings": "2",
    "constraint": "3",
    "learning": "4",
    "control": "4'",
    "planning": "5",
    "drivers": "5",
    "playback": "5",
    "plots": "6",
    "experiments": "6",
    "teach": "6",
    "commands": "7",
    "cli": "8",
    "__main__": "9",
}
# Who may import what from outside, at any depth. What is not named here may be imported everywhere.
ROOMS = {
    "pinocchio": {"robot", "planning", "playback"},
    "coal": {"robot", "planning", "playback"},
    "meshcat": {"playback"},
    "trimesh": {"robot", "playback"},
    "yourdfpy": {"robot", "playback"},
    "xacrodoc": {"robot"},
    "pink": {"control"},
    "rosbags": {"recordings"},
    "pyarrow": {"recordings"},
    "h5py": {"recordings"},
    "typer": {"cli", "commands"},
    "rich": {"cli", "commands"},
    "matplotlib": {"experiments", "plots"},
    "joblib": {"experiments"},
    "mujoco": {"drivers", "robot", "teach"},
    "dask": {"learning"},
    "distributed": {"learning"},
    "pickle": set(),
}
IMPORTED_AS = {"pin": "pinocchio"}
# a sentence and exit code 1 for our own failures, never a traceback; an arm in motion brakes, whatever a task of the
# user's own, or a driver, raises; parsers of meshes and expressions of xacro files are code of others
LAST_LINES_OF_DEFENCE = (
    *("cli.py", "control/servo_loop.py", "control/driver.py"),
    *("robot/visuals/meshes.py", "robot/description/xacro_expansion.py"),
    *("drivers/record.py", "commands/record.py", "teach/worker.py"),
    "playback/live_viewer.py",
)


def own_imports(source: Source) -> Iterator[tuple[str, int]]:
    """Files of the library that a file imports, by their name in `library()`."""
    names = {s.name for s in library()}
    for target, line in source.imports():
        if target.split(".")[0] != "manip_learn":
            continue
        inner = target.removeprefix("manip_learn").lstrip(".")
        while inner and inner not in names:
            inner = inner.rpartition(".")[0]
        yield inner, line


def test_every_file_has_a_floor():
    """A new module is given its floor in the table above before it is used, and no floor is empty."""
    assert {s.top for s in library() if s.name} == FLOORS.keys()


def test_imports_only_go_down():
    """No file imports from a higher floor; 4 and 4' do not import each other; nothing but the commands, which use the
    library as a user does, imports the package's front, and what they take there counts as imported from its module.
    """
    faults = []
    for source in library():
        if source.name == "":  # the front door re-exports, lazily
            continue
        here = FLOORS[source.top]
        for target, line in own_imports(source):
            where = f"{source.relative}:{line} imports {target or 'the package itself'}"
            if not target and source.top == "commands":
                continue
            if not target:
                faults.append(f"{where}: import from the module where the name lives")
                continue
            there = FLOORS[target.split(".")[0]]
            if there[0] > here[0]:
                faults.append(f"{where}, which is on floor {there}, from floor {here}")
            if {here, there} == {"4", "4'"}:
                faults.append(f"{where}: learning and control meet in constraint/ only")
    assert not faults, listed(faults)


def test_no_import_cycles():
    """Files can be put in an order in which each imports only from those before it, imports for types included."""
    graph = {s.name: {target for target, _ in own_imports(s)} for s in library() if s.name}
    order = list(TopologicalSorter(graph).static_order())
    assert len(order) >= len(graph)


def test_third_parties_stay_in_their_rooms():
    """Pinocchio in robot/, planning/ and playback/, formats in recordings/, tools of the command line in commands/."""
    faults = []
    for source in library():
        for target, line in source.imports():
            allowed = ROOMS.get(target.split(".")[0])
            if allowed is not None and source.top not in allowed:
                faults.append(f"{source.relative}:{line} imports {target}")
    assert not faults, listed(faults)


def test_every_dependency_is_imported():
    """What pyproject.toml asks of each user is imported somewhere in the library."""
    project = tomllib.loads((PACKAGE.parent / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    names = {re.split(r"[\[<>=!~; ]", line)[0] for line in project["dependencies"]}
    imported = {target.split(".")[0] for s in library() for target, _line in s.imports()} | {
        "meshcat"
    }  # its viewer's script
    assert {IMPORTED_AS.get(name, name) for name in names} - imported == set()


def test_names_say_what_is_inside():
    """No utils, misc, common or helpers: a function with no home is asking for a noun."""
    vague = {"utils", "util", "misc", "common", "helpers", "tools", "core", "base"}
    assert [s.relative for s in library() if vague & set(s.name.split("."))] == []


def test_no_blanket_handlers_and_no_asserts():
    """Handlers name what they handle; bad input raises an error of ours, never an assertion that -O removes."""
    faults = []
    for source in library():
        for node in ast.walk(source.tree):
            where = f"{source.relative}:{getattr(node, 'lineno', '')}"
            if isinstance(node, ast.Assert):
                faults.append(f"{where}: no assert in the library")
            if isinstance(node, ast.ExceptHandler) and source.relative not in LAST_LINES_OF_DEFENCE:
                if node.type is None or ast.unparse(node.type) in ("Exception", "BaseException"):
                    faults.append(f"{where}: which error is meant?")
            if isinstance(node, ast.Call) and ast.unparse(node.func) in ("hasattr", "eval", "exec", "np.random.seed"):
                faults.append(f"{where}: {ast.unparse(node.func)} is not used in this project")
    assert not faults, listed(faults)
