"""Faults that are generated from the syntax tree: do the tests notice them?

    python tests/mutation/run.py                        lines changed since the last release, or the last commit
    python tests/mutation/run.py --since main           lines changed since a revision
    python tests/mutation/run.py manip_learn/linalg.py  whole files
    python tests/mutation/run.py --everything --hours 8 the library, a random fault after the other
    python tests/mutation/run.py --quick --since main   two minutes of the changed lines, for every change

The test files that use a file run once without any fault, and say which of their tests reach which line. A sample of
faults follows; each is tried with the quickest tests that reach its line. The run fails if fewer than LEAST of the
faults are noticed; those that are not are listed with what the function around them promises. A quick run takes a few
faults of each changed file and the nearest two test files; a fault that these do not reach does not count, and since so
few are no proof it fails below LEAST_OF_FEW.
"""

from __future__ import annotations

import argparse
import re
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from itertools import islice
from pathlib import Path

import numpy as np
from faults import Fault, faults_of
from uses import rings_around, users_of_the_library
from workshop import ROOT, Workshop

# of the faults: about one in eight changes nothing that a caller could see (another bound of a loop that ends before
# it, a constant of a tie, < for <= where equality cannot be)
LEAST = 0.8
LEAST_OF_FEW, FEW = 0.5, 5  # of a quick run, where so many were tried: eight of ten may be five of ten by chance
# seconds of a test file whose lines are followed, and test files of a ring: more repeat what these reach; rings of test
# files that are asked for a line, all of them only where each test file is followed anyhow
QUICK = {"hours": 2.0 / 60.0, "count": 3, "timeout": 20.0, "followed": 10.0, "nearest": 2, "rings": 1}
THOROUGH = {"followed": 60.0, "nearest": 10, "rings": 2}
UNREACHED = "no test comes here"
WHOLE = 4  # test files that are tried whole where none is seen to come to a line
TESTS = 12  # quickest tests of a line that are tried: those that remain repeat what these check


def main() -> int:
    """Exit code 0 if the tests are strong enough."""
    options = _options()
    importers = users_of_the_library()
    noticed, tried = Counter[str](), Counter[str]()
    end = time.monotonic() + 3600.0 * options.hours
    with tempfile.TemporaryDirectory() as folder:
        workshop = Workshop(Path(folder) / "project", options.timeout, options.followed)
        for file, fault in _sample(_lines_of(options), options):
            if time.monotonic() > end:
                break
            outcome = _try(workshop, file, fault, importers, options)
            if options.quick and outcome == UNREACHED:
                continue
            room = "/".join(file.split("/")[1:-1][:1]) or "top"
            tried[room] += 1
            if outcome in ("noticed", "too slow", "broken"):
                noticed[room] += 1
            else:
                print(f"{outcome.upper()} {file}:{fault.line}: {fault.words}\n    promise: {fault.promise}", flush=True)
    for room in sorted(tried):
        print(f"{room}: {noticed[room]} of {tried[room]} faults noticed")
    total, known = sum(tried.values()), sum(noticed.values())
    print(f"{known} of {total} faults noticed, {100.0 * known / max(total, 1):.0f} %")
    least = LEAST if not options.quick else LEAST_OF_FEW if total >= FEW else 0.0
    return 0 if known >= least * total else 1


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "files", nargs="*", metavar="FILE", help="files of the library; default: the lines that changed"
    )
    parser.add_argument("--since", metavar="REVISION", help="default: the last tag, or the commit before this one")
    parser.add_argument("--everything", action="store_true", help="all files, in the order of chance")
    parser.add_argument("--quick", action="store_true", help="about two minutes, whatever has changed")
    parser.add_argument("--hours", type=float, default=np.inf, help="no new fault after that")
    parser.add_argument("--count", type=int, default=10, help="faults of each file")
    parser.add_argument("--seed", type=int, default=0, help="of the sample")
    parser.add_argument("--timeout", type=float, default=300.0, help="seconds after which a fault counts as noticed")
    parser.set_defaults(**THOROUGH)
    if "--quick" in sys.argv:
        parser.set_defaults(**QUICK)
    if "--everything" in sys.argv:
        parser.set_defaults(rings=None)
    options = parser.parse_args()
    unknown = [file for file in options.files if not (ROOT / file).is_file() or not file.startswith("manip_learn/")]
    if unknown:
        parser.error(f"no file of the library: {', '.join(unknown)}; give paths such as manip_learn/linalg.py")
    return options


def _lines_of(options: argparse.Namespace) -> dict[str, set[int] | None]:
    """File -> lines to put faults into; None for all of them."""
    if options.everything:
        return dict.fromkeys(str(path.relative_to(ROOT)) for path in (ROOT / "manip_learn").rglob("*.py"))
    if options.files:
        return dict.fromkeys(options.files)
    since = options.since or _git("describe", "--tags", "--abbrev=0") or "HEAD~1"
    if not _git("rev-parse", "--verify", "--quiet", since):
        raise SystemExit(f"--since {since}: git knows no such revision here; give files instead")
    since = _git("merge-base", since, "HEAD") or since  # what others have changed there meanwhile is not ours
    changed: dict[str, set[int] | None] = {}
    lines = set[int]()
    for line in _git("diff", "--unified=0", "--diff-filter=AMR", since, "--", "manip_learn/*.py").splitlines():
        if line.startswith("+++ b/"):
            changed[line.removeprefix("+++ b/")] = lines = set[int]()
        elif found := re.match(r"@@ -\S+ \+(\d+)(?:,(\d+))? @@", line):
            lines |= set(range(int(found[1]), int(found[1]) + int(found[2] or 1)))
    return changed


def _git(*words: str) -> str:
    done = subprocess.run(["git", *words], cwd=ROOT, capture_output=True, text=True)
    return done.stdout.strip() if done.returncode == 0 else ""


def _sample(lines: Mapping[str, set[int] | None], options: argparse.Namespace) -> Iterator[tuple[str, Fault]]:
    """The faults to try: some of each file, or of the whole library in the order of chance."""
    rng = np.random.default_rng(options.seed)
    chosen: list[tuple[str, Fault]] = []
    for file, wanted in sorted(lines.items()):
        faults = [f for f in faults_of((ROOT / file).read_text(encoding="utf-8")) if wanted is None or f.line in wanted]
        count = len(faults) if options.everything else min(options.count, len(faults))
        chosen += [(file, faults[i]) for i in sorted(rng.permutation(len(faults))[:count])]
    yield from [chosen[i] for i in rng.permutation(len(chosen))] if options.everything or options.quick else chosen


def _try(
    workshop: Workshop, file: str, fault: Fault, importers: Mapping[str, Sequence[str]], options: argparse.Namespace
) -> str:
    """What becomes of a fault; where no near test comes to its line, the next ring of test files is asked.

    Processes that tests start are not followed: a line that only they come to is tried with the nearest files whole.
    """
    rings = list(islice(rings_around(file, importers, options.nearest), options.rings))
    for test_files in rings:
        reached = workshop.tests_of(file, test_files).get(fault.line, [])
        if reached:
            return workshop.try_fault(file, fault.text(), reached[:TESTS])
    nearest = [name for ring in rings for name in ring][:WHOLE]
    if options.quick or not nearest:
        return UNREACHED
    outcome = workshop.try_fault(file, fault.text(), nearest)
    return UNREACHED if outcome == "survived" else outcome


if __name__ == "__main__":
    sys.exit(main())
