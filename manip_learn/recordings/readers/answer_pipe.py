"""What a parsing process answers, read from its pipe for no longer than it may take."""

from __future__ import annotations

import os
import selectors
import time
from typing import final

PIECE = 1 << 20  # bytes that are asked for at a time


@final
class AnswerPipe:
    """Lines and numbers of bytes from a pipe, each with a deadline: no thread has to watch the clock.

    What is not there in time raises a TimeoutError.

    Args:
        descriptor: Of the pipe's end that is read; nobody else reads from it.
    """

    def __init__(self, descriptor: int):
        self._descriptor = descriptor
        self._held = bytearray()
        self._selector = selectors.DefaultSelector()
        self._selector.register(descriptor, selectors.EVENT_READ)

    def line(self, deadline: float) -> bytes:
        """The next line, with its end; what there was of it if the pipe was closed before.

        Args:
            deadline: On the clock of `time.monotonic` [s].
        """
        start = 0
        while (end := self._held.find(b"\n", start)) < 0:
            start = len(self._held)
            if not self._more(deadline):
                return self._taken(start)
        return self._taken(end + 1)

    def content(self, size: int, deadline: float) -> bytes:
        """So many bytes, fewer if the pipe was closed before.

        Args:
            size: How many.
            deadline: On the clock of `time.monotonic` [s].
        """
        while len(self._held) < size and self._more(deadline):
            pass
        return self._taken(min(size, len(self._held)))

    def close(self) -> None:
        """Forget the pipe, which its owner closes."""
        self._selector.close()

    def _more(self, deadline: float) -> bool:
        """Wait for bytes; False if the pipe is closed."""
        remaining = deadline - time.monotonic()
        if remaining <= 0.0 or not self._selector.select(remaining):
            raise TimeoutError
        piece = os.read(self._descriptor, PIECE)
        self._held += piece
        return bool(piece)

    def _taken(self, size: int) -> bytes:
        taken = bytes(memoryview(self._held)[:size])
        del self._held[:size]
        return taken
