"""The paper's five claims (§5, §6) against the runs in a folder, from their files alone.

    python results/claims.py [FOLDER]

prints, for the runs of results/whole if no folder is given, claim by claim, comparison by
comparison, what was found: the difference of interquartile means over seeds and its 95% bootstrap
interval (Agarwal et al. 2021), of what runs earn in the last fifth of the steps that all of them
made. Supported: the whole interval is where the claim says. Refuted: none of it is. Else, or with
fewer than three seeds, or none: not enough evidence. The interval of a difference of three and
three seeds holds the truth four times in five, not 19 in 20: of equal arms, one "above" in nine is
supported. Beside the claims, what the paper's argument needs: that `maxent` covers more of the
environment's own states than `revised`, in `small` with equal noise on both explorers' actions.
"""

import argparse
import sys
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))
from results import plot
from results.play import exit_code
from results.plot import by_seed, covered, iqm, over_seeds, score
from train import ARMS, Patient, default_settings

LEAST = 3  # seeds: of two against two, one pair is above the other by chance once in six
MARGIN = 0.1  # on par: this share of what the best arm that got as far earns above random actions
SUPPORTED, REFUTED, OPEN = "supported", "refuted", "not enough evidence"
HOPPER, WALKER, CHEETAH, ANT = ROBOTS = ("Hopper", "Walker2D", "HalfCheetah", "Ant")
BLIND = "best blind action"  # of reference.csv: the most that actions earn that look at nothing


class Comparison(NamedTuple):
    """Σ sign · what the arm earns, on one robot, and where the paper says that it lies."""

    robot: str
    signs: dict[str, int]  # of arms, named as plot.py names them
    lies: str  # "above" 0, "within" a margin of it, or "not above" that margin
    what: Callable[[dict, float], float] = score  # or `covered`


def above(robot: str, arm: str, other: str, what=score) -> Comparison:
    return Comparison(robot, {arm: 1, other: -1}, "above", what)


MAJORITY = {"maxent": 1, "revised": -2, "dreamer": 1}  # (maxent − revised) − (revised − dreamer)
CLAIMS = {  # each a list of (how many of them must hold, comparisons)
    "1. The original Dreamer is entirely unable to solve Walker2D and Hopper": [
        (2, [Comparison(r, {"dreamer": 1, BLIND: -1}, "not above") for r in (WALKER, HOPPER)])
    ],
    "2. There the modifications produce a score, and exploration improves it further": [
        (4, [above(robot, arm, other) for robot in (WALKER, HOPPER)
             for arm, other in (("revised", "dreamer"), ("maxent", "revised"))])
    ],
    "3. On Ant the modifications improve nothing, exploration does, with and without them": [
        (3, [Comparison(ANT, {"revised": 1, "dreamer": -1}, "not above"),
             above(ANT, "maxent", "revised"), above(ANT, "dreamer-maxent", "dreamer")])
    ],
    "4. On HalfCheetah the modifications alone improve, on par with exploration": [
        (3, [above(CHEETAH, "revised", "dreamer"),
             Comparison(CHEETAH, {"revised": 1, "maxent": -1}, "within"),
             Comparison(CHEETAH, {"revised": 1, "dreamer-maxent": -1}, "within")])
    ],
    "5. MaxEnt Dreamer improves on all four, on three most of it by exploration": [
        (4, [above(robot, "maxent", "dreamer") for robot in ROBOTS]),
        (3, [Comparison(robot, MAJORITY, "above") for robot in ROBOTS]),
    ],
    "What `maxent` collects covers more of the environment's states than what `revised` does": [
        (4, [above(robot, "maxent", "revised", covered) for robot in ROBOTS])
    ],
}  # fmt: skip


def verdict(low: float, high: float, lies: str, margin: float) -> str:
    """Of an interval, whether all, none or a part of it lies where it should."""
    infinity = float("inf")
    least, most = {
        "above": (0, infinity), "within": (-margin, margin), "not above": (-infinity, margin)
    }[lies]  # fmt: skip
    if least < low and high < most:
        return SUPPORTED
    return REFUTED if high <= least or low >= most else OPEN


def changes(label: str) -> tuple[str, frozenset[str]]:
    """The arm of a line of plot.py's, and what it changes."""
    arm, *changed = label.split(", ")
    return arm, frozenset(changed)


def line_of(arm: str, common: frozenset[str]) -> tuple[str, frozenset[str]]:
    """The arm, and of the settings common to all arms those that it does not have anyway."""
    preset = "paper" if "preset paper" in common else default_settings().preset
    usual = plot.usual_settings(arm, preset)
    return arm, common - {f"{name} {value}" for name, value in usual.items()}


def choose(arms: dict, arm: str, common: frozenset[str]) -> list[tuple[str, dict]]:
    """The runs of that line, each with its seed."""
    line = line_of(arm, common)
    fitting = (runs for label, runs in arms.items() if changes(label) == line)
    return [each for runs in fitting for each in runs.items()]


