"""The arm, its surroundings and the constraint, as the teaching page draws them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, final

import numpy as np
from jaxtyping import Float

from manip_learn.constraint.constraint import Constraint
from manip_learn.constraint.manipulability import manipulability
from manip_learn.errors import counted
from manip_learn.playback.appearance import joint_tracks
from manip_learn.playback.page_writer import REPLAY, to_base64
from manip_learn.playback.replay_page import live_page
from manip_learn.playback.scene_data import held_directions
from manip_learn.robot.robot import Robot
from manip_learn.teach.arm import TeachingArm
from manip_learn.teach.scene import MOVES, TITLES, TeachingScene

ENOUGH = 5  # recordings that a person is asked for
RECORD = {"say": "Record another one", "said": {"do": "record"}}  # button, and what it says to the program

# type of a mechanism -> the answer in a line
LINES = {
    "line": "The hand slides along a straight line, like a drawer",
    "hinge": "The hand turns about an axis, like a door",
    "screw": "The hand turns about an axis and moves along it, like a screw",
    "plane": "The hand stays on a plane, like a table",
    "ball": "The hand turns about a point",
    "curve": "The hand follows a curve",
}
_FOLDER = Path(__file__).with_name("page")
_PARTS = "link pointing hand furniture drawing recordings answer ghosts take panel teach"
NOT_TAUGHT_WITH = ("shown.js", "legend.js", "live.js", "main.js")  # of a replay's program
TEACH = replace(
    REPLAY,
    mode="teach",
    style=(*REPLAY.style, _FOLDER / "teach.css"),
    program=(
        *(file for file in REPLAY.program if file.name not in NOT_TAUGHT_WITH),
        *(_FOLDER / f"{name}.js" for name in _PARTS.split()),
    ),
    markup=(_FOLDER / "teach.html",),
)


def teaching_page(robot: Robot, name: str, token: str) -> str:
    """HTML of the page for `manip-learn teach`, self-contained; it speaks to the server that it came from alone.

    Args:
        robot: The robot; its poses, furniture and recordings arrive as events.
        name: Headline.
        token: Of the address under which it is served.

    Raises:
        OutputError: Meshcat's viewer is missing.
    """
    return live_page(robot, name, token, TEACH)


@final
class TeachingPicture:
    """What the page is told of one arm, picture by picture.

    Args:
        robot: The arm.
        tip: Its frame that is guided.
    """

    def __init__(self, robot: Robot, tip: str):
        self._robot, self._tip = robot, tip
        rng = np.random.default_rng(0)
        # directions in which the tip can move at all, in any of 20 random postures: two for an arm in a plane
        drawn = (robot.random_configuration(rng) for _ in range(20))
        self._rank = int(np.linalg.matrix_rank(np.hstack([robot.jacobian(q, tip)[:3] for q in drawn]), tol=1e-9))

    def pose(self, arm: TeachingArm, constraint: Constraint | None, rows: Constraint | None) -> dict[str, Any]:
        """One picture: vectors in the base, SI units.

        Args:
            arm: The arm now.
            constraint: The learnt one, or None.
            rows: Rows whose manipulability counts, or None for the tip's translation.
        """
        robot, hand, q = self._robot, arm.hand, arm.q
        U, sizes, _ = np.linalg.svd(robot.jacobian(q, self._tip)[:3], full_matrices=False)
        last = min(self._rank, len(sizes)) - 1
        # of the tip's translation, least over largest singular value: below 0.2 the weak direction is drawn
        share = float(sizes[last] / max(sizes[0], 1e-12))
        held = hand.pull and {
            "at": hand.at.tolist(),
            "to": hand.pull.to.tolist(),
            "force": float(np.linalg.norm(hand.force)),
            "limited": bool(hand.limited),
        }
        touches = [at.pos.tolist() for at in arm.data.contact[: arm.data.ncon] if at.dist < 0.0]
        # [rad or m] from a joint's limit: within 0.01 the arm feels it
        gaps = np.minimum(q - robot.position_lower, robot.position_upper - q)
        return {
            "time": arm.time,
            "values": joint_tracks(robot, q[None])[0].tolist(),
            "furniture": [[*arm.handle_place.tolist(), *arm.data.body("handle").xquat.tolist()]],  # real part first
            "held": [arm.held],
            "near": 0 if arm.is_near else None,
            "hand": held,
            "weak": {"direction": U[:, last].tolist(), "share": share} if share < 0.2 else None,
            "mu": float(np.prod(sizes[: last + 1])) if rows is None else float(manipulability(rows, q)),
            "marks": None if constraint is None else self._marks(constraint, q, arm.place),
            "limit": [name for name, gap in zip(robot.joint_names, gaps, strict=True) if gap < 0.01],
            "opening": [arm.opening],
            "touches": touches[:3],  # an edge gives a dozen
        }

    def _marks(self, constraint: Constraint, q: np.ndarray, place: np.ndarray) -> dict[str, Any] | None:
        """Directions held and free at the tip now."""
        told = held_directions(constraint, place[None])
        if told is None:
            return None
        axes = np.eye(3) if told.axes is None else self._robot.pose(q, told.axes)[:3, :3]
        parts = {"held": told.held, "free": told.free, "fixed": told.held_turns, "turns": told.free_turns}
        return {name: (_directions(part) @ axes.T).tolist() for name, part in parts.items()}


def _directions(projector: Float[np.ndarray, "..."]) -> Float[np.ndarray, "k 3"]:
    """Orthonormal rows that span what a projector keeps."""
    values, vectors = np.linalg.eigh(np.asarray(projector).reshape(-1, 3, 3)[0])
    return vectors[:, values > 0.5].T


def scene_content(scene: TeachingScene, number: int) -> dict[str, Any]:
    """The furniture for the page."""
    handle, (move, task) = scene.handle, MOVES[scene.handle.type]
    at, unit = handle.pose[:3, 3].tolist(), "rad" if handle.turns else "m"
    return {
        "number": number,
        "kind": scene.kind,
        "title": TITLES[scene.kind],
        "task": task,
        "handles": [{"name": handle.name, "unit": unit, "at": at, "firm": handle.firm, "move": move}],
        "furniture": [
            {"fixed": {"pose": handle.pose.ravel().tolist(), "boxes": handle.fixed}, "moving": {"boxes": handle.moving}}
        ],
        "notes": list(scene.notes),
    }


def truth_content(scene: TeachingScene, constraint: Constraint | None) -> dict[str, Any]:
    """Return what the physics have, and how far off the learnt mechanism is."""
    handle, known, errors = scene.handle, None if constraint is None else constraint.mechanism, []
    if known is not None and known.axis is not None:
        axis = np.asarray(known.axis)
        errors.append(["axis", f"{np.degrees(np.arccos(min(1.0, abs(float(axis @ handle.axis))))):.2g} degrees off"])
        if known.point is not None and handle.turns:
            gap = float(np.linalg.norm(np.cross(handle.axis, np.asarray(known.point) - handle.point)))
            errors.append(["place", f"{1e3 * gap:.2g} mm off"])
        if known.type != handle.type:
            errors.append(["kind", f"taken for a {known.type}, is a {handle.type}"])
    axis, place = ("({:.3f}, {:.3f}, {:.3f})".format(*(x + 0.0)) for x in (handle.axis, handle.point))
    moves = {"line": "slides along", "plane": "stays across the normal", "hinge": f"turns, through {place}, about"}
    how = f"{'firmly' if handle.firm else 'loosely'} held, with {1e3 * handle.play:.1f} mm of play"
    ends = np.array([handle.point - 0.4 * handle.axis, handle.point + 0.4 * handle.axis])
    return {
        "sentence": f"In truth: the {handle.name} {moves[handle.type]} {axis}, {how}.",
        "errors": errors,
        "lines": [] if handle.type == "plane" else [to_base64(ends, "<f4")],
    }


def refusal_content(why: str, recordings: int) -> dict[str, Any]:
    """What the page says where nothing was learnt, and what to do next.

    Args:
        why: The learner's reason.
        recordings: How many there were.
    """
    few = recordings < ENOUGH
    return {
        "sentence": "This was not understood." if few else "Nothing holds the hand, as far as can be seen.",
        "line": "",
        "refused": True,
        "evidence": why,
        **dict.fromkeys(("facts", "rows", "warnings", "odd", "phaseKinds"), []),
        "mechanism": None,
        "next": f"Show it {counted(ENOUGH - recordings, 'time')} more, each time a little differently."
        if few
        else "Nothing that you showed holds the hand firmly. Take hold of something, move it as far as it goes and "
        "back, and begin each time from another posture.",
        "offer": RECORD,
    }


def answer_content(content: Mapping[str, Any]) -> dict[str, Any]:
    """What the page says of what the worker learnt, and what to do next."""
    uncertain, answer = content["uncertainty"], content["answer"]
    known = uncertain is not None and uncertain <= 1.0  # [degrees], which are 9 mm at 0.5 m
    sure = known and not answer["warnings"]
    told = "" if uncertain is None else f"; known to {uncertain:.2g}°"
    kind, further = LINES.get((answer["mechanism"] or {}).get("type", "")), "Show it once more, from another posture, "
    then = "let the arm do it." if sure else "read the warnings before you let the arm do it."
    return answer | {
        "line": answer["sentence"] if kind is None else f"{kind}{told}.",
        "next": f"It is known well enough: {then}" if known else f"{further}until it is known to 1 degree.",
        "offer": None if sure else RECORD,
    }
