"""The process behind a live view; run as a script with nothing but the standard library, never imported.

It reads from stdin one line of JSON (`{"page": number of bytes, "token": text}`), the page, and then a line of JSON for
each pose. It serves the page and a stream of the newest pose on 127.0.0.1, and ends when stdin closes or its parent is
gone. One thread serves all connections, so that none of them can hold up another, however slowly it asks or reads.
"""

from __future__ import annotations

import asyncio
import json
import os
import sys
import threading
import time

HOST = "127.0.0.1"
REQUEST_SECONDS = 3.0  # in which a request must be complete: a browser on the same machine needs milliseconds
READER_SECONDS = 5.0  # a browser that does not take an event, or the page, for this long is dropped
HEARTBEAT_SECONDS = 2.0
PARENT_CHECK_SECONDS = 1.0
MAX_UNASKED = 150  # connections without a complete request; one more, and the oldest is closed
MAX_STREAMS = 50  # browsers at a time; all in all fewer files than the 256 that macOS lets a process open
MAX_REQUEST = 16_384  # [bytes] of a request with its headers: browsers send below 2,000
REASONS = {
    200: "OK",
    400: "Bad Request",
    403: "Forbidden",
    404: "Not Found",
    501: "Not Implemented",
    503: "Service Unavailable",
}
HEADERS = (
    "Cache-Control: no-store",
    "Connection: close",
    "X-Content-Type-Options: nosniff",
    "X-Frame-Options: DENY",
    "Referrer-Policy: no-referrer",
    "Cross-Origin-Resource-Policy: same-origin",
)


class LiveServer:
    """Serves one page and one stream of poses to browsers on this machine; slow readers skip poses."""

    def __init__(self, page: bytes, token: str):
        self._page, self._token = page, token
        self._own: dict[str, set[str]] = {}  # what a header must say, if it is there
        self._number, self._line, self._changed = 0, b"", asyncio.Event()
        self._unasked: dict[asyncio.StreamWriter, None] = {}  # oldest first
        self._streams = 0

    async def start(self) -> int:
        """Listen; the port."""
        server = await asyncio.start_server(self._serve, HOST, 0, limit=MAX_REQUEST, backlog=MAX_UNASKED)
        port = server.sockets[0].getsockname()[1]
        hosts = {f"{HOST}:{port}", f"localhost:{port}"}
        # a web site whose name was made to point at this machine sends its own name, another page its own origin
        self._own = {"host": hosts, "origin": {f"http://{host}" for host in hosts}}
        return port

    def put(self, line: bytes) -> None:
        """Replace the pose."""
        self._number, self._line = self._number + 1, line
        self._changed.set()
        self._changed = asyncio.Event()

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """One connection: its request, its answer, its end."""
        writer.transport.set_write_buffer_limits(0)  # drained is what has been taken
        self._unasked[writer] = None
        if len(self._unasked) > MAX_UNASKED:
            oldest = next(iter(self._unasked))
            del self._unasked[oldest]
            oldest.transport.abort()
        try:
            async with asyncio.timeout(REQUEST_SECONDS):
                request = await reader.readuntil(b"\r\n\r\n")
            self._unasked.pop(writer, None)
            await self._answer(request.decode("latin-1").split("\r\n"), writer)
            writer.close()
            async with asyncio.timeout(READER_SECONDS):
                await writer.wait_closed()
        except (TimeoutError, OSError, asyncio.IncompleteReadError, asyncio.LimitOverrunError):
            pass  # browsers that leave, and whoever is too slow or asks for too much, are no error
        finally:
            self._unasked.pop(writer, None)
            writer.transport.abort()

    async def _answer(self, request: list[str], writer: asyncio.StreamWriter) -> None:
        """The page or the stream, if they are asked for under this machine's own name."""
        method, _, rest = request[0].partition(" ")
        path, _, version = rest.partition(" ")
        headers = [(name.strip().lower(), value.strip()) for name, _, value in (h.partition(":") for h in request[1:])]
        if not version.startswith("HTTP/1."):
            await self._send(writer, 400, b"not a request\n")
        elif method != "GET":
            await self._send(writer, 501, b"only GET is served\n")
        elif "host" not in dict(headers) or any(v not in self._own.get(name, {v}) for name, v in headers):
            await self._send(writer, 403, b"this address is served under 127.0.0.1 only\n")
        elif path == f"/{self._token}/":
            await self._send(writer, 200, self._page, "text/html; charset=utf-8")
        elif path != f"/{self._token}/events":
            await self._send(writer, 404, b"not found\n")
        elif self._streams >= MAX_STREAMS:
            await self._send(writer, 503, b"too many browsers look at this page\n")
        else:
            self._streams += 1
            try:
                await self._stream(writer)
            finally:
                self._streams -= 1

    async def _stream(self, writer: asyncio.StreamWriter) -> None:
        """Events until the browser leaves, with a sign of life where nothing moves."""
        await self._send(writer, 200, None, "text/event-stream")
        seen = 0
        while True:
            if seen == self._number:
                try:
                    async with asyncio.timeout(HEARTBEAT_SECONDS):
                        await self._changed.wait()
                except TimeoutError:
                    await self._write(writer, b": still here\n\n")
                    continue
            seen = self._number
            await self._write(writer, b"data: " + self._line + b"\n\n")

    async def _send(
        self, writer: asyncio.StreamWriter, code: int, body: bytes | None, kind: str = "text/plain; charset=utf-8"
    ) -> None:
        """A whole answer, or its head alone if there is no body."""
        size = () if body is None else (f"Content-Length: {len(body)}",)
        lines = (f"HTTP/1.1 {code} {REASONS[code]}", f"Content-Type: {kind}", *size, *HEADERS, "", "")
        await self._write(writer, "\r\n".join(lines).encode() + (body or b""))

    async def _write(self, writer: asyncio.StreamWriter, data: bytes) -> None:
        writer.write(data)
        async with asyncio.timeout(READER_SECONDS):
            await writer.drain()


def end_with_parent(parent: int) -> None:
    """End this process when its parent is gone, even if another process keeps our stdin open."""
    while os.getppid() == parent:
        time.sleep(PARENT_CHECK_SECONDS)
    os._exit(0)


async def main() -> None:
    """Serve until stdin closes."""
    threading.Thread(target=end_with_parent, args=(os.getppid(),), daemon=True).start()
    header = json.loads(sys.stdin.buffer.readline())
    server = LiveServer(sys.stdin.buffer.read(header["page"]), header["token"])
    sys.stdout.write(json.dumps({"port": await server.start()}) + "\n")
    sys.stdout.flush()
    loop = asyncio.get_running_loop()

    def feed() -> None:
        for line in sys.stdin.buffer:
            loop.call_soon_threadsafe(server.put, line.strip())
        os._exit(0)  # without waiting for browsers

    await asyncio.to_thread(feed)


if __name__ == "__main__":
    asyncio.run(main())
