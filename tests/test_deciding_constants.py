"""The numbers of the learner that decide an answer stand in one file, few of them, each with a reason."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import manip_learn

ROOM = Path(manip_learn.__file__).parent / "learning"
DECIDING = ROOM / "deciding.py"
MOST = 100
# every other number of a module of the room: it bounds time or memory (or how much is printed), or it is rounding (or a
# step on the way to a converged answer, a property of a distribution, the size of a thing). What decides is no choice
BESIDE = {
    "answer": {"time": "MOST_PATHS START_SHARE"},
    "audit": {"time": "CHUNK CRITERIA", "rounding": "NOTABLE MAD_EFFICIENCY MAD_SMALL MAD_TO_SIGMA"},
    "effort_witness": {"time": "MOST_SAMPLES DRAWS", "rounding": "SHORTEST RANK ONE_POPULATION"},
    "descent": {"rounding": "FIRST_DAMPING MOST_DAMPED CUTOFF"},
    "estimators.joint_estimator": {
        "time": "RANDOM_STARTS COMPARE_LIMIT MAX_COLUMNS MOST_POSTURES FEW FEW_SAMPLES STARTS IDLE_ROUNDS REFINED LOOK",
        "rounding": "EXACT NOISY",
    },
    "estimators.model_search": {
        "time": "N_FOLDS SCAN_COLUMNS ROUNDS MOST_TRIALS COMPARE RANDOM_STARTS SUBSPACES PROGRESS",
        "rounding": "ROUNDING EXACT VANISHING",
    },
    "estimators.null_space": {"time": "MAX_ITERATIONS MAX_FOLDS", "rounding": "SAME_COST SHORTEST GAIN"},
    "estimators.policy_equations": {
        "time": "REFINEMENTS CHUNK TYLER_STEPS",
        "rounding": "FLAT FLOOR PRIOR DIFFERENCES MEDIAN",
    },
    "estimators.separation": {"time": "MAX_ITERATIONS STALLED SEPARATION_LIMIT", "rounding": "STAGES NO_GAIN"},
    "estimators.variable_projection": {
        "time": "MAX_ITERATIONS MANY_COLUMNS MAX_BLOCKS MARGINAL_ITERATIONS FIRST_UPDATES UPDATES START KEEP_LIMIT",
        "rounding": "RANK_TOLERANCE BASIS_TOLERANCE NEARLY_EXACT LEAST_PIVOT SETTLED LEAST DETERMINED",
    },
    "explanation.explain": {
        "time": "MOST_CONSTRAINTS MOST_TESTED FIRST_SCALES KEPT TURNS SETTLING BEST_ALONE STRIDE MOST_PAIRED "
        "MOST_ALONE MOST_PAIRS MOST SAME",
        "rounding": "TINY",
    },
    "explanation.findings": {"rounding": "MEDIAN_SQUARE"},
    "explanation.row_motion": {"time": "SCAN_RATE FEW", "rounding": "RANK"},
    "mechanisms.find_mechanism": {"time": "SAMPLES MOST LEAST", "rounding": "BLIND"},
    "mechanisms.place_fit": {
        "time": "ITERATIONS ROUNDS ASTRAY LONGEST DRAWS",
        "rounding": "SETTLED UNDETERMINED LEVERAGE_FLOOR",
    },
    "mechanisms.quantities": {"rounding": "NEAR_AXIS QUANTITIES"},
    "recombination": {
        "time": "SURE MOST_BINS MOST_POINTS NODES_PER_BIN RECOMBINATIONS MOST_RECOMBINATIONS MOST_TRAJECTORIES SHIFTS "
        "MOMENTS_AT_ONCE",
        "rounding": "LEVEL_FLOOR",
    },
    "repeats": {"time": "POSTURES PROBES PROBES_NEAR THINNED SEAM SEAM_SHARE"},
    "report": {"time": "ADVICES_SAID MOST_NOTES KEPT_POSTURES SPANS_SHOWN"},
    "samples": {"time": "IN_MEMORY_SAMPLES BLOCK KEEP_LIMIT KEEP_WHITENED_LIMIT", "rounding": "PRUNE_RATIO SAME"},
    "streaming.refinement": {
        "time": "GOLDEN MAX_PASSES NULL_SPACE_BLOCKS",
        "rounding": "SETTLED ROUNDING WITHIN_ROUNDING",
    },
    "streaming.sample_stream": {"time": "CHUNK TOGETHER MOST_RECORDINGS IN_MEMORY KEPT_BYTES"},
    "uncertainty": {
        "time": "DRAWS MOST_STEPS TAU_STEPS MOST_SAMPLES",
        "rounding": "LEVERAGE_FLOOR SPENT LEAST_VARIANCE UNSEEN",
    },
}


def has_number(value: ast.AST) -> bool:
    """Whether a number is written in it, not counting functions."""
    if isinstance(value, ast.Constant):
        return isinstance(value.value, int | float) and not isinstance(value.value, bool)
    return not isinstance(value, ast.Lambda) and any(map(has_number, ast.iter_child_nodes(value)))


def numbers(file: Path) -> dict[str, int]:
    """Names that a module gives to numbers outside of its functions -> line."""
    out: dict[str, int] = {}
    for line in ast.parse(file.read_text()).body:
        if isinstance(line, ast.Assign | ast.AnnAssign) and line.value is not None and has_number(line.value):
            targets = line.targets if isinstance(line, ast.Assign) else [line.target]
            out |= {n.id: line.lineno for target in targets for n in ast.walk(target) if isinstance(n, ast.Name)}
    return out


def test_few_numbers_decide():
    """At most a hundred, each with words above it: a new case is answered by a rule that is there already."""
    found, lines = numbers(DECIDING), DECIDING.read_text().splitlines()
    assert 0 < len(found) <= MOST
    bare = [name for name, line in found.items() if not lines[line - 2].startswith("# ")]
    assert not bare


def test_what_decides_stands_in_one_file():
    """A number elsewhere in the room is on the list of those that bound computing: a new one has to say what it is."""
    there = {}
    for file in sorted(ROOM.rglob("*.py")):
        names = set(numbers(file)) if file != DECIDING else set()
        if names:
            there[".".join(file.relative_to(ROOM).with_suffix("").parts)] = names
    listed = {module: set(" ".join(kinds.values()).split()) for module, kinds in BESIDE.items()}
    assert there == listed


def test_all_that_decide_are_used():
    """No number stays in the file when the rule that read it has gone, and none has two names."""
    code = "\n".join(file.read_text() for file in ROOM.rglob("*.py") if file != DECIDING)
    unused = [name for name in numbers(DECIDING) if not re.search(rf"\b{name}\b", code)]
    assert not unused
    assert not re.findall(r"learning\.deciding import .* as ", code)
