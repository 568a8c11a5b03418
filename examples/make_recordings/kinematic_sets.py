"""Demonstrations of many kinds of task by kinematics alone, for studies that need hundreds of them.

    trajectories, truth = make_set("drawer", "panda", seed=7, n_demonstrations=6)

A person guides the arm by the tip. What holds the tip is obeyed to 1e-10 m by Newton iterations on positions, and the
joints wander in what is left: no learnt quantity takes part. Each recording is whole unless asked otherwise: rest, a
curved free approach, contact, a curved free retreat, rest. Everything is drawn from kind, robot and seed; seeds below
1000 are for development, those from 1000 on for held-out tests.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from make_recordings.arms import ARMS, Arm, load_arm
from make_recordings.furniture import comfortable
from make_recordings.hand_motion import RATE
from make_recordings.kinds import FREE, KINDS, TASKS
from make_recordings.mechanism_motion import UnreachableError
from make_recordings.mechanisms import Mechanism, across
from make_recordings.whole_recording import TRIES, Perform, Session, Tape

ENCODER_NOISE = 1e-4  # [rad]
WANDER = 0.12  # [rad]
DRAWS = 400
LEAST_DIFFERENCE = np.deg2rad(25.0), 0.15  # between the axes of the right mechanism and the other [rad], [m]

Trajectories = list[tuple[Float[np.ndarray, " T"], Float[np.ndarray, "T nv"]]]
Drawn = tuple[list[Tape], list[Mechanism], list[int]]
Draw = Callable[[str, Arm, list[int], int, bool], Drawn]


def make_set(
    kind: str,
    robot: str,
    seed: int,
    n_demonstrations: int = 6,
    noise: float = ENCODER_NOISE,
    whole: bool = True,
    tilt: float = 0.0,
) -> tuple[Trajectories, dict[str, Any]]:
    """Demonstrations of one task, and the truth about them.

    Args:
        kind: One of `KINDS`.
        robot: One of `ARMS`.
        seed: Everything is drawn from it; the noise is drawn apart, the motion is the same without it.
        n_demonstrations: At least 1.
        noise: Standard deviation of the encoders [rad].
        whole: Whether approach, retreat and rests are recorded, or the contacts only.
        tilt: By how much the furniture is turned about where the hand takes hold, across its axis [deg].

    Returns:
        (time [s], q [rad]) of each demonstration, sampled at 100 Hz; and the truth, see `describe`.

    Raises:
        ValueError: No such kind or robot, or no demonstration asked for.
        RuntimeError: Nothing within reach was drawn.
    """
    return record_set(partial(draw_set, tilt=tilt), kind, robot, seed, n_demonstrations, noise, whole)


def record_set(
    draw_one: Draw, kind: str, robot: str, seed: int, n_demonstrations: int, noise: float, whole: bool
) -> tuple[Trajectories, dict[str, Any]]:
    """`make_set` with another way to make the motion: the first good draw, with the encoders' noise and its truth.

    Raises:
        ValueError: No such kind, or no demonstration asked for.
        RuntimeError: Nothing within reach was drawn.
    """
    if kind not in KINDS:
        raise ValueError(f"no kind {kind!r}; there are {', '.join(KINDS)}")
    if n_demonstrations < 1:
        raise ValueError(f"{n_demonstrations} demonstrations: at least 1 is needed")
    arm = load_arm(robot)
    key = [seed, zlib.crc32(kind.encode()), tuple(ARMS).index(robot)]
    for draw in range(DRAWS):
        try:
            tapes, mechanisms, other = draw_one(kind, arm, [*key, draw], n_demonstrations, whole)
        except UnreachableError:
            continue
        encoders = np.random.default_rng([*key, DRAWS])
        recorded = [tape.motion + encoders.normal(0.0, noise, tape.motion.shape) for tape in tapes]
        facts = {"kind": kind, "robot": robot, "tip": arm.tip.name, "seed": seed, "rate": RATE, "noise": noise}
        return [(np.arange(len(q)) / RATE, q) for q in recorded], facts | describe(tapes, mechanisms, other)
    raise RuntimeError(f"{kind}, {robot}, seed {seed}: {DRAWS} draws and nothing was within reach")


def describe(tapes: list[Tape], mechanisms: list[Mechanism], other: list[int]) -> dict[str, Any]:
    """The truth, ready for JSON.

    `windows`: (start [s], end [s], index of the mechanism) of each contact of each demonstration. `mechanisms`: type,
    how it is held, axis, a point on it or in it [m], radius [m], pitch [m/rad], `rows` of the tip's velocity (linear
    part first) that hold in base axes throughout, and `n_rows`, how many hold at each moment. `contaminated`: indices
    of the demonstrations that do not belong. `offsets`: the point that is held and of which the rows speak, seen from
    the tip's frame [m], of each demonstration. After a slip the hand is elsewhere on a door: type, axis and point
    hold, the radius does not.
    """
    return {
        "windows": [[list(window) for window in tape.windows] for tape in tapes],
        "mechanisms": [mechanism.truth() for mechanism in mechanisms],
        "contaminated": other,
        "offsets": [list(tape.offset) for tape in tapes],
    }


def draw_set(
    kind: str,
    arm: Arm,
    key: list[int],
    n: int,
    whole: bool,
    settle: float = 0.0,
    perform: Perform | None = None,
    tilt: float = 0.0,
) -> Drawn:
    """One draw of the furniture, and n demonstrations with it; the key seeds it.

    Returns:
        The demonstrations, the mechanisms, and the indices of the demonstrations that do not belong.

    Raises:
        UnreachableError: A demonstration could not be made with it.
    """
    if kind in FREE:
        return [_free(kind, arm, [*key, number], perform) for number in range(n)], [], []
    rng, task = np.random.default_rng(key), TASKS[kind]
    places = [comfortable(arm, rng) for _ in task.makers]
    handles = [arm.pose(place)[:3, 3] for place in places]
    mechanisms = [maker(handle, rng) for maker, handle in zip(task.makers, handles, strict=True)]
    if tilt:
        mechanisms = [_tilted(m, tilt) for m in mechanisms]
    if task.contaminates == "mechanism" and not _differ(*mechanisms):
        raise UnreachableError("the other one is too much like the first")
    count = int(rng.integers(1, max((n - 1) // 2, 1) + 1)) if task.contaminates else 0
    other = sorted(rng.choice(n, count, replace=False).tolist())
    grip, wander = task.grip * rng.uniform(0.4, 1.2), WANDER * rng.uniform(0.5, 1.5)
    session = Session(arm, mechanisms, places, grip, wander, whole, settle, perform)
    if task.moved:
        return _with_moved_furniture(session, key, n)
    tapes = []
    for number in range(n):
        indices = [int(number in other)] if task.contaminates == "mechanism" else list(range(len(mechanisms)))
        slips = task.contaminates == "slip" and number in other
        offset = np.random.default_rng([*key, number, DRAWS]).normal(0.0, task.offset, 3)
        held = replace(session, arm=replace(arm, offset=tuple(offset.tolist()))) if task.offset else session
        tapes.append(held.demonstrate(indices, slips, [*key, number]))
    return tapes, mechanisms, other


def _tilted(mechanism: Mechanism, tilt: float) -> Mechanism:
    turn = Rotation.from_rotvec(np.radians(tilt) * across(np.array(mechanism.truth()["axis"]))[0]).as_matrix()
    motion = np.eye(4)
    motion[:3, :3], motion[:3, 3] = turn, mechanism.handle - turn @ mechanism.handle
    return mechanism.moved(motion)


def _with_moved_furniture(session: Session, key: list[int], n: int) -> Drawn:
    """Each demonstration at another place, where hand and furniture are moved together as one body."""
    (mechanism,), (place,), tapes, mechanisms = session.mechanisms, session.places, [], []
    back = np.linalg.inv(session.arm.pose(place))
    for number in range(n):
        tape = None
        for attempt in range(TRIES):
            there = comfortable(session.arm, np.random.default_rng([*key, number, attempt, DRAWS]))
            moved = mechanism.moved(session.arm.pose(there) @ back)
            here = replace(session, mechanisms=[*mechanisms, moved], places=[place] * number + [there], grip=0.0)
            try:
                tape = here.demonstrate([number], False, [*key, number, attempt])
            except UnreachableError:
                continue
            mechanisms.append(moved)
            break
        if tape is None:
            raise UnreachableError(f"demonstration {number}: {TRIES} places and none was good")
        tapes.append(tape)
    return tapes, mechanisms, []


def _differ(first: Mechanism, second: Mechanism) -> bool:
    """Whether two mechanisms of one type have clearly different axes."""
    one, two = first.truth(), second.truth()
    angle = np.arccos(min(abs(float(np.dot(one["axis"], two["axis"]))), 1.0))
    if angle > LEAST_DIFFERENCE[0] or one["point"] is None:
        return bool(angle > LEAST_DIFFERENCE[0])
    apart = np.cross(one["axis"], np.subtract(one["point"], two["point"]))
    return bool(np.linalg.norm(apart) > LEAST_DIFFERENCE[1])


def _free(kind: str, arm: Arm, key: list[int], perform: Perform | None) -> Tape:
    for attempt in range(TRIES):
        rng = np.random.default_rng([*key, attempt])
        tape = Tape([FREE[kind](arm, np.random.default_rng(key[:-1]), rng)])
        if perform:
            tape = perform(arm, tape, [], rng)
        if arm.stays_inside(tape.motion, RATE) and arm.keeps_clear(tape.motion[::20]):
            return tape
    raise UnreachableError(f"{TRIES} tries and none was good")
