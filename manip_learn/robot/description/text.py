"""Safe reading of robot descriptions and other untrusted files: bytes, XML and JSON.

XML with entities or doctypes is refused. XML nodes know their line and the link or joint to which they belong, and
error messages name both.
"""

from __future__ import annotations

import errno
import json
import math
import os
import re
import stat
import xml.parsers.expat
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO, final
from xml.parsers.expat import ExpatError, errors

from manip_learn.errors import RobotError, advice, closest_names, counted, few

NAMES_SHOWN = 4  # largest number of names in a sentence
MAX_WARNINGS = 100  # largest number of warnings
MAX_BYTES = 10_000_000  # size of a description; the largest of example-robot-data has 0.2 MB
MAX_ELEMENTS = 200_000  # elements of one file; limits memory and time
DEEPEST = 100  # nested brackets of JSON or YAML; beyond, parsers take quadratic time or run out of stack
# the pattern is unambiguous: otherwise matching a long number with a typing error would take minutes
NUMBER_TEXT = re.compile(r"[+-]?(\d+(\.\d*)?|\.\d+)([eE][+-]?\d+)?", re.ASCII)
# parts of a warning: its line and element, and its text
PLACE = re.compile(r"(?s)(?P<place>(line \d+)?((: |^)(?P<kind>mesh|link|joint|body|site) ('.*?'|\".*?\"))?)(?P<why>.*)")
# error of the operating system -> code and sentence for an unreadable file
UNREADABLE: dict[int, tuple[str, str]] = {
    **dict.fromkeys((errno.ENOENT, errno.ENOTDIR), ("missing", "there is no such file; check the path")),
    errno.EISDIR: ("not-a-file", "not a regular file; it is a folder, name a file in it"),
    errno.ENXIO: ("not-a-file", "not a regular file, but a device or a pipe such as <(); write it to a file first"),
    errno.EFBIG: ("file-too-large", "the file has {}; is it the right one?"),
    errno.ELOOP: ("unreadable", "cannot be opened, the symbolic link leads to itself; name the file"),
    **dict.fromkeys((errno.EACCES, errno.EPERM), ("unreadable", "permission denied; change its permissions")),
}
# error of expat -> code and remedy
NOT_XML = {
    errors.XML_ERROR_UNKNOWN_ENCODING: ("encoding", "save the file as UTF-8"),
    errors.XML_ERROR_INCORRECT_ENCODING: ("encoding", "save the file as UTF-8"),
    errors.XML_ERROR_UNDEFINED_ENTITY: ("entity", "only &lt; &gt; &amp; &quot; &apos; are read; write the value out"),
    errors.XML_ERROR_NO_ELEMENTS: ("not-xml", "the file ends before the description does; is it cut off?"),
}
# code -> actual value; expected value; remedy
RULES = {
    "no-links.macros": "it only defines the macros {names}, no <link>; a robot is expected; load the file that calls "
    "them, usually robot.urdf.xacro, or write three lines that include this file and call the macro",
    "urdf-version": "its version is {version!r:.80}; 1.0 is supported; convert it to URDF 1.0",
    "name-missing": 'it has no name; a name is expected; add name="..."',
    "name-long": "its name has {length} characters; at most {most} are expected; shorten it",
    "name-unprintable": "its name {name!r} contains unprintable characters; rename it",
    "name-reserved": "the name {name!r} is reserved for the fixed world; rename it, e.g. 'world'",
    "origin-attribute": "its origin has {seen}; xyz and rpy are read; write rpy",
    "far-away": "its {tag} {key} is {seen} m; at most 1e+06 m is allowed; check the unit",
    "mass": "its mass is {mass} kg; 0 or more is expected; correct the mass",
    "mjcf-class": "<{tag}> has the class {name!r:.80}; one that a <default> defines is expected; correct the name",
    "mjcf-orientation": "{seen}; exactly one orientation is expected; {fix}",
    "mjcf-coupling": "it is coupled to {other!r} by polycoef {c}; one linear coupling to one other joint is expected; "
    "make it linear, or remove it and lock the joint",
    "mjcf-element": "its shape {kind!r:.80} is not supported; a primitive or a mesh file is expected; replace it",
    "no-links": "the robot has no <link>; at least one is expected; is it a xacro file, or cut off?",
    "too-many-dof": 'the robot has {nv} degrees of freedom; the limit is {most}; make unused joints type="fixed"',
    "too-deep": "the tree of links is more than {most} joints deep; merge links that are fixed to each other",
    "many-roots": "the links {names} have no parent; one root is expected; join {other!r} to the rest, or delete it",
    "detached": "{names} form a loop that is not connected to the root; open the loop and connect it to the rest",
    "joint-link": 'it names no {tag} link; one is expected; add <{tag} link="..."/>',
    "planar-axis": "{seen}; a planar joint needs 0 0 1; turn the joint's origin instead",
    "axis-zero": 'its axis is 0 0 0; a direction is expected; write it, or type="fixed" for a joint that never moves',
    "axis-norm": "its axis {xyz} has length {norm:.3g}; length 1 is expected; write a unit vector",
    "limit-order": "its limits are {lower:g} ... {upper:g} {unit}{likewise}; lower below upper is expected; "
    "swap or correct them, or {otherwise}, or lock {locks}",
    "limit-degrees": "its limits are {lower:g} ... {upper:g} {unit}{likewise}, more than two turns: they look like "
    "degrees; radians are expected; write {low:.4f} ... {high:.4f}{compiler}, or {otherwise} for many turns",
    "self-loop": "its parent and its child are both {link!r}; two links are expected; correct one of them",
    "two-parents": "its child {link!r} already has the joint {other!r}; closed chains are not supported: remove one",
    "mimic-leader": 'its <mimic> names no joint; one is expected; add joint="..." to <mimic>, or delete it',
    "mimic-type": "it is {type}, with {nv} degrees of freedom, in a <mimic>; one is expected; delete the <mimic>",
    "mimic-multiplier": "it follows {leader!r} by the factor {by:g}; at most 1e+06 is allowed; correct the multiplier",
}


