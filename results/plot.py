"""The figure and the table of all runs in a folder, from their files alone.

    python results/plot.py [FOLDER]

draws FOLDER/curves.png (results/ if none is given), one column of panels an environment, one line
an arm: the mean over seeds and its 95% t-interval, each seed as a thin line; above, returns of
evaluation; below, how much of the environment's own state space the collected rows cover. Writes
FOLDER/table.md.
"""

import argparse
import csv
import dataclasses
import json
import sys
from collections import defaultdict
from pathlib import Path

import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE.parent))
from train import ARMS, Patient, default_settings, interval95

# what may differ between runs of one line: who and where, not what is learnt
NOT_LEARNT = {
    "env",
    "seed",
    "eval_every",
    "eval_episodes",
    "eval_max_steps",
    "checkpoint_minutes",
}

POLICIES = {"random": ":", "zero": "--", "constant": "-."}  # of reference.csv, and their lines
COLUMNS = {
    "env_steps", "wall_seconds", "eval_return", "eval_interval95", "eval_length", "coverage",
}  # fmt: skip


def label(settings: dict) -> str:
    """The arm and the settings that the run changes in it: no line mixes two experiments. A run of
    an older version is held against what it recorded alone."""
    usual = dataclasses.asdict(default_settings(settings["arm"], settings["preset"]))
    usual |= {"preset": default_settings().preset}
    changed = [
        k for k in usual if k in settings and k not in NOT_LEARNT and settings[k] != usual[k]
    ]
    return ", ".join([settings["arm"]] + [f"{k} {settings[k]}" for k in changed])


def read_run(path: Path) -> tuple[dict, dict[str, np.ndarray]]:
    """Settings and columns of metrics.csv of the run whose settings.json it is; no columns if it
    was not evaluated yet. A last row that is half written is left out.

    Raises:
        ValueError: if it is no run's.
    """
    settings = json.loads(path.read_text())
    label(settings), settings["seed"], int(settings["action_repeat"]), settings["env"].lower()
    metrics = path.with_name("metrics.csv")
    lines = metrics.read_text().splitlines() if metrics.exists() else []
    rows = [row for row in csv.DictReader(lines) if None not in row.values() and None not in row]
    columns = {name: np.array([float(row[name]) for row in rows]) for name in rows[:1] and rows[0]}
    if columns and not columns.keys() >= COLUMNS:
        raise ValueError(f"{metrics} lacks {', '.join(sorted(COLUMNS - columns.keys()))}")
    return settings, columns


def differ(run: dict, other: dict, action_repeat: int) -> bool:
    """Whether two runs were evaluated at different steps."""
    pairs = zip(run["env_steps"], other["env_steps"], strict=False)
    return any(abs(a - b) >= action_repeat for a, b in pairs)


def read_runs(folder: Path) -> dict[str, dict[str, dict[str, dict[str, np.ndarray]]]]:
    """{env: {label: {name: {column: values}}}} of each run in a folder, named by its seed; a second
    one of a seed also by its folder. Runs without an evaluation are left out, and what is no
    run is, with a word.
    """
    runs = defaultdict(lambda: defaultdict(dict))
    for path in sorted(folder.glob("*/settings.json")):
        try:
            settings, columns = read_run(path)
        except (ValueError, KeyError, TypeError, AttributeError, OSError) as error:
            print(f"{path.parent} is left out: {type(error).__name__} {error}", file=sys.stderr)
            continue
        if not columns:
            continue
        seeds = runs[settings["env"]][label(settings)]
        if any(differ(columns, other, settings["action_repeat"]) for other in seeds.values()):
            print(f"{path.parent} is left out: other steps than another seed's", file=sys.stderr)
            continue
        name = str(settings["seed"])
        seeds[f"{name}, {path.parent.name}" if name in seeds else name] = columns
    return runs


def read_reference() -> dict[tuple[str, str], dict[str, str]]:
    """{(env, policy): row} of what random and no actions earn."""
    with open(HERE / "reference.csv", newline="") as file:
        return {(row["env"], row["policy"]): row for row in csv.DictReader(file)}


