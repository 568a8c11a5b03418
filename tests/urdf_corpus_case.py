"""One hostile or odd robot description, and the arm that most of them are made from."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

ARM = """<?xml version="1.0"?>
<robot name="arm">
  <link name="base"/>
  <link name="upper">
    <inertial><origin xyz="0.1 0 0"/><mass value="2"/>
      <inertia ixx="0.1" ixy="0" ixz="0" iyy="0.1" iyz="0" izz="0.1"/></inertial>
  </link>
  <link name="tip"/>
  <joint name="shoulder" type="revolute">
    <origin xyz="0 0 0.3" rpy="0 0 0.1"/><parent link="base"/><child link="upper"/>
    <axis xyz="0 0 1"/><limit lower="-2" upper="2.5" velocity="1" effort="10"/>
  </joint>
  <joint name="elbow" type="revolute">
    <origin xyz="0.4 0 0"/><parent link="upper"/><child link="tip"/>
    <axis xyz="0 1 0"/><limit lower="-1" upper="1.5" velocity="3" effort="20"/>
  </joint>
</robot>
"""
LIMIT = '<limit lower="-2" upper="2.5" velocity="1" effort="10"/>'
ORIGIN = '<origin xyz="0 0 0.3" rpy="0 0 0.1"/>'
AXIS = '<axis xyz="0 0 1"/>'
SHOULDER = '<joint name="shoulder" type="revolute">'
PARENT, CHILD = '<parent link="base"/>', '<child link="upper"/>'


@dataclass(frozen=True)
class Case:
    """One description.

    Attributes:
        category: One of the twelve.
        name: What is odd.
        verdict: `"accept"`, `"warn"`, `"refuse:CODE"`, or for meshes `"stand-in:CODE"`.
        content: The URDF.
        files: Other files, path relative to the case's folder -> content.
        file: Where the URDF is, relative to the case's folder.
        special: Makes something other than a file with that content; gets the path.
        options: Keyword arguments of `load_robot`.
    """

    category: str
    name: str
    verdict: str
    content: bytes = field(default=b"", repr=False)
    files: dict[str, bytes] = field(default_factory=dict, repr=False)
    file: str = "robot.urdf"
    special: Callable[[Path], None] | None = None
    options: dict[str, object] = field(default_factory=dict)

    def write(self, folder: Path) -> Path:
        """Write the case below a folder; the path to load."""
        path = folder / self.file
        path.parent.mkdir(parents=True, exist_ok=True)
        for name, content in self.files.items():
            target = folder / name
            target.parent.mkdir(parents=True, exist_ok=True)
            target.write_bytes(content)
        if self.special is None:
            path.write_bytes(self.content)
        else:
            self.special(path)
        return path


def edited(*changes: tuple[str, str]) -> bytes:
    """The arm with texts replaced; each must occur."""
    text = ARM
    for old, new in changes:
        if old not in text:
            raise ValueError(f"{old!r} is not in the arm")
        text = text.replace(old, new, 1)
    return text.encode()


def chain(n: int, kind: str = "fixed", limit: str = "") -> bytes:
    """A chain of n joints."""
    axis = "" if kind == "fixed" else '<axis xyz="0 0 1"/>'
    links = "".join(f'<link name="l{i}"/>' for i in range(n + 1))
    joints = "".join(
        f'<joint name="j{i}" type="{kind}"><parent link="l{i}"/><child link="l{i + 1}"/>'
        f'<origin xyz="0.1 0 0"/>{axis}{limit}</joint>'
        for i in range(n)
    )
    return f'<robot name="chain">{links}{joints}</robot>'.encode()


def star(n: int) -> bytes:
    """n links fixed to one."""
    links = "".join(f'<link name="l{i}"/>' for i in range(n + 1))
    joints = "".join(
        f'<joint name="j{i}" type="fixed"><parent link="l0"/><child link="l{i + 1}"/></joint>' for i in range(n)
    )
    return f'<robot name="star">{links}{joints}</robot>'.encode()


def tree(joints: list[tuple[str, str, str]], links: str = "abcde", extra: str = "") -> bytes:
    """Links named by letters, fixed joints (name, parent, child)."""
    body = "".join(f'<link name="{name}"/>' for name in links)
    body += "".join(
        f'<joint name="{n}" type="fixed"><parent link="{p}"/><child link="{c}"/></joint>' for n, p, c in joints
    )
    return f'<robot name="tree">{body}{extra}</robot>'.encode()


def cases_of(category: str, rows: list[tuple]) -> list[Case]:
    """Rows (name, verdict, content[, keyword arguments of Case])."""
    return [Case(category, row[0], row[1], row[2], **(row[3] if len(row) > 3 else {})) for row in rows]
