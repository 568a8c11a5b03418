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
import textwrap
import time
from urllib.parse import urlsplit

import numpy as np
import pytest

from manip_learn.errors import ConfigurationError, OutputError
from manip_learn.playback import LiveViewer, live_viewer

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


def server_pid(viewer):
    """Process id of a viewer's server."""
    return viewer._process._process.pid


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


def is_full(pipe):
    """True if a write to a pipe would wait."""
    return select.select([], [pipe], [], 0.0)[1] == []


@pytest.mark.timeout(60)  # a call that waits for the frozen server never returns
def test_show_does_not_wait(robot_of, monkeypatch):
    """Showing returns even when the server is frozen and its pipe is full; closing then ends the server."""
    monkeypatch.setattr(live_viewer, "FRAMES_PER_SECOND", 1e5)
    robot = robot_of("sawyer")
    viewer = LiveViewer(robot, open_browser=False)
    pid, pipe = server_pid(viewer), viewer._process._process.stdin
    os.kill(pid, signal.SIGSTOP)
    q = robot.neutral()
    while not is_full(pipe):
        viewer.show(q, manipulability=0.1)
    for _ in range(1000):
        viewer.show(q, manipulability=0.1)
    assert is_full(pipe) and viewer.is_open
    viewer.close()
    assert is_gone(pid)


def test_dead_server_does_not_stop_the_program(viewer):
    """When the server dies the program goes on; showing and closing raise nothing."""
    os.kill(server_pid(viewer), signal.SIGKILL)
    for _ in range(20):
        viewer.show(np.zeros(3))
        time.sleep(0.01)
    assert not viewer.is_open
    viewer.close()
    viewer.close()
    viewer.show(np.zeros(3))


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
print(viewer._process._process.pid, flush=True)
viewer.show(np.zeros(3))
{then}
"""


def test_server_ends_with_the_program():
    """However the program ends, killed or without closing its viewer, no server stays behind."""
    for then in ("time.sleep(60)", "raise SystemExit(3)", ""):
        code = textwrap.dedent(PROGRAM).format(then=then)
        with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True) as program:
            pid = int(program.stdout.readline())
            if "sleep" in then:
                program.kill()
            program.wait(30.0)
        assert is_gone(pid), then


def test_slow_clients_lock_nobody_out(viewer):
    """Mute and dripping connections, more than there is room for too, streams that nobody reads, and hundreds of page
    loads: a page is there within a second all the while, and whoever is too slow is gone after a few.
    """
    address = urlsplit(viewer.url)
    streams = [request(viewer.url, address.path + "events")[0] for _ in range(10)]
    slow = [socket.create_connection((address.hostname, address.port)) for _ in range(100)]
    begin, slowest, gone = time.monotonic(), 0.0, set()
    while time.monotonic() < begin + 6.0:
        for i, connection in enumerate(slow[:100:2]):  # a byte a second, of a head that never ends
            try:
                connection.send(b"GET / HTTP/1.1\r\nX: 1"[: 1 + i % 20][-1:])
            except OSError:
                gone.add(connection)
        for _ in range(3):
            asked = time.monotonic()
            assert answer(viewer.url)[0] == 200
            slowest = max(slowest, time.monotonic() - asked)
        if len(slow) == 100 and time.monotonic() > begin + 2.0:
            slow += [socket.create_connection((address.hostname, address.port)) for _ in range(300)]
        time.sleep(0.5)
    assert slowest < 1.0
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
