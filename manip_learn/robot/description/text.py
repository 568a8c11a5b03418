"""Text of a robot description, or of another file of somebody else: bytes read without trusting the path, XML and JSON
without surprises.

XML has no entities and no doctypes here; its nodes know their line and whose they are, and refusals name both.
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

NAMES_SHOWN = 4  # names that a sentence lists
MAX_WARNINGS = 100  # nobody reads more
MAX_BYTES = 10_000_000  # of a description; the largest of example-robot-data has 0.2
MAX_ELEMENTS = 200_000  # of one file, so that memory and time stay small
DEEPEST = 100  # brackets of JSON or YAML within each other; beyond, parsers take quadratic time or run out of stack
# no two ways to read the same digits: else a long number with a typing error takes minutes
NUMBER_TEXT = re.compile(r"[+-]?(\d+(\.\d*)?|\.\d+)([eE][+-]?\d+)?", re.ASCII)
LARGEST_READ = 1e100  # squares and products of what is larger overflow
# what a sentence is about, and what it says
PLACE = re.compile(r"(?s)(?P<place>(line \d+)?((: |^)(?P<kind>mesh|link|joint|body|site) ('.*?'|\".*?\"))?)(?P<why>.*)")
# error of the operating system -> code and sentence of a file that cannot be read
UNREADABLE: dict[int, tuple[str, str]] = {
    **dict.fromkeys((errno.ENOENT, errno.ENOTDIR), ("missing", "there is no such file; check the path")),
    errno.EISDIR: ("not-a-file", "not a regular file; it is a folder, name a file in it"),
    errno.ENXIO: ("not-a-file", "not a regular file, but a device or a pipe as of <(); write it to a file first"),
    errno.EFBIG: ("file-too-large", "the file has {}; is it the right one?"),
    errno.ELOOP: ("unreadable", "cannot be opened, the link leads to itself; name the file"),
    **dict.fromkeys((errno.EACCES, errno.EPERM), ("unreadable", "it may not be read; change its permissions")),
}
# what expat says -> code, and what to do
NOT_XML = {
    errors.XML_ERROR_UNKNOWN_ENCODING: ("encoding", "save the file as UTF-8"),
    errors.XML_ERROR_INCORRECT_ENCODING: ("encoding", "save the file as UTF-8"),
    errors.XML_ERROR_UNDEFINED_ENTITY: ("entity", "only &lt; &gt; &amp; &quot; &apos; are read; write the value out"),
    errors.XML_ERROR_NO_ELEMENTS: ("not-xml", "the file ends before the description does; is it cut off?"),
}
# code -> what is seen; what is expected; what to do
RULES = {
    "no-links.macros": "it only defines the macros {names}, no <link>; a robot is expected; load the file that calls "
    "them, usually robot.urdf.xacro, or write three lines that include this file and call the macro",
    "urdf-version": "it says version {version!r:.80}; 1.0 is read; convert it to URDF 1.0",
    "name-missing": 'it has no name; a name is expected; add name="..."',
    "name-long": "its name has {length} characters; at most {most} are expected; shorten it",
    "name-unprintable": "its name {name!r} holds unprintable characters; rename it",
    "name-reserved": "the name {name!r} is kept for the fixed world; rename it, e.g. 'world'",
    "origin-attribute": "its origin has {seen}; xyz and rpy are read; write rpy",
    "far-away": "its {tag} {key} is {seen} m; at most 1e+06 m is expected; check the unit",
    "mass": "its mass is {mass} kg; 0 or more is expected; write the true mass",
    "mjcf-class": "<{tag}> has the class {name!r:.80}; one that a <default> defines is expected; correct the name",
    "mjcf-orientation": "{seen}; one direction, written in one way, is expected; {fix}",
    "mjcf-coupling": "it is coupled to {other!r} by polycoef {c}; one other joint, once, and two numbers are expected; "
    "make it linear, or remove it and lock the joint",
    "mjcf-element": "its shape {kind!r:.80} is not read; a plain body or a mesh file is expected; replace it",
    "no-links": "the robot has no <link>; at least one is expected; is it a xacro file, or cut off?",
    "too-many-dof": 'the robot has {nv} degrees of freedom; at most {most} work; make unused joints type="fixed"',
    "too-deep": "the tree of links is more than {most} joints deep; merge links that are fixed to each other",
    "many-roots": "the links {names} have no parent; one such is expected; join {other!r} to the rest, or delete it",
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
    "two-parents": "its child {link!r} is also that of joint {other!r}; closed chains are not read: remove one of them",
    "mimic-leader": 'its <mimic> names no joint; one is expected; add joint="..." to <mimic>, or delete it',
    "mimic-type": "it is {type}, with {nv} degrees of freedom, in a <mimic>; one is expected; delete the <mimic>",
    "mimic-multiplier": "it follows {leader!r} by the factor {by:g}; at most 1e+06 works; correct the multiplier",
}


@final
@dataclass(frozen=True)
class Diagnostics:
    """Collects warnings about one file and words its refusals.

    Attributes:
        path: The file.
        kept: What was warned of, in the order found.
    """

    path: Path
    kept: list[str] = field(default_factory=list)

    @property
    def warnings(self) -> tuple[str, ...]:
        """Sentences, in the order found, each once; after a hundred only their number."""
        said = list(dict.fromkeys(said_once(self.kept).values()))
        more = [f"{len(said) - MAX_WARNINGS} more warnings are left out"] if len(said) > MAX_WARNINGS else []
        return (*said[:MAX_WARNINGS], *more)

    def refusal(self, code: str, line: int | None, sentence: str) -> RobotError:
        """Return the error to raise; the sentence says whose fault it is, the value seen and expected, the remedy."""
        place = f"{self.path}:{line}" if line is not None else f"{self.path}"
        return RobotError(f"{place}: {sentence}", code=code, path=self.path, line=line)

    def require(self, is_right: bool, code: str, line: int | None, where: str = "", **values: object) -> None:
        """Refuse the file in the words of `RULES`, which the values complete, where that rule does not hold."""
        if not is_right:
            raise self.refusal(code, line, where + RULES[code].format(**values))

    def warn(self, line: int | None, sentence: str) -> None:
        """Keep a sentence for `Robot.warnings`."""
        self.kept.append(f"line {line}: {sentence}" if line is not None else sentence)


def said_once(sentences: Iterable[str]) -> dict[str, str]:
    """Return what to say for each sentence; those alike but for line, name or mesh numbers share one."""
    alike: dict[tuple[str, str], list[re.Match[str]]] = {}
    for match in (found for sentence in dict.fromkeys(sentences) if (found := PLACE.fullmatch(sentence))):
        why = re.sub(r" [\d.e+]+ ", "", match["why"]) if match["kind"] == "mesh" else match["why"]
        alike.setdefault((match["kind"] or "", why), []).append(match)
    said: dict[str, str] = {}
    for first, *others in alike.values():
        joined = f"{first['place']} (and {len(others)} more){first['why']}" if first["place"] and others else ""
        said |= {match.string: joined or match.string for match in (first, *others)}
    return said


def quoted(names: Sequence[str]) -> str:
    """Return the first few names in quotes, with the number of those left out."""
    return few([repr(shortened(n)) for n in names], NAMES_SHOWN)


def shortened(text: str, length: int = 80) -> str:
    """Text cut to a length that fits into a sentence."""
    return text if len(text) <= length else f"{text[: length - 3]}..."


def meant(name: str, known: Iterable[str], otherwise: str) -> str:
    """The remedy for a misspelt name: `did you mean 'elbow'?`, or the other advice if no known name is near."""
    near = closest_names(name, known)
    return f"did you mean {quoted(near)}?" if near else otherwise


def open_regular_file(path: str | os.PathLike[str]) -> BinaryIO:
    """Open a regular file that somebody else wrote, without waiting for the writer of a pipe.

    Raises:
        OSError: As from `open`; `ENXIO` if it is no regular file, `EINVAL` if no file can have that path.
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
    """Return the content of a regular file of at most `most` bytes.

    Raises:
        OSError: As from `open_regular_file`; `EFBIG` if it is larger.
    """
    with open_regular_file(path) as file:
        content = file.read(most + 1)
    if len(content) > most:
        raise OSError(errno.EFBIG, f"more than {most:,} bytes")
    return content


