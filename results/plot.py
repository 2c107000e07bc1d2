"""The figure and the table of all runs in a folder, from their files alone.

    python results/plot.py [FOLDER]

draws FOLDER/curves.png (of results/whole, if none is given), one column of panels an environment,
one line an arm: the mean over its runs and, from three runs on, its 95% t-interval, each run as a
thin line; above, returns of evaluation beside what actions earn that look at nothing; then how much
of the environment's own state space the collected rows cover; below, that coverage against the
agent's own estimate of the entropy of its future states, which it maximises. Writes
FOLDER/table.md.
"""

import argparse
import csv
import dataclasses
import glob
import itertools
import json
import sys
import textwrap
from collections import defaultdict
from collections.abc import Callable, Iterable
from pathlib import Path

import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np
from scipy import stats

HERE = Path(__file__).parent
WHOLE = HERE / "whole"  # the runs of this repository
sys.path.insert(0, str(HERE.parent))
from results.baseline import COLUMNS, USUAL
from results.play import exit_code
from train import ARMS, Patient, default_settings, interval95

# What may differ between runs of one line: who, where and how looked at, not what is learnt, nor
# `eval_max_steps`, on which returns depend, nor `eval_every`, on which coverage does.
NOT_LEARNT = {
    "env", "seed", "eval_episodes", "checkpoint_minutes",
    "run_dir", "device", "precision",  # in files of before 2026-11-25
}  # fmt: skip
POLICIES = {"random": ":", "zero": "--", "constant": "-."}  # of reference.csv, and their lines
GOALS = {"HopperBulletEnv-v0": 800, "HalfCheetahBulletEnv-v0": 300}  # the speed of learning


def usual_settings(arm: str, preset: str) -> dict:
    """Those that a line of that arm does not name; the preset is named if it is not the default."""
    return dataclasses.asdict(default_settings(arm, preset)) | {"preset": default_settings().preset}


def label(settings: dict) -> str:
    """The arm and the settings that the run changes in it: no line mixes two experiments. A file of
    another version is held to what it has: a setting that it lacks is not changed."""
    usual = USUAL.get(settings["arm"])  # of no arm of ours, but of baseline.py's
    if usual is None:
        usual = usual_settings(settings["arm"], settings["preset"])
    changed = [k for k, v in settings.items() if k not in NOT_LEARNT and v != usual.get(k)]
    return ", ".join([settings["arm"]] + [f"{k} {settings[k]}" for k in changed if k != "arm"])


def read_settings(path: Path) -> tuple[str, str, str]:
    """Environment, label and seed of a run's settings.json, of whichever version. A ValueError, in
    one sentence, if it is none."""
    try:
        settings = json.loads(path.read_text())
        return str(settings["env"]), label(settings), str(int(settings["seed"]))
    except (ValueError, KeyError, TypeError) as error:
        what = f"({type(error).__name__} {error})"
        raise ValueError(f"{path} is no run's settings {what}: left out.") from None


def read_metrics(path: Path) -> dict[str, np.ndarray]:
    """Columns of a metrics.csv, of its whole rows: the last one of a run that goes on may be half
    written, or none be there yet. A ValueError, in one sentence, if it is another table."""
    text = path.read_text(errors="replace") if path.is_file() else ""
    rows = list(csv.DictReader(text[: text.rfind("\n") + 1].splitlines()))
    names = rows[0].keys() if rows else {}
    if rows and (lacking := ", ".join(sorted({*COLUMNS} - names))):
        raise ValueError(f"{path} is no run's metrics, without {lacking}: left out.")
    try:
        return {name: np.array([float(row[name]) for row in rows]) for name in names}
    except (ValueError, TypeError):
        raise ValueError(f"{path} has rows that are no numbers: left out.") from None


