"""Try every mutant of the catalogue: the named tests must notice it.

    python tests/mutation/run.py [AREA...] [--timeout 300]

Each area's tests first run without any fault, so that a test that fails anyway proves nothing. The run fails if the
catalogue is stale, if an area's tests fail without a fault, or if less than 95 % of all mutants are noticed; those that
are not are listed either way.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from pathlib import Path

from catalogue import ROOT, Mutant, StaleCatalogueError, areas, load
from trial import Workshop

LEAST = 0.95  # of the mutants must be noticed


def main() -> int:
    """Exit code 0 if the tests are strong enough."""
    parser = argparse.ArgumentParser(description="Do the tests notice faults that are put in on purpose?")
    parser.add_argument("areas", nargs="*", choices=[*areas(), []], metavar="AREA", help="default: all")
    parser.add_argument("--timeout", type=float, default=300.0, help="seconds after which a mutant counts as hanging")
    options = parser.parse_args()
    try:
        catalogue = {area: load(area) for area in options.areas or areas()}
        for mutants in catalogue.values():
            for mutant in mutants:
                mutant.applied(ROOT)
    except StaleCatalogueError as error:
        print(f"STALE CATALOGUE: {error}", file=sys.stderr)
        return 1
    noticed = total = 0
    with tempfile.TemporaryDirectory() as folder:
        workshop = Workshop(Path(folder) / "project", options.timeout)
        for area, mutants in catalogue.items():
            start, killed, survivors = time.monotonic(), 0, []
            different = [mutant for mutant in mutants if not mutant.equivalent]
            if not _passes(workshop, area, different):
                return 1
            for mutant in different:
                outcome, _first = workshop.try_mutant(mutant, mutant.tests)
                if outcome == "survived":
                    survivors.append(mutant)
                    print(f"SURVIVED {mutant.name}\n         {', '.join(mutant.tests)}", flush=True)
                else:
                    killed += 1
            noticed, total = noticed + killed, total + len(different)
            equivalent = len(mutants) - len(different)
            print(
                f"{area:12} {killed} of {len(different)} mutants noticed, {equivalent} equivalent ones listed, "
                f"{time.monotonic() - start:.0f} s",
                flush=True,
            )
    print(f"{'all':12} {noticed} of {total} mutants noticed, {100.0 * noticed / max(total, 1):.1f} %")
    return 0 if noticed >= LEAST * total else 1


def _passes(workshop: Workshop, area: str, mutants: list[Mutant]) -> bool:
    """Whether the tests of an area exist and pass without any fault."""
    tests = sorted({test for mutant in mutants for test in mutant.tests})
    outcome, first = workshop.run(tests) if tests else ("survived", "")
    if outcome == "survived":
        return True
    print(workshop.output()[-4000:], file=sys.stderr)
    print(f"{area}: the tests do not pass without any fault: {outcome} {first}", file=sys.stderr)
    return False


if __name__ == "__main__":
    sys.exit(main())
