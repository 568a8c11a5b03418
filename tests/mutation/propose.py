"""New mutants for the catalogue: a sample with a fixed seed per file, each with the first test that notices it.

    python tests/mutation/propose.py AREA FILE COUNT TEST...
    python tests/mutation/propose.py <requests.txt      (lines of the same four)

All of them go into the catalogue. Write a test for what none notices, or say in the catalogue why it is equivalent.
"""

from __future__ import annotations

import sys
import tempfile
import zlib
from pathlib import Path

import numpy as np
from catalogue import ROOT, Mutant, areas, load, save
from operators import sample
from trial import Workshop


def propose(workshop: Workshop, area: str, file: str, count: int, tests: list[str]) -> None:
    """Sample mutants of one file, look for the test that notices each, and add them to the area's catalogue."""
    rng = np.random.default_rng(zlib.crc32(file.encode()))
    faults = sample((ROOT / file).read_text(encoding="utf-8"), count, rng)
    outcome, failing = workshop.run(tests)
    if outcome != "survived":
        print(workshop.output())
        raise SystemExit(f"the tests fail without any fault: {outcome} {failing}")
    for old, new in faults:
        mutant = Mutant(file, old, new)
        known = load(area) if area in areas() else []
        if any(m.file == file and m.old == old and m.new == new for m in known):
            continue
        outcome, first = workshop.try_mutant(mutant, tests)
        print(f"{outcome:9} {mutant.name}   [{first}]", flush=True)
        noticed_by = tuple(tests) if outcome == "survived" else (first or tests[0],)
        save(area, [*(load(area) if area in areas() else []), Mutant(file, old, new, noticed_by)])


def main() -> None:
    """One file from the command line, or many, one per line of standard input."""
    requests = [sys.argv[1:]] if len(sys.argv) > 1 else [line.split() for line in sys.stdin if line.strip()]
    with tempfile.TemporaryDirectory() as folder:
        workshop = Workshop(Path(folder) / "project", timeout=120.0)
        for area, file, count, *tests in requests:
            print(f"{area}: {file}", flush=True)
            propose(workshop, area, file, int(count), tests)


if __name__ == "__main__":
    main()
