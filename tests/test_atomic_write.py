"""Files are written completely or not at all."""

from __future__ import annotations

import os
import stat
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest

import manip_learn as ml
from manip_learn.atomic_write import write_atomically
from manip_learn.errors import OutputError

DATA = Path(__file__).resolve().parents[1] / "examples" / "data"


def test_writes_and_replaces(tmp_path, monkeypatch):
    """Text and bytes arrive unchanged, in folders that did not exist, and the old content is gone. The whole content is
    flushed to the disk before it takes the old file's place, and then the folder is flushed.
    """
    path, steps = tmp_path / "new" / "folder" / "page.html", []
    assert write_atomically(path, "ä\r\n") == path.resolve()
    assert path.read_bytes() == "ä\r\n".encode()
    flush, move = os.fsync, os.replace

    def flushed(descriptor):
        mode = os.fstat(descriptor)
        steps.append("folder" if stat.S_ISDIR(mode.st_mode) else f"{mode.st_size} bytes")
        flush(descriptor)

    def moved(source, target):
        steps.append("in place")
        assert path.read_bytes() == "ä\r\n".encode()
        move(source, target)

    monkeypatch.setattr(os, "fsync", flushed)
    monkeypatch.setattr(os, "replace", moved)
    write_atomically(path, b"\x00\xff" * 500)
    assert steps == ["1000 bytes", "in place", "folder"] and path.read_bytes() == b"\x00\xff" * 500


def test_leaves_nothing_behind(tmp_path, monkeypatch):
    """When the last step fails, the old file is still whole and no temporary file stays."""
    path = tmp_path / "page.html"
    write_atomically(path, "old")

    def refuse(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "replace", refuse)
    with pytest.raises(OutputError, match="No space left on device; make room, or choose another disk"):
        write_atomically(path, "new")
    assert [p.name for p in tmp_path.iterdir()] == ["page.html"]
    assert path.read_text() == "old"


WRITER = """
import os, sys
from manip_learn.atomic_write import write_atomically

def at_the_disk(descriptor):
    print("writing", flush=True)
    sys.stdin.readline() or os.kill(os.getpid(), 9)

os.fsync = at_the_disk
write_atomically(sys.argv[1], "theirs")
"""


def test_what_a_killed_writer_left_is_swept_and_no_living_ones_file(tmp_path):
    """By the next writing of the same name; a file that only looks alike stays, and a writer at work ends its work."""
    path = tmp_path / "run[1].npz"

    def writer():
        pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
        started = subprocess.Popen([sys.executable, "-c", WRITER, str(path)], **pipes)
        assert started.stdout.readline() == "writing\n"
        return started

    def temporary():
        return sorted(p.name for p in tmp_path.iterdir() if p.name.endswith(".tmp"))

    alike = tmp_path / ".run[1].npz.notes.tmp"
    alike.write_text("mine")
    killed, living = writer(), writer()
    assert len(temporary()) == 3
    killed.communicate("", timeout=60)
    assert killed.returncode == -9 and len(temporary()) == 3
    write_atomically(path, "ours")
    assert len(temporary()) == 2 and path.read_text() == "ours"
    living.communicate("go on\n" * 3, timeout=60)
    assert living.returncode == 0 and temporary() == [alike.name]
    assert path.read_text() == "theirs" and alike.read_text() == "mine"


def test_refuses_folders_and_devices(tmp_path):
    """A folder, a pipe, an empty path and a folder that is a file are each refused in one sentence."""
    (tmp_path / "file").write_text("")
    os.mkfifo(tmp_path / "pipe")
    for path, reason in {
        tmp_path: "it is a folder",
        f"{tmp_path}/missing/": "names a folder",
        "": "empty path",
        tmp_path / "pipe": "device or a pipe",
        tmp_path / "file" / "page.html": "cannot write",
        tmp_path / "a\0b": "cannot write",
    }.items():
        with pytest.raises(OutputError, match=reason):
            write_atomically(path, "x")
    assert not (tmp_path / "missing").exists()


def test_keeps_links_and_modes(tmp_path):
    """A symbolic link still points at its target, and the file keeps its access rights."""
    target, link = tmp_path / "target", tmp_path / "link"
    target.write_text("old")
    target.chmod(0o600)
    link.symlink_to(target)
    write_atomically(link, "new")
    assert link.is_symlink()
    assert target.read_text() == "new"
    assert stat.S_IMODE(target.stat().st_mode) == 0o600
    (tmp_path / "touched").touch()
    modes = {path.stat().st_mode for path in (write_atomically(tmp_path / "fresh", "x"), tmp_path / "touched")}
    assert len(modes) == 1


NO_ROOM = """
import resource, sys
from manip_learn.cli import main
sys.dont_write_bytecode = True  # before 3.12.8 a .pyc that found no room stays, and breaks every import
resource.setrlimit(resource.RLIMIT_FSIZE, (16, 16))  # [bytes] of a file
for line in sys.stdin:
    print("exit code", main(line.split()), file=sys.stderr, flush=True)
"""


def test_every_file_that_has_no_room_gets_a_sentence(tmp_path):
    """Whatever a command writes: exit code 2, one sentence that names the file, and nothing of it stays."""
    arm = ml.load_robot("planar3")
    constraint = ml.Constraint([[0.0, 1.0]], ml.FrameJacobian(arm, "tip", "x y"))
    constraint.save(tmp_path / "line.json")
    rollout = ml.simulate(arm, ml.ResolvedRateController(constraint), [0.1, 0.5, 0.5], 0.5, 0.05)
    inputs = {"line.json", *(rollout.save(tmp_path / f"run.{end}").name for end in ("npz", "csv"))}
    written = {
        "c.json": f"learn planar3 {DATA}/planar3_reach --frame tip --axes planar --out c.json",
        **{f"r{e}": f"control planar3 line.json --duration 0.1 --out r{e}" for e in (".npz", ".csv", ".mcap")},
        "p.html": "replay planar3 run.npz --html p.html",
        "a.csv": "audit planar3 line.json run.csv --csv a.csv",
        **{f"x{e}": f"export planar3 run.npz --out x{e}" for e in (".mcap", ".csv", ".yaml")},
        "set/": "export planar3 run.npz --to lerobot --out set",
        "figures": "reproduce singular-start --out figures",
    }
    lines, program = "\n".join(written.values()), [sys.executable, "-c", NO_ROOM]
    done = subprocess.run(program, input=lines, cwd=tmp_path, capture_output=True, text=True, timeout=300)
    said = [line for line in done.stderr.splitlines() if line.startswith(("manip-learn: ", "exit code"))]
    assert len(said) == 2 * len(written), done.stderr
    for (file, command), sentence, code in zip(written.items(), said[::2], said[1::2], strict=True):
        assert code == "exit code 2" and sentence.startswith("manip-learn: cannot write"), (command, sentence)
        where = tempfile.gettempdir() if file.endswith(".mcap") else tmp_path / file.rstrip("/")
        assert str(where) in sentence and "File too large; make room" in sentence, sentence
    assert {p.name for p in tmp_path.rglob("*") if p.is_file()} == inputs
