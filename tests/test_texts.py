"""What the library says: flags and commands that exist, codes that are documented, sentences with their figures."""

from __future__ import annotations

import ast
import re
import string
import tomllib
from pathlib import Path

from library_source import PACKAGE, library

from manip_learn import errors
from manip_learn.commands.command_line import flags_of
from manip_learn.commands.program import program
from manip_learn.recordings.guards import template
from manip_learn.robot.description.text import RULES

# flags of other programs: of `ros2 topic pub` and `echo`, of the program that writes the planar arms, and of git
FOREIGN = {"--once", "--name", "--no-optional-locks", "--always", "--abbrev", "--exclude", "--dirty", "--csv"}
COMMAND_LINE = re.compile(r"`manip-learn ([a-z]+)([^`]*)`")
PAGE = (Path(__file__).resolve().parents[1] / "docs" / "troubleshooting.md").read_text(encoding="utf-8")
# codes in the source: by name, or as an argument of a function that makes errors, for a key up to its dot
NAMED = re.compile(r'\bcode(?:: str)? ?= ?\(?\s*f?"([a-z0-9*-]+)"(?:\s+if [^=]*? else "([a-z0-9-]+)")?')
MADE = re.compile(
    r'\b(?:_?refusal|refused|NamingError|_header_error|MergeError|refuse)\((?:[^()"]|\([^()]*\)|"[^"]* [^"]*")*?'
    r'f?"([a-z][a-z0-9*-]*)[".]'
)
SAYS = {"refusal", "_refusal", "refused", "sentence", "note", "NamingError", "template"}
PLACE = {"sample", "line", "column", "where", "path", "in_full", "text"}  # arguments that are no figures


def test_flags_that_texts_name_exist():
    """A flag is one of some command; in a command line, one of that command."""
    own = {name: set(flags_of(program, [name])) for name in program.commands}
    every, found, faults = set().union(*own.values(), {"--version", "--help"}, FOREIGN), set[str](), list[str]()
    for source in library():
        said = [text(node) for node in ast.walk(source.tree) if isinstance(node, ast.Constant)]
        for command, words in (pair for part in said for pair in COMMAND_LINE.findall(part)):
            known = own.get(command, set()) if "..." not in command else every
            faults += [f"{source.name}: {command} {flag}" for flag in errors.FLAG.findall(words) if flag not in known]
        named = {flag for part in said for flag in errors.FLAG.findall(COMMAND_LINE.sub("", part))}
        found |= named
        faults += [f"{source.name}: {flag}" for flag in named - every]
    assert {"--rename", "--lock", "--time-unit", "--frame", "--xacro"} <= found
    assert not faults, faults


def test_commands_share_their_options():
    """One set of reading options and one of the robot's, for all commands that read recordings or load robots."""
    sets = {name: flags_of(program, [name]) for name in program.commands}
    robot = {"--lock", "--package-dir", "--object", "--xacro", "--xacro-arg"}
    reading = {flag for flag in sets["export"] if flag.startswith("--")} - robot - {"--out", "--to", "--at"}
    assert {"--rename", "--columns", "--degrees", "--episodes"} <= reading
    assert all(robot <= sets[name] for name in ("learn", "audit", "replay", "export", "control", "inspect"))
    assert all(reading <= sets[name] for name in ("learn", "audit", "replay", "export"))
    assert all("--json" in own for own in sets.values())


def values(node: ast.expr) -> list[ast.expr]:
    """Both values of a choice, or the one that there is."""
    return [node.body, node.orelse] if isinstance(node, ast.IfExp) else [node]


def text(node: ast.AST) -> str:
    """A constant; of an f-string what is constant, with * for the rest; empty for anything else."""
    if isinstance(node, ast.JoinedStr):
        return "".join(text(v) if isinstance(v, ast.Constant) else "*" for v in node.values)
    return node.value if isinstance(node, ast.Constant) and isinstance(node.value, str) else ""


def test_each_code_has_its_entry_and_each_entry_its_code() -> None:
    """Both ways; and whatever is raised on purpose has a code, from its class or from where it is raised."""
    entries = re.findall(r"^\| `([^`]+)` \|", PAGE, re.MULTILINE)
    texts = "\n".join(source.text for source in library())
    calls = re.sub(r"\{[^{}]*\}", "*", texts)  # parts of f-strings that are not constant
    in_source = {code for pair in NAMED.findall(calls) for code in pair if code} | {*MADE.findall(calls)}
    in_source |= {rule.partition(".")[0] for rule in RULES}
    assert len(in_source) > 150
    patterns = [re.compile(re.escape(code).replace(r"\*", "[a-z]+")) for code in in_source]
    missing = sorted(p.pattern for p in patterns if not any(p.fullmatch(e) for e in entries))
    # a code may be made elsewhere and passed on: then the source contains it as a string
    surplus = [e for e in entries if not any(p.fullmatch(e) for p in patterns) and f'"{e}"' not in texts]
    assert (missing, surplus) == ([], [])
    samples = {"UnknownNameError": ("frame", "a", ["b"]), "NumberOfConstraintsError": (9, 3, "rows")}
    samples["MissingExtraError"] = ("reading", "ros")
    for name in (n for n in dir(errors) if n.endswith("Error")):
        assert getattr(errors, name)(*samples.get(name, ("a sentence",))).code in entries, name


def test_every_sentence_about_recordings_is_said_with_its_figures() -> None:
    """A key in the code has a sentence, figures that are written out are those of the sentence; none is left over."""
    catalogue = tomllib.loads((PACKAGE / "recordings" / "sentences.toml").read_text(encoding="utf-8"))
    variants = ((code, v if isinstance(v, dict) else {"": v}) for code, v in catalogue.items())
    sentences = {f"{code}.{word}".rstrip(".") for code, words in variants for word in words}
    room = [source for source in library() if source.top == "recordings"]
    texts, said = "\n".join(source.text for source in room), set[str]()
    for call in (n for source in room for n in ast.walk(source.tree) if isinstance(n, ast.Call)):
        name = call.func.attr if isinstance(call.func, ast.Attribute) else getattr(call.func, "id", "")
        keys = [key for a in call.args[:2] for v in values(a) if (key := text(v)) and "*" not in key]
        if name not in SAYS or not keys or len(call.args) > 2 or (len(call.args) == 2 and text(call.args[0]) in keys):
            continue
        for key in keys:
            needed = {field for _, field, _, _ in string.Formatter().parse(template(key)) if field is not None}
            given = {k.arg for k in call.keywords}
            said.add(key)
            if None not in given:  # no figures by `**`
                missing = needed - given - ({"name"} if name == "_refusal" else set())
                assert not missing, (key, missing)
            assert not {g for g in given if g} - needed - PLACE, (key, given)
    left = {k for k in sentences - said if f'"{k}' not in texts and f'"{k.partition(".")[0]}.{{' not in texts}
    assert not left
