"""The live view: never in the way of the program, on this machine only, gone when the program is gone."""

from __future__ import annotations

import contextlib
import http.client
import json
import os
import select
import signal
import socket
import subprocess
import sys
import threading
import webbrowser
from pathlib import Path
from time import sleep
from urllib.parse import quote, urlsplit

import numpy as np
import pytest
from case import case, rows_in

from manip_learn.errors import ConfigurationError, OutputError
from manip_learn.playback import LiveViewer, live_viewer
from manip_learn.playback.live_viewer import LiveProcess

pytestmark = pytest.mark.timeout(60)  # a call that waits for a server that stands still never returns
HELLO = b"<html>page"


class Lines(list):
    """Lines that a process has heard; a test can wait for them."""

    def until(self, condition):
        """Wait until a condition on the lines holds."""
        for _ in range(2000):
            if condition(self):
                return list(self)
            sleep(0.01)
        raise AssertionError(list(self))


@pytest.fixture
def lines():
    """What the process has heard."""
    return Lines()


@pytest.fixture
def process(lines):
    """A process that appends what it hears."""
    with contextlib.closing(LiveProcess(lambda token: HELLO.decode(), 10.0, lines.append)) as process:
        yield process


@contextlib.contextmanager
def request(url, path="", method="GET", body=b"", **headers):
    """The answer to a request with the headers of a page of its own, but for those given; None omits one."""
    address = urlsplit(url)
    usual = {"Host": address.netloc}
    if method == "POST":
        usual |= {"Origin": f"http://{address.netloc}", "Content-Type": "application/json", "Content-Length": len(body)}
    usual |= {name.replace("_", "-"): value for name, value in headers.items()}
    connection = http.client.HTTPConnection(address.hostname, address.port, timeout=20.0)
    with contextlib.closing(connection):
        connection.putrequest(method, path if path.startswith("/") else address.path + path, skip_host=True)
        for name, value in usual.items():
            if value is not None:
                connection.putheader(name, value)
        connection.endheaders(body)
        with contextlib.closing(connection.getresponse()) as response:
            yield response


def answer(url, path="", **more):
    """Status and body of an answer."""
    with request(url, path, **more) as response:
        return response.status, response.read()


def post(url, body=b'{"do": "stop"}', path="said?page=a-1", **headers):
    """Status of the answer to what a page says."""
    return answer(url, path, method="POST", body=body, **headers)[0]


@contextlib.contextmanager
def stream(url, page="a-1"):
    """The events of a page's stream as pairs of a name and a value."""
    with request(url, f"events?page={page}") as response:
        assert response.headers["Content-Type"] == "text/event-stream"
        lines = (line.decode().strip().partition(": ") for line in response)

        def events():
            name = "message"
            for field, _, value in lines:
                if field == "event":
                    name = value
                elif field == "data":
                    yield name, json.loads(value)
                    name = "message"

        yield events()


def server_pid(program=None):
    """Process id of the only live server that a program has started; by default this one."""
    found = subprocess.run(["pgrep", "-P", str(program or os.getpid()), "-f", "live_server"], capture_output=True)
    (pid,) = found.stdout.split()
    return int(pid)


def ends(pid):
    """Wait until a process has ended."""
    try:
        handle = os.pidfd_open(pid)
    except ProcessLookupError:
        return True
    with open(handle, closefd=True):
        return bool(select.select([handle], [], [], 20.0)[0])  # readable once it has ended


def test_a_viewer_is_on_this_machine_only(robot_of, monkeypatch):
    """The server listens on 127.0.0.1 and on no other address. No command line contains the page's secret address: the
    browser is given a file that only this user can read and that leads to the page, and it goes with the viewer.
    """
    opened: list[str] = []
    monkeypatch.setattr(webbrowser, "open", opened.append)
    with LiveViewer(robot_of("planar3")) as viewer:
        address, (file,) = urlsplit(viewer.url), (Path(urlsplit(uri).path) for uri in opened)
        assert viewer.url in file.read_text() and address.path.strip("/") not in opened[0]
        assert file.parent.stat().st_mode & 0o077 == 0
        assert address.hostname == "127.0.0.1" and post(viewer.url) == 501
        if sys.platform == "linux":
            rows = [
                line.split() for name in ("tcp", "tcp6") for line in Path("/proc/net", name).read_text().splitlines()
            ]
            ports = [r[1] for r in rows if r[3] == "0A" and r[1].endswith(f":{address.port:04X}")]
            assert ports == [f"0100007F:{address.port:04X}"]
        status, body = answer(viewer.url)
        assert status == 200 and b'data-mode="live"' in body and b"connect-src 'self'" in body
    assert not file.parent.exists()


