"""The paper's figure: arms × environments × seeds, a process each, some at once.

    python results/reproduce.py --workers 2

Runs lie in OUT/ENV-ARM-seedS. Unfinished ones are taken up, finished ones skipped, and a failure of
one stops no other; so the same command goes on after Ctrl-C, SIGTERM or a kill. It ends with the
figure and the table (results/plot.py). What stands after -- goes to train.py as it is.
"""

import argparse
import csv
import json
import os
import shlex
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

from tqdm import tqdm

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT))
from results import plot
from train import ARMS, Patient

ROBOTS = ("Hopper", "Walker2D", "HalfCheetah", "Ant")
SMOKE = shlex.split(
    "--deter 16 --stoch 8 --hidden 16 --units 16 --depth 2 --mdn-units 16 --horizon 5 "
    "--batch-size 3 --length 8 --prefill 60 --eval-every 60 --eval-episodes 1 --eval-max-steps 40"
)
SMOKE_STEPS = 120


def parse(arguments: list[str]) -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(
        prog="python results/reproduce.py", description="Makes the paper's figure.",
        epilog="What stands after -- goes to train.py as it is.",
    )  # fmt: skip
    add, cores = parser.add_argument, len(getattr(os, "sched_getaffinity", lambda _: [0])(0))
    add("--arms", nargs="+", choices=ARMS, default=list(ARMS), help="curves (all)")
    envs = [f"{robot}BulletEnv-v0" for robot in ROBOTS]
    add("--envs", nargs="+", default=envs, help="Gymnasium ids (the paper's four)")
    add("--seeds", nargs="+", type=int, default=[0, 1], help="seeds of each curve (0 1)")
    add("--steps", type=int, default=100_000, help="environment steps of a run (%(default)s)")
    add("--workers", type=int, default=cores, help="runs at once, a thread each (%(default)s)")
    add("--out", type=Path, default=Path("runs/figure"), help="folder of the runs (%(default)s)")
    add("--index", type=int, help="make this run alone, for a scheduler's job array")
    add("--list", action="store_true", help="print the runs and their indices, and end")
    add("--smoke", action="store_true", help="all of it with tiny runs, in some two minutes")
    cut = arguments.index("--") if "--" in arguments else len(arguments)
    command = parser.parse_args(arguments[:cut])
    command.options = arguments[cut + 1 :]
    if command.smoke:
        command.steps, command.seeds = SMOKE_STEPS, command.seeds[:1]
        command.options = [*SMOKE, *command.options]
    if command.workers < 1:
        parser.error("--workers must be 1 or more")
    return command


def names(command: argparse.Namespace) -> list[tuple[str, list[str]]]:
    """Each run's name and options; all arms of a seed before the next, lest a figure that is cut
    short be unfair to one."""
    return [
        (f"{env}-{arm}-seed{seed}".replace("/", "-").replace(":", "-"),
         ["--env", env, "--arm", arm, "--seed", str(seed)])
        for seed in command.seeds for env in command.envs for arm in command.arms
    ]  # fmt: skip


def steps_made(folder: Path) -> int:
    """Environment steps at the last evaluation of a run; 0 before the first."""
    path = folder / "metrics.csv"
    lines = path.read_text().splitlines() if path.exists() else []
    made = [row.get("env_steps") or "" for row in csv.DictReader(lines)]
    return int(made[-1]) if made and made[-1].isdigit() else 0


def finished(folder: Path, steps: int) -> bool:
    """Whether a run has made its steps and been evaluated at their end."""
    return (folder / "weights.pt").exists() and steps_made(folder) >= steps


