"""The process behind a live view; run as a script with nothing but the standard library, never imported.

It reads from stdin lines `SLOT JSON`, of which the newest of each slot counts; the first has `{"page": HTML, "token":
text, "hears": whether pages may say something}`. On 127.0.0.1 it serves the page, a stream of the newest slots, and the
files of the slot `files`.
To stdout it writes its port, and then a line for each thing that a page says (`{"page": its id, "said": {...}}`) and
`{"pages": [ids]}` whenever one comes or goes. It ends when stdin closes or its parent is gone. Each connection has a
thread of its own and a limit of time for whatever it does. stderr is read by nobody: the messages of `http.server` end
there.
"""

from __future__ import annotations

import json
import os
import re
import select
import sys
import threading
import time
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from urllib.parse import unquote

HOST = "127.0.0.1"
SLOWEST = 5.0  # [s] that a browser or the program may take for a part of what is said
MOST_STREAMS = 50  # browsers at a time
MOST_SAID = 16 * 2**20  # [bytes] of a body: recordings are dropped on the page
PAGE_ID = re.compile("[A-Za-z0-9-]{1,64}")
HEADERS = {
    "Cache-Control": "no-store",
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Resource-Policy": "same-origin",
}

# what a browser asks in our place, once we are gone; it forgets us when it has said so
AFTERWARDS = b"""const words = "The program has ended. Start it again, and open its new page.";
const ended = () => self.registration.unregister().then(() => new Response(words));
self.addEventListener("fetch", (event) => {
  if (event.request.mode === "navigate") event.respondWith(fetch(event.request).catch(ended));
});
"""


class LiveServer(ThreadingHTTPServer):
    """Serves one page, one stream of slots and some files to browsers on this machine; slow readers skip lines."""

    request_queue_size = 128  # connections that wait for a thread

    def __init__(self, page: str, token: str, hears: bool):
        super().__init__((HOST, 0), _Answer)
        self.root, self.hears = f"/{token}/", hears
        self.origins = {f"http://{name}:{self.server_port}" for name in (HOST, "localhost")}
        self.pages = {"": ("html", page.encode()), "afterwards.js": ("javascript", AFTERWARDS)}
        self.slots: dict[bytes, tuple[int, bytes]] = {}  # each with the number of its change, the newest last
        self.number, self.changed = 0, threading.Condition()
        self.files: dict[str, str] = {}
        self.streams: list[str] = []  # page of each, oldest first
        self.speaking = threading.RLock()  # of stdout

    def put(self, slot: bytes, line: bytes) -> None:
        """Replace the content of a slot."""
        if slot == b"files":
            self.files = json.loads(line)
            return
        with self.changed:
            self.number += 1
            self.slots.pop(slot, None)
            self.slots[slot] = self.number, b"event: " + slot + b"\ndata: " + line + b"\n\n"
            self.changed.notify_all()

    def tell(self, said: object) -> None:
        """Write a line to the program; a busy one is waited for."""
        with self.speaking:
            print(json.dumps(said), flush=True)

    def tell_pages(self) -> None:
        """Tell the program which pages there are; one that comes again before its first stream ends counts once."""
        with self.speaking:
            self.tell({"pages": list(dict.fromkeys(self.streams))})


