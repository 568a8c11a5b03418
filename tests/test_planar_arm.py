"""The planar-arm generator and the shipped robots/planar3.urdf."""

from __future__ import annotations

import itertools
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest

from manip_learn.errors import RobotError
from manip_learn.robot.planar_arm import TURN_LIMIT, main, planar_arm_urdf

SHIPPED = Path(__file__).resolve().parents[1] / "robots" / "planar3.urdf"


def tip_by_textbook(lengths: list[float], q: np.ndarray) -> np.ndarray:
    heading = np.cumsum(q)
    return np.array([np.dot(lengths, np.cos(heading)), np.dot(lengths, np.sin(heading)), 0.0])


def test_the_shipped_file_is_what_the_generator_writes() -> None:
    """Regenerating planar3.urdf gives the same bytes."""
    assert SHIPPED.read_bytes() == planar_arm_urdf((1.0, 1.0, 1.0), "planar3").encode()


def test_the_module_writes_the_shipped_file_to_standard_output(capsys: pytest.CaptureFixture[str]) -> None:
    """`python -m manip_learn.robot.planar_arm 1 1 1` prints the shipped file."""
    main(["1", "1", "1"])
    assert capsys.readouterr().out.encode() == SHIPPED.read_bytes()


def test_a_bad_length_on_the_command_line_is_one_sentence_and_code_2(capsys: pytest.CaptureFixture[str]) -> None:
    """A negative length ends the module with exit code 2, names the link and prints no traceback."""
    with pytest.raises(SystemExit) as exit_info:
        main(["1", "-0.5"])
    assert exit_info.value.code == 2
    assert "link 2 has length -0.5 m" in capsys.readouterr().err


@pytest.mark.parametrize("lengths", [[1.0, 1.0, 1.0], [0.7], [0.1, 0.2, 0.3, 1e-3, 2.5, 1 / 3, 0.4]])
def test_forward_kinematics_is_the_textbook_formula(lengths: list[float]) -> None:
    """Any number of links and lengths: the tip is at the sum of the links turned by the summed angles."""
    model = pin.buildModelFromXML(planar_arm_urdf(lengths, "arm"))
    data = model.createData()
    assert list(model.names)[1:] == [f"joint{i + 1}" for i in range(len(lengths))]
    rng = np.random.default_rng(0)
    for _ in range(20):
        q = rng.uniform(-2 * np.pi, 2 * np.pi, len(lengths))
        pin.framesForwardKinematics(model, data, q)
        pose = data.oMf[model.getFrameId("tip")]
        np.testing.assert_allclose(pose.translation, tip_by_textbook(lengths, q), atol=1e-13)
        np.testing.assert_allclose(pose.rotation[:2, 0], [np.cos(q.sum()), np.sin(q.sum())], atol=1e-13)


def test_limits_allow_the_papers_starts_and_do_not_look_like_degrees() -> None:
    """Full turns each way lie well inside the limits, which stay below 4 pi."""
    model = pin.buildModelFromXML(planar_arm_urdf())
    assert np.all(model.upperPositionLimit > np.deg2rad(700.0))
    assert np.all(model.lowerPositionLimit == -model.upperPositionLimit)
    assert TURN_LIMIT < 4 * np.pi
    assert np.all(model.velocityLimit > 0.0) and np.all(model.effortLimit > 0.0)


def test_a_prismatic_joint_slides_its_link_along_itself() -> None:
    """Prismatic joints lengthen the arm along the link's own x axis."""
    model = pin.buildModelFromXML(planar_arm_urdf((0.5, 0.4, 0.3), "rpr", ("revolute", "prismatic", "revolute")))
    data = model.createData()
    q = np.array([0.3, 0.2, -0.8])
    pin.framesForwardKinematics(model, data, q)
    first, last = q[0], q[0] + q[2]
    expected = 1.1 * np.array([np.cos(first), np.sin(first)]) + 0.3 * np.array([np.cos(last), np.sin(last)])
    np.testing.assert_allclose(data.oMf[model.getFrameId("tip")].translation[:2], expected, atol=1e-14)
    assert model.upperPositionLimit[1] == 0.4 and model.lowerPositionLimit[1] == 0.0


def test_inertias_are_those_of_a_solid_body() -> None:
    """Every moving link has a positive mass and principal moments that obey the triangle inequality."""
    model = pin.buildModelFromXML(planar_arm_urdf((0.3, 1.7), "two"))
    for inertia in list(model.inertias)[1:]:
        moments = np.linalg.eigvalsh(inertia.inertia)
        assert inertia.mass > 0.0
        assert moments[0] > 0.0 and moments[0] + moments[1] >= moments[2] * (1 - 1e-6)


def test_an_awkward_name_is_escaped() -> None:
    """Quotes, < and & in the name cannot break the XML."""
    name = "arm \"one\" <&> 'two'"
    assert pin.buildModelFromXML(planar_arm_urdf((1.0,), name)).name == name


@pytest.mark.parametrize(
    "lengths",
    [
        [],
        [1.0, 0.0],
        [np.nan],
        [np.inf],
        ["long"],
        3.0,
    ],
)
def test_lengths_that_make_no_arm_are_refused(lengths: object) -> None:
    """No link, or a length that is not a positive number, is an error of this library."""
    with pytest.raises(RobotError) as error:
        planar_arm_urdf(lengths)  # type: ignore[arg-type]
    assert error.value.code == "lengths"


@pytest.mark.parametrize("types", [["revolute"], ["revolute", "helical"]])
def test_joint_types_that_do_not_fit_are_refused(types: list[str]) -> None:
    """As many joint types as links, of the two known kinds."""
    with pytest.raises(RobotError) as error:
        planar_arm_urdf((1.0, 1.0), "arm", types)  # type: ignore[arg-type]
    assert error.value.code == "joint-types"


def test_equal_arguments_give_equal_text_for_every_size() -> None:
    """The text depends on the arguments only, and parses for 1 to 12 links."""
    for n, kind in itertools.product((1, 2, 12), ("revolute", "prismatic")):
        arguments = ([0.25] * n, "arm", [kind] * n)
        text = planar_arm_urdf(*arguments)  # type: ignore[arg-type]
        assert text == planar_arm_urdf(*arguments)  # type: ignore[arg-type]
        assert pin.buildModelFromXML(text).nv == n