def read_runs(folder: Path) -> dict[str, dict[str, dict[str, dict[str, np.ndarray]]]]:
    """{env: {label: {name: {column: values}}}} of each run below a folder, named by its seed; a
    second one of a seed also by its folder. Runs without an evaluation are left out, and what is no
    run is, with a word. So are those of an old_view, which is a figure of its own. A ValueError if
    none is left."""
    runs = defaultdict(lambda: defaultdict(dict))
    found = glob.glob("**/settings.json", root_dir=folder, recursive=True)  # also in linked folders
    paths = {path.resolve(): path for path in sorted(folder / name for name in found)}
    for path in paths.values():
        place = path.parent.relative_to(folder)
        if "old_view" in place.parts:
            continue
        try:
            settings, columns = read_settings(path), read_metrics(path.with_name("metrics.csv"))
        except (ValueError, OSError) as error:
            print(error, file=sys.stderr)
            continue
        if columns:
            env, experiment, name = settings
            seeds = runs[env][experiment]
            seeds[f"{name}, {place}" if name in seeds else name] = columns
    if not runs:
        raise ValueError(f"{folder} holds no evaluated run.")
    names = in_order(runs)
    return {env: {name: arms[name] for name in names if name in arms} for env, arms in runs.items()}


def in_order(runs: dict[str, dict]) -> list[str]:
    """All experiments' names, the arms of the figure first."""
    return [*dict.fromkeys([*ARMS, *sorted({name for arms in runs.values() for name in arms})])]


def read_reference() -> dict[tuple[str, str], dict[str, str]]:
    """{(env, policy): row} of what actions earn that look at nothing."""
    with open(HERE / "reference.csv", newline="") as file:
        return {(row["env"], row["policy"]): row for row in csv.DictReader(file)}


def draw_curve(axes, runs: dict[str, dict], column: str, name: str, color: str) -> None:
    """One experiment's mean where all of its runs were evaluated, at the first one's steps (others
    on a straight line between theirs); each run as a thin line."""
    for run in runs.values():
        mark = "o" if len(run[column]) == 1 else ""  # a line of one point is not seen
        axes.plot(run["env_steps"], run[column], mark + "-", color=color, alpha=0.35, linewidth=0.8)
    first, *_ = every = [run["env_steps"] for run in runs.values()]
    # A hundredth either way: an evaluation may be a step late, where an episode ended.
    low, high = 0.99 * max(steps[0] for steps in every), 1.01 * min(steps[-1] for steps in every)
    steps = first[(first >= low) & (first <= high)]
    values = np.stack([np.interp(steps, r["env_steps"], r[column]) for r in runs.values()])
    mean, half = values.mean(0), np.array([interval95(v) for v in values.T])
    mark = "o" if len(steps) == 1 else ""
    axes.plot(steps, mean, mark + "-", color=color, label=f"{name}, runs: {len(runs)}")
    if len(runs) > 2:  # of two, it reaches six times as far either way as they lie apart
        axes.fill_between(steps, mean - half, mean + half, color=color, alpha=0.12, linewidth=0)


def draw_against(axes, runs: dict[str, dict], name: str, color: str) -> None:
    """One experiment's coverage against Ĥ, a line a run through its evaluations, a dot at the last;
    Spearman's ρ of the two, its mean over runs. Nothing if no entropy was estimated."""
    found = []
    for run in runs.values():
        both = np.array([run.get("mdn/entropy", np.nan * run["coverage"]), run["coverage"]])
        both = both[:, np.isfinite(both).all(0)]
        axes.plot(*both, color=color, alpha=0.5, linewidth=0.8)
        axes.plot(*both[:, -1:], "o", color=color, markersize=4)
        if both.shape[1] > 2 and np.ptp(both, axis=1).all():
            found.append(stats.spearmanr(*both).statistic)
    if found:
        axes.plot([], [], color=color, label=f"{name}: ρ {np.mean(found):.2f}")


