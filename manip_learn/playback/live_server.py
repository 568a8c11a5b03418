"""The process behind a live view; run as a script with nothing but the standard library, never imported.

It reads from stdin one line of JSON (`{"page": number of bytes, "token": text, "hears": bool}`), the page, and then
lines `SLOT JSON`, of which the newest of each slot counts. On 127.0.0.1 it serves the page, a stream of the newest
slots, and the files of the slot `files`. To stdout it writes `{"port": number}`, and if it hears, a line for each thing
that a page says (`{"page": its id, "said": {...}}`) and for each change of `{"pages": [ids], "loading": number}`. It
ends when stdin closes or its parent is gone. One thread serves all connections, so that none of them can hold up
another, however slowly it asks, says or reads.
"""

from __future__ import annotations

import asyncio
import json
import os
import re
import stat
import sys
import threading
import time
from collections import deque
from collections.abc import Callable
from http import HTTPStatus
from typing import BinaryIO, NamedTuple
from urllib.parse import quote, unquote

HOST = "127.0.0.1"
REQUEST_SECONDS = 3.0  # in which a request must be complete: a browser on the same machine needs milliseconds
READER_SECONDS = 5.0  # a browser that does not take an event, or the page, for this long is dropped
HEARTBEAT_SECONDS = 2.0
# between two things that a page says: a minute spares the browser a new connection while a hand rests, and costs
# nothing, since whoever is idle for longest makes room; browsers give an idle connection up after two to five minutes
IDLE_SECONDS = 60.0
LOADING_SECONDS = 10.0  # from a page to its stream: a slow machine builds the scene in 2; later, the page was left
PARENT_CHECK_SECONDS = 1.0
MAX_UNASKED = 150  # connections without a complete request; one more, and the oldest is closed
MAX_STREAMS = 50  # browsers at a time
# connections that say something: a browser opens 6 to one server. One more, and the one idle for longest is closed. All
# three limits together are fewer files than the 256 that macOS lets a process open
MAX_SAYING = 30
MAX_REQUEST = 16_384  # [bytes] of a request with its headers: browsers send below 2,000
MAX_SAID = 16 * 2**20  # [bytes] of a body: recordings are dropped on the page, and hold the streams up for 0.4 s
PIECE = 2**18  # [bytes] of a file at a time: enough for full speed, and below a millisecond of one thread
STREAM_QUERY = re.compile(r"page=([A-Za-z0-9-]{1,64})")
HEADERS = (
    "Cache-Control: no-store",
    "X-Content-Type-Options: nosniff",
    "X-Frame-Options: DENY",
    "Referrer-Policy: no-referrer",
    "Cross-Origin-Resource-Policy: same-origin",
)
LAST = ("Connection: close",)
STAYS = ("Connection: keep-alive", f"Keep-Alive: timeout={IDLE_SECONDS:.0f}")
TEXT = "text/plain; charset=utf-8"
KINDS = {
    "csv": "text/csv; charset=utf-8",
    "gz": "application/gzip",
    "html": "text/html; charset=utf-8",
    "json": "application/json",
    "npz": "application/zip",
    "py": "text/x-python; charset=utf-8",
    "txt": TEXT,
    "zip": "application/zip",
}
# what a browser asks in our place, once we are gone; it forgets us when it has said so
AFTERWARDS = b"""const page = '<!DOCTYPE html><meta charset="utf-8"><title>Ended</title>\
<p>The program has ended. Start it again, and open its new page.';
async function ended() {
  await self.registration.unregister();
  return new Response(page, { headers: { "Content-Type": "text/html" } });
}
self.addEventListener("fetch", (event) => {
  if (event.request.mode === "navigate") event.respondWith(fetch(event.request).catch(ended));
});
"""


class Refusal(Exception):
    """An answer that gives nothing: its code, and why."""

    def __init__(self, code: int, says: str):
        super().__init__(says)
        self.code, self.says = code, says


class Request(NamedTuple):
    """The head of a request."""

    method: str
    path: str
    query: str
    version: str
    headers: list[tuple[str, str]]

    def of(self, name: str) -> str | None:
        """A header's value, the last one if there are more."""
        return dict(self.headers).get(name)


def parsed(head: bytes) -> Request:
    """A request's head, taken apart; odd ones too."""
    first, *lines = head.decode("latin-1").split("\r\n")
    method, _, rest = first.partition(" ")
    target, _, version = rest.partition(" ")
    path, _, query = target.partition("?")
    headers = [(name.strip().lower(), value.strip()) for name, _, value in (line.partition(":") for line in lines)]
    return Request(method, path, query, version, headers)


