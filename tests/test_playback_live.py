"""The live view: never in the way of the program, on this machine only, gone when the program is gone."""

from __future__ import annotations

import contextlib
import http.client
import json
import os
import signal
import socket
import subprocess
import sys
import textwrap
import threading
import time
import webbrowser
from pathlib import Path
from urllib.parse import quote, urlsplit

import numpy as np
import pytest

from manip_learn.errors import ConfigurationError, OutputError
from manip_learn.playback import LiveViewer, live_viewer
from manip_learn.playback.live_viewer import LiveProcess

pytestmark = pytest.mark.filterwarnings("error")


@pytest.fixture
def viewer(robot_of):
    """A viewer without a browser."""
    with LiveViewer(robot_of("planar3"), open_browser=False) as viewer:
        yield viewer


def request(url, path=None, host=None, method="GET", origin=None):
    """An answer of the server, read to its end unless it is the stream."""
    address = urlsplit(url)
    connection = http.client.HTTPConnection(address.hostname, address.port, timeout=10.0)
    connection.putrequest(method, path or address.path, skip_host=True)
    connection.putheader("Host", host or address.netloc)
    if origin is not None:
        connection.putheader("Origin", origin)
    connection.endheaders()
    return connection, connection.getresponse()


def answer(url, **kwargs):
    """Status and body of an answer."""
    connection, response = request(url, **kwargs)
    body = response.read()
    connection.close()
    return response.status, body


def is_gone(pid, seconds=10.0):
    """True once a process has ended."""
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        try:
            os.kill(pid, 0)
        except ProcessLookupError:
            return True
        time.sleep(0.05)
    return False


def server_pid(program=None):
    """Process id of the only live server that a program has started; by default this one."""
    found = subprocess.run(["pgrep", "-P", str(program or os.getpid()), "-f", "live_server"], capture_output=True)
    (pid,) = found.stdout.split()
    return int(pid)


def test_page_and_stream(viewer):
    """The page is served under its secret address, and the stream has the newest posture."""
    status, body = answer(viewer.url)
    assert status == 200 and b'data-mode="live"' in body and b"connect-src 'self'" in body
    connection, response = request(viewer.url, urlsplit(viewer.url).path + "events")
    assert response.headers["Content-Type"] == "text/event-stream"
    q = np.array([0.1, 0.2, 0.3])
    viewer.show(q, manipulability=0.5, time=7.0)
    q[:] = 9.0  # the posture is taken as it was when it was shown
    line = b""
    while not line.startswith(b"data: "):
        line = response.readline()
    assert json.loads(line[6:]) == {"time": 7.0, "values": [0.1, 0.2, 0.3], "mu": 0.5}
    connection.close()


def test_other_hosts_and_addresses_are_refused(viewer):
    """Another host name (DNS rebinding), a wrong address and other methods get nothing of the page."""
    port = urlsplit(viewer.url).port
    for host in ("evil.example", f"evil.example:{port}", "127.0.0.1", f"127.0.0.1:{port + 1}", f"[::1]:{port}"):
        status, body = answer(viewer.url, host=host)
        assert status == 403 and b"<html" not in body
        assert answer(viewer.url, path=urlsplit(viewer.url).path + "events", host=host)[0] == 403
    for origin in ("http://evil.example", "null", f"https://127.0.0.1:{port}", f"http://127.0.0.1:{port + 1}", ""):
        for path in (None, urlsplit(viewer.url).path + "events"):
            status, body = answer(viewer.url, path=path, origin=origin)
            assert status == 403 and b"<html" not in body, origin
    assert answer(viewer.url, host=f"localhost:{port}", origin=f"http://localhost:{port}")[0] == 200
    for path in ("/", "/events", "/x/", urlsplit(viewer.url).path + "../etc/passwd"):
        assert answer(viewer.url, path=path)[0] == 404
    assert answer(viewer.url, method="POST")[0] == 501


def test_only_this_machine_can_connect(viewer):
    """The server listens on 127.0.0.1 and on no other address of this machine."""
    port = urlsplit(viewer.url).port
    assert urlsplit(viewer.url).hostname == "127.0.0.1"
    if sys.platform == "linux":
        with open("/proc/net/tcp") as table, open("/proc/net/tcp6") as table6:
            rows = [line.split() for line in [*table, *table6][1:]]
        listening = [r[1] for r in rows if len(r) > 3 and r[3] == "0A" and r[1].endswith(f":{port:04X}")]
        assert listening == [f"0100007F:{port:04X}"]
    with pytest.raises(OSError), socket.create_connection(("::1", port), timeout=2.0):
        pass


