"""The colour that a COLLADA mesh has for the most part."""

from __future__ import annotations

import re
from collections import Counter
from pathlib import Path

from manip_learn.robot.description.regular_file import read_regular_file
from manip_learn.robot.visuals.mesh_content import MAX_MESH_BYTES
from manip_learn.robot.visuals.shapes import Colour

# every pattern stops at the next "<", so that the time is linear in the size of the file, whatever is in it
PIECE = re.compile(rb"<(?:triangles|polylist|polygons)\b([^<>]*)>")
BOUND = re.compile(rb"<instance_material\b([^<>]*)>")
MATERIAL = re.compile(rb"<material\b([^<>]*)>\s*<instance_effect\b([^<>]*)>")
DIFFUSE = re.compile(rb"<diffuse>\s*<color[^<>]*>([^<]*)<")


def mesh_colour(path: Path) -> Colour | None:
    """Diffuse colour of the material with the most polygons; None for other formats, textures, and what is unclear."""
    if path.suffix.lower() != ".dae":
        return None
    try:
        content = read_regular_file(path, MAX_MESH_BYTES)
    except OSError:
        return None
    effects = {}
    for effect in content.split(b"<effect")[1:]:
        found = DIFFUSE.search(effect)
        colour = _rgba(found.group(1)) if found else None
        if colour is not None:
            effects[_value(effect.partition(b">")[0], b"id")] = colour
    materials = {_value(a, b"id"): _value(b, b"url").removeprefix(b"#") for a, b in MATERIAL.findall(content)}
    targets = {_value(a, b"symbol"): _value(a, b"target").removeprefix(b"#") for a in BOUND.findall(content)}
    polygons: Counter[Colour] = Counter()
    for attributes in PIECE.findall(content):
        symbol, count = _value(attributes, b"material"), _value(attributes, b"count")
        colour = effects.get(materials.get(targets.get(symbol, symbol), b""))
        if colour is not None and count.isdigit():
            polygons[colour] += int(count[:9])
    return polygons.most_common(1)[0][0] if polygons else None


def _value(attributes: bytes, name: bytes) -> bytes:
    found = re.search(rb"\b" + name + rb"\s?=\s?[\"']([^\"']*)", attributes[:2000])
    return found.group(1) if found else b""


def _rgba(text: bytes) -> Colour | None:
    try:
        numbers = [min(max(float(word), 0.0), 1.0) for word in text.split()]
    except ValueError:
        return None
    if len(numbers) not in (3, 4) or any(x != x for x in numbers):
        return None
    # exporters disagree on what the fourth number means: a mesh is not transparent by it
    return (numbers[0], numbers[1], numbers[2], 1.0)
