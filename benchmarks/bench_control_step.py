"""One control step on a 7-joint arm beside the steps of the peers, each in an environment of its own, in one run.

Promise, as a ratio: the step with limits and status takes less time than Pinocchio with NumPy's pseudo-inverse.

A peer that cannot be installed or run is skipped with its reason. The environments are kept (`.venv-bench-...`).
"""

from __future__ import annotations

import json
import os
import statistics
import subprocess
import sys
import venv
from pathlib import Path
from typing import Any

import pytest
from timing import keep

pytestmark = [pytest.mark.bench, pytest.mark.timeout(1800)]
ROUNDS = int(os.environ.get("BENCH_ROUNDS", "5"))
SCRIPTS = Path(__file__).resolve().parent / "peers"
PEERS: dict[str, tuple[str, ...]] = {  # and the packages that each needs
    "manip_learn": (),
    "pinocchio": (),
    "pink": ("pin-pink", "quadprog"),
    "mink": ("mink", "daqp"),
    "placo": ("placo",),
    "oink": ("roboplan-core", "roboplan-oink"),
    "drake": ("drake",),
    "roboticstoolbox": ("roboticstoolbox-python",),
}
ENVIRONMENT = {**os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
PROMISED = {  # of Pinocchio's "task only", best rounds: neighbours only ever add time
    "bare law, b given": 0.75,
    "with limits and status, reaching a point": 1.0,
}


def interpreter(peer: str) -> str:
    """Python that runs a peer.

    Raises:
        OSError: The environment cannot be made.
        subprocess.CalledProcessError: The peer cannot be installed.
    """
    if not PEERS[peer]:
        return sys.executable
    folder = SCRIPTS.parents[1] / f".venv-bench-{peer}"
    python, made = folder / "bin" / "python", folder / "made"
    if not made.exists():
        venv.create(folder, with_pip=True, clear=True)
        install = [str(python), "-m", "pip", "--disable-pip-version-check", "install", "--quiet", *PEERS[peer]]
        subprocess.run(install, check=True, capture_output=True, text=True, timeout=900)
        made.touch()
    return str(python)


def measured(peer: str, python: str) -> dict[str, Any]:
    """One round of one peer.

    Raises:
        subprocess.CalledProcessError: It failed.
    """
    command = [python, str(SCRIPTS / f"{peer}_peer.py"), "step"]
    done = subprocess.run(command, check=True, capture_output=True, text=True, timeout=600, env=ENVIRONMENT)
    return json.loads(done.stdout.strip().splitlines()[-1])


def last_words(error: subprocess.CalledProcessError) -> str:
    """The last line that a failed command wrote."""
    return ((error.stderr or "") + (error.stdout or "no output")).strip().splitlines()[-1]


def all_rounds() -> tuple[dict[tuple[str, str], list[dict[str, float]]], dict[str, dict[str, str]], dict[str, str]]:
    """Timings of every peer and step, versions, and why peers were skipped; they take turns in each round."""
    timings: dict[tuple[str, str], list[dict[str, float]]] = {}
    versions: dict[str, dict[str, str]] = {}
    skipped: dict[str, str] = {}
    pythons: dict[str, str] = {}
    for peer in PEERS:
        try:
            pythons[peer] = interpreter(peer)
        except subprocess.CalledProcessError as error:
            skipped[peer] = last_words(error)
    for _ in range(ROUNDS):
        for peer, python in pythons.items():
            if peer in skipped:
                continue
            try:
                document = measured(peer, python)
            except subprocess.CalledProcessError as error:
                skipped[peer] = last_words(error)
                continue
            versions[peer] = document["versions"]
            for step, timing in document["us"].items():
                timings.setdefault((peer, step), []).append(timing)
    return timings, versions, skipped


def table(
    timings: dict[tuple[str, str], list[dict[str, float]]], versions: dict[str, dict[str, str]], skipped: dict[str, str]
) -> str:
    """Markdown: medians over the rounds, their spread, the best, and the best's ratio to Pinocchio's plain step.

    Ratios are of bests: neighbours only ever add time, and not to everyone the same.
    """
    base = min(t["best"] for t in timings["pinocchio", "task only"])
    lines = ["| package | step | us a step | rounds from .. to | best | ratio |", "|---|---|---|---|---|---|"]
    for (peer, step), rounds in timings.items():
        package, version = next(iter(versions[peer].items()))
        medians = [t["median"] for t in rounds]
        middle, best = statistics.median(medians), min(t["best"] for t in rounds)
        lines.append(
            f"| {package} {version} | {step} | {middle:.2f} | {min(medians):.2f} .. {max(medians):.2f} | {best:.2f} "
            f"| {best / base:.2f} |"
        )
    lines += [f"| {peer} | SKIPPED: {reason} | | | | |" for peer, reason in skipped.items()]
    return "\n".join(lines)


def test_control_step_beside_its_peers(benchmark: Any) -> None:
    """The promises hold, and the table that the README shows is printed; skipped peers are named in it."""
    results = benchmark.pedantic(all_rounds, rounds=1, iterations=1)
    timings, _, skipped = results
    print(f"\n{table(*results)}\n")
    assert "manip_learn" not in skipped, skipped.get("manip_learn")
    best = {step: min(t["best"] for t in rounds) for (peer, step), rounds in timings.items() if peer == "manip_learn"}
    bare = min(t["best"] for t in timings["pinocchio", "task only"])
    ratios = {step: seconds / bare for step, seconds in best.items()}
    late = {step: round(ratios[step], 2) for step, promise in PROMISED.items() if ratios.get(step, 0.0) > promise}
    keep("control step", ratios)
    assert not late, f"slower than promised: {late} of Pinocchio's step, promised {PROMISED}"
    for peer, reason in skipped.items():
        print(f"SKIPPED {peer}: {reason}")