@final
@dataclass(frozen=True)
class Diagnostics:
    """Collector of warnings about one file, which also makes the errors with which the file is refused.

    Attributes:
        path: The file.
        kept: Warnings so far, in order.
    """

    path: Path
    kept: list[str] = field(default_factory=list)

    @property
    def warnings(self) -> tuple[str, ...]:
        """Warnings in order, each once; if there are more than a hundred, the last one counts the others."""
        merged = list(dict.fromkeys(merge_similar(self.kept).values()))
        more = [f"{len(merged) - MAX_WARNINGS} more warnings are left out"] if len(merged) > MAX_WARNINGS else []
        return (*merged[:MAX_WARNINGS], *more)

    def refusal(self, code: str, line: int | None, sentence: str) -> RobotError:
        """Return the error with which the file is refused; the caller raises it.

        Args:
            code: Short stable name of the reason.
            line: Line in the file, counted from 1; None if it is not known.
            sentence: Message: the element, the actual value, the expected value and the remedy.
        """
        place = f"{self.path}:{line}" if line is not None else f"{self.path}"
        return RobotError(f"{place}: {sentence}", code=code, path=self.path, line=line)

    def require(self, is_right: bool, code: str, line: int | None, where: str = "", **values: object) -> None:
        """Raise an error with a message from `RULES` unless a condition holds.

        Args:
            is_right: The condition; False refuses the file.
            code: Key of the message in `RULES`, and code of the error.
            line: Line in the file, counted from 1; None if it is not known.
            where: Name of the element at fault, with which the message begins.
            **values: Values for the placeholders of the message.

        Raises:
            RobotError: `is_right` is False.
        """
        if not is_right:
            raise self.refusal(code, line, where + RULES[code].format(**values))

    def warn(self, line: int | None, sentence: str) -> None:
        """Add a warning to `Robot.warnings`.

        Args:
            line: Line in the file, counted from 1; None if it is not known.
            sentence: The warning.
        """
        self.kept.append(f"line {line}: {sentence}" if line is not None else sentence)


