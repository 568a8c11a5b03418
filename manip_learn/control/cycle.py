"""What the cycles of `run` and `record` share: a clock, a collector at rest, and an end in order, however it comes."""

from __future__ import annotations

import atexit
import gc
import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any, Protocol, final

LONGEST_END = 12.0  # [s] that the interpreter waits for an arm to brake and to hold itself
SPIN = 2e-4  # [s] before a cycle begins, from which on it is waited for awake: sleeping may wake up late


class Clock(Protocol):
    """Where a cycle takes its time from."""

    def now(self) -> float:
        """The time [s]; it never falls."""
        ...

    def wait_until(self, moment: float) -> object:
        """Return at a time [s], or at once where that is over."""
        ...


@final
class ComputerClock:
    """The time that passes here."""

    @staticmethod
    def now() -> float:
        """Since an arbitrary moment [s]."""
        return time.perf_counter()

    @staticmethod
    def wait_until(moment: float) -> None:
        """Sleep, then spin."""
        while (left := moment - time.perf_counter()) > 0.0:
            if left > SPIN:
                time.sleep(left - SPIN)


@contextmanager
def quiet_collector() -> Iterator[None]:
    """No garbage collection inside: one was seen to take 260 ms."""
    ran = gc.isenabled()
    gc.collect()
    gc.freeze()
    gc.disable()
    try:
        yield
    finally:
        gc.unfreeze()
        if ran:
            gc.enable()


@final
class GivenUp(KeyboardInterrupt):
    """A signal while a call of the driver was not returning; its argument says for how long [s]."""


@final
class OrderlyEnd:
    """However a cycle ends, the arm holds itself: by a signal, an exception, or with the interpreter.

    Ctrl-C, SIGTERM and SIGHUP (a stopped container, a closed terminal) ask the cycle to end, wherever it is. They come
    to the main thread; a cycle in another one, which would be killed with a daemon thread, is asked when the
    interpreter ends, and waited for. A program that was started to ignore SIGTERM or SIGHUP, as by nohup, goes on
    ignoring it. After one of these two, once the cycle has ended, the program's own handler is called; where there is
    none, the program ends by `SystemExit` with 128 and the number of the signal. What cannot be caught (kill -9, a loss
    of power) needs a watchdog in the driver or in the arm.

    Args:
        driver: Its `hold()`, where it has one, is called at the end.
        stop: Told what ends the cycle, in words.
        patience: Time that a call of the driver may take [s]; a signal after that gives the call up.
        clock: Measures that time.

    Attributes:
        asked: Whether a signal has come.
        holds: Whether `hold()` is to be called; a driver that has not returned from one call is not asked for another.
        failed: What went wrong with `hold()`, in words, or nothing.
    """

    def __init__(self, driver: object, stop: Callable[[str], object], patience: float, clock: Clock):
        self._driver, self._stop, self._patience, self._clock = driver, stop, patience, clock
        self._called: float | None = None  # when the driver was called that has not returned yet
        self._before: dict[int, Any] = {}
        self._pressed, self.asked, self.holds, self.failed = False, False, True, ""
        self._ends_by: int | None = None
        self._over = threading.Event()

    @contextmanager
    def waiting(self) -> Iterator[None]:
        """A call of the driver; raises `GivenUp` by a signal if it does not return, or by a second Ctrl-C."""
        self._called = self._clock.now()
        try:
            yield
        finally:
            self._called = None

    def __enter__(self) -> OrderlyEnd:
        if threading.current_thread() is not threading.main_thread():
            atexit.register(self._interpreter_ends)
            return self
        for name in ("SIGINT", "SIGTERM", "SIGHUP"):
            number = getattr(signal, name, None)  # Windows has no SIGHUP
            before = None if number is None else signal.getsignal(number)  # None where it is not Python's to put back
            if number is not None and before is not None and (before != signal.SIG_IGN or number == signal.SIGINT):
                self._before[number] = signal.signal(number, self._received)
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        hold = getattr(self._driver, "hold", None) if self.holds or kind is not None else None
        try:
            if hold is not None:
                with self.waiting():
                    hold()
        except GivenUp as error:
            self.failed = f"the driver's hold() had not returned for {error.args[0]:.2g} s"
        except Exception as error:  # whatever a driver raises, what was recorded is kept
            self.failed = f"the driver's hold() failed: {type(error).__name__}: {error}"
        finally:
            self._over.set()
            atexit.unregister(self._interpreter_ends)
            for number, handler in self._before.items():
                signal.signal(number, handler)
        if self._ends_by is None:
            return
        handler = self._before[self._ends_by]
        if not callable(handler):
            raise SystemExit(128 + self._ends_by)  # as a shell says it
        handler(self._ends_by, None)

    def _interpreter_ends(self) -> None:
        """The main thread is over: brake, before this thread is killed."""
        self.asked = True
        self._stop("the interpreter ended")
        self._over.wait(LONGEST_END)

    def _received(self, number: int, frame: FrameType | None) -> None:
        """Stop; in a call of the driver that does not return, give that call up.

        Raises:
            GivenUp: In the call of the driver.
        """
        by_hand = number == signal.SIGINT
        again = by_hand and self._pressed  # not of a SIGHUP, which kernel and shell may both send
        self._pressed, self.asked = self._pressed or by_hand, True
        self._ends_by = self._ends_by if by_hand else number
        self._stop("Ctrl-C" if by_hand else signal.Signals(number).name)
        taken = 0.0 if self._called is None else self._clock.now() - self._called
        if self._called is not None and (again or taken > self._patience):
            raise GivenUp(taken)
