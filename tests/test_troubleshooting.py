"""Every code of an error has an entry in docs/troubleshooting.md, and every entry is a code."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

from library_source import Source, library

from manip_learn import errors

PAGE = Path(__file__).resolve().parents[1] / "docs" / "troubleshooting.md"
CODE = re.compile(r"[a-z][a-z0-9]*(-[a-z0-9]+)*")
# functions that make errors; one of their first arguments is the code
MAKERS = ("refusal", "_refusal", "refused", "NamingError", "_header_error", "MergeError", "refuse")
# tables of codes: (what it looks like, code, sentence)
TABLES = ("REFUSED_MAGIC",)


def codes(source: Source) -> Iterator[str]:
    """Codes in a file: given by name, to a function that makes errors, as a class's own, or in a table."""
    for node in ast.walk(source.tree):
        if isinstance(node, ast.Call):
            yield from (text(part) for k in node.keywords if k.arg == "code" for part in values(k.value))
            name = ast.unparse(node.func).split(".")[-1]
            if name in MAKERS:
                said = [text(v).partition(".")[0] for a in node.args[:4] for v in values(a)]  # of a key, its code
                yield next((s for s in said if s and CODE.fullmatch(s.replace("*", "x"))), "")
        elif isinstance(node, ast.Assign | ast.AnnAssign):
            target = ast.unparse(node.targets[0] if isinstance(node, ast.Assign) else node.target)
            if target == "code" and node.value is not None:
                yield from map(text, values(node.value))
            if target == "RULES" and isinstance(node.value, ast.Dict):  # code: sentence
                yield from (text(key).partition(".")[0] for key in node.value.keys if key is not None)
            if target in TABLES and isinstance(node.value, ast.Tuple):
                yield from (text(row.elts[1]) for row in node.value.elts if isinstance(row, ast.Tuple))
        elif isinstance(node, ast.FunctionDef):
            pairs = zip(node.args.kwonlyargs, node.args.kw_defaults, strict=True)
            yield from (text(value) for argument, value in pairs if argument.arg == "code" and value is not None)


def values(node: ast.expr) -> list[ast.expr]:
    """Both values of a choice, or the one that there is."""
    return [node.body, node.orelse] if isinstance(node, ast.IfExp) else [node]


def text(node: ast.AST) -> str:
    """A constant; of an f-string what is constant, with * for the rest; empty for anything else."""
    if isinstance(node, ast.Constant) and isinstance(node.value, str):
        return node.value
    if isinstance(node, ast.JoinedStr):
        return "".join(str(v.value) if isinstance(v, ast.Constant) else "*" for v in node.values)
    return ""


def test_each_code_has_its_entry_and_each_entry_its_code() -> None:
    """Both ways."""
    entries = re.findall(r"^\| `([^`]+)` \|", PAGE.read_text(encoding="utf-8"), re.MULTILINE)
    in_source = {code for source in library() for code in codes(source) if CODE.fullmatch(code.replace("*", "x"))}
    assert len(in_source) > 150
    patterns = [re.compile(re.escape(code).replace(r"\*", "[a-z]+")) for code in in_source]
    missing = sorted(p.pattern for p in patterns if not any(p.fullmatch(e) for e in entries))
    # a code may be made elsewhere and passed on: then it stands in the source as a text
    texts = "\n".join(source.text for source in library())
    surplus = [e for e in entries if not any(p.fullmatch(e) for p in patterns) and f'"{e}"' not in texts]
    assert (missing, surplus) == ([], [])


def test_every_error_has_a_code() -> None:
    """Whatever is raised on purpose has one, from its class or from where it is raised."""
    samples = {"UnknownNameError": ("frame", "a", ["b"]), "NumberOfConstraintsError": (9, 3, "rows")}
    samples["MissingExtraError"] = ("reading", "ros")
    for name in (n for n in dir(errors) if n.endswith("Error")):
        error = getattr(errors, name)(*samples.get(name, ("a sentence",)))
        assert CODE.fullmatch(error.code) and f"| `{error.code}` |" in PAGE.read_text(encoding="utf-8"), name
