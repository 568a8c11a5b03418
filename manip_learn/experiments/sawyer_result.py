"""What came out of the drawer: tables and the picture."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, final

import numpy as np

from manip_learn.control.rollout import Rollout
from manip_learn.experiments import charts
from manip_learn.experiments.experiment_result import ExperimentResult, markdown_table, mean_and_sd, number, summary
from manip_learn.experiments.paired import compare_pairs
from manip_learn.experiments.paper_setup import PAPER_SAWYER_MIE, PAPER_SAWYER_RMSE
from manip_learn.experiments.ways import SAID
from manip_learn.robot.robot import Robot

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Key = tuple[str, str, str]  # source and number of samples, reading, direction
ERRORS = ("mie", "nmie", "mie_held", "nmie_held", "angle_deg")


@final
@dataclass(frozen=True, eq=False)
class SawyerResult(ExperimentResult):
    """Outcome of every trial.

    Attributes:
        outcomes: Case in words -> one dictionary per trial, see `sawyer.sawyer_trial`.
    """

    outcomes: dict[Key, list[dict[str, Any]]]

    def values(self, case: Key, what: str) -> list[Any]:
        """One value per trial that was not refused."""
        return [t[what] for t in self.outcomes[case] if what in t]

    def to_dict(self) -> dict[str, Any]:
        """Paper and ours; source, reading and direction make the key."""
        ours = {}
        for case, trials in self.outcomes.items():
            inside = [t["angle_deg"] <= t["stated_deg"] for t in trials if t.get("stated_deg") is not None]
            ours[" | ".join(case)] = {what: summary(self.values(case, what)) for what in ERRORS} | {
                "rmse": summary(v for t in trials for v in t.get("rmse", ())),
                "rows_right": sum(t.get("rows") == t["rows_true"] for t in trials) / len(trials),
                "inside": float(np.mean(inside)) if inside else None,
                "others": {name: self._other(case, name) for name in trials[0]["others"]},
            }
        paper = {
            "mie": PAPER_SAWYER_MIE,
            "rmse": dict(PAPER_SAWYER_RMSE),
            "note": "a real Sawyer, data unpublished: the paper's numbers hold the friction, compliance and noise of "
            "an arm that we do not have",
        }
        return {"paper": paper, "ours": ours}

    def _other(self, case: Key, name: str) -> dict[str, Any]:
        trials = self.outcomes[case]
        angles = [t["others"][name]["angle_deg"] for t in trials]
        return {
            "angle_deg": summary(angles),
            "nmie_held": summary(t["others"][name]["nmie_held"] for t in trials),
            "pair": compare_pairs([t.get("angle_deg") for t in trials], angles),
        }

    def rows(self) -> list[dict[str, Any]]:
        """One line per trial."""
        return [
            {
                "source": case[0],
                "reading": case[1],
                "direction": case[2],
                "trial": i,
                **{k: t.get(k, "") for k in ("refused", "estimator", "rows", "gap", *ERRORS)},
                "rmse_mean": float(np.mean(t["rmse"])) if "rmse" in t else "",
            }
            for case, trials in self.outcomes.items()
            for i, t in enumerate(trials)
        ]

    def markdown(self) -> str:
        """All readings beside the paper's numbers, then the published learners on the same recordings."""
        paper = [
            "**paper, a real arm**",
            "",
            "",
            number(PAPER_SAWYER_MIE),
            "",
            "",
            "",
            mean_and_sd(PAPER_SAWYER_RMSE),
            "",
        ]
        lines, pairs = [paper], []
        for key, block in self.to_dict()["ours"].items():
            case = key.split(" | ")
            lines.append([*case, *(number(block[w]["median"]) for w in ("mie", "mie_held", "nmie_held"))])
            lines[-1].append(_angle(block["angle_deg"]))
            lines[-1] += [mean_and_sd(block["rmse"]), f"{100 * block['rows_right']:.0f} %"]
            if block["others"]:
                said = [_other_cell(block["others"].get(n)) for n in ("held", "row-by-row", "line")]
                pairs.append([*case, number(block["angle_deg"]["median"]), *said])
        header = ["demonstrations", "reading", "Lambda", "MIE, training", "MIE, held out", "NMIE, held out"]
        header += ["angle [deg], median (worst)", "RMSE, mean +- s.d.", "rows found"]
        against = ["recordings", "reading", "Lambda", SAID["auto"], SAID["held"], SAID["row-by-row"], SAID["line"]]
        return "\n\n".join(
            [
                markdown_table(header, lines),
                "Published learners for b = 0 on the same recordings, told the number of rows: median angle [deg]; the "
                f"median of its ratio to that of *{SAID['auto']}* [95 % interval], resamples at which "
                f"*{SAID['auto']}* is better. A ratio below 1 is a loss of ours.",
                markdown_table(against, pairs),
            ]
        )

    def figures(self) -> dict[str, Figure]:
        """MIE on held-out recordings and RMSE of every trial."""
        figure, axes = charts.new_figure(12.0, 5.6, 1, 2)
        labels = {f"{source}: {reading.split()[0]} {d}": (source, reading, d) for source, reading, d in self.outcomes}
        charts.strip(axes[0, 0], {k: self.values(c, "mie_held") for k, c in labels.items()}, PAPER_SAWYER_MIE)
        axes[0, 0].set_ylabel("MIE on held-out recordings\n[m$^2$ for one row, m$^4$ for two]")
        means = {k: [float(np.mean(v)) for v in self.values(c, "rmse")] for k, c in labels.items()}
        charts.strip(axes[0, 1], means, PAPER_SAWYER_RMSE["mean"])
        axes[0, 1].set_ylabel("RMSE of the policy, mean of 20 rollouts\n[m/rad for one row, m$^2$/rad for two]")
        for ax in axes[0]:
            ax.tick_params(axis="x", labelsize=6.5)
        figure.supxlabel("recordings: reading of Lambda; a dot is a trial, a bar the median", fontsize=9)
        return {"sawyer": figure}

    def replays(self) -> dict[str, tuple[Robot, Mapping[str, Rollout]]]:
        """None."""
        return {}


def _angle(statistics: dict[str, Any]) -> str:
    return f"{number(statistics['median'])} ({number(statistics['worst'])})"


def _other_cell(other: dict[str, Any] | None) -> str:
    if other is None:
        return "not run"
    pair = other["pair"]
    interval = "" if pair["low"] is None else f" [{number(pair['low'])}, {number(pair['high'])}]"
    return f"{number(other['angle_deg']['median'])}; {number(pair['ratio'])}{interval}, {pair['wins']} of {pair['n']}"
