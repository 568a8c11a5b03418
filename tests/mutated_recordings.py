"""Reads damaged copies of one good file of every format: each is read or refused in a sentence, in no time.

    python tests/mutated_recordings.py [--count 5000] [--seed 0] [FORMAT ...]

Prints, for each format, how many copies were read, how many were refused, and what else happened: another exception, a
process that died, a copy that took longer than `SECONDS`. The exit code is 1 if anything else happened.
"""

from __future__ import annotations

import argparse
import multiprocessing
import shutil
import signal
import sys
import tempfile
import warnings
from collections import Counter
from pathlib import Path
from types import FrameType
from typing import Any

import numpy as np
from test_damaged_files import mutant
from test_names import JOINTS, WRITERS, Q

from manip_learn.errors import ManipLearnError
from manip_learn.recordings import load_demonstrations
from manip_learn.robot import load_robot

SECONDS = 20  # a copy is read in a hundredth of a second
PART = 250  # copies that one process reads
OPTIONS = {"--units": "units", "--rate": "rate", "--joint-names": "joint_names"}


class TooLongError(BaseException):
    """No library takes it for an error of the file."""


def too_long(signal_number: int, frame: FrameType | None) -> None:
    """Called by the alarm."""
    raise TooLongError


def read_part(name: str, seed: int, count: int, results: multiprocessing.Queue) -> None:
    """Read damaged copies; puts one word a copy into the queue."""
    warnings.simplefilter("ignore")
    signal.signal(signal.SIGALRM, too_long)
    rng, robot = np.random.default_rng(seed), load_robot("planar3")
    with tempfile.TemporaryDirectory() as folder:
        good, words = WRITERS[name](Path(folder), JOINTS, Q)
        options = dict(zip((OPTIONS[w] for w in words[::2]), words[1::2], strict=True))
        given: Any = {
            k: v.split(",") if k == "joint_names" else float(v) if k == "rate" else v for k, v in options.items()
        }
        files = sorted(p for p in good.rglob("*") if p.is_file()) if good.is_dir() else [good]
        for number in range(count):
            victim = files[int(rng.integers(len(files)))]
            content = victim.read_bytes()
            victim.write_bytes(mutant(content, rng))
            signal.alarm(SECONDS)
            try:
                load_demonstrations(good, robot, **given)
                word = "read"
            except ManipLearnError:
                word = "refused"
            except TooLongError:
                word = f"took longer than {SECONDS} s (seed {seed}, copy {number})"
            except BaseException as error:  # whatever else: it is counted
                word = f"{type(error).__name__}: {str(error)[:80]} (seed {seed}, copy {number})"
            signal.alarm(0)
            if word not in ("read", "refused"):
                kept = Path(tempfile.gettempdir()) / f"mutated_{name.replace(' ', '_')}_{seed}_{number}"
                shutil.copy(victim, kept)
            victim.write_bytes(content)
            results.put(word)


def main() -> int:
    """Exit code 0 if every copy was read or refused."""
    parser = argparse.ArgumentParser(description="Reads damaged copies of every format.")
    parser.add_argument("formats", nargs="*", default=list(WRITERS), metavar="FORMAT")
    parser.add_argument("--count", type=int, default=5000)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    failed = False
    for name in options.formats:
        found: Counter[str] = Counter()
        for first in range(0, options.count, PART):
            results: multiprocessing.Queue = multiprocessing.Queue()
            n = min(PART, options.count - first)
            child = multiprocessing.Process(target=read_part, args=(name, options.seed + first, n, results))
            child.start()
            words = []
            while len(words) < n and (child.is_alive() or not results.empty()):
                try:
                    words.append(results.get(timeout=1.0))
                except Exception:  # the queue is empty for a while, or the process died
                    continue
            child.join(5.0)
            if child.is_alive():
                child.kill()
            found.update(words)
            if len(words) < n:
                found[f"process died with {child.exitcode} (seed {options.seed + first}, copy {len(words)})"] += 1
        odd = {word: k for word, k in found.items() if word not in ("read", "refused")}
        print(
            f"{name}: {found['read']} read, {found['refused']} refused, {sum(odd.values())} else {odd or ''}",
            flush=True,
        )
        failed |= bool(odd)
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