def draw_env(panels, env: str, arms, reference, colors) -> None:
    """The column of panels of an environment."""
    above, below, against = panels
    above.sharex(below)
    runs = [run for of in arms.values() for run in of.values()]
    earned = {p: float(reference[env, p]["return"]) for p in POLICIES if (env, p) in reference}
    for policy, value in earned.items():
        above.axhline(value, color="grey", linestyle=POLICIES[policy], label=f"{policy} actions")
    for axes, column in ((above, "eval_return"), (below, "coverage")):
        for name, of in arms.items():
            draw_curve(axes, of, column, name, colors[name])
        values = np.concatenate([run[column] for run in runs])
        values = [*values[np.isfinite(values)], *(earned.values() if axes is above else ())]
        if values:  # an interval may leave the panel
            margin = 0.1 * np.ptp(values) + 1
            axes.set_ylim(min(values) - margin, max(values) + margin)
    for name, of in arms.items():
        draw_against(against, of, name, colors[name])
    against.set_visible(any("mdn/entropy" in run for run in runs))
    above.set(title=env, ylabel="evaluation return")
    below.set(xlabel="environment steps", ylabel="coverage of states, nats")
    against.set(xlabel="Ĥ of states to come, nats; to compare within a run")
    against.set(ylabel="coverage of states, nats")
    for axes, of in ((below, above), (against, against)):
        lines, labels = of.get_legend_handles_labels()
        labels = [textwrap.fill(text, 60) for text in labels]  # there are arms with many changes
        if lines:
            below_xlabel = dict(loc="upper center", bbox_to_anchor=(0.5, 0), borderaxespad=5.5)
            axes.legend(lines, labels, fontsize=7, **below_xlabel)


def draw(path: Path, runs, reference) -> None:
    """Writes the figure."""
    # The first four, of the arms, are told apart by the colour-blind too.
    palettes = mpl.color_sequences
    wheel = [*palettes["petroff6"][:4], *palettes["Dark2"], *palettes["tab10"]]
    colors = dict(zip(in_order(runs), itertools.cycle(wheel)))  # an arm has one colour everywhere
    figure = plt.figure(figsize=(5 * len(runs), 13), layout="constrained")
    panels = figure.subplots(3, len(runs), squeeze=False)
    for (env, arms), column in zip(sorted(runs.items()), panels.T, strict=True):
        draw_env(column, env, arms, reference, colors)
    figure.savefig(path, dpi=90, bbox_inches="tight", metadata={"Software": None})


def score(run: dict, end: float) -> float:
    """What a run earns: its mean evaluation over the last fifth of the steps up to `end`, at five
    points, between evaluations on a straight line. The last one alone is ten episodes' luck. nan
    if it was not evaluated by then."""
    if run["env_steps"][0] > 1.01 * end:  # an evaluation may be a step late
        return float("nan")
    return np.interp(np.linspace(0.8 * end, end, 5), run["env_steps"], run["eval_return"]).mean()


def covered(run: dict, end: float) -> float:
    """Its mean coverage up to `end`, in nats; nan if it was not evaluated by then."""
    seen = run["coverage"][run["env_steps"] <= 1.01 * end]
    return seen.mean() if seen.size else float("nan")


def by_seed(runs: Iterable[tuple[str, dict]], what: Callable, end: float) -> list[float]:
    """What each seed has up to a step, of runs by their names: one that was run twice is one
    sample, the mean of its runs."""
    seeds = defaultdict(list)
    for name, run in runs:
        seeds[name.partition(",")[0]].append(what(run, end))
    return [float(np.mean(found)) for found in seeds.values()]


def iqm(values: np.ndarray, axis: int = -1) -> np.ndarray:
    """Interquartile mean: without a quarter of the values at either end, rounded down (Agarwal et
    al. 2021); of fewer than four, the mean."""
    return stats.trim_mean(values, 0.25, axis=axis)


def over_seeds(
    *samples: list[float], signs: tuple[float, ...] = (1,)
) -> tuple[float, float, float]:
    """Σ sign · IQM of samples, and its 95% percentile bootstrap interval over seeds (Agarwal et al.
    2021); nan where a sample has a single seed or a nan. Of one sample of two or three seeds it
    reaches from the least to the most."""

    def statistic(*samples, axis=-1):
        return sum(sign * iqm(x, axis) for sign, x in zip(signs, samples, strict=True))

    low = high = float("nan")
    if min(map(len, samples)) > 1 and np.isfinite(np.concatenate(samples)).all():
        low, high = stats.bootstrap(
            samples, statistic, method="percentile", rng=0
        ).confidence_interval
    return float(statistic(*map(np.array, samples))), float(low), float(high)


