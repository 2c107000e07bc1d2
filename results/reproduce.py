"""The paper's figure by one command: arms × environments × seeds, some processes at once.

    python results/reproduce.py [--smoke] [-- OPTIONS OF TRAIN.PY]

A run is a train.py of one thread in OUT/ENV-ARM-seedS; what it says is in the .log beside it, what
made it in its made_with.json. The same command again skips finished runs and takes up the others.
"""

import argparse
import contextlib
import dataclasses
import json
import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from filelock import FileLock, Timeout
from tqdm import tqdm

sys.path.insert(0, str(Path(__file__).parents[1]))
import train
from results import plot
from results.made_with import record

ROBOTS = ("Hopper", "Walker2D", "HalfCheetah", "Ant")  # of the paper's figure
TINY = "--deter 16 --stoch 8 --units 16 --depth 2 --mdn-units 16 --horizon 5 --prefill 60 "
TINY += "--batch-size 3 --length 8 --eval-every 100 --eval-episodes 2 --eval-max-steps 50"
OWN = ("--steps", "--env", "--arm", "--seed", "--run-dir", "--resume")  # that each run is given
SMOKE = dict(seeds=[0], steps=200, out=Path("runs/smoke"), options=TINY.split())


def parse(arguments: list[str]) -> argparse.Namespace:
    """The command line; bad input ends the process with one sentence and exit code 2."""
    parser = argparse.ArgumentParser(
        prog="reproduce.py", epilog="After --: options of train.py.", allow_abbrev=False
    )
    parser.error = lambda text: parser.exit(2, f"{text}\n")
    add, allowed = parser.add_argument, getattr(os, "sched_getaffinity", None)  # not on macOS
    cores = len(allowed(0)) if allowed else os.cpu_count() or 1
    add("--arms", nargs="+", choices=train.ARMS, default=list(train.ARMS), help="all four arms")
    add("--envs", nargs="+", default=[f"{e}BulletEnv-v0" for e in ROBOTS], help="four robots")
    add("--seeds", nargs="+", type=int, default=[0, 1], help="%(default)s")
    add("--steps", type=int, default=100_000, help="environment steps of each run: %(default)s")
    add("--out", type=Path, default=Path("runs/figure"), help="folder of the runs: %(default)s")
    add("--workers", type=int, default=cores, help="runs at once, a thread each: %(default)s")
    add("--index", type=int, help="make this run alone, in the foreground: for a job array")
    add("--list", action="store_true", help="print each run's index and name, and end")
    add("--smoke", action="store_true", help="all of it with tiny networks, in two minutes")
    parser.set_defaults(**(SMOKE if "--smoke" in arguments else {"options": []}))
    cut = [*arguments, "--"].index("--")
    command, options = parser.parse_args(arguments[:cut]), arguments[cut + 1 :]
    if own := [a for a in options if a.partition("=")[0].replace("_", "-") in OWN]:
        parser.error(
            f"{own[0]} after --: give --steps, --envs, --arms, --seeds or --out before it."
        )
    command.runs = runs(command, command.options + options)
    if command.index is not None:
        command.runs = dict([*command.runs.items()][command.index :][:1])
    low = command.workers < 1 or min(command.seeds) < 0 or (command.index or 0) < 0
    if low or not command.runs:
        parser.error("--workers: 1 or more; --seeds: 0 or more; --index: one that --list shows.")
    try:  # what the first run cannot have, none can
        train.parse(next(iter(command.runs.values())))
        if not command.list:
            command.out.mkdir(parents=True, exist_ok=True)
            for folder, options in command.runs.items():
                if others := differing(folder, options):
                    raise ValueError(f"{folder} is of a run with {others}: name another --out.")
    except (ValueError, OSError) as error:
        parser.error(error)
    return command


def runs(command: argparse.Namespace, options: list[str]) -> dict[Path, list[str]]:
    """Each run's folder and options; seed by seed, so that a figure cut short is fair to arms."""
    return {
        command.out / re.sub(r"[^\w.-]", "-", f"{env}-{arm}-seed{seed}"):
        [*options, f"--steps={command.steps}", f"--env={env}", f"--arm={arm}", f"--seed={seed}"]
        for seed in command.seeds for env in command.envs for arm in command.arms
    }  # fmt: skip


def differing(folder: Path, options: list[str]) -> str:
    """In which settings the run that a folder holds is not of these options, of whichever version
    it is: none, if there is none."""
    wanted = dataclasses.asdict(train.parse(options).settings)
    try:
        made = dict(json.loads((folder / "settings.json").read_text()))
        goes_on = ["steps"] if made["steps"] < wanted["steps"] else []
    except (OSError, ValueError, TypeError, KeyError):  # damaged, and train.py will say so
        return ""
    now = dict.fromkeys(made) | wanted  # None: a setting of another version's
    free = ("eval_episodes", "checkpoint_minutes", *goes_on)  # the rest makes another figure
    return ", ".join(sorted(train.fixed_changes(made, now, free)))


