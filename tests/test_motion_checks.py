"""Validation: faults are detected by limits and named; real data pass; every change is reported."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from case import case
from jaxtyping import Float

import manip_learn as ml
from manip_learn.errors import RecordingError
from manip_learn.recordings.checks import alternation


def guided(robot: ml.Robot, rng: np.random.Generator, n: int = 400, dt: float = 0.05) -> tuple[np.ndarray, ...]:
    """A motion as of a guided arm: smooth, inside the limits, jittering stamps, encoder noise."""
    time = np.cumsum(dt * rng.uniform(0.3, 1.7, n))
    lower, upper = np.maximum(robot.position_lower, -3.0), np.minimum(robot.position_upper, 3.0)
    middle, half = 0.5 * (lower + upper), 0.25 * (upper - lower)
    rate, phase = rng.uniform(0.2, 0.6, robot.nv), rng.uniform(0, 6, robot.nv)
    q = middle + half * np.sin(rate * time[:, None] + phase) + 1e-4 * rng.normal(size=(n, robot.nv))
    return time, q, half * rate * np.cos(rate * time[:, None] + phase)


def load(robot: ml.Robot, folder: Path, time: Any, q: Any, u: Any = None, more="", **options: Any) -> ml.Demonstrations:
    arrays = {"time": time, "q": q, "joint_names": np.array([*robot.joint_names, more][: np.shape(q)[1]])}
    arrays |= {"effort": options.pop("effort")} if "effort" in options else {}
    np.savez(folder / "demo.npz", **arrays | ({} if u is None else {"u": u}))
    return ml.load_demonstrations(folder / "demo.npz", robot, **options)


def refused(*arguments: Any, **options: Any) -> RecordingError:
    with pytest.raises(RecordingError) as caught:
        load(*arguments, **options)
    return caught.value


def test_guided_motions_pass_without_a_word(sawyer: ml.Robot, rng: np.random.Generator, tmp_path: Path) -> None:
    """Jitter, noise and quantisation of real recordings are no faults, with and without velocities."""
    for _ in range(8):
        time, q, u = guided(sawyer, rng)
        assert load(sawyer, tmp_path, time, q, u).notes == ()
        assert load(sawyer, tmp_path, time, q).notes == ()
    q[:, 2], u[:, 2] = 0.4 + 1e-4 * rng.normal(size=len(q)), -1e-6  # at rest, with an offset in the velocity
    assert load(sawyer, tmp_path, time, q, u).notes == ()


def test_a_little_beyond_the_limits_is_a_note(sawyer: ml.Robot, rng, tmp_path: Path) -> None:
    """An excess of two degrees is accepted with a note; twelve degrees are rejected, unless the caller allows it."""
    time, q, u = guided(sawyer, rng)
    q[:, 0] += sawyer.position_upper[0] + 0.035 - q[:, 0].max()
    demos = load(sawyer, tmp_path, time, q, u)
    np.testing.assert_array_equal(demos[0].q, q)
    assert "'right_j0'" in demos.notes[0] and "by 0.035 rad" in demos.notes[0]
    q[:, 0] += 0.2
    error = refused(sawyer, tmp_path, time, q, u)
    assert error.code == "outside-limits" and error.column == "right_j0"
    assert load(sawyer, tmp_path, time, q, u, outside_limits="note").n_samples == len(q)


def put(q: np.ndarray, joint: int, values: Any, samples: Any = slice(None)) -> np.ndarray:
    """Other positions of one joint."""
    out = q.copy()
    out[samples, joint] = values
    return out


# what is wrong -> positions of a Sawyer, the code, the joint, and what the sentence says
FAULTS: dict[str, tuple[Callable[[np.ndarray], np.ndarray], str, str, tuple[str, ...]]] = {
    "a full turn": (lambda q: put(q, 2, q[:, 2] + 2 * np.pi), "outside-limits", "right_j2", ("a full turn too much?",)),
    "a sign": (lambda q: put(q, 1, 2.6 + 0.1 * q[:, 0]), "outside-limits", "right_j1", ("a wrong sign?",)),
    "a sample above": (
        lambda q: put(q, 3, 50.0, 100), "outside-limits", "right_j3", ("sample 100", "50 is outside", "at 1 of 400")
    ),
    "all samples": (lambda q: put(q, 3, 4.0 + 0.01 * q[:, 3]), "outside-limits", "right_j3", ("400 of 400", "robot?")),
    "one column in degrees": (
        lambda q: put(np.clip(q, -2, 2), 3, np.degrees(np.clip(q[:, 3], -2, 2))), "degrees", "right_j3",
        ("convert this column",),  # units would spoil the other columns
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", FAULTS)
def test_faults_are_told_apart(name: str, sawyer: ml.Robot, rng, tmp_path: Path) -> None:
    """By the limits: the joint, the sample and what it may be."""
    (time, q, _), (spoil, code, column, words) = guided(sawyer, rng), FAULTS[name]
    error = refused(sawyer, tmp_path, time, spoil(q))
    assert (error.code, error.column) == (code, column) and all(w in str(error) for w in words), str(error)


def test_gaps_split_the_demonstration(sawyer: ml.Robot, rng, tmp_path: Path) -> None:
    """More than ten usual steps: two trajectories with velocities and efforts of their own, said aloud; a lone sample
    between gaps is left out, said too.
    """
    time, q, u = guided(sawyer, rng, n=100)
    time[40:] += 5.0
    time[41:] += 5.0
    demos = load(sawyer, tmp_path, time, q, u, effort=7.0 * q)
    assert [(t.name, len(t)) for t in demos] == [("demo.npz part 1 of 2", 40), ("demo.npz part 2 of 2", 59)]
    np.testing.assert_array_equal(demos[1].u, u[41:])
    np.testing.assert_array_equal(demos[1].effort, 7.0 * q[41:])
    assert "split where no new posture came for 5" in demos.notes[0] and "; for 5" in demos.notes[0]
    assert "lone" in demos.notes[1]


def test_angles_and_lengths_are_told_apart(robot_of, tmp_path: Path) -> None:
    """An angle that wraps at pi is the same posture: full turns are added, and it is said; degrees wrap at 180. Only
    angles are converted, and the columns that are taken as metres are said.
    """
    robot, gantry, time = robot_of("wrist"), robot_of("gantry"), np.arange(100) * 0.02
    q = np.column_stack([2.5 + time, 0.1 * time, 0.3 * time, 0.2 * time])
    wrapped = (q + np.pi) % (2 * np.pi) - np.pi
    for given, options in ((wrapped, {}), (np.degrees(wrapped), {"degrees": True})):
        demos = load(robot, tmp_path, time, given, **options)
        np.testing.assert_allclose(demos[0].q, q, rtol=0, atol=1e-12)
        assert any("joint0" in note and "wraps" in note for note in demos.notes)
    q = np.column_stack([0.1 * np.sin(time + i) for i in range(5)])
    demos = load(gantry, tmp_path, time, q * [1, 1, 57.29577951308232, 57.29577951308232, 1], degrees=True)
    np.testing.assert_allclose(demos[0].q, q, rtol=1e-12)
    assert "joint0, joint1, joint4 taken as metres" in demos.notes[0]


def test_locked_and_mimic_joints_are_known_names(robot_of, tmp_path: Path) -> None:
    """Columns of joints that do not move by themselves are not used, and it is said when they contradict the robot."""
    robot = robot_of("mimic")
    mimic = robot.mimics[0]
    time = np.arange(100) * 0.02
    q = np.column_stack([0.1 * np.sin(time + i) for i in range(robot.nv)])
    leader = q[:, robot.joint_names.index(mimic.leader)]
    for off, said in ((0.019, False), (0.021, True)):
        follower = mimic.multiplier * leader + mimic.offset + off
        demos = load(robot, tmp_path, time, np.column_stack([q, follower]), more=mimic.joint)
        assert mimic.joint in demos.notes[0] and ("0.021 away" in demos.notes[0]) == said
    panda = robot_of("panda")
    lower, upper = panda.position_lower, panda.position_upper
    q = np.clip(0.5 * (lower + upper) + 0.1 * np.sin(time)[:, None] * np.arange(panda.nv), lower, upper)
    for span, said in ((0.019, False), (0.021, True)):
        posture = np.column_stack([q, np.linspace(0.0, span, 100)])
        demos = load(panda, tmp_path, time, posture, more="panda_finger_joint1")
        note = next(n for n in demos.notes if "panda_finger_joint1" in n)
        assert ("moves by 0.021" in note) == said


def test_a_stamp_that_repeats(planar3: ml.Robot, rng: np.random.Generator, tmp_path: Path) -> None:
    """The same sample twice: left out once. Another position with the same stamp: spread up to the next stamp."""
    time, q, u = (np.insert(x, 21, x[20], axis=0) for x in guided(planar3, rng))
    demos = load(planar3, tmp_path, time, q, u, effort=7.0 * q)
    assert demos.notes == ("demo.npz: 1 repeated sample left out (first: sample 21)",)
    np.testing.assert_array_equal(demos[0].u, np.delete(u, 21, axis=0))
    np.testing.assert_array_equal(demos[0].effort, np.delete(7.0 * q, 21, axis=0))
    np.testing.assert_array_equal(demos[0].time, np.delete(time, 21))
    demos = load(planar3, tmp_path, time, q + (np.arange(401) == 21)[:, None] * 1e-3)
    assert "1 stamp repeated with other positions" in demos.notes[0]
    assert demos[0].time[21] == pytest.approx(0.5 * (time[20] + time[22]))


def test_each_bound_lies_where_it_is_meant(robot_of, tmp_path: Path) -> None:
    """Just inside nothing is said; just outside the note or the refusal comes."""
    robot, wrist = robot_of("gantry"), robot_of("wrist")  # limits of 2 rad, m; m/s and rad/s; two joints without limits
    time = 0.02 * np.arange(200)
    q, u = (0.3 * f(time[:, None] + np.arange(5)) for f in (np.sin, np.cos))

    def said(robot: ml.Robot, *arrays: Any, **options: Any) -> str:
        """What is noted, or the code of the refusal."""
        try:
            return " ".join(load(robot, tmp_path, *arrays, **options).notes)
        except RecordingError as error:
            return f"{error.code} {error}"

    def raised(joint: int, top: float) -> np.ndarray:
        return q + (top - q[:, joint].max()) * (np.arange(5) == joint)

    def late(gap: float) -> np.ndarray:
        return time + (gap - 1.0) * 0.02 * (np.arange(200) >= 100)

    def only(positions: np.ndarray) -> np.ndarray:
        return np.outer(positions, np.eye(5)[2])

    def creeping(step: float, speed: float) -> tuple[np.ndarray, np.ndarray]:
        there_and_back = np.abs(np.arange(200.0) - 100.0)
        return step * np.arange(200.0), only(step * speed * there_and_back - 1.0)

    # what is made of a number -> the arrays; a number inside and one outside; what is said outside
    bounds: dict[str, tuple[Any, float, float, str]] = {
        "angle beyond its limit [rad]": (lambda x: (time, raised(2, 2.0 + x)), 0.099, 0.101, "outside-limits"),
        "length beyond its limit [m]": (lambda x: (time, raised(0, 2.0 + x)), 0.049, 0.051, "outside-limits"),
        "gap [steps]": (lambda x: (late(x), q, u), 9.9, 10.1, "split where no new"),
        "step [usual ones]": (lambda x: (late(x), q, u), 0.101, 0.099, "under a tenth of the usual"),
        "speed [m/s]": (lambda x: (0.1 * time, only(0.1 * x * time - 1.2)), 5.9, 6.1, "its limit is 2"),
        "jump [rad]": (lambda x: (time, q + only(x * (np.arange(200) >= 100) - 0.5)), 1.5, 1.65, "jump"),
        "milliseconds since 1970": (lambda x: (x + time, q), 0.99e11, 1.01e11, "as milliseconds"),
        "microseconds since 1970": (lambda x: (x + 1e6 * time, q), 0.99e14, 1.01e14, "read as microseconds"),
        "nanoseconds since 1970": (lambda x: (x + 1e9 * time, q), 0.99e17, 1.01e17, "as nanoseconds"),
        "step [s]": (lambda x: creeping(x, 0.01), 0.98, 1.02, "as milliseconds"),
        "speed [rad/s]": (lambda x: creeping(1.5, x), 0.021, 0.019, "as milliseconds"),
    }
    normal = np.array([[50.0, 0.0, -50.0, 1.0, 2.0]]) * np.cos(time)[:, None]
    for top, is_refused in ((109.0, False), (111.0, True)):
        noted = said(robot, time, normal * [top / 50.0, 1, 1, 1, 1], units="normalised")
        assert ("normalised ones are" in noted) == is_refused
    assert "full turn" not in said(robot, time, raised(2, 2.2))
    for name, (made, inside, outside, expected) in bounds.items():
        with case(name):
            assert expected not in said(robot, *made(inside))
            assert expected in said(robot, *made(outside))
    turning = 0.1 * np.column_stack([time, *(np.sin(time + i) for i in range(1, 4))])
    for size, is_refused in ((0.9e50, False), (1.1e50, True)):
        noted = said(wrist, time, turning, np.tile([0, 0, 0, size], (200, 1)), velocities="recorded")
        assert ("is not a number" in noted) == is_refused


# ---- two publishers on one topic, and reads that failed: seen from the samples alone


def motion(rng: np.random.Generator, n_samples: int, nv: int, dt: float, speed: float) -> Float[np.ndarray, "T nv"]:
    """A smooth motion of some joints; the others stand still."""
    time = np.arange(n_samples)[:, None] * dt
    total = np.zeros((n_samples, nv))
    for _ in range(3):
        size, rate, phase = (rng.uniform(low, high, nv) for low, high in ((0, speed), (0.05, 0.5), (0, 6.3)))
        total += size * np.sin(2 * np.pi * rate * time + phase)
    return total * (rng.random(nv) < 0.8)


@pytest.mark.parametrize("kind", ["strict", "random"])
def test_interleaved_motions_are_found(kind: str, rng: np.random.Generator) -> None:
    """A moving robot and a GUI that stands elsewhere: at least 19 of 20 are found, however they take turns; so in a
    part of a recording.
    """
    found = 0
    for _ in range(40):
        n, nv, dt = int(rng.integers(60, 1200)), int(rng.integers(2, 8)), float(rng.choice([0.002, 0.01, 0.02]))
        robot = motion(rng, n, nv, dt, 0.5) + 1e-4 * rng.standard_normal((n, nv))
        gui = np.broadcast_to(rng.choice([-1, 1], nv) * rng.uniform(0.6, 1.5, nv), (n, nv))
        turns = np.arange(n) % 2 == 1 if kind == "strict" else rng.random(n) < rng.uniform(0.2, 0.8)
        found += alternation(np.where(turns[:, None], gui, robot))[0].size > 0
    assert found >= 38
    q = motion(rng, 2_000, 4, 0.01, 0.5)
    q[800:1000:2] += 0.8
    assert 795 <= alternation(q)[0][0] <= 805


def test_noise_and_coarse_encoders_are_no_second_publisher(rng: np.random.Generator) -> None:
    """White and heavy-tailed noise up to 0.03 rad, quanta up to 0.02 rad that flicker, at rest and in motion: none."""
    for _ in range(120):
        n, nv, dt = int(rng.integers(40, 1200)), int(rng.integers(1, 8)), float(rng.choice([0.001, 0.01, 0.05]))
        q = motion(rng, n, nv, dt, float(rng.choice([0.0, 0.01, 0.3, 1.0])))
        size = 10 ** rng.uniform(-6, -1.7)
        noisy = (
            q + 1.5 * size * rng.standard_normal(q.shape),
            q + size * rng.standard_t(2, q.shape),
            np.round((q + 0.3 * size * rng.standard_normal(q.shape)) / size) * size,
            np.round((q + size * (np.arange(n) % 2)[:, None]) / size) * size,
        )
        assert not any(alternation(x)[0].size for x in noisy)


def test_failed_reads_are_left_out(planar3: ml.Robot, rng: np.random.Generator) -> None:
    """A driver that could not read its motors publishes one posture now and then: said, and the rest is the motion; one
    that is held for long, or is no jump, is a motion.
    """
    for n in (2, 12, 40):
        with case(f"{n} failed reads"):
            q = motion(rng, 1000, 3, 0.01, 0.3) + [0.4, 0.5, 0.6]
            failed = np.sort(rng.choice(998, n, replace=False)) + 1
            told = ml.load_demonstrations(table(q, failed, -1.5), planar3)
            assert told.n_samples == 1000 - n
            assert f"{n} failed reads left out (first: sample {failed[0]}; " in told.notes[0]
    rested = np.concatenate([q[:300], np.repeat(q[300:301], 200, axis=0), q[301:801]])
    kept = ml.load_demonstrations(table(rested), planar3)
    assert kept.n_samples == 1000 and kept.notes == ()
    slow = motion(rng, 100, 3, 0.1, 3.0)  # written ten times as fast, with large steps that are no failed reads
    told = ml.load_demonstrations(table(np.repeat(slow, 10 + rng.integers(-3, 4, 100), axis=0)), planar3)
    assert len(told) == 1 and {*map(tuple, told[0].q)} == {*map(tuple, slow)} and len(told[0].q) < 120


def table(q: np.ndarray, at: Any = (), value: float = 0.0) -> pd.DataFrame:
    """Return positions of three joints; samples `at` have one value."""
    columns = {f"joint{j + 1}": put(q, j, value, np.array(at, dtype=int))[:, j] for j in range(3)}
    return pd.DataFrame({"time": 0.01 * np.arange(len(q)), **columns})
