"""What a library's exception says, in one short line."""

from __future__ import annotations

LONGEST = 160


def reason(error: BaseException) -> str:
    """Its message without line breaks; the name of its class if it has none."""
    text = " ".join(str(error).split()) or type(error).__name__
    return text if len(text) <= LONGEST else text[: LONGEST - 3] + "..."
