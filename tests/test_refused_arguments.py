"""Arguments in Python that cannot be meant, of `data/refused_arguments.txt`: refused at once, with what was wrong."""

from __future__ import annotations

import builtins
import json
from collections.abc import Callable
from functools import partial

import numpy as np
import pytest
from case import rows_in

import manip_learn as ml
from manip_learn import errors
from manip_learn.constraint.features.mechanism_rows import PlaceRows

TCP, READY = "panda_hand_tcp", [0.0, -0.3, 0.0, -2.0, 0.0, 1.8, 0.7]


@pytest.fixture(scope="module")
def calls(robot_of) -> dict[str, Callable[..., object]]:
    """What can be called, by its name in the table, with all arguments but the wrong ones."""
    planar, sawyer, panda = (robot_of(name) for name in ("planar3", "sawyer", "panda"))
    tip, hand, mass = ml.FrameJacobian(planar, "tip", "planar"), ml.FrameJacobian(panda, TCP), ml.CentreOfMass(panda)
    two, line = ml.Constraint(np.eye(3)[:2], tip), ml.Constraint(np.eye(3)[1:], hand)
    law = ml.ResolvedRateController(two, ml.PointAttractor([1.0, 1.0]))
    rail = ml.Constraint(np.eye(2, 3), ml.CurveRows(panda, TCP, np.eye(4, 3)))
    way = ml.Skill((line,), (ml.Step("way", line),))

    def along_rows(rows: str, selection: object = None, direction: object = None) -> object:
        features = (ml.FrameJacobian if rows[0] == "x" else ml.MechanismRows)(panda, TCP, rows)
        held = ml.Constraint(np.eye(features.n_rows) if selection is None else selection, features)
        return ml.FreeDirection(held, 1, 1, direction=direction)

    assert along_rows("radial axial", [[1.0, 0.0]], "axial")  # what is not selected is free
    return {
        "ServoLoop": partial(ml.ServoLoop, law),
        "ServoLoop with Contact": lambda **settings: ml.ServoLoop(law, contact=ml.Contact(**settings)),
        "Contact": ml.Contact,
        "payload": lambda mass, place=(0.0, 0.0, 0.05): sawyer.with_payload(mass, "right_hand", place),
        "Limits": partial(ml.Limits, sawyer),
        "Limits above a floor": partial(ml.Limits, sawyer, clear_of=ml.Scene(floor=-1.0)),
        "ConstraintLearner": lambda **settings: ml.ConstraintLearner(**({"features": tip} | settings)),
        "ResolvedRateController": partial(ml.ResolvedRateController, two),
        "call of a controller": lambda q=(1.0, 1.0, 1.0), dt=None: law(q, 0.0, dt),
        "simulate": lambda q0=(1.0, 1.0, 1.0), **settings: ml.simulate(planar, law, q0, **settings),
        "repeat": partial(ml.repeat, way, READY),
        "FreeDirection": lambda **settings: ml.FreeDirection(line, **({"distance": 0.1, "speed": 0.1} | settings)),
        "FreeDirection of rows": along_rows,
        "PointAttractor": ml.PointAttractor,
        "JointAttractor": ml.JointAttractor,
        "ManipulabilityAscent": partial(ml.ManipulabilityAscent, two),
        "WeightedPolicies of one": partial(ml.WeightedPolicies, [ml.ZeroPolicy(3)]),
        "FrameJacobian": lambda frame=TCP, **settings: ml.FrameJacobian(panda, frame, **settings),
        "CentreOfMass": partial(ml.CentreOfMass, panda),
        "RelativeFrameJacobian": partial(ml.RelativeFrameJacobian, sawyer, "right_hand"),
        "MechanismRows": partial(ml.MechanismRows, panda, TCP),
        "PlaceRows": partial(PlaceRows, panda, TCP),
        "CurveRows": partial(ml.CurveRows, panda, TCP),
        "motion on a curve": partial(ml.motion, rail),
        "target of a hand": lambda target: hand.error_to(target, np.zeros(7)),
        "target of the centre of mass": lambda target: mass.error_to(target, np.zeros(7)),
        "Constraint": lambda selection: ml.Constraint(selection, tip),
    }


@pytest.mark.parametrize(("what", "arguments", "error", "words"), rows_in("refused_arguments.txt"))
def test_what_cannot_be_meant_is_refused(what, arguments, error, words, calls):
    """With an error that names the argument and what was given, or what would fit; at the edge it is not (-)."""
    if error == "-":
        assert calls[what](**json.loads(arguments)) is not None
        return
    with pytest.raises(getattr(errors, error, None) or getattr(builtins, error), match=words):
        calls[what](**json.loads(arguments))
