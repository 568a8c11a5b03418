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
from urllib.parse import quote, urlsplit

import numpy as np
import pytest
from case import case

from manip_learn.errors import ConfigurationError, OutputError
from manip_learn.playback import LiveViewer, live_viewer
from manip_learn.playback.live_viewer import LiveProcess

pytestmark = pytest.mark.timeout(60)  # a call that waits for a server that stands still never returns
HELLO = b"<html>page"


class Heard(list):
    """Lines that a process was told, for which a test can wait."""

    def __init__(self):
        super().__init__()
        self._news = threading.Condition()

    def __call__(self, line):
        """Hear one line."""
        with self._news:
            self.append(line)
            self._news.notify()

    def until(self, condition):
        """Wait until a condition on the lines holds."""
        with self._news:
            assert self._news.wait_for(lambda: condition(self), 20.0), list(self)
        return list(self)


@pytest.fixture
def heard():
    """What the process has heard."""
    return Heard()


@pytest.fixture
def process(heard):
    """A process that hears."""
    with contextlib.closing(LiveProcess(lambda token: HELLO.decode(), 10.0, heard)) as process:
        yield process


@contextlib.contextmanager
def asked(url, path="", method="GET", body=b"", **headers):
    """The answer to a request; headers are those of a page of its own, but for what is given."""
    address = urlsplit(url)
    usual = {"Host": address.netloc}
    if method == "POST":
        origin = f"http://{address.netloc}"
        usual |= {"Origin": origin, "Content-Type": "application/json", "Content-Length": len(body)}
    usual |= {name.replace("_", "-"): value for name, value in headers.items()}
    connection = http.client.HTTPConnection(address.hostname, address.port, timeout=20.0)
    with contextlib.closing(connection):
        connection.putrequest(method, path if path.startswith("/") else address.path + path, skip_host=True)
        for name, value in usual.items():
            if value is not None:
                connection.putheader(name, value)
        connection.endheaders(body)
        with contextlib.closing(connection.getresponse()) as answer:
            yield answer


def answer(url, path="", **more):
    """Status and body of an answer."""
    with asked(url, path, **more) as given:
        return given.status, given.read()


def post(url, body=b'{"do": "stop"}', path="said?page=a-1", **headers):
    """Status of the answer to what a page says."""
    return answer(url, path, method="POST", body=body, **headers)[0]


@contextlib.contextmanager
def stream(url, page="a-1"):
    """A stream's events as pairs of a name and what it says."""
    with asked(url, f"events?page={page}") as given:
        assert given.headers["Content-Type"] == "text/event-stream"

        def events():
            name = "message"
            for line in given:
                if line.startswith(b"event: "):
                    name = line[7:].strip().decode()
                elif line.startswith(b"data: "):
                    yield name, json.loads(line[6:])
                    name = "message"

        yield events()


def server_pid(program=None):
    """Process id of the only live server that a program has started; by default this one."""
    found = subprocess.run(["pgrep", "-P", str(program or os.getpid()), "-f", "live_server"], capture_output=True)
    (pid,) = found.stdout.split()
    return int(pid)


def ends(pid):
    """Wait until a process has ended, by a handle that is readable then."""
    with contextlib.suppress(ProcessLookupError):
        handle = os.pidfd_open(pid)
        try:
            return bool(select.select([handle], [], [], 20.0)[0])
        finally:
            os.close(handle)
    return True


def test_a_viewer_is_on_this_machine_only(robot_of, monkeypatch):
    """The server listens on 127.0.0.1 and on no other address. The page is served under its secret address, which is in
    no command line: the browser is given a file that only this user can read and that leads to the page, and goes with
    the viewer. The stream has the newest posture, as it was when shown; pages of a viewer say nothing. When the server
    dies the program goes on; showing and closing raise nothing.
    """
    opened: list[str] = []
    monkeypatch.setattr(webbrowser, "open", opened.append)
    with LiveViewer(robot_of("planar3")) as viewer:
        address = urlsplit(viewer.url)
        (file,) = (Path(urlsplit(one).path) for one in opened)
        assert viewer.url in file.read_text() and address.path.strip("/") not in opened[0]
        assert file.parent.stat().st_mode & 0o077 == 0
        assert address.hostname == "127.0.0.1" and post(viewer.url) == 501
        if sys.platform == "linux":
            tables = [Path(f"/proc/net/{name}").read_text().splitlines()[1:] for name in ("tcp", "tcp6")]
            rows = [line.split() for table in tables for line in table]
            ports = [r[1] for r in rows if len(r) > 3 and r[3] == "0A" and r[1].endswith(f":{address.port:04X}")]
            assert ports == [f"0100007F:{address.port:04X}"]
        status, body = answer(viewer.url)
        assert status == 200 and b'data-mode="live"' in body and b"connect-src 'self'" in body
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
        viewer.close()
        viewer.show(np.zeros(3))
    assert not file.parent.exists()


