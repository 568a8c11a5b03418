"""Following error: how far the measured posture is from the commanded one, and whether that is too far."""

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
from manip_learn.control.servos import HIDDEN, LATEST, ROUNDING, STILL, Servos, beyond, copied
from manip_learn.control.timing import is_number
from manip_learn.errors import ConfigurationError, counted, under_new_names
from manip_learn.robot.robot import Robot
from manip_learn.robot.tips import default_tip

STIFFNESS = 2000.0  # [N m/rad or N/m] of a stiff position servo of an arm that works beside people
GRAVITY = 9.81  # [m/s2]
LEFT = 3.0  # [N] that may be left on the hand of an arm that has let go
# [rad or m] what stays of a servo's error where friction, play and noise have been measured: 0.5 N m at 2,000 N m/rad
RESOLUTION = 2.5e-4
LOOK_BACK = 0.01  # [s] over which the rise of a force is looked at, and by which it is carried on at the least
# [s] of motion after which a hand goes, and for which that is remembered: stick and slip take turns faster
BRIEFLY, GOING = 0.1, 0.5
# standard deviations of the force that count as noise, carried on as it is: four, times the square root of five
QUIET = 9.0
_FORMER = {"held": "max_lateral_force", "driven": "max_axial_force"}  # names of arguments, until 0.4