class _Answer(SimpleHTTPRequestHandler):
    """The requests of one connection."""

    protocol_version = "HTTP/1.1"
    timeout = SLOWEST
    path, page = "", ""  # below the secret address, and the id of the page that asks
    server: LiveServer

    def parse_request(self) -> bool:
        """Refuse requests that are not made under this machine's own name, or not below the secret address."""
        if not super().parse_request():
            return False
        # a web site whose name was made to point at this machine sends its own name, another page its own origin
        own = f"http://{self.headers['Host']}"
        if not {own, self.headers.get("Origin", own)} <= self.server.origins:
            self.send_error(403, "this address is served under 127.0.0.1 only")
        elif not self.path.startswith(self.server.root):
            self.send_error(404)
        else:
            self.path, _, self.page = self.path.removeprefix(self.server.root).partition("?page=")
            return True
        return False

    def end_headers(self) -> None:
        """End the head of an answer with what all of them have."""
        attachment = {"Content-Disposition": "attachment"} if self.path.startswith("files/") else {}
        for name, value in (HEADERS | attachment).items():
            self.send_header(name, value)
        super().end_headers()

    def do_GET(self) -> None:
        """Answer with the page, the stream or a file."""
        if self.path == "events":
            self._stream()
        elif self.path in self.server.pages:
            kind, body = self.server.pages[self.path]
            self._head(f"{kind}; charset=utf-8", "Content-Length", str(len(body)))
            self.wfile.write(body)
        else:
            super().do_GET()

    def translate_path(self, path: str) -> str:
        """Return the file that was offered under this path, or an empty name, which no file has."""
        offered = self.server.files.get(unquote(path), "")
        return offered if os.path.isfile(offered) else ""

    def do_POST(self) -> None:
        """Hear what a page says: a JSON object of finite numbers, with its length."""
        headers, length = self.headers, self.headers["Content-Length"] or ""
        is_counted = length.isascii() and length.isdigit() and headers["Transfer-Encoding"] is None
        is_long = is_counted and (len(length) > len(str(MOST_SAID)) or int(length) > MOST_SAID)
        is_json = headers["Content-Type"] is not None and headers.get_content_type() == "application/json"
        refusals = {
            501: not self.server.hears,
            403: headers["Origin"] is None,  # only a page of this address may say something
            404: self.path != "said",
            415: not is_json,
            400: not PAGE_ID.fullmatch(self.page),
            411: not is_counted,
            413: is_long,
        }
        if (refused := next((code for code, applies in refusals.items() if applies), None)) is not None:
            return self.send_error(refused)
        try:
            said = json.loads(self.rfile.read(int(length)).decode())
            json.dumps(said, allow_nan=False)
        except (ValueError, RecursionError):
            said = None
        if not isinstance(said, dict):
            return self.send_error(400)
        if not self.server.speaking.acquire(timeout=SLOWEST):
            return self.send_error(503)  # the program has not taken the lines before
        try:
            self.server.tell({"page": self.page, "said": said})
        finally:
            self.server.speaking.release()
        self.send_response(204)
        self.end_headers()

    def _stream(self) -> None:
        """Send the newest of each slot that has changed until the browser leaves, which its end tells."""
        server, seen = self.server, 0
        if (server.hears or self.page) and not PAGE_ID.fullmatch(self.page):
            return self.send_error(400)
        if len(server.streams) >= MOST_STREAMS:
            return self.send_error(503)
        server.streams.append(self.page)
        try:
            server.tell_pages()
            self._head("event-stream", "Connection", "close")
            while not select.select([self.connection], [], [], 0.0)[0]:
                with server.changed:
                    if server.number == seen:
                        server.changed.wait(0.1)  # [s] between two looks whether the browser has left
                    news = [event for number, event in server.slots.values() if number > seen]
                    seen = server.number
                self.wfile.write(b"".join(news))
        finally:
            server.streams.remove(self.page)
            server.tell_pages()

    def _head(self, kind: str, name: str, value: str) -> None:
        """Send the head of an answer of some kind of text, with one more header."""
        self.send_response(200)
        self.send_header("Content-Type", f"text/{kind}")
        self.send_header(name, value)
        self.end_headers()


def end_with_parent(parent: int) -> None:
    """End this process when its parent is gone, even if another process keeps our stdin open."""
    while os.getppid() == parent:
        time.sleep(1.0)  # [s]
    os._exit(0)


def main() -> None:
    """Serve until stdin closes."""
    server = LiveServer(**json.loads(sys.stdin.buffer.readline().partition(b" ")[2]))
    server.tell(server.server_port)
    threading.Thread(target=end_with_parent, args=(os.getppid(),), daemon=True).start()
    threading.Thread(target=server.serve_forever, daemon=True).start()
    for line in sys.stdin.buffer:
        slot, _, said = line.strip().partition(b" ")
        server.put(slot, said)
    os._exit(0)  # without waiting for browsers


if __name__ == "__main__":
    main()
