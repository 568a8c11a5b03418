"""Recordings of every format: what was recorded comes back, bit for bit; what cannot be used is refused."""

from __future__ import annotations

import importlib
import json
import shutil
import sys
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
import pytest
from case import rows_in
from recording_corpus import FULL, GOOD, HEADER, JOINTS, TABLE, TIME, VELOCITIES, Q, U, csv, npz, refusal, text
from recording_formats import (
    FPS,
    KINDS,
    START,
    STEPS,
    Build,
    Message,
    all_in_one,
    archive,
    bag,
    frames,
    h5py,
    info,
    lerobot,
    motion,
    one,
    robomimic,
    some,
    table,
    version_2,
    version_3,
)  # fmt: skip
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import CompressionMode
from scipy.io import savemat

import manip_learn as ml
from manip_learn.cli import main
from manip_learn.errors import MissingExtraError, RecordingError
from manip_learn.recordings.streams import JointStates, joint_groups, merge
from manip_learn.robot.identity import RobotIdentity

EFFORT = np.column_stack([np.exp(TIME), -3.0 * TIME, 1.0 / 3.0 + TIME])
NAMES = ",".join(JOINTS)


class Read(NamedTuple):
    """Expected contents of a recording; lists if it has several trajectories."""

    build: Build
    options: dict[str, Any]
    note: tuple[str, ...] = ()
    q: Any = Q
    u: Any = None
    effort: Any = None
    time: Any = TIME
    names: list[str] | None = None
    atol: float = 0.0


def read(build: Build, *note: str, **expected: Any) -> Read:
    """Return a row of the table; without words no note is expected, other keywords are options of the reader."""
    known = {name: expected.pop(name) for name in Read._fields[3:] if name in expected}
    return Read(build, expected, note, **known)


# ---- text tables
ORDER = [2, 4, 0, 3, 6, 1, 5]
CLOCK = [f"1:02:{t:06.3f}" for t in 3.5 + TIME]
# columns beside those of positions: their names, the velocities and efforts that are read, and words of a note
BESIDE: list[tuple[Any, ...]] = [
    (["velocity.{}"], U, None),
    (["{}_velocity", "{}.vel"], None, None, "not used: joint1_velocity, joint2_velocity"),
    (["{}_desired_effort", "{}_effort"], None, Q + 1.0, "not used: joint1_desired_effort"),
    (["{}_acceleration"], None, None, "not used: joint1_acceleration"),
]
BROKEN = np.where(EFFORT > 2.0, np.nan, EFFORT)


def header(*patterns: str, names: Any = JOINTS) -> str:
    return ",".join(["time", *(p.format(j) for p in patterns for j in names)])


TABLES = {
    "17 digits in another order": read(
        table(",".join((HEADER + VELOCITIES).split(",")[k] for k in ORDER), FULL[:, ORDER]), u=U
    ),
    "milliseconds": read(table("time_ms," + NAMES, 1e3 * (3723.5 + TIME), Q), "'time_ms', in milliseconds"),
    "times of day": read(table(HEADER, CLOCK, Q)),
    "dates": read(table("timestamp," + NAMES, [f"2026-01-02T0{c}" for c in CLOCK], Q), "from column 'timestamp'"),
    "a column of text, ignored": read(table(HEADER + ",phase", TABLE, ["reach out"] * 60), ignore_columns="phase"),
    **{
        f"beside {patterns}": read(
            table(header("{}", *patterns), TIME, Q, *(U, Q + 1.0)[: len(patterns)]), *words, u=u, effort=effort
        )
        for patterns, u, effort, *words in BESIDE
    },
    **{
        f"efforts as {pattern}": read(
            table(f"{HEADER},{header(pattern, names=JOINTS[::-1])[5:]}", TABLE, EFFORT[:, ::-1]), effort=EFFORT
        )
        for pattern in ("effort_{}", "{}_torque")
    },
    "half a set of efforts": read(
        table(HEADER + ",joint1_effort,joint2_effort", TABLE, EFFORT[:, :2]), "efforts are recorded for 2 of 3 joints"
    ),
}  # fmt: skip


# ---- archives
def cell(*values: Any) -> np.ndarray:
    """Return a MATLAB cell array of these values."""
    out = np.empty((1, len(values)), dtype=object)
    out[0, :] = values
    return out


def typed(dtype: str) -> Read:
    """Big-endian, short and integer numbers, read for what they are, with a note."""
    q = (Q * 3.0).astype(dtype)
    return read(archive(q=q, u=None), dtype.strip("<>"), q=q.astype(float))