def merge_similar(sentences: Iterable[str]) -> dict[str, str]:
    """Merge sentences that differ only in line, name or numbers about meshes.

    Args:
        sentences: Warnings.

    Returns:
        Dictionary from each sentence to its merged form, which names the first element and the number of the others.
    """
    alike: dict[tuple[str, str], list[re.Match[str]]] = {}
    for match in filter(None, map(PLACE.fullmatch, dict.fromkeys(sentences))):
        why = re.sub(r" [\d.e+]+ ", "", match["why"]) if match["kind"] == "mesh" else match["why"]
        alike.setdefault((match["kind"] or "", why), []).append(match)
    merged: dict[str, str] = {}
    for first, *others in alike.values():
        joined = f"{first['place']} (and {len(others)} more){first['why']}" if first["place"] and others else ""
        merged |= {match.string: joined or match.string for match in (first, *others)}
    return merged


def quoted(names: Sequence[str]) -> str:
    """Return names as text: the first few in quotes, with the number of the others.

    Args:
        names: Names; long names are shortened.
    """
    return few([repr(shorten(n)) for n in names], NAMES_SHOWN)


def shorten(text: str, length: int = 80) -> str:
    """Shorten a text to a length that fits into a sentence.

    Args:
        text: The text.
        length: Largest number of characters.

    Returns:
        The text; a shortened one ends in `...`.
    """
    return text if len(text) <= length else f"{text[: length - 3]}..."


def suggest_name(name: str, known: Iterable[str], otherwise: str) -> str:
    """Return advice for an unknown name, e.g. `did you mean 'elbow'?`.

    Args:
        name: The unknown name.
        known: Names that exist.
        otherwise: Advice to return if no known name is similar.
    """
    near = closest_names(name, known)
    return f"did you mean {quoted(near)}?" if near else otherwise


def open_regular_file(path: str | os.PathLike[str]) -> BinaryIO:
    """Open a regular file of unknown origin for reading, without waiting for the writer of a pipe.

    Args:
        path: The file.

    Returns:
        The open binary file.

    Raises:
        OSError: The file cannot be opened, as for `open`; `ENXIO` if it is not a regular file, `EINVAL` if no file can
            have that path.
    """
    try:  # opening a pipe would wait for its writer
        file = open(path, "rb", opener=lambda name, flags: os.open(name, flags | os.O_NONBLOCK))
    except ValueError as error:
        raise OSError(errno.EINVAL, f"not a usable path, {error}") from error
    if not stat.S_ISREG(os.fstat(file.fileno()).st_mode):
        file.close()
        raise OSError(errno.ENXIO, "not a regular file")
    return file


def read_regular_file(path: str | os.PathLike[str], most: int) -> bytes:
    """Read a regular file of limited size.

    Args:
        path: The file.
        most: Largest size [bytes].

    Returns:
        Its content.

    Raises:
        OSError: The file cannot be opened, see `open_regular_file`; `EFBIG` if it is larger than `most`.
    """
    with open_regular_file(path) as file:
        content = file.read(most + 1)
    if len(content) > most:
        raise OSError(errno.EFBIG, f"more than {most:,} bytes")
    return content


def unreadable(error: OSError) -> tuple[str, str]:
    """Explain why a file cannot be read.

    Args:
        error: Error from `open_regular_file` or `read_regular_file`.

    Returns:
        Short code of the reason, and a sentence with the reason and the remedy.
    """
    code, sentence = UNREADABLE.get(error.errno or 0, ("unreadable", "cannot be opened ({}); check the path"))
    return code, sentence.format(error.strerror or error)


def parsed_json(content: bytes | str) -> Any:
    """Parse an untrusted JSON document.

    Args:
        content: Text of the document.

    Returns:
        The JSON value.

    Raises:
        ValueError: The text is not JSON, a key appears twice, or brackets are nested too deeply.
    """

    def unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        content = dict(pairs)
        if len(content) < len(pairs):
            raise ValueError(f"one of the keys {quoted(list(content))} stands twice")
        return content

    def depth(value: Any) -> int:
        inner = value.values() if isinstance(value, dict) else value if isinstance(value, list) else ()
        return 1 + max(map(depth, inner), default=0)

    try:
        # an integer beyond 64 bits becomes a float, as in other parsers, and infinite if it is too large
        value = json.loads(content, object_pairs_hook=unique, parse_int=lambda n: int(n) if len(n) < 20 else float(n))
        if depth(value) <= DEEPEST:
            return value
    except RecursionError:
        pass
    raise ValueError(f"more than {DEEPEST} brackets are open within each other")


