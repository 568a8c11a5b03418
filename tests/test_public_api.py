"""The public names: they exist, are documented, and cost nothing until they are used."""

from __future__ import annotations

import inspect
import re
import subprocess
import sys
from pathlib import Path

import pytest

import manip_learn as ml

HEAVY = (
    "meshcat IPython matplotlib dask distributed rosbags pyarrow h5py mujoco yourdfpy trimesh typer "
    "scipy pinocchio xacrodoc joblib"
).split()
OPTIONAL = "example_robot_data mujoco rosbags pyarrow h5py dask distributed xacrodoc matplotlib joblib".split()
REMOVED = {"optimise_path": "ml.plan", "MechanismFit": "report_.mechanism"}
ROOT = Path(__file__).resolve().parents[1]


def test_names_exist_and_are_documented():
    """Each name in __all__ can be reached, has a docstring of its own, and is not hidden by a module of that name; they
    are in order, and dir() shows them and the version, nothing else.
    """
    things = {name: getattr(ml, name) for name in ml.__all__}
    assert not [name for name, thing in things.items() if inspect.ismodule(thing) or not inspect.getdoc(thing)]
    assert list(ml.__all__) == sorted(set(ml.__all__))
    assert dir(ml) == sorted([*ml.__all__, "__version__"]) and re.match(r"\d+\.\d+\.\d+", ml.__version__)


def test_unknown_and_removed_names_are_attribute_errors():
    """A misspelt name fails as Python users expect; a removed one says until 0.3 what replaces it."""
    for name, instead in REMOVED.items():
        with pytest.raises(AttributeError, match=f"{name} has been removed.*{instead}"):
            getattr(ml, name)
    with pytest.raises(AttributeError, match="simulat"):
        _ = ml.simulat
    with pytest.raises(ImportError):
        from manip_learn import simulat  # type: ignore[attr-defined]  # noqa: F401


@pytest.mark.parametrize(
    "code",
    [
        f"import sys, manip_learn\nassert not [m for m in {HEAVY!r} if m in sys.modules]",
        f"import sys\nfor m in {OPTIONAL!r}: sys.modules[m] = None\n"
        "import manip_learn as ml\nfor n in ml.__all__: getattr(ml, n)\n"
        "ml.FrameJacobian(ml.load_robot('planar3'), 'tip')([0.1, 0.2, 0.3])",
        "import signal, sys; sys.argv = ['manip-learn']; before = signal.getsignal(signal.SIGINT)\n"
        "import manip_learn, manip_learn.cli; assert signal.getsignal(signal.SIGINT) is before",
    ],
    ids=["loads nothing heavy", "works without the extras", "leaves the signals alone"],
)
def test_an_import(code):
    """In a fresh interpreter, with warnings as errors: only the command line's `main` decides what Ctrl-C does."""
    done = subprocess.run([sys.executable, "-W", "error", "-c", code], capture_output=True, text=True, timeout=100)
    assert done.returncode == 0, done.stderr


def test_versions_agree():
    """The library, the compiled law, the citation and the changelog are of one release."""
    files = ("pyproject.toml", "fast/pyproject.toml", "CITATION.cff", "CHANGELOG.md")
    texts = [(ROOT / file).read_text(encoding="utf-8") for file in files]
    found = [re.search(r"^(?:version(?: = \"|: )|## \[)(\d[\w.]*)", text, re.MULTILINE) for text in texts]
    assert all(found) and len({match[1] for match in found if match}) == 1