@pytest.mark.timeout(60)  # a call that waits for the frozen server never returns
def test_show_does_not_wait(viewer):
    """Putting returns even when the server is frozen and its pipe is full; closing then ends the server."""
    process, begun, made = LiveProcess(lambda token: b"<html>page", 10.0), threading.Event(), []
    viewer.close()
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
    assert is_gone(pid)


def test_dead_server_does_not_stop_the_program(viewer):
    """When the server dies the program goes on; showing and closing raise nothing."""
    os.kill(server_pid(), signal.SIGKILL)
    for _ in range(20):
        viewer.show(np.zeros(3))
        time.sleep(0.01)
    assert not viewer.is_open
    viewer.close()
    viewer.close()
    viewer.show(np.zeros(3))


def test_the_address_is_in_no_command_line(robot_of, monkeypatch):
    """The browser is given a file that only this user can read and that leads to the page; it goes with the viewer."""
    opened: list[str] = []
    monkeypatch.setattr(webbrowser, "open", opened.append)
    with LiveViewer(robot_of("planar3")) as viewer:
        (file,) = (Path(urlsplit(one).path) for one in opened)
        token = urlsplit(viewer.url).path.strip("/")
        assert viewer.url in file.read_text() and token not in opened[0]
        assert file.parent.stat().st_mode & 0o077 == 0
    assert not file.parent.exists()


def test_bad_postures_are_refused(viewer):
    """NaN, a wrong size and an infinite manipulability are errors of the caller and never reach the browser."""
    for q in (np.array([0.0, np.nan, 0.0]), np.zeros(4)):
        with pytest.raises(ConfigurationError):
            viewer.show(q)
    with pytest.raises(ConfigurationError):
        viewer.show(np.zeros(3), manipulability=float("inf"))
    assert viewer.is_open


PROGRAM = """
import numpy as np, time, manip_learn as ml
from manip_learn.playback import LiveViewer
viewer = LiveViewer(ml.load_robot("planar3"), open_browser=False)
viewer.show(np.zeros(3))
print("shown", flush=True)
input()
{then}
"""


def test_server_ends_with_the_program():
    """However the program ends, killed or without closing its viewer, no server stays behind."""
    for then in ("time.sleep(60)", "raise SystemExit(3)", ""):
        code = textwrap.dedent(PROGRAM).format(then=then)
        pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
        with subprocess.Popen([sys.executable, "-c", code], **pipes, text=True) as program:
            program.stdout.readline()
            pid = server_pid(program.pid)
            program.stdin.write("\n")
            program.stdin.flush()
            if "sleep" in then:
                program.kill()
            program.wait(30.0)
        assert is_gone(pid), then


def test_slow_clients_lock_nobody_out(viewer):
    """Mute and dripping connections, more than there is room for too, streams that nobody reads, and hundreds of page
    loads: the page is served all the while, and whoever is too slow is gone after a few seconds.
    """
    address = urlsplit(viewer.url)
    streams = [request(viewer.url, address.path + "events")[0] for _ in range(10)]
    slow = [socket.create_connection((address.hostname, address.port)) for _ in range(100)]
    begin, gone = time.monotonic(), set()
    while time.monotonic() < begin + 6.0:
        for i, connection in enumerate(slow[:100:2]):  # a byte a second, of a head that never ends
            try:
                connection.send(b"GET / HTTP/1.1\r\nX: 1"[: 1 + i % 20][-1:])
            except OSError:
                gone.add(connection)
        for _ in range(3):
            assert answer(viewer.url)[0] == 200
        if len(slow) == 100 and time.monotonic() > begin + 2.0:
            slow += [socket.create_connection((address.hostname, address.port)) for _ in range(300)]
        time.sleep(0.5)
    assert len(gone) == 50  # they never stopped sending
    for connection in slow[:100]:
        connection.settimeout(1.0)
        with contextlib.suppress(ConnectionError):
            assert connection.recv(1) == b""
    for _ in range(300):
        assert answer(viewer.url, path="/x")[0] == 404
    assert answer(viewer.url)[0] == 200
    for connection in (*slow, *streams):
        connection.close()