def shown(found: tuple[float, float, float]) -> str:
    """What `over_seeds` found."""
    middle, low, high = found
    return f"{middle:.1f} [{low:.1f}, {high:.1f}]" if np.isfinite(low) else f"{middle:.1f}"


def table(runs, reference) -> str:
    """A line a run: its last and its best evaluation, what it earned in the last fifth of its
    steps, what it covered on average, and how soon it was good; a line a group of seeds."""
    columns = (
        "environment | arm | seed | steps | minutes | last return | best return | last fifth | "
        "last length | mean coverage, nats | minutes to a return"
    )
    lines = [columns, " | ".join(11 * ["---"])]
    for env, arms in sorted(runs.items()):
        for policy in POLICIES:
            if row := reference.get((env, policy)):
                earned = f"{row['return']} ± {row['interval95']} | – | – | {row['length']} | – | –"
                lines.append(f"{env} | {policy} actions | – | – | – | {earned}")
        for name, of in arms.items():
            together, goal = rows_of_all(of), GOALS.get(env)
            rows = [row_of(seed, run, not together, goal) for seed, run in sorted(of.items())]
            lines += [f"{env} | {name} | {row}" for row in rows + together]
    return "".join(f"| {line} |\n" for line in lines)


def row_of(seed: str, run: dict, alone: bool, goal: float | None) -> str:
    """A run's row from its seed on; with the interval over an evaluation's episodes if no other
    seed tells how far runs differ."""
    last = {column: values[-1] for column, values in run.items()}
    half, end = last["eval_interval95"], last["env_steps"]
    spread = f" ± {half:.1f}" if alone and np.isfinite(half) else ""  # of one episode: none
    return (
        f"{seed} | {end:,.0f} | {last['wall_seconds'] / 60:.0f} | "
        f"{last['eval_return']:.1f}{spread} | {run['eval_return'].max():.1f} | "
        f"{score(run, end):.1f} | {last['eval_length']:.0f} | {covered(run, end):.1f} | "
        f"{minutes_to(run, goal)}"
    )


def minutes_to(run: dict, goal: float | None) -> str:
    """The goal, and the minutes after which an evaluation first reached it, if one did."""
    if goal is None:
        return "–"
    reached = np.flatnonzero(run["eval_return"] >= goal)
    return f"{goal}: " + (f"{run['wall_seconds'][reached[0]] / 60:.0f}" if reached.size else "–")


def rows_of_all(runs: dict[str, dict]) -> list[str]:
    """The row of a group of seeds, up to where all of them are; none of a single one."""
    end = min(run["env_steps"][-1] for run in runs.values())
    scores, covers = (by_seed(runs.items(), what, end) for what in (score, covered))
    if len(scores) == 1:
        return []
    earned, seen = shown(over_seeds(scores)), shown(over_seeds(covers))
    return [f"**IQM of {len(scores)}** | {end:,.0f} | – | – | – | {earned} | – | {seen} | –"]


def show(folder: Path) -> None:
    """Draws, writes and prints. A ValueError, in one sentence, if there is nothing to draw."""
    runs, reference = read_runs(folder), read_reference()
    draw(folder / "curves.png", runs, reference)
    text = table(runs, reference)
    (folder / "table.md").write_text(text, encoding="utf-8")
    print(text, end="")


def main(arguments: list[str]) -> int:
    """Runs a command line. Returns its `exit_code`."""
    says = "Draws all runs below a folder: its curves.png and table.md."
    parser = argparse.ArgumentParser(prog="python results/plot.py", description=says)
    add, says = parser.add_argument, "where runs are, however deep (%(default)s)"
    add("folder", type=Path, nargs="?", default=WHOLE, help=says)
    folder = parser.parse_args(arguments).folder
    mpl.use("Agg")
    return exit_code(lambda: show(folder))


if __name__ == "__main__":
    sys.stdout, sys.stderr = Patient(sys.stdout), Patient(sys.stderr)
    sys.exit(main(sys.argv[1:]))
