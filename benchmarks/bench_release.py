"""This tree beside the last release, in the same run and on the same machine: nothing may have become slower.

Every timed case runs in three processes that take turns in each round: the release, this tree, and this tree once more.
The ratio of a case is the median over the rounds of this tree's time over the release's. What the two processes of this
tree differ by is what the machine and the neighbours do in this run. A case fails if its ratio is above 1 by more than
5 % (a difference that a user could notice, and that another layout of the same code can make) and the twins' spread
(the wider quarter mark of the rounds' ratios); one that seems slower is measured once more before it fails.

The release is the last tag; `make bench BASE=REVISION` names another one. Without a tag it is the last commit, or the
one before where nothing has changed since.
"""

from __future__ import annotations

import json
import os
import statistics
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from timed_cases import CASES
from timing import Ratio, keep

pytestmark = [pytest.mark.bench, pytest.mark.timeout(900)]
ROOT = Path(__file__).resolve().parents[1]
ROUNDS = int(os.environ.get("BENCH_ROUNDS", "9"))
NOTICED = 0.05  # share of the release's time
TURN = 0.1  # [s] of a case's turn in a round: many ticks of the clock of processor time


def git(*arguments: str) -> str:
    """What a git command answers.

    Raises:
        subprocess.CalledProcessError: It fails.
    """
    return subprocess.run(["git", *arguments], cwd=ROOT, capture_output=True, text=True, check=True).stdout.strip()


def base_revision() -> str:
    """What is compared with: BASE, else the last tag, else the last commit that differs from this tree."""
    if os.environ.get("BASE"):
        return git("rev-parse", "--verify", f"{os.environ['BASE']}^{{commit}}")
    tags = git("tag", "--merged", "HEAD", "--sort=-creatordate").splitlines()
    if tags:
        return tags[0]
    return "HEAD" if git("status", "--porcelain", "--", "manip_learn") else "HEAD~1"


class Worker:
    """A process that times cases with the library of one tree."""

    def __init__(self, tree: Path):
        threads = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
        environment = {**os.environ, **threads, "PYTHONPATH": str(tree)}
        environment.pop("PYTHONDONTWRITEBYTECODE", None)  # modules are compiled as those of an installation are
        script = [sys.executable, str(ROOT / "benchmarks" / "timed_cases.py")]
        self.process = subprocess.Popen(
            script, env=environment, cwd=tree, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )

    def time(self, benchmark: str, case: str, calls: int) -> dict[str, Any]:
        """Seconds of a call, or why it cannot be made."""
        source, sink = self.process.stdout, self.process.stdin
        assert source is not None and sink is not None
        sink.write(json.dumps({"benchmark": benchmark, "case": case, "calls": calls}) + "\n")
        sink.flush()
        return json.loads(source.readline())


@pytest.fixture(scope="module")
def workers() -> Iterator[dict[str, Worker]]:
    """The release's process, and two of this tree; the release is checked out for this run only."""
    try:
        revision = base_revision()
    except (OSError, subprocess.CalledProcessError) as error:
        pytest.skip(f"no history to compare with: {error}")
    with tempfile.TemporaryDirectory() as folder:
        tree = Path(folder) / "release"
        git("worktree", "add", "--detach", str(tree), revision)
        running = {"release": Worker(tree), "this": Worker(ROOT), "twin": Worker(ROOT)}
        if not git("tag", "--merged", "HEAD"):
            print("\nthere is no release yet: a commit stands in its place")
        print(f"\ncompared with {revision} ({git('log', '-1', '--format=%h %cs %s', revision)})")
        try:
            yield running
        finally:
            for worker in running.values():
                worker.process.communicate()
            git("worktree", "remove", "--force", str(tree))


def compared(workers: dict[str, Worker], benchmark: str, case: str, rounds: int) -> tuple[Ratio, Ratio]:
    """Time of this tree over the release's, and over its twin's; the order of the turns is reversed in every round."""
    first = {}
    for name, worker in workers.items():
        first[name] = worker.time(benchmark, case, 1)
        if "cannot" in first[name]:
            if name != "release":
                pytest.fail(f"{benchmark}, {case}: {first[name]['cannot']}")
            pytest.skip(f"the release cannot run it: {first[name]['cannot']}")
    calls = max(1, round(TURN / max(first["this"]["seconds"], 1e-6)))
    seconds: dict[str, list[float]] = {name: [] for name in workers}
    for turn in range(rounds):
        for name in sorted(workers, reverse=bool(turn % 2)):
            seconds[name].append(workers[name].time(benchmark, case, calls)["seconds"])
    return paired(seconds["this"], seconds["release"]), paired(seconds["this"], seconds["twin"])


def paired(ours: list[float], theirs: list[float]) -> Ratio:
    """Median of the rounds' ratios, and their quarter marks."""
    lower, median, upper = statistics.quantiles([a / b for a, b in zip(ours, theirs, strict=True)], n=4)
    return Ratio(median, lower, upper)


def allowed(twins: Ratio) -> float:
    """The largest ratio that is not called slower, by what a tree shows against itself."""
    return 1.0 + NOTICED + max(abs(twins.lower - 1.0), abs(twins.upper - 1.0))


@pytest.mark.parametrize(("benchmark_", "case"), [(b, c) for b, cases in CASES.items() for c in cases])
def test_no_slower_than_the_release(workers: dict[str, Worker], benchmark_: str, case: str) -> None:
    """Within 5 % and what this run's noise explains."""
    ratio, twins = compared(workers, benchmark_, case, ROUNDS)
    if ratio.value > allowed(twins):
        ratio, twins = compared(workers, benchmark_, case, 2 * ROUNDS)
    keep("over the release", {f"{benchmark_}: {case}": ratio})
    keep("this tree over itself", {f"{benchmark_}: {case}": twins})
    assert ratio.value <= allowed(twins), (
        f"{benchmark_}, {case}: {ratio.value:.3f} of the release's time ({ratio.lower:.3f} .. {ratio.upper:.3f}), "
        f"where the same tree shows {twins.lower:.3f} .. {twins.upper:.3f} against itself"
    )