def test_odd_requests_are_refused(viewer):
    """What is no request, is too long or has no host gets a refusal or nothing, and the page stays there."""
    address = urlsplit(viewer.url)
    for said, expected in (
        (b"\x16\x03\x01\r\n\r\n", b"HTTP/1.1 400"),
        (f"GET {address.path} HTTP/1.1\r\n\r\n".encode(), b"HTTP/1.1 403"),
        (f"GET {address.path} HTTP/1.1\r\nHost: evil\r\nHost: {address.netloc}\r\n\r\n".encode(), b"HTTP/1.1 403"),
        (b"GET / HTTP/1.1\r\n" + b"X: " + 30_000 * b"x" + b"\r\n\r\n", b""),
    ):
        with socket.create_connection((address.hostname, address.port), timeout=5.0) as connection:
            connection.sendall(said)
            with contextlib.suppress(ConnectionError):
                assert connection.recv(12) == expected
    assert answer(viewer.url)[0] == 200


def test_server_that_does_not_start_is_an_error(robot_of, monkeypatch, tmp_path):
    """A server that dies, or says nothing, at its start is one error within the time-out, and leaves no process."""
    for code in ("raise SystemExit(1)", "import time; time.sleep(60)", "print('no port', flush=True)"):
        script = tmp_path / "server.py"
        script.write_text(code)
        monkeypatch.setattr(live_viewer, "SERVER", script)
        with pytest.raises(OutputError, match="did not start within"):
            LiveViewer(robot_of("planar3"), open_browser=False, timeout=1.0)


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

    def wait(self, number, seconds=10.0):
        """The first lines, so many of them."""
        self.until(lambda: len(self) >= number, seconds)
        return self[:number]

    def until(self, condition, seconds=10.0):
        """Wait until a condition on the lines holds."""
        with self._news:
            assert self._news.wait_for(condition, seconds), list(self)


@pytest.fixture
def talk():
    """A process that hears, and what it has heard."""
    heard = Heard()
    process = LiveProcess(lambda token: b"<html>page", 10.0, heard)
    yield process, heard
    process.close()


def post(url, body=b'{"do": "stop"}', path="said?page=a-1", **headers):
    """Status of an answer to what a page says; headers are those of a page of its own, but for what is given."""
    address = urlsplit(url)
    given = {"Origin": f"http://{address.netloc}", "Content-Type": "application/json", "Content-Length": len(body)}
    given |= {name.replace("_", "-"): value for name, value in headers.items()}
    with contextlib.closing(http.client.HTTPConnection(address.hostname, address.port, timeout=10.0)) as connection:
        kept = {name: value for name, value in given.items() if value is not None}
        connection.putrequest("POST", address.path + path, skip_host="Host" in kept)
        for name, value in kept.items():
            connection.putheader(name, value)
        connection.endheaders(body)
        return connection.getresponse().status


def stream(url, page="a-1"):
    """A stream's connection, and its events as pairs of a name and what it says."""
    connection, response = request(url, f"{urlsplit(url).path}events?page={page}")

    def events():
        name = "message"
        for line in response:
            if line.startswith(b"event: "):
                name = line[7:].strip().decode()
            elif line.startswith(b"data: "):
                yield name, json.loads(line[6:])
                name = "message"

    return connection, events()


def test_slots_are_newest_only(talk):
    """Whoever comes late gets the newest of each slot at once; of many poses the last arrives, and whatever was put
    before it in another slot.
    """
    process, _ = talk
    process.put(lambda: '{"n": -1}')
    for n in range(50):
        process.put(lambda: '{"n": 0}', "scene")
        process.put(lambda n=n: json.dumps({"n": n}), "state")
        process.put(lambda n=n: json.dumps({"n": n}), "pose")
    early, events = stream(process.url)
    seen = {}
    while seen.get("pose") != 49:
        name, said = next(events)
        seen[name] = said["n"]
    assert seen == {"message": -1, "scene": 0, "state": 49, "pose": 49}  # what was put before it came before it
    late, events = stream(process.url, "b")
    assert [next(events) for _ in range(4)] == [
        ("message", {"n": -1}),
        ("scene", {"n": 0}),
        ("state", {"n": 49}),
        ("pose", {"n": 49}),
    ]
    process.put(lambda: '{"n": 50}', "state")
    assert next(events) == ("state", {"n": 50})  # the others have not changed
    early.close()
    late.close()