STACK, RATE = np.stack([Q, 2.0 * Q]), {"joint_names": JOINTS, "rate": 50.0, "q": [Q, 2.0 * Q]}
STAMPED = np.vstack([Q.T, TIME])  # the pose beside it has the same shape and is not taken for joint positions
STRUCTS = ({"arm": {"pose": STAMPED, "joint_states": STAMPED}, "times": [0.0, 3.0]} for _ in range(2))
ARCHIVES = {
    **{dtype: typed(dtype) for dtype in (">f8", "<f2", "<i4", "u1")},
    "efforts": read(archive(effort=EFFORT), u=U, effort=EFFORT),
    "efforts that are no numbers": read(archive(effort=BROKEN), "efforts are not finite", u=U),
    "a stack in an archive": read(one("a.npz", npz(demos=STACK)), "q from 'demos'", **RATE),
    "structs": read(
        one("a.mat", lambda path: savemat(path, {"data": cell(*STRUCTS)})), "not used", q=[Q, Q],
        joint_names=(*JOINTS, "time"),
    ),
}  # fmt: skip

# ---- LeRobot
RADIANS = {"units": "radians", "time": np.arange(80) / FPS}
ONE, FOUR = motion(0).astype(np.float32), [motion(i).astype(np.float32) for i in (0, 1, 2, 10)]
SPEED = np.gradient(motion(0), 1 / FPS, axis=0)
WHOLE = frames({0: motion(0), 1: motion(1)})
KEY = "observation.state.joint_position"
NAMED: dict[str, Any] = {"joint_names": JOINTS, "units": "radians", "feature": KEY}
STAMPS = np.arange(80)


def alone(folder: Path) -> Path:
    return Path(shutil.copy(part_of_a_set(folder), folder / "alone.parquet"))


def part_of_a_set(folder: Path) -> Path:
    return version_2(folder / "set") / "data/chunk-000/episode_000001.parquet"


def droid(folder: Path) -> Path:
    """A data set in the layout of DROID: joints under a key of their own."""
    q = {i: motion(i) for i in (0, 1, 2)}
    arrays = {
        KEY: q.values(),
        "observation.state.joint_velocity": [np.gradient(x, 1 / FPS, axis=0) for x in q.values()],
    }
    lists = {name: np.concatenate([*parts]).astype(np.float32).tolist() for name, parts in arrays.items()}
    rows = frames(q, **lists).drop_columns(["observation.state", "action"])
    features = {name: {"dtype": "float32", "shape": [3], "names": None} for name in arrays}
    features["observation.images.wrist"] = {"dtype": "video", "shape": [180, 320, 3], "names": None}
    return lerobot(rows, described={**info(None, "v3.0"), "features": features})(folder)


def scaled(factor: float) -> Build:
    return lambda folder: version_2(folder / "set", scale=factor)


def stamped(stamps: np.ndarray) -> Build:
    return lerobot(frames({0: motion(0)}, timestamp=pa.array(stamps)))


LEROBOT = {
    **{
        f"lists of the kind {kind}": read(
            lambda folder, kind=kind: version_2(folder / "set", kind=kind), q=FOUR, **RADIANS,
            names=[f"set episode {i}" for i in (0, 1, 2, 10)],
        )
        for kind in ("fixed", "list", "large")
    },
    "an episode that goes on in the next file": read(
        lerobot(WHOLE.slice(0, 100), WHOLE.slice(100)), q=FOUR[:2], **RADIANS
    ),
    "a file of a data set": read(part_of_a_set, q=FOUR[1], **RADIANS),
    "a file alone": read(alone, q=FOUR[1][:, ::-1], joint_names=JOINTS[::-1], **RADIANS),
    "normalised": read(
        scaled(30.0), "normalised", q=[3.75 * motion(i) for i in (0, 1, 2, 10)], atol=1e-5,
        **RADIANS | {"units": "normalised"},
    ),
    "velocities in the state": read(
        lerobot(frames({0: np.hstack([motion(0), SPEED])}), names=[f"{j}.{k}" for k in ("pos", "vel") for j in JOINTS]),
        "", q=ONE, u=SPEED.astype(np.float32), **RADIANS,
    ),
    **{
        f"names {names}": read(lerobot(frames({0: motion(0)}), names=names), q=ONE, **RADIANS)
        for names in ({"arm": ["joint1"], "hand": ["joint2", "joint3"]}, {"joint2": 1, "joint1": 0, "joint3": 2})
    },
    "joints under another key": read(
        droid, "2 of 3 episodes selected", q=FOUR[1:3],
        u=[np.gradient(motion(i), 1 / FPS, axis=0).astype(np.float32) for i in (1, 2)], **NAMED, episodes="1:3",
        names=["set episode 1", "set episode 2"], time=STAMPS / FPS,
    ),
    "stamps of zero": read(stamped(0.0 * STAMPS), "the stamps do not increase: frame_index / 50", q=ONE, **RADIANS),
    "stamps overruled": read(stamped(STAMPS / 30.0), "stamps are overridden", q=ONE, **RADIANS, rate=50.0),
}  # fmt: skip