def unreadable(error: OSError) -> tuple[str, str]:
    """Return the code and the words for a file that cannot be read: what is in its place, and what to do."""
    code, said = UNREADABLE.get(error.errno or 0, ("unreadable", "cannot be opened ({}); check the path"))
    return code, said.format(error.strerror or error)


def parsed_json(content: bytes | str) -> Any:
    """Return what a JSON document of somebody else holds.

    Raises:
        ValueError: It is no JSON, a key stands twice, or values lie too deep within each other.
    """

    def once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        known = dict(pairs)
        if len(known) < len(pairs):
            raise ValueError(f"one of the keys {quoted(list(known))} stands twice")
        return known

    def depth(value: Any) -> int:
        inner = value.values() if isinstance(value, dict) else value if isinstance(value, list) else ()
        return 1 + max(map(depth, inner), default=0)

    try:
        # an integer beyond 64 bits is what it is elsewhere, a float, and infinite where that has no such number
        value = json.loads(content, object_pairs_hook=once, parse_int=lambda n: int(n) if len(n) < 20 else float(n))
        if depth(value) <= DEEPEST:
            return value
    except RecursionError:
        pass
    raise ValueError(f"more than {DEEPEST} brackets are open within each other")


def read_description(path: Path) -> bytes:
    """Return the content of a regular file of at most 10 MB.

    Raises:
        RobotError: Codes `missing`, `not-a-file`, `unreadable`, `file-too-large`.
    """
    try:
        return read_regular_file(path, MAX_BYTES)
    except OSError as error:
        (code, said), inside = unreadable(error), sorted(p.name for p in path.glob("*.urdf")) if path.is_dir() else []
        more = f", e.g. {', '.join(inside[:NAMES_SHOWN])}" if inside else ""
        raise RobotError(f"{path}: {said}{more}", code=code, path=path) from error


