"""What a user would pick instead: Stable-Baselines3's SAC on the same robots, by its own defaults.

    pip install stable-baselines3
    python results/baseline.py --from states --env HopperBulletEnv-v0
    python results/baseline.py --from pixels --env HopperBulletEnv-v0 --minutes 60

`states`: the environment's own observations, an action a step, which the agent of train.py never
has. `pixels`: the images and the action repeat of train.py's default preset, the last three images
stacked, CnnPolicy. The run's folder holds settings.json, metrics.csv and made_with.json as far as
plot.py reads them, a row every 5,000 environment steps: ten episodes of the actor's mode, with the
seeds of every evaluation. A run that was stopped does not go on.
"""

import argparse
import csv
import dataclasses
import json
import re
import sys
import time
from pathlib import Path

import gymnasium as gym
import numpy as np
import torch
from gymnasium import wrappers

sys.path.insert(0, str(Path(__file__).parents[1]))
import train
from env import EnvironmentFault, Foreign, blame, coverage, find_spec
from results.made_with import made_with
from results.play import exit_code

COLUMNS = "env_steps wall_seconds eval_return eval_interval95 eval_length coverage".split()
EVERY, EPISODES, STACK, ROWS = 5_000, 10, 3, 50_000  # ROWS: of a replay of images, 4 GB
USUAL = {  # by its name in plot.py, what its settings.json holds beside env and seed
    "sac-states": {"steps": 100_000, "minutes": None, "action_repeat": 1},
    "sac-pixels": {"steps": 100_000, "minutes": 60, "action_repeat": 2},
}


def make_world(arm: str, env_id: str) -> gym.Env:
    """The environment, warmed up as train.py's: a step is a decision, info["state"] its state. A
    ValueError if there is none of that name, or it cannot be made."""
    if arm == "sac-pixels":
        return train.make_env_of(dataclasses.replace(train.default_settings(), env=env_id))
    try:
        spec = find_spec(env_id)
        with blame(env_id):
            world = gym.make(spec, render_mode="rgb_array")
        world = Foreign(world)
    except EnvironmentFault as error:
        raise ValueError(str(error)) from error
    world = wrappers.RecordEpisodeStatistics(world)
    return wrappers.RepeatAction(world, USUAL[arm]["action_repeat"])


def episode(model, world, seed: int) -> tuple[float, int]:
    """Return and length, in environment steps, of an episode of the actor's mode; `world` is a
    vector of one environment."""
    world.seed(seed)
    seen, over = world.reset(), [False]
    while not over[0]:
        seen, _, over, infos = world.step(model.predict(seen, deterministic=True)[0])
    return infos[0]["episode"]["r"], infos[0]["episode"]["l"]


class Record:
    """SB3's callback, called after each decision: counts, evaluates when due, says when to end."""

    def __init__(self, settings: dict, folder: Path, world):
        self.settings, self.folder, self.world = settings, folder, world  # world: to evaluate in
        self.step = self.length = 0  # environment steps made; of the episode under way
        self.visited, self.began = [], time.monotonic()

    def __call__(self, local: dict, _) -> bool:
        (info,), (over,), before = local["infos"], local["dones"], self.length
        self.length = info["episode"]["l"] if over else before + self.settings["action_repeat"]
        self.step, last = self.step + self.length - before, self.step
        self.length = 0 if over else self.length
        # as many states as train.py has of so many steps: coverage depends on their number
        if train.passed(last, self.step, train.Settings.action_repeat):
            self.visited.append(info["state"])
        late = self.elapsed() >= 60 * (self.settings["minutes"] or float("inf"))
        ends = late or self.step >= self.settings["steps"]
        if ends or train.passed(last, self.step, EVERY):
            self.report(local["self"])
        return not ends

    def elapsed(self) -> float:
        """Seconds since it began, evaluations among them."""
        return time.monotonic() - self.began

    def report(self, model) -> None:
        """A row of metrics.csv, and a line."""
        played = [episode(model, self.world, train.evaluation_seed(k)) for k in range(EPISODES)]
        returns, lengths = np.array(played).T
        covered, self.visited = coverage(np.array(self.visited)), []
        found = returns.mean(), train.interval95(returns), lengths.mean(), covered
        row = [self.step, *(f"{value:.6g}" for value in (self.elapsed(), *found))]
        with open(self.folder / "metrics.csv", "a", newline="") as file:
            csv.writer(file).writerows([row] if file.tell() else [COLUMNS, row])
        print(*(f"{name} {value}" for name, value in zip(COLUMNS, row, strict=True)), flush=True)


def learn(settings: dict, folder: Path, sb3) -> None:
    """A run of SB3's SAC from beginning to end, in a folder that it makes. A ValueError if there is
    one already, or nothing to do."""
    if folder.exists():
        raise ValueError(f"{folder} is there already: name another --run-dir.")
    if any(settings[of] is not None and settings[of] <= 0 for of in ("steps", "minutes")):
        raise ValueError("--steps and --minutes have to be above 0.")
    arm, vector = settings["arm"], sb3.common.vec_env
    worlds = [vector.DummyVecEnv([lambda: make_world(arm, settings["env"])]) for _ in range(2)]
    own = {"policy": "MlpPolicy"}
    if arm == "sac-pixels":
        worlds = [vector.VecFrameStack(world, STACK) for world in worlds]
        own = {"policy": "CnnPolicy", "buffer_size": ROWS}
    model = sb3.SAC(env=worlds[0], seed=settings["seed"], **own)
    folder.mkdir(parents=True)
    (folder / "settings.json").write_text(json.dumps(settings, indent=2) + "\n")
    by = made_with() | {"threads": torch.get_num_threads(), "stable_baselines3": sb3.__version__}
    (folder / "made_with.json").write_text(json.dumps([by], indent=2) + "\n")
    model.learn(settings["steps"], Record(settings, folder, worlds[1]))


def main(arguments: list[str]) -> int:
    """Runs a command line. Returns its `exit_code`; 2 also without Stable-Baselines3."""
    parser = argparse.ArgumentParser(prog="python results/baseline.py")
    add = parser.add_argument
    add("--from", choices=("states", "pixels"), required=True, dest="sees", help="what SAC sees")
    add("--env", default="HopperBulletEnv-v0", help="%(default)s")
    add("--seed", type=int, default=0, help="%(default)s")
    add("--steps", type=int, help="environment steps: 100,000")
    add("--minutes", type=float, help="ends it if it is not over by then; of pixels: 60")
    add("--run-dir", type=Path, help="folder to create: runs/sac-FROM-ENV-seedSEED")
    command = parser.parse_args(arguments)
    arm = f"sac-{command.sees}"
    given = {k: v for k, v in vars(command).items() if k in ("steps", "minutes") and v is not None}
    settings = {"env": command.env, "arm": arm, "seed": command.seed} | USUAL[arm] | given
    name = re.sub(r"[^\w.-]", "-", f"{arm}-{command.env}-seed{command.seed}")
    folder = command.run_dir or Path("runs") / name
    try:
        import stable_baselines3 as sb3
    except ImportError:
        print("Stable-Baselines3 is not here: pip install stable-baselines3.", file=sys.stderr)
        return 2
    return exit_code(lambda: learn(settings, folder, sb3))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
