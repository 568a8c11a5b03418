"""The command line as it was typed, for pages that show how to repeat it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar

PROGRAM = "manip-learn"
_WORDS: ContextVar[tuple[str, ...]] = ContextVar("typed words", default=())
# of `replay`, with the number of values; `learn` has no use for them
_ONLY_REPLAY = {"--html": 1, "--tip": 1, "--constraint": 1, "--open": 0, "--json": 0}


@contextmanager
def typed(arguments: Sequence[str]) -> Iterator[None]:
    """Within it, `typed_command` knows the arguments."""
    token = _WORDS.set((PROGRAM, *arguments))
    try:
        yield
    finally:
        _WORDS.reset(token)


def typed_command() -> tuple[str, ...]:
    """Words of the command line; empty if the library was called from Python."""
    return _WORDS.get()


def learning_command(frame: str, axes: Sequence[str], reference: str) -> tuple[str, ...]:
    """The command line that learns with such features from what `replay` was given; empty if called from Python."""
    words, kept, skip = typed_command(), [], 0
    if not words:
        return ()
    for word in words:
        if skip:
            skip -= 1
        elif word.partition("=")[0] in _ONLY_REPLAY:
            skip = 0 if "=" in word else _ONLY_REPLAY[word]
        else:
            kept.append("learn" if word == "replay" and len(kept) == 1 else word)
    return (*kept, "--frame", frame, "--axes", " ".join(axes), "--reference", reference)
