"""Every malformed or unusual recording of the corpus gets its expected verdict: no traceback, no hang."""

from __future__ import annotations

from pathlib import Path

import pytest
from recording_corpus import CHAPTERS, Case

from manip_learn.errors import ManipLearnError, RecordingError
from manip_learn.recordings import load_demonstrations
from manip_learn.robot import Robot


def verdict_of(path: Path, robot: Robot, options: dict) -> tuple[str, str]:
    """What the reader decides, and what it says."""
    try:
        demos = load_demonstrations(path, robot, **options)
    except RecordingError as error:
        return error.code, str(error)
    except ManipLearnError as error:
        return type(error).__name__, str(error)
    return ("note" if demos.notes else "accept"), "\n".join(demos.notes)


@pytest.mark.parametrize("chapter", CHAPTERS, ids=lambda c: c.__name__)
def test_verdict(chapter, planar3: Robot, tmp_path: Path) -> None:
    """Accepted, accepted with a note, or refused for the right reason, in a sentence that names the file."""
    cases: list[Case] = chapter()
    assert len({c.name for c in cases}) == len(cases)
    for case in cases:
        path = tmp_path / case.name
        case.write(path)
        verdict, said = verdict_of(path, planar3, case.options)
        assert verdict == case.verdict, f"{case.name}: {said}"
        if verdict not in ("accept", "note"):
            assert len(said) < 700 and "\n" not in said
            assert case.name in said or path.is_dir(), said
