"""load_demonstrations: one door for all formats, folders, options, notes; streaming; extras that are missing."""

from __future__ import annotations

import builtins
import sys
from pathlib import Path

import numpy as np
import pytest
from case import case
from recording_corpus import JOINTS, TABLE, TIME, Q, csv, refusal

from manip_learn.errors import MissingExtraError, RecordingError
from manip_learn.recordings import RecordingSource, load_demonstrations
from manip_learn.recordings.trajectory import Demonstrations
from manip_learn.robot import Robot, load_robot


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for i in (1, 2, 10):
        (tmp_path / f"demo_{i}.csv").write_text(csv(TABLE + [0, 0.01 * i, 0, 0]))
    return tmp_path


def test_paths_may_be_strings_lists_and_folders(planar3: Robot, folder: Path) -> None:
    """One path, several, and their folder give the same; folders in natural order."""
    files = [folder / f"demo_{i}.csv" for i in (1, 2, 10)]
    for paths in (files, [str(f) for f in files], iter(files), folder, str(folder), [folder]):
        demos = load_demonstrations(paths, planar3)
        assert isinstance(demos, Demonstrations)
        assert [t.name for t in demos] == ["demo_1.csv", "demo_2.csv", "demo_10.csv"]
    assert len(load_demonstrations(files[0], planar3)) == 1


def test_formats_can_be_mixed_in_a_list(planar3: Robot, folder: Path) -> None:
    """A list may name files of several formats; a folder may not hold them."""
    np.savez(folder / "a.npz", time=TIME, q=Q, joint_names=np.array(JOINTS))
    assert len(load_demonstrations([folder / "demo_1.csv", folder / "a.npz"], planar3)) == 2
    assert refusal(folder, planar3).code == "mixed-folder"


def test_a_file_given_twice_counts_once(planar3: Robot, folder: Path) -> None:
    """Through the folder and by name: read once, and said; what three files have in common is one sentence."""
    demos = load_demonstrations([folder, folder / "demo_2.csv"], planar3, units="normalised")
    assert len(demos) == 3 and "read once" in demos.notes[0]
    assert len(demos.notes) == 2 and demos.notes[1].startswith("demo_1.csv and 2 more: normalised")


def test_broken_files_in_a_folder_are_not_passed_over(planar3: Robot, folder: Path) -> None:
    """A recording by its name that is broken refuses the folder; a README is left out, and it is said."""
    (folder / "README.txt").write_text("made on a Monday")
    assert load_demonstrations(folder, planar3).notes == (f"{folder.name}: not recordings, not read: README.txt",)
    (folder / "demo_3.csv").write_text("")
    refusal(folder, planar3, match=r"demo_3\.csv")


def test_no_path_at_all(planar3: Robot) -> None:
    """Nothing, or something that is no path, is refused in a sentence."""
    for paths in [[], "", [""], [None], 7, None]:
        with case(paths):
            refusal(paths, planar3)


def test_options_are_checked(planar3: Robot, folder: Path) -> None:
    """A misspelt option or value is refused with what is allowed, before any file is opened."""
    for options, said in [
        ({"unit": "degrees"}, "there is no option 'unit'"),
        ({"time_unit": "min"}, "'ms'"),
        ({"rate": 0}, "positive"),
        ({"degrees": True, "units": "radians"}, "contradict"),
        ({"ignore_columns": (1,)}, "names"),
        ({"joint_names": 3}, "names"),
        ({"rename": ["a"]}, "rename"),
    ]:
        with case(options, said):
            assert refusal(folder / "not_there.csv", planar3, match=said, **options).code == "option"


def test_trajectories_come_one_by_one(planar3: Robot, folder: Path) -> None:
    """The generator has given the first before it opens the second; notes are handed out at the end, progress is told
    after each file.
    """
    told: list[float] = []
    load_demonstrations(folder, planar3, progress=lambda _step, share: told.append(share))
    assert told == [1 / 3, 2 / 3, 1.0] and len(list(RecordingSource(folder, planar3))) == 3
    (folder / "demo_2.csv").write_text(csv(TABLE[:1]))
    stream = iter(RecordingSource([folder / "demo_1.csv", folder / "demo_2.csv"], planar3).part(0))
    assert next(stream).name == "demo_1.csv"
    with pytest.raises(RecordingError, match="demo_2"):
        next(stream)
    notes: list[str] = []
    assert len(list(RecordingSource(folder / "demo_1.csv", planar3, units="degrees").part(0, notes))) == 1
    assert len(notes) == 1


def test_missing_libraries_name_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without the library: one sentence with the pip command, not an ImportError."""
    readers = "manip_learn.recordings."
    real, missing = builtins.__import__, ""

    def absent(name, *arguments, **keywords):
        if name.split(".")[0] == missing:
            raise ImportError(f"No module named {name!r}")
        return real(name, *arguments, **keywords)

    for missing, reader, extra in (
        ("rosbags", "readers.bags", "ros"),
        ("lz4", "readers.bags", "ros"),
        ("pyarrow", "writers.lerobot_writer", "lerobot"),
        ("h5py", "readers.hdf5", "robomimic"),
    ):
        with case(missing), monkeypatch.context() as patch:
            patch.setattr(builtins, "__import__", absent)
            for name in [n for n in sys.modules if n.startswith(readers)]:
                patch.delitem(sys.modules, name)
            with pytest.raises(Exception) as caught:  # noqa: PT011 - the class is a new one after the new import
                __import__(readers + reader)
            assert type(caught.value).__name__ == MissingExtraError.__name__
            assert caught.value.extra == extra and f"manip_learn[{extra}]" in str(caught.value)


def test_shipped_recordings_load(planar3: Robot) -> None:
    """The recordings in examples/data are accepted without any note."""
    data = Path(__file__).resolve().parents[1] / "examples" / "data"
    for name, robot in (("planar3_reach", planar3), ("sawyer_drawer", load_robot("sawyer"))):
        demos = load_demonstrations(data / name, robot)
        assert demos.notes == () and demos.joint_names == robot.joint_names
