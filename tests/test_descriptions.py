"""Descriptions as other people have them, unusual, hostile and mutated: each works as it is meant, or is explained."""

from __future__ import annotations

import random
import re
from collections import Counter
from pathlib import Path

import hypothesis
import numpy as np
import pytest
from case import DATA, case, rows_in
from hypothesis import strategies as st
from urdf_corpus import ARM, CASES, DAE, chain, mimic_chain

import manip_learn as ml
from manip_learn.errors import NotIdentifiableError, RobotError, UnknownNameError
from manip_learn.robot import loading
from manip_learn.robot.loading import load_robot, robot_from_text
from manip_learn.robot.visuals.meshes import Mesh, read_meshes
from manip_learn.robot.visuals.visual_shapes import visual_shapes

# ---- descriptions as other people have them ----


def joint(name: str, parent: str, child: str, more: str = "", kind: str = "revolute", x: float = 0.3) -> str:
    """A joint about y, with usual limits unless others are given."""
    limit = "" if kind == "fixed" or "<limit" in more else '<limit lower="-2" upper="2" velocity="2" effort="9"/>'
    ends = f'<parent link="{parent}"/><child link="{child}"/><origin xyz="{x} 0 0"/><axis xyz="0 1 0"/>'
    return f'<joint name="{name}" type="{kind}">{ends}{limit}{more}</joint>'


def described(path: Path, links: list[str], *joints: str) -> Path:
    """Write a URDF."""
    bodies = "".join(f'<link name="{name}"/>' for name in links)
    path.write_text(f'<robot name="made">{bodies}{"".join(joints)}</robot>')
    return path


def test_the_unit_of_a_collada_file_is_applied(tmp_path):
    """A file that counts millimetres or inches is as large as one that counts metres and says the same."""
    sizes = {}
    for unit in ("1", "0.001", "0.0254"):
        path = tmp_path / f"{unit}.dae"
        path.write_bytes(DAE.replace(b'meter="1"', f'meter="{unit}"'.encode()))
        made = read_meshes([path])[path]
        assert isinstance(made, Mesh), made
        sizes[unit] = float(np.ptp(made.vertices, axis=0).max())
    np.testing.assert_allclose([sizes["0.001"], sizes["0.0254"]], np.array([0.001, 0.0254]) * sizes["1"], rtol=1e-6)


@pytest.mark.parametrize(("limits", "said", "in_joint", "in_control"), rows_in("narrower_limits.txt"))
def test_narrower_limits_of_safety_controllers_and_ros2_control_are_used(limits, said, in_joint, in_control, tmp_path):
    """Of positions and velocities, where they are narrower and make sense, with a note that names both ranges."""
    beside = f'<ros2_control name="c" type="system">{in_control}</ros2_control>' * bool(in_control)
    robot = load_robot(described(tmp_path / "a.urdf", ["b", "l"], joint("j", "b", "l", in_joint), beside))
    used = (robot.position_lower[0], robot.position_upper[0], robot.velocity_limit[0])
    assert used == tuple(map(float, limits.split()))
    notes = (f"line 1: joint 'j': its {said} -2 ... 2: the narrower range is used",)
    assert robot.warnings == notes[: bool(said)]


# by hand from the makers' Denavit-Hartenberg parameters, all joints at zero
@pytest.mark.parametrize(
    ("name", "tip", "place"),
    [("ur5e", "tool0", (0.425 + 0.3922, 0.1333 + 0.0996, 0.1625 - 0.0997)),
     ("ur10e", "tool0", (0.6127 + 0.57155, 0.17415 + 0.11655, 0.1807 - 0.11985)),
     ("fr3", "fr3_hand_tcp", (0.088, 0.0, 0.333 + 0.316 + 0.384 - 0.107 - 0.1034))],
)  # fmt: skip
def test_shipped_arms_are_those_of_their_makers(name, tip, place):
    """The tip at zero, and no warning."""
    robot = load_robot(name)
    assert ml.likely_tips(robot) == (tip,) and not robot.warnings
    np.testing.assert_allclose(np.abs(robot.pose(np.zeros(robot.nv), tip)[:3, 3]), place, atol=1e-12)


def test_a_hand_that_did_not_move_is_refused():
    """Of two arms one moves: the error names the other one's hand, and the frame to give instead."""
    robot, rng, time = load_robot("baxter"), np.random.default_rng(3), np.linspace(0.0, 2.0, 120)[:, None]
    middle = 0.5 * (robot.position_lower + robot.position_upper)
    moves, motions = [robot.moves(joint, "right_gripper") for joint in robot.joint_names], []
    for _ in range(6):
        swing = rng.uniform(0.2, 0.6, 17) * np.sin(rng.uniform(1, 3, 17) * time + rng.uniform(0, 3, 17))
        q = middle + np.where(moves, swing, 1e-4 * rng.standard_normal(swing.shape))
        motions.append((time[:, 0], np.clip(q, robot.position_lower, robot.position_upper)))
    words = "'left_gripper' stood still.*'right_gripper': name it with frame='right_gripper'"
    with pytest.raises(NotIdentifiableError, match=words):
        ml.ConstraintLearner(ml.FrameJacobian(robot, frame="left_gripper", axes="xyz")).fit(motions)


@pytest.mark.parametrize(("tips", "joints"), [pytest.param(*row, id=name) for name, *row in rows_in("tips.txt")])
def test_the_tip_is_what_the_whole_arm_moves(tips, joints, tmp_path):
    """Fingers are known by their place in the tree, and names decide only among the ends of chains."""
    made, links = [], ["b"]
    for parent, child, called, *kind in (written.split(", ") for written in joints.split("; ")):
        how = {"kind": "fixed", "x": 0.0} if kind == ["copy"] else {"kind": (*kind, "revolute")[0], "x": 0.1}
        made.append(joint(called, parent, child, **how))
        links.append(child)
    assert ml.likely_tips(load_robot(described(tmp_path / "a.urdf", links, *made))) == tuple(tips.split())