# ---- robomimic
GIVEN: dict[str, Any] = {"joint_names": JOINTS}
NO_RATE = (None, "{}", "not json", '{"env_kwargs": {"control_freq": 0}}', "[" * 5000)


def demo(name: str = "a.hdf5", **changes: Any) -> Build:
    """One demonstration in a file."""
    return one(name, lambda path: robomimic(path, (0,), **changes))


ROBOMIMIC = {
    "in natural order": read(
        one("low.hdf5", robomimic), "control_freq", "3 more", q=[Q + 0.01 * i for i in (0, 1, 2, 10)], u=U, **GIVEN,
        names=[f"low.hdf5 demo_{i}" for i in (0, 1, 2, 10)],
    ),
    "stamps before a rate": read(
        demo(robot0_gripper_qpos=Q[:, :2], timestamps=2.0 * TIME), "not used: robot0_gripper_qpos", u=U,
        time=2.0 * TIME, **GIVEN,
    ),
    "a rate given": read(demo(env_args=None), "by the words", u=U, rate=FPS, **GIVEN),
}  # fmt: skip

# ---- bags
AHEAD = 51_000_000_000  # [ns]
PACKED: tuple[tuple[str, dict[str, Any]], ...] = (
    ("ros1", {"compression": Writer1.CompressionFormat.BZ2}),
    ("sqlite", {"mode": CompressionMode.MESSAGE}),
    ("sqlite", {"mode": CompressionMode.FILE}),
    ("mcap", {"mode": CompressionMode.STORAGE}),
)
COMMANDED = bag("mcap", all_in_one(topic="/real"), all_in_one(q=Q + 0.1, topic="/command"))
HALF = [("/slide", START + int(s) + 10**7, (START + int(s) + 10**7, ("joint3", "finger"), (0.5e-9 * (s + 10**7), 0.01)))
        for s in STEPS[::2]]  # fmt: skip


def but_one(change: Any, messages: list[Message] | None = None) -> list[Message]:
    """Messages of which one has other fields."""
    messages = all_in_one() if messages is None else messages
    topic, at, content = messages[20]
    return [*messages[:20], (topic, at, change(*content)), *messages[21:]]


BAGS = {
    **{f"{k} in another order": read(bag(k, all_in_one(("joint3", "joint1", "joint2"))), u=U) for k in KINDS},
    **{f"{kind} with {o}": read(bag(kind, all_in_one(), **o), u=U) for kind, o in PACKED},
    **{
        f"{k} beside a foreign message": read(
            bag(k, all_in_one(), foreign="uint8 x\ncompany_msgs/Missing y\n"), "not read: '/odd'", u=U
        )
        for k in KINDS
    },
    "numbers of the other byte order": read(bag("mcap", all_in_one(), big_endian=True), u=U),
    "efforts of two publishers": read(
        bag("sqlite", some("/arm", (0, 1)), some("/wrist", (2,))), "", effort=7.0 * Q, atol=1e-12
    ),
    "two publishers at two rates": read(
        bag("mcap", some("/arm", (1, 0)), HALF), "joint3 come from /slide: interpolated", "finger",
        "2 samples left out", q=Q[1:-1], time=TIME[:-2], atol=1e-9,
    ),
    "efforts of some messages": read(bag("mcap", but_one(lambda *c: c[:4], some("/joint_states", (0, 1, 2)))), ""),
    "a command beside": read(COMMANDED, "/command", u=U),
    "velocities of one publisher": read(
        bag("mcap", all_in_one(("joint1", "joint2")), some("/wrist", (2,))), "velocities", atol=1e-12
    ),
    "two efforts": read(bag("mcap", but_one(lambda *c: (*c, (1.0, 2.0)))), "1 message of /joint_states", u=U),
    "the command": read(COMMANDED, "", q=Q + 0.1, u=U, topics=["/command"]),
    "one message of other joints": read(
        bag("mcap", but_one(lambda s, _, *c: (s, ("joint1", "joint2", "jointX"), *c))),
        "1 message of /joint_states with another list of joints are not used", time=np.delete(TIME, 20),
        q=np.delete(Q, 20, axis=0), u=np.delete(U, 20, axis=0),
    ),
    "some stamps": read(bag("mcap", but_one(lambda _, *c: (0, *c))), "not set", u=U),
    "two hosts on one topic": read(
        bag("mcap", some("/joint_states", (0, 1, 2)), some("/joint_states", (0, 1, 2), late=1000, ahead=AHEAD)),
        "51 s apart", q=[Q, Q], effort=7.0 * Q, names=["bag sender 1", "bag sender 2"],
    ),
    "joints of two hosts": read(
        bag("mcap", some("/arm", (0, 1)), some("/wrist", (2,), late=1, ahead=AHEAD)), "its clock, 51 s ahead",
        q=Q[1:], effort=7.0 * Q[1:], time=TIME[:-1], atol=1e-5,
    ),
}  # fmt: skip
READ = TABLES | ARCHIVES | LEROBOT | ROBOMIMIC | BAGS