def test_a_viewer_shows_postures_and_outlives_its_server(robot_of):
    """The stream has the latest posture, as it was when shown; NaN is refused. If the server dies the program goes on:
    showing and closing raise nothing.
    """
    with LiveViewer(robot_of("planar3"), open_browser=False) as viewer:
        q = np.array([0.1, 0.2, 0.3])
        viewer.show(q, manipulability=0.5, time=7.0)
        q[:] = 9.0
        with stream(viewer.url) as events:
            assert next(events) == ("message", {"time": 7.0, "values": [0.1, 0.2, 0.3], "mu": 0.5})
        for wrong, mu in ((np.array([0.0, np.nan, 0.0]), 0.1), (np.zeros(4), 0.1), (np.zeros(3), np.inf)):
            with pytest.raises(ConfigurationError):
                viewer.show(wrong, manipulability=mu)
        assert viewer.is_open
        os.kill(pid := server_pid(), signal.SIGKILL)
        assert ends(pid)
        viewer.show(np.zeros(3))
        assert not viewer.is_open
        viewer.close()
        viewer.show(np.zeros(3))


def test_strangers_get_nothing_and_are_not_heard(process, lines):
    """Requests are refused from another host (DNS rebinding) or origin, to a wrong address, with another kind of body,
    without a page id, and with a body that is no JSON object. What the server's own pages post is heard in order.
    """
    url, port, token = process.url, urlsplit(process.url).port, urlsplit(process.url).path
    assert answer(url) == (200, HELLO)
    assert answer(url, Host=f"localhost:{port}", Origin=f"http://localhost:{port}")[0] == 200
    names = ("evil.example", f"evil.example:{port}", "127.0.0.1", f"127.0.0.1:{port + 1}", f"[::1]:{port}", None)
    origins = ("http://evil.example", "null", f"https://127.0.0.1:{port}", f"http://127.0.0.1:{port + 1}", "")
    for headers in (*({"Host": name} for name in names), *({"Origin": origin} for origin in origins)):
        with case(headers):
            assert [answer(url, path, **headers)[0] for path in ("", "events?page=a", "files/x")] == [403, 403, 403]
            assert post(url, **headers) == 403
    for status, method, path, header, value in rows_in("requests_refused.txt"):
        headers = {header: None if value == "none" else value} if header else {}
        with case(method, path, headers):
            path, body = path.format(token=token, token_cut=token[:-1]), b'{"do": "stop"}' * (method == "POST")
            assert answer(url, path, method=method, body=body, **headers)[0] == int(status)
    assert post(url, Content_Length=10**4000) == 413
    assert post(url, Content_Length=None, Transfer_Encoding="chunked") == 411
    for body in (b"", b"{", b"[]", b"1", b"null", b"{}{}", b"\xff", b'{"to": NaN}', b'{"to": 1e999}',
                 b'{"to": ' + 10_000 * b"9" + b"}", b'{"a":' * 3_000 + b"1" + b"}" * 3_000):  # fmt: skip
        assert post(url, body) == 400, body[:20]
    assert lines == []
    bodies = [{"do": "stop"}, {"do": "drop", "text": "1,2\n" * 100_000}, {}, {"do": "rename", "to": "\u00e4"}]
    assert [post(url, json.dumps(body, indent=1).encode()) for body in bodies] == 4 * [204]
    assert lines.until(lambda lines: len(lines) == 4) == [{"page": "a-1", "said": body} for body in bodies]
    for raw in (b"\x16\x03\x01\r\n\r\n", f"GET {token} HTTP/1.1\r\n\r\n".encode(),
                    f"GET {token} HTTP/1.1\r\nHost: a\r\nHost: {urlsplit(url).netloc}\r\n\r\n".encode()):  # fmt: skip
        with socket.create_connection(("127.0.0.1", port), timeout=20.0) as connection:
            connection.sendall(raw)
            assert HELLO not in connection.recv(4096)


def test_put_does_not_wait(process):
    """`put` returns even when the server is frozen and its pipe is full; `close` then ends the server."""
    begun, made = threading.Event(), []
    pid = server_pid()
    os.kill(pid, signal.SIGSTOP)

    def message():
        made.append(len(made))
        begun.set()
        return '"' + 10**6 * "x" + '"'  # more than a pipe can hold: its writer waits

    process.put(message)
    assert begun.wait(30.0)
    for _ in range(1000):
        process.put(message)
    assert made == [0] and process.is_open
    process.close()
    assert ends(pid) and not process.is_open


PROGRAM = """
from manip_learn.playback.live_viewer import LiveProcess
process = LiveProcess(lambda token: "page", 10.0)
print("shown", flush=True)
input()
raise SystemExit(3)
"""