def test_strangers_get_nothing_and_are_not_heard(process, heard):
    """Another host (DNS rebinding) or origin, a wrong address, another kind of body, no page, no JSON object."""
    url, port, token = process.url, urlsplit(process.url).port, urlsplit(process.url).path
    assert answer(url) == (200, HELLO)
    assert answer(url, Host=f"localhost:{port}", Origin=f"http://localhost:{port}")[0] == 200
    names = ("evil.example", f"evil.example:{port}", "127.0.0.1", f"127.0.0.1:{port + 1}", f"[::1]:{port}", None)
    origins = ("http://evil.example", "null", f"https://127.0.0.1:{port}", f"http://127.0.0.1:{port + 1}", "")
    for headers in (*({"Host": name} for name in names), *({"Origin": origin} for origin in origins)):
        with case(headers):
            assert [answer(url, path, **headers)[0] for path in ("", "events?page=a", "files/x")] == [403, 403, 403]
            assert post(url, **headers) == 403
    elsewhere = "/", "/events", "/said?page=a-1", "/x/", "/files/x", token + "../etc/passwd", token[:-1], token + "?x"
    for path in elsewhere:
        with case(path):
            assert answer(url, path)[0] == 404
    for headers, status in (
        ({"path": "/said?page=a-1"}, 404),
        ({"Origin": None}, 403),
        *(({"Content_Type": kind}, 415) for kind in (None, "text/plain", "text/plain; application/json")),
        *(({"Content_Length": length}, 411) for length in (None, "-1")),
        ({"Content_Length": None, "Transfer_Encoding": "chunked"}, 411),
        *(({"Content_Length": length}, 413) for length in (16 * 2**20 + 1, 10**4000)),
        *(({"path": path}, 400) for path in ("said?page=", "said?page=a%0ab", "said?page=" + 65 * "a")),
        *(({"path": path}, 404) for path in ("", "events?page=a", "files/x", "said/?page=a", "../said?page=a")),
    ):
        with case(headers):
            assert post(url, **headers) == status
    for body in (b"", b"{", b"[]", b"1", b"null", b"{}{}", b"\xff", b'{"to": NaN}', b'{"to": 1e999}',
                 b'{"to": ' + 10_000 * b"9" + b"}", b'{"a":' * 3_000 + b"1" + b"}" * 3_000):  # fmt: skip
        assert post(url, body) == 400, body[:20]
    assert answer(url, method="PUT")[0] == 501 and answer(url, "events")[0] == 400
    assert heard == []
    assert post(url) == 204
    assert heard.until(len) == [{"page": "a-1", "said": {"do": "stop"}}]
    for said in (b"\x16\x03\x01\r\n\r\n", f"GET {token} HTTP/1.1\r\n\r\n".encode(),
                 f"GET {token} HTTP/1.1\r\nHost: evil\r\nHost: {urlsplit(url).netloc}\r\n\r\n".encode()):  # fmt: skip
        with socket.create_connection(("127.0.0.1", port), timeout=20.0) as connection:
            connection.sendall(said)
            assert HELLO not in connection.recv(4096)


def test_show_does_not_wait(process):
    """Putting returns even when the server is frozen and its pipe is full; closing then ends the server."""
    begun, made = threading.Event(), []
    pid = server_pid()
    os.kill(pid, signal.SIGSTOP)

    def message():
        made.append(len(made))
        begun.set()
        return '"' + 10**6 * "x" + '"'  # more than a pipe holds: its writer waits

    process.put(message)
    assert begun.wait(30.0)
    for _ in range(1000):
        process.put(message)
    assert made == [0] and process.is_open
    process.close()
    process.close()
    assert ends(pid) and not process.is_open


PROGRAM = """
import time
from manip_learn.playback.live_viewer import LiveProcess
process = LiveProcess(lambda token: "page", 10.0)
print("shown", flush=True)
input()
{then}
"""


