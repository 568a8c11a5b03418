"""Our controller beside its peers on the same oblique tasks; markdown tables.

    python benchmarks/peer_controllers.py [--robots panda ur5] [--tasks 100] [--peers pink placo] [--out FILE.md]

Every peer runs as a child process in an environment of its own (`.venv-bench-...`, made at first use; `--python
pink=/path/to/python` takes one that is there). Peers get the rows in the way that each allows: a task of their own kind
(Pink, mink), rotated axes (placo), or A itself. Their manipulability is that of all of x, y, z, because none accepts a
dense selection. One that cannot be installed or run is named with the reason.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import venv
from pathlib import Path

import numpy as np
from controller_cases import ROBOTS, Tasks, tasks_of, write
from controller_scores import JUMP, Scores, scores

SCRIPTS = Path(__file__).resolve().parent / "peers"
ROOT = SCRIPTS.parents[1]
PEERS: dict[str, tuple[str, ...]] = {
    "manip_learn": (),
    "pinocchio": (),
    "pink": ("pin-pink", "quadprog"),
    "mink": ("mink", "daqp"),
    "placo": ("placo",),
    "oink": ("roboplan-core", "roboplan-oink"),
    "drake": ("drake",),
    "jparse": ("jparse-robotics", "pin"),
    "roboticstoolbox": ("roboticstoolbox-python",),
}
PACKAGES = {**PEERS, "ripl_articulation": ("ripl_articulation",)}  # and of peers that estimate
REFERENCE = "pseudo-inverse"
GAIN, TASK_GAIN = 3.0, 2.0
DURATION, DT = 5.0, 0.01
UNREACHABLE_GAINS, UNREACHABLE_DURATION, UNREACHABLE_DT = [0.3, 1.0, 3.0], 3.0, 0.001
Results = dict[str, dict[str, list[Scores]]]  # robot -> method -> one per case


def interpreter(peer: str, given: dict[str, str]) -> str:
    """Python that runs a peer.

    Raises:
        OSError: The environment cannot be made.
        subprocess.CalledProcessError: The peer cannot be installed.
    """
    if peer in given or not PACKAGES[peer]:
        return given.get(peer, sys.executable)
    folder = ROOT / f".venv-bench-{peer}"
    python, made = folder / "bin" / "python", folder / "made"
    if not made.exists():
        venv.create(folder, with_pip=True, clear=True)
        install = [str(python), "-m", "pip", "--disable-pip-version-check", "install", "--quiet", *PACKAGES[peer]]
        subprocess.run(install, check=True, capture_output=True, text=True, timeout=900)
        made.touch()
    return str(python)


def run(peer: str, python: str, cases: Path, tasks: Tasks, dt: float) -> dict[str, list[Scores]]:
    """Scores of each of a peer's methods.

    Raises:
        subprocess.CalledProcessError: It failed.
    """
    answer = cases.with_name(f"{peer}-{cases.stem}.npz")
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    command = [python, str(SCRIPTS / f"{peer}_peer.py"), "control", str(cases), str(answer)]
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True, env=environment)
    out: dict[str, list[Scores]] = {}
    with np.load(answer) as content:
        for name in dict.fromkeys(key.split("|")[0] for key in content if "|" in key):
            q, u = content[f"{name}|q"], content[f"{name}|u"]
            seconds, failed, excess = (content[f"{name}|{key}"] for key in ("seconds", "failed", "excess"))
            n = len(tasks.rows)
            out[name] = [
                scores(tasks, i % n, q[i], u[i], dt, seconds[i], int(failed[i]), tuple(excess[i].tolist()))
                for i in range(len(q))
            ]
    answer.unlink()
    return out


def measure(
    options: argparse.Namespace, folder: Path
) -> tuple[Results, Results, dict[str, list[bool]], dict[str, str]]:
    """Reachable and unreachable tasks of every robot by every peer; which starts were near-singular; who failed."""
    given = dict(pair.split("=", 1) for pair in options.python)
    reached: Results = {}
    pressed: Results = {}
    near: dict[str, list[bool]] = {}
    skipped: dict[str, str] = {}
    for name in options.robots:
        tasks = tasks_of(name, folder, options.tasks, True)
        far = tasks_of(name, folder, options.unreachable, False)
        write(tasks, folder / f"{name}.json", [GAIN], DT, DURATION, TASK_GAIN)
        write(far, folder / f"{name}-far.json", UNREACHABLE_GAINS, UNREACHABLE_DT, UNREACHABLE_DURATION, TASK_GAIN)
        reached[name], pressed[name], near[name] = {}, {}, tasks.near_singular
        for peer in options.peers:
            try:
                python = interpreter(peer, given)
                reached[name].update(run(peer, python, folder / f"{name}.json", tasks, DT))
                if options.unreachable:
                    pressed[name].update(run(peer, python, folder / f"{name}-far.json", far, UNREACHABLE_DT))
            except subprocess.CalledProcessError as error:
                skipped[f"{peer} ({name})"] = ((error.stderr or "").strip() or "no output").splitlines()[-1][:200]
            print(f"{name}: {peer} done", file=sys.stderr, flush=True)
    return reached, pressed, near, skipped


def spread(values: list[float], digits: int = 2) -> str:
    """Median (quartiles)."""
    q1, middle, q3 = np.quantile(values, [0.25, 0.5, 0.75])
    return f"{middle:.{digits}f} ({q1:.{digits}f} .. {q3:.{digits}f})"


def reach_table(results: Results, near: dict[str, list[bool]]) -> str:
    """One line per method, all robots together."""
    methods = list(dict.fromkeys(m for per_robot in results.values() for m in per_robot))
    lines = [
        "| method | runs | within 1 cm | 1 mm | least μ after 1 s / plain | mean μ / plain | mean μ, singular half "
        "| deviation [mm] | runs with jumps > 20 % | acceleration / limit | steps without answer | us a step |",
        "|---|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    for method in methods:
        pairs = [
            (s, plain, is_near)
            for robot, per_method in results.items()
            if method in per_method and REFERENCE in per_method
            for s, plain, is_near in zip(per_method[method], per_method[REFERENCE], near[robot], strict=True)
        ]
        if not pairs:
            continue
        own = [s for s, _, _ in pairs]
        mean_ratio = [s.mean / max(p.mean, 1e-9) for s, p, _ in pairs]
        cells = [
            str(len(own)),
            str(sum(s.miss < 0.01 for s in own)),
            str(sum(s.miss < 0.001 for s in own)),
            spread([s.least / max(p.least, 1e-9) for s, p, _ in pairs]),
            spread(mean_ratio),
            spread([r for r, (_, _, is_near) in zip(mean_ratio, pairs, strict=True) if is_near] or [np.nan]),
            spread([1e3 * s.deviation for s in own], 1),
            str(sum(s.jump > JUMP for s in own)),
            spread([s.exceeded for s in own], 1),
            str(sum(s.failed for s in own)),
            spread([s.microseconds for s in own], 0),
        ]
        lines.append(f"| {method} | {' | '.join(cells)} |")
    return "\n".join(lines)


def flip_table(results: Results) -> str:
    """Changes of sign per second at unreachable targets: median and worst, per gain."""
    methods = list(dict.fromkeys(m for per_robot in results.values() for m in per_robot))
    columns = [f"gain {g:g}: median, worst, not at rest" for g in UNREACHABLE_GAINS]
    lines = [
        f"| method | {' | '.join(columns)} | jump / limit |",
        "|---" * (len(UNREACHABLE_GAINS) + 2) + "|",
    ]
    for method in methods:
        cells, jumps = [], []
        for k in range(len(UNREACHABLE_GAINS)):
            own = []
            for per_method in results.values():
                part = per_method.get(method, [])
                n = len(part) // len(UNREACHABLE_GAINS)
                own += part[k * n : (k + 1) * n]
            flips = [s.flips for s in own]
            cells.append(f"{np.median(flips):.0f}, {max(flips):.0f}, {sum(f > 0 for f in flips)} of {len(own)}")
            jumps += [s.jump for s in own]
        lines.append(f"| {method} | {' | '.join(cells)} | {spread(jumps)} |")
    return "\n".join(lines)


def tell(parts: list[str], out: Path | None) -> None:
    """Print the parts of a page, and write them to a file if one is named."""
    text = "\n\n".join(parts)
    print(text)
    if out is not None:
        out.write_text(text + "\n", encoding="utf-8")


def main() -> None:
    """Run everything that was asked for and print the tables."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--robots", nargs="+", default=list(ROBOTS), choices=list(ROBOTS))
    parser.add_argument("--tasks", type=int, default=100, help="reachable tasks per robot")
    parser.add_argument("--unreachable", type=int, default=10, help="unreachable tasks per robot, at 1 kHz; 0: none")
    parser.add_argument("--peers", nargs="+", default=list(PEERS), choices=list(PEERS))
    parser.add_argument("--python", nargs="*", default=[], metavar="PEER=PYTHON", help="environments that exist")
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    if "pinocchio" not in options.peers:
        options.peers.append("pinocchio")  # what all are compared with
    with tempfile.TemporaryDirectory() as folder:
        reached, pressed, near, skipped = measure(options, Path(folder))
    parts = [
        f"{options.tasks} tasks per robot ({', '.join(options.robots)}), {DURATION:g} s at {1 / DT:g} Hz, half from "
        "near-singular starts; median (quartiles).",
        reach_table(reached, near),
    ]
    if options.unreachable:
        parts += [
            f"{options.unreachable} unreachable targets per robot, {UNREACHABLE_DURATION:g} s at "
            f"{1 / UNREACHABLE_DT:g} Hz: changes of sign of a joint velocity per second, in the last second.",
            flip_table(pressed),
        ]
    parts += [f"SKIPPED {peer}: {reason}" for peer, reason in skipped.items()]
    tell(parts, options.out)


if __name__ == "__main__":
    main()
