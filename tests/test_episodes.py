"""Selected episodes: files of a folder by their place, LeRobot episodes by number."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from case import case
from recording_corpus import TABLE, csv, refusal

from manip_learn.cli import main
from manip_learn.errors import RecordingError
from manip_learn.recordings import RecordingSource, load_demonstrations
from manip_learn.recordings.options import EpisodeSelection
from manip_learn.recordings.trajectory import Demonstrations
from manip_learn.robot import Robot

lerobot = pytest.importorskip("test_lerobot_reader", exc_type=ImportError)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for i in range(12):
        (tmp_path / f"demo_{i + 1}.csv").write_text(csv(TABLE + [0, 0.01 * i, 0, 0]))
    return tmp_path


def made(root: Path, version: str) -> Path:
    """Four episodes of twenty samples at 50 Hz, of which the first joint tells which."""
    q = {i: np.linspace(0, 0.1, 20)[:, None] + [0.01 * i, 0.2, 0.3] for i in range(4)}
    if version == "v2":
        files = {f"data/chunk-000/episode_{i:06d}.parquet": lerobot.table({i: x}) for i, x in q.items()}
    else:
        parts = (range(3), range(3, 4))
        files = {
            f"data/chunk-000/file-{k:03d}.parquet": lerobot.table({i: q[i] for i in p}) for k, p in enumerate(parts)
        }
    lerobot.dataset(root, lerobot.info(lerobot.JOINTS, version + ".0"), files)
    return root


def numbers(demonstrations: Demonstrations) -> list[int]:
    return [int(t.name.rpartition(" ")[2]) for t in demonstrations]


def test_text_selects_as_python_counts() -> None:
    """Ranges are half-open, from 0, and may go beyond the last episode."""
    for text, known, chosen in [
        ("0:3", 10, {0, 1, 2}),
        ("0:2,5, 7", 10, {0, 1, 5, 7}),
        ("8:", 10, {8, 9}),
        (":2", 10, {0, 1}),
        ("0:99", 3, {0, 1, 2}),
    ]:
        with case(text, known, chosen):
            assert EpisodeSelection.of(text).of_known(range(known), "here") == chosen


def test_what_is_no_selection_is_refused() -> None:
    """One sentence that shows how it is written."""
    for text in ["", "a", "1-3", "3,", "-1", "1:2:3", "1.5", [], [-1], [1.5], ["1"], 2.5, True]:
        with case(text):
            with pytest.raises(RecordingError, match="0:50,60,75") as caught:
                EpisodeSelection.of(text)
            assert caught.value.code == "option"


def test_files_are_selected_by_natural_order(planar3: Robot, folder: Path) -> None:
    """demo_2 comes before demo_10; the order of the selection does not matter; a note tells what was left out."""
    demos = load_demonstrations(folder, planar3, episodes="9,0:2")
    assert [t.name for t in demos] == ["demo_1.csv", "demo_2.csv", "demo_10.csv"]
    assert any("3 of 12 files selected" in note for note in demos.notes)
    assert [t.name for t in load_demonstrations(folder, planar3, episodes=[11])] == ["demo_12.csv"]
    assert [t.name for t in load_demonstrations(folder, planar3, episodes=range(1, 3))] == ["demo_2.csv", "demo_3.csv"]


def test_lerobot_episodes_by_number(planar3: Robot) -> None:
    """The number is the episode's own, in both versions of the format, in memory and streamed."""
    for version in ("v2", "v3"):
        with case(version) as tmp_path:
            root = made(tmp_path / "set", version)
            demos = load_demonstrations(root, planar3, units="radians", episodes="1:3")
            assert numbers(demos) == [1, 2]
            np.testing.assert_allclose([t.q[0, 0] for t in demos], [0.01, 0.02], atol=1e-6)
            assert any("2 of 4 episodes selected" in note for note in demos.notes)
            source = RecordingSource(root, planar3, units="radians", episodes="0,3")
            assert numbers(Demonstrations(t for i in range(source.n_parts) for t in source.part(i))) == [0, 3]


def test_episodes_that_do_not_exist_name_near_ones(planar3: Robot, folder: Path, tmp_path: Path) -> None:
    """Each item must select something: a number beyond the end is no silent empty selection, nor is episode 1 of two
    data sets.
    """
    refusal(
        folder, planar3, match=r"'12'.*there are 12, numbered 0 to 11; the nearest: 8, 9, 10, 11", episodes="0:3,12"
    )
    root = made(tmp_path / "set", "v3")
    with pytest.raises(RecordingError, match="'7:9'") as caught:
        RecordingSource(root, planar3, units="radians", episodes="7:9")
    assert caught.value.code == "no-episode"
    refusal([root, made(tmp_path / "b", "v2")], planar3, match="name one data set", units="radians", episodes="1")


def test_command_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """`learn --episodes` learns from the selected recordings only; a wrong one is one sentence and exit code 2."""
    recordings = Path(__file__).resolve().parents[1] / "examples" / "data" / "sawyer_drawer"
    words = ["learn", "sawyer", str(recordings), "--frame", "right_gripper_tip", "--reference", "world", "--json"]
    assert main([*words, "--episodes", "0:8,20"]) == 0
    assert json.loads(capsys.readouterr().out)["n_trajectories"] == 9
    assert main([*words, "--episodes", "99"]) == 2
    assert "the nearest: 46, 47, 48, 49" in capsys.readouterr().err
