"""Content of the teaching page: pictures of the arm, its surroundings and the constraint, and texts."""

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

RECORD = {"say": "Record another one", "said": {"do": "record"}}  # label of a button, and its message

# type of a mechanism -> the answer in one line
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
_REPLAY_ONLY = ("shown.js", "legend.js", "live.js", "main.js")  # files of the replay's program
TEACH = replace(
    REPLAY,
    mode="teach",
    style=(*REPLAY.style, _FOLDER / "teach.css"),
    program=(
        *(file for file in REPLAY.program if file.name not in _REPLAY_ONLY),
        *(_FOLDER / f"{name}.js" for name in _PARTS.split()),
    ),
    markup=(_FOLDER / "teach.html",),
)


def teaching_page(robot: Robot, name: str, token: str) -> str:
    """Return the HTML of the page for `manip-learn teach`, self-contained; it connects only to its own server.

    Args:
        robot: The robot. The server sends its poses, furniture and recordings later, as events.
        name: Headline of the page.
        token: Secret token in the address of the page.

    Raises:
        OutputError: The viewer of Meshcat is not installed.
    """
    return live_page(robot, name, token, TEACH)


@final
class TeachingPicture:
    """Pictures of one arm for the teaching page.

    Args:
        robot: The arm.
        tip: Name of the guided frame.
    """

    def __init__(self, robot: Robot, tip: str):
        self._robot, self._tip = robot, tip
        rng = np.random.default_rng(0)
        # number of directions in which the tip can move, over 20 random postures: two for a planar arm
        postures = (robot.random_configuration(rng) for _ in range(20))
        self._rank = int(np.linalg.matrix_rank(np.hstack([robot.jacobian(q, tip)[:3] for q in postures]), tol=1e-9))

    def pose(self, arm: TeachingArm, constraint: Constraint | None, rows: Constraint | None) -> dict[str, Any]:
        """Return one picture as data for JSON: vectors in the base frame, in SI units.

        Args:
            arm: The arm in its present state.
            constraint: The learnt constraint; None before learning.
            rows: Constraint whose manipulability is shown; None for the translation of the tip.
        """
        robot, hand, q = self._robot, arm.hand, arm.q
        U, sizes, _ = np.linalg.svd(robot.jacobian(q, self._tip)[:3], full_matrices=False)
        last = min(self._rank, len(sizes)) - 1
        # smallest over largest singular value of the tip's translation: below 0.2 the weak direction is drawn
        share = float(sizes[last] / max(sizes[0], 1e-12))
        grasp = hand.pull and {
            "at": hand.at.tolist(),
            "to": hand.pull.to.tolist(),
            "force": float(np.linalg.norm(hand.force)),
            "limited": bool(hand.limited),
        }
        touches = [at.pos.tolist() for at in arm.data.contact[: arm.data.ncon] if at.dist < 0.0]
        # [rad or m] distance of each joint to its limits; below 0.01 a joint counts as at its limit
        gaps = np.minimum(q - robot.position_lower, robot.position_upper - q)
        return {
            "time": arm.time,
            "values": joint_tracks(robot, q[None])[0].tolist(),
            "furniture": [[*arm.handle_place.tolist(), *arm.data.body("handle").xquat.tolist()]],  # real part first
            "held": [arm.held],
            "near": 0 if arm.is_near else None,
            "hand": grasp,
            "weak": {"direction": U[:, last].tolist(), "share": share} if share < 0.2 else None,
            "mu": float(np.prod(sizes[: last + 1])) if rows is None else float(manipulability(rows, q)),
            "marks": None if constraint is None else self._marks(constraint, q, arm.place),
            "limit": [name for name, gap in zip(robot.joint_names, gaps, strict=True) if gap < 0.01],
            "opening": [arm.opening],
            "touches": touches[:3],  # an edge has a dozen contacts
        }

    def _marks(self, constraint: Constraint, q: np.ndarray, place: np.ndarray) -> dict[str, Any] | None:
        """Return the held and free directions at the tip; None if unknown."""
        marks = held_directions(constraint, place[None])
        if marks is None:
            return None
        axes = np.eye(3) if marks.axes is None else self._robot.pose(q, marks.axes)[:3, :3]
        parts = {"held": marks.held, "free": marks.free, "fixed": marks.held_turns, "turns": marks.free_turns}
        return {name: (_directions(part) @ axes.T).tolist() for name, part in parts.items()}