def object_line(body: bytes) -> bytes:
    """A JSON object on one line; ValueError if it is none, or has a number that is not finite."""
    try:
        said = json.loads(body.decode("utf-8"))
        line = json.dumps(said, allow_nan=False).encode()
    except RecursionError as error:
        raise ValueError("nested too deeply") from error
    if not isinstance(said, dict):
        raise ValueError("no object")
    return line


def opened(path: str) -> tuple[BinaryIO, int]:
    """A regular file and its size [bytes]."""
    file = open(path, "rb")
    state = os.fstat(file.fileno())
    if not stat.S_ISREG(state.st_mode):
        file.close()
        raise OSError(f"{path} is no regular file")
    return file, state.st_size


class Program(asyncio.BaseProtocol):
    """The program's end of our stdout."""

    def __init__(self) -> None:
        self._pipe: asyncio.WriteTransport | None = None
        self._free = asyncio.Event()  # it has taken all that was written

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Write to this pipe from now on."""
        if isinstance(transport, asyncio.WriteTransport):
            transport.set_write_buffer_limits(0)
            self._pipe = transport
            self._free.set()

    def pause_writing(self) -> None:
        """Something of a line is left here."""
        self._free.clear()

    def resume_writing(self) -> None:
        """Nothing is left here."""
        self._free.set()

    async def tell(self, line: Callable[[], bytes]) -> None:
        """Write a line, made once the program has taken those before."""
        await self._free.wait()
        if self._pipe is not None:
            self._pipe.write(line() + b"\n")


class LiveServer:
    """Serves one page, one stream of slots and some files to browsers on this machine; slow readers skip lines."""

    def __init__(self, page: bytes, token: str, hears: bool):
        self._page, self._token, self._hears = page, token, hears
        self._own: dict[str, set[str]] = {}  # what a header must say, if it is there
        self._slots: dict[str, tuple[int, bytes]] = {}  # each with the number of its change, the newest last
        self._number, self._changed = 0, asyncio.Event()
        self._files: dict[str, str] = {}
        self._unasked: dict[asyncio.StreamWriter, None] = {}  # oldest first
        self._saying: dict[asyncio.StreamWriter, None] = {}  # the one that has said nothing for longest first
        self._streams: dict[asyncio.StreamWriter, str] = {}  # page of each, oldest first
        self._known: set[str] = set()  # pages that have had a stream: they come back without being fetched
        self._loading: deque[asyncio.TimerHandle] = (
            deque()
        )  # of the pages fetched whose stream is not open, oldest first
        self._moved = asyncio.Event()  # something about pages that the program has not been told
        self._program = Program()

    async def start(self) -> int:
        """Listen; the port."""
        server = await asyncio.start_server(self._serve, HOST, 0, limit=MAX_REQUEST, backlog=MAX_UNASKED)
        port = server.sockets[0].getsockname()[1]
        hosts = {f"{HOST}:{port}", f"localhost:{port}"}
        # a web site whose name was made to point at this machine sends its own name, another page its own origin
        self._own = {"host": hosts, "origin": {f"http://{host}" for host in hosts}}
        return port

    async def tell(self, pipe: BinaryIO) -> None:
        """Tell the program through a pipe which pages there are, and what they say."""
        await asyncio.get_running_loop().connect_write_pipe(lambda: self._program, pipe)
        while True:
            await self._moved.wait()
            await self._program.tell(self._pages)  # one line, however often pages come and go meanwhile

    def _pages(self) -> bytes:
        self._moved.clear()
        pages = list(dict.fromkeys(page for page in self._streams.values() if page))
        return json.dumps({"pages": pages, "loading": len(self._loading)}).encode()

    def put(self, slot: str, line: bytes) -> None:
        """Replace the content of a slot."""
        if slot == "files":
            self._files = json.loads(line)
            return
        self._number += 1
        self._slots.pop(slot, None)
        name = b"" if slot == "message" else b"event: " + slot.encode() + b"\n"
        self._slots[slot] = self._number, name + b"data: " + line + b"\n\n"
        self._changed.set()
        self._changed = asyncio.Event()

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """One connection: its requests, their answers, its end."""
        writer.transport.set_write_buffer_limits(0)  # drained is what has been taken
        self._enter(self._unasked, MAX_UNASKED, writer)
        try:
            async with asyncio.timeout(REQUEST_SECONDS):
                asked = await reader.readuntil(b"\r\n\r\n")
            while await self._answer(parsed(asked), reader, writer):
                asked = await self._next_head(reader)
            writer.close()
            async with asyncio.timeout(READER_SECONDS):
                await writer.wait_closed()
        except (TimeoutError, OSError, asyncio.IncompleteReadError, asyncio.LimitOverrunError):
            pass  # browsers that leave, and whoever is too slow or asks for too much, are no error
        finally:
            self._unasked.pop(writer, None)
            self._saying.pop(writer, None)
            writer.transport.abort()

    def _enter(self, group: dict[asyncio.StreamWriter, None], most: int, writer: asyncio.StreamWriter) -> None:
        """Count a connection as the newest of one group, alone; whoever is one too many is closed."""
        self._unasked.pop(writer, None)
        self._saying.pop(writer, None)
        group[writer] = None
        if len(group) > most:
            oldest = next(iter(group))
            del group[oldest]
            oldest.transport.abort()

    async def _next_head(self, reader: asyncio.StreamReader) -> bytes:
        """The head of a further request on a connection, which may be idle before it begins, but not within it."""
        async with asyncio.timeout(IDLE_SECONDS) as clock:
            first = await reader.readexactly(1)
            clock.reschedule(asyncio.get_running_loop().time() + REQUEST_SECONDS)
            return first + await reader.readuntil(b"\r\n\r\n")

    async def _answer(self, request: Request, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> bool:
        """Answer a request if it was made under this machine's own name; whether the connection stays."""
        try:
            self._check(request)
            if request.method == "POST":
                await self._hear(request, reader, writer)
                stays = request.version == "HTTP/1.1" and "close" not in (request.of("connection") or "").lower()
                await self._write(writer, head(204, *(STAYS if stays else LAST)))
                await asyncio.sleep(0)  # a client that has sent many at once waits for the others, too
                return stays
            self._unasked.pop(writer, None)
            self._saying.pop(writer, None)
            await self._give(request, reader, writer)
        except Refusal as refusal:
            await self._send(writer, refusal.code, f"{refusal.says}\n".encode())
            if request.method == "POST":
                await self._let_finish(reader, writer)
        return False

    def _check(self, request: Request) -> None:
        """Refuse bad requests, methods that are not served, and other sites."""
        if not request.version.startswith("HTTP/1."):
            raise Refusal(400, "not a request")
        if request.method != "GET" and not (self._hears and request.method == "POST"):
            raise Refusal(501, "only GET and POST are served" if self._hears else "only GET is served")
        if request.of("host") is None or any(v not in self._own.get(name, {v}) for name, v in request.headers):
            raise Refusal(403, "this address is served under 127.0.0.1 only")
        if request.method == "POST" and request.of("origin") is None:
            raise Refusal(403, "only a page of this address may say something: Origin is missing")

    async def _give(self, request: Request, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """The page, the stream or a file."""
        room, _, rest = request.path[1:].partition("/")
        if room != self._token:
            raise Refusal(404, "not found")
        if rest == "events":
            page = self._id(request) if request.query or self._hears else ""
            await self._stream(page, reader, writer)
        elif rest == "afterwards.js":
            await self._send(writer, 200, AFTERWARDS, "text/javascript; charset=utf-8")
        elif rest.startswith("files/"):
            await self._send_file(unquote(rest.removeprefix("files/")), writer)
        elif rest == "" and request.path.endswith("/") and not request.query:
            self._loading.append(asyncio.get_running_loop().call_later(LOADING_SECONDS, self._given_up))
            self._moved.set()
            await self._send(writer, 200, self._page, "text/html; charset=utf-8")
        else:
            raise Refusal(404, "not found")

    def _given_up(self) -> None:
        """The oldest page that was fetched will open no stream any more."""
        self._loading.popleft()
        self._moved.set()

    def _id(self, request: Request) -> str:
        """The page that asks."""
        found = STREAM_QUERY.fullmatch(request.query)
        if found is None:
            raise Refusal(400, "which page? page=ID is missing, of at most 64 letters, digits and hyphens")
        return found[1]

    async def _hear(self, request: Request, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """Pass on what a page says."""
        if request.path != f"/{self._token}/said":
            raise Refusal(404, "not found")
        page, length = self._id(request), said_length(request)
        self._enter(self._saying, MAX_SAYING, writer)
        async with asyncio.timeout(REQUEST_SECONDS):
            body = await reader.readexactly(length)
        try:
            line = object_line(body)
            whole = b'{"page": "' + page.encode() + b'", "said": ' + line + b"}"
            async with asyncio.timeout(READER_SECONDS):  # it waits for a busy program, and nobody else does
                await self._program.tell(lambda: whole)
        except ValueError as error:
            raise Refusal(400, "a JSON object of finite numbers is needed") from error
        except TimeoutError as error:
            raise Refusal(503, "the program is busy: say it again later") from error
        self._enter(self._saying, MAX_SAYING, writer)

    async def _stream(self, page: str, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """Events until the browser leaves, which its end of the connection tells at once."""
        if len(self._streams) >= MAX_STREAMS:
            raise Refusal(503, "too many browsers look at this page")
        if page not in self._known and self._loading:
            self._loading.popleft().cancel()
        self._known.add(page)
        self._streams[writer] = page
        self._moved.set()
        tasks = [asyncio.create_task(self._send_events(writer)), asyncio.create_task(reader.read(1))]
        try:
            await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
        finally:
            del self._streams[writer]
            self._moved.set()
            writer.transport.abort()
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)

    async def _send_events(self, writer: asyncio.StreamWriter) -> None:
        """The newest of each slot that has changed, with a sign of life where nothing moves."""
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
            news = [event for number, event in self._slots.values() if number > seen]
            seen = self._number
            await self._write(writer, b"".join(news))

    async def _send_file(self, name: str, writer: asyncio.StreamWriter) -> None:
        """A file that was offered under this name, to be kept."""
        try:
            file, size = await asyncio.to_thread(opened, self._files[name])
        except (KeyError, OSError) as error:
            raise Refusal(404, "not found") from error
        with file:
            kind = KINDS.get(name.rpartition(".")[2].lower(), "application/octet-stream")
            kept = f"Content-Disposition: attachment; filename*=UTF-8''{quote(name, safe='')}"
            await self._send(writer, 200, None, kind, f"Content-Length: {size}", kept)
            while size:
                piece = await asyncio.to_thread(file.read, min(size, PIECE))
                if not piece:
                    raise OSError(f"{name} was cut while it was sent")
                await self._write(writer, piece)
                size -= len(piece)

    async def _let_finish(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """Take the rest of a refused request, without which a browser would not see why; not for long."""
        self._enter(self._unasked, MAX_UNASKED, writer)
        writer.write_eof()
        async with asyncio.timeout(REQUEST_SECONDS):
            while await reader.read(MAX_REQUEST):
                pass

    async def _send(
        self, writer: asyncio.StreamWriter, code: int, body: bytes | None, kind: str = TEXT, *more: str
    ) -> None:
        """A whole answer, or its head alone if there is no body."""
        size = () if body is None else (f"Content-Length: {len(body)}",)
        await self._write(writer, head(code, f"Content-Type: {kind}", *size, *more, *LAST) + (body or b""))

    async def _write(self, writer: asyncio.StreamWriter, data: bytes) -> None:
        writer.write(data)
        async with asyncio.timeout(READER_SECONDS):
            await writer.drain()


def head(code: int, *lines: str) -> bytes:
    """The head of an answer."""
    return "\r\n".join((f"HTTP/1.1 {code} {HTTPStatus(code).phrase}", *lines, *HEADERS, "", "")).encode()


def said_length(request: Request) -> int:
    """How long the JSON is that follows [bytes]."""
    if (request.of("content-type") or "").partition(";")[0].strip().lower() != "application/json":
        raise Refusal(415, "say it as application/json")
    lengths = {value for name, value in request.headers if name == "content-length"}
    length = lengths.pop() if len(lengths) == 1 else ""
    if request.of("transfer-encoding") is not None or not (length.isascii() and length.isdigit()):
        raise Refusal(411, "say its length: one Content-Length is needed")
    if len(length) > len(str(MAX_SAID)) or int(length) > MAX_SAID:
        raise Refusal(413, f"too long: at most {MAX_SAID} bytes are taken")
    return int(length)


def end_with_parent(parent: int) -> None:
    """End this process when its parent is gone, even if another process keeps our stdin open."""
    while os.getppid() == parent:
        time.sleep(PARENT_CHECK_SECONDS)
    os._exit(0)


async def main() -> None:
    """Serve until stdin closes."""
    threading.Thread(target=end_with_parent, args=(os.getppid(),), daemon=True).start()
    header = json.loads(sys.stdin.buffer.readline())
    server = LiveServer(sys.stdin.buffer.read(header["page"]), header["token"], header["hears"])
    sys.stdout.write(json.dumps({"port": await server.start()}) + "\n")
    sys.stdout.flush()
    loop = asyncio.get_running_loop()

    def feed() -> None:
        for line in sys.stdin.buffer:
            slot, _, said = line.strip().partition(b" ")
            loop.call_soon_threadsafe(server.put, slot.decode(), said)
        os._exit(0)  # without waiting for browsers

    tasks = [asyncio.to_thread(feed)]
    if header["hears"]:
        tasks.append(server.tell(sys.stdout.buffer))
    await asyncio.gather(*tasks)


if __name__ == "__main__":
    asyncio.run(main())