def test_pages_are_heard(talk):
    """What a page says is heard with its id, in order, over one connection, long or short, and on one line."""
    process, heard = talk
    address = urlsplit(process.url)
    connection = http.client.HTTPConnection(address.hostname, address.port, timeout=10.0)
    bodies = [{"do": "pull", "seq": 1}, {"do": "drop", "text": "1,2\n" * 100_000}, {}, {"do": "rename", "to": "\u00e4"}]
    ports = set()
    for body in bodies:
        own = {"Content-Type": "application/json; charset=utf-8", "Origin": f"http://localhost:{address.port}"}
        connection.request("POST", address.path + "said?page=Aa-0", json.dumps(body, indent=1).encode(), own)
        response = connection.getresponse()
        assert (response.status, response.read()) == (204, b"")
        ports.add(connection.sock.getsockname()[1])
    assert len(ports) == 1
    assert heard.wait(4) == [{"page": "Aa-0", "said": body} for body in bodies]
    connection.request("GET", address.path)  # browsers use a connection for whatever comes next
    assert connection.getresponse().read() == b"<html>page"
    connection.close()


def test_strangers_are_not_heard(talk):
    """Another host or origin, none, another kind or address, no page, and no JSON object: refused, and not heard."""
    process, heard = talk
    port = urlsplit(process.url).port
    for headers, status in (
        ({"Host": "evil.example"}, 403),
        ({"Host": f"evil.example:{port}"}, 403),
        ({"Origin": "http://evil.example"}, 403),
        ({"Origin": f"http://127.0.0.1:{port + 1}"}, 403),
        ({"Origin": "null"}, 403),
        ({"Origin": None}, 403),
        ({"Content_Type": None}, 415),
        ({"Content_Type": "text/plain"}, 415),
        ({"Content_Type": "text/plain; application/json"}, 415),
        ({"Content_Length": None}, 411),
        ({"Content_Length": "-1"}, 411),
        ({"Content_Length": None, "Transfer_Encoding": "chunked"}, 411),
        ({"Content_Length": 16 * 2**20 + 1}, 413),
        ({"Content_Length": 10**4000}, 413),
        *(({"path": path}, 400) for path in ("said", "said?page=", "said?page=a%0ab", "said?page=" + 65 * "a")),
        *(({"path": path}, 404) for path in ("", "events?page=a", "files/x", "said/?page=a", "../said?page=a")),
    ):
        assert post(process.url, **headers) == status, headers
    for body in (b"", b"{", b"[]", b"1", b"null", b'"{}"', b"{}{}", b"\xff", b'{"to": NaN}', b'{"to": -Infinity}',
                 b'{"to": 1e999}', b'{"to": ' + 10_000 * b"9" + b"}", b'{"a":' * 3_000,
                 b'{"a":' * 3_000 + b"1" + b"}" * 3_000, 20_000 * b"[" + 20_000 * b"]",
                 b'{"text": "' + 40_000 * b"x", b'{"to": [' + 9_000 * b"1, " + b"1e999]}"):  # fmt: skip
        assert post(process.url, body) == 400, body[:20]
    assert heard == []
    assert post(process.url) == 204
    assert heard.wait(1) == [{"page": "a-1", "said": {"do": "stop"}}]


def test_pages_are_counted(talk):
    """Pages that are fetched, opened, closed and opened again are told at once, oldest first, though nothing moves."""
    process, heard = talk
    open_pages = {}
    for action, page, pages, loading in (
        ("fetch", "", [], 1),
        ("fetch", "", [], 2),
        ("open", "one", ["one"], 1),
        ("open", "two", ["one", "two"], 0),
        ("fetch", "", ["one", "two"], 1),
        ("close", "one", ["two"], 1),
        ("open", "one", ["two", "one"], 1),  # it comes back without having been fetched
        ("open", "three", ["two", "one", "three"], 0),
        ("close", "two", ["one", "three"], 0),
    ):
        number = len(heard)
        if action == "fetch":
            assert answer(process.url)[0] == 200
        elif action == "open":
            open_pages[page] = stream(process.url, page)
        else:
            open_pages.pop(page)[0].close()
        assert heard.wait(number + 1)[number:] == [{"pages": pages, "loading": loading}], (action, page)
    assert request(process.url, urlsplit(process.url).path + "events")[1].status == 400
    open_pages["one again"] = stream(process.url, "one")  # before the server has seen the first stream end
    assert heard.wait(10)[-1] == {"pages": ["one", "three"], "loading": 0}
    assert len(heard) == 10


