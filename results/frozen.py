"""Is it the actors that hold a run back, or its world model? Fresh actors in a frozen model.

    python results/frozen.py runs/NAME --horizon 15 --no-critic-norm

takes a run's newest world model and its replay, leaves both as they are, and trains the actor that
is evaluated (the explorer: --no-deterministic-actor) and its critic from nothing, in dreams of that
model, under the run's settings or those given. Prints what the actor is promised (from the states
of the replay, with its noise in dreams) and what then came (in episodes of its average), both
discounted: compare settings, not these two closely. Settings that earn more in the same model are
better for the actors; where all are promised far more than comes, the model is at fault, or its
critic, and only other experience mends a model. The run is stopped, or may be going on.
"""

import argparse
import sys
from pathlib import Path

import gymnasium as gym
import numpy as np
import torch

sys.path.insert(0, str(Path(__file__).parents[1]))
import train
from actors import play
from env import Replay
from results.diagnose import discounted, known
from results.play import exit_code

EXPERIENCE = (  # settings of what was seen, which only the run itself could change
    "env", "action_repeat", "camera_distance", "floor_brightness", "replay_capacity",
)  # fmt: skip


def frozen(folder: Path, like: train.Command, seed: int) -> tuple[gym.Env, train.Agent, Replay]:
    """A run's environment, an agent with its world model and all else anew, and its replay (of
    several processes, the first one's). A ValueError, in one sentence, if these settings are of
    another model or other experience."""
    s, made = like.settings, train.read_settings(folder)
    if other := [name for name in EXPERIENCE if getattr(s, name) != getattr(made, name)]:
        raise ValueError(f"{folder} has its own experience: leave out {', '.join(other)}.")
    saved = train.read_checkpoint(folder)[1]
    env = train.make_env_of(s)
    torch.manual_seed(seed)
    agent = train.make_agent(s, env, like.device, like.precision)
    of_model = (item for item in saved["agent"].items() if item[0].startswith("model."))
    train.load_weights(agent.model, {name.removeprefix("model."): x for name, x in of_model})
    replay = Replay(s.replay_capacity, env.action_space.shape[0], folder / "replay.bin")
    replay.restore(saved["kept"]["saved_rows"], saved["checksums"].numpy())
    return env, agent, replay


def learn(command: argparse.Namespace, settings: list[str]) -> None:
    """Trains an actor as that run of train.py would, with the β of its start. A line each `every`
    updates and at the end: promised to the actor itself, came and returns of its average
    (`play_rate`), of which after k updates (1 − play_rate)^k is still untrained."""
    if min(command.updates, command.every, command.episodes) < 1:
        raise ValueError("--updates, --every and --episodes are 1 at least.")
    like = train.parse(["--resume", str(command.folder), *settings])
    s = like.settings
    name = "deterministic" if s.deterministic_actor else "stochastic"  # the one that is evaluated
    env, agent, replay = frozen(command.folder, like, command.seed)
    rng, promised = np.random.default_rng(command.seed), []
    for updates in range(1, command.updates + 1):
        batch = train.to_tensors(replay.sample(s.batch_size, s.length, rng), agent.device)
        with torch.no_grad(), agent.autocast():
            seen = agent.model.observe(batch["image"], batch["action"], batch["is_first"])
        starts = train.dream_starts(seen.state, train.live_rows(agent, batch), s.starts)
        metrics = {}
        train.update_actor(agent, name, starts, s.beta_start, metrics, look=False)
        promised.append(train.as_numbers(metrics)[f"{name}_actor/return"])
        agent.follow()
        if updates % command.every == 0 or updates == command.updates:
            policy = agent.evaluated.greedy
            seeds = [train.evaluation_seed(k) for k in range(command.episodes)]
            episodes = [play(agent, env, policy, seed, s.eval_max_steps) for seed in seeds]
            returns = [discounted(e.rewards, s.gamma)[known(e, s.gamma)] for e in episodes]
            came = f"{np.concatenate(returns).mean():.1f}" if any(map(len, returns)) else "–"
            earned = " ".join(f"{e.total:.0f} ({e.length})" for e in episodes)
            said = f"promised {np.mean(promised[-50:]):.1f}, came {came}, discounted"
            print(f"{updates} updates: {said}; returns (and lengths): {earned}", flush=True)


def main(arguments: list[str]) -> int:
    """Runs a command line. Returns its `exit_code`."""
    parser = argparse.ArgumentParser(
        prog="python results/frozen.py", description="Trains fresh actors in a run's frozen model.",
        epilog="Any setting of train.py may follow, as in train.py --resume.", allow_abbrev=False,
    )  # fmt: skip
    add = parser.add_argument
    add("folder", type=Path, help="a run's folder, runs/NAME, with its replay")
    add("--updates", type=int, default=600, help="of the actor and its critic (%(default)s)")
    add("--every", type=int, default=300, help="updates between two lines (%(default)s)")
    add("--episodes", type=int, default=4, help="played for a line (%(default)s)")
    add("--seed", type=int, default=0, help="of networks and dreams (%(default)s)")
    return exit_code(lambda: learn(*parser.parse_known_args(arguments)))


if __name__ == "__main__":
    sys.stdout, sys.stderr = train.Patient(sys.stdout), train.Patient(sys.stderr)
    sys.exit(main(sys.argv[1:]))
