"""Corpus: XML, entities, encodings, topology."""

from __future__ import annotations

from urdf_corpus_case import ARM, CHILD, ORIGIN, PARENT, Case, cases_of, edited, tree


def xml_cases() -> list[Case]:
    """Broken, cut, foreign and unusual XML."""
    arm = ARM.encode()
    rows = [
        ("plain", "accept", arm),
        ("no declaration", "accept", arm.partition(b"?>\n")[2]),
        ("single quotes", "accept", arm.replace(b'"', b"'")),
        ("empty file", "refuse:empty", b""),
        ("only spaces", "refuse:empty", b"  \n\t "),
        ("cut in the middle", "refuse:not-xml", arm[: len(arm) // 2]),
        ("two roots", "refuse:not-xml", arm + b"<robot/>"),
        ("mismatched tags", "refuse:not-xml", arm.replace(b"</joint>", b"</jiont>")),
        ("attribute twice", "refuse:not-xml", arm.replace(b'<link name="base"', b'<link name="base" name="b"')),
        ("plain text", "refuse:not-xml", b"this is not a robot"),
        ("zero byte inside", "refuse:not-xml", arm.replace(b"elbow", b"el\0ow")),
        ("control character", "refuse:not-xml", arm.replace(b"elbow", b"el\x01ow")),
        ("sdf", "refuse:not-urdf", b'<sdf version="1.6"><model name="m"/></sdf>'),
        ("xacro macro", "refuse:xacro", edited(('<link name="base"/>', '<link name="base"/><xacro:arm/>'))),
        ("xacro include", "refuse:xacro", edited(('<link name="base"/>', '<include filename="x"/>'))),
        ("xacro expression", "refuse:xacro-expression", edited(("0 0 0.3", "0 0 ${pi/2}"))),
        ("version 1.1", "refuse:urdf-version", edited(('name="arm"', 'name="arm" version="1.1"'))),
        ("unknown element", "warn", edited(('<link name="base"/>', '<link name="base"/><wheel/>'))),
        ("element in wrong case", "warn", edited(("<axis", "<Axis"), ("</robot>", "</robot>"))),
        ("misspelt origin", "warn", edited(("<origin xyz", "<orgin xyz"))),
        ("element twice", "refuse:element-twice", edited((ORIGIN, ORIGIN + ORIGIN))),
        ("quaternion origin", "refuse:origin-attribute", edited(('rpy="0 0 0.1"', 'quat_xyzw="0 0 0 1"'))),
        ("unknown attribute", "warn", edited(('rpy="0 0 0.1"', 'rqy="0 0 0.1"'))),
    ]
    return cases_of("xml", rows)


def entity_cases() -> list[Case]:
    """Everything that needs a DTD is refused; character references are plain XML."""
    arm = ARM.partition("?>\n")[2]

    def with_dtd(dtd: str, use: str = "elbow") -> bytes:
        return f"<!DOCTYPE robot {dtd}>\n{arm}".replace("elbow", use).encode()

    laughs = "".join(f'<!ENTITY l{i} "{f"&l{i - 1};" * 10}">' for i in range(1, 10))
    rows = [
        ("billion laughs", "refuse:doctype", with_dtd(f'[<!ENTITY l0 "ha">{laughs}]', "&l9;")),
        ("external entity", "refuse:doctype", with_dtd('[<!ENTITY f SYSTEM "file:///etc/passwd">]', "&f;")),
        ("parameter entity", "refuse:doctype", with_dtd('[<!ENTITY % p SYSTEM "file:///dev/random"> %p;]')),
        ("external subset", "refuse:doctype", with_dtd('SYSTEM "file:///dev/zero"')),
        ("default attributes", "refuse:doctype", with_dtd('[<!ATTLIST link name CDATA "x">]')),
        ("undefined entity", "refuse:entity", arm.replace("elbow", "&elbow;").encode()),
        ("built-in entities", "accept", arm.replace("elbow", "a&amp;b&lt;c&gt;").encode()),
        ("character reference", "accept", arm.replace("elbow", "el&#98;ow").encode()),
        ("reference to zero", "refuse:not-xml", arm.replace("elbow", "&#0;").encode()),
    ]
    return cases_of("entities", rows)


def encoding_cases() -> list[Case]:
    """Encodings as declared, as meant, and as neither."""
    text = ARM.partition("?>\n")[2].replace("elbow", "Ellenbögen")

    def declared(encoding: str, codec: str = "") -> bytes:
        return (f'<?xml version="1.0" encoding="{encoding}"?>\n' + text).encode(codec or encoding)

    rows = [
        ("utf-8", "accept", declared("utf-8")),
        ("utf-8 with mark", "accept", b"\xef\xbb\xbf" + declared("utf-8")),
        ("utf-16 with mark", "accept", declared("utf-16")),
        ("latin-1", "accept", declared("iso-8859-1")),
        ("ascii with references", "accept", declared("ascii", "utf-8").replace("ö".encode(), b"&#246;")),
        ("latin-1 undeclared", "refuse:not-xml", text.encode("latin-1")),
        ("utf-8 declared as utf-16", "refuse:encoding", declared("utf-16", "utf-8")),
        ("unknown encoding", "refuse:encoding", declared("klingon", "utf-8")),
        ("codec that is no text encoding", "refuse:encoding", declared("rot13", "utf-8")),
        ("overlong utf-8", "refuse:not-xml", ARM.encode().replace(b"elbow", b"el\xc0\xafow")),
    ]
    return cases_of("encoding", rows)


def topology_cases() -> list[Case]:
    """Trees, and what is no tree."""
    line = [("1", "a", "b"), ("2", "b", "c"), ("3", "c", "d"), ("4", "d", "e")]
    rows = [
        ("one link", "warn", b'<robot name="r"><link name="a"/></robot>'),
        ("fixed line", "warn", tree(line)),
        ("branches", "warn", tree([("1", "a", "b"), ("2", "a", "c"), ("3", "a", "d"), ("4", "d", "e")])),
        ("joints before links", "warn", tree(line, "", "".join(f'<link name="{c}"/>' for c in "abcde"))),
        ("no links", "refuse:no-links", b'<robot name="r"/>'),
        ("joints only", "refuse:no-links", tree(line, "")),
        ("two roots", "refuse:many-roots", tree(line[:3])),
        ("circle of five", "refuse:no-root", tree([*line, ("5", "e", "a")])),
        ("root and a circle", "refuse:detached", tree([("1", "a", "b"), ("2", "c", "d"), ("3", "d", "c")], "abcd")),
        ("closed chain", "refuse:two-parents", tree([*line, ("5", "a", "e")])),
        ("link joined to itself", "refuse:self-loop", tree([*line, ("5", "e", "e")])),
        ("unknown parent", "refuse:unknown-link", tree([*line[:3], ("4", "x", "e")])),
        ("unknown child", "refuse:unknown-link", tree([*line, ("5", "e", "f")])),
        ("no parent element", "refuse:joint-link", edited((PARENT, ""))),
        ("no child element", "refuse:joint-link", edited((CHILD, ""))),
        ("parent without attribute", "refuse:joint-link", edited((PARENT, "<parent>base</parent>"))),
        ("two parents in a joint", "refuse:element-twice", edited((PARENT, PARENT + '<parent link="tip"/>'))),
    ]
    return cases_of("topology", rows)