def steps_made(folder: Path, steps: int) -> int:
    """Environment steps of a run at its last evaluation; `steps` only if it is finished."""
    path = folder / "metrics.csv"
    last = "".join(path.read_text().splitlines()[-1:] if path.exists() else []).partition(",")[0]
    made = int(last) if last.isdigit() else 0
    return min(made, steps if (folder / "weights.pt").exists() else steps - 1)


def start(folder: Path, options: list[str], log) -> subprocess.Popen:
    """Begin a run or take it up; in its own session, so that Ctrl-C comes through `make` alone."""
    whole = (folder / "settings.json").exists()  # train.py writes it last, and then trains
    if folder.is_dir() and not whole and not (folder / "metrics.csv").exists():
        with contextlib.suppress(Timeout), FileLock(folder / "run.lock", blocking=False):
            tqdm.write(f"{folder} was ended before it began: deleted, begun anew.", sys.stderr)
            shutil.rmtree(folder)
    line = [sys.executable, train.__file__, *options, "--resume" if whole else "--run-dir", folder]
    environment = os.environ | {"OMP_NUM_THREADS": "1"}
    return subprocess.Popen(line, stdout=log, stderr=log, env=environment, start_new_session=True)


def make(folder: Path, command: argparse.Namespace, ends: list[int]) -> str:
    """Make a run, passing on to it the signals that come into `ends`: why it failed, if it did."""
    if ends or steps_made(folder, command.steps) == command.steps:
        return ""
    log, told, recorded = folder.with_name(folder.name + ".log"), 0, False
    with open(log, "a") if command.index is None else contextlib.nullcontext() as file:
        before, process = file and file.tell(), start(folder, command.runs[folder], file)
    while process.poll() is None:
        time.sleep(0.5)
        recorded = recorded or record(folder, process.pid)
        for number in ends[told:]:  # it saves and ends; at once if Ctrl-C comes again
            process.send_signal(number)
            told += 1
    if ends or steps_made(folder, command.steps) == command.steps:
        return ""
    said = log.read_bytes()[before:].decode(errors="replace").splitlines() if file else []
    if re.search("in use by|is there already", str(said)) and (folder / "settings.json").exists():
        tqdm.write(f"{folder} is another process's, and left to it.", sys.stderr)
        return ""
    return ": ".join([f"{folder.name} failed with exit code {process.returncode}", *said[-1:]])


def main(arguments: list[str]) -> int:
    """Runs a command line. Returns 0 done, 1 a run failed, 75 stopped (EX_TEMPFAIL: try again)."""
    command, ends = parse(arguments), []
    if command.list:
        print(*(f"{k} {folder.name}" for k, folder in enumerate(command.runs)), sep="\n")
        return 0
    hangup = getattr(signal, "SIGHUP", signal.SIGINT)  # Windows has none
    for number in (signal.SIGINT, signal.SIGTERM, hangup):
        if signal.getsignal(number) != signal.SIG_IGN:  # as nohup has it
            signal.signal(number, lambda number, _: ends.append(number))
    made = {folder: steps_made(folder, command.steps) for folder in command.runs}
    with ThreadPoolExecutor(command.workers) as pool, tqdm(
        total=command.steps * len(made), initial=sum(made.values()), unit=" steps", unit_scale=True,
        smoothing=0, miniters=0, mininterval=10, disable=command.index is not None,
    ) as bar:  # fmt: skip
        work = {folder: pool.submit(make, folder, command, ends) for folder in made}
        while not all(w.done() for w in work.values()):
            time.sleep(0.5)
            made = {folder: steps_made(folder, command.steps) for folder in made}
            bar.total = sum(n if work[f].done() else command.steps for f, n in made.items())
            bar.update(sum(made.values()) - bar.n)
    drawn = plot.main([str(command.out)]) if command.index is None else 0
    failed = [why for w in work.values() if (why := w.exception() or w.result())]
    for why in failed:
        train.say(why)
    if ends:
        train.say("Stopped. Go on with: " + shlex.join([sys.executable, __file__, *arguments]))
        return 75
    return 1 if failed or drawn else 0


if __name__ == "__main__":
    sys.stdout, sys.stderr = train.Patient(sys.stdout), train.Patient(sys.stderr)
    sys.exit(main(sys.argv[1:]))
