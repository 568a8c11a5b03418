"""Every malformed or unusual recording of the corpus gets its expected verdict: no traceback, no hang."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from recording_corpus import CHAPTERS

from manip_learn.commands.command_line import flags_of
from manip_learn.commands.program import program
from manip_learn.errors import RecordingError, advice_for_command
from manip_learn.recordings import load_demonstrations
from manip_learn.robot import Robot

# words of what is to be done, where no flag is advised
TO_DO = re.compile(
    r"needed|save (it|the|again)|not read|(more|larger) than|at most|not opened|given|unpack it|correct|again|write all"
    r"|no recorded motion|keep one|left|convert|leave|remove|of no known kind|check the path|cannot|name |git lfs pull"
    r"|download|is an|--[a-z]",
    re.IGNORECASE,
)


@pytest.mark.parametrize("chapter", CHAPTERS, ids=lambda c: c.__name__)
def test_verdict(chapter, planar3: Robot, tmp_path: Path) -> None:
    """Accepted, accepted with a note, or refused for the right reason, in one sentence that names the file and what to
    do: on the command line by flags alone, and only those that the command has.
    """
    for number, case in enumerate(chapter()):
        path, flags = tmp_path / case.name, flags_of(program, [("learn", "replay", "audit", "export")[number % 4]])
        case.write(path)
        try:
            with advice_for_command(flags):
                demos = load_demonstrations(path, planar3, **case.options)
        except RecordingError as error:
            verdict, said = error.code, str(error)
            assert len(said) < 700 and "\n" not in said and (case.name in said or path.is_dir()), said
            assert TO_DO.search(said), said
            assert set(re.findall(r"(?<![\w-])--[a-z][a-z-]*", said)) <= flags, said
            assert not re.search(r"\w=\[|\w=\{|\w='|=True", said), said
        else:
            verdict, said = "note" if demos.notes else "accept", "\n".join(demos.notes)
        assert verdict == case.verdict, f"{case.name}: {said}"