def compare(comparison: Comparison, arms: dict, common, reference) -> tuple[str, ...]:
    """Where it should lie, where it does, seeds, steps, verdict."""
    env = f"{comparison.robot}BulletEnv-v0"
    signs = {name: sign for name, sign in comparison.signs.items() if name != BLIND}
    runs = {name: choose(arms, name, common) for name in signs}
    if missing := [name for name, of in runs.items() if not of]:
        return comparison.lies, "–", "; ".join(f"no {name}" for name in missing), "–", OPEN
    end = min(run["env_steps"][-1] for of in runs.values() for _, run in of)
    blind = {p: float(reference[env, p]["return"]) for p in plot.POLICIES}
    shift = comparison.signs.get(BLIND, 0) * max(blind.values())
    samples = [by_seed(of, comparison.what, end) for of in runs.values()]
    found = [x + shift for x in over_seeds(*samples, signs=tuple(signs.values()))]
    chosen = [choose(arms, arm, common) for arm in ARMS]
    as_far = [of for of in chosen if of and min(r["env_steps"][-1] for _, r in of) >= 0.99 * end]
    best = np.nanmax([iqm(by_seed(of, score, end)) for of in as_far])
    margin = MARGIN * max(0.0, best - blind["random"])
    seeds = [len(sample) for sample in samples]
    said = OPEN if min(seeds) < LEAST else verdict(*found[1:], comparison.lies, margin)
    bound = {"above": "0", "within": f"±{margin:.3g}", "not above": f"{margin:.3g}"}
    where = f"{comparison.lies} {bound[comparison.lies]}"
    return where, plot.shown(found), ", ".join(map(str, seeds)), f"{end:,.0f}", said


def judge(groups: list, runs: dict, common, reference) -> tuple[str, list[str]]:
    """The verdict on a claim, and a row for each of its comparisons."""
    verdicts, rows = [], []
    for needed, comparisons in groups:
        found = []
        for one in comparisons:
            arms = runs.get(f"{one.robot}BulletEnv-v0", {})
            where, *told = compare(one, arms, common, reference)
            found.append(told[-1])
            terms = (f"{'+' if n > 0 else '−'} {'2 ' * (abs(n) > 1)}{name}"
                     for name, n in one.signs.items())  # fmt: skip
            compared = f"{' '.join(terms).removeprefix('+ ')}: {where}"
            rows.append(" | ".join([one.robot, compared, *told]))
        failed = found.count(REFUTED) > len(found) - needed
        held = found.count(SUPPORTED) >= needed
        verdicts.append(REFUTED if failed else SUPPORTED if held else OPEN)
    return next(v for v in (REFUTED, OPEN, SUPPORTED) if v in verdicts), rows


def shared_changes(runs: dict) -> list[frozenset[str]]:
    """The settings that at least two arms of the figure were run with; the usual ones first."""
    lines = {changes(label) for of in runs.values() for label in of}
    every = {changed for arm, changed in lines if arm in ARMS}
    found = [c for c in every if sum(line_of(arm, c) in lines for arm in ARMS) > 1]
    return sorted(found, key=lambda c: (len(c), sorted(c)))


def report(runs: dict, reference: dict) -> str:
    """All claims, once for each configuration that two arms share; and which runs have no other."""
    lines, configurations = [], shared_changes(runs) or [frozenset()]
    for common in configurations:
        lines += [f"With {', '.join(sorted(common)) or 'the usual settings'}:", ""]
        lines += ["| claim, robot | compared | by how much | seeds | steps | verdict |"]
        lines += [f"|{6 * ' --- |'}"]
        for claim, groups in CLAIMS.items():
            said, rows = judge(groups, runs, common, reference)
            lines += [f"| **{claim}** | | | | | **{said}** |", *(f"| {row} |" for row in rows)]
        lines += [""]
    held = {line_of(arm, c) for arm in ARMS for c in configurations}
    ours = {label for of in runs.values() for label in of if changes(label)[0] in ARMS}
    alone = sorted(label for label in ours if changes(label) not in held)
    lines += [f"Left out, no other arm was run with these settings: {label}." for label in alone]
    return "\n".join([*lines, ""])


def main(arguments: list[str]) -> int:
    """Runs a command line. Returns its `exit_code`."""
    says = "Holds the paper's claims against all runs below a folder."
    parser = argparse.ArgumentParser(prog="python results/claims.py", description=says)
    add, says = parser.add_argument, "where runs are, however deep (%(default)s)"
    add("folder", type=Path, nargs="?", default=plot.WHOLE, help=says)
    folder = parser.parse_args(arguments).folder
    return exit_code(lambda: print(report(plot.read_runs(folder), plot.read_reference()), end=""))


if __name__ == "__main__":
    sys.stdout, sys.stderr = Patient(sys.stdout), Patient(sys.stderr)
    sys.exit(main(sys.argv[1:]))