@pytest.mark.parametrize("name", READ)
def test_what_was_recorded_is_read(name: str, planar3: ml.Robot, tmp_path: Path) -> None:
    """Positions, velocities and efforts are read by name and bit for bit, names in natural order; the rest is noted."""
    row = READ[name]
    demos = ml.load_demonstrations(row.build(tmp_path), planar3, **row.options)
    each = row.q if isinstance(row.q, list) else [row.q]
    assert len(demos) == len(each) and row.names in (None, [t.name for t in demos])
    assert bool(demos.notes) == bool(row.note) and all(words in " ".join(demos.notes) for words in row.note)
    for k, (t, q) in enumerate(zip(demos, each, strict=True)):
        u = row.u[k] if isinstance(row.u, list) else row.u
        for got, expected in ((t.q, q), (t.u, u), (t.effort, row.effort)):
            assert (got is None) == (expected is None)
            if got is not None:
                np.testing.assert_allclose(got, expected, rtol=0, atol=row.atol)
        np.testing.assert_allclose(t.time - t.time[0], row.time, rtol=0, atol=2e-6)


# ---- what cannot be used
Unfit = tuple[str, str, Build, dict[str, Any]]


def unfit(code: str, words: str, build: Build, **options: Any) -> Unfit:
    """Return a row: code and words of the refusal, how the file is written, options of the reader."""
    return code, words, build, options


REMARKS = ("recorded by hand", "1, 2, 3, 4", "time, joint1, joint2")
STATES = motion(0).tolist()
NO_NAMES = ({"joint2": 5, "joint1": 0, "joint3": 1}, None, [], {}, [1, 2, 3], "abc", {"motors": "abc"})
GAPS = {
    "a sample is missing": ("not-finite", pa.array([*STATES[:-1], None], type=pa.list_(pa.float64()))),
    "a short sample": ("ragged", pa.array([*STATES[:-1], [1.0]])),
    "text": ("not-a-number", pa.array([[str(x) for x in row] for row in STATES])),
}
FEATURES = {
    "observation.state.joint_positon": f"did you mean '{KEY}'",
    "observation.images.wrist": "holds video, joint positions are a vector of numbers",
}


def states(array: pa.Array) -> Build:
    return lerobot(frames({0: motion(0)}).set_column(0, "observation.state", array))


def linked(make: Any) -> Build:
    """Positions that lie elsewhere, though they would be good numbers."""

    def write(folder: Path) -> Path:
        robomimic(folder / "secret.hdf5")
        (folder / "secret.bin").write_bytes(Q.tobytes())
        path = demo(robot0_joint_pos=None)(folder)
        with h5py.File(path, "a") as file:
            make(file, folder)
        return path

    return write


PLACE = "data/demo_0/obs/robot0_joint_pos"


def virtual(file: Any, folder: Path) -> None:
    layout = h5py.VirtualLayout(Q.shape, "f8")
    layout[:] = h5py.VirtualSource(str(folder / "secret.hdf5"), PLACE, Q.shape)
    file["data/demo_0/obs"].create_virtual_dataset("robot0_joint_pos", layout)


