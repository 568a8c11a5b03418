"""Learn which directions a demonstrated task constrains, and keep the arm away from its singularities.

URDF + demonstrations -> Lambda -> controller -> replay. Method: J. Manavalan and M. Howard, "Learning Singularity
Avoidance".
"""

from __future__ import annotations

from typing import Any

import lazy_loader

# names are loaded at first use, so that `import manip_learn` and `manip-learn --help` are quick: __init__.pyi has them
_load, _, __all__ = lazy_loader.attach_stub(__name__, __file__)
# names that are gone, and what to use instead: of 0.1 until 0.3, of 0.2 until 0.4
_REMOVED = {
    "following_error_limit": "give ServoLoop contact=Contact(stiffness=...): forces on the hand stop the arm",
    "GraspCone": "leave it out: a loose grip turns freely, a firm one is held as it was shown",
    "SelfCollisionAvoidance": "Limits(robot, clear_of=SelfCollision(robot)) keeps the links apart",
    "PenalisedManipulabilityAscent": "task.ascent() climbs the room that is left, of joint ranges too",
    **dict.fromkeys(
        ("penalised_manipulability", "penalised_manipulability_gradient", "log_penalised_manipulability_gradient"),
        "manipulability(constraint, q) says how near a singularity is, robot.position_lower and _upper the limits",
    ),
    "resample": "time stamps need not be even: leave the call out, or interpolate with numpy.interp",
    "trim_standstill": "cut a trajectory by time, demo[2.0:5.5]; the learner itself leaves out what rests",
    "CompiledController": "nothing is compiled any more: use the ResolvedRateController itself",
    "warm_up": "nothing is compiled any more: leave the call out",
    "PlacoTask": "hand PlaCo the rows A(q), b and pi yourself: A(q + dq) = A q + dt b as two joint-space half-spaces",
    "iter_demonstrations": "RecordingSource(paths, robot).part(i) reads part by part, load_demonstrations all at once",
    **dict.fromkeys(
        ("find_mechanism", "MechanismFit"),
        "ConstraintLearner(features).fit(demos).report_.mechanism has the mechanism with its uncertainty",
    ),
    "optimise_path": "ml.plan chooses posture and motion of a whole way; ManipulabilityAscent climbs on the spot",
}


def __getattr__(name: str) -> Any:
    if name in _REMOVED:
        raise AttributeError(f"{name} has been removed from manip_learn: {_REMOVED[name]}")
    if name == "__version__":
        from importlib.metadata import version  # takes as long to import as all else here

        return version("manip_learn")
    return _load(name)


def __dir__() -> list[str]:
    return sorted([*__all__, "__version__"])