def _directions(projector: Float[np.ndarray, "..."]) -> Float[np.ndarray, "k 3"]:
    """Return orthonormal rows that span the range of a projector."""
    values, vectors = np.linalg.eigh(np.asarray(projector).reshape(-1, 3, 3)[0])
    return vectors[:, values > 0.5].T


def scene_content(scene: TeachingScene, number: int) -> dict[str, Any]:
    """Return the furniture and its texts for the page, as data for JSON.

    Args:
        scene: The scene.
        number: Number of the scene in this session.
    """
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
    """Return the true mechanism of the simulation, and the errors of the learnt one, as data for JSON.

    Args:
        scene: The scene.
        constraint: The learnt constraint; None before learning.
    """
    handle, mechanism, errors = scene.handle, None if constraint is None else constraint.mechanism, []
    if mechanism is not None and mechanism.axis is not None:
        axis = np.asarray(mechanism.axis)
        errors.append(["axis", f"{np.degrees(np.arccos(min(1.0, abs(float(axis @ handle.axis))))):.2g} degrees off"])
        if mechanism.point is not None and handle.turns:
            gap = float(np.linalg.norm(np.cross(handle.axis, np.asarray(mechanism.point) - handle.point)))
            errors.append(["place", f"{1e3 * gap:.2g} mm off"])
        if mechanism.type != handle.type:
            errors.append(["kind", f"learnt as a {mechanism.type}, is a {handle.type}"])
    axis, place = ("({:.3f}, {:.3f}, {:.3f})".format(*(x + 0.0)) for x in (handle.axis, handle.point))
    moves = {"line": "slides along", "plane": "stays across the normal", "hinge": f"turns, through {place}, about"}
    how = f"{'firmly' if handle.firm else 'loosely'} grasped, with {1e3 * handle.play:.1f} mm of play"
    ends = np.array([handle.point - 0.4 * handle.axis, handle.point + 0.4 * handle.axis])
    return {
        "sentence": f"True mechanism: the {handle.name} {moves[handle.type]} {axis}, {how}.",
        "errors": errors,
        "lines": [] if handle.type == "plane" else [to_base64(ends, "<f4")],
    }


def refusal_content(why: str, recordings: int) -> dict[str, Any]:
    """Return the texts of the page after learning failed, with the next step, as data for JSON.

    Args:
        why: Message of the learner's error.
        recordings: Number of recordings.
    """
    enough = 5  # number of recordings that the page asks for
    few = recordings < enough
    return {
        "sentence": "No constraint was found." if few else "The recordings show no constraint on the hand.",
        "line": "",
        "refused": True,
        "evidence": why,
        **dict.fromkeys(("facts", "rows", "warnings", "odd", "phaseKinds"), []),
        "mechanism": None,
        "next": f"Demonstrate it {counted(enough - recordings, 'time')} more, each time a little differently."
        if few
        else "Nothing in the demonstrations constrains the hand. Grasp something, move it through its whole range and "
        "back, and begin each time from another posture.",
        "offer": RECORD,
    }


def answer_content(content: Mapping[str, Any]) -> dict[str, Any]:
    """Return the texts of the page about a learnt constraint, with the next step, as data for JSON.

    Args:
        content: Result of `worker.learn`.
    """
    uncertain, answer = content["uncertainty"], content["answer"]
    precise = uncertain is not None and uncertain <= 1.0  # [degrees]: 9 mm at 0.5 m
    sure = precise and not answer["warnings"]
    accuracy = "" if uncertain is None else f"; known to {uncertain:.2g}°"
    kind, further = LINES.get((answer["mechanism"] or {}).get("type", "")), "Show it once more, from another posture, "
    then = "let the arm do it." if sure else "read the warnings before you let the arm do it."
    return answer | {
        "line": answer["sentence"] if kind is None else f"{kind}{accuracy}.",
        "next": f"It is known well enough: {then}" if precise else f"{further}until it is known to 1 degree.",
        "offer": None if sure else RECORD,
    }
