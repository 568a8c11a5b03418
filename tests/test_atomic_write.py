"""Files are written completely or not at all."""

from __future__ import annotations

import os
import stat
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest
from case import rows_in

import manip_learn as ml
from manip_learn.atomic_write import write_atomically
from manip_learn.errors import OutputError

DATA = Path(__file__).resolve().parents[1] / "examples" / "data"


def test_writes_and_replaces(tmp_path, monkeypatch):
    """Text and bytes arrive unchanged, in new folders, and replace the old content. The whole content is flushed to the
    disk before it replaces the old file, and then the folder is flushed.
    """
    path, steps = tmp_path / "new" / "folder" / "page.html", []
    assert write_atomically(path, "ä\r\n") == path.resolve()
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


WRITER = """
import os, sys
from manip_learn.atomic_write import write_atomically

def at_the_disk(descriptor):
    print("writing", flush=True)
    sys.stdin.readline() or os.kill(os.getpid(), 9)

os.fsync = at_the_disk
write_atomically(sys.argv[1], "theirs")
"""


def test_files_of_a_killed_writer_are_removed(tmp_path):
    """The next write of the same name removes them; a similar file stays, and a writer at work finishes."""
    path, alike = tmp_path / "run[1].npz", tmp_path / ".run[1].npz.notes.tmp"
    alike.write_text("mine")
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
    killed, living = (subprocess.Popen([sys.executable, "-c", WRITER, str(path)], **pipes) for _ in range(2))
    for writer in (killed, living):
        assert writer.stdout.readline() == "writing\n"
    assert len([*tmp_path.glob("*.tmp")]) == 3
    killed.communicate("", timeout=60)
    assert killed.returncode == -9 and len([*tmp_path.glob("*.tmp")]) == 3
    write_atomically(path, "ours")
    assert len([*tmp_path.glob("*.tmp")]) == 2 and path.read_text() == "ours"
    living.communicate("go on\n" * 3, timeout=60)
    assert living.returncode == 0 and [*tmp_path.glob("*.tmp")] == [alike]
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
    """A symbolic link still points at its target, and the file keeps its access rights; a new one has the usual."""
    target, link = tmp_path / "target", tmp_path / "link"
    target.touch(mode=0o600)
    link.symlink_to(target)
    write_atomically(link, "new")
    assert link.is_symlink() and target.read_text() == "new" and stat.S_IMODE(target.stat().st_mode) == 0o600
    (tmp_path / "touched").touch()
    assert write_atomically(tmp_path / "fresh", "x").stat().st_mode == (tmp_path / "touched").stat().st_mode


NO_ROOM = """
import resource, sys
from manip_learn.cli import main
sys.dont_write_bytecode = True  # before 3.12.8 a .pyc that found no room stays, and breaks every import
resource.setrlimit(resource.RLIMIT_FSIZE, (16, 16))  # [bytes] of a file
for line in sys.stdin:
    print("exit code", main(line.split()), file=sys.stderr, flush=True)
"""


def test_a_full_disk_is_named_and_leaves_no_file(tmp_path):
    """Whatever a command writes: exit code 2, one sentence that names the file, nothing of it stays, and a file that
    was there keeps its content.
    """
    arm = ml.load_robot("planar3")
    constraint = ml.Constraint([[0.0, 1.0]], ml.FrameJacobian(arm, "tip", "x y"))
    constraint.save(tmp_path / "line.json")
    rollout = ml.simulate(arm, ml.ResolvedRateController(constraint), [0.1, 0.5, 0.5], 0.5, 0.05)
    (tmp_path / "p.html").write_text("old")
    inputs = {"line.json", "p.html", *(rollout.save(tmp_path / f"run.{end}").name for end in ("npz", "csv"))}
    written = {file: command.format(data=DATA) for file, command in rows_in("commands_that_write.txt")}
    lines, program = "\n".join(written.values()), [sys.executable, "-c", NO_ROOM]
    done = subprocess.run(program, input=lines, cwd=tmp_path, capture_output=True, text=True, timeout=300)
    answers = [line for line in done.stderr.splitlines() if line.startswith(("manip-learn: ", "exit code"))]
    assert len(answers) == 2 * len(written), done.stderr
    for (file, command), sentence, code in zip(written.items(), answers[::2], answers[1::2], strict=True):
        assert code == "exit code 2" and sentence.startswith("manip-learn: cannot write"), (command, sentence)
        where = tempfile.gettempdir() if file.endswith(".mcap") else tmp_path / file
        assert str(where) in sentence and "File too large; make room" in sentence, sentence
    assert {p.name for p in tmp_path.rglob("*") if p.is_file()} == inputs
    assert (tmp_path / "p.html").read_text() == "old"