@pytest.mark.parametrize("then", ["time.sleep(60)", "raise SystemExit(3)"])
def test_server_ends_with_the_program(then):
    """However the program ends, killed or without closing its viewer, no server stays behind."""
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
    with subprocess.Popen([sys.executable, "-c", PROGRAM.format(then=then)], **pipes, text=True) as program:
        program.stdout.readline()
        pid = server_pid(program.pid)
        program.stdin.write("\n")
        program.stdin.flush()
        if "sleep" in then:
            program.kill()
        program.wait(30.0)
    assert ends(pid)


def test_slow_clients_lock_nobody_out(process):
    """A hundred connections that say nothing, and streams that nobody reads: the page is served, and whoever says
    nothing is closed after a few seconds.
    """
    address = urlsplit(process.url)
    with contextlib.ExitStack() as kept:
        streams = [kept.enter_context(stream(process.url, f"a{n}")) for n in range(10)]
        mute = [kept.enter_context(socket.create_connection((address.hostname, address.port))) for _ in range(100)]
        process.put(lambda: "1", "pose")
        assert [next(events) for events in streams] == 10 * [("pose", 1)]
        assert answer(process.url) == (200, HELLO)
        for connection in mute:
            connection.settimeout(20.0)
            with contextlib.suppress(ConnectionError):
                assert connection.recv(1) == b""
        for n in range(10, 50):
            kept.enter_context(stream(process.url, f"a{n}"))
        assert answer(process.url, "events?page=b")[0] == 503


@pytest.mark.parametrize("code", ["raise SystemExit(1)", "import time; time.sleep(60)", "print('no port', flush=True)"])
def test_server_that_does_not_start_is_an_error(robot_of, monkeypatch, tmp_path, code):
    """A server that dies, or says nothing, at its start is one error within the time-out, and leaves no process."""
    script = tmp_path / "server.py"
    script.write_text(code)
    monkeypatch.setattr(live_viewer, "SERVER", script)
    with pytest.raises(OutputError, match="did not start within"):
        LiveViewer(robot_of("planar3"), open_browser=False, timeout=0.5)


def test_slots_are_newest_only(process):
    """Whoever comes late gets the newest of each slot at once; of many poses the last arrives, and whatever was put
    before it in another slot.
    """
    process.put(lambda: '{"n": -1}')
    for n in range(50):
        process.put(lambda: '{"n": 0}', "scene")
        process.put(lambda n=n: json.dumps({"n": n}), "state")
        process.put(lambda n=n: json.dumps({"n": n}), "pose")
    with stream(process.url) as events:
        seen = {}
        while seen.get("pose") != 49:
            name, said = next(events)
            seen[name] = said["n"]
        assert seen == {"message": -1, "scene": 0, "state": 49, "pose": 49}  # what was put before it came before it
    with stream(process.url, "b") as events:
        late = [(name, said["n"]) for name, said in (next(events) for _ in range(4))]
        assert late == [("message", -1), ("scene", 0), ("state", 49), ("pose", 49)]
        process.put(lambda: '{"n": 50}', "state")
        assert next(events) == ("state", {"n": 50})  # the others have not changed


def test_pages_are_heard(process, heard):
    """What a page says is heard with its id, in order, over one connection, long or short, and on one line."""
    address = urlsplit(process.url)
    connection = http.client.HTTPConnection(address.hostname, address.port, timeout=20.0)
    bodies = [{"do": "pull", "seq": 1}, {"do": "drop", "text": "1,2\n" * 100_000}, {}, {"do": "rename", "to": "\u00e4"}]
    ports = set()
    with contextlib.closing(connection):
        for body in bodies:
            own = {"Content-Type": "application/json; charset=utf-8", "Origin": f"http://localhost:{address.port}"}
            connection.request("POST", address.path + "said?page=Aa-0", json.dumps(body, indent=1).encode(), own)
            response = connection.getresponse()
            assert (response.status, response.read()) == (204, b"")
            ports.add(connection.sock.getsockname()[1])
        assert len(ports) == 1
        assert heard.until(lambda all_: len(all_) == 4) == [{"page": "Aa-0", "said": body} for body in bodies]
        connection.request("GET", address.path)  # browsers use a connection for whatever comes next
        assert connection.getresponse().read() == HELLO


