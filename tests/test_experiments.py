"""Running experiments: seeds, parts that are kept, output folders, and what is refused."""

from __future__ import annotations

import dataclasses
import json
from dataclasses import dataclass

import numpy as np
import pytest
from threadpoolctl import threadpool_limits

from manip_learn.errors import ExperimentError, OutputError, UnknownNameError
from manip_learn.experiments import EXPERIMENTS, reproduce, rmse, table
from manip_learn.experiments.experiment_result import markdown_table, mean_and_sd, number, summary
from manip_learn.experiments.paper_setup import Setup
from manip_learn.experiments.reproduce import PARTS as EXPERIMENT_PARTS
from manip_learn.experiments.reproduce import write_result
from manip_learn.experiments.table import LearningCase, learning_trial
from manip_learn.experiments.trial_runner import MARKER, PART, PARTS, PartStore, TrialRunner


@dataclass(frozen=True)
class Dice:
    """Settings of a trial that only draws."""

    sides: int


def throw(case: Dice, rng: np.random.Generator) -> dict[str, int]:
    """A trial."""
    return {"value": int(rng.integers(case.sides))}


def throw_until_ten(case: Dice, rng: np.random.Generator) -> dict[str, int]:
    """A trial that is interrupted once in its life."""
    if case.sides == 666:
        raise KeyboardInterrupt
    return throw(case, rng)


def test_trials_have_seeds_of_their_own():
    """Trials differ from each other, the same call gives the same numbers, another seed or experiment other ones."""
    runner = TrialRunner(workers=1)
    first = runner.map("dice", throw, [Dice(10**9)], 12, seed=3)
    assert len({t["value"] for t in first[0]}) == 12
    assert runner.map("dice", throw, [Dice(10**9)], 12, seed=3) == first
    assert runner.map("dice", throw, [Dice(10**9)], 12, seed=4) != first
    assert runner.map("coins", throw, [Dice(10**9)], 12, seed=3) != first
    assert runner.map("dice", throw, [Dice(10**9)], 3, seed=3)[0] == first[0][:3]


def test_number_of_workers_does_not_change_numbers():
    """One process and two give the same trials in the same order, learning included (seconds aside)."""
    case = LearningCase(Setup("x y", trajectories=20), ("joint-affine", "separate"))
    one, two = (TrialRunner(workers=w).map("few", learning_trial, [case], 2 * PART, seed=1)[0] for w in (1, 2))
    assert [[{**t[n], "seconds": 0} for n in t] for t in one] == [[{**t[n], "seconds": 0} for n in t] for t in two]


def test_threads_of_linear_algebra_do_not_change_numbers():
    """The last digit is the same whatever number of threads BLAS was given."""
    case = LearningCase(Setup("x rz"), ("joint-rbf",))
    outcomes = []
    for threads in (1, 2):
        with threadpool_limits(limits=threads):
            outcomes.append(TrialRunner(workers=1).map("blas", learning_trial, [case], 1, seed=3)[0][0]["joint-rbf"])
    assert {**outcomes[0], "seconds": 0} == {**outcomes[1], "seconds": 0}


def test_threads_give_the_same_numbers():
    """The threading backend agrees with the processes."""
    one = TrialRunner(workers=1).map("dice", throw, [Dice(6), Dice(20)], 13, seed=0)
    assert TrialRunner(workers=2, backend="threading").map("dice", throw, [Dice(6), Dice(20)], 13, seed=0) == one


@pytest.mark.slow
def test_dask_gives_the_same_numbers():
    """An embedded dask cluster on this machine agrees with one process."""
    one = TrialRunner(workers=1).map("dice", throw, [Dice(6), Dice(20)], 13, seed=0)
    assert TrialRunner(workers=2, backend="dask").map("dice", throw, [Dice(6), Dice(20)], 13, seed=0) == one


def test_progress_counts_to_the_total():
    """Progress is reported with the experiment's name and the completed fraction of all trials, and ends at 1."""
    seen: list[tuple[str, float]] = []
    runner = TrialRunner(workers=1, progress=lambda title, fraction: seen.append((title, fraction)), total=24)
    for experiment in ("dice", "coins"):
        runner.map(experiment, throw, [Dice(6)], 12, seed=0)
    assert [title for title, _ in seen] == ["dice"] * 3 + ["coins"] * 3
    assert [round(24 * fraction) for _, fraction in seen] == [5, 10, 12, 17, 22, 24]


def test_interrupted_run_keeps_and_uses_its_parts(tmp_path):
    """After Ctrl-C the finished parts are in the folder, and the next run does not do them again."""
    cases = [Dice(10**9), Dice(666)]
    with pytest.raises(KeyboardInterrupt):
        TrialRunner(1, store=PartStore(tmp_path)).map("dice", throw_until_ten, cases, 2 * PART, seed=0)
    kept = sorted((tmp_path / PARTS).iterdir())
    assert len(kept) == 2
    stamps = [p.stat().st_mtime_ns for p in kept]
    values = TrialRunner(1, store=PartStore(tmp_path)).map("dice", throw_until_ten, cases[:1], 2 * PART, seed=0)
    assert [p.stat().st_mtime_ns for p in kept] == stamps
    assert values == TrialRunner(1).map("dice", throw_until_ten, cases[:1], 2 * PART, seed=0)


def test_parts_depend_on_their_settings(tmp_path):
    """With other settings, another seed or a damaged file, stored results are not reused."""
    runner = TrialRunner(1, store=PartStore(tmp_path))
    a = runner.map("dice", throw, [Dice(10**9)], 2, seed=0)
    assert runner.map("dice", throw, [Dice(10**9)], 2, seed=1) != a
    assert runner.map("dice", throw, [Dice(10**8)], 2, seed=0) != a
    for path in (tmp_path / PARTS).iterdir():
        path.write_text("{", encoding="utf-8")
    assert runner.map("dice", throw, [Dice(10**9)], 2, seed=0) == a


