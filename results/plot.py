"""The figure and the table of all runs in a folder, from their files alone.

    python results/plot.py [FOLDER]

draws FOLDER/curves.png (results/ if none is given), one column of panels an environment, one line
an arm: the mean over seeds and its 95% t-interval, each seed as a thin line; above, returns of
evaluation; below, how much of the environment's own state space the collected rows cover. Writes
FOLDER/table.md.
"""

import csv
import json
import sys
from collections import defaultdict
from pathlib import Path

import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE.parent))
from train import ARMS, interval95


def read_runs(folder: Path) -> dict[str, dict[str, dict[int, dict[str, np.ndarray]]]]:
    """{env: {arm: {seed: {column: values}}}} of every folder in it that holds a run.

    Raises:
        ValueError: if two runs are of one environment, arm and seed.
    """
    runs = defaultdict(lambda: defaultdict(dict))
    for path in sorted(folder.glob("*/settings.json")):
        settings = json.loads(path.read_text())
        with open(path.with_name("metrics.csv"), newline="") as file:
            rows = list(csv.DictReader(file))
        columns = {name: np.array([float(row[name]) for row in rows]) for name in rows[0]}
        # a row is written at the end of the decision that passes a multiple of eval_every
        every = settings["eval_every"]
        columns["env_steps"] = every * np.round(columns["env_steps"] / every)
        seeds = runs[settings["env"]][settings["arm"]]
        if settings["seed"] in seeds:
            raise ValueError(f"{path.parent} repeats the seed of another run here: remove one.")
        seeds[settings["seed"]] = columns
    return runs


def read_reference() -> dict[tuple[str, str], dict[str, str]]:
    """{(env, policy): row} of what random and no actions earn."""
    with open(HERE / "reference.csv", newline="") as file:
        return {(row["env"], row["policy"]): row for row in csv.DictReader(file)}


def draw_curve(axes, seeds: dict[int, dict[str, np.ndarray]], column: str, arm: str) -> None:
    """One arm's line: up to the last step that all of its seeds have reached."""
    color = f"C{list(ARMS).index(arm)}"
    for run in seeds.values():
        axes.plot(run["env_steps"], run[column], color=color, alpha=0.35, linewidth=0.8)
    length = min(len(run[column]) for run in seeds.values())
    values = np.stack([run[column][:length] for run in seeds.values()])
    steps, mean = next(iter(seeds.values()))["env_steps"][:length], values.mean(0)
    axes.plot(steps, mean, color=color, label=f"{arm}, seeds: {len(seeds)}")
    half = np.array([interval95(v) for v in values.T])
    axes.fill_between(steps, mean - half, mean + half, color=color, alpha=0.12, linewidth=0)


def draw(path: Path, runs, reference) -> None:
    """Writes the figure."""
    rows = {"eval_return": "evaluation return", "coverage": "coverage of states, nats"}
    figure, panels = plt.subplots(
        len(rows), len(runs), figsize=(5 * len(runs), 6), sharex="col", squeeze=False
    )
    for (env, arms), column_of_panels in zip(sorted(runs.items()), panels.T, strict=True):
        for axes, (column, label) in zip(column_of_panels, rows.items(), strict=True):
            for arm, seeds in arms.items():
                draw_curve(axes, seeds, column, arm)
            every_value = np.concatenate([r[column] for seeds in arms.values()
                                          for r in seeds.values()])  # fmt: skip
            margin = 0.1 * np.ptp(every_value) + 1  # an interval over two seeds may leave the panel
            axes.set_ylim(every_value.min() - margin, every_value.max() + margin)
            axes.set_ylabel(label)
            if column == "eval_return":
                for policy, style in (("random", ":"), ("zero", "--")):
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
        for policy in ("random", "zero"):
            row = reference[env, policy]
            lines.append(
                f"| {env} | {policy} actions | – | – | – | {row['return']} ± {row['interval95']} "
                f"| – | {row['length']} | – |"
            )
        for arm, seeds in arms.items():
            for seed, run in sorted(seeds.items()):
                last = {name: values[-1] for name, values in run.items()}
                lines.append(
                    f"| {env} | {arm} | {seed} | {last['env_steps']:,.0f} "
                    f"| {last['wall_seconds'] / 60:.0f} | {last['eval_return']:.1f} "
                    f"± {last['eval_interval95']:.1f} | {run['eval_return'].max():.1f} "
                    f"| {last['eval_length']:.0f} | {run['coverage'].mean():.1f} |"
                )
    return "\n".join(lines) + "\n"


def main(arguments: list[str]) -> int:
    """Runs a command line. Returns the exit code: 0 done, 2 bad input."""
    folder = Path(arguments[0]) if arguments else HERE
    mpl.use("Agg")
    try:
        runs, reference = read_runs(folder), read_reference()
        if not runs:
            raise ValueError(f"{folder} holds no folder of a run: there is nothing to draw.")
    except (ValueError, OSError) as error:
        print(error, file=sys.stderr)
        return 2
    draw(folder / "curves.png", runs, reference)
    (folder / "table.md").write_text(table(runs, reference))
    print(table(runs, reference), end="")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
