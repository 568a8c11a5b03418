"""Numbers that a change of the library's structure must not change: writes them, or compares with those written.

    python tests/golden/make_golden.py             # write golden.json and golden.npz
    python tests/golden/make_golden.py --check     # recompute and compare; exit code 1 and one line a difference

On the machine that wrote them, and with the same NumPy, SciPy and Pinocchio, all are compared to 1e-12;
elsewhere with the tolerances of comparison.py. `--strict` and `--portable` choose one of these.

Only the public names of `manip_learn` and `python -m manip_learn` are used, so that modules may move. Keys that a later
version adds to an answer are not looked at; keys that it loses are differences. golden.json holds words, counts and
the shape of each array; golden.npz holds all floating-point numbers in the same order.
"""

from __future__ import annotations

import os

# before NumPy is loaded: sums must not depend on the number of cores
os.environ.update(dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1"))
os.environ["MANIP_LEARN_ENGINE"] = "python"  # the text of the law, whatever else is installed

import argparse  # noqa: E402
import importlib.metadata  # noqa: E402
import json  # noqa: E402
import platform  # noqa: E402
import re  # noqa: E402
import sys  # noqa: E402
from pathlib import Path  # noqa: E402

import numpy as np  # noqa: E402
from threadpoolctl import threadpool_info  # noqa: E402

CPU = Path("/proc/cpuinfo")
FOLDER = Path(__file__).resolve().parent
WRITER = "made with"
sys.path.insert(0, str(FOLDER))

from cases_command_line import command_line_cases  # noqa: E402
from cases_control import command_cases, kinematic_cases, rollout_cases  # noqa: E402
from cases_learning import learning_cases  # noqa: E402
from comparison import Cases, differences  # noqa: E402


def computed() -> Cases:
    """Case name -> key -> numbers, words or counts, by the library on the path."""
    return {**learning_cases(), **kinematic_cases(), **command_cases(), **rollout_cases(), **command_line_cases()}


def made_with() -> dict[str, str]:
    """What rounding depends on: the processor that OpenBLAS sees, and the libraries that calculate."""
    kernels = {str(pool.get("architecture", "")) for pool in threadpool_info() if pool["user_api"] == "blas"}
    # one kernel blocks its sums by the size of the cache: of one architecture, processors differ in the last bits
    models = re.findall(r"^model name\s*: (.*)$", CPU.read_text(), re.MULTILINE) if CPU.is_file() else []
    cache = os.environ.get("OPENBLAS_L2_SIZE", "")
    versions = {}
    for package in ("numpy", "scipy", "pin"):
        try:
            versions[package] = importlib.metadata.version(package)
        except importlib.metadata.PackageNotFoundError:
            versions[package] = "none"
    processor = " ".join([platform.machine(), *models[:1], cache]).strip()
    return {"machine": processor, "kernels": " ".join(sorted(kernels)), **versions}


def write(cases: Cases, writer: dict[str, str], folder: Path = FOLDER) -> None:
    """Write golden.json and golden.npz into a folder."""
    words: Cases = {WRITER: dict(writer)}
    numbers = []
    for name, content in cases.items():
        words[name] = {}
        for key, value in content.items():
            if isinstance(value, np.ndarray):
                words[name][key] = {"shape": list(value.shape)}
                numbers.append(value.ravel())
            else:
                words[name][key] = value
    lines = (f"{json.dumps(name)}: {json.dumps(content)}" for name, content in words.items())
    (folder / "golden.json").write_text("{\n" + ",\n".join(lines) + "\n}\n", encoding="utf-8")
    np.savez_compressed(folder / "golden.npz", numbers=np.concatenate(numbers))


def read(folder: Path = FOLDER) -> tuple[Cases, dict[str, str]]:
    """Read what `write` wrote: the cases, and what they were made with."""
    words = json.loads((folder / "golden.json").read_text(encoding="utf-8"))
    with np.load(folder / "golden.npz", allow_pickle=False) as content:
        numbers = content["numbers"]
    writer = words.pop(WRITER)
    start = 0
    for content in words.values():
        for key, value in content.items():
            if isinstance(value, dict) and set(value) == {"shape"}:
                size = int(np.prod(value["shape"], dtype=int))
                content[key] = numbers[start : start + size].reshape(value["shape"])
                start += size
    return words, writer


def main() -> int:
    """Write or compare; returns the exit code."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--check", action="store_true", help="compare with what is written instead of writing")
    parser.add_argument("--strict", action="store_true", help="1e-12 for every case, on any machine")
    parser.add_argument("--portable", action="store_true", help="the tolerances for another machine")
    options = parser.parse_args()
    cases = computed()
    if not options.check:
        write(cases, made_with())
        print(f"{len(cases)} cases written to {FOLDER}")
        return 0
    golden, writer = read()
    strict = options.strict or (writer == made_with() and not options.portable)
    found = differences(golden, cases, strict=strict)
    how = "to 1e-12" if strict else f"with the tolerances for another machine than {writer}"
    print("\n".join([*found, f"{len(golden)} cases compared {how}: {len(found) or 'no'} difference(s)"]))
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main())
