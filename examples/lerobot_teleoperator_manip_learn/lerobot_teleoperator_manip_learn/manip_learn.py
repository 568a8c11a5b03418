"""The teleoperator: a servo loop whose arm is the last action, or what `send_feedback` was told."""

import logging
import time
from typing import Any

from lerobot.teleoperators.teleoperator import Teleoperator
from lerobot.utils.decorators import check_if_not_connected

import manip_learn as ml

from .config_manip_learn import ManipLearnConfig

_LOGGER = logging.getLogger(__name__)


class ManipLearn(Teleoperator):
    """Actions of a `ServoLoop`. LeRobot hands no observation over, so the loop begins at the start of the config."""

    config_class = ManipLearnConfig
    name = "manip_learn"

    def __init__(self, config: ManipLearnConfig):
        super().__init__(config)
        self.config, self._loop, self._stopped = config, None, ""
        self._values = {f"{motor}.pos": float(value) for motor, value in config.start.items()}

    @property
    def action_features(self) -> dict:
        """Position of each motor."""
        return dict.fromkeys(self._values, float)

    # as an arm of LeRobot, which our driver takes it for
    observation_features = action_features
    feedback_features = action_features

    @property
    def is_connected(self) -> bool:
        """Whether there is a loop, or one is being made."""
        return self._loop is not None

    @property
    def is_calibrated(self) -> bool:
        """There is nothing to calibrate."""
        return True

    def calibrate(self) -> None:
        """There is nothing to calibrate."""

    def configure(self) -> None:
        """There is nothing to configure."""

    def connect(self, calibrate: bool = True) -> None:
        """Load robot and constraint, and make the loop."""
        c = self.config
        robot = ml.load_robot(c.robot, locked=tuple(c.locked))
        constraint = ml.Constraint.load(c.constraint, robot)
        task = ml.PointAttractor(c.target) if c.target else ml.motion(constraint, distance=c.along, angle=c.turn)
        controller = ml.ResolvedRateController(constraint, task, ml.ManipulabilityAscent(constraint))
        self._loop, self._begun = ml.ServoLoop(controller, 1.0 / c.fps), time.perf_counter()
        self._driver = ml.LeRobotDriver(self, robot, 1.0 / c.fps, c.motors, c.others, c.units)

    def disconnect(self) -> None:
        """Forget the loop."""
        self._loop = None

    @check_if_not_connected
    def get_action(self) -> dict[str, float]:
        """Where the motors should be at the end of the period; the last action where the loop cannot go on."""
        command = self._loop.update(self._driver.read()[0], time.perf_counter() - self._begun)
        try:
            self._driver.command(self._loop.position, command.velocity)
        except ml.ManipLearnError as error:
            self._loop.stop()
            if not self._stopped:
                self._stopped = str(error)
                _LOGGER.warning("the arm stands: %s", error)
        return dict(self._values)

    def send_feedback(self, feedback: dict[str, Any]) -> None:
        """Where the motors are, for programs that hand it over: lerobot-record does not."""
        self._values |= {key: float(feedback[key]) for key in self._values if key in feedback}

    def get_observation(self) -> dict[str, float]:
        """Where the motors are, to our driver."""
        return dict(self._values)

    def send_action(self, action: dict[str, float]) -> dict[str, float]:
        """Take an action from our driver."""
        self._values |= action
        return action
