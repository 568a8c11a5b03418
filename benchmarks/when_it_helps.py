"""When does the manipulability of the task, or a plan, help? Six arms, seven tasks, nine policies and peers, one table.

    python benchmarks/when_it_helps.py [--out FILE.csv] [--starts 50] [--seed 41000] [--workers 2]
        [--arms panda so101] [--tasks reach "door 60 deg"] [--policies none learnt] [--few 10] [--plans 10]
        [--cache FOLDER] [--json FILE] [--python pink=/path/to/python]

What is simulated stands in `when_cases.py` and `when_runs.py`. `--few` starts of each cell get the peers,
`--plans` a plan; 0 leaves them out. With `--cache` a run that was stopped goes on where it was. The numbers do not
depend on how many workers there are.
"""

from __future__ import annotations

import argparse
import json
import math
import multiprocessing
import os
import subprocess
import sys
import time
from collections.abc import Iterable, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from pathlib import Path
from typing import NamedTuple

import numpy as np
from peer_controllers import interpreter
from table_file import put
from when_cases import ARMS, GRIPS, KINDS, TASKS, cases_of, exists, robot_of, smallest
from when_runs import PEERS, POLICIES, Score, run, run_peer

import manip_learn as ml

DT = 0.01  # [s] a period that an arm's interface has; at 20 ms 3 of 75 ways strayed that did not at 10 ms
NORMAL = 1.959964  # standard deviations of a two-sided interval of 95 %
LEVEL = 0.05  # of the test behind the marks
TITLES = {
    "none": "no null-space motion",
    "learnt": "μ, held and driven",
    "held": "μ, held only",
    "limits": "joint limits",
    "plan": "plan",
    "pink": "Pink, its μ",
    "mink": "mink",
    "placo": "PlaCo, its μ",
}
HEADER = ["arm", "task", "hand", "starts", "sigma", "policy", "done", "of", "low %", "high %", "against none"]
HEADER += ["mu least", "mu mean", "seconds", "fastest joint %", "note"]
GRIP_WORDS = {"free": "may turn", "held": "held"}


class Cell(NamedTuple):
    """One row of the table; `"all"` for several arms or tasks."""

    arm: str
    task: str
    grip: str
    kind: str


class Job(NamedTuple):
    """What one worker does: some policies of a cell, each with its number of starts."""

    cell: Cell
    numbers: dict[str, int]
    seed: int
    pythons: dict[str, str]
    cache: Path | None


Found = dict[Cell, dict[str, list[Score]]]


def wilson(done: int, n: int) -> tuple[float, float]:
    """Interval of 95 % of a share (Wilson 1927)."""
    if n == 0:
        return 0.0, 1.0
    z2, share = NORMAL**2, done / n
    middle = (share + z2 / (2 * n)) / (1.0 + z2 / n)
    half = NORMAL / (1.0 + z2 / n) * math.sqrt(share * (1.0 - share) / n + z2 / (4.0 * n * n))
    return max(middle - half, 0.0), min(middle + half, 1.0)


def differs(ours: Sequence[bool], theirs: Sequence[bool]) -> bool:
    """Whether two policies differ on the same starts: exact two-sided sign test (McNemar) at LEVEL."""
    more = sum(a and not b for a, b in zip(ours, theirs, strict=True))
    less = sum(b and not a for a, b in zip(ours, theirs, strict=True))
    n = more + less
    tail = sum(math.comb(n, k) for k in range(min(more, less) + 1)) / 2.0**n
    return 2.0 * tail < LEVEL


# ---- measuring ------------------------------------------------------------------------------------------------------


def numbers_of(cell: Cell, given: argparse.Namespace, pythons: dict[str, str]) -> dict[str, int]:
    """How many starts each policy gets in a cell; 0 where it does not apply."""
    out = {}
    for policy in given.policies:
        number = given.starts
        if policy in PEERS:
            number = min(given.few, number) if policy in pythons else 0
        elif policy == "plan":
            number = min(given.plans, number) if hasattr(ml, "plan") and cell.task != "reach" else 0
        out[policy] = number
    return out


def kept(job: Job, policy: str) -> Path | None:
    """Where the scores of a policy are cached."""
    if job.cache is None:
        return None
    name = "-".join([*job.cell, policy, str(job.numbers[policy]), str(job.seed)])
    return job.cache / f"{name.replace(' ', '_')}.json"


