"""The parent's end of a live view: starts the server process and feeds it the newest pose."""

from __future__ import annotations

import contextlib
import json
import secrets
import selectors
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import final

from manip_learn.errors import OutputError

SERVER = Path(__file__).with_name("live_server.py")
FRAMES_PER_SECOND = 60.0
STOP_SECONDS = 2.0


@final
class LiveProcess:
    """A server process and the thread that writes to it.

    Whoever puts a message never waits: the thread takes the newest one, at most 60 times a second, and only the thread
    waits if the server is slow.

    Args:
        make_page: Token -> the page to serve.
        timeout: How long the server may take to start [s].

    Raises:
        OutputError: The server does not start.
    """

    def __init__(self, make_page: Callable[[str], bytes], timeout: float):
        token = secrets.token_urlsafe(18)
        self._page = make_page(token)
        self._newest: Callable[[], str] | None = None
        self._wake = threading.Event()
        self._closed = threading.Event()
        self._process = _started_server()
        self._thread = threading.Thread(target=self._feed, args=(token,), name="live view", daemon=True)
        self._thread.start()
        try:
            port = self._read_port(timeout)
        except OutputError:
            self.close()
            raise
        self.url = f"http://127.0.0.1:{port}/{token}/"

    @property
    def is_open(self) -> bool:
        """True while the server is there to be fed."""
        return not self._closed.is_set() and self._process.poll() is None

    def put(self, message: Callable[[], str]) -> None:
        """Hand over the newest message, as a function that makes its one line of text; it runs in the thread."""
        self._newest = message
        self._wake.set()

    def close(self) -> None:
        """End the server and the thread; twice does no harm."""
        self._closed.set()
        self._wake.set()
        if self._thread is not threading.current_thread():
            self._thread.join(STOP_SECONDS)
        if self._thread.is_alive():  # it waits in a write that nobody reads
            self._process.kill()
            self._thread.join(STOP_SECONDS)
        for pipe in (self._process.stdin, self._process.stdout):
            if pipe is not None:
                with contextlib.suppress(OSError):
                    pipe.close()
        try:
            self._process.wait(STOP_SECONDS)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()

    def _read_port(self, timeout: float) -> int:
        stdout = self._process.stdout
        if stdout is None:
            raise OutputError("the live view's server has no pipe to answer through")
        with selectors.DefaultSelector() as selector:
            selector.register(stdout, selectors.EVENT_READ)
            line = stdout.readline() if selector.select(timeout) else b""
        try:
            return int(json.loads(line)["port"])
        except (ValueError, KeyError) as error:
            raise OutputError(
                f"the live view's server did not start within {timeout:g} s: is there room for another process, and "
                "may it listen on 127.0.0.1?"
            ) from error

    def _feed(self, token: str) -> None:
        pipe = self._process.stdin
        if pipe is None:
            return
        try:
            pipe.write(json.dumps({"page": len(self._page), "token": token}).encode() + b"\n" + self._page)
            pipe.flush()
            while not self._closed.is_set():
                self._wake.wait()
                self._wake.clear()
                message, self._newest = self._newest, None
                if message is not None and not self._closed.is_set():
                    pipe.write(message().encode() + b"\n")
                    pipe.flush()
                    time.sleep(1.0 / FRAMES_PER_SECOND)
        except (OSError, ValueError):  # the server is gone, or the pipe was closed
            self._closed.set()


def _started_server() -> subprocess.Popen[bytes]:
    try:
        return subprocess.Popen(
            [sys.executable, "-I", str(SERVER)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            start_new_session=True,  # Ctrl-C is for the program, which then closes us
        )
    except OSError as error:
        raise OutputError(f"the live view's server cannot be started: {error}") from error