@final
@dataclass(frozen=True, init=False)
class Contact:
    """What a `ServoLoop` makes of the distance between where an arm is and where it was sent: forces on the hand.

    A force that loads the hand makes the position servos give way. The loop finds the force that explains best by how
    much they do, and stops the arm where it is too large. A row of the constraint that is *held* takes no force in a
    task that is done right; along a row that is *driven* the force is the task, e.g. of a drawer that sticks.

    What is no force is measured in the first half second in which the arm moves, and told in `ServoLoop.notes`: by how
    much it follows late, the noise of its encoders, and the friction and the play of its joints.

    Args:
        max_lateral_force: Largest force on the hand across the driven rows [N], beyond a fifth of the force along them,
            by which directions and joints may be other than they are taken for. A tenth of what ISO/TS 15066 lets a
            robot press a hand with: the force goes on rising while the arm brakes.
        max_axial_force: The same along the rows that the task drives (`Task.driven_rows`) [N]; "auto" takes 1.5 times
            the force while it was taught, where efforts were recorded (`Shown.force`), `max_lateral_force` at the
            least, and else 60 N. What was moving and stops is blocked already at `max_lateral_force` more than it took.
        latency: Longest delay of the arm [s]; "auto" measures it, up to 0.2 s.
        resolution: Force that cannot be told from friction, backlash and noise [N]; "auto" measures it. The arm is
            stopped at no less.
        stiffness: shape (nv,) or a number, of the arm's position servos [N m/rad or N/m]. None, not known: the limits
            are then distances, those of servos of 2,000, as a warning says.
        **renamed: Former names of arguments, valid until 0.4: `held`, `driven`.

    Raises:
        ConfigurationError: A number that is not positive.
        TypeError: An argument that does not exist.
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
        given = {"max_lateral_force": max_lateral_force, "max_axial_force": max_axial_force, "latency": latency}
        given |= {"resolution": resolution, "stiffness": stiffness, **under_new_names("Contact()", _FORMER, renamed)}
        vars(self).update(given)
        units = ("newtons", 'newtons or "auto"', 'seconds or "auto"', 'newtons or "auto"')
        for (name, value), unit in zip(given.items(), units, strict=False):  # a stiffness is for a robot's joints
            is_auto = isinstance(value, str) and value == "auto" and "auto" in unit
            is_size, may_be_none = (
                is_number(value) and 0.0 <= float(value) < math.inf,
                name in ("latency", "resolution"),
            )
            if not (is_auto or (is_size and (value or may_be_none))):
                raise ConfigurationError(f"{name} must be a positive number of {unit}, got {value!r}")

    @property
    def held(self) -> float:
        """Former name of `max_lateral_force`, valid until 0.4."""
        return self.max_lateral_force

    @property
    def driven(self) -> float | Literal["auto"]:
        """Former name of `max_axial_force`, valid until 0.4."""
        return self.max_axial_force


_CREEPS = 0.15  # share of the commanded speed below which an arm may stand
Directions = Callable[[Posture], Float[np.ndarray, "k nv"]]


@final
class FollowingError:
    """Distance between the commanded and the measured posture, and the force on the hand that explains it.

    Of the distance, what late servos with friction and play explain is no force (`Servos`), nor what the inertia of the
    links does, nor a weight of up to 2 kg. The force is the one that explains the rest best,

        f = (C C^T + (RESOLUTION / held)^2)^-1 C e,    C = J(q) / stiffness.

    Along what is driven it may be `driven`, across it `held`. What touches the arm elsewhere leaves distances that no
    force on the hand explains: they trip where they load a joint as `held` would at the arm's longest lever.

    Args:
        robot: The robot.
        contact: What counts as a force, and which force is too large.
        dt: Period [s].
        acceleration: shape (nv,), with which the arm brakes [rad/s2 or m/s2].
        frame: Name of the tip's frame.

    Attributes:
        limit: shape (nv,), to which `held` at the longest lever would load a joint [rad or m].
        distance: shape (nv,), measured less commanded.
        force: shape (3,), on the hand, in the base frame [N].
        tripped: Why the arm is to be stopped, in words; empty where it is not.
        load: shape (nv,), distance at which a weight keeps the arm, with nothing in its way [rad or m].
        sinks: True if the force that stopped the arm points down, as a weight does.
        servos: What is known of them.
        notes: Sentences on them.
        resolution: Force that cannot be told from friction, play and noise [N].

    Raises:
        ConfigurationError: A stiffness that is not positive or has the wrong size.
    """

    def __init__(self, robot: Robot, contact: Contact, dt: float, acceleration: Vector, frame: str | None = None):
        # settings, which do not change
        self.contact, self._robot, self._dt, self._acceleration = contact, robot, dt, acceleration
        # along what is driven, where nothing is known of it; what the hand may carry without the drives' knowing [N]
        self._driven = 60.0 if isinstance(contact.max_axial_force, str) else float(contact.max_axial_force)
        self._heaviest = GRAVITY * max(2.0, robot.payload)
        told = STIFFNESS if contact.stiffness is None else contact.stiffness
        self._stiffness = per_joint("stiffness", told, robot.joint_names)
        # links that are slower on servos softer than they are taken for give way by more: ten times at 200 N m/rad
        self._inertial = self._stiffness if contact.stiffness is not None else 0.1 * self._stiffness
        self._frame, rng = robot.frame(frame or default_tip(robot)), np.random.default_rng(0)
        # the longest lever of the tip on any joint [m]; at least 1 where a joint is prismatic
        rows = [robot.jacobian(robot.random_configuration(rng), self._frame)[:3] for _ in range(200)]
        held = contact.max_lateral_force
        self.limit = held * float(np.linalg.norm(rows, axis=1).max()) / self._stiffness
        self._damping = (RESOLUTION / held) ** 2 * np.eye(3)
        latency = LATEST if isinstance(contact.latency, str) else float(contact.latency)
        # the state, whose parts are replaced, never changed in place
        zero = np.zeros(robot.nv)
        self.servos, self.notes = Servos(dt, latency, HIDDEN / self._stiffness), tuple[str, ...]()
        self.resolution = 0.0 if isinstance(contact.resolution, str) else float(contact.resolution)
        if contact.stiffness is None:
            joint = int(np.argmax(self.limit))
            self.notes = (
                "the stiffness of the servos is not told: the arm is stopped by distances, at the latest where joint "
                f"{robot.joint_names[joint]} is {1e3 * self.limit[joint]:.2g} mrad off. On servos of {STIFFNESS:g} "
                f"N m/rad that is {held:g} N on the hand, on stiffer ones more: give Contact(stiffness=...)",
            )
        self.distance, self.load, self.force, self.tripped, self.sinks = zero, zero, np.zeros(3), "", False
        # excess and distance of this period, and of those before, newest first
        self._now, self._found = (zero, zero), tuple[tuple[np.ndarray, np.ndarray], ...]()
        # velocity, and its change since inertia was looked at; between what servos lately gave way to that
        self._velocity, self._change, self._lasted, self._gave_way = zero, zero, 0.0, (zero, zero)
        # how far the force on the hand pushes the joints [rad or m], and the weight that it seems to carry [N]; for how
        # long it has been moving [s], and what that takes [N]
        self._pushed, self._weight, self._going, self._carried = zero, 0.0, 0.0, 0.0

    def copied(self) -> FollowingError:
        """Return a copy; nothing that it is made of is changed in place."""
        other = copied(self)
        other.servos = copied(self.servos)
        return other

    def moved(self, q: Posture, time: float, velocity: Vector) -> None:
        """Take note of a step of the commanded posture: the posture before it, how long it took [s], its velocity."""
        over = self.servos.moved(time * velocity, time)
        if over:
            self._found = (self._now, *self._found[: math.ceil(LOOK_BACK / self._dt) - 1])
        self._change, self._velocity = self._change + (velocity - self._velocity), velocity
        self._lasted += max(time, 0.0)
        if over and time > 0.0 and self.servos.has_looked:
            # a servo gives way to M a as a spring and a damper do: by no more than lately, and for a while after
            now = -self._robot.inertial_effort(q, self._change / self._lasted) / self._inertial
            # 0.1 s are three times sqrt(2 kg m2 / 2,000 N m/rad)
            lately, (low, high) = math.exp(-self._lasted / 0.1), self._gave_way
            self._gave_way = np.minimum(lately * low, now), np.maximum(lately * high, now)
            self._change, self._lasted = np.zeros_like(velocity), 0.0

    @property
    def largest(self) -> float:
        """Largest distance of a joint in the newest comparison, beyond what being late explains [rad or m]."""
        return float(np.abs(self.servos.raw).max(initial=0.0))

    def relief(self) -> Vector:
        """Return the way to a commanded posture at which the servos no longer press, shape (nv,) [rad or m].

        To where the arm was measured, less its load (a weight presses nothing), and on in the sense of the force by
        what friction would go on holding.
        """
        held = self.servos.friction * self._pushed / (np.abs(self._pushed) + RESOLUTION)
        return self.distance - self.load + held

    def farthest(self) -> Vector:
        """Return by how much it makes sense to let go, shape (nv,) [rad or m]: the measurement may be wrong.

        What the largest force makes of the limits, friction, and what was commanded within the delay.
        """
        largest = max(1.0, self._driven / self.contact.max_lateral_force) * self.limit
        return largest + self.servos.moved_lately + self.servos.width

    def left(self, q: Posture) -> float:
        """Return the force on the hand that is left in a measured posture, beyond what friction holds [N]."""
        friction = self.servos.friction
        off = beyond(self.distance - self.load, -friction, friction)
        return float(np.linalg.norm(self._force_of(off, self._yields(q))[0]))

    def carry(self, off: Vector, q: Posture) -> str:
        """Take distances [rad or m] at a posture as the arm's load if a weight explains them.

        Returns:
            Words on a payload that the drives do not know of; empty if there is none.
        """
        f = self._explained(off, self._yields(q))
        forces = np.array([f, self.force if self.force.any() else f])  # now, and that which stopped the arm
        # a weight is a force of which at least 80 % point down
        weighs, self.sinks = (-forces[:, 2] > np.maximum(LEFT, 0.8 * np.linalg.norm(forces, axis=1))).tolist()
        self.load = weighs * off
        if not (weighs and self.sinks and -f[2] > self._heaviest):
            return ""
        self._pushed = np.zeros_like(off)
        mass = "..." if self.contact.stiffness is None else f"{-f[2] / GRAVITY:.2g}"
        words = (
            f"; that looks like a payload of about {mass} kg, which the drives do not know of: load the robot with it"
        )
        return f"{words}, robot.with_payload({mass}, {self._frame.name!r})"

    def sentence(self, constraint: Constraint | None, q: Posture) -> str:
        """Say what was blocked and by how much: the row of the constraint, if known, the joint, and what to do."""
        j = int(np.abs(self.distance).argmax())
        unit = self._robot.joint_units[j]
        turns = other_turns(float(self.distance[j]), unit)
        words = f"joint {self._robot.joint_names[j]} is {1e3 * self.distance[j]:+.2g} m{unit} from where it was sent"
        if constraint is not None and not turns:
            off = constraint(q) @ self.distance
            i = int(np.abs(off).argmax())
            row = constraint.selection[i]
            unit = "mrad" if constraint.features.row_units[int(np.abs(row).argmax())].startswith("rad") else "mm"
            parts = sum_in_words(row, constraint.features.row_names, "+.2g", 0.05)
            words = f"row {i + 1} of the constraint ({parts}) is {1e3 * off[i]:+.2g} {unit} off, {words}"
        share, stands = self.servos.pace()
        if _CREEPS < share < 0.95:
            return f"{words}{turns}; {_slow(share)}"
        still = "; no joint moves any more: look at brakes, control mode and emergency stop" if stands else ""
        return f"{words}{turns}{still}; {self.tripped}"

    def compare(self, commanded: Posture, measured: Posture, driven: Directions | None = None) -> None:
        """Compare two postures, the newest commanded and the newest measured one.

        `driven` gives the motions of the joints that the task drives, at a posture.
        """
        servos, was_known, (low, high) = self.servos, self.servos.late is not None, self._gave_way
        self.distance, self.force = self._robot.difference(commanded, measured), np.zeros(3)
        excess = beyond(servos.excess(self.distance), low - ROUNDING, high + ROUNDING)
        self._now, is_known = (excess, self.distance), servos.late is not None
        if is_known and not was_known:
            self._tell(measured)
        gone = servos.gone(round(BRIEFLY / self._dt))
        if self.tripped or servos.repeats:
            return
        # 16 times the limit: 0.2 s late at 0.5 rad/s, and what a blocked arm is pressed with that starts so fast
        if not is_known and np.any(np.abs(self.distance) > 16.0 * self.limit):
            self.tripped = "the arm has not begun to move: it is blocked or switched off, or give Contact(latency=...)"
        elif excess.dot(excess) > RESOLUTION * RESOLUTION:  # with less no force can be larger than `held`
            self.tripped = self._judge(measured, excess, driven)
        elif is_known and gone.dot(gone) > 4.0 * (RESOLUTION * RESOLUTION + servos.most.dot(servos.most)):
            self._going = min(GOING, self._going + self._dt)  # by more than may stay unseen

    def _judge(self, measured: np.ndarray, excess: np.ndarray, driven: Directions | None) -> str:
        """Find the force on the hand, as it will be when a brake takes effect that is ordered now, and judge it.

        Returns:
            Why the arm is to be stopped, in words; empty where it is not.
        """
        servos, dt, ago = self.servos, self._dt, len(self._found)
        before = (self._now, *self._found)[-1]
        rise, gains, sent = excess - before[0], self.distance - before[1], servos.gone(ago)
        # it rises until what is measured is seen, and, ever more slowly, until the arm stands
        ahead = servos.delay + 0.5 * float(np.max(np.abs(self._velocity) / self._acceleration))
        further = min(max(ahead / (math.ceil(LOOK_BACK / dt) * dt), 1.0), 3.0)  # noise grows with it
        J = self._robot.jacobian(measured, self._frame)[:3]
        self.force, beside = self._force_of(excess + further * rise, J / self._stiffness)
        force, taken, step = math.sqrt(self.force.dot(self.force)), math.nan, J.dot(sent)
        # share of its way that the hand lacks, unless it was sent by noise only, or by a delay that is not known
        if servos.late is not None and step.any() and sent.dot(sent) > RESOLUTION * RESOLUTION:
            taken = -float(J.dot(gains).dot(step)) / float(step.dot(step))
        moves, goes = bool(self._velocity.any()), taken < 0.5
        self._going = moves * min(GOING, max(0.0, self._going + (dt if goes else -dt)))
        self._carried += moves * goes * min(1.0, dt / 0.2) * (force - self._carried)  # known within 0.2 s
        held, most = max(self.contact.max_lateral_force, self.resolution), max(self._driven, self.resolution)
        if force > held:
            rows = np.zeros((0, len(sent))) if driven is None else driven(measured)
            way, side = self._split(J, rows, servos.raw + further * gains)
            along = f"{way:.0f} N along what is driven"
            # a fifth may seem to be across: joints differ, directions are known to 10 degrees
            if side > held + 0.2 * way:
                across = f"{side:.0f} N across what is driven, of {held:.0f} allowed (Contact.max_lateral_force)"
                return f"{across}: what was learnt lies elsewhere, or something is in the way"
            if way > most:
                return f"{along}, of {most:.0f} allowed (Contact.max_axial_force): it is locked, or allow more"
            # a hand that stands lacks 80 % of its way; one that lacks more than all of it was pushed back
            if 0.8 < taken < 1.0 / 0.8 and self._going > BRIEFLY and way > self._carried + held:
                return f"{along}, which was moving with {self._carried:.0f} and has stopped: look what blocks it"
        j = int((np.abs(beside) / self.limit).argmax())
        load, name = abs(float(beside[j] * self._stiffness[j])), self._robot.joint_names[j]
        words = f"joint {name} is pushed by {load:.0f} N m beside what the hand is: look what touches the arm"
        return words if abs(beside[j]) > self.limit[j] else ""

    def _split(self, J: np.ndarray, driven: np.ndarray, off: Vector) -> tuple[float, float]:
        """Return the force on the hand along and across what is driven [N].

        A hand that is on its way presses a rail by what the arm is not equally stiff in all directions: that is no
        force across. There it is then no more than what explains by how much the hand is off its way.

        Args:
            J: Jacobian of the hand's position.
            driven: shape (k, nv), motions of the joints that the task drives.
            off: How far the arm is from the posture that it seems to follow [rad or m].
        """
        U, sigma, _ = np.linalg.svd(J @ driven.T)
        rank = int(np.sum(sigma > 0.01 * max(float(sigma.max(initial=0.0)), 1e-6)))
        along, aside = U[:, :rank].T.dot(self.force), U[:, rank:].T.dot(J)
        way, side = float(np.linalg.norm(along)), math.sqrt(max(0.0, self.force.dot(self.force) - along.dot(along)))
        if rank:
            yields = (aside / self._stiffness).dot(aside.T) + ROUNDING * np.eye(len(aside))
            side = min(side, float(np.linalg.norm(np.linalg.solve(yields, aside.dot(off)))))
        return way, side

    def _yields(self, q: Posture) -> Float[np.ndarray, "3 nv"]:
        """Return C = J / stiffness, by how much joints give way to a force on the hand."""
        return self._robot.jacobian(q, self._frame)[:3] / self._stiffness

    def _explained(self, off: np.ndarray, C: np.ndarray, sees: np.ndarray | float = 1.0) -> np.ndarray:
        """Return the force on the hand that explains distances best, by joints that say something of it."""
        seen = C * sees
        return np.linalg.solve(seen.dot(C.T) + self._damping, seen.dot(off))

    def _force_of(self, excess: np.ndarray, C: np.ndarray) -> tuple[Float[np.ndarray, " 3"], Vector]:
        """The force on the hand that explains distances, less a weight, and what is left of them."""
        # joints that were seen to move, or were not sent far, or are farther away than friction takes
        sees = self.servos.seen | (self.servos.most < STILL) | (self.servos.newest != 0.0)
        f = self._explained(excess, C, sees)
        beside = (excess - f.dot(C)) * sees
        weight = min(max(0.0, -f[2]), self._heaviest)
        if self.servos.moving <= 0.25:  # [s] after which a weight is known
            self._weight = max(self._weight, weight)
        f[2] += min(weight, self._weight)
        self._pushed = f.dot(C)
        return f, beside

    def _tell(self, q: np.ndarray) -> None:
        """Say what the first motion has shown of the servos, and how small a force can still be seen."""
        servos, held, C, ms = self.servos, self.contact.max_lateral_force, self._yields(q), 1e3 * self._dt
        # what was sent from one new reading to the next is no friction
        dry = np.maximum(servos.width - np.abs(servos.gone(round(servos.every - 1.0))), 0.0) * servos.seen
        sizes = np.sqrt(servos.variance), servos.width * servos.seen, dry
        noise, width, friction = (float(np.linalg.norm(self._explained(np.diag(x), C))) for x in sizes)
        # readings are averaged until noise is a third of what is allowed. Friction is known to 70 %: it depends on load
        # and speed, and presses the hand itself
        periods = max(1.0, 0.5 * (3.0 * QUIET * noise / held) ** 2)
        least, servos.smoothing = max(0.7 * width, QUIET * noise / math.sqrt(2.0 * periods)), 1.0 / periods
        if isinstance(self.contact.resolution, str):
            self.resolution = least
        share, late, seldom = servos.pace()[0], servos.late or 0.0, servos.every >= 2.0
        slow = _CREEPS < share < 0.75
        cause = "an arm that is slower than it is sent" if slow else "friction, play and noise"
        cause = "readings that come late" if seldom else cause
        notes = {
            _slow(share): slow,
            f"the arm follows {1e3 * late:.0f} ms late": not slow and late > LOOK_BACK,
            f"readings change every {servos.every * ms:.0f} ms, the loop runs at {ms:g} ms": seldom,
            f"friction and play of the joints take up to {friction:.0f} N on the hand: forces from {least:.0f} N on "
            "are seen": not slow and friction > held,
            f"max_lateral_force={held:g} N cannot be kept: from {cause}, {self.resolution:.0f} N can be told, and at "
            "that the arm is stopped": self.resolution > held,
        }
        self.notes = (*self.notes, *(note for note, applies in notes.items() if applies))


def other_turns(step: float, unit: str) -> str:
    """Return words on a step of a joint [rad or m] that is a number of full turns; empty where it is none."""
    turns = round(step / (2.0 * math.pi))
    if not turns or unit != "rad" or abs(step - 2.0 * math.pi * turns) > 0.1:
        return ""
    return f", which is {counted(abs(turns), 'full turn')}: the driver counts that joint's angle in other turns"


def _slow(share: float) -> str:
    """Return words on an arm that goes along its path at a share of the commanded speed."""
    return f"the arm follows its path at about {share:.0%} of its speed: speed slider, override or a limit of its own"