def measure(job: Job) -> tuple[Cell, list[float], dict[str, list[Score]]]:
    """The smallest singular values at the starts of a cell, and the scores of each policy."""
    most = max(job.numbers.values())
    cases = cases_of(*job.cell, most, job.seed)
    out = {}
    for policy, number in job.numbers.items():
        file = kept(job, policy)
        if file is not None and file.exists():
            out[policy] = [Score(*values) for values in json.loads(file.read_text(encoding="utf-8"))]
            continue
        if policy in PEERS and number:
            out[policy] = run_peer(policy, job.pythons[policy], cases[:number], DT)
        else:
            out[policy] = [run(case, policy, DT) for case in cases[:number]]
        if file is not None:
            part = file.with_suffix(f".{os.getpid()}.tmp")
            part.write_text(json.dumps(out[policy]), encoding="utf-8")
            part.replace(file)
    return job.cell, [smallest(case) for case in cases], out


def measured(jobs: list[Job], workers: int) -> tuple[Found, dict[Cell, float]]:
    """The scores of all cells in the order of the jobs, and the median smallest singular value at their starts."""
    found: Found = {}
    sigma: dict[Cell, float] = {}
    began, context = time.monotonic(), multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(workers, mp_context=context) as pool:
        waiting = {pool.submit(measure, job): job for job in jobs}
        for count, future in enumerate(as_completed(waiting), 1):
            cell, values, scores = future.result()
            found[cell], sigma[cell] = scores, float(np.median(values))
            words = ", ".join(f"{p} {sum(s.done for s in scores[p])}/{len(scores[p])}" for p in scores)
            head = f"{(time.monotonic() - began) / 60.0:6.1f} min, {count} of {len(jobs)}"
            print(f"{head}: {' | '.join(cell)}: {words}", file=sys.stderr, flush=True)
    return {job.cell: found[job.cell] for job in jobs}, sigma


def peers_of(given: argparse.Namespace) -> tuple[dict[str, str], dict[str, str]]:
    """The interpreter of each peer, and why some have none."""
    there = dict(pair.split("=", 1) for pair in given.python)
    pythons, missing = {}, {}
    for peer in PEERS:
        if given.few and peer in given.policies:
            try:
                pythons[peer] = interpreter(peer, there)
            except (OSError, subprocess.CalledProcessError) as error:
                missing[peer] = str(getattr(error, "stderr", None) or error).strip().splitlines()[-1][:200]
    return pythons, missing


# ---- the table ------------------------------------------------------------------------------------------------------


def within(row: Cell, found: Found) -> list[dict[str, list[Score]]]:
    """The scores of all cells that a row of the table is about."""
    return [
        scores
        for cell, scores in found.items()
        if scores and cell[2:] == row[2:] and row.arm in ("all", cell.arm) and row.task in ("all", cell.task)
    ]


def pooled(found: Found) -> Found:
    """Sums over arms and tasks: everything, each task, each arm."""
    arms, tasks = (list(dict.fromkeys(getattr(cell, name) for cell in found)) for name in ("arm", "task"))
    groups = [("all", "all"), *(("all", task) for task in tasks), *((arm, "all") for arm in arms)]
    out: Found = {}
    for row in (Cell(arm, task, grip, kind) for arm, task in groups for grip in GRIPS for kind in KINDS):
        parts = within(row, found)
        if parts:
            out[row] = {policy: [score for scores in parts for score in scores[policy]] for policy in parts[0]}
    return out


def paired(policy: str, part: dict[str, list[Score]], cells: Iterable[dict[str, list[Score]]]) -> str:
    """The mark of a policy: significantly more, or less, often done than without null-space motion, same starts."""
    if policy == "none" or "none" not in part:
        return ""
    both = [(a.done, b.done) for scores in cells for a, b in zip(scores[policy], scores["none"], strict=False)]
    ours, theirs = [a for a, _ in both], [b for _, b in both]
    if not both or not differs(ours, theirs):
        return ""
    return "more" if sum(ours) > sum(theirs) else "less"


