"""The process behind a live view; run as a script with nothing but the standard library, never imported.

It reads from stdin one line of JSON (`{"page": number of bytes, "token": text}`), the page, and then a line of JSON for
each pose. It serves the page and a stream of the newest pose on 127.0.0.1, and ends when stdin closes or its parent is
gone.
"""

from __future__ import annotations

import json
import os
import sys
import threading
import time
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

HOST = "127.0.0.1"
SOCKET_SECONDS = 5.0  # a browser that reads nothing for this long is dropped
HEARTBEAT_SECONDS = 2.0
PARENT_CHECK_SECONDS = 1.0
MAX_CONNECTIONS = 24


class Newest:
    """The newest pose; slow readers skip the ones in between."""

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._number = 0
        self._line = b""

    def put(self, line: bytes) -> None:
        """Replace the pose."""
        with self._changed:
            self._number += 1
            self._line = line
            self._changed.notify_all()

    def wait(self, seen: int, seconds: float) -> tuple[int, bytes]:
        """The newest pose and its number, once it is not number `seen`, or after so many seconds."""
        with self._changed:
            self._changed.wait_for(lambda: self._number != seen, seconds)
            return self._number, self._line


class LiveServer(ThreadingHTTPServer):
    """Serves one page and one stream to browsers on this machine."""

    daemon_threads = True
    allow_reuse_address = False

    def __init__(self, page: bytes, token: str):
        super().__init__((HOST, 0), Handler)
        self.page, self.token, self.newest = page, token, Newest()
        port = self.server_address[1]
        self.hosts = {f"{HOST}:{port}", f"localhost:{port}"}
        self._room = threading.BoundedSemaphore(MAX_CONNECTIONS)

    def process_request(self, request: Any, client_address: Any) -> None:
        """Refuse more connections than there is room for."""
        if self._room.acquire(blocking=False):
            super().process_request(request, client_address)
        else:
            self.shutdown_request(request)

    def process_request_thread(self, request: Any, client_address: Any) -> None:
        """Make room again when a connection ends."""
        try:
            super().process_request_thread(request, client_address)
        finally:
            self._room.release()

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Disconnecting browsers are not an error."""


class Handler(BaseHTTPRequestHandler):
    """Answers GET for two paths, if they are asked for under this machine's own name."""

    server: LiveServer
    timeout = SOCKET_SECONDS
    server_version = "manip_learn"
    sys_version = ""

    def do_GET(self) -> None:  # noqa: N802 (the name is the base class's)
        """The page, or the stream of poses."""
        # a web site whose name was made to point at this machine sends its own name here
        if self.headers.get("Host", "") not in self.server.hosts:
            self._refuse(403, "this address is served under 127.0.0.1 only")
        elif self.path == f"/{self.server.token}/":
            self._begin("text/html; charset=utf-8", len(self.server.page))
            self.wfile.write(self.server.page)
        elif self.path == f"/{self.server.token}/events":
            self._begin("text/event-stream", None)
            self._stream()
        else:
            self._refuse(404, "not found")

    def _begin(self, kind: str, size: int | None, code: int = 200) -> None:
        self.send_response(code)
        self.send_header("Content-Type", kind)
        if size is not None:
            self.send_header("Content-Length", str(size))
        for name, value in (
            ("Cache-Control", "no-store"),
            ("Connection", "close"),
            ("X-Content-Type-Options", "nosniff"),
            ("X-Frame-Options", "DENY"),
            ("Referrer-Policy", "no-referrer"),
            ("Cross-Origin-Resource-Policy", "same-origin"),
        ):
            self.send_header(name, value)
        self.end_headers()

    def _refuse(self, code: int, reason: str) -> None:
        body = (reason + "\n").encode()
        self._begin("text/plain; charset=utf-8", len(body), code)
        self.wfile.write(body)

    def _stream(self) -> None:
        seen = 0
        while True:
            number, line = self.server.newest.wait(seen, HEARTBEAT_SECONDS)
            self.wfile.write(b": still here\n\n" if number == seen else b"data: " + line + b"\n\n")
            self.wfile.flush()
            seen = number

    def log_message(self, format: str, *args: object) -> None:
        """No log: the terminal belongs to the calling program."""


def end_with_parent(parent: int) -> None:
    """End this process when its parent is gone, even if another process keeps our stdin open."""
    while os.getppid() == parent:
        time.sleep(PARENT_CHECK_SECONDS)
    os._exit(0)


def main() -> None:
    """Serve until stdin closes."""
    threading.Thread(target=end_with_parent, args=(os.getppid(),), daemon=True).start()
    header = json.loads(sys.stdin.buffer.readline())
    page = sys.stdin.buffer.read(header["page"])
    server = LiveServer(page, header["token"])
    threading.Thread(target=server.serve_forever, daemon=True).start()
    sys.stdout.write(json.dumps({"port": server.server_address[1]}) + "\n")
    sys.stdout.flush()
    for line in sys.stdin.buffer:
        server.newest.put(line.strip())
    os._exit(0)  # without waiting for browsers


if __name__ == "__main__":
    main()
