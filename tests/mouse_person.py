"""A person who drags the arm on the teaching page with the mouse, with an unsteady hand and pauses."""

from __future__ import annotations

import re
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from teaching_person import Unsteady, smooth
from test_playback_browser import wait_until

ASTRAY = 3.0  # [px] of the pointer from where it is meant to be, standard deviation
READY = "window.manipLearnReady && manipLearnTeach.allowed && manipLearnTeach.pose !== null"
MOVES = 0.016  # [s] between two moves of a mouse


@contextmanager
def program(folder: Path, *more: str) -> Iterator[tuple[subprocess.Popen[str], str]]:
    """`manip-learn teach` as a child process, and the address of its page."""
    command = [sys.executable, "-m", "manip_learn", "teach", *more, "--no-browser", "--out", str(folder)]
    child = subprocess.Popen(command, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True)
    try:
        said = next((line for line in child.stderr if "http://" in line), "")
        assert said, "the program ended without a page"
        yield child, re.search(r"http://\S+", said)[0]
    finally:
        child.terminate()
        child.communicate(timeout=20)


class MousePerson:
    """Sees the page, moves the mouse over it and presses keys."""

    def __init__(self, page: Any, seed: int):
        self.page, self.rng = page, np.random.default_rng(seed)
        self.at = np.zeros(2)
        self._home = self.teach("tip()")
        self._unsteady = Unsteady(self.rng, 2, ASTRAY)

    def teach(self, what: str) -> Any:
        """What the page knows of."""
        return self.page.evaluate(f"manipLearnTeach.{what}")

    def screen(self, place: Any) -> np.ndarray:
        """Where a place is on the page [px]."""
        return np.array(list(self.page.evaluate("p => manipLearnTeach.screenOf(p)", list(map(float, place))).values()))

    def take(self) -> None:
        """Press the button on the tip."""
        self.at = np.array(list(self.teach("tipOnScreen()").values()))
        self.page.mouse.move(*self.at)
        self.page.mouse.down()

    def drag(self, to: np.ndarray, seconds: float, until: Callable[[], bool] | None = None) -> None:
        """Draw the pointer there, at most in this time."""
        start, began = self.at, time.monotonic()
        while (share := (time.monotonic() - began) / seconds) < 1.0:
            self.at = start + smooth(share) * (to - start)
            self.page.mouse.move(*(self.at + self._unsteady.at(time.monotonic())))
            if until is not None and until():
                return
            self.page.wait_for_timeout(1000 * MOVES)
        self.at = to

    def pause(self) -> None:
        """Do nothing for a moment."""
        self.page.wait_for_timeout(float(self.rng.uniform(200, 500)))

    def reach(self, number: int = 0) -> None:
        """Draw the hand over a handle and wait until the gripper has closed."""
        held = partial(self.teach, f"pose.held[{number}]")
        self.drag(self.screen(self.teach(f"pose.furniture[{number}]")[:3]), float(self.rng.uniform(0.9, 1.4)), held)
        wait_until(self.page, f"manipLearnTeach.pose.held[{number}]")
        self.pause()

    def demonstrate(self, move: Callable[[MousePerson], None]) -> None:
        """Record one motion: to the first handle, what is to be shown, away again."""
        page, before = self.page, len(self.teach("state.recordings"))
        page.keyboard.press("r")
        wait_until(page, "manipLearnTeach.state.doing === 'recording'")
        self.take()
        self.pause()
        self.reach()
        move(self)
        page.keyboard.press("g")
        self.pause()
        self.drag(self.screen(self._home), float(self.rng.uniform(0.7, 1.1)))
        self.pause()
        page.mouse.up()
        self.pause()
        page.keyboard.press("r")
        wait_until(page, f"manipLearnTeach.state.recordings.length > {before}")

    def open_and_shut(self, far: float, out: np.ndarray, number: int = 0) -> None:
        """Pull a drawer out by its handle until it is open so far, and push it shut."""
        rest = np.array(self.teach(f"scene.handles[{number}].at"))
        away, shut = self.screen(rest + 1.6 * far * out), self.screen(rest - 0.4 * far * out)
        self.drag(away, float(self.rng.uniform(1.8, 2.6)), lambda: self.teach(f"pose.opening[{number}]") > far)
        self.pause()
        self.drag(shut, float(self.rng.uniform(1.4, 2.0)))
        self.pause()