def entry(scores: list[Score], mark: str, counts_only: bool) -> list[object]:
    """The figures of one policy in a cell: done, its interval, the mark, least and mean mu, time and fastest joint."""
    n, good = len(scores), [score for score in scores if score.done]
    low, high = wilson(len(good), n)
    counts = [len(good), n, f"{100 * low:.0f}", f"{100 * high:.0f}", mark]
    if counts_only:
        return [*counts, "", "", "", ""]
    least, mean, fastest = (
        np.nanmedian([getattr(s, name) for s in scores]) if any(not math.isnan(s.least) for s in scores) else math.nan
        for name in ("least", "mean", "fastest")
    )
    seconds = f"{np.median([score.seconds for score in good]):.2f}" if good else ""
    return [*counts, f"{least:.3g}", f"{mean:.3g}", seconds, f"{100 * fastest:.0f}"]


def lines_of(cell: Cell, scores: dict[str, list[Score]], found: Found, sigma: dict[Cell, float]) -> list[list[object]]:
    """The lines of a cell, one for each policy that was run."""
    whole = "all" in cell
    head = [cell.arm, cell.task, GRIP_WORDS[cell.grip], cell.kind]
    if not scores:
        return [[*head, *[""] * (len(HEADER) - 5), f"cannot be: 6 rows, {robot_of(cell.arm).nv} joints"]]
    head.append("" if whole else f"{sigma[cell]:.3f}")
    cells = within(cell, found)
    return [
        [*head, TITLES[policy], *entry(part, paired(policy, scores, cells), whole), ""]
        for policy in POLICIES
        if (part := scores.get(policy, []))
    ]


def table(found: Found, sigma: dict[Cell, float]) -> list[list[object]]:
    """Sums first, then every cell."""
    cells = {**pooled(found), **found}
    return [line for cell, scores in cells.items() for line in lines_of(cell, scores, found, sigma)]


def written(found: Found, sigma: dict[Cell, float], path: Path) -> None:
    """All numbers as JSON."""
    document = [
        {
            **cell._asdict(),
            "sigma": sigma.get(cell),
            "scores": {policy: [score._asdict() for score in part] for policy, part in scores.items()},
        }
        for cell, scores in found.items()
    ]
    path.write_text(json.dumps(document), encoding="utf-8")


def jobs_of(given: argparse.Namespace, pythons: dict[str, str]) -> tuple[list[Cell], list[Job]]:
    """All cells, and the work on those that exist."""
    cells = [Cell(a, t, g, k) for a in given.arms for t in given.tasks for g in GRIPS for k in KINDS]
    jobs = [
        Job(cell, numbers_of(cell, given, pythons), given.seed, pythons, given.cache)
        for cell in cells
        if exists(*cell[:3])
    ]
    return cells, jobs


def options(arguments: Sequence[str] | None = None) -> argparse.Namespace:
    """What was asked for."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--starts", type=int, default=50, help="starts a cell")
    parser.add_argument("--few", type=int, default=10, help="of them with the peers; 0: none")
    parser.add_argument("--plans", type=int, default=10, help="of them with a plan; 0: none")
    parser.add_argument("--seed", type=int, default=41_000)
    parser.add_argument("--arms", nargs="+", default=list(ARMS), choices=list(ARMS))
    parser.add_argument("--tasks", nargs="+", default=list(TASKS), choices=list(TASKS))
    parser.add_argument("--policies", nargs="+", default=list(POLICIES), choices=list(POLICIES))
    parser.add_argument("--python", nargs="*", default=[], metavar="PEER=PYTHON", help="environments that exist")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--cache", type=Path, help="folder in which the scores of each cell are kept")
    parser.add_argument("--json", type=Path, help="file for all numbers")
    parser.add_argument("--out", type=Path, help="file for the table; default: it is printed")
    return parser.parse_args(arguments)


def main() -> None:
    """Measure, and print or write the table."""
    given = options()
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
        os.environ.setdefault(name, "1")  # of the workers
    if given.cache is not None:
        given.cache.mkdir(parents=True, exist_ok=True)
    pythons, missing = peers_of(given)
    cells, jobs = jobs_of(given, pythons)
    some, sigma = measured(jobs, given.workers)
    found = {cell: some.get(cell, {}) for cell in cells}
    if given.json is not None:
        written(found, sigma, given.json)
    put(HEADER, table(found, sigma), given.out)
    for peer, reason in missing.items():
        print(f"SKIPPED {peer}: {reason}", file=sys.stderr)


if __name__ == "__main__":
    main()
