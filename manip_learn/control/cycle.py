"""What the cycles of `run` and `record` share: a clock, a period, and an end in order, however it comes."""

from __future__ import annotations

import atexit
import gc
import math
import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, Protocol, final

from manip_learn.control.timing import in_milliseconds


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

    def now(self) -> float:
        """Since an arbitrary moment [s]."""
        return time.perf_counter()

    def wait_until(self, moment: float) -> None:
        """Sleep, then spin: sleeping may wake up 0.2 ms late."""
        time.sleep(max(0.0, moment - time.perf_counter() - 2e-4))
        while time.perf_counter() < moment:
            pass


@final
class Pace:
    """Cycles of a driver, one per period; the clock of a simulated driver is their number.

    Args:
        driver: Its `period`, and whether it is `simulated`.
        clock: Where the time of other drivers comes from.

    Attributes:
        period: Between two cycles [s].
        simulated: True if the cycles are not waited for.
        cycles: Number of cycles, counted by the caller.
        overruns: Number of cycles that began late by more than half a period.
        longest_delay: Of the beginning of a cycle [s].
        fault: Why the period is not held, in words; empty if it is.
    """

    def __init__(self, driver: Any, clock: Clock):
        self._driver, self._clock, self.period = driver, clock, float(driver.period)
        self.simulated = bool(getattr(driver, "simulated", False))
        self.cycles, self.overruns, self.longest_delay, self.fault = 0, 0, 0.0, ""
        self._missed, self._due = 0.0, clock.now()  # share of the periods of late that were missed, next cycle [s]
        self.begin()

    def begin(self) -> None:
        """Count the time of a clock from the next cycle on."""
        self._start, self._began = self._due, ComputerClock().now()

    @property
    def time(self) -> float:
        """Time since `begin`, that of a simulated driver since its first cycle [s]."""
        return self.cycles * self.period if self.simulated else self._clock.now() - self._start

    def wait(self) -> float:
        """Wait for the next cycle and return when it begins [s]; a period that was missed is not made up for."""
        period, time, late = self.period, self.time, 0.0
        if not self.simulated:
            self._clock.wait_until(self._due)
            time = self.time
            late = time + self._start - self._due
        self.longest_delay = max(self.longest_delay, late)
        self.overruns += late > 0.5 * period
        missed = int(max(0.0, late) / period)
        # where half of the periods of a second were missed, the period cannot be held
        self._missed += (missed / (missed + 1.0) - self._missed) * min(1.0, (missed + 1.0) * period)
        if self._missed > 0.5 * (1.0 - math.exp(-1.0)):
            seconds = ComputerClock().now() - self._began
            self.fault = f"the period of {1e3 * period:g} ms cannot be held: cycles begin {1e3 * late:.2g} ms late"
            if in_milliseconds(time, seconds):
                self.fault += f"; the clock went on by {time:.3g} in {seconds:.1g} s: it is to count seconds"
        if self._driver.period != period:
            self.fault = f"the driver's period changed from {1e3 * period:g} to {1e3 * self._driver.period:g} ms"
        self._due += period * (missed + 1)
        return time


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
    of power) needs a watchdog in the driver or in the arm. Meanwhile no garbage is collected: that was seen to take
    260 ms.

    Args:
        driver: Its `hold()`, where it has one, is called at the end.
        brake: Called once, when there is a reason to end.
        patience: Time that a call of the driver may take [s]; a signal after that gives the call up.
        clock: Measures that time.

    Attributes:
        reason: Why the cycle is to end, in words; empty so far.
        ordered: Whether it ends for that reason as it was meant to.
        signals: Those that have come; the end of the interpreter counts as Ctrl-C.
        holds: Whether `hold()` is to be called; a driver that has not returned from one call is not asked for another.
        failed: Call that was given up, or `hold()` that raised -> what went wrong, in words.
        raised: What is to be raised when the arm stands.
    """

    def __init__(self, driver: object, brake: Callable[[], object], patience: float, clock: Clock):
        self._driver, self._brake, self._patience, self._clock = driver, brake, patience, clock
        self.reason, self.ordered, self.holds, self._collected = "", False, True, gc.isenabled()
        self.failed: dict[str, str] = {}
        self.raised: BaseException | None = None
        self.signals: list[int] = []
        self._called = math.inf  # when the driver was called that has not returned yet [s]
        self._before: dict[int, Any] = {}  # handlers of signals
        self._over = threading.Event()

    def stop(self, reason: str, ordered: bool = False) -> None:
        """Brake, and end when the arm stands; the first reason counts, an empty one is none."""
        if reason and not self.reason:
            self.reason, self.ordered = reason, ordered
            self._brake()

    @property
    def outcome(self) -> tuple[str, bool]:
        """Why the cycle ended and what failed then, in words; and whether it ended as it was meant to."""
        return "; ".join((self.reason, *self.failed.values())), self.ordered and not self.failed

    @contextmanager
    def waiting(self, call: str) -> Iterator[None]:
        """A call of the driver, which a signal gives up if it does not return, as does a second Ctrl-C."""
        self._called = self._clock.now()
        try:
            yield
        except GivenUp as error:
            self.failed[call] = f"the driver's {call}() had not returned for {error.args[0]:.2g} s"
        finally:
            self._called = math.inf

    def ask(self, call: str, *arguments: Any) -> Any:
        """Return the driver's answer; None where it has no such call, or one that does not return or raises."""
        try:
            if call not in self.failed and (function := getattr(self._driver, call, None)) is not None:
                with self.waiting(call):
                    return function(*arguments)
        except KeyboardInterrupt:
            self.stop("Ctrl-C", True)
        except BaseException as error:  # whatever it is, an arm in motion must brake: it is raised when the arm stands
            self.stop(f"the driver's {call}() failed: {type(error).__name__}: {error}")
            self.raised = self.raised if isinstance(error, Exception) else error
        return None

    def __enter__(self) -> None:
        atexit.register(self._interpreter_ends)
        names = ("SIGINT", "SIGTERM", "SIGHUP") if threading.current_thread() is threading.main_thread() else ()
        for number in [number for number in signal.Signals if number.name in names]:  # Windows has no SIGHUP
            before = signal.getsignal(number)  # None where it is not Python's to put back
            if before is not None and (before != signal.SIG_IGN or number == signal.SIGINT):
                self._before[number] = signal.signal(number, self._receive)
        gc.collect()
        gc.disable()

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if self._collected:
            gc.enable()
        try:
            if self.holds or kind is not None:
                with self.waiting("hold"):
                    getattr(self._driver, "hold", lambda: None)()
        except Exception as error:  # whatever a driver raises, what was recorded is kept
            self.failed["hold"] = f"the driver's hold() failed: {type(error).__name__}: {error}"
        finally:
            self._over.set()
            atexit.unregister(self._interpreter_ends)
            for number, handler in self._before.items():
                signal.signal(number, handler)
        for number in [number for number in self.signals if number != signal.SIGINT][-1:]:
            if not callable(handler := self._before[number]):
                raise SystemExit(128 + number)  # as a shell says it
            handler(number, None)

    def _interpreter_ends(self) -> None:
        """The main thread is over: brake, before this thread is killed."""
        self.signals.append(signal.SIGINT)
        self.stop("the interpreter ended", True)
        self._over.wait(12.0)  # [s] for the arm to brake and to hold itself

    def _receive(self, number: int, frame: object) -> None:
        """Stop; in a call of the driver that does not return, give that call up.

        Raises:
            GivenUp: In the call of the driver.
        """
        by_hand = number == signal.SIGINT
        again = by_hand and number in self.signals  # not of a SIGHUP, which kernel and shell may both send
        self.signals.append(number)
        self.stop("Ctrl-C" if by_hand else signal.Signals(number).name, True)
        taken = self._clock.now() - self._called  # negative if no call is under way
        if taken > self._patience or (again and taken >= 0.0):
            raise GivenUp(taken)
