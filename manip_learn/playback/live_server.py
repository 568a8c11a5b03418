"""Server process of a live view; run as a script with the standard library only.

It reads lines `SLOT JSON` from stdin; the newest line of each slot is valid. The first line has `{"page": HTML,
"token": text, "hears": whether pages may post}`. On 127.0.0.1 it serves the page, a stream of the newest slots, and the
files of the slot `files`.
To stdout it writes its port, then a line for each message that a page posts (`{"page": its id, "said": {...}}`) and
`{"pages": [ids]}` whenever a page opens or closes. It ends when stdin closes or its parent process is gone. Each
connection has its own thread and a time limit for every operation. stderr is not read: it receives the messages of
`http.server`.
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
TIMEOUT = 5.0  # [s] for a browser to send or take data, and for the program to take a line
PAGE_ID = re.compile("[A-Za-z0-9-]{1,64}")
HEADERS = {
    "Cache-Control": "no-store",
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Resource-Policy": "same-origin",
}

# service worker that answers in the browser after this process has ended, and then unregisters itself
SERVICE_WORKER = b"""const words = "The program has ended. Start it again, and open its new page.";
const ended = () => self.registration.unregister().then(() => new Response(words));
self.addEventListener("fetch", (event) => {
  if (event.request.mode === "navigate") event.respondWith(fetch(event.request).catch(ended));
});
"""


class LiveServer(ThreadingHTTPServer):
    """HTTP server for browsers on this machine, with one page, a stream of messages, and files to download.

    Messages have slots (names); a page that reads slowly misses older messages of a slot.

    Args:
        page: HTML of the page.
        token: Secret part of the address.
        hears: True if pages may post messages.
    """

    request_queue_size = 128  # connections waiting for a thread

    def __init__(self, page: str, token: str, hears: bool):
        super().__init__((HOST, 0), _Handler)
        self.root, self.hears = f"/{token}/", hears
        self.origins = {f"http://{name}:{self.server_port}" for name in (HOST, "localhost")}
        self.pages = {"": ("html", page.encode()), "afterwards.js": ("javascript", SERVICE_WORKER)}
        self.slots: dict[bytes, tuple[int, bytes]] = {}  # each with the number of its change, the newest last
        self.number, self.changed = 0, threading.Condition()
        self.files: dict[str, str] = {}
        self.streams: list[str] = []  # page id of each, oldest first
        self.output_lock = threading.RLock()  # for stdout

    def put(self, slot: bytes, line: bytes) -> None:
        """Set the newest message of a slot, which is sent to all pages.

        Args:
            slot: Name of the slot, which is the event name in the page; `files` for the files to download.
            line: The message, one line of JSON.
        """
        if slot == b"files":
            self.files = json.loads(line)
            return
        with self.changed:
            self.number += 1
            self.slots.pop(slot, None)
            self.slots[slot] = self.number, b"event: " + slot + b"\ndata: " + line + b"\n\n"
            self.changed.notify_all()

    def send(self, message: object) -> None:
        """Write a message to the program that started this process, and wait until it is read.

        Args:
            message: JSON values.
        """
        with self.output_lock:
            print(json.dumps(message), flush=True)

    def send_pages(self) -> None:
        """Write the ids of the open pages to the program that started this process.

        A page that reconnects before its first stream ends is listed once.
        """
        with self.output_lock:
            self.send({"pages": list(dict.fromkeys(self.streams))})


class _Handler(SimpleHTTPRequestHandler):
    """Handler of the requests of one connection."""

    protocol_version = "HTTP/1.1"
    timeout = TIMEOUT
    path, page = "", ""  # path below the secret address, and the id of the requesting page
    server: LiveServer

    def parse_request(self) -> bool:
        """Refuse requests under another host name or origin, or outside the secret address.

        Returns:
            True if the request may be answered.
        """
        if not super().parse_request():
            return False
        # a site whose name resolves to this machine sends its own host name, another page its own origin
        host = f"http://{self.headers['Host']}"
        if not {host, self.headers.get("Origin", host)} <= self.server.origins:
            self.send_error(403, "this address is served under 127.0.0.1 only")
        elif not self.path.startswith(self.server.root):
            self.send_error(404)
        else:
            self.path, _, self.page = self.path.removeprefix(self.server.root).partition("?page=")
            return True
        return False

    def end_headers(self) -> None:
        """Add the common headers and end the head of a response."""
        attachment = {"Content-Disposition": "attachment"} if self.path.startswith("files/") else {}
        for name, value in (HEADERS | attachment).items():
            self.send_header(name, value)
        super().end_headers()

    def do_GET(self) -> None:
        """Send the page, the stream or a file."""
        if self.path == "events":
            self._stream()
        elif self.path in self.server.pages:
            kind, body = self.server.pages[self.path]
            self._head(f"{kind}; charset=utf-8", "Content-Length", str(len(body)))
            self.wfile.write(body)
        else:
            super().do_GET()

    def translate_path(self, path: str) -> str:
        """Return the file offered under a path.

        Args:
            path: Path below the secret address.

        Returns:
            Path of the file; empty, which matches no file, if none is offered or it is missing.
        """
        offered = self.server.files.get(unquote(path), "")
        return offered if os.path.isfile(offered) else ""

    def do_POST(self) -> None:
        """Read a message of a page: a JSON object of finite numbers, with its length."""
        headers, length = self.headers, self.headers["Content-Length"] or ""
        is_counted = length.isascii() and length.isdigit() and headers["Transfer-Encoding"] is None
        max_body = 16 * 2**20  # [bytes] enough for recordings that are dropped on the page
        is_long = is_counted and (len(length) > len(str(max_body)) or int(length) > max_body)
        is_json = headers["Content-Type"] is not None and headers.get_content_type() == "application/json"
        refusals = {
            501: not self.server.hears,
            403: headers["Origin"] is None,  # only a page of this address may post
            404: self.path != "said",
            415: not is_json,
            400: not PAGE_ID.fullmatch(self.page),
            411: not is_counted,
            413: is_long,
        }
        if (refused := next((code for code, applies in refusals.items() if applies), None)) is not None:
            return self.send_error(refused)
        try:
            message = json.loads(self.rfile.read(int(length)).decode())
            json.dumps(message, allow_nan=False)
        except (ValueError, RecursionError):
            message = None
        if not isinstance(message, dict):
            return self.send_error(400)
        if not self.server.output_lock.acquire(timeout=TIMEOUT):
            return self.send_error(503)  # the program has not taken the lines before
        try:
            self.server.send({"page": self.page, "said": message})
        finally:
            self.server.output_lock.release()
        self.send_response(204)
        self.end_headers()

    def _stream(self) -> None:
        """Send the newest content of each changed slot until the browser closes the connection."""
        server, sent = self.server, 0
        if (server.hears or self.page) and not PAGE_ID.fullmatch(self.page):
            return self.send_error(400)
        if len(server.streams) >= 50:  # limit the number of browsers
            return self.send_error(503)
        server.streams.append(self.page)
        try:
            server.send_pages()
            self._head("event-stream", "Connection", "close")
            while not select.select([self.connection], [], [], 0.0)[0]:
                with server.changed:
                    if server.number == sent:
                        server.changed.wait(0.1)  # [s] between two checks of the connection
                    news = [event for number, event in server.slots.values() if number > sent]
                    sent = server.number
                self.wfile.write(b"".join(news))
        finally:
            server.streams.remove(self.page)
            server.send_pages()

    def _head(self, kind: str, name: str, value: str) -> None:
        """Send the head of a text response with one more header."""
        self.send_response(200)
        self.send_header("Content-Type", f"text/{kind}")
        self.send_header(name, value)
        self.end_headers()


def end_with_parent(parent: int) -> None:
    """Exit this process when its parent has ended, even if another process keeps its stdin open.

    Args:
        parent: Process id of the parent.
    """
    while os.getppid() == parent:
        time.sleep(1.0)  # [s]
    os._exit(0)


def main() -> None:
    """Run the server until stdin closes."""
    server = LiveServer(**json.loads(sys.stdin.buffer.readline().partition(b" ")[2]))
    server.send(server.server_port)
    threading.Thread(target=end_with_parent, args=(os.getppid(),), daemon=True).start()
    threading.Thread(target=server.serve_forever, daemon=True).start()
    for line in sys.stdin.buffer:
        slot, _, content = line.strip().partition(b" ")
        server.put(slot, content)
    os._exit(0)  # without waiting for browsers


if __name__ == "__main__":
    main()