def test_files_are_those_offered(talk, tmp_path):
    """A file that is offered can be kept under its name, and nothing else is found, by whatever detour."""
    process, _ = talk
    (tmp_path / "secret.csv").write_text("secret")
    (tmp_path / "q.csv").write_bytes(bytes(range(256)) * 3000)
    (tmp_path / "page.html").write_text("<script>")
    name = 'a "b"\r\nX: \u00e4.html'
    files = {"take.csv": tmp_path / "q.csv", name: tmp_path / "page.html", "gone": tmp_path / "x", "dir": tmp_path}
    process.offer(files)
    process.put(lambda: "{}", "state")
    connection, events = stream(process.url)
    assert next(events) == ("state", {})  # it is offered before the page is told, and paths are not told
    connection.close()
    path = urlsplit(process.url).path + "files/"
    connection, response = request(process.url, path + "take.csv")
    assert response.read() == bytes(range(256)) * 3000
    assert response.headers["Content-Disposition"] == "attachment; filename*=UTF-8''take.csv"
    assert response.headers["Content-Type"] == "text/csv; charset=utf-8"
    assert response.headers["X-Content-Type-Options"] == "nosniff"
    connection.close()
    connection, response = request(process.url, path + quote(name))
    assert response.read() == b"<script>" and response.headers["X"] is None
    assert response.headers["Content-Disposition"] == (
        "attachment; filename*=UTF-8''a%20%22b%22%0D%0AX%3A%20%C3%A4.html"
    )
    connection.close()
    outside = ("secret.csv", "../secret.csv", "%2e%2e/secret.csv", "..%2fsecret.csv", f"{tmp_path}/secret.csv", "q.csv")
    for odd in (*outside, "", ".", "..", "%2e%2e", "take.csv/", "take.csv%00", "gone", "dir", "take.csv/../secret.csv"):
        assert answer(process.url, path=path + odd) == (404, b"not found\n"), odd
    assert answer(process.url, path="/files/take.csv")[0] == 404
    for headers in ({"host": "evil.example"}, {"origin": "http://evil.example"}):
        assert answer(process.url, path=path + "take.csv", **headers)[0] == 403
    process.offer({"other": tmp_path / "q.csv"})
    process.put(lambda: "{}", "done")
    connection, events = stream(process.url)
    while next(events)[0] != "done":
        pass
    connection.close()
    assert answer(process.url, path=path + "take.csv")[0] == 404


def test_failures_of_the_program_are_told(caplog):
    """Where the program fails on what it hears, or to make a message, that is logged once and the rest goes on."""
    heard = Heard()

    def failing(line):
        heard(line)
        if "said" in line:
            raise KeyError("nobody knows this")

    process = LiveProcess(lambda token: b"<html>page", 10.0, failing)
    for _ in range(3):
        assert post(process.url) == 204
        process.put(lambda: str(1 / 0), "state")
    assert len(heard.wait(3)) == 3
    connection, events = stream(process.url)
    process.put(lambda: "1", "pose")
    assert next(events) == ("pose", 1)
    heard.wait(4)
    connection.close()
    process.close()
    assert sorted(record.exc_info[0].__name__ for record in caplog.records) == ["KeyError", "ZeroDivisionError"]
    assert all(record.name == "manip_learn" and record.levelname == "ERROR" for record in caplog.records)


def test_busy_program_holds_up_nobody():
    """While the program does not take what it hears, whoever says more waits, pages are served and streams go on; then
    it hears everything, and closing ends the process.
    """
    go_on, heard, statuses = threading.Event(), Heard(), []

    def busy(line):
        go_on.wait(60.0)
        heard(line)

    process = LiveProcess(lambda token: b"<html>page", 10.0, busy)
    pid = server_pid()
    body = json.dumps({"text": 15_000 * "x"}).encode()
    speakers = [threading.Thread(target=lambda: statuses.append(post(process.url, body))) for _ in range(20)]
    for speaker in speakers:
        speaker.start()
    connection, events = stream(process.url)
    for n in range(10):
        process.put(lambda n=n: str(n), "pose")
        while next(events) != ("pose", n):
            pass
        assert answer(process.url) == (200, b"<html>page")
    connection.close()
    assert 0 < len(statuses) < len(speakers)  # a pipe holds a few
    go_on.set()
    for speaker in speakers:
        speaker.join()
    assert statuses == 20 * [204]
    heard.until(lambda: sum("said" in line for line in heard) == 20)
    process.close()
    process.close()
    assert is_gone(pid) and not process.is_open
