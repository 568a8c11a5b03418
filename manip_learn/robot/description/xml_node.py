"""XML without entities, doctypes or surprises: bytes -> nodes that know their line, attributes -> finite numbers."""

from __future__ import annotations

import math
import re
import xml.parsers.expat
from dataclasses import dataclass, field
from pathlib import Path
from typing import final

from manip_learn.errors import RobotError, advice
from manip_learn.robot.description.diagnostics import Diagnostics, shortened

MAX_ELEMENTS = 200_000
MAX_NESTING = 60
MAX_ATTRIBUTE = 100_000  # [characters]
# no two ways to read the same digits: else a long number with a typing error takes minutes
NUMBER = re.compile(r"[+-]?(\d+(\.\d*)?|\.\d+)([eE][+-]?\d+)?", re.ASCII)
LARGEST = 1e100  # squares and products of what is larger overflow


@final
@dataclass(frozen=True)
class XmlNode:
    """One element: tag, attributes, children and the line on which it starts. Text between tags is not kept."""

    tag: str
    attributes: dict[str, str]
    line: int
    children: list[XmlNode] = field(default_factory=list)

    def all(self, tag: str) -> list[XmlNode]:
        """Children with that tag."""
        return [c for c in self.children if c.tag == tag]

    def first(self, tag: str) -> XmlNode | None:
        """First child with that tag, or None."""
        return next((c for c in self.children if c.tag == tag), None)


def parse_xml(content: bytes, path: Path) -> XmlNode:
    """The root element of an XML document.

    Args:
        content: The document.
        path: Where it came from, for the messages.

    Raises:
        RobotError: Codes `empty`, `not-xml`, `doctype`, `encoding`, `xml-too-deep`, `xml-too-large`.
    """
    if not content.strip():
        raise RobotError(f"{path}: the file is empty; a robot description is expected", code="empty", path=path)
    builder = _Builder(path)
    try:
        builder.parser.Parse(content, True)
    except xml.parsers.expat.ExpatError as error:
        raise _explained(error, content, path) from error
    except (LookupError, ValueError) as error:  # an encoding that Python does not know, or cannot use
        line = builder.parser.CurrentLineNumber
        raise RobotError(
            f"{path}:{line}: its XML declaration names an encoding that cannot be read ({error}); save it as UTF-8",
            code="encoding",
            path=path,
            line=line,
        ) from error
    return builder.root


class _Builder:
    def __init__(self, path: Path):
        self.path = path
        self.count = 0
        self.stack: list[XmlNode] = []
        self.parser = xml.parsers.expat.ParserCreate()
        self.parser.StartElementHandler = self._start
        self.parser.EndElementHandler = self._end
        self.parser.StartDoctypeDeclHandler = self._doctype

    def _start(self, tag: str, attributes: dict[str, str]) -> None:
        self.count += 1
        if self.count > MAX_ELEMENTS:
            raise self._refusal("xml-too-large", f"more than {MAX_ELEMENTS} XML elements; split the file")
        if len(self.stack) >= MAX_NESTING:
            raise self._refusal(
                "xml-too-deep", f"XML elements are nested deeper than {MAX_NESTING} levels; URDF needs 6"
            )
        for key, value in attributes.items():
            if len(value) > MAX_ATTRIBUTE:
                raise self._refusal(
                    "xml-too-large",
                    f"attribute {key!r} of <{tag}> has {len(value)} characters, at most {MAX_ATTRIBUTE} are read",
                )
        node = XmlNode(tag, attributes, self.parser.CurrentLineNumber)
        if self.stack:
            self.stack[-1].children.append(node)
        else:
            self.root = node
        self.stack.append(node)

    def _end(self, tag: str) -> None:
        self.stack.pop()

    def _doctype(self, *_: object) -> None:
        raise self._refusal(
            "doctype", "a <!DOCTYPE> is not read, since it can define entities; delete it and write the values out"
        )

    def _refusal(self, code: str, sentence: str) -> RobotError:
        line = self.parser.CurrentLineNumber
        return RobotError(f"{self.path}:{line}: {sentence}", code=code, path=self.path, line=line)


def _explained(error: xml.parsers.expat.ExpatError, content: bytes, path: Path) -> RobotError:
    errors, line = xml.parsers.expat.errors, int(error.lineno)
    reason = xml.parsers.expat.ErrorString(error.code) or "unreadable"
    code = "not-xml"
    if error.code in (
        errors.codes[errors.XML_ERROR_UNKNOWN_ENCODING],
        errors.codes[errors.XML_ERROR_INCORRECT_ENCODING],
    ):
        code, fix = "encoding", "save the file as UTF-8"
    elif error.code == errors.codes[errors.XML_ERROR_UNDEFINED_ENTITY]:
        code, fix = "entity", "entities other than &lt; &gt; &amp; &quot; &apos; are not read; write the value out"
    elif not content.lstrip(b"\xef\xbb\xbf \t\r\n").startswith((b"<", b"\xff\xfe", b"\xfe\xff")):
        fix = "a URDF file begins with '<'; is this the right file?"
    elif error.code == errors.codes[errors.XML_ERROR_NO_ELEMENTS]:
        fix = "the file ends before the description does; is it cut off?"
    else:
        fix = "repair the XML at this line"
    sentence = f"{path}:{line}: not readable as XML ({reason}, column {error.offset + 1}); {fix}"
    return RobotError(sentence, code=code, path=path, line=line)


def number(node: XmlNode, attribute: str, where: str, log: Diagnostics) -> float | None:
    """The number in an attribute; None if there is no such attribute.

    Raises:
        RobotError: Codes `number`, `not-finite`, `xacro-expression`.
    """
    text = node.attributes.get(attribute)
    return None if text is None else _parsed(text.strip(), node, attribute, where, log)


def vector(node: XmlNode, attribute: str, size: int, where: str, log: Diagnostics) -> tuple[float, ...] | None:
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
            f"{size} are expected",
            fix,
        )
    return tuple(_parsed(word, node, attribute, where, log) for word in words)


def _parsed(text: str, node: XmlNode, attribute: str, where: str, log: Diagnostics) -> float:
    seen = f'{node.tag} {attribute}="{shortened(text)}"'
    if NUMBER.fullmatch(text):
        value = float(text)
        if math.isfinite(value) and abs(value) <= LARGEST:
            return value
        raise log.refusal(
            "not-finite", node.line, where, seen, f"at most {LARGEST:g} is expected", "write the true value"
        )
    if "${" in text:
        raise log.refusal(
            "xacro-expression",
            node.line,
            where,
            seen,
            "a number is expected",
            "this is xacro, not URDF: name the file *.xacro" + advice(" and load it with {}", "xacro=True", "--xacro"),
        )
    if text.lower().lstrip("+-") in ("nan", "inf", "infinity", "1.#inf", "1.#qnan"):
        fix = 'for a joint without limits write type="continuous"' if node.tag == "limit" else "write the true value"
        raise log.refusal("not-finite", node.line, where, seen, "a finite number is expected", fix)
    fix = "write a decimal point, not a comma" if re.fullmatch(r"[+-]?\d+,\d+", text) else "write digits such as 0.5"
    raise log.refusal("number", node.line, where, seen, "a number is expected", fix)
