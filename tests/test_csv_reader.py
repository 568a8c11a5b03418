"""Text tables: every way of writing the same numbers gives the same numbers; refusals name line and column."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from case import case
from hypothesis import given
from hypothesis import strategies as st
from recording_corpus import FULL, HEADER, TABLE, VELOCITIES, csv, refusal

from manip_learn.errors import RecordingError
from manip_learn.recordings import load_demonstrations
from manip_learn.robot import Robot, load_robot


def written(path: Path, content: str) -> Path:
    path.write_text(content, encoding="utf-8", newline="")
    return path


def test_round_trip_is_exact(planar3: Robot, tmp_path: Path) -> None:
    """Numbers printed with 17 digits by NumPy come back bit for bit, positions and velocities, by name."""
    path, order = tmp_path / "demo.csv", [2, 4, 0, 3, 6, 1, 5]
    names = np.array((HEADER + VELOCITIES).split(","))
    np.savetxt(path, FULL[:, order], delimiter=",", fmt="%.17g", header=",".join(names[order]), comments="")
    demos = load_demonstrations(path, planar3)
    assert demos.joint_names == planar3.joint_names and demos.notes == ()
    np.testing.assert_array_equal(demos[0].time, FULL[:, 0])
    np.testing.assert_array_equal(demos[0].q, FULL[:, 1:4])
    np.testing.assert_array_equal(demos[0].u, FULL[:, 4:])


def test_the_refused_line_is_named(planar3: Robot) -> None:
    """File, line as an editor counts it (comments and blank lines too), column and the value seen."""
    for line, code, column, said in [
        ("0.14,x1,1.9,0.07", "not-a-number", "joint1", "'x1'"),
        ("0.14,,1.9,0.07", "not-a-number", "joint1", "an empty field"),
        ("0.14,nan,1.9,0.07", "not-finite", "joint1", "nan"),
        ("0.14,0.1,1.9", "ragged", None, "3 fields, the header has 4"),
        ("0.14,900,1.9,0.07", "outside-limits", "joint1", "900"),
    ]:
        with case(line, code, column, said) as tmp_path:
            lines = csv(TABLE).split("\n")
            lines[8] = line
            path = written(tmp_path / "demo.csv", "\n".join(["# one", "", *lines[:5], "# two", *lines[5:]]))
            error = refusal(path, planar3)
            assert (error.code, error.line, error.column, error.path) == (code, 12, column, path), str(error)
            assert "demo.csv:12" in str(error) and said in str(error)


def test_whole_seconds_are_no_row_numbers(planar3: Robot, tmp_path: Path) -> None:
    """A column is left out where it has no name, as pandas writes row numbers, and is time where it is so called."""
    rows = ["0,0.1,0.2,0.3", "1,0.2,0.2,0.3", "2,0.3,0.2,0.3", ""]
    demos = load_demonstrations(written(tmp_path / "a.csv", "\n".join([HEADER, *rows])), planar3)
    np.testing.assert_array_equal(demos[0].time, [0.0, 1.0, 2.0])
    counted = [f"{i},{row.replace('0,', '0.5,', 1) if i < 1 else row}" for i, row in enumerate(rows[:3])]
    demos = load_demonstrations(written(tmp_path / "b.csv", "\n".join([f",{HEADER}", *counted, ""])), planar3)
    np.testing.assert_array_equal(demos[0].time, [0.5, 1.0, 2.0])
    assert demos.notes == ("b.csv: columns not used: column 1 (without a name)",)


def test_stamps_are_read_in_the_unit_of_their_name_or_as_a_clock(planar3: Robot) -> None:
    """Milliseconds, dates and times of day, in every dialect, are seconds in the end."""
    seconds = 3723.5 + TABLE[:, 0]  # 1:02:03.5
    clock = [f"{int(t // 3600)}:{int(t // 60 % 60):02d}:{t % 60:06.3f}" for t in seconds]
    for name, delimiter, stamps in (
        ("time_ms", ",", [f"{1e3 * t:.9g}" for t in seconds]),
        ("time", ",", clock),
        ("stamp", "  ", clock),
        ("time", ";", [c.replace(".", ",") for c in clock]),
        ("timestamp", ",", [f"2026-01-02T0{c}" for c in clock]),
    ):
        with case(name, delimiter, stamps[0]) as tmp_path:
            mark = "," if delimiter == ";" else "."
            header, *rows = csv(TABLE[:, 1:], ",".join([*planar3.joint_names]), delimiter, mark).splitlines()
            lines = [f"{name}{delimiter}{header}", *(s + delimiter + row for s, row in zip(stamps, rows, strict=True))]
            (demo,) = load_demonstrations(written(tmp_path / "a.csv", "\n".join([*lines, ""])), planar3)
            np.testing.assert_allclose(demo.time - demo.time[0], TABLE[:, 0], atol=2e-6)
            np.testing.assert_allclose(demo.q, TABLE[:, 1:], rtol=1e-8)


def test_ignored_columns_may_hold_anything(planar3: Robot, tmp_path: Path) -> None:
    """An ignored column may contain text; rows must still have all fields."""
    rows = csv(TABLE).splitlines()
    content = "\n".join([rows[0] + ",phase", *(r + ",reach out" for r in rows[1:]), ""])
    path = written(tmp_path / "demo.csv", content)
    assert refusal(path, planar3).code == "not-a-number"
    demos = load_demonstrations(path, planar3, ignore_columns="phase")
    np.testing.assert_allclose(demos[0].q, TABLE[:, 1:], rtol=1e-8)
    written(path, content[:-1] + ",more\n")
    assert refusal(path, planar3, ignore_columns=("phase",)).code == "ragged"


def test_a_table_that_was_cut_off_loses_its_last_line_only(planar3: Robot, tmp_path: Path) -> None:
    """Wherever a table is cut within its last two rows, every number that is read is one that was written, and a
    row that is lost is said; a last line that holds no numbers is none.
    """
    content = csv(TABLE)
    start = content.rindex("\n", 0, content.rindex("\n", 0, -1))
    path = tmp_path / "demo.csv"
    for end in ("# the end", "  "):
        assert load_demonstrations(written(path, content + end), planar3).notes == ()
    for end in range(start, len(content) + 1):
        demos = load_demonstrations(written(path, content[:end]), planar3)
        n = content[:end].count("\n") - 1
        np.testing.assert_allclose(demos[0].q, TABLE[:n, 1:], rtol=1e-8)
        is_cut = not content[:end].endswith("\n")
        assert ("the last line has no line end" in " ".join(demos.notes)) == is_cut


def test_a_joint_may_be_called_like_a_velocity(tmp_path: Path) -> None:
    """A robot whose joint is named belt_velocity gets its positions, not its velocities."""
    links = "".join(f'<link name="l{i}"/>' for i in range(3))
    joints = "".join(
        f'<joint name="{n}" type="revolute"><parent link="l{i}"/><child link="l{i + 1}"/><axis xyz="0 0 1"/>'
        '<limit lower="-3" upper="3" velocity="2" effort="1"/></joint>'
        for i, n in enumerate(("belt", "belt_velocity"))
    )
    urdf = written(tmp_path / "r.urdf", f'<robot name="r">{links}{joints}</robot>')
    path = written(tmp_path / "demo.csv", csv(TABLE[:, :3], "time,belt,belt_velocity"))
    demos = load_demonstrations(path, load_robot(urdf))
    np.testing.assert_allclose(demos[0].q, TABLE[:, 1:3], rtol=1e-8)
    assert demos[0].u is None


@given(st.text(alphabet="time,joint123_velocity;\t\n\r 0.5e-+#%\"'\u00e4\x00", max_size=200))
@pytest.mark.fuzz
def test_any_text_is_read_or_refused(content: str) -> None:
    """For any content of a text file, the result is a recording or a one-line error."""
    with case(content) as folder:
        path = folder / "demo.csv"
        path.write_bytes(f"{HEADER}\n{content}".encode())
        try:
            load_demonstrations(path, load_robot("planar3"))
        except RecordingError as error:
            assert "\n" not in str(error)


def test_a_comment_that_is_no_header_is_not_taken_for_one(planar3: Robot) -> None:
    """A remark, numbers, or names for another number of columns above the first row: refused, a header is needed."""
    for comment in ["recorded by hand", "1, 2, 3, 4", "time, joint1, joint2"]:
        with case(comment) as tmp_path:
            rows = csv(TABLE).partition("\n")[2]
            error = refusal(written(tmp_path / "a.csv", f"# {comment}\n{rows}"), planar3)
            assert error.code == "no-header" and ":2:" in str(error)


def test_a_header_may_hold_a_number(planar3: Robot, tmp_path: Path) -> None:
    """A column that is named by a number, beside those of the joints, does not make the header a row of numbers."""
    head, _, rows = csv(TABLE).partition("\n")
    table = "\n".join([f"{head},7", *(f"{row},0.5" for row in rows.split())]) + "\n"
    demos = load_demonstrations(written(tmp_path / "a.csv", table), planar3, ignore_columns=["7"])
    np.testing.assert_allclose(demos[0].q, TABLE[:, 1:], rtol=1e-8)


def test_stamps_that_are_right_and_uneven_are_kept(planar3: Robot, tmp_path: Path) -> None:
    """Samples of a loop that runs late and catches up, with rests and noise of 1e-3 rad: the arm moves as they say."""
    for seed in (9, 13, 16):
        rng = np.random.default_rng(seed)
        time = np.cumsum(np.where(rng.random(200) < 0.3, 0.002, 0.07))
        s = np.clip((time / time[-1] - 0.3) / 0.4, 0.0, 1.0)
        q = np.outer(s**3 * (10.0 - 15.0 * s + 6.0 * s * s), [0.5, -0.4, 0.3]) + [0.1, 0.9, 0.2]
        table = np.column_stack([time, q + 1e-3 * rng.normal(size=q.shape)])
        (one,) = load_demonstrations(written(tmp_path / "a.csv", csv(table)), planar3)
        np.testing.assert_allclose(one.time, time, atol=1e-9)
