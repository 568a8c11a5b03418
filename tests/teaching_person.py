"""A person at the teaching page, scripted: drags the hand with an unsteady hand, presses buttons, reads the answers."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Generator, Iterator
from pathlib import Path
from typing import Any

import numpy as np

PERIOD = 0.01  # [s] between two poses
ASTRAY = 0.008  # [m] of the hand from where it is meant to go, standard deviation
Said = dict[str, Any] | None
Script = Generator[Said, None, None]


class Person:
    """Receives what the session shows, and sends the next message of its script once a period, like server and page."""

    def __init__(self, seed: int):
        self.rng = np.random.default_rng(seed)
        self.pose: dict[str, Any] = {}
        self.slots: dict[str, Any] = {}
        self.files: dict[str, Path] = {}
        self.script: Iterator[Said] = iter(())
        self.session: Any = None

    @property
    def state(self) -> dict[str, Any]:
        """The latest state."""
        return self.slots["state"]

    def put(self, message: Callable[[], str], slot: str = "message") -> None:
        """Receive a message for the page."""
        content = json.loads(message())
        self.slots[slot] = content
        if slot == "pose" and self.session is not None:
            self.pose = content
            said = next(self.script, {"end": True})
            if said is not None:
                self.session.hear(said if "end" in said else {"page": "person", "said": said})

    def offer(self, files: Any) -> None:
        """Receive the files that can be downloaded."""
        self.files = dict(files)

    # ---- scripts ----------------------------------------------------------------------------------------------------

    def wait(self, seconds: float) -> Script:
        """Do nothing for a while."""
        for _ in range(round(seconds / PERIOD)):
            yield None

    def wait_for(self, done: Callable[[], bool], seconds: float = 60.0) -> Script:
        """Do nothing until a condition holds, at most so many seconds on the arm's clock."""
        for _ in range(round(seconds / PERIOD)):
            if done():
                return
            if self.state["progress"] is not None:
                time.sleep(PERIOD)  # the other process has the processor
            yield None
        raise AssertionError(f"the condition never held; the page says {self.state['said']}")

    def press(self, **said: Any) -> Script:
        """Press a button, and wait until it was heard and shown."""
        yield said
        yield from self.wait(0.05)

    def drag(self, path: Callable[[float], np.ndarray], seconds: float, turn: Any = None) -> Script:
        """Drag the tip along a path over [0, 1], unsteadily."""
        n = round(seconds / PERIOD)
        for k in range(n):
            self._time += PERIOD
            astray = np.sum(self._waves * np.sin(self._speed * self._time + self._phase), axis=1)
            to = path((k + 1) / n) + astray
            yield pull(to, None if turn is None else turn((k + 1) / n).tolist(), k)

    def other_hand(self) -> None:
        """Be unsteady in another way from now on: slow waves about where the hand is meant to be."""
        waves = self.rng.uniform(0.5, 1.5, (3, 4))
        self._waves = waves * ASTRAY / np.sqrt(0.5 * np.sum(waves**2, axis=1, keepdims=True))
        self._speed = 2.0 * np.pi * self.rng.uniform(0.3, 1.2, (3, 4))
        self._phase = self.rng.uniform(0.0, 2.0 * np.pi, (3, 4))
        self._time = 0.0

    def hold(self, seconds: float) -> Script:
        """Pull the hand to the first handle until the gripper holds it, at most so many seconds."""
        for _ in range(round(seconds / PERIOD)):
            if self.session.arm.held:
                return
            yield pull(self.session.arm.handle_place)

    def demonstrate(self) -> Script:
        """Record one motion: to the handle, along its whole travel and back, and away, with pauses."""
        session, rng = self.session, self.rng
        arm = session.arm
        self.other_hand()
        yield from self.press(do="record")
        yield from self.wait(float(rng.uniform(0.3, 0.7)))
        home = arm.place
        yield from self._move(arm.scene.handle)
        a = arm.place
        yield from self.drag(lambda s: a + smooth(s) * (home - a), float(rng.uniform(0.8, 1.3)))
        yield {"do": "release"}
        yield from self.wait(float(rng.uniform(0.3, 0.6)))
        recorded = len(self.state["recordings"])
        yield from self.press(do="record")
        yield from self.wait_for(lambda: len(self.state["recordings"]) > recorded)
        yield from self.wait(0.3)

    def _move(self, handle: Any) -> Script:
        """Go to a handle, move it as far as it goes and back, and let it go."""
        arm, rng = self.session.arm, self.rng
        a, b = arm.place, arm.handle_place
        yield from self.drag(lambda s: a + smooth(1.15 * s) * (b - a), float(rng.uniform(1.0, 1.6)))
        yield from self.hold(5.0)
        assert arm.held, "the hand did not come to the handle"
        yield from self.drag(lambda _: b, float(rng.uniform(0.3, 0.6)))
        far, turn = float(rng.uniform(0.75, 1.0)) * handle.travel, None
        if handle.type == "plane":
            lag = float(rng.uniform(0.0, 6.0))

            def wiped(s: float) -> np.ndarray:
                size = far * smooth(4.0 * s) * smooth(4.0 * (1.0 - s))
                return handle.moved(size * np.sin(12.0 * s + lag), size * np.sin(19.0 * s + 2.0 * lag))[:3, 3]

            yield from self.drag(wiped, float(rng.uniform(5.0, 7.0)))
        else:
            there, back = (lambda s: smooth(s) * far), (lambda s: (1.0 - smooth(s)) * far)
            for way, *seconds in ((there, 1.5, 2.5), (lambda s: far, 0.2, 0.6), (back, 1.5, 2.5)):
                if handle.firm:
                    turn = lambda s, way=way: way(s) * handle.axis  # noqa: E731
                yield from self.drag(lambda s, way=way: handle.moved(way(s))[:3, 3], rng.uniform(*seconds), turn)
        yield {"do": "grip", "closed": False}

    def learn(self) -> Script:
        """Press Learn, and wait for the answer."""
        yield from self.press(do="learn")
        yield from self.wait_for(lambda: self.state["progress"] is None and self.state["answer"] is not None, 1e5)


def pull(to: np.ndarray, turn: list[float] | None = None, seq: int = 0) -> dict[str, Any]:
    """Return the message for a pull of the tip."""
    return {"do": "pull", "to": to.tolist(), "turn": turn, "seq": seq}


def smooth(share: float) -> float:
    """Return the share of the path [0, 1] at a share of the time, slow at both ends."""
    x = min(max(share, 0.0), 1.0)
    return x * x * (3.0 - 2.0 * x)