def test_pages_are_counted(process, heard):
    """Pages that are opened, closed and opened again are told, oldest first, though nothing moves; one that comes
    again before the server has seen its first stream end counts once.
    """
    open_pages = {}
    for step, pages in (
        *(("+one", ["one"]), ("+two", ["one", "two"]), ("-one", ["two"]), ("+one", ["two", "one"])),
        *(("+three", ["two", "one", "three"]), ("-two", ["one", "three"])),
    ):
        if step[0] == "+":
            open_pages[step[1:]] = contextlib.ExitStack()
            open_pages[step[1:]].enter_context(stream(process.url, step[1:]))
        else:
            open_pages[step[1:]].close()
        assert heard.until(lambda all_, p=pages: all_ and all_[-1] == {"pages": p})
    assert len(heard) == 6
    with stream(process.url, "one"):
        open_pages["one"].close()
        open_pages["three"].close()
        assert heard.until(lambda all_: all_[-1] == {"pages": ["one"]})


def test_files_are_those_offered(process, tmp_path):
    """A file that is offered can be kept under its name, and nothing else is found, by whatever detour."""
    (tmp_path / "secret.csv").write_text("secret")
    (tmp_path / "q.csv").write_bytes(bytes(range(256)) * 3000)
    (tmp_path / "page.html").write_text("<script>")
    name = 'a "b"\r\nX: \u00e4.html'
    files = {"take.csv": tmp_path / "q.csv", name: tmp_path / "page.html", "gone": tmp_path / "x", "dir": tmp_path}
    process.offer(files)
    process.put(lambda: "{}", "state")
    with stream(process.url) as events:
        assert next(events) == ("state", {})  # it is offered before the page is told, and paths are not told
    with asked(process.url, "files/take.csv") as given:
        assert given.read() == bytes(range(256)) * 3000
        assert given.headers["Content-Disposition"] == "attachment"
        assert given.headers["Content-Type"] == "text/csv"
        assert given.headers["X-Content-Type-Options"] == "nosniff"
    with asked(process.url, "files/" + quote(name)) as given:
        assert given.read() == b"<script>" and given.headers["Content-Disposition"] == "attachment"
    outside = ("secret.csv", "../secret.csv", "%2e%2e/secret.csv", "..%2fsecret.csv", f"{tmp_path}/secret.csv", "q.csv")
    for odd in (*outside, "", ".", "..", "take.csv/", "take.csv%00", "gone", "dir", "take.csv/../secret.csv"):
        assert answer(process.url, "files/" + odd)[0] == 404, odd


def test_failures_of_the_program_are_told(heard, caplog):
    """Where the program fails on what it hears, or to make a message, that is logged once and the rest goes on."""

    def failing(line):
        heard(line)
        if "said" in line:
            raise KeyError("nobody knows this")

    process = LiveProcess(lambda token: HELLO.decode(), 10.0, failing)
    for _ in range(3):
        assert post(process.url) == 204
        process.put(lambda: str(1 / 0), "state")
    heard.until(lambda all_: len(all_) == 3)
    with stream(process.url) as events:
        process.put(lambda: "1", "pose")
        assert next(events) == ("pose", 1)
        heard.until(lambda all_: len(all_) == 4)
    process.close()
    assert sorted(record.exc_info[0].__name__ for record in caplog.records) == ["KeyError", "ZeroDivisionError"]
    assert all(record.name == "manip_learn" and record.levelname == "ERROR" for record in caplog.records)


def test_busy_program_holds_up_nobody(heard):
    """While the program does not take what it hears, pages are served and streams go on; then it hears everything, and
    closing ends the process.
    """
    go_on, statuses = threading.Event(), []
    process = LiveProcess(lambda token: HELLO.decode(), 10.0, lambda line: (go_on.wait(60.0), heard(line)))
    pid, body = server_pid(), json.dumps({"text": 15_000 * "x"}).encode()
    speakers = [threading.Thread(target=lambda: statuses.append(post(process.url, body))) for _ in range(20)]
    with stream(process.url) as events:
        for speaker in speakers:
            speaker.start()
        for n in range(5):
            process.put(lambda n=n: str(n), "pose")
            while next(events) != ("pose", n):
                pass
            assert answer(process.url) == (200, HELLO)
    assert len(statuses) < len(speakers)  # a pipe holds a few
    go_on.set()
    for speaker in speakers:
        speaker.join()
    assert statuses == 20 * [204]
    heard.until(lambda all_: sum("said" in line for line in all_) == 20)
    process.close()
    assert ends(pid) and not process.is_open
