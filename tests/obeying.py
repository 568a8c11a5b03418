"""Follows the advice of an error: the flags in its sentence, as they stand there, are typed after the command."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

from manip_learn.cli import main

# a flag, and its value: a word, or what stands in quotes
FLAG = r"--[a-z][a-z-]*(?: (?:'[^']*'|[^\s'-][^\s;]*(?<![:.,;])))?"
RUN = re.compile(rf"(?<![\w-]){FLAG}(?: {FLAG})*")
WITHOUT_VALUE = re.compile(r"(--degrees|--xacro)\b.*")


def advised(sentence: str) -> list[list[str]]:
    """Words to type, one list for each way that the sentence offers."""
    sentence = sentence.replace("<samples per second>", "50")
    runs = (WITHOUT_VALUE.sub(r"\1", run) for run in RUN.findall(sentence))
    return [shlex.split(run) for run in runs]


def said(words: list[str], capsys) -> str:
    """What the command says; empty if it succeeds."""
    code = main(words)
    text = capsys.readouterr().err
    if code:
        assert code == 2 and "Traceback" not in text, text
    return text if code else ""


def obeyed(path: Path, robot: str, out: Path, capsys, *options: str, way: int = 0, most: int = 3) -> list[str]:
    """The options with which a recording is read, once every refusal has been obeyed; each must be another one."""
    heard: list[str] = []
    words = list(options)
    while refused := said(["export", robot, str(path), "--out", str(out), *words], capsys):
        assert refused not in heard, f"obeyed {words}, and heard again: {refused}"
        heard.append(refused)
        ways = advised(refused)
        assert ways and len(heard) <= most, f"{words}: {refused}"
        words += ways[min(way, len(ways) - 1)] if len(heard) == 1 else ways[0]
    return words
