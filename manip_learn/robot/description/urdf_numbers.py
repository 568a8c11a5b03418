"""Numbers and vectors out of XML attributes: strict, finite, with a sentence for everything else."""

from __future__ import annotations

import math
import re

from manip_learn.robot.description.diagnostics import GateLog, shortened
from manip_learn.robot.description.xml_node import XmlNode

# no two ways to read the same digits: else a long number with a typing error takes minutes
NUMBER = re.compile(r"[+-]?(\d+(\.\d*)?|\.\d+)([eE][+-]?\d+)?", re.ASCII)
LARGEST = 1e100  # squares and products of what is larger overflow


def number(node: XmlNode, attribute: str, where: str, log: GateLog) -> float | None:
    """The number in an attribute; None if there is no such attribute.

    Raises:
        RobotError: Codes `number`, `not-finite`, `xacro-expression`.
    """
    text = node.attributes.get(attribute)
    return None if text is None else _parsed(text.strip(), node, attribute, where, log)


def vector(node: XmlNode, attribute: str, size: int, where: str, log: GateLog) -> tuple[float, ...] | None:
    """`size` numbers in an attribute; None if there is no such attribute.

    Raises:
        RobotError: Codes `number`, `not-finite`, `vector-size`, `xacro-expression`.
    """
    text = node.attributes.get(attribute)
    if text is None:
        return None
    words = text.split()
    if "${" not in text and len(words) != size:
        fix = "separate the numbers by spaces, not by commas" if "," in text else "write one number for each"
        raise log.refusal(
            "vector-size",
            node.line,
            where,
            f'{node.tag} {attribute}="{shortened(text)}" has {len(words)} numbers',
            f"{size} are wanted",
            fix,
        )
    return tuple(_parsed(word, node, attribute, where, log) for word in words)


def _parsed(text: str, node: XmlNode, attribute: str, where: str, log: GateLog) -> float:
    seen = f'{node.tag} {attribute}="{shortened(text)}"'
    if NUMBER.fullmatch(text):
        value = float(text)
        if math.isfinite(value) and abs(value) <= LARGEST:
            return value
        raise log.refusal(
            "not-finite", node.line, where, seen, f"at most {LARGEST:g} is wanted", "write the true value"
        )
    if "${" in text:
        raise log.refusal(
            "xacro-expression",
            node.line,
            where,
            seen,
            "a number is wanted",
            "this is xacro, not URDF: name the file *.xacro and load it with xacro=True",
        )
    if text.lower().lstrip("+-") in ("nan", "inf", "infinity", "1.#inf", "1.#qnan"):
        fix = 'for a joint without limits write type="continuous"' if node.tag == "limit" else "write the true value"
        raise log.refusal("not-finite", node.line, where, seen, "a finite number is wanted", fix)
    fix = "write a decimal point, not a comma" if re.fullmatch(r"[+-]?\d+,\d+", text) else "write digits such as 0.5"
    raise log.refusal("number", node.line, where, seen, "a number is wanted", fix)
