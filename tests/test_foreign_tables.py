"""Tables as other programs export them: read with at most two flags, nothing guessed, and every advised flag works."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from case import case
from recording_corpus import refusal

from manip_learn.errors import RecordingError
from manip_learn.recordings import load_demonstrations
from manip_learn.robot import Robot

TIME = np.arange(60) * 0.02
JOINTS = ("joint1", "joint2", "joint3")


def motion() -> tuple[np.ndarray, np.ndarray]:
    """Positions [rad] and velocities [rad/s] of three joints, each column unlike the others."""
    phase = TIME[:, None] * np.array([1.0, 1.7, 2.3])
    return 0.4 * np.sin(phase) + [0.1, 0.2, 0.3], 0.4 * np.array([1.0, 1.7, 2.3]) * np.cos(phase)


Q, U = motion()


def table(header: list[str], *columns: object) -> str:
    """Comma-separated text; a column is an array, or one value for all rows."""
    full = [c if isinstance(c, list | np.ndarray) else [c] * len(TIME) for c in columns]
    rows = [",".join(f"{v:.17g}" if isinstance(v, float) else str(v) for v in row) for row in zip(*full, strict=True)]
    return "\n".join([",".join(header), *rows, ""])


def refused(path: Path, robot: Robot, text: str, **options: object) -> RecordingError:
    """The refusal of a table."""
    path.write_text(text)
    return refusal(path, robot, **options)


def test_several_candidates_are_a_choice(planar3: Robot, tmp_path: Path) -> None:
    """Measured and commanded positions, or two sources, are never told apart by the reader, nor are two times."""
    path = tmp_path / "demo.csv"
    two = table(["time", *(f"{s}.{j}.position" for s in ("left", "right") for j in JOINTS)], TIME, *Q.T, *U.T)
    error = refused(path, planar3, two)
    assert error.code == "columns"
    assert "columns='left.{joint}.position' or columns='right.{joint}.position'" in str(error)
    assert len(load_demonstrations(path, planar3, columns="right.{joint}.position")) == 1
    only_command = table(["time", *(f"target.{j}" for j in JOINTS)], TIME, *Q.T)
    assert "columns='target.{joint}'" in str(refused(path, planar3, only_command))
    measured_too = table(["time", *(f"{s}.{j}" for s in ("actual", "target") for j in JOINTS)], TIME, *Q.T, *U.T)
    path.write_text(measured_too)
    np.testing.assert_array_equal(load_demonstrations(path, planar3)[0].q, Q)
    error = refused(path, planar3, table(["t", "stamp", *JOINTS], TIME, TIME, *Q.T))
    assert error.code == "no-time" and "rename={'t': 'time'} or rename={'stamp': 'time'}" in str(error)


def test_numbers_must_be_those_of_the_joints(planar3: Robot, tmp_path: Path) -> None:
    """Gaps, more columns than joints, or a pattern that names nothing are refused with what is there."""
    path = tmp_path / "demo.csv"
    error = refused(path, planar3, table(["time", "q0", "q1", "q3"], TIME, *Q.T), columns="q{index}")
    assert "numbered 0, 1, 3" in str(error)
    four = table(["time", "q0", "q1", "q2", "q3"], TIME, *Q.T, Q[:, 0])
    assert "4 such columns and 3 moving joints" in str(refused(path, planar3, four, columns="q{index}"))
    assert "no column such as 'p0'" in str(refused(path, planar3, four, columns="p{index}"))
    assert "no column 'pos.joint1'" in str(
        refused(path, planar3, table(["time", *JOINTS], TIME, *Q.T), columns="pos.{joint}")
    )
    for bad in ("q", "{joint}{index}", ["a{joint}", "b{joint}", "c{joint}"]):
        assert refused(path, planar3, four, columns=bad).code == "option"


# beside the columns of positions: how others are called -> velocities are read, efforts are read, what a note says
BESIDE: dict[str, tuple[list[str], bool, bool, str]] = {
    "velocity.{joint}": (["velocity.{}"], True, False, ""),
    "{joint}_vel": (["{}_vel"], True, False, ""),
    "both": (["{}.vel", "tau_{}"], True, True, ""),
    "two of velocities": (["{}_velocity", "{}.vel"], False, False, "not used: joint1_velocity, joint2_velocity"),
    "a command": (["desired_{}"], False, False, "not used: desired_joint1"),
    "commanded efforts": (["{}_desired_effort", "{}_effort"], False, True, "not used: joint1_desired_effort"),
    "temperatures": (["{}_temperature"], False, False, "not used: joint1_temperature"),
    "accelerations": (["{}_acceleration"], False, False, "not used: joint1_acceleration"),
}


def test_quantities_are_told_by_words(planar3: Robot, tmp_path: Path) -> None:
    """Where columns are called as the joints, or contain their names, the words around these say what others hold."""
    path = tmp_path / "demo.csv"
    for position in ("{}", "position.{}"):
        for name, (patterns, with_velocity, with_effort, said) in BESIDE.items():
            with case(position, name):
                header = ["time", *(p.format(j) for p in (position, *patterns) for j in JOINTS)]
                others = [U if i == 0 else Q + 1.0 for i in range(len(patterns))]
                path.write_text(table(header, TIME, *Q.T, *(c for values in others for c in values.T)))
                demos = load_demonstrations(path, planar3)
                np.testing.assert_array_equal(demos[0].q, Q)
                assert demos[0].u is None or np.array_equal(demos[0].u, U)
                assert (demos[0].u is not None, demos[0].effort is not None) == (with_velocity, with_effort)
                assert said in " ".join(demos.notes)
