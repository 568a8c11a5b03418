"""The terms that the commands print, explained: a short line each under a table, or with --explain a paragraph."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from rich.markup import escape

if TYPE_CHECKING:
    from rich.console import Console

# term -> a few words, and a paragraph
WORDS: dict[str, tuple[str, str]] = {
    "row": (
        "a combination of velocities that the task holds",
        "Each row of Lambda is one combination of velocities that the task holds: a drawer holds two of x, y, z. The "
        "directions that are left are free.",
    ),
    "gap": (
        "weakest free direction over strongest held one; 10 is clear, below 3 none",
        "Directions of the motion are put in order of how much they are used. The gap is the ratio between the first "
        "one that is free and the last one that is held. Noise and softness make it smaller; 10 and above is clear, "
        "3 to 10 is weak. The joint estimator compares what fits with one row fewer leave unexplained; there 1.5 says "
        "something.",
    ),
    "left out": (
        "tested on recordings that were not learnt from; 0 % is best",
        "The constraint is learnt again without some of the recordings and asked about those. What it does not explain "
        "of their motion is noise, softness, or a constraint that is not theirs.",
    ),
    "uncertainty": (
        "68 % of repetitions with other recordings stay within it",
        "The recordings are drawn again with repetition and learnt from, many times (bootstrap). It says how much the "
        "answer depends on which recordings there are, not whether they are of the right task.",
    ),
    "strength": (
        "growth of a row's motion when joints are exchanged; 1 or less: free",
        "Joints are exchanged between recordings, so that nothing is held any more (recombination test). A row that "
        "the world holds then moves far more; a row that nobody tried does not. Strength is the ratio, p the chance "
        "of it.",
    ),
    "mu": (
        "manipulability of the task, 0 at its singularity; compare policies only",
        "The volume of velocities along the held rows that joint velocities of length 1 reach: the product of the "
        "singular values of A(q). At 0 the arm cannot follow the task in some direction.",
    ),
    "off": (
        "how far the hand strayed from the line, plane or circle",
        "The held rows, integrated: a drawer pushes back as soon as the hand leaves its line. Near a singularity the "
        "arm cannot follow in every direction, and the hand strays.",
    ),
    "fastest": (
        "fastest joint, of its speed limit",
        "Of all joints and moments of the motion, the largest share of a velocity limit. At 100 % the arm was as fast "
        "as it may be and the hand had to wait for it.",
    ),
    "least mu": (
        "smallest manipulability on the way, 0 at a singularity",
        "The product of the singular values of A(q), the rows that the task holds and the direction that it drives. "
        "The smaller it is, the faster the joints must move for the same motion of the hand.",
    ),
    "error": (
        "distance to the target at the end, along the rows driven [m or rad]",
        "All directions that the target names are driven, and the tip goes to the point. With --rows held those that "
        "the constraint leaves free do not count, and the tip may end elsewhere along them.",
    ),
    "peak": ("the fastest joint [rad/s or m/s]", "The largest speed of any joint during the motion."),
    "unhindered": (
        "share of the steps that no limit and no singularity changed",
        "Steps with the status ok: the command is what the control law asks for. In the others joint limits, speed "
        "limits, acceleration limits or a singularity slowed, bent or stopped it; replay shows where.",
    ),
    "score": (
        "how unusual the episode is; left out above the threshold below",
        "Root of the sum of squares of all z-scores that are worse than usual. Episodes are compared with the median "
        "of those given, so it says nothing if most of them are of another task.",
    ),
    "sigma": (
        "smallest singular value of the task; 0 at its singularity",
        "The least speed along the held rows for joint velocities of length 1, at the worst posture of the episode.",
    ),
    "broken": (
        "share of the motion along held rows; 0 % is best",
        "What A(q) u leaves of the joint velocities: noise gives some tenths of a percent, another task much more.",
    ),
    "mm, deg": ("extent of that motion", "How far the tip went along rows that are held, in positions and rotations."),
    "margin": (
        "room to the nearest joint limit, of the joint's range",
        "Negative beyond the limit; 50 % is the middle of the range.",
    ),
    "speed": ("fastest joint, of its limit", "Above 100 % the recording is faster than the description allows."),
    "jerk": ("roughness [rad/s3]", "Root mean square of the third derivative, less what noise contributes."),
    "rest": ("share of the time at rest", "No joint is faster than 0.02 rad/s."),
}


def print_words(console: Console, terms: Sequence[str], explain: bool) -> None:
    """Explain terms: one line each in short, or a paragraph each."""
    if explain:
        for term in terms:
            console.print(f"[bold]{escape(term)}[/bold]: {escape('. '.join(_sentences(term)))}", highlight=False)
        return
    for term in terms:
        console.print(f"[dim]{escape(f'{term}: {WORDS[term][0]}')}[/dim]", highlight=False)
    console.print("[dim]--explain says more[/dim]", highlight=False)


def _sentences(term: str) -> tuple[str, str]:
    short, long = WORDS[term]
    return short[0].upper() + short[1:], long