def start(folder: Path, options: list[str], command: argparse.Namespace) -> subprocess.Popen:
    """Begin a run, or take it up. Its words go to NAME.log beside its folder."""
    train = [sys.executable, str(ROOT / "train.py")]
    if (folder / "settings.json").exists():
        train += ["--resume", str(folder), "--steps", str(command.steps)]
    else:
        if folder.exists():  # killed before it was whole: settings.json is written last
            shutil.rmtree(folder)
        train += ["--run-dir", str(folder), "--steps", str(command.steps), *options]
        train += command.options
    folder.parent.mkdir(parents=True, exist_ok=True)
    with open(folder.with_name(folder.name + ".log"), "a") as log:
        return subprocess.Popen(
            train, stdout=log, stderr=log, stdin=subprocess.DEVNULL,
            env=os.environ | {"OMP_NUM_THREADS": "1"}, start_new_session=True,
        )  # fmt: skip


def run_all(command: argparse.Namespace, stopped: list) -> list[str]:
    """Makes what is missing; returns the names of the runs that failed."""
    every = [(command.out / name, options) for name, options in names(command)]
    waiting = [(f, options) for f, options in every if not finished(f, command.steps)]
    running: dict[Path, subprocess.Popen] = {}
    failed, total = [], command.steps * len(every)
    before = sum(min(steps_made(f), command.steps) for f, _ in every)
    with tqdm(total=total, initial=before, unit="step", desc=f"{len(every)} runs") as bar:
        while running or (waiting and not stopped):
            while waiting and len(running) < command.workers and not stopped:
                folder, options = waiting.pop(0)
                running[folder] = start(folder, options, command)
            time.sleep(0.5)
            for folder, process in list(running.items()):
                if stopped and process.poll() is None and process not in stopped:
                    process.send_signal(signal.SIGINT)  # it saves and ends
                    stopped.append(process)
                if process.poll() is not None:
                    del running[folder]
                    if process.returncode and process.returncode != -signal.SIGINT:
                        failed.append(folder.name)
            made = sum(min(steps_made(folder), command.steps) for folder, _ in every)
            bar.update(made - bar.n)
            bar.set_postfix_str(", ".join(folder.name for folder in running)[:60])
    return failed


def record(command: argparse.Namespace) -> None:
    """What the runs were made with, beside them: made_with.json."""
    commit = subprocess.run(
        ["git", "-C", str(ROOT), "describe", "--always", "--dirty"], capture_output=True, text=True
    ).stdout.strip()
    command.out.mkdir(parents=True, exist_ok=True)
    made = {"commit": commit or "unknown", "python": sys.version.split()[0], "threads": 1,
            "options": command.options}  # fmt: skip
    (command.out / "made_with.json").write_text(json.dumps(made, indent=2) + "\n")


def main(arguments: list[str]) -> int:
    """Runs a command line. Returns the exit code: 0 done, 1 some run failed, 2 bad input."""
    command, stopped = parse(arguments), []
    chosen = names(command)
    if command.list:
        print(*(f"{k} {name}" for k, (name, _) in enumerate(chosen)), sep="\n")
        return 0
    if command.index is not None:
        if not 0 <= command.index < len(chosen):
            print(f"--index {command.index}: give 0 to {len(chosen) - 1}.", file=sys.stderr)
            return 2
        name, options = chosen[command.index]
        process = start(command.out / name, options, command)
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, lambda *_: process.send_signal(signal.SIGINT))
        return process.wait()
    record(command)
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, lambda *_: stopped.append(None))
    failed = run_all(command, stopped)
    for name in failed:
        log = (command.out / f"{name}.log").read_text(errors="replace").splitlines()
        print(f"{name} failed: {log[-1] if log else 'without a word'}", file=sys.stderr)
    if stopped:
        again = shlex.join([sys.executable, str(Path(__file__)), *arguments])
        print(f"Stopped; what was learnt is saved. Go on with: {again}")
    drawn = plot.main([str(command.out)])
    return 1 if failed else drawn


if __name__ == "__main__":
    sys.stdout, sys.stderr = Patient(sys.stdout), Patient(sys.stderr)
    sys.exit(main(sys.argv[1:]))