def outside_group(file: Any, folder: Path) -> None:
    del file["data"]
    file["data"] = h5py.ExternalLink("secret.hdf5", "data")


LINKS = {
    "a file": lambda file, _: file.update({PLACE: h5py.ExternalLink("secret.hdf5", PLACE)}),
    "a group": outside_group,
    "within": lambda file, _: file.update({PLACE: h5py.SoftLink("/data/demo_0/obs/robot0_joint_vel")}),
    "storage": lambda file, folder: file["data/demo_0/obs"].create_dataset(
        "robot0_joint_pos", Q.shape, "f8", external=[(str(folder / "secret.bin"), 0, Q.nbytes)]
    ),
    "a virtual set": virtual,
}


def made(**options: Any) -> Any:
    return lambda file, _: file["data/demo_0/obs"].create_dataset("robot0_joint_pos", **options)


HDF5 = {
    "nothing": ("no-state", lambda file, _: None),
    "two columns": ("shape", made(data=Q[:, :2])),
    "a sample less": ("shape", made(data=Q[:-1])),
    "no number": ("not-finite", made(data=np.where(Q == Q[5, 1], np.nan, Q))),
    "nothing stored": ("damaged", made(shape=(60, 3), dtype="f8")),
    "a terabyte": ("damaged", made(shape=(10**12, 3), dtype="f8", chunks=(1000, 3))),
}


