"""Sentences of refusals and remarks, by their keys: the words are in `sentences.toml`, the figures in the code."""

from __future__ import annotations

import functools
import tomllib
from pathlib import Path
from typing import Any

from manip_learn.errors import RecordingError


@functools.cache
def _templates() -> dict[str, str | dict[str, str]]:
    return tomllib.loads(Path(__file__).with_name("sentences.toml").read_text(encoding="utf-8"))


def template(key: str) -> str:
    """Return a sentence with `{name}` for each figure.

    Args:
        key: Its code, e.g. `"jump"`; where several sentences have one, `"shape.width"`.
    """
    code, _, variant = key.partition(".")
    found = _templates()[code]
    return found if isinstance(found, str) else found[variant]


def refused(key: str, **figures: Any) -> RecordingError:
    """Return the error that refuses what was given in memory."""
    return RecordingError(sentence(key, **figures), code=key.partition(".")[0])


def sentence(key: str, **figures: Any) -> str:
    """Return a sentence with its figures."""
    return template(key).format(**figures)
