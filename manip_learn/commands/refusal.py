"""How a command says that it cannot do what was asked: one sentence, and under --json one document."""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Mapping
from typing import Any

from manip_learn.commands.output import finite

BAD_INPUT = 2


def refuse(
    sentence: str, as_json: bool, code: str, facts: Mapping[str, Any] | None = None, exit_code: int = BAD_INPUT
) -> int:
    """Print a sentence on standard error; under --json also `{"error": {"code", "message", ...}}` on standard output.

    Returns:
        The exit code.
    """
    printable = sentence.encode("utf-8", "backslashreplace").decode()  # names in a damaged file may be no text
    message = " ".join(printable.split())
    if as_json:
        content = finite({"error": {"code": code, "message": message, **(facts or {})}})
        try:
            print(json.dumps(content, indent=2), flush=True)
        except OSError:  # a pipe that nobody reads any more, or a full disk, which the sentence below tells
            nobody_reads()
    print(f"manip-learn: {message}", file=sys.stderr)
    return exit_code


def nobody_reads() -> int:
    """The reader of a pipe, such as `head`, has what it wants: what is left is given up, without a word.

    Returns:
        The exit code.
    """
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    return 0
