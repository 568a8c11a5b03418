"""Mutated robot descriptions: from a seed number, always the same one."""

from __future__ import annotations

import random
import re
from pathlib import Path

from urdf_corpus import ARM, chain, mimic_chain

ROBOTS = Path(__file__).resolve().parents[1] / "robots"
MJCF = """<mujoco model="m">
  <compiler angle="degree" eulerseq="xyz"/>
  <default><joint axis="0 1 0"/><default class="c"><joint type="slide" range="0 0.2"/></default></default>
  <asset><mesh name="mesh" file="a.stl" scale="1 1 1"/></asset>
  <worldbody><geom type="plane" size="1 1 1"/>
    <body name="a" pos="0 0 0.3" euler="10 20 30"><joint name="j" range="-90 90" pos="0.1 0 0" ref="5"/>
      <inertial pos="0 0 0" mass="1" diaginertia="0.1 0.1 0.1"/><geom type="capsule" size="0.1 0.2" rgba="1 0 0 1"/>
      <body name="b" axisangle="0 0 1 45" childclass="c"><joint name="k"/><joint name="l" class="main" limited="false"/>
        <geom mesh="mesh" type="mesh" quat="1 0 0 0"/><site name="tip" pos="0.1 0 0"/></body></body>
    <body name="d" xyaxes="1 0 0 0 1 0"><freejoint name="f"/></body>
  </worldbody>
  <equality><joint joint1="l" joint2="j" polycoef="0.1 2 0 0 0"/></equality>
</mujoco>
"""
VALUES = (
    "nan inf -inf 0 -0 1 -1 1e308 -1e308 1e-308 4e-324 1e999 2147483648 4294967296 9223372036854775808 0x10 1e 1.2.3 "
    "1,5 universe world root_joint revolute continuous prismatic planar floating fixed spherical mimic package://a/b.stl"
).split() + ["", " ", "0 0 0", "0 0 1e-4", "1 1", "1 2 3 4", "\u2028", "\U0001f916", "&amp;", "%n%s", "a" * 5000]


def parents() -> list[str]:
    """The descriptions that mutants are made from."""
    shipped = [p.read_text(encoding="utf-8") for p in sorted(ROBOTS.glob("*.urdf"))]
    planar = ARM.replace('"revolute"', '"planar"', 1)
    limit = '<limit lower="-1" upper="1" velocity="1" effort="1"/>'
    made = [chain(4, "continuous"), chain(3, "floating"), chain(6, "prismatic", limit), mimic_chain((2, 0, 1))]
    return [ARM, ARM, planar, *(m.decode() for m in made), *shipped, MJCF, MJCF]


PARENTS = parents()


def mutant(seed: int) -> bytes:
    """The description of that seed: one to four changes to one of the parents."""
    rng = random.Random(seed)
    text = rng.choice(PARENTS)
    for _ in range(rng.choice((1, 1, 1, 2, 2, 3, 4))):
        text = rng.choice(STRUCTURED)(text, rng)
    content = text.encode("utf-8", "surrogatepass")
    for _ in range(rng.choice((0, 0, 0, 0, 0, 0, 0, 0, 1, 2))):
        content = rng.choice(RAW)(content, rng)
    return content


def _attribute_value(text: str, rng: random.Random) -> str:
    """An attribute gets a strange value, or that of another attribute."""
    found = list(re.finditer(r'"([^"<]*)"', text))
    if not found:
        return text
    here = rng.choice(found)
    value = rng.choice(VALUES) if rng.random() < 0.6 else rng.choice(found).group(1)
    return text[: here.start(1)] + value + text[here.end(1) :]


def _one_number(text: str, rng: random.Random) -> str:
    """One number of a vector changes."""
    found = list(re.finditer(r"(?<=[\" ])-?\d+\.?\d*(?=[\" ])", text))
    if not found:
        return text
    here = rng.choice(found)
    return text[: here.start()] + rng.choice(VALUES) + text[here.end() :]


def _element_dropped(text: str, rng: random.Random) -> str:
    """An empty element goes, or a whole joint or link."""
    found = list(re.finditer(r"<[^<>/!?]*/>|<(joint|link|visual|body)\b.*?</\1>", text, re.DOTALL))
    if not found:
        return text
    here = rng.choice(found)
    return text[: here.start()] + text[here.end() :]


def _element_doubled(text: str, rng: random.Random) -> str:
    """A whole element comes twice, or moves; rarely a piece that is no element."""
    pattern = (
        r"<(joint|link|visual|inertial|body)\b.*?</\1>|<[^<>/!?]*/>" if rng.random() < 0.9 else r"<[^<>]*>[^<]*<[^<>]*>"
    )
    found = list(re.finditer(pattern, text, re.DOTALL))
    cuts = [m.end() for m in found]
    if not cuts:
        return text
    here, k = rng.choice(found), rng.choice(cuts)
    if rng.random() < 0.5:
        return text[:k] + here.group() + text[k:]
    return text[: here.start()] + text[here.end() : k] + here.group() + text[max(k, here.end()) :]


def _tag_renamed(text: str, rng: random.Random) -> str:
    """A tag or attribute name changes."""
    words = list(re.finditer(r"(?<=[</ ])[a-z]+(?=[ =>/])", text))
    if not words:
        return text
    here, other = rng.choice(words), rng.choice(words)
    return text[: here.start()] + rng.choice((other.group(), "xacro:if", "x")) + text[here.end() :]


def _cut(content: bytes, rng: random.Random) -> bytes:
    return content[: rng.randrange(len(content) + 1)]


def _bit(content: bytes, rng: random.Random) -> bytes:
    out = bytearray(content)
    for _ in range(rng.choice((1, 1, 4))):
        if out:
            out[rng.randrange(len(out))] ^= 1 << rng.randrange(8)
    return bytes(out)


def _spliced(content: bytes, rng: random.Random) -> bytes:
    if not content:
        return content
    i, j, k = (rng.randrange(len(content)) for _ in range(3))
    return content[:i] + content[min(j, k) : max(j, k)] + content[i:]


def _junk(content: bytes, rng: random.Random) -> bytes:
    i = rng.randrange(len(content) + 1)
    return content[:i] + rng.randbytes(rng.randrange(1, 20)) + content[i:]


STRUCTURED = (_attribute_value, _attribute_value, _one_number, _element_dropped, _element_doubled, _tag_renamed)
RAW = (_cut, _bit, _bit, _spliced, _junk)
