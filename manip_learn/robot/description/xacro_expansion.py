"""xacro files -> URDF, on request: their expressions are code of others, and run in a process of limits."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from importlib.util import find_spec
from pathlib import Path

from manip_learn.errors import MissingExtraError, RobotError, advice, closest_names
from manip_learn.robot.description.text import MAX_BYTES, read_description
from manip_learn.robot.description.xacro_child import FORBIDDEN, declared_in
from manip_learn.robot.limited_child import LimitedChild

CHILD = Path(__file__).with_name("xacro_child.py")
MEMORY = 1_000_000_000  # [bytes] of the expanding process; the libraries alone take 100 MB
SECONDS = 20  # for one file; the largest robots take 3


def expanded_xacro(path: Path, asked: bool | Mapping[str, str], package_dirs: Sequence[Path] = ()) -> bytes:
    """Text of the URDF that a xacro file stands for.

    Args:
        path: The .xacro file.
        asked: Whether the caller opted in: True, or the values of its arguments (`<xacro:arg>`) by name.
        package_dirs: Folders that contain the packages of `$(find ...)`; the folders above the file are searched too.

    Raises:
        RobotError: Codes `xacro` (not opted in), `xacro-arg` (no such argument), `xacro-failed` (its expressions are
            wrong, or take more than 20 s or 1 GB), `doctype`, and those of reading a file.
        MissingExtraError: xacrodoc is not installed.
    """
    content = read_description(path)
    if asked is False:
        how = advice("{}", "load_robot(..., xacro=True)", "--xacro") or "xacro robot.xacro > robot.urdf"
        raise RobotError(
            f"{path}: a xacro file is not expanded unless you ask, since it runs expressions and includes other "
            f"files; if you trust it: {how}",
            code="xacro",
            path=path,
        )
    values = {} if asked is True else asked
    if not isinstance(values, Mapping) or not all(isinstance(name, str) for name in values):
        sentence = f"{path}: xacro is {asked!r:.80}; True, or a mapping {{argument: value}}, is needed"
        raise RobotError(sentence, code="xacro-arg")
    if any(word in content for word in FORBIDDEN):
        raise _doctype(path)
    if find_spec("xacro") is None or find_spec("xacrodoc") is None:
        raise MissingExtraError(f"the xacro file {path}", "xacro")
    text, declared = _expanded(path, {name: str(value) for name, value in values.items()}, package_dirs)
    declared |= declared_in(content)
    unknown = sorted(set(values) - declared)
    if unknown:  # xacro itself would ignore it
        shown = ", ".join(map(repr, closest_names(unknown[0], declared) or sorted(declared))) or "none"
        sentence = f"{path}: the xacro file has no argument {unknown[0]!r}; it has {shown}"
        raise RobotError(sentence, code="xacro-arg", path=path)
    return text.encode()


def _expanded(path: Path, values: dict[str, str], package_dirs: Sequence[Path]) -> tuple[str, set[str]]:
    """The URDF, and the names of the arguments that included files declare."""
    packages = {p.name: str(p.absolute()) for d in package_dirs for p in d.iterdir() if p.is_dir()}
    job = {"path": str(path.absolute()), "values": values, "packages": packages, "most": MAX_BYTES}
    child = LimitedChild(CHILD, memory=MEMORY, seconds=SECONDS, folder=path.absolute().parent)
    try:
        answer = child.ask(job, SECONDS)
    except (TimeoutError, ChildProcessError) as error:
        limits = f"its expressions may take {SECONDS} s and {MEMORY // 1_000_000_000} GB"
        raise RobotError(
            f"{path}: xacro could not be expanded: {error}; {limits}", code="xacro-failed", path=path
        ) from error
    finally:
        child.close()
    if "doctype" in answer:
        raise _doctype(Path(answer["doctype"]))
    if "fault" in answer:
        said = " ".join(answer["fault"].split())[:300]
        folders = advice(
            ", or name the folder that contains the package with {}", "package_dirs=[...]", "--package-dir FOLDER"
        )
        fix = f"correct it{folders or ', or set ROS_PACKAGE_PATH'} for $(find ...)"
        raise RobotError(f"{path}: xacro could not be expanded ({said}); {fix}", code="xacro-failed", path=path)
    return answer["text"], set(answer["declared"])


def _doctype(path: Path) -> RobotError:
    return RobotError(f"{path}: a <!DOCTYPE> is not read; delete it", code="doctype", path=path)