# ---- hostile, unusual and mutated descriptions ----

PATH = Path("some/arm.urdf")
GOLDEN = Path(__file__).with_name("golden") / "robot_sentences.txt"


def use(robot: ml.Robot, rng: np.random.Generator) -> None:
    """Evaluate the last frame at a random posture, so that a robot that only looks loaded is found out."""
    q, frame = robot.random_configuration(rng), robot.frame(robot.frame_names[-1])
    numbers = [robot.pose(q, frame), robot.jacobian(q, frame), *robot.jacobian_and_derivative(q, frame)]
    assert all(np.isfinite(x).all() for x in numbers) and numbers[1].shape == (6, robot.nv)


def verdict(content: bytes, path: Path, options: dict, rng: np.random.Generator) -> tuple[str, tuple[str, ...]]:
    """What became of a description, and the refusal or the warnings."""
    try:
        robot = robot_from_text(content, path, **options)
    except UnknownNameError as error:
        return f"unknown-{error.kind}", (str(error),)
    except RobotError as error:
        return error.code, (str(error),)
    use(robot, rng)
    return "warn" if robot.warnings else "accept", robot.warnings


def sentences(rng: np.random.Generator) -> list[str]:
    """All sentences, each with the first description that it is said about; every case has its verdict."""
    first: dict[str, str] = {}
    for category, name, expected, content, options in CASES:
        with case(category, name):
            seen, said = verdict(content, PATH, options, rng)
            assert seen == expected
            for sentence in said:
                assert "\n" not in sentence and len(sentence) < 600
                if len(content) < 200_000:
                    first.setdefault(sentence, f"{category}, {name}: {sentence}")
    return list(first.values())


def test_every_case_gets_its_verdict_and_its_sentence(rng):
    """File, line, whose fault, value found, value expected, remedy, word by word.

    After a change of words: `python tests/test_descriptions.py` writes the golden file; read what has changed.
    """
    assert sentences(rng) == GOLDEN.read_text(encoding="utf-8").splitlines()


VALUES = (
    "nan inf -inf 0 -0 1 -1 1e308 1e-308 4e-324 1e999 4294967296 9223372036854775808 0x10 1e 1.2.3 1,5 universe world "
    "root_joint revolute continuous prismatic planar floating fixed spherical mimic package://a/b.stl x"
).split() + ["", " ", "0 0 0", "0 0 1e-4", "1 1", "1 2 3 4", "\u2028", "\U0001f916", "&amp;", "%n%s", "a" * 5000]
PIECES = (  # values, numbers, elements, names
    r'(?<=")[^"<]*(?=")',
    r'(?<=[" ])-?\d+\.?\d*(?=[" ])',
    r"<[^<>/!?]*/>|<(?P<tag>joint|link|visual|inertial|body)\b.*?</(?P=tag)>",
    r"(?<=[</ ])[a-z]+(?=[ =>/])",
)
MJCF = (DATA / "arm.xml").read_text(encoding="utf-8")
PARENTS = [ARM, ARM.replace('"revolute"', '"planar"', 1), MJCF, chain(4, "continuous").decode()]
PARENTS += [chain(3, "floating").decode(), mimic_chain((2, 0, 1)).decode()]


def mutant(seed: int) -> bytes:
    """One to four pieces of a description dropped, doubled or replaced; sometimes its bytes are cut or turned."""
    rng = random.Random(seed)
    written = rng.choice(PARENTS)
    for _ in range(rng.choice((1, 1, 1, 2, 2, 3, 4))):
        pieces = list(re.finditer(rng.choice(PIECES), written, re.DOTALL))
        if pieces:
            here, other = rng.choice(pieces), rng.choice(pieces).group()
            new = rng.choice(("", rng.choice(VALUES), other, here.group() + other))
            written = written[: here.start()] + new + written[here.end() :]
    content = bytearray(written.encode("utf-8", "surrogatepass"))
    if content and rng.random() < 0.2:
        content[rng.randrange(len(content))] ^= 1 << rng.randrange(8)
        del content[rng.choice((len(content), rng.randrange(len(content)))) :]
    return bytes(content)


@pytest.mark.fuzz
def test_mutants_are_refused_or_work(rng):
    """No error but ours; what loads gives finite poses and derivatives, and shapes or their faults."""
    seen = Counter[str]()

    @hypothesis.settings(max_examples=max(300, hypothesis.settings.default.max_examples))
    @hypothesis.given(st.integers(0, 2**63))
    def attempt(seed: int) -> None:
        content = mutant(seed)
        said = verdict(content, PATH, {}, rng)[0]
        seen[said] += 1
        if said in ("accept", "warn"):
            visual_shapes(robot_from_text(content, PATH))

    attempt()
    assert seen["accept"] + seen["warn"] > 0.05 * seen.total(), "too wild to test what comes after validation"


def test_what_pinocchio_refuses_is_refused(monkeypatch):
    """Its reason is in the sentence."""

    def failing(*arguments):
        raise ValueError("the reason")

    monkeypatch.setattr(loading.pin, "buildModelFromXML", failing)
    with pytest.raises(RobotError, match="the reason") as caught:
        robot_from_text(ARM.encode(), PATH)
    assert caught.value.code == "pinocchio"


if __name__ == "__main__":
    GOLDEN.write_text("\n".join(sentences(np.random.default_rng(0))) + "\n", encoding="utf-8")
