"""Learn which directions a demonstrated task constrains, and keep the arm away from its singularities.

URDF + demonstrations -> Lambda -> controller -> replay. Method: J. Manavalan and M. Howard, "Learning Singularity
Avoidance".
"""

from __future__ import annotations

from typing import Any

import lazy_loader

# names are loaded at first use to keep `import manip_learn` and `manip-learn --help` quick; __init__.pyi lists them
_load, _, __all__ = lazy_loader.attach_stub(__name__, __file__)
# removed names and their replacements: names of 0.1 stay here until 0.3, names of 0.2 until 0.4
_REMOVED = {
    "following_error_limit": "give ServoLoop contact=Contact(stiffness=...): forces on the hand stop the arm",
    "GraspCone": "leave it out: a loose grip turns freely, a firm one keeps the demonstrated orientation",
    "SelfCollisionAvoidance": "Limits(robot, clear_of=SelfCollision(robot)) keeps the links apart",
    "PenalisedManipulabilityAscent": "task.ascent() moves away from singularities of the task and from joint limits",
    **dict.fromkeys(
        ("penalised_manipulability", "penalised_manipulability_gradient", "log_penalised_manipulability_gradient"),
        "use manipulability(constraint, q) for singularities, robot.position_lower and position_upper for the limits",
    ),
    "resample": "time stamps may be uneven: leave the call out, or interpolate with numpy.interp",
    "trim_standstill": "cut a trajectory by time, demo[2.0:5.5]; the learner itself drops samples at rest",
    "CompiledController": "controllers are no longer compiled: use the ResolvedRateController itself",
    "warm_up": "controllers are no longer compiled: leave the call out",
    "PlacoTask": "pass the rows A(q), b and pi to PlaCo: A(q + dq) = A q + dt b as two joint-space half-spaces",
    "iter_demonstrations": "RecordingSource(paths, robot).part(i) reads one part, load_demonstrations reads all",
    **dict.fromkeys(
        ("find_mechanism", "MechanismFit"),
        "ConstraintLearner(features).fit(demos).report_.mechanism has the mechanism with its uncertainty",
    ),
    "optimise_path": "ml.plan chooses the posture and the motion for the whole task; ManipulabilityAscent acts locally",
}


def __getattr__(name: str) -> Any:
    if name in _REMOVED:
        raise AttributeError(f"{name} has been removed from manip_learn: {_REMOVED[name]}")
    if name == "__version__":
        from importlib.metadata import version  # this import takes as long as all others together

        return version("manip_learn")
    return _load(name)


def __dir__() -> list[str]:
    return sorted([*__all__, "__version__"])