@final
@dataclass(frozen=True)
class XmlNode:
    """One element.

    Attributes:
        tag: Its tag.
        attributes: Its attributes, as text.
        line: Line on which it starts; None in text that xacro wrote, whose lines are those of no file.
        log: Of its file.
        parent: The element around it.
        children: The elements inside.
        texts: The text between its tags, in pieces, of a `<param>`; the text of other elements is not kept.
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
        """The link, joint, body or site that it is or belongs to, as messages name it."""
        name = self.attributes.get("name")
        if name and self.tag in ("link", "joint", "body", "site"):
            return f"{self.tag} {shortened(name)!r}"
        return "the robot" if self.parent is None else self.parent.where

    def all(self, tag: str) -> list[XmlNode]:
        """Children with that tag."""
        return [c for c in self.children if c.tag == tag]

    def first(self, tag: str) -> XmlNode | None:
        """First child with that tag, or None."""
        return next((c for c in self.children if c.tag == tag), None)

    def refusal(self, code: str, sentence: str) -> RobotError:
        """Return the error to raise; the sentence says the value seen; the value expected; the remedy."""
        return self.log.refusal(code, self.line, f"{self.where}: {sentence}")

    def require(self, is_right: bool, code: str, **values: object) -> None:
        """Refuse the element in the words of `RULES`, which the values complete, where that rule does not hold.

        Raises:
            RobotError: With that code.
        """
        if not is_right:
            self.log.require(False, code, self.line, f"{self.where}: ", **values)

    def warn(self, sentence: str) -> None:
        """Keep a sentence about it for `Robot.warnings`."""
        self.log.warn(self.line, f"{self.where}: {sentence}")

    def number(self, attribute: str, default: float = math.nan) -> float:
        """Return the number in an attribute, or the default if there is no such attribute.

        Raises:
            RobotError: Codes `number`, `not-finite`, `xacro-expression`.
        """
        text = self.attributes.get(attribute)
        return default if text is None else self._parsed(text.strip(), attribute)

    def vector(self, attribute: str, size: int) -> tuple[float, ...] | None:
        """`size` numbers in an attribute; None if there is no such attribute.

        Raises:
            RobotError: Codes `number`, `not-finite`, `vector-size`, `xacro-expression`.
        """
        text = self.attributes.get(attribute)
        if text is None:
            return None
        words = text.split()
        if "${" not in text and len(words) != size:
            fix = "separate the numbers by spaces, not by commas" if "," in text else "write one number for each"
            seen = f'{self.tag} {attribute}="{shortened(text)}" has {counted(len(words), "number")}'
            raise self.refusal("vector-size", f"{seen}; {size} are expected; {fix}")
        return tuple(self._parsed(word, attribute) for word in words)

    def _parsed(self, text: str, attribute: str) -> float:
        value = float(text) if NUMBER_TEXT.fullmatch(text) else math.nan
        if abs(value) <= LARGEST_READ:
            return value
        code, wanted, fix = "number", "a number is expected", "write digits such as 0.5"
        if not math.isnan(value):
            code, wanted, fix = "not-finite", f"at most {LARGEST_READ:g} is expected", "write the true value"
        elif "${" in text:
            code, fix = "xacro-expression", "this is xacro, not URDF: name the file *.xacro"
            fix += advice(" and load it with {}", "xacro=True", "--xacro")
        elif text.lower().lstrip("+-") in ("nan", "inf", "infinity", "1.#inf", "1.#qnan"):
            code, wanted, fix = "not-finite", "a finite number is expected", "write the true value"
            fix = 'for a joint without limits write type="continuous"' if self.tag == "limit" else fix
        elif re.fullmatch(r"[+-]?\d+,\d+", text):
            fix = "write a decimal point, not a comma"
        raise self.refusal(code, f'{self.tag} {attribute}="{shortened(text)}"; {wanted}; {fix}')


def parse_xml(content: bytes, path: Path) -> XmlNode:
    """The root element of an XML document; its `log` is that of the file.

    Args:
        content: The document.
        path: Where it came from, for the messages.

    Raises:
        RobotError: Codes `empty`, `not-xml`, `entity`, `doctype`, `encoding`, `xml-too-deep`, `xml-too-large`.
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
        if len(stack) >= 60:  # nested bodies of MJCF need one a joint
            raise refusal("xml-too-deep", "XML elements are nested deeper than 60 levels; URDF needs 6")
        for key, value in attributes.items():
            if len(value) > 100_000:  # no robot needs more than a few hundred
                seen = f"attribute {shortened(key)!r} of <{shortened(tag)}> has {len(value)} characters"
                raise refusal("xml-too-large", f"{seen}, at most 100000 are read")
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
            fix = "a URDF file begins with '<'; name the robot here, its name or its file, and other files after it"
        seen = f"not readable as XML ({reason}, column {error.offset + 1})"
        raise log.refusal(code, error.lineno, f"{seen}; {fix}") from error
    except (LookupError, ValueError) as error:  # an encoding that Python does not know, or cannot use
        seen = f"its XML declaration names an encoding that cannot be read ({error})"
        raise refusal("encoding", f"{seen}; save it as UTF-8") from error
    return nodes[0]