def read_description(path: Path) -> bytes:
    """Read a regular file of at most 10 MB.

    Args:
        path: The file.

    Returns:
        Its content.

    Raises:
        RobotError: The file cannot be read; codes `missing`, `not-a-file`, `unreadable`, `file-too-large`.
    """
    try:
        return read_regular_file(path, MAX_BYTES)
    except OSError as error:
        (code, words), inside = unreadable(error), sorted(p.name for p in path.glob("*.urdf")) if path.is_dir() else []
        more = f", e.g. {', '.join(inside[:NAMES_SHOWN])}" if inside else ""
        raise RobotError(f"{path}: {words}{more}", code=code, path=path) from error


@final
@dataclass(frozen=True)
class XmlNode:
    """XML element of a robot description.

    Attributes:
        tag: Tag of the element.
        attributes: Its attributes, as text.
        line: Line in the file on which it starts; None in the output of xacro, whose lines are not in the file.
        log: Collector of the warnings about the file.
        parent: The element around it; None for the root.
        children: The elements inside it.
        texts: Text between its tags, in pieces; stored for `<param>` only.
    """

    tag: str
    attributes: dict[str, str]
    line: int | None
    log: Diagnostics
    parent: XmlNode | None
    children: list[XmlNode] = field(default_factory=list, repr=False, compare=False)
    texts: list[str] = field(default_factory=list)

    @property
    def where(self) -> str:
        """Name of the link, joint, body or site to which the element belongs, for messages."""
        name = self.attributes.get("name")
        if name and self.tag in ("link", "joint", "body", "site"):
            return f"{self.tag} {shorten(name)!r}"
        return "the robot" if self.parent is None else self.parent.where

    def all(self, tag: str) -> list[XmlNode]:
        """Return the children with a tag.

        Args:
            tag: The tag.
        """
        return [c for c in self.children if c.tag == tag]

    def first(self, tag: str) -> XmlNode | None:
        """Return the first child with a tag, or None.

        Args:
            tag: The tag.
        """
        return next((c for c in self.children if c.tag == tag), None)

    def refusal(self, code: str, sentence: str) -> RobotError:
        """Return the error with which the element is refused; the caller raises it.

        Args:
            code: Short stable name of the reason.
            sentence: Message: the actual value, the expected value and the remedy.
        """
        return self.log.refusal(code, self.line, f"{self.where}: {sentence}")

    def require(self, is_right: bool, code: str, **values: object) -> None:
        """Raise an error about this element with a message from `RULES` unless a condition holds.

        Args:
            is_right: The condition; False refuses the element.
            code: Key of the message in `RULES`, and code of the error.
            **values: Values for the placeholders of the message.

        Raises:
            RobotError: `is_right` is False.
        """
        if not is_right:
            self.log.require(False, code, self.line, f"{self.where}: ", **values)

    def warn(self, sentence: str) -> None:
        """Add a warning about this element to `Robot.warnings`.

        Args:
            sentence: The warning.
        """
        self.log.warn(self.line, f"{self.where}: {sentence}")

    def number(self, attribute: str, default: float = math.nan) -> float:
        """Return the number in an attribute.

        Args:
            attribute: Name of the attribute.
            default: Result if there is no such attribute.

        Raises:
            RobotError: The text is no finite number; codes `number`, `not-finite`, `xacro-expression`.
        """
        text = self.attributes.get(attribute)
        return default if text is None else self._parse_number(text.strip(), attribute)

    def vector(self, attribute: str, size: int) -> tuple[float, ...] | None:
        """Return the numbers in an attribute; None if there is no such attribute.

        Args:
            attribute: Name of the attribute.
            size: Required number of numbers.

        Raises:
            RobotError: The text is no vector of this size; codes `number`, `not-finite`, `vector-size`,
                `xacro-expression`.
        """
        text = self.attributes.get(attribute)
        if text is None:
            return None
        words = text.split()
        if "${" not in text and len(words) != size:
            fix = "separate the numbers by spaces, not by commas" if "," in text else "write one number for each"
            finding = f'{self.tag} {attribute}="{shorten(text)}" has {counted(len(words), "number")}'
            raise self.refusal("vector-size", f"{finding}; {size} are expected; {fix}")
        return tuple(self._parse_number(word, attribute) for word in words)

    def _parse_number(self, text: str, attribute: str) -> float:
        """Return the number of a text, or refuse the text."""
        value = float(text) if NUMBER_TEXT.fullmatch(text) else math.nan
        largest = 1e100  # squares and products of larger numbers overflow
        if abs(value) <= largest:
            return value
        code, expected, fix = "number", "a number is expected", "write digits such as 0.5"
        if not math.isnan(value):
            code, expected, fix = "not-finite", f"at most {largest:g} is expected", "write the true value"
        elif "${" in text:
            code, fix = "xacro-expression", "this is xacro, not URDF: name the file *.xacro"
            fix += advice(" and load it with {}", "xacro=True", "--xacro")
        elif text.lower().lstrip("+-") in ("nan", "inf", "infinity", "1.#inf", "1.#qnan"):
            code, expected, fix = "not-finite", "a finite number is expected", "write the true value"
            fix = 'for a joint without limits write type="continuous"' if self.tag == "limit" else fix
        elif re.fullmatch(r"[+-]?\d+,\d+", text):
            fix = "write a decimal point, not a comma"
        raise self.refusal(code, f'{self.tag} {attribute}="{shorten(text)}"; {expected}; {fix}')


