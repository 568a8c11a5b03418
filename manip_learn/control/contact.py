"""Following error: the distance of the measured from the commanded posture, and the detection of contacts by it."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal, final

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from manip_learn.constraint.constraint import Constraint
from manip_learn.constraint.features.feature_map import sum_in_words
from manip_learn.control.command import Posture, Vector
from manip_learn.control.limits import per_joint
from manip_learn.control.servos import HIDDEN, MAX_LATENCY, ROUNDING, STILL, Servos, shallow_copy, signed_excess
from manip_learn.control.timing import is_number
from manip_learn.errors import ConfigurationError, counted, under_new_names
from manip_learn.robot.robot import Robot
from manip_learn.robot.tips import default_tip

STIFFNESS = 2000.0  # [N m/rad or N/m] of a stiff position servo of an arm that works near people
GRAVITY = 9.81  # [m/s2]
LEFT = 3.0  # [N] largest remaining force on the hand of an arm that has relaxed
# [rad or m] unexplained error of a servo after friction, backlash and noise were measured: 0.5 N m at 2,000 N m/rad
RESOLUTION = 2.5e-4
LOOK_BACK = 0.01  # [s] over which the rise of a force is measured, and by which it is extrapolated at least
# [s] of motion after which a hand counts as moving, and memory of that motion: stick-slip alternates faster
MOTION_ONSET, MOTION_MEMORY = 0.1, 0.5
_FORMER = {"held": "max_lateral_force", "driven": "max_axial_force"}  # former names of arguments, valid until 0.4


@final
@dataclass(frozen=True, init=False)
class Contact:
    """Settings for the forces on the hand, which a `ServoLoop` derives from the arm's following error.

    A force on the hand deflects the position servos. The loop estimates the force that explains the deflections best,
    and stops the arm if it is too large. Along the *held* rows of the constraint no force is expected; along the
    *driven* rows the force is part of the task, e.g. to open a drawer that sticks.

    Deflections without a force are measured in the first half second in which the arm moves, and reported in
    `ServoLoop.notes`: the latency of the arm, the noise of its encoders, and the friction and the backlash of its
    joints.

    Args:
        max_lateral_force: Largest force on the hand across the driven rows [N]. A fifth of the force along the driven
            rows is tolerated in addition, for errors of the directions and the joints. The default is a tenth of the
            force with which ISO/TS 15066 lets a robot press a hand, because the force keeps rising while the arm
            brakes.
        max_axial_force: Largest force on the hand along the rows that the task drives (`Task.driven_rows`) [N]; "auto"
            takes 1.5 times the force in the demonstrations, if efforts were recorded (`Shown.force`), but at least
            `max_lateral_force`, and 60 N otherwise. A hand that was moving and stops counts as blocked as soon as the
            force has risen by `max_lateral_force`, if its joints moved by more than 2.5e-4 rad in 10 ms (about 20 mm/s
            at the hand); a slower one is stopped at `max_axial_force`.
        latency: Longest delay of the arm [s]; "auto" measures it, up to 0.2 s.
        resolution: Force that cannot be distinguished from friction, backlash and noise [N]; "auto" measures it. The
            arm is stopped at no smaller force.
        stiffness: Stiffness of the arm's position servos, shape (nv,) or a number [N m/rad or N/m]. None if it is not
            known: 2,000 is then assumed, so that the limits are in effect position errors, and `ServoLoop.notes`
            reports that.
        **renamed: Former names of arguments, valid until 0.4: `held`, `driven`.

    Raises:
        ConfigurationError: A force is not positive, the latency or the resolution is negative, or one of them is not a
            finite number. `ServoLoop` checks the stiffness.
        TypeError: An unknown argument.
    """

    max_lateral_force: float
    max_axial_force: float | Literal["auto"]
    latency: float | Literal["auto"]
    resolution: float | Literal["auto"]
    stiffness: ArrayLike | None

    def __init__(
        self,
        max_lateral_force: float = 15.0,
        max_axial_force: float | Literal["auto"] = "auto",
        latency: float | Literal["auto"] = "auto",
        resolution: float | Literal["auto"] = "auto",
        stiffness: ArrayLike | None = None,
        **renamed: Any,
    ):
        values = {"max_lateral_force": max_lateral_force, "max_axial_force": max_axial_force, "latency": latency}
        values |= {"resolution": resolution, "stiffness": stiffness, **under_new_names("Contact()", _FORMER, renamed)}
        vars(self).update(values)
        units = ("newtons", 'newtons or "auto"', 'seconds or "auto"', 'newtons or "auto"')
        for (name, value), unit in zip(values.items(), units, strict=False):  # a stiffness needs a robot to be checked
            is_auto = isinstance(value, str) and value == "auto" and "auto" in unit
            is_size = is_number(value) and 0.0 <= float(value) < math.inf
            zero = "0 or " * (name in ("latency", "resolution"))
            if not (is_auto or (is_size and (value or zero))):
                raise ConfigurationError(f"{name} must be {zero}a positive number of {unit}, got {value!r}")

    @property
    def held(self) -> float:
        """Former name of `max_lateral_force`, valid until 0.4."""
        return self.max_lateral_force

    @property
    def driven(self) -> float | Literal["auto"]:
        """Former name of `max_axial_force`, valid until 0.4."""
        return self.max_axial_force


_CREEP_SHARE = 0.15  # share of the commanded speed below which an arm may be at rest
Directions = Callable[[Posture], Float[np.ndarray, "k nv"]]


@final
class FollowingError:
    """Distance between the commanded and the measured posture, and the force on the hand that explains it.

    Delay, friction and backlash of the servos (`Servos`), the inertia of the links, and a weight of up to 2 kg explain
    parts of the distance; these are not contact forces. The estimated force f is the one that explains the remaining
    distance e best,

        f = (C C^T + (RESOLUTION / F)^2)^-1 C e,    C = J(q) / stiffness,    F = max_lateral_force

    Its limits are `max_axial_force` along the driven rows and `max_lateral_force` across them. A contact elsewhere on
    the arm leaves distances that no force on the hand explains: the arm also stops if they load a joint as much as
    `max_lateral_force` would at the arm's longest lever.

    Args:
        robot: The robot.
        contact: Limits of the forces.
        dt: Period [s].
        acceleration: Accelerations with which the arm brakes, shape (nv,) [rad/s2 or m/s2].
        frame: Name of the tip's frame; None for the robot's likeliest tip.

    Attributes:
        limit: shape (nv,), deflection of each joint under `max_lateral_force` at the longest lever [rad or m].
        distance: shape (nv,), measured minus commanded joint positions [rad or m].
        force: shape (3,), estimated force on the hand, in the base frame [N].
        tripped: Reason for which the arm must be stopped, in words; empty if there is none.
        load: shape (nv,), deflection due to a weight, without a contact [rad or m].
        sinks: True if the force that stopped the arm points down, as a weight does.
        servos: Measured properties of the servos.
        notes: Sentences on the measured properties of the servos.
        resolution: Force that cannot be distinguished from friction, backlash and noise [N].

    Raises:
        ConfigurationError: A stiffness that is not positive or has the wrong size.
    """

    def __init__(self, robot: Robot, contact: Contact, dt: float, acceleration: Vector, frame: str | None = None):
        # settings, which do not change
        self.contact, self._robot, self._dt, self._acceleration = contact, robot, dt, acceleration
        # limit of the axial force, 60 N by default; largest weight that the drives need not know of [N]
        self._axial_limit = 60.0 if isinstance(contact.max_axial_force, str) else float(contact.max_axial_force)
        self._max_weight = GRAVITY * max(2.0, robot.payload)
        stiffness = STIFFNESS if contact.stiffness is None else contact.stiffness
        self._stiffness = per_joint("stiffness", stiffness, robot.joint_names)
        # if the stiffness is unknown, softer servos may deflect more under inertia: ten times at 200 N m/rad
        self._inertial = self._stiffness if contact.stiffness is not None else 0.1 * self._stiffness
        self._frame, rng = robot.frame(frame or default_tip(robot)), np.random.default_rng(0)
        # the longest lever of the tip on any joint [m]; at least 1 where a joint is prismatic
        rows = [robot.jacobian(robot.random_configuration(rng), self._frame)[:3] for _ in range(200)]
        lateral = contact.max_lateral_force
        self.limit = lateral * float(np.linalg.norm(rows, axis=1).max()) / self._stiffness
        self._damping = (RESOLUTION / lateral) ** 2 * np.eye(3)
        latency = MAX_LATENCY if isinstance(contact.latency, str) else float(contact.latency)
        # the state, whose parts are replaced, never changed in place
        zero = np.zeros(robot.nv)
        self.servos, self.notes = Servos(dt, latency, HIDDEN / self._stiffness), tuple[str, ...]()
        self.resolution = 0.0 if isinstance(contact.resolution, str) else float(contact.resolution)
        if contact.stiffness is None:
            joint = int(np.argmax(self.limit))
            self.notes = (
                "the stiffness of the servos is unknown, so the limits are position errors: the arm stops at the "
                f"latest if joint {robot.joint_names[joint]} is {1e3 * self.limit[joint]:.2g} mrad off. On servos of "
                f"{STIFFNESS:g} N m/rad that is {lateral:g} N, on stiffer ones more: set Contact(stiffness=...)",
            )
        self.distance, self.load, self.force, self.tripped, self.sinks = zero, zero, np.zeros(3), "", False
        # excess and distance of this period, and of the previous periods, newest first
        self._now, self._history = (zero, zero), tuple[tuple[np.ndarray, np.ndarray], ...]()
        # velocity; its change, and the time, since inertia was last evaluated; recent range of deflections by inertia
        self._velocity, self._change, self._elapsed, self._inertial_range = zero, zero, 0.0, (zero, zero)
        # deflection of the joints by the force on the hand [rad or m], and the weight that it seems to carry [N]; time
        # for which it has been moving [s], and the force of that motion [N]
        self._deflection, self._weight, self._motion_time, self._moving_force = zero, 0.0, 0.0, 0.0

    def copy(self) -> FollowingError:
        """Return a copy; changes of the copy do not affect the original."""
        other = shallow_copy(self)
        other.servos = shallow_copy(self.servos)
        return other

    def record_step(self, q: Posture, time: float, velocity: Vector) -> None:
        """Record a step of the commanded posture.

        Args:
            q: Commanded configuration (nq,) or joint positions (nv,) before the step [rad or m].
            time: Duration of the step [s]; negative if a call came early and takes back a part of the previous step.
            velocity: Commanded velocity (nv,) [rad/s or m/s].
        """
        over = self.servos.record_step(time * velocity, time)
        if over:
            self._history = (self._now, *self._history[: math.ceil(LOOK_BACK / self._dt) - 1])
        self._change, self._velocity = self._change + (velocity - self._velocity), velocity
        self._elapsed += max(time, 0.0)
        if over and time > 0.0 and self.servos.is_slow_period:
            # a servo reacts to M a as a spring and a damper: the deflection decays for a while after its largest value
            now = -self._robot.inertial_effort(q, self._change / self._elapsed) / self._inertial
            # 0.1 s are three times sqrt(2 kg m2 / 2,000 N m/rad)
            decay, (low, high) = math.exp(-self._elapsed / 0.1), self._inertial_range
            self._inertial_range = np.minimum(decay * low, now), np.maximum(decay * high, now)
            self._change, self._elapsed = np.zeros_like(velocity), 0.0

    @property
    def largest(self) -> float:
        """Largest joint distance in the newest comparison [rad or m], after subtraction of the servos' delay."""
        return float(np.abs(self.servos.raw).max(initial=0.0))

    def relief(self) -> Vector:
        """Return the change of the commanded posture after which the servos no longer press, shape (nv,) [rad or m].

        The change leads to the measured posture, without the deflection by the load (a weight does not press on the
        contact), and further in the direction of the force, by the deflection that friction would keep.
        """
        by_friction = self.servos.friction * self._deflection / (np.abs(self._deflection) + RESOLUTION)
        return self.distance - self.load + by_friction

    def largest_relaxation(self) -> Vector:
        """Return the largest relaxation that the measurement supports, shape (nv,) [rad or m].

        Because a measurement may be wrong, the commanded posture may change by at most this: the deflection under the
        largest allowed force, plus friction and backlash, plus the commanded motion within the delay.
        """
        largest = max(1.0, self._axial_limit / self.contact.max_lateral_force) * self.limit
        return largest + self.servos.recent_travel + self.servos.width

    def remaining_force(self, q: Posture) -> float:
        """Return the force on the hand that remains at a measured posture, without the part due to friction [N].

        Args:
            q: Measured configuration (nq,) or joint positions (nv,) [rad or m].
        """
        friction = self.servos.friction
        off = signed_excess(self.distance - self.load, -friction, friction)
        return float(np.linalg.norm(self._split_weight(off, self._compliance(q))[0]))

    def accept_weight(self, off: Vector, q: Posture) -> str:
        """Store the joints' distances in `load` if a weight explains them; update `sinks`.

        Args:
            off: Distances of the joints from the commanded posture (nv,) [rad or m].
            q: Measured configuration (nq,) or joint positions (nv,) [rad or m].

        Returns:
            Sentence that suggests to declare a payload, if the weight is larger than the 2 kg that need no setting;
            otherwise empty.
        """
        f = self._estimate_force(off, self._compliance(q))
        forces = np.array([f, self.force if self.force.any() else f])  # now, and at the time of the stop
        # a force counts as a weight if at least 80 % of it points down
        weighs, self.sinks = (-forces[:, 2] > np.maximum(LEFT, 0.8 * np.linalg.norm(forces, axis=1))).tolist()
        self.load = weighs * off
        if not (weighs and self.sinks and -f[2] > self._max_weight):
            return ""
        self._deflection = np.zeros_like(off)
        mass = "..." if self.contact.stiffness is None else f"{-f[2] / GRAVITY:.2g}"
        words = (
            f"; that looks like a payload of about {mass} kg, which the drives do not know of: load the robot with it"
        )
        return f"{words}, robot.with_payload({mass}, {self._frame.name!r})"

    def describe_cause(self, constraint: Constraint | None, q: Posture) -> str:
        """Return a sentence on a stop: the blocked row of the constraint (if known), the joint farthest from its
        command, their deviations, and a remedy.

        Args:
            constraint: Constraint of the controller; None if there is none.
            q: Measured configuration (nq,) or joint positions (nv,) [rad or m].
        """
        j = int(np.abs(self.distance).argmax())
        unit = self._robot.joint_units[j]
        turns = other_turns(float(self.distance[j]), unit)
        words = f"joint {self._robot.joint_names[j]} is {1e3 * self.distance[j]:+.2g} m{unit} from its command"
        if constraint is not None and not turns:
            off = constraint(q) @ self.distance
            i = int(np.abs(off).argmax())
            row = constraint.selection[i]
            unit = "mrad" if constraint.features.row_units[int(np.abs(row).argmax())].startswith("rad") else "mm"
            parts = sum_in_words(row, constraint.features.row_names, "+.2g", 0.05)
            words = f"row {i + 1} of the constraint ({parts}) is {1e3 * off[i]:+.2g} {unit} off, {words}"
        share, stands = self.servos.pace()
        if _CREEP_SHARE < share < 0.95:
            return f"{words}{turns}; {_slow(share)}"
        still = "; no joint moves any more: look at brakes, control mode and emergency stop" if stands else ""
        return f"{words}{turns}{still}; {self.tripped}"

    def compare(self, commanded: Posture, measured: Posture, driven: Directions | None = None) -> None:
        """Compare the newest commanded and measured postures; update `distance`, `force` and `tripped`.

        Args:
            commanded: Commanded configuration (nq,) or joint positions (nv,) [rad or m].
            measured: Measured configuration (nq,) or joint positions (nv,) [rad or m].
            driven: Function of a posture that returns the joint motions which the task drives (k, nv), see
                `LimitedController.driven_motions`; None if it drives none.
        """
        servos, was_known, (low, high) = self.servos, self.servos.late is not None, self._inertial_range
        self.distance, self.force = self._robot.difference(commanded, measured), np.zeros(3)
        excess = signed_excess(servos.excess(self.distance), low - ROUNDING, high + ROUNDING)
        self._now, is_known = (excess, self.distance), servos.late is not None
        if is_known and not was_known:
            self._write_notes(measured)
        travel = servos.travel(round(MOTION_ONSET / self._dt))
        if self.tripped or servos.repeats:
            return
        # 16 times the limit: the error of 0.2 s of delay at 0.5 rad/s, and of a blocked arm that starts so fast
        if not is_known and np.any(np.abs(self.distance) > 16.0 * self.limit):
            self.tripped = "the arm has not begun to move: it is blocked or switched off, or set Contact(latency=...)"
        elif excess.dot(excess) > RESOLUTION * RESOLUTION:  # with less no force can be larger than `held`
            self.tripped = self._judge(measured, excess, driven)
        elif is_known and travel.dot(travel) > 4.0 * (RESOLUTION * RESOLUTION + servos.most.dot(servos.most)):
            # the motion exceeds the undetectable deflections
            self._motion_time = min(MOTION_MEMORY, self._motion_time + self._dt)

    def _judge(self, measured: np.ndarray, excess: np.ndarray, driven: Directions | None) -> str:
        """Estimate the force on the hand at the time when a brake ordered now takes effect, and compare it with the
        limits.

        Returns:
            Why the arm must be stopped, in words; empty where it need not.
        """
        servos, dt, ago = self.servos, self._dt, len(self._history)
        before = (self._now, *self._history)[-1]
        rise, gains, sent = excess - before[0], self.distance - before[1], servos.travel(ago)
        # it rises for the delay of the measurement and then, ever more slowly, until the arm is at rest
        ahead = servos.delay + 0.5 * float(np.max(np.abs(self._velocity) / self._acceleration))
        further = min(max(ahead / (math.ceil(LOOK_BACK / dt) * dt), 1.0), 3.0)  # noise grows with it
        J = self._robot.jacobian(measured, self._frame)[:3]
        self.force, residual = self._split_weight(excess + further * rise, J / self._stiffness)
        force, lacking, step = math.sqrt(self.force.dot(self.force)), math.nan, J.dot(sent)
        # share of the commanded motion that the hand lacks; unknown if the command is only noise, or the delay unknown
        if servos.late is not None and step.any() and sent.dot(sent) > RESOLUTION * RESOLUTION:
            lacking = -float(J.dot(gains).dot(step)) / float(step.dot(step))
        moves, is_moving = bool(self._velocity.any()), lacking < 0.5
        self._motion_time = moves * min(MOTION_MEMORY, max(0.0, self._motion_time + (dt if is_moving else -dt)))
        # the force of the motion, averaged over 0.2 s
        self._moving_force += moves * is_moving * min(1.0, dt / 0.2) * (force - self._moving_force)
        lateral, most = max(self.contact.max_lateral_force, self.resolution), max(self._axial_limit, self.resolution)
        if force > lateral:
            rows = np.zeros((0, len(sent))) if driven is None else driven(measured)
            way, side = self._split_directions(J, rows, servos.raw + further * gains)
            along = f"{way:.0f} N along the driven direction"
            # a fifth may seem to be lateral: joints differ, directions are known to 10 degrees
            if side > lateral + 0.2 * way:
                across = (
                    f"{side:.0f} N across the driven direction, of {lateral:.0f} allowed (Contact.max_lateral_force)"
                )
                return f"{across}: the learnt constraint is misplaced, or something is in the way"
            if way > most:
                return f"{along}, of {most:.0f} allowed (Contact.max_axial_force): it is locked, or allow more"
            # a hand at rest lacks at least 80 % of its motion; one that lacks more than 125 % was pushed back
            if 0.8 < lacking < 1.0 / 0.8 and self._motion_time > MOTION_ONSET and way > self._moving_force + lateral:
                return f"{along}, which moved with {self._moving_force:.0f} N and has stopped: look for a blockage"
        j = int((np.abs(residual) / self.limit).argmax())
        load, name = abs(float(residual[j] * self._stiffness[j])), self._robot.joint_names[j]
        words = f"joint {name} carries {load:.0f} N m that no force on the hand explains: look for a contact of the arm"
        return words if abs(residual[j]) > self.limit[j] else ""

    def _split_directions(self, J: np.ndarray, driven: np.ndarray, off: Vector) -> tuple[float, float]:
        """Return the force on the hand along and across the driven rows [N].

        A moving hand presses on a rail because the arm's stiffness differs between directions: that is not a lateral
        force. The lateral force is therefore at most the one that explains the hand's deviation from its path.

        Args:
            J: Jacobian of the hand's position.
            driven: shape (k, nv), motions of the joints that the task drives.
            off: Distance of the arm from the posture that it seems to follow [rad or m].
        """
        U, sigma, _ = np.linalg.svd(J @ driven.T)
        rank = int(np.sum(sigma > 0.01 * max(float(sigma.max(initial=0.0)), 1e-6)))
        along, aside = U[:, :rank].T.dot(self.force), U[:, rank:].T.dot(J)
        way, side = float(np.linalg.norm(along)), math.sqrt(max(0.0, self.force.dot(self.force) - along.dot(along)))
        if rank:
            yields = (aside / self._stiffness).dot(aside.T) + ROUNDING * np.eye(len(aside))
            side = min(side, float(np.linalg.norm(np.linalg.solve(yields, aside.dot(off)))))
        return way, side

    def _compliance(self, q: Posture) -> Float[np.ndarray, "3 nv"]:
        """Return C = J / stiffness, the deflections of the joints per newton on the hand."""
        return self._robot.jacobian(q, self._frame)[:3] / self._stiffness

    def _estimate_force(self, off: np.ndarray, C: np.ndarray, sees: np.ndarray | float = 1.0) -> np.ndarray:
        """Return the force on the hand that explains distances best, using the joints that `sees` selects."""
        selected = C * sees
        return np.linalg.solve(selected.dot(C.T) + self._damping, selected.dot(off))

    def _split_weight(self, excess: np.ndarray, C: np.ndarray) -> tuple[Float[np.ndarray, " 3"], Vector]:
        """Return the force on the hand that explains distances, less a weight, and the distances that it does not
        explain.
        """
        # use joints that have moved, or were hardly commanded to move, or deviate by more than friction explains
        sees = self.servos.seen | (self.servos.most < STILL) | (self.servos.newest != 0.0)
        f = self._estimate_force(excess, C, sees)
        residual = (excess - f.dot(C)) * sees
        weight = min(max(0.0, -f[2]), self._max_weight)
        if self.servos.moving <= 0.25:  # [s] after which a weight is known
            self._weight = max(self._weight, weight)
        f[2] += min(weight, self._weight)
        self._deflection = f.dot(C)
        return f, residual

    def _write_notes(self, q: np.ndarray) -> None:
        """Write notes on the servos' properties in the first motion, and on the smallest detectable force."""
        servos, lateral_limit, C, ms = self.servos, self.contact.max_lateral_force, self._compliance(q), 1e3 * self._dt
        # the commanded motion between two new readings is not friction
        dry = np.maximum(servos.width - np.abs(servos.travel(round(servos.every - 1.0))), 0.0) * servos.seen
        sizes = np.sqrt(servos.variance), servos.width * servos.seen, dry
        noise, width, friction = (float(np.linalg.norm(self._estimate_force(np.diag(x), C))) for x in sizes)
        # readings are averaged until noise is a third of the limit. Friction is known to 70 %: it depends on load and
        # speed, and presses the hand itself
        deviations = 9.0  # standard deviations that count as noise: 4, times the square root of 5 for the extrapolation
        periods = max(1.0, 0.5 * (3.0 * deviations * noise / lateral_limit) ** 2)
        least, servos.smoothing = max(0.7 * width, deviations * noise / math.sqrt(2.0 * periods)), 1.0 / periods
        if isinstance(self.contact.resolution, str):
            self.resolution = least
        share, late, reads_slowly = servos.pace()[0], servos.late or 0.0, servos.every >= 2.0
        slow = _CREEP_SHARE < share < 0.75
        cause = "an arm that is slower than its command" if slow else "friction, backlash and noise"
        cause = "readings that come late" if reads_slowly else cause
        notes = {
            _slow(share): slow,
            f"the arm follows {1e3 * late:.0f} ms late": not slow and late > LOOK_BACK,
            f"readings change every {servos.every * ms:.0f} ms, the loop runs at {ms:g} ms": reads_slowly,
            f"friction and backlash of the joints take up to {friction:.0f} N on the hand: forces are detected from "
            f"{least:.0f} N on": not slow and friction > lateral_limit,
            f"max_lateral_force={lateral_limit:g} N cannot be kept because of {cause}: the arm stops at "
            f"{self.resolution:.0f} N, the smallest force that can be detected": self.resolution > lateral_limit,
        }
        self.notes = (*self.notes, *(note for note, applies in notes.items() if applies))


def other_turns(step: float, unit: str) -> str:
    """Return the end of a sentence on a joint step of one or more full turns; empty for any other step.

    Args:
        step: Step of the joint [rad or m].
        unit: `"rad"` or `"m"`.
    """
    turns = round(step / (2.0 * math.pi))
    if not turns or unit != "rad" or abs(step - 2.0 * math.pi * turns) > 0.1:
        return ""
    return f", which is {counted(abs(turns), 'full turn')}: the driver counts the turns of that joint differently"


def _slow(share: float) -> str:
    """Return words on an arm that follows its path at a share of the commanded speed."""
    return f"the arm follows its path at about {share:.0%} of its speed: speed slider, override or a limit of its own"