@pytest.mark.parametrize("killed", [True, False])
def test_server_ends_with_the_program(killed):
    """No server stays behind when the program is killed, or exits without closing its viewer."""
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
    with subprocess.Popen([sys.executable, "-c", PROGRAM], **pipes, text=True) as program:
        program.stdout.readline()
        pid = server_pid(program.pid)
        if killed:
            program.kill()
        else:
            program.communicate("\n", timeout=30.0)
    assert ends(pid)


def test_slow_clients_lock_nobody_out(process):
    """A hundred silent connections, and streams that nobody reads, do not block the page; silent ones are closed after
    a few seconds, and the number of streams is limited.
    """
    address = urlsplit(process.url)
    with contextlib.ExitStack() as stack:
        streams = [stack.enter_context(stream(process.url, f"a{n}")) for n in range(50)]
        silent = [stack.enter_context(socket.create_connection((address.hostname, address.port))) for _ in range(100)]
        process.put(lambda: "1", "pose")
        assert [next(events) for events in streams] == 50 * [("pose", 1)]
        assert answer(process.url) == (200, HELLO) and answer(process.url, "events?page=b")[0] == 503
        for connection in silent:
            connection.settimeout(20.0)
            with contextlib.suppress(ConnectionError):
                assert connection.recv(1) == b""


@pytest.mark.parametrize("code", ["raise SystemExit(1)", "import time; time.sleep(60)", "print('no port', flush=True)"])
def test_server_that_does_not_start_is_an_error(robot_of, monkeypatch, tmp_path, code):
    """A server that exits or prints no port at its start is an error within the time-out."""
    script = tmp_path / "server.py"
    script.write_text(code)
    monkeypatch.setattr(live_viewer, "SERVER", script)
    with pytest.raises(OutputError, match="did not start within"):
        LiveViewer(robot_of("planar3"), open_browser=False, timeout=0.5)


def test_pages_get_the_latest_of_each_slot(process):
    """Of many messages in a slot the last arrives, after those that were put before it in other slots. A page that is
    opened later gets the latest of each slot at once.
    """
    process.put(lambda: "-1")
    for n in range(50):
        process.put(lambda: "0", "scene")
        process.put(lambda n=n: str(n), "pose")
    latest = {"message": -1, "scene": 0, "pose": 49}
    with stream(process.url) as events:
        shown = dict([next(events)])
        while shown.get("pose") != 49:
            shown |= dict([next(events)])
        assert shown == latest
    with stream(process.url, "b") as events:
        assert dict(next(events) for _ in latest) == latest
        process.put(lambda: "50", "scene")
        assert next(events) == ("scene", 50)  # the other slots have not changed


def test_pages_are_counted(process, lines):
    """The ids of the open pages are reported, oldest first, whenever one opens or closes. A page that is opened again
    before the server has seen its first stream end counts once.
    """
    streams = {}
    for page, pages in (("one", ["one"]), ("two", ["one", "two"]), ("one", ["two"]), ("one", ["two", "one"])):
        if page in streams:
            streams.pop(page).close()
        else:
            streams[page] = contextlib.ExitStack()
            streams[page].enter_context(stream(process.url, page))
        lines.until(lambda lines, pages=pages: lines and lines[-1] == {"pages": pages})
    assert len(lines) == 4
    with stream(process.url, "one"):
        streams["one"].close()
        streams["two"].close()
        lines.until(lambda lines: lines[-1] == {"pages": ["one"]})


def test_files_are_those_offered(process, tmp_path):
    """A file that is offered can be downloaded under its name, and no other path leads to a file."""
    for name, content in {"secret.csv": b"secret", "q.csv": bytes(range(256)) * 3000, "page.html": b"<script>"}.items():
        (tmp_path / name).write_bytes(content)
    name = 'a "b"\r\nX: \u00e4.html'
    files = {"take.csv": tmp_path / "q.csv", name: tmp_path / "page.html", "gone": tmp_path / "x", "dir": tmp_path}
    process.offer(files)
    process.put(lambda: "{}", "state")
    with stream(process.url) as events:
        assert next(events) == ("state", {})  # pages see no paths, and files are there before this message
    with request(process.url, "files/take.csv") as response:
        assert response.read() == bytes(range(256)) * 3000
        headers = {"Content-Disposition": "attachment", "Content-Type": "text/csv", "X-Content-Type-Options": "nosniff"}
        assert {key: response.headers[key] for key in headers} == headers
    with request(process.url, "files/" + quote(name)) as response:
        assert response.read() == b"<script>" and response.headers["Content-Disposition"] == "attachment"
    outside = ("secret.csv", "../secret.csv", "%2e%2e/secret.csv", "..%2fsecret.csv", f"{tmp_path}/secret.csv", "q.csv")
    for path in (*outside, "", ".", "..", "take.csv/", "take.csv%00", "gone", "dir", "take.csv/../secret.csv"):
        assert answer(process.url, "files/" + path)[0] == 404, path
