"""The process behind a live view; run as a script with nothing but the standard library, never imported.

It reads from stdin one line of JSON (`{"page": number of bytes, "token": text, "hears": bool}`), the page, and then
lines `SLOT JSON`, of which the newest of each slot counts. On 127.0.0.1 it serves the page, a stream of the newest
slots, and the files of the slot `files`. To stdout it writes `{"port": number}`, and if it hears, a line for each thing
that a page says (`{"page": its id, "said": {...}}`) and for each change of `{"pages": [ids]}`. It ends when stdin
closes or its parent is gone. Each connection has a thread of its own and a limit of time for whatever it does.
"""

from __future__ import annotations

import json
import mimetypes
import os
import re
import select
import shutil
import sys
import threading
import time
from collections.abc import Callable, Mapping
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from urllib.parse import quote, unquote

HOST = "127.0.0.1"
_SLOWEST = 5.0  # [s] that a browser may take for an event, the page or a part of its request, before it is dropped
HEARTBEAT = 2.0  # [s] between signs of life of a stream where nothing moves
MOST_STREAMS = 50  # browsers at a time
MOST_SAID = 16 * 2**20  # [bytes] of a body: recordings are dropped on the page
HEADERS = {
    "Cache-Control": "no-store",
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Resource-Policy": "same-origin",
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


class LiveServer(ThreadingHTTPServer):
    """Serves one page, one stream of slots and some files to browsers on this machine; slow readers skip lines."""

    daemon_threads = True
    request_queue_size = 128  # connections that wait for a thread

    def __init__(self, page: bytes, token: str, hears: bool):
        super().__init__((HOST, 0), _Answer)
        self.pages = {"": ("html", page), "afterwards.js": ("javascript", AFTERWARDS)}
        self.token, self.hears = token, hears
        hosts = {f"{HOST}:{self.server_port}", f"localhost:{self.server_port}"}
        # a web site whose name was made to point at this machine sends its own name, another page its own origin
        self.own = {"host": hosts, "origin": {f"http://{host}" for host in hosts}}
        self.slots: dict[str, tuple[int, bytes]] = {}  # each with the number of its change, the newest last
        self.number, self.changed = 0, threading.Condition()
        self.files: dict[str, str] = {}
        self.streams: list[str] = []  # page of each, oldest first
        self.moved = threading.Event()  # something about streams that the program has not been told
        self.speaking = threading.Lock()  # of stdout

    def put(self, slot: str, line: bytes) -> None:
        """Replace the content of a slot."""
        if slot == "files":
            self.files = json.loads(line)
            return
        with self.changed:
            self.number += 1
            self.slots.pop(slot, None)
            name = b"" if slot == "message" else b"event: " + slot.encode() + b"\n"
            self.slots[slot] = self.number, name + b"data: " + line + b"\n\n"
            self.changed.notify_all()

    def tell(self, line: bytes, patience: float = -1.0) -> None:
        """Write a line to the program; a busy one is waited for, at most so long [s].

        Raises:
            Refusal: It has not taken the lines before.
        """
        if not self.speaking.acquire(timeout=patience):
            raise Refusal(503, "the program is busy: say it again later")
        try:
            sys.stdout.buffer.write(line + b"\n")
            sys.stdout.buffer.flush()
        finally:
            self.speaking.release()

    def tell_pages(self) -> None:
        """Tell the program which pages there are, whenever that changes."""
        told: list[str] = []
        while True:
            self.moved.wait()
            self.moved.clear()
            pages = list(dict.fromkeys(self.streams))
            if pages != told:
                self.tell(json.dumps({"pages": pages}).encode())
            told = pages

    def handle_error(self, request: object, client_address: object) -> None:
        """Browsers that leave, and whoever is too slow, are no error."""


class _Answer(BaseHTTPRequestHandler):
    """The requests of one connection."""

    protocol_version, timeout = "HTTP/1.1", _SLOWEST
    error_message_format, error_content_type = "%(message)s\n", "text/plain; charset=utf-8"
    server: LiveServer

    def do_GET(self) -> None:
        """Answer with the page, the stream or a file."""
        self._answer(self._give)

    def do_POST(self) -> None:
        """Hear what a page says."""
        self._answer(self._hear)

    def log_message(self, format: str, *args: object) -> None:
        """Nobody reads it."""

    def end_headers(self) -> None:
        """End the head of an answer with what all of them have."""
        for name, value in HEADERS.items():
            self.send_header(name, value)
        super().end_headers()

    def _answer(self, give: Callable[[str, str], None]) -> None:
        """Answer a request if it was made under this machine's own name."""
        path, _, query = self.path.partition("?")
        try:
            names = [(name.lower(), value) for name, value in self.headers.items()]
            if self.headers["Host"] is None or any(v not in self.server.own.get(name, {v}) for name, v in names):
                raise Refusal(403, "this address is served under 127.0.0.1 only")
            give(path, query)
        except Refusal as refusal:
            self.send_error(*refusal.args)

    def _give(self, path: str, query: str) -> None:
        rest = path.removeprefix(f"/{self.server.token}/")
        if rest == "events":
            self._stream(self._page(query) if query or self.server.hears else "")
        elif rest.startswith("files/"):
            self._send_file(unquote(rest.removeprefix("files/")))
        elif rest in self.server.pages and not query:
            kind, body = self.server.pages[rest]
            self._head(f"text/{kind}; charset=utf-8", {"Content-Length": str(len(body))})
            self.wfile.write(body)
        else:
            raise Refusal(404, "not found")

    def _page(self, query: str) -> str:
        """Return the id of the page that asks."""
        found = re.fullmatch(r"page=([A-Za-z0-9-]{1,64})", query)
        if found is None:
            raise Refusal(400, "which page? page=ID is missing, of at most 64 letters, digits and hyphens")
        return found[1]

    def _hear(self, path: str, query: str) -> None:
        headers, length = self.headers, self.headers["Content-Length"] or ""
        has_length = headers["Transfer-Encoding"] is None and re.fullmatch("[0-9]+", length)
        size = int(length[:20]) if has_length else 0
        for is_wrong, code, why in (
            (not self.server.hears, 501, "only GET is served"),
            (headers["Origin"] is None, 403, "only a page of this address may say something: Origin is missing"),
            (path != f"/{self.server.token}/said", 404, "not found"),
            (headers.get_content_type() != "application/json", 415, "say it as application/json"),
            (not has_length, 411, "say its length: one Content-Length is needed"),
            (size > MOST_SAID, 413, f"too long: at most {MOST_SAID} bytes are taken"),
        ):
            if is_wrong:
                raise Refusal(code, why)
        page = self._page(query)
        try:
            said = json.loads(self.rfile.read(size).decode("utf-8"))
            if not isinstance(said, dict):
                raise ValueError(said)
            line = json.dumps({"page": page, "said": said}, allow_nan=False).encode()
        except (ValueError, RecursionError) as error:
            raise Refusal(400, "a JSON object of finite numbers is needed") from error
        self.server.tell(line, _SLOWEST)
        self.send_response_only(204)
        self.end_headers()

    def _stream(self, page: str) -> None:
        """Send the newest of each slot that has changed, with a sign of life where nothing moves, until the browser
        leaves, which its end of the connection tells.
        """
        server, seen, alive = self.server, 0, time.monotonic()
        if len(server.streams) >= MOST_STREAMS:
            raise Refusal(503, "too many browsers look at this page")
        server.streams.append(page)
        server.moved.set()
        try:
            self._head("text/event-stream", {"Connection": "close"})
            while not select.select([self.connection], [], [], 0.0)[0]:
                with server.changed:
                    if server.number == seen:
                        server.changed.wait(0.1)  # [s] between two looks whether the browser has left
                    news = [event for number, event in server.slots.values() if number > seen]
                    seen = server.number
                if not news and time.monotonic() > alive + HEARTBEAT:
                    news = [b": still here\n\n"]
                if news:
                    self.wfile.write(b"".join(news))
                    alive = time.monotonic()
        finally:
            server.streams.remove(page)
            server.moved.set()

    def _send_file(self, name: str) -> None:
        """Send a file that was offered under this name, to be kept."""
        path = self.server.files.get(name, "")
        if not os.path.isfile(path):
            raise Refusal(404, "not found")
        kind = mimetypes.guess_type(name)[0] or "application/octet-stream"
        with open(path, "rb") as file:
            kept = f"attachment; filename*=UTF-8''{quote(name, safe='')}"
            size = str(os.fstat(file.fileno()).st_size)
            charset = "; charset=utf-8" if kind.startswith("text/") else ""
            self._head(kind + charset, {"Content-Length": size, "Content-Disposition": kept})
            shutil.copyfileobj(file, self.wfile)

    def _head(self, kind: str, more: Mapping[str, str]) -> None:
        """Send the head of an answer that gives something."""
        self.send_response_only(200)
        for name, value in {"Content-Type": kind, **more}.items():
            self.send_header(name, value)
        self.end_headers()


def end_with_parent(parent: int) -> None:
    """End this process when its parent is gone, even if another process keeps our stdin open."""
    while os.getppid() == parent:
        time.sleep(1.0)  # [s]
    os._exit(0)


def main() -> None:
    """Serve until stdin closes."""
    header = json.loads(sys.stdin.buffer.readline())
    server = LiveServer(sys.stdin.buffer.read(header["page"]), header["token"], header["hears"])
    server.tell(json.dumps({"port": server.server_port}).encode())
    threading.Thread(target=end_with_parent, args=(os.getppid(),), daemon=True).start()
    threading.Thread(target=server.serve_forever, daemon=True).start()
    if server.hears:
        threading.Thread(target=server.tell_pages, daemon=True).start()
    for line in sys.stdin.buffer:
        slot, _, said = line.strip().partition(b" ")
        server.put(slot.decode(), said)
    os._exit(0)  # without waiting for browsers


if __name__ == "__main__":
    main()