POSITIONLESS = [(t, r, (s, n, (), u)) for t, r, (s, n, _, u) in all_in_one()]
GUI = [(t, r + 8_000_000, (s + 8_000_000, n, Q[0] + 0.4)) for t, r, (s, n, *_) in all_in_one()]
TWICE = but_one(lambda s, n, q, _: (s, (*n, "joint2"), (*q, 0.5)))
# names of joints come before arrays that could be positions
NAMES_FIRST = npz(joint_names=np.array(JOINTS), t=TIME, alpha=Q, beta=Q)
REFUSED = {
    "a column of text": unfit("not-a-number", "phase", table(HEADER + ",phase", TABLE, ["reach out"] * 60)),
    **{f"a remark {r!r}": unfit("no-header", ":2:", table(f"# {r}\n{TABLE[0, 0]},0,2,0", TABLE[1:])) for r in REMARKS},
    "commands alone": unfit("columns", "columns='target.{joint}'", table(header("target.{}"), TABLE)),
    "a joint too many": unfit(
        "unknown-column", "no joint of robot", archive(q=TABLE, u=None, joint_names=["copy", *JOINTS])
    ),
    "a joint that is ignored": unfit("missing-joint", "joint 'joint1'", archive(u=None), ignore_columns=["joint1"]),
    **{
        f"LeRobot units like {units}": unfit("units", f"'{units}'", scaled(factor))
        for units, factor in (("radians", 1.0), ("degrees", 57.29578), ("normalised", 30.0))
    },
    "a part of a LeRobot set alone": unfit("no-joint-names", "joint_names", alone, units="radians"),
    **{
        f"LeRobot names {names}": unfit("no-joint-names", "", lerobot(WHOLE, names=names), units="radians")
        for names in NO_NAMES
    },
    **{f"LeRobot, {name}": unfit(code, "", states(array), units="radians") for name, (code, array) in GAPS.items()},
    "LeRobot, no object": unfit("damaged", "", lerobot(WHOLE, described=[]), units="radians"),
    "LeRobot, names of others": unfit("missing-joint", "", lerobot(WHOLE, names=list("abc")), units="radians"),
    **{
        f"feature {name}": unfit("no-state", words, droid, **NAMED | {"feature": name})
        for name, words in FEATURES.items()
    },
    "LeRobot stamps against fps": unfit(
        "fps", "give 30 frames per second, its fps is 50", stamped(STAMPS / 30.0), units="radians"
    ),
    **{f"robomimic rate {args!r:.30}": unfit("no-time", "", demo(env_args=args), **GIVEN) for args in NO_RATE},
    "names of joints are no positions": unfit("missing-array", "rename={'NAME': 'q'}", one("a.npz", NAMES_FIRST)),
    **{f"robomimic, link to {name}": unfit("link", "", linked(make), **GIVEN) for name, make in LINKS.items()},
    **{f"robomimic, {name}": unfit(code, "", linked(make), **GIVEN) for name, (code, make) in HDF5.items()},
    "a stamp less": unfit("shape", "they have", archive(time=TIME[:-1], u=None)),
    "four dimensions": unfit("shape", "must have shape", archive(q=Q[None, None])),
    "one text for all names": unfit("shape", "a list of names", archive(joint_names=None, names=np.array("a b c"))),
    "a bag of other joints": unfit("missing-joint", "joint3", bag("mcap", some("/arm", (0, 1)))),
    "velocities alone": unfit("no-positions", "velocities of 3 joints are recorded", bag("ros1", POSITIONLESS)),
    "no such topic": unfit("unknown-topic", "/command", COMMANDED, topics=["/wnted"]),
    "a forgotten GUI": unfit(
        "two-publishers", "joint.*Two programs published on one topic", bag("sqlite", all_in_one(u=None), GUI)
    ),
    "a joint twice": unfit("duplicate-column", "name the joint 'joint2' 2 times", bag("mcap", TWICE)),
}  # fmt: skip
FILES = {
    **{"good.csv": text(GOOD), "bare.csv": text(GOOD.partition("\n")[2]), "gone.csv": lambda path: None},
    "numbered.csv": text(csv(np.column_stack([TABLE, TIME]), "time,q0,q1,q2,q3")),
    "gap.csv": text(csv(TABLE, "time,q0,q1,q3")),
}
REFUSED |= {
    what: unfit(code, said, one(file, FILES[file]), **json.loads(options))
    for what, file, code, said, options in rows_in("wrong_options.txt")
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_cannot_be_used_is_refused(name: str, planar3: ml.Robot, tmp_path: Path) -> None:
    """Nothing is filled in or guessed, nothing outside a file is opened, no bomb unpacked, no option passed over."""
    code, words, build, options = REFUSED[name]
    path = build(tmp_path)
    error = refusal(path, planar3, match=words or None, **options)
    assert (
        error.code == code and "\n" not in str(error) and (code == "option" or path.is_dir() or path.name in str(error))
    )


@pytest.mark.parametrize(("value", "code"), [("x1", "not-a-number"), ("900", "outside-limits")])
def test_the_refused_line_is_named(value: str, code: str, planar3: ml.Robot, tmp_path: Path) -> None:
    """The error names the file, the line as an editor counts it (comments and blank lines too), column and value."""
    lines, path = GOOD.split("\n"), tmp_path / "demo.csv"
    path.write_text("\n".join(["# one", "", *lines[:5], "# two", *lines[5:8], f"0.14,{value},1.9,0.07", *lines[9:]]))
    error = refusal(path, planar3)
    assert (error.code, error.line, error.column, error.path) == (code, 12, "joint1", path), str(error)
    assert "demo.csv:12" in str(error) and value in str(error)


def test_grippers_are_in_percent(tmp_path: Path) -> None:
    """LeRobot keeps the gripper in 0 .. 100 whatever the unit of the arm; '.pos' is taken off the names; both said."""
    robot = ml.load_robot("so101")
    state, g = np.tile(np.linspace(-20.0, 20.0, 40)[:, None], (1, robot.nv)), robot.joint_names.index("gripper")
    state[:, g] = np.linspace(0.0, 100.0, 40)
    root = lerobot(frames({0: state}), names=[f"{j}.pos" for j in robot.joint_names])(tmp_path)
    demos = ml.load_demonstrations(root, robot, units="degrees")
    ends = [robot.position_lower[g], robot.position_upper[g]]
    np.testing.assert_allclose(demos[0].q[[0, -1], g], ends, rtol=0, atol=1e-6)
    np.testing.assert_allclose(demos[0].q[:, g - 1], np.radians(state[:, g - 1]), rtol=0, atol=1e-6)
    assert "gripper" in " ".join(demos.notes) and ".pos" in " ".join(demos.notes)


def test_efforts_of_locked_joints_are_dropped(tmp_path: Path) -> None:
    """The efforts of the joints that move are kept."""
    path = table(HEADER + ",joint1_effort,joint2_effort,joint3_effort", TABLE, EFFORT)(tmp_path)
    (t,) = ml.load_demonstrations(path, ml.load_robot("planar3", locked={"joint2": 1.0}))
    np.testing.assert_array_equal(t.effort, EFFORT[:, [0, 2]])


# ---- several publishers in one table: nothing is invented where one of them was silent
MS = 1_000_000  # [ns]


def states_of(topic: str, names: str, stamps: Any, q: Any = None, *received: Any) -> JointStates:
    """Messages of one topic; positions are 0.001 per millisecond times 1, 2, 3, ... unless given."""
    slopes = 1e-3 * (1.0 + np.arange(len(names.split())))
    q = np.outer((stamps - START) / MS, slopes) if q is None else np.asarray(q, dtype=float)
    return JointStates(topic, tuple(names.split()), stamps, {"position": q}, *received)


def every(step: float, first: float, last: float) -> np.ndarray:
    """Stamps at a regular step [ms]."""
    return START + (np.arange(first, last + 1e-9, step) * MS).astype(np.int64)


def test_gaps_of_a_publisher_are_not_bridged():
    """Where another publisher was silent far longer than usual the samples are left out, and the note counts them."""
    stamps = np.concatenate([every(20, 5, 805), every(20, 1505, 2005)])
    merged, notes = merge([states_of("/arm", "a b", every(10, 0, 2000)), states_of("/hand", "c", stamps)], frozenset())
    kept = (merged.stamps - START) / MS
    np.testing.assert_array_equal(kept, [*range(10, 801, 10), *range(1510, 2001, 10)])
    assert "71 samples left out" in " ".join(map(str, notes))
    np.testing.assert_allclose(merged.arrays["position"], np.outer(kept, [1e-3, 2e-3, 1e-3]), rtol=0, atol=1e-12)


def test_angles_that_wrap_are_interpolated_the_short_way():
    """A continuous joint that passes from 3.1 to -3.1 is near pi in between; any other joint passes through 0."""
    both = [states_of("/arm", "a b", every(10, 0, 20)), states_of("/hand", "c", every(20, 0, 20), [[3.1], [-3.1]])]
    for wraps, middle in ((frozenset({"c"}), np.pi), (frozenset(), 0.0)):
        assert merge(both, wraps)[0].arrays["position"][1, 2] == pytest.approx(middle)


def test_the_last_message_of_equal_stamps_is_kept() -> None:
    """Of messages of two kinds with one stamp the last stays, by the names of its joints, and it is said."""
    stamps = every(10, 0, 20)
    first = states_of("/arm", "a b", stamps, np.arange(6.0).reshape(3, 2), stamps)
    other = states_of("/arm", "b a", stamps[1:2], [[8, 7]], stamps[1:2])
    (merged,), notes = joint_groups([first, other], {"a": "/arm", "b": "/arm"})
    np.testing.assert_array_equal(merged.arrays["position"], [[0, 1], [7, 8], [4, 5]])
    assert [*map(str, notes)] == ["/arm: 1 message left out for a repeated stamp, the last is kept"]


def test_a_late_message_is_told_from_a_clock_that_was_set_back():
    """After a late message the next stamp is as expected; after a clock was set back it is not. Both are corrected."""
    arrival, q = every(10, 0, 390), np.outer(np.arange(40.0), [1.0, -1.0])
    late, back = np.array([*range(20), 22, 20, 21, *range(23, 40)]), 300 * MS * (np.arange(40) >= 20)
    for stamps, positions, words in (
        (START + late * 10 * MS, q[late], "/arm: 1 sample came late: sorted by their stamps"),
        (arrival - back, q, "set back by 0.3 s"),
    ):
        (merged,), notes = states_of("/arm", "a b", stamps, positions, arrival).in_order()
        np.testing.assert_array_equal(merged.stamps, arrival)
        np.testing.assert_array_equal(merged.arrays["position"], q)
        assert words in str(notes[0])


# ---- one door for all formats, folders and options
@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Twelve tables."""
    for i in range(1, 13):
        (tmp_path / f"demo_{i}.csv").write_text(csv(TABLE + [0, 0.01 * i, 0, 0]))
    return tmp_path


def test_paths_may_be_strings_lists_and_folders(planar3: ml.Robot, folder: Path) -> None:
    """One path, several, and their folder give the same, in natural order and each once; a list may mix formats."""
    files = [folder / f"demo_{i}.csv" for i in range(1, 13)]
    for paths in ([str(f) for f in files], iter(files), folder, str(folder)):
        assert [t.name for t in ml.load_demonstrations(paths, planar3)] == [f.name for f in files]
    demos = ml.load_demonstrations([folder, files[1]], planar3, units="normalised")
    assert len(demos) == 12 and "read once" in demos.notes[0] and len(demos.notes) == 2
    assert len(ml.load_demonstrations([files[0], archive()(folder)], planar3)) == 2
    assert refusal(folder, planar3).code == "mixed-folder"
    for paths in ([], "", [""], [None], 7, None):
        refusal(paths, planar3)


@pytest.mark.parametrize(("missing", "module", "extra"), rows_in("missing_libraries.txt"))
def test_missing_libraries_name_the_extra(missing: str, module: str, extra: str, monkeypatch) -> None:
    """Without the library: one sentence with the pip command, not an ImportError."""
    parts = ("manip_learn.recordings.", f"manip_learn.{module}", f"{missing}.")
    for name in [n for n in sys.modules if n.startswith(parts)]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, missing, None)
    with pytest.raises(MissingExtraError, match=rf"manip_learn\[{extra}\]"):
        importlib.import_module(f"manip_learn.{module}")


# ---- selected episodes
def test_files_are_selected_by_natural_order(planar3: ml.Robot, folder: Path) -> None:
    """demo_2 comes before demo_10, whatever the order of the selection; a note tells how many were selected. Ranges are
    half-open, from 0, and may go beyond the last file.
    """
    for chosen, numbers in {
        "9,0:2": (1, 2, 10),
        range(1, 3): (2, 3),
        ":2,5, 7": (1, 2, 6, 8),
        "10:99": (11, 12),
    }.items():
        demos = ml.load_demonstrations(folder, planar3, episodes=chosen)
        assert [t.name for t in demos] == [f"demo_{i}.csv" for i in numbers]
        assert any(f"{len(numbers)} of 12 files selected" in note for note in demos.notes)


def test_episodes_that_do_not_exist_name_near_ones(planar3: ml.Robot, folder: Path) -> None:
    """Each item must select something: a number beyond the end is no silent empty selection, nor is episode 1 of two
    data sets.
    """
    near = r"'12'.*there are 12, numbered 0 to 11; the nearest: 8, 9, 10, 11"
    refusal(folder, planar3, match=near, episodes="0:3,12")
    root = version_3(folder / "a")
    with pytest.raises(RecordingError, match="'7:9'") as caught:
        ml.RecordingSource(root, planar3, units="radians", episodes="7:9")
    assert caught.value.code == "no-episode"
    refusal([root, version_2(folder / "b")], planar3, match="name one data set", units="radians", episodes="1")


# ---- options that match in some files, or in none
def test_an_option_may_match_in_one_file_only(planar3: ml.Robot, tmp_path: Path, monkeypatch) -> None:
    """An option that matches in one file of a set is accepted; one that matches in no file is refused."""
    for i, names in enumerate((HEADER, "time,joint1,elbow,joint3")):
        table(names, TABLE, name=f"demo_{i}.csv")(tmp_path)
    options = {"rename": {"elbow": "joint2"}}
    assert len(ml.load_demonstrations(tmp_path, planar3, **options)) == 2
    refusal(tmp_path / "demo_0.csv", planar3, match="nothing in the recordings is called 'elbow'", **options)
    monkeypatch.setattr("manip_learn.recordings.load.PART_BYTES", 1)
    assert len(list(ml.RecordingSource(tmp_path, planar3, **options))) == 2
    source = ml.RecordingSource(tmp_path, planar3, rename={"elbow": "joint2", "nope": "joint1"})
    with pytest.raises(RecordingError, match="nope"):
        ml.ConstraintLearner(ml.FrameJacobian(planar3, "tip", "x y")).fit(source)


def test_another_robot_is_suspected(tmp_path: Path) -> None:
    """If no column is a joint of the robot, the error suspects another robot and names a shipped one that fits."""
    for names, words in (
        (HEADER, "it was recorded with 'planar3', not 'sawyer': name that robot"),
        ("time,left_a,left_b,left_c", "was it recorded with another robot than 'sawyer'?"),
    ):
        assert words in str(refusal(table(names, TABLE)(tmp_path), ml.load_robot("sawyer")))


def test_options_for_rollouts_are_refused_as_typed(planar3: ml.Robot, tmp_path: Path, capsys) -> None:
    """A rollout is read as it was written: an option for recordings would be ignored in silence."""
    run = ml.Rollout(TIME, Q, U, TIME, ("ok",) * 60, planar3.joint_names, TIME, robot=RobotIdentity.of(planar3))
    path = str(run.save(tmp_path / "run.npz"))
    assert main(["replay", "planar3", path, "--html", str(tmp_path / "page.html"), "--topic", "/x"]) == 2
    assert "so --topic has no use" in capsys.readouterr().err
