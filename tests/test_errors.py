"""Errors carry facts, travel between processes, and their sentences help."""

from __future__ import annotations

import ast
import inspect
import pickle
import re
from pathlib import Path

import pytest
from library_source import library, listed

from manip_learn import errors
from manip_learn.errors import (
    ManipLearnError,
    MissingExtraError,
    NotIdentifiableError,
    NumberOfConstraintsError,
    RecordingError,
    RobotError,
    UnknownNameError,
    closest_names,
)

ALL = [c for _, c in inspect.getmembers(errors, inspect.isclass) if c.__module__ == errors.__name__]
EXAMPLES = [
    RobotError("no", code="not-xml", path=Path("a.urdf"), line=3),
    UnknownNameError("frame", "panda_hnd", ["panda_hand", "panda_link1"], "robot 'panda'"),
    RecordingError("no", code="missing-joint", path=Path("a.csv"), line=7, column="j1"),
    NotIdentifiableError("no", code="weak-gap"),
    MissingExtraError("reading ROS bags", "ros"),
    NumberOfConstraintsError(7, 3, "FrameJacobian(...)"),
    *(c("a sentence") for c in ALL if c not in (UnknownNameError, MissingExtraError, NumberOfConstraintsError)),
]


@pytest.mark.parametrize("error_class", ALL, ids=lambda c: c.__name__)
def test_one_base(error_class):
    """Every error is a ManipLearnError, so that one except clause is enough, and its name says that it is one."""
    assert issubclass(error_class, ManipLearnError)
    assert error_class.__name__.endswith("Error")


@pytest.mark.parametrize("error", EXAMPLES, ids=lambda e: type(e).__name__)
def test_errors_travel(error):
    """Pickling (workers, dask) keeps type, sentence and facts."""
    copy = pickle.loads(pickle.dumps(error))
    assert type(copy) is type(error)
    assert str(copy) == str(error)
    assert vars(copy) == vars(error)


def test_unknown_name_offers_near_ones():
    """The near matches stand in the sentence and in the attribute; the place is named."""
    error = UnknownNameError("frame", "panda_hnd", ["panda_hand", "panda_link1", "other"], "robot 'panda'")
    assert error.near[0] == "panda_hand"
    assert str(error).startswith("unknown frame 'panda_hnd' in robot 'panda': did you mean 'panda_hand'")


def test_unknown_name_without_near_ones_lists_what_there_is():
    """Nothing near: at most twelve names are listed and the others counted; nothing at all is said to be nothing."""
    error = UnknownNameError("joint", "zzz", [f"joint{i}" for i in range(20)])
    assert "and 8 more" in str(error)
    assert error.near == ()
    assert "there are no joints" in str(UnknownNameError("joint", "a", []))


def test_closest_names():
    """Similar names come first, then those that contain the word; upper case does not matter there."""
    known = ["right_hand", "right_gripper_tip", "left_hand"]
    assert closest_names("right_hnd", known)[0] == "right_hand"
    assert "right_gripper_tip" in closest_names("TIP", known)
    assert closest_names("", known) == []


def test_missing_extra_says_how_to_get_it():
    """The command that installs the extra stands in the sentence."""
    error = MissingExtraError("reading ROS bags", "ros")
    assert error.extra == "ros"
    assert "pip install 'manip_learn[ros]'" in str(error)


def said(node: ast.expr) -> str:
    """The text of a message, with a letter for what is filled in."""
    match node:
        case ast.Constant(value=str(text)):
            return text
        case ast.JoinedStr(values=parts):
            return "".join(map(said, parts))
        case ast.BinOp(left=left, right=right):
            return said(left) + said(right)
        case ast.IfExp(body=body):
            return said(body)
        case ast.Call(args=arguments, func=ast.Name(id="advice" | "spoken")):
            return said(arguments[0])
    return "x"


def test_messages_are_short_and_inflected():
    """A refusal has at most two sentences, and nothing says "row(s)": numbers come with the noun that fits them."""
    faults = []
    for source in library():
        for node in ast.walk(source.tree):
            if isinstance(node, ast.Raise) and isinstance(node.exc, ast.Call):
                texts = list(map(said, node.exc.args))
                if any(len(re.split(r"[.?!] (?=[A-Z])", text)) > 2 for text in texts):
                    faults.append(f"{source.relative}:{node.lineno} has more than two sentences")
            if isinstance(node, ast.Constant) and re.search(r"[a-z]\((s|es|ies)\)", str(node.value)):
                faults.append(f"{source.relative}:{node.lineno} leaves the number open: {str(node.value)[:60]!r}")
    assert not faults, listed(faults)


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (errors.counted(1, "trajectory"), "1 trajectory"),
        (errors.counted(1200, "trajectory"), "1,200 trajectories"),
        (errors.counted(0, "stretch"), "0 stretches"),
        (errors.counted(2, "day"), "2 days"),
        (errors.named("joint", ["a"]), "joint a"),
        (errors.named("joint", iter("abc")), "joints a, b and c"),
        (errors.error_in_words(8.4e-4, "degrees"), "0.0008 degrees"),
        (errors.error_in_words(7.43, "mm"), "7.4 mm"),
        (errors.error_in_words(3e-6, "degrees"), "better than 0.0001 degrees"),
    ],
)
def test_numbers_come_with_their_noun(words, expected):
    """One thing is one, several are several, and an error has as many digits as one says aloud."""
    assert words == expected