def test_folder_with_other_files_is_refused(tmp_path):
    """A folder with foreign files is left untouched, with an error; an empty one and earlier results are fine."""
    PartStore(tmp_path / "new" / "deep")
    PartStore(tmp_path / "new" / "deep")
    (tmp_path / "thesis.docx").write_text("mine")
    with pytest.raises(OutputError, match=r"thesis\.docx.*empty folder"):
        reproduce("rmse", trials=1, out=tmp_path)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["new", "thesis.docx"]
    with pytest.raises(OutputError, match="is a file"):
        PartStore(tmp_path / "thesis.docx")
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / MARKER).write_text('{"format": "something else"}')
    with pytest.raises(OutputError, match="other files"):
        PartStore(tmp_path / "other")


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"trials": 0}, "from 1"),
        ({"trials": -3}, "from 1"),
        ({"trials": 2.5}, "whole number"),
        ({"trials": True}, "whole number"),
        ({"trials": 10**9}, "100000"),
        ({"seed": -1}, "seed"),
        ({"seed": "a"}, "seed"),
        ({"workers": 0}, "workers"),
    ],
)
def test_settings_out_of_range(tmp_path, options, said):
    """Zero and negative trials and the like are refused before anything is written."""
    with pytest.raises(ExperimentError, match=said):
        reproduce("rmse", out=tmp_path / "out", **({"trials": 1} | options))
    assert not (tmp_path / "out").exists()


def test_unknown_names(tmp_path):
    """An unknown experiment or backend is answered with those that exist."""
    with pytest.raises(UnknownNameError, match="singular-start"):
        reproduce("singularstart", out=tmp_path / "out")
    with pytest.raises(UnknownNameError, match="backend"):
        reproduce("rmse", backend="multiprocessing")  # type: ignore[arg-type]
    assert not (tmp_path / "out").exists()


def test_names_of_experiments():
    """The command line's names are there, and `all` has every part."""
    names = {"table", "bounds", "rmse", "singular-start", "near-singular-start", "sawyer", "recorded", "beyond", "all"}
    assert names == set(EXPERIMENTS)
    assert set(EXPERIMENTS["all"]) == set(EXPERIMENT_PARTS)


def test_files_of_an_experiment(tmp_path):
    """JSON, CSV, Markdown and both kinds of figures are written, and the JSON is what the call returned."""
    out = tmp_path / "out"
    answer = reproduce("rmse", trials=1, seed=5, out=out, workers=1)
    for kind in ("json", "csv", "md", "png", "svg"):
        assert (out / f"rmse.{kind}").stat().st_size > 100
    content = json.loads((out / "rmse.json").read_text())
    assert content["result"] == answer["rmse"] == reproduce("rmse", trials=1, seed=5, workers=1)["rmse"]
    assert content["settings"] == {"trials": 1, "seed": 5}


def test_table_has_the_shape_that_checks_read():
    """Constraint -> paper and ours -> estimator -> mean, sd, median, worst, seconds_per_fit."""
    result = table.TABLE.run(1, np.random.default_rng(0)).to_dict()
    assert list(result) == ["x y", "x rz", "y rz"]
    for block in result.values():
        assert set(block["paper"]) == {"mean", "sd"}
        assert {"joint-affine", "joint-rbf", "separate", "separate-row-by-row", "true-w"} <= set(block["ours"])
        for numbers in block["ours"].values():
            assert {"mean", "sd", "median", "worst", "seconds_per_fit"} <= set(numbers)
    json.dumps(result, allow_nan=False)


def test_figures_are_the_same_bytes_every_time(tmp_path):
    """Drawing twice writes the same files: no dates, no random ids."""
    result = rmse.RMSE.run(1, np.random.default_rng(0))
    for name in ("a", "b"):
        write_result("rmse", result, tmp_path / name, {})
    for kind in ("png", "svg", "csv", "json"):
        assert (tmp_path / "a" / f"rmse.{kind}").read_bytes() == (tmp_path / "b" / f"rmse.{kind}").read_bytes()


def test_summary():
    """Mean, sample s.d., median and worst; None where there is no number."""
    assert summary([1.0, 2.0, 6.0]) == {"mean": 3.0, "sd": pytest.approx(7.0**0.5), "median": 2.0, "worst": 6.0, "n": 3}
    assert summary([4.0])["sd"] == 0.0
    assert summary([])["median"] is None
    assert mean_and_sd(summary([])) == "- +- -"


def test_numbers_for_tables():
    """Short, and never misleading."""
    assert [number(v) for v in (None, 0.0, 1.23e-7, 0.314, 12.4, 12345.0)] == [
        "-",
        "0",
        "1.2e-07",
        "0.31",
        "12",
        "1.2e+04",
    ]
    assert markdown_table(["a", "b"], [[1, 2]]) == "| a | b |\n|---|---|\n| 1 | 2 |"


def test_settings_are_plain():
    """Settings of every part become JSON, since they are part of what a kept part is found by."""
    from manip_learn.experiments import beyond, bounds, recorded, sawyer
    from manip_learn.experiments.singular_starts import NEAR_SINGULAR, SINGULAR

    parts = (*beyond.CASES, *bounds.CASES, *recorded.CASES, *sawyer.CASES, *table.cases().values())
    for case in (*parts, SINGULAR, NEAR_SINGULAR):
        json.dumps(dataclasses.asdict(case))