def parse_xml(content: bytes, path: Path) -> XmlNode:
    """Return the root element of an XML document; its `log` collects the warnings of the file.

    Args:
        content: Text of the document.
        path: File of the document, for error messages.

    Raises:
        RobotError: The document is refused; codes `empty`, `not-xml`, `entity`, `doctype`, `encoding`, `xml-too-deep`,
            `xml-too-large`.
    """
    log = Diagnostics(path)
    if not content.strip():
        raise log.refusal("empty", None, "the file is empty; a robot description is expected")
    parser, nodes, stack = xml.parsers.expat.ParserCreate(), list[XmlNode](), list[XmlNode]()

    def refusal(code: str, sentence: str) -> RobotError:
        return log.refusal(code, parser.CurrentLineNumber, sentence)

    def start(tag: str, attributes: dict[str, str]) -> None:
        if len(nodes) >= MAX_ELEMENTS:
            raise refusal("xml-too-large", f"more than {MAX_ELEMENTS} XML elements; split the file")
        if len(stack) >= 60:  # nested bodies of MJCF need one level per joint
            raise refusal("xml-too-deep", "XML elements are nested deeper than 60 levels; URDF needs 6")
        for key, value in attributes.items():
            if len(value) > 100_000:  # no robot needs more than a few hundred
                finding = f"attribute {shorten(key)!r} of <{shorten(tag)}> has {len(value)} characters"
                raise refusal("xml-too-large", f"{finding}, at most 100000 are read")
        line = parser.CurrentLineNumber if path.suffix != ".xacro" else None
        node = XmlNode(tag, attributes, line, log, stack[-1] if stack else None)
        if stack:
            stack[-1].children.append(node)
        nodes.append(node)
        stack.append(node)
        parser.CharacterDataHandler = node.texts.append if tag == "param" else None  # until the next element begins

    def doctype(*_: object) -> None:
        reason = "since it can define entities; delete it and write the values out"
        raise refusal("doctype", f"a <!DOCTYPE> is not read, {reason}")

    parser.StartElementHandler, parser.StartDoctypeDeclHandler = start, doctype
    parser.EndElementHandler = lambda tag: stack.pop()
    try:
        parser.Parse(content, True)
    except ExpatError as error:
        reason = xml.parsers.expat.ErrorString(error.code) or "unreadable"
        code, fix = NOT_XML.get(reason, ("not-xml", "repair the XML at this line"))
        begins = content.lstrip(b"\xef\xbb\xbf \t\r\n").startswith((b"<", b"\xff\xfe", b"\xfe\xff"))
        if code == "not-xml" and not begins:
            fix = "a URDF file begins with '<'; name the robot here, by its name or its file, and other files after it"
        finding = f"not readable as XML ({reason}, column {error.offset + 1})"
        raise log.refusal(code, error.lineno, f"{finding}; {fix}") from error
    except (LookupError, ValueError) as error:  # unknown or unusable encoding
        finding = f"its XML declaration names an encoding that cannot be read ({error})"
        raise refusal("encoding", f"{finding}; save it as UTF-8") from error
    return nodes[0]
