"""The public names: they exist, are documented, and cost nothing until they are used."""

from __future__ import annotations

import inspect
import re
import subprocess
import sys
import tomllib

import pytest
from library_source import PACKAGE, library

import manip_learn as ml

HEAVY = (
    "meshcat IPython matplotlib dask distributed rosbags pyarrow h5py mujoco yourdfpy trimesh typer "
    "scipy pinocchio xacrodoc joblib"
).split()
OPTIONAL = "example_robot_data mujoco rosbags pyarrow h5py dask distributed xacrodoc matplotlib joblib".split()


def run(code: str) -> subprocess.CompletedProcess[str]:
    """A fresh interpreter: what this one has imported already proves nothing."""
    return subprocess.run([sys.executable, "-W", "error", "-c", code], capture_output=True, text=True, timeout=100)


def test_names_exist_and_are_documented():
    """Each name in __all__ can be reached, has a docstring of its own, and is not hidden by a module of that name."""
    things = {name: getattr(ml, name) for name in ml.__all__}
    assert [name for name, thing in things.items() if inspect.ismodule(thing)] == []
    assert [name for name, thing in things.items() if not inspect.getdoc(thing)] == []


def test_all_is_sorted_and_complete():
    """__all__ is in order, without repeats, has nothing private, and dir() shows that and the version, nothing else."""
    assert list(ml.__all__) == sorted(set(ml.__all__))
    assert not [n for n in ml.__all__ if n.startswith("_")]
    assert dir(ml) == sorted([*ml.__all__, "__version__"])


def test_contract():
    """The names that the documentation promises are there."""
    promised = (
        "load_robot FrameJacobian CentreOfMass Stacked CustomFeatures load_demonstrations Demonstrations Trajectory "
        "ConstraintLearner Constraint manipulability manipulability_gradient ResolvedRateController PointAttractor "
        "ManipulabilityAscent JointAttractor ZeroPolicy simulate replay Rollout ManipLearnError"
    )
    assert set(promised.split()) <= set(ml.__all__)


def test_unknown_names_are_attribute_errors():
    """A misspelt name fails as Python users expect."""
    with pytest.raises(AttributeError, match="simulat"):
        _ = ml.simulat
    with pytest.raises(ImportError):
        from manip_learn import simulat  # type: ignore[attr-defined]  # noqa: F401


@pytest.mark.parametrize(
    ("name", "instead"),
    [
        ("optimise_path", "ml.plan"),
        ("CompiledController", "the ResolvedRateController itself"),
        ("warm_up", "leave"),
        ("following_error_limit", "Contact"),
        ("find_mechanism", "report_.mechanism"),
        ("MechanismFit", "report_.mechanism"),
    ],
)
def test_a_removed_name_says_what_replaces_it(name, instead):
    """Until 0.3, in one sentence that names the name."""
    with pytest.raises(AttributeError, match=f"{name} has been removed.*{instead}"):
        getattr(ml, name)


def test_every_dependency_is_imported():
    """What pyproject.toml asks of each user is imported somewhere in the library; of meshcat it is the viewer."""
    project = tomllib.loads((PACKAGE.parent / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    names = {re.split(r"[\[<>=!~; ]", line)[0].replace("-", "_") for line in project["dependencies"]} - {"meshcat"}
    text = "\n".join(source.text for source in library())
    imported = set(re.findall(r"^\s*(?:from|import) (\w+)", text, re.MULTILINE))
    assert names - imported <= {"pin"} and "pinocchio" in imported


def test_import_is_light():
    """`import manip_learn` loads none of the heavy libraries, the optional ones least of all."""
    result = run(f"import sys, manip_learn; print(*[m for m in {HEAVY!r} if m in sys.modules])")
    assert result.returncode == 0, result.stderr
    assert result.stdout.split() == []


def test_names_work_without_the_extras():
    """Every public name can be imported where no extra is installed."""
    code = (
        f"import sys\nfor m in {OPTIONAL!r}: sys.modules[m] = None\n"
        "import manip_learn as ml\nfor n in ml.__all__: getattr(ml, n)\n"
        "ml.FrameJacobian(ml.load_robot('planar3'), 'tip')([0.1, 0.2, 0.3])\nprint('fine')"
    )
    result = run(code)
    assert result.stdout == "fine\n", result.stderr


def test_importing_the_library_leaves_the_signals_alone():
    """Whatever the program is called: only the command line's `main` decides what Ctrl-C does."""
    code = (
        "import signal, sys; sys.argv = ['manip-learn']; before = signal.getsignal(signal.SIGINT); import manip_learn; "
        "import manip_learn.cli; assert signal.getsignal(signal.SIGINT) is before"
    )
    assert run(code).returncode == 0
