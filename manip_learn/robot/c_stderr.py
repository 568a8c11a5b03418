"""What C and C++ libraries print on stderr, caught instead of shown."""

from __future__ import annotations

import os
import sys
import tempfile
import threading
from collections.abc import Iterator
from contextlib import contextmanager

_one_at_a_time = threading.Lock()


@contextmanager
def captured_c_stderr() -> Iterator[list[str]]:
    """Collect the lines written to file descriptor 2; the list is filled when the block ends, also by an error.

    The descriptor belongs to the whole process: what other threads print meanwhile is collected too.
    """
    lines: list[str] = []
    with _one_at_a_time:
        if sys.stderr is not None:
            sys.stderr.flush()
        try:
            saved = os.dup(2)
        except OSError:  # no stderr, as in a service: nothing is lost that anybody could have seen
            yield lines
            return
        with tempfile.TemporaryFile() as sink:
            os.dup2(sink.fileno(), 2)
            try:
                yield lines
            finally:
                if sys.stderr is not None:
                    sys.stderr.flush()
                os.dup2(saved, 2)
                os.close(saved)
                sink.seek(0)
                text = sink.read(1_000_000).decode("utf-8", "replace")
                lines += [line.strip() for line in text.splitlines() if line.strip()]
