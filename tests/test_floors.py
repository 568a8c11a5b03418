"""The structure of the library: imports only go down, third parties stay in their rooms, files stay small."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from graphlib import TopologicalSorter

import pytest
from library_source import Source, library

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
    "playback": "5",
    "experiments": "6",
    "commands": "7",
    "cli": "8",
    "__main__": "9",
}
# Who may import what from outside, at any depth. What is not named here may be imported everywhere.
ROOMS = {
    "pinocchio": {"robot", "playback"},
    "coal": {"robot", "playback"},
    "meshcat": {"playback"},
    "trimesh": {"robot", "playback"},
    "yourdfpy": {"robot", "playback"},
    "defusedxml": {"robot", "playback"},
    "xacrodoc": {"robot"},
    "numba": {"robot", "control"},
    "rosbags": {"recordings"},
    "pyarrow": {"recordings"},
    "h5py": {"recordings"},
    "typer": {"cli", "commands"},
    "rich": {"cli", "commands", "experiments"},
    "matplotlib": {"experiments"},
    "joblib": {"experiments", "learning"},
    "mujoco": {"experiments", "robot"},
    "dask": {"experiments", "learning"},
    "distributed": {"experiments", "learning"},
    "pickle": set(),
}
LAST_LINES_OF_DEFENCE = ("cli.py",)  # a sentence and exit code 1 for our own failures, never a traceback
MAX_LINES, MAX_FUNCTION_LINES = 300, 50
# Each with the size that it may not outgrow. Robot has one state, Pinocchio's, that all of its methods share.
LONG_FILES = {"robot/robot.py": 530}

SOURCES = library()
by_file = pytest.mark.parametrize("source", SOURCES, ids=lambda s: s.relative)


def own_imports(source: Source) -> Iterator[tuple[str, int]]:
    """Files of the library that a file imports, by their name in `library()`."""
    names = {s.name for s in SOURCES}
    for target, line in source.imports():
        if target.split(".")[0] != "manip_learn":
            continue
        inner = target.removeprefix("manip_learn").lstrip(".")
        while inner and inner not in names:
            inner = inner.rpartition(".")[0]
        yield inner, line


@by_file
def test_every_file_has_a_floor(source):
    """A new module is given its floor in the table above before it is used."""
    assert source.top in FLOORS or source.name == ""


@by_file
def test_imports_only_go_down(source):
    """No file imports from a higher floor; 4 and 4' do not import each other; nothing imports the package's front."""
    if source.name == "":  # the front door re-exports, lazily
        return
    here = FLOORS[source.top]
    for target, line in own_imports(source):
        where = f"{source.relative}:{line} imports {target or 'the package itself'}"
        assert target, f"{where}: import from the module where the name lives"
        there = FLOORS[target.split(".")[0]]
        assert there[0] <= here[0], f"{where}, which is on floor {there}, from floor {here}"
        assert {here, there} != {"4", "4'"}, f"{where}: learning and control meet in constraint.py only"


def test_no_import_cycles():
    """Files can be put in an order in which each imports only from those before it (names for types alone aside)."""
    graph = {s.name: {t for t, line in own_imports(s) if line not in s.typing_lines()} for s in SOURCES if s.name}
    order = list(TopologicalSorter(graph).static_order())
    assert len(order) >= len(graph)


@by_file
def test_third_parties_stay_in_their_rooms(source):
    """Pinocchio in robot/ and playback/ only, each file format in io/, the command line's tools in cli, and so on."""
    for target, line in source.imports():
        allowed = ROOMS.get(target.split(".")[0])
        assert allowed is None or source.top in allowed, f"{source.relative}:{line} imports {target}"


@by_file
def test_names_say_what_is_inside(source):
    """No utils, misc, common or helpers: a function with no home is asking for a noun."""
    assert not {"utils", "util", "misc", "common", "helpers", "tools", "core", "base"} & set(source.name.split("."))


@by_file
def test_files_are_small(source):
    """One noun or verb a file, within 300 lines."""
    lines = source.text.count("\n")
    assert lines <= LONG_FILES.get(source.relative, MAX_LINES), f"{source.relative} has {lines} lines: split it"


@by_file
def test_functions_are_small(source):
    """Functions stay within 50 lines, not counting their signatures (options are a table) and docstrings."""
    for node in ast.walk(source.tree):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            body = node.body[1:] if ast.get_docstring(node) is not None else node.body
            lines = (node.end_lineno or 0) - body[0].lineno + 1 if body else 0
            assert lines <= MAX_FUNCTION_LINES, f"{source.relative}: {node.name} has {lines} lines: split it"


@by_file
def test_no_blanket_handlers_and_no_asserts(source):
    """Handlers name what they handle; bad input raises an error of ours, never an assertion that -O removes."""
    for node in ast.walk(source.tree):
        where = f"{source.relative}:{getattr(node, 'lineno', '')}"
        assert not isinstance(node, ast.Assert), f"{where}: no assert in the library"
        if isinstance(node, ast.ExceptHandler) and source.relative not in LAST_LINES_OF_DEFENCE:
            caught = ast.unparse(node.type) if node.type else ""
            assert caught not in ("", "Exception", "BaseException"), f"{where}: which error is meant?"
        if isinstance(node, ast.Call) and ast.unparse(node.func) in ("hasattr", "eval", "exec", "np.random.seed"):
            pytest.fail(f"{where}: {ast.unparse(node.func)} is not used in this project")


def test_the_tables_are_up_to_date():
    """No file keeps a place on the list of long ones that it no longer needs."""
    sizes = {s.relative: s.text.count("\n") for s in SOURCES}
    assert all(sizes.get(name, 0) > MAX_LINES for name in LONG_FILES)
