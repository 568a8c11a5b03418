"""Every sentence about recordings has its figures, and none is left over."""

from __future__ import annotations

import ast
import string
import tomllib
from pathlib import Path

import manip_learn
from manip_learn.recordings.guards import template

ROOM = Path(manip_learn.__file__).parent / "recordings"
SAYS = {"refusal", "_refusal", "refused", "sentence", "note", "NamingError", "template"}
PLACE = {"sample", "line", "column", "where", "path", "in_full", "text"}  # arguments that are no figures


def test_every_sentence_is_said_with_its_figures() -> None:
    """A key in the code has a sentence, and figures that are written out are those of the sentence."""
    catalogue = tomllib.loads((ROOM / "sentences.toml").read_text(encoding="utf-8"))
    variants = ((code, v if isinstance(v, dict) else {"": v}) for code, v in catalogue.items())
    sentences = {f"{code}.{word}".rstrip(".") for code, words in variants for word in words}
    text = "\n".join(p.read_text(encoding="utf-8") for p in ROOM.rglob("*.py"))
    tree, said = ast.parse(text.replace("from __future__", "# ")), set[str]()
    for call in (n for n in ast.walk(tree) if isinstance(n, ast.Call)):
        name = call.func.attr if isinstance(call.func, ast.Attribute) else getattr(call.func, "id", "")
        keys = [a for a in call.args[:2] if isinstance(a, ast.Constant) and isinstance(a.value, str)]
        keys += [b for a in call.args[:2] if isinstance(a, ast.IfExp) for b in (a.body, a.orelse)]
        if name not in SAYS or not keys or len(call.args) > 2 or (len(call.args) == 2 and keys[0] is call.args[0]):
            continue
        for key in (k.value for k in keys if isinstance(k, ast.Constant)):
            needed = {field for _, field, _, _ in string.Formatter().parse(template(key)) if field is not None}
            given = {k.arg for k in call.keywords}
            said.add(key)
            if None not in given:  # no figures by `**`
                missing = needed - given - ({"name"} if name == "_refusal" else set())
                assert not missing, (key, missing)
            assert not {g for g in given if g} - needed - PLACE, (key, given)
    left = {key for key in sentences - said if f'"{key}' not in text and f'"{key.partition(".")[0]}.{{' not in text}
    assert not left