def draw_curve(axes, seeds: dict[str, dict], column: str, name: str, color: str) -> None:
    """One experiment's line: up to the last step that all of its seeds have reached."""
    for run in seeds.values():
        mark = "o" if len(run[column]) == 1 else ""  # a line of one point is not seen
        axes.plot(
            run["env_steps"], run[column], color=color, alpha=0.35, linewidth=0.8, marker=mark
        )
    length = min(len(run[column]) for run in seeds.values())
    values = np.stack([run[column][:length] for run in seeds.values()])
    steps, mean = next(iter(seeds.values()))["env_steps"][:length], values.mean(0)
    axes.plot(steps, mean, color=color, label=f"{name}, seeds: {len(seeds)}")
    half = np.array([interval95(v) for v in values.T])
    axes.fill_between(steps, mean - half, mean + half, color=color, alpha=0.12, linewidth=0)


def draw(path: Path, runs, reference) -> None:
    """Writes the figure."""
    names = dict.fromkeys([*ARMS, *sorted({name for arms in runs.values() for name in arms})])
    colors = {name: f"C{k}" for k, name in enumerate(names)}  # an arm has one colour everywhere
    rows = {"eval_return": "evaluation return", "coverage": "coverage of states, nats"}
    figure, panels = plt.subplots(
        len(rows), len(runs), figsize=(5 * len(runs), 6), sharex="col", squeeze=False
    )
    for (env, arms), column_of_panels in zip(sorted(runs.items()), panels.T, strict=True):
        for axes, (column, label) in zip(column_of_panels, rows.items(), strict=True):
            for name, seeds in arms.items():
                draw_curve(axes, seeds, column, name, colors[name])
            every_value = np.concatenate([r[column] for seeds in arms.values()
                                          for r in seeds.values()])  # fmt: skip
            every_value = every_value[np.isfinite(every_value)]
            if every_value.size:  # an interval over two seeds may leave the panel
                margin = 0.1 * np.ptp(every_value) + 1
                axes.set_ylim(every_value.min() - margin, every_value.max() + margin)
            axes.set_ylabel(label)
            if column == "eval_return":
                for policy, style in POLICIES.items():
                    if (env, policy) not in reference:
                        continue
                    earned = float(reference[env, policy]["return"])
                    axes.axhline(earned, color="grey", linestyle=style, label=f"{policy} actions")
                axes.set_title(env)
        column_of_panels[0].legend(fontsize=8)
        column_of_panels[-1].set_xlabel("environment steps")
    figure.tight_layout()
    figure.savefig(path, dpi=90, metadata={"Software": None})


def table(runs, reference) -> str:
    """A line a run: its last and its best evaluation, and what it covered on average."""
    lines = [
        "| environment | arm | seed | steps | minutes | last return | best return "
        "| last length | mean coverage, nats |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for env, arms in sorted(runs.items()):
        for policy in POLICIES:
            if not (row := reference.get((env, policy))):
                continue
            lines.append(
                f"| {env} | {policy} actions | – | – | – | {row['return']} ± {row['interval95']} "
                f"| – | {row['length']} | – |"
            )
        for name, seeds in arms.items():
            for seed, run in sorted(seeds.items()):
                last = {column: values[-1] for column, values in run.items()}
                lines.append(
                    f"| {env} | {name} | {seed} | {last['env_steps']:,.0f} "
                    f"| {last['wall_seconds'] / 60:.0f} | {last['eval_return']:.1f} "
                    f"± {last['eval_interval95']:.1f} | {run['eval_return'].max():.1f} "
                    f"| {last['eval_length']:.0f} | {run['coverage'].mean():.1f} |"
                )
    return "\n".join(lines) + "\n"


def main(arguments: list[str]) -> int:
    """Runs a command line. Returns the exit code: 0 done, 2 bad input."""
    parser = argparse.ArgumentParser(
        prog="python results/plot.py", description="Draws all runs in a folder: curves, table."
    )
    parser.add_argument("folder", type=Path, nargs="?", default=HERE, help="%(default)s")
    folder = parser.parse_args(arguments).folder
    mpl.use("Agg")
    try:
        runs, reference = read_runs(folder), read_reference()
        if not runs:
            raise ValueError(f"{folder} holds no evaluated run in a folder: nothing to draw.")
        draw(folder / "curves.png", runs, reference)
        (folder / "table.md").write_text(table(runs, reference), encoding="utf-8")
    except (ValueError, OSError) as error:
        print(error, file=sys.stderr)
        return 2
    print(table(runs, reference), end="")
    return 0


if __name__ == "__main__":
    sys.stdout, sys.stderr = Patient(sys.stdout), Patient(sys.stderr)
    sys.exit(main(sys.argv[1:]))
